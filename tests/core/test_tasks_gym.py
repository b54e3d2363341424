"""Tasks on Gymnasium's environments: files, `gym:ID` without a file, and environments that fail in a run."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qrlsuite import options, registry, specs
from qrlsuite.errors import EnvironmentFailure, OptionError
from qrlsuite.experiment import catalog, task
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.gymlanes import quick_name
from qrlsuite.plugins.environments.beam6g.placements import placement
from qrlsuite.results.store import EntryStore
from qrlsuite.training import group
from tests.commands import qrlsuite
from tests.conftest import results
from tests.environments.strangers import HERE

ROOT = Path(__file__).parents[2]
PRESETS = [
    (name, preset, algorithm, family)
    for name in registry.load().names(specs.TaskSpec)
    for preset, tables in task.load(name).file.presets.items()
    for algorithm, families in tables.items()
    for family in ("classical", "quantum")
    if families.keys() & {"all", family}
]


def cli(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return qrlsuite(
        *words, cwd=cwd, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )  # for strangers' environments


@pytest.mark.parametrize("name", registry.load().names(specs.TaskSpec))
def test_every_task_is_whole(name: str) -> None:
    loaded = task.load(name)
    file = loaded.file
    assert (loaded.name, file.protocol.rounds >= 1) == (name, True)
    assert task.Task(task.TaskFile.model_validate(file.model_dump(mode="json")), "again").hash == loaded.hash
    reference, ranking = file.ranking.reference, file.ranking
    assert min(ranking.deltas) <= reference.delta <= max(ranking.deltas)
    if ranking.thresholds is None:
        assert reference.epsilon in (ranking.epsilons or [])
    else:
        assert reference.threshold in ranking.thresholds
        assert file.score.max_return is None
    steps = {file.protocol.interactions * epochs for epochs in file.protocol.algorithm_epochs.values()}
    assert set(ranking.horizons) == steps | {file.protocol.interactions * file.protocol.epochs}


@pytest.mark.parametrize(("name", "preset", "algorithm", "family"), PRESETS)
def test_every_preset_is_made_of_options(name: str, preset: str, algorithm: str, family: str) -> None:
    if algorithm not in registry.load().names(specs.AlgorithmSpec):
        pytest.skip(f"{algorithm} is not registered")
    _, values = task.load(name).preset(preset, algorithm, family)
    built = options.build(
        specs.resolve(registry.get(specs.AlgorithmSpec, algorithm).options), values, "preset"
    )
    assert {key: value for key, value in options.plain(built).items() if key in values} == values


def test_all_twenty_placements_are_there_and_differ() -> None:
    names = [name for name in registry.load().names(specs.TaskSpec) if re.fullmatch(r"beam6g-a\d-\d", name)]
    assert names == [f"beam6g-a{antennas}-{index}" for antennas in (2, 3, 4, 5) for index in range(5)]
    assert len({task.load(name).hash for name in names}) == 20
    for name in names:
        drawn = placement(int(name[8]), int(name[10]))
        assert task.load(name).file.environment.options["antennas"] == json.loads(json.dumps(drawn))
        assert "ours" in task.load(name).file.summary


@pytest.mark.parametrize(
    ("env_id", "thresholds"),
    [
        ("Acrobot-v1", [-200, -150, -125, -100]),
        ("CartPole-v1", [237.5, 356.25, 475]),
        ("CliffWalking-v1", [0]),
        ("FrozenLake-v1", [0.35, 0.525, 0.7]),
        ("MountainCar-v0", [-165, -137.5, -110]),
    ],
)
def test_a_task_without_a_file(env_id: str, thresholds: list[float]) -> None:
    quick = task.load(f"gym:{env_id}")
    assert quick.environment_options.id == env_id
    assert quick.file.ranking.thresholds == pytest.approx(thresholds)
    assert quick.file.ranking.reference.threshold == pytest.approx(thresholds[-1])
    assert quick.file.score.source == "return"
    unlimited = env_id.startswith("CliffWalking")
    assert quick.environment_options.max_episode_steps == (1000 if unlimited else None)
    assert quick.hash == task.load(f"gym:{env_id}").hash
    saved = task.parse(catalog.task_file(f"gym:{env_id}"), "saved.toml")
    assert (saved.hash, saved.file) == (quick.hash, quick.file)
    assert quick.preset(None, "ddqn", "classical")[1]["target_steps"] == 50


def test_thresholds_that_random_actions_always_reach_are_left_out() -> None:
    """MountainCar's were -220 (random actions have -200), and 0 elsewhere, which no return is below."""
    assert "without threshold -220, because random" in task.load("gym:MountainCar-v0").file.summary
    assert "without" not in task.load("gym:Acrobot-v1").file.summary
    counted = task.load(f"gym:{HERE}:Counted-v0").file
    assert "the only threshold is the best of 10 random episodes (11)" in counted.summary
    assert counted.ranking.thresholds == [11], "episodes have 3 to 11 steps"
    with pytest.raises(
        OptionError, match="random actions always have the return 3, which reaches every known threshold"
    ):
        task.load(f"gym:{HERE}:Even-v0")


@pytest.mark.parametrize("name", sorted(registry.load().of(specs.EnvironmentSpec).keys() - {"gym"}))
def test_every_environment_has_a_task(name: str) -> None:
    assert task.load(name).environment.name == name or name in registry.load().of(specs.TaskSpec)


def test_names_of_tasks_without_a_file_are_names() -> None:
    for env_id in ("Acrobot-v1", "phys2d/CartPole-v1", "a.b:C_d/E-v0", "X" * 99, "a" * 59 + "-b"):
        assert specs.NAME.fullmatch(quick_name(env_id))
        assert len(quick_name(env_id)) <= 64
    assert quick_name("phys2d/CartPole-v1") == "gym-phys2d-cartpole-v1"


def test_a_quick_look_from_the_command_line(tmp_path: Path) -> None:
    shown = json.loads(cli("show", "task", "gym:FrozenLake-v1", "--json", cwd=tmp_path).stdout)
    assert shown["ranking"]["thresholds"] == pytest.approx([0.35, 0.525, 0.7])
    assert cli("show", "gym:FrozenLake-v1", cwd=tmp_path).stdout.startswith(
        "kind: task\nname: gym:FrozenLake-v1\n"
    )
    words = ["run", "--task", "gym:FrozenLake-v1", "--model", "mlp", "--seeds", "2", "--epochs", "2"]
    done = cli(*words, "--runs", "tmp", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert (summary["task"], summary["seeds"], summary["epochs"]) == ("gym-frozenlake-v1", 2, 2)
    assert 0 <= summary["median_score"] <= 1


TASK = """
format_version = 1
name = "stranger"
summary = "An environment of a third party"
[environment]
name = "gym"
[environment.options]
id = "{env_id}"
arguments = {{ {arguments} }}
[protocol]
seeds = 2
epochs = 4
environments = 2
interactions = 20
validation_episodes = 3
[score]
source = "{source}"
[ranking]
thresholds = [0.5]
deltas = [0.5]
reference = {{ threshold = 0.5, delta = 0.5 }}
horizons = [80]
"""


@pytest.fixture
def stranger(tmp_path: Path) -> Callable[..., Entry]:
    """An entry on an environment of `tests.environments.strangers`."""

    def build(name: str = "Walk-v0", source: str = "return", **arguments: Any) -> Entry:
        words = ", ".join(f"{key} = {json.dumps(value)}" for key, value in arguments.items())
        path = tmp_path / "stranger.toml"
        path.write_text(TASK.format(env_id=f"{HERE}:{name}", arguments=words, source=source))
        return resolve(str(path), "mlp", settings=[options.parse_setting("width=8")])

    return build


def train(entry: Entry, folder: Path, seeds: list[int], epochs: int = 4) -> EntryStore:
    store = EntryStore.create(folder, entry)
    group.GroupRun([(entry, store, seeds)], epochs).run()
    return store


def test_scores_are_the_environments_or_returns(stranger: Callable[..., Entry], tmp_path: Path) -> None:
    scores = train(stranger(source="info"), tmp_path / "info", [0]).seed(0).epochs()[-1].scores
    steps = np.array(scores) * 12
    np.testing.assert_allclose(steps, steps.round(), atol=1e-5)
    assert (steps >= 3).all()
    with pytest.raises(EnvironmentFailure, match=r"gave no info\['score'\] at the end of an episode"):
        train(stranger(source="info", scored=False), tmp_path / "none", [0])


def test_an_environment_that_raises_fails_its_group_and_keeps_finished_epochs(
    stranger: Callable[..., Entry], tmp_path: Path
) -> None:
    """It raises in training, in the 25th round of 10 per epoch: two epochs stay, and the rest comes later."""
    marker = tmp_path / "marker"
    entry = stranger("Broken-v0", marker=str(marker))
    store = EntryStore.create(tmp_path / "runs", entry)
    with pytest.raises(
        EnvironmentFailure,
        match=r"environment 'gym' failed: ZeroDivisionError: the cart left the rails .*strangers.py, line .*; finished",
    ):
        group.GroupRun([(entry, store, [0])], 4).run()
    assert [row.epoch for row in store.seed(0).epochs()] == [1, 2]
    group.GroupRun([(entry, store, [0])], 4).run()
    undisturbed = train(entry, tmp_path / "undisturbed", [0])
    assert results(store.path, 0) == results(undisturbed.path, 0)


def test_other_groups_go_on_when_one_fails(stranger: Callable[..., Entry], tmp_path: Path) -> None:
    entry = stranger("Broken-v0", marker=str(tmp_path / "marker"))
    words = ["run", "--task", "stranger.toml", "--model", "mlp", "--set", "width=8", "--workers", "2"]
    failed = cli(*words, "--runs", "runs", cwd=tmp_path)
    assert failed.returncode == 2
    assert "1 group(s) failed, finished epochs are kept" in failed.stderr
    assert "ZeroDivisionError: the cart left the rails" in failed.stderr
    store = EntryStore.create(tmp_path / "runs", entry)
    assert sorted(len(store.seed(seed).epochs()) for seed in (0, 1)) == [2, 4]
    again = cli(*words, "--runs", "runs", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert [len(store.seed(seed).epochs()) for seed in (0, 1)] == [4, 4]
