"""The parts of every board: entries that are ranked together, their common cells, and their sample complexity there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qrlsuite.experiment.task import RankingSection
from qrlsuite.leaderboard import rules
from qrlsuite.leaderboard.rules import DEFAULT
from qrlsuite.leaderboard.shelf.curves import EntryResults, edited_between
from qrlsuite.results.text import steps_text
from qrlsuite.statistics import (
    LearningCurves,
    SignificanceRule,
    at_cap,
    bootstrap_interval,
    sample_complexity,
    unsettled,
)
from qrlsuite.statistics.compare import TOO_FEW


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


def learning_curves(entry: EntryResults) -> LearningCurves:
    """Return an entry's curves as the statistics take them."""
    return LearningCurves(entry.curves, entry.steps_per_epoch, entry.name, not entry.missing)


def unranked_since(entry: EntryResults) -> str:
    """Return why a board ranks an entry no better: its seeds are missing, or too few."""
    return "incomplete: seeds are missing" if entry.missing else TOO_FEW


WITH_LOOKS = (
    "trained by a study with looks, whose number of seeds depends on their results, so no rule for a fixed "
    "number applies; `qrlsuite show STUDY` has its verdicts"
)


def of_one_definition(
    entries: Sequence[EntryResults], definitions: Mapping[str, str] | None = None
) -> tuple[list[EntryResults], list[str]]:
    """Leave out entries of studies with looks, or of another task or world than most entries.

    Another task is another definition of the task. Another world is other code of a plugin's environment. If equally
    many entries have two definitions, the one whose hash comes first stays.

    Parameters
    ----------
    definitions:
        Hash of the definition by task name. A definition that is given stays, however few entries have it.

    Returns
    -------
    tuple
        The entries that stay, task by task, and one line for each entry that was left out.
    """
    problems = [f"{entry.folder}: {WITH_LOOKS}" for entry in entries if entry.study]
    fixed = [entry for entry in entries if not entry.study]
    kept = []
    for task in sorted({entry.task for entry in fixed}):
        members = [entry for entry in fixed if entry.task == task]
        hashes = [entry.task_hash for entry in members]
        definition = (definitions or {}).get(task) or max(sorted(set(hashes)), key=hashes.count)
        kept += [entry for entry in members if entry.task_hash == definition]
        problems += [
            f"{entry.folder}: made under another definition of task '{task}' ({entry.task_hash}, not {definition})"
            for entry in members
            if entry.task_hash != definition
        ]
    worlds, edited = [], list[str]()
    for task in sorted({entry.task for entry in kept}):
        members = [entry for entry in kept if entry.task == task]
        codes = [code for entry in members for code in entry.environments]
        most = max(sorted(set(codes)), key=codes.count, default="")
        for entry in members:
            if entry.environments and most not in entry.environments:
                of_most = next(other for other in members if most in other.environments)
                edited.append(f"{entry.folder}: {edited_between(of_most, entry)}")
            else:
                worlds.append(entry)
    return worlds, [*problems, *edited]


def ranking_of(entries: Sequence[EntryResults]) -> RankingSection:
    """Return the cells and horizons that most entries of a task have; all have the same if the task is registered.

    Scores of policies are taken from most of these entries, too, whatever the others state.
    """
    ranked = [entry.task_file.ranking for entry in entries]
    cells = [ranking.model_copy(update={"policies": {}}) for ranking in ranked]
    most = max(sorted(cells, key=_json), key=cells.count)
    stated = [ranking for ranking, own in zip(ranked, cells) if own == most and ranking.policies]
    return max(sorted(stated, key=_json), key=stated.count, default=most)


def _json(ranking: RankingSection) -> str:
    return ranking.model_dump_json()


def rule_of(entries: Sequence[EntryResults]) -> SignificanceRule:
    """Return the rule that a task names in `[ranking]`, the paper's where it names none."""
    return rules.load(ranking_of(entries).rule or DEFAULT)


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
