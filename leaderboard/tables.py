"""Boards and comparisons as text: tables for a terminal and a notebook, Markdown, CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Literal

from rich import box
from rich.table import Table
from rich.text import Text

from qrlsuite.engine.terminal import printable
from qrlsuite.leaderboard.absent import absent
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import Comparison

if TYPE_CHECKING:  # boards show themselves by this module
    from qrlsuite.leaderboard.across import AcrossBoard
    from qrlsuite.leaderboard.board import Leaderboard, Row, Section
    from qrlsuite.leaderboard.costs import CostBoard, CostSection
    from qrlsuite.leaderboard.curves import EntryCurves
    from qrlsuite.leaderboard.pair import PairVerdict

COLUMNS = (
    "tier",
    "rests on",
    "entry",
    "parameters",
    "settings",
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
NUMERIC = {"rests on", "parameters", "seeds", "score", "cells +/-", "hours"}
WIDE = 165
"""Characters per line in which the whole table can be read."""
LEFT_OUT = ((105, ("outperforms", "outperformed by")), (0, ("parameters", "settings", "cells +/-", "hours")))
"""What a narrower one leaves out: the first where it has so many columns, else the second too."""


def cells(section: Section, row: Row) -> tuple[str, ...]:
    """Return an entry's cells, one per column of `COLUMNS`."""
    entry = row.entry
    classical, quantum = entry.parameters
    return (
        tier_text(row),
        row.rests_on.text if row.rests_on is not None else "-",
        entry.label,
        (f"{classical} + {quantum} q" if quantum else str(classical)) + entry.fixed_text,
        entry.settings,
        f"{len(entry.seeds)}" + "*" * row.provisional,
        row.reference.text,
        f"{row.median_score:.3f}",
        f"{row.wins}/{row.losses}",
        _names(row.outperforms, [r for r in section.rows if r.depth > row.depth], "all lower tiers"),
        _names(row.outperformed_by, [r for r in section.rows if 0 < r.depth < row.depth], "all higher tiers"),
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


def notes(section: Section) -> list[str]:
    """Explain the marks that occur in a section."""
    lines = sorted({row.reason for row in section.rows if row.reason})
    if any(row.rests_on for row in section.rows):
        lines.append(
            "rests on: cells of the narrowest win in the chain of wins above an entry, of the cells in which not "
            "both are at the cap"
        )
    if any(row.provisional for row in section.rows):
        protocol_seeds = section.rows[0].entry.task_file.protocol.seeds
        lines.append(f"* provisional: the protocol asks for {protocol_seeds} seeds")
    if any(row.reference.unsettled for row in section.rows):
        lines.append(">= : still below delta at the last epoch; the sample complexity is at least this")
    if any(row.entry.parameters[1] for row in section.rows):
        lines.append("q: quantum parameters")
    if any(row.entry.fixed for row in section.rows):
        lines.append("fixed: parameters that stay as they were drawn, beside the trained ones")
    alone = [row.entry.label for row in section.rows if row.entry.first_network_alone]
    if alone:
        lines.append(
            "parameters of the first network alone (older records count no other, such as a critic): "
            + ", ".join(alone)
        )
    unprobed = [row.entry.label for row in section.rows if row.entry.unprobed]
    if unprobed:
        lines.append(
            f"not probed: {', '.join(unprobed)}; made with code of others, and no seed was trained again alone to show "
            "that seeds do not depend on each other (`qrlsuite run` does, where it trains)"
        )
    missing = sorted({name for row in section.rows for name in absent(row.entry)})
    if missing:
        lines.append(f"not installed here: {', '.join(missing)}; ranked from the stored curves")
    tuned = [row.entry for row in section.rows if row.entry.tuning]
    if tuned:
        lines.append(
            "settings found by tuning: "
            + ", ".join(f"{entry.label} ({_tuning_text(entry.tuning or {})})" for entry in tuned)
        )
    diverged = [row.entry for row in section.rows if row.entry.diverged]
    if diverged:
        lines.append(
            "diverged (numbers of the agents are no longer finite), ranked with the scores that they had: "
            + ", ".join(
                f"{entry.label} ({len(entry.diverged)} of {len(entry.seeds)} seeds)" for entry in diverged
            )
        )
    lines += changed_thresholds([row.entry for row in section.rows])
    lines += unequal_tuning(section)
    seen = [row.entry.label for row in section.rows if row.entry.on_protocol_seeds]
    if seen:
        lines.append(
            f"settings chosen after seeing runs on protocol seeds, which may flatter: {', '.join(seen)}"
        )
    mixed = [row.entry for row in section.rows if row.entry.mixed_versions]
    if mixed:
        lines.append(
            "made with several versions, see `qrlsuite show ENTRY`: "
            + ", ".join(f"{entry.label} ({', '.join(entry.mixed_versions)})" for entry in mixed)
        )
    devices = [row.entry for row in section.rows if len(row.entry.devices) > 1]
    if devices:
        lines.append(
            "trained on several kinds of device, see `qrlsuite show ENTRY`: "
            + ", ".join(f"{entry.label} ({', '.join(entry.devices)})" for entry in devices)
        )
    lines.append(
        "cells +/-: grid cells with significantly fewer samples, and with more, over all other entries"
    )
    return [*lines, "score: median over seeds after the last epoch; hours: core-hours"]


def changed_thresholds(entries: Sequence[EntryCurves]) -> list[str]:
    """Say of which entries the thresholds changed after their first seed: they may have been chosen to flatter."""
    labels = [entry.label for entry in entries if entry.changed_thresholds]
    return [f"thresholds changed after the first seed: {', '.join(labels)}"] if labels else []


def unequal_tuning(section: Section) -> list[str]:
    """Say where entries that were tuned unequally are ranked against each other."""
    tuned = [row.entry.tuning for row in section.rows if row.entry.tuning]
    lines = []
    if 0 < len(tuned) < len(section.rows):
        lines.append(
            "tuned and untuned settings are ranked against each other: a difference may be one of tuning"
        )
    budgets = {record.get("budget") for record in tuned}
    if len(budgets) > 1:
        texts = sorted("not known" if budget is None else str(budget) for budget in budgets)
        lines.append(f"tuned with different budgets: {'; '.join(texts)}")
    return lines


def _tuning_text(tuning: Mapping[str, Any]) -> str:
    """Say what finding an entry's settings took, as far as it is known: `7 trials, 0.12 core-hours`."""
    units = {"trials": "trials", "steps": "steps", "core_hours": "core-hours"}
    known = [f"{tuning[name]:,} {unit}" for name, unit in units.items() if tuning.get(name) is not None]
    return ", ".join(known) or "budget not known"


def title(section: Section) -> str:
    """Return the heading of a section."""
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


def section_table(section: Section, width: int = WIDE) -> Table:
    """Return a section as a table for a terminal of some width, without the columns for which there is no room."""
    remarks, left_out = notes(section), _left_out(width)
    shown = [name for name in COLUMNS if name not in left_out]
    if left_out:
        remarks.append(f"a terminal of {WIDE} columns, or --format markdown, shows {', '.join(left_out)} too")
    result = table(
        shown,
        title=title(section),
        caption="\n".join(remarks),
        left=[name for name in shown if name not in NUMERIC],
        fixed=[name for name in shown if name in NUMERIC or name.startswith("S_hat")],
    )
    for row in section.rows:
        texts = dict(zip(COLUMNS, cells(section, row)))
        result.add_row(*(Text(texts[name]) for name in shown))
    return result


def table(
    columns: Sequence[str],
    *,
    title: str | None = None,
    caption: str | None = None,
    left: Sequence[str] = (),
    fixed: Sequence[str] = (),
) -> Table:
    """Return an empty table as all commands show them.

    Parameters
    ----------
    columns:
        Their names. Numbers stand at the right.
    title, caption:
        What stands above and below it.
    left:
        Columns of words, which stand at the left.
    fixed:
        Columns that are never broken into several lines.
    """
    result = Table(
        title=None if title is None else Text(title),
        title_justify="left",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        caption=None if caption is None else Text(caption),
        caption_justify="left",
        pad_edge=False,
    )
    for name in columns:
        justify: Literal["left", "right"] = "left" if name in left else "right"
        result.add_column(Text(name), justify=justify, overflow="fold", no_wrap=name in fixed)
    return result


NARROW = 105
"""Characters per line in which the whole table by mean time can be read."""
LEFT_OUT_OF_TIMES = ("seeds", "at cap", "at half")
"""What a narrower one leaves out."""
NAMES = ("entry", "needs less than", "needs more than")
"""Columns of names, which may be broken into several lines."""


def times_title(section: Section) -> str:
    """Return the heading of a section by mean time below threshold."""
    return f"{section.task}, {steps_text(section.horizon)} steps, by mean time below threshold"


def times_table(section: Section, width: int = WIDE) -> Table:
    """Return a section by mean time below threshold as a table for a terminal of some width."""
    times = section.times
    remarks, columns = times.notes(), times.columns()
    left_out = LEFT_OUT_OF_TIMES if width < NARROW else ()
    if left_out:
        remarks.append(
            f"a terminal of {NARROW} columns, or --format markdown, shows {', '.join(left_out)} too"
        )
    kept = [place for place, name in enumerate(columns) if name not in left_out]
    shown = [columns[place] for place in kept]
    result = table(
        shown,
        title=times_title(section),
        caption="\n".join(remarks),
        left=[name for name in shown if name not in LEFT_OUT_OF_TIMES],
        fixed=[name for name in shown if name not in NAMES],
    )
    for row in times.rows:
        texts = times.cells(row)
        result.add_row(*(Text(texts[place]) for place in kept))
    return result


def across_table(board: AcrossBoard) -> Table:
    """Return a comparison over several tasks as a table."""
    columns = board.columns()
    fixed = [name for name in columns if name not in NAMES]
    result = table(columns, title=board.title, caption="\n".join(board.notes()), left=columns, fixed=fixed)
    for place in range(len(board.order)):
        result.add_row(*map(Text, board.cells(place)))
    return result


def cost_table(section: CostSection) -> Table:
    """Return a section by cost as a table."""
    columns = section.columns()
    result = table(
        columns,
        title=section.title,
        caption="\n".join(section.notes()),
        left=NAMES,
        fixed=[name for name in columns if name not in NAMES],
    )
    for row in section.rows:
        result.add_row(*map(Text, section.cells(row)))
    return result


def cost_markdown(board: CostBoard) -> str:
    """Return a board by cost as Markdown."""
    lines = []
    for section in board.sections:
        rows = [section.cells(row) for row in section.rows]
        lines += _markdown_table(section.title, section.columns(), rows, section.notes())
    return "\n".join(lines)


def markdown(board: Leaderboard) -> str:
    """Return a board as Markdown: for each section two tables, each with heading and notes."""
    lines = []
    for section in board.sections:
        times = section.times
        rows = [cells(section, row) for row in section.rows]
        lines += _markdown_table(title(section), COLUMNS, rows, notes(section))
        by_time = [times.cells(row) for row in times.rows]
        lines += _markdown_table(times_title(section), times.columns(), by_time, times.notes())
    return "\n".join(lines)


def across_markdown(board: AcrossBoard) -> str:
    """Return a comparison over several tasks as Markdown."""
    rows = [board.cells(place) for place in range(len(board.order))]
    return "\n".join(_markdown_table(board.title, board.columns(), rows, board.notes()))


def _markdown_table(
    heading: str, columns: Sequence[str], rows: Sequence[Sequence[str]], remarks: Sequence[str]
) -> list[str]:
    lines = [f"### {_plain(heading)}", "", f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    lines += [f"| {' | '.join(map(_plain, row))} |" for row in rows]
    return [*lines, "", *(f"{_plain(line, '')}  " for line in remarks), ""]


def _plain(text: str, further: str = "`|") -> str:
    """Return Markdown that shows a text as it is: labels and options are strangers' words.

    An underscore within a word stands for itself, as in `batch_size`.

    Parameters
    ----------
    further:
        Characters to escape beside the usual ones; a remark of ours may have code in it.
    """
    special = rf"[\\*\[\]{further}]|(?<!\w)_|_(?!\w)"
    escaped = re.sub(special, lambda found: f"\\{found[0]}", printable(text))
    return escaped.replace("&", "&amp;").replace("<", "&lt;")


def csv_text(board: Leaderboard) -> str:
    """Write one line per entry and section; lists are separated by semicolons."""
    rows: list[dict[str, object]] = []
    for made, section in zip(board.sections, board.as_dict()["sections"]):
        for of, row in zip(made.rows, section["rows"]):
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
                "parameters_fixed": count["fixed"],
                "networks": count["networks"],
                **{f"rests_on_{name}": support.get(name) for name in SUPPORT},
                "interval_low": low,
                "interval_high": high,
                "tuned": tuned,
                "tuned_on_protocol_seeds": on_protocol_seeds,
                "rule": section["rule"],
                **made.times.flat(of.entry),
            }
            rows.append(flat)
    return csv_rows(rows)


def csv_rows(rows: Sequence[Mapping[str, object]]) -> str:
    """Write rows of equal columns; lists are separated by semicolons."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        flat = {name: "; ".join(value) if isinstance(value, list) else value for name, value in row.items()}
        writer.writerow({name: _harmless(value) for name, value in flat.items()})
    return buffer.getvalue()


def _harmless(value: object) -> object:
    """Keep spreadsheets from reading a name as a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in tuple("=+-@\t\r") else value


def board_html(board: Leaderboard) -> str:
    """Return a board as HTML for a notebook: every section with its heading, table and notes."""
    parts = []
    for section in board.sections:
        rows = [cells(section, row) for row in section.rows]
        parts.append(html_table(COLUMNS, rows, title(section), notes(section)))
        times = section.times
        by_time = [times.cells(row) for row in times.rows]
        parts.append(html_table(times.columns(), by_time, times_title(section), times.notes()))
    parts += [f"<p>left out: {escape(line)}</p>" for line in board.refused]
    return "\n".join(parts) or "<p>no entries</p>"


def html_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], heading: str = "", remarks: Sequence[str] = ()
) -> str:
    """Return a table as HTML; every text is escaped."""
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return (
        (f"<p><b>{escape(heading)}</b></p>" if heading else "")
        + f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        + "".join(f"<p><small>{escape(line)}</small></p>" for line in remarks)
    )


SYMBOLS = {
    "win": ("+", "bold bright_blue", "significantly fewer samples"),
    "loss": ("-", "bold dark_orange", "significantly more samples"),
    "tie": (".", "dim", "no significant difference"),
    "both-at-cap": ("^", "dim", "both at the cap"),
    "undecided": ("?", "yellow", "undecided"),
}
"""What a cell of a comparison looks like; the sign says everything, the color only helps."""


def pair_table(pair: PairVerdict) -> Table:
    """Return two entries threshold by threshold as a table."""
    columns = pair.columns()
    result = table(
        columns, caption="\n".join(pair.notes), left=columns[-1:], fixed=(columns[0], *columns[3:])
    )
    for row in pair.rows():
        result.add_row(*map(Text, row))
    return result


def _levels(comparison: Comparison) -> tuple[str, list[str], list[str]]:
    """Return what the rows of a comparison's grid are, their levels, and the deltas across."""
    grid = comparison.grid
    rows = [f"{float(level):g}" for level in grid.levels]
    return f"{grid.level_name} down, delta across", rows, [f"{float(delta):g}" for delta in grid.deltas]


def comparison_table(comparison: Comparison) -> Table:
    """Return a comparison as a table: a sign per cell of the grid."""
    heading, rows, deltas = _levels(comparison)
    result = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=Text(heading), title_justify="left")
    result.add_column("", justify="right")
    for delta in deltas:
        result.add_column(Text(delta), justify="center")
    for name, verdicts in zip(rows, comparison.verdicts):
        result.add_row(Text(name), *(Text(*SYMBOLS[str(verdict)][:2]) for verdict in verdicts))
    return result


def legend(comparison: Comparison) -> str:
    """Explain the signs that occur in a comparison's table."""
    occurring = {str(verdict) for row in comparison.verdicts for verdict in row}
    return ", ".join(f"{sign} {meaning}" for name, (sign, _, meaning) in SYMBOLS.items() if name in occurring)


def comparison_html(comparison: Comparison, headline: str) -> str:
    """Return a comparison's cells as HTML for a notebook: the result in words, and a sign per cell of the grid."""
    heading, rows, deltas = _levels(comparison)
    signs = [[name, *(SYMBOLS[str(v)][0] for v in row)] for name, row in zip(rows, comparison.verdicts)]
    remarks = [heading, legend(comparison)]
    return html_table(["", *deltas], signs, f"{headline}: {comparison.sentence}", remarks)
