"""A seed of third-party code is trained again alone: the result, what is said, and what ends it."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.engine import probe
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.results.records import EpochLine
from qrlsuite.results.store import EntryStore, read_table, table_bytes
from tests.commands import qrlsuite, start
from tests.conftest import HANGS, install, installed, results

PLUGIN = """
from qrlsuite import hookimpl, specs

@hookimpl
def register_models(register):
    for name in ("good", "class_attribute", "growing", "changing", "waiting"):
        register(specs.ModelSpec(name, "for tests", family="classical", options="bad_plugins:Options",
                                 build=f"{'acme_waiting' if name == 'waiting' else 'bad_plugins'}:{name}"))
"""

WAITING = """
import os, sys, time
from pathlib import Path
import bad_plugins

SITE = Path(__file__).parent


def waiting(obs, out, options, generator):
    if sys.argv[0].endswith("probe.py") and not (SITE / "released").exists():
        (SITE / "probing.part").write_text(str(os.getpid()))
        (SITE / "probing.part").rename(SITE / "probing")
        while not (SITE / "released").exists():
            time.sleep(0.02)
    return bad_plugins.good(obs, out, options, generator)
"""
"""Whose building waits in the probe's process, and nowhere else."""


class Acme:
    """A folder with the distribution, and commands with it."""

    def __init__(self, folder: Path, task: str) -> None:
        self.folder, self.task, self.site = folder, task, folder / "site"
        self.site.mkdir()
        install(self.site, "acme", PLUGIN)
        shutil.copy(Path(__file__).parent / "bad_plugins.py", self.site)
        (self.site / "acme_waiting.py").write_text(WAITING)
        self.environment = installed(self.site)

    def words(self, model: str, seeds: str, *more: str, runs: str = "runs") -> list[str]:
        given = ("run", "--task", self.task, "--model", model, "--seeds", seeds, "--epochs", "3")
        return [*given, "--workers", "1", "--runs", str(self.folder / runs), *more]

    def run(self, model: str, seeds: str, *more: str, runs: str = "runs", code: int = 0) -> str:
        done = qrlsuite(*self.words(model, seeds, *more, runs=runs), env=self.environment)
        assert done.returncode == code, done.stdout + done.stderr
        return " ".join(done.stderr.split())

    def entry(self, runs: str = "runs") -> Path:
        (found,) = (self.folder / runs).glob("*/*/entry.json")
        return found.parent

    def probes(self, runs: str = "runs") -> dict[int, Any]:
        records = {path: json.loads(path.read_text()) for path in self.entry(runs).glob("seed-*/run.json")}
        return {record["seed"]: record.get("probe") for record in records.values()}


@pytest.fixture
def acme(tmp_path: Path, tiny_task: str) -> Acme:
    return Acme(tmp_path, tiny_task)


def test_a_probe_is_said_stored_and_made_once(acme: Acme) -> None:
    said = acme.run("good", "3")
    assert "probing: the middle seed of a group is trained again alone in a fresh process" in said
    assert "probed: seed 1 is the same alone, to the last bit, up to epoch 1 (" in said
    found = acme.probes()
    assert {seed: record["result"] for seed, record in found.items()} == dict.fromkeys(range(3), "equal")
    assert found[0]["seconds"] > 0 < found[0]["cpu"]
    assert re.fullmatch("[0-9a-f]{16}", found[0]["code"])
    assert list((acme.entry() / "probe" / "claims").glob("*.json")) == []

    assert "probing" not in acme.run("good", "4")
    assert acme.probes()[3] is None
    words = ("leaderboard", "--explain", "--runs", str(acme.folder / "runs"))
    shown = qrlsuite(*words, env=acme.environment).stdout
    assert "not probed" not in shown


def test_one_seed_and_two_are_probed_among_three(acme: Acme) -> None:
    assert "probed: seed 0 is the same alone" in acme.run("good", "1")
    assert "probed: seed 6 is the same alone" in acme.run("good", "5:7", runs="two")


def test_dependent_seeds_end_the_run_and_are_not_ranked(acme: Acme) -> None:
    said = acme.run("class_attribute", "4", "--workers", "1", code=2)
    assert (
        "seed 2 depends on its company: trained again in a fresh process, it differs in 'loss' of epoch 1."
        in said
    )
    assert "qrlsuite check model:class_attribute" in said
    assert {record["result"] for record in acme.probes().values()} == {"differs"}
    kept = EntryStore(acme.entry()).seed(0).epochs()
    assert len(kept) == 1, "what was trained is lost"

    again = acme.run("class_attribute", "4", code=2)
    assert "depends on its company" in again
    assert "probing" not in again
    assert EntryStore(acme.entry()).seed(0).epochs() == kept

    board = qrlsuite("leaderboard", "--runs", str(acme.folder / "runs"), env=acme.environment)
    assert "not ranked, because its seeds are not independent: trained again, seed 2 differs" in " ".join(
        (board.stdout + board.stderr).split()
    )


def test_a_variable_that_grows_ends_the_run(acme: Acme) -> None:
    """Alone and in company it is the same, since a pass is one for all seeds."""
    said = acme.run("growing", "2", code=2)
    assert "it differs in 'loss' of epoch 1, after another seed. So its seeds are not independent" in said
    assert {record["result"] for record in acme.probes().values()} == {"differs"}


@pytest.mark.parametrize("seeds", ["3", "5"], ids=["longer", "more"])
def test_what_changed_since_is_seen_and_nothing_is_lost(seeds: str, acme: Acme) -> None:
    """Not the code, but something that it uses."""
    acme.run("changing", "3", runs="straight")
    acme.run("changing", seeds, "--epochs", "4", runs="straight")
    acme.run("changing", "3")
    acme.environment["GAIN"] = "2"
    said = acme.run("changing", seeds, "--epochs", "4", code=2)
    assert "seed 1 has changed: trained again in a fresh process, it differs from its record" in said
    assert re.search(r"in '\w+' of epoch 1\. Something has changed since", said)
    assert len(list(acme.entry().glob("seed-*"))) == 3

    del acme.environment["GAIN"]
    acme.run("changing", seeds, "--epochs", "4")
    for seed in range(int(seeds)):
        assert results(acme.entry(), seed) == results(acme.entry("straight"), seed)


def test_a_table_says_the_same_as_lines(tmp_path: Path) -> None:
    first = {"epoch": 1, "scores": [0.5], "loss": None, "executions": {"a": 1}, "measured.regret": 3.0}
    lines = [first, {**first, "epoch": 2, "executions": {"a": 1, "b": 2}, "diverged": True}]
    (tmp_path / "table").write_bytes(table_bytes(lines))
    rows = [EpochLine.read(row, tmp_path).content for row in read_table(tmp_path / "table")]
    assert probe.difference(probe.Side(rows, {}), probe.Side(lines, {})) == ""
    other = [{**first, "executions": {"a": 1, "b": 1}}, lines[1]]
    assert probe.difference(probe.Side(rows, {}), probe.Side(other, {})) == "'executions.b' of epoch 1"


def test_with_other_versions_nothing_is_compared_and_that_is_said(acme: Acme) -> None:
    acme.run("changing", "1")
    (path,) = acme.entry().glob("seed-*/run.json")
    record = json.loads(path.read_text())
    record["provenance"][0]["versions"]["torch"] = "1.0"
    path.write_text(json.dumps(record))
    said = acme.run("changing", "1", "--epochs", "4")
    assert re.search(r"warning: seed 0 was not compared with its record: torch \S+ here, 1\.0 there", said)


def test_corrected_code_begins_anew_beside_dependent_seeds(acme: Acme) -> None:
    acme.run("class_attribute", "2", code=2)  # two seeds are probed before their first epoch
    assert EntryStore(acme.entry()).seed(0).epochs() == []
    path = acme.site / "bad_plugins.py"
    path.write_text(path.read_text().replace("forward(x) * ClassAttribute.gain", "forward(x)"))
    assert "2 seeds complete" in acme.run("class_attribute", "2")


def test_another_group_of_dependent_seeds_stops_too(acme: Acme) -> None:
    acme.run("class_attribute", "6", "--workers", "2", "--epochs", "100000", code=2)
    assert len(acme.probes()) == 6


def test_entries_of_earlier_versions_are_marked_until_they_are_trained_further(acme: Acme) -> None:
    acme.run("good", "3")
    for path in acme.entry().glob("seed-*/run.json"):
        record = json.loads(path.read_text())
        del record["probe"]
        path.write_text(json.dumps(record))
    words = ("leaderboard", "--explain", "--runs", str(acme.folder / "runs"))
    assert "not probed: ddqn good" in " ".join(qrlsuite(*words, env=acme.environment).stdout.split())

    assert "probed: seed 1 is the same alone" in acme.run("good", "3", "--epochs", "4")
    assert "not probed" not in qrlsuite(*words, env=acme.environment).stdout


def test_nothing_is_shown_where_nothing_is_learned(acme: Acme) -> None:
    said = acme.run("good", "3", "--set", "lr=1e-30")
    assert "not probed: no parameter has changed within 3 epochs" in said
    assert acme.probes()[0]["result"] == "not probed"


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL], ids=["interrupted", "killed"])
def test_a_probe_that_is_ended_costs_nothing(acme: Acme, end: signal.Signals) -> None:
    """The same command makes it again, and leaves the bytes of a run that nothing ended."""
    acme.run("good", "3", runs="straight")
    command = start(*acme.words("waiting", "3"), env=acme.environment)
    mark = acme.site / "probing"
    while not mark.exists():
        assert command.poll() is None, command.communicate()
        time.sleep(0.02)
    prober = int(mark.read_text())
    (claim,) = (acme.entry() / "probe" / "claims").glob("*.json")
    worker = json.loads(claim.read_text())["pid"]
    if end == signal.SIGKILL:
        os.kill(worker, end)
    command.send_signal(signal.SIGINT)
    command.wait(HANGS)
    while Path(f"/proc/{prober}").exists():  # it ends with its worker
        time.sleep(0.02)

    (acme.site / "released").touch()
    assert "probed: seed 1 is the same alone" in acme.run("waiting", "3")
    for seed in range(3):
        assert results(acme.entry(), seed) == results(acme.entry("straight"), seed)


def test_what_needs_no_probe(acme: Acme, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = resolve(acme.task, "mlp")
    store = EntryStore.create(acme.folder / "runs", entry)
    assert probe.prepare([(store.entry(), store, [0, 1, 2])], 3, "cpu") is None, "built-in"
    monkeypatch.setattr(type(entry), "third_party", lambda self: ["acme"])
    assert probe.prepare([(store.entry(), store, [TUNING_SEEDS])], 3, "cpu") is None, "for tuning"
    made = probe.prepare([(store.entry(), store, [0, 1, 2])], 3, "cpu")
    assert made is not None
    assert probe.prepare([(store.entry(), store, [3])], 3, "cpu") is None, "it is claimed"
    made.claim.release()
