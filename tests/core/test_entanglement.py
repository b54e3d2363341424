"""Entanglement of circuits' states: measures by hand, and along the episodes of trained agents."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from qrlsuite.circuit import Circuit, ansatz, expectations
from qrlsuite.cli.app import build
from qrlsuite.errors import OptionError
from qrlsuite.plugins.circuits.native import dense
from qrlsuite.results.store import EntryStore
from qrlsuite.training.entanglement import EPISODES, along_episodes
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


def test_trained_agents_beside_their_initial_parameters(train: Train, tmp_path: Path) -> None:
    folder = train("runs", [0, 1], 2, model="vqc-native", settings=SMALL)
    found = along_episodes(EntryStore(folder), episodes=3)
    assert (found.qubits, set(found.seeds)) == (2, {0, 1})
    assert found.steps.tolist() == list(range(20))
    for values in found.values.values():
        assert values["trained"].shape == values["initial"].shape == (2, 3, 20)
        assert not np.array_equal(values["trained"], values["initial"])
        assert np.isfinite(values["trained"]).all()
        assert (values["trained"] >= -1e-6).all()
        assert (values["trained"] <= 1 + 1e-6).all()
    apart = train("runs", [0], 1, model="vqc-native", settings=(*SMALL, "entangled=separable"))
    for values in along_episodes(EntryStore(apart), episodes=1).values.values():
        assert np.abs(values["trained"]).max() < 1e-5
    words = ["evaluate", str(folder), "--entanglement", "--episodes", "2", "--runs", str(tmp_path / "runs")]
    picture = tmp_path / "e.svg"
    shown = CliRunner().invoke(build(), [*words, "--out", str(picture)])
    assert shown.exit_code == 0, shown.output
    assert "half-cut entropy" in shown.output
    assert "trained" in picture.read_text()
    content = json.loads(CliRunner().invoke(build(), [*words, "--json"]).stdout)["entanglement"]
    assert 0 <= content[0]["meyer-wallach"]["trained"]["mean"] <= 1


def test_steps_after_an_episode_s_end_do_not_count(tiny_task: str, train: Train) -> None:
    Path(tiny_task).write_text(POLE)
    folder = train("runs", [0], 1, model="vqc-native", settings=SMALL)
    found = along_episodes(EntryStore(folder), episodes=1000)
    values = found.values["meyer-wallach"]["initial"]
    assert values.shape[1] == EPISODES
    ended = np.isnan(values[0])
    assert ended.any(axis=1).any()
    assert not ended[:, 0].any()
    assert (np.diff(ended.astype(int), axis=1) >= 0).all()


def test_what_has_no_states_is_refused(train: Train) -> None:
    network = train("runs", [0], 1)
    with pytest.raises(OptionError, match=r"--entanglement: model 'mlp' of .* has no circuit"):
        along_episodes(EntryStore(network))
    mean_field = train("runs", [0], 1, model="vqc-native", settings=(*SMALL, "entangled=mean-field"))
    with pytest.raises(OptionError, match="drops all correlations, so nothing is entangled"):
        along_episodes(EntryStore(mean_field))
