"""The room and the steered beam: what is seen and earned, by hand, and both forms of each."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded

from qrlsuite.environment import LaneEnv, OneLane
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.plugins.environments.beam6g.angle import AngleLanes, AngleOptions, BeamAngle, BestAngle
from qrlsuite.plugins.environments.room import FORWARD, Room, RoomLanes, RoomOptions, ShortestWay


def placed(agent: tuple[int, int, int], goal: tuple[int, int], **options: Any) -> RoomLanes:
    """One lane in a room of 3 x 3 free cells."""
    lanes = RoomLanes(RoomOptions(**{"size": 5, "sight": 3, **options}), 1)
    lanes.reset(seed=0)
    state = lanes.state_dict()
    state["agent"][:], state["goal"][:] = agent, goal
    lanes.load_state_dict(state)
    return lanes


def test_what_an_agent_sees_by_itself() -> None:
    """In the left upper corner, turned down: the wall is at its right hand, and the goal two cells ahead."""
    wall, goal = placed((1, 1, 1), (1, 3))._seen().reshape(2, 3, 3)
    assert wall.tolist() == [[0, 0, 1], [0, 0, 1], [0, 0, 1]]
    assert goal.tolist() == [[0, 1, 0], [0, 0, 0], [0, 0, 0]]
    wall, goal = placed((3, 2, 0), (3, 1))._seen().reshape(2, 3, 3)
    assert wall.tolist() == [[1, 1, 1], [1, 1, 1], [0, 0, 0]], "a wall ahead, and what is behind it"
    assert goal.tolist() == [[0, 0, 0], [0, 0, 0], [1, 0, 0]], "at its left hand"


def test_the_whole_room() -> None:
    seen = placed((2, 3, 3), (1, 1), view="whole")._seen().reshape(6, 5, 5)
    assert seen[0].sum() == 16
    assert seen[1].tolist()[1] == [0, 1, 0, 0, 0]
    assert [int(seen[channel].sum()) for channel in range(2, 6)] == [0, 0, 0, 1]
    assert seen[5, 3, 2] == 1


def test_ways_are_the_shortest_and_the_policy_walks_them() -> None:
    """Every place and direction against a breadth-first search; the policy's score is 1."""
    far = {}
    for x, y, direction in np.ndindex(3, 3, 4):
        queue, seen = deque([((x, y, direction), 0)]), {(x, y, direction)}
        while queue:
            (a, b, d), steps = queue.popleft()
            far.setdefault((x, y, direction, a, b), steps)
            moved = np.clip((a, b) + FORWARD[d], 0, 2).tolist()
            for after in ((a, b, (d + 1) % 4), (a, b, (d + 3) % 4), (*moved, d)):
                if after not in seen:
                    seen.add(after)
                    queue.append((after, steps + 1))
    for (x, y, direction, a, b), steps in far.items():
        if (x, y) != (a, b):
            lanes = placed((x + 1, y + 1, direction), (a + 1, b + 1))
            assert lanes.ways(np.arange(1)).tolist() == [steps], (x, y, direction, a, b)
    lanes = RoomLanes(RoomOptions(size=6), 64)
    lanes.autoreset = False
    first, _ = lanes.reset(seed=1)
    policy, scores, seen_at = ShortestWay(lanes), np.zeros(64), first
    for _ in range(30):
        seen_at, _, ended, _, infos = lanes.step(policy(seen_at))
        scores[ended] = infos.get("final_info", {}).get("score", scores)[ended]
    assert scores.tolist() == [1.0] * 64


def test_the_beam_earns_what_the_equation_says() -> None:
    """At xi = pi / N_s, in the main lobe, what the sum over the senders gives; on the peak 1 / R^2."""
    lanes = AngleLanes(AngleOptions(degree=2, steps=2, turn=None), 1)
    lanes.reset(seed=0)
    state = lanes.state_dict()
    state["support_points"][:] = [[[3, 3], [3, 3.5]]]  # hardly a step from straight above the antenna
    lanes.load_state_dict(state)
    assert lanes.best_angles()[0] == pytest.approx(np.pi / 2)
    xi = np.pi / 17
    angle = np.arccos(-xi / np.pi)  # u = 0, so that xi = -phi
    _, (earned,), _, _, _ = lanes.step(np.array([[angle]], np.float32))
    senders = np.exp(1j * xi * np.arange(17)).sum() / 17
    r2 = 3.25**2 + 1
    assert earned == pytest.approx(abs(senders) ** 2 / r2, rel=1e-4)
    _, (earned,), _, _, infos = lanes.step(np.array([[np.pi / 2]], np.float32))
    assert earned == pytest.approx(1 / (3.5**2 + 1), rel=1e-6)
    error = infos["final_info"]["metrics"]["angle-error"][0]
    assert error == pytest.approx((angle - np.pi / 2) / 2, rel=1e-4)


@pytest.mark.parametrize("turn", [None, 0.5])
def test_the_best_angle_has_a_score_of_one(turn: float | None) -> None:
    lanes = AngleLanes(AngleOptions(steps=60, turn=turn), 16)
    seen, _ = lanes.reset(seed=3)
    policy = BestAngle(lanes)
    for _ in range(60):
        seen, _, _, _, infos = lanes.step(policy(seen))
    np.testing.assert_allclose(infos["final_info"]["score"], 1, atol=1e-5 if turn is None else 0.05)


@pytest.mark.parametrize(
    ("env", "lanes"),
    [
        (Room(size=5, steps=9), RoomLanes(RoomOptions(size=5, steps=9), 2)),
        (BeamAngle(steps=9), AngleLanes(AngleOptions(steps=9), 2)),
    ],
)
def test_a_lane_plays_what_the_single_form_plays(env: gymnasium.Env[Any, Any], lanes: LaneEnv) -> None:
    seeds = [5, 6]
    lanes.autoreset = False
    lanes.seed_lanes([gymnasium.utils.seeding.np_random(seed)[0] for seed in seeds])
    seen, _ = lanes.reset()
    env.action_space.seed(0)
    actions = np.stack([[env.action_space.sample() for _ in seeds] for _ in range(9)])
    for lane, seed in enumerate(seeds):
        np.testing.assert_array_equal(env.reset(seed=seed)[0].ravel(), seen[lane])
    for lane, seed in enumerate(seeds):
        lanes.seed_lanes([gymnasium.utils.seeding.np_random(each)[0] for each in seeds])
        lanes.reset()
        env.reset(seed=seed)
        for both in actions:
            single, reward, terminated, truncated, info = env.step(both[lane])
            seen, rewards, ends, cut, infos = lanes.step(both)
            np.testing.assert_array_equal(single.ravel(), seen[lane])
            assert (reward, terminated, truncated) == (rewards[lane], ends[lane], cut[lane])
            if terminated or truncated:
                assert info["score"] == infos["final_info"]["score"][lane]
                assert ("metrics" in info) == isinstance(env, BeamAngle)
                break
        with pytest.raises(ResetNeeded):
            env.step(actions[0, 0])


def test_what_is_refused() -> None:
    with pytest.raises(OptionError, match="sight = 4: write an odd number"):
        Room(sight=4)
    with pytest.raises(OptionError, match="outside the field"):
        BeamAngle(antenna=((9.0, 0.0), (1.0, 0.0)))
    lanes = placed((1, 1, 0), (2, 2))
    with pytest.raises(InvalidAction):
        lanes.step(np.array([3]))
    state = lanes.state_dict()
    state["goal"][:] = 4
    with pytest.raises(StoreError, match="outside the room of side 5"):
        lanes.load_state_dict(state)
    lanes = RoomLanes(RoomOptions(), 2)
    with pytest.raises(ValueError, match="one lane, not 2"):
        OneLane(lanes)


def test_a_picture_shows_agent_and_goal() -> None:
    room = Room(size=5, render_mode="rgb_array")
    room.reset(seed=0)
    image = room.render()
    assert image.shape == (80, 80, 3)
    colors = {tuple(color) for color in image.reshape(-1, 3).tolist()}
    assert {(0, 158, 115), (0, 114, 178)} <= colors
