"""Published entries: validation curves and their provenance in three small files, and trained agents.

    <task>/<entry>/entry.json       every option, versions and processors
                   curves.parquet   seed, epoch, score (the mean of each validation), and other metrics
                   seeds.parquet    per seed: hours, circuit executions, and a fingerprint from before training
                   agents.safetensors  the trained parameters of all or some seeds, seed-first; optional

Nothing in them is believed: hashes are computed again, the folder's place, the label and every number are
checked, and every figure of a leaderboard is computed from the curves.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
from numpy.typing import NDArray
from safetensors.numpy import save as encode

from qrlsuite.engine.terminal import command
from qrlsuite.errors import QrlSuiteError, StoreError, listed
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.experiment.task import TaskFile
from qrlsuite.files import read_bytes
from qrlsuite.leaderboard.shelf.curves import EntryResults, require_scores
from qrlsuite.leaderboard.shelf.fingerprint import Fingerprint
from qrlsuite.notation import parse_entry
from qrlsuite.registry import load as registered
from qrlsuite.results import parquet
from qrlsuite.results.records import (
    MEASURED,
    AgentsRecord,
    EntryRecord,
    Provenance,
    PublishedRecord,
    RunRecord,
)
from qrlsuite.results.store import (
    Arrays,
    EntryStore,
    SeedRun,
    SeedStore,
    read_arrays,
    require_finite,
)
from qrlsuite.specs import NAME, AlgorithmSpec, EnvironmentSpec, ModelSpec
from qrlsuite.statistics.grid import settled

PUBLISHED = Path(__file__).parents[1] / "entries"
"""The entries that come with the suite and stand on its boards."""

OF_STUDIES = Path(__file__).parents[1] / "unranked"
"""The entries of studies that come with the suite. Boards leave them out: every further entry makes pairs harder to
decide.

A study ranks its own entries. A task without other entries has a board of them.
"""

CURVES = "curves.parquet"
SEEDS = "seeds.parquet"
AGENTS = "agents.safetensors"
MAX_BYTES = 20_000_000
"""A larger file, packed or unpacked, is refused, as is one with more values than its seeds and epochs make."""


@dataclass(frozen=True)
class PublishedEntry:
    """A published entry, checked.

    Attributes
    ----------
    curves:
        (N, T) float64.
    hours, executions:
        (N,): core-hours and circuit executions per seed.
    measured:
        Metrics of the environment by name, (N, T); NaN where it measured none.
    origins:
        (N,): index of each seed's provenance in the record.
    fingerprint:
        Fingerprint of the seeds from before training.
    """

    folder: Path
    record: EntryRecord
    seeds: tuple[int, ...]
    curves: NDArray[np.float64]
    measured: Mapping[str, NDArray[np.float64]]
    hours: NDArray[np.float64]
    executions: NDArray[np.int64]
    origins: NDArray[np.int64]
    fingerprint: Fingerprint

    @property
    def task_file(self) -> TaskFile:
        """The task as the record holds it."""
        return self.record.task_file

    @property
    def published(self) -> PublishedRecord:
        """The published part of the record."""
        assert self.record.published is not None
        return self.record.published

    @property
    def provenance(self) -> list[Provenance]:
        """The provenance of each seed, in the seeds' order."""
        return [self.published.provenance[index] for index in self.origins]

    @property
    def agents(self) -> tuple[int, ...]:
        """The seeds whose trained agents are published; none where the entry is of curves alone."""
        return () if self.published.agents is None else tuple(self.published.agents.seeds)

    def parameters(self) -> dict[int, Arrays]:
        """Return the trained parameters by seed."""
        path, stated = self.folder / AGENTS, self.published.agents
        if stated is None:
            return {}
        stacked = read_arrays(path, MAX_BYTES)
        if hashlib.sha256(read_bytes(path)).hexdigest() != stated.sha256:
            raise StoreError(
                f"{path} is not the file whose hash is in entry.json: restore it, or export the entry again"
            )
        require_finite(stacked, path)
        if not stacked or any(array.shape[:1] != (len(self.agents),) for array in stacked.values()):
            raise StoreError(f"{path} does not hold the {len(self.agents)} agents that entry.json names")
        return {
            seed: {name: array[row] for name, array in stacked.items()}
            for row, seed in enumerate(self.agents)
        }

    @property
    def withdrawn(self) -> dict[int, str]:
        """Why seeds that were asked for no longer are, by seed."""
        return {int(seed): reason for seed, reason in self.published.withdrawn.items()}

    def entry_results(self) -> EntryResults:
        """Return the entry as a leaderboard ranks it."""
        runs = {seed: self.run(row) for row, seed in enumerate(self.seeds)}
        asked = dict[int, int]()
        if self.record.plan is None:  # a study has a block of its own; other seeds may have been chosen
            asked = dict.fromkeys(set(range(len(self.seeds))) - self.withdrawn.keys(), self.published.epochs)
        facts = {"asked": asked, "withdrawn": self.withdrawn}
        return EntryResults.of(self.record, self.folder, runs, **facts)

    def run(self, row: int) -> SeedRun:
        """Return one seed in the form of a results folder; its `scores` are the means."""
        seed, said = self.seeds[row], self.published
        diverged = said.diverged.get(str(seed))
        record = RunRecord.model_construct(
            task=self.record.task_name,
            task_hash=self.record.task_hash,
            entry=self.record.name,
            parameters=said.parameters,
            seed=seed,
            code=self.record.code,
            probe=said.probe,
            status="finished",
            epochs=int(self.curves.shape[1]),
            diverged=diverged,
            agent=seed in self.agents,
            provenance=said.provenance[self.origins[row]].with_earlier,
        )
        return SeedRun(
            seed,
            record,
            self.curves[row][:, None],
            3600 * float(self.hours[row]),
            int(self.executions[row]),
            None,
            diverged,
            self.metrics(row),
            folder=self.folder,
            published=True,
        )

    def metrics(self, row: int) -> dict[str, NDArray[np.float64]]:
        """Return the metrics of one seed's environment, (T,) by name."""
        return {name: values[row] for name, values in self.measured.items()}


class PublishedAgents(EntryStore):
    """The seeds of a published entry that have agents, read like seeds of a results folder.

    Parameters
    ----------
    runs:
        A results folder for evaluations: nothing is written beside published files.
    """

    def __init__(self, folder: Path, runs: Path) -> None:
        super().__init__(folder)
        self.published = read(folder)
        if not self.published.agents:
            record = self.published.record
            words = command("run", "--task", record.task_name, record.label, runs=runs)
            with_agents = [
                f"{p.parent.parent.name}/{p.parent.name}"
                for at in folders()
                for p in at.glob(f"*/*/{AGENTS}")
            ]
            others = f" (published with agents: {listed(sorted(with_agents))})" if with_agents else ""
            raise StoreError(
                f"{folder} is published as curves without agents{others}; {words} trains it here"
            )
        self.agents = self.published.parameters()
        stated = self.published.published.agents
        assert stated is not None
        self.evaluations = runs / folder.parent.name / folder.name / f"evaluations-{stated.sha256[:16]}"

    def seeds(self) -> list[int]:
        """Return the seeds whose agents are there."""
        return sorted(self.agents)

    def seed(self, seed: int) -> SeedStore:
        """Return one seed."""
        return _PublishedSeed(self, seed)


class _PublishedSeed(SeedStore):
    """One published seed: its record, curve and parameters."""

    def __init__(self, of: PublishedAgents, seed: int) -> None:
        super().__init__(of.path, seed, of)
        self._published, self.agent = of, of.path / AGENTS

    def record(self) -> RunRecord | None:
        """Return the end and the code of a seed, as in `run.json`."""
        return self.read().record

    def read(self) -> SeedRun:
        """Return the seed's curve, hours and executions."""
        entry = self._published.published
        return entry.run(entry.seeds.index(self.seed))

    def parameters(self) -> Arrays:
        """Return the trained agent's parameters by name."""
        return self._published.agents[self.seed]


def folders() -> tuple[Path, ...]:
    """Return the folders of all entries that come with the suite."""
    return PUBLISHED, OF_STUDIES


def comes_with_suite(folder: Path) -> bool:
    """Return whether a folder holds an entry that comes with the suite."""
    return folder.parent.parent in folders()


def is_published(folder: Path) -> bool:
    """Return whether a folder holds a published entry rather than runs."""
    return (folder / CURVES).exists()


def read(folder: Path, label: bool = True) -> PublishedEntry:
    """Read a published entry and check all that can be checked without training.

    Parameters
    ----------
    label:
        Check the label, which imports the code of algorithm and model, and torch. Boards do without for entries that
        come with the suite: this file comes from the same place, and `verify` and the tests check them in full.
    """
    try:
        return _read(folder, label)
    except StoreError:
        raise
    except (
        QrlSuiteError,
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        OverflowError,
        RecursionError,
    ) as error:
        text = " ".join(str(error).split())[:200]
        raise StoreError(f"{folder}: not a published entry: {type(error).__name__}: {text}") from None


def _read(folder: Path, label: bool) -> PublishedEntry:
    _require(folder.is_dir(), folder, "it is gone: restore it; what is published is removed by maintainers")
    for name in ("entry.json", CURVES, SEEDS):
        if not (folder / name).is_file():
            raise StoreError(f"{folder}: {name} is missing; write the entry again with `qrlsuite export`")
        if (folder / name).stat().st_size > MAX_BYTES:
            raise StoreError(f"{folder / name}: larger than {MAX_BYTES // 1_000_000} MB")
    record = EntryStore(folder).record()
    published = record.published
    if published is None:
        raise StoreError(f"{folder / 'entry.json'} has no table 'published': it is no published entry's")
    _check_identity(folder, record)
    if label:
        _check_label(folder, record)
    rows = published.seeds * published.epochs
    seeds, curves, measured = _curves(folder, record.task_file, rows, published.measured)
    _require(
        published.diverged.keys() <= set(map(str, seeds))
        and all(epoch <= published.epochs for epoch in published.diverged.values()),
        folder,
        f"diverged: {str(published.diverged)[:100]} does not name seeds and their epochs",
    )
    facts = _table(folder / SEEDS, _SEED_COLUMNS, published.seeds, 10_000)
    _require(facts["seed"] == list(seeds), folder, f"{SEEDS} and {CURVES} hold different seeds")
    _check_agents(folder, published.agents, seeds)
    hours = np.array(facts["hours"], np.float64)
    executions = np.array(facts["executions"], np.int64)
    origins = np.array(facts["origin"], np.int64)
    beginning = Fingerprint(
        np.array(facts["parameters"], np.float64),
        np.array(facts["episodes"], np.float64),
        np.array(facts["before"], np.float64),
    )
    _require(
        bool(np.isfinite(hours).all() and (hours >= 0).all()), folder, "hours must be numbers, not negative"
    )
    _require(bool((executions >= 0).all()), folder, "circuit executions must not be negative")
    _require(
        bool((origins >= 0).all() and (origins < len(published.provenance)).all()),
        folder,
        "a seed names a provenance that is not there",
    )
    for values in (beginning.parameters, beginning.episodes, beginning.before):
        _require(bool(np.isfinite(values).all()), folder, f"{SEEDS} holds values that are not finite")
    _require(
        beginning.parameters.ndim == 2 and beginning.episodes.shape == (len(seeds), 2),
        folder,
        f"{SEEDS} has rows of different lengths",
    )
    return PublishedEntry(folder, record, seeds, curves, measured, hours, executions, origins, beginning)


def _check_agents(folder: Path, stated: AgentsRecord | None, seeds: Sequence[int]) -> None:
    """Check that the file of agents is there if, and only if, the record names seeds and a hash."""
    if stated is None:
        _require(
            not (folder / AGENTS).exists(), folder, f"{AGENTS} is there, and entry.json does not name it"
        )
        return
    _require(
        set(stated.seeds) <= set(seeds), folder, f"agents: not all of {str(stated.seeds)[:100]} are its seeds"
    )
    _require(
        (folder / AGENTS).is_file(),
        folder,
        f"{AGENTS} is missing; write the entry again with `qrlsuite export`",
    )


def _require(holds: bool, folder: Path, problem: str) -> None:
    if not holds:
        raise StoreError(f"{folder}: {problem}")


def _check_identity(folder: Path, record: EntryRecord) -> None:
    """Check that the hashes belong to the folder's place and the protocol."""
    for name in (record.identity.algorithm, record.identity.model):
        _require(bool(NAME.fullmatch(name)), folder, f"{name!r} is not a name")
    _require(
        (folder.parent.name, folder.name) == (record.task_name, record.name),
        folder,
        f"its place is {record.task_name}/{record.name}",
    )
    task_file, task = record.task_file, record.identity.task
    protocol = task_file.protocol
    stated = {
        "environment": task_file.environment.name,
        "environments": protocol.environments,
        "interactions": protocol.interactions,
        "validation_episodes": protocol.validation_episodes,
        "score": task_file.score.model_dump(mode="json"),
    }
    for name, value in stated.items():
        _require(
            task.get(name) == value,
            folder,
            f"its task file has {name} = {value!r}, its task {task.get(name)!r}",
        )


def _check_label(folder: Path, record: EntryRecord) -> None:
    """Check the label, and that the options still make the hash, as far as the parts are installed."""
    identity, registry = record.identity, registered()
    if not (
        identity.algorithm in registry.of(AlgorithmSpec)
        and identity.model in registry.of(ModelSpec)
        and record.task_file.environment.name in registry.of(EnvironmentSpec)
    ):
        usual = f"{identity.algorithm} {identity.model}"
        _require(record.label.startswith(usual), folder, f"its label does not begin with {usual!r}")
        return
    entry = record.entry(str(folder / "entry.json"))  # builds the options anew, and compares the hash
    _require(
        record.label == entry.label or _words(record.label) == _words(entry.label),
        folder,
        f"its label is {record.label!r}, and should be {entry.label!r}",
    )


def _words(label: str) -> list[tuple[str, str]]:
    """Return the options in a label; before 0.2.0 an ansatz's options were a table there."""
    written = parse_entry(label)
    words = [("algorithm", str(written.algorithm)), ("model", written.model)]
    for setting in written.settings:
        table = setting.name == "ansatz_options" and isinstance(setting.value, Mapping)
        values = setting.value if table else {setting.name: setting.value}
        words += [(name, repr(value)) for name, value in values.items()]
    return words


_CURVE_COLUMNS = {"seed": "int64", "epoch": "int64", "score": "double"}
_SEED_COLUMNS = {
    "seed": "int64",
    "origin": "int64",
    "hours": "double",
    "executions": "int64",
    "before": "double",
    "episodes": "list<double>",
    "parameters": "list<double>",
}


def _curves(
    folder: Path, task_file: TaskFile, rows: int, metrics: Sequence[str]
) -> tuple[tuple[int, ...], NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Read (N,) seeds, (N, T) curves of N T rows, and by name the metrics (N, T) beside them."""
    columns = {**_CURVE_COLUMNS, **{f"{MEASURED}.{name}": "double" for name in metrics}}
    table = _table(folder / CURVES, columns, rows, len(columns))
    numbers = np.array(table["seed"], np.int64)
    epochs, scores = np.array(table["epoch"], np.int64), np.array(table["score"], np.float64)
    seeds, counts = np.unique(numbers, return_counts=True)
    _require(len(seeds) > 0, folder, "it holds no run")
    _require(int(seeds[0]) >= 0, folder, f"seed {seeds[0]} is negative")
    _require(int(seeds[-1]) < TUNING_SEEDS, folder, f"seed {seeds[-1]} is one of those kept for tuning")
    length = int(epochs.max())
    order = np.lexsort((epochs, numbers))
    for seed, count in zip(seeds, counts):
        own = np.sort(epochs[numbers == seed])
        twice = own[1:][own[1:] == own[:-1]]
        _require(
            not len(twice), folder, f"seed {seed} is there twice (epoch {twice[0] if len(twice) else 0})"
        )
        _require(
            int(count) == length and int(own[0]) == 1,
            folder,
            f"seed {seed} has {count} of {length} epochs: some are missing",
        )
    require_scores(scores, task_file, folder)
    curves = settled(scores[order].reshape(len(seeds), length))
    _refuse_copies(folder, seeds.tolist(), curves)
    measured = {
        name: np.array(table[f"{MEASURED}.{name}"], np.float64)[order].reshape(curves.shape)
        for name in metrics
    }
    _require(not any(np.isinf(values).any() for values in measured.values()), folder, "a metric is infinite")
    return tuple(seeds.tolist()), curves, measured


def _refuse_copies(folder: Path, seeds: list[int], curves: NDArray[np.float64]) -> None:
    """Refuse two seeds with one curve. Curves of one or two values are allowed: runs that learn nothing share them."""
    first: dict[bytes, int] = {}
    for seed, curve in zip(seeds, curves):
        other = first.setdefault(curve.tobytes(), seed)
        _require(
            other == seed or len(np.unique(curve)) <= 2,
            folder,
            f"seeds {other} and {seed} have the same curve",
        )


def _table(path: Path, columns: Mapping[str, str], rows: int, values: int) -> dict[str, list[Any]]:
    """Read a parquet file that must hold exactly these columns, without empty cells.

    Parameters
    ----------
    rows, values:
        Rows at most, and values in each; a column is a dictionary of its values and places in it, so both may be there.
    """
    table = parquet.read(path, min(MAX_BYTES // 8, 2 * rows * values))
    types = {
        field.name: "list<double>"
        if pyarrow.types.is_list(field.type) and pyarrow.types.is_float64(field.type.value_type)
        else str(field.type)
        for field in table.schema
    }
    if types != dict(columns):
        raise StoreError(f"{path}: columns are {types}, and should be {dict(columns)}")
    if any(column.null_count for column in table.columns):
        raise StoreError(f"{path} has empty cells")
    result: dict[str, list[Any]] = table.to_pydict()
    return result


def files(
    record: Mapping[str, Any],
    seeds: tuple[int, ...],
    curves: NDArray[np.float64],
    hours: list[float],
    executions: list[int],
    made_with: list[Provenance],
    parameters: Mapping[str, int],
    beginning: Fingerprint,
    found: Mapping[str, Any],
    agents: Mapping[int, Arrays],
    measured: Mapping[str, NDArray[np.float64]],
) -> dict[str, bytes]:
    """Encode an entry's files, by name; equal entries give equal bytes.

    Parameters
    ----------
    record:
        `entry.json` of its runs.
    curves:
        (N, T).
    parameters:
        As `qrlsuite.results.store.parameters_of` returns them.
    hours, executions, made_with, beginning:
        Per seed, N of each.
    found:
        `diverged` and `probe`, as `PublishedEntry` has them; where there are none, their names are left out.
    agents:
        By seed the trained parameters, of no seed or more.
    measured:
        (N, T) by name, as `PublishedEntry` has them.
    """
    distinct: list[Provenance] = []
    for made in made_with:
        if made not in distinct:
            distinct.append(made)
    count, length = curves.shape
    stated, file = encode_agents(agents)
    content = {
        **record,
        "published": {
            "seeds": count,
            "epochs": length,
            "parameters": dict(parameters),
            "core_hours": round(math.fsum(hours), 6),
            "circuit_executions": sum(executions),
            "provenance": [made.content for made in distinct],
            **found,
            **stated,
            **({"measured": sorted(measured)} if measured else {}),
        },
    }
    return {
        **file,
        "entry.json": encode_record(content),
        CURVES: _encode(
            {
                "seed": np.repeat(np.array(seeds, np.int64), length),
                "epoch": np.tile(np.arange(1, length + 1, dtype=np.int64), count),
                "score": np.asarray(curves, np.float64).ravel(),
                **{f"{MEASURED}.{name}": values.ravel() for name, values in measured.items()},
            }
        ),
        SEEDS: _encode(
            {
                "seed": np.array(seeds, np.int64),
                "origin": np.array([distinct.index(made) for made in made_with], np.int64),
                "hours": np.array(hours, np.float64),
                "executions": np.array(executions, np.int64),
                "before": beginning.before,
                "episodes": beginning.episodes.tolist(),
                "parameters": beginning.parameters.tolist(),
            }
        ),
    }


def encode_record(content: Mapping[str, Any]) -> bytes:
    """Encode `entry.json`."""
    return json.dumps(content, indent=1, allow_nan=False).encode() + b"\n"


def encode_agents(agents: Mapping[int, Arrays]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the record of agents, and their file by name; both empty without agents."""
    if not agents:
        return {}, {}
    seeds = sorted(agents)
    try:
        stacked = {name: np.stack([agents[seed][name] for seed in seeds]) for name in agents[seeds[0]]}
    except (KeyError, ValueError):
        raise StoreError(
            "agents of one entry have different parameters: export it with --no-agents"
        ) from None
    content = encode(stacked)
    if len(content) > MAX_BYTES:
        size, most = len(content) / 1e6, MAX_BYTES // 1_000_000
        raise StoreError(f"its agents take {size:.0f} MB, more than {most}: export it with --no-agents")
    stated = {"sha256": hashlib.sha256(content).hexdigest(), "seeds": seeds}
    return {"agents": stated}, {AGENTS: content}


def _encode(columns: Mapping[str, Any]) -> bytes:

    sink = pyarrow.BufferOutputStream()
    table = pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()})
    pyarrow.parquet.write_table(table, sink, compression="zstd", compression_level=19)
    result: bytes = sink.getvalue().to_pybytes()
    return result
