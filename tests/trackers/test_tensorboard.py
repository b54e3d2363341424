"""The TensorBoard tracker, read with TensorBoard's own reader; and trackers that fail, which stop nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from qrlsuite import registry, specs
from qrlsuite.errors import QrlSuiteError, UnknownNameError
from qrlsuite.plugins.trackers.tensorboard import TensorBoard
from qrlsuite.testing import check
from qrlsuite.testing.tracker import RECORD, RUN
from qrlsuite.training import trackers
from tests.conftest import Train


def read(folder: Path) -> dict[str, list[tuple[int, float]]]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(folder)).Reload()
    return {tag: [(e.step, e.value) for e in found.Scalars(tag)] for tag in found.Tags()["scalars"]}


def test_every_seed_has_its_curves(train: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(trackers.TRACK, "tensorboard")
    entry = train("runs", [0, 1], epochs=1)
    train("runs", [0, 1], epochs=3)  # goes on where it stopped
    for seed in (0, 1):
        curves = read(entry / f"seed-{seed:04d}" / "tensorboard")
        assert {"validation/score", "training/loss", "training/return"} <= curves.keys()
        assert [step for step, _ in curves["validation/score"]] == [1, 2, 3]
        from qrlsuite.results.store import EntryStore

        expected = EntryStore(entry).seed(seed).read().curve
        assert [value for _, value in curves["validation/score"]] == pytest.approx(list(expected), abs=1e-6)


def test_epochs_after_a_lost_checkpoint_are_shown_once(tmp_path: Path) -> None:
    run = {**RUN, "folder": str(tmp_path / "seed-0007")}
    for begin, last in ((0, 5), (3, 6)):  # killed after epoch 5, resumed from the checkpoint of epoch 3
        tracker = TensorBoard(str(tmp_path / "board"))
        tracker.run_started({**run, "epochs": begin})
        for epoch in range(begin + 1, last + 1):
            tracker.epoch_finished(run, {**RECORD, "epoch": epoch, "loss": float(epoch)})
    curves = read(tmp_path / "board" / RUN["task"] / RUN["entry"] / "seed-0007")
    assert curves["training/loss"] == [(epoch, float(epoch)) for epoch in range(1, 7)]
    assert "training/return" not in curves  # None: there was no value


class Fails:
    def __init__(self, event: str) -> None:
        self.event = event
        self.calls: list[str] = []

    def __getattr__(self, name: str) -> Any:
        if name not in trackers.EVENTS:
            raise AttributeError(name)

        def method(*given: Any) -> None:
            self.calls.append(name)
            if name == self.event:
                raise ValueError("disk full")

        return method


MADE: list[Fails] = []


def factory(target: str | None) -> Fails:
    if target == "factory":
        raise ValueError("disk full")
    MADE.append(Fails(target or ""))
    return MADE[-1]


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = specs.TrackerSpec(name="failing", summary="Fails", factory=f"{__name__}:factory")
    monkeypatch.setitem(
        registry.load().entries[specs.TrackerSpec], "failing", registry.Registered(spec, "tests")
    )


@pytest.mark.usefixtures("failing")
@pytest.mark.parametrize("event", ["factory", *trackers.EVENTS])
def test_a_tracker_that_fails_never_stops_a_run(
    event: str, train: Train, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    MADE.clear()
    monkeypatch.setenv(trackers.TRACK, f"failing={event}\ntensorboard")
    entry = train("runs", [0, 1], epochs=2)
    assert json.loads((entry / "seed-0001" / "run.json").read_text())["status"] == "finished"
    assert len(read(entry / "seed-0001" / "tensorboard")["validation/score"]) == 2
    [message] = [record.getMessage() for record in caplog.records if "failing" in record.getMessage()]
    where = "its factory" if event == "factory" else event
    assert f"failed in {where} and is left out: ValueError: disk full" in message
    assert event == "factory" or MADE[0].calls.count(event) == 1
    [progress] = entry.glob("groups/*/progress.json")
    assert json.loads(progress.read_text())["warnings"] == [message]


def test_asking_for_what_there_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownNameError, match="unknown tracker 'tensorbord'; did you mean 'tensorboard'"):
        trackers.parse(["tensorbord"])
    with pytest.raises(QrlSuiteError, match="nothing follows '='"):
        trackers.parse(["tensorboard="])
    spec = specs.TrackerSpec("far", "Away", factory="a:b", extras={"no_such_module": "pip install far"})
    monkeypatch.setitem(registry.load().entries[specs.TrackerSpec], "far", registry.Registered(spec, "tests"))
    with pytest.raises(
        QrlSuiteError, match="tracker 'far' needs the package 'no_such_module': pip install far"
    ):
        trackers.parse(["far"])


class Changes:
    """Breaks a rule of trackers."""

    def __init__(self, target: str | None) -> None:
        if target == "target":
            raise ValueError("no such place")

    def epoch_finished(self, run: dict[str, Any], record: dict[str, Any]) -> None:
        record["loss"] = record["scores"].pop() if record["train_return"] is None else 0.0


def test_check_tells_a_tracker_the_events_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    findings = check("tracker", specs.TrackerSpec("changes", "Changes", f"{__name__}:Changes"))
    broken = {finding.rule: finding.message for finding in findings if not finding.ok}
    assert broken.keys() == {"events", "target"}
    assert "epoch_finished changes what it is given: copy it" in broken["events"]
    assert "ValueError: no such place; the factory takes 'target'" in broken["target"]
    assert all(finding.ok for finding in check("tracker", "tensorboard"))
    assert not list(tmp_path.iterdir())
