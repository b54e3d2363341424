"""The built-in function approximators: a multilayer perceptron, and hybrid variational quantum circuits."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import ModelSpec

CIRCUITS = {
    "native": "in the suite's own batched simulator; the fast one",
    "pennylane": "on any PennyLane device",
    "qiskit": "on Qiskit primitives: exact, with shots, or with noise",
}


@hookimpl
def register_models(register: Callable[[ModelSpec], None]) -> None:
    """Register `mlp` and the `vqc-*` models."""
    register(
        ModelSpec(
            name="mlp",
            summary="Multilayer perceptron; options: width, depth, activation, init",
            family="classical",
            options="qrlsuite.plugins.models.mlp:MLPOptions",
            build="qrlsuite.plugins.models.mlp:build",
            population="qrlsuite.plugins.models.mlp:population",
        )
    )
    for backend, summary in CIRCUITS.items():
        options = {
            "native": "VQCNativeOptions",
            "pennylane": "VQCPennyLaneOptions",
            "qiskit": "VQCQiskitOptions",
        }[backend]
        register(
            ModelSpec(
                name=f"vqc-{backend}",
                summary=f"Hybrid variational quantum circuit {summary}",
                family="quantum",
                options=f"qrlsuite.plugins.models.vqc:{options}",
                build="qrlsuite.plugins.models.vqc:build",
                population="qrlsuite.plugins.models.vqc:population",
            )
        )
