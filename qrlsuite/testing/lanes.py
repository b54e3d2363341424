"""Builds lanes of an environment as a run does, and plays given actions in them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import qrlsuite
from qrlsuite import specs
from qrlsuite.actions import draw
from qrlsuite.environment import LaneEnv
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import require

S, E = 5, 2
"""Seeds, and lanes of every seed."""
LONGEST = 10_000
"""Steps within which an episode must end."""

Seen = dict[str, NDArray[Any]]
"""Outputs of lanes, lane-first: `observations`, `rewards`, `terminated`, `truncated`, and `scores` (NaN for none)."""


class Lanes:
    """Builds lanes of the environment that is checked, as a run does."""

    def __init__(self, subject: Subject) -> None:
        spec = subject.spec
        assert isinstance(spec, specs.EnvironmentSpec)
        self.spec, self.options = spec, subject.options()

    def make(self, seeds: Sequence[int], autoreset: bool = True, shared: bool = False) -> LaneEnv:
        """Return two lanes for each seed, with streams of their own, or one that they share, as in validation."""
        lanes = len(seeds) * E
        if self.spec.vector is not None:
            envs: LaneEnv = specs.resolve(self.spec.vector)(self.options, lanes)
            require(
                isinstance(envs, LaneEnv),
                f"{self.spec.vector} returned {type(envs).__name__}, and must return a "
                "qrlsuite.environment.LaneEnv: is `return` there?",
            )
        else:
            from qrlsuite.gymlanes import GymLanes

            register(self.spec)
            envs = GymLanes(self.spec.gymnasium_id, lanes, dataclasses.asdict(self.options))
        require(
            envs.num_envs == lanes,
            f"asked for {lanes} lanes, num_envs is {envs.num_envs}: the second argument of {self.spec.vector} says how "
            "many",
        )
        envs.autoreset = autoreset
        keys = [1000 * s + e for s in seeds for e in range(1 if shared else E)]
        envs.seed_lanes([np.random.Generator(np.random.Philox(key=key)) for key in keys])
        return envs


def register(spec: specs.EnvironmentSpec) -> None:
    """Make the environment known to Gymnasium, as the suite does with registered ones."""
    qrlsuite.register_environments()
    if spec.entry_point is not None and spec.gymnasium_id not in gymnasium.registry:
        gymnasium.register(spec.gymnasium_id, entry_point=spec.entry_point)


def rows(seeds: Sequence[int]) -> list[int]:
    """Return the lanes of some seeds among the lanes of all."""
    return [s * E + e for s in seeds for e in range(E)]


def actions(seeds: Sequence[int], space: gymnasium.Space[Any], steps: int) -> NDArray[Any]:
    """Return every lane's actions (steps, 2 len(seeds), ...); a seed's actions do not depend on other seeds."""
    columns = [draw(space, np.random.Generator(np.random.Philox(key=77 + s)), steps, E) for s in seeds]
    return np.concatenate(columns, axis=1)


def play(envs: LaneEnv, actions: NDArray[Any], reset: bool = True) -> Seen:
    """Return everything that lanes show under actions (T, L, ...); observations have one more where they are reset."""
    names = ("observations", "rewards", "terminated", "truncated", "scores")
    seen: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    if reset:
        seen["observations"].append(np.array(envs.reset()[0]))
    for row in actions:
        *step, infos = envs.step(row)
        for values, value in zip(seen.values(), (*step, _scores(infos, envs.num_envs))):
            values.append(np.array(value))
    return {name: np.stack(values, axis=1) for name, values in seen.items()}


def _scores(infos: Mapping[str, Any], lanes: int) -> NDArray[np.float64]:
    """Return the scores of the episodes that end in a step (L,), NaN where none ends."""
    score = infos.get("final_info", {}).get("score")
    if score is None or np.shape(score) != (lanes,):  # the rule `score` looks at the form
        return np.full(lanes, np.nan)
    return np.where(infos["_final_obs"], score, np.nan)


def differs(a: Mapping[str, NDArray[Any]], b: Mapping[str, NDArray[Any]]) -> str | None:
    """Return the names that only one of them has, or the first that is not the same in both, or None."""
    if a.keys() != b.keys():
        return ", ".join(sorted(a.keys() ^ b.keys()))
    return next((k for k, v in a.items() if not np.array_equal(v, b[k], equal_nan=v.dtype.kind == "f")), None)


def first_episodes(seen: Seen) -> list[Seen]:
    """Return every lane's first episode, without the observation that follows its last step."""
    episodes = []
    for lane, ended in enumerate(seen["terminated"] | seen["truncated"]):
        length = int(np.argmax(ended)) + 1 if ended.any() else len(ended)
        episodes.append({name: value[lane, :length] for name, value in seen.items()})
    return episodes
