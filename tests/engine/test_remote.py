"""Training from bytes to bytes, and what is accepted of it; workers are this process, which calls the real thing."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qrlsuite.engine import api, missing, remote
from qrlsuite.engine.api import Answer, EngineOutcome, Link
from qrlsuite.engine.where import Where
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.results import checkpoint, claims
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore, read_lines
from qrlsuite.training import remote_task
from qrlsuite.training.remote_task import pack, unpack, work_on
from tests.conftest import Train, results

EPOCHS = 4


@pytest.fixture(autouse=True)
def _short_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every task is one epoch."""
    monkeypatch.setenv("QRLSUITE_CHECKPOINT_SECONDS", "0")


@pytest.fixture
def entry(tiny_task: str) -> Entry:
    return resolve(tiny_task, "mlp width=16")


@pytest.fixture
def store(entry: Entry, tmp_path: Path) -> EntryStore:
    return EntryStore.create(tmp_path / "runs", entry)


class Here:
    """An engine and its link: this process works on the newest task first."""

    def __init__(self) -> None:
        self.tasks: dict[str, bytes] = {}
        self.sent = 0
        self.closed = False

    def workers(self, requested: int | None) -> int:
        return requested or 1

    def queued(self, store: EntryStore) -> set[int]:
        return set()

    def run(self, works: Sequence[api.Work], show: api.Show) -> EngineOutcome:
        return api.train_remotely(self, works, show)

    def connect(self, workers: int, versions: Mapping[str, str | None]) -> Link:
        return self

    def send(self, key: str, task: bytes, priority: int) -> None:
        self.sent += 1
        self.tasks[key] = task

    def receive(self, seconds: float) -> list[Answer]:
        key, task = self.tasks.popitem()
        return self.answers(key, task)

    def answers(self, key: str, task: bytes) -> list[Answer]:
        return [Answer(key, work_on(task))]

    def close(self) -> None:
        self.closed = True


def train(
    engine: Here, store: EntryStore, groups: list[tuple[int, ...]], epochs: int = EPOCHS
) -> EngineOutcome:
    work = api.Work(store, [SeedGroup(seeds, 0) for seeds in groups], epochs, len(groups))
    outcome = engine.run([work], lambda snapshot: None)
    assert engine.closed
    assert claims.claims(store) == []
    return outcome


def edited(content: bytes, **changes: Any) -> bytes:
    header, arrays = unpack(content)
    return pack({**header, **changes}, arrays)


def test_bytes_are_those_of_the_local_engine(store: EntryStore, train_locally: Train) -> None:
    engine = Here()
    assert train(engine, store, [(0, 1), (2,)]) == EngineOutcome()
    assert engine.sent == 2 * EPOCHS, "one epoch each"
    straight = train_locally("straight", [0, 1, 2], EPOCHS)
    assert [results(store.path, seed) for seed in range(3)] == [results(straight, seed) for seed in range(3)]
    assert {seed: len(read_lines(store.seed(seed).timings)) for seed in range(3)} == dict.fromkeys(
        range(3), EPOCHS
    )
    assert train(Here(), store, [(0, 1), (2,)]) == EngineOutcome(), (
        "to train again what is there sends nothing"
    )


@pytest.fixture
def train_locally(train: Train) -> Train:
    return train


def test_local_and_remote_training_continue_each_other(
    store: EntryStore, train_locally: Train, entry: Entry
) -> None:
    train_locally("runs", [0, 1], 2)
    train(Here(), store, [(1,), (0,)], 3)
    train_locally("runs", [0, 1], EPOCHS)
    straight = train_locally("straight", [0, 1], EPOCHS)
    assert [results(store.path, seed) for seed in (0, 1)] == [results(straight, seed) for seed in (0, 1)]


class Strange(Here):
    """Every answer comes again later, some before it with another token, seeds, epoch, lines or arrays."""

    def __init__(self) -> None:
        super().__init__()
        self.old: list[Answer] = []
        self.wrong = iter(
            [{"token": "x"}, {"seeds": [7]}, {"epoch": 9}, {"lines": [[{"epoch": 1}]]}, {"lines": []}]
        )

    def answers(self, key: str, task: bytes) -> list[Answer]:
        content = work_on(task)
        changes = next(self.wrong, {})
        came = [*self.old, Answer(key, edited(content, **changes)), Answer(key, content)]
        self.old = [Answer(key, content), Answer("nobody's", content)]
        return came


def test_an_answer_is_accepted_once_and_only_where_it_fits(
    store: EntryStore, train_locally: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "ATTEMPTS", 10)
    engine = Strange()
    assert train(engine, store, [(0, 1)]) == EngineOutcome()
    assert engine.sent == EPOCHS + 5, "each of the five that do not fit is one more task"
    straight = train_locally("straight", [0, 1], EPOCHS)
    for seed in (0, 1):
        assert results(store.path, seed) == results(straight, seed)
        assert [line["epoch"] for line in read_lines(store.seed(seed).timings)] == [1, 2, 3, 4]


def line(header: dict[str, Any], **values: Any) -> dict[str, Any]:
    """Change the first seed's line of the first epoch."""
    header["lines"][0][0] |= values
    return header


def time_of(header: dict[str, Any], **values: Any) -> dict[str, Any]:
    header["timings"][0] |= values
    return header


def without(header: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in header.items() if key != name}


ALTERED: dict[str, tuple[Callable[[dict[str, Any]], dict[str, Any]], str]] = {
    "one score": (lambda h: line(h, scores=[0.5]), "epoch 1 has not 5 scores for each seed"),
    "too many scores": (lambda h: line(h, scores=[0.5] * 6), "epoch 1 has not 5 scores"),
    "no scores": (lambda h: line(h, scores=None), "epoch 1 has not 5 scores"),
    "a score that is no number": (lambda h: line(h, scores=[0.5] * 4 + [math.nan]), r"scores\.4 = nan: "),
    "an infinite score": (lambda h: line(h, scores=[0.5] * 4 + [math.inf]), r"scores\.4 = inf: "),
    "a score above 1": (lambda h: line(h, scores=[0.5] * 4 + [1.5]), r"from 0\.5 to 1\.5, outside \[0, 1\]"),
    "a score below 0": (lambda h: line(h, scores=[0.5] * 4 + [-0.5]), "outside"),
    "an epoch that is a text": (lambda h: line(h, epoch="1"), "epoch = '1': "),
    "a loss that is no number": (lambda h: line(h, loss=math.nan), "loss = nan: "),
    "a loss that is a text": (lambda h: line(h, loss="low"), "loss = 'low': "),
    "a further value": (lambda h: line(h, **{"loss.other": 1.0}), r"has 'loss\.other'"),
    "negative executions": (lambda h: line(h, executions={"forward": -1}), r"executions\.forward = -1: "),
    "a line that is a number": (lambda h: {**h, "lines": [[7]]}, "EpochLine: "),
    "no line": (lambda h: {**h, "lines": [[]]}, "not one for each seed"),
    "lines that are a table": (lambda h: {**h, "lines": {"0": []}}, "it has no epochs"),
    "a time that is a number": (lambda h: {**h, "timings": [7]}, "TimingLine: "),
    "a negative time": (lambda h: time_of(h, train=-1.0), "train = -1.0: "),
    "another group": (lambda h: time_of(h, group=50), "times of epoch 1 are not its own"),
    "an epoch too many": (lambda h: {**h, "epoch": 2}, "ends at epoch 2 with 1 epochs after 0"),
    "no epoch": (lambda h: without(h, "epoch"), "it has no epochs"),
    "no parameters": (lambda h: without(h, "parameters"), "it counts other parameters"),
    "other parameters": (
        lambda h: {**h, "parameters": {**h["parameters"], "classical": 1}},
        "other parameters",
    ),
    "parameters that are a text": (lambda h: {**h, "parameters": "many"}, "it counts other parameters"),
    "no provenance": (lambda h: without(h, "provenance"), "Provenance: "),
    "nested provenance": (
        lambda h: {**h, "provenance": {**h["provenance"], "versions": {"torch": {"is": "2"}}}},
        r"Provenance: versions\.torch",
    ),
    "an escape sequence": (
        lambda h: {**h, "provenance": {**h["provenance"], "host": "\x1b]0;owned\x07"}},
        "text that controls a terminal",
    ),
    "no warnings": (lambda h: without(h, "warnings"), "its warnings are no texts"),
    "warnings that are numbers": (lambda h: {**h, "warnings": [7]}, "its warnings are no texts"),
    "an error that is a number": (lambda h: {**h, "error": 7}, "its error is no text"),
}


def alter_header(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[bytes], bytes]:
    def altered(content: bytes) -> bytes:
        header, arrays = unpack(content)
        return pack(change(header), arrays)

    return altered


def alter_arrays(change: Callable[[dict[str, Any]], object]) -> Callable[[bytes], bytes]:
    def altered(content: bytes) -> bytes:
        header, arrays = unpack(content)
        change(arrays)
        return pack(header, arrays)

    return altered


def cast(arrays: dict[str, Any], name: str) -> None:
    arrays[name] = arrays[name].astype(np.float64)


ALTERED_ARRAYS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "no arrays": (lambda a: a.clear(), "its checkpoint has another"),
    "no agent": (
        lambda a: [a.pop(name) for name in [*a] if name.startswith("policy.")],
        "its trained agent has another '.*' than the entry, or none",
    ),
    "an agent's part is missing": (lambda a: a.pop("policy.w0"), "trained agent has another 'w0'"),
    "an agent of another shape": (
        lambda a: a.update({"policy.w0": a["policy.w0"][:, :3]}),
        "trained agent has another 'w0'",
    ),
    "an agent of another type": (lambda a: cast(a, "policy.w0"), "trained agent has another 'w0'"),
    "a further part": (lambda a: a.update({"policy.x": a["policy.w0"]}), "trained agent has another 'x'"),
    "a part that is a number": (lambda a: a.update({"policy.w0": np.float32(1)}), "agent has another 'w0'"),
    "a checkpoint's part is missing": (
        lambda a: a.pop(sorted(name for name in a if not name.startswith("policy."))[0]),
        "its checkpoint has another",
    ),
}


@pytest.mark.parametrize(
    ("alter", "problem"),
    [
        *(pytest.param(alter_header(change), said, id=name) for name, (change, said) in ALTERED.items()),
        *(
            pytest.param(alter_arrays(change), said, id=name)
            for name, (change, said) in ALTERED_ARRAYS.items()
        ),
    ],
)
def test_an_altered_answer_costs_its_group_and_the_entry_stays_readable(
    alter: Callable[[bytes], bytes], problem: str, store: EntryStore, train_locally: Train
) -> None:
    class Altering(Here):
        def answers(self, key: str, task: bytes) -> list[Answer]:
            content = work_on(task)
            return [Answer(key, alter(content) if unpack(task)[0]["seeds"] == [0] else content)]

    (message,) = train(Altering(), store, [(0,), (1,)], 1).failed.values()
    assert re.search(problem, message)
    assert "\n" not in message
    assert store.finished([0, 1], 1) == {1}, "the other group goes on"
    entry = collect.read_entry(store)
    assert entry is not None
    assert (entry.seeds, entry.refused) == ((1,), ())
    assert train(Here(), store, [(0,)], 1) == EngineOutcome()
    assert results(store.path, 0) == results(train_locally("straight", [0], 1), 0)


class Pair(Here):
    """Two workers, of which the second repeats answers; what it changes of them is given."""

    def __init__(self, change: Callable[[bytes], bytes] = lambda content: content) -> None:
        super().__init__()
        self.change = change
        self.apart: dict[str, str] = {}
        self.repeated: list[dict[str, Any]] = []

    def send_apart(self, key: str, task: bytes, priority: int, other: str) -> None:
        self.apart[key] = other
        self.repeated.append(unpack(task)[0])
        self.send(key, task, priority)

    def answers(self, key: str, task: bytes) -> list[Answer]:
        content = work_on(task)
        return [Answer(key, self.change(content) if key in self.apart else content)]


def test_a_second_worker_repeats_some_answers(
    store: EntryStore, train_locally: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "REPEATED", 3)
    engine = Pair()
    assert train(engine, store, [(0, 1), (2,)]) == EngineOutcome()
    assert len(engine.repeated) == 3, "the 1st, 4th and 7th of 8 answers"
    assert engine.sent == 2 * EPOCHS + 3
    assert all(task["epochs"] == task["epoch"] + 1 for task in engine.repeated)
    straight = train_locally("straight", [0, 1, 2], EPOCHS)
    assert [results(store.path, seed) for seed in range(3)] == [results(straight, seed) for seed in range(3)]
    one = Pair()
    assert (
        train(one, EntryStore.create(store.path.parents[2] / "one", store.entry()), [(0,)]) == EngineOutcome()
    )
    assert one.repeated == [], "there is no second worker"


def one_bit(arrays: dict[str, Any]) -> None:
    name = max(name for name in arrays if not name.startswith("policy."))
    arrays[name].reshape(-1).view(np.uint8)[0] ^= 1


def one_digit(header: dict[str, Any]) -> dict[str, Any]:
    return line(header, loss=math.nextafter(header["lines"][0][0]["loss"] or 0.0, math.inf))


def on_another_processor(header: dict[str, Any]) -> dict[str, Any]:
    return {**one_digit(header), "provenance": {**header["provenance"], "processor": "another"}}


@pytest.mark.parametrize("change", [alter_arrays(one_bit), alter_header(one_digit)])
def test_two_workers_that_disagree_end_their_group_alone(
    change: Callable[[bytes], bytes], store: EntryStore
) -> None:
    (message,) = train(Pair(change), store, [(0,), (1,)], 2).failed.values()
    assert re.fullmatch(r"two workers, on \S+ and \S+, gave different answers to one task, .*", message)
    assert [len(store.seed(seed).epochs()) for seed in store.seeds()] == [2], "nothing of it was written"


def test_answers_of_other_processors_say_nothing_about_each_other(
    store: EntryStore, train_locally: Train
) -> None:
    engine = Pair(alter_header(on_another_processor))
    assert train(engine, store, [(0,), (1,)], 2) == EngineOutcome()
    assert len(engine.repeated) == 1
    straight = train_locally("straight", [0, 1], 2)
    assert [results(store.path, seed) for seed in (0, 1)] == [results(straight, seed) for seed in (0, 1)]


def test_nothing_is_written_once_another_process_has_the_seeds(store: EntryStore) -> None:
    class Suspended(Here):
        def answers(self, key: str, task: bytes) -> list[Answer]:
            if unpack(task)[0]["epoch"] == 1:
                (claim,) = claims.claims(store)
                claim.path.unlink()
            return super().answers(key, task)

    with pytest.raises(StoreError, match="its seeds were taken over"):
        train(Suspended(), store, [(0,)], 3)
    assert len(store.seed(0).epochs()) == 1


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (None, "its task was lost 3 times: killed by the system"),
        (b"nonsense", "its task was lost 3 times: these 8 bytes are no task and no answer"),
        (pack({"refused": "node7 has no numba"}, {}), "its task was lost 3 times: node7 has no numba"),
    ],
)
def test_a_task_that_is_lost_again_and_again_is_given_up(
    content: bytes | None, problem: str, store: EntryStore
) -> None:
    class Losing(Here):
        def answers(self, key: str, task: bytes) -> list[Answer]:
            if unpack(task)[0]["seeds"] == [0]:
                return [Answer(key, content, "killed by the system")]
            return super().answers(key, task)

    engine = Losing()
    outcome = train(engine, store, [(0,), (1,)])
    (message,) = outcome.failed.values()
    assert message.startswith(problem)
    assert store.finished([0, 1], EPOCHS) == {1}, "the other group goes on"
    assert engine.sent == 3 + EPOCHS


def test_the_same_task_has_the_same_answer_times_aside(store: EntryStore) -> None:
    tasks = []

    class Watched(Here):
        def answers(self, key: str, task: bytes) -> list[Answer]:
            tasks.append(task)
            return super().answers(key, task)

    train(Watched(), store, [(0, 1)], 2)
    for task in tasks:
        (first, one), (second, two) = (unpack(work_on(task)) for _ in range(2))
        assert {**first, "timings": None} == {**second, "timings": None}
        assert one.keys() == two.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], two[name])


def test_a_worker_of_other_versions_refuses_by_name() -> None:
    header, arrays = unpack(
        work_on(pack({"token": "t", "seeds": [0], "versions": {"torch": "1.0", "no-such": "2"}}, {}))
    )
    assert header["token"] == "t"
    assert header["refused"].startswith(f"{os.uname().nodename} has torch ")
    assert header["refused"].endswith(" instead of 1.0, no no-such")
    assert arrays == {}
    assert unpack(work_on(b"\x08\0\0\0\0\0\0\0{}"))[0]["refused"].startswith("this is no task: ")


def test_what_an_environment_raises_is_said_and_what_was_finished_before_stays(
    store: EntryStore, monkeypatch: pytest.MonkeyPatch, train_locally: Train
) -> None:
    from qrlsuite.training.trainer import Trainer

    monkeypatch.setenv("QRLSUITE_CHECKPOINT_SECONDS", "1000")
    real = Trainer.train_epoch

    def failing(self: Trainer) -> Any:
        if self.epoch == 2:
            raise QrlSuiteError("the antenna is broken")
        return real(self)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_epoch", failing)
        outcome = train(Here(), store, [(0,)])
    assert list(outcome.failed.values()) == ["the antenna is broken"]
    (progress,) = [ProgressFile(store, checkpoint.group_id([0])).read()]
    assert (progress["error"], progress["epoch"]) == ("the antenna is broken", 2)
    assert train(Here(), store, [(0,)]) == EngineOutcome()
    assert results(store.path, 0) == results(train_locally("straight", [0], EPOCHS), 0)


def test_groups_are_small_enough_to_be_sent(
    entry: Entry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: EntryStore
) -> None:
    fits = remote.seeds_per_task(entry)
    size = checkpoint_bytes(store)
    assert fits == (remote_task.MOST_BYTES - remote.HEADER_BYTES) // size
    limit = 2 * size + remote.HEADER_BYTES
    for module in (remote_task, remote):
        monkeypatch.setattr(module, "MOST_BYTES", limit)
    plan = missing.find(tmp_path / "more", entry, Where(Here(), 1), list(range(5)), 2)
    assert [group.seeds for group in plan.groups] == [(0,), (1, 2), (3, 4)]
    for module in (remote_task, remote):
        monkeypatch.setattr(module, "MOST_BYTES", size + 10)
    with pytest.raises(OptionError, match=r"too large to be sent: \d+ MB for 1 seed, .*--engine local"):
        remote.seeds_per_task(entry)
    assert advance_error(store).startswith("a checkpoint is too large to be sent")


def checkpoint_bytes(store: EntryStore) -> int:
    from qrlsuite.training.trainer import Trainer

    trainer = Trainer(store.entry(), [0])
    trainer.start()
    return sum(a.nbytes for arrays in (trainer.capture(), trainer.policy()) for a in arrays.values())


def advance_error(store: EntryStore) -> str:
    header = {
        "token": "t",
        "entry": store.record().content,
        "seeds": [0],
        "epoch": 0,
        "epochs": 1,
        "seconds": 0,
    }
    answer, arrays = unpack(work_on(pack({**header, "device": "cpu", "versions": {}}, {})))
    assert (answer["epoch"], answer["lines"], arrays) == (0, [], {})
    return str(answer["error"])


def test_seeds_that_somebody_else_trains_are_left_to_them(store: EntryStore) -> None:
    claim = claims.acquire(store, [0])
    work = api.Work(store, [SeedGroup((0,), 0), SeedGroup((1,), 0)], 1, 2)
    outcome = remote.train(Here(), [work], lambda snapshot: None)
    claim.release()
    (message,) = outcome.taken.values()
    assert "is being trained" in message or "are being trained" in message
    assert store.finished([0, 1], 1) == {1}


def test_a_claim_that_was_taken_over_ends_the_run(store: EntryStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "HEARTBEAT", 0.01)

    class Suspended(Here):
        def answers(self, key: str, task: bytes) -> list[Answer]:
            for claim in claims.claims(store):
                claim.path.unlink()
            return [Answer(key, None, "lost")] if self.sent > 1000 else super().answers(key, task)

    with pytest.raises(StoreError, match="its seeds were taken over"):
        train(Suspended(), store, [(0,)], 10_000)


def test_a_full_disk_where_the_results_are(disk: Path, entry: Entry, train_locally: Train) -> None:
    store = EntryStore.create(disk / "runs", entry)
    outcome = train(Here(), store, [(0, 1)])
    (message,) = outcome.failed.values()
    assert "No space left on device" in message
    subprocess.run(["mount", "-o", "remount,size=20m", str(disk)], check=True)
    assert train(Here(), store, [(0, 1)]) == EngineOutcome()
    straight = train_locally("straight", [0, 1], EPOCHS)
    assert [results(store.path, seed) for seed in (0, 1)] == [results(straight, seed) for seed in (0, 1)]


def test_ctrl_c_keeps_what_was_accepted(store: EntryStore, train_locally: Train) -> None:
    def show(snapshot: api.Snapshot) -> None:
        if any(state.get("epoch") == 2 for state in snapshot.values()):
            raise KeyboardInterrupt

    work = api.Work(store, [SeedGroup((0,), 0)], EPOCHS, 1)
    engine = Here()
    with pytest.raises(KeyboardInterrupt):
        remote.train(engine, [work], show)
    assert engine.closed
    assert claims.claims(store) == []
    assert checkpoint.load(store, [0])[0] == 2
    assert train(Here(), store, [(0,)]) == EngineOutcome()
    assert results(store.path, 0) == results(train_locally("straight", [0], EPOCHS), 0)


def test_numbers_that_json_rounds_survive() -> None:
    header = {"x": [0.1, 1 / 3, math.pi, 5e-324]}
    again, arrays = unpack(pack(header, {"a": np.arange(6.0).reshape(2, 3).T}))
    assert again == json.loads(json.dumps(header)) == header
    np.testing.assert_array_equal(arrays["a"], np.arange(6.0).reshape(2, 3).T)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="sets what glibc's allocator does")
def test_a_worker_keeps_freed_memory() -> None:
    """As Dask starts workers, arrays of a megabyte would be fetched from the system again and again."""
    program = """if True:
        import resource, sys, threading
        import numpy as np
        from qrlsuite.training.remote_task import keep_freed_memory
        faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        def work():
            keep_freed_memory()
            before = faults()
            for _ in range(100):
                np.ones(1 << 17)
            print(faults() - before)
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    """
    environment = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 100 * 256 / 4  # pages of 4 kB of 100 arrays of 1 MB
