"""Channel: find out by experiments which kind of error a qubit suffers, and name it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.environment import EpisodeLanes, LaneEnv, require_lanes
from qrlsuite.plugins.environments.quantum import pictures
from qrlsuite.plugins.environments.quantum.lanes import Drawn, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IntArray = NDArray[np.int64]
CHANNELS = ("bit flip", "bit-phase flip", "phase flip", "depolarizing", "amplitude damping")
INPUTS: dict[str, tuple[int, int, int]] = {"0": (0, 0, 1), "1": (0, 0, -1), "+": (1, 0, 0), "+i": (0, 1, 0)}
"""Input states and their Bloch vectors."""
EXPERIMENTS = [(state, basis) for state in INPUTS for basis in "XYZ"]
"""Input state and basis of measurement, in the order of the actions."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ChannelOptions:
    """Options of Channel."""

    strength: Annotated[
        float,
        Field(gt=0, le=1, description="probability p of the error, or damping, which the agent may learn"),
    ] = 0.4
    steps: Annotated[
        int, Field(ge=2, le=1000, description="steps of an episode: experiments, and naming the channel")
    ] = 20


def probabilities(strength: float) -> FloatArray:
    """Return the probability of the outcome +1 for each channel and experiment, (5, 12).

    A channel maps a Bloch vector r to T r + t. Flips by X, Y or Z happen with probability p and shrink the two other
    components by 1 - 2p. Depolarizing replaces the state by the mixed one with probability p, and shrinks all by 1 - p.
    Amplitude damping has the Kraus operators diag(1, sqrt(1 - p)) and sqrt(p) |0><1|.
    """
    p = strength
    flips = [np.full(3, 1 - 2 * p) for _ in range(3)]
    for axis, shrunk in enumerate(flips):  # X, Y, Z leave the axis of their own as it is
        shrunk[axis] = 1.0
    damped = np.array([np.sqrt(1 - p), np.sqrt(1 - p), 1 - p])
    shrinks = np.array([*flips, np.full(3, 1 - p), damped])
    moved = np.zeros((5, 3))
    moved[4, 2] = p
    vectors = np.array(list(INPUTS.values()))
    after = shrinks[:, None, :] * vectors + moved[:, None, :]
    result: FloatArray = ((1.0 + after) / 2.0).reshape(5, -1)
    return result


class Channel(Drawn):
    """Find out by experiments which error a qubit suffers.

    ## Description

    A qubit goes through one of five channels, each equally likely: with probability p a bit flip (X), a bit-phase flip
    (Y) or a phase flip (Z), a state that is replaced by the mixed one (depolarizing), or amplitude damping with gamma =
    p. An experiment prepares |0>, |1>, |+> or |+i>, sends it through the channel, and measures X, Y or Z. The agent
    chooses experiments one by one, and names the channel when it knows enough.

    ## Action Space

    `Discrete(17)`: experiments 0 to 11, (input, basis) = (0, X), (0, Y), (0, Z), (1, X), ..., (+i, Z); then the names:
    bit flip, bit-phase flip, phase flip, depolarizing, amplitude damping.

    ## Observation Space

    `Box(-1, 1, (25,), float32)`: for each experiment the mean outcome, 0 where it was not made, and how often it was
    made, divided by `steps`; then the part of the steps that is over. Nothing else that was seen says more.

    ## Rewards

    With p the probability of a channel by Bayes' rule, after all measurements: an experiment earns the rise of the
    highest p; a name earns its p less the highest, and an end without a name 0 less the highest. So a return is
    the probability that the name is right, less 1/5.

    ## Episode End

    The episode is *terminated* when a channel is named, and after `steps` steps. `info["score"]` is 1 where the name
    was right, else 0.

    Arguments are the fields of `ChannelOptions`.
    """

    lanes: ChannelLanes

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(ChannelLanes, ChannelOptions, options, render_mode)

    def moment(self) -> FloatArray:
        """Return the probability of each channel after all measurements, (5,)."""
        believed: FloatArray = self.lanes.believed[0].copy()
        return believed

    def figure(self) -> Figure:
        """Return a figure of the measurements, and the probability of each channel by them."""
        lanes = self.lanes
        named = int(lanes.named[0])
        return pictures.channel(
            lanes.counts[0], self.shown[-1], list(INPUTS), CHANNELS, int(lanes.kind[0]), named
        )


class ChannelLanes(EpisodeLanes):
    """Vector form of `Channel`; see there for spaces and rewards.

    An episode begins with uniform numbers of the lane's stream: one for the channel, and one for each outcome.

    Attributes
    ----------
    kind, named:
        The channel, and the one that was named, -1 where none was yet, (L,).
    counts:
        How often -1 and +1 were measured, (L, 12, 2).
    believed:
        How probable each channel is after that, by Bayes' rule, (L, 5).
    """

    name = "channel"

    def __init__(self, options: ChannelOptions, num_envs: int) -> None:
        observation = Box(-1.0, 1.0, (2 * len(EXPERIMENTS) + 1,), np.float32)
        super().__init__(options, num_envs, observation, Discrete(len(EXPERIMENTS) + len(CHANNELS)))
        self.plus = probabilities(options.strength)
        self.kind = np.zeros(num_envs, np.int64)
        self.named = np.full(num_envs, -1, np.int64)
        self.counts = np.zeros((num_envs, len(EXPERIMENTS), 2), np.int64)
        self.believed = np.full((num_envs, len(CHANNELS)), 1 / len(CHANNELS))
        self._luck = np.zeros((num_envs, options.steps))

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {
            "kind": self.kind,
            "named": self.named,
            "counts": self.counts,
            "believed": self.believed,
            "luck": self._luck,
        }

    def _draw(self, stream: np.random.Generator, count: int) -> FloatArray:
        return stream.random((count, 1 + self.options.steps))

    def _begin(self, lanes: NDArray[np.intp], drawn: FloatArray) -> None:
        self.kind[lanes] = (drawn[:, 0] * len(CHANNELS)).astype(np.int64)
        self._luck[lanes] = drawn[:, 1:]
        self.named[lanes], self.counts[lanes], self.believed[lanes] = -1, 0, 1 / len(CHANNELS)

    def _act(self, actions: NDArray[Any], running: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
        names = actions >= len(EXPERIMENTS)
        before = self.believed.max(1)
        tried = np.flatnonzero(running & ~names)
        plus = self.plus[:, actions[tried]].T
        luck = self._luck[tried, self.step_count[tried] - 1]
        outcome = luck < plus[np.arange(len(tried)), self.kind[tried]]
        self.counts[tried, actions[tried], outcome.astype(np.int64)] += 1
        likely = self.believed[tried] * np.where(outcome[:, None], plus, 1.0 - plus)
        self.believed[tried] = likely / likely.sum(1, keepdims=True)
        self.named[running & names] = actions[running & names] - len(EXPERIMENTS)
        named = np.where(self.named < 0, 0.0, self.believed[np.arange(self.num_envs), self.named])
        ends = names | (self.step_count >= self.options.steps)
        return np.where(ends, named, self.believed.max(1)) - before, names

    def _seen(self) -> NDArray[np.float32]:
        made = self.counts.sum(2)
        means = (self.counts[:, :, 1] - self.counts[:, :, 0]) / np.maximum(made, 1)
        pairs = np.stack([means, made / self.options.steps], axis=2).reshape(self.num_envs, -1)
        over = self.step_count / self.options.steps
        seen: NDArray[np.float32] = np.column_stack([pairs, over]).astype(np.float32)
        return seen

    def _scores(self) -> FloatArray:
        result: FloatArray = (self.named == self.kind).astype(np.float64)
        return result

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        kinds = range(len(CHANNELS))
        return bool(
            np.isin(state["kind"], kinds).all()
            and np.isin(state["named"], (-1, *kinds)).all()
            and state["counts"].min() >= 0
            and (state["counts"].sum((1, 2)) <= state["step"]).all()
            and np.allclose(state["believed"].sum(1), 1)
            and ((state["luck"] >= 0) & (state["luck"] < 1)).all()
        )


class Informative:
    """The reference policy that makes the experiment from which most is learned, and then names the likeliest channel.

    The information is the mutual information of outcome and channel, after all measurements: greedy, one step ahead.
    The name is the best one for this data; whether other experiments would be better still is unknown.
    """

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, ChannelLanes)

    def __call__(self, observations: NDArray[np.float32]) -> IntArray:
        """Return actions (L,)."""
        believed = self.envs.believed
        last = self.envs.step_count >= self.envs.options.steps - 1
        named = len(EXPERIMENTS) + believed.argmax(1)
        result: IntArray = np.where(last, named, self.experiments(believed)).astype(np.int64)
        return result

    def experiments(self, believed: FloatArray) -> IntArray:
        """Return an experiment for each lane, given how probable the channels are (L, 5)."""
        plus = self.envs.plus
        learned = _entropy(believed @ plus) - believed @ _entropy(plus)
        chosen: IntArray = learned.round(9).argmax(1)
        return chosen


class InTurn(Informative):
    """The reference policy that makes the experiments in turn, and at last names the most probable channel."""

    def experiments(self, believed: FloatArray) -> IntArray:
        """Return an experiment for each lane."""
        result: IntArray = self.envs.step_count % len(EXPERIMENTS)
        return result


def _entropy(plus: FloatArray) -> FloatArray:
    """Return the entropy, in nats, of outcomes that are +1 with these probabilities."""
    p = np.stack([plus, 1.0 - plus])
    result: FloatArray = -(p * np.log(np.maximum(p, 1e-300))).sum(0)
    return result
