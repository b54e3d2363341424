"""Circuits that remember: by circuits that are computed one by one, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from qrlsuite import options, registry, specs
from qrlsuite.circuit import ansatz, expectations
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.plugins.models import qlstm
from qrlsuite.population import unroll
from qrlsuite.training.trainer import Trainer


def agents(model: str = "qlstm-native", **settings: Any) -> tuple[Any, list[Any]]:
    spec = registry.get(specs.ModelSpec, model)
    own = options.build(specs.resolve(spec.options), {"qubits": 3, "layers": 2, **settings}, "model")
    made = [specs.resolve(spec.build)(2, 1, own, torch.Generator().manual_seed(s)) for s in range(2)]
    return qlstm.population(made, own), made


@pytest.mark.parametrize(("linear", "backend"), [(True, "native"), (False, "native"), (True, "pennylane")])
def test_gates_are_expectation_values_of_four_circuits(linear: bool, backend: str) -> None:
    population, modules = agents(f"qlstm-{backend}", linear=linear)
    width = 3 if linear else 1
    assert population.remembers == modules[0].remembers == 2 * width
    x = torch.randn(2, 4, 3, 2, generator=torch.Generator().manual_seed(1))
    begins = torch.zeros(2, 4, 3)
    begins[:, 1, 2] = 1.0
    outputs, states = unroll(population, x, begins, torch.zeros(2, 4, 2 * width))
    circuit = ansatz("cz", 3, 2)
    for s, module in enumerate(modules):
        p = {name: value.detach().numpy().astype(np.float64) for name, value in module.named_parameters()}
        for b in range(4):
            h = m = np.zeros(width)
            for k in range(3):
                if begins[s, b, k]:
                    h = m = np.zeros(width)
                v = np.concatenate([x[s, b, k].numpy().astype(np.float64), h])
                v = p["input.weight"] @ v + p["input.bias"] if linear else v
                given = [{n: p[f"circuit.{n}"][gate] for n in circuit.parameters} for gate in range(4)]
                e = [expectations(circuit, v[None], each).numpy()[0, :width] for each in given]
                i, f, o = (1 / (1 + np.exp(-e[gate])) for gate in (0, 1, 3))
                m = f * m + i * np.tanh(e[2])
                h = o * np.tanh(m)
                y = p["output.weight"] @ h + p["output.bias"] if linear else p["output.weight"] * h
                np.testing.assert_allclose(states[s, b, k].detach(), np.concatenate([h, m]), atol=2e-6)
                np.testing.assert_allclose(outputs[s, b, k].detach(), y, atol=2e-6)
    outputs.sum().backward()
    assert population.executions.as_dict() == {
        "forward": 4 * 4 * 3,
        "parameter_shift": 4 * 4 * 3 * modules[0].executions.per_gradient,
    }


def test_fast_weights_are_added_to_angles_that_scale_no_input() -> None:
    population, modules = agents("qfwp-native", ansatz="skolik")
    circuit = ansatz("skolik", 3, 2)
    assert population.remembers == 2 * 3 * 2, "layers, times two weights of each qubit"
    x = torch.randn(2, 4, 3, 2, generator=torch.Generator().manual_seed(1))
    outputs, states = unroll(population, x, torch.zeros(2, 4, 3), torch.zeros(2, 4, 12))
    for s, module in enumerate(modules):
        p = {name: value.detach().numpy().astype(np.float64) for name, value in module.named_parameters()}
        for b in range(4):
            fast = np.zeros((2, 6))
            for k in range(3):
                seen = x[s, b, k].numpy().astype(np.float64)
                rows, columns, v = (
                    p[f"{n}.weight"] @ seen + p[f"{n}.bias"] for n in ("rows", "columns", "input")
                )
                fast = fast + np.outer(rows, columns)
                given = {
                    "scaling": p["circuit.scaling"],
                    "weights": p["circuit.weights"] + fast.reshape(2, 3, 2),
                }
                e = expectations(circuit, v[None], given).numpy()[0]
                np.testing.assert_allclose(states[s, b, k].detach(), fast.ravel(), atol=2e-6)
                y = p["output.weight"] @ e + p["output.bias"]
                np.testing.assert_allclose(outputs[s, b, k].detach(), y, atol=5e-6)
    outputs.sum().backward()
    assert population.executions.as_dict()["forward"] == 4 * 3


def test_what_it_cannot_be_is_refused(tiny_task: str) -> None:
    small = agents(linear=False)[0]._runner.options
    with pytest.raises(
        OptionError, match=r"linear = false: the circuit has 3 inputs .* choose 5 qubits or more"
    ):
        qlstm.build(2, 3, small, torch.Generator())
    with pytest.raises(OptionError, match=r"take one of drqn, ppo: qrlsuite run 'drqn qlstm-native'"):
        Trainer(resolve(tiny_task, "qlstm-native", "ddqn", [parse_setting("qubits=2")]), [0])
    with pytest.raises(OptionError, match="the states of circuits that remember"):
        agents()[0].circuit_states(torch.zeros(2, 1, 2))
