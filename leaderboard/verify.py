"""Checking published entries: their files, and some of their seeds by training them again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from qrlsuite.errors import QrlSuiteError, listed
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry, from_record
from qrlsuite.leaderboard import origin, published
from qrlsuite.leaderboard.fingerprint import fingerprint
from qrlsuite.leaderboard.published import PublishedEntry
from qrlsuite.results import codes, provenance
from qrlsuite.results.progress import Progress
from qrlsuite.results.store import learning_curve

AGREEMENT = 1e-5
"""How closely the beginnings of runs agree between machines, relative to 1 or the value."""
P_VALUE = 0.01
"""Below it, final scores of a re-run are not plausible members of the entry."""

Check = Literal["files", "equal", "plausible"]


@dataclass(frozen=True)
class VerificationResult:
    """What came of checking one entry.

    Attributes
    ----------
    check:
        The strongest check that was made: of the files alone, of equal curves, or of plausible ones.
    seeds:
        The seeds that were trained again.
    message:
        What was checked and what came out, in words.
    """

    folder: Path
    name: str
    ok: bool
    check: Check
    seeds: tuple[int, ...]
    message: str

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "entry": self.name,
            "folder": str(self.folder),
            "ok": self.ok,
            "check": self.check,
            "seeds": list(self.seeds),
            "message": self.message,
        }


def find(path: Path) -> list[Path]:
    """Return the absolute paths of the published entries at or below a folder, sorted.

    An entry is checked against the names of the folders that it lies in, which `.` does not have.

    Raises
    ------
    QrlSuiteError
        If there is none.
    """
    place = path.absolute()
    if (place / "entry.json").exists():
        return [place]
    folders = sorted(
        {p.parent for p in place.glob("*/*/entry.json")} | {p.parent for p in place.glob("*/entry.json")}
    )
    if not folders:
        raise QrlSuiteError(f"{path} holds no published entry: qrlsuite export ENTRY --out {path}")
    return folders


def verify(
    folder: Path,
    rerun: int = 0,
    generator: np.random.Generator | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
) -> VerificationResult:
    """Check one published entry.

    With `rerun`, that many seeds are chosen at random and trained again from nothing, on the CPU. On the type of
    machine and with the versions that made them, their curves must be equal. Elsewhere, and where they were made on a
    GPU, floating point differs in the last bits and training amplifies that, so that initial parameters, the first
    epoch's episodes and the score before training must agree to 1e-5, and the final scores must be plausible members
    of the entry (two-sided Mann-Whitney rank test, p > .01).

    Parameters
    ----------
    generator:
        Chooses the seeds; fresh entropy by default, which nobody who forges an entry can foresee.
    report:
        Called with the progress of the training.
    """
    name = f"{folder.parent.name}/{folder.name}"
    try:
        entry = published.read(folder)
        made_by = from_record(entry.record, str(folder / "entry.json")) if rerun else None
    except QrlSuiteError as error:
        return VerificationResult(folder, name, False, "files", (), str(error))
    count, length = entry.curves.shape
    sound = f"files sound: {count} seeds of {length} epochs, hashes and label computed again"
    if made_by is None:
        return VerificationResult(folder, name, True, "files", (), sound)
    if changed := _changed_code(entry, made_by):
        return VerificationResult(folder, name, False, "files", (), changed)
    chooser = generator or np.random.default_rng()
    places = sorted(int(i) for i in chooser.choice(count, size=min(rerun, count), replace=False))
    seeds = tuple(entry.seeds[place] for place in places)
    problem = _beginning(entry, made_by, places)
    if problem:
        return VerificationResult(folder, name, False, "plausible", seeds, problem)
    again = _train(made_by, seeds, length, report)
    differs = _elsewhere(entry, made_by, places)
    if differs is None:
        return _equal(entry, name, places, seeds, again)
    return _plausible(entry, name, places, seeds, again, differs)


def _changed_code(entry: PublishedEntry, made_by: Entry) -> str | None:
    """Say in what the installed code differs from that which made an entry; None where that is unknown or nothing."""
    made_with = codes.read(entry.record, entry.folder / "entry.json")
    if made_with is None:
        return None
    changed = identity.differences(made_with.parts, identity.of(made_by).parts)
    return f"its seeds cannot be trained again by this code: {listed(changed)}" if changed else None


def _beginning(entry: PublishedEntry, made_by: Entry, places: Sequence[int]) -> str | None:
    """Say what differs before training, None where everything agrees."""
    seeds = [entry.seeds[place] for place in places]
    here, stated = fingerprint(made_by, seeds), entry.fingerprint
    parts = {
        "initial parameters": (here.parameters, stated.parameters),
        "the first epoch's episodes": (here.episodes, stated.episodes),
        "the score before training": (here.before, stated.before),
    }
    for name, (computed, published_values) in parts.items():
        published_part = published_values[list(places)]
        if computed.shape != published_part.shape:
            return f"seeds {_list(seeds)}: {name} are of another number"
        away = np.abs(computed - published_part) > AGREEMENT * np.maximum(1, np.abs(published_part))
        if away.any():
            most = np.abs(computed - published_part).max()
            return f"seeds {_list(seeds)}: {name} differ by {most:.2g}, more than {AGREEMENT:g}"
    return None


def _train(
    made_by: Entry, seeds: Sequence[int], epochs: int, report: Callable[[Progress], None]
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Train seeds from nothing, in memory; returns their curves (seeds, epochs)."""
    from qrlsuite.training.trainer import Trainer  # torch, which checking files does without

    trainer = Trainer(made_by, seeds, report=report)
    trainer.progress.epochs = epochs
    trainer.start()
    curves = []
    for _ in range(epochs):
        scores = trainer.train_epoch().scores
        curves.append(learning_curve(np.asarray(scores, np.float32)))
        trainer.progress.epoch = trainer.epoch
    return np.stack(curves, axis=1)


def _elsewhere(entry: PublishedEntry, made_by: Entry, places: Sequence[int]) -> str | None:
    """Say in what this machine differs from the one that made the seeds; None where bits must be equal.

    The suite's version does not count: its parts compute equal bits while their `numerics` are equal, which are 1 where
    none are recorded. Versions of plugins, and the device, are missing from what earlier versions of the suite
    recorded: they are then not compared, and the device was the CPU.
    """
    here = provenance.of(made_by)
    for record in (made for place in places for made in origin.all_of(entry.provenance[place])):
        if provenance.device_kind(record) != "cpu":
            name = record["device"].get("name", "unknown")
            return f"trained on the CPU here, on {provenance.device_kind(record)} ({name}) there"
        versions = record.get("versions")
        versions = versions if isinstance(versions, dict) else {}
        for name, version in here["versions"].items():
            compared = name != "qrlsuite" and (name in versions or name in provenance.PACKAGES)
            if versions.get(name) != version and compared:
                return f"{name} {version} here, {versions.get(name)} there"
        numerics = record.get("numerics")
        numerics = numerics if isinstance(numerics, dict) else {}
        for role, number in here["numerics"].items():
            if numerics.get(role, 1) != number:
                return f"numerics {number} of the {role} here, {numerics.get(role, 1)} there"
        for name in ("processor", "system", "python"):
            if record.get(name) != here[name]:
                return f"{name} {here[name]} here, {record.get(name)} there"
    return None


def _equal(
    entry: PublishedEntry,
    name: str,
    places: Sequence[int],
    seeds: tuple[int, ...],
    again: np.ndarray[Any, Any],
) -> VerificationResult:
    stated = entry.curves[list(places)]
    if np.array_equal(again, stated):
        message = (
            f"seeds {_list(seeds)} trained again: curves equal, bit for bit (same versions and processor)"
        )
        return VerificationResult(entry.folder, name, True, "equal", seeds, message)
    row, epoch = np.argwhere(again != stated)[0]
    message = (
        f"seed {seeds[row]} trained again differs from epoch {epoch + 1} on ({again[row, epoch]:.6f}, published "
        f"{stated[row, epoch]:.6f}), with the same versions on the same processor"
    )
    return VerificationResult(entry.folder, name, False, "equal", seeds, message)


def _plausible(
    entry: PublishedEntry,
    name: str,
    places: Sequence[int],
    seeds: tuple[int, ...],
    again: np.ndarray[Any, Any],
    differs: str,
) -> VerificationResult:

    from scipy.stats import mannwhitneyu  # a second, which checking files does without

    others = np.delete(entry.curves[:, -1], list(places))
    begun = f"seeds {_list(seeds)} begin alike to {AGREEMENT:g}"
    if not len(others):
        return VerificationResult(
            entry.folder, name, True, "plausible", seeds, f"{begun} ({differs}); no others to rank them with"
        )
    p = float(mannwhitneyu(again[:, -1], others, alternative="two-sided").pvalue)
    p = 1.0 if np.isnan(p) else p  # all scores equal
    verdict = "plausible" if p > P_VALUE else "not plausible"
    message = (
        f"{begun}; their final scores are {verdict} among the others (rank test, p = {p:.2g}); {differs}"
    )
    return VerificationResult(entry.folder, name, p > P_VALUE, "plausible", seeds, message)


def _list(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, seeds))
