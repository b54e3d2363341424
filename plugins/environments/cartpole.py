"""CartPole-v1 for populations: all lanes in one computation, each lane the one that Gymnasium would give.

The equations are from Gymnasium's `CartPoleEnv` in the same order of operations, in float64, so states,
rewards and ends agree with it to the last bit, in every lane and whatever the number of lanes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, field_validator
from pydantic.dataclasses import dataclass

from qrlsuite import options as option_words
from qrlsuite.actions import check_actions
from qrlsuite.compiled.cache import rounded
from qrlsuite.environment import LaneEnv, State, batched_spaces, require_state
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.normalization import KIND, Kind, Normalization

GRAVITY = 9.8  # m/s^2
POLE_MASS = 0.1  # kg
TOTAL_MASS = POLE_MASS + 1.0  # kg, pole and cart
LENGTH = 0.5  # m, half the pole
POLE_MASS_LENGTH = POLE_MASS * LENGTH
FORCE = 10.0  # N
TAU = 0.02  # s between two steps
X_LIMIT = 2.4  # m
THETA_LIMIT = 12 * 2 * np.pi / 360  # rad
START = 0.05
"""The four values of a starting state are uniform in (-START, START)."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CartPoleOptions:
    """Options of CartPole."""

    steps: Annotated[
        int, Field(ge=1, le=100_000, description="time limit, at which an episode is truncated")
    ] = 500
    normalization: Annotated[Kind, Field(description=KIND)] = "none"
    bounds: Annotated[
        tuple[float, float, float, float],
        Field(
            description="what becomes 1 (its negative: -1) with normalization = 'bounds': position, velocity, angle, "
            "angular velocity"
        ),
    ] = (2.4, 2.5, 0.21, 2.5)

    @field_validator("bounds")
    @classmethod
    def _positive(cls, bounds: tuple[float, ...]) -> tuple[float, ...]:
        if not all(0 < bound < 1e30 for bound in bounds):
            raise ValueError("every bound must be a positive, finite number")
        return bounds


def _normalization(options: CartPoleOptions) -> Normalization:
    """Return the map from raw observations (..., 4) to observations by `options`."""
    high = np.array([2 * X_LIMIT, np.inf, 2 * THETA_LIMIT, np.inf], dtype=np.float32)
    low = high_given = None
    if options.normalization == "bounds":
        low, high_given = [-bound for bound in options.bounds], options.bounds
    return Normalization(options.normalization, Box(-high, high), low, high_given, "environment 'cartpole'")


class CartPole(CartPoleEnv):
    """Balance a pole on a cart: Gymnasium's CartPole-v1, with a choice of normalized observations.

    ## Description

    A pole is attached by an unactuated joint to a cart that moves along a frictionless track; the cart is
    pushed to the left or to the right at every step, and the pole shall not fall. Source: Barto, Sutton and
    Anderson, "Neuronlike Adaptive Elements That Can Solve Difficult Learning Control Problems" (1983). The
    dynamics are Gymnasium's, to the last bit; this class adds the time limit and the normalization.

    ## Action Space

    `Discrete(2)`: 0 pushes the cart to the left, 1 to the right, with 10 N.

    ## Observation Space

    `Box((4,), float32)`, without normalization:

    | Num | Observation           | Min    | Max   | Unit  |
    |-----|-----------------------|--------|-------|-------|
    | 0   | cart position         | -4.8   | 4.8   | m     |
    | 1   | cart velocity         | -Inf   | Inf   | m/s   |
    | 2   | pole angle            | -0.418 | 0.418 | rad   |
    | 3   | pole angular velocity | -Inf   | Inf   | rad/s |

    With `normalization = "arctan"` each value is replaced by its arcus tangens, in (-pi/2, pi/2), as in Skolik,
    Jerbi and Dunjko, "Quantum agents in the Gym" (2022). With `"bounds"` each is divided by its bound; the
    default bounds are from Jerbi et al., "Parametrized quantum policies for reinforcement learning" (2021).
    With `"running"`, in tasks only, the environment leaves them and each agent standardizes them by the mean and
    variance of its training observations (`qrlsuite.training.standardization`).

    ## Rewards

    1 for every step, the last one included: the best possible return is `steps`.

    ## Starting State

    All four values uniform in (-0.05, 0.05).

    ## Episode End

    The episode is *terminated* when the pole leans by more than 12 degrees or the cart leaves [-2.4, 2.4], and
    *truncated* after `steps` steps: an agent that learns from the following state's value must still use it.

    Arguments are the fields of `CartPoleOptions`; render modes "rgb_array" and "human" need pygame.
    """

    def __init__(
        self,
        steps: int = 500,
        normalization: Kind = "none",
        bounds: tuple[float, float, float, float] = (2.4, 2.5, 0.21, 2.5),
        render_mode: str | None = None,
    ) -> None:
        values = {"steps": steps, "normalization": normalization, "bounds": bounds}
        self.options = parse(values)
        if self.options.normalization == "running":
            raise OptionError(
                "environment 'cartpole': running statistics belong to an agent, which keeps them in a task; "
                "of a single environment, gymnasium.wrappers.NormalizeObservation keeps some"
            )
        super().__init__(render_mode=render_mode)
        self._normalize = _normalization(self.options)
        self.observation_space = self._normalize.space
        self._taken = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; `options` may hold `low` and `high` of the starting state, as Gymnasium's."""
        observation, info = super().reset(seed=seed, options=options)
        self._taken = 0
        return self._normalize(observation), info

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Push the cart."""
        observation, reward, terminated, _, info = super().step(action)  # type: ignore[no-untyped-call]
        self._taken += 1
        return self._normalize(observation), reward, terminated, self._taken >= self.options.steps, info


class CartPoleLanes(LaneEnv):
    """Vector form of `CartPole` with same-step autoreset; see there for spaces and rewards.

    A starting state is drawn from a lane's stream as Gymnasium draws it from an environment's generator, so a
    lane with a stream of its own plays the episodes of a single environment with that generator. Without
    autoreset, a lane whose episode has ended stays where it is: its steps return the last observation, reward
    0, and neither termination nor truncation.

    Parameters
    ----------
    options:
        Options of the environment, common to all lanes.
    num_envs:
        Number of lanes L, at least 1.

    Attributes
    ----------
    state:
        Position (m), velocity (m/s), angle (rad) and angular velocity (rad/s) of every lane, (4, L) float64.
    """

    def __init__(self, options: CartPoleOptions, num_envs: int) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.options = options
        self._normalize = _normalization(options)
        self.running_statistics = options.normalization == "running"
        batched_spaces(self, self._normalize.space, Discrete(2), num_envs)
        self.streams = []
        self.state = np.zeros((4, num_envs))
        self._step = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode in every lane; returns observations (L, 4) and an empty dictionary.

        `options={"state": (L, 4)}` gives the starting states instead of drawing them.
        """
        settings = dict(options or {})
        start = settings.pop("state", None)
        if settings:
            raise OptionError(
                f"environment 'cartpole': reset() takes the option 'state', not {sorted(settings)}"
            )
        if seed is not None or not self.streams:
            self.seed_from(seed)
        if start is None:
            self._begin(np.arange(self.num_envs))
        else:
            state = np.asarray(start, dtype=np.float64)
            if state.shape != (self.num_envs, 4):
                raise OptionError(
                    f"environment 'cartpole': 'state' has the shape {state.shape}, not {(self.num_envs, 4)}"
                )
            self.state = np.ascontiguousarray(state.T)
            self._step[:] = 0
            self._ended[:] = False
        self._begun = True
        return self._observations(), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Push the carts, `actions` (L,): 0 to the left, 1 to the right."""
        if not self._begun:
            raise ResetNeeded("call reset() before step()")
        actions = np.asarray(actions)
        check_actions(actions, self.num_envs, 2)
        rewards, (terminated, truncated) = np.zeros(self.num_envs), np.zeros((2, self.num_envs), np.bool_)
        cos, sin = np.cos(self.state[2]), np.sin(self.state[2])  # numpy's, whose bits numba's need not be
        push(
            self.state, cos, sin, actions.astype(np.int64), self._ended, self._step, self.options.steps,
            rewards, terminated, truncated,
        )  # fmt: skip
        infos: dict[str, Any] = {}
        done = terminated | truncated
        if done.any():
            infos = self._finish(done)
        return self._observations(), rewards, terminated, truncated, infos

    def state_dict(self) -> State:
        """Return the episodes' state, lane-first: `state` (L, 4), `step` (L,) and `ended` (L,)."""
        if not self._begun:
            raise ResetNeeded("call reset() before state_dict()")
        return {
            "state": np.ascontiguousarray(self.state.T),
            "step": self._step.copy(),
            "ended": self._ended.copy(),
        }

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue where `state_dict` was taken; states may be sliced and joined along the lanes."""
        shapes = {"state": (self.num_envs, 4), "step": (self.num_envs,), "ended": (self.num_envs,)}
        require_state("cartpole", state, shapes)
        if state["step"].min() < 0 or state["step"].max() > self.options.steps:
            raise StoreError(f"cartpole: 'step' must lie in 0..{self.options.steps}")
        self.state = np.array(state["state"].T, dtype=np.float64, order="C")
        self._step = np.array(state["step"], dtype=np.int64)
        self._ended = np.array(state["ended"], dtype=np.bool_)
        self._begun = True

    def _begin(self, lanes: NDArray[np.intp]) -> None:
        """Put `lanes` (ascending) at the beginning of new episodes."""
        per_stream = self.num_envs // len(self.streams)
        counts = np.bincount(lanes // per_stream, minlength=len(self.streams)).tolist()
        drawn = [
            stream.uniform(low=-START, high=START, size=(count, 4))
            for stream, count in zip(self.streams, counts)
            if count
        ]
        self.state[:, lanes] = np.concatenate(drawn).T
        self._step[lanes] = 0
        self._ended[lanes] = False

    def _finish(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        """Report the episodes that end and begin the next ones in their lanes."""
        infos = {
            "final_obs": np.where(done[:, None], self._observations(), np.float32(0.0)),
            "_final_obs": done.copy(),
            "final_info": {},
            "_final_info": done.copy(),
        }
        if self.autoreset:
            self._begin(np.flatnonzero(done))
        else:
            self._ended |= done
        return infos

    def _observations(self) -> NDArray[np.float32]:
        """Return the normalized observations (L, 4), a new array."""
        return self._normalize(self.state.T.astype(np.float32, order="C"))


@rounded
def push(
    state: Any, cos: Any, sin: Any, actions: Any, ended: Any, step: Any, steps: int,
    rewards: Any, terminated: Any, truncated: Any,
) -> None:  # fmt: skip
    """Push the carts of lanes that have not ended, `state` (4, L), in place; explicit Euler steps.

    Equations: Florian, "Correct equations for the dynamics of the cart-pole system" (2007), without friction.
    """
    for lane in range(state.shape[1]):
        if ended[lane]:
            continue
        x_dot, theta_dot, c, s = state[1, lane], state[3, lane], cos[lane], sin[lane]
        force = FORCE if actions[lane] == 1 else -FORCE
        temp = (force + POLE_MASS_LENGTH * (theta_dot * theta_dot) * s) / TOTAL_MASS
        theta_acc = (GRAVITY * s - c * temp) / (LENGTH * (4.0 / 3.0 - POLE_MASS * (c * c) / TOTAL_MASS))
        x_acc = temp - POLE_MASS_LENGTH * theta_acc * c / TOTAL_MASS
        state[0, lane] += TAU * x_dot
        state[2, lane] += TAU * theta_dot
        state[1, lane] = x_dot + TAU * x_acc
        state[3, lane] = theta_dot + TAU * theta_acc
        step[lane] += 1
        rewards[lane] = 1.0
        terminated[lane] = abs(state[0, lane]) > X_LIMIT or abs(state[2, lane]) > THETA_LIMIT
        truncated[lane] = step[lane] >= steps


def parse(values: Mapping[str, Any]) -> CartPoleOptions:
    """Return the options that `values` describe."""
    options: CartPoleOptions = option_words.build(CartPoleOptions, values, "environment 'cartpole'")
    return options
