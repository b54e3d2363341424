"""A run killed at any moment and resumed ends with the same bytes as one never stopped."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
import warnings

import pytest

from qrlsuite.results import checkpoint
from qrlsuite.results.store import EntryStore
from qrlsuite.training.interrupts import Interruptible
from qrlsuite.training.trainer import Trainer
from tests.commands import start_worker
from tests.conftest import HANGS, Train, results

EPOCHS = 6


def _interrupt_in_epoch(monkeypatch: pytest.MonkeyPatch, epoch: int) -> None:
    """Raise KeyboardInterrupt, as Ctrl-C does, in the middle of an epoch's validation."""
    original = Trainer._validate

    def validate(self: Trainer, number: int) -> object:
        if number == epoch:
            raise KeyboardInterrupt
        return original(self, number)

    monkeypatch.setattr(Trainer, "_validate", validate)


@pytest.mark.parametrize("model", ["mlp", "vqc-native"])
def test_interrupted_and_resumed_equals_undisturbed(
    model: str, train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ("width=16",) if model == "mlp" else ("qubits=2", "layers=2")
    straight = train("straight", [0, 1], EPOCHS, model=model, settings=settings)
    with monkeypatch.context() as patch:
        _interrupt_in_epoch(patch, 4)
        with pytest.raises(KeyboardInterrupt):
            train("stopped", [0, 1], EPOCHS, model=model, settings=settings)
    store = EntryStore(straight.parent.parent.parent / "stopped" / straight.parent.name / straight.name)
    assert {h.epoch for h in checkpoint.headers(store)} == {3}, (
        "an interruption saves the last finished epoch"
    )
    stopped = train("stopped", [0, 1], EPOCHS, model=model, settings=settings)
    for seed in (0, 1):
        assert results(straight, seed) == results(stopped, seed)


def test_lines_newer_than_the_checkpoint_and_a_torn_line_are_cut(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    straight = train("straight", [0], EPOCHS)
    with monkeypatch.context() as patch:
        _interrupt_in_epoch(patch, 4)
        with pytest.raises(KeyboardInterrupt):
            train("torn", [0], EPOCHS)
    folder = EntryStore(straight.parent.parent.parent / "torn" / straight.parent.name / straight.name).seed(0)
    lines = folder.lines.read_bytes().splitlines(keepends=True)
    folder.lines.write_bytes(
        b"".join(lines) + lines[-1].replace(b'"epoch":3', b'"epoch":4') + b'{"epoch":5,"sco'
    )
    torn = train("torn", [0], EPOCHS)
    assert results(straight, 0) == results(torn, 0)


def test_sigterm_saves_and_exits_130(train: Train) -> None:
    entry = train("runs", [0, 1], 1)
    process = start_worker(str(entry), "--seeds", "0:2", "--epochs", "100000")
    while len(EntryStore(entry).seed(0).epochs()) < 3:
        assert process.poll() is None
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(HANGS) == 130
    assert checkpoint.headers(EntryStore(entry))[0].epoch >= 3
    assert not list((entry / "claims").glob("*.json"))


def test_children_that_are_forked_meanwhile_end_by_sigterm() -> None:
    with Interruptible() as guard, guard.deferred(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python 3.12 warns of threads
        begun, say = multiprocessing.Pipe()
        child = multiprocessing.get_context("fork").Process(target=lambda: (say.send(1), time.sleep(60)))
        child.start()
        begun.recv()
    child.terminate()
    child.join()
    assert child.exitcode == -signal.SIGTERM


def test_an_interruption_that_other_code_swallows_is_raised_at_the_end_of_the_next_deferred_block() -> None:
    with Interruptible() as guard:
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt), guard.deferred():
            pass
        with guard.deferred():
            pass
