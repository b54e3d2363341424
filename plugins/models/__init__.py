"""The built-in function approximators: perceptrons, Fourier features, recurrent units, hybrid quantum circuits."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import NO_MODEL, ModelSpec


@hookimpl
def register_models(register: Callable[[ModelSpec], None]) -> None:
    """Register `mlp`, `tmlp`, `fourier`, `cnn`, `gru`, `lstm`, `none`, and `vqc-`, `qlstm-` and `qfwp-BACKEND`."""
    register(
        ModelSpec(
            name="mlp",
            summary="Multilayer perceptron; options: width, depth, activation, init, input_scale",
            family="classical",
            options="qrlsuite.plugins.models.mlp:MLPOptions",
            build="qrlsuite.plugins.models.mlp:build",
            population="qrlsuite.plugins.models.mlp:population",
            numerics=2,
        )
    )
    register(
        ModelSpec(
            name="tmlp",
            summary="Perceptron with tensor networks as weights; options: width, depth, cores, bond, activation",
            family="classical",
            options="qrlsuite.plugins.models.tmlp:TMLPOptions",
            build="qrlsuite.plugins.models.tmlp:build",
            population="qrlsuite.plugins.models.tmlp:population",
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
            numerics=2,
        )
    )
    register(
        ModelSpec(
            name="cnn",
            summary="Convolutions and a hidden layer, for images; options: channels, depth, kernel, stride, width",
            family="classical",
            options="qrlsuite.plugins.models.cnn:CNNOptions",
            build="qrlsuite.plugins.models.cnn:build",
        )
    )
    for name, unit in (("gru", "Gated recurrent unit"), ("lstm", "Long short-term memory")):
        register(
            ModelSpec(
                name=name,
                summary=f"{unit}, a network that remembers; options: width, input_scale",
                family="classical",
                options="qrlsuite.plugins.models.recurrent:RecurrentOptions",
                build=f"qrlsuite.plugins.models.recurrent:{name}",
                population="qrlsuite.plugins.models.recurrent:population",
            )
        )
    register(
        ModelSpec(
            name=NO_MODEL,
            summary="No network, for algorithms that build none",
            family="classical",
            options="qrlsuite.plugins.models.none:NoneOptions",
            build="qrlsuite.plugins.models.none:build",
        )
    )
    register(
        ModelSpec(
            name="vqc",
            summary="Hybrid variational quantum circuit",
            family="quantum",
            options="qrlsuite.plugins.models.vqc:VQCOptions",
            build="qrlsuite.plugins.models.vqc:build",
            population="qrlsuite.plugins.models.vqc:population",
            faster="vqc-native",
            backends=True,
            numerics_on={"native": 2},
        )
    )
    register(
        ModelSpec(
            name="qlstm",
            summary="Quantum long short-term memory, circuits that remember",
            family="quantum",
            options="qrlsuite.plugins.models.qlstm:QLSTMOptions",
            build="qrlsuite.plugins.models.qlstm:build",
            population="qrlsuite.plugins.models.qlstm:population",
            faster="qlstm-native",
            backends=True,
        )
    )
    register(
        ModelSpec(
            name="qfwp",
            summary="Quantum fast weights, a circuit whose angles remember",
            family="quantum",
            options="qrlsuite.plugins.models.qfwp:QFWPOptions",
            build="qrlsuite.plugins.models.qfwp:build",
            population="qrlsuite.plugins.models.qlstm:population",
            faster="qfwp-native",
            backends=True,
        )
    )
