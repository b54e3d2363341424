"""A trained agent as a policy for loops that are not the suite's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.api.evaluation import find_players
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.experiment.entry import Entry
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.training import evaluation
from qrlsuite.training.trainer import Trainer, build_envs


@dataclass(frozen=True, eq=False)
class TrainedAgent:
    """One trained agent of an entry.

    Attributes
    ----------
    policy:
        The entry's label.
    task:
        The name of the task that it plays.
    seed:
        Its seed.
    runs:
        Number of finished runs; this one has the best last validation score. 1 if its seed was given.
    entry, trainer:
        The entry, on the task that it plays, and the population of this agent alone.
    """

    policy: str
    task: str
    seed: int
    runs: int
    entry: Entry = field(repr=False)
    trainer: Trainer = field(repr=False)

    def environments(self, count: int = 1) -> LaneEnv:
        """Return the task's environment, `count` times side by side: a `gymnasium.vector.VectorEnv`."""
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise OptionError(f"count = {count!r}: give a whole number, 1 or more")
        return build_envs(self.entry, count, lambda: None).inner

    def act(
        self,
        observations: NDArray[Any],
        begins: NDArray[np.bool_] | None = None,
        infos: Mapping[str, Any] | None = None,
    ) -> NDArray[Any]:
        """Return the actions of validation (B, ...) for observations (B, obs), as `environments` gives them.

        Parameters
        ----------
        begins:
            Where an episode begins with the observation (B,): everywhere after a reset, then `terminated | truncated`.
            Only an agent that remembers needs it.
        infos:
            The environments' infos on it. Only a task with masks needs them: `infos["action_mask"]` (B, choices).

        Raises
        ------
        OptionError
            If an argument has another shape or values that are not finite, or is needed and absent.
        """
        seen = self._seen(observations)
        wanted = None if self._choices is None else (len(seen), self._choices)
        if wanted is not None and np.shape((infos or {}).get("action_mask", ())) != wanted:
            raise OptionError(
                f"task '{self.task}' has action masks: give act() the infos of the environments, whose "
                f"'action_mask' has the shape {wanted} here"
            )
        try:
            return self.trainer.act(seen, None if begins is None else _begins(begins, len(seen)), infos)
        except ValueError as error:
            raise OptionError(str(error)) from None

    @cached_property
    def _choices(self) -> int | None:
        """How many choices the task's masks have; None where it has none."""
        _, infos = self.environments().reset(seed=0)
        return len(infos["action_mask"][0]) if "action_mask" in infos else None

    def _seen(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        envs = self.trainer.envs
        size = int(np.prod(envs.single_observation_space.shape or (1,)))
        whole = getattr(envs.unflattened_space, "shape", None)
        said = f"task '{self.task}' has {size} numbers each, so give (B, {size}); one alone is (1, {size})"
        try:
            given = np.asarray(observations)
        except (TypeError, ValueError, RuntimeError):  # ragged rows, or a tensor that needs its gradient
            given = np.empty(0, object)
        if given.dtype.kind not in "biuf":
            raise OptionError(
                f"observations of type {type(observations).__name__} are no array of real numbers: {said}"
            )
        with np.errstate(over="ignore"):
            seen = given.astype(np.float32)
        if seen.ndim == 0 or len(seen) == 0 or seen.shape[1:] not in ((size,), whole):
            raise OptionError(f"observations of shape {seen.shape}: {said}")
        if not np.isfinite(seen).all():
            raise OptionError("observations must be finite numbers")
        return seen


def _begins(given: Any, lanes: int) -> NDArray[np.bool_]:
    begins = np.asarray(given)
    if begins.shape != (lanes,) or begins.dtype.kind not in "biuf" or not np.isin(begins, (0, 1)).all():
        raise OptionError(f"begins: give {lanes} truth values, one for each observation")
    return begins.astype(np.bool_)


def load(written: Selection, entry: str, seed: int | None = None) -> TrainedAgent:
    """Return a trained agent of an entry: see `qrlsuite.api.agent`."""
    on, [store] = find_players(written, [entry])
    played = evaluation.trained_entry(store, on)
    [chosen], count = ([seed], 1) if seed is not None else evaluation.best_runs(store, 1)[::2]
    if chosen not in store.seeds():
        raise StoreError(f"{store.path} has no seed {chosen}")
    trainer = evaluation.trained_agents(played, store, [chosen])
    name = evaluation.policy_name(store, on)
    return TrainedAgent(name, played.task.name, chosen, count, played, trainer)
