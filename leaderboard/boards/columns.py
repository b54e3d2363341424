"""The columns of boards by environment steps: of ranks, of tiers, and facts about an entry.

A new column is one more `Column` here: tables, the page, csv and JSON are made of these lists, and Arrow tables of
`of_entry`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from qrlsuite import registry
from qrlsuite.columns import Column
from qrlsuite.errors import PluginError
from qrlsuite.leaderboard.boards.ranked import learning_curves, unranked_since
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.text import hours_text, interval_text, mean_text, score_text, steps_text
from qrlsuite.specs import NAME
from qrlsuite.statistics import final_scores, times_below

if TYPE_CHECKING:  # boards show themselves by this module
    from qrlsuite.leaderboard.boards.steps import Row, Section, TieredRow

SUPPORT = ("winner", "loser", "cells", "at_cap", "total")


def of_entry(score: str = "score", most: bool = True) -> tuple[Column[EntryResults], ...]:
    """Return columns of an entry by its curves, which a board cuts at its horizon; the first is its final score.

    Parameters
    ----------
    score, most:
        What the task calls its score, and whether more of it is better.
    """
    return (
        Column(
            "final_score",
            lambda entry: float(final_scores(learning_curves(entry)).mean()),
            score_text,
            "mean over seeds and over the last tenth of the epochs",
            head=f"final {score}",
            most=most,
            type=float,
        ),
        Column(
            "spread",
            _spread,
            lambda ends: f"{mean_text(ends[0])} to {mean_text(ends[1])}",
            "5th to 95th percentile, over seeds, of the steps that a seed spends before a threshold, mean over the "
            "task's thresholds",
            flat=("spread_low", "spread_high"),
            unit="environment steps",
            type=float,
        ),
        *_of_plugins(),
    )


def _of_plugins() -> list[Column[EntryResults]]:
    """Return the columns of plugins; whatever goes wrong in one is an error that names its distribution."""
    found: list[Column[EntryResults]] = []
    for hook in registry.load().manager.hook.register_columns.get_hookimpls():
        origin = f"of distribution '{hook.plugin_name.partition(':')[0]}'"
        handed: list[Any] = []
        _guarded(f"hook 'register_columns' {origin}", hook.function)(*[handed.append] * len(hook.argnames))
        for column in handed:
            if not isinstance(column, Column) or not NAME.fullmatch(str(column.name)):
                raise PluginError(
                    f"hook 'register_columns' {origin}: {column!r} is no Column with a usable name"
                )
            found.append(_fenced(column, f"column '{column.name}' {origin}"))
    return found


def _fenced(column: Column[Any], title: str) -> Column[EntryResults]:
    parts = ("value", "text", "cell", "bar", "beside", "hover")
    guarded: Any = {name: _guarded(title, own) for name in parts if (own := getattr(column, name))}

    def plain(entry: EntryResults) -> Any:
        value = guarded["value"](entry)
        value = value.item() if isinstance(value, np.generic) else value
        if not isinstance(value, bool | int | float | str | None):
            raise PluginError(f"{title}: {type(value).__name__} is no number, text or truth value")
        return None if isinstance(value, float) and not np.isfinite(value) else value

    return replace(column, flat=None, **guarded | {"value": plain})


def _guarded(title: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:
            raise PluginError(f"{title} fails: {registry.words(error)}") from error

    return call


def require_new(columns: Iterable[Column[Any]], taken: Iterable[str]) -> None:
    """Refuse columns of plugins whose name another column has."""
    names = set(taken)
    for column in columns:
        if names & set(column.heads):
            raise PluginError(f"there is a column '{column.name}' already: give the plugin's another name")
        names |= set(column.heads)


def _spread(entry: EntryResults) -> list[float]:
    times = times_below(entry.curves, entry.task_file.ranking.grid, entry.steps_per_epoch).mean(axis=1)
    low, high = np.percentile(times, (5, 95))
    return [float(low), float(high)]


def estimate(
    name: str,
    interval: str,
    read: Callable[[Any], Sequence[float] | None],
    write: Callable[[float], str],
    flat: tuple[str, ...] | None = None,
    **more: Any,
) -> tuple[Column[Any], Column[Any]]:
    """Return the columns of a number and of its interval, which stands behind it in a cell.

    Parameters
    ----------
    read:
        Value, low and high of a row; None where it has none.
    flat:
        Heads of low and high in spreadsheets.
    more:
        Of the number's column.
    """

    def part(row: Any, places: slice) -> list[float] | None:
        return None if (found := read(row)) is None else [float(each) for each in found[places]]

    def value(row: Any) -> float | None:
        return None if (found := part(row, slice(1))) is None else found[0]

    def cell(row: Any) -> str:
        return "-" if (found := read(row)) is None else interval_text(write, *found)

    return (
        Column(name, value, **{"cell": cell} | more),
        Column(interval, lambda row: part(row, slice(1, None)), flat=flat),
    )


def names_text(names: Sequence[str]) -> str:
    """Write names into a cell."""
    return ", ".join(names) or "-"


def ranks_column(read: Callable[[Any], Sequence[int] | None], **more: Any) -> Column[Any]:
    """Return the column of best and worst ranks."""
    return Column("ranks", read, ranks_text, head="rank", flat=("rank", "rank_worst"), **more)


def ranks_text(ranks: Sequence[int]) -> str:
    """Write the best and worst rank of an entry: `3`, or `3-5`."""
    return "-".join(map(str, dict.fromkeys(ranks)))


def names(entries: Sequence[EntryResults]) -> list[str]:
    """Return the names of entries in a table: their labels, without the algorithm if all share it."""
    alike = len({entry.algorithm for entry in entries}) == 1
    return [(entry.short if alike else entry.label) + " †" * entry.on_protocol_seeds for entry in entries]


def _name(section: Section) -> Column[Row]:
    entries = [row.entry for row in section.rows]
    called = dict[Hashable, str](zip(map(id, entries), names(entries)))
    return Column(
        "entry", lambda row: row.entry.name, cell=lambda row: called[id(row.entry)], words=True
    )  # fmt: skip


def ranks(section: Section) -> list[Column[Row]]:
    """Return the columns of a section's ranks."""
    before, times = section.before, section.times
    first = next((row.entry for row in section.rows if row.time.ranks is not None), None)

    def never(row: Row) -> str:
        shares = (f"{times.kind} {level}: {at:.0%}" for level, at in zip(times.levels, row.time.mean.at_cap))
        return (
            f"never there: {', '.join(shares)}; {steps_text(round(row.time.mean.half))} at half the horizon"
        )

    return [
        ranks_column(
            lambda row: None if row.time.ranks is None else list(row.time.ranks),
            meaning="1 + the number of entries that outperform this one, to the last that the decided pairs leave. A "
            "outperforms B if it needs significantly fewer steps, as a mean over the thresholds (permutation "
            "tests, Holm's correction over all pairs of the board, shown or not)",
            hover=lambda row: unranked_since(row.entry) if row.time.ranks is None else "",
        ),
        _name(section),
        Column("place", lambda row: row.time.place, flat=("time_place",)),
        Column("place_at_half", lambda row: row.time.place_at_half, flat=("time_place_at_half",)),
        *estimate(
            "mean_time",
            "interval",
            lambda row: (row.time.mean.mean, *row.time.mean.interval),
            mean_text,
            ("mean_time_low", "mean_time_high"),
            meaning=f"environment steps that a run spends {before} a threshold, mean over seeds and the task's "
            "thresholds, with its interval; a run that never reaches one counts with the horizon. The bar is solid to "
            "the interval's lower end and shaded to its upper end",
            head=f"steps {before} threshold ({times.level})",
            bar=lambda row: (row.time.mean.interval[0], row.time.mean.mean, row.time.mean.interval[1]),
            hover=never,
        ),
        Column("mean_time_at_half", lambda row: row.time.mean.half, flat=()),
        Column("at_cap", lambda row: row.time.at_cap, flat=("times_at_cap",)),
        Column("at_cap_by_threshold", lambda row: [float(at) for at in row.time.mean.at_cap], flat=()),
        Column(
            "",
            lambda row: (
                0.0 if row.entry is first else None if row.time.difference is None else row.time.difference[0]
            ),
            meaning=f"steps {before} threshold, against the first entry of the table; each interval at the level of "
            "the pair's own test, not all together",
            head="vs. first",
            cell=lambda row: row.time.difference_text.partition(" ")[0],
            beside=lambda row: row.time.difference_text.partition(" ")[2],
        ),
        Column(
            "difference_to_first", lambda row: None if row.time.difference is None else row.time.difference[0]
        ),
        Column(
            "difference_interval",
            lambda row: None if row.time.difference is None else list(row.time.difference[1:]),
        ),
        Column("told_apart_from_next", lambda row: times.told_apart_from_next(row.time), flat=()),
        Column("few_and_unequal", lambda row: row.time.few, flat=("times_few_and_unequal",)),
    ]


def tiers(section: Section) -> list[Column[TieredRow]]:
    """Return the columns of a section's tiers."""
    return [
        Column(
            "tier",
            lambda row: row.tier,
            meaning="1 + the length of the longest chain of entries above, each of which outperforms the next",
            cell=lambda row: (
                str(row.tier) if row.tier is not None else "not reached" if row.not_reached else "undecided"
            ),
            hover=lambda row: row.reason,
        ),
        _name(section),
        Column("verdict", lambda row: row.reason or "ranked"),
        Column(
            "",
            lambda row: row.reference.steps,
            meaning=_complexity(section),
            head="sample complexity (5%-95%)",
            cell=lambda row: row.reference.text,
            bar=lambda row: (row.reference.low, row.reference.steps, row.reference.high),
        ),
        Column(
            "rests_on",
            lambda row: None if row.rests_on is None else asdict(row.rests_on),
            meaning="cells of the narrowest win in the chain of wins above an entry, of the cells in which not both "
            "are at the cap",
            cell=lambda row: "-" if row.rests_on is None else row.rests_on.text,
            flat=tuple(f"rests_on_{name}" for name in SUPPORT),
            hover=lambda row: "" if row.rests_on is None else row.rests_on.sentence,
        ),
        Column(
            "",
            lambda row: row.wins,
            meaning="grid cells with significantly fewer samples, and with more, over all other entries",
            head="cells +/-",
            cell=lambda row: f"{row.wins}/{row.losses}",
        ),
        Column("copeland", lambda row: row.copeland),
        Column("wins", lambda row: row.wins),
        Column("losses", lambda row: row.losses),
        Column("outperforms", lambda row: list(row.outperforms)),
        Column("outperformed_by", lambda row: list(row.outperformed_by)),
    ]


def facts(section: Section) -> list[Column[Row]]:
    """Return the columns that ranks and tiers have in common."""
    final, *others = of_entry(section.score.called, section.score.sign > 0)

    def cost(name: str) -> Column[Row]:
        meaning = f"mean over the last tenth of the epochs, less is better; --by {name} ranks by it"
        return Column("", lambda row: row.costs[name], "{:.3g}".format, meaning, head=name)

    by_name: Column[Row] = Column(
        "costs", lambda row: dict(row.costs), flat=tuple(f"cost_{name}" for name in section.ranking.costs)
    )
    made: list[Column[Row]] = [
        Column("label", lambda row: row.entry.label),
        Column("external", lambda row: row.entry.external),
        Column(
            "sample_complexity",
            lambda row: row.reference.steps,
            meaning=_complexity(section),
            cell=lambda row: ">= " * row.reference.unsettled + steps_text(row.reference.steps),
            hover=lambda row: row.reference.text,
        ),
        Column("interval", lambda row: [row.reference.low, row.reference.high]),
        Column("at_cap", lambda row: row.reference.at_cap),
        Column("unsettled", lambda row: row.reference.unsettled),
        final.of(lambda row: row.cut),
        *map(cost, section.ranking.costs),
        *([by_name] if section.ranking.costs else []),
        Column(
            "seeds",
            lambda row: len(row.entry.seeds),
            cell=lambda row: f"{len(row.entry.seeds)}{'*' * row.provisional}{'!' * row.time.few}",
            most=True,
        ),
        Column("unfinished_seeds", lambda row: len(row.entry.left_out)),
        Column("diverged_seeds", lambda row: list(row.entry.diverged)),
        Column("provisional", lambda row: row.provisional),
        Column(
            "core_hours",
            lambda row: row.entry.hours,
            meaning="of training",
            head="core-hours",
            cell=lambda row: (
                "-" if row.entry.external and not row.entry.hours else hours_text(row.entry.hours)
            ),
        ),
        Column(
            "",
            lambda row: sum(row.entry.parameters),
            meaning="trained numbers of an agent; q: of a quantum circuit; fixed: numbers that stay as "
            "they were drawn",
            head="parameters",
            cell=lambda row: row.entry.parameters_text(" q"),
        ),
        Column(
            "parameters",
            lambda row: {
                "classical": row.entry.parameters[0],
                "quantum": row.entry.parameters[1],
                "fixed": row.entry.fixed,
                "networks": row.entry.networks,
            },
            flat=("parameters_classical", "parameters_quantum", "parameters_fixed", "networks"),
        ),
        Column("settings", lambda row: row.entry.settings, cell=lambda row: row.entry.settings, words=True),
        Column("tuning", lambda row: row.entry.tuning, flat=()),
    ]
    own: list[Column[Any]] = [*ranks(section), *tiers(section), *made]
    require_new(others, {name for column in own for name in (column.name, *column.heads)})
    return [*made, *(column.of(lambda row: row.cut) for column in others)]


def _complexity(section: Section) -> str:
    goal = "score 1 - epsilon or more" if section.times.kind == "epsilon" else "have reached a threshold"
    return f"steps until a share delta of the seeds {goal}, here at {section.ranking.cell}"
