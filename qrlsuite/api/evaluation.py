"""Plays trained agents and reference policies on the same fresh episodes: a table and a histogram."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.progress import TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from qrlsuite import registry, specs
from qrlsuite.engine.display import Bar
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.task import Task, load
from qrlsuite.leaderboard.pictures import histogram
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf import published as published_entries
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.shelf.published import PublishedAgents
from qrlsuite.notation import parse_named
from qrlsuite.results.store import EntryStore, entries
from qrlsuite.training import evaluation
from qrlsuite.training.deployment import Deployment, steps_per_episode
from qrlsuite.training.evaluation import Played

WIDE = 100
"""Columns of a terminal in which the whole table can be read."""


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Shown):
    """Results of policies on the same fresh episodes of one task.

    Attributes
    ----------
    policies:
        The entries' best trained agents in the order of the entries, then the reference policies.
    episodes:
        Complete episodes of each agent.
    seed:
        The evaluation seed, which fixes the episodes.
    """

    task: str
    task_hash: str
    policies: tuple[Played, ...]
    episodes: int
    seed: int
    score: str = "score"
    """Name of the task's ranked number: `score`, or a metric's name."""

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values: mean, percentiles and extremes of every policy."""
        return {
            "task": self.task,
            "task_hash": self.task_hash,
            "evaluation_seed": self.seed,
            "episodes": self.episodes,
            "selection": "last validation score",
            "policies": [each.summary() for each in self.policies],
        }

    def figure(self) -> Figure:
        """Draw the histogram of the episodes' sums of rewards."""
        note = ""
        if any(each.seeds for each in self.policies):
            note = (
                "agents: the best runs by last validation score; episodes: fresh, the same for all policies"
            )
        values = {each.name: each.returns if each.seeds else each.returns[0] for each in self.policies}
        return histogram.draw(values, quantity="sum of rewards over an episode", title=self.task, note=note)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show a row per policy; a narrow terminal shows means only."""
        wide = options.max_width >= WIDE
        relative = any(each.scores is not None for each in self.policies)
        notes = self._notes()
        if not wide:
            notes.append(f"a terminal of {WIDE} columns shows medians and percentiles too")
        table = Table(
            title=Text(f"{self.task}: {self.episodes} fresh episodes of each policy, the same for all"),
            title_justify="left",
            header_style="bold",
            box=box.SIMPLE_HEAD,
            caption=Text("\n".join(notes)),
            caption_justify="left",
            pad_edge=False,
        )
        names = ["policy", "agents", "return: mean", "median", "5%", "95%"]
        names += [f"{self.score}: mean", "median", "5%", "95%"] * relative
        shown = [i for i, name in enumerate(names) if wide or i < 2 or name.endswith("mean")]
        for name in (names[i] for i in shown):
            table.add_column(
                Text(name),
                justify="left" if name == "policy" else "right",
                overflow="fold",
                no_wrap=name != "policy",
            )
        for each in self.policies:
            row = [
                each.name,
                str(len(each.seeds) or "-"),
                *_row(each, "return"),
                *_row(each, "score") * relative,
            ]
            row += [""] * (len(names) - len(row))
            table.add_row(*(Text(row[i]) for i in shown))
        yield table

    def _notes(self) -> list[str]:
        """Return notes: the choice of the agents, and their validation scores against these results."""
        scores = f"{self.score}: as the task defines it; " * any(
            each.scores is not None for each in self.policies
        )
        notes = [f"return: sum of rewards; {scores}percentiles over all episodes"]
        for each in self.policies:
            if not each.seeds:
                continue
            among = f"the {len(each.seeds)} of {each.runs} runs with the best last validation score"
            promised = f"(mean {np.mean(each.validation):.3f}"
            came = "" if each.scores is None else f"; on these fresh episodes {each.scores.mean():.3f}"
            notes.append(f"{each.name}: {among} {promised}{came})")
        return notes


def _row(played: Played, label: str) -> list[str]:
    content = played.summary()[label]
    if content is None:
        return []
    digits = 3 if label == "score" else 2
    return [f"{content[name]:.{digits}f}" for name in ("mean", "p50", "p5", "p95")]


def evaluate(
    written: Selection,
    names: Sequence[str],
    best: int = 10,
    episodes: int = 1000,
    seed: int = 0,
    device: str = "cpu",
    progress: bool = True,
    backend: str | None = None,
    yes: bool = False,
    perturb: Sequence[float] = (),
) -> Evaluation:
    """Play fresh episodes with the best trained agents of some entries, and with the reference policies.

    Parameters
    ----------
    written:
        Its task, by name or file, is the one that is played. Entries are looked for among its own; one that is named
        with another task before it (`TASK/ENTRY`), or by its folder, plays it too, where observations and actions are
        the same. Without a task the entries play their own.
    names:
        The entries, of one task, as `qrlsuite.leaderboard.shelf.collect.find` finds them; none are the reference
        policies of the task alone.
    best, episodes, seed, device:
        As for `qrlsuite.training.evaluation.trained`.
    progress:
        Whether to show a bar.
    backend:
        Play every entry with its circuits on this backend, too: `qiskit shots=1000`, see
        `qrlsuite.training.deployment`. The cost is printed first; finished episodes are kept.
    yes:
        Execute circuits on a real device.
    perturb:
        Play every entry with its parameters perturbed by each of these relative sizes, too.

    Raises
    ------
    UnknownNameError
        If no entry, or several, have a name, or no task has the name given.
    OptionError
        If neither entry nor task is named, the entries belong to several tasks, or a number is not positive; or agents
        cannot play the task.
    StoreError
        If an entry has no trained agent.
    """
    if not names and (not written.tasks or backend or perturb):
        raise OptionError(
            "name at least one entry to evaluate, or --task alone for a task's reference policies"
        )
    on, stores = find_players(written, names)
    if on is None:
        _one_task(stores)
    there = parse_named(backend, "--backend ") if backend else None
    deployed = [Deployment(store, *there, best, device, on) for store in stores] if there else []
    console = Console(stderr=True, quiet=not progress, highlight=False)
    for each, store in zip(deployed, stores):
        cost = each.cost(episodes, seed, steps_per_episode(store, best, episodes, seed, device, on))
        if not each.simulator and not yes:
            raise OptionError(f"{each.name} is not a simulator: {cost}; add --yes to execute them")
        console.print(f"{each.name}: {cost}", soft_wrap=True)
    bar = Bar(console, TimeRemainingColumn())

    def report(name: str, done: int, total: int) -> None:
        bar.start(total, name)
        bar.update(done, name, f"{done}/{total} episodes")
        if done == total:
            bar.stop()

    try:
        more = (best, episodes, seed, device, report, on)
        played = [evaluation.trained(store, *more) for store in stores]
        elsewhere = [each.play(episodes, seed, report) for each in deployed]
        elsewhere += [evaluation.trained(store, *more, scale) for store in stores for scale in perturb]
        if on is not None and not stores:  # policies need its environment alone, any model will do
            entry = replace(resolve("beam6g", "mlp"), task=on)
        else:
            entry = evaluation.trained_entry(stores[0], on)
        references = evaluation.references(entry, episodes, seed, report)
    finally:
        bar.stop()
    labels = [each.name for each in played]
    played = [
        each if labels.count(each.name) == 1 else replace(each, name=f"{each.name} {store.path.name[-8:]}")
        for each, store in zip(played, stores)
    ]
    return Evaluation(
        entry.task.name,
        entry.task.hash,
        (*played, *elsewhere, *references),
        episodes,
        seed,
        entry.task.file.score.called,
    )


def find_players(written: Selection, names: Iterable[str]) -> tuple[Task | None, list[EntryStore]]:
    """Return the task that is played, None where entries play their own; and where their trained agents are."""
    on = _task(written) if written.tasks else None
    selection = written if on is None else written.of(on.name)
    found = (find(selection, name) for name in names)
    return on, list({store.path.resolve(): store for store in found}.values())


def _task(written: Selection) -> Task:
    """Return a task: a registered one, a file's, or one that entries here have."""
    [name] = written.tasks
    registered = name.endswith(".toml") or name in registry.load().of(specs.TaskSpec)
    if not registered:
        written.named()  # it is known
        for folder in written.folders:
            if folder.is_dir() and (stores := entries(folder, name)):
                return stores[0].entry().task
    return load(name)


def find(selection: Selection, name: str) -> EntryStore:
    """Return where the trained agents of an entry are; of copies that have some, the better one.

    The selection's task is looked into, unless the name says which one: `TASK/NAME`, or a folder.
    """
    before, slash, _ = name.partition("/")
    placed = (Path(name) / "entry.json").exists() or (slash and "=" not in before)
    anywhere = selection.of()
    try:
        copies = collect.read_copies(anywhere if placed else selection, name)
    except UnknownNameError as error:
        if placed or not selection.tasks:
            raise
        try:
            other = collect.read_copies(anywhere, name)[0].task
        except UnknownNameError:
            raise error from None
        raise UnknownNameError(
            f"task '{selection.tasks[0]}' has no entry '{name}' in {selection.runs}; if its agents were "
            f"trained on '{other}', write '{other}/{name}'"
        ) from None
    chosen = collect.best([copy for copy in copies if _has_agents(copy)] or copies)
    if chosen.source == "published":
        return PublishedAgents(chosen.folder, selection.runs)
    return EntryStore(chosen.folder)


def _has_agents(copy: EntryResults) -> bool:
    if copy.source == "published":
        return (copy.folder / published_entries.AGENTS).is_file()
    store = EntryStore(copy.folder)
    return any(store.seed(seed).agent.is_file() for seed in copy.seeds)


def _one_task(stores: Sequence[EntryStore]) -> None:
    tasks = {record.task_hash: record.task_name for record in (store.record() for store in stores)}
    if len(tasks) > 1:
        raise OptionError(
            f"the entries belong to different tasks ({', '.join(sorted(tasks.values()))}), whose episodes and sums "
            "cannot be compared: evaluate them one by one, or name the task that all play: --task TASK"
        )
