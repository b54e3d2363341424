"""Diagnostics of trained agents, and the command for these and for circuits."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from typer.testing import CliRunner

from qrlsuite import api
from qrlsuite.circuit import Circuit, ansatz, expectations
from qrlsuite.cli.app import build
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.plugins.circuits.native import dense
from qrlsuite.results.store import EntryStore
from qrlsuite.training.diagnosis import along_episodes
from tests.conftest import POLE, Train

SMALL = ("qubits=2", "layers=2")


def test_states_are_those_of_the_circuit_also_where_qubits_are_apart() -> None:
    apart = Circuit(3)
    apart.append("RY", 1, apart.input(1))
    apart.append("H", 2)
    apart.append("CNOT", (2, 0))
    for circuit in (apart, ansatz("iqp", 3, 2), ansatz("cz", 3, 2, entangled="separable")):
        source = torch.Generator().manual_seed(0)
        x = torch.rand(2, 3, generator=source, dtype=torch.float64)
        parameters = {
            n: 6 * torch.rand(p.shape, generator=source, dtype=torch.float64)
            for n, p in circuit.parameters.items()
        }
        flat = torch.cat([torch.zeros(0), *(p.reshape(-1) for p in parameters.values())])
        probabilities = (
            dense.states(circuit, x[None], flat[None].to(x.dtype))[0].abs().square().reshape(2, 2, 2, 2)
        )
        marginals = [probabilities.sum([a for a in (1, 2, 3) if a != 1 + q]) for q in range(3)]
        got = torch.stack([m[:, 0] - m[:, 1] for m in marginals], 1)
        torch.testing.assert_close(got, expectations(circuit, x, parameters), rtol=0, atol=1e-10)
    found = dense.states(
        apart, torch.zeros(1, 1, 3, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
    )
    # qubits 0 and 2 in a Bell pair, qubit 1 alone in 0
    np.testing.assert_allclose(found[0, 0].abs().square(), np.eye(8)[[0, 5]].sum(0) / 2, atol=1e-12)


def qrlsuite(*words: object) -> str:
    shown = CliRunner().invoke(build(), list(map(str, words)))
    if isinstance(shown.exception, QrlSuiteError):
        raise shown.exception
    assert shown.exit_code == 0, shown.output
    return shown.stdout


def at_80_columns(found: object) -> str:
    text = io.StringIO()
    Console(width=80, file=text).print(found)
    return text.getvalue()


def test_trained_agents_beside_their_initial_parameters(kept: Train, tmp_path: Path) -> None:
    folder = kept("runs", [0, 1], 2, model="vqc-native", settings=SMALL)
    found = along_episodes(EntryStore(folder), episodes=3)
    assert (found.qubits, set(found.seeds), found.outputs) == (2, {0, 1}, "values")
    assert found.steps.tolist() == list(range(20))
    for which, values in found.entanglement.items():
        assert values["meyer-wallach"].shape == (2, 3, 20)
        assert (values["half-cut entropy"] >= -1e-6).all()
        assert (values["half-cut entropy"] <= 1 + 1e-6).all()
        for each in found.information[which]:
            assert 0 < each.rank < found.parameters
            assert each.gauge.sum() == pytest.approx(found.parameters - each.rank)
            assert 0 < found.effective_dimension(each) < found.parameters
        assert found.powers[which].shape[0] == 2
    for by_parameters in (found.information, found.powers, found.entanglement):
        assert str(by_parameters["trained"]) != str(by_parameters["initial"])
    network = kept("runs", [0], 1, settings=("width=3",))
    picture = tmp_path / "e.svg"
    words = ("diagnose", folder, network, "--episodes", 2)
    text = qrlsuite(*words, "--out", picture)
    assert "gauge directions of ddqn vqc-native" in text
    assert "vqc-native" in picture.read_text()
    assert "entropy" in at_80_columns(api.diagnose(str(folder), episodes=1, progress=False))
    circuit, classical = json.loads(qrlsuite(*words, "--json"))["entries"]
    assert 0 <= circuit["trained"]["meyer-wallach"]["mean"] <= 1
    assert sum(circuit["initial"]["gauge_directions"].values()) > 0
    assert "meyer-wallach" not in classical["trained"]
    assert classical["trained"]["effective_dimension"][0] > 0


def test_gauge_directions_of_a_policy_hold_what_is_added_to_all_logits(kept: Train) -> None:
    """The biases of 3 logits have 2 directions. A circuit that was trained with shots is taken exactly."""
    folder = kept("runs", [0], 1, model="reinforce vqc-native", settings=(*SMALL, "shots=10"))
    found = along_episodes(EntryStore(folder), episodes=2)
    assert found.outputs == "policy"
    gauge = found.gauge("trained")
    assert gauge is not None
    assert "circuit.weights[1, 1, 2]" in found.without_effect("trained")
    assert gauge["output.bias"] == pytest.approx(1.0, abs=1e-6)


def test_steps_after_an_episode_s_end_do_not_count(tiny_task: str, train: Train) -> None:
    Path(tiny_task).write_text(POLE)
    folder = train("runs", [0], 1, model="vqc-native", settings=SMALL)
    values = along_episodes(EntryStore(folder), episodes=20).entanglement["initial"]["meyer-wallach"]
    ended = np.isnan(values[0])
    assert ended.any(axis=1).any()
    assert not ended[:, 0].any()
    assert (np.diff(ended.astype(int), axis=1) >= 0).all()


def test_what_has_no_states_has_no_entanglement(kept: Train) -> None:
    mean_field = kept("runs", [0], 1, model="vqc-native", settings=(*SMALL, "entangled=mean-field"))
    found = along_episodes(EntryStore(mean_field), episodes=1)
    assert not found.entanglement
    assert found.information["trained"][0].rank > 0
    apart = kept("runs", [0], 1, model="vqc-native", settings=(*SMALL, "entangled=separable"))
    for values in along_episodes(EntryStore(apart), episodes=1).entanglement["trained"].values():
        assert np.abs(values).max() < 1e-5


def test_a_circuit_over_its_size(tmp_path: Path) -> None:
    picture = tmp_path / "c.svg"
    words = ("diagnose", "ansatz", "cz", "gate=xyz", "qubits=1:3", "--draws", 5)
    text = " ".join(qrlsuite(*words, "layers=n", "--out", picture).split())
    assert "with each further qubit" in text
    assert "layers = n" in text
    assert "global" in picture.read_text()
    sizes = json.loads(qrlsuite(*words, "layers=1,2", "--json"))["sizes"]
    assert [(each["qubits"], each["layers"]) for each in sizes] == [
        (n, law) for law in (1, 2) for n in (1, 2, 3)
    ]
    assert list(sizes[0]["gradient_variance"]) == ["local"]
    assert sizes[5]["without_effect"][-1] == "weights[1, 2, 2]"  # the last RZ
    assert sizes[5]["rank"] + sizes[5]["gauge_directions"] == sizes[5]["parameters"] == 36


def bare(qubits: int, layers: int) -> Circuit:
    return Circuit(qubits)


def test_functions_of_one_s_own_and_large_circuits() -> None:
    def chain(qubits: int, layers: int) -> Circuit:
        circuit = Circuit(qubits)
        circuit.append("RX", 0, circuit.parameter("w", (1,))[0] + circuit.input(0) * circuit.input(0))
        return circuit

    found = api.diagnose_ansatz(chain, [11, 2], 1, draws=3)
    assert [each.rank for each in found.sizes] == [1, None]
    assert [each.algebra for each in found.sizes] == [1, None]
    assert found.sizes[0].mean_frequency is None  # an input times another has no highest frequency
    assert "Lie" in at_80_columns(found)
    with pytest.raises(OptionError, match="bare with 2 qubits has no parameters"):
        api.diagnose_ansatz(bare, 2, 1)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("ansatz",), "give the name of one ansatz"),
        (("ansatz", "iqp", "cz"), "give the name of one ansatz"),
        (("ansatz", "iqpp"), "iqp"),
        (("ansatz", "iqp", "qubits=4-12"), "qubits '4-12': write one number"),
        (("ansatz", "iqp", "qubits=12:4"), "qubits '12:4': write one number"),
        (("ansatz", "iqp", "qubits=2:25"), "backend 'native' takes at most 20"),
        (("ansatz", "iqp", "layers=0n"), "layers '0n': write one number"),
        (("no-such-entry",), "no-such-entry"),
    ],
)
def test_wrong_input_is_one_clear_sentence(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    with pytest.raises(QrlSuiteError) as caught:
        qrlsuite("diagnose", *words, "--runs", tmp_path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
