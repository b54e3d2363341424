"""Writing published entries from runs."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qrlsuite.engine.terminal import command
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.files import read_bytes
from qrlsuite.leaderboard.shelf import published
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.shelf.fingerprint import fingerprint, unknown
from qrlsuite.results import codes, probes
from qrlsuite.results.records import Provenance
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import Arrays, EntryStore, SeedRun, parameters_of


def export(entry: EntryResults, out: Path, force: bool = False, agents: bool = True) -> Path:
    """Write an entry's published form; returns its folder `out/<task>/<entry>`.

    Only complete runs are written. If the entry was published without agents and has these seeds' curves, bit for bit,
    only the agents are added, with their provenance. The fingerprint of untrained seeds is computed anew, so that a
    file that was changed meanwhile does not agree with it.

    Parameters
    ----------
    entry:
        Read from a results folder.
    force:
        Replace a published entry that has more seeds or more epochs.
    agents:
        Write the trained agents, too, of all seeds whose parameters exist, are finite and belong to the curves' last
        epoch.
    """
    if entry.source != "runs":
        raise QrlSuiteError(f"{entry.folder} is a published entry already")
    store = EntryStore(entry.folder)
    record = store.record()
    scripted = record.identity.algorithm == SCRIPT
    built = record.entry(str(store.path)) if scripted else store.entry()
    if built.start is not None:
        raise QrlSuiteError(
            f"'{entry.label}' begins with the agents of another entry, so nobody could train its seeds again from what "
            "is published: it cannot be exported"
        )
    if not scripted:
        codes.require_installed(store, identity.of(built))
    run = {name: value for name, value in record.content.items() if name not in ("published", "code")}
    folder = out / entry.task / built.name
    kept = _agents(store, entry) if agents else {}
    if kept and not force and _add_agents(folder, entry, store, kept):
        return folder
    if folder.exists() and not force:
        _require_all_seeds(folder, entry)
    runs = [store.seed(seed).read() for seed in entry.seeds]
    unfinished = [run.seed for run in runs if not run.finished]
    lacking = entry.missing_text if entry.study is None else ""
    if unfinished and not lacking:  # of an older version, which recorded no request
        lacking = f"{len(unfinished)} of {len(runs)} seeds are still training"
    if lacking:
        raise QrlSuiteError(
            f"'{entry.label}' is not complete: {lacking}; repeat the `qrlsuite run` that made it, or withdraw them "
            "with `qrlsuite runs rm`"
        )
    withdrawn = {str(seed): reason for seed, reason in entry.withdrawn.items()}
    records = [run.record for run in runs if run.record is not None]
    code = records[0].code
    content = published.files(
        {
            "preset": None,
            "tuning": None,
            **run,
            **({} if record.tuned is None else {"tuning": record.tuned}),
            **({"code": code.content} if entry.codes and code is not None else {}),
        },
        entry.seeds,
        entry.curves,
        [run.seconds / 3600 for run in runs],
        [run.executions for run in runs],
        [_made_with(record.provenance) for record in records],
        {"classical": 0, "quantum": 0, **parameters_of(records)},
        unknown(len(entry.seeds)) if scripted else fingerprint(built, entry.seeds),
        {**_found(runs), **({"withdrawn": withdrawn} if withdrawn else {})},
        kept,
        entry.metrics,
    )
    _replace(folder, content)
    published.read(folder)
    return folder


def _agents(store: EntryStore, entry: EntryResults) -> dict[int, Arrays]:
    """Return the trained parameters by seed: of runs that end where the curves do, and whose numbers are finite."""
    ended = store.finished(entry.seeds, entry.curves.shape[1])
    held: dict[int, Arrays] = {}
    for seed in (store.seed(seed) for seed in entry.seeds if seed in ended):
        longer = seed.trained_epochs() > entry.curves.shape[1]
        agent = seed.parameters() if seed.agent.exists() and not longer else {}
        if agent and all(np.isfinite(values).all() for values in agent.values()):
            held[seed.seed] = agent
    return held


def _add_agents(folder: Path, entry: EntryResults, store: EntryStore, agents: Mapping[int, Arrays]) -> bool:
    """Add agents to an entry published without them, if their runs have its curves; return whether they fit."""
    if not folder.exists():
        return False
    there = published.read(folder)
    rows = [there.seeds.index(seed) for seed in entry.seeds if seed in there.seeds]
    if there.agents or len(rows) < len(entry.seeds) or not np.array_equal(there.curves[rows], entry.curves):
        return False
    stated, files = published.encode_agents(agents)
    records = [record for seed in agents if (record := store.seed(seed).record()) is not None]
    origins = _distinct(_made_with(record.provenance) for record in records)
    stated["agents"]["provenance"] = [origin.content for origin in origins]
    extended = there.record.changed(published={**there.published.content, **stated})
    kept = {name: read_bytes(folder / name) for name in (published.CURVES, published.SEEDS)}
    _replace(folder, {"entry.json": published.encode_record(extended.content), **kept, **files})
    published.read(folder).parameters()
    return True


_OF_PROBE = {"result", "seed", "epochs", "reason", "seconds", "cpu"}


def _found(runs: Sequence[SeedRun]) -> dict[str, Any]:
    """Return which seeds diverged, and the probe of independent seeds; of either nothing, where there is none."""
    diverged = {str(run.seed): run.diverged for run in runs if run.diverged is not None}
    made = sorted(
        probes.of_records(run.record for run in runs), key=lambda probe: probe.result != probes.EQUAL
    )
    kept = made[0].model_dump(include=_OF_PROBE, exclude_unset=True) if made else {}
    return {name: value for name, value in (("diverged", diverged), ("probe", kept)) if value}


def _made_with(origins: Sequence[Provenance]) -> Provenance:
    """Return the provenance of a seed's last epochs; under `before`, different provenances of earlier epochs.

    The `host` in an older Dask worker's record is private.
    """
    *earlier, last = [origin.without_host for origin in origins] or [Provenance()]
    before = [origin for origin in _distinct(earlier) if origin != last]
    return last.changed(before=before) if before else last


def _distinct(origins: Iterable[Provenance]) -> list[Provenance]:
    """Return records, each once, with their keys in the alphabet's order."""
    texts = dict.fromkeys(json.dumps(origin.content, sort_keys=True) for origin in origins)
    return [Provenance.model_validate(json.loads(text)) for text in texts]


def _require_all_seeds(folder: Path, entry: EntryResults) -> None:
    """Refuse to replace a published entry by results that lack some of its seeds or epochs."""
    try:
        there = published.read(folder).entry_results()
        union = entry + there
    except (OptionError, StoreError) as error:
        raise QrlSuiteError(f"{error}; --force replaces {folder}, --out writes to another folder") from None
    lacking = [
        seed for seed, run in union.records.items() if seed not in entry.seeds or run.epochs > entry.epochs
    ]
    if lacking:
        runs = str(entry.folder.parents[1])
        adding = f"`{command('import', str(folder), '--runs', runs)}` adds them"
        held = set(lacking) <= entry.records.keys()
        raise QrlSuiteError(
            f"{folder} has epochs of seeds {format_seeds(lacking)} that would not be in the new files: "
            f"{'train all seeds to the same number of epochs' if held else adding}; --force replaces {folder}"
        )


def _replace(folder: Path, content: dict[str, bytes]) -> None:
    """Replace a folder's files as a whole: a reader sees the old files or the new files."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as temporary:
            fresh, old = Path(temporary) / "new", Path(temporary) / "old"
            fresh.mkdir()
            for name, data in content.items():
                (fresh / name).write_bytes(data)
            if folder.exists():
                folder.rename(old)
            fresh.rename(folder)
            shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise StoreError(f"cannot write {folder}: {error.strerror or error}") from None
