"""The built-in tasks: one TOML file each, beside this module."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import TaskSpec


@hookimpl
def register_tasks(register: Callable[[TaskSpec], None]) -> None:
    """Register every TOML file of this folder under its `name`, with its `summary`."""
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        head = tomllib.loads(path.read_text(encoding="utf-8"))
        register(TaskSpec(name=head["name"], summary=head["summary"], path=str(path)))
