"""Light cones: what is said to be dead has no gradient anywhere, and small circuits by hand."""

from __future__ import annotations

import numpy as np
import pytest

from qrlsuite.circuit import GATES, Circuit, ansatz
from qrlsuite.circuit.lightcone import described, uses
from qrlsuite.errors import OptionError
from qrlsuite.testing import effects


def alive(circuit: Circuit) -> tuple[set[int], set[effects.Scalar]]:
    angles = [use.angle for use in uses(circuit) if use.alive]
    elements = {(each.parameter, each.index) for angle in angles for each in angle.elements}
    return {k for angle in angles for k in angle.inputs}, elements


def drawn(seed: int, mean_field: bool) -> Circuit:
    """Return a random circuit of few gates, so that much of it is dead; some angles are constants."""
    source = np.random.default_rng(seed)
    circuit = Circuit(4, inputs=6, mean_field=mean_field)
    weights = circuit.parameter("w", (60,))
    for k in range(20):
        gate = str(source.choice(list(GATES)))
        kind = GATES[gate]
        qubits = [int(q) for q in source.permutation(4)]
        angles = [
            float(source.choice([0.0, np.pi / 2, np.pi, 0.3]))
            if source.random() < 0.3
            else weights[3 * k + i] + circuit.input(k % 6)
            for i in range(kind.angles)
        ]
        control = qubits[3] if kind.controllable and source.random() < 0.5 else None
        circuit.append(gate, qubits[: kind.wires], *angles, control=control)
    circuit.measure([0, 3] if mean_field else [(0, 1), "X3"])
    return circuit


@pytest.mark.parametrize("mean_field", [False, True])
@pytest.mark.parametrize("seed", range(15))
def test_dead_parameters_and_unseen_inputs_have_no_gradient(seed: int, mean_field: bool) -> None:
    circuit = drawn(seed, mean_field)
    inputs, scalars = alive(circuit)
    felt_inputs, felt = effects.effective(circuit)
    assert felt_inputs <= inputs
    assert felt <= scalars


@pytest.mark.parametrize(
    "name", ["basic", "cx", "cz", "hsiao", "iqp", "jerbi", "perez-salinas", "skolik", "wang"]
)
def test_of_built_in_circuits_no_other_parameter_is_dead(name: str) -> None:
    circuit = ansatz(name, 4, 3)
    assert alive(circuit) == effects.effective(circuit)


def chain(layers: int) -> Circuit:
    """Return RX of an input and RZ of a weight on three qubits, and a chain of CNOTs, in every layer; Z is measured."""
    circuit = Circuit(3)
    weights = circuit.parameter("w", (layers, 3))
    for layer in range(layers):
        for q in range(3):
            circuit.append("RX", q, circuit.input(q))
            circuit.append("RZ", q, weights[layer, q])
        for q in range(2):
            circuit.append("CNOT", (q, q + 1))
    return circuit


def test_a_chain_by_hand() -> None:
    # Z of qubit q goes back through the CNOTs to Z on qubits 0..q, which commutes with RZ; and RX of the first layer on
    # qubit 2 meets Z_0 in no way with one layer: an output sees 1, 2 or 3 inputs. With two, X and Y go back, too.
    assert described(chain(1), chain) == {
        "dead_parameters": "3 of 3: w[0, 0], w[0, 1], w[0, 2]",
        "inputs_that_no_output_sees": "none",
        "inputs_that_an_output_sees": "1 or 2 or 3 of 3",
        "layers_until_every_output_sees_every_input": "3",
    }
    circuit = chain(1)
    circuit.measure([0])

    def of_one_size(layers: int) -> Circuit:
        if layers > 1:
            raise OptionError("layers: 1")
        return circuit

    said = described(circuit, of_one_size)
    assert said["inputs_that_no_output_sees"] == "1, 2"
    assert said["layers_until_every_output_sees_every_input"] == "more than 1"
