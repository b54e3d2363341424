"""How long training takes here: from what was measured, scaled by reference measurements where need be.

A speed is the time of one epoch of one seed, training and validation, on one core, as its share of the group that
it was trained in. An estimate says what it rests on, from the best evidence to the weakest:

- `measured`: epochs of this very entry in this results folder;
- `scaled`: epochs of the most similar entry in it, times the ratio of the two entries' reference speeds;
- `alike`: epochs of the most similar entry, as they are, where there is no reference;
- `reference`: the speed of the most similar entry on another machine;
- `unknown`: there is nothing to go by until a first epoch has been trained.
"""

from __future__ import annotations

import math
import statistics
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import BaseModel, ConfigDict, Field

from qrlsuite import options, registry, specs
from qrlsuite.errors import StoreError, TaskError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.store import EntryStore, entries, read_lines

SAMPLED_SEEDS = 8
"""Seeds of an entry whose timings are read; those of a group hardly differ."""

BASES = {
    "measured": "measured on its own epochs",
    "scaled": "measured on a similar entry, scaled by reference speeds",
    "alike": "measured on a similar entry, not scaled",
    "reference": "reference speeds of another machine",
    "unknown": "not known before a first epoch is trained",
}

Basis = Literal["measured", "scaled", "alike", "reference", "unknown"]


@dataclass(frozen=True)
class Speed:
    """A speed and what it was measured on.

    Attributes
    ----------
    kind:
        Environment, algorithm and model: speeds of different kinds say nothing about each other.
    options:
        Everything else that may matter, by name.
    seconds:
        Seconds per seed and epoch on one core.
    """

    kind: tuple[str, str, str]
    options: Mapping[str, Any]
    seconds: float
    hash: str = ""


@dataclass(frozen=True)
class Estimate:
    """Seconds per seed and epoch on one core, None where unknown, and what that rests on."""

    seconds: float | None
    basis: Basis


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    environment: str
    algorithm: str
    model: str
    options: Annotated[dict[str, Any], Field(description="of the model, the algorithm or the task")] = {}
    seconds: Annotated[float, Field(gt=0, lt=1e9)]


class SpeedFile(BaseModel):
    """A file of reference speeds: where they were measured, and one row per measurement."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    format_version: Literal[1]
    machine: str
    speeds: list[_Row]


@dataclass
class Speeds:
    """What was measured in a results folder, and reference speeds."""

    measured: list[Speed] = field(default_factory=list)
    references: list[Speed] = field(default_factory=list)

    def estimate(self, entry: Entry) -> Estimate:
        """Return the best estimate for an entry."""
        subject = _subject(entry)
        for speed in self.measured:
            if speed.hash == entry.hash:
                return Estimate(speed.seconds, "measured")
        reference = _nearest(subject, self.references)
        alike = _nearest(subject, self.measured)
        if alike is not None:
            base = _nearest(alike, self.references)
            if reference is None or base is None:
                return Estimate(alike.seconds, "alike")
            return Estimate(alike.seconds * reference.seconds / base.seconds, "scaled")
        return (
            Estimate(reference.seconds, "reference") if reference is not None else Estimate(None, "unknown")
        )

    def note(self, store: EntryStore) -> None:
        """Take in what an entry's folder has measured by now."""
        found = measure(store)
        if found is not None:
            self.measured = [*(speed for speed in self.measured if speed.hash != found.hash), found]


def known(*folders: Path) -> Speeds:
    """Read the speeds of results folders, and the reference speeds of all studies: the evidence of every estimate.

    Raises
    ------
    TaskError
        If a file of reference speeds is malformed.
    """
    references = [
        registered.spec.speeds
        for kind, registered in registry.load()
        if kind == "studies" and isinstance(registered.spec, specs.StudySpec)
    ]
    speeds = gather(folders[0], dict.fromkeys(references))
    for folder in folders[1:]:
        speeds.measured += gather(folder).measured
    return speeds


def gather(runs: Path, references: Iterable[str | None] = ()) -> Speeds:
    """Read the speeds of every entry in a results folder, and files of reference speeds; damage is passed over.

    Raises
    ------
    TaskError
        If a file of reference speeds is malformed.
    """
    speeds = Speeds(references=[row for path in references if path is not None for row in load(Path(path))])
    for store in entries(runs) if runs.is_dir() else []:
        try:
            speeds.note(store)
        except StoreError:
            continue
    return speeds


def load(path: Path) -> list[Speed]:
    """Read a file of reference speeds.

    Raises
    ------
    TaskError
        If it cannot be read or is malformed; every problem is listed.
    """
    try:
        file = SpeedFile.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TaskError(f"{path.name} cannot be read: {error}") from None
    except pydantic.ValidationError as error:
        raise TaskError(f"{path.name}: " + "; ".join(options.file_problems(error, SpeedFile))) from None
    return [
        Speed((row.environment, row.algorithm, row.model), row.options, row.seconds) for row in file.speeds
    ]


def measure(store: EntryStore) -> Speed | None:
    """Return the median speed of an entry's epochs, None where too little was timed (imported entries, for example).

    A seed's first epoch does not count: it holds the start of its process. Nor do small groups where there were larger
    ones, for a seed alone takes many times its share of a group.

    Raises
    ------
    StoreError
        If a file is damaged.
    """
    record = store.record()
    identity = record["identity"]
    by_group: dict[int, list[float]] = {}
    for seed in store.seeds()[-SAMPLED_SEEDS:]:
        for line in read_lines(store.seed(seed).timings)[1:]:
            values = [line.get(name) for name in ("train", "validate")]
            group = line.get("group", 1)
            if isinstance(group, int) and all(isinstance(v, int | float) and 0 <= v < 1e9 for v in values):
                by_group.setdefault(group, []).append(sum(values))  # type: ignore[arg-type]
    seconds = by_group[max(by_group)] if by_group else []
    if not seconds or not statistics.median(seconds) > 0:
        return None
    task = record["task_file"]
    return Speed(
        (str(task["environment"]["name"]), str(identity["algorithm"]), str(identity["model"])),
        _options(task, identity),
        float(statistics.median(seconds)),
        str(record["hash"]),
    )


def _subject(entry: Entry) -> Speed:
    record = entry.record()
    kind = (entry.task.environment.name, entry.algorithm.name, entry.model.name)
    return Speed(kind, _options(record["task_file"], entry.identity), math.nan, entry.hash)


def _options(task: Mapping[str, Any], identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an entry's speed may depend on, by name; a list counts by its length."""
    protocol = task["protocol"]
    found: dict[str, Any] = {
        name: protocol.get(name) for name in ("environments", "interactions", "validation_episodes")
    }
    for part in (
        task["environment"].get("options"),
        identity.get("algorithm_options"),
        identity.get("model_options"),
    ):
        found |= part or {}
    return {name: len(value) if isinstance(value, list) else value for name, value in found.items()}


def _nearest(subject: Speed, known: Sequence[Speed]) -> Speed | None:
    """Return the most similar speed of the same kind: few options differ, and numbers by a small ratio."""
    same = [speed for speed in known if speed.kind == subject.kind]
    return min(same, key=lambda speed: _distance(subject.options, speed.options), default=None)


def _distance(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    total = 0.0
    for name in first.keys() & second.keys():
        a, b = first[name], second[name]
        if a == b:
            continue
        numbers = all(
            isinstance(value, int | float) and not isinstance(value, bool) and value > 0 for value in (a, b)
        )
        total += abs(math.log(a / b)) if numbers else 1.0
    return total
