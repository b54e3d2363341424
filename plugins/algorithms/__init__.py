"""The built-in algorithms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import AlgorithmSpec

CLEANRL_DQN = {"gamma": 0.99, "lr": 2.5e-4, "buffer": 10_000, "batch": 128, "target_steps": 50}
"""Settings of CleanRL's dqn.py (commit 020cf0e), whose target is copied every 500 steps: 50 gradient steps here."""


@hookimpl
def register_algorithms(register: Callable[[AlgorithmSpec], None]) -> None:
    """Register `ddqn`, `drqn`, `ppo`, `reinforce`, `sac` and `td3`."""
    register(
        AlgorithmSpec(
            name="ddqn",
            summary="Double deep Q-learning with replay buffer and target network",
            options="qrlsuite.plugins.algorithms.ddqn:DDQNOptions",
            factory="qrlsuite.plugins.algorithms.ddqn:DDQN",
            starting_values=CLEANRL_DQN,
            unusable="qrlsuite.plugins.algorithms:unusable_ddqn",
        )
    )
    register(
        AlgorithmSpec(
            name="drqn",
            summary="Deep recurrent Q-learning: double Q-learning on sequences, for models that remember",
            options="qrlsuite.plugins.algorithms.drqn:DRQNOptions",
            factory="qrlsuite.plugins.algorithms.drqn:DRQN",
            unusable="qrlsuite.plugins.algorithms:unusable_drqn",
        )
    )
    register(
        AlgorithmSpec(
            name="ppo",
            summary="Proximal policy optimization, generalized advantages; on sequences for models that remember",
            options="qrlsuite.plugins.algorithms.ppo:PPOOptions",
            factory="qrlsuite.plugins.algorithms.ppo:PPO",
            actions=("discrete", "box", "multi-discrete", "multi-binary"),
            unusable="qrlsuite.plugins.algorithms:unusable_ppo",
            numerics=2,
        )
    )
    register(
        AlgorithmSpec(
            name="reinforce",
            summary="REINFORCE, the vanilla policy gradient, with or without a baseline",
            options="qrlsuite.plugins.algorithms.reinforce:REINFORCEOptions",
            factory="qrlsuite.plugins.algorithms.reinforce:Reinforce",
            unusable="qrlsuite.plugins.algorithms:unusable_reinforce",
            numerics=2,
        )
    )
    register(
        AlgorithmSpec(
            name="sac",
            summary="Soft actor-critic with a learned temperature, for continuous or discrete actions",
            options="qrlsuite.plugins.algorithms.sac:SACOptions",
            factory="qrlsuite.plugins.algorithms.sac:SAC",
            actions=("box", "discrete"),
            unusable="qrlsuite.plugins.algorithms:unusable_warm_up",
        )
    )
    register(
        AlgorithmSpec(
            name="td3",
            summary="Twin delayed deterministic policy gradient, for continuous actions",
            options="qrlsuite.plugins.algorithms.td3:TD3Options",
            factory="qrlsuite.plugins.algorithms.td3:TD3",
            actions=("box",),
            unusable="qrlsuite.plugins.algorithms:unusable_warm_up",
        )
    )


def _copies(target_steps: int, steps: int) -> list[str]:
    """Say that a target network is copied fewer than 5 times in a run of so many gradient steps.

    >>> _copies(2000, 2400)
    ['target_steps=2000 copies the target network once in 2400 gradient steps, first after 83% of the run']
    """
    copies = steps // target_steps
    if copies >= 5:
        return []
    if not copies:
        return [f"target_steps={target_steps} never copies the target network in {steps} gradient steps"]
    times = "once" if copies == 1 else f"{copies} times"
    first = f"first after {target_steps / steps:.0%} of the run"
    return [
        f"target_steps={target_steps} copies the target network {times} in {steps} gradient steps, {first}"
    ]


def unusable_ddqn(own: Mapping[str, Any], epochs: int, rounds: int, environments: int) -> list[str]:
    """Name a target network that is rarely copied, and exploration longer than half of the run."""
    steps = epochs * rounds
    return [
        *_copies(own["target_steps"], steps),
        *_beyond("epsilon_steps", own.get("epsilon_steps") or 0, steps * environments // 2, HALF),
        *_stops(own.get("decay_steps"), steps * environments),
    ]


def unusable_drqn(own: Mapping[str, Any], epochs: int, rounds: int, environments: int) -> list[str]:
    """Name a target network that is rarely copied, and sequences longer than the run."""
    steps, sequence = epochs * rounds, own["burn_in"] + own["length"]
    return [
        *_copies(own["target_steps"], steps * own["updates"]),
        *_beyond("burn_in + length", sequence, steps, "steps of an environment"),
    ]


def unusable_ppo(own: Mapping[str, Any], epochs: int, rounds: int, environments: int) -> list[str]:
    """Name a minibatch that an epoch does not fill, and learning that stops early."""
    samples = rounds * environments
    return [
        *_beyond("batch", own["batch"], samples, "samples of an epoch"),
        *_stops(own.get("decay_steps"), epochs * samples),
    ]


def unusable_reinforce(own: Mapping[str, Any], epochs: int, rounds: int, environments: int) -> list[str]:
    """Name episodes of which no update sees all steps: longer than an epoch with `memory`, or between two updates."""
    updates, episode = own.get("epochs_per_update", 1), own["episode"]
    option, most = f"memory={own['memory']}", own["memory"] + rounds
    if updates > 1:
        option, most = f"epochs_per_update={updates}", updates * rounds
    enough = episode is None or episode <= most
    return [] if enough else [f"{option} is too small for episodes of {episode} steps: an update sees {most}"]


def unusable_warm_up(own: Mapping[str, Any], epochs: int, rounds: int, environments: int) -> list[str]:
    """Name a warm-up longer than half of the run, and learning that stops early."""
    run = epochs * rounds * environments
    return [*_beyond("warm_up", own["warm_up"], run // 2, HALF), *_stops(own.get("decay_steps"), run)]


HALF = "transitions, half of the run"


def _stops(decay_steps: int | None, run: int) -> list[str]:
    """Say that learning rates are 0 for a second half of a run of so many interactions, or for more.

    >>> _stops(400, 1000), _stops(501, 1000)
    (['decay_steps=400 stops learning after 40% of the run'], [])
    """
    if decay_steps is None or decay_steps > run // 2:
        return []
    return [f"decay_steps={decay_steps} stops learning after {decay_steps / run:.0%} of the run"]


def _beyond(option: str, value: int, most: int, unit: str) -> list[str]:
    """Say that an option exceeds what a run has: `batch=64 exceeds 20 samples of an epoch`."""
    return [f"{option}={value} exceeds {most} {unit}"] if value > most else []
