"""A worker's heartbeat ends its process when the claim is lost, and only then."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from qrlsuite.engine import worker
from qrlsuite.results import claims
from qrlsuite.results.store import EntryStore


@pytest.fixture
def killed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The signals that this process sends itself."""
    sent: list[int] = []
    monkeypatch.setattr(os, "kill", lambda pid, number: sent.append(number))
    monkeypatch.setattr(worker, "HEARTBEAT", 0.01)
    return sent


@pytest.mark.parametrize("released", [True, False])
def test_a_claim_that_was_given_back_is_not_lost(
    released: bool, killed: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = claims.acquire(EntryStore(tmp_path), [0])
    heartbeat = worker.ClaimHeartbeat([claim], None)

    def refresh(self: claims.Claim) -> bool:
        """The training ends between two lines of a refresh; or another worker takes over."""
        if released:
            heartbeat.stopped.set()
        claim.path.unlink()
        return False

    monkeypatch.setattr(claims.Claim, "refresh", refresh)
    heartbeat.start()
    heartbeat.join(10)
    assert not heartbeat.is_alive()
    assert killed == ([] if released else [signal.SIGTERM])


def test_a_worker_that_is_told_to_end_before_it_trains_gives_its_seeds_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, deaths = EntryStore(tmp_path), list[int]()

    def told(*given: object, **more: object) -> list[object]:
        """SIGTERM comes after the seeds were claimed."""
        assert [claim.seeds for claim in claims.claims(store)] == [(0,)]
        signal.raise_signal(signal.SIGTERM)
        return []

    monkeypatch.setattr(worker, "plan_groups", told)
    before = signal.signal(signal.SIGTERM, lambda number, frame: deaths.append(number))  # in place of a death
    try:
        with pytest.raises(KeyboardInterrupt):
            worker.train_group(store.path, [0], 1)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert not deaths
    assert claims.claims(store) == []
