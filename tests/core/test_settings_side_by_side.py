"""Entries that differ in options per agent, trained in one population: each is left as if it had been trained alone."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from rich.console import Console
from torch import Tensor, nn

from qrlsuite import population
from qrlsuite.engine import local, missing, where, worker
from qrlsuite.engine.display import Bar
from qrlsuite.errors import PluginError, StoreError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import Tuned, parse_setting
from qrlsuite.plugins.models.mlp import MLPOptions
from qrlsuite.results import checkpoint
from qrlsuite.results.claims import SeedsClaimedError, acquire
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.store import EntryStore, read_lines
from qrlsuite.specs import ModelSpec
from qrlsuite.training import group
from qrlsuite.training.trainer import Trainer, require_trainable
from qrlsuite.tuning import search
from qrlsuite.tuning.bayesian import Bayesian
from qrlsuite.tuning.display import TuneDisplay
from qrlsuite.tuning.runner import run as run_searches
from tests.conftest import results
from tests.core.test_bayesian import OWN
from tests.core.test_tuning import finish, request, varied, without_hours

NETWORK = ("width=4", "depth=1")
CASES = {
    "mlp": (NETWORK, "input_scale={}"),
    "fourier": (("frequencies=3",), "bandwidth={}"),
    "vqc-native": (("qubits=2", "layers=1"), "init_scale={}"),
}
RATES = ((0.01, 0.002, 1.0), (0.03, 0.02, 0.3), (0.001, 0.1, 3.7))
"""lr, quantum_lr and the gain at the input of three entries."""


def entries(task: str, model: str = "mlp", algorithm: str = "ddqn") -> list[Entry]:
    settings, gain = CASES[model]
    head = " ".join((algorithm, model, *settings))
    return [
        resolve(task, f"{head} lr={lr} quantum_lr={quantum} {gain.format(scale)}")
        for lr, quantum, scale in RATES
    ]


def stores(folder: Path, chosen: Sequence[Entry]) -> list[EntryStore]:
    return [EntryStore.create(folder, entry) for entry in chosen]


def together(folders: Sequence[EntryStore], seeds: Sequence[int], epochs: int) -> None:
    first, *others = (store.path for store in folders)
    worker.train_group(first, seeds, epochs, others=others)


@pytest.mark.parametrize("model", CASES)
@pytest.mark.parametrize("algorithm", ["ddqn", "ppo", "reinforce"])
def test_entries_trained_together_equal_entries_trained_alone(
    algorithm: str, model: str, tiny_task: str, tmp_path: Path
) -> None:
    chosen = entries(tiny_task, model, algorithm)
    assert len({entry.population_key for entry in chosen}) == 1
    beside, alone = stores(tmp_path / "together", chosen), stores(tmp_path / "alone", chosen)
    together(beside, [0, 1], 2)
    for one, other in zip(beside, alone):
        worker.train_group(other.path, [1], 2)
        assert results(one.path, 1) == results(other.path, 1)
        assert saved(one) == saved(other)
    assert len({results(one.path, 1) for one in beside}) == len(chosen), "or the options do nothing here"


def saved(store: EntryStore) -> dict[str, bytes]:
    """The checkpoint of seed 1 after two epochs."""
    epoch, arrays = checkpoint.load(store, [1])
    assert epoch == 2
    return {name: array.tobytes() for name, array in arrays.items()}


def test_killed_between_the_saves_of_two_entries_they_end_the_same(
    tiny_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are then at different epochs, and trained in turn; or alone, by whoever finds one of them."""
    chosen = entries(tiny_task)
    folders = stores(tmp_path / "killed", chosen)
    monkeypatch.setattr(group, "CHECKPOINT_SECONDS", 0.0)
    with monkeypatch.context() as killing:
        save = group.GroupFiles.save

        def killed(self: group.GroupFiles, epoch: int, arrays: Any) -> None:
            if epoch == 2 and self.store.path == folders[1].path:
                raise SystemExit
            save(self, epoch, arrays)

        killing.setattr(group.GroupFiles, "save", killed)
        with pytest.raises(SystemExit):
            together(folders, [0, 1], 3)
    assert [{header.epoch for header in checkpoint.headers(store)} for store in folders] == [{2}, {1}, {1}]
    worker.train_group(folders[2].path, [1], 3)
    together(folders, [0, 1], 3)
    straight = stores(tmp_path / "straight", chosen)
    for one, other in zip(folders, straight):
        worker.train_group(other.path, [0, 1], 3)
        for seed in (0, 1):
            assert results(one.path, seed) == results(other.path, seed)
            assert read_lines(one.seed(seed).timings)[0]["group"] == 6


def test_checkpoints_of_different_versions_are_not_joined(tiny_task: str, tmp_path: Path) -> None:
    folders = stores(tmp_path, entries(tiny_task))
    together(folders, [0, 1], 1)
    epoch, arrays = checkpoint.load(folders[1], [0, 1])
    checkpoint.save(folders[1], [0, 1], epoch, {**arrays, "models.new": np.zeros((2, 1), np.float32)})
    with pytest.raises(StoreError, match="these entries are at different epochs, or of different versions"):
        together(folders, [0, 1], 2)


def test_each_entry_has_its_own_progress_and_claim(tiny_task: str, tmp_path: Path) -> None:
    """An entry that another process trains is left to it, and the others are trained."""
    first, held, last = folders = stores(tmp_path, entries(tiny_task))
    claim = acquire(held, [1])
    with pytest.raises(SeedsClaimedError, match="being trained by process"):
        together(folders, [0, 1], 1)
    claim.release()
    for store in (first, last):
        assert store.finished([0, 1], 1) == {0, 1}
        progress = ProgressFile(store, checkpoint.group_id([0, 1])).read()
        assert progress["phase"] == "finished"
        scores = [float(store.seed(seed).read().curve[-1]) for seed in (0, 1)]
        assert progress["seed_scores"] == pytest.approx(scores)
        assert not list(store.claims.glob("*.json"))
    assert not held.finished([0, 1], 1)


def test_entries_that_differ_in_more_are_refused(tiny_task: str) -> None:
    apart = [resolve(tiny_task, f"mlp gamma={gamma}") for gamma in (0.9, 0.5)]
    assert len({entry.population_key for entry in apart}) == 2
    with pytest.raises(ValueError, match="differ in options marked per_agent only"):
        Trainer(apart, [0, 0])
    with pytest.raises(ValueError, match="agents of one population cannot differ in gamma"):
        population.joined([entry.algorithm_options for entry in apart])


@dataclass(frozen=True)
class Gained:
    """Options of a plugin: one is tuned per agent, the other is not."""

    gain: Annotated[float, Field(gt=0), Tuned(0.1, 10, per_agent=True)] = 1.0
    decay: Annotated[float, Field(gt=0), Tuned(0.1, 10)] = 1.0


class Amplified(nn.Module):
    """A network that keeps its options where a stack of agents has one for all."""

    def __init__(self, inputs: int, outputs: int, own: MLPOptions, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.rand(inputs, outputs, generator=generator))
        self.gain = own.input_scale

    def forward(self, x: Tensor) -> Tensor:
        return self.gain * x @ self.weight


def test_a_stack_of_agents_with_a_plain_number_each_is_refused(
    tiny_task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Entry, "third_party", lambda self: ["acme"])
    model = ModelSpec(
        "amplified",
        "Plain number",
        "classical",
        f"{MLPOptions.__module__}:MLPOptions",
        f"{__name__}:Amplified",
    )
    chosen = [dataclasses.replace(entry, model=model) for entry in entries(tiny_task)]
    with pytest.raises(PluginError, match=r"model 'amplified': self\.gain differs"):
        require_trainable(chosen)


def test_options_per_agent_become_tensors() -> None:
    joined = population.joined([Gained(gain=0.5), Gained(gain=2)])
    assert torch.equal(joined.gain, torch.tensor([0.5, 2.0], dtype=torch.float64))
    assert joined.decay == 1.0
    assert population.joined([Gained(gain=2.0), Gained(gain=2.0)]) == Gained(gain=2.0)
    with pytest.raises(ValueError, match="cannot differ in decay"):
        population.joined([Gained(decay=0.5), Gained(decay=2)])


def plans(folder: Path, chosen: Sequence[Entry], seeds: Sequence[int], by: where.Where) -> Any:
    return [missing.find(folder, entry, by, seeds, 1) for entry in chosen]


def test_plans_are_divided_among_workers_and_into_memory(
    tiny_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def divided(workers: int) -> list[tuple[int, list[int]]]:
        by = where.Where(local.LocalEngine(), workers)
        (alike,) = by.divide(plans(tmp_path, entries(tiny_task), [0, 1, 2, 3], by))
        return [
            (1 + len(work.others), [len(g.seeds) for g in work.groups]) for work in by._populations(alike)
        ]

    assert divided(1) == [(3, [4])]
    assert divided(2) == [(3, [2, 2])]
    assert divided(8) == [(1, [1] * 4), (2, [1] * 4)], "entries are divided where seeds are too few"
    with monkeypatch.context() as patch:
        patch.setattr(where, "LARGEST_GROUP", 8)
        assert divided(1) == [(1, [4]), (2, [4])]


def test_what_cannot_be_together_is_trained_in_turn(tiny_task: str, tmp_path: Path) -> None:
    """An option without the mark, an entry that another process trains, and any other engine."""
    by = where.Where(local.LocalEngine(), 1)
    alike = entries(tiny_task)
    other = resolve(tiny_task, "mlp width=4 depth=1 gamma=.5")
    stores(tmp_path, alike)
    claim = acquire(EntryStore.find(tmp_path, alike[1]), [1])
    lists = by.divide(plans(tmp_path, [*alike, other], [0, 1], by))
    claim.release()
    assert [[plan.entry for plan in each] for each in lists] == [[alike[0], alike[2]], [alike[1]], [other]]
    elsewhere = where.Where.create("command template='{command}'", 1)
    lists = elsewhere.divide(plans(tmp_path, alike, [0, 1], elsewhere))
    assert (len(lists), elsewhere.room) == (3, 1)


def bayesian(task: str, folder: Path) -> Bayesian:
    """Five trials, then two rounds of as many."""
    return Bayesian(request(task, varied=(), settings=OWN, sampler="bayesian", trials=20), folder)


def test_how_many_settings_can_be_side_by_side(tiny_task: str, tmp_path: Path) -> None:
    """What a search is expected to cost depends on it."""
    for words, sampler, beside in (
        (("lr=1e-3,1e-2",), "grid", 2),
        (("lr=1e-3,1e-2", "gamma=.9,.99"), "grid", 1),
        (("lr+quantum_lr=1e-3,1e-2",), "bayesian", 12),
        (("gamma=.9,.99",), "bayesian", 1),
    ):
        fixed = (*OWN, *([parse_setting("lr=1e-3")] * (words == ("gamma=.9,.99",))))
        wanted = request(tiny_task, settings=fixed, varied=varied(*words), sampler=sampler)
        found = Bayesian(wanted, tmp_path) if sampler == "bayesian" else search.Search(wanted, tmp_path)
        assert found.beside == beside, words


def test_progress_names_the_trials_that_are_trained_together(tiny_task: str, tmp_path: Path) -> None:
    by = where.Where(local.LocalEngine(), 1)
    found = bayesian(tiny_task, tmp_path)
    shown = io.StringIO()
    display = TuneDisplay([found], by)
    display.console = Console(force_terminal=True, width=120, file=shown)
    display.bar = Bar(display.console)

    def train(chosen: Sequence[Entry], seeds: Sequence[int], epochs: int) -> list[EntryStore]:
        begun = [missing.find(found.runs, entry, by, seeds, epochs) for entry in chosen]
        display.begin_trials(begun)
        display.training(begun)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        found.step(train, by.room)
    display.interrupted()
    assert "trials 1-5/20  epoch 0/1" in shown.getvalue()
    assert "every finished epoch is saved" in shown.getvalue()


def test_what_is_left_of_a_search_is_known_after_the_second_epoch(
    tiny_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch starts for 5 s, its epochs take 2 s, and as many runs again are to come as each batch has."""
    clock = [100.0]
    monkeypatch.setattr("qrlsuite.tuning.display.time.monotonic", lambda: clock[0])
    by = where.Where(local.LocalEngine(), 1)
    found = bayesian(tiny_task, tmp_path)
    display = TuneDisplay([found], by, quiet=True)
    begun = [missing.find(found.runs, entry, by, [0, 1], 10) for entry in entries(tiny_task)]
    display.training(begun)
    runs = 2 * len(begun)
    monkeypatch.setattr(type(found), "runs_planned", 3 * runs)
    said = []
    for epoch, now in enumerate((105.0, 107.0, 109.0, 111.0)):
        clock[0] = now
        said.append(display._left(epoch, 10))
    assert said == [None, None, pytest.approx(8 * 2 + 2 * 25), pytest.approx(7 * 2 + 2 * 25)]
    display.training(begun)
    assert display._left(0, 10) == pytest.approx(25 + 2 * 25), "by the pace of the batch before"


def preset(found: Bayesian) -> str:
    found.write(found.path)
    return without_hours(found.path.read_text())


@pytest.mark.usefixtures("forked_workers")
def test_a_search_ends_the_same_side_by_side_and_in_turn(tiny_task: str, tmp_path: Path) -> None:
    """Begun the one way it continues the other way."""
    folder = tmp_path / "in turn"
    in_turn = bayesian(tiny_task, folder)
    assert in_turn.beside == 12
    finish(in_turn)
    expected = preset(in_turn)

    by = where.Where(local.LocalEngine(), 1)
    for name, begun in (("straight", 0), ("begun", 2)):
        if begun:
            with pytest.raises(KeyboardInterrupt):
                finish(bayesian(tiny_task, tmp_path / name), stop_before=begun)
        found = bayesian(tiny_task, tmp_path / name)
        assert run_searches([found], tmp_path / name, by, TuneDisplay([found], by, quiet=True))
        assert preset(found) == expected
        assert [trial.merit for trial in found.trials] == [trial.merit for trial in in_turn.trials]
        sizes = {
            line["group"]
            for trial in found.trials
            for line in read_lines(EntryStore.find(found.runs, trial.entry).seed(trial.seeds[0]).timings)
        }
        assert sizes == ({2, 6, 24} if begun else {10, 24, 6}), "5 settings on two seeds, then 12, then 3"

    stopped = bayesian(tiny_task, tmp_path / "stopped")

    class Stopping(TuneDisplay):
        def told(self, *given: Any) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_searches([stopped], tmp_path / "stopped", by, Stopping([stopped], by, quiet=True))
    again = bayesian(tiny_task, tmp_path / "stopped")
    finish(again)
    assert preset(again) == expected
