"""Hooks: one for every kind of spec, one for commands, one for columns. Their manual is docs/api/hooks.md."""

from __future__ import annotations

import pluggy

from qrlsuite import specs

PROJECT = "qrlsuite"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)

REGISTER = {f"register_{spec.kinds}": spec for spec in specs.KINDS.values()}
"""The kind that a hook `register_KINDS(register)` registers: it calls `register` with specs of that kind."""

HOOKS = {
    "register_commands": hookspec(lambda app: None),
    "register_columns": hookspec(lambda register: None),
} | {name: hookspec(lambda register: None) for name in REGISTER}
"""Every hook: a function with its arguments."""
