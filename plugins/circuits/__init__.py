"""The built-in ansaetze, and the backends that compute a circuit's expectation values."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import AnsatzSpec, CircuitBackendSpec

_HERE = "qrlsuite.plugins.circuits"

MAX_QUBITS = 20
"""How many qubits the simulators take: a state of 2^20 amplitudes, 16 MiB, for every sample."""


@hookimpl
def register_ansatzes(register: Callable[[AnsatzSpec], None]) -> None:
    """Register the paper's three structures, and the circuits of other papers."""
    for name, summary, options in (
        (
            "iqp",
            "Closed ring of controlled gates between layers of Hadamards; options: gate, entangled",
            "GateOptions",
        ),
        ("cx", "A gate on every qubit, then a ring of CNOTs; options: gate, entangled", "GateOptions"),
        ("cz", "A gate on every qubit, then a ring of CZs; options: gate, entangled", "GateOptions"),
        (
            "skolik",
            "Re-uploading with trainable input scaling: RX, RY, RZ and a ring of CZs; option: entangled",
            "SkolikOptions",
        ),
        (
            "jerbi",
            "Trained rotations, a ring of CZs and the observation by turns; option: entangled",
            "EntangledOptions",
        ),
        (
            "hsiao",
            "Qubits without entanglement: the observation and RX in every layer; options: encoding, entangled",
            "HsiaoOptions",
        ),
        (
            "perez-salinas",
            "Universal re-uploading: the whole observation on every qubit, CZs between layers; options: inputs, "
            "entangled",
            "PerezSalinasOptions",
        ),
        (
            "wang",
            "Re-uploading with rings of CZs or trained ZZ, measured in X; options: coupling, edges, entangled",
            "WangOptions",
        ),
        (
            "basic",
            "The observation encoded once, as angles or bits, then RX and rings of CNOTs; options: encoding, entangled",
            "BasicOptions",
        ),
    ):
        build = f"{_HERE}.ansatz:{name.replace('-', '_')}"
        register(AnsatzSpec(name, summary, f"{_HERE}.ansatz:{options}", build))


@hookimpl
def register_circuit_backends(register: Callable[[CircuitBackendSpec], None]) -> None:
    """Register the backends."""
    register(
        CircuitBackendSpec(
            name="native",
            summary="The suite's own fast simulator; options: shots, gradient, noise_model, trajectories",
            options=f"{_HERE}.options:NativeOptions",
            factory=f"{_HERE}.native:NativeBackend",
            mean_field=True,
            products=True,
            max_qubits=MAX_QUBITS,
        )
    )
    register(
        CircuitBackendSpec(
            name="pennylane",
            summary="Any PennyLane device by name; options: device, diff_method, shots",
            options=f"{_HERE}.options:PennyLaneOptions",
            factory=f"{_HERE}.pennylane:PennyLaneBackend",
            products=True,
            max_qubits=MAX_QUBITS,
            speedup="150 to 198 times faster; --set device=qrlsuite.native is 4 to 8 times faster than default.qubit",
            quick=(2, 1),
        )
    )
    register(
        CircuitBackendSpec(
            name="qiskit",
            summary="Qiskit's simulator Aer; options: estimator, gradient, shots, noise_model",
            options=f"{_HERE}.options:QiskitOptions",
            factory=f"{_HERE}.qiskit:QiskitBackend",
            products=True,
            max_qubits=MAX_QUBITS,
            speedup="169 to 649 times faster",
            quick=(2, 1),
        )
    )
