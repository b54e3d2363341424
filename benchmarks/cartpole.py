"""Speed of CartPole in lanes, against looping over single environments, Gymnasium's vector form and generic lanes.

    python benchmarks/cartpole.py [--repeats 5] [--steps 200] [--lanes 200 2000]

All play the same random actions with a random stream per 10 lanes and same-step autoreset where they have it.
Everything is measured in turn in one run and given as medians; trust the ratios more than the times.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from qrlsuite.environment import LaneEnv
from qrlsuite.gymlanes import GymLanes
from qrlsuite.plugins.environments.cartpole import CartPoleLanes, CartPoleOptions

GROUP = 10
Play = Callable[[NDArray[np.int64]], None]


def loop(count: int) -> Play:
    """Single environments in a Python loop, as `gymnasium.make` gives them."""
    envs = [gymnasium.make("CartPole-v1") for _ in range(count)]
    for lane, env in enumerate(envs):
        env.reset(seed=lane)

    def play(actions: NDArray[np.int64]) -> None:
        for row in actions:
            for env, action in zip(envs, row):
                _, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    env.reset()

    return play


def vector(env: gymnasium.vector.VectorEnv) -> Play:
    """A vector environment."""
    if isinstance(env, LaneEnv):
        env.seed_lanes([np.random.default_rng(g) for g in range(env.num_envs // GROUP)])
        env.reset()
    else:
        env.reset(seed=0)

    def play(actions: NDArray[np.int64]) -> None:
        for row in actions:
            env.step(row)

    return play


def sync(count: int) -> Play:
    """Gymnasium's vector environment over single environments."""
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    make = [lambda: gymnasium.make("CartPole-v1") for _ in range(count)]
    return vector(gymnasium.vector.SyncVectorEnv(make, autoreset_mode=mode))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--lanes", type=int, nargs="+", default=[200, 2000])
    arguments = parser.parse_args()
    kinds: dict[str, Callable[[int], Play]] = {
        "loop over single envs": loop,
        "SyncVectorEnv": sync,
        "generic lanes": lambda count: vector(GymLanes("CartPole-v1", count)),
        "Gymnasium's own vector": lambda count: vector(
            gymnasium.make_vec("CartPole-v1", count, vectorization_mode="vector_entry_point")
        ),
        "CartPole in lanes": lambda count: vector(CartPoleLanes(CartPoleOptions(), count)),
        "the same, arctan": lambda count: vector(
            CartPoleLanes(CartPoleOptions(normalization="arctan"), count)
        ),
    }
    print(f"{'':24}{'lanes':>8}{'us/round':>12}{'ns/step':>10}{'steps/s':>14}{'ratio':>8}")
    for count in arguments.lanes:
        plays = {name: kind(count) for name, kind in kinds.items()}
        actions = np.random.default_rng(0).integers(0, 2, (arguments.steps, count))
        times: dict[str, list[float]] = {name: [] for name in plays}
        for _ in range(arguments.repeats):
            for name, play in plays.items():
                start = time.perf_counter()
                play(actions)
                times[name].append((time.perf_counter() - start) / arguments.steps)
        slow = statistics.median(times["loop over single envs"])
        for name, values in times.items():
            took = statistics.median(values)
            print(
                f"{name:24}{count:8}{took * 1e6:12.1f}{took / count * 1e9:10.0f}{count / took:14,.0f}{slow / took:8.1f}"
            )


if __name__ == "__main__":
    main()
