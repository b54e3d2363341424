"""Successive halving over seeds: its rungs, its ranges at an edge, its budgets, and that it can be stopped anywhere."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.engine.budget import Budget
from qrlsuite.errors import OptionError, PluginError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import Tuned, parse_setting
from qrlsuite.results.store import FORMAT_VERSION, EntryStore, table_bytes
from qrlsuite.tuning import halving, runner, search, space
from qrlsuite.tuning.halving import Halving
from tests.core.test_tuning import SETTINGS, Trainer, varied

OWN = (*SETTINGS, parse_setting("input_scale=1"))
"""Leaves lr alone to be tuned."""


def request(task: str, model: str = "mlp", **changes: Any) -> search.Request:
    given: dict[str, Any] = {
        "settings": OWN if model == "mlp" else (),
        "sampler": "halving",
        "seeds": search.tuning_seeds("5"),
        "epochs": 3,
    }
    return search.Request(task, model, **{**given, **changes})


class Recorder:
    """Leaves runs whose learning depends on their settings and seeds as told, without training."""

    def __init__(self, folder: Path, speed: Callable[[Entry, int], float], stop_before: int = 10**9) -> None:
        self.folder, self.speed, self.stop_before = folder, speed, stop_before
        self.runs: list[tuple[str, int]] = []

    def __call__(self, entries: Sequence[Entry], seeds: Sequence[int], epochs: int) -> list[EntryStore]:
        return [self.train(entry, seeds, epochs) for entry in entries]

    def train(self, entry: Entry, seeds: Sequence[int], epochs: int) -> EntryStore:
        store = EntryStore.create(self.folder, entry)
        for seed in sorted(set(seeds) - store.finished(seeds, epochs)):
            if len(self.runs) == self.stop_before:
                raise KeyboardInterrupt
            self.runs.append((entry.hash, seed))
            score = self.speed(entry, seed)
            rows = [{"epoch": t, "scores": [min(1.0, score * t)]} for t in range(1, epochs + 1)]
            folder = store.seed(seed)
            folder.path.mkdir(
                exist_ok=True
            )  # plain writes: forcing hundreds of files to the disk takes a minute
            folder.table.write_bytes(table_bytes(rows))
            folder.timings.write_text('{"epoch":1,"cpu":36.0}\n')
            names = {"format_version": FORMAT_VERSION, "seed": seed, **store.names}
            record = {**names, "status": "finished", "epochs": epochs}
            (folder.path / "run.json").write_text(json.dumps(record))
        return store


def finish(found: Halving, train: Recorder | Trainer, most: int = 1) -> Halving:
    while not found.over:
        found.step(train, most)
    return found


def near(lr: float, width: float = 2.0) -> Callable[[Entry, int], float]:
    """Learning is fastest at a learning rate."""

    def speed(entry: Entry, seed: int) -> float:
        away = math.log(entry.algorithm_options.lr / lr)
        return 0.4 * math.exp(-((away / width) ** 2)) + 1e-4 * (seed % 7)

    return speed


def test_the_ladder_by_hand() -> None:
    assert halving.ladder(16, 20) == ((16, 4), (6, 12), (3, 20))
    assert halving.runs(halving.ladder(16, 20)) == 16 * 4 + 6 * 8 + 3 * 20
    assert halving.ladder(2, 20) == ((2, 4), (2, 20))
    assert halving.affordable(172, 20) == 16
    assert halving.affordable(171, 20) == 15
    assert halving.affordable(3, 20) == 0


def test_rungs_keep_the_best_and_the_last_has_fresh_seeds(tiny_task: str, tmp_path: Path) -> None:
    train = Recorder(tmp_path / "tuning", near(2e-3))
    found = finish(Halving(request(tiny_task, trials=12, seeds=search.tuning_seeds("10")), tmp_path), train)
    assert found.rungs == ((12, 2), (4, 6), (3, 10))
    by_rung = [[trial for trial in found.trials if trial.rung == rung] for rung in range(3)]
    assert [len(trials) for trials in by_rung] == [12, 4, 3]
    for lower, upper, count in zip(by_rung, by_rung[1:], (4, 3)):
        best = sorted(lower, key=lambda trial: trial.merit.order)[:count]
        assert {trial.number for trial in upper} == {trial.number for trial in best}
    assert by_rung[0][0].point == {"algorithm.lr": 5e-4}, "the first trial is untuned"
    seen = {seed for trial in (*by_rung[0], *by_rung[1]) for seed in trial.seeds}
    assert seen == set(range(1_000_000, 1_000_006))
    assert all(trial.seeds == tuple(range(1_000_006, 1_000_016)) for trial in by_rung[2])
    assert found.best in by_rung[2]
    assert len(train.runs) == len(set(train.runs)) == found.runs_planned == found.runs_done
    tuning = found.preset().tuning
    assert tuning is not None
    assert (tuning.trials, tuning.runs, tuning.seeds) == (12, 12 * 2 + 4 * 4 + 3 * 10, "1000000:1000016")
    assert tuning.steps == 70 * 3 * 60
    assert tuning.value == found.best.merit.time


def test_a_range_moves_on_while_the_best_lies_at_its_end(tiny_task: str, tmp_path: Path) -> None:
    found = finish(
        Halving(request(tiny_task, trials=12), tmp_path), Recorder(tmp_path / "tuning", near(0.05))
    )
    tried = [trial.point["algorithm.lr"] for trial in found.trials if trial.rung == 0]
    assert max(tried[:6]) <= 1e-2 < max(tried)
    ends = found.searched["algorithm.lr"]
    assert (ends.low, ends.high) == (2e-4, 0.501), "twice by half its width, a factor of 50 ** .5"
    assert found.best is not None
    assert found.best.point["algorithm.lr"] > 1e-2
    assert len(tried) == 12, "an edge costs no further trial"
    assert found.preset().tuning.space == {"algorithm.lr": {"low": 2e-4, "high": 0.501, "log": True}}  # type: ignore[union-attr]
    inside = finish(
        Halving(request(tiny_task, trials=12), tmp_path / "2"), Recorder(tmp_path / "2", near(2e-3))
    )
    assert inside.searched["algorithm.lr"].high == 1e-2


def test_an_options_own_bounds_are_kept_and_said(tiny_task: str, tmp_path: Path) -> None:
    def speed(entry: Entry, seed: int) -> float:
        return 0.3 + 0.1 * float(entry.algorithm_options.gamma)

    words = varied("gamma={low = .8, high = 1.0}")
    wanted = request(tiny_task, trials=4, varied=words, settings=(*OWN, parse_setting("lr=1e-3")))
    found = finish(Halving(wanted, tmp_path), Recorder(tmp_path / "tuning", speed))
    assert found.searched["algorithm.gamma"].high == 1.0, "gamma beyond 1 is refused by the option"
    assert found.at_edge == ["algorithm.gamma"]
    assert found.preset().tuning.note == "nothing was tried beyond the best gamma"  # type: ignore[union-attr]


@pytest.mark.parametrize("stop", [0, 1, 5, 13, 20])
def test_stopped_at_any_run_it_ends_the_same(stop: int, tiny_task: str, tmp_path: Path) -> None:
    wanted = request(tiny_task, trials=6)
    straight = finish(Halving(wanted, tmp_path / "a"), Recorder(tmp_path / "a" / "tuning", near(8e-3)))
    with pytest.raises(KeyboardInterrupt):
        finish(Halving(wanted, tmp_path / "b"), Recorder(tmp_path / "b" / "tuning", near(8e-3), stop))
    rest = Recorder(tmp_path / "b" / "tuning", near(8e-3))
    resumed = finish(
        Halving(wanted, tmp_path / "b"), rest, most=4
    )  # and goes on with several trials at a time
    assert len(rest.runs) == straight.runs_done - stop, "no run is trained twice"
    assert [(t.number, t.point, t.seeds, t.merit) for t in resumed.trials] == [
        (t.number, t.point, t.seeds, t.merit) for t in straight.trials
    ]
    straight.write(straight.path)
    resumed.write(resumed.path)
    assert straight.path.name == resumed.path.name
    assert straight.path.read_bytes() == resumed.path.read_bytes()


def test_with_real_training_two_models_get_equal_budgets(tiny_task: str, tmp_path: Path) -> None:
    """Settings in proportion to the options: lr for the network, lr and quantum_lr for the circuit."""
    requests = [
        request(tiny_task, trials=2, seeds=search.tuning_seeds("1"), epochs=1),
        request(
            tiny_task,
            "vqc-native",
            settings=tuple(parse_setting(word) for word in ("qubits=2", "layers=1", "init_scale=1")),
            trials=2,
            seeds=search.tuning_seeds("1"),
            epochs=1,
        ),
    ]
    network, circuit = runner.build(requests, tmp_path)
    assert isinstance(network, Halving)
    assert isinstance(circuit, Halving)
    assert (network.settings, circuit.settings) == (2, 4)
    assert {dimension.name for dimension in circuit.space} == {"algorithm.lr", "algorithm.quantum_lr"}
    assert network.budget_text == circuit.budget_text
    for each in (network, circuit):
        finish(each, Trainer(tmp_path / "tuning"))
        each.write(each.path)
        assert each.best is not None
        entry = resolve(tiny_task, each.base.model.name, preset=str(each.path))
        assert entry.hash == each.best.entry.hash
        assert entry.tuning is not None
        assert entry.tuning["budget"] == network.budget_text
        assert EntryStore.create(tmp_path / "runs", entry).record()["tuning"] == entry.tuning


def test_equal_core_hours(tiny_task: str, tmp_path: Path) -> None:
    """A run is recorded with 36 core-seconds, .01 core-hours."""
    wanted = request(tiny_task, budget=Budget(None, 0.301))
    found = Halving(wanted, tmp_path)
    assert found.settings is None
    finish(found, Recorder(tmp_path / "tuning", near(2e-3)))
    assert found.settings == halving.affordable(30, 5) == 9
    assert found.core_seconds == 36 * halving.runs(halving.ladder(9, 5)) <= 0.301 * 3600
    assert found.preset().tuning.budget == "0.301 core-hours, up to 5 fresh seeds"  # type: ignore[union-attr]
    again = Recorder(tmp_path / "tuning", near(2e-3))
    assert finish(Halving(wanted, tmp_path), again).settings == 9
    assert again.runs == []
    little = Halving(request(tiny_task, budget=Budget(None, 0.01)), tmp_path)
    with pytest.raises(OptionError, match=r"needs 0\.19: give more, or fewer --seeds"):
        finish(little, again)


def test_what_a_queue_trains_is_waited_for(tiny_task: str, tmp_path: Path) -> None:
    """A part is handed over together; nothing is chosen before its trials are there."""

    def queue(entries: Sequence[Entry], seeds: Sequence[int], epochs: int) -> list[EntryStore]:
        return [EntryStore.create(tmp_path / "tuning", entry) for entry in entries]

    found = Halving(request(tiny_task, trials=8), tmp_path)
    while not found.over:
        assert found.step(queue) == [None]
    assert len(found.pending) == 4
    assert not found.presentable


def test_all_combinations_of_a_list_and_no_more(tiny_task: str, tmp_path: Path) -> None:
    wanted = request(
        tiny_task, trials=9, varied=varied("activation=relu,tanh"), settings=(*OWN, parse_setting("lr=1e-3"))
    )
    found = finish(Halving(wanted, tmp_path), Recorder(tmp_path / "tuning", near(2e-3)))
    assert {trial.point["model.activation"] for trial in found.trials} == {"relu", "tanh"}
    assert found.settings == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": (1_000_000, 1_000_002)}, "halving takes seeds one after the other, such as --seeds 2"),
        ({"trials": 3, "budget": Budget(None, 1.0)}, "--budget in core-hours and trials: give one of them"),
        ({"settings": (*OWN, parse_setting("lr=1e-3"))}, "nothing is varied"),
    ],
)
def test_bad_requests(changes: dict[str, Any], message: str, tiny_task: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=message):
        runner.build([request(tiny_task, **changes)], tmp_path)


@dataclass(frozen=True)
class Gained:
    """Options of a plugin."""

    gain: Annotated[float, Field(gt=0, description="at the input"), Tuned(0.1, 10, "quantum")] = 1.0
    width: Annotated[int, Field(ge=1, description="units")] = 4


def test_options_say_that_they_are_tuned() -> None:
    assert options.tuned(Gained) == {"gain": Tuned(0.1, 10, "quantum")}
    with pytest.raises(PluginError, match="give a range with 0 < low < high"):
        Tuned(0, 1)


@pytest.mark.parametrize("algorithm", ["ddqn", "ppo", "reinforce"])
@pytest.mark.parametrize(
    ("model", "names"),
    [
        ("mlp", {"algorithm.lr", "model.input_scale"}),
        ("fourier", {"algorithm.lr", "model.bandwidth"}),
        ("vqc-native", {"algorithm.lr", "algorithm.quantum_lr", "model.init_scale"}),
        ("vqc-pennylane", {"algorithm.lr", "algorithm.quantum_lr", "model.init_scale"}),
    ],
)
def test_every_model_tunes_its_learning_rates_and_its_gain(
    algorithm: str, model: str, names: set[str]
) -> None:
    entry = resolve("beam6g", model, algorithm)
    found = space.declared(entry)
    assert set(found) == names
    own = {"algorithm": entry.algorithm_options, "model": entry.model_options}
    for name, ends in found.items():
        side, _, option = name.partition(".")
        if side == "algorithm":
            assert (ends.low, ends.high, ends.log) == (2e-4, 1e-2, True)
        assert ends.low <= getattr(own[side], option) <= ends.high, "the untuned value lies within"


@pytest.mark.parametrize(("train", "varied"), [("scaling", True), ("linear", False)])
def test_a_circuit_that_stays_as_drawn_has_no_quantum_learning_rate(train: str, varied: bool) -> None:
    found = space.declared(resolve("beam6g", f"ddqn vqc-native train={train} qubits=2 layers=1"))
    assert ("algorithm.quantum_lr" in found) == varied


def test_places_and_values_undo_each_other() -> None:
    for ends in (space.Range(low=1e-3, high=1.0, log=True), space.Range(low=-2.0, high=3.0)):
        for place in np.linspace(-0.5, 1.5, 9):
            value = halving._value(ends, float(place))
            assert halving._place(ends, value) == pytest.approx(place, abs=2e-3)
