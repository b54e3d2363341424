"""What things keep to that are registered by the path of their TOML file: tasks and studies."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from qrlsuite import specs
from qrlsuite.errors import QrlSuiteError
from qrlsuite.testing.findings import BrokenRuleError, require


def check_path(spec: specs.TaskSpec | specs.StudySpec) -> None:
    """Require that the path leads to a file, from whatever folder a command runs in."""
    require(
        Path(spec.path).is_absolute(),
        f"path = {spec.path!r} is relative to the folder where a command runs: write str(Path(__file__).parent / ...)",
    )
    require(
        Path(spec.path).is_file(),
        f"{spec.path} is not there: is the TOML file among the package data, [tool.setuptools.package-data]?",
    )


@contextlib.contextmanager
def in_its_words() -> Iterator[None]:
    """Let the suite's own errors say what is broken: they name the place and the remedy."""
    try:
        yield
    except QrlSuiteError as error:
        raise BrokenRuleError(str(error)) from error


def read(spec: specs.TaskSpec | specs.StudySpec) -> str:
    """Return the file's text."""
    path = Path(spec.path)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BrokenRuleError(f"{path.name} is not text in UTF-8, as TOML is: {error}") from error


def check_names(spec: specs.TaskSpec | specs.StudySpec, name: str, summary: str, otherwise: str) -> None:
    """Require that name and summary are the file's.

    Parameters
    ----------
    name, summary:
        As the file has them.
    otherwise:
        What another name would lead to.
    """
    require(name == spec.name, f"registered as '{spec.name}', and the file says name = '{name}': {otherwise}")
    require(
        summary == spec.summary,
        f"registered with the summary {spec.summary!r}, and the file says {summary!r}: read it from the file",
    )
