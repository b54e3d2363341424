"""How many seeds find a difference: from results, with what they cost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.errors import OptionError, UnknownNameError
from qrlsuite.experiment.entry import resolve
from qrlsuite.results.records import RunRecord
from qrlsuite.results.store import EntryStore, json_line, table_bytes
from tests.commands import say
from tests.conftest import TINY

EPOCHS = 20


def put(width: int, *starts: int, epochs: int = EPOCHS, runs: str = "runs", first: int = 0) -> None:
    """Leave an entry of finished runs that reach every threshold at some epoch, 0.5 seconds an epoch."""
    store = EntryStore.create(Path(runs), resolve("tiny.toml", f"mlp width={width}"))
    for seed, start in enumerate(starts, first):
        folder = store.seed(seed)
        rows = [{"epoch": t, "scores": [0.5 * (t >= start)] * 5} for t in range(1, epochs + 1)]
        folder.path.mkdir()
        folder.table.write_bytes(table_bytes(rows))
        times = {"train": 0.4, "validate": 0.1, "group": 1}
        folder.timings.write_bytes(b"".join(json_line({"epoch": t, **times}) for t in range(1, epochs + 1)))
        folder.write_record(RunRecord(seed=seed, **store.names, status="finished", epochs=epochs))


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(TINY)


def power(*words: str) -> str:
    return say("power", *words, "--draws", "20").stdout


def test_an_entry_alone_and_against_another() -> None:
    """Runs that hardly differ: 20 seeds, the fewest, find 50 percent. Both entries cost 20 epochs of half a second."""
    put(16, *([10, 11] * 10))
    put(8, *([14, 15] * 10))
    content = json.loads(power("mlp width=8", "mlp width=16", "--json"))
    assert content["horizon"] == EPOCHS * 60
    rows: list[dict[str, Any]] = content["needs"]
    assert [row["power"] for row in rows] == [0.8, 0.9] * 4
    assert rows[0]["difference"] == "ddqn mlp width=8 against ddqn mlp width=16: 42% slower"
    half = rows[-1]
    assert half["difference"] == "50% slower than ddqn mlp width=8"
    assert (half["fixed_seeds"], half["looks"], half["mean_seeds"]) == (20, [20], 20)
    assert half["fixed_core_hours"] == pytest.approx(20 * 2 * EPOCHS * 0.5 / 3600)
    shown = power("mlp width=16")
    assert "10% slower than ddqn mlp width=16" in shown
    assert "Simulated from 20 seeds of ddqn mlp width=16" in shown


def test_what_cannot_be_planned_from_is_refused() -> None:
    put(16, 10)
    put(8, 10, 11, epochs=15)
    with pytest.raises(OptionError, match=r"'ddqn mlp width=16' has a single seed"):
        power("mlp width=16")
    with pytest.raises(UnknownNameError, match="no entry 'mpl'"):
        power("mpl")


def test_a_weak_pilot_is_marked_and_the_shorter_horizon_said() -> None:
    put(16, 6, 7, 8)
    put(8, 10, 11, 12, epochs=15)
    shown = power("mlp width=16", "mlp width=8")
    assert "900 steps, 20 pairs per line" in shown
    assert "Fewer than 20 seeds are a weak pilot" in shown


def test_a_study_that_has_not_begun_says_the_power_of_its_claims() -> None:
    """Runs that differ by a tenth: half of the steps is found at the first look."""
    put(4, *([2, 10, 18] * 10))  # on a board; the spread of the study's own entry in its search counts
    put(8, *([9, 10, 11] * 10), runs="runs/tuning", first=1_100_000)
    say("study", "new", "w.toml", "mlp width=16", "mlp width=8", "--task", "tiny.toml", "--epochs", "20")
    head, entries = Path("w.toml").read_text().split("\n[[entries]]\n", 1)
    claim = '\n[[looks.claims]]\nentry = "mlp width=16"\nrivals = ["mlp width=8"]\n'
    Path("w.toml").write_text(f"{head}{claim}{claim}at_most = 0.1\n\n[[entries]]\n{entries}")
    shown = say("show", "w.toml").stdout
    assert "needs fewer steps than mlp width=8, if it needs 50% fewer than each: 100, 100, 100" in shown
    most = "mlp width=8 needs at most 10 percent more steps than mlp width=16, if all need the same: "
    first, *_, last = map(int, shown.split(most)[1].splitlines()[0].split(", "))
    assert 5 < first < last
