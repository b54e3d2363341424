"""Counts rounds, for the progress display, and returns and scores of finished episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium.error import InvalidAction
from numpy.typing import NDArray

from qrlsuite import own, specs
from qrlsuite.actions import choices
from qrlsuite.environment import LaneEnv, State, batched_spaces
from qrlsuite.errors import EnvironmentFailure, PluginError, nearest
from qrlsuite.experiment.task import ScoreSection


class MeteredEnv(LaneEnv):
    """Wraps a LaneEnv: passes everything through, and counts episodes, returns and scores.

    Attributes
    ----------
    returns:
        Undiscounted return of every lane's unfinished episode (num_envs,).
    observe:
        Called with the observations (num_envs, ...) that every step returns, unless None.
    measured:
        By name, of every metric that an episode's end had since `take_metrics` was last called: lanes and values.
    finished:
        (lane, return, score) of every episode that ended since `take_finished` was last called.
    """

    def __init__(
        self,
        inner: LaneEnv,
        name: str,
        score: ScoreSection,
        tick: Callable[[], None],
    ) -> None:
        self.inner = inner
        self.environment_name = name
        self.score = score
        self.tick = tick
        batched_spaces(self, inner.single_observation_space, inner.single_action_space, inner.num_envs)
        self.unflattened_space = inner.unflattened_space
        self._choices = choices(inner.single_action_space)
        self.returns = np.zeros(inner.num_envs)
        self.observe: Callable[[NDArray[np.float32]], None] | None = None
        self.measured: dict[str, list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = {}
        self.finished: list[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset every lane."""
        self.returns[:] = 0.0
        try:
            observations, infos = self.inner.reset(seed=seed, options=options)
        except PluginError:
            raise
        except Exception as error:
            raise self._failure(error) from error
        self._require_choice(infos)
        return observations, infos

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every lane."""
        try:
            observations, rewards, terminated, truncated, infos = self.inner.step(actions)
            if self.observe is not None:
                self.observe(observations)
        except InvalidAction as error:
            raise PluginError(
                f"environment '{self.environment_name}' got an action outside its action space: {error}"
            ) from error
        except PluginError:
            raise
        except Exception as error:
            raise self._failure(error) from error
        self.returns += rewards
        if not np.isfinite(self.returns).all():
            worst = float(rewards[~np.isfinite(self.returns)][0])
            raise EnvironmentFailure(
                f"environment '{self.environment_name}' gave a reward of {worst:g}: rewards must be finite numbers"
            )
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            self.finished.append((ended, self.returns[ended].copy(), self._scores(ended, infos)))
            self.returns[ended] = 0.0
            self._measure(ended, infos)
        self._require_choice(infos)
        if "action_mask" in infos and truncated.any() and "action_mask" not in infos.get("final_info", {}):
            raise EnvironmentFailure(
                f"environment '{self.environment_name}': a time limit ended an episode, and infos['final_info'] lacks "
                "'action_mask', what could be chosen then"
            )
        self.tick()
        return observations, rewards, terminated, truncated, infos

    def _require_choice(self, infos: Mapping[str, Any]) -> None:
        """Refuse masks of another shape, and one that leaves nothing to choose."""
        if "action_mask" not in infos or not self._choices:
            return
        given = np.asarray(infos["action_mask"])
        what = f"environment '{self.environment_name}': info['action_mask']"
        if given.shape != (self.num_envs, sum(self._choices)):
            raise EnvironmentFailure(
                f"{what} has {given[0].size} numbers, and there are {sum(self._choices)} choices: give one for each, "
                "1 where it can be chosen"
            )
        starts = np.cumsum([0, *self._choices[:-1]])
        if not np.logical_or.reduceat(given != 0, starts, axis=1).all():
            raise EnvironmentFailure(
                f"{what} leaves no action, and the episode goes on: end it there (terminated), or allow an action"
            )

    def _scores(self, ended: NDArray[np.int64], infos: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the scores of the episodes that have just ended in the lanes `ended`."""
        if self.score.source == "return":
            return self.returns[ended] / (self.score.max_return if self.score.max_return is not None else 1.0)
        if self.score.metric is not None:
            return self._metric(self.score.metric, ended, infos)
        score = infos.get("final_info", {}).get("score")
        if score is None:
            raise EnvironmentFailure(
                f"environment '{self.environment_name}' gave no info['score'] at the end of an episode: "
                "set [score] source = 'return' and max_return in the task file"
            )
        scores = np.asarray(score, np.float64)[ended]
        if not (np.isfinite(scores).all() and (scores >= 0).all() and (scores <= 1 + 1e-9).all()):
            raise EnvironmentFailure(
                f"environment '{self.environment_name}' gave a score outside [0, 1]: {scores[:5].tolist()}"
            )
        return scores

    def _metric(self, name: str, ended: NDArray[np.int64], infos: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the metric that is ranked, of the episodes that have just ended in the lanes `ended`."""
        measured = infos.get("final_info", {}).get("metrics", {})
        if name not in measured:
            others = nearest(name, [ascii(other)[1:-1] for other in measured]) if measured else ""
            raise EnvironmentFailure(
                f"environment '{self.environment_name}' gave no info['metrics']['{name}'] at the end of an episode, "
                f"which the task ranks ([score] metric){others}"
            )
        values = np.asarray(measured[name], np.float64)[ended]
        if not np.isfinite(values).all():
            raise EnvironmentFailure(
                f"environment '{self.environment_name}' gave an episode info['metrics']['{name}'] = "
                f"{values[~np.isfinite(values)][0]:g}, which cannot be ranked: every episode needs a finite number"
            )
        return values

    def _measure(self, ended: NDArray[np.int64], infos: Mapping[str, Any]) -> None:
        """Keep the metrics of the episodes that have just ended in the lanes `ended`."""
        for name, values in infos.get("final_info", {}).get("metrics", {}).items():
            found = np.asarray(values, np.float64)[ended]
            known = ~np.isnan(found)
            if not specs.NAME.fullmatch(str(name)) or np.isinf(found).any():
                raise EnvironmentFailure(
                    f"environment '{self.environment_name}': info['metrics'] of an episode has {str(name)[:40]!r} "
                    f"= {found[0]:g}: names are like 'constraint-violations', and values finite"
                )
            self.measured.setdefault(str(name), []).append((ended[known], found[known]))

    def take_metrics(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Return, by name, lanes and values of the metrics of episodes that ended, and forget them."""
        measured, self.measured = self.measured, {}
        return {
            name: (np.concatenate([lanes for lanes, _ in parts]), np.concatenate([each for _, each in parts]))
            for name, parts in sorted(measured.items())
        }

    def take_finished(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return lanes, returns and scores of the episodes finished since the last call, and forget them."""
        finished, self.finished = self.finished, []
        if not finished:
            return np.empty(0, np.int64), np.empty(0), np.empty(0)
        lanes, returns, scores = (np.concatenate(parts) for parts in zip(*finished))
        return lanes, returns, scores

    def seed_lanes(self, streams: Any) -> None:
        """Replace the random streams."""
        self.inner.seed_lanes(streams)

    def state_dict(self) -> State:
        """Return the inner state and the unfinished episodes' returns, lane-first."""
        return {**self.inner.state_dict(), "metered.returns": self.returns}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a result of `state_dict`."""
        self.inner.load_state_dict({k: v for k, v in state.items() if k != "metered.returns"})
        self.returns = np.array(state["metered.returns"])

    def _failure(self, error: Exception) -> Exception:
        if isinstance(error, EnvironmentFailure):
            return error
        return EnvironmentFailure(
            f"environment '{self.environment_name}' failed: {own.failure(error)}; "
            "finished epochs are kept, and the same command tries again"
        )
