"""Boards as sheets, and comparisons as tables for a terminal and a notebook."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from qrlsuite.columns import Column
from qrlsuite.engine.sheet import Sheet
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.leaderboard.boards import columns
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.shelf.absent import absent
from qrlsuite.notation import START
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import (
    counted,
    interval_text,
    mean_text,
    p_text,
    steps_text,
)
from qrlsuite.statistics import Direction
from qrlsuite.statistics.compare import MIN_RUNS, TOO_FEW
from qrlsuite.statistics.curves import reached
from qrlsuite.statistics.steps import LEAST_RUNS

if TYPE_CHECKING:  # boards show themselves by this module
    from qrlsuite.leaderboard.boards.steps import Section
    from qrlsuite.leaderboard.shelf.curves import EntryResults

MARKS = {
    "†": "settings chosen after seeing runs on protocol seeds, which may flatter",
    "*": "fewer than the protocol's {protocol} seeds",
    "!": "fewer than 50 seeds against another number: errors are likelier",
    ">=": "lower bound",
}


def sheets(sections: Sequence[Section], explain: bool = False) -> list[Sheet]:
    """Return a table per task, at the horizon that most of its entries reach; the others have a line below it.

    With `explain` the matrix of all pairs follows each.
    """
    made = []
    for task in dict.fromkeys(section.task for section in sections):
        of_task = [section for section in sections if section.task == task]
        main = main_section(of_task)
        made.append(replace(sheet(main, explain), lines=tuple(_elsewhere(main, of_task))))
        made += [pairs_sheet(main)] * (explain and len(main.rows) > 1)
    return made


def main_section(sections: Sequence[Section]) -> Section:
    """Return the section to show of a task: the one with most entries, then the longest; not provisional if possible.

    Among provisional sections it is the one at which most entries end: an entry that has just begun cuts no other.
    """

    def entries(section: Section) -> int:
        if not section.provisional:
            return len(section.rows)
        ends = (row.entry.curves.shape[1] * row.entry.steps_per_epoch for row in section.rows)
        return sum(end == section.horizon for end in ends)

    return max(sections, key=lambda each: (not each.provisional, entries(each), each.horizon))


def _elsewhere(main: Section, sections: Sequence[Section]) -> list[str]:
    """Return a line for every entry of other horizons, and the command that shows them in a table."""
    told, lines = {row.entry.name for row in main.rows}, []
    for section in sorted(sections, key=lambda each: -each.horizon):
        for row in section.rows:
            if row.entry.name in told:
                continue
            told.add(row.entry.name)
            mean = row.time.mean
            lines.append(
                f"shorter: {row.entry.label}, {counted(len(row.entry.seeds), 'seed')}, {steps_text(section.horizon)} "
                f"steps, {interval_text(mean_text, mean.mean, *mean.interval)} of them {section.before} threshold"
                + f"; diverged: {_of_seeds(row.entry, len(row.entry.diverged))}"
                * bool(row.entry.diverged)
            )
    others = [each for each in sections if each is not main]
    lines += [
        f"--horizon {each.horizon} ranks all at their first {steps_text(each.horizon)} steps"
        for each in others
        if lines and each.horizon < main.horizon
    ]
    longer = [each for each in others if each.horizon > main.horizon]
    lines += [
        f"{counted(len(e.rows), 'entry')} at {steps_text(e.horizon)} steps: --horizon {e.horizon}"
        for e in longer
    ]
    return lines


def sheet(section: Section, explain: bool = False) -> Sheet:
    """Return a section as a table: ranks, or tiers where it shows these."""
    facts_columns = columns.facts(section)
    shown: tuple[Column[Any], ...]
    if section.by_tiers:
        shown = (
            *columns.tiers(section),
            *(each for each in facts_columns if each.name != "sample_complexity"),
        )
    else:
        shown = (*columns.ranks(section), *facts_columns)
    remarks = notes(section, section.by_tiers, () if section.by_tiers else section.times.special())
    rows = section.tiers if section.by_tiers else section.rows
    return Sheet(
        title(section), shown, rows, tuple(remarks), explain, label=f"{section.task}-{section.horizon}"
    )


def notes(section: Section, by_tiers: bool, special: Sequence[str] = ()) -> list[str]:
    """Return what to know of a section beside its numbers, the most important first.

    Parameters
    ----------
    special:
        Lines on single pairs.
    """
    first, *others = tier_notes(section) if by_tiers else _rank_notes(section)
    entries = [row.entry for row in section.rows]
    promise = [f"rule '{section.rule}': {section.promise}"] * by_tiers
    marks = _marks(section)
    return [first, *doubts(entries, section.horizon), *others, *marks, *special, *promise, *remarks(entries)]


def title(section: Section) -> str:
    """Return the heading of a section."""
    algorithms = {row.entry.algorithm for row in section.rows}
    only = f", {algorithms.pop()}" if len(algorithms) == 1 else ""
    whole = steps_text(min(ranking_of([row.entry for row in section.rows]).horizons))
    steps = f"{steps_text(section.horizon)}{f' of {whole}' * section.provisional} steps"
    by = f", tiers by rule '{section.rule}'" if section.by_tiers else ""
    return f"{section.task}{only}, {steps}{' (provisional)' * section.provisional}{by}"


def _rank_notes(section: Section) -> list[str]:
    times = section.times
    pairs = (
        f"{times.n_decided} of {counted(times.n_pairs, 'pair')} of {times.n_ranked} entries decided, error "
        f"{times.board.alpha:g} for all together"
        if times.n_pairs
        else "no pair to test"
    )
    few = any(len(row.entry.seeds) < MIN_RUNS for row in section.rows)
    return [
        f"rank: by significant outperformance: {pairs}",
        *[f"no rank below {MIN_RUNS} seeds; `qrlsuite compare` decides from {LEAST_RUNS} on"] * few,
        f"steps {section.before} threshold: mean over seeds and thresholds; sample complexity at {section.ranking.cell}"
        + policies_text(section),
    ]


def policies_text(section: Section) -> str:
    """Return the scores of other policies, as the end of a note: `; final score of random 0.51, greedy 0.72`."""
    told = ", ".join(f"{name} {value:.4g}" for name, value in section.ranking.policies.items())
    return f"; final {section.score.called} of {told}" * bool(told)


def tier_notes(section: Section) -> list[str]:
    """Define tiers, and explain why an entry has none."""
    return [
        "tier: 1 + the longest chain of entries above, each outperforming the next; sample complexity at "
        f"{section.ranking.cell}{policies_text(section)}",
        *sorted({row.reason for row in section.tiers if row.reason}),
    ]


def _marks(section: Section) -> list[str]:
    """Explain the marks that occur, in one line."""
    rows = section.rows
    occurring = {
        "†": any(row.entry.on_protocol_seeds for row in rows),
        "*": any(row.provisional for row in rows),
        "!": any(row.time.few for row in rows),
        ">=": any(row.reference.unsettled for row in rows),
    }
    protocol = rows[0].entry.task_file.protocol.seeds
    marks = [f"{mark} {MARKS[mark].format(protocol=protocol)}" for mark, there in occurring.items() if there]
    return ["; ".join(marks)] * bool(marks)


def _of_seeds(entry: EntryResults, count: int) -> str:
    return f"{count} of {len(entry.seeds)} seeds"


def about(entries: Sequence[EntryResults]) -> list[str]:
    """Return the notes below every verdict: first doubts, then how settings were found and what trained the entries."""
    return [*doubts(entries), *remarks(entries)]


def remarks(entries: Sequence[EntryResults]) -> list[str]:
    """Return further notes on entries: how their settings were found, and what made them."""
    notes = {
        "parameters of the first network alone (older records count no other, such as a critic)": {
            entry.label: "" for entry in entries if entry.first_network_alone
        },
        "made with a plugin's code, and not probed": {entry.label: "" for entry in entries if entry.unprobed},
        "not installed here, so judged from the stored curves": {
            name: "" for entry in entries for name in absent(entry)
        },
        "made with several versions, see `qrlsuite show ENTRY`": {
            entry.label: ", ".join(entry.mixed_versions) for entry in entries if entry.mixed_versions
        },
        "seeds of several codes that `--same` joined, see `qrlsuite show ENTRY`": {
            entry.label: "" for entry in entries if len(entry.codes) > 1
        },
        "trained on several kinds of device, see `qrlsuite show ENTRY`": {
            entry.label: ", ".join(entry.devices) for entry in entries if len(entry.devices) > 1
        },
    }
    return [*_settings(entries), *_listed(notes)]


def doubts(entries: Sequence[EntryResults], horizon: int | None = None) -> list[str]:
    """Return the notes on entries that may turn a verdict: these stand first.

    Parameters
    ----------
    horizon:
        Environment steps at which all are judged; None means the shortest one's.
    """
    failed = _failed(entries, horizon)
    nowhere = sum(len(entry.seeds) == failed[entry.label] for entry in entries) > 1
    by_area = "; `--by area` ranks by the learning curves alone" * nowhere
    notes = {
        "curves of other programs, which nobody here can train or check again": {
            entry.label: entry.ended_early
            for entry in entries
            if entry.external and entry.algorithm != SCRIPT
        },
        "trained by scripts, which `qrlsuite verify` cannot train again": {
            entry.label: "" for entry in entries if entry.algorithm == SCRIPT
        },
        "warm-started, without the steps that their first agents took before": {
            entry.label.partition(f" {START}=")[0]: f"from {entry.identity[START]}"
            for entry in entries
            if START in entry.identity
        },
        "seeds have in common by declaration": {
            entry.label: "; ".join(entry.declared) for entry in entries if entry.declared
        },
        f"failed (reached no threshold{by_area})": {
            entry.label: _of_seeds(entry, failed[entry.label]) for entry in entries if failed[entry.label]
        },
        "diverged (numbers of the agents are no longer finite), judged with the scores that they had": {
            entry.label: _of_seeds(entry, len(entry.diverged)) for entry in entries if entry.diverged
        },
        **{
            sentence: {entry.label: "" for entry in entries if sentence in entry.unusable}
            for sentence in dict.fromkeys(line for entry in entries for line in entry.unusable)
        },
        "unfinished seeds, left out": {
            entry.label: format_seeds(entry.left_out)
            for entry in entries
            if set(entry.left_out) - {*entry.missing}
        },
    }
    return [*missing(entries), *_listed(notes), *_edited(entries), *changed_thresholds(entries)]


def _failed(entries: Sequence[EntryResults], horizon: int | None) -> dict[str, int]:
    """Return how many seeds of each entry reach no threshold, by label."""
    if not entries:
        return {}
    grid = ranking_of(entries).grid
    end = horizon or min(entry.curves.shape[1] * entry.steps_per_epoch for entry in entries)
    curves = {entry.label: entry.curves[:, : end // entry.steps_per_epoch] for entry in entries}
    return {label: int((~reached(each, grid).any(axis=(0, 1))).sum()) for label, each in curves.items()}


def missing(entries: Sequence[EntryResults]) -> list[str]:
    """Name the seeds that are missing, with the remedy, and the requests that were withdrawn."""
    notes = {
        "incomplete, without rank until these seeds are trained (`qrlsuite run`) or withdrawn (`qrlsuite runs rm "
        "ENTRY --seeds`)": {entry.label: entry.missing_text for entry in entries if entry.missing},
        "seeds that were asked for, and withdrawn": {
            entry.label: "; ".join(
                f"{format_seeds([seed for seed, why in entry.withdrawn.items() if why == reason])}: {reason}"
                for reason in dict.fromkeys(entry.withdrawn.values())
            )
            for entry in entries
            if entry.withdrawn
        },
    }
    return _listed(notes)


def _listed(notes: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Write a line for each note: the entries' labels, each with its text."""
    return [
        f"{note}: {', '.join(f'{label} ({text})' if text else label for label, text in labels.items())}"
        for note, labels in notes.items()
        if labels
    ]


def changed_thresholds(entries: Sequence[EntryResults]) -> list[str]:
    """Name the entries whose thresholds changed after their first seed: they may have been chosen to flatter."""
    used = sorted(ranking_of(entries).grid.thresholds) if entries else []
    labels = [
        entry.label
        for entry in entries
        if entry.changed_thresholds or sorted(entry.first_thresholds or used) != used
    ]
    levels = ", ".join(f"{level:g}" for level in used)
    told = f"thresholds changed after the first seed: {', '.join(labels)} (judged by {levels})"
    return [told] if labels else []


def _grouped(labels: Mapping[str, Hashable]) -> str:
    """Write labels in groups: `A, B | C`."""
    groups: dict[Hashable, list[str]] = {}
    for label, group in labels.items():
        groups.setdefault(group, []).append(label)
    return " | ".join(map(", ".join, groups.values())) if len(groups) > 1 else ""


def _edited(entries: Sequence[EntryResults]) -> list[str]:
    """Name the plugin files that were edited between entries of this board."""
    lines = []
    for name in sorted({name for entry in entries for name in entry.plugins}):
        groups = _grouped({entry.label: entry.plugins[name] for entry in entries if name in entry.plugins})
        if groups:
            lines.append(f"{name} was edited between these entries (its text is not the same): {groups}")
    return lines


def _settings(entries: Sequence[EntryResults]) -> list[str]:
    """Return how the settings of entries were found, and whether they were found alike."""
    found: dict[str, list[str]] = {}
    for entry in entries:
        found.setdefault(_settings_text(entry), []).append(entry.label)
    texts = [text if len(found) == 1 else f"{text}: {', '.join(labels)}" for text, labels in found.items()]
    lines = [f"settings: {'; '.join(texts)}"] if texts else []
    tuned = [entry.tuning for entry in entries if entry.tuning]
    if 0 < len(tuned) < len(entries):
        lines.append("tuned and untuned settings are compared: a difference may come from tuning")
    budgets = {record.get("budget") for record in tuned}
    if len(budgets) > 1:
        texts = sorted("not known" if budget is None else str(budget) for budget in budgets)
        lines.append(f"tuned with different budgets: {'; '.join(texts)}")
    return lines


def _settings_text(entry: EntryResults) -> str:
    """Say how an entry's settings were found: `released, not tuned`, or by which search, with its regret and budget."""
    if entry.tuning is None:
        return "how they were found is not known" if entry.external else f"{entry.settings}, not tuned"
    search, note = entry.tuning.get("sampler"), entry.tuning.get("note") or ""
    doubts = note.partition("; ")[2] if entry.tuning.get("regret") else note  # it begins with the regret
    flatters = MARKS["†"] * entry.on_protocol_seeds
    return ", ".join(filter(None, [entry.settings, search and f"search: {search}", flatters, doubts]))


SIGNS = {Direction.FEWER: "+", Direction.MORE: "-"}
"""A decided pair, from the row's side."""


def pairs_sheet(section: Section) -> Sheet:
    """Return the matrix of all pairs: who outperforms whom, by the board's ranks or by the cells of its tiers."""
    if section.by_tiers:
        rows = [row.entry for row in section.tiers]
        order = [section.pairs.names.index(entry.name) for entry in rows]
        texts = [[_cells_text(section, i, j) for j in order] for i in order]
        notes = ["+n: the row's entry needs significantly fewer samples in n cells; -n: more; . in none"]
    else:
        rows, order = [row.entry for row in section.rows], list(section.times.order)
        texts = [[_decision_text(section, i, j) for j in order] for i in order]
        notes = [
            "+ the row's entry outperforms the column's; - the reverse; a number: adjusted p of a pair that is not "
            "told apart"
        ]
    if any("?" in line for line in texts):
        notes.append(f"? {TOO_FEW}")
    places = [str(place + 1) for place in range(len(order))]
    lines = [(place, name, *line) for place, name, line in zip(places, columns.names(rows), texts)]
    heads = ("", "entry", *places)
    return Sheet.of(f"{title(section)}: pairs", heads, lines, notes, ("entry",), f"{section.task}-pairs")


def _decision_text(section: Section, i: int, j: int) -> str:
    board = section.times.board
    direction = board.directions[i][j]
    if i == j:
        return ""
    if direction is Direction.UNDECIDED:
        return "?"
    return SIGNS.get(direction, p_text(board.adjusted[i, j]))


def _cells_text(section: Section, i: int, j: int) -> str:
    board = section.pairs
    if i == j:
        return ""
    if not board.decided[i, j]:
        return "?"
    wins, losses = int(board.better_cells[i, j]), int(board.better_cells[j, i])
    return f"{f'+{wins}' * bool(wins)}{f'-{losses}' * bool(losses)}" or "."
