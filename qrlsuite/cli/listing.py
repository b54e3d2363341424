"""`qrlsuite list`: what is installed."""

from __future__ import annotations

from typing import Annotated

import typer

from qrlsuite.cli.app import JsonOption


def list_things(
    kind: Annotated[
        str | None,
        typer.Argument(
            help="tasks, models, algorithms, environments, ansatzes, circuit_backends, hooks, ... or all"
        ),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """List what is registered, by the suite or by plugins, and from which distribution.

    Example: qrlsuite list models
    """
    import json

    from qrlsuite import registry
    from qrlsuite.errors import UnknownNameError, nearest

    known = registry.load()
    accepted = {name.replace("_", "-"): name for name in registry.KINDS} | {
        name: name for name in registry.KINDS
    }
    if kind == "hooks":
        rows = _hooks()
    else:
        if kind is not None and kind not in accepted:
            raise UnknownNameError(f"unknown kind '{kind}'{nearest(kind, [*registry.KINDS, 'hooks'])}")
        rows = [
            {"kind": k, "name": r.spec.name, "summary": r.spec.summary, "distribution": r.distribution}
            for k, r in known
            if kind is None or k == accepted[kind]
        ]
    if json_output:
        typer.echo(json.dumps(rows))
        return
    _print(rows)


def _hooks() -> list[dict[str, str]]:
    """Return every hook with the first line of its manual."""
    import inspect

    from qrlsuite import hookspecs

    return [
        {
            "kind": "hooks",
            "name": name,
            "summary": (inspect.getdoc(function) or "").partition("\n")[0],
            "distribution": "qrlsuite",
        }
        for name, function in vars(hookspecs).items()
        if inspect.isfunction(function) and hasattr(function, f"{hookspecs.PROJECT}_spec")
    ]


def _print(rows: list[dict[str, str]]) -> None:
    width = max((len(row["name"]) for row in rows), default=0)
    last = None
    for row in rows:
        if row["kind"] != last:
            typer.echo(("" if last is None else "\n") + row["kind"].replace("_", " "))
            last = row["kind"]
        origin = "" if row["distribution"] == "qrlsuite" else f"  [{row['distribution']}]"
        typer.echo(f"  {row['name']:<{width}}  {row['summary']}{origin}")
