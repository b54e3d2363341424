"""Published entries: written from runs, read without trust, trained again."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qrlsuite import api, registry, specs
from qrlsuite.errors import QrlSuiteError, StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.experiment.task import digest
from qrlsuite.leaderboard.boards import board, costs
from qrlsuite.leaderboard.shelf import collect, import_seeds, published, verify
from qrlsuite.leaderboard.shelf.curves import edited_between
from qrlsuite.leaderboard.shelf.export import export
from qrlsuite.results import provenance
from qrlsuite.results.store import EntryStore, table_bytes
from tests.commands import answer, say
from tests.conftest import TINY, Train, trainer
from tests.leaderboard import boards
from tests.leaderboard.boards import refused

EPOCHS = 3


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `runs`, eight seeds of a tiny task, and `entries`, the same published."""
    root = tmp_path_factory.mktemp("published")
    (root / "tiny.toml").write_text(TINY)
    publish(trainer(str(root / "tiny.toml"), root)("runs", range(8), EPOCHS), root / "entries")
    return root


def publish(runs: Path, out: Path, **options: Any) -> Path:
    entry = collect.read_entry(EntryStore(runs))
    assert entry is not None
    return export(entry, out, **options)


@pytest.fixture
def folder(trained: Path, tmp_path: Path) -> Path:
    """The published entry, in a copy that a test may change."""
    shutil.copytree(trained / "entries", tmp_path / "entries")
    return next(tmp_path.glob("entries/*/*"))


@pytest.fixture
def runs(trained: Path, tmp_path: Path) -> Path:
    """What it was published from, in a copy that a test may change."""
    shutil.copytree(trained / "runs", tmp_path / "runs")
    return next(tmp_path.glob("runs/*/*"))


def rewrite(path: Path, change: Callable[[dict[str, list[Any]]], Any]) -> None:
    """Change a parquet file's columns."""
    table = pyarrow.parquet.read_table(path)
    columns = table.to_pydict()
    change(columns)
    arrays = {name: pyarrow.array(values, table.schema.field(name).type) for name, values in columns.items()}
    pyarrow.parquet.write_table(pyarrow.table(arrays), path)


def edit(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change `entry.json`."""
    record = json.loads((folder / "entry.json").read_text())
    change(record)
    (folder / "entry.json").write_text(json.dumps(record))


SAME = [
    "name", "label", "task", "task_hash", "task_file", "parameters", "networks", "devices", "seeds", "identity",
    "executions", "preset", "versions", "processors", "options", "algorithm", "model",
]  # fmt: skip


def test_what_is_published_is_what_was_run(trained: Path) -> None:
    (one,), refused = collect.collect(collect.Selection(trained / "runs"))
    (other,), refused_there = collect.collect(collect.Selection(trained / "entries"))
    assert refused == refused_there == []
    assert np.array_equal(one.curves, other.curves)
    assert other.source == "published"
    assert {name: getattr(one, name) for name in SAME} == {name: getattr(other, name) for name in SAME}
    assert other.hours == pytest.approx(one.hours)


def test_writing_again_gives_the_same_bytes(folder: Path, trained: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    publish(next(trained.glob("runs/*/*")), tmp_path / "entries")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_names_of_hosts_are_not_exported(runs: Path, tmp_path: Path) -> None:
    """An older Dask worker's record has one, in the run and in what it replaced."""
    store = EntryStore(runs)
    for seed in store.seeds():
        record = store.seed(seed).record()
        (made,) = record.provenance
        both = [made.changed(python="3.0", host="secret-node"), made.changed(host="secret-node")]
        store.seed(seed).write_record(record.changed(provenance=both))
    text = (publish(runs, tmp_path / "entries") / "entry.json").read_text()
    assert '"before"' in text
    assert "secret-node" not in text
    assert '"host"' not in text


def test_published_seeds_are_replaced_by_a_union_or_by_force(
    folder: Path, train: Train, tmp_path: Path
) -> None:
    few, out = train("few", range(6, 10), EPOCHS), tmp_path / "entries"
    with pytest.raises(QrlSuiteError, match=r"has epochs of seeds 0:6 .* import .*few` adds them; --force"):
        publish(few, out)
    import_seeds.import_seeds(EntryStore(folder), few.parents[1])
    assert published.read(publish(few, out)).seeds == tuple(range(10))
    rewrite(folder / "curves.parquet", put("score", 0, 0.125))
    with pytest.raises(
        QrlSuiteError, match=r"seed 0 has one curve in .* and another in .*; --force replaces"
    ):
        publish(few, out)
    shorter = train("shorter", range(2), EPOCHS)
    publish(shorter, out, force=True)
    assert published.read(folder).seeds == (0, 1)


def test_the_beginning_of_a_seed_does_not_depend_on_its_company(folder: Path) -> None:
    from qrlsuite.leaderboard.shelf.fingerprint import fingerprint

    stated = published.read(folder)
    alone = fingerprint(stated.record.entry(""), [5])
    assert np.array_equal(alone.parameters[0], stated.fingerprint.parameters[5])
    assert np.array_equal(alone.episodes[0], stated.fingerprint.episodes[5])
    assert alone.before[0] == stated.fingerprint.before[5]
    assert len(np.unique(stated.fingerprint.parameters[:, 0])) == 8


def put(name: str, place: int, value: Any) -> Callable[[dict[str, list[Any]]], None]:
    def change(columns: dict[str, list[Any]]) -> None:
        columns[name][place] = value

    return change


def drop(place: int) -> Callable[[dict[str, list[Any]]], None]:
    def change(columns: dict[str, list[Any]]) -> None:
        for values in columns.values():
            del values[place]

    return change


CURVES = {
    "missing epoch": (drop(1), "seed 0 has 2 of 3 epochs"),
    "a missing last epoch": (drop(-1), "seed 7 has 2 of 3 epochs"),
    "duplicate seed": (put("seed", 3, 0), "is there twice|of 3 epochs"),
    "above one": (put("score", 4, 1.5), "outside \\[0, 1\\]"),
    "below zero": (put("score", 4, -0.1), "outside \\[0, 1\\]"),
    "not a number": (put("score", 4, float("nan")), "finite"),
    "empty cell": (put("score", 4, None), "empty cells"),
    "negative seed": (lambda c: c.update(seed=[s - 1 for s in c["seed"]]), "seed -1 is negative"),
    "other seeds": (lambda c: c.update(seed=[s + 1 for s in c["seed"]]), "hold different seeds"),
    "an epoch 0": (lambda c: c.update(epoch=[e - 1 for e in c["epoch"]]), "are missing"),
}


@pytest.mark.parametrize("case", CURVES)
def test_wrong_curves_are_refused(folder: Path, tmp_path: Path, case: str) -> None:
    change, message = CURVES[case]
    rewrite(folder / "curves.parquet", change)
    with pytest.raises(StoreError, match=str(message)):
        published.read(folder)
    assert len(collect.collect(collect.Selection(tmp_path / "entries"))[1]) == 1


def rehash(record: dict[str, Any]) -> None:
    """Make the hashes fit, as a careful forger would."""
    record["task_hash"] = digest(record["identity"]["task"])
    record["hash"] = digest(record["identity"])


def other_task(record: dict[str, Any]) -> None:
    record["identity"]["task"]["environment_options"]["degree"] = 2


RECORDS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "steps": (lambda r: r["task_file"]["protocol"].update(interactions=4), "interactions"),
    "task": (other_task, "definition does not have its hash"),
    "task rehashed": (lambda r: (other_task(r), rehash(r)), "should be|hash"),
    "options": (lambda r: r["identity"]["model_options"].update(width=17), "entry's hash"),
    "label": (lambda r: r.update(label="ddqn vqc-native qubits=14"), "its label is"),
    "hostile label": (lambda r: r.update(label="<script>alert(1)</script>"), "its label is"),
    "name": (lambda r: r.update(name="ddqn-mlp-00000000"), "named"),
    "place": (lambda r: r.update(task_name="../elsewhere"), "place|task"),
    "diverged": (lambda r: r["published"].update(diverged={"77": 1}), "diverged: {'77': 1}"),
    "probe": (
        lambda r: r["published"].update(probe={"result": "differs"}),
        "published.probe: not the result of a probe that found",
    ),
    "nothing published": (lambda r: r.pop("published"), "published"),
}


@pytest.mark.parametrize("case", RECORDS)
def test_a_record_that_lies_is_refused(folder: Path, case: str) -> None:
    change, message = RECORDS[case]
    edit(folder, change)
    with pytest.raises(StoreError, match=message):
        published.read(folder)


@pytest.mark.parametrize("name", ["curves.parquet", "seeds.parquet", "entry.json"])
def test_truncated_and_missing_files_are_refused_and_the_rest_is_ranked(
    folder: Path, tmp_path: Path, name: str
) -> None:
    bad = folder.with_name("ddqn-mlp-ffffffff")
    shutil.copytree(folder, bad)
    content = (bad / name).read_bytes()
    (bad / name).write_bytes(content[: len(content) // 2])
    (entry,), (refused,) = collect.collect(collect.Selection(tmp_path / "entries"))
    assert entry.folder == folder
    assert "ffffffff" in refused
    (bad / name).unlink()
    if name == "seeds.parquet":
        assert "seeds.parquet is missing" in collect.collect(collect.Selection(tmp_path / "entries"))[1][0]


def test_a_table_that_unpacks_to_too_much_is_not_unpacked(folder: Path) -> None:
    count = published.MAX_BYTES // 8 + 1
    zeros = pyarrow.array(np.zeros(count, np.int64))
    table = pyarrow.table({"seed": zeros, "epoch": zeros, "score": zeros.cast("float64")})
    pyarrow.parquet.write_table(table, folder / "curves.parquet", compression="zstd")
    assert (folder / "curves.parquet").stat().st_size < 100_000
    with pytest.raises(StoreError, match="unpacks to more than"):
        published.read(folder)


def test_any_bytes_are_read_or_refused(folder: Path) -> None:
    originals = {path: path.read_bytes() for path in sorted(folder.iterdir())}

    @settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def check(data: st.DataObject) -> None:
        path = data.draw(st.sampled_from(sorted(originals)))
        content = bytearray(originals[path])
        for _ in range(data.draw(st.integers(1, 8))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        path.write_bytes(bytes(content))
        with contextlib.suppress(StoreError):  # any other exception fails the test
            published.read(folder)
        path.write_bytes(originals[path])

    check()


def test_seeds_trained_again_here_are_equal(folder: Path) -> None:
    verdict = verify.verify(folder, rerun=2)
    assert verdict.ok
    assert verdict.check == "verified"
    assert len(verdict.seeds) == 2
    assert "bit for bit" in verdict.message


def added(name: str) -> Callable[[dict[str, list[Any]]], None]:
    """Add a thousandth to every number of a column."""

    def change(columns: dict[str, list[Any]]) -> None:
        columns[name] = [[x + 1e-3 for x in v] if isinstance(v, list) else v + 1e-3 for v in columns[name]]

    return change


RERUNS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "curve": (lambda f: rewrite(f / "curves.parquet", added("score")), "differs from epoch 1 on"),
    "before": (lambda f: rewrite(f / "seeds.parquet", added("before")), "score before training"),
    "parameters": (lambda f: rewrite(f / "seeds.parquet", added("parameters")), "initial parameters"),
    "episodes": (lambda f: rewrite(f / "seeds.parquet", added("episodes")), "first epoch's"),
}


@pytest.mark.parametrize("agents", [True, False])
def test_other_numbers_of_parameters_are_found_without_training(
    agents: bool, runs: Path, tmp_path: Path
) -> None:
    folder = publish(runs, tmp_path / "out", agents=agents)
    assert verify.verify(folder).ok
    edit(folder, lambda record: record["published"]["parameters"].update(classical=3))
    verdict = verify.verify(folder)
    assert not verdict.ok
    assert "its record has parameters {'classical': 3, " in verdict.message


@pytest.mark.parametrize("case", RERUNS)
def test_what_was_changed_is_found_out_by_training_again(folder: Path, case: str) -> None:
    change, message = RERUNS[case]
    change(folder)
    verdict = verify.verify(folder, rerun=1)
    assert not verdict.ok
    assert message in verdict.message
    assert case != "curve" or verdict.check == "verified"


def test_records_from_before_devices_and_plugins_were_recorded_keep_their_bits(folder: Path) -> None:
    """Those of one network of several, too: "networks" is newer than they are."""

    def older(record: dict[str, Any]) -> None:
        record["published"]["parameters"].pop("networks")
        for made in record["published"]["provenance"]:
            assert made.pop("device")["kind"] == "cpu"

    edit(folder, older)
    verdict = verify.verify(folder, rerun=1)
    assert (verdict.ok, verdict.check) == (True, "verified"), verdict.message
    assert not collect.collect(collect.Selection(folder.parent.parent))[0][0].mixed_versions


def test_curves_of_other_numerics_are_those_of_another_version(folder: Path) -> None:
    """Whether the record has a code identity, as later versions write it, or only lacks numerics."""

    def older(record: dict[str, Any]) -> None:
        for made in record["published"]["provenance"]:
            made.pop("numerics")
        for part in record["code"]["parts"]:
            part["numerics"] = 1
        record["code"]["digest"] = identity.CodeIdentity(tuple(record["code"]["parts"])).digest

    edit(folder, older)
    rewrite(folder / "curves.parquet", part)
    for _ in range(2):
        verdict = verify.verify(folder, rerun=1)
        assert (verdict.ok, verdict.check) == (True, "files"), verdict.message
        assert "(numerics 2 of the model here, 1 there)" in verdict.message
        edit(folder, lambda record: record.pop("code", None))


@pytest.mark.parametrize("cpu", [0, 2], ids=["all", "first"])
def test_epochs_of_a_gpu_are_those_of_another_machine(cpu: int, runs: Path, tmp_path: Path) -> None:
    """Its curves are not equal to the CPU's, and that is no failure; those before epochs of the CPU count, too."""
    for path in runs.glob("seed-*/run.json"):
        record = json.loads(path.read_text())
        (last,) = record["provenance"]
        gpu = {**last, "device": {"kind": "cuda", "name": "NVIDIA H100"}}
        path.write_text(json.dumps({**record, "provenance": [gpu, *[last] * cpu]}))
    again = publish(runs, tmp_path / "again")
    (found,), _ = collect.collect(collect.Selection(tmp_path / "again"))
    assert found.devices == (("cpu", "cuda") if cpu else ("cuda",))
    rewrite(again / "curves.parquet", lambda c: c.update(score=[s - 1e-6 for s in c["score"]]))
    verdict = verify.verify(again, rerun=1)
    assert (verdict.ok, verdict.check) == (True, "files"), verdict.message
    assert "trained on the CPU here, on cuda (NVIDIA H100) there" in verdict.message


def test_verification_is_no_run_that_trackers_hear_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []
    tracker = type("Tracker", (), {"run_started": lambda self, run: heard.append(run["folder"])})
    monkeypatch.setitem(sys.modules, "listening", types.SimpleNamespace(tracker=lambda target: tracker()))
    spec = specs.TrackerSpec("listening", "Hears of every run", "listening:tracker", always=True)
    known = registry.load().entries[specs.TrackerSpec]
    monkeypatch.setitem(known, "listening", registry.Registered(spec, "tests"))
    assert verify.verify(folder, rerun=1).check == "verified"
    assert heard == []


def test_what_a_seed_was_made_with_names_device_and_every_plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    known = registry.load()
    named = {"environments": "beam6g", "algorithms": "ddqn", "ansatzes": "cx", "circuit_backends": "native"}
    packages = dict(zip(named, ("pluggy", "packaging", "pydantic", "pydantic_core")))
    for kind, name in named.items():
        of_kind = known.entries[specs.kind(kind)]
        monkeypatch.setitem(of_kind, name, dataclasses.replace(of_kind[name], distribution=packages[kind]))
    made = provenance.of(resolve("beam6g", "ddqn vqc-native ansatz=cx"), torch.device("cpu"))
    assert set(packages.values()) <= made.versions.keys()
    assert made.device.content == {"kind": "cpu", "name": provenance.processor()}


def elsewhere(record: dict[str, Any]) -> None:
    for made in record["published"]["provenance"]:
        made["processor"] = "another processor"


@pytest.fixture(scope="module")
def fourteen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fourteen seeds of the tiny task, published."""
    root = tmp_path_factory.mktemp("fourteen")
    (root / "tiny.toml").write_text(TINY)
    return publish(trainer(str(root / "tiny.toml"), root)("runs", range(14), EPOCHS), root / "entries")


@pytest.fixture
def far(fourteen: Path, tmp_path: Path) -> Path:
    """The same in a copy, made on another processor."""
    folder = tmp_path / fourteen.parent.name / fourteen.name
    shutil.copytree(fourteen, folder)
    edit(folder, elsewhere)
    return folder


def part(columns: dict[str, list[Any]]) -> None:
    """Change the last bits of every score from the second epoch on."""
    columns["score"] = [s - 1e-6 * (e > 1) for s, e in zip(columns["score"], columns["epoch"])]


def test_equal_bits_are_verified_wherever_they_were_made(far: Path) -> None:
    verdict = verify.verify(far, rerun="auto")
    assert (verdict.ok, verdict.check) == (True, "verified"), verdict.message
    assert len(verdict.seeds) == verify.needed(14)
    assert "not compared: 0 of 14 seeds, hours" in verdict.message


def test_elsewhere_bits_that_differ_are_not_compared(far: Path) -> None:
    rewrite(far / "curves.parquet", part)
    verdict = verify.verify(far, rerun="auto")
    assert (verdict.ok, verdict.check) == (True, "files"), verdict.message
    assert "another processor there" in verdict.message
    assert "0 of them equal, bit for bit" in verdict.message
    assert f"not compared: bits of {verify.needed(14)} seeds" in verdict.message


def test_the_draw_is_fresh_and_can_be_repeated_but_proves_nothing_then(folder: Path) -> None:
    said: list[str] = []
    first = verify.verify(folder, rerun=2, announce=said.append)
    assert first.check == "verified"
    assert "2 of 8 seeds are trained again, core-hours" in said[0]
    again = verify.verify(folder, rerun=2, choice=first.choice)
    assert (again.seeds, again.digest) == (first.seeds, first.digest)
    assert again.check == "repeated"
    assert "is no new evidence" in again.message
    assert len({first.choice, *(verify.verify(folder, rerun=1).choice for _ in range(2))}) == 3
    edit(folder, lambda r: r.update(remark="another"))
    assert verify.verify(folder).digest != first.digest, "of other files the same number draws others"


def test_seeds_that_may_have_been_chosen_are_not_ranked(folder: Path, tmp_path: Path) -> None:
    for name in ("curves", "seeds"):
        rewrite(folder / f"{name}.parquet", lambda c: c.update(seed=[s + 5 * (s > 2) for s in c["seed"]]))
    edit(folder, lambda r: r["published"]["agents"].update(seeds=[s + 5 * (s > 2) for s in range(8)]))
    said = "5 of 13 seeds are missing: 3, 4, 5, 6, 7"
    (section,) = api.board("tiny", runs=tmp_path / "entries").sections
    assert (section.rows[0].time.ranks, said in section.as_dict()["missing"][0]) == (None, True)
    assert said in verify.verify(folder).message


def test_two_seeds_with_one_curve_are_refused(folder: Path) -> None:
    def copy(columns: dict[str, list[Any]]) -> None:
        columns["score"][3:6] = columns["score"][:3]

    rewrite(folder / "curves.parquet", copy)
    with pytest.raises(StoreError, match="seeds 0 and 1 have the same curve"):
        published.read(folder)
    rewrite(folder / "curves.parquet", lambda c: c.update(score=[0.0] * len(c["score"])))
    assert len(published.read(folder).seeds) == 8, "runs that learn nothing may be alike"


def test_what_is_published_with_the_suite_chose_no_seeds() -> None:
    for root in published.folders():
        for path in root.glob("*/*"):
            assert not published.read(path).entry_results().missing


def test_boards_of_what_comes_with_the_suite_need_neither_torch_nor_matplotlib(tmp_path: Path) -> None:
    program = (
        f"import sys; from qrlsuite import api; board = api.board('cartpole', runs={str(tmp_path)!r}, published=True); "
        "assert board.sections[0].rows; assert not {'torch', 'matplotlib', 'jinja2'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_the_reruns_own_count_decides_circuit_executions(train: Train, tmp_path: Path) -> None:
    runs = train("runs", range(2), 1, model="vqc-native", settings=("qubits=2", "layers=1"))
    folder = publish(runs, tmp_path / "entries")
    assert verify.verify(folder, rerun=1).check == "verified"
    rewrite(folder / "seeds.parquet", lambda c: c.update(executions=[1, 1]))
    verdict = verify.verify(folder, rerun=1)
    assert not verdict.ok
    assert "1 circuit executions in its record" in verdict.message


def test_fixed_instruction_sets_make_bits_comparable_across_processors(
    far: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rewrite(far / "curves.parquet", part)
    edit(far, lambda r: [made.pop("instructions", None) for made in r["published"]["provenance"]])
    for name, value in provenance.INSTRUCTIONS.items():
        monkeypatch.setenv(name, value)
    verdict = verify.verify(far, rerun=1)
    assert (verdict.ok, verdict.check) == (True, "files")
    assert "there by nothing" in verdict.message, "an entry made before says so"
    stated = dict(provenance.INSTRUCTIONS)
    edit(far, lambda r: [made.update(instructions=stated) for made in r["published"]["provenance"]])
    verdict = verify.verify(far, rerun=1)
    assert (verdict.ok, verdict.check) == (False, "verified")
    monkeypatch.delenv("MKL_CBWR")
    assert verify.verify(far, rerun=1).check == "files"


def test_the_container_fixes_the_instruction_sets_that_are_recorded() -> None:
    text = (Path(published.PUBLISHED).parents[1] / "Containerfile").read_text()
    for name, value in provenance.INSTRUCTIONS.items():
        assert f'{name}="{value}"' in text
    assert all(f"{name}==" in text for name in provenance.PACKAGES if name != "qrlsuite")


def test_the_page_says_how_many_seeds_are_trained_again() -> None:
    page = " ".join((Path(published.PUBLISHED).parents[1] / "docs" / "publish.md").read_text().split())
    said = ", ".join(f"{verify.needed(count)} of {count}" for count in (100, 20))
    assert f"probability .95: {said}." in page


def test_hours_of_published_entries_rank_nothing(folder: Path) -> None:
    assert costs.price(published.read(folder).entry_results(), "core-hours").problem


def test_commands(folder: Path, trained: Path, tmp_path: Path) -> None:
    out, runs = tmp_path / "out", str(trained / "runs")
    done = say("export", "all", "--runs", runs, "--out", str(out))
    assert done.exit_code == 0
    assert "8 seeds" in done.stdout
    done = say("verify", str(out), "--rerun", "1 choice=3", "--json")
    assert done.exit_code == 0
    (told,) = json.loads(done.stdout)["entries"]
    assert (told["choice"], told["check"]) == (3, "repeated")
    assert "seeds are trained again" in done.stderr
    done = say("verify", str(out), "--rerun", "auto")
    assert ": verified: 8 seeds trained again" in done.stdout
    assert "--rerun many: write a number of seeds" in refused("verify", out, "--rerun", "many")
    rewrite(next(out.glob("*/*")) / "curves.parquet", put("score", 0, 2.0))
    done = say("verify", str(out))
    assert done.exit_code == 1
    assert "outside [0, 1]" in done.stdout
    done = say("leaderboard", "--runs", str(tmp_path / "entries"), "--format", "csv")
    header, line = done.stdout.splitlines()
    assert header.startswith("task,horizon,rank,rank_worst,entry")
    assert line.startswith("tiny,")
    assert "export all" in refused("export", "--runs", runs)
    (tmp_path / "none").mkdir()
    said = refused("export", "all", "--runs", tmp_path / "none")
    assert "no entry was exported: qrlsuite runs --runs" in said


def test_an_entry_is_verified_from_inside_its_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for here, path in ((folder, "."), (folder.parent, folder.name), (folder.parents[1], ".")):
        monkeypatch.chdir(here)
        done = say("verify", path)
        assert done.exit_code == 0, done.stdout
        assert f"{folder.parent.name}/{folder.name}" in done.stdout


def test_own_runs_of_a_published_entry_are_shown_once(
    folder: Path, train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(published, "PUBLISHED", tmp_path / "entries")
    train("mine", range(2), EPOCHS)
    entries, refused = collect.collect(collect.Selection(tmp_path / "mine", published=True))
    assert ([len(entry.seeds) for entry in entries], refused) == ([8], [])
    train("mine", range(9), EPOCHS)
    [entry], refused = collect.collect(collect.Selection(tmp_path / "mine", published=True))
    assert (entry.seeds, entry.source, refused) == (tuple(range(9)), "runs and published", []), (
        "the seeds of both"
    )
    assert [record.published for record in entry.records.values()] == [True] * 8 + [False]
    table = EntryStore(tmp_path / "mine" / "tiny" / entry.name).seed(0).table
    table.write_bytes(table_bytes([{"epoch": epoch, "score": 0.5} for epoch in range(1, EPOCHS + 1)]))
    [entry], refused = collect.collect(collect.Selection(tmp_path / "mine", published=True))
    assert (len(entry.seeds), entry.source) == (9, "runs"), "where a seed differs, the copy with more seeds"
    assert refused[0].startswith("seed 0 has one curve in ")
    assert str(folder) in refused[0]
    assert str(tmp_path / "mine") in refused[0]
    assert refused[0].endswith(f"shown are 9 seeds of 3 epochs of the same entry, from {entry.folder}")
    other = dataclasses.replace(boards.changed(entry, name="another"), folder=tmp_path)
    compared = api.compare(entry.name, other, task="tiny", runs=tmp_path / "mine", published=True)
    assert compared.remarks[-1] == f"left out: {refused[0]}"
    assert not edited_between(entry, other)
    a, b, c = (CodeIdentity(({"role": "environment", "name": name, "distribution": "x"},)) for name in "abc")
    both = {seed: boards.changed(entry, code=code).records[seed] for seed, code in enumerate((a, b))}
    first = dataclasses.replace(entry, records=both)
    assert not edited_between(first, boards.changed(other, code=b)), "joined by --same"
    assert "was edited between" in edited_between(first, boards.changed(other, code=c))
    train("short", range(9), 1)
    entries, refused = collect.collect(collect.Selection(tmp_path / "short", published=True))
    assert [(entry.curves.shape, "(published)" in entry.label) for entry in entries] == [
        ((9, 1), False),
        ((8, 3), True),
    ], "an own entry that is shorter stands beside the published one"
    only = {("tiny", entries[0].name), ("tiny", "another")}
    asked, refused = collect.collect(collect.Selection(tmp_path / "short", published=True, only=only))
    assert [entry.label for entry in asked] == [entry.label for entry in entries], "of a study, too"
    assert refused == ["1 of the study's 2 entries: nothing is trained yet"]
    assert len(collect.collect(collect.Selection(tmp_path / "nothing", published=True))[0]) == 1


def test_tuning_seeds_are_not_ranked_and_the_record_of_tuning_is_carried(
    train: Train, tmp_path: Path
) -> None:
    runs = train("runs", [0, 1_000_000], EPOCHS)
    record = json.loads((runs / "entry.json").read_text())
    (runs / "entry.json").write_text(json.dumps({**record, "tuning": {"steps": 7}}))
    entry = collect.read_entry(EntryStore(runs))
    assert entry is not None and entry.seeds == (0,)  # noqa: PT018
    there = published.read(export(entry, tmp_path / "entries")).entry_results()
    for found in (entry, there):
        assert board.build([found]).as_dict()["sections"][0]["rows"][0]["tuning"] == {"steps": 7}


STUDY = """
format_version = 1
name = "two"
summary = "Two widths"

[[entries]]
name = "width"
task = "beam6g"
model = "mlp"
grid = { width = [16, 64] }

[[pictures]]
kind = "bars"
"""


@pytest.fixture
def two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A study of two published networks: width 64 stands on the board, width 16 does not."""
    places = {"PUBLISHED": "mlp width=64", "OF_STUDIES": "mlp width=16"}
    folders = [
        api.load(label, task="beam6g", runs="none", published=True).folder for label in places.values()
    ]
    for place, there in zip(places, folders):
        root = tmp_path / place.lower()
        shutil.copytree(there, root / "beam6g" / there.name)
        monkeypatch.setattr(published, place, root)
    path = tmp_path / "two.toml"
    path.write_text(STUDY)
    return str(path)


def test_entries_of_studies_are_found_by_name_and_by_study_only(two: str, tmp_path: Path) -> None:
    def labels(**choice: Any) -> list[str]:
        found = api.board("beam6g", runs=tmp_path, published=True, **choice)
        return sorted(row.entry.label for row in found.sections[0].rows)

    small, large = "ddqn mlp width=16", "ddqn mlp width=64"
    assert labels() == [large]
    assert labels(entries=["mlp width=16"]) == [small]
    assert labels(entries=["mlp width="]) == [large], "a beginning means an entry of the board, if it can"
    assert labels(study=two) == [small, large]
    with pytest.raises(QrlSuiteError, match=r"holds no entry of study .* --published shows"):
        api.board("beam6g", runs=tmp_path, study=two)
    with pytest.raises(QrlSuiteError, match="no entry of task cartpole"):
        api.board("cartpole", runs=tmp_path, published=True, study=two)
    with pytest.raises(QrlSuiteError, match="leave --entry out"):
        labels(study=two, entries=["mlp"])
    done = say("leaderboard", "--study", two, "--published", "--runs", str(tmp_path), "--format", "csv")
    assert [line.partition(" mlp ")[2][:8] for line in done.stdout.splitlines()[1:]] == [
        "width=64",
        "width=16",
    ]
    assert say("verify").stdout.count("ok ") == 2


def test_a_task_that_only_studies_have_entries_of_has_a_board_of_them(
    two: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.setattr(published, "PUBLISHED", tmp_path / "empty")
    runs = tmp_path / "runs"
    runs.mkdir()

    def labels(task: str | None) -> list[str]:
        found = api.board(task, runs=runs, published=True)
        assert not found.refused
        return [row.entry.label for section in found.sections for row in section.rows]

    small = "ddqn mlp width=16"
    assert labels("beam6g") == [small]
    assert labels(None) == [], "neither named nor with entries of one's own"
    assert len(api.board("beam6g", runs=runs, published=True, study=two).sections[0].rows) == 1
    api.train("beam6g", model="mlp", options={"width": 8}, seeds=2, epochs=1, runs=runs, progress=False)
    own = "ddqn mlp width=8"
    assert sorted(labels("beam6g")) == sorted(labels(None)) == [small, own]
    assert api.load("mlp width=16", runs=runs, published=True).label == small
    with pytest.raises(QrlSuiteError, match="'mlp' may be any of 'ddqn mlp width=16', 'ddqn mlp width=8'"):
        api.load("mlp", task="beam6g", runs=runs, published=True)
    assert len(api.board("beam6g", runs=runs, published=True, study=two).refused) == 1, "width 64 is absent"


def test_an_ambiguous_name_lists_entries_of_boards_where_some_fit(tmp_path: Path) -> None:
    with pytest.raises(QrlSuiteError, match=r"may be any of .*'beam6g/ddqn mlp width=64': write") as raised:
        api.load("mlp width=64", runs=tmp_path, published=True)
    assert "beam6g-a5-0" not in str(raised.value)
    with pytest.raises(QrlSuiteError, match="'ppo mlp width' may be any of 'ppo mlp width=16'"):
        api.load("ppo mlp width", task="beam6g", runs=tmp_path, published=True)


def test_a_study_is_drawn_from_published_entries(two: str, tmp_path: Path) -> None:
    words = ("plot", "picture", "--study", two, "--runs", str(tmp_path / "runs"))
    assert "study 'two' has no seeds yet" in refused(*words)
    assert set(answer(*words, "--published")["seeds"].values()) == {100}
    assert (tmp_path / "runs" / "study-two-picture.png").exists()
    assert set(answer(*words, "--published", "--seeds", "20")["seeds"].values()) == {20}
    assert "has no complete run of seed 100" in refused(*words, "--published", "--seeds", 101)
