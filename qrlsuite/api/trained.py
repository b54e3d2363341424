"""A trained agent as a policy for loops that are not the suite's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.api.evaluation import find, the_task
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.experiment.entry import Entry
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
        Finished runs, of which it has the best last validation score; 1 where its seed was given.
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
            Where an episode begins with the observation, (B,); only an agent that remembers needs it.
        infos:
            What the environments said of it; only an agent of a task with masks needs it.

        Raises
        ------
        OptionError
            If observations have another size, or an agent that remembers is not told where episodes begin.
        """
        size = int(np.prod(self.trainer.envs.single_observation_space.shape or (1,)))
        seen = np.asarray(observations, np.float32)
        if seen.ndim < 1 or not len(seen) or seen.size != len(seen) * size:
            raise OptionError(
                f"observations of shape {np.shape(observations)}: task '{self.task}' has {size} numbers each, so give "
                f"(B, {size}); one alone is (1, {size})"
            )
        try:
            return self.trainer.act(seen, begins, infos)
        except ValueError as error:
            raise OptionError(str(error)) from None


def load(
    runs: Path, entry: str, task: str | None = None, seed: int | None = None, published: bool = False
) -> TrainedAgent:
    """Return a trained agent of an entry: see `qrlsuite.api.agent`."""
    on = None if task is None else the_task(runs, task, published)
    store = find(runs, entry, None if on is None else on.name, published)
    played = evaluation.trained_entry(store, on)
    [chosen], count = ([seed], 1) if seed is not None else evaluation.best_runs(store, 1)[::2]
    if chosen not in store.seeds():
        raise StoreError(f"{store.path} has no seed {chosen}")
    trainer = evaluation.trained_agents(played, store, [chosen])
    name = evaluation.policy_name(store, on)
    return TrainedAgent(name, played.task.name, chosen, count, played, trainer)
