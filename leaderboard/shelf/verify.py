"""Checking published entries: their files, and some of their seeds by training them again.

Which seeds, is drawn after the files are read, from fresh entropy. Curves that come out bit for bit are `verified`,
wherever they were trained. Where bits must be equal, one that is not is a failure; elsewhere they are not compared.
"""

from __future__ import annotations

import hashlib
import math
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from qrlsuite.errors import QrlSuiteError, StoreError, listed
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.files import read_bytes
from qrlsuite.leaderboard.shelf import published
from qrlsuite.leaderboard.shelf.absent import absent
from qrlsuite.leaderboard.shelf.fingerprint import CHUNK, fingerprint
from qrlsuite.leaderboard.shelf.published import PublishedEntry
from qrlsuite.results import provenance, speed
from qrlsuite.results.progress import Progress
from qrlsuite.results.store import learning_curve
from qrlsuite.results.text import hours_text

if TYPE_CHECKING:
    from qrlsuite.training.trainer import Trainer

AGREEMENT = 1e-5
"""How closely the beginnings of runs agree between machines, relative to 1 or the value."""
EXECUTIONS = 0.1
"""By how much circuit executions of seeds whose curves differ may differ in sum: episodes have other lengths."""
SAME = 1e-6
"""Two runs have not parted while their scores differ by less."""

Check = Literal["files", "verified", "repeated"]

POWER = 0.95
"""Probability of finding a forgery, for which the number of seeds is chosen."""

REPLACED = 0.1
"""Share of forged seeds that is to be found with that probability."""
Wanted = int | Literal["auto"]


@dataclass(frozen=True)
class VerificationResult:
    """The result of checking one entry.

    Attributes
    ----------
    check:
        The strongest statement: files and beginnings alone, or curves equal bit for bit (`verified`). Equal bits of
        seeds that an earlier draw named are `repeated`.
    seeds:
        The seeds that were trained again.
    message:
        Checks, results, and omitted comparisons, in words.
    digest:
        Hash of the entry's three files, 16 hexadecimal digits: it shows which checks are of equal files.
    choice:
        The number that drew the seeds; None if none were drawn.
    """

    folder: Path
    name: str
    ok: bool
    check: Check
    seeds: tuple[int, ...]
    message: str
    digest: str = ""
    choice: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "entry": self.name,
            "folder": str(self.folder),
            "ok": self.ok,
            "check": self.check,
            "seeds": list(self.seeds),
            "message": self.message,
            "digest": self.digest,
            "choice": self.choice,
        }


@dataclass(frozen=True)
class Retrained:
    """k seeds, trained again.

    Attributes
    ----------
    curves:
        (k, T).
    executions:
        (k,): circuit executions of each.
    parameters:
        Parameters that the entry's record may state: of all networks; and of the first network alone, if the record
        states no number of networks.
    measured:
        Metrics of each seed's environment by name, (T,).
    """

    curves: NDArray[np.float64]
    executions: NDArray[np.int64]
    agents: tuple[Mapping[str, NDArray[Any]], ...]
    parameters: tuple[Mapping[str, int], ...]
    measured: tuple[Mapping[str, NDArray[np.float64]], ...]


def find(path: Path) -> list[Path]:
    """Return the absolute paths of the published entries at or below a folder, sorted.

    An entry is checked against the names of the folders that it lies in, which `.` does not have.
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
    rerun: Wanted = 0,
    choice: int | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
    announce: Callable[[str], None] = lambda text: None,
) -> VerificationResult:
    """Check one published entry.

    With `rerun`, seeds are drawn and trained again from nothing, on the CPU. Initial parameters, the first epoch's
    episodes and the score before training must agree to 1e-5; numbers of parameters and circuit executions must equal
    the record. If versions and type of machine are equal, curves must be equal, bit for bit. Other curves that differ
    are not compared.

    Parameters
    ----------
    rerun:
        Number of seeds; `auto` for as many as find a tenth of forged seeds with probability .95.
    choice:
        The number of an earlier check, to train its seeds again. None draws a number that no forger can foresee.
    report:
        Called with the progress of the training.
    announce:
        Called with the number of seeds and their cost, before they are trained.
    """
    name = f"{folder.parent.name}/{folder.name}"
    try:
        entry, digest = published.read(folder), _digest(folder)
        _check_agents(entry)
        repeatable = not entry.record.imported
        made_by = entry.record.entry(str(folder / "entry.json")) if rerun and repeatable else None
    except QrlSuiteError as error:
        return VerificationResult(folder, name, False, "files", (), str(error))
    (count, length), missing = entry.curves.shape, entry.entry_results().missing_text
    if made_by is None:
        agents = f", {len(entry.agents)} agents" if entry.agents else ""
        sound = f"files sound: {count} seeds of {length} epochs{agents}, hashes and label computed again"
        again = "no seed was trained again" if repeatable else "not repeatable here: a script trained it"
        message = "; ".join(filter(None, [sound, missing, again]))
        return VerificationResult(folder, name, True, "files", (), message, digest)
    if changed := _changed_code(entry, made_by):
        return VerificationResult(folder, name, False, "files", (), changed, digest)
    number = secrets.randbelow(10**9) if choice is None else choice
    places = _draw(number, digest, count, needed(count) if rerun == "auto" else min(rerun, count))
    announce(f"{name}: {_cost(made_by, len(places), count, length)}")
    ok, check, message = _train_again(entry, made_by, places, report)
    if check == "verified" and choice is not None:
        check, message = "repeated", f"{message}; the draw of an earlier check, which is no new evidence"
    message = "; ".join(filter(None, [message, missing]))
    seeds = tuple(entry.seeds[place] for place in places)
    return VerificationResult(folder, name, ok, check, seeds, message, digest, number)


def _check_agents(entry: PublishedEntry) -> None:
    """Check numbers of parameters; agents match the record and fit the model. What is not installed is not checked."""
    agents = entry.parameters()
    if entry.record.imported or absent(entry.entry_results()):
        return
    from qrlsuite.training.evaluation import require_fitting  # torch, which checking files does without
    from qrlsuite.training.trainer import Trainer

    trainer = Trainer(entry.record.entry(str(entry.folder / "entry.json")), [0])
    if problem := _other_parameters(entry, _parameters(trainer)):
        raise StoreError(f"{entry.folder}: {problem}")
    if agents:
        require_fitting(trainer, agents[entry.agents[0]], entry.folder / published.AGENTS)


def _parameters(trainer: Trainer) -> tuple[Mapping[str, int], ...]:
    """Return the numbers of an agent's parameters, and of its first network alone, which older records have."""
    first = dict(zip(("classical", "quantum", "fixed"), trainer.models.parameters[0]))
    return trainer.models.trained(), first


def _other_parameters(entry: PublishedEntry, counted: Sequence[Mapping[str, int]]) -> str | None:
    """Name numbers of parameters that differ from an entry's record; None if they agree."""
    stated = entry.published.parameters
    allowed = counted if "networks" not in stated else counted[:1]
    if any(_same_parameters(stated, each) for each in allowed):
        return None
    return f"its record has parameters {dict(stated)}, counted here: {dict(counted[0])}"


def found_by(again: int, forged: int, seeds: int) -> float:
    """Return the probability that at least one of `forged` seeds is among the `again` seeds that are trained again.

    >>> round(found_by(25, 10, 100), 3)
    0.952
    """
    return 1 - math.comb(seeds - forged, again) / math.comb(seeds, again)


def forged_of(seeds: int) -> int:
    """Return how many forged seeds are to be found: a tenth, and one at least."""
    return max(1, round(REPLACED * seeds))


def needed(seeds: int) -> int:
    """Return how many seeds have to be trained again to find a tenth of them forged with probability .95.

    >>> needed(100), needed(20)
    (25, 16)
    """
    forged = forged_of(seeds)
    return next(again for again in range(1, seeds + 1) if found_by(again, forged, seeds) >= POWER)


def _digest(folder: Path) -> str:
    """Return a hash of an entry's files; the record has the hash of the agents."""
    paths = (folder / name for name in ("entry.json", published.CURVES, published.SEEDS))
    hashes = b"".join(hashlib.sha256(read_bytes(path)).digest() for path in paths)
    return hashlib.sha256(hashes).hexdigest()[:16]


def _draw(number: int, digest: str, count: int, wanted: int) -> list[int]:
    generator = np.random.default_rng([number, int(digest, 16)])
    return sorted(int(place) for place in generator.choice(count, size=wanted, replace=False))


def _cost(made_by: Entry, again: int, count: int, epochs: int) -> str:
    """Return the number of seeds to train again, their cost, and the probability to find a forgery, in words."""
    measured = speed.find(made_by, min(again, CHUNK), Path("runs"))
    span = () if measured is None else measured.range(again * epochs)
    cost = " to ".join(hours_text(seconds / 3600) for seconds in span) or "not known"
    return f"{again} of {count} seeds are trained again, core-hours {cost}; {_finds(again, count)}"


def _finds(again: int, count: int) -> str:
    """Return the probability that this many seeds find a forgery, in words."""
    forged = forged_of(count)
    return (
        f"if {forged} of {count} were forged, it would be found with probability "
        f"{found_by(again, forged, count):.2f}"
    )


def _train_again(
    entry: PublishedEntry, made_by: Entry, places: list[int], report: Callable[[Progress], None]
) -> tuple[bool, Check, str]:
    """Return whether the retrained seeds fit the entry, the strongest statement, and both in words."""
    if problem := _beginning(entry, made_by, places):
        return False, "files", problem
    again = retrain(entry, places, report)
    equal = (again.curves == entry.curves[places]).all(axis=1)
    if problem := _counts(entry, again, places, equal):
        return False, "files", problem
    elsewhere = {int(entry.origins[place]): _elsewhere(entry, made_by, [place]) for place in places}
    for row, place in enumerate(places):
        if not equal[row] and elsewhere[entry.origins[place]] is None:
            return False, "verified", _differs(entry, place, again.curves[row])
    agents = entry.parameters()
    for row, place in enumerate(places):
        seed = entry.seeds[place]
        if (
            seed in agents
            and elsewhere[entry.origins[place]] is None
            and not _equal(agents[seed], again.agents[row])
        ):
            return False, "verified", f"seed {seed} trained again is another agent than the published one"
        other = _other_metric(entry, place, again.measured[row])
        if equal[row] and elsewhere[entry.origins[place]] is None and other is not None:
            return False, "verified", f"seed {seed} trained again has other values of the metric '{other}'"
    count, trained = len(entry.seeds), len(places)
    left = f"{count - trained} of {count} seeds, hours"
    begun = f"{trained} {'seed' if trained == 1 else 'seeds'} trained again"
    if equal.all():
        found = f"curves equal, bit for bit; {_finds(trained, count)}"
        return True, "verified", f"{begun}: {found}; not compared: {left}"
    differs = next(text for text in elsewhere.values() if text is not None)
    apart = np.abs(again.curves - entry.curves[places]) > SAME
    parts = int(np.median(np.where(apart.any(axis=1), apart.argmax(axis=1), apart.shape[1])))
    begun += f", {int(equal.sum())} of them equal, bit for bit ({differs}), half alike for {parts} epochs"
    return True, "files", f"{begun}; not compared: bits of {int((~equal).sum())} seeds, {left}"


def _changed_code(entry: PublishedEntry, made_by: Entry) -> str | None:
    """Name the differences between the installed code and the code that made an entry; None if unknown or none.

    Other `numerics` are equal code with other bits, see `_elsewhere`.
    """
    made_with = entry.record.code_identity
    if made_with is None:
        return None
    changed = identity.differences(made_with.parts, identity.of(made_by).parts, numerics=False)
    lacking = (
        "; --plugin PATH brings a plugin's file"
        if any("not registered here" in each for each in changed)
        else ""
    )
    return f"its seeds cannot be trained again by this code: {listed(changed)}{lacking}" if changed else None


def _beginning(entry: PublishedEntry, made_by: Entry, places: Sequence[int]) -> str | None:
    """Name the differences before training, None if everything agrees."""
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


def retrain(
    entry: PublishedEntry,
    places: Sequence[int] | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
) -> Retrained:
    """Train the seeds at some places of an entry, or all seeds, from nothing and in memory."""
    made_by = entry.record.entry(str(entry.folder / "entry.json"))
    seeds = entry.seeds if places is None else [entry.seeds[place] for place in places]
    epochs = entry.curves.shape[1]
    parts = [_group(made_by, seeds[i : i + CHUNK], epochs, report) for i in range(0, len(seeds), CHUNK)]
    return Retrained(
        np.concatenate([part.curves for part in parts]),
        np.concatenate([part.executions for part in parts]),
        tuple(agent for part in parts for agent in part.agents),
        parts[0].parameters,
        tuple(measured for part in parts for measured in part.measured),
    )


def _group(
    made_by: Entry, seeds: Sequence[int], epochs: int, report: Callable[[Progress], None]
) -> Retrained:
    from qrlsuite.training.trainer import Trainer  # torch, which checking files does without

    trainer = Trainer(made_by, seeds, report=report)
    trainer.progress.epochs = epochs
    trainer.start()
    curves, executions = [], np.zeros(len(seeds), np.int64)
    measured: dict[str, NDArray[np.float64]] = {}
    for _ in range(epochs):
        epoch = trainer.train_epoch()
        curves.append(learning_curve(np.asarray(epoch.scores, np.float32)))
        executions += [
            sum(n for name, n in own.items() if name != "shots") for own in epoch.executions or [{}]
        ]
        for name, values in epoch.measured.items():
            measured.setdefault(name, np.full((len(seeds), epochs), np.nan))[:, trainer.epoch - 1] = values
        trainer.progress.epoch = trainer.epoch
    policy = trainer.policy()
    agents = tuple(
        {name: np.atleast_1d(values[s]) for name, values in policy.items()} for s in range(len(seeds))
    )
    own = tuple({name: values[s] for name, values in measured.items()} for s in range(len(seeds)))
    return Retrained(np.stack(curves, axis=1), executions, agents, _parameters(trainer), own)


def _counts(
    entry: PublishedEntry, again: Retrained, places: Sequence[int], equal: NDArray[np.bool_]
) -> str | None:
    """Name the numbers in an entry's record that differ from its re-run, None if all agree.

    Seeds with equal curves have equal circuit executions. In other seeds they depend on the lengths of episodes.
    """
    if problem := _other_parameters(entry, again.parameters):
        return problem
    executions = entry.executions[list(places)]
    wrong = np.flatnonzero(equal & (executions != again.executions))
    if len(wrong):
        row = wrong[0]
        return (
            f"seed {entry.seeds[places[row]]}: {executions[row]:,} circuit executions in its record, "
            f"{again.executions[row]:,} counted here"
        )
    here, there = int(again.executions.sum()), int(executions.sum())
    if abs(here - there) > EXECUTIONS * here:
        return f"{there:,} circuit executions in its record, {here:,} counted here"
    return None


def _same_parameters(stated: Mapping[str, int], counted: Mapping[str, int]) -> bool:
    networks = {"networks": counted["networks"]} if "networks" in stated else {}
    return {"fixed": 0, **stated} == {
        "fixed": 0,
        **{name: number for name, number in counted.items() if name != "networks"},
        **networks,
    }


def _elsewhere(entry: PublishedEntry, made_by: Entry, places: Sequence[int]) -> str | None:
    """Name a difference between this machine and the machine that made the seeds; None if bits must be equal."""
    here = provenance.of(made_by)
    origins = (origin for place in places for origin in entry.provenance[place].with_earlier)
    return next((differs for there in origins if (differs := provenance.difference(here, there))), None)


def _differs(entry: PublishedEntry, place: int, again: NDArray[np.float64]) -> str:
    """Name the epoch at which a curve leaves the published curve."""
    stated = entry.curves[place]
    epoch = int(np.flatnonzero(again != stated)[0])
    return (
        f"seed {entry.seeds[place]} trained again differs from epoch {epoch + 1} on ({again[epoch]:.6f}, published "
        f"{stated[epoch]:.6f}), with the same versions on the same processor"
    )


def _other_metric(entry: PublishedEntry, place: int, again: Mapping[str, NDArray[np.float64]]) -> str | None:
    """Name a published metric of a seed that training it again does not give; None where all agree."""
    stated = entry.metrics(place)
    nothing = np.full(entry.curves.shape[1], np.nan)
    return next(
        (
            name
            for name, values in stated.items()
            if not np.array_equal(values, again.get(name, nothing), equal_nan=True)
        ),
        None,
    )


def _equal(one: Mapping[str, NDArray[Any]], other: Mapping[str, NDArray[Any]]) -> bool:
    """Return whether two agents have equal parameters, bit for bit."""
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def _list(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, seeds))
