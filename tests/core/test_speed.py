"""Estimates of what training costs: their evidence, from the best to the weakest."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from qrlsuite.errors import TaskError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.results import speed
from qrlsuite.results.speed import Speed, Speeds
from qrlsuite.results.store import EntryStore

KIND = ("beam6g", "ddqn", "vqc-native")
REFERENCES = [Speed(KIND, {"qubits": n}, seconds) for n, seconds in ((4, 1.0), (8, 3.0), (12, 50.0))]


def vqc(qubits: int, *words: str) -> Entry:
    return resolve("beam6g", "vqc-native", settings=[parse_setting(w) for w in (f"qubits={qubits}", *words)])


def test_without_evidence_nothing_is_claimed() -> None:
    assert Speeds().estimate(vqc(4)) == speed.Estimate(None, "unknown")
    other = Speed(("cartpole", "ddqn", "vqc-native"), {"qubits": 4}, 1.0)
    assert Speeds(references=[other]).estimate(vqc(4)).basis == "unknown"


def test_a_reference_is_the_nearest_one() -> None:
    known = Speeds(references=REFERENCES)
    assert known.estimate(vqc(4)) == speed.Estimate(1.0, "reference")
    assert known.estimate(vqc(11)).seconds == 50.0
    assert known.estimate(vqc(5, "gate=u3", "environment.degree=5")).seconds == 1.0


def test_what_was_measured_scales_the_references() -> None:
    eight = vqc(8)
    measured = Speed(KIND, {"qubits": 8, "ansatz": "iqp"}, 6.0, eight.hash)
    known = Speeds([measured], REFERENCES)
    assert known.estimate(eight) == speed.Estimate(6.0, "measured")
    assert known.estimate(vqc(12)) == speed.Estimate(100.0, "scaled"), "this machine is half as fast"
    assert Speeds([measured]).estimate(vqc(12)) == speed.Estimate(6.0, "alike")


def test_the_median_of_an_entrys_epochs_is_measured(train: Callable[..., Path], tmp_path: Path) -> None:
    store = EntryStore(train("runs", [0, 1], 3))
    for seed in (0, 1):
        lines = [{"epoch": e, "train": e, "validate": 0.5} for e in (1, 2, 3)]
        store.seed(seed).timings.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = speed.gather(tmp_path / "runs")
    assert [each.seconds for each in found.measured] == [3.0], (
        "the first epoch holds the start of the process"
    )
    assert found.estimate(store.entry()) == speed.Estimate(3.0, "measured")
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
        TaskError, match=r"missing key 'speeds.0.seconds'; unknown key 'secs' in \[speeds.0\]; did you"
    ):
        speed.load(path)
    path.write_text(f'format_version = 1\nmachine = "m"\n{row}seconds = 0.5\n')
    assert speed.load(path) == [Speed(("beam6g", "ddqn", "mlp"), {}, 0.5)]
    with pytest.raises(TaskError, match=r"gone\.toml cannot be read"):
        speed.load(tmp_path / "gone.toml")
