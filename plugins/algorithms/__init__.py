"""The built-in algorithms."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import AlgorithmSpec


@hookimpl
def register_algorithms(register: Callable[[AlgorithmSpec], None]) -> None:
    """Register `ddqn`, `drqn`, `ppo`, `reinforce`, `sac` and `td3`."""
    register(
        AlgorithmSpec(
            name="ddqn",
            summary="Double deep Q-learning with replay buffer and target network",
            options="qrlsuite.plugins.algorithms.ddqn:DDQNOptions",
            factory="qrlsuite.plugins.algorithms.ddqn:DDQN",
        )
    )
    register(
        AlgorithmSpec(
            name="drqn",
            summary="Deep recurrent Q-learning: double Q-learning on sequences, for models that remember",
            options="qrlsuite.plugins.algorithms.drqn:DRQNOptions",
            factory="qrlsuite.plugins.algorithms.drqn:DRQN",
        )
    )
    register(
        AlgorithmSpec(
            name="ppo",
            summary="Proximal policy optimization, generalized advantages; on sequences for models that remember",
            options="qrlsuite.plugins.algorithms.ppo:PPOOptions",
            factory="qrlsuite.plugins.algorithms.ppo:PPO",
            actions=("discrete", "box", "multi-discrete", "multi-binary"),
        )
    )
    register(
        AlgorithmSpec(
            name="reinforce",
            summary="REINFORCE, the vanilla policy gradient, with or without a baseline",
            options="qrlsuite.plugins.algorithms.reinforce:REINFORCEOptions",
            factory="qrlsuite.plugins.algorithms.reinforce:Reinforce",
        )
    )
    register(
        AlgorithmSpec(
            name="sac",
            summary="Soft actor-critic with a learned temperature, for continuous or discrete actions",
            options="qrlsuite.plugins.algorithms.sac:SACOptions",
            factory="qrlsuite.plugins.algorithms.sac:SAC",
            actions=("box", "discrete"),
        )
    )
    register(
        AlgorithmSpec(
            name="td3",
            summary="Twin delayed deterministic policy gradient, for continuous actions",
            options="qrlsuite.plugins.algorithms.td3:TD3Options",
            factory="qrlsuite.plugins.algorithms.td3:TD3",
            actions=("box",),
        )
    )
