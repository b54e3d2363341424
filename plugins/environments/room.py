"""A walled room with a goal, seen as an image: the environment `room`, in lanes and as a `gymnasium.Env`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from qrlsuite.environment import EpisodeLanes, LaneEnv, require_lanes
from qrlsuite.errors import StoreError
from qrlsuite.plugins.environments.single import Single

FORWARD = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
"""(x, y) of a step in each direction, clockwise: to the right, down, left, up."""
LEFT, RIGHT, AHEAD = range(3)
"""The actions."""
View = Literal["own", "whole"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RoomOptions:
    """Options of the room."""

    size: Annotated[int, Field(ge=4, le=64, description="side of the room in cells, its walls included")] = 8
    view: Annotated[
        View,
        Field(
            description="own: the cells in front of the agent, as it is turned; whole: the room from above"
        ),
    ] = "own"
    sight: Annotated[
        int, Field(ge=3, le=63, description="own: side of the square that is seen, an odd number of cells")
    ] = 5
    steps: Annotated[int, Field(ge=1, le=100_000, description="time limit of an episode")] = 100

    @model_validator(mode="after")
    def _odd(self) -> RoomOptions:
        if self.sight % 2 == 0:
            raise ValueError(f"sight = {self.sight}: write an odd number, for the agent stands in the middle")
        return self


class Room(Single):
    """Find the goal in a walled room, by turning and walking, as MiniGrid's empty room.

    ## Description

    Agent and goal stand on different cells of a square room, everywhere equally likely, and the agent is turned in any
    of four directions. It sees an image. Its own view (`view = "own"`) is a part of the room: if the goal is not in
    sight, it has to look around. Source of the idea: Chevalier-Boisvert et al., "Minigrid & Miniworld"
    (2023), `MiniGrid-Empty-Random`; code and sizes are ours.

    ## Action Space

    `Discrete(3)`: 0 turns to the left, 1 to the right, 2 walks one cell ahead. A wall stops the agent.

    ## Observation Space

    `Box(0, 1, (channels, height, width), float32)`, 1 where something is, 0 elsewhere.

    | view    | channels                                                       | height, width    |
    |---------|----------------------------------------------------------------|------------------|
    | `own`   | wall, goal; the agent is in the middle of the last row, looking up | `sight`, `sight` |
    | `whole` | wall, goal, and the agent by its direction: right, down, left, up  | `size`, `size`   |

    ## Rewards

    1 - 0.9 t / `steps` for the goal after t steps, else 0.

    ## Episode End

    The episode is *terminated* at the goal and *truncated* after `steps` steps. `info["score"]` is then the return over
    the shortest way's return, in [0, 1].

    Arguments are the fields of `RoomOptions`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(RoomLanes, RoomOptions, options, render_mode)

    def render(self) -> Any:
        """Return the room from above, (height, width, 3) uint8, with the agent's view brighter."""
        assert isinstance(self.lanes, RoomLanes)
        return self.lanes.picture()


class RoomLanes(EpisodeLanes):
    """Vector form of `Room` with same-step autoreset; see there for spaces and rewards.

    Observations are flat, (L, channels * height * width). An episode begins with three uniform numbers of the lane's
    stream: agent, goal and direction.
    """

    name = "room"
    cut = True

    def __init__(self, options: RoomOptions, num_envs: int) -> None:
        side = options.sight if options.view == "own" else options.size
        self.unflattened_space = Box(0.0, 1.0, (2 if options.view == "own" else 6, side, side), np.float32)
        count = int(np.prod(self.unflattened_space.shape))
        super().__init__(options, num_envs, Box(0.0, 1.0, (count,), np.float32), Discrete(3))
        self._lane = np.arange(num_envs)
        self._agent = np.ones((num_envs, 3), np.int64)
        """x, y and direction."""
        self._goal = np.ones((num_envs, 2), np.int64)
        self._best = np.ones(num_envs, np.int64)
        """Steps of the shortest way."""

    def _act(
        self, actions: NDArray[np.int64], running: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Turn or walk; `step_count` already has this step."""
        ahead = self._agent[:, :2] + FORWARD[self._agent[:, 2]]
        free = ((ahead > 0) & (ahead < self.options.size - 1)).all(1) & (actions == AHEAD) & running
        self._agent[free, :2] = ahead[free]
        turn = np.where(actions == LEFT, 3, np.where(actions == RIGHT, 1, 0)) * running
        self._agent[:, 2] = (self._agent[:, 2] + turn) % 4
        return self._rewards(), self._found()

    def _found(self) -> NDArray[np.bool_]:
        """Return which agents stand on the goal (L,)."""
        found: NDArray[np.bool_] = (self._agent[:, :2] == self._goal).all(1)
        return found

    def _rewards(self) -> NDArray[np.float64]:
        """Return the reward of each agent's place, (L,)."""
        return np.where(self._found(), 1.0 - 0.9 * self.step_count / self.options.steps, 0.0)

    def _scores(self) -> NDArray[np.float64]:
        """Return the reward over the shortest way's reward."""
        steps = self.options.steps
        scores: NDArray[np.float64] = self._rewards() / (1.0 - 0.9 * np.minimum(self._best, steps) / steps)
        return scores

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        """Refuse agents and goals outside the room."""
        places = np.concatenate([state["agent"][:, :2], state["goal"]])
        inside = places.min() >= 1 and places.max() <= self.options.size - 2
        if not inside or not np.isin(state["agent"][:, 2], range(4)).all():
            raise StoreError(f"room: an agent or a goal stands outside the room of side {self.options.size}")
        return True

    def ways(self, lanes: NDArray[np.intp]) -> NDArray[np.int64]:
        """Return the steps of the shortest way to the goal from where the agents of `lanes` are, (n,)."""
        offset = self._goal[lanes] - self._agent[lanes, :2]
        ahead = (offset * FORWARD[self._agent[lanes, 2]]).sum(1)  # cells in the agent's direction
        distance = np.abs(offset).sum(1)
        straight = (offset == 0).any(1)
        turns = np.where(
            straight, np.where(ahead > 0, 0, np.where(ahead < 0, 2, 1)), np.where(ahead > 0, 1, 2)
        )
        result: NDArray[np.int64] = distance + np.where(distance > 0, turns, 0)
        return result

    def picture(self) -> NDArray[np.uint8]:
        """Return the first lane's room from above, (16 size, 16 size, 3)."""
        size = self.options.size
        cells = np.full((size, size, 3), 235, np.uint8)
        cells[[0, -1]] = cells[:, [0, -1]] = 90
        if self.options.view == "own":
            x, y = (part[0] for part in self._seen_cells())
            here = (x >= 0) & (x < size) & (y >= 0) & (y < size)
            cells[y[here], x[here]] = np.minimum(cells[y[here], x[here]].astype(int) + 20, 255)
        cells[self._goal[0, 1], self._goal[0, 0]] = (0, 158, 115)
        image = cells.repeat(16, 0).repeat(16, 1)
        x, y, direction = self._agent[0].tolist()
        rows, columns = np.mgrid[-7.5:8, -7.5:8]
        forward, side = FORWARD[direction], FORWARD[(direction + 1) % 4]
        along, across = columns * forward[0] + rows * forward[1], columns * side[0] + rows * side[1]
        image[16 * y : 16 * y + 16, 16 * x : 16 * x + 16][
            (np.abs(across) < (6 - along) / 2) & (along > -6)
        ] = (0, 114, 178)
        return image

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"agent": self._agent, "goal": self._goal, "best": self._best}

    def _draw(self, stream: np.random.Generator, count: int) -> NDArray[np.float64]:
        return stream.random((count, 3))

    def _begin(self, lanes: NDArray[np.intp], drawn: NDArray[np.float64]) -> None:
        """Put `lanes` (ascending) at the beginning of new episodes."""
        side = self.options.size - 2
        cells = side * side
        agent, goal, direction = (drawn * (cells, cells - 1, 4)).astype(np.int64).T
        goal += goal >= agent  # any other cell
        self._agent[lanes] = np.stack([1 + agent % side, 1 + agent // side, direction], axis=1)
        self._goal[lanes] = np.stack([1 + goal % side, 1 + goal // side], axis=1)
        self._best[lanes] = self.ways(lanes)

    def _seen_cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return x and y (L, sight, sight) of the cells that agents see by themselves."""
        sight = self.options.sight
        rows, columns = np.mgrid[:sight, :sight]
        forward, side = sight - 1 - rows, columns - sight // 2
        x, y, direction = (part[:, None, None] for part in self._agent.T)
        dx, dy = FORWARD[direction, 0], FORWARD[direction, 1]
        return x + forward * dx - side * dy, y + forward * dy + side * dx

    def _seen(self) -> NDArray[np.float32]:
        """Return every lane's observation (L, n), a new array."""
        assert self.unflattened_space is not None
        seen = np.zeros((self.num_envs, *(self.unflattened_space.shape or ())), np.float32)
        size = self.options.size
        if self.options.view == "own":
            x, y = self._seen_cells()
            seen[:, 0] = (x < 1) | (y < 1) | (x > size - 2) | (y > size - 2)
            seen[:, 1] = (x == self._goal[:, 0, None, None]) & (y == self._goal[:, 1, None, None])
        else:
            seen[:, 0] = 1.0
            seen[:, 0, 1:-1, 1:-1] = 0.0
            seen[self._lane, 1, self._goal[:, 1], self._goal[:, 0]] = 1.0
            seen[self._lane, 2 + self._agent[:, 2], self._agent[:, 1], self._agent[:, 0]] = 1.0
        return seen.reshape(self.num_envs, -1)


class ShortestWay:
    """The reference policy that walks the shortest way, which it knows: a score of 1."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, RoomLanes)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return actions (L,): ahead where that is nearer to the goal, else the turn that is."""
        state = self.envs.state_dict()
        offset = state["goal"] - state["agent"][:, :2]
        direction = state["agent"][:, 2]
        ahead = (offset * FORWARD[direction]).sum(1)
        right = (offset * FORWARD[(direction + 1) % 4]).sum(1)
        actions: NDArray[np.int64] = np.where(ahead > 0, AHEAD, np.where(right >= 0, RIGHT, LEFT))
        return actions
