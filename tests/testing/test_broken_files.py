"""Tasks and studies that break one rule each: edits of good files."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from qrlsuite import registry
from qrlsuite.specs import Spec, StudySpec, TaskSpec
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
    edit("format", r"horizons: 50 steps are not a whole number of epochs of 60", "[180]", "[180, 50]"),
    edit("format", r"horizons: 100 steps are not a whole number .* epochs of 60 steps", "[180]", "[100]"),
    edit("ranking", r"240 lies beyond a complete run, 180 interactions: no entry .* raise", "[180]", "[240]"),
    edit("scores", r"has the return \d+ and the score [2-9]\S*, outside \[0, 1\]: is max_return the best",
         BEAM, environment("cartpole", 'source = "return"\nmax_return = 5')),
    edit("scores", r"return -0.5 and the score -0.5, outside \[0, 1\]", BEAM, environment("plain", reward="-0.1")),
    edit("scores", r"gave an episode the return nan: .* rewards that are nan", BEAM, environment("plain", reward="1")),
    edit("scores", r"^environment 'plain' gave no info\['score'\]", BEAM, environment("plain", 'source = "info"')),
    edit("scores", r"no episode ended within 20000 steps .* a time limit", BEAM, environment("plain", steps="1000000")),
]  # fmt: skip
STUDY = """
format_version = 1
name = "small"
summary = "Two sizes of a network"

[[entries]]
name = "mlp"
task = "beam6g"
model = "mlp"
grid = { width = [8, 16] }

[[entries]]
name = "deep"
task = "beam6g"
model = "mlp"
options = { depth = 3 }

[[pictures]]
kind = "bars"
entries = ["mlp", "deep"]
settings = { epsilons = [0.2], deltas = [0.5] }
"""
SPEEDS = """
format_version = 1
machine = "a laptop"

[[speeds]]
environment = "beam6g"
algorithm = "ddqn"
model = "mlp"
options = { width = 8 }
seconds = 0.1
"""

STUDIES = [
    edit("format", r"^studies.toml: .*unknown key 'sumary'.*'summary'", "summary", "sumary"),
    edit("format", r"^studies.toml: not valid TOML", "[[pictures]]", "[[pictures]"),
    edit("format", r"no group 'dep'; did you mean 'deep'", '["mlp", "deep"]', '["mlp", "dep"]'),
    edit("format", r"^studies.toml is not text in UTF-8, as TOML is", "Two sizes", "Zwei Größen"),
    edit("says what is registered", r"as 'small', .* name = 'tiny': `qrlsuite list studies`", '"small"', '"tiny"'),
    edit("says what is registered", r"with the summary .* read it from the file", "Two sizes", "Sizes"),
    edit("entries", r"group 'mlp': unknown task 'beam5g'; did you mean 'beam6g", '"beam6g"', '"beam5g"'),
    edit("entries", r"group 'mlp': unknown model 'mpl'; did you mean 'mlp'", '"mlp"\ngrid', '"mpl"\ngrid'),
    edit("entries", r"group 'mlp': grid.widht: no option of that name; did you mean", "width =", "widht ="),
    edit("entries", r"group 'mlp': .*width", "[8, 16]", "[8, 0]"),
    edit("all shown", r"^deep: trained, and in no picture", '["mlp", "deep"]', '["mlp"]'),
    edit("pictures", r"pictures.0.kind: unknown picture 'bar'; did you mean 'bars'", '"bars"', '"bar"'),
    edit("pictures", r"pictures.0.settings.*'epsilon'; did you mean 'epsilons'", "epsilons", "epsilon"),
]  # fmt: skip
GOOD = {"tasks": TINY, "studies": STUDY}
CASES = [(kind, edit) for kind, edits in (("tasks", TASKS), ("studies", STUDIES)) for edit in edits]


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


def spec(kind: str, path: Path | str, speeds: Path | str | None = None) -> Spec:
    if kind == "tasks":
        return TaskSpec("tiny", "A beam management task of seconds, for tests", path=str(path))
    return StudySpec("small", "Two sizes of a network", str(path), speeds and str(speeds))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Good files, and one of speeds with a wrong key."""
    for kind, text in GOOD.items():
        (tmp_path / f"{kind}.toml").write_text(text)
    (tmp_path / "speeds.toml").write_text(SPEEDS)
    (tmp_path / "wrong.toml").write_text(SPEEDS.replace("seconds =", "second ="))
    return tmp_path


@pytest.mark.parametrize(("kind", "edit"), CASES, ids=ids(edit for _, edit in CASES))
def test_one_rule_is_broken(kind: str, edit: Edit, tmp_path: Path) -> None:
    path = tmp_path / f"{kind}.toml"
    path.write_bytes(edit.of(GOOD[kind]).encode("latin-1"))
    assert_breaks(spec(kind, path), edit.rule, edit.message)


@pytest.mark.parametrize("kind", GOOD)
def test_a_file_is_where_the_spec_says(kind: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = r"missing.toml is not there: is the TOML file among the package data, \[tool.setuptools.package-data\]"
    assert_breaks(spec(kind, folder / "missing.toml"), "file", message)
    monkeypatch.chdir(folder)
    message = r"is relative to the folder where .* write str\(Path\(__file__\).parent / ...\)"
    assert_breaks(spec(kind, f"{kind}.toml"), "file", f"path = '{kind}.toml' {message}")


@pytest.mark.parametrize(
    ("speeds", "message"),
    [
        ("speeds.toml", r"^speeds = 'speeds.toml' is relative to the folder"),
        ("{folder}/missing.toml", r"missing.toml"),
        ("{folder}/wrong.toml", r"unknown key 'second'.*'seconds'"),
    ],
)
def test_speeds_that_cannot_be_read(speeds: str, message: str, folder: Path) -> None:
    broken = spec("studies", folder / "studies.toml", speeds.format(folder=folder))
    assert_breaks(broken, "speeds", message)


@pytest.mark.parametrize("kind", GOOD)
def test_every_rule_has_a_file_that_breaks_it(kind: str, folder: Path) -> None:
    rules = assert_all_good(spec(kind, folder / f"{kind}.toml", folder / "speeds.toml"))
    broken = {edit.rule for one, edit in CASES if one == kind} | {"file"}
    assert rules == broken | ({"speeds"} if kind == "studies" else set())
