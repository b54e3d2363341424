"""`qrlsuite import`: seeds trained elsewhere count as trained here, and only what is missing is trained."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qrlsuite.engine.worker import train_group
from qrlsuite.errors import StoreError
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard.shelf import collect, import_seeds
from qrlsuite.leaderboard.shelf.export import export
from qrlsuite.options import parse_setting
from qrlsuite.results import checkpoint
from qrlsuite.results.claims import SeedsClaimedError, acquire
from qrlsuite.results.seeds import plan_groups
from qrlsuite.results.store import EntryStore, table_bytes, write_atomically
from tests.conftest import TINY

TUNING = {"trials": 3, "seeds": "1000000:1000004", "changed": []}


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("task") / "tiny.toml"
    path.write_text(TINY)
    return str(path)


def create(task: str, runs: Path, *settings: str) -> EntryStore:
    words = [parse_setting(word) for word in ("width=4", "depth=1", *settings)]
    return EntryStore.create(runs, resolve(task, "mlp", settings=words))


@pytest.fixture(scope="module")
def elsewhere(task: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of two epochs, settings tuned; copied by tests that change it."""
    runs = tmp_path_factory.mktemp("elsewhere") / "runs"
    store = create(task, runs)
    record = json.loads((store.path / "entry.json").read_text())
    (store.path / "entry.json").write_text(json.dumps({**record, "tuning": TUNING}))
    train_group(store.path, [0, 1], 2)
    return runs


@pytest.fixture(scope="module")
def exported(elsewhere: Path) -> Path:
    out = elsewhere.parent / "entries"
    (found,), _ = collect.collect(collect.Selection(elsewhere))
    return export(found, out)


@pytest.fixture
def copied(elsewhere: Path, tmp_path: Path) -> EntryStore:
    shutil.copytree(elsewhere, tmp_path / "copied")
    (store,) = import_seeds.sources(tmp_path / "copied")
    return store


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def take(source: Path, runs: Path) -> import_seeds.Imported:
    (found,) = import_seeds.sources(source)
    return import_seeds.import_seeds(found, runs)


def test_only_what_is_missing_is_trained_and_seeds_go_on(elsewhere: Path, task: str, tmp_path: Path) -> None:
    """Here seed 1 is trained already; seed 0 is taken over, and later trained to more epochs."""
    runs = tmp_path / "runs"
    own = create(task, runs)
    train_group(own.path, [1], 2)
    before = files(own.seed(1).path)
    done = take(elsewhere, runs)
    assert (done.new, done.known, done.notes) == ((0,), (1,), ())
    (source,) = import_seeds.sources(elsewhere)
    assert files(own.seed(0).path) == files(source.seed(0).path)
    assert files(own.seed(1).path) == before
    assert [group.seeds for group in plan_groups(own, range(3), 2, 1)] == [(2,)]
    assert own.record().tuning.trials == 3, "the record of tuning travels"
    assert (take(elsewhere, runs).new, own.seeds()) == ((), [0, 1])
    train_group(own.path, [0], 3)
    straight = create(task, tmp_path / "straight")
    train_group(straight.path, [0], 3)
    for name in ("epochs.parquet", "final.safetensors"):
        assert files(own.seed(0).path)[name] == files(straight.seed(0).path)[name]


def test_an_exported_entry_counts_with_the_same_curves(
    exported: Path, elsewhere: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    done = take(exported, runs)
    assert done.new == (0, 1)
    assert done.notes == ("an export holds no checkpoints: these seeds cannot be trained to more epochs",)
    (source,) = import_seeds.sources(elsewhere)
    for s in (0, 1):
        assert done.store.seed(s).agent.read_bytes() == source.seed(s).agent.read_bytes()
    (here,), _ = collect.collect(collect.Selection(runs))
    (there,), _ = collect.collect(collect.Selection(elsewhere))
    assert np.array_equal(here.curves, there.curves)
    assert here.hours == pytest.approx(there.hours)
    for name in ("seeds", "label", "tuning", "parameters", "versions"):
        assert getattr(here, name) == getattr(there, name)
    assert plan_groups(done.store, range(2), 2, 1) == []
    train_group(done.store.path, [2], 2)
    (more,), _ = collect.collect(collect.Selection(runs))
    assert more.seeds == (0, 1, 2)
    with pytest.raises(StoreError, match="cannot be extended"):
        train_group(done.store.path, [0], 3)
    assert take(elsewhere, runs).known == (0, 1), "no seed twice"


def test_scores_above_one_keep_every_digit(tmp_path: Path) -> None:
    """Returns of hundreds have no seven decimals in float32."""
    store = EntryStore(tmp_path).seed(0)
    write_atomically(store.table, table_bytes([{"epoch": 1, "score": 487.1234567}]))
    assert store.read().curve.tolist() == [487.1234567]


@pytest.mark.parametrize("kind", ["runs", "export"])
def test_stopped_anywhere_it_goes_on(
    kind: str, elsewhere: Path, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped before the second seed is renamed into its place: the half copy is no seed, and is replaced."""
    source, runs = (elsewhere if kind == "runs" else exported), tmp_path / "runs"
    rename, renamed = Path.rename, list[Path]()

    def interrupted(self: Path, target: Path) -> Path:
        if self.name.endswith(".import"):
            renamed.append(self)
            if len(renamed) == 2:
                (self / "run.json").write_text("{")  # as if killed while writing
                raise KeyboardInterrupt
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", interrupted)
        with pytest.raises(KeyboardInterrupt):
            take(source, runs)
    (store,) = import_seeds.sources(runs)
    assert store.seeds() == [0]
    done = take(source, runs)
    assert (done.new, done.known) == ((1,), (0,))
    assert not list(store.path.glob(".seed*"))
    if kind == "runs":
        assert set(checkpoint.latest(store)) == {0, 1}
    (here,), _ = collect.collect(collect.Selection(runs))
    assert here.seeds == (0, 1)


def test_a_seed_that_differs_stays_as_it_is_here(copied: EntryStore, elsewhere: Path, tmp_path: Path) -> None:
    take(elsewhere, tmp_path / "runs")
    folder = copied.seed(1)
    first, *later = folder.epochs()
    rows = [first.changed(scores=[0.5] * len(first.scores)).content, *(line.content for line in later)]
    folder.table.write_bytes(table_bytes(rows))
    done = import_seeds.import_seeds(copied, tmp_path / "runs")
    assert done.notes == (
        f"seeds 1:2 have other curves in {copied.path} than in {done.store.path}: yours stay, until `qrlsuite runs rm` "
        "removes the entry",
    )


def test_a_longer_seed_without_an_agent_takes_none_away(
    copied: EntryStore, elsewhere: Path, tmp_path: Path
) -> None:
    here = take(elsewhere, tmp_path / "runs").store.seed(1)
    before = files(here.path)
    train_group(copied.path, [1], 3)
    copied.seed(1).agent.unlink()
    done = import_seeds.import_seeds(copied, tmp_path / "runs")
    assert (done.new, done.known) == ((), (0, 1))
    assert done.notes[0].endswith("without their agents: yours stay")
    assert files(here.path) == before


@pytest.mark.parametrize("renames", range(3))
def test_a_killed_replacement_loses_no_seed(
    renames: int, copied: EntryStore, elsewhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after so many renames: the next command finds two epochs or three, and the import can be repeated."""
    store = take(elsewhere, tmp_path / "runs").store
    train_group(copied.path, [1], 3)
    rename, left = Path.rename, [renames]

    def killed(self: Path, target: Path) -> Path:
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            import_seeds.import_seeds(copied, tmp_path / "runs")
    assert store.seeds() == [0, 1]
    assert store.seed(1).read().epochs == (3 if renames == 2 else 2)
    import_seeds.import_seeds(copied, tmp_path / "runs")
    assert files(store.seed(1).path) == files(copied.seed(1).path)


def test_seeds_in_training_are_left_there(copied: EntryStore, task: str, tmp_path: Path) -> None:
    claim = acquire(copied, [1])
    done = import_seeds.import_seeds(copied, tmp_path / "runs")
    assert done.new == (0,)
    assert "seeds 1:2 are left there: they are being trained" in done.notes[0]
    claim.release()
    claim = acquire(done.store, [0])
    with pytest.raises(SeedsClaimedError):
        import_seeds.import_seeds(copied, tmp_path / "runs")
    claim.release()


def test_other_versions_are_named(copied: EntryStore, tmp_path: Path) -> None:
    path = copied.seed(0).path / "run.json"
    record = json.loads(path.read_text())
    record["provenance"][0]["versions"]["torch"] = "0.9"
    path.write_text(json.dumps(record))
    (note,) = import_seeds.import_seeds(copied, tmp_path / "runs").notes
    assert note.startswith("made with torch ")
    assert "0.9" in note


def change(store: EntryStore, path: str, **values: Any) -> None:
    file = store.path / path
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


@pytest.mark.parametrize(
    ("path", "values", "message"),
    [
        ("entry.json", {"hash": "0" * 16}, "the options do not have the entry's hash"),
        ("entry.json", {"plan": "0" * 16}, "belongs to a study with looks"),
        ("entry.json", {"imported": True}, "holds curves that another program made"),
        ("seed-0001/run.json", {"task_hash": "0" * 16}, "does not say that it is seed 1 of"),
        ("seed-0001/run.json", {"seed": 7}, "does not say that it is seed 1 of"),
        ("seed-0001/run.json", {"epochs": 9}, "finished 9 epochs and holds 2"),
    ],
)
def test_what_is_refused_leaves_nothing(
    path: str, values: dict[str, Any], message: str, copied: EntryStore, tmp_path: Path
) -> None:
    change(copied, path, **values)
    with pytest.raises(StoreError, match=message) as refused:
        import_seeds.import_seeds(copied, tmp_path / "runs")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "runs").exists()


def test_another_definition_of_the_task_is_refused(elsewhere: Path, tmp_path: Path) -> None:
    other = tmp_path / "tiny.toml"
    other.write_text(TINY.replace("validation_episodes = 5", "validation_episodes = 6"))
    create(str(other), tmp_path / "runs")
    with pytest.raises(StoreError, match="was made under another definition of task 'tiny'"):
        take(elsewhere, tmp_path / "runs")


def test_wrong_folders(elsewhere: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("nowhere", "empty"):
        with pytest.raises(StoreError, match="holds no entry: give a results folder"):
            take(tmp_path / name, elsewhere)
    with pytest.raises(StoreError, match="itself: there is nothing to import"):
        take(elsewhere, elsewhere)
