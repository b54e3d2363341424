"""Estimates of what training costs: their evidence, from the best to the weakest."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

import qrlsuite
from qrlsuite import registry
from qrlsuite.errors import FileError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.leaderboard.shelf import published
from qrlsuite.results import provenance, speed
from qrlsuite.results.speed import Estimate, Speed, Speeds
from qrlsuite.results.store import EntryStore
from qrlsuite.specs import StudySpec
from tests.conftest import Train

KIND = ("beam6g", "ddqn", "vqc-native")
REFERENCES = [Speed(KIND, {"qubits": n}, seconds) for n, seconds in ((4, 1.0), (8, 3.0), (12, 50.0))]


def vqc(qubits: int, *words: str) -> Entry:
    return resolve("beam6g", " ".join((f"vqc-native qubits={qubits}", *words)))


def test_without_evidence_nothing_is_claimed() -> None:
    assert Speeds().estimate(vqc(4), 1) == Estimate(None, "unknown")
    assert Estimate(None, "unknown").range(10) is None
    other = Speed(("cartpole", "ddqn", "vqc-native"), {"qubits": 4}, 1.0)
    assert Speeds(references=[other]).estimate(vqc(4), 1).basis == "unknown"


def test_a_reference_is_the_nearest_one() -> None:
    known = Speeds(references=REFERENCES)
    assert known.estimate(vqc(4), 1) == Estimate(1.0, "reference", 3.0)
    assert known.estimate(vqc(11), 1).seconds == 50.0
    assert known.estimate(vqc(5, "gate=u3", "environment.degree=5"), 1).seconds == 1.0


def test_exact_circuits_say_nothing_about_sampled_ones() -> None:
    exact, sampled, guessed = vqc(4), vqc(4, "shots=100"), vqc(4, "shots=100", "gradient=spsa")
    known = Speeds([Speed(KIND, {"qubits": 4, "ansatz": "iqp"}, 0.1, exact.hash)], REFERENCES)
    assert known.estimate(sampled, 1).basis == "unknown"
    known.references = [*REFERENCES, Speed(KIND, {"qubits": 4, "shots": 1000}, 8.0)]
    assert known.estimate(sampled, 1) == Estimate(8.0, "reference", 3.0)
    assert known.estimate(guessed, 1).basis == "unknown"


def test_what_was_measured_here_is_a_row_of_the_table() -> None:
    eight = vqc(8)
    measured = Speed(KIND, {"qubits": 8, "ansatz": "iqp"}, 6.0, eight.hash, within=1.5)
    known = Speeds([measured], REFERENCES)
    assert known.estimate(eight, 1) == Estimate(6.0, "measured", 1.5)
    assert known.estimate(vqc(9), 1) == Estimate(6.0, "reference", 3.0)
    assert known.estimate(vqc(12), 1) == Estimate(50.0, "reference", 3.0)
    assert Speeds([measured]).estimate(vqc(12), 1) == Estimate(6.0, "reference", 3.0)


def test_the_worse_the_evidence_the_wider_the_range() -> None:
    assert Estimate(6.0, "measured", 1.5).range(10) == (40.0, 90.0)
    assert 1 < speed.WITHIN["measured"] < speed.WITHIN["reference"]


def test_a_seed_s_share_depends_on_the_size_of_its_group() -> None:
    """An epoch of a group costs 10 s and 1 s per seed: 11 s alone, 2 s in a group of ten, 1.5 s in one of twenty."""
    known = Speeds(references=[Speed(KIND, {"qubits": 8}, 2.0, group=10, alone=11.0)])
    assert [known.estimate(vqc(8), size).seconds for size in (1, 10, 20)] == pytest.approx([11.0, 2.0, 1.5])
    eight = vqc(8)
    known.measured = [Speed(KIND, {"qubits": 8}, 22.0, eight.hash)]
    assert known.estimate(eight, 2).basis == "measured", "two seeds are nearly as few as one"
    assert known.estimate(eight, None).basis == "measured", "there is nothing to train of it"
    assert known.estimate(eight, 10) == Estimate(2.0, "reference", 3.0), (
        "one seed alone says nothing about ten"
    )
    known.references = []
    assert known.estimate(eight, 10) == Estimate(None, "unknown")


def test_references_are_scaled_by_the_calibrations_of_both_machines() -> None:
    calls = []
    rows = [Speed(KIND, {"qubits": 8}, 3.0, calibration=0.5)]
    known = Speeds(references=rows, calibrate=lambda: calls.append(1) or 1.5)  # type: ignore[func-returns-value]
    assert known.estimate(vqc(8), 1).seconds == 9.0, "this machine takes three times as long"
    known.measured = [Speed(KIND, {"qubits": 8}, 2.0)]
    assert known.estimate(vqc(8), 1).seconds == 2.0
    assert len(calls) == 1, "what was measured here needs no calibration"


def test_a_calibration_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QRLSUITE_CACHE", str(tmp_path))
    monkeypatch.setattr(speed, "PRODUCTS", 2)
    kept = tmp_path / "qrlsuite" / "speed.json"
    calibration = speed.calibration.__wrapped__
    first = calibration()
    assert first > 0
    (key,) = json.loads(kept.read_text())
    assert key == f"{provenance.processor()}, qrlsuite {qrlsuite.__version__}"
    kept.write_text(json.dumps({key: 7.0, "another processor, qrlsuite 0.0.1": 3.0}))
    assert calibration() == 7.0
    for damaged in ('{"', "[1]", json.dumps({key: "x"}), json.dumps({key: -1}), "\xff"):
        kept.write_text(damaged, encoding="latin-1")
        assert 0 < calibration() < 7.0, damaged
        assert json.loads(kept.read_text())[key] > 0, "measured anew, and kept"
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("QRLSUITE_CACHE", str(tmp_path / "file"))
    assert calibration() > 0, "no folder to keep it in"


def test_the_reference_speeds_agree_with_the_hours_of_published_entries() -> None:
    """Of every published entry: its seconds per seed and epoch lie in the range that the reference speeds give."""
    (path,) = {
        Path(registered.spec.speeds)
        for registered in registry.load().of(StudySpec).values()
        if registered.spec.speeds
    }
    known = Speeds(references=[replace(row, calibration=None) for row in speed.load(path)])
    found = [file for folder in published.folders() for file in folder.glob("*/*/entry.json")]
    checked = 0
    for file in found:
        record = EntryStore(file.parent).record()
        hours = record.published
        assert hours is not None
        if {origin.device.kind for origin in hours.provenance} != {"cpu"}:
            continue  # hours of a GPU are no core-hours
        entry = record.entry(str(file))
        if any(origin.numerics.get("model", 1) != entry.model.numerics for origin in hours.provenance):
            continue  # trained by other code
        checked += 1
        seconds = hours.core_hours * 3600 / hours.seeds / hours.epochs
        low, high = known.estimate(entry, min(hours.seeds, 50)).range(1) or (0.0, 0.0)
        assert low <= seconds <= high, (record.label, seconds, low, high)
    assert checked >= 37


def test_the_median_of_an_entrys_epochs_is_measured(train: Train, tmp_path: Path) -> None:
    store = EntryStore(train("runs", [0, 1], 3))
    for seed in (0, 1):
        lines = [{"epoch": e, "train": e, "validate": 0.5} for e in (1, 2, 3)]
        store.seed(seed).timings.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = speed.gather(tmp_path / "runs")
    assert [each.seconds for each in found.measured] == [3.0], (
        "the first epoch holds the start of the process"
    )
    assert found.estimate(store.entry(), 1) == Estimate(3.0, "measured", 1.25)
    assert found.measured[0].options["antennas"] == 3, "a list counts by its length"

    store.seed(1).timings.write_text(
        '{"train": "x"}\n{"train": NaN, "validate": 1}\n{"train": -1, "validate": 1}\n'
    )
    found.note(store)
    assert [each.seconds for each in found.measured] == [3.0], "what is no time is passed over"
    assert all(math.isfinite(each.seconds) for each in found.measured)
    alone = [
        {"epoch": e, "train": 1.0, "validate": 0.5, "group": g} for e, g in ((1, 1), (2, 1), (3, 1), (4, 50))
    ]
    store.seed(1).timings.write_text(
        "".join(json.dumps(line) + "\n" for line in [*alone, {**alone[3], "train": 0.1}])
    )
    store.seed(0).timings.write_text(json.dumps(alone[0]) + "\n")
    measured = speed.measure(store)
    assert measured is not None
    assert measured.seconds == pytest.approx(1.05), "a group of fifty tells more than a seed alone"
    assert measured.group == 50
    assert measured.within == pytest.approx(1.05 / 0.69), "of .6 and 1.5, .69 and 1.41 are the percentiles"
    store.seed(1).timings.unlink()
    assert speed.measure(store) is None, "one epoch tells nothing"
    (store.path / "entry.json").write_text("{")
    assert speed.gather(tmp_path / "runs").measured == [], "a damaged entry tells nothing and stops nobody"
    assert speed.gather(tmp_path / "nowhere").measured == []


def test_files_of_speeds(tmp_path: Path) -> None:
    path = tmp_path / "speeds.toml"
    row = '[[speeds]]\nenvironment = "beam6g"\nalgorithm = "ddqn"\nmodel = "mlp"\n'
    path.write_text(f'format_version = 1\nmachine = "m"\n{row}secs = 3\n')
    with pytest.raises(
        FileError, match=r"missing key 'speeds.0.seconds'; unknown key 'secs' in \[speeds.0\]; did you"
    ):
        speed.load(path)
    path.write_text(f'format_version = 1\nmachine = "m"\n{row}seconds = 0.5\n')
    assert speed.load(path) == [Speed(("beam6g", "ddqn", "mlp"), {}, 0.5)], "as files of earlier versions are"
    path.write_text(
        f'format_version = 1\nmachine = "m"\ncalibration = 0.2\n{row}seconds = 0.5\ngroup = 4\nalone = 1.5\n'
    )
    (read,) = speed.load(path)
    assert (read.group, read.alone, read.calibration) == (4, 1.5, 0.2)
    with pytest.raises(FileError, match=r"gone\.toml cannot be read"):
        speed.load(tmp_path / "gone.toml")
