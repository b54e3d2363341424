"""The built-in tasks, one TOML file each beside this module, and the built-in studies in `studies/`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import StudySpec, TaskSpec


@hookimpl
def register_tasks(register: Callable[[TaskSpec], None]) -> None:
    """Register every TOML file of this folder under its `name`, with its `summary`."""
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        head = tomllib.loads(path.read_text(encoding="utf-8"))
        register(TaskSpec(name=head["name"], summary=head["summary"], path=str(path)))


@hookimpl
def register_studies(register: Callable[[StudySpec], None]) -> None:
    """Register every TOML file of `studies/`."""
    folder = Path(__file__).parent
    for path in sorted((folder / "studies").glob("*.toml")):
        head = tomllib.loads(path.read_text(encoding="utf-8"))
        register(StudySpec(name=head["name"], summary=head["summary"], path=str(path)))
