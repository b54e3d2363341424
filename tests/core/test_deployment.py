"""Trained agents on another circuit backend: the same policy where it is exact, resumable, refused in one line."""

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path
from typing import Any

import numpy as np
import pennylane as qml
import pytest

from qrlsuite import api
from qrlsuite.api.evaluation import evaluate
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError, UnknownNameError
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results.store import EntryStore
from qrlsuite.training import deployment, evaluation
from qrlsuite.training.deployment import Deployment, on_backend
from tests.commands import answer, say
from tests.conftest import Train

CIRCUIT = ("qubits=2", "layers=1")


class Unreliable(qml.devices.DefaultQubit):  # type: ignore[misc, unused-ignore]
    """A device that is not a simulator by its name, and hangs up after some batches of circuits."""

    batches = 0

    def execute(self, *arguments: Any, **named: Any) -> Any:
        Unreliable.batches -= 1
        if Unreliable.batches < 0:
            raise ConnectionError("the service\nhung up")
        return super().execute(*arguments, **named)


@pytest.fixture
def unreliable(monkeypatch: pytest.MonkeyPatch) -> type[Unreliable]:
    point = importlib.metadata.EntryPoint("unreliable.qpu", f"{__name__}:Unreliable", "pennylane.plugins")
    devices = {**qml.plugin_devices, point.name: point}
    monkeypatch.setattr(qml.devices.device_constructor, "plugin_devices", devices)
    monkeypatch.setattr(deployment, "LANES", 4)
    return Unreliable


@pytest.fixture
def trained(kept: Train) -> EntryStore:
    return EntryStore(kept("runs", [0, 1], 1, "vqc-native", CIRCUIT))


@pytest.mark.parametrize("backend", ["native", "pennylane", "qiskit"])
def test_an_exact_backend_earns_what_the_agents_earned(backend: str, trained: EntryStore) -> None:
    expected = evaluation.trained(trained, 2, episodes=12)
    played = Deployment(trained, backend, {}, best=2).play(12, 0)
    np.testing.assert_allclose(played.returns, expected.returns)
    assert played.seeds == expected.seeds
    assert played.name == f"{expected.name} on {backend}"


def test_shots_and_noise_change_what_they_earn(trained: EntryStore) -> None:
    exact = evaluation.trained(trained, 2, episodes=20)
    noisy = {"shots": 1, "noise_model": "depolarizing", "noise_rate": 0.5}
    played = Deployment(trained, "native", noisy, best=2).play(20, 0)
    assert not np.allclose(played.returns, exact.returns)
    assert "shots=1" in played.name


def test_training_options_of_the_backend_stay_behind(kept: Train) -> None:
    entry = EntryStore(
        kept("runs", [0], 1, "vqc-native", (*CIRCUIT, "shots=5", "activation_in=tanh"))
    ).entry()
    there = on_backend(entry, "qiskit", {"shots": 7}).model_options
    assert (there.shots, there.qubits, there.activation_in) == (7, 2, "tanh")
    assert on_backend(entry, "native", {}).model_options.shots is None


def test_finished_rounds_are_kept_and_two_parts_equal_one(
    trained: EntryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deployment, "LANES", 4)
    noisy = {"shots": 3}

    def scores(episodes: int) -> Any:
        return Deployment(trained, "native", noisy, best=2).play(episodes, 0).returns

    first = scores(4)
    assert Deployment(trained, "native", noisy, best=2).cost(12, 0, 20).kept == 4
    (path,) = (trained.path / "evaluations").glob("*.jsonl")
    path.write_bytes(path.read_bytes() + b'{"round":1,"to')  # a writer was killed
    resumed = scores(12)
    assert [json.loads(line).get("round") for line in path.read_text().splitlines()] == [None, 0, 1, 2]
    path.unlink()
    whole = scores(12)
    np.testing.assert_array_equal(resumed, whole)
    np.testing.assert_array_equal(first, whole[:, :4])
    assert not np.array_equal(scores(12), Deployment(trained, "native", noisy, best=2).play(12, 1).returns)


def test_the_cost_is_said_before(trained: EntryStore) -> None:
    cost = Deployment(trained, "native", {"shots": 100}, best=2).cost(30, 0, 20.0)
    assert str(cost) == "2 agents, 30 episodes each: about 1,200 circuits, 100 shots each: 120,000 shots"


def test_a_device_that_refuses_half_way_loses_one_round(
    trained: EntryStore, unreliable: type[Unreliable]
) -> None:
    device = {"device": "unreliable.qpu"}

    def play() -> Any:
        return Deployment(trained, "pennylane", device, best=1).play(8, 0)

    unreliable.batches = 32  # a round takes 20, and building the agents 2
    message = "stopped after 4 episodes of each agent: the service hung up; they are kept"
    with pytest.raises(QrlSuiteError, match=message) as caught:
        play()
    assert "\n" not in str(caught.value)
    unreliable.batches = 22  # only the second round is played again
    np.testing.assert_allclose(play().returns, evaluation.trained(trained, 1, episodes=8).returns)


def test_a_device_that_is_no_simulator_needs_a_yes(trained: EntryStore, unreliable: type[Unreliable]) -> None:
    runs, entry = trained.path.parent.parent, [str(trained.path)]
    given: dict[str, Any] = {
        "best": 1, "episodes": 4, "progress": False,
        "backend": "pennylane device=unreliable.qpu shots=5",
    }  # fmt: skip
    unreliable.batches = 0
    with pytest.raises(OptionError, match=r"is not a simulator: 1 agents.*80 circuits.*400 shots; add --yes"):
        evaluate(Selection(runs), entry, **given)
    assert unreliable.batches == 0  # nothing was executed
    unreliable.batches = 22
    assert (
        evaluate(Selection(runs), entry, **given, yes=True)
        .policies[1]
        .name.endswith("device=unreliable.qpu shots=5")
    )


STUDY = """
format_version = 1
name = "hardware"
summary = "Agents on a device"

[[entries]]
name = "vqc"
task = "TASK"
model = "vqc-native"
options = { qubits = 2, layers = 1 }

[[pictures]]
kind = "deployed"

[pictures.evaluation]
episodes = 4
deployed = { backend = "pennylane", vary = "shots", values = [5], options = { device = "unreliable.qpu" } }
"""


def test_a_study_executes_nothing_on_hardware(
    trained: EntryStore, tiny_task: str, unreliable: type[Unreliable], tmp_path: Path
) -> None:
    unreliable.batches = 0
    path = tmp_path / "hardware.toml"
    path.write_text(STUDY.replace("TASK", tiny_task))
    with pytest.raises(
        OptionError, match=r"unreliable\.qpu shots=5 is not a simulator: a picture executes nothing"
    ):
        api.plot("picture", study=str(path), runs=trained.path.parent.parent)
    assert unreliable.batches == 0


def test_from_python(trained: EntryStore) -> None:
    runs, entry = trained.path.parent.parent, str(trained.path)
    given: dict[str, Any] = {"best": 2, "episodes": 5, "progress": False, "runs": runs}
    found = api.evaluate(entry, **given, backend="native shots=1")
    exact, sampled = found.policies[:2]
    assert sampled.name == f"{exact.name} on native shots=1"
    assert sampled.seeds == exact.seeds
    np.testing.assert_array_equal(
        sampled.returns, Deployment(trained, "native", {"shots": 1}, best=2).play(5, 0).returns
    )
    np.testing.assert_array_equal(exact.returns, api.evaluate(entry, **given).policies[0].returns)


@pytest.mark.parametrize(
    ("backend", "values", "error", "message"),
    [
        ("qiskti", {}, UnknownNameError, "did you mean 'qiskit'"),
        ("native", {"shots": 0}, OptionError, "shots = 0: .*greater than or equal to 1"),
        ("native", {"shot": 10}, OptionError, "no option 'shot'; did you mean 'shots'"),
        ("native", {"noise_model": "FakeManilaV2"}, OptionError, "noise_model = 'FakeManilaV2': .*'depolarizing'"),
        ("pennylane", {"noise_model": "depolarizing"}, OptionError, "'pennylane' has no option 'noise_model'"),
        ("qiskit", {"noise_model": "depolarizing"}, OptionError, "needs estimator = 'aer'"),
        ("pennylane", {"device": "cirq.simulator"}, OptionError, "pip install pennylane-cirq"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_refused_before_it_begins(
    backend: str, values: dict[str, Any], error: type[Exception], message: str, trained: EntryStore
) -> None:
    with pytest.raises(error, match=message):
        Deployment(trained, backend, values, best=1)


def test_entries_without_circuits_or_agents_are_refused(kept: Train, trained: EntryStore) -> None:
    network = EntryStore(kept("runs", [0], 1))
    with pytest.raises(OptionError, match="--backend qiskit: model 'mlp' has no circuit"):
        Deployment(network, "qiskit", {}, best=1)
    for seed in (0, 1):
        (trained.path / f"seed-000{seed}" / "final.safetensors").unlink()
    with pytest.raises(StoreError, match="no trained parameters"):
        evaluate(Selection(trained.path.parent.parent), [str(trained.path)], backend="qiskit", progress=False)


def test_the_command(trained: EntryStore) -> None:
    runs = str(trained.path.parent.parent)
    words = ["evaluate", str(trained.path), "--runs", runs, "--best", "1", "--episodes", "5"]
    there = ["--backend", "qiskit shots=10 estimator=aer"]
    policies = [each["policy"] for each in answer(*words, *there)["policies"]]
    assert policies[1] == f"{policies[0]} on qiskit shots=10 estimator=aer"
    with pytest.raises(OptionError, match="--backend 'native shots': write a name and its options"):
        say(*words, "--backend", "native shots")
