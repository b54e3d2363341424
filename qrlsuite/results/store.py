"""Results on disk: the single source of truth, readable without this suite.

    runs/<task>/<entry>/entry.json              the entry with every option resolved
                        seed-0007/run.json      status, parameters, code identity, versions, machine
                                  epochs.jsonl  one line per epoch while the run goes on
                                  epochs.parquet  all epochs once the run has finished
                                  timings.jsonl everything that may differ between two equal runs
                                  final.safetensors  the trained agent
                        start/            agents with which seeds begin, if the entry begins with trained agents
                        groups/<id>/checkpoint.safetensors, progress.json
                        claims/<id>.json        who is working on which seeds
                        requests.jsonl          the seeds that were asked for
                <entry>@1a2b3c4d/               the same entry of other code (`qrlsuite.results.codes`)

Files are replaced atomically (temporary file, fsync, rename) and carry a format version; lines are appended,
and a torn last line is dropped. Nothing is ever pickled.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import itertools
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow
import pyarrow.parquet
from numpy.typing import NDArray

from qrlsuite import registry, specs
from qrlsuite.errors import StoreError, UnknownNameError
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.preset import EntryTuning
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.files import read_bytes
from qrlsuite.results import genuine, parquet
from qrlsuite.results.records import (
    FORMAT_VERSION,
    MEASURED,
    EntryRecord,
    EpochLine,
    Record,
    RunRecord,
    TimingLine,
)
from qrlsuite.specs import NAME
from qrlsuite.statistics.grid import settled

_MARK = re.compile(r"@[0-9a-f]{8}")
_SEED_FOLDER = re.compile(r"seed-(\d{4}|[1-9]\d{4,})", re.ASCII)
ASIDE = ".old"
"""End of the name `.seed-0007.old` of a seed's folder while an import puts a longer run into its place."""
MOST_AGENT_BYTES = 200_000_000
"""A file of parameters that is larger than this is not read."""

Arrays = dict[str, NDArray[Any]]
R = TypeVar("R", bound=Record)


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file's content as a whole, or leave the file unchanged."""
    try:
        with contextlib.suppress(FileExistsError):  # a file in the folder's place is named by the next line
            path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o666 & ~_umask())
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise StoreError(f"cannot write {path}: {cause(error)}; the old file is unchanged") from None


def cause(error: OSError) -> str:
    """Return why a file could not be written and, on a full disk, a command that frees space."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    hint = " (to free some: qrlsuite runs gc --runs DIR; for searches, --runs DIR/tuning)"
    return f"{error.strerror or error}{hint * full}"


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object with a format version."""
    try:
        content = json.loads(read_bytes(path))
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise StoreError(f"{path} does not hold a JSON object")
    version = content.get("format_version")
    if version != FORMAT_VERSION:
        raise StoreError(
            f"{path} has format version {version!r}, this suite reads {FORMAT_VERSION}: "
            "use the version of the suite that wrote it, or another folder (--runs DIR)"
        )
    genuine.require_plain(path, content)
    return content


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Replace a JSON file, stamped with the format version."""
    text = json.dumps({"format_version": FORMAT_VERSION, **content}, indent=1, allow_nan=False)
    write_atomically(path, text.encode() + b"\n")


def json_line(record: Mapping[str, Any]) -> bytes:
    """Encode one line of a JSON lines file."""
    return json.dumps(record, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read JSON lines; a torn last line (a writer was killed) is dropped."""
    try:
        pieces = read_bytes(path).split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error}") from None
    records = []
    for number, piece in enumerate(pieces[:-1], start=1):  # what follows the last newline is torn, or empty
        try:
            record = json.loads(piece)
        except (ValueError, RecursionError):
            raise StoreError(
                f"{path}, line {number}: not JSON; restore the file or delete the seed's folder"
            ) from None
        if not isinstance(record, dict):
            raise StoreError(f"{path}, line {number}: not a JSON object")
        records.append(record)
    return records


def read_records(path: Path, kind: type[R]) -> list[R]:
    """Read JSON lines of one type."""
    return [kind.read(line, f"{path}, line {number}") for number, line in enumerate(read_lines(path), 1)]


def read_arrays(path: Path, most: int = MOST_AGENT_BYTES) -> Arrays:
    """Read a safetensors file: arrays by name.

    Parameters
    ----------
    most:
        Bytes of a file that is read; the format packs nothing, so arrays are no larger.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        if (size := path.stat().st_size) > most:
            raise StoreError(f"{path} has {size:,} bytes, more than {most:,}: it is not read")
        arrays: Arrays = load(read_bytes(path))
    except FileNotFoundError:
        raise
    except (OSError, SafetensorError, ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{path} is damaged ({type(error).__name__}: {_first_line(error)}); restore the file or delete its folder"
        ) from None
    genuine.require_plain(path, [*arrays])
    return arrays


def require_finite(arrays: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Refuse parameters that are not numbers."""
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise StoreError(
                f"{path}: '{name[:80]}' holds a value that is not a finite number; restore the file"
            )


def drop_torn_line(path: Path) -> None:
    """Remove the text after the last newline: the next line would be written behind it."""
    if path.exists():
        content = read_bytes(path)
        whole = content[: content.rfind(b"\n") + 1]
        if whole != content:
            write_atomically(path, whole)


def append(path: Path, content: bytes) -> None:
    """Append whole lines."""
    try:
        with path.open("ab") as file:
            file.write(content)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {cause(error)}") from None


def shortest(values: NDArray[Any]) -> list[float]:
    """Return float32 values as the shortest decimals that read back to the same float32."""
    return [float(text) for text in np.asarray(values, np.float32).astype(str).ravel()]


def learning_curve(scores: NDArray[np.float32 | np.float64]) -> NDArray[np.float64]:
    """Return the mean of every epoch's validation scores (..., episodes), rounded by `settled`."""
    values = np.asarray(scores, np.float64)
    means = values.mean(axis=-1)
    # a mean that is as small as the noise of what it is made of is that noise
    noise = np.abs(means) <= np.finfo(np.float32).eps * np.abs(values).max(axis=-1)
    return np.where(noise, np.round(means, 7), settled(means))


@dataclass(frozen=True, eq=False)
class SeedRun:
    """The content of one seed's run so far, from a results folder or published. Runs of one seed add.

    Attributes
    ----------
    record:
        `run.json`; None where the run never began.
    scores:
        (T, validation episodes), one row per epoch; (T, 1), the means, for seeds imported from an export.
    seconds:
        Core-seconds spent on the run, see `SeedStore.seconds`.
    clocked:
        Whether some of these seconds are by the clock, which other work on the cores stretches; None if not recorded.
    executions:
        Circuit executions of training, gradients and validation together. A circuit that is sampled with many shots
        is executed once.
    diverged:
        The first epoch after which numbers of the agent were not finite; None if they always were.
    measured:
        Metrics of the environment by name: means over each epoch's validation episodes, (T,); NaN where it measured
        none.
    training:
        Metrics of training by name, such as the algorithm's losses, (T,).
    published:
        Whether it was read from a published entry.
    """

    seed: int
    record: RunRecord | None
    scores: NDArray[np.float32 | np.float64]
    seconds: float
    executions: int
    clocked: bool | None = False
    diverged: int | None = None
    measured: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    training: Mapping[str, pyarrow.ChunkedArray] = field(default_factory=dict)
    folder: Path = Path()
    published: bool = False

    def __add__(self, other: SeedRun) -> SeedRun:
        """Return the longer run; of two equally long runs the published one."""
        return max(self, other, key=lambda run: (run.epochs, run.published, str(run.folder)))

    def agrees(self, other: SeedRun) -> bool:
        """Return whether the curves are equal in the epochs that both have."""
        shared = min(self.epochs, other.epochs)
        return np.array_equal(self.curve[:shared], other.curve[:shared])

    @property
    def epochs(self) -> int:
        """The finished epochs T."""
        return len(self.scores)

    @property
    def hours(self) -> float:
        """Core-hours spent on the run."""
        return self.seconds / 3600

    @property
    def finished(self) -> bool:
        """Whether the run reached the epochs that were asked for."""
        return self.record is not None and self.record.finished

    @functools.cached_property
    def curve(self) -> NDArray[np.float64]:
        """The learning curve V_1..V_T (T,): the mean score of every epoch's validation, see `learning_curve`."""
        return learning_curve(self.scores)


class SeedStore:
    """The folder of one seed's run.

    Parameters
    ----------
    of:
        The entry that it lies in, if its record has to name it.
    """

    def __init__(self, path: Path, seed: int, of: EntryStore | None = None) -> None:
        self.path = path
        self.seed = seed
        self.of = of
        self.lines = path / "epochs.jsonl"
        self.table = path / "epochs.parquet"
        self.timings = path / "timings.jsonl"
        self.agent = path / "final.safetensors"

    def record(self) -> RunRecord | None:
        """Return `run.json`, or None where the run never began."""
        path = self.path / "run.json"
        genuine.require_no_link(self.path, path, self.lines, self.table, self.timings, self.agent)
        if not path.exists():
            return None
        record = RunRecord.read(read_json(path), path)
        genuine.require_seed(self.path, self.seed, record, {} if self.of is None else self.of.names)
        return record

    def write_record(self, record: RunRecord) -> None:
        """Replace `run.json`."""
        write_json(self.path / "run.json", record.content)

    def write_curve(self, record: EntryRecord, scores: NDArray[np.float64], **facts: Any) -> None:
        """Write the finished run of another program into an empty folder.

        Parameters
        ----------
        scores:
            (T,): the score of every epoch.
        facts:
            Further keys of `run.json`.
        """
        self.path.mkdir(parents=True)
        rows = [{"epoch": epoch, "score": float(score)} for epoch, score in enumerate(scores, start=1)]
        write_atomically(self.table, table_bytes(rows))
        content = {
            "task": record.task_name,
            "task_hash": record.task_hash,
            "entry": record.name,
            "label": record.label,
            "algorithm": record.identity.algorithm,
            "model": record.identity.model,
            "parameters": {},
            "seed": self.seed,
            "interactions_per_epoch": record.task_file.protocol.interactions,
            "status": "finished",
            "epochs": len(rows),
            **facts,
        }
        self.write_record(RunRecord.model_validate(content))

    def trained_epochs(self) -> int:
        """Return the epochs of the run; 0 where it never began."""
        record = self.record()
        return 0 if record is None else record.epochs

    def finished(self, epochs: int = 0) -> bool:
        """Return whether the run has finished, with that many epochs or more."""
        record = self.record()
        return record is not None and record.finished and record.epochs >= epochs

    def parameters(self) -> Arrays:
        """Return the trained agent's parameters by name."""
        try:
            arrays = read_arrays(self.agent)
        except FileNotFoundError:
            raise StoreError(
                f"{self.agent} is missing: seed {self.seed} has a learning curve but no trained parameters (entries "
                "that were imported may have none); train the entry here with `qrlsuite run`"
            ) from None
        if (record := self.record()) is None or record.diverged is None:
            require_finite(arrays, self.agent)
        return arrays

    def epochs(self) -> list[EpochLine]:
        """Return every epoch's record in order: the table, then newer lines."""
        rows = self._table()
        rows += [
            line for line in read_records(self.lines, EpochLine) if not rows or line.epoch > rows[-1].epoch
        ]
        for expected, row in enumerate(rows, start=1):
            if row.epoch != expected:
                raise StoreError(f"{self.path}: epoch {expected} is missing (found {row.epoch})")
        return rows

    def _table(self) -> list[EpochLine]:
        rows = read_table(self.table) if self.table.exists() else []
        return [EpochLine.read(row, self.table) for row in rows]

    def cut(self, epoch: int) -> int:
        """Drop every line newer than an epoch, and torn last lines; a table newer than it becomes lines again.

        If two workers wrote at once, lines may be doubled or missing: the first line of each epoch is kept, up to the
        first missing epoch.

        Returns
        -------
        int
            The number of remaining epochs: fewer than `epoch` if some are missing.
        """
        drop_torn_line(self.timings)
        table, by_epoch = self._table(), dict[int, EpochLine]()
        for row in (*table, *read_records(self.lines, EpochLine)):
            by_epoch.setdefault(row.epoch, row)
        numbers = itertools.takewhile(by_epoch.__contains__, range(1, epoch + 1))
        rows, last = [by_epoch[number] for number in numbers], table[-1].epoch if table else 0
        if last > epoch:
            write_atomically(self.lines, b"".join(json_line(row.content) for row in rows))
            self.table.unlink()
        elif self.lines.exists():
            newer = (json_line(row.content) for row in rows if row.epoch > last)
            write_atomically(self.lines, b"".join(newer))
        return len(rows)

    def sync(self) -> None:
        """Force appended lines to the disk: called before a checkpoint that supersedes them is written."""
        for path in (self.lines, self.timings):
            if path.exists():
                with path.open("rb") as file:
                    os.fsync(file.fileno())

    def compact(self) -> list[EpochLine]:
        """Turn the lines into a table; return all epochs."""
        rows = self.epochs()
        if rows and self.lines.exists():
            write_atomically(self.table, table_bytes([row.content for row in rows]))
            self.lines.unlink(missing_ok=True)
        return rows

    def newest_epoch(self) -> int:
        """Return the epoch of the newest line of a run that goes on, or the epoch in its record without lines."""
        lines = read_lines(self.lines)
        return EpochLine.read(lines[-1], self.lines).epoch if lines else self.trained_epochs()

    def times(self) -> list[TimingLine]:
        """Return the times of every epoch."""
        return read_records(self.timings, TimingLine)

    def seconds(self) -> float:
        """Return the core-seconds spent on this seed's epochs so far: its share of the group's time.

        Processor time if it was recorded (training on the CPU), since other work on the cores does not stretch it;
        otherwise time by the clock.
        """
        return self._timed()[0]

    def _timed(self) -> tuple[float, bool]:
        """Return the core-seconds, and whether some of them are by the clock."""
        lines, total = self.times(), 0.0
        for seconds in (seconds for line in lines for seconds in line.spent):
            total += seconds
        return total, any(line.cpu is None for line in lines)

    def read(self) -> SeedRun:
        """Return the content of the run so far."""
        columns = self._columns()
        record, epochs = self.record(), columns.num_rows
        if record is not None and record.finished and epochs < record.epochs:
            raise StoreError(
                f"{self.path} finished {record.epochs} epochs and holds {epochs}: restore the file or delete "
                "the seed's folder"
            )
        scores = _scores(columns, self.path) if epochs else np.empty((0, 0), np.float32)
        seconds, clocked = self._timed()
        counts, measured = 0, dict[str, NDArray[np.float64]]()
        for name in columns.column_names:
            outer, _, inner = name.partition(".")
            if outer == "executions" and inner != "shots":
                counts += _count(columns[name].to_pylist(), self.path)
            elif outer == MEASURED:
                measured[inner] = _metric(inner, columns[name], self.path)
        diverged = columns["diverged"].to_pylist() if "diverged" in columns.column_names else []
        first = diverged.index(True) + 1 if True in diverged else None
        own = [
            name
            for name in columns.column_names
            if name not in EpochLine.model_fields and name.isidentifier()
        ]
        training = {name.removeprefix("train_"): columns[name] for name in own}
        folder = self.path.parent
        return SeedRun(self.seed, record, scores, seconds, counts, clocked, first, measured, training, folder)

    def _columns(self) -> pyarrow.Table:
        """Return all epochs as columns: of the table, with newer lines behind them."""
        parts = [parquet.read(self.table)] if self.table.exists() else []
        last = parts[0].num_rows if parts else 0
        lines = [line.content for line in read_records(self.lines, EpochLine) if line.epoch > last]
        try:
            columns = pyarrow.concat_tables([*parts, table_of(lines)], promote_options="permissive")
            numbers = columns["epoch"].to_pylist() if columns.num_rows else []
        except (pyarrow.ArrowException, KeyError) as error:
            raise StoreError(
                f"{self.path} does not hold epochs ({_first_line(error)}); restore the file or delete the folder"
            ) from None
        for expected, number in enumerate(numbers, start=1):
            if number != expected:
                raise StoreError(f"{self.path}: epoch {expected} is missing (found {number!r})")
        return columns


def _scores(columns: pyarrow.Table, path: Path) -> NDArray[np.float32 | np.float64]:
    """Return validation scores (T, episodes), or their means (T, 1)."""
    name = "scores" if "scores" in columns.column_names else "score"
    try:
        column = columns[name].combine_chunks()
        if name == "score":
            means: NDArray[np.float64] = np.asarray(column.cast(pyarrow.float64()).to_numpy(False))[:, None]
            values: NDArray[np.float32 | np.float64] = means
        else:
            with np.errstate(over="ignore"):
                flat = np.asarray(column.flatten().to_numpy(False), np.float32)
            lengths = set(column.value_lengths().to_pylist())
            values = flat.reshape(len(column), -1) if len(lengths) == 1 else np.empty((0, 0), np.float32)
    except (KeyError, AttributeError, TypeError, ValueError):
        raise StoreError(f"{path}: an epoch has no list of validation scores") from None
    if not values.size or not np.isfinite(values).all():
        raise StoreError(f"{path}: validation scores must be finite and equally many in every epoch")
    return values


def _count(counts: Sequence[Any], path: Path) -> int:
    """Return the sum of circuit executions; an epoch without has None."""
    known = [count for count in counts if count is not None]
    if not all(type(count) is int and count >= 0 for count in known):
        raise StoreError(f"{path}: {str(known)[:80]} are not numbers of circuit executions")
    return sum(known)


def _metric(name: str, column: pyarrow.ChunkedArray, path: Path) -> NDArray[np.float64]:
    """Return a metric of every epoch's validation (T,); NaN where an epoch has none."""
    try:
        values = np.asarray(column.cast(pyarrow.float64()).to_numpy(), np.float64)
    except pyarrow.ArrowException:
        values = np.full(1, np.inf)
    if np.isinf(values).any() or not NAME.fullmatch(name):
        raise StoreError(f"{path}: {ascii(name)[:40]} is no metric")
    return values


def parameters_of(records: Iterable[RunRecord | None]) -> dict[str, int]:
    """Return the trainable numbers of an entry's agents, from the `run.json` of its seeds.

    `classical` and `quantum` are summed over all trained networks, `networks` in number; `fixed` counts numbers of
    these networks that stay as drawn, if any. Records without `networks` are of older versions, which counted the first
    network alone; they count only if there is no newer record.
    """
    per_run = [{} if record is None else record.parameters for record in records]
    whole = [counts for counts in per_run if "networks" in counts]
    return next(iter([*whole, *per_run]), {})


def _steps(tuning: EntryTuning | None) -> int:
    """Return the environment steps that a record of tuning names; -1 where it does not know them, -2 without one."""
    if tuning is None:
        return -2
    return -1 if tuning.steps is None else tuning.steps


def table_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Encode epoch records as parquet: one row per epoch, nested values as their own columns."""
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(table_of(rows), sink, compression="zstd")
    result: bytes = sink.getvalue().to_pybytes()
    return result


def table_of(rows: Sequence[Mapping[str, Any]]) -> pyarrow.Table:
    """Return epoch records as columns, which `table_bytes` encodes."""
    flat = [flatten(row) for row in rows]
    columns = {
        name: [row.get(name) for row in flat] for name in sorted({name for row in flat for name in row})
    }
    of_scores = pyarrow.list_(pyarrow.float32())
    return pyarrow.table(
        {
            name: pyarrow.array(values, of_scores if name == "scores" else None)
            for name, values in columns.items()
        }
    )


def flatten(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return an epoch's record with nested values under names of their own, as a table has them."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            flat.update({f"{name}.{inner}": item for inner, item in value.items()})
        else:
            flat[name] = value
    return flat


def read_table(path: Path) -> list[dict[str, Any]]:
    """Read a table that `table_bytes` encoded, one mapping a row, with scores as the shortest decimals."""
    table = parquet.read(path)
    try:
        columns = [_column(table, name) for name in table.column_names]
        rows = [_nest(dict(zip(table.column_names, values))) for values in zip(*columns)]
    except (TypeError, ValueError, OverflowError):  # columns of other types than `table_bytes` writes
        raise StoreError(
            f"{path} does not hold epochs; restore the file or delete the seed's folder"
        ) from None
    if not rows:
        raise StoreError(f"{path} holds no epoch")
    return rows


def _column(table: pyarrow.Table, name: str) -> list[Any]:
    """Return a column's values, one a row."""
    if name != "scores":
        values: list[Any] = table[name].to_pylist()
        return values
    return [None if array is None else shortest(array) for array in table[name].to_numpy()]


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Undo `flatten`."""
    row: dict[str, Any] = {}
    for name, value in flat.items():
        outer, dot, inner = name.partition(".")
        if dot:
            row.setdefault(outer, {})[inner] = value
        else:
            row[name] = value
    return row


Writer = Callable[[SeedStore], None]
"""Writes a seed into an empty folder."""


class EntryStore:
    """The folder of one entry."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.groups = path / "groups"
        self.claims = path / "claims"
        self.evaluations = path / "evaluations"
        self.start = path / "start"

    @property
    def mark(self) -> str:
        """The end of the folder's name if another code has the name alone: `@1a2b3c4d`; else empty."""
        found = _MARK.search(self.path.name)
        return found[0] if found is not None and found.end() == len(self.path.name) else ""

    @property
    def name(self) -> str:
        """The folder's name without the mark."""
        return self.path.name.removesuffix(self.mark)

    @property
    def trained(self) -> str:
        """When the newest epoch of its seeds ended, in UTC; empty if not recorded."""
        times = [""]
        for seed in self.seeds():
            with contextlib.suppress(StoreError):  # is said where the seed is read
                times += [line.time for line in self.seed(seed).times()[-1:]]
        return max(times)

    @classmethod
    def find(cls, runs: Path, entry: Entry, mark: str = "") -> EntryStore:
        """Return the entry's folder below a results folder, existing or not.

        Parameters
        ----------
        mark:
            Mark of another code than the code of the folder without a mark.
        """
        store = cls(runs / entry.task.name / f"{entry.name}{mark}")
        genuine.require_no_link(store.path.parent, store.path)
        if (store.path / "entry.json").exists() and store.record().hash != entry.hash:
            raise StoreError(f"{store.path} belongs to another entry; choose another folder with --runs DIR")
        return store

    @classmethod
    def of_name(cls, runs: Path, entry: Entry) -> list[EntryStore]:
        """Return the folders of an entry below a results folder, one for each code; the one without a mark first."""
        others = (runs / entry.task.name).glob(f"{entry.name}@*")
        marks = dict.fromkeys(["", *sorted(cls(path).mark for path in others)])
        stores = [cls.find(runs, entry, mark) for mark in marks]
        return [store for store in stores if (store.path / "entry.json").exists()]

    @classmethod
    def create(cls, runs: Path, entry: Entry, mark: str = "") -> EntryStore:
        """Return the entry's folder below a results folder; create it if it does not exist.

        If the entry's settings come from tuning, its record says so from now on. Of two records of tuning the one with
        more steps stays; a record without steps gives way to one with steps. `mark` is as for `find`.
        """
        store = cls.find(runs, entry, mark)
        if not (store.path / "entry.json").exists():
            store.write_record(EntryRecord.of(entry))
        elif entry.tuning is not None:
            record = store.record()
            if _steps(record.tuning) < _steps(EntryTuning(**entry.tuning)):
                store.write_record(record.changed(tuning=entry.tuning))
        return store

    def record(self) -> EntryRecord:
        """Return `entry.json`."""
        path = self.path / "entry.json"
        genuine.require_no_link(self.path.parent, self.path, path)
        return EntryRecord.read(read_json(path), path)

    def write_record(self, record: EntryRecord) -> None:
        """Replace `entry.json`."""
        write_json(self.path / "entry.json", record.content)

    @functools.cached_property
    def names(self) -> dict[str, str]:
        """Names that each seed's record must have: `entry`, `task`, `task_hash`; empty if `entry.json` is damaged."""
        try:
            record = self.record()
        except StoreError:
            return {}
        return {"entry": record.name, "task": record.task_name, "task_hash": record.task_hash}

    def entry(self) -> Entry:
        """Build the entry that the folder belongs to."""
        record = self.record()
        if record.imported:
            kept = "evaluated" if record.identity.algorithm == SCRIPT else "trained, evaluated or published"
            raise StoreError(
                f"{self.path} holds curves that another program made: they can be compared, not {kept}"
            )
        try:
            entry = record.entry(str(self.path / "entry.json"))
            if hasattr(entry.model_options, "ansatz_options"):  # else a word of the model's own
                registry.load().get(specs.AnsatzSpec, entry.model_options.ansatz)
            return entry
        except UnknownNameError as error:
            raise UnknownNameError(f"{error}{copies_of_plugins(self, record)}") from None

    def seed(self, seed: int) -> SeedStore:
        """Return the folder of one seed (it need not exist)."""
        return SeedStore(self.path / f"seed-{seed:04d}", seed, self)

    def seeds(self) -> list[int]:
        """Return the seeds that have a folder, sorted; `seed-00007` is none, for seed 7 has `seed-0007`.

        A seed that a killed import had moved aside, and not replaced yet, is put back.
        """
        for aside in self.path.glob(f".seed-*{ASIDE}"):
            place = aside.with_name(aside.name[1 : -len(ASIDE)])
            if _SEED_FOLDER.fullmatch(place.name) and not place.exists():
                with contextlib.suppress(OSError):  # the import is alive, or the folder cannot be written
                    aside.rename(place)
        children = self.path.iterdir() if self.path.is_dir() else ()
        matches = [_SEED_FOLDER.fullmatch(child.name) for child in children if child.is_dir()]
        return sorted(int(match.group(1)) for match in matches if match)

    def put(self, seed: int, write: Writer) -> bool:
        """Put a seed into its place, whole or not at all; an existing seed stays until the new one is whole.

        A seed without an agent does not replace one that has an agent: False.
        """
        place = self.seed(seed).path
        made, aside = (place.with_name(f".{place.name}{end}") for end in (".import", ASIDE))
        try:
            shutil.rmtree(made, ignore_errors=True)
            write(SeedStore(made, seed))
            if self.seed(seed).agent.exists() and not SeedStore(made, seed).agent.exists():
                shutil.rmtree(made, ignore_errors=True)
                return False
            if place.exists():
                shutil.rmtree(aside, ignore_errors=True)
                place.rename(aside)
            made.rename(place)
            if aside.exists():
                aside.rename(made)  # so that a half-removed folder is never put back
            shutil.rmtree(made, ignore_errors=True)
        except OSError as error:
            self.seeds()  # puts the old seed back
            shutil.rmtree(made, ignore_errors=True)
            raise StoreError(f"cannot write {place}: {error.strerror or error}") from None
        return True

    def start_of(self, seed: int) -> Path:
        """Return the file of the agent with which a seed's training begins, where its entry begins with agents."""
        return self.start / f"seed-{seed:04d}.safetensors"

    def initial(self, seeds: Sequence[int]) -> Arrays:
        """Return the agents with which the training of seeds begins, seed-first by name."""
        agents = []
        for seed in seeds:
            path = self.start_of(seed)
            try:
                agents.append(read_arrays(path))
            except FileNotFoundError:
                raise StoreError(
                    f"{path} is missing, the agent with which seed {seed} begins: run it with --from ENTRY"
                ) from None
            require_finite(agents[-1], path)
        try:
            return {name: np.stack([agent[name] for agent in agents]) for name in (agents or [{}])[0]}
        except (KeyError, ValueError):
            raise StoreError(f"{self.start} holds agents of different models: restore it") from None

    def finished(self, seeds: Iterable[int], epochs: int) -> set[int]:
        """Return which of the seeds have completed that many epochs."""
        return {seed for seed in seeds if self.seed(seed).finished(epochs)}


def copies_of_plugins(store: EntryStore, record: EntryRecord) -> str:
    """Return a hint how to load the copies of plugins in an entry's folder; empty if there are none."""
    names = sorted({Path(place).name for places in record.plugins.values() for place in places})
    if not names:
        return ""
    return f"; {store.path} has a copy of {' and '.join(names)}: if you trust it, add --plugin {store.path}"


def plugins_in(runs: Path, unknown: str) -> str:
    """Return a hint if an entry of a results folder has a copy of the plugin that registers an unknown name.

    Parameters
    ----------
    unknown:
        The message about the unknown name, with the name in quotes.
    """
    name = unknown.partition("'")[2].partition("'")[0]
    for store in entries(runs) if runs.is_dir() else ():
        try:
            record = store.record()
        except StoreError:
            continue
        if f'"{name}"' in json.dumps(record.identity.content) and (hint := copies_of_plugins(store, record)):
            return hint
    return ""


ANOTHER_FOLDER = "`qrlsuite run` makes one, --runs DIR (in Python runs=DIR) names another"
"""How a results folder is made, and named."""


def entries(runs: Path, task: str | None = None) -> list[EntryStore]:
    """Return every entry's folder below a results folder, sorted by path."""
    if not runs.is_dir():
        raise StoreError(f"there is no results folder {runs}: {ANOTHER_FOLDER}")
    pattern = f"{task}/*/entry.json" if task else "*/*/entry.json"
    return [EntryStore(path.parent) for path in sorted(runs.glob(pattern))]
