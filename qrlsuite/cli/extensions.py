"""Commands that plugins bring: one that fails, or takes a name that is taken, is left out and reported."""

from __future__ import annotations

from typing import Any

import typer

from qrlsuite.errors import PluginError
from qrlsuite.registry import Registry, words


def add_commands(app: typer.Typer, registry: Registry) -> None:
    """Call every plugin's `register_commands`.

    Raises
    ------
    PluginError
        If one fails, and problems of plugins are fatal (`qrlsuite --strict`).
    """
    for implementation in registry.manager.hook.register_commands.get_hookimpls():
        commands, groups = list(app.registered_commands), list(app.registered_groups)
        taken = {_name(info) for info in (*commands, *groups)}
        try:
            implementation.function(*(app for _ in implementation.argnames))
            for info in (*app.registered_commands[len(commands) :], *app.registered_groups[len(groups) :]):
                if _name(info) in taken:
                    raise PluginError(f"there is a command '{_name(info)}' already")
        except (Exception, SystemExit) as error:
            app.registered_commands[:], app.registered_groups[:] = commands, groups
            distribution, _, module = implementation.plugin_name.partition(":")
            reason = str(error) if isinstance(error, PluginError) else words(error)
            problem = (
                f"plugin '{module}' of distribution '{distribution}': hook 'register_commands': {reason}"
            )
            registry.report(f"{problem}; its commands are left out")


def _name(info: Any) -> str:
    """Return the name that a Typer command or group will have."""
    if info.name:
        return str(info.name)
    function = getattr(info, "callback", None)
    if function is not None:
        return str(function.__name__).lower().replace("_", "-")
    inner = getattr(info, "typer_instance", None)
    return str(getattr(getattr(inner, "info", None), "name", "") or "")
