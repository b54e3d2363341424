"""Results of probes of independent seeds, stored in `run.json` under `probe`; `qrlsuite.engine.probe` makes them."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterable

from qrlsuite import own, registry, specs
from qrlsuite.errors import PluginError, StoreError
from qrlsuite.results.provenance import PACKAGES
from qrlsuite.results.records import ProbeRecord, Provenance, RunRecord
from qrlsuite.results.store import EntryStore

EQUAL, DIFFERS, NOT_PROBED = "equal", "differs", "not probed"


class DependentSeedsError(PluginError):
    """A seed gives another result in company than alone, or than it gave."""


def of_records(records: Iterable[RunRecord | None]) -> list[ProbeRecord]:
    """Return the probes of runs that have one."""
    return [record.probe for record in records if record is not None and record.probe is not None]


def of_entry(store: EntryStore) -> list[ProbeRecord]:
    """Return the probes in an entry's folder, one for each seed that has one; damaged seeds count as having none."""
    if not store.path.is_dir():
        return []
    records = []
    for seed in store.seeds():
        with contextlib.suppress(StoreError):
            records.append(store.seed(seed).record())
    return of_records(records)


def sentence(probe: ProbeRecord) -> str:
    """Describe the result and the cost of a probe that did not end the run."""
    if probe.result != EQUAL:
        return f"not probed: {probe.reason}"
    return (
        f"probed: seed {probe.seed} is the same alone, to the last bit, up to epoch {probe.epochs} "
        f"({probe.seconds} s, {probe.cpu} s of processor time)" + f"; {probe.reason}" * bool(probe.reason)
    )


def third_party(origin: Provenance) -> bool:
    """Tell from a provenance whether code of others than this suite has part in the numbers."""
    return not set(origin.versions) <= set(PACKAGES)


def require_independent(store: EntryStore) -> None:
    """Refuse to go on with an entry whose seeds depend on each other, by a probe's result."""
    for probe in of_entry(store):
        if probe.result == DIFFERS:
            raise refusal(store, probe)


def refusal(store: EntryStore, probe: ProbeRecord) -> DependentSeedsError:
    """Return the error for seeds that depend on each other: how they do, likely causes, and the command to type."""
    identity = store.record().identity
    kind, name = (
        (specs.AlgorithmSpec, identity.algorithm)
        if identity.model == specs.NO_MODEL
        else (specs.ModelSpec, identity.model)
    )
    registered = registry.load().of(kind)
    loaded = own.of_distribution(registered[name].distribution) if name in registered else None
    plugin = f" --plugin {shlex.quote(str(loaded.source.path))}" if loaded is not None else ""
    return DependentSeedsError(
        f"seed {probe.seed} depends on its company: trained again in a fresh process, it differs in "
        f"{probe.difference}. So its seeds are not independent, and boards leave the entry out. Likely "
        "causes: something that all agents of a process share (a global variable, a class attribute, a "
        "closure, a cache), a global random generator, the time, or functions that torch rounds by the "
        "place in a stack (sigmoid, silu, softplus, elu, gelu: take tanh or relu). `qrlsuite check "
        f"{kind.kind}:{name}{plugin}` looks for them (and likewise for an environment or algorithm). "
        f"Trained seeds are kept in {store.path}; fix the code and rerun the command"
    )
