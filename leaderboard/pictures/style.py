"""Colors, line styles, hatches, labels and axes that all pictures share."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from qrlsuite.leaderboard.shelf.curves import EntryResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito's palette: distinguishable with color-deficient sight."""
LINES = ("-", "--", "-.", ":")
HATCHES = ("", "////", "....", "\\\\\\\\", "xxxx", "----", "++++")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


@dataclass(frozen=True)
class Style:
    """How one entry is drawn; color and pattern each tell entries apart without the other."""

    color: str
    line: str
    hatch: str
    marker: str


def style(index: int) -> Style:
    """Return the style of the entry at a place in the legend."""
    turn, place = divmod(index, len(COLORS))
    return Style(
        color=COLORS[place],
        line=LINES[(place + turn) % len(LINES)],
        hatch=HATCHES[(place + turn) % len(HATCHES)],
        marker=MARKERS[(place + turn) % len(MARKERS)],
    )


def of(entry: EntryResults, index: int) -> Style:
    """Return an entry's own style if it has one, else the style of its place in the legend."""
    return style(index if entry.color is None else entry.color)


def seeds_text(entry: EntryResults) -> str:
    """Write the number of seeds of an entry, with a mark where the protocol asks for more: `50 seeds*`."""
    count = len(entry.seeds)
    return f"{count} seed{'s' * (count != 1)}{'*' * provisional(entry)}"


def provisional(entry: EntryResults) -> bool:
    """Whether an entry has fewer seeds than its task's protocol asks for."""
    return len(entry.seeds) < entry.task_file.protocol.seeds


def in_legend(entries: Sequence[EntryResults]) -> list[str]:
    """Return the texts of entries in a legend: labels and seeds."""
    texts = _apart([entry.legend for entry in entries])
    return [f"{text}  ({seeds_text(entry)})" for text, entry in zip(texts, entries)]


def _apart(texts: Sequence[str], longest: int = 60) -> list[str]:
    """Return texts for matplotlib, cut unless that makes two of them alike."""
    short = [plain(text, longest) for text in texts]
    return short if len(set(short)) == len(set(texts)) else [plain(text, 1000) for text in texts]


def plain(text: str, longest: int = 60) -> str:
    """Return text that matplotlib draws literally: no mathematics, no control characters, and not too long."""
    visible = "".join(c if c.isprintable() else "?" for c in text)
    short = visible if len(visible) <= longest else f"{visible[: longest - 3]}..."
    return short.replace("$", r"\$")


def note(entries: Sequence[EntryResults]) -> str:
    """Return the sentence that explains the mark of provisional entries; empty where there is none."""
    protocol_seeds = sorted({entry.task_file.protocol.seeds for entry in entries if provisional(entry)})
    if not protocol_seeds:
        return ""
    return f"* provisional: the protocol asks for {' or '.join(map(str, protocol_seeds))} seeds"


def relative(entries: Sequence[EntryResults]) -> bool:
    """Whether the scores of all entries are fractions of the optimum."""
    return all(entry.task_file.score.of_optimum for entry in entries)


def score_name(entries: Sequence[EntryResults]) -> str:
    """Return the title of an axis of learning curves: `validation score`, or the metric's name instead of `score`.

    Scores that another program wrote may be of training: no axis with such curves says `validation`.
    """
    [name] = {entry.task_file.score.called for entry in entries} or {"score"}
    validation = "" if any(entry.external for entry in entries) else "validation "
    return f"{validation}{plain(name)}{' (received / optimal)' if relative(entries) else ''}"


def tidy(axes: Axes) -> None:
    """Give axes a light grid and no frame above and to the right."""
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def labels(entries: Sequence[EntryResults], longest: int = 60) -> list[str]:
    """Return unique names of entries for legends: without the algorithm if all share it.

    An ansatz that no option chose is named where there is room for it.
    """
    algorithms = {entry.algorithm for entry in entries}

    def short_name(entry: EntryResults) -> str:
        start = f"{entry.algorithm} " if len(algorithms) == 1 and not entry.own_label else ""
        whole = entry.legend.removeprefix(start)
        return whole if len(whole) <= longest else entry.label.removeprefix(start)

    short = [short_name(entry) for entry in entries]
    texts = [
        text if short.count(text) == 1 else f"{entry.name.rpartition('-')[2]} {text}"
        for text, entry in zip(short, entries)
    ]
    return _apart(texts, longest)


def facts(entry: EntryResults) -> str:
    """Write parameters, if known, and seeds: `73 + 240 parameters, 100 seeds`."""
    known = entry.parameters_text()
    return seeds_text(entry) if known == "-" else f"{known} parameters, {seeds_text(entry)}"


def heading(entries: Sequence[EntryResults]) -> str:
    """Return the common facts of entries: the task, and the algorithm if all share it."""
    tasks, algorithms = (
        {getattr(entry, attribute) for entry in entries} for attribute in ("task", "algorithm")
    )
    return plain(", ".join([*sorted(tasks)[:1], *(algorithms if len(algorithms) == 1 else [])]))


def footnotes(figure: Figure, *lines: str) -> None:
    """Write remarks below a picture, where there are any, in as many lines as its width needs."""
    text = ";  ".join(line for line in lines if line)
    if text:
        wrapped = textwrap.fill(text, int(16.5 * figure.get_figwidth()))
        figure.supxlabel(wrapped, x=0.01, ha="left", fontsize=8, color="#505050")


def legend(figure: Figure, title: str, handles: Sequence[Artist]) -> None:
    """Write a picture's title and, below it, its legend in as many columns as there is room for."""
    longest = max((len(str(handle.get_label())) for handle in handles), default=1)
    columns = max(1, int(figure.get_figwidth() / (0.5 + 0.083 * longest)))
    figure.legend(
        handles=list(handles),
        loc="outside upper left",
        title=title,
        title_fontsize="medium",
        alignment="left",
        frameon=False,
        ncols=min(columns, 2 if len(handles) == 4 else 3),
        fontsize=8.5,
        borderaxespad=0.2,
    )
