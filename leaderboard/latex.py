"""Boards as LaTeX: tables that a paper can take. They need the package booktabs and nothing else."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence

from qrlsuite.leaderboard.across import AcrossBoard
from qrlsuite.leaderboard.board import Leaderboard, Row, Section
from qrlsuite.leaderboard.costs import CostBoard, CostSection
from qrlsuite.leaderboard.tables import tier_text
from qrlsuite.leaderboard.times import TimeRow
from qrlsuite.results.text import steps_text

_SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "`": r"\textasciigrave{}",
    "'": r"\symbol{39}",
    "[": "{[}",  # a row that begins with one would be read as an option of the row before
    "]": "{]}",
}
_JOINED = {"/": r"$\lceil$", "|": r"$\vert$", "\\": r"$\lfloor$", "": ""}


def escaped(text: str) -> str:
    r"""Return text that LaTeX prints as it is, on one line.

    >>> print(escaped("lr=2e-3 50% & a_b"))
    lr=2e-3 50\% \& a\_b
    """
    plain = "".join(c if unicodedata.category(c)[0] != "C" else " " for c in " ".join(text.split()))
    return "".join(_SPECIAL.get(c, c) for c in plain).replace("--", "-{}-")  # two would become a dash


def tables(board: Leaderboard) -> str:
    """Return one table per section, in the order of the mean time below threshold."""
    return "\n".join(_section(section) for section in board.sections)


def _section(section: Section) -> str:
    times = section.times
    rows = {id(row.entry): row for row in section.rows}
    level = escaped(times.level)
    head = (
        "Rank",
        "",
        "Entry",
        "Parameters",
        "Seeds",
        "Tier",
        r"$\hat{S}$ (5\%--95\%)",
        f"$M$ ({level})",
        f"Above the first ({level})",
    )
    lines = [_cells(row, rows[id(row.entry)]) for row in times.rows]
    caption = (
        f"{escaped(section.task)} at {escaped(steps_text(section.horizon))} environment steps. "
        f"Tier: significant outperformance, rule {escaped(section.rule)}. "
        rf"$\hat{{S}}$: sample complexity at {escaped(section.cell)}. "
        "$M$: mean time below threshold, over seeds and the task's thresholds. "
        f"Rank: what the decided pairs leave ({times.n_decided} of {times.n_pairs}; max-T permutation tests, Holm over "
        rf"all pairs, $\alpha = {times.board.alpha:g}$). "
    )
    if any(row.joined for row in times.rows):
        caption += "Brackets join neighbors that are not told apart. "
    if any(row.reference.unsettled for row in section.rows):
        caption += r"$\geq$: a lower bound. "
    if any(row.few for row in times.rows):
        caption += r"$\dagger$: fewer than 50 seeds against another number. "
    caption += "".join(
        f"{escaped(line[0].upper() + line[1:])}. " for line in times.trade_offs() + times.against_the_order()
    )
    label = "".join(c if c.isascii() and c.isalnum() else "-" for c in section.task)
    return _table("r@{\\;}llrrllll", head, lines, caption.strip(), f"tab:{label}-{section.horizon}")


def _cells(row: TimeRow, of: Row) -> tuple[str, ...]:
    classical, quantum = row.entry.parameters
    complexity = of.reference
    steps, low, high = (steps_text(each) for each in (complexity.steps, complexity.low, complexity.high))
    mean, mean_low, mean_high = (steps_text(each, digits=3) for each in (row.mean.mean, *row.mean.interval))
    bound = r"$\geq$ " if complexity.unsettled else ""
    cap = ", at cap" if complexity.at_cap else ""
    return (
        row.rank_text.replace("-", "--"),
        _JOINED[row.joined],
        escaped(row.entry.label),
        (f"{classical} + {quantum} q" if quantum else str(classical)) + row.entry.fixed_text,
        f"{len(row.entry.seeds)}" + r"$^\dagger$" * row.few,
        tier_text(of),
        f"{bound}{steps} ({low}--{high}{cap})",
        f"{mean} ({mean_low}--{mean_high})",
        _signed(row.difference_text),
    )


def _signed(text: str) -> str:
    """Write signs of numbers as LaTeX writes them."""
    if text == "-":
        return "--"
    return escaped(text).replace("-", "$-$").replace("+", "$+$")


def across_table(board: AcrossBoard) -> str:
    """Return one table of a comparison over several tasks."""
    lines = [tuple(map(escaped, board.cells(place))) for place in range(len(board.order))]
    caption = f"{escaped(board.title)}. " + " ".join(f"{escaped(note)}." for note in board.notes())
    return _table("lrlllll", tuple(map(escaped, board.columns())), lines, caption, "tab:across")


def cost_tables(board: CostBoard) -> str:
    """Return one table per section of a board by cost."""
    return "\n".join(_costs(section) for section in board.sections)


def _costs(section: CostSection) -> str:
    lines = [tuple(map(escaped, section.cells(row))) for row in section.rows]
    caption = f"{escaped(section.title)}. " + " ".join(f"{escaped(note)}." for note in section.notes())
    label = "".join(c if c.isascii() and c.isalnum() else "-" for c in section.task)
    return _table(
        "llrrrlllll",
        tuple(map(escaped, section.columns())),
        lines,
        caption,
        f"tab:{label}-{section.unit.name}",
    )


def _table(columns: str, head: Sequence[str], rows: Sequence[Sequence[str]], caption: str, label: str) -> str:
    lines = [" & ".join(row) + r" \\" for row in rows]
    return "\n".join(
        [
            "% needs \\usepackage{booktabs}",
            r"\begin{table*}",
            r"  \centering",
            rf"  \caption{{{caption}}}",
            rf"  \label{{{label}}}",
            rf"  \begin{{tabular}}{{{columns}}}",
            r"    \toprule",
            f"    {' & '.join(head)} " + r"\\",
            r"    \midrule",
            *(f"    {line}" for line in lines),
            r"    \bottomrule",
            r"  \end{tabular}",
            r"\end{table*}",
            "",
        ]
    )
