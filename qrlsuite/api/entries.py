"""Entries from Python: read, rank, compare and draw them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qrlsuite.api.arguments import Seeds, several
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.leaderboard import rules, studies
from qrlsuite.leaderboard.boards import across
from qrlsuite.leaderboard.boards import board as boards
from qrlsuite.leaderboard.boards.board import Leaderboard
from qrlsuite.leaderboard.boards.compared import EntryComparison, compare_entries
from qrlsuite.leaderboard.boards.costs import UNITS
from qrlsuite.leaderboard.boards.pair import on_board
from qrlsuite.leaderboard.boards.times import ALPHA
from qrlsuite.leaderboard.pictures.compose import Composed, compose
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results import lookup
from qrlsuite.results.store import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Selected = tuple[list[EntryResults], list[str]]


def load(
    entry: str, *, task: str | None = None, runs: str | PathLike[str] = "runs", published: bool = False
) -> EntryResults:
    """Read an entry: the learning curves of its seeds, and how they were made.

    Parameters
    ----------
    entry:
        Its name or label, `TASK/` before it or not, or the beginning of one of them; or its folder.
    task:
        Look among the entries of this task only; None looks among all.
    runs:
        The results folder.
    published:
        Look among the published entries that come with the suite, too. Of an entry that is in both, the seeds of both
        are read; where they do not add, or one copy gets further, the better copy.

    Returns
    -------
    EntryResults
        With `curves` of shape (N, T): the mean validation score of N seeds after each of T epochs, in the task's
        units ([0, 1] where scores are fractions of the optimum); `steps_per_epoch` environment steps each;
        `records` by seed; `table("epochs", entries=[results])` for pandas and polars.

    Raises
    ------
    UnknownNameError
        If no entry or several have the name, or no epoch of it is finished; the message names the next command.
    StoreError
        If there is no results folder, or a file is damaged.

    Examples
    --------
    >>> load("mlp width=64", task="beam6g", runs="none-yet", published=True).curves.shape
    (100, 100)
    """
    return collect.find(Selection.create(runs, task, published).named(), entry)


def board(
    task: str | Sequence[str] | None = None,
    *,
    by: str = "steps",
    runs: str | PathLike[str] = "runs",
    published: bool = False,
    rule: str | None = None,
    alpha: float = ALPHA,
    horizon: int | None = None,
    entries: Sequence[str | EntryResults] = (),
    study: str | None = None,
    all_codes: bool = False,
    labels: Mapping[str, str] | Sequence[str] = (),
) -> Leaderboard:
    """Rank entries by significant outperformance: on a task, on each task, or over several tasks together.

    Parameters
    ----------
    task:
        One; None means all, one after the other. Several are compared together: the entries that were trained on
        all of them with the same options, by means over the tasks.
    by:
        `steps`; `executions` (of circuits), `shots` or `core-hours`: the cost of learning, within one budget for all;
        `score`, the mean of the last tenth of the epochs, or `area`, the mean of all; or a metric that the task's
        `[ranking] costs` names, by the last tenth of the epochs, less first. Entries whose record does not
        hold a cost, or not so that it can be compared, have no rank, and a `price.problem` that says why.
    runs, published:
        As for `load`. Published entries that answer the question of one study are not ranked beside others of their
        task: name the study.
    rule:
        None ranks by significant outperformance with the error of the whole board held. `paper`, or another name of
        `qrlsuite list rules`, shows tiers by the cells of the task's grid in the place of ranks. A task
        may name a rule of its own.
    alpha:
        Probability of any false decision on the board.
    horizon:
        Environment steps to which all entries are cut; shorter ones are left out. None means the task's horizons.
    entries:
        Show these only: arguments of `load`. They keep their ranks among all entries of their task. Results of `load`
        are compared only with each other; and by cost, named entries are, too, because the cheapest entry sets the
        budget.
    study:
        Rank the entries of this study only: its name, or a study file's path.
    all_codes:
        Show entries of every code, and not only of the newest code with 20 seeds or more.
    labels:
        Names of your own by entry, which are shown as they are.

    Returns
    -------
    Leaderboard
        `sections`, one per task and horizon, with a row per entry; `refused`, one line for each entry that was left
        out and why; `as_dict()`. Without any entry it has no section.

    Raises
    ------
    UnknownNameError
        If a task, an entry or the rule is unknown, or no entry is left.
    OptionError
        If there is no such axis, the horizon is no whole number of epochs, or both `entries` and `study` are given.
    StoreError
        If there is no results folder, and `published` is false.
    PluginError
        If a plugin's rule fails.

    Examples
    --------
    >>> found = board("beam6g", runs="none-yet", published=True, entries=["mlp width=64", "mlp width=16"])
    >>> [(row.rank_text, row.entry.label) for row in found.sections[0].times.rows]
    [('1-3', 'ddqn mlp width=64'), ('11', 'ddqn mlp width=16')]
    >>> names = ["vqc-native qubits=6", "mlp width=16"]
    >>> found = board("beam6g", by="executions", runs="none-yet", published=True, entries=names)
    >>> [(row.entry.label, row.price.problem) for row in found.sections[0].rows]
    [('ddqn vqc-native qubits=6', ''), ('ddqn mlp width=16', 'executes no circuits')]
    """
    written = replace(Selection.create(runs, task, published, labels), all_codes=all_codes)
    selection = written.named()
    together = selection.tasks if len(selection.tasks) > 1 else ()
    if rule is not None and (together or by != "steps"):
        other = "several tasks" if together else f"by = '{by}'"
        raise OptionError(f"--rule {rule} judges cells of one task in environment steps: not {other}")

    if study is not None and entries:
        raise OptionError(f"--study {study} names the entries: leave --entry out")

    def select(among: Selection, chosen: Sequence[str | EntryResults]) -> Selected:
        if study is None:
            return collect.select(among, chosen, horizon)
        return studies.select(study, among, horizon)

    definitions = lookup.definitions(written.tasks)
    if together:
        found, left_out = across.collected(together, lambda task: select(selection.of(task), entries))
        return boards.build(
            found, left_out, None, horizon, alpha, by=by, together=together, definitions=definitions
        )
    shown, left_out = select(selection, entries)
    keys = {(entry.task_hash, entry.name) for entry in shown}
    family = shown
    read = any(isinstance(entry, EntryResults) for entry in entries)
    if entries and not read and by not in UNITS:
        family = _family(shown, select(selection, ())[0])
    return boards.build(
        family,
        left_out,
        rules.load(rule) if rule else None,
        horizon,
        alpha,
        lambda entry: (entry.task_hash, entry.name) in keys,
        by,
        definitions=definitions,
    )


def write_page(
    out: Path | None, written: Selection, by: str, study: str | None, **asked: Any
) -> tuple[Path | None, list[str]]:
    """Write boards as a page, with the studies with looks of their tasks.

    Parameters
    ----------
    out:
        None writes leaderboard.html in the results folder.
    written:
        The tasks as they are written.
    by, study, asked:
        As for `board`.

    Returns
    -------
    tuple
        The file, None where there is nothing to show; and one line for each entry or study that was left out and why.
    """
    from qrlsuite.leaderboard import report
    from qrlsuite.leaderboard.shelf import published_studies

    tasks, runs = written.tasks, written.runs
    asked |= {"runs": runs, "published": written.published, "study": study}
    beside = None if len(tasks) < 2 and by == "steps" else board(tasks, by=by, **asked)
    shown = [board(names, **asked) for names in [[task] for task in tasks] or [[]]]
    sections = tuple(section for one in shown for section in one.sections)
    named = written.named()
    if study is not None and not tasks:
        named = named.of(*sorted({section.task for section in sections}))
    outcomes, unreadable = published_studies.collected(named)
    every = (*shown, *([beside] if beside else []))
    refused = list(dict.fromkeys(line for one in every for line in one.refused)) + list(unreadable)
    if not sections and not outcomes:
        return None, refused
    path = out or runs / "leaderboard.html"
    page = replace(shown[0], sections=sections, refused=tuple(refused))
    write_atomically(path, report.render(page, studies=outcomes, beside=beside).encode())
    return path, refused


def compare(
    first: str | EntryResults,
    second: str | EntryResults,
    *,
    task: str | None = None,
    runs: str | PathLike[str] = "runs",
    published: bool = False,
    rule: str | None = None,
    by: str = "steps",
    labels: Mapping[str, str] | Sequence[str] = (),
) -> EntryComparison:
    """Compare two entries: which needs fewer steps, by how much and how surely, and their final scores.

    All seeds of both count, up to the shorter horizon.

    Parameters
    ----------
    first, second:
        Arguments of `load`, or its results.
    task, runs, published:
        As for `load`.
    rule:
        Judges the cells of the task's grid, too, at equal numbers of seeds: `paper`, or a name of `list rules`.
    by:
        The number that decides the verdict: `steps`, `score`, `area`, `spread`, or a cost that the task names.
    labels:
        As for `board`.

    Returns
    -------
    EntryComparison
        `sentence`, the verdict, and its `p`, `difference` (-0.2: the first needs 20% fewer steps) and `interval`;
        `pair`, with the numbers of each threshold and the final scores; `remarks`, on settings, seeds and versions;
        `among`, the verdict on the board of all entries of the task, where one of the two is given by name; with a
        rule `cells`, a `qrlsuite.statistics.Comparison`. `as_dict()` has all.

    Raises
    ------
    UnknownNameError
        If an entry, the task or the rule is unknown.
    QrlSuiteError
        If the entries belong to different tasks, or their lengths have no common horizon.

    Examples
    --------
    >>> found = compare("mlp width=64", "mlp width=16", task="beam6g", runs="none-yet", published=True)
    >>> for clause in found.sentence.split("; "):
    ...     print(clause)
    mlp width=64 needs 53% fewer steps than mlp width=16 (49% to 56%, 100 seeds each, p < .0001)
    final score 0.909 against 0.860, p < .0001
    >>> round(found.difference, 2), found.p < 0.0002
    (-0.53, True)
    """
    selection = Selection.create(runs, task, published, labels).named()

    def find(entry: str | EntryResults, beside: str | EntryResults) -> EntryResults:
        if isinstance(entry, EntryResults):
            return entry
        try:
            return collect.find(selection, entry)
        except UnknownNameError as error:  # it may be one of several, of which one is on the other's task
            try:
                known = beside if isinstance(beside, EntryResults) else collect.find(selection, beside)
                return collect.find(selection.of(known.task), entry)
            except UnknownNameError:
                raise error from None

    left, other = find(first, second), find(second, first)
    compared = compare_entries(left, other, rules.load(rule) if rule else None, by)
    if isinstance(first, EntryResults) and isinstance(second, EntryResults):
        return compared
    others, left_out = collect.collect(selection.of(left.task))
    among = on_board(left, other, others, compared.pair.times.alpha)
    places = (f"of the same entry, from {left.folder}", f"of the same entry, from {other.folder}")
    codes = [f"than '{one.record.label}{end}" for one in (left, other) for end in ("'", " @")]
    copies = [
        f"left out: {line}"
        for line in left_out
        if line.endswith(places) or any(code in line for code in codes)
    ]
    return replace(compared, among=among, remarks=(*compared.remarks, *copies))


def plot(
    kind: str,
    *,
    task: str | Sequence[str] | None = None,
    entries: Sequence[str | EntryResults] = (),
    study: str | Sequence[str] = (),
    horizon: int | None = None,
    seeds: Seeds | None = None,
    runs: str | PathLike[str] = "runs",
    published: bool = False,
    environment: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Figure:
    """Draw a picture of entries or of a task's environment.

    Entries that would cut the others to their own length are left out, unless `entries` names them. A warning names
    each entry that was left out.

    Parameters
    ----------
    kind:
        Kind of picture, such as `curves`, `bars` or `tiers`: `qrlsuite plot --help` lists the kinds.
    task, entries, horizon, runs, published:
        As for `board`. Without `entries` all of the task are drawn, the smallest model first.
    study:
        Draw a picture that a study's file names, or its entries; of studies with looks also `pairs` and `entries`.
    seeds:
        Draw these alone, of every entry (30: seeds 0 to 29), so that all have equal numbers; entries that lack one are
        left out. None means all.
    environment:
        For a picture of an environment: options that replace the task's.
    settings:
        The picture's own settings: `qrlsuite show picture KIND` lists them.

    Returns
    -------
    matplotlib.figure.Figure
        To show, change, or save with `figure.savefig`.

    Raises
    ------
    UnknownNameError
        If the kind, a task or an entry is unknown, or there are no entries.
    OptionError
        If a setting is unknown or has a bad value, or the picture cannot be made of these entries or tasks.
    StoreError
        If there is no results folder, and `published` is false.

    Examples
    --------
    >>> plot("tiers", task="beam6g", runs="none-yet", published=True).savefig("tiers.pdf")  # doctest: +SKIP
    """
    if "tasks" in settings:
        raise OptionError(f"plot takes `task`, one or several: write task={settings['tasks']!r}")
    drawn = draw_picture(
        kind,
        Selection.create(runs, task, published),
        entries,
        several(study),
        horizon=horizon,
        seeds=seeds,
        settings=settings,
        environment=environment or {},
    )
    for line in drawn.left_out:
        warnings.warn(f"left out: {line}", stacklevel=2)
    return drawn.figure


def draw_picture(
    kind: str,
    selection: Selection,
    entries: Sequence[str | EntryResults],
    of_studies: Sequence[str],
    **settings: Any,
) -> Composed:
    """Draw a picture of entries, studies or a task's environment, as `plot` and its command do."""
    if not of_studies:
        return compose(kind, selection, entries, **settings)
    if entries or settings.pop("environment"):
        raise OptionError(
            f"--study {of_studies[0]} names the entries and their tasks: leave --entry and environment.NAME out"
        )
    return studies.draw(kind, of_studies, selection.named(), **settings)


def _family(shown: Sequence[EntryResults], ranked: Sequence[EntryResults]) -> list[EntryResults]:
    """Return the entries to compare: all ranked entries of the same definitions of tasks, and the shown ones."""
    hashes = {entry.task_hash for entry in shown}
    family = [entry for entry in ranked if entry.task_hash in hashes]
    keys = {(entry.task_hash, entry.name) for entry in family}
    return family + [entry for entry in shown if (entry.task_hash, entry.name) not in keys]
