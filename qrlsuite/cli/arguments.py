"""Options that several commands share."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite.errors import OptionError


def is_typed(context: typer.Context, name: str) -> bool:
    """Return whether a parameter was typed, and is not the default or a variable's value."""
    return getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE"


def refuse_typed(context: typer.Context, where: str, *names: str) -> None:
    """Refuse typed options, by their parameters, `where` they change nothing."""
    for parameter in context.command.params:
        if parameter.name in names and is_typed(context, parameter.name):
            raise OptionError(f"{parameter.opts[0]} changes nothing {where}: leave it out")


def names_of(kind: str) -> Callable[[str], list[str]]:
    """Return a function that completes a registered name; `kind` is as in `qrlsuite list`."""

    def complete(incomplete: str) -> list[str]:
        from qrlsuite import registry, specs

        return [name for name in registry.load().names(specs.kind(kind)) if name.startswith(incomplete)]

    return complete


def entries_here(context: typer.Context, incomplete: str) -> list[str]:
    """Complete the beginning of an entry's name, or of TASK/NAME: entries of the results folder, and published ones."""
    from qrlsuite.leaderboard.shelf.published import PUBLISHED
    from qrlsuite.results.store import entries

    folders = [Path(context.params.get("runs") or os.environ.get("QRLSUITE_RUNS") or "runs")]
    folders += [PUBLISHED] if any(option.name == "published" for option in context.command.params) else []
    task = context.params.get("task")
    plain = isinstance(task, str) and re.fullmatch(r"[\w.+-]+", task) and not task.endswith(".toml")
    among = task if plain else None
    paths = [store.path for folder in folders if folder.is_dir() for store in entries(folder, among)]
    names = {f"{path.parent.name}/{path.name}" if "/" in incomplete else path.name for path in paths}
    return sorted(name for name in names if name.startswith(incomplete) and name.isprintable())


def split_settings(words: Sequence[str] | None) -> tuple[list[str], dict[str, Any]]:
    """Divide words into names and settings: `NAME=VALUE` is a setting, `mlp width=16` in one word is a name."""
    from qrlsuite.options import parse_setting

    names = [word for word in words or () if not re.match(r"[^\s=]+=", word)]
    settings = [parse_setting(word, "") for word in words or () if word not in names]
    return names, {setting.full_name: setting.value for setting in settings}


TaskOption = Annotated[
    str | None, typer.Option("--task", help="Only this task.", autocompletion=names_of("tasks"))
]
TasksOption = Annotated[
    list[str] | None,
    typer.Option(
        "--task",
        help="Only this task. Repeat it to compare entries by their means over several tasks.",
        autocompletion=names_of("tasks"),
    ),
]
TrainedTaskOption = Annotated[
    str,
    typer.Option(
        "--task",
        help="A task (see `qrlsuite list tasks`) or a task file's path.",
        autocompletion=names_of("tasks"),
    ),
]
AmongOption = Annotated[
    str | None, typer.Option("--task", help="Look for ENTRY among the entries of this task only.")
]
EntryOption = Annotated[
    list[str] | None,
    typer.Option(
        "--entry",
        metavar="ENTRY",
        help="Only this entry: its name or label, or the beginning of one, after [TASK/]. Repeatable.",
        autocompletion=entries_here,
    ),
]
HorizonOption = Annotated[
    int | None,
    typer.Option(
        "--horizon",
        metavar="STEPS",
        min=1,
        help="Cut all entries to their first STEPS environment steps; leave out shorter entries.",
    ),
]
RunsOption = Annotated[
    Path, typer.Option("--runs", metavar="DIR", help="The results folder.", envvar="QRLSUITE_RUNS")
]
RuleOption = Annotated[
    str | None,
    typer.Option(
        "--rule",
        metavar="NAME",
        help="Also judge the cells of the task's grid by this rule: paper, or a name of `qrlsuite list rules`.",
    ),
]
AlphaOption = Annotated[
    float,
    typer.Option(
        "--alpha", metavar="P", help="Probability of any false difference on the board, between 0 and 1."
    ),
]
PublishedOption = Annotated[
    bool,
    typer.Option("--published", help="With the published entries that come with the suite."),
]
LabelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--label", metavar="ENTRY=TEXT", help="Your own name for an entry, shown as it is. Repeatable."
    ),
]
TableFileOption = Annotated[
    Path | None, typer.Option("--out", metavar="FILE", help="Write the table to this tex or md file.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
