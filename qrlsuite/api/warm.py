"""Begins the training of an entry with the trained agents of another one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from safetensors.numpy import save as encode

from qrlsuite.api.evaluation import find
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import Arrays, EntryStore, write_atomically
from qrlsuite.training import evaluation
from qrlsuite.training.trainer import Trainer


def begin_with(
    entry: Entry, runs: Path, name: str, seeds: Sequence[int] | None = None
) -> tuple[Entry, Callable[[EntryStore], None]]:
    """Return an entry whose seeds begin with trained agents, seed k with seed k's; and what puts them into its folder.

    Parameters
    ----------
    entry:
        The entry to train.
    name:
        The entry of the agents: one of the same task, `TASK/ENTRY`, or a folder; of the results folder, or published.
    seeds:
        The seeds to train; None takes the task's protocol. Existing agents stay.
    """
    source = find(Selection(runs, True, (entry.task.name,)), name)
    agents, _, _ = evaluation.best_runs(source, max(1, len(source.seeds())))
    first = source.seed(agents[0])
    _require_fit(entry, agents[0], first.parameters(), first.agent)
    trained = evaluation.trained_entry(source)
    epochs = first.trained_epochs()
    start = f"{trained.task.name}/{trained.name}{source.mark}:{epochs}"
    begun = replace(entry, start=start)

    def put(store: EntryStore) -> None:
        requested = range(entry.task.file.protocol.seeds) if seeds is None else seeds
        wanted = [seed for seed in requested if not store.start_of(seed).exists()]
        if absent := sorted(set(wanted) - set(agents)):
            there = format_seeds(sorted(agents))
            raise OptionError(
                f"--from: '{start}' has the agents of seeds {there}, and none for {format_seeds(absent)}: "
                f"--seeds {there}"
            )
        if wanted:
            EntryStore.create(runs, begun, store.mark)
        for seed in wanted:
            write_atomically(store.start_of(seed), encode(source.seed(seed).parameters()))

    return begun, put


def _require_fit(entry: Entry, seed: int, agent: Arrays, path: Path) -> None:
    """Begin with one agent, to see whether that can be done."""
    trainer = Trainer(entry, [seed])
    evaluation.require_fitting(trainer, agent, path)
    trainer.start({name: value[None] for name, value in agent.items()})
