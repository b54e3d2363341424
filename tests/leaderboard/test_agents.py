"""Trained agents in published entries: written, read without trust, taken over, and played."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save

from qrlsuite import api
from qrlsuite.engine.worker import train_group
from qrlsuite.errors import QrlSuiteError, StoreError
from qrlsuite.leaderboard.shelf import collect, import_seeds, published, verify
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.shelf.export import export
from qrlsuite.results.store import EntryStore
from qrlsuite.seeding import Streams
from qrlsuite.training import evaluation
from tests.commands import say
from tests.conftest import TINY, Train, trainer
from tests.leaderboard import boards
from tests.leaderboard.boards import refused

SEEDS = (0, 1, 2)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `runs`, three seeds of a tiny task, and `entries`, the same published."""
    root = tmp_path_factory.mktemp("agents")
    (root / "tiny.toml").write_text(TINY)
    store = EntryStore(trainer(str(root / "tiny.toml"), root)("runs", SEEDS, 2))
    export(read(store), root / "entries")
    return root


def read(store: EntryStore, seeds: list[int] | None = None) -> EntryResults:
    entry = collect.read_entry(store)
    assert entry is not None
    return entry if seeds is None else entry.with_seeds(seeds)


@pytest.fixture
def folder(trained: Path, tmp_path: Path) -> Path:
    """The published entry, in a copy that a test may change."""
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    return next(tmp_path.glob("entries/*/*"))


def runs_of(root: Path) -> EntryStore:
    (store,) = import_seeds.sources(root / "runs")
    return store


def state(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change what the record says of the agents."""
    record = json.loads((folder / "entry.json").read_text())
    change(record["published"])
    (folder / "entry.json").write_text(json.dumps(record))


def rewrite(folder: Path, change: Callable[[dict[str, Any]], Any], rehash: bool = True) -> None:
    """Change the agents' arrays, and, as a careful forger would, their hash."""
    path = folder / published.AGENTS
    arrays = {name: array.copy() for name, array in load(path.read_bytes()).items()}
    path.write_bytes(save(change(arrays) or arrays))
    if rehash:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        state(folder, lambda p: p["agents"].update(sha256=digest))


def test_published_agents_are_the_trained_ones_and_play_the_same_episodes(
    folder: Path, tmp_path: Path
) -> None:
    store = runs_of(tmp_path)
    agents = published.read(folder).parameters()
    for seed in SEEDS:
        own = store.seed(seed).parameters()
        assert {name: a.tobytes() for name, a in agents[seed].items()} == {
            n: a.tobytes() for n, a in own.items()
        }
    here = evaluation.trained(store, 2, 5)
    there = evaluation.trained(published.PublishedAgents(folder, tmp_path / "other"), 2, 5)
    assert (here.seeds, here.runs) == (there.seeds, there.runs)
    assert here.returns.tobytes() == there.returns.tobytes()
    assert verify.verify(folder).message.startswith("files sound: 3 seeds of 2 epochs, 3 agents, hashes")


def test_curves_alone_are_published_on_request_and_say_what_to_type(folder: Path, tmp_path: Path) -> None:
    bare = export(read(runs_of(tmp_path)), tmp_path / "bare", agents=False)
    assert sorted(path.name for path in bare.iterdir()) == ["curves.parquet", "entry.json", "seeds.parquet"]
    assert verify.verify(bare).ok
    with pytest.raises(
        StoreError, match=r"curves without agents.*; qrlsuite run --task tiny 'ddqn mlp width=16'"
    ):
        published.PublishedAgents(bare, tmp_path / "runs")
    (source,) = import_seeds.sources(bare)
    taken = import_seeds.import_seeds(source, tmp_path / "new")
    assert taken.notes[-1] == "seeds 0:3 came without agents: they cannot be evaluated"
    with pytest.raises(StoreError, match="no trained parameters"):
        evaluation.trained(taken.store, 1, 5)


def test_agents_are_added_to_an_entry_with_the_same_curves(folder: Path, tmp_path: Path) -> None:
    """Agents of fewer seeds are published, too, and the published curves do not change."""
    store = runs_of(tmp_path)
    bare = export(read(store), tmp_path / "bare", agents=False)
    before = {path.name: path.read_bytes() for path in bare.iterdir()}
    record = json.loads(before["entry.json"])
    export(read(store, [0, 2]), tmp_path / "bare")
    found = published.read(bare)
    assert found.agents == (0, 2)
    assert found.seeds == SEEDS
    stated = found.published.content
    assert len(stated["agents"]["provenance"]) == 1
    assert {**stated, "agents": None} == {**record["published"], "agents": None}
    assert all((bare / name).read_bytes() == before[name] for name in ("curves.parquet", "seeds.parquet"))
    played = evaluation.trained(published.PublishedAgents(bare, tmp_path / "runs"), 3, 5)
    assert sorted(played.seeds) == [0, 2]
    (source,) = import_seeds.sources(bare)
    taken = import_seeds.import_seeds(source, tmp_path / "new")
    assert taken.notes[-1] == "seeds 1:2 came without agents: they cannot be evaluated"
    assert sorted(evaluation.trained(taken.store, 3, 5).seeds) == [0, 2]


def test_agents_of_later_epochs_than_the_curves_are_left_out(folder: Path, tmp_path: Path) -> None:
    """Most seeds have two epochs, which are published; seed 0 was trained further."""
    store = runs_of(tmp_path)
    train_group(store.path, [0], 3)
    entry = read(store)
    assert (entry.seeds, entry.curves.shape) == (SEEDS, (3, 2))
    assert published.read(export(entry, tmp_path / "fresh")).agents == (1, 2)


def test_agents_of_other_curves_are_not_added(folder: Path, tmp_path: Path) -> None:
    store = runs_of(tmp_path)
    whole = read(store)
    bare = export(whole, tmp_path / "bare", agents=False)
    curves = whole.curves.copy()
    curves[1, 1] -= 1e-6
    with pytest.raises(QrlSuiteError, match="has one curve in"):
        export(boards.changed(whole, curves=curves), tmp_path / "bare")
    assert not published.read(bare).agents


def nudge(arrays: dict[str, Any]) -> None:
    arrays["b0"] += np.float32(1e-3)


def nan(arrays: dict[str, Any]) -> None:
    arrays["w0"][1, 0] = np.nan


CASES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "another file": (lambda f: rewrite(f, nudge, False), "is not the file"),
    "not a number": (lambda f: rewrite(f, nan), "'w0' holds a value that is not a finite number"),
    "another model": (lambda f: rewrite(f, lambda a: {**a, "b0": a["b0"][:, :-1]}), "does not fit the entry's model"),
    "fewer agents": (lambda f: rewrite(f, lambda a: {n: v[:2] for n, v in a.items()}), "does not hold the 3 agents"),
    "an odd name": (lambda f: rewrite(f, lambda a: {**a, "\x1b[2J": a["b0"]}), "controls a terminal"),
    "truncated": (
        lambda f: (f / published.AGENTS).write_bytes((f / published.AGENTS).read_bytes()[:99]),
        "agents.safetensors is damaged",
    ),
    "missing": (lambda f: (f / published.AGENTS).unlink(), "agents.safetensors is missing"),
    "not named": (lambda f: state(f, lambda p: p.pop("agents")), "entry.json does not name it"),
    "strange seeds": (lambda f: state(f, lambda p: p["agents"].update(seeds=[0, 1, 9])), "are its seeds"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_wrong_agents_are_refused_by_verify_and_import(case: str, folder: Path, tmp_path: Path) -> None:
    change, message = CASES[case]
    change(folder)
    found = verify.verify(folder)
    assert not found.ok
    assert message in found.message
    assert "\x1b" not in found.message
    if case != "another model":  # is said where they are played: an import builds no model
        (source,) = import_seeds.sources(folder)
        with pytest.raises(StoreError):
            import_seeds.import_seeds(source, tmp_path / "new")
        assert not (tmp_path / "new").exists()


def test_a_file_of_any_size_is_not_read(folder: Path, tmp_path: Path) -> None:
    with (folder / published.AGENTS).open("ab") as file:
        file.truncate(50_000_000_000)  # a hole, of no blocks
    assert "50,000,000,000 bytes, more than 20,000,000: it is not read" in verify.verify(folder).message
    path = runs_of(tmp_path).seed(0).agent
    with path.open("ab") as file:
        file.truncate(50_000_000_000)
    with pytest.raises(StoreError, match="more than 200,000,000: it is not read"):
        runs_of(tmp_path).seed(0).parameters()


def test_parameters_that_are_no_numbers_are_not_played(folder: Path, tmp_path: Path) -> None:
    seed = runs_of(tmp_path).seed(1)
    arrays = {name: array.copy() for name, array in load(seed.agent.read_bytes()).items()}
    arrays["w0"][0] = np.inf
    seed.agent.write_bytes(save(arrays))
    with pytest.raises(StoreError, match="'w0' holds a value that is not a finite number"):
        evaluation.trained(runs_of(tmp_path), 3, 5)
    seed.write_record(seed.record().changed(diverged=2))  # of a run that diverged it is known
    assert len(evaluation.trained(runs_of(tmp_path), 3, 5).seeds) == 3
    assert published.read(export(read(runs_of(tmp_path)), tmp_path / "fresh")).agents == (0, 2)


def test_a_forged_agent_is_found_by_training_again(folder: Path) -> None:
    assert verify.verify(folder, rerun=3).check == "verified"
    rewrite(folder, nudge)
    found = verify.verify(folder, rerun=3)
    assert not found.ok
    assert "trained again is another agent than the published one" in found.message


OTHER = TINY.replace("degree = 3", "degree = 2").replace('name = "tiny"', 'name = "other"')


def test_agents_play_another_task_as_that_tasks_own_would(folder: Path, tmp_path: Path) -> None:
    """Put into the folder of an entry that was trained there, the same parameters earn the same."""
    (tmp_path / "other.toml").write_text(OTHER)
    there = EntryStore(trainer(str(tmp_path / "other.toml"), tmp_path)("runs", SEEDS, 2))
    here = EntryStore(next(tmp_path.glob("runs/tiny/*")))
    before = {seed: there.seed(seed).agent.read_bytes() for seed in SEEDS}
    for seed in SEEDS:
        there.seed(seed).agent.write_bytes(here.seed(seed).agent.read_bytes())
    swapped = evaluation.trained(there, 3, 20)
    for seed in SEEDS:
        there.seed(seed).agent.write_bytes(before[seed])
    found = api.evaluate(
        ["tiny/mlp", "mlp"], task="other", best=3, episodes=20, runs=tmp_path / "runs", progress=False
    )
    transferred, own, *references = found.policies
    assert (found.task, transferred.name) == ("other", "ddqn mlp width=16 (trained on tiny)")
    for row, seed in enumerate(transferred.seeds):
        assert np.array_equal(transferred.returns[row], swapped.returns[swapped.seeds.index(seed)])
    assert not np.array_equal(transferred.returns, own.returns)
    assert references[0].returns.tobytes() == evaluation.references(there.entry(), 20)[0].returns.tobytes()
    words = ["evaluate", folder, "--task", tmp_path / "other.toml", "--runs", tmp_path / "runs", "--json"]
    result = say(*map(str, words), "--best", "3", "--episodes", "20")
    assert json.loads(result.stdout)["policies"][0]["return"] == transferred.summary()["return"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["tiny/mlp", "--task", "cartpole"], "observations are Box(0.0, 1.0, (3,), float32), but here"),
        (["mlp", "--task", "cartpole"], "write 'tiny/mlp'"),
        (["nothing", "--task", "cartpole"], "no entry 'nothing'"),
        (["mlp", "--task", "cartpol"], "did you mean 'cartpole'"),
        (["mlp", "--perturb", "-1"], "give a relative size"),
        (["mlp", "--perturb", "nan"], "give a relative size"),
        (["beam6g/ddqn mlp width=256", "--published"], "is published as curves without agents"),
    ],
)  # fmt: skip
def test_what_agents_cannot_play_is_said_in_one_line(
    words: list[str], message: str, folder: Path, tmp_path: Path
) -> None:
    assert message in refused("evaluate", *words, "--runs", tmp_path / "runs")


def test_perturbed_numbers_are_as_large_as_asked_for_and_drawn_anew(folder: Path, tmp_path: Path) -> None:
    store = runs_of(tmp_path)
    entry = store.entry()
    agents = evaluation.trained_agents(entry, store, [0, 1])
    exact = {name: value.clone() for name, value in agents.algorithm.policy_state().items()}
    shake = evaluation._perturbing(agents, 0.1, Streams(entry.task.hash, 0))

    def noise(block: int) -> np.ndarray:
        shake(block)
        state = agents.algorithm.policy_state()
        return np.hstack([((state[n] / v - 1) / 0.1).flatten(1).numpy() for n, v in exact.items()])

    first = noise(0)
    assert np.isfinite(first).all()
    assert abs(first.mean()) < 0.2
    assert 0.85 < first.std() < 1.15
    agents.algorithm.act(np.zeros((2, 1, 3), np.float32))  # a first pass moves the parameters in memory
    assert not np.allclose(first, noise(1), atol=0.1)
    assert np.array_equal(first, noise(0)), "of the trained numbers, not of the perturbed ones"
    assert not np.allclose(first[0], first[1], atol=0.1), "each agent has its own"


def test_perturbed_agents_do_not_depend_on_their_company(folder: Path, tmp_path: Path) -> None:
    store = runs_of(tmp_path)
    together = evaluation.trained(store, 3, 20, perturb=0.5)
    alone = evaluation.trained(store, 1, 20, perturb=0.5)
    assert together.name == "ddqn mlp width=16 perturbed 0.5"
    assert np.array_equal(together.returns[:1], alone.returns)
    exact = evaluation.trained(store, 3, 20)
    assert not np.array_equal(together.returns, exact.returns)
    found = api.evaluate(
        str(folder), best=3, episodes=20, perturb=[0.5, 0.25], runs=tmp_path / "runs", progress=False
    )
    assert np.array_equal(found.policies[1].returns, together.returns)
    assert found.policies[2].name == "ddqn mlp width=16 perturbed 0.25"


def test_published_circuits_act_with_shots_and_nothing_is_written_beside_them(
    train: Train, tmp_path: Path
) -> None:
    store = EntryStore(train("runs", [0, 1], 1, "vqc-native", settings=("qubits=3", "layers=1")))
    folder = export(read(store), tmp_path / "entries")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    arguments: dict[str, Any] = {"best": 2, "episodes": 10, "backend": "native shots=10", "progress": False}
    here = api.evaluate(str(store.path), runs=tmp_path / "runs", **arguments)
    there = api.evaluate(str(folder), runs=tmp_path / "fresh", **arguments)
    assert [each.name for each in here.policies] == [each.name for each in there.policies]
    assert np.array_equal(here.policies[1].returns, there.policies[1].returns)
    assert not np.array_equal(there.policies[0].returns, there.policies[1].returns)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert len(list((tmp_path / "fresh").glob("*/*/evaluations-*/*.jsonl"))) == 1
