"""The Typer application. Built-in commands are references, imported when they are called."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

import qrlsuite
from qrlsuite import registry
from qrlsuite.cli.extensions import add_commands
from qrlsuite.engine.terminal import as_command
from qrlsuite.errors import OptionError
from qrlsuite.specs import resolve


@dataclass(frozen=True)
class LazyCommand:
    """A built-in command.

    Attributes
    ----------
    summary:
        Its line in `qrlsuite --help`, short enough for a terminal of 80 columns.
    reference:
        `module:function`, or `module:app` for a group of commands.
    cls:
        Class of the command, `module:class`, where it is not Typer's.
    """

    name: str
    summary: str
    reference: str
    cls: str | None = None


_ROOM = "qrlsuite.cli.commands"
BUILT_IN = {
    command.name: command
    for command in (
        LazyCommand("demo", "Train three models and compare them: 2 minutes.", f"{_ROOM}.demo:demo"),
        LazyCommand("run", "Train the missing seeds of a model on a task.", f"{_ROOM}.run:run"),
        LazyCommand(
            "runs", "List the entries of the results folder, and their progress.", f"{_ROOM}.runs:app"
        ),
        LazyCommand(
            "leaderboard",
            "Rank entries by significant outperformance.",
            f"{_ROOM}.leaderboard:leaderboard",
        ),
        LazyCommand("view", "Show results in a browser while runs go on.", f"{_ROOM}.view:view"),
        LazyCommand("compare", "Say which of two entries needs fewer steps.", f"{_ROOM}.compare:compare"),
        LazyCommand(
            "plot",
            "Draw a picture of results or of an environment.",
            f"{_ROOM}.plot:plot",
            f"{_ROOM}.plot:PlotCommand",
        ),
        LazyCommand(
            "evaluate", "Play trained agents against reference policies.", f"{_ROOM}.evaluate:evaluate"
        ),
        LazyCommand("diagnose", "Analyze circuits or trained agents.", f"{_ROOM}.diagnose:diagnose"),
        LazyCommand("play", "Show an episode of a trained agent.", f"{_ROOM}.play:play"),
        LazyCommand("tune", "Search settings on seeds of their own.", f"{_ROOM}.tune:tune"),
        LazyCommand(
            "import", "Take over seeds and curves made elsewhere.", f"{_ROOM}.import_:import_entries"
        ),
        LazyCommand(
            "export",
            "Write entries to publish on a leaderboard.",
            f"{_ROOM}.export:export",
        ),
        LazyCommand("verify", "Check published entries, and train seeds again.", f"{_ROOM}.verify:verify"),
        LazyCommand("list", "List what the suite and plugins register.", f"{_ROOM}.listing:list_things"),
        LazyCommand("show", "Show options, protocols, circuits, provenance.", f"{_ROOM}.show:show"),
        LazyCommand("check", "Check plugins against every rule of the suite.", f"{_ROOM}.check:check"),
        LazyCommand(
            "doctor", "Check the installation; print facts for a bug report.", f"{_ROOM}.doctor:doctor"
        ),
        LazyCommand("study", "Run a paper's experiments, or your own, by name.", f"{_ROOM}.study:app"),
        LazyCommand("power", "Say how many seeds find a difference.", f"{_ROOM}.power:power"),
        LazyCommand("new", "Write a new plugin package.", f"{_ROOM}.new:app"),
    )
}

PluginOption = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        metavar="PATH",
        help="Load a plugin: a file, or the folder of a package, a project or an entry. Repeatable.",
        expose_value=False,
    ),
]
"""An option of every command: `cli.main` takes it out of the words before they are parsed, this one is for --help."""


def _common(plugin: PluginOption = None) -> None:
    pass


@functools.cache
def load(command: LazyCommand) -> Any:
    """Import a built-in command and return it as Typer builds it."""
    target = resolve(command.reference)
    holder = typer.Typer(rich_markup_mode=None)
    holder.callback()(_common)  # with a callback it is a group, even of one command
    if isinstance(target, typer.Typer):
        holder.add_typer(target, name=command.name)
    else:
        holder.command(command.name, cls=resolve(command.cls) if command.cls else None)(target)
    group: Any = get_command(holder)
    built = group.commands[command.name]
    for each in getattr(built, "commands", {"": built}).values():
        each.params += [option for option in group.params if option.name == "plugin"]
    return built


def split_plugins(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a command's words without `--plugin PATH`, and the paths: plugins register the names that words use."""
    rest, paths = list[str](), list[str]()
    left = iter(words)
    for word in left:
        option, equals, path = word.partition("=")
        if word == "--":
            rest += [word, *left]
        elif option != "--plugin":
            rest.append(word)
        elif path := path if equals else next(left, ""):
            paths.append(path)
        else:
            raise OptionError("--plugin needs a path, for example --plugin ring.py")
    return rest, paths


class LazyGroup(TyperGroup):
    """The group of all commands; a built-in one is a placeholder with its summary until it is called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return name, command and the remaining arguments, importing a built-in command."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, load(BUILT_IN[name]) if name in BUILT_IN else command, rest

    def invoke(self, ctx: Any) -> Any:
        """Run the command; after Ctrl-C, when it has saved and said so, the exit code is 130."""
        try:
            with as_command():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Exit(130) from None


def build() -> typer.Typer:
    """Return the application with every built-in and plugin command."""
    app = typer.Typer(
        name="qrlsuite",
        cls=LazyGroup,
        help=(
            "Does a quantum model really beat a classical one at reinforcement learning, or did five lucky seeds "
            "say so? Train many seeds, estimate sample complexity with confidence intervals, and rank by "
            "significant outperformance.\n\n"
            "Start with:  qrlsuite demo"
        ),
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    for command in BUILT_IN.values():
        app.command(command.name, help=command.summary)(lambda: None)

    @app.callback()
    def common(
        version: Annotated[
            bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_print_version)
        ] = False,
        strict: Annotated[
            bool,
            typer.Option(
                "--strict", help="Stop at a broken plugin instead of skipping it (or QRLSUITE_STRICT=1)."
            ),
        ] = False,
        plugin: PluginOption = None,
    ) -> None:
        pass  # `cli.main` sees to --strict and --plugin, for plugins are loaded before options are read

    add_commands(app, registry.load())
    return app


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"qrlsuite {qrlsuite.__version__}")
        raise typer.Exit
