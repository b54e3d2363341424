"""Turns released result files into an entry: learning curves to compare with, which cannot be trained further.

An imported entry's identity is the task, the algorithm and the label under which it was imported; its model is called
`imported`, so that it never meets an entry of this suite's own, and its label ends in "(imported)". Every file is one
seed, numbered in the order in which the files were given; the file's name, digest and arguments are in `run.json`.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite import registry, specs
from qrlsuite.errors import StoreError
from qrlsuite.experiment.task import Task, digest
from qrlsuite.results.claims import SeedsClaimedError, acquire
from qrlsuite.results.provenance import collect
from qrlsuite.results.records import RunRecord
from qrlsuite.results.store import EntryStore, shortest, table_bytes, write_atomically, write_json
from qrlsuite_released.unpickle import Released, read

MODEL = "imported"
_ANY = (0,)
"""What an import claims: nothing else works on an imported entry, so one seed stands for all."""


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    Attributes
    ----------
    new, known:
        Seeds that were added, and number of files that were there already.
    differing:
        Arguments, other than seeds, in which the files differ.
    """

    store: EntryStore
    label: str
    new: tuple[int, ...]
    known: int
    differing: tuple[str, ...]


def import_files(
    files: Sequence[Path],
    task: Task,
    algorithm: str,
    label: str,
    runs: Path,
    quantum: str | None = None,
    each: Callable[[Path], None] = lambda path: None,
) -> Imported:
    """Import files as the seeds of one entry; those imported before are left as they are.

    Parameters
    ----------
    quantum:
        Pattern (`*`, `?`) of the names of the model's tensors that are parameters of a circuit.
    each:
        Called with every file before it is read.

    Raises
    ------
    StoreError
        If a file is refused or its returns cannot be scores of the task, or another import into the same entry is
        going on; nothing is then written.
    UnknownNameError
        If there is no such algorithm.
    """
    registry.get(specs.AlgorithmSpec, algorithm)
    contents = []
    for path in files:
        each(path)
        content = read(path)
        contents.append(
            (path, content, _scores(content.returns, task, path), _parameters(content, quantum, path))
        )
    store = _create(task, algorithm, label, runs)
    try:
        claim = acquire(store, _ANY)  # before the numbers are chosen: two imports would choose the same
    except SeedsClaimedError:
        raise StoreError(
            f"another import into {store.path} is going on: repeat this command when it has ended"
        ) from None
    try:
        seeds = store.seeds()
        records = [record for seed in seeds if (record := store.seed(seed).record()) is not None]
        digests = {record.imported.get("sha256") for record in records}
        new: list[int] = []
        for path, content, scores, parameters in contents:
            if content.sha256 not in digests:
                digests.add(content.sha256)
                new.append(max([*seeds, *new], default=-1) + 1)
                _write(store, new[-1], path, content, scores, parameters)
    finally:
        claim.release()
    return Imported(
        store, label, tuple(new), len(files) - len(new), _differing([c for _, c, _, _ in contents])
    )


def _scores(returns: NDArray[np.float64], task: Task, path: Path) -> NDArray[np.float64]:
    """Turn validation returns (T, episodes) into scores.

    Raises
    ------
    StoreError
        If they lie outside [0, 1] and the task does not say what the best return is.
    """
    best = task.file.score.max_return
    scores = returns if best is None else returns / best
    if best is None and (scores.min() < -1e-6 or scores.max() > 1 + 1e-6):
        raise StoreError(
            f"{path}: its validation returns lie between {scores.min():g} and {scores.max():g}, and the scores of task "
            f"'{task.name}' between 0 and 1: they are not of this task (give it with --task)"
        )
    return np.clip(scores, 0, 1) if best is None else scores


def _parameters(content: Released, quantum: str | None, path: Path) -> dict[str, int]:
    sizes = {name: math.prod(shape) for name, shape in content.shapes.items()}
    circuit = [name for name in sizes if quantum is not None and fnmatch.fnmatchcase(name, quantum)]
    if quantum is not None and not circuit:
        raise StoreError(
            f"{path}: no tensor of its model matches '{quantum}'; it has {', '.join(sizes) or 'none'}"
        )
    total, of_circuit = sum(sizes.values()), sum(sizes[name] for name in circuit)
    return {"classical": total - of_circuit, "quantum": of_circuit}


def _create(task: Task, algorithm: str, label: str, runs: Path) -> EntryStore:
    identity = {
        "task": task.definition,
        "algorithm": algorithm,
        "algorithm_options": {},
        "model": MODEL,
        "model_options": {"label": label},
    }
    name = f"{algorithm}-{MODEL}-{digest(identity)[:8]}"
    store = EntryStore(runs / task.name / name)
    if not (store.path / "entry.json").exists():
        record = {
            "name": name,
            "hash": digest(identity),
            "label": f"{algorithm} {label} ({MODEL})",
            "imported": True,
            "preset": None,
            "task_name": task.name,
            "task_hash": task.hash,
            "task_file": task.file.model_dump(mode="json"),
            "identity": identity,
        }
        write_json(store.path / "entry.json", record)
    return store


def _write(
    store: EntryStore,
    seed: int,
    path: Path,
    content: Released,
    scores: NDArray[np.float64],
    parameters: dict[str, int],
) -> None:
    """Write one seed: its curve first, the record that makes it count last."""
    entry = store.record()
    rows: list[dict[str, Any]] = []
    for epoch, row in enumerate(scores, start=1):
        line: dict[str, Any] = {"epoch": epoch, "scores": shortest(row)}
        if content.train_returns is not None:
            line["train_return"] = float(content.train_returns[epoch - 1])
        rows.append(line)
    folder = store.seed(seed)
    write_atomically(folder.table, table_bytes(rows))
    folder.write_record(
        RunRecord.model_validate(
            {
                "task": entry.task_name,
                "task_hash": entry.task_hash,
                "entry": entry.name,
                "label": entry.label,
                "algorithm": entry.identity.algorithm,
                "algorithm_options": {},
                "model": MODEL,
                "family": "quantum" if parameters["quantum"] else "classical",
                "model_options": entry.identity.model_options,
                "parameters": parameters,
                "seed": seed,
                "status": "finished",
                "epochs": len(rows),
                "imported": {
                    "file": path.name,
                    "sha256": content.sha256,
                    "arguments": dict(content.arguments),
                },
                "provenance": [{"imported_with": collect([]).versions}],
            }
        )
    )


def _differing(contents: Sequence[Released]) -> tuple[str, ...]:
    names = sorted({name for content in contents for name in content.arguments})
    return tuple(
        name
        for name in names
        if "seed" not in name.lower() and len({repr(content.arguments.get(name)) for content in contents}) > 1
    )
