"""Every backend says how many qubits it takes: a plugin's chain of tensors takes 30, without a state of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, ansatz, create_backend, expectations
from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.elementary import Elementary
from qrlsuite.circuit.matrices import FIXED, X, Y, Z
from qrlsuite.errors import OptionError, PluginError
from qrlsuite.plugins.circuits.options import NativeOptions

PAULI = {"RX": X, "RY": Y, "RZ": Z}


class Chain:
    """A matrix-product state without truncation: each gate on two qubits doubles the bonds between them."""

    shots = None

    def __init__(self, circuit: Circuit, options: NativeOptions) -> None:
        self.circuit = circuit
        self.table = AngleTable(circuit)
        self.elementary = Elementary(circuit, self.table)

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None = None
    ) -> Tensor:
        S, B = inputs.shape[:2]
        exact = {name: value.double() for name, value in parameters.items()}
        turns = self.elementary(self.table(inputs.double(), exact).reshape(-1, S * B))
        zero = torch.tensor([1, 0], dtype=torch.complex128).reshape(1, 1, 2, 1)
        sites = [zero.expand(S * B, 1, 2, 1) for _ in range(self.circuit.qubits)]  # (lanes, left, 2, right)
        for gate, wires, rotation in self.elementary.gates:
            if rotation is not None:
                half = turns[rotation][:, None, None] / 2
                matrix = half.cos() * torch.eye(2) - 1j * half.sin() * torch.tensor(PAULI[gate])
                sites[wires[0]] = torch.einsum("lij,lajb->laib", matrix, sites[wires[0]])
            elif len(wires) == 1:
                sites[wires[0]] = torch.einsum("ij,lajb->laib", torch.tensor(FIXED[gate]), sites[wires[0]])
            else:
                swap = [("CNOT", wires), ("CNOT", wires[::-1]), ("CNOT", wires)]
                for name, pair in swap if gate == "SWAP" else [(gate, wires)]:
                    self._connect(sites, "X" if name == "CNOT" else "Z", *pair)
        values = []
        for measured in self.circuit.measured:
            left = torch.ones(S * B, 1, 1, dtype=torch.complex128)
            for q, site in enumerate(sites):
                seen = site * torch.tensor([1, -1]).reshape(2, 1) if q in measured else site
                left = torch.einsum("lab,lasc,lbsd->lcd", left, site.conj(), seen)
            values.append(left[:, 0, 0].real)
        return torch.stack(values, dim=1).reshape(S, B, -1).to(inputs)

    def _connect(self, sites: list[Tensor], pauli: str, control: int, target: int) -> None:
        """Apply a Pauli where the control is 1: a bond of two carries its value."""
        first, last = min(control, target), max(control, target)
        for q in range(first, last + 1):
            if q == control:
                carried = torch.stack([sites[q] * torch.eye(2)[k, :, None] for k in (0, 1)])
            elif q == target:
                turned = torch.einsum("ij,lajb->laib", torch.tensor(FIXED[pauli]), sites[q])
                carried = torch.stack([sites[q], turned])
            else:
                carried = torch.stack([sites[q], sites[q]])
            lanes, a, _, b = sites[q].shape
            room = sites[q].new_zeros(lanes, 1 if q == first else 2, a, 2, 1 if q == last else 2, b)
            for k in (0, 1):
                room[:, 0 if q == first else k, :, :, 0 if q == last else k] += carried[k]
            sites[q] = room.reshape(lanes, -1, 2, room.shape[4] * b)


SPEC = specs.CircuitBackendSpec(
    "chain", "A chain of tensors", "qrlsuite.plugins.circuits.options:NativeOptions", f"{__name__}:Chain",
    products=True, max_qubits=30,
)  # fmt: skip


@pytest.fixture
def chain(monkeypatch: pytest.MonkeyPatch) -> None:
    known = registry.load().entries[specs.CircuitBackendSpec]
    monkeypatch.setitem(known, "chain", replace(known["native"], spec=SPEC))


def drawn(circuit: Circuit) -> dict[str, np.ndarray]:
    source = np.random.default_rng(0)
    return {name: source.uniform(0, 6, p.shape) for name, p in circuit.parameters.items()}


def gradients(circuit: Circuit, x: Tensor, backend: str) -> Tensor:
    leaf = x.clone().requires_grad_()
    expectations(circuit, leaf, drawn(circuit), backend).sum().backward()
    assert leaf.grad is not None
    return leaf.grad


@pytest.mark.usefixtures("chain")
def test_a_plugin_runs_thirty_connected_qubits() -> None:
    small, large = (ansatz("cz", n, 2, gate="xyz") for n in (6, 30))
    x = torch.randn(2, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(gradients(small, x[:, :6], "chain"), gradients(small, x[:, :6], "native"))
    for circuit in (small, large):  # qubit 2 is in the light cone of 1, 2 and 3 alone
        circuit.measure([2, (2, 3)])
    values = {name: p.reshape(2, 6, -1) for name, p in drawn(small).items()}
    same = {name: np.tile(values[name], (1, 5, 1)).reshape(p.shape) for name, p in large.parameters.items()}
    found = expectations(large, x, same, "chain")
    torch.testing.assert_close(found, expectations(small, x[:, :6], drawn(small), "native"))


@pytest.mark.usefixtures("chain")
def test_a_refusal_says_who_takes_more() -> None:
    start = "gates or observables connect 22 of them, and backend"
    circuit = Circuit(31)
    for q in range(21):
        circuit.append("CNOT", (q, q + 1))
    for backend in ("native", "pennylane", "qiskit"):
        with pytest.raises(OptionError, match=f"qubits = 31: {start} '{backend}' .* 20; 'chain' takes 30$"):
            create_backend(backend, circuit)
    circuit.measure([range(31)])
    with pytest.raises(OptionError, match="'chain' takes at most 30; no backend that is installed takes so"):
        create_backend("chain", circuit)
    with pytest.raises(PluginError, match="max_qubits = 0"):
        replace(SPEC, max_qubits=0)


@pytest.mark.parametrize("backend", ["native", "pennylane", "qiskit"])
@pytest.mark.parametrize("shots", [None, 400])
def test_qubits_that_nothing_connects_are_computed_apart(backend: str, shots: int | None) -> None:
    circuit = Circuit(23)
    w = circuit.parameter("w", (23,))
    for q in range(23):
        circuit.append("RX", q, circuit.input(q) + w[q])
    circuit.append("RY", 22, w[0], control=0)
    circuit.append("CNOT", (3, 4))
    circuit.measure([(0, 22), (4, 3), 5, "Y0", 4, 12])
    x = torch.randn(2, 23, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    few = Circuit(7)
    v = few.parameter("v", (7,))
    for k in range(6):
        few.append("RX", k, few.input(k) + v[k])
    few.append("RY", 1, v[0], control=0)
    few.append("CNOT", (2, 3))
    few.measure([(0, 1), (3, 2), 4, "Y0", 3, 5])
    values = drawn(circuit)
    picked = [0, 22, 3, 4, 5, 12, 6]
    exact = expectations(few, x[:, picked], {"v": values["w"][picked]})
    found = expectations(circuit, x, values, backend, seed=1, **({"shots": shots} if shots else {}))
    torch.testing.assert_close(found, exact, rtol=0, atol=5 / 20 if shots else 1e-9)
