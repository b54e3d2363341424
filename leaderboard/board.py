"""Leaderboards: entries of a task ranked by significant outperformance, one section per horizon.

Everything is computed here from raw curves. Entries that are shorter than the task's shortest horizon stand in
a provisional section of their own length.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from html import escape
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import PluginError, QrlSuiteError
from qrlsuite.experiment.task import RankingSection
from qrlsuite.leaderboard import rules, tables
from qrlsuite.leaderboard.pair import OnBoard, PairVerdict, judge_pair
from qrlsuite.leaderboard.rules import DEFAULT, TIMES
from qrlsuite.leaderboard.sheet import Sheet
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.times import ALPHA, TimeRanking, rank_by_time
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import (
    MIN_RUNS,
    Board,
    Comparison,
    LearningCurves,
    SignificanceRule,
    at_cap,
    bootstrap_interval,
    compare,
    outperformance,
    sample_complexity,
    unsettled,
)
from qrlsuite.statistics.compare import TOO_FEW
from qrlsuite.statistics.times import check_probability


@dataclass(frozen=True)
class Complexity:
    """Sample complexity at one cell: steps, its 5th to 95th percentile, and both marks."""

    steps: int
    low: int
    high: int
    at_cap: bool
    unsettled: bool

    @property
    def text(self) -> str:
        """Steps with interval and marks: `>= 64k (52k to 200k, at cap)`."""
        sign = ">= " if self.unsettled else ""
        mark = ", at cap" if self.at_cap else ""
        return f"{sign}{steps_text(self.steps)} ({steps_text(self.low)} to {steps_text(self.high)}{mark})"


@dataclass(frozen=True)
class Support:
    """The narrowest win in the chain that puts an entry into its tier.

    Attributes
    ----------
    winner, loser:
        Labels of the pair.
    cells:
        Cells in which the winner needs significantly fewer samples.
    at_cap:
        Cells that say nothing, because both are at the cap.
    total:
        Cells of the grid.
    """

    winner: str
    loser: str
    cells: int
    at_cap: int
    total: int

    @property
    def text(self) -> str:
        """`1 of 3`: won, of the cells in which not both are at the cap."""
        return f"{self.cells} of {self.total - self.at_cap}"


@dataclass(frozen=True)
class Row:
    """One entry of a section.

    Attributes
    ----------
    tier:
        None for an entry that is undecided, or reached the goal of no cell.
    wins, losses:
        Cells of the ranking grid, over all other entries, in which it needs significantly fewer samples, and more.
    """

    entry: EntryResults
    tier: int | None
    reference: Complexity
    median_score: float
    copeland: int
    wins: int
    losses: int
    outperforms: tuple[str, ...]
    outperformed_by: tuple[str, ...]
    provisional: bool
    """Fewer seeds than the task's protocol asks for."""
    not_reached: bool = False
    """At the cap in every cell: below those that outperform it, not ranked among others like it."""
    rests_on: Support | None = None
    """None in the first tier, and without a tier."""

    @property
    def depth(self) -> float:
        """What orders entries on the board: the tier, then those that reached no goal; 0 where undecided."""
        return float("inf") if self.not_reached else float(self.tier or 0)

    @property
    def reason(self) -> str:
        """Why the entry has no tier; empty where it has one."""
        return "" if self.tier is not None else untiered_reason(self)


@dataclass(frozen=True)
class Section:
    """The ranking of a task's entries at one horizon."""

    task: str
    summary: str
    horizon: int
    provisional: bool
    """Shorter than the task's own horizons."""
    cell: str
    rows: tuple[Row, ...]
    pairs: Board
    """The verdicts of all pairs, cell by cell."""
    times: TimeRanking
    """The same entries by steps below threshold, which ranks them."""
    rule: str = DEFAULT
    """Name of the significance rule that the tiers rest on."""
    promise: str = ""
    """What that rule controls."""
    by_tiers: bool = False
    """Whether tables show tiers by that rule in the place of ranks: where it was asked for, or the task names it."""


@dataclass(frozen=True, repr=False)
class Leaderboard(Shown):
    """All sections, and what was refused and why. It shows itself as a table per task."""

    sections: tuple[Section, ...]
    refused: tuple[str, ...]

    @property
    def rules(self) -> dict[str, str]:
        """Name and promise of every significance rule that judged a section."""
        return {section.rule: section.promise for section in self.sections}

    @property
    def rule(self) -> str:
        """Their names, joined by commas; the paper's where there is no section."""
        return ", ".join(self.rules) or DEFAULT

    @property
    def promise(self) -> str:
        """What they control, joined by semicolons."""
        return "; ".join(self.rules.values())

    def as_dict(self) -> dict[str, Any]:
        """Return the board as plain values, for JSON."""
        return as_dict(self)

    def sheets(self, explain: bool = False, pairs: bool = False) -> list[Sheet]:
        """Return a table per task; `explain` adds what its columns and marks mean, `pairs` the matrix of pairs."""
        return tables.sheets(self.sections, explain, pairs)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from self.sheets()
        for line in self.refused:
            yield Text(f"left out: {line}")

    def _repr_html_(self) -> str:
        parts = [sheet.html() for sheet in self.sheets()]
        parts += [f"<p>left out: {escape(line)}</p>" for line in self.refused]
        return "\n".join(parts) or "<p>no entries</p>"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class EntryComparison(Shown, Comparison):
    """The result of `compare_entries`. It shows itself as a verdict, a table of thresholds, and the cells in a line.

    Attributes
    ----------
    labels:
        What the two entries are called.
    pair:
        The verdict by steps below threshold, and the final scores.
    remarks:
        What may flatter one of them.
    show_cells:
        Whether the cells are shown one by one: a rule was asked for.
    among:
        The same pair on the board of its task; None where it was not looked for, or there is no other entry.
    """

    labels: tuple[str, str]
    pair: PairVerdict
    remarks: tuple[str, ...] = ()
    show_cells: bool = False
    among: OnBoard | None = None

    @property
    def verdict(self) -> str:
        """Which entry needs fewer steps, by how much and how surely, in a sentence."""
        return self.pair.sentence

    @property
    def headline(self) -> str:
        """Who is compared with whom cell by cell, and at how many seeds and steps."""
        one, other = self.labels
        rule = "" if self.rule == DEFAULT else f", rule '{self.rule}'"
        return f"{one} against {other}, {self.n_runs} seeds each, {self.horizon} steps{rule}"

    @property
    def cells_line(self) -> str:
        """What the rule for cells of the sample-complexity surface says."""
        rule = "the paper's rule" if self.rule == DEFAULT else f"rule '{self.rule}'"
        return f"by {rule}, cell by cell: {self.sentence}"

    @property
    def further(self) -> list[str]:
        """What follows the table of thresholds, line by line."""
        board = self.among.text if self.among is not None else ""
        return [line for line in (board, self.pair.final, self.cells_line, *self.remarks) if line]

    @property
    def legend(self) -> str:
        """What the signs in the table of cells mean."""
        return tables.legend(self)

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison as plain values, for JSON: the cells, and `verdict` and `times` beside them."""
        return {
            **super().as_dict(),
            "verdict": self.verdict,
            "times": self.pair.as_dict(),
            "board": None if self.among is None else asdict(self.among),
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.verdict)
        yield tables.pair_table(self.pair)
        yield Text("\n".join(self.further))
        if self.show_cells:
            yield Text(f"\n{self.headline}:")
            yield tables.comparison_table(self)
            yield Text(self.legend)

    def _repr_html_(self) -> str:
        pair = self.pair
        notes = [*pair.notes, *self.further]
        shown = Sheet.of(self.verdict, pair.columns(), pair.rows(), notes, explained=True).html()
        return shown + (tables.comparison_html(self, self.headline) if self.show_cells else "")


def learning_curves(entry: EntryResults) -> LearningCurves:
    """Return an entry's curves as the statistics take them."""
    return LearningCurves(entry.curves, entry.steps_per_epoch, entry.name)


_WITH_LOOKS = (
    "trained by a study with looks, which stops by what the seeds show, so that no rule for a fixed number of seeds "
    "applies; `qrlsuite show STUDY` has its verdicts"
)


def build(
    entries: Sequence[EntryResults],
    refused: Sequence[str] = (),
    rule: SignificanceRule | None = None,
    horizon: int | None = None,
    alpha: float = ALPHA,
    shown: Callable[[EntryResults], bool] | None = None,
) -> Leaderboard:
    """Rank entries, task by task and horizon by horizon.

    Entries of one task that were made under another definition of it are refused: the majority's stands. So are those
    of a study with looks, whose number of seeds depends on what they showed.

    Parameters
    ----------
    entries:
        Of any tasks.
    refused:
        Lines about what could not be read, passed on.
    rule:
        By which tiers are judged, see `qrlsuite.leaderboard.rules.load`; None means each task's own, the paper's
        where it names none. Tables show tiers where a rule other than `times` is given or named.
    horizon:
        Environment steps at which all entries that reach it are ranked; None means the task's own horizons.
    alpha:
        Error probability of the whole board, see `qrlsuite.leaderboard.times.rank_by_time`.
    shown:
        Which entries have a row. All are compared: what is shown changes no verdict. None means all.

    Raises
    ------
    OptionError
        If `alpha` is not between 0 and 1.
    PluginError
        If a plugin's rule fails.
    """
    check_probability(alpha, "alpha")
    sections: list[Section] = []
    ranked, unranked = of_one_definition(entries)
    problems = [*refused, *unranked]
    for task in sorted({entry.task for entry in ranked}):
        good = [entry for entry in ranked if entry.task == task]
        for steps, provisional, group in _by_horizon(good, horizon):
            if shown is not None and not any(map(shown, group)):
                continue
            try:
                chosen = rule or rule_of(group)
                named = rule is not None or ranking_of(group).rule is not None
                section = _section(task, steps, provisional, group, chosen, alpha, shown)
                sections.append(replace(section, by_tiers=named and chosen.name != TIMES))
            except PluginError:
                raise
            except QrlSuiteError as error:
                problems.append(f"task '{task}' at {steps} steps: {error}")
    return Leaderboard(tuple(sections), tuple(problems))


def of_one_definition(entries: Sequence[EntryResults]) -> tuple[list[EntryResults], list[str]]:
    """Leave out entries of studies with looks or chosen seeds, and those made under another definition than most.

    Returns
    -------
    tuple
        The entries that stay, task by task, and one line for each that was left out.
    """
    problems = [f"{entry.folder}: {_WITH_LOOKS}" for entry in entries if entry.plan]
    problems += [f"{entry.folder}: {entry.chosen_seeds}" for entry in entries if entry.chosen_seeds]
    fixed = [entry for entry in entries if not entry.plan and not entry.chosen_seeds]
    kept = []
    for task in sorted({entry.task for entry in fixed}):
        members = [entry for entry in fixed if entry.task == task]
        hashes = [entry.task_hash for entry in members]
        definition = max(sorted(set(hashes)), key=hashes.count)
        kept += [entry for entry in members if entry.task_hash == definition]
        problems += [
            f"{entry.folder}: made under another definition of task '{task}' ({entry.task_hash}, not {definition})"
            for entry in members
            if entry.task_hash != definition
        ]
    return kept, problems


def _by_horizon(
    entries: Sequence[EntryResults], requested: int | None
) -> list[tuple[int, bool, list[EntryResults]]]:
    """Divide entries of a task: (horizon, provisional, members); a long entry is in every section it reaches."""
    horizons = sorted(ranking_of(entries).horizons)
    groups = []
    for horizon in horizons if requested is None else [requested]:
        reached = [entry.reaching(horizon // entry.steps_per_epoch) for entry in entries]
        members = [entry for entry in reached if entry is not None]
        if members:
            groups.append((horizon, horizon < horizons[0], members))
    if requested is not None:
        return groups
    short = [entry for entry in entries if entry.longest * entry.steps_per_epoch < horizons[0]]
    lengths = sorted({_length(entry) for entry in short}, reverse=True)
    return groups + [
        (steps, True, [entry for entry in short if _length(entry) == steps]) for steps in lengths
    ]


def _length(entry: EntryResults) -> int:
    return int(entry.curves.shape[1]) * entry.steps_per_epoch


def ranking_of(entries: Sequence[EntryResults]) -> RankingSection:
    """Return the cells and horizons that most entries of a task have; they are equal where it is registered."""
    ranked = [entry.task_file.ranking for entry in entries]
    return max(sorted(ranked, key=lambda r: r.model_dump_json()), key=ranked.count)


def rule_of(entries: Sequence[EntryResults]) -> SignificanceRule:
    """Return the rule that a task names in `[ranking]`, the paper's where it names none."""
    return rules.load(ranking_of(entries).rule or DEFAULT)


def _section(
    task: str,
    horizon: int,
    provisional: bool,
    entries: Sequence[EntryResults],
    rule: SignificanceRule,
    alpha: float,
    shown: Callable[[EntryResults], bool] | None,
) -> Section:
    ranking = ranking_of(entries)
    board = outperformance([learning_curves(entry) for entry in entries], ranking.grid, rule, horizon=horizon)
    by_name = {entry.name: entry for entry in entries}
    labels = {entry.name: entry.label for entry in entries}
    protocol_seeds = entries[0].task_file.protocol.seeds
    rows = []
    places, better = board.ranking, board.better_cells
    capped = {place.name for place in places.not_reached}
    for place in places.entries:
        entry = by_name[place.name]
        if shown is not None and not shown(entry):
            continue
        values = entry.curves[:, : horizon // entry.steps_per_epoch]
        rows.append(
            Row(
                entry=entry,
                tier=place.tier,
                reference=complexity_at(values, ranking, entry.steps_per_epoch, horizon),
                median_score=float(np.median(values[:, -1])),
                copeland=place.copeland,
                wins=int(better[board.names.index(place.name)].sum()),
                losses=int(better[:, board.names.index(place.name)].sum()),
                outperforms=tuple(labels[name] for name in place.outperforms),
                outperformed_by=tuple(labels[name] for name in place.outperformed_by),
                provisional=len(entry.seeds) < protocol_seeds,
                not_reached=place.name in capped,
                rests_on=_support(board, place.rests_on, labels),
            )
        )
    return Section(
        task=task,
        summary=entries[0].task_file.summary,
        horizon=horizon,
        provisional=provisional,
        cell=cell_text(ranking),
        rows=tuple(rows),
        pairs=board,
        times=rank_by_time(entries, ranking.grid, horizon, alpha, shown),
        rule=rule.name,
        promise=rule.promise,
    )


def _support(board: Board, pair: tuple[str, str] | None, labels: Mapping[str, str]) -> Support | None:
    if pair is None:
        return None
    won, lost = (board.names.index(name) for name in pair)
    return Support(
        winner=labels[pair[0]],
        loser=labels[pair[1]],
        cells=int((board.signs[won, lost] > 0).sum()),
        at_cap=int(board.capped[won, lost].sum()),
        total=board.signs[won, lost].size,
    )


def cell_text(ranking: RankingSection) -> str:
    """Return the reference cell in words."""
    cell = ranking.reference
    if cell.epsilon is not None:
        return f"epsilon {cell.epsilon:g}, delta {cell.delta:g}"
    return f"return {cell.threshold:g}, delta {cell.delta:g}"


def complexity_at(
    values: np.ndarray[Any, np.dtype[np.float64]], ranking: RankingSection, steps_per_epoch: int, horizon: int
) -> Complexity:
    """Return the sample complexity at a task's reference cell.

    Parameters
    ----------
    values:
        (N, T) learning curves, cut to the horizon.
    """
    cell = ranking.reference_grid
    steps = sample_complexity(values, cell, steps_per_epoch)
    interval = bootstrap_interval(values, cell, steps_per_epoch)
    low, high = (round(float(v)) for v in interval[0, 0])
    capped, open_end = at_cap(interval, horizon)[0, 0], unsettled(values, cell)[0, 0]
    return Complexity(int(steps[0, 0]), low, high, bool(capped), bool(open_end))


def compare_entries(
    first: EntryResults, second: EntryResults, rule: SignificanceRule | None = None
) -> EntryComparison:
    """Compare two entries of one task: by steps below threshold, by final score, and cell by cell of its ranking grid.

    Parameters
    ----------
    first, second:
        The entries.
    rule:
        What counts as significant in a cell; None means the task's own, the paper's where it names none.

    Raises
    ------
    QrlSuiteError
        If they belong to different tasks, one is of a study with looks, or their lengths have no common horizon.
    """
    if first.task_hash != second.task_hash:
        raise QrlSuiteError(
            f"'{first.label}' was run on {first.task} and '{second.label}' on {second.task} "
            f"(definitions {first.task_hash} and {second.task_hash}): only entries of one task can be compared"
        )
    for entry in (first, second):
        if entry.plan:
            raise QrlSuiteError(f"'{entry.label}' was {_WITH_LOOKS}")
        if entry.chosen_seeds:
            raise QrlSuiteError(f"'{entry.label}': {entry.chosen_seeds}")
    epochs = min(first.curves.shape[1], second.curves.shape[1])
    first, second = first.reaching(epochs) or first, second.reaching(epochs) or second
    grid, asked = ranking_of([first, second]).grid, rule is not None
    pair = judge_pair(first, second, grid, ALPHA)
    rule = rule or rule_of([first, second])
    comparison = compare(learning_curves(first), learning_curves(second), grid, rule)
    values = {field.name: getattr(comparison, field.name) for field in fields(comparison)}
    remarks = tables.changed_thresholds([first, second]) + [
        f"{entry.label}: settings chosen after seeing runs on protocol seeds, which may flatter"
        for entry in (first, second)
        if entry.on_protocol_seeds
    ]
    return EntryComparison(**values, labels=pair.labels, pair=pair, remarks=tuple(remarks), show_cells=asked)


def untiered_reason(row: Row) -> str:
    """Say why an entry has no tier."""
    if row.not_reached:
        return "not reached: at the cap in every cell, and not ranked among each other"
    if len(row.entry.seeds) < MIN_RUNS:
        return TOO_FEW
    return "undecided: nothing to compare with"


def as_dict(board: Leaderboard) -> dict[str, Any]:
    """Return a leaderboard as plain values, for JSON."""
    return {
        "rule": board.rule,
        "sections": [
            {
                "task": section.task,
                "horizon": section.horizon,
                "provisional": section.provisional,
                "cell": section.cell,
                "rule": section.rule,
                "times": section.times.as_dict(),
                "rows": [_row_dict(row) for row in section.rows],
            }
            for section in board.sections
        ],
        "refused": list(board.refused),
    }


def _row_dict(row: Row) -> dict[str, Any]:
    entry = row.entry
    return {
        "tier": row.tier,
        "verdict": "ranked" if row.tier is not None else untiered_reason(row),
        "rests_on": None if row.rests_on is None else asdict(row.rests_on),
        "entry": entry.name,
        "label": entry.label,
        "parameters": {
            "classical": entry.parameters[0],
            "quantum": entry.parameters[1],
            "fixed": entry.fixed,
            "networks": entry.networks,
        },
        "settings": entry.settings,
        "seeds": len(entry.seeds),
        "unfinished_seeds": len(entry.left_out),
        "diverged_seeds": list(entry.diverged),
        "provisional": row.provisional,
        "sample_complexity": row.reference.steps,
        "interval": [row.reference.low, row.reference.high],
        "at_cap": row.reference.at_cap,
        "unsettled": row.reference.unsettled,
        "median_score": row.median_score,
        "copeland": row.copeland,
        "wins": row.wins,
        "losses": row.losses,
        "outperforms": list(row.outperforms),
        "outperformed_by": list(row.outperformed_by),
        "core_hours": entry.hours,
        "tuning": entry.tuning,
    }
