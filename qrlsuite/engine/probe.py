"""Probes that a seed does not depend on its company: the middle one of a group, trained again alone in a fresh process.

Statistics over seeds mean nothing if seeds influence each other. `qrlsuite check` tests that at toy size before any
training; a probe tests the real training. Both trainings go from nothing until the parameters have changed,
and must agree in every record and every number of the state, to the last bit. The built-in things are held by the
suite's tests and are not probed.

- The middle seed shows most: leaked state is the first seed's (a cache, a stack's plain attributes) or the last
  seed's (a class attribute).
- A group that begins is one side itself, and its middle seed, alone, the other. A group of one is the other side, and
  three seeds are trained in a fresh process. Of a group of two, or one that goes on from a checkpoint, both sides are
  trained in fresh processes.
- The fresh process then trains another seed, and the same again: variables of a class or module that grow show there.
- Where a code was probed before, the first epoch of that seed is trained again, and must be its record: anything that
  has changed in between shows there. On another machine, or with other versions, bits differ, and nothing is compared.
- A probe is made once per code and kind of device, by the holder of its claim; its result is in `run.json` of the seeds
  that existed. Seeds that depend on their company are trained no further and never ranked.

`python -m qrlsuite.engine.probe ANSWER PARENT` is the fresh process: it reads what to train from stdin.
"""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors.numpy import load, save

from qrlsuite import own, specs
from qrlsuite.errors import EnvironmentFailure, PluginError, QrlSuiteError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.results import probes, provenance
from qrlsuite.results.checkpoint import Arrays
from qrlsuite.results.claims import Claim, SeedsClaimedError, acquire
from qrlsuite.results.probes import DIFFERS, EQUAL, NOT_PROBED
from qrlsuite.results.records import EntryRecord, EpochLine, ProbeRecord, Provenance
from qrlsuite.results.store import EntryStore, SeedStore, flatten, read_arrays

if TYPE_CHECKING:
    from qrlsuite.training.group import Part
    from qrlsuite.training.trainer import Trainer

SECONDS = 10.0
"""Of processor time, beyond which a seed is not trained once more."""

MOST_EPOCHS = 10
"""After which a probe ends although no parameter has changed; it then shows nothing."""

_FOLDER = "probe"


def code_of(entry: Entry) -> str:
    """Return the digest of an entry's code: a probe of equal code is not repeated."""
    return identity.of(entry).digest


@dataclass
class Side:
    """The results of training one seed, up to the epoch after which its parameters had changed.

    `again` is the first difference when it was trained once more after another seed, None where it was not.
    """

    lines: list[Mapping[str, Any]]
    arrays: Arrays
    changed: bool = False
    again: str | None = None


def pack(header: Mapping[str, Any], arrays: Arrays) -> bytes:
    """Return the answer of the fresh process as bytes: a safetensors file with the header as JSON in its metadata."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    content: bytes = save(contiguous, metadata={"header": json.dumps(header)})
    return content


def unpack(content: bytes) -> tuple[dict[str, Any], Arrays]:
    """Return header and arrays of a result of `pack`."""
    length = int.from_bytes(content[:8], "little")
    return json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["header"]), load(content)


class Recorder:
    """Takes down the middle seed of a training that begins, epoch by epoch."""

    def __init__(self, trainer: Trainer) -> None:
        self.side = Side([], {})
        self._place = trainer.S // 2
        self._first = self._parameters(trainer)

    def add(self, trainer: Trainer, lines: Sequence[EpochLine], state: Arrays) -> bool:
        """Add an epoch; returns whether the parameters have changed by now.

        Parameters
        ----------
        lines:
            The epoch's line of every seed.
        state:
            Result of `Trainer.capture` after it.
        """
        self.side.lines.append(lines[self._place].content)
        self.side.arrays = {name: array[self._place, None] for name, array in state.items()}
        self.side.changed = bool(_different(self._first, self._parameters(trainer)))
        return self.side.changed

    def _parameters(self, trainer: Trainer) -> Arrays:
        tensors = trainer.algorithm.policy_state()
        return {name: value[self._place].detach().cpu().numpy().copy() for name, value in tensors.items()}


def _different(first: Arrays, second: Arrays) -> str:
    """Return the first name that only one has, or whose arrays differ in a bit; nothing where all are equal."""
    for name in sorted({*first, *second}):
        a, b = first.get(name), second.get(name)
        if (
            a is None
            or b is None
            or a.dtype != b.dtype
            or not np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
        ):
            return name
    return ""


def difference(together: Side, alone: Side) -> str:
    """Name the first difference; empty if there is none."""
    for number, lines in enumerate(zip(together.lines, alone.lines), start=1):
        # rows of a table nest values, and have None where an epoch has none
        line, other = map(flatten, lines)
        for name in {**line, **other}:
            if line.get(name) != other.get(name):
                return f"'{name}' of epoch {number}"
    if len(together.lines) != len(alone.lines):
        return "the epoch in which it first learns"
    name = _different(together.arrays, alone.arrays)
    return f"the state '{name}' after epoch {len(together.lines)}" if name else ""


def train(
    entry: Entry, seeds: Sequence[int], epochs: int, device: str = "cpu", start: Path | None = None
) -> Side:
    """Train seeds from nothing until the parameters of the middle one have changed, for some epochs at most.

    Parameters
    ----------
    start:
        The file of the agent with which all of them begin, where the entry begins with agents.
    """
    from qrlsuite.training.group import lines_of
    from qrlsuite.training.trainer import Trainer

    trainer = Trainer(entry, seeds, device)
    first = {} if start is None else read_arrays(start)
    trainer.start({name: np.stack([value] * len(seeds)) for name, value in first.items()})
    recorder = Recorder(trainer)
    for _ in range(epochs):
        lines = lines_of(trainer.train_epoch())
        if recorder.add(trainer, lines, trainer.capture()):
            break
    return recorder.side


def _again(side: Side, entry: Entry, seeds: Sequence[int], device: str, start: Path | None) -> str:
    """Train a seed of another block a little, and the same seeds once more; return the first difference from a side."""
    from qrlsuite.training.trainer import Trainer

    other = Trainer(entry, [seeds[0] + TUNING_SEEDS], device)
    other.start()
    with own.blamed():
        other.algorithm.train_epoch(1)
    return difference(side, train(entry, seeds, len(side.lines), device, start))


def _declared(entry: Entry) -> Iterator[str]:
    """Name the things that seeds share by declaration of plugins, for the notes of boards."""
    for spec in (each.spec for each in entry.registered().values() if each.distribution != identity.OURS):
        if isinstance(spec, specs.ModelSpec) and spec.shared:
            yield f"{spec.title}: the same {', '.join(spec.shared)} at the beginning"
        if isinstance(spec, specs.EnvironmentSpec) and spec.repeats:
            yield f"{spec.title}: the same episodes"


class _ProbeFailed(Exception):
    """The fresh process ended without an answer, for a reason that says nothing about seeds."""


def in_fresh_process(
    entry: Entry,
    seeds: Sequence[int],
    epochs: int,
    device: str,
    start: Path | None = None,
    again: bool = False,
    limited: bool = False,
) -> tuple[Side, float]:
    """Run `train` in a process that has run nothing else, then once more if `again`; return its processor time, too.

    If `limited`, training ends without an answer after `SECONDS`.
    """
    task: dict[str, Any] = {
        "entry": EntryRecord.of(entry).content,
        "seeds": list(seeds),
        "epochs": epochs,
        "device": device,
        "start": start and str(start),
        "again": again,
        "limited": limited,
    }
    task["plugins"] = [str(plugin.copy) for plugin in identity.plugins(entry)]
    command = [sys.executable, "-P", "-m", "qrlsuite.engine.probe"]  # -P: as workers are started
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as output:
        answer = Path(folder) / "answer"
        (Path(folder) / "task").write_text(json.dumps(task))
        with (Path(folder) / "task").open("rb") as given:
            process = subprocess.Popen(
                [*command, str(answer), str(os.getpid())], stdin=given, stdout=output, stderr=output
            )
        try:
            code = process.wait()
        finally:
            if process.poll() is None:  # Ctrl-C
                process.kill()
                process.wait()
        if not answer.exists():
            output.seek(0)
            last = output.read().decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
            raise _ProbeFailed(f"the process of the probe ended with code {code}: {last[0]}")
        header, arrays = unpack(answer.read_bytes())
    if header["error"] is not None:
        raise PluginError(header["error"])
    return Side(header["lines"], arrays, header["changed"], header["again"]), header["cpu"]


@dataclass
class Probe:
    """The probe of a group of seeds, made while it is trained.

    Attributes
    ----------
    entry, seed:
        The middle one of the group.
    claim:
        With which this process keeps others from making it, too.
    start:
        The file of the agent with which the seed begins, where the entry begins with agents.
    recorded:
        The seed's folder, if it was trained before.
    made:
        Whether the code was probed before.
    """

    entry: Entry
    seed: int
    epochs: int
    device: str
    claim: Claim
    start: Path | None
    recorded: SeedStore | None
    made: bool
    _recorder: Recorder | None = field(default=None, init=False)
    _alone: bool = field(default=False, init=False)

    def require_unchanged(self, trainer: Trainer) -> str:
        """Refuse to train on where the seed's first epoch is not its record; return why they were not compared."""
        if self.recorded is None or (record := self.recorded.record()) is None:
            return ""
        if not (lines := self.recorded.epochs()):
            return ""
        here = provenance.of(self.entry, trainer.device)
        skipped = f"seed {self.seed} was not compared with its record: "
        there = record.provenance[0] if record.provenance else Provenance()
        if elsewhere := provenance.difference(here, there):
            return f"{skipped}{elsewhere}"
        try:
            side, _ = in_fresh_process(self.entry, [self.seed], 1, self.device, self.start, limited=True)
            found = difference(Side([lines[0].content], {}), replace(side, arrays={}))
        except _ProbeFailed as error:
            return f"{skipped}{error}"
        except PluginError as error:
            found = f"that it fails: {error}"
        if found:
            raise probes.DependentSeedsError(
                f"seed {self.seed} has changed: trained again in a fresh process, it differs from its "
                f"record ({self.recorded.path}) in {found}. Something has changed since: the code, if "
                "--same joined two; a file that the plugin reads and does not declare, another package, a "
                "variable of the environment. Nothing was trained, and nothing is lost: restore it and "
                "rerun the command, or start over with --runs DIR"
            )
        return ""

    def begin(self, trainer: Trainer) -> bool:
        """Look at a training before its first epoch; returns whether `judge` can be called."""
        if trainer.epoch == 0 and trainer.S != 2:
            self._recorder, self._alone = Recorder(trainer), trainer.S == 1
        return self._recorder is None and not self.made

    def add(self, trainer: Trainer, lines: Sequence[EpochLine], state: Arrays) -> bool:
        """Add an epoch; returns whether `judge` can be called."""
        if self.made or self._recorder is None:
            return False
        changed = self._recorder.add(trainer, lines, state)
        return changed or len(self._recorder.side.lines) >= self.epochs

    def judge(self) -> ProbeRecord:
        """Train the missing sides in fresh processes, and compare; return the value of `probe` in `run.json`."""
        self.made = True
        began = time.monotonic()
        facts: dict[str, Any] = {
            "seed": self.seed,
            "device": self.device.partition(":")[0],
            "code": code_of(self.entry),
        }
        if declared := list(_declared(self.entry)):
            facts["declared"] = declared

        def found(result: str, **more: Any) -> ProbeRecord:
            return ProbeRecord.model_validate({**facts, "result": result, **more})

        try:
            together, again, what, cpu = self._compare()
        except _ProbeFailed as error:
            return found(NOT_PROBED, reason=str(error))
        epochs = len(together.lines)
        cost: dict[str, Any] = {"seconds": round(time.monotonic() - began, 2), "cpu": round(cpu, 2)}
        if what:
            return found(DIFFERS, epochs=epochs, difference=what, **cost)
        if not together.changed:
            reason = f"no parameter has changed within {epochs} epochs"
            return found(NOT_PROBED, reason=reason, **cost)
        if not again:
            cost["reason"] = (
                f"not once more after another seed, for more than {SECONDS:g} s of processor time"
            )
        return found(EQUAL, epochs=epochs, **cost)

    def _compare(self) -> tuple[Side, bool, str, float]:
        """Return the side in company, whether one was trained again, the first difference, and the processor time."""
        seed, cpu = self.seed, 0.0
        sides = []
        for seeds in ([abs(seed - 1), seed, seed + 1 + (seed == 0)], [seed]):
            if self._recorder is not None and (seeds == [seed]) == self._alone:
                sides.append(self._recorder.side)  # the group itself
                continue
            again = seeds == [seed] or self._alone
            try:
                side, seconds = in_fresh_process(
                    self.entry, seeds, self.epochs, self.device, self.start, again
                )
            except PluginError as error:
                if self._recorder is None and not sides:  # it fails in company, too
                    raise _ProbeFailed(str(error)) from error
                return Side([], {}), False, f"that it fails: {error}", cpu
            sides.append(side)
            cpu += seconds
        together, alone = sides
        more = together.again if self._alone else alone.again
        found = difference(together, alone) or (f"{more}, after another seed" if more else "")
        return together, more is not None, found, cpu


def prepare(parts: Sequence[Part], epochs: int, device: str) -> Probe | None:
    """Return the probe that a group is to make; None where none is needed, or another process makes it.

    Where an equal code was probed, it only compares that seed with its record.

    Seeds for tuning are not probed: nothing ranks them.

    Parameters
    ----------
    parts:
        As for `qrlsuite.training.group.GroupRun`.
    """
    agents = [(entry, store, seed) for entry, store, seeds in parts for seed in seeds]
    entry, store, seed = agents[len(agents) // 2]
    if not entry.third_party() or seed >= TUNING_SEEDS:
        return None
    key = EQUAL, device.partition(":")[0], code_of(entry)
    made = [each for each in probes.of_entry(store) if (each.result, each.device, each.code) == key]
    seed = next((each.seed for each in made if each.seed is not None), seed)
    try:
        claim = acquire(EntryStore(store.path / _FOLDER), [0])
    except SeedsClaimedError:
        return None
    start = None if entry.start is None else store.start_of(seed).absolute()
    recorded = store.seed(seed) if seed in store.seeds() else None
    return Probe(entry, seed, min(epochs, MOST_EPOCHS), device, claim, start, recorded, bool(made))


def _end(*given: object) -> None:
    """End this process, whatever a plugin catches."""
    print(f"an epoch takes more than {SECONDS:g} s of processor time", flush=True)
    os._exit(2)


def main(arguments: Sequence[str]) -> int:
    """Run the fresh process; returns its exit code."""
    from qrlsuite.engine.worker import end_with

    answer, parent = arguments
    if not end_with(int(parent)):
        return 130
    task = json.load(sys.stdin)
    header: dict[str, Any] = {"error": None}
    arrays: Arrays = {}
    try:
        for path in task["plugins"]:
            own.load(path)
        start = None if task["start"] is None else Path(task["start"])
        entry = EntryRecord.read(task["entry"], "the probe").entry("the probe")
        began, more = time.process_time(), (task["device"], start)
        if task["limited"]:
            signal.signal(signal.SIGXCPU, _end)
            most = math.ceil(began + SECONDS)
            resource.setrlimit(resource.RLIMIT_CPU, (most, most + 1))
        side = train(entry, task["seeds"], task["epochs"], *more)
        took = time.process_time() - began
        again = _again(side, entry, task["seeds"], *more) if task["again"] and took <= SECONDS else None
        header |= {"lines": side.lines, "changed": side.changed, "again": again}
        arrays = side.arrays
    except (PluginError, EnvironmentFailure) as error:
        header["error"] = str(error)
    except QrlSuiteError as error:  # there is no such device here, say
        print(error)
        return 2
    header["cpu"] = time.process_time()
    unfinished = Path(f"{answer}.part")
    unfinished.write_bytes(pack(header, arrays))
    unfinished.replace(answer)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
