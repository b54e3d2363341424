"""Rules of TOML files of tasks and studies."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from qrlsuite import specs
from qrlsuite.errors import QrlSuiteError
from qrlsuite.testing.findings import BrokenRuleError, Checklist, require

T = TypeVar("T")
FileSpec = specs.TaskSpec | specs.StudySpec


@contextlib.contextmanager
def in_its_words() -> Iterator[None]:
    """Turn the suite's own errors into broken rules: they name the place and the remedy."""
    try:
        yield
    except QrlSuiteError as error:
        raise BrokenRuleError(str(error)) from error


def parsed(spec: FileSpec, parse: Callable[[str, str], T]) -> T:
    """Return the parsed file; `parse` takes its text and its name."""
    path = Path(spec.path)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BrokenRuleError(f"{path.name} is not text in UTF-8, as TOML is: {error}") from error
    with in_its_words():
        return parse(text, path.name)


def check_format(
    rules: Checklist, spec: FileSpec, parse: Callable[[str, str], T], valid: str, cause: str = ""
) -> T | None:
    """Check that the file is there and valid.

    Parameters
    ----------
    valid:
        Statement about a valid file.
    cause:
        Likely cause of errors that are not the suite's own.

    Returns
    -------
    object or None
        The parsed file; None where there is none.
    """
    if not rules.run(
        "file", "an absolute path, to a file that is there", lambda: check_path("path", spec.path)
    ):
        return None
    results: list[T] = []
    rules.run("format", valid, lambda: results.append(parsed(spec, parse)), cause)
    return results[0] if results else None


def check_names(rules: Checklist, spec: FileSpec, name: str, summary: str, otherwise: str) -> None:
    """Check that name and summary are the file's.

    Parameters
    ----------
    name, summary:
        As the file has them.
    otherwise:
        Consequence of another name.
    """
    rules.run(
        "says what is registered",
        "name and summary are the file's",
        lambda: _check_names(spec, name, summary, otherwise),
    )


def check_path(field: str, path: str) -> None:
    """Require that a field of a spec leads to a file, from whatever folder a command runs in."""
    require(
        Path(path).is_absolute(),
        f"{field} = {path!r} is relative to the folder where a command runs: write str(Path(__file__).parent / ...)",
    )
    require(
        Path(path).is_file(),
        f"{path} is not there: is the TOML file among the package data, [tool.setuptools.package-data]?",
    )


def _check_names(spec: FileSpec, name: str, summary: str, otherwise: str) -> None:
    require(name == spec.name, f"registered as '{spec.name}', and the file says name = '{name}': {otherwise}")
    require(
        summary == spec.summary,
        f"registered with the summary {spec.summary!r}, and the file says {summary!r}: read it from the file",
    )
