"""What `run` asks of a plugin's file before its first epoch: whether its seeds are seeds."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.commands import qrlsuite

NETWORK = """
import torch

class Net(torch.nn.Module):
    def __init__(self, inputs, outputs, seed: int = 42):
        super().__init__()
        self.hidden = torch.nn.Linear(inputs, 4)
        self.scale = torch.nn.Parameter(torch.ones(4))
        self.out = torch.nn.Linear(4, outputs)
        torch.nn.init.zeros_(self.out.bias)

    def forward(self, x):
        return self.out(self.scale * torch.relu(self.hidden(x)))
"""
"""Honest: what is constant may be equal in all seeds."""
RESET = NETWORK.replace("super().__init__()", "super().__init__(); torch.manual_seed(0)")
OWN = NETWORK.replace(
    "torch.nn.init.zeros_(self.out.bias)",
    "torch.nn.init.normal_(self.out.weight, generator=torch.Generator().manual_seed(seed))",
)
DECLARED = OWN.replace("def __init__", "shared = ('out.weight',)\n\n    def __init__", 1)

WALK = """
import gymnasium
import numpy as np

class Walk(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self):
        self.rng = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 5
        return self.show(), {}

    def show(self):
        return np.array([(self.rng or self.np_random).random() > 0.5], np.float32)

    def step(self, action):
        self.left -= 1
        seen = self.show()
        return seen, float(action == seen[0]), self.left == 0, False, {}
"""
COIN = WALK.replace("self.left = 5", "self.left, self.side = 5, self.np_random.random()").replace(
    "(self.rng or self.np_random).random()", "self.side"
)
"""Honest, and lanes often meet the same episode: there are two."""
NOISE = WALK.replace("self.rng = None", "self.rng = np.random.default_rng(0)")
GLOBAL = WALK.replace("self.rng = None", "self.rng = np.random")
ALIKE = WALK.replace("[(self.rng or self.np_random).random() > 0.5]", "[self.left % 2]")
CYCLE = NOISE.replace("def __init__", "repeats = True\n\n    def __init__")


def run(folder: Path, code: str, *words: str, command: str = "run") -> tuple[int, str]:
    (folder / "mine.py").write_text(code)
    given = ("--plugin", str(folder / "mine.py"), "--workers", "1", "--runs", str(folder / "runs"))
    done = qrlsuite(command, *words, *given, "--epochs", "1")
    return done.returncode, " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("code", "tensor"), [(RESET, "hidden.weight"), (OWN, "out.weight")], ids=["reset", "own"]
)
def test_seeds_that_begin_alike_are_refused(code: str, tensor: str, tmp_path: Path, tiny_task: str) -> None:
    exit_code, said = run(tmp_path, code, "net", "--task", tiny_task, "--seeds", "2")
    assert exit_code == 2
    assert f"model 'net' ({tmp_path / 'mine.py'}:4): all seeds begin with the same '{tensor}'" in said
    assert "draw it from the `generator` that is handed in" in said
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("command", ["run", "tune"])
@pytest.mark.parametrize(
    ("code", "reason"),
    [(NOISE, "several seeds meet the same ones"), (GLOBAL, "the same streams and actions give other")],
    ids=["own", "global"],
)
def test_seeds_that_meet_the_same_noise_are_refused(
    code: str, reason: str, command: str, tmp_path: Path
) -> None:
    more = ("--vary", "lr=1e-3,1e-2") if command == "tune" else ()
    words = ("mlp width=2", "--task", "walk", "--seeds", "2", *more)
    exit_code, said = run(tmp_path, code, *words, command=command)
    assert exit_code == 2
    assert f"environment 'walk' ({tmp_path / 'mine.py'}:5): " in said
    assert reason in said
    assert "draw from self.np_random" in said
    assert list(tmp_path.glob("runs/**/run.json")) == []


def test_seeds_with_weights_of_their_own_are_trained(tmp_path: Path, tiny_task: str) -> None:
    assert run(tmp_path, NETWORK, "net", "--task", tiny_task, "--seeds", "2")[0] == 0


@pytest.mark.parametrize(
    ("code", "words", "declared"),
    [
        (DECLARED, ("net", "--task", "{tiny}"), "model 'net': the same out.weight at the beginning"),
        (CYCLE, ("mlp width=2", "--task", "walk"), "environment 'walk': the same episodes"),
    ],
    ids=["weights", "episodes"],
)
def test_boards_name_what_seeds_have_in_common_by_declaration(
    code: str, words: tuple[str, ...], declared: str, tmp_path: Path, tiny_task: str
) -> None:
    given = [word.format(tiny=tiny_task) for word in words]
    assert run(tmp_path, code, *given, "--seeds", "2")[0] == 0
    board = qrlsuite("leaderboard", "--runs", str(tmp_path / "runs")).stdout  # without the plugin
    assert re.search(rf"seeds have in common by declaration: .* \({declared}\)", " ".join(board.split()))


@pytest.mark.parametrize("code", [WALK, COIN, ALIKE], ids=["honest", "coin", "alike"])
def test_lanes_with_episodes_of_their_own_or_without_noise_are_trained(code: str, tmp_path: Path) -> None:
    exit_code, said = run(tmp_path, code, "mlp width=2", "--task", "walk", "--seeds", "2")
    assert (exit_code, "was not asked" in said) == (0, False), said
