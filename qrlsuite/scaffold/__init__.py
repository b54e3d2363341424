"""New plugin packages, written from the templates beside this file.

A template `templates/KIND/NAME.jinja` becomes the file NAME of the package; templates in `templates/common` become
files of every package.
"""

from __future__ import annotations

import importlib.util
import keyword
import math
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from qrlsuite import registry, specs
from qrlsuite.errors import OptionError, QrlSuiteError

if TYPE_CHECKING:
    import jinja2

TEMPLATES = Path(__file__).parent / "templates"
NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
LONGEST = 40
WAY = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95)
"""Where a new task's thresholds lie on the way from the random to the best known score."""


class ScaffoldError(QrlSuiteError):
    """A plugin package cannot be written under that name or at that place."""


class Kind(StrEnum):
    """What a new plugin adds."""

    ansatz = "ansatz"
    model = "model"
    environment = "environment"
    algorithm = "algorithm"
    task = "task"
    tracker = "tracker"


@dataclass(frozen=True)
class _Words:
    """Texts of a kind: a summary, the commands after installing, and the files besides registration.

    A kind with a task has a range, too: the scores of random actions and of the best policy known.
    """

    summary: str
    commands: tuple[str, ...]
    files: dict[str, str]
    range: tuple[float, float] | None = None


_WORDS = {
    Kind.ansatz: _Words(
        "data re-uploading on a ring of qubits",
        (
            "qrlsuite show ansatz {thing}",
            "qrlsuite run --task beam6g --model vqc-native --set ansatz={thing} --quick",
        ),
        {"ansatz.py": "the circuit: edit this"},
    ),
    Kind.model: _Words(
        "a network with one hidden layer",
        ("qrlsuite show model {thing}", "qrlsuite run --task beam6g --model {thing} --quick"),
        {"model.py": "the network: edit this"},
    ),
    Kind.environment: _Words(
        "walk along a line to a place",
        ("qrlsuite show task {thing}", "qrlsuite run --task {thing} --model mlp --seeds 20"),
        {"environment.py": "the environment: edit this", "task.toml": "a task with it: protocol and ranking"},
        range=(0.65, 1.0),
    ),
    Kind.algorithm: _Words(
        "policy gradient with a mean baseline",
        (
            "qrlsuite show algorithm {thing}",
            "qrlsuite run {thing} mlp --task cartpole --quick",
        ),
        {"algorithm.py": "the algorithm: edit this"},
    ),
    Kind.task: _Words(
        "balance a pole for 200 steps",
        ("qrlsuite show task {thing}", "qrlsuite run --task {thing} --model mlp --quick"),
        {"task.toml": "environment, protocol and ranking: edit this"},
        range=(0.11, 1.0),
    ),
    Kind.tracker: _Words(
        "every epoch as a line of a CSV file",
        ("qrlsuite run --task beam6g --model mlp --quick --track {thing}=epochs.csv",),
        {"tracker.py": "the tracker: edit this"},
    ),
}


@dataclass(frozen=True)
class Package:
    """A plugin package that can be written.

    Attributes
    ----------
    name:
        Name of the distribution: `acme-ring`.
    module:
        Name to import: `acme_ring`.
    thing:
        Registered name: the distribution's without a leading `qrlsuite-`.
    commands:
        Commands to type once it is installed.
    files:
        Text by path within the package.
    """

    name: str
    module: str
    thing: str
    commands: tuple[str, ...]
    files: dict[str, str]


def package(name: str, kind: Kind, scores: tuple[float, float] | None = None) -> Package:
    """Render a plugin package.

    Parameters
    ----------
    name:
        Name of the distribution, `acme-ring`: lower-case words and digits with single hyphens between them.
    kind:
        Kind of thing that it adds.
    scores:
        For a kind with a task: the scores of random actions and of the best policy known, between which its
        thresholds are spread. Numbers outside [0, 1] are returns. Default: scores of the template's environment.
    """
    kinds: tuple[type[specs.Spec], ...] = (
        specs.kind(kind),
        *([specs.TaskSpec] if kind is Kind.environment else []),
    )
    module, thing = names_of(name, kinds)
    template_words = _WORDS[kind]
    checks = [
        f"qrlsuite check {each.kind}:{thing}" for each in kinds
    ]  # with the kind: the distribution has the same name
    commands = tuple(line.format(thing=thing) for line in ("pytest", *checks, *template_words.commands))
    source = f"src/{module}"
    contents = {
        f"{source}/__init__.py": f"registers the {kind} with qrlsuite",
        **{f"{source}/{file}": meaning for file, meaning in template_words.files.items()},
        f"tests/test_{module}.py": "runs qrlsuite's checks",
    }
    values = {
        "name": name,
        "module": module,
        "thing": thing,
        "kind": str(kind),
        "article": "an" if kind[0] in "ae" else "a",
        "summary": template_words.summary,
        "things": [(each.kind, thing) for each in kinds],
        "check": checks[0],
        "commands": commands,
        "contents": list(contents.items()),
        "files": any(file.endswith(".toml") for file in template_words.files),
        **_ranking(kind, scores),
    }

    def render(template: str) -> str:
        return _templates().get_template(template).render(values)

    files = rendered(values)
    for path in contents:
        template = "test.py" if path.startswith("tests/") else Path(path).name
        if path not in files or (TEMPLATES / kind / f"{template}.jinja").exists():
            files[path] = render(f"{kind}/{template}.jinja")
    files[f"{source}/py.typed"] = ""
    return Package(name, module, thing, commands, files)


def rendered(values: Mapping[str, object]) -> dict[str, str]:
    """Return the files of every package, with values in the places that their templates have for them."""
    templates = {name: name for name in ("pyproject.toml", "README.md")}
    templates[f"tests/test_{values['module']}.py"] = "test.py"
    return {
        path: _templates()
        .get_template(f"common/{template}.jinja")
        .render({**values, "versions": compatible_versions()})
        for path, template in templates.items()
    }


def commands_of(kind: str, thing: str) -> tuple[str, ...]:
    """Return the commands for a thing once it is installed; empty if its kind has no template."""
    return (
        tuple(line.format(thing=thing) for line in _WORDS[Kind(kind)].commands)
        if kind in Kind.__members__
        else ()
    )


def _templates() -> jinja2.Environment:
    import jinja2

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        autoescape=False,  # Python and TOML, of names that `names_of` has checked
    )


def _ranking(kind: Kind, scores: tuple[float, float] | None) -> dict[str, object]:
    """Return the range of scores and the thresholds for a task's template."""
    usual = _WORDS[kind].range
    if usual is None:
        if scores is not None:
            raise OptionError(f"--range: a new {kind} has no task; it goes with --kind task or environment")
        return {}
    worst, best = scores or usual
    span = best - worst
    if not 0 < span < math.inf:
        raise OptionError(
            f"--range {worst:g} {best:g}: give two numbers, the score of random actions and then the best known "
            "one, which is larger"
        )
    digits = 2 - math.floor(math.log10(span))
    relative = worst >= 0 and best <= 1
    levels = [worst + part * span for part in WAY]
    cells = [round(1 - level if relative else level, digits) for level in levels]
    return {
        "relative": relative,
        "random": worst,
        "best": best,
        "way": ", ".join(f"{part:.0%}" for part in WAY),
        "cells": sorted(cells),
        "reference": cells[WAY.index(0.9)],
    }


def names_of(name: str, kinds: Sequence[type[specs.Spec]]) -> tuple[str, str]:
    """Check a distribution's name; returns the module's name and the registered name.

    Parameters
    ----------
    kinds:
        Kinds in which the registered name must be free.
    """
    if not NAME.fullmatch(name) or len(name) > LONGEST:
        usable = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-0123456789")[:LONGEST].rstrip("-")
        raise ScaffoldError(
            f"'{name}' cannot be the name of a package: lower-case letters, digits and single hyphens, beginning with "
            f"a letter, {LONGEST} characters at most" + (f"; for example {usable}" if usable else "")
        )
    module, thing = name.replace("-", "_"), name.removeprefix("qrlsuite-")
    if keyword.iskeyword(module) or module in sys.stdlib_module_names:
        raise ScaffoldError(f"'{module}' is a word of Python; for example acme-{name}")
    if importlib.util.find_spec(module) is not None:
        raise ScaffoldError(
            f"a module '{module}' is installed already: choose another name, for example acme-{name}"
        )
    for each in kinds:
        if thing in registry.load().of(each):
            article = "an" if each.kind[0] in "ae" else "a"
            raise ScaffoldError(
                f"there is {article} {specs.title(each, thing)} already (`qrlsuite list {each.kinds}`): "
                f"choose another name, for example acme-{thing}"
            )
    return module, thing


def compatible_versions() -> str:
    """Return the version range that a plugin written for this version asks for: `>=0.1,<0.2`, or `>=1.2,<2`."""
    from qrlsuite import __version__

    major, minor = (int(number) for number in __version__.split(".")[:2])
    return f">={major}.{minor},<{major + 1}" if major else f">=0.{minor},<0.{minor + 1}"


def write(package: Package, out: Path) -> Path:
    """Write a package below a folder; returns the package's folder."""
    folder = out / package.name
    if folder.exists() or folder.is_symlink():
        raise ScaffoldError(f"{folder} exists already and is left unchanged: choose another name or --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{package.name}-", dir=out) as temporary:
            draft = Path(temporary) / package.name
            for path, text in package.files.items():
                file = draft / path
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
            shutil.move(draft, folder)
    except OSError as error:
        raise ScaffoldError(f"{folder} cannot be written: {error.strerror or error}") from None
    return folder
