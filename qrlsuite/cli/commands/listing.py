"""`qrlsuite list`: list tasks, models, algorithms and everything else that is registered."""

from __future__ import annotations

import dataclasses
import itertools
import json
import textwrap
from typing import Annotated

import typer

from qrlsuite import registry, specs
from qrlsuite.cli.arguments import JsonOption
from qrlsuite.engine.terminal import printable, table_console
from qrlsuite.registry import Registry

SHOWN = 8
"""Names of a kind that `list plugins` shows."""
MANY = 4
"""Variants of one thing that `list` folds into a line."""


def list_things(
    kind: Annotated[
        str | None,
        typer.Argument(
            help="tasks, models, algorithms, environments, ansatzes, circuit-backends, ..., plugins; "
            "default: all that is registered"
        ),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """List the things that the suite and plugins register, with their distribution.

    `plugins` shows each plugin with its version, its things and its problems.

    Examples: qrlsuite list models; qrlsuite list plugins
    """
    registered = registry.load()
    if kind == "plugins":
        _list_plugins(registered, json_output)
        return
    only = None if kind is None else specs.kind(kind)
    rows = [
        {"kind": each.spec.kinds, "name": each.spec.name, "summary": each.spec.summary}
        | {"distribution": each.distribution}
        for each in registered
        if only in (None, type(each.spec))
    ]
    rows += _published_studies() if only in (None, specs.StudySpec) else []
    rows.sort(key=lambda row: list(specs.KINDS).index(row["kind"]))
    if json_output:
        typer.echo(json.dumps(rows))
        return
    _print(rows, folded=kind is None)


def _published_studies() -> list[dict[str, str]]:
    """Return the studies with looks that come with the suite; each is listed by its file."""
    from qrlsuite.leaderboard.shelf import PLANS
    from qrlsuite.studies.study import load

    return [
        {"kind": "studies", "name": path.parent.name, "distribution": "qrlsuite"}
        | {"summary": load(str(path)).summary}
        for path in sorted(PLANS.glob("*/plan.toml"))
    ]


def _list_plugins(known: Registry, json_output: bool) -> None:

    if json_output:
        rows = [dataclasses.asdict(plugin) for plugin in known.plugins]
        typer.echo(json.dumps({"plugins": rows, "problems": known.problems}))
        return
    last = ""
    for plugin in known.plugins:
        if plugin.distribution != last:
            needs = f", for qrlsuite{plugin.requires}" if plugin.requires else ""
            if not needs and plugin.version and plugin.distribution != "qrlsuite":
                needs = ", for any qrlsuite (its pyproject.toml should say dependencies = ['qrlsuite>=...'])"
            typer.echo(("\n" if last else "") + printable(f"{plugin.distribution} {plugin.version}{needs}"))
            last = plugin.distribution
        typer.echo(f"  {printable(plugin.module)}")
        for kind, names in plugin.registered.items():
            shown = ", ".join(names[:SHOWN]) + (
                f", and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
            )
            typer.echo(f"    {kind.replace('_', ' ')}: {shown}")
        if plugin.problem:
            typer.echo(f"    SKIPPED: {printable(plugin.problem)}")
        elif not plugin.registered:
            typer.echo("    registers nothing by name")
    skipped = tuple(plugin.problem for plugin in known.plugins if plugin.problem)
    others = [text for text in known.problems if not text.startswith(skipped)]
    if others:
        typer.echo("\n" + "\n".join(f"problem: {printable(text)}" for text in others))


def _print(rows: list[dict[str, str]], folded: bool) -> None:
    width = table_console(10_000).width  # a pipe keeps a thing on one line
    for place, (kind, group) in enumerate(itertools.groupby(rows, key=lambda row: row["kind"])):
        typer.echo("\n" * bool(place) + kind.replace("_", " "))
        things = [(printable(row["name"]), printable(f"{row['summary']}{_origin(row)}")) for row in group]
        lines = _folded(things, f"qrlsuite list {kind.replace('_', '-')}") if folded else things
        indent = max(len(name) for name, _ in lines) + 4
        for name, summary in lines:
            first, *more = textwrap.wrap(summary, max(width - indent, 30)) or [""]
            typer.echo(
                "\n".join([f"  {name:<{indent - 4}}  {first}", *(" " * indent + line for line in more)])
            )


def _origin(row: dict[str, str]) -> str:
    return "" if row["distribution"] == "qrlsuite" else f"  [{row['distribution']}]"


def _folded(things: list[tuple[str, str]], command: str) -> list[tuple[str, str]]:
    """Fold the many variants of a thing, named with its name and a hyphen, into one line."""
    names = [name for name, _ in things]
    variants = {name: [each for each in names if each.startswith(f"{name}-")] for name in names}
    many = {name: found for name, found in variants.items() if len(found) >= MANY}
    hidden = {each for found in many.values() for each in found}
    lines = []
    for name, summary in things:
        if name not in hidden:
            lines.append((name, summary))
        if name in many and name not in hidden:
            lines.append((f"{name}-*", f"{len(many[name])} variants of {name}: {command}"))
    return lines
