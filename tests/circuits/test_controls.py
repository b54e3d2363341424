"""Circuits with the coupling of their qubits taken out: `entangled = separable` and `mean-field`."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from qrlsuite.circuit import Circuit, ansatz, create_backend, expectations
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.plugins.circuits.native import NativeBackend, mean_field
from qrlsuite.testing.circuits import every_gate
from qrlsuite.testing.dense import expectation_values

STRUCTURES, GATES = ("iqp", "cx", "cz"), ("rot", "xyz", "u3")
VARIANTS = list(itertools.product(STRUCTURES, GATES))


def given(circuit: Circuit, seeds: int, batch: int, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Inputs (S, B, in), then every parameter (S, ...)."""
    source = torch.Generator().manual_seed(3)
    x = 3 * torch.rand(seeds, batch, circuit.inputs, generator=source, dtype=dtype) - 1.5
    shapes = [p.shape for p in circuit.parameters.values()]
    return [x, *(6.3 * torch.rand(seeds, *shape, generator=source, dtype=dtype) for shape in shapes)]


def values(circuit: Circuit, leaves: list[Tensor], backend: str = "native") -> Tensor:
    return create_backend(backend, circuit)(leaves[0], dict(zip(circuit.parameters, leaves[1:])))


@pytest.mark.parametrize("gate", GATES)
def test_separable_is_the_same_for_all_structures(gate: str) -> None:
    """A gate on its own qubit, H between layers: written down for two qubits and two layers."""
    circuits = [ansatz(name, 2, 2, gate=gate, entangled="separable") for name in STRUCTURES]
    names = {"rot": ["Rot"], "xyz": ["RX", "RY", "RZ"], "u3": ["U3"]}[gate]
    plus, layer = [("H", (0,)), ("H", (1,))], [(name, (q,)) for q in range(2) for name in names]
    for circuit in circuits:
        assert [(op.gate, op.qubits) for op in circuit] == [*plus, *layer, *plus, *layer]
        assert circuit.operations == circuits[0].operations
    assert circuits[0].parameter_count == ansatz("iqp", 2, 2, gate=gate).parameter_count


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_separable_with_scalings_of_one_is_a_trigonometric_polynomial(layers: int) -> None:
    """<Z_q> is one of degree 3 L - 1, of input q alone: each rotation counts 1, the last RZ 0 (Schuld et al. 2021)."""
    circuit, points = ansatz("cx", 2, layers, entangled="separable"), 64
    x = torch.zeros(1, points, 2, dtype=torch.float64)
    x[0, :, 1] = 2 * math.pi * torch.arange(points, dtype=torch.float64) / points
    weights = given(circuit, 1, 1)[2]
    got = values(circuit, [x, torch.ones_like(weights), weights])[0]
    assert float((got[:, 0] - got[0, 0]).abs().max()) < 1e-12, "qubit 0 does not depend on input 1"
    coefficients = np.abs(np.fft.rfft(got[:, 1].numpy())) / points
    assert coefficients[3 * layers :].max() < 1e-12
    assert coefficients[3 * layers - 1] > 1e-4, "the degree is reached"


@pytest.mark.parametrize(
    "circuit",
    [
        *(
            ansatz(s, n, 3, gate=g, entangled="mean-field")
            for (s, g), n in itertools.product(VARIANTS, (2, 3))
        ),
        every_gate(mean_field=True),
    ],
    ids=lambda circuit: f"{len(circuit)}-gates-{circuit.qubits}",
)
def test_mean_field_is_the_circuit_without_correlations(circuit: Circuit) -> None:
    leaves = given(circuit, 2, 2)
    got = values(circuit, leaves)
    flat = torch.cat([p.reshape(2, -1) for p in leaves[1:]], 1)
    torch.testing.assert_close(NativeBackend(circuit).by_torch(leaves[0], flat), got, rtol=0, atol=1e-12)
    for s in range(2):
        parameters = {name: p[s].numpy() for name, p in zip(circuit.parameters, leaves[1:])}
        expected = [expectation_values(circuit, x, parameters) for x in leaves[0][s].numpy()]
        np.testing.assert_allclose(got[s], expected, rtol=0, atol=1e-12)


def test_mean_field_by_hand() -> None:
    """A control with <Z> = cos a flips the target's z by that factor; a target without x leaves it no coherence."""
    circuit = Circuit(2, mean_field=True)
    circuit.append("RY", 0, circuit.input(0))
    circuit.append("RY", 1, circuit.input(1))
    circuit.append("CNOT", (0, 1))
    circuit.append("H", 0)
    a, b = 0.4, 1.1
    got = expectations(circuit, [[a, b]], {})[0]
    assert got.tolist() == pytest.approx([math.sin(a) * math.sin(b), math.cos(a) * math.cos(b)], abs=1e-12)
    assert expectations(circuit, [[a, 0.0]], {})[0, 0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_seed_of_a_mean_field_does_not_depend_on_its_company(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    circuit = ansatz("iqp", 4, 2, entangled="mean-field")
    whole = given(circuit, 17, 10, dtype)
    cotangent = torch.rand(17, 10, 4, dtype=dtype, generator=torch.Generator().manual_seed(1))

    def slice_of(first: int, last: int) -> list[Tensor]:
        leaves = [t[first:last].clone().requires_grad_() for t in whole]
        result = values(circuit, leaves)
        result.backward(cotangent[first:last])
        return [result.detach(), *(leaf.grad for leaf in leaves)]

    together = slice_of(0, 17)
    assert together[0].dtype == dtype
    for first, last in ((0, 1), (16, 17), (3, 5), (5, 16)):
        for part, all_ in zip(slice_of(first, last), together):
            assert torch.equal(part, all_[first:last])
    monkeypatch.setattr("qrlsuite.plugins.circuits.native.cpu.KEEP_BYTES", 0)
    for again, before in zip(slice_of(0, 17), together):
        assert torch.equal(again, before), "recomputed vectors differ from kept ones"


@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_cost_of_a_mean_field_is_linear_in_the_number_of_qubits(structure: str) -> None:
    programs = [
        mean_field.compile_circuit(ansatz(structure, n, 4, entangled="mean-field")) for n in (10, 20, 30)
    ]
    counts = np.array([[len(p.steps), len(p.rotations), sum(mean_field.record_rows(p))] for p in programs])
    assert (np.diff(counts, axis=0)[0] == np.diff(counts, axis=0)[1]).all()
    assert counts[0, 0] == 10 + 4 * 10 + 3 * 10, "one step per gate"
    many = ansatz(structure, 64, 2, entangled="mean-field")
    assert values(many, given(many, 1, 1, torch.float32)).shape == (1, 1, 64)


@pytest.mark.parametrize("backend", ["pennylane", "qiskit"])
def test_backends_that_run_circuits_refuse_mean_fields(backend: str) -> None:
    circuit = ansatz("cz", 2, 1, entangled="mean-field")
    message = f"^backend '{backend}' runs circuits, and the mean-field .* backend 'native' computes it .*$"
    with pytest.raises(OptionError, match=message):
        create_backend(backend, circuit)
    zeros = {name: np.zeros(p.shape) for name, p in circuit.parameters.items()}
    with pytest.raises(OptionError, match=message):
        expectations(circuit, [[0.0, 0.0]], zeros, backend=backend)
    words = ["ansatz=cz", "entangled=mean-field"]
    with pytest.raises(OptionError, match=message):
        resolve("beam6g", f"vqc-{backend}", settings=[parse_setting(word) for word in words])


def test_the_circuit_and_its_mean_field_are_prepared_apart() -> None:
    parameters = {name: np.full(p.shape, 0.7) for name, p in ansatz("cz", 2, 3).parameters.items()}
    circuits = [ansatz("cz", 2, 3, entangled=e) for e in (True, "separable", "mean-field")]
    apart = [expectations(circuit, [[0.3, 0.4]], parameters) for circuit in circuits]
    for a, b in itertools.combinations(apart, 2):
        assert float((a - b).abs().max()) > 1e-3


def test_one_qubit_can_be_separable_and_coupled_to_none() -> None:
    assert [op.gate for op in ansatz("iqp", 1, 2, entangled="separable")] == ["H", "Rot", "H", "Rot"]
    with pytest.raises(OptionError, match="'iqp' with 1 qubit"):
        ansatz("iqp", 1, 2, entangled="mean-field")


def test_coupled_circuits_keep_their_identity() -> None:
    """The default is no part of it, written out or not; the other values are."""
    plain = resolve("beam6g", "vqc-native")

    def hash_with(value: str) -> str:
        return resolve("beam6g", "vqc-native", settings=[parse_setting(f"entangled={value}")]).hash

    assert hash_with("true") == plain.hash
    for name in ("skolik", "iqp", "cz"):
        words = [parse_setting(f"ansatz={name}"), parse_setting("entangled=true")]
        assert (
            resolve("beam6g", "vqc-native", settings=words[:1]).hash
            == resolve("beam6g", "vqc-native", settings=words).hash
        )
    assert len({plain.hash, hash_with("separable"), hash_with("mean-field")}) == 3


def test_entangled_that_is_no_choice_or_not_there() -> None:
    with pytest.raises(OptionError, match=r"entangled = 'seperable': .*'separable' or 'mean-field'"):
        ansatz("iqp", 2, 1, entangled="seperable")
    with pytest.raises(OptionError, match="ansatz 'skolik' has no option 'gate'"):
        ansatz("skolik", 2, 1, gate="u3")
    words = ["ansatz=skolik", "edges=0-1"]
    message = "--set edges: no option of that name: ansatz 'skolik' has none, .*'wang' has it"
    with pytest.raises(OptionError, match=message):
        resolve("beam6g", "vqc-native", settings=[parse_setting(word) for word in words])
