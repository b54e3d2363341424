"""Pong: a game step by step against rules written once more, one frame after the other, and its reference policies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from qrlsuite.errors import OptionError, StoreError
from qrlsuite.plugins.environments.pong import Follower, Pong, PongLanes, PongOptions, SteepReturns
from tests.environments.test_quantum import scores


class Game:
    """One game by the rules of PufferLib's `pong.h`, in scalars."""

    def __init__(self, serves: list[float], frames: int, points: int) -> None:
        self.serves, self.frames, self.points = [*serves, serves[-1]], frames, points
        self.won = self.lost = 0
        self.serve()

    def serve(self) -> None:
        self.other = self.own = 320 - 35.0
        self.x, self.y, self.vx, self.vy = 100.0, 320 - 16.0, 10.0, self.serves[self.won + self.lost]

    def step(self, action: int) -> float:
        reward, move = 0.0, (0, 1, -1)[action]
        for _ in range(self.frames):
            self.own = min(max(self.own + 8 * move, -35), 605)
            self.other = min(max(self.other + min(max(self.y - (self.other + 35), -8), 8), -35), 605)
            self.x, self.y = self.x + self.vx, self.y + self.vy
            if self.y < 0 or self.y + 32 > 640:
                self.vy = -self.vy
            if self.x < 0:
                if self.y + 32 > self.other and self.y < self.other + 70:
                    self.vx = -self.vx
                else:
                    self.won += 1
                    self.serve()
                    return 1.0
            if self.x + 32 > 500:
                if self.y + 32 > self.own and self.y < self.own + 70:
                    self.vx, reward = -self.vx, 0.1
                    self.vy = min(max(self.vy + 3 * move, -13), 13)
                    if abs(self.vy) < 0.01:
                        self.vy = 3.0
                    self.x, self.y = min(self.x, 468), min(max(self.y, 0), 608)
                else:
                    self.lost += 1
                    self.serve()
                    return -1.0
        return reward

    def seen(self) -> list[float]:
        ball = [self.x / 500, self.y / 640, (self.vx + 10) / 20, (self.vy + 13) / 26]
        scores = [self.lost / self.points, self.won / self.points]
        return [(self.other + 35) / 640, (self.own + 35) / 640, *ball, *scores]


@pytest.mark.parametrize(("frames", "serve"), [(1, 4.0), (3, 13.0), (8, 0.0)])
def test_games_follow_the_rules(frames: int, serve: float) -> None:
    lanes = PongLanes(PongOptions(points=2, frames=frames, serve=serve, steps=4000 // frames), 20)
    lanes.autoreset = False
    seen, _ = lanes.reset(seed=frames)
    luck = lanes.state_dict()["serves"]
    slopes = serve * (2 * luck - 1) if serve else np.where(luck < 0.5, 0.0, -1.0)
    games = [Game(each, frames, 2) for each in slopes.tolist()]
    random = np.random.default_rng(0)
    policy = SteepReturns(lanes)
    ended = 0
    for _ in range(4000 // frames):
        random_ones = random.integers(0, 3, 20)
        actions = np.where(random.random(20) < 0.1, random_ones, policy(seen))
        playing = ~lanes.state_dict()["ended"]
        seen, rewards, terminated, _, infos = lanes.step(actions)
        for lane in np.flatnonzero(playing):
            game = games[lane]
            assert rewards[lane] == game.step(int(actions[lane]))
            np.testing.assert_allclose(seen[lane], np.clip(game.seen(), 0, 1), atol=1e-6)
            assert terminated[lane] == (2 in (game.won, game.lost))
            if terminated[lane]:
                ended += 1
                assert infos["final_info"]["score"][lane] == 0.5 + (game.won - game.lost) / 4
    assert ended > 10


def test_who_follows_wins_a_point_at_times_and_who_hits_in_motion_wins() -> None:
    policies = (None, Follower, SteepReturns)
    random, follower, steep = (scores(PongLanes(PongOptions(), 100), p).mean() for p in policies)
    assert random < 0.01 < 0.1 < follower < 0.5 < 0.95 < steep


def test_a_time_limit_truncates() -> None:
    game = Pong(steps=3)
    game.reset(seed=0)
    *_, terminated, truncated, info = [game.step(0) for _ in range(3)][-1]
    assert (terminated, truncated, info["score"]) == (False, True, 0.5)
    with pytest.raises(OptionError, match="points"):
        Pong(points=0)


@pytest.mark.parametrize(
    ("name", "value"), [("ball", 700.0), ("paddles", -36.0), ("points", 3), ("serves", 1.0)]
)
def test_impossible_states_are_refused(name: str, value: Any) -> None:
    lanes = PongLanes(PongOptions(points=2), 2)
    lanes.reset(seed=0)
    state = lanes.state_dict()
    lanes.load_state_dict(state)
    state[name][:] = value
    with pytest.raises(StoreError, match="none of a game to 2 points"):
        lanes.load_state_dict(state)


def test_the_picture_shows_ball_and_paddles() -> None:
    game = Pong(render_mode="rgb_array")
    game.reset(seed=0)
    image = game.render()
    assert (image.shape, image.dtype) == ((320, 270, 3), np.uint8)
    assert (image == (40, 40, 40)).all(2).sum() == 16 * 16
    assert (image == (0, 114, 178)).all(2).sum() == 10 * 35
