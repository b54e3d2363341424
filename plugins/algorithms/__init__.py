"""The built-in algorithms."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import AlgorithmSpec


@hookimpl
def register_algorithms(register: Callable[[AlgorithmSpec], None]) -> None:
    """Register `ddqn`."""
    register(
        AlgorithmSpec(
            name="ddqn",
            summary="Double deep Q-learning with replay buffer and target network",
            options="qrlsuite.plugins.algorithms.ddqn:Options",
            factory="qrlsuite.plugins.algorithms.ddqn:DDQN",
        )
    )
