"""Asks a plugin's code, before its first epoch, whether its seeds are seeds; `qrlsuite check` has the same rules.

A verdict counts seeds as independent. So seeds must not begin with the same weights, and their lanes must not meet the
same random numbers: models and environments draw from the streams that they are given.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from qrlsuite import actions, registry, specs
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import PluginError
from qrlsuite.training.fences import moved, seeded, states

SECONDS = 10.0
"""Of processor time, after which an environment is asked no further."""
STEPS = 300
"""In which lanes with equal streams are compared, and rare draws are waited for."""
SEEDS, CHANGES = 8, 20
"""Seeds that begin with equal weights, and changes between episodes that two lanes share, until chance is ruled out.

Lanes that draw independently share so many with a probability below 1e-7, however few different episodes there are.
"""

STREAMS = (
    "draw from self.np_random in a gymnasium.Env, from self.streams in lanes, and from nothing global; set all state "
    "in reset()"
)
Make = Callable[[Sequence[int]], LaneEnv]
"""Builds lanes of some seeds, the same number for each, with the streams of these seeds."""


def _placed(spec: specs.Spec) -> str:
    """Return a thing's name in messages with the file and line that registered it."""
    place = getattr(registry.load().of(type(spec)).get(spec.name), "place", "")
    return f"{spec.title} ({place})" if place else spec.title


def require_own_weights(build: Callable[[int], nn.Module], spec: specs.ModelSpec) -> None:
    """Refuse a parameter with which all seeds begin alike, unless its elements are all equal or the spec names it.

    Parameters
    ----------
    build:
        Builds the module of a seed, counted from 0.
    """
    alike = {
        name: value
        for name, value in build(0).named_parameters()
        if name not in spec.shared and bool((value != value.flatten()[:1]).any())
    }
    for seed in range(1, SEEDS):
        other = dict(build(seed).named_parameters())
        alike = {name: value for name, value in alike.items() if value.equal(other.get(name, value))}
        if not alike:
            return
    name = next(iter(alike))
    raise PluginError(
        f"{_placed(spec)}: all seeds begin with the same '{name}', so that they count as one: draw it from the "
        "`generator` that is handed in, or from torch's default one as layers of torch.nn do, and set no seed "
        "(torch.manual_seed, a generator of its own). If it is meant to be the same, write "
        f"shared = ('{name}',) in the ModelSpec, or in the class of a file; boards then say so"
    )


def require_no_global_draw(module: nn.Module, inputs: Tensor, spec: specs.ModelSpec) -> None:
    """Refuse a pass that draws from a global generator."""
    with seeded(0), torch.no_grad():
        before = states()
        with contextlib.suppress(Exception):  # its own error, which training will meet and report
            module(inputs)
        names = moved(before)
    if names:
        raise PluginError(
            f"{_placed(spec)}: a pass moves {' and '.join(names)}, which all seeds of a process share, so that no seed "
            "would be what it is alone: draw in `build`; leave out layers that draw, such as Dropout"
        )


class _Lanes:
    """Lanes of two seeds whose t-th action in an episode is the same in every lane and every episode.

    Parameters
    ----------
    state:
        Decides the states of the global generators.
    """

    def __init__(self, make: Make, state: int) -> None:
        self.state = state
        with seeded(state):
            self.envs = make([0, 1])
            seen = self.envs.reset()[0]
        self.steps = np.zeros(self.envs.num_envs, np.int64)
        self.actions: list[Any] = []
        self.source = np.random.Generator(np.random.Philox(key=77))
        self.running = [hashlib.sha256(row.tobytes()) for row in seen]
        self.episodes: list[list[bytes]] = [[] for _ in self.running]

    def step(self) -> None:
        if self.steps.max() == len(self.actions):
            self.actions.append(actions.draw(self.envs.single_action_space, self.source, 1)[0])
        with seeded(self.state):
            seen, rewards, terminated, truncated, infos = self.envs.step(
                np.stack([self.actions[step] for step in self.steps])
            )
        done = terminated | truncated
        score = np.broadcast_to(infos.get("final_info", {}).get("score", 0.0), done.shape)
        last = infos.get("final_obs", seen)
        for lane, ended in enumerate(done):
            shown = (rewards[lane], terminated[lane], truncated[lane], last[lane] if ended else seen[lane])
            for value in (*shown, score[lane]) if ended else shown:
                self.running[lane].update(np.asarray(value).tobytes())
            if ended:
                self.episodes[lane].append(self.running[lane].digest())
                self.running[lane] = hashlib.sha256(seen[lane].tobytes())
        self.steps = np.where(done, 0, self.steps + 1)

    def shown(self) -> list[tuple[bytes, ...]]:
        return [(*ended, now.digest()) for ended, now in zip(self.episodes, self.running)]

    def changes(self, lane: int) -> int:
        """Count a lane's episodes that differ from the one before."""
        return sum(first != second for first, second in itertools.pairwise(self.episodes[lane]))


def require_reproducible(make: Make, spec: specs.EnvironmentSpec) -> None:
    """Refuse lanes that show something else in other lanes of the same streams, which are built after them."""
    first, second = _Lanes(make, 0), _Lanes(make, 1)
    began = time.process_time()
    for _ in range(STEPS):
        if time.process_time() - began > SECONDS / 10:
            break
        first.step()
        second.step()
    if first.shown() != second.shown():
        raise PluginError(
            f"{_placed(spec)}: the same streams and actions give other observations, rewards or ends: {STREAMS}"
        )


def drawn(make: Make, spec: specs.EnvironmentSpec) -> Literal["drawn", "alike", "unknown"]:
    """Refuse an environment whose episodes differ from one to the next, but not between lanes or seeds.

    Returns
    -------
    str
        Whether lanes draw episodes of their own, or all episodes are alike; "unknown" after `SECONDS`.
    """
    lanes, began = _Lanes(make, 0), time.process_time()
    for taken in itertools.count():
        shown = lanes.shown()
        alike = [lane for lane, own in enumerate(shown) if shown.count(own) > 1]
        if not alike:
            return "drawn"
        changes = [lanes.changes(lane) for lane in alike]
        if max(changes) >= CHANGES:
            break
        if taken >= STEPS and max(changes) == 0 and all(len(lanes.episodes[lane]) > 1 for lane in alike):
            return "alike"
        if time.process_time() - began > SECONDS:
            return "unknown"
        lanes.step()
    whose = "seeds" if shown[0] == shown[len(shown) // 2] else "lanes of a seed"
    raise PluginError(
        f"{_placed(spec)}: its episodes differ, and several {whose} meet the same ones, so that they count as one (a "
        f"generator made in __init__, say): {STREAMS}. If it is a fixed cycle of levels, write repeats = True in the "
        "EnvironmentSpec, or in the class of a file; boards then say so"
    )
