"""Training that begins with the trained agents of another entry."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from qrlsuite import api
from qrlsuite.api.warm import begin_with
from qrlsuite.engine import probe
from qrlsuite.engine.worker import train_group
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.leaderboard.boards import tables
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.export import export
from qrlsuite.results.records import EntryRecord
from qrlsuite.results.store import EntryStore
from qrlsuite.training.trainer import Trainer
from tests.commands import answer, say
from tests.conftest import POLE, TINY, Train, trainer

WORDS = ["--seeds", "2", "--epochs", "2", "--workers", "1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `runs`: two seeds of `tiny`, and of `other`, a task of another degree that began with them."""
    root = tmp_path_factory.mktemp("warm")
    (root / "tiny.toml").write_text(TINY)
    (root / "other.toml").write_text(TINY.replace("degree = 3", "degree = 2").replace('"tiny"', '"other"'))
    trainer(str(root / "tiny.toml"), root)("runs", [0, 1], 2)
    words = ["run", "mlp width=16", "--task", str(root / "other.toml"), "--from", "tiny/mlp", *WORDS]
    assert answer(*words, "--runs", str(root / "runs"))["seeds"] == 2
    return root


@pytest.fixture
def root(trained: Path, tmp_path: Path) -> Path:
    """The same, in a copy that a test may change."""
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    return tmp_path


def stores(root: Path) -> tuple[EntryStore, EntryStore]:
    """The entry of the agents, and the one that began with them."""
    cold, warm = (EntryStore(next(root.glob(f"runs/{task}/*"))) for task in ("tiny", "other"))
    return cold, warm


def again(root: Path, name: str, seeds: list[int]) -> EntryStore:
    """Return a place for the same entry anew, with the agents to begin with."""
    _, warm = stores(root)
    store = EntryStore.create(root / name, warm.entry())
    store.start.mkdir()
    for seed in seeds:
        shutil.copy(warm.start_of(seed), store.start)
    return store


def files(store: EntryStore, seed: int) -> list[bytes]:
    return [(store.seed(seed).path / name).read_bytes() for name in ("final.safetensors", "epochs.parquet")]


def test_it_is_another_entry_with_the_agents_in_its_label(trained: Path) -> None:
    cold, warm = stores(trained)
    entry = warm.entry()
    text = f"tiny/{cold.path.name}:2"
    assert entry.label == f"ddqn mlp width=16 from={text}"
    assert entry.identity["from"] == text
    assert resolve(str(trained / "other.toml"), entry.label).hash == entry.hash
    plain = resolve(str(trained / "other.toml"), "mlp width=16")
    assert plain.hash != entry.hash
    assert plain.population_key != entry.population_key
    assert "from" not in plain.identity
    assert warm.start_of(1).read_bytes() == cold.seed(1).agent.read_bytes()
    with pytest.raises(OptionError, match="write TASK/ENTRY:EPOCHS"):
        resolve("beam6g", "mlp width=16 from=elsewhere")


def test_from_python_it_is_the_same_entry(root: Path) -> None:
    _, warm = stores(root)
    shutil.move(root / "runs" / "other", root / "moved")
    arguments: dict[str, Any] = {"seeds": 2, "epochs": 2, "workers": 1, "progress": False}
    api.train(str(root / "other.toml"), "mlp width=16", start="tiny/mlp", runs=root / "runs", **arguments)
    there = EntryStore(root / "moved" / warm.path.name)
    assert [files(warm, seed) for seed in (0, 1)] == [files(there, seed) for seed in (0, 1)]


def test_names_mean_the_cold_entry_or_the_warm_one(root: Path) -> None:
    _, warm = stores(root)
    cold = trainer(str(root / "other.toml"), root)("runs", [0], 1)
    assert collect.find(collect.Selection(root / "runs", tasks=("other",)), "mlp width=16").folder == cold
    assert collect.find(collect.Selection(root / "runs"), warm.entry().label).folder == warm.path
    text = warm.entry().start
    found = collect.find(collect.Selection(root / "runs"), f"other/mlp from={text} width=16")
    assert found.folder == warm.path
    (note,) = (note for note in tables.doubts([found]) if note.startswith("warm-started, "))
    assert note.endswith(f" mlp width=16 (from {text})")


def test_seeds_begin_with_their_agents_and_all_else_is_fresh(trained: Path) -> None:
    cold, warm = stores(trained)
    begun, fresh = Trainer(warm.entry(), [0, 1]), Trainer(warm.entry(), [0, 1])
    begun.start(warm.initial([0, 1]))
    fresh.start()
    state, other = begun.algorithm.state_dict(), fresh.algorithm.state_dict()
    for seed in (0, 1):
        for name, value in cold.seed(seed).parameters().items():
            for network in ("online", "target"):
                assert np.array_equal(state[f"{network}.{name}"][seed].numpy(), value), "the target's, too"
    rest = [name for name in state if not name.startswith(("online.", "target."))]
    assert len(rest) > 3
    assert all(torch.equal(state[name], other[name]) for name in rest), "optimizer and buffer"


def test_a_critic_is_drawn_as_without(trained: Path) -> None:
    task = str(trained / "tiny.toml")
    entry = resolve(task, "mlp width=4", "ppo")
    begun, fresh, actor = Trainer(entry, [0]), Trainer(entry, [0]), Trainer(entry, [7])
    begun.start(actor.policy())
    fresh.start()
    for name, value in begun.algorithm.state_dict().items():
        own = fresh.algorithm.state_dict()[name]
        if name.startswith("actor."):
            expected = actor.algorithm.state_dict()[name]
            assert torch.equal(value, expected)
        else:
            assert torch.equal(value, own)


def test_stopped_anywhere_and_in_any_company_it_ends_with_the_same_bytes(root: Path) -> None:
    _, warm = stores(root)
    expected = [files(warm, seed) for seed in (0, 1)]
    parts = again(root, "parts", [0, 1])
    train_group(parts.path, [1], 1)
    shutil.rmtree(root / "runs")
    train_group(parts.path, [1], 2)
    train_group(parts.path, [0], 2)
    assert [files(parts, seed) for seed in (0, 1)] == expected
    cold = EntryStore.create(root / "cold", resolve(str(root / "other.toml"), "mlp width=16"))
    train_group(cold.path, [0], 2)
    assert files(cold, 0) != expected[0]


def test_the_probe_begins_alike(root: Path) -> None:
    _, warm = stores(root)
    entry = warm.entry()
    side = probe.train(entry, [1], 2, start=warm.start_of(1))
    scores = warm.seed(1).epochs()[0].scores
    assert side.lines[0]["scores"] == scores
    together = probe.train(entry, [0, 1, 2], 2, start=warm.start_of(1))
    assert together.lines[0]["scores"] == scores


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["mlp width=16", "--from", "tiny/mlp", "--seeds", "4"],
            "has the agents of seeds 0:2, and none for 2:4",
        ),
        (["mlp width=8", "--from", "tiny/mlp"], "does not fit the entry's model: 'w0' is float32 of shape"),
        (["vqc-native qubits=3", "--from", "tiny/mlp"], "does not fit the entry's model: it has no"),
        (["mlp width=16", "--from", "nothing"], "no entry 'nothing'"),
        (["mlp width=16", "--from", "beam6g/ddqn mlp width=256"], "curves without agents"),
    ],
)
def test_what_is_refused_is_said_in_one_line_and_trains_nothing(
    words: list[str], message: str, root: Path
) -> None:
    shutil.rmtree(root / "runs" / "other")
    runs = ["--runs", str(root / "runs"), "--task", str(root / "other.toml")]
    with pytest.raises(QrlSuiteError) as refused:
        say("run", *words, *runs)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not list(root.glob("runs/other/*/seed-*"))


def test_running_statistics_are_no_beginning(trained: Path) -> None:
    task = trained / "running.toml"
    task.write_text(POLE.replace("steps = 30", 'steps = 30\nnormalization = "running"'))
    entry = resolve(str(task), "reinforce mlp width=4")
    other = Trainer(entry, [1])
    with pytest.raises(OptionError, match="standardized by running statistics"):
        Trainer(entry, [0]).start(other.policy())


def test_an_agent_that_is_gone_or_damaged_is_named(root: Path) -> None:
    store = again(root, "parts", [0])
    with pytest.raises(
        StoreError, match=r"seed-0001.safetensors is missing, the agent with which seed 1 begins"
    ):
        train_group(store.path, [1], 1)
    path = store.start_of(0)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(StoreError, match="is damaged"):
        train_group(store.path, [0], 1)


def test_agents_that_are_there_stay_when_the_source_goes_on(root: Path) -> None:
    cold, warm = stores(root)
    before = warm.start_of(0).read_bytes()
    train_group(cold.path, [0, 1], 3)
    assert cold.seed(0).agent.read_bytes() != before
    plain = resolve(str(root / "other.toml"), "mlp width=16")
    begun, _ = begin_with(plain, root / "runs", "tiny/mlp", [0, 1])
    assert begun.start == f"tiny/{cold.path.name}:3"
    assert begun.hash != warm.entry().hash, "after more epochs, they are other agents"
    assert warm.start_of(0).read_bytes() == before


def test_it_is_not_published(root: Path) -> None:
    _, warm = stores(root)
    entry = collect.read_entry(warm)
    assert entry is not None
    with pytest.raises(QrlSuiteError, match="begins with the agents of another entry"):
        export(entry, root / "entries")


def test_entries_without_agents_are_as_before(train: Train) -> None:
    entry: Entry = EntryStore(train("runs", [0], 1)).entry()
    assert entry.start is None
    assert "from" not in json.dumps(EntryRecord.of(entry).content)
