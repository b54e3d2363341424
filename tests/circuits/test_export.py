"""Exported circuits compute what they are exported from: the text is run by whom it is written for."""

import math
from typing import Any

import numpy as np
import pytest
from qiskit.quantum_info import SparsePauliOp, Statevector

from qrlsuite.circuit import Circuit, ansatz, expectations
from qrlsuite.circuit.export import FORMATS, export
from qrlsuite.errors import OptionError
from qrlsuite.testing.circuits import every_gate
from tests.circuits.test_products import functions, rich, words
from tests.commands import say

CIRCUITS = [
    every_gate,
    rich,
    words,
    functions,
    lambda: ansatz("iqp", 3, 1),
    lambda: ansatz("iqp", 2, 1, gate="u3"),
]


def numbers(circuit: Circuit) -> tuple[Any, dict[str, Any], list[float]]:
    """Inputs, parameters, and the expectation values that go with them."""
    source = np.random.default_rng(0)
    x = source.normal(size=circuit.inputs)
    parameters = {name: 6 * source.random(p.shape) for name, p in circuit.parameters.items()}
    return x, parameters, expectations(circuit, x[None], parameters)[0].tolist()


def values(circuit: Any, observables: list[SparsePauliOp]) -> list[float]:
    state = Statevector(circuit)
    return [float(state.expectation_value(observable).real) for observable in observables]


@pytest.mark.parametrize("make", CIRCUITS)
def test_the_qiskit_program(make: Any) -> None:
    circuit = make()
    x, parameters, expected = numbers(circuit)
    names: dict[str, Any] = {}
    exec(export(circuit, "qiskit"), names)
    bound = {names["x"]: x} | {names[name]: value.ravel() for name, value in parameters.items()}
    flat = {
        element: number
        for vector, array in bound.items()
        for element, number in zip(vector, array)
        if element in names["circuit"].parameters
    }
    got = values(names["circuit"].assign_parameters(flat), names["observables"])
    np.testing.assert_allclose(got, expected, atol=1e-12)


@pytest.mark.parametrize("make", CIRCUITS)
def test_the_pennylane_program(make: Any) -> None:
    circuit = make()
    x, parameters, expected = numbers(circuit)
    names: dict[str, Any] = {}
    exec(export(circuit, "pennylane"), names)
    np.testing.assert_allclose(names["circuit"](x, **parameters), expected, atol=1e-12)
    batch = np.stack([x, 0 * x, -x])
    alone = [names["circuit"](each, **parameters) for each in batch]
    np.testing.assert_allclose(np.transpose(names["circuit"](batch, **parameters)), alone, atol=1e-12)


@pytest.mark.parametrize("make", [each for each in CIRCUITS if each is not functions])  # Qiskit reads none
def test_the_qasm3_text(make: Any) -> None:
    qasm3 = pytest.importorskip("qiskit_qasm3_import")
    circuit = make()
    x, parameters, expected = numbers(circuit)
    text = export(circuit, "qasm3")
    read = qasm3.parse(text)
    given = {f"x_{i}": number for i, number in enumerate(x)}
    for name, array in parameters.items():
        given |= {"_".join([name, *map(str, index)]): array[index] for index in np.ndindex(array.shape)}
    flat = {parameter: given[parameter.name] for parameter in read.parameters}
    said = text.partition("// observables: ")[2].partition("\n")[0].split(", ")
    factors = ([factor.split("_") for factor in word.split("*")] for word in said)
    words = [[("".join(a for a, _ in word), [int(q) for _, q in word], 1.0)] for word in factors]
    observables = [SparsePauliOp.from_sparse_list(word, circuit.qubits) for word in words]
    np.testing.assert_allclose(values(read.assign_parameters(flat), observables), expected, atol=1e-12)


def test_functions_of_inputs() -> None:
    circuit = Circuit(1)
    circuit.append("RX", 0, 2 * np.arctan(circuit.input(0) + 1))
    assert "rx(2.0 * arctan(x_0 + 1.0)) q[0];" in export(circuit, "qasm3")
    circuit.append("RX", 0, np.tanh(circuit.input(0)))
    assert "qml.math.tanh(x[..., 0])" in export(circuit, "pennylane")
    for format in ("qasm3", "qiskit"):
        with pytest.raises(OptionError, match="it has no function tanh of inputs"):
            export(circuit, format)


def test_a_small_circuit_by_hand() -> None:
    circuit = Circuit(2, inputs=1)
    w = circuit.parameter("w", (1, 2))
    circuit.append("RX", 0, w[0, 1] * circuit.input(0) + 0.5)
    circuit.append("RZ", 1, math.pi, control=0)
    circuit.measure([(0, 1)])
    assert export(circuit, "qasm3").splitlines() == [
        "OPENQASM 3.0;", 'include "stdgates.inc";', "// observables: Z_0*Z_1", "input float[64] x_0;",
        "input float[64] w_0_0;", "input float[64] w_0_1;", "qubit[2] q;", "rx(w_0_1 * x_0 + 0.5) q[0];",
        f"crz({math.pi}) q[0], q[1];",
    ]  # fmt: skip
    assert "circuit.rx(w[1] * x[0] + 0.5, 0)" in export(circuit, "qiskit")
    assert "qml.RX(w[0, 1] * x[..., 0] + 0.5, wires=0)" in export(circuit, "pennylane")


@pytest.mark.parametrize("format", FORMATS)
def test_the_command_prints_nothing_but_the_text(format: str) -> None:
    result = say("show", "ansatz", "iqp", "qubits=3", "--format", format)
    assert result.stdout == export(ansatz("iqp", 3, 2), format)


def test_what_cannot_be_written_is_refused() -> None:
    with pytest.raises(OptionError, match=r"--format qasm: one of qasm3, .*; did you mean 'qasm3'"):
        export(ansatz("iqp", 2, 1), "qasm")
    with pytest.raises(OptionError, match="the mean-field approximation of a circuit is none"):
        export(ansatz("iqp", 2, 1, entangled="mean-field"), "qiskit")
