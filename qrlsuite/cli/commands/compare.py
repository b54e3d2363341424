"""`qrlsuite compare`: two entries, cell by cell, and in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qrlsuite.cli.arguments import AmongOption, JsonOption, PublishedOption, RuleOption, RunsOption
from qrlsuite.leaderboard import board, collect, rules
from qrlsuite.results import lookup
from qrlsuite.statistics import Comparison

SYMBOLS = {
    "win": ("+", "bold bright_blue", "significantly fewer samples"),
    "loss": ("-", "bold dark_orange", "significantly more samples"),
    "tie": (".", "dim", "no significant difference"),
    "both-at-cap": ("^", "dim", "both at the cap"),
    "undecided": ("?", "yellow", "undecided"),
}
"""What a cell looks like; the sign says everything, the color only helps."""


def compare(
    first: Annotated[
        str,
        typer.Argument(metavar="ENTRY", help="An entry: name or label, [TASK/] before it, or the beginning."),
    ],
    second: Annotated[str, typer.Argument(metavar="ENTRY", help="Another entry of the same task.")],
    task: AmongOption = None,
    rule: RuleOption = rules.DEFAULT,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Say whether the first entry outperforms the second, cell by cell of the task's ranking grid.

    Both are compared at equal numbers of seeds and equal horizons.

    Example: qrlsuite compare --task beam6g "mlp width=64" "mlp width=16"
    """
    lookup.check_tasks(runs, task)
    tasks = [task] if task else []
    one, other = (collect.find(runs, name, published, tasks) for name in (first, second))
    comparison = board.compare_entries(one, other, rules.load(rule))
    if json_output:
        typer.echo(json.dumps(comparison.as_dict()))
        return
    _matrix(comparison)
    typer.echo(
        f"{one.label} against {other.label}, {comparison.n_runs} seeds each, {comparison.horizon} steps"
        + ("" if rule == rules.DEFAULT else f", rule '{rule}'")
        + ":"
    )
    typer.echo(comparison.sentence)
    for entry in (one, other):
        if entry.on_protocol_seeds:
            typer.echo(
                f"{entry.label}: settings chosen after seeing runs on protocol seeds, which may flatter"
            )


def _matrix(comparison: Comparison) -> None:

    grid = comparison.grid
    level = "epsilon" if grid.epsilons is not None else "threshold"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=Text(f"{level} down, delta across"))
    table.title_justify = "left"
    table.add_column("", justify="right")
    for delta in grid.deltas:
        table.add_column(Text(f"{float(delta):g}"), justify="center")
    for name, verdicts in zip(grid.epsilons or grid.thresholds, comparison.verdicts):
        cells = (Text(*SYMBOLS[str(verdict)][:2]) for verdict in verdicts)
        table.add_row(Text(f"{float(name):g}"), *cells)
    Console().print(table)
    there = {str(verdict) for row in comparison.verdicts for verdict in row}
    typer.echo(", ".join(f"{sign} {words}" for name, (sign, _, words) in SYMBOLS.items() if name in there))
