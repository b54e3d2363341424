"""`qrlsuite leaderboard`: entries ranked by significant outperformance."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.table import Table
from rich.text import Text

from qrlsuite.cli.arguments import (
    EntryOption,
    HorizonOption,
    MinSeedsOption,
    PublishedOption,
    RuleOption,
    RunsOption,
    TaskOption,
)
from qrlsuite.cli.commands import verify
from qrlsuite.cli.terminal import table_console
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.leaderboard import board as boards
from qrlsuite.leaderboard import collect, report, rules
from qrlsuite.leaderboard.absent import absent
from qrlsuite.leaderboard.board import Leaderboard, Row, Section, steps_text
from qrlsuite.results import lookup
from qrlsuite.results.store import write_atomically


class Format(StrEnum):
    """How a leaderboard is written."""

    table = "table"
    markdown = "markdown"
    json = "json"
    csv = "csv"
    html = "html"


app = typer.Typer(invoke_without_command=True)
app.command("verify")(verify.verify)


@app.callback()
def leaderboard(
    context: typer.Context,
    task: TaskOption = None,
    entry: EntryOption = None,
    horizon: HorizonOption = None,
    min_seeds: MinSeedsOption = 1,
    format_: Annotated[Format, typer.Option("--format", help="How to write it.")] = Format.table,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="For html; default: leaderboard.html in the results folder."
        ),
    ] = None,
    rule: RuleOption = rules.DEFAULT,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
) -> None:
    """Rank the entries of each task by significant outperformance.

    A tier is 1 + the longest chain of entries that outperform one another above it. Entries are compared at
    equal numbers of seeds; below 20 the verdict is undecided. S_hat is the sample complexity: environment steps
    until (and whenever) fewer than delta of the runs score 1 - epsilon, with its 5th to 95th percentile.
    With --published, an entry that you trained less far than the published one is shown beside it.

    Example: qrlsuite leaderboard --task beam6g --format markdown
    """
    if context.invoked_subcommand is not None:
        return

    if output is not None and format_ is not Format.html:
        raise OptionError(f"--out {output}: only the page is written to a file; add --format html")
    lookup.check_tasks(runs, task)
    tasks = [task] if task else []
    found, refused = collect.select(runs, tasks, entry or [], published, horizon, min_seeds)
    board = boards.build(found, refused, rules.load(rule), horizon)
    if format_ is Format.json:
        typer.echo(json.dumps(boards.as_dict(board)))
        return
    for line in board.refused:
        typer.echo(f"left out: {line}", err=True)
    if not board.sections:
        raise UnknownNameError(
            f"{runs} holds no results{f' of task {task}' if task else ''} yet: qrlsuite run; "
            "--published shows those that come with the suite"
        )
    if format_ is Format.html:
        _page(board, output or runs / "leaderboard.html")
    elif format_ is Format.markdown:
        typer.echo(_markdown(board))
    elif format_ is Format.csv:
        typer.echo(_csv(board), nl=False)
    else:
        for section in board.sections:
            _table(section)
    if board.rule != rules.DEFAULT and format_ not in (Format.html, Format.csv):
        typer.echo(f"rule '{board.rule}': {board.promise}")


def _page(board: Leaderboard, path: Path) -> None:
    """Write one self-contained page, which works offline."""
    write_atomically(path, report.render(board).encode())
    typer.echo(f"wrote {path}")


COLUMNS = (
    "tier",
    "rests on",
    "entry",
    "parameters",
    "seeds",
    "S_hat (5%-95%)",
    "score",
    "cells +/-",
    "outperforms",
    "outperformed by",
    "hours",
)
SUPPORT = ("winner", "loser", "cells", "at_cap", "total")
"""What a spreadsheet shows of the win that a tier rests on."""
WIDE = 150
"""Columns of a terminal, or a file, in which the whole table can be read."""
LEFT_OUT = ((105, ("outperforms", "outperformed by")), (0, ("parameters", "cells +/-", "hours")))
"""What a narrower one leaves out: the first where it has so many columns, else the second too."""


def _cells(section: Section, row: Row) -> tuple[str, ...]:

    entry = row.entry
    classical, quantum = entry.parameters
    return (
        tier_text(row),
        row.rests_on.text if row.rests_on is not None else "-",
        entry.label,
        f"{classical} + {quantum} q" if quantum else str(classical),
        f"{len(entry.seeds)}" + "*" * row.provisional,
        boards.complexity_text(row.reference),
        f"{row.median_score:.3f}",
        f"{row.wins}/{row.losses}",
        _names(row.outperforms, [r for r in section.rows if r.depth > row.depth], "all lower tiers"),
        _names(
            row.outperformed_by,
            [r for r in section.rows if 0 < r.depth < row.depth],
            "all higher tiers",
        ),
        f"{entry.hours:.2f}",
    )


def tier_text(row: Row) -> str:
    """Return the tier, or in a word why there is none."""
    if row.tier is not None:
        return str(row.tier)
    return "not reached" if row.not_reached else "undecided"


def _names(names: Sequence[str], others: Sequence[Row], everyone: str) -> str:
    """List a few names; many that are all the entries on one side of the board are called so."""
    if len(names) > 1 and sorted(names) == sorted(row.entry.label for row in others):
        return everyone
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "") or "-"


def _notes(section: Section) -> list[str]:
    """Explain the marks that occur in a section."""
    notes = sorted({boards.untiered_reason(row) for row in section.rows if row.tier is None})
    if any(row.rests_on for row in section.rows):
        notes.append(
            "rests on: cells of the narrowest win in the chain of wins above an entry, of the cells in which not "
            "both are at the cap"
        )
    if any(row.provisional for row in section.rows):
        wanted = section.rows[0].entry.task_file.protocol.seeds
        notes.append(f"* provisional: the protocol asks for {wanted} seeds")
    if any(row.reference.unsettled for row in section.rows):
        notes.append(">= : still below delta at the last epoch; the sample complexity is at least this")
    if any(row.entry.parameters[1] for row in section.rows):
        notes.append("q: quantum parameters")
    alone = [row.entry.label for row in section.rows if row.entry.first_network_alone]
    if alone:
        notes.append(
            "parameters of the first network alone (older records count no other, such as a critic): "
            + ", ".join(alone)
        )
    missing = sorted({name for row in section.rows for name in absent(row.entry)})
    if missing:
        notes.append(f"not installed here: {', '.join(missing)}; ranked from the stored curves")
    tuned = [row.entry for row in section.rows if row.entry.tuning]
    if tuned:
        notes.append(
            "settings found by tuning: "
            + ", ".join(f"{entry.label} ({boards.tuning_text(entry.tuning or {})})" for entry in tuned)
        )
    seen = [row.entry.label for row in section.rows if row.entry.on_protocol_seeds]
    if seen:
        notes.append(
            f"settings chosen after seeing runs on protocol seeds, which may flatter: {', '.join(seen)}"
        )
    mixed = [row.entry for row in section.rows if row.entry.mixed_versions]
    if mixed:
        notes.append(
            "made with several versions, see `qrlsuite show ENTRY`: "
            + ", ".join(f"{entry.label} ({', '.join(entry.mixed_versions)})" for entry in mixed)
        )
    devices = [row.entry for row in section.rows if len(row.entry.devices) > 1]
    if devices:
        notes.append(
            "trained on several kinds of device, see `qrlsuite show ENTRY`: "
            + ", ".join(f"{entry.label} ({', '.join(entry.devices)})" for entry in devices)
        )
    notes.append(
        "cells +/-: grid cells with significantly fewer samples, and with more, over all other entries"
    )
    return [*notes, "score: median over seeds after the last epoch; hours: core-hours"]


def _title(section: Section) -> str:

    note = " (provisional: shorter than the task's horizon)" if section.provisional else ""
    return f"{section.task}, {steps_text(section.horizon)} steps{note}, S_hat at {section.cell}"


def _left_out(width: int) -> list[str]:
    """Return the columns for which a table of some width has no room."""
    left_out: list[str] = []
    for enough, names in LEFT_OUT if width < WIDE else ():
        left_out += names
        if width >= enough:
            break
    return left_out


def _table(section: Section) -> None:

    console = table_console(WIDE)
    notes, left_out = _notes(section), _left_out(console.width)
    shown = [name for name in COLUMNS if name not in left_out]
    if left_out:
        notes.append(f"a terminal of {WIDE} columns, or --format markdown, shows {', '.join(left_out)} too")
    table = Table(
        title=Text(_title(section)),
        title_justify="left",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        caption=Text("\n".join(notes)),
        caption_justify="left",
        pad_edge=False,
    )
    numeric = {"rests on", "parameters", "seeds", "score", "cells +/-", "hours"}
    for name in shown:
        table.add_column(
            Text(name),
            justify="right" if name in numeric else "left",
            overflow="fold",
            no_wrap=name in numeric or name.startswith("S_hat"),
        )
    for row in section.rows:
        cells = dict(zip(COLUMNS, _cells(section, row)))
        table.add_row(*(Text(cells[name]) for name in shown))
    console.print(table)


def _markdown(board: Leaderboard) -> str:
    lines = []
    for section in board.sections:
        lines += [f"### {_title(section)}", "", f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
        for row in section.rows:
            cells = (cell.replace("|", "\\|").replace("<", "&lt;") for cell in _cells(section, row))
            lines.append(f"| {' | '.join(cells)} |")
        lines += ["", *(f"{note.replace('*', chr(92) + '*')}  " for note in _notes(section)), ""]
    return "\n".join(lines)


def _csv(board: Leaderboard) -> str:
    """Write one line per entry and section; lists are separated by semicolons."""
    rows = []
    for section in boards.as_dict(board)["sections"]:
        for row in section["rows"]:
            low, high = row.pop("interval")
            count = row.pop("parameters")
            tuning = row.pop("tuning") or {}
            tuned, on_protocol_seeds = bool(tuning), bool(tuning.get("on_protocol_seeds"))
            support = row.pop("rests_on") or {}
            flat = {
                **{name: section[name] for name in ("task", "horizon", "cell")},
                **row,
                "parameters_classical": count["classical"],
                "parameters_quantum": count["quantum"],
                "networks": count["networks"],
                **{f"rests_on_{name}": support.get(name) for name in SUPPORT},
                "interval_low": low,
                "interval_high": high,
                "tuned": tuned,
                "tuned_on_protocol_seeds": on_protocol_seeds,
                "rule": board.rule,
            }
            rows.append({k: "; ".join(v) if isinstance(v, list) else v for k, v in flat.items()})
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _harmless(value) for name, value in row.items()} for row in rows)
    return buffer.getvalue()


def _harmless(value: object) -> object:
    """Keep spreadsheets from reading a name as a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in tuple("=+-@\t\r") else value
