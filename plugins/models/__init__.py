"""The built-in function approximators: multilayer perceptron, Fourier features, hybrid variational quantum circuits."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import ModelSpec

CIRCUITS = {
    "native": "in the suite's own batched simulator; the fast one",
    "pennylane": "on any PennyLane device",
    "qiskit": "on Qiskit primitives: exact, with shots, or with noise",
}

MEMORY = {
    "native": "qrlsuite.plugins.models.vqc:native_memory",
    "pennylane": "qrlsuite.plugins.models.vqc:pennylane_memory",
}
"""What is known of the states that a simulator keeps."""


@hookimpl
def register_models(register: Callable[[ModelSpec], None]) -> None:
    """Register `mlp`, `fourier`, `gru` and the `vqc-*` models."""
    register(
        ModelSpec(
            name="mlp",
            summary="Multilayer perceptron; options: width, depth, activation, init, input_scale",
            family="classical",
            options="qrlsuite.plugins.models.mlp:MLPOptions",
            build="qrlsuite.plugins.models.mlp:build",
            population="qrlsuite.plugins.models.mlp:population",
            memory="qrlsuite.plugins.models.mlp:memory",
        )
    )
    register(
        ModelSpec(
            name="fourier",
            summary="Fourier features, trained or random, and a linear layer; options: frequencies, bandwidth, train",
            family="classical",
            options="qrlsuite.plugins.models.fourier:FourierOptions",
            build="qrlsuite.plugins.models.fourier:build",
            population="qrlsuite.plugins.models.fourier:population",
            memory="qrlsuite.plugins.models.fourier:memory",
        )
    )
    register(
        ModelSpec(
            name="gru",
            summary="Gated recurrent unit, a network that remembers; options: width, input_scale",
            family="classical",
            options="qrlsuite.plugins.models.gru:GRUOptions",
            build="qrlsuite.plugins.models.gru:build",
            memory="qrlsuite.plugins.models.gru:memory",
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
                memory=MEMORY.get(backend),
                faster=None if backend == "native" else "vqc-native",
            )
        )
