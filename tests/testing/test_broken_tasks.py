"""Tasks that break one rule each."""

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
from tests.testing.broken import Broken, assert_breaks, own_rules
from tests.testing.edits import Edit

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
BEAM = TINY[TINY.index('name = "beam6g"') : TINY.index("[protocol]")]


def environment(name: str, score: str = 'source = "return"\nmax_return = 1', **options: str) -> str:
    given = "\n".join(f"{option} = {value}" for option, value in options.items())
    return f'name = "{name}"\n[environment.options]\n{given}\n[score]\n{score}\n'


BROKEN = {
    "key": Edit("format", "epsilons", "epsilon", r"^tiny.toml: .*unknown key 'epsilon' in \[ranking\].*'epsilons'"),
    "toml": Edit("format", "[ranking]", "[ranking", r"^tiny.toml: not valid TOML"),
    "environment": Edit("format", "beam6g", "beam5g", r"unknown environment 'beam5g'; did you mean 'beam6g'"),
    "latin": Edit("format", "for tests", "für Tests", r"^tiny.toml is not text in UTF-8, as TOML is"),
    "nan": Edit("format", BEAM, environment("plain", reward="nan"), r"hashed as JSON, which has neither nan"),
    "name": Edit("says what is registered", '"tiny"', '"small"', r"as 'tiny', .* name = 'small': results would lie"),
    "summary": Edit("says what is registered", "of seconds", "", r"with the summary .* read it from the file"),
    "drift": Edit("identity", BEAM, environment("numbered", reward="0.2"), r"two hashes, .* from a clock, a counter"),
    "default": Edit("algorithms", '"ddqn"', '"dqn"', r"^default_algorithm: unknown .* did you mean 'ddqn'"),
    "epochs": Edit(
        "algorithms",
        "interactions = 60",
        "interactions = 60\nalgorithm_epochs = { pppo = 3 }",
        r"^protocol.algorithm_epochs: unknown algorithm 'pppo'; did you mean 'ppo'",
    ),
    "preset": Edit(
        "algorithms",
        "[ranking]",
        "[presets.fast.ppoo.all]\n[ranking]",
        r"^\[presets.fast.ppoo\]: unknown algorithm 'ppoo'; did you mean 'ppo'",
    ),
    "option": Edit(
        "algorithms",
        "[ranking]",
        "[presets.fast.ddqn.quantum]\nlrr = 1\n[ranking]",
        r"^\[presets.fast.ddqn\]: algorithm 'ddqn' has no option 'lrr'; did you mean 'lr'",
    ),
    "short": Edit("format", "[180]", "[180, 50]", r"horizons: 50 steps are not a whole number of epochs of 60"),
    "part": Edit("format", "[180]", "[100]", r"horizons: 100 steps are not a whole number .* epochs of 60 steps"),
    "long": Edit("ranking", "[180]", "[240]", r"240 lies beyond a complete run, 180 interactions: no entry .* raise"),
    "maximum": Edit(
        "scores",
        BEAM,
        environment("cartpole", 'source = "return"\nmax_return = 5'),
        r"has the return \d+ and the score [2-9]\S*, outside \[0, 1\]: is max_return the best possible return",
    ),
    "negative": Edit(
        "scores", BEAM, environment("plain", reward="-0.1"), r"return -0.5 and the score -0.5, outside \[0, 1\]"
    ),
    "infinite": Edit(
        "scores", BEAM, environment("plain", reward="1"), r"gave an episode the return nan: .* rewards that are nan"
    ),
    "unscored": Edit(
        "scores", BEAM, environment("plain", 'source = "info"'), r"^environment 'plain' gave no info\['score'\]"
    ),
    "endless": Edit(
        "scores", BEAM, environment("plain", steps="1000000"), r"no episode ended within 20000 steps .* a time limit"
    ),
}  # fmt: skip


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


def spec(path: Path, text: str = TINY) -> TaskSpec:
    path.write_bytes(text.encode("latin-1"))
    return TaskSpec(name="tiny", summary="A beam management task of seconds, for tests", path=str(path))


@pytest.mark.parametrize("name", BROKEN)
def test_one_rule_is_broken(name: str, tmp_path: Path) -> None:
    edit = BROKEN[name]
    case = Broken(spec(tmp_path / "tiny.toml", edit.of(TINY)), edit.message)
    assert_breaks("tasks", edit.rule, case)


def test_a_file_that_was_not_packaged(tmp_path: Path) -> None:
    missing = TaskSpec(name="tiny", summary="Not there", path=str(tmp_path / "tiny.toml"))
    message = (
        r"tiny.toml is not there: is the TOML file among the package data, \[tool.setuptools.package-data\]"
    )
    assert_breaks("tasks", "file", Broken(missing, message))


def test_a_relative_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec(tmp_path / "tiny.toml")
    monkeypatch.chdir(tmp_path)
    relative = TaskSpec(name="tiny", summary="Here only", path="tiny.toml")
    message = (
        r"path = 'tiny.toml' is relative to the folder where .* write str\(Path\(__file__\).parent / ...\)"
    )
    assert_breaks("tasks", "file", Broken(relative, message))


def test_every_rule_has_a_task_that_breaks_it(tmp_path: Path) -> None:
    findings = own_rules("tasks", spec(tmp_path / "tiny.toml"))
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {"file", *(edit.rule for edit in BROKEN.values())}
