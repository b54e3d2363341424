"""The search until a small regret: its rounds, ranges at an edge, budgets, and that it can be stopped anywhere."""

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
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError, PluginError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.leaderboard.shelf.curves import _tuned_text
from qrlsuite.options import Tuned, parse_setting
from qrlsuite.results.store import FORMAT_VERSION, EntryStore, table_bytes
from qrlsuite.tuning import bayesian, runner, search, space, surrogate
from qrlsuite.tuning.bayesian import Bayesian
from tests.core.test_tuning import FIXED, SETTINGS, Trainer, varied

OWN = (*SETTINGS, *FIXED)
"""Leaves lr alone to be tuned."""


def request(task: str, model: str = "mlp", **changes: Any) -> search.Request:
    given: dict[str, Any] = {
        "settings": OWN if model == "mlp" else (),
        "sampler": "bayesian",
        "seeds": search.tuning_seeds("2"),
        "trials": 40,
        "epochs": 8,
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


def finish(found: Bayesian, train: Recorder | Trainer, most: int = 1) -> Bayesian:
    while not found.over:
        found.step(train, most)
    return found


def near(lr: float, width: float = 2.0) -> Callable[[Entry, int], float]:
    """Learning is fastest at a learning rate."""

    def speed(entry: Entry, seed: int) -> float:
        away = math.log(entry.algorithm_options.lr / lr)
        return (0.4 + 0.02 * (seed % 7)) * math.exp(-((away / width) ** 2))

    return speed


def test_rounds_bring_seeds_that_no_setting_had_until_the_regret_is_small(
    tiny_task: str, tmp_path: Path
) -> None:
    train = Recorder(tmp_path / "tuning", near(2e-3))
    wanted = request(tiny_task, rows=("lr=.0123456 epsilon=.1",))
    (found,) = runner.build([wanted], tmp_path)
    assert isinstance(found, Bayesian)
    finish(found, train)
    assert [trial.point["algorithm.lr"] for trial in found.trials[:2]] == [5e-4, 0.0123456], (
        "by hand, exactly"
    )
    blocks: dict[int, set[int]] = {}
    for trial in found.trials:
        blocks.setdefault(trial.round, set()).update(trial.seeds[-2:])
    assert blocks == {k: {1_000_000 + 2 * k, 1_000_001 + 2 * k} for k in range(len(blocks))}
    assert max(len(trial.seeds) for trial in found.trials) > 2, "what may be the best is trained again"
    assert len(train.runs) == len(set(train.runs)) == found.runs_done == 2 * len(found.trials)
    assert found.regret_reached
    assert found.best is not None
    assert 1e-3 < found.best.point["algorithm.lr"] < 4e-3
    tuning = found.preset().tuning
    assert tuning is not None
    assert tuning.regret is not None
    assert 0 <= tuning.regret.low <= tuning.regret.expected <= tuning.regret.goal == 0.05
    assert tuning.budget == "expected regret 5%"
    assert tuning.note is not None
    assert "within 3% of the best with probability" in tuning.note
    little = finish(Bayesian(request(tiny_task, trials=4), tmp_path), train)
    assert not little.regret_reached
    assert little.budget_text == "expected regret 5%, or 4 trials per option"


def test_a_range_is_extended_while_the_best_lies_at_its_end(tiny_task: str, tmp_path: Path) -> None:
    found = finish(
        Bayesian(request(tiny_task, trials=60), tmp_path), Recorder(tmp_path / "tuning", near(0.05))
    )
    tried = [trial.point["algorithm.lr"] for trial in found.trials]
    assert max(tried[:5]) <= 1e-2 < 0.02 < max(tried)
    assert found.searched["algorithm.lr"].high > 2e-2
    assert found.best is not None
    assert found.best.point["algorithm.lr"] > 2e-2
    assert found.preset().tuning.space["algorithm.lr"]["high"] == found.searched["algorithm.lr"].high  # type: ignore[union-attr, index]


def test_the_last_round_takes_the_best_of_three_on_seeds_that_no_other_trial_had(
    tiny_task: str, tmp_path: Path
) -> None:
    """On the seeds of the search, learning rates near .05 have luck: it is gone on others."""

    def speed(entry: Entry, seed: int) -> float:
        lucky = seed < 1_100_000 and entry.algorithm_options.lr > 5e-4
        return near(0.05 if lucky else 5e-4, 1.0)(entry, seed)

    wanted = request(tiny_task, trials=30, rows=("lr=.0123456 epsilon=.1",), last=20)
    train = Recorder(tmp_path / "tuning", speed)
    found = finish(Bayesian(wanted, tmp_path), train)
    before = finish(Bayesian(request(tiny_task, trials=30, rows=wanted.rows), tmp_path), train)
    assert {trial.number for trial in found.last} == {trial.number for trial in before.ordered[:3]}
    assert {trial.seeds for trial in found.last} == {tuple(range(1_100_000, 1_100_020))}
    assert before.best is not None
    assert found.best is found.last[0]
    assert found.best.number != before.best.number
    assert found.best.merit.value == min(trial.merit.value for trial in found.last)
    tuning, other = found.preset().tuning, before.preset().tuning
    assert tuning is not None
    assert other is not None
    assert tuning.last is not None
    assert tuning.last.values == tuple(trial.merit.value for trial in found.last)
    assert tuning.last.low <= tuning.last.expected <= tuning.last.high
    assert (tuning.last.seeds, tuning.trials, tuning.regret) == (
        "1100000:1100020",
        other.trials,
        other.regret,
    )
    assert found.runs_done == before.runs_done + 3 * 20 <= found.runs_planned
    assert "last" not in other.model_dump(), "hashes of older studies cover records without it"
    text = _tuned_text(tuning.model_dump())
    assert text.endswith(f"{tuning.last.expected:.0%} among the last 3)")
    stopped = Bayesian(wanted, tmp_path)
    while len(stopped.trials) < len(before.trials):
        stopped.step(train)
    assert str(stopped.preset().tuning.note).endswith("; the last round is missing")  # type: ignore[union-attr]


def test_the_regret_among_a_few_settings_is_that_of_their_means() -> None:
    """Two settings of equal means, one standard error each: the mean of the positive part of their difference."""
    equal = surrogate.regret_among(np.array([100.0, 100.0]), np.array([0.1, 0.1]), np.array([100.0, 100.0]))
    assert equal.expected == pytest.approx(0.01 * math.sqrt(2) / math.sqrt(2 * math.pi), rel=0.05)
    far = surrogate.regret_among(np.array([100.0, 200.0]), np.array([0.1, 0.1]), np.array([100.0, 100.0]))
    assert far == surrogate.Regret(0.0, 0.0, 0.0, 1.0)


def test_an_options_own_bounds_are_kept_and_said(tiny_task: str, tmp_path: Path) -> None:
    def speed(entry: Entry, seed: int) -> float:
        return 0.3 + 0.1 * float(entry.algorithm_options.gamma)

    words = varied("gamma={low = .8, high = 1.0}")
    wanted = request(tiny_task, trials=30, varied=words, settings=(*OWN, parse_setting("lr=1e-3")))
    found = finish(Bayesian(wanted, tmp_path), Recorder(tmp_path / "tuning", speed))
    assert found.searched["algorithm.gamma"].high == 1.0, "gamma beyond 1 is refused by the option"
    assert found.best is not None
    assert (found.best.point["algorithm.gamma"] > 0.9) or found.behind


@pytest.mark.parametrize("stop", [0, 9, 30, -5])
def test_stopped_at_any_run_it_ends_the_same(stop: int, tiny_task: str, tmp_path: Path) -> None:
    wanted = request(tiny_task, trials=30, last=5)
    straight = finish(Bayesian(wanted, tmp_path / "a"), Recorder(tmp_path / "a" / "tuning", near(8e-3)))
    stop = stop if stop >= 0 else straight.runs_done + stop
    with pytest.raises(KeyboardInterrupt):
        finish(Bayesian(wanted, tmp_path / "b"), Recorder(tmp_path / "b" / "tuning", near(8e-3), stop))
    rest = Recorder(tmp_path / "b" / "tuning", near(8e-3))
    resumed = finish(
        Bayesian(wanted, tmp_path / "b"), rest, most=4
    )  # and goes on with several trials at a time
    assert len(rest.runs) == straight.runs_done - stop, "no run is trained twice"
    assert [(t.number, t.point, t.seeds, t.merit) for t in resumed.trials] == [
        (t.number, t.point, t.seeds, t.merit) for t in straight.trials
    ]
    straight.write(straight.path)
    resumed.write(resumed.path)
    assert straight.path.name == resumed.path.name
    assert straight.path.read_bytes() == resumed.path.read_bytes()


def test_with_real_training_two_models_are_searched_until_the_same_regret(
    tiny_task: str, tmp_path: Path
) -> None:
    small = {"trials": 1, "seeds": search.tuning_seeds("1"), "epochs": 1}
    words = ("qubits=2", "layers=1", "init_scale=1")
    settings = (*(parse_setting(word) for word in words), *FIXED[1:])
    requests = [request(tiny_task, **small), request(tiny_task, "vqc-native", settings=settings, **small)]
    network, circuit = runner.build(requests, tmp_path)
    assert {dimension.name for dimension in circuit.space} == {"algorithm.lr", "algorithm.quantum_lr"}
    for each in (network, circuit):
        assert isinstance(each, Bayesian)
        finish(each, Trainer(tmp_path / "tuning"))
        each.write(each.path)
        assert each.best is not None
        entry = resolve(tiny_task, each.base.model.name, preset=str(each.path))
        assert entry.hash == each.best.entry.hash
        assert entry.tuning is not None
        said = entry.tuning["regret"]
        assert said["goal"] == 0.05
        assert _tuned_text(entry.tuning).endswith(f"regret {said['expected']:.0%})")
        assert EntryStore.create(tmp_path / "runs", entry).record().tuned == entry.tuning


def test_core_hours_are_kept(tiny_task: str, tmp_path: Path) -> None:
    """A run is recorded with 36 core-seconds, .01 core-hours."""
    wanted = request(tiny_task, trials=None, budget=Budget(None, 0.301), regret=1e-9)
    found = finish(Bayesian(wanted, tmp_path), Recorder(tmp_path / "tuning", near(2e-3)))
    assert found.core_seconds <= 0.301 * 3600 < found.core_seconds + 36 * 2 * surrogate.BATCH
    again = Recorder(tmp_path / "tuning", near(2e-3))
    assert finish(Bayesian(wanted, tmp_path), again).runs_done == found.runs_done
    assert again.runs == []


def test_what_a_queue_trains_is_waited_for(tiny_task: str, tmp_path: Path) -> None:
    """A round is handed over together; nothing is chosen before its trials are there."""

    def queue(entries: Sequence[Entry], seeds: Sequence[int], epochs: int) -> list[EntryStore]:
        return [EntryStore.create(tmp_path / "tuning", entry) for entry in entries]

    found = Bayesian(request(tiny_task), tmp_path)
    while not found.over:
        assert found.step(queue) == [None]
    assert len(found.pending) == 1 + surrogate.DESIGN
    assert not found.presentable


def test_lists_and_steps_of_two(tiny_task: str, tmp_path: Path) -> None:
    """An option in which agents of one population cannot differ goes in steps of a factor of two."""
    wanted = request(
        tiny_task,
        trials=15,
        regret=1e-9,
        varied=varied("activation=relu,tanh", "buffer={low=500, high=8000, log=true}"),
        settings=tuple(each for each in OWN if each.name != "buffer"),
    )
    found = finish(Bayesian(wanted, tmp_path), Recorder(tmp_path / "tuning", near(2e-3)))
    assert {trial.point["model.activation"] for trial in found.trials} == {"relu", "tanh"}
    tried = {trial.point["algorithm.buffer"] for trial in found.trials}
    assert tried <= {500 * 2**k for k in range(-3, 9)}
    assert len(tried) > 2
    assert found.beside == 1
    populations: dict[int, set[tuple[str, int]]] = {}
    for trial in found.trials:
        own = trial.point["model.activation"], trial.point["algorithm.buffer"]
        populations.setdefault(trial.round, set()).add(own)
    assert len(populations) == 5
    assert len(found.trials) == found.planned == 45, "the last round is shorter"
    assert max(map(len, populations.values())) <= 4, "populations of four, and the untuned settings"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": (1_000_000, 1_000_002)}, "it takes seeds one after the other, such as --seeds 2"),
        ({"settings": (*OWN, parse_setting("lr=1e-3"))}, "nothing is varied"),
        ({"rows": ("gamma=.9 lr=.01",)}, "no entry has all of these options among those that are varied"),
    ],
)
def test_bad_requests(changes: dict[str, Any], message: str, tiny_task: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=message):
        runner.build([request(tiny_task, **changes)], tmp_path)


@pytest.mark.parametrize(
    ("word", "row"),
    [
        ("lr=.002 buffer=10000", True),
        ("preset=mine.toml", True),
        ("lr=.002", False),
        ("lr=[1e-3, 5e-4]", False),
        ("lr={low = 1e-4, high = 1e-2}", False),
        ("paper", False),
    ],
)
def test_settings_by_hand_are_told_from_lists(word: str, row: bool) -> None:
    assert bool(space.ROW.fullmatch(word)) == row


def test_the_stated_regret_is_about_the_real_one_and_small() -> None:
    """On bowls over two options, runs scattering by 28 percent; `benchmarks/tuning.py` has more of them."""
    real, said = [], []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        optimum = generator.uniform(-0.1, 1.1, 2)
        climb = surrogate.Climb([generator.random(2)], seed=seed)
        found: dict[int, list[float]] = {}
        for _ in range(8):
            for number in climb.next():
                mean = math.exp(float(np.square(climb.tried[number] - optimum).sum()))
                found.setdefault(number, []).extend(mean * generator.gamma(1 / 0.28**2, 0.28**2, 4))
            runs = [np.array(each) for each in found.values()]
            climb.tell(
                [*found],
                np.array([each.mean() for each in runs]),
                np.array([each.std(ddof=1) / each.mean() for each in runs]),
                np.array([float(len(each)) for each in runs]),
            )
        assert climb.regret is not None
        real.append(math.expm1(float(np.square(climb.tried[climb.best] - optimum).sum())))
        said.append(climb.regret.expected)
    assert np.mean(real) < 0.05
    assert np.mean(real) / 3 < np.mean(said) < 3 * np.mean(real)


@dataclass(frozen=True)
class Gained:
    """Options of a plugin."""

    gain: Annotated[float, Field(gt=0, description="at the input"), Tuned(0.1, 10, "quantum")] = 1.0
    width: Annotated[int, Field(ge=1, description="units")] = 4


def test_options_say_that_they_are_tuned() -> None:
    assert options.tuned(Gained) == {"gain": Tuned(0.1, 10, "quantum")}
    with pytest.raises(PluginError, match="give a range with 0 < low < high"):
        Tuned(0, 1)


ALGORITHMS = {
    "ddqn": {
        "algorithm.lr",
        "algorithm.epsilon",
        "algorithm.buffer",
        "algorithm.batch",
        "algorithm.target_steps",
    },
    "ppo": {"algorithm.lr", "algorithm.clip", "algorithm.repeats", "algorithm.batch"},
    "reinforce": {"algorithm.lr"},
}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    ("model", "names"),
    [
        ("mlp", {"model.input_scale"}),
        ("fourier", {"model.bandwidth"}),
        ("vqc-native", {"algorithm.quantum_lr", "model.init_scale"}),
        ("vqc-pennylane", {"algorithm.quantum_lr", "model.init_scale"}),
    ],
)
def test_every_model_tunes_its_gain_and_what_its_algorithm_marks(
    algorithm: str, model: str, names: set[str]
) -> None:
    entry = resolve("beam6g", model, algorithm)
    found = space.declared(entry)
    assert set(found) == names | ALGORITHMS[algorithm]
    own = {"algorithm": entry.algorithm_options, "model": entry.model_options}
    for name, ends in found.items():
        side, _, option = name.partition(".")
        if option in ("lr", "quantum_lr"):
            assert (ends.low, ends.high, ends.log) == (2e-4, 1e-2, True)
        assert ends.low <= getattr(own[side], option) <= ends.high, "the untuned value lies within"


@pytest.mark.parametrize(("train", "varied"), [("scaling", True), ("linear", False)])
def test_a_circuit_that_stays_as_drawn_has_no_quantum_learning_rate(train: str, varied: bool) -> None:
    found = space.declared(resolve("beam6g", f"ddqn vqc-native train={train} qubits=2 layers=1"))
    assert ("algorithm.quantum_lr" in found) == varied


def test_places_and_values_undo_each_other() -> None:
    for ends in (space.Range(low=1e-3, high=1.0, log=True), space.Range(low=-2.0, high=3.0)):
        for place in np.linspace(-0.5, 1.5, 9):
            value = bayesian.value(ends, float(place))
            assert bayesian.place_of(ends, value) == pytest.approx(place, abs=2e-3)


def test_one_value_beside_settings_is_settings_too(tiny_task: str) -> None:
    assert space.read_varied(["lr=.002", "lr=.003 batch=32"]) == (None, (), ("lr=.002", "lr=.003 batch=32"))
    _, (lr,), rows = space.read_varied(["lr=.002"])
    assert (lr.name, lr.value, rows) == ("lr", [0.002], ())
    _, (lr,), rows = space.read_varied(["lr=.002,.004", "lr=.003 batch=32"])
    assert (lr.value, rows) == ([0.002, 0.004], ("lr=.003 batch=32",))
    for vary, sampler in (
        (["lr=.002,.004"], "grid"),
        (["lr=.002,.004", "lr=.002 epsilon=.2"], "bayesian"),
        (["lr={low=1e-3,high=1e-2}"], "bayesian"),
    ):
        [wanted] = search.read_requests(
            tiny_task, ["mlp"], vary, None, None, None, "time", None, Where.create("local")
        )
        assert wanted.sampler == sampler
