"""What an entry's epochs take, as they took before."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from qrlsuite.experiment import identity
from qrlsuite.results import speed
from qrlsuite.results.speed import Speed
from qrlsuite.results.store import EntryStore
from tests.conftest import Train


def test_the_median_of_an_entrys_epochs_is_measured(train: Train, tmp_path: Path) -> None:
    store = EntryStore(train("runs", [0, 1], 3))

    def write(seed: int, *times: dict[str, float]) -> None:
        store.seed(seed).timings.write_text("".join(json.dumps(line) + "\n" for line in times))

    for seed in (0, 1):
        write(seed, *({"epoch": e, "train": e, "validate": 0.5} for e in (1, 2, 3)))
    spread = Speed(3.0, 3.0 / 1.25, 3.0 * 1.25)
    assert speed.find(store.entry(), None, tmp_path / "nowhere", tmp_path / "runs") == spread
    assert spread.range(10) == (24.0, 37.5)

    store.seed(1).timings.write_text(
        '{"train": "x"}\n{"train": NaN, "validate": 1}\n{"train": -1, "validate": 1}\n'
    )
    assert speed.measure(store) == spread, "what is no time is passed over"
    alone = [{"epoch": e, "train": 9.0, "validate": 1.0, "group": 1} for e in (1, 2, 3)]
    fifty = [{"epoch": e, "train": t, "validate": 0.5, "group": 50} for e, t in ((4, 1.0), (5, 0.1))]
    write(1, *alone, *fifty)
    write(0, alone[0])
    measured = speed.measure(store)
    assert measured is not None
    assert measured.seconds == pytest.approx(1.05), "a group of fifty tells more than a seed alone"
    within = 1.05 / 0.69  # of .6 and 1.5, .69 and 1.41 are the percentiles
    assert (measured.low, measured.high) == pytest.approx((1.05 / within, 1.05 * within))
    few = speed.measure(store, 5)
    assert few is not None
    assert (few.low, few.high) == pytest.approx((8.0 / 5, 12.5)), (
        "its group takes one time to five times as long"
    )
    many = speed.measure(store, 25)
    assert many is not None
    assert (many.low, many.high) == pytest.approx((1.05 / within, 2 * 1.05 * within))
    write(1)
    assert speed.measure(store) is None, "one epoch tells nothing"


def test_what_other_code_took_is_no_measure(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = EntryStore(train("runs", [0], 3)).entry()
    assert speed.find(entry, None, tmp_path / "runs") is not None
    other = identity.CodeIdentity(({"role": "model", "name": "mlp", "distribution": "x"},))
    monkeypatch.setattr(identity, "of", lambda entry: other)
    assert speed.find(entry, None, tmp_path / "runs") is None
