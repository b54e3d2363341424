"""Small environments of a third party, registered on import: `strangers:...-v0` in the tests of generic lanes."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from qrlsuite import actions as action_spaces

HERE = "tests.environments.strangers"


class Walk(gymnasium.Env[Any, Any]):
    """A random walk of random length.

    What it shows depends on `kind`, what it takes on `acts`; `start` shifts its actions. With `masked`, action 0 cannot
    be chosen at even steps, and with `masked = "all"` none ever. The steps are a metric of the name `measured`; late
    episodes have another.
    """

    def __init__(
        self,
        kind: str = "box",
        start: int = 0,
        scored: bool = True,
        acts: str = "discrete",
        masked: str = "",
        measured: str = "",
    ) -> None:
        self.kind = kind
        self.scored = scored
        self.masked, self.measured = masked, measured
        self.action_space: Any = {
            "discrete": spaces.Discrete(3, start=start),
            "multi-discrete": spaces.MultiDiscrete([3, 2], start=[start, 0]),
            "multi-binary": spaces.MultiBinary(3),
            "box": spaces.Box(np.array([[-1, 0]], np.float32), np.array([[1, 4]], np.float32)),
            "doubles": spaces.Box(-1, 1, (), np.float64),
            "unbounded": spaces.Box(-np.inf, 1, (2,)),
            "whole": spaces.Box(0, 9, (2,), np.int64),
            "several": spaces.Tuple([spaces.Discrete(2), spaces.Discrete(3)]),
        }[acts]
        self.observation_space: Any = {
            "box": spaces.Box(-10, 10, (2, 2), np.float64),
            "image": spaces.Box(0, 255, (2, 2), np.uint8),
            "discrete": spaces.Discrete(5, start=1),
            "binary": spaces.MultiBinary(3),
            "multi": spaces.MultiDiscrete([2, 3]),
            "dict": spaces.Dict(b=spaces.Discrete(2), a=spaces.Box(-1, 1, (2, 2))),
            "tuple": spaces.Tuple([spaces.Discrete(2), spaces.Box(-1, 1, (1,))]),
            "sequence": spaces.Sequence(spaces.Discrete(2)),
        }[kind]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.length = int(self.np_random.integers(3, 12))
        self.steps = 0
        self.position = float(self.np_random.normal())
        return self._observe(), self._info()

    def _info(self) -> dict[str, Any]:
        choices = sum(action_spaces.choices(self.action_space)) or 3
        mask = np.array([self.steps % 2, *[1] * (choices - 1)], np.int8) * (self.masked != "all")
        return {"action_mask": mask} if self.masked else {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action in self.action_space, action
        self.steps += 1
        self.position += float(self.np_random.normal()) + float(np.sum(action))
        ended = self.steps == self.length
        info: dict[str, Any] = {"score": self.steps / 12} if ended and self.scored else {}
        if ended and self.measured:
            info["metrics"] = {self.measured: self.steps, **({"late": 1.0} if self.steps > 8 else {})}
        return self._observe(), self.position, ended, False, {**info, **self._info()}

    def _observe(self) -> Any:
        return {
            "box": np.tanh([[self.position, self.steps], [1.0, 0.0]]),
            "image": np.full((2, 2), min(self.steps, 255), np.uint8),
            "discrete": 1 + self.steps % 5,
            "binary": np.array([self.steps & 1, self.steps >> 1 & 1, self.steps >> 2 & 1], np.int8),
            "multi": np.array([self.steps % 2, self.steps % 3]),
            "dict": {"b": 1, "a": np.full((2, 2), self.steps / 20, np.float32)},
            "tuple": (self.steps % 2, np.ones(1, np.float32)),
            "sequence": (),
        }[self.kind]


class Forgetful(Walk):
    """Has randomness of its own, that a seed does not reach."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.position += int.from_bytes(os.urandom(4)) / 2**32
        return super().step(action)


class Counted(Walk):
    """Gives 1 for every step."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, *rest = super().step(action)
        return observation, 1.0, *rest


class Even(Counted):
    """The same, for three steps."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        first = super().reset(seed=seed)
        self.length = 3
        return first


class Endless(Walk):
    """Never ends."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.length = -1
        return super().step(action)


class Broken(Walk):
    """Raises once, in the step after the 24th of one of its instances: whichever creates the file `marker`.seen."""

    def __init__(self, marker: str) -> None:
        super().__init__()
        self.marker = (
            f"{marker}.seen"  # not the option itself: files that options name are part of an entry's code
        )
        self.taken = 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken += 1
        if self.taken > 24 and not os.path.exists(self.marker):
            os.close(os.open(self.marker, os.O_CREAT | os.O_EXCL))
            raise ZeroDivisionError("the cart left the rails")
        return super().step(action)


class Unmade(Walk):
    """Needs a package that nobody has."""

    def __init__(self) -> None:
        import no_such_package.inner  # noqa: F401


for name, limit in [
    ("Walk", 20),
    ("Counted", 20),
    ("Even", 20),
    ("Forgetful", 20),
    ("Endless", None),
    ("Broken", 20),
    ("Unmade", 20),
]:
    gymnasium.register(f"{name}-v0", f"{HERE}:{name}", max_episode_steps=limit, disable_env_checker=True)
gymnasium.register("Cut-v0", f"{HERE}:Endless", max_episode_steps=4, disable_env_checker=True)
gymnasium.register("Unbounded-v0", f"{HERE}:Walk", kwargs={"acts": "unbounded"}, disable_env_checker=True)
