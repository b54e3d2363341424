"""The built-in function approximators: a multilayer perceptron, and hybrid variational quantum circuits."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import ModelSpec


@hookimpl
def register_models(register: Callable[[ModelSpec], None]) -> None:
    """Register `mlp` and the `vqc-*` models."""
    register(
        ModelSpec(
            name="mlp",
            summary="Multilayer perceptron; options: width, depth, activation, init",
            family="classical",
            options="qrlsuite.plugins.models.mlp:Options",
            build="qrlsuite.plugins.models.mlp:build",
            population="qrlsuite.plugins.models.mlp:population",
        )
    )
