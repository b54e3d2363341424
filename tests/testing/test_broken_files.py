"""Tasks that break one rule each: edits of a good file."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from qrlsuite import registry
from qrlsuite.specs import TaskSpec
from tests.conftest import TINY
from tests.core.test_hooks import install
from tests.testing.broken import Edit, assert_all_good, assert_breaks, edit, ids

STRANGE = '''
import itertools
from dataclasses import field

import numpy as np
from gymnasium.spaces import Box, Discrete
from pydantic.dataclasses import dataclass
from qrlsuite import hookimpl
from qrlsuite.environment import LaneEnv, batched_spaces
from qrlsuite.specs import EnvironmentSpec

numbers = itertools.count()

@dataclass(frozen=True)
class Plain:
    reward: float = 0.0
    steps: int = 5

@dataclass(frozen=True)
class Numbered(Plain):
    number: int = field(default_factory=lambda: next(numbers))

class Lanes(LaneEnv):
    """A constant reward, and nothing to see."""

    def __init__(self, options, num_envs):
        batched_spaces(self, Box(0, 1, (1,)), Discrete(2), num_envs)
        self.options, self.taken = options, 0
        self.seen = np.zeros((num_envs, 1), dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        return self.seen, {}

    def step(self, actions):
        self.taken += 1
        no = np.zeros(self.num_envs, dtype=bool)
        done = no | (self.taken % self.options.steps == 0)
        reward = self.options.reward if self.options.reward < 1 else np.nan
        return self.seen, np.full(self.num_envs, reward), done, no, {}

@hookimpl
def register_environments(register):
    for name in ("Plain", "Numbered"):
        register(EnvironmentSpec(name.lower(), "Strange", f"strange:{name}", "Strange-v0", None, "strange:Lanes"))
'''
GOOD = TINY.replace("[environment]", 'default_preset = "short"\n[environment]', 1).replace(
    "[ranking]", "[presets.short.ddqn.all]\ntarget_steps = 9\n[ranking]"
)
BEAM = TINY[TINY.index('name = "beam6g"') : TINY.index("[protocol]")]


def environment(name: str, score: str = 'source = "return"\nmax_return = 1', **options: str) -> str:
    given = "\n".join(f"{option} = {value}" for option, value in options.items())
    return f'name = "{name}"\n[environment.options]\n{given}\n[score]\n{score}\n'


TASKS = [
    edit("format", r"^tasks.toml: .*unknown key 'epsilon' in \[ranking\].*'epsilons'", "epsilons", "epsilon"),
    edit("format", r"^tasks.toml: not valid TOML", "[ranking]", "[ranking"),
    edit("format", r"unknown environment 'beam5g'; did you mean 'beam6g'", "beam6g", "beam5g"),
    edit("format", r"^tasks.toml is not text in UTF-8, as TOML is", "for tests", "für Tests"),
    edit("format", r"hashed as JSON, which has neither nan", BEAM, environment("plain", reward="nan")),
    edit("says what is registered", r"as 'tiny', .* name = 'small': results would lie", '"tiny"', '"small"'),
    edit("says what is registered", r"with the summary .* read it from the file", "of seconds", ""),
    edit("identity", r"two hashes, .* from a clock, a counter", BEAM, environment("numbered", reward="0.2")),
    edit("algorithms", r"^default_algorithm: unknown .* did you mean 'ddqn'", '"ddqn"', '"dqn"'),
    edit("algorithms", r"^protocol.algorithm_epochs: unknown algorithm 'pppo'; did you mean 'ppo'",
         "interactions = 60", "interactions = 60\nalgorithm_epochs = { pppo = 3 }"),
    edit("algorithms", r"^\[presets.fast.ppoo\]: unknown algorithm 'ppoo'; did you mean 'ppo'",
         "[ranking]", "[presets.fast.ppoo.all]\n[ranking]"),
    edit("algorithms", r"^\[presets.fast.ddqn\]: algorithm 'ddqn' has no option 'lrr'; did you mean 'lr'",
         "[ranking]", "[presets.fast.ddqn.quantum]\nlrr = 1\n[ranking]"),
    edit("settings", r"^target_steps=40 copies the target network once in 45 gradient steps, first after 89% of the "
         r"run: write another value in \[presets.short.ddqn.all\]", "target_steps = 9", "target_steps = 40"),
    edit("settings", r"^target_steps=2000 never copies .* in 45 gradient steps: .*presets.default",
         'default_preset = "short"\n', ""),
    edit("format", r"horizons: 50 steps are not a whole number of epochs of 60", "[180]", "[180, 50]"),
    edit("format", r"horizons: 100 steps are not a whole number .* epochs of 60 steps", "[180]", "[100]"),
    edit("ranking", r"240 lies beyond a complete run, 180 interactions: no entry .* raise", "[180]", "[240]"),
    edit("scores", r"has the return \d+ and the score [2-9]\S*, outside \[0, 1\]: is max_return the best",
         BEAM, environment("cartpole", 'source = "return"\nmax_return = 5')),
    edit("scores", r"return -0.5 and the score -0.5, outside \[0, 1\]", BEAM, environment("plain", reward="-0.1")),
    edit("scores", r"gave a reward of nan: rewards must be finite", BEAM, environment("plain", reward="1")),
    edit("scores", r"^environment 'plain' gave no info\['score'\]", BEAM, environment("plain", 'source = "info"')),
    edit("scores", r"no episode ended within 20000 steps .* a time limit", BEAM, environment("plain", steps="1000000")),
]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def strange(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A distribution with environments that no task can be made of, as pip leaves it."""
    folder = tmp_path_factory.mktemp("site")
    install(folder, "strange", STRANGE)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv(registry.LOAD_PLUGINS, "strange")
        registry.load.cache_clear()
        yield
    registry.load.cache_clear()
    sys.modules.pop("strange", None)
    importlib.invalidate_caches()


def spec(path: Path | str) -> TaskSpec:
    return TaskSpec("tiny", "A beam management task of seconds, for tests", path=str(path))


@pytest.mark.parametrize("edit", TASKS, ids=ids(TASKS))
def test_one_rule_is_broken(edit: Edit, tmp_path: Path) -> None:
    path = tmp_path / "tasks.toml"
    path.write_bytes(edit.of(GOOD).encode("latin-1"))
    assert_breaks(spec(path), edit.rule, edit.message)


def test_a_file_is_where_the_spec_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = r"missing.toml is not there: is the TOML file among the package data, \[tool.setuptools.package-data\]"
    assert_breaks(spec(tmp_path / "missing.toml"), "file", message)
    (tmp_path / "tasks.toml").write_text(GOOD)
    monkeypatch.chdir(tmp_path)
    message = r"is relative to the folder where .* write str\(Path\(__file__\).parent / ...\)"
    assert_breaks(spec("tasks.toml"), "file", f"path = 'tasks.toml' {message}")


def test_every_rule_has_a_file_that_breaks_it(tmp_path: Path) -> None:
    (tmp_path / "tasks.toml").write_text(GOOD)
    assert assert_all_good(spec(tmp_path / "tasks.toml")) == {edit.rule for edit in TASKS} | {"file"}
