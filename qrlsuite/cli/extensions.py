"""Adds the commands of plugins; one that fails, or whose name is taken, is skipped and reported."""

from __future__ import annotations

from typing import Any

import typer
from typer.main import get_command

from qrlsuite.engine.terminal import printable
from qrlsuite.errors import PluginError
from qrlsuite.registry import Registry, words


def add_commands(app: typer.Typer, registry: Registry) -> None:
    """Call every plugin's `register_commands`."""
    taken = {_name(info) for info in (*app.registered_commands, *app.registered_groups)}
    for implementation in registry.manager.hook.register_commands.get_hookimpls():
        before = list(app.registered_commands), list(app.registered_groups), app.registered_callback
        try:
            implementation.function(*(app for _ in implementation.argnames))
            new = _names(*_added(app, *before))
            _check(new, taken)
            taken |= set(new)
        except (Exception, SystemExit) as error:
            app.registered_commands[:], app.registered_groups[:], app.registered_callback = before
            distribution, _, module = implementation.plugin_name.partition(":")
            reason = str(error) if isinstance(error, PluginError) else words(error)
            problem = (
                f"plugin '{module}' of distribution '{distribution}': hook 'register_commands': {reason}"
            )
            registry.report(f"{problem}; its commands are left out")


def _added(
    app: typer.Typer, commands: list[Any], groups: list[Any], callback: Any
) -> tuple[list[Any], list[Any]]:
    """Return the commands and groups that were added to the earlier ones."""
    first, second = app.registered_commands[: len(commands)], app.registered_groups[: len(groups)]
    if first != commands or second != groups or app.registered_callback is not callback:
        raise PluginError("it changes other commands or the callback, but may only add commands")
    return app.registered_commands[len(commands) :], app.registered_groups[len(groups) :]


def _names(commands: list[Any], groups: list[Any]) -> list[str]:
    """Build commands, which typer does late and for all at once, and return the names that they have."""
    names: list[str] = []
    for command, group in [*((info, None) for info in commands), *((None, info) for info in groups)]:
        alone = typer.Typer(rich_markup_mode=None)
        alone.callback()(lambda: None)
        alone.registered_commands += [command] if command else []
        alone.registered_groups += [group] if group else []
        names += getattr(get_command(alone), "commands", {})
    return names


def _check(names: list[str], taken: set[str]) -> None:
    for position, name in enumerate(names):
        if not name or name != printable(name) or " " in name or name.startswith("-"):
            raise PluginError(f"nobody can type the command name {name!r}: letters, digits and hyphens")
        if name in taken or name in names[:position]:
            raise PluginError(f"there is a command '{name}' already")


def _name(info: Any) -> str:
    """Return the name that a command or a group of the suite has."""
    return str(info.name or info.callback.__name__.lower().replace("_", "-"))
