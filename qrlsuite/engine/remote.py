"""Trains groups of seeds on workers that see no results folder: sends tasks, checks answers, writes results.

This process holds the claims, tells the trackers and writes the results folder. A group is with one worker at a time,
for about a minute: a task has its newest checkpoint, the answer the next one with the lines between. A worker that is
lost costs that minute. An answer is accepted once, for the group, epoch and token of the task that is waited for, and
checked before it is written. Of every `REPEATED` answers, a second worker repeats the first, to the bit.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import secrets
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from qrlsuite import registry
from qrlsuite.engine import probe as probing
from qrlsuite.engine.answers import Asked, Expected, expected_of, require_alike, require_fit
from qrlsuite.engine.local import ATTEMPTS
from qrlsuite.engine.work import (
    Answer,
    ChoosingLink,
    EngineOutcome,
    Link,
    RemoteEngine,
    Show,
    Work,
    job_name,
)
from qrlsuite.engine.worker import checkpoint_seconds
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.results import probes
from qrlsuite.results.checkpoint import Arrays
from qrlsuite.results.claims import HEARTBEAT, Claim, SeedsClaimedError, acquire_each
from qrlsuite.results.progress import Progress, ProgressFile
from qrlsuite.results.provenance import PACKAGES
from qrlsuite.results.records import EntryRecord, EpochLine, ProbeRecord, Provenance, TimingLine
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore, json_line
from qrlsuite.training.remote_task import MOST_BYTES, POLICY, pack, too_large, unpack, versions
from qrlsuite.training.trackers import EventSink, asked

if TYPE_CHECKING:
    from qrlsuite.training.group import GroupFiles  # torch, which is imported when it is needed

TASK_SECONDS = 60.0
"""How long a task trains, one epoch at least; QRLSUITE_CHECKPOINT_SECONDS replaces it."""

MOST_SENT = 512 << 20
"""Bytes of tasks that are with the engine at a time, at most: a scheduler keeps them in memory."""

REPEATED = 20
"""The first of this many answers is compared with a second worker's, if the engine can choose workers."""

AT_LENGTH = 1e9
"""Seconds for which a task trains that ends at an epoch."""

WAIT_SECONDS = 0.5
"""For which an answer is waited for at a time."""

HEADER_BYTES = 1 << 20
"""Room in an answer for the lines of its epochs."""


@functools.lru_cache(maxsize=64)
def _expected(entry_hash: str, record: bytes) -> Expected:
    """Return the expected content of an answer for one seed."""
    import torch

    from qrlsuite.training.trainer import Trainer

    threads = torch.get_num_threads()
    try:
        trainer = Trainer(EntryRecord.read(json.loads(record), "the entry").entry("the entry"), [0])
    finally:
        torch.set_num_threads(threads)  # this may be a user's notebook
    trainer.start()
    return expected_of(trainer)


def seeds_per_task(entry: Entry) -> int:
    """Return how many seeds of an entry fit into a task, at most."""
    size = _expected(entry.hash, json_line(EntryRecord.of(entry).content)).seed_bytes
    if size > MOST_BYTES - HEADER_BYTES:
        raise OptionError(f"'{entry.label}': {too_large(size, 1)}")
    return (MOST_BYTES - HEADER_BYTES) // size


def train(engine: RemoteEngine, works: Sequence[Work], show: Show) -> EngineOutcome:
    """Train groups of entries to their last epoch, one entry after the other."""
    outcome = EngineOutcome()
    for work in works:
        run = _Run(engine, work, works)
        try:
            outcome += run.train(show)
        finally:
            run.close()
    return outcome


class _Member:
    """A group, where it stands, and the task that it waits for."""

    def __init__(self, work: Work, group: SeedGroup, works: Sequence[Work]) -> None:
        self.group, self.name = group, job_name(work, group, works)
        self.progress_file = ProgressFile(work.store, group.id)
        self.progress = Progress(phase="waiting", epoch=group.epoch, epochs=work.epochs)
        self.epoch = group.epoch
        self.size = 0
        self.losses = 0
        self.begun = False
        self.first: tuple[str, dict[str, Any], Arrays] | None = None
        """An answer, with its token, that a second worker repeats before it is accepted."""

    def write(self, error: str | None = None) -> None:
        """Write the progress."""
        self.progress_file.write(self.progress, error, force=True)


class _Run:
    """The training of groups of one entry."""

    def __init__(self, engine: RemoteEngine, work: Work, works: Sequence[Work]) -> None:
        from qrlsuite.training.group import GroupFiles  # torch

        self.work, self.store = work, work.store
        self.entry = work.store.entry()
        self.events = EventSink(registry.load(), asked())
        self.code = identity.of(self.entry)
        self._files = functools.partial(
            GroupFiles, self.entry, work.store, events=self.events, code=self.code
        )
        found = versions([*PACKAGES, *self.entry.distributions()])
        self.versions = {name: version for name, version in found.items() if version is not None}
        self.seconds = checkpoint_seconds(TASK_SECONDS)
        self.expected = _expected(self.entry.hash, json_line(EntryRecord.of(self.entry).content))
        self.found: ProbeRecord | None = None
        """What a probe has found, see `qrlsuite.engine.probe`."""
        self.outcome = EngineOutcome()
        self.members = [_Member(work, group, works) for group in work.groups]
        self.files: dict[str, GroupFiles] = {}
        self.answered = 0
        self.sent: dict[str, _Member] = {}
        self.link: Link = engine.connect(work.workers, self.versions)
        try:
            self.claims = _Claims(work.store, [member.group.seeds for member in self.members])
        except BaseException:
            self.link.close()
            raise

    def train(self, show: Show) -> EngineOutcome:
        """Send and accept until every group has finished or failed."""
        waiting = deque(self.members)
        for member in self.members:
            member.progress_file.clear()
        self._probe(show)
        while waiting or self.sent:
            while waiting and len(self.sent) < self.work.workers and self._room():
                self._guarded(waiting.popleft(), self._resume)
            for answer in self.link.receive(WAIT_SECONDS) if self.sent else ():
                if answer.key in self.sent:  # else it is answered twice
                    self._guarded(self.sent.pop(answer.key), functools.partial(self._take, answer=answer))
            self.claims.require()
            show({member.name: dataclasses.asdict(member.progress) for member in self.members})
        return self.outcome

    def close(self) -> None:
        """Disconnect, and give the seeds back."""
        try:
            self.link.close()
        finally:
            self.claims.close()

    def _probe(self, show: Show) -> None:
        """Make the entry's probe here, where one is needed: both sides are trained in fresh processes."""
        probes.require_independent(self.store)
        first = self.members[0]
        probe = probing.prepare(
            [(self.entry, self.store, first.group.seeds)], self.work.epochs, self.work.device
        )
        if probe is None:
            return
        try:
            first.progress.phase = "probing"
            show({first.name: dataclasses.asdict(first.progress)})
            self.found = probe.judge()
        finally:
            probe.claim.release()
            first.progress.phase = "waiting"
        if self.found.result == probes.DIFFERS:
            raise probes.refusal(self.store, self.found)

    def _room(self) -> bool:
        return sum(member.size for member in self.sent.values()) < MOST_SENT

    def _guarded(self, member: _Member, step: Any) -> None:
        """Do something for a group; where that fails, the others go on."""
        try:
            step(member)
        except SeedsClaimedError as error:
            self.outcome.taken[member.name] = str(error)
        except QrlSuiteError as error:
            self._fail(member, str(error))

    def _fail(self, member: _Member, message: str) -> None:
        self.outcome.failed[member.name] = message
        self.claims.release(member.group.seeds)
        with contextlib.suppress(StoreError):  # on a full disk the message is in the outcome alone
            member.write(message)

    def _resume(self, member: _Member) -> None:
        """Send a group's first task, from the newest checkpoint."""
        seeds = member.group.seeds
        self.claims.require_held(seeds)
        if self.store.finished(seeds, self.work.epochs) == set(
            seeds
        ):  # by somebody else, since it was planned
            self._finished(member)
            return
        self.files[member.group.id] = self._files(seeds=seeds)
        member.epoch, arrays = self.files[member.group.id].resume()
        self._send(member, arrays)

    def _send(self, member: _Member, arrays: Arrays) -> None:
        token, first = secrets.token_hex(16), member.first
        header = {
            "token": token,
            "entry": EntryRecord.of(self.entry).content,
            "seeds": list(member.group.seeds),
            "epoch": member.epoch,
            "epochs": self._last_epoch(member),
            "seconds": self.seconds if first is None else AT_LENGTH,
            "device": self.work.device,
            "versions": self.versions,
            "code": self.code.record()["parts"],
            "plugins": [plugin.packed() for plugin in identity.plugins(self.entry)],
        }
        task = pack(header, arrays)
        if len(task) > MOST_BYTES:
            raise StoreError(too_large(len(task), len(member.group.seeds)))
        member.size, member.progress.phase = len(task), "sent"
        member.write()
        self.sent[token] = member
        if first is not None and isinstance(self.link, ChoosingLink):
            self.link.send_apart(token, task, member.epoch, first[0])
        else:
            self.link.send(token, task, member.epoch)

    def _last_epoch(self, member: _Member) -> int:
        """Return the epoch that a task ends at the latest; one that is repeated ends where it did."""
        return self.work.epochs if member.first is None else int(member.first[1]["epoch"])

    def _take(self, member: _Member, answer: Answer) -> None:
        """Accept an answer, or send the task again."""
        if answer.content is None:
            self._again(member, answer.problem)
            return
        try:
            header, arrays = unpack(answer.content)
            refused = header.get("refused")
            if refused is None:
                asked = Asked(answer.key, member.group.seeds, member.epoch, self._last_epoch(member))
                require_fit(header, arrays, asked, self.entry.task.file, self.expected)
        except StoreError as error:
            refused = str(error)
        if refused is not None:
            self._again(member, str(refused))
            return
        member.losses = 0
        if member.first is not None:
            _, own, own_arrays = member.first
            member.first = None
            require_alike(own, own_arrays, header, arrays)
            header, arrays = own, own_arrays
        elif self._repeated(header):
            member.first = (answer.key, header, arrays)
            self._send(member, self.files[member.group.id].resume()[1])
            return
        self._accept(member, header, arrays)

    def _repeated(self, header: Mapping[str, Any]) -> bool:
        """Tell whether a second worker is to repeat an answer before it is accepted."""
        if header["error"] is not None or not header["lines"]:
            return False
        self.answered += 1
        choosing = isinstance(self.link, ChoosingLink) and self.work.workers > 1
        return choosing and self.answered % REPEATED == 1

    def _again(self, member: _Member, problem: str) -> None:
        """Send a task that was lost once more, unless that has happened too often."""
        member.losses += 1
        if member.losses >= ATTEMPTS:
            raise QrlSuiteError(f"its task was lost {ATTEMPTS} times: {problem}")
        _, arrays = self.files[member.group.id].resume()
        self._send(member, arrays)

    def _accept(self, member: _Member, header: Mapping[str, Any], arrays: Arrays) -> None:
        """Write the lines and the checkpoint of an answer; then finish the group, or send its next task."""
        self.claims.require_held(member.group.seeds)
        files, progress = self.files[member.group.id], member.progress
        if header["lines"] or header["error"] is None:
            origin = Provenance.read(header["provenance"], "the worker's answer")
            if member.begun:
                files.add_origin(origin)
            else:
                files.begin(member.epoch, header["parameters"], origin)
                if self.found is not None:
                    files.add_probe(self.found)
                member.begun = True
        for epoch, (of_seeds, times) in enumerate(zip(header["lines"], header["timings"]), member.epoch + 1):
            lines, timing = (
                [EpochLine.model_validate(line) for line in of_seeds],
                TimingLine.model_validate(times),
            )
            files.record(lines, timing)
            progress.finished_epoch(
                epoch, [line.mean for line in lines], [bool(line.diverged) for line in lines]
            )
            if epoch == member.group.epoch + 1:
                continue  # it holds what happens once
            progress.epoch_seconds = len(lines) * ((timing.train or 0.0) + (timing.validate_ or 0.0))
        policy = {name.removeprefix(POLICY): a for name, a in arrays.items() if name.startswith(POLICY)}
        state = {name: array for name, array in arrays.items() if not name.startswith(POLICY)}
        files.save(header["epoch"], state)
        member.epoch = header["epoch"]
        known = [*progress.warnings, *self.events.problems, *header["warnings"]]
        progress.warnings = list(dict.fromkeys(known))
        if header["error"] is not None:
            raise QrlSuiteError(str(header["error"]))
        if member.epoch < self.work.epochs:
            self._send(member, state)
            return
        files.finish(member.epoch, policy)
        self._finished(member)

    def _finished(self, member: _Member) -> None:
        member.progress.phase, member.progress.epoch = "finished", self.work.epochs
        member.write()
        self.files.pop(member.group.id, None)
        self.claims.release(member.group.seeds)


class _Claims(threading.Thread):
    """The claims of groups of seeds by this process, refreshed by a thread of their own."""

    def __init__(self, store: EntryStore, groups: Sequence[tuple[int, ...]]) -> None:
        super().__init__(daemon=True)
        self._store = store
        answers = dict(zip(groups, acquire_each(store, groups)))
        self._held = {seeds: claim for seeds, claim in answers.items() if isinstance(claim, Claim)}
        self._refused = {s: error for s, error in answers.items() if isinstance(error, SeedsClaimedError)}
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._lost = False
        self.start()

    def run(self) -> None:
        """Refresh until closed."""
        while not self._stopped.wait(HEARTBEAT):
            with self._lock:
                self._lost |= any(not claim.refresh() for claim in self._held.values())

    def require_held(self, seeds: tuple[int, ...]) -> None:
        """Refuse a group that is somebody else's."""
        if seeds in self._refused:
            raise self._refused[seeds]
        with self._lock:
            self._lost |= seeds in self._held and not self._held[seeds].refresh()
        self.require()

    def release(self, seeds: tuple[int, ...]) -> None:
        """Release the claim of seeds, if there is one."""
        with self._lock:
            claim = self._held.pop(seeds, None)
            if claim is not None:
                claim.release()

    def require(self) -> None:
        """Refuse to go on without a claim that was held."""
        if self._lost:
            raise StoreError(
                f"{self._store.path}: this process was not heard of for a while, and its seeds were taken over; "
                "finished epochs are kept, the same command continues"
            )

    def close(self) -> None:
        """Give everything back."""
        self._stopped.set()
        for seeds in list(self._held):
            self.release(seeds)
