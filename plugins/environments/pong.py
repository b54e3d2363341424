"""Pong against an opponent that follows the ball: the environment `pong`, in lanes and as a `gymnasium.Env`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.environment import EpisodeLanes, LaneEnv, require_lanes
from qrlsuite.errors import StoreError
from qrlsuite.plugins.environments.single import Single

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

WIDTH, HEIGHT = 500.0, 640.0
"""The field, in pixels; x to the right, y upward."""
BALL, PADDLE, PADDLE_WIDTH = 32.0, 70.0, 20.0
"""Side of the ball and height of a paddle. Paddles stand behind the field's edges, so their width is only drawn."""
PADDLE_SPEED, BALL_SPEED, BALL_MOST, BALL_MORE = 8.0, 10.0, 13.0, 3.0
"""Pixels a frame: of paddles; of the ball to the side; upward at most; added upward by a moving paddle."""
LOWEST, HIGHEST = -PADDLE / 2, HEIGHT - PADDLE / 2
"""Between these is the lower end of a paddle."""
STEPS = np.array([0.0, 1.0, -1.0])
"""Movements of the actions: stay, up, down."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PongOptions:
    """Options of Pong."""

    points: Annotated[
        int, Field(ge=1, le=100, description="points that a side needs: the game, an episode, is over then")
    ] = 3
    serve: Annotated[
        float,
        Field(
            ge=0,
            le=BALL_MOST,
            description="the ball is served at most so steeply, pixels a frame; 0: 0 or 1 downward, as PufferLib does",
        ),
    ] = 4.0
    frames: Annotated[int, Field(ge=1, le=64, description="frames of a step, in which an action holds")] = 8
    steps: Annotated[int, Field(ge=1, le=100_000, description="time limit of an episode")] = 400


class Pong(Single):
    """Play Pong against an opponent that follows the ball.

    ## Description

    The agent's paddle is on the right, the opponent's on the left. The ball flies from side to side and is reflected
    above and below. A side that misses it loses a point, and the next ball is served from the left, with both paddles
    in the middle. The opponent follows the ball as fast as a paddle moves, 8 pixels a frame: it misses only a ball that
    is steeper. A ball becomes steeper, by 3 pixels a frame, when the agent's paddle moves as it hits.

    Rules and sizes are from PufferLib's Pong (`ocean/pong/pong.h`; in its settings, `frames` is 8 and `points` 21).
    Three things are ours: `serve`, because a game from two serves can be learned by heart; the time limit; and that the
    agent sees points and the new serve at once. There, points are divided as integers and seen as 0, and right after a
    point the observation is the one before it. The code is ours.

    ## Action Space

    `Discrete(3)`: 0 stays, 1 moves up, 2 moves down.

    ## Observation Space

    `Box(0, 1, (8,), float32)`: the heights of the opponent's and the agent's paddle, the ball's x and y, its speed to
    the right and upward, and the points of opponent and agent, each as part of its range.

    ## Rewards

    1 for a point, -1 for one lost, 0.1 for a ball that the agent hits and that brings no point in the same step.

    ## Episode End

    The episode is *terminated* when a side has `points`, and *truncated* after `steps` steps. `info["score"]` is then
    1/2 + (won - lost) / (2 `points`), in [0, 1].

    Arguments are the fields of `PongOptions`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(PongLanes, PongOptions, options, render_mode)

    def render(self) -> Any:
        """Return the field with the points of both sides as bars, (height, width, 3) uint8."""
        assert isinstance(self.lanes, PongLanes)
        return self.lanes.picture()


class PongLanes(EpisodeLanes):
    """Vector form of `Pong` with same-step autoreset; see there for spaces and rewards.

    An episode begins with a uniform number of the lane's stream for each serve of the longest game.

    Attributes
    ----------
    paddles:
        Lower ends of the opponent's and the agent's paddle, (L, 2).
    ball:
        The lower left corner, x and y, and the speeds in these directions, (L, 4).
    points:
        Of opponent and agent, (L, 2).
    """

    name = "pong"
    cut = True

    def __init__(self, options: PongOptions, num_envs: int) -> None:
        super().__init__(options, num_envs, Box(0.0, 1.0, (8,), np.float32), Discrete(3))
        self.paddles = np.zeros((num_envs, 2))
        self.ball = np.zeros((num_envs, 4))
        self.points = np.zeros((num_envs, 2), np.int64)
        self._serves = np.zeros((num_envs, 2 * options.points - 1))

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"paddles": self.paddles, "ball": self.ball, "points": self.points, "serves": self._serves}

    def _draw(self, stream: np.random.Generator, count: int) -> FloatArray:
        return stream.random((count, self._serves.shape[1]))

    def _begin(self, lanes: NDArray[np.intp], drawn: FloatArray) -> None:
        self._serves[lanes] = drawn
        self.points[lanes] = 0
        self._serve(lanes)

    def _serve(self, lanes: NDArray[np.intp]) -> None:
        """Put ball and paddles of `lanes` where a point begins."""
        played = np.minimum(self.points[lanes].sum(1), self._serves.shape[1] - 1)
        luck = self._serves[lanes, played]
        steepest = self.options.serve
        slope = steepest * (2.0 * luck - 1.0) if steepest else -np.floor(2.0 * luck)
        self.paddles[lanes] = HEIGHT / 2 - PADDLE / 2
        self.ball[lanes] = np.stack(
            np.broadcast_arrays(WIDTH / 5, HEIGHT / 2 - BALL / 2, BALL_SPEED, slope), axis=1
        )

    def _act(self, actions: NDArray[Any], running: BoolArray) -> tuple[FloatArray, BoolArray]:
        moves = STEPS[actions]
        rewards = np.zeros(self.num_envs)
        flying = running.copy()
        for _ in range(self.options.frames):
            hit, won, lost = self._frame(moves, flying)
            rewards = np.where(won, 1.0, np.where(lost, -1.0, np.where(hit, 0.1, rewards)))
            self.points[lost, 0] += 1
            self.points[won, 1] += 1
            self._serve(np.flatnonzero(won | lost))
            flying &= ~(won | lost)  # the rest of the step's frames is not played
        return rewards, (self.points >= self.options.points).any(1)

    def _frame(self, moves: FloatArray, flying: BoolArray) -> tuple[BoolArray, BoolArray, BoolArray]:
        """Play a frame in the lanes `flying`; return where the agent hit the ball, won or lost a point, (L,) each."""
        x, y, right, up = self.ball.T
        behind = y - (self.paddles[:, 0] + PADDLE / 2)
        follow = np.clip(behind, -PADDLE_SPEED, PADDLE_SPEED)
        wanted = self.paddles + np.stack([follow, PADDLE_SPEED * moves], axis=1) * flying[:, None]
        self.paddles[...] = wanted.clip(LOWEST, HIGHEST)
        x += right * flying
        y += up * flying
        up[flying & ((y < 0) | (y + BALL > HEIGHT))] *= -1.0
        met = (y + BALL > self.paddles.T) & (y < self.paddles.T + PADDLE)
        left, arrived = flying & (x < 0), flying & (x + BALL > WIDTH)
        hit = arrived & met[1]
        right[(left & met[0]) | hit] *= -1.0
        steeper = np.clip(up[hit] + BALL_MORE * moves[hit], -BALL_MOST, BALL_MOST)
        up[hit] = np.where(np.abs(steeper) < 0.01, BALL_MORE, steeper)  # no ball flies level for ever
        x[hit] = np.minimum(x[hit], WIDTH - BALL)
        y[hit] = np.clip(y[hit], 0.0, HEIGHT - BALL)
        return hit, left & ~met[0], arrived & ~met[1]

    def _seen(self) -> NDArray[np.float32]:
        paddles = (self.paddles - LOWEST) / (HIGHEST - LOWEST)
        speeds = (BALL_SPEED, BALL_MOST)
        ball = np.concatenate(
            [self.ball[:, :2] / (WIDTH, HEIGHT), (self.ball[:, 2:] / speeds + 1.0) / 2.0], axis=1
        )
        seen = np.concatenate([paddles, ball, self.points / self.options.points], axis=1)
        result: NDArray[np.float32] = seen.clip(0.0, 1.0).astype(np.float32)
        return result

    def _scores(self) -> FloatArray:
        lost, won = self.points.T
        scores: FloatArray = 0.5 + (won - lost) / (2.0 * self.options.points)
        return scores

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        """Refuse states that no game reaches."""
        most, ball = self.options.points, np.abs(state["ball"])
        points, paddles, serves = state["points"], state["paddles"], state["serves"]
        possible = (
            (ball <= (WIDTH, HEIGHT, BALL_SPEED, BALL_MOST)).all()
            and ((paddles >= LOWEST) & (paddles <= HIGHEST)).all()
            and ((points >= 0) & (points <= most)).all()
            and (points.sum(1) < 2 * most).all()
            and ((serves >= 0) & (serves < 1)).all()
        )
        if not possible:
            raise StoreError(f"pong: the state is none of a game to {most} points")
        return True

    def picture(self) -> NDArray[np.uint8]:
        """Return the first lane's field at half its size, (320, 270, 3); bars at its top are both sides' points."""
        edge = int(PADDLE_WIDTH)
        image = np.full((int(HEIGHT), int(WIDTH) + 2 * edge, 3), 235, np.uint8)
        image[:, :edge] = image[:, -edge:] = 200
        (other, own), (lost, won) = self.paddles[0], self.points[0].tolist()

        def block(x: float, y: float, width: float, height: float, color: tuple[int, int, int]) -> None:
            low, high = (round(float(np.clip(HEIGHT - at, 0, HEIGHT))) for at in (y, y + height))
            image[high:low, round(x) : round(x + width)] = color

        block(0, other, PADDLE_WIDTH, PADDLE, (213, 94, 0))
        block(WIDTH + edge, own, PADDLE_WIDTH, PADDLE, (0, 114, 178))
        block(edge + self.ball[0, 0], self.ball[0, 1], BALL, BALL, (40, 40, 40))
        for count, first, color in ((lost, edge, (213, 94, 0)), (won, WIDTH / 2 + edge, (0, 114, 178))):
            block(first, HEIGHT - 8, count * WIDTH / 2 / self.options.points, 8, color)
        return image[::2, ::2]


class Follower:
    """The reference policy that follows the ball, once a step: with 8 frames a step it loses most games."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, PongLanes)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return actions (L,)."""
        return self.toward(self.envs.ball[:, 1] - PADDLE / 2 + BALL / 2)

    def toward(self, wanted: FloatArray) -> NDArray[np.int64]:
        """Return the actions that bring the paddle's lower end near `wanted`, (L,)."""
        away = wanted - self.envs.paddles[:, 1]
        step = PADDLE_SPEED * self.envs.options.frames
        moves: NDArray[np.int64] = np.where(away > step / 2, 1, np.where(away < -step / 2, 2, 0))
        return moves


class SteepReturns(Follower):
    """The reference policy that hits in motion, so that the ball becomes too steep for the opponent.

    It knows where the ball will arrive. It waits half a step's way off, and moves in the ball's direction as it hits.
    """

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return actions (L,)."""
        x, y, right, up = self.envs.ball.T
        frames = np.ceil(np.maximum(WIDTH - BALL - x, 0.0) / BALL_SPEED)
        top = HEIGHT - BALL
        unfolded = y + up * frames
        folded = unfolded % (2 * top)
        at = np.where(folded > top, 2 * top - folded, folded)
        upward = np.where((unfolded // top) % 2 == 0, up, -up) >= 0
        along = np.where(upward, 1.0, -1.0)
        step = PADDLE_SPEED * self.envs.options.frames
        coming = right > 0
        center = at - PADDLE / 2 + BALL / 2
        waits = np.where(coming, center - along * step / 2, HEIGHT / 2 - PADDLE / 2)
        hits = coming & (frames <= self.envs.options.frames)
        moving = np.where(upward, 1, 2)
        actions: NDArray[np.int64] = np.where(hits, moving, self.toward(waits))
        return actions
