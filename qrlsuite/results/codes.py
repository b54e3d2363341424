"""The code identities of an entry's seeds: which seeds make one entry, and the ways on after the code has changed.

Under `code`, `run.json` has the identity of the code that began the seed, and `entry.json` that of the code that trains
now. Older seeds have no identity: they have the suite's first bits, or unknown code of a plugin. Codes
that an author declared to be equal in effect stand in `entry.json` under `same`.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qrlsuite import own
from qrlsuite.errors import OptionError, PluginError, StoreError, listed
from qrlsuite.experiment import identity
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.results import genuine, survey
from qrlsuite.results.claims import move_away
from qrlsuite.results.records import PLUGINS, EntryRecord
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, copies_of_plugins

UNKNOWN = ""
"""The digest of seeds whose code was not recorded."""


class ChangedCodeError(StoreError):
    """An entry has seeds of another code than the installed one."""


@dataclass(frozen=True)
class SameCode:
    """Seeds of one code, or of several codes that were declared to be equal in effect.

    Attributes
    ----------
    codes:
        Identities by digest, in the order of the seeds; None if no identity was recorded.
    """

    seeds: tuple[int, ...]
    codes: Mapping[str, CodeIdentity | None]

    @property
    def mark(self) -> str:
        """Eight digits that identify the code of these seeds; zeros if it is unknown."""
        return next(filter(None, self.codes), "0" * 8)[:8]


def distinct(codes: Iterable[CodeIdentity | None]) -> tuple[str, ...]:
    """Return the digests of identities; none where one is unknown or of the suite's first bits: these are alike."""
    known = list(codes)
    if any(code is None or code.original for code in known):
        return ()
    return tuple(dict.fromkeys(code.digest for code in known if code is not None))


def environments(codes: Iterable[CodeIdentity | None]) -> frozenset[str]:
    """Return the digests of the environments among identities, where a plugin's code makes them."""
    parts = (part for code in codes if code is not None for part in code.parts)
    return frozenset(
        CodeIdentity((part,)).digest
        for part in parts
        if part["role"] == "environment" and part.get("distribution") != identity.OURS
    )


def of_seeds(store: EntryStore) -> list[SameCode]:
    """Return an entry's seeds by their code; the code of the lowest seed comes first.

    A seed without a finished epoch is left out: any code may begin it anew.
    """
    seeds: dict[str, list[int]] = {}
    codes: dict[str, CodeIdentity | None] = {}
    for seed in store.seeds() if store.path.is_dir() else ():
        folder = store.seed(seed)
        try:
            record = folder.record()
        except StoreError:  # is said where the seed is read
            continue
        if record is None or not (record.epochs or folder.lines.exists() or folder.table.exists()):
            continue
        digest = UNKNOWN if record.code is None else record.code.digest
        codes[digest] = record.code_identity
        seeds.setdefault(digest, []).append(seed)
    return [
        SameCode(
            tuple(sorted(seed for digest in alike for seed in seeds[digest])),
            {digest: codes[digest] for digest in alike},
        )
        for alike in _alike(codes, store.record().same_codes if len(codes) > 1 else [])
    ]


def _alike(codes: Mapping[str, CodeIdentity | None], declared: Sequence[Sequence[str]]) -> list[list[str]]:
    """Group digests of equal code, in their order."""
    first = next((digest for digest, code in codes.items() if code is not None and code.original), None)
    links = [*declared, *([[UNKNOWN, first]] if first is not None and UNKNOWN in codes else [])]
    groups: list[set[str]] = []
    for link in [*([digest] for digest in codes), *links]:
        touched = [group for group in groups if group & set(link)]
        groups = [group for group in groups if group not in touched] + [set(link).union(*touched)]
    order = list(codes)
    found = [[digest for digest in order if digest in group] for group in groups]
    return sorted((group for group in found if group), key=lambda group: order.index(group[0]))


def others(store: EntryStore, current: CodeIdentity) -> list[SameCode]:
    """Return the seeds of an entry that another code than this one has begun."""
    held = of_seeds(store)
    if not held:
        return []
    codes = {digest: code for group in held for digest, code in group.codes.items()}
    same = next(
        group
        for group in _alike({current.digest: current, **codes}, store.record().same_codes)
        if current.digest in group
    )
    return [group for group in held if not set(group.codes) & set(same)]


def require(store: EntryStore, current: CodeIdentity) -> None:
    """Refuse to continue an entry's seeds with another code than that which began them."""
    for group in others(store, current):
        raise ChangedCodeError(_refusal(store, group, current))


def _refusal(store: EntryStore, group: SameCode, current: CodeIdentity) -> str:
    seeds, record = format_seeds(group.seeds), store.record()
    before = next(filter(None, group.codes.values()), None)
    if before is None and all("numerics" in part or part["role"] == "file" for part in current.parts):
        before = CodeIdentity(
            tuple({**part, **({"numerics": 1} if "numerics" in part else {})} for part in current.parts)
        )
    if before is None:
        change = (
            "they were begun before the code of plugins was recorded, so nobody knows whether it is the same"
        )
    else:
        change = listed(identity.differences(before.parts, current.parts))
    if record.plan is None:
        anew = (
            f"--fresh trains anew, and the old seeds move to {store.path.name}@{group.mark}; a changed thing can be "
            "registered under another name"
        )
    else:
        anew = "Restore that code, or write another study"
    return (
        f"{store.path} has seeds {seeds} of '{record.label}' that another code has begun: {change}. Nothing was "
        f'trained. {anew}; and --same "REASON" says that nothing changed in effect'
    )


def require_installed(store: EntryStore, seeds: Collection[int], current: CodeIdentity) -> None:
    """Refuse to build trained agents with a plugin's code that has changed since; `numerics` do not count."""
    for group in others(store, current):
        for code in filter(None, group.codes.values() if set(group.seeds) & set(seeds) else ()):
            changed = identity.differences(code.parts, current.parts, numerics=False)
            if changed:
                raise ChangedCodeError(
                    f"{store.path}: seeds {format_seeds(group.seeds)} were trained by another code than is installed: "
                    f"{listed(changed)}; install that code, or say with `qrlsuite run --same` that nothing changed"
                    f"{copies_of_plugins(store, store.record())}"
                )


def require_mergeable(store: EntryStore, source: EntryStore, exported: bool) -> None:
    """Refuse to merge seeds of different code.

    Parameters
    ----------
    store:
        Destination of the seeds; it need not exist.
    exported:
        Whether `source` is an exported entry, whose record has its code.
    """
    groups = of_seeds(store)
    present = {digest: code for group in groups for digest, code in group.codes.items()}
    if exported:
        code = source.record().code_identity
        added: Mapping[str, CodeIdentity | None] = {UNKNOWN if code is None else code.digest: code}
    else:
        added = {digest: code for group in of_seeds(source) for digest, code in group.codes.items()}
    declared = source.record().same_codes + (store.record().same_codes if groups else [])
    alike = _alike({**present, **added}, declared)
    if len(alike) < 2:
        return
    before, other = ({**present, **added}[digests[0]] for digests in alike[:2])
    change = "of some, the code is not known"
    if before is not None and other is not None:
        change = listed(identity.differences(before.parts, other.parts))
    raise ChangedCodeError(
        f"the seeds of {source.path} are not all of one code with each other and those of {store.path}: {change}; "
        "choose another folder with --runs"
    )


def require_sent(store: EntryStore, current: CodeIdentity, host: str) -> None:
    """Refuse to train an entry on this machine with other code than the machine that started it has."""
    record = store.record() if (store.path / "entry.json").exists() else None
    sent = None if record is None else record.code_identity
    if record is None or sent is None:
        return
    if len(_alike({sent.digest: sent, current.digest: current}, record.same_codes)) > 1:
        differing = listed(identity.differences(sent.parts, current.parts))
        raise ChangedCodeError(
            f"{host} would train {store.path} with another code than the machine that started it: {differing}; "
            "install the same on both, and repeat the command"
        )


def prepare(store: EntryStore, current: CodeIdentity, plugins: Sequence[own.Source] = ()) -> None:
    """Write down with which code an entry is trained from now on; workers refuse another one.

    Parameters
    ----------
    plugins:
        The plugins by path among that code. They are copied into the entry's folder, where workers find them.
    """
    record = store.record()
    kept = {code: places for code, places in record.plugins.items() if code != current.digest}
    places = [_copied(store, plugin) for plugin in plugins]
    if places:
        kept[current.digest] = places
    changes: dict[str, Any] = {}
    if record.code_identity != current:
        changes["code"] = current.record()
    if kept != record.plugins:
        changes["plugins"] = kept
    if changes:
        store.write_record(record.changed(**changes))


def contents(record: EntryRecord, digests: Iterable[str]) -> dict[str, frozenset[str]]:
    """Return the marks of the copied plugins that belong to some codes, by the plugin's file name."""
    marks: dict[str, set[str]] = {}
    for place in (place for digest in digests for place in record.plugins.get(digest, [])):
        _, mark, name = place.split("/")
        marks.setdefault(name, set()).add(mark)
    return {name: frozenset(of_name) for name, of_name in marks.items()}


def _copied(store: EntryStore, plugin: own.Source) -> str:
    """Copy a plugin into an entry's folder, whatever is there in its place; returns where it is in that folder."""
    folder = store.path / PLUGINS
    genuine.require_no_link(store.path, folder, folder / plugin.mark, folder / plugin.mark / plugin.name)
    return own.copy(plugin, folder).relative_to(store.path).as_posix()


def copies(store: EntryStore) -> list[Path]:
    """Return the copies of plugins by path with which an entry is trained now; imports nothing."""
    record = store.record()
    places = [] if record.code is None else record.plugins.get(record.code.digest, [])
    for place in places:
        path = store.path / place
        genuine.require_no_link(store.path, store.path / PLUGINS, path.parent, path)
    return [store.path / place for place in places]


def load_plugins(path: str | os.PathLike[str]) -> list[own.Loaded]:
    """Load a plugin's file or folder; for an entry's folder, load the copies with which the entry is trained.

    Nothing else imports code from a results folder: reading an entry never does.
    """
    store = EntryStore(Path(path))
    if not (store.path / "entry.json").is_file():
        return [own.load(path)]
    found = load_copies(store)
    if not found:
        raise PluginError(
            f"{path} has no copies of plugins: its code is the suite's, or of installed plugins"
        )
    return found


def load_copies(store: EntryStore) -> list[own.Loaded]:
    """Load the copies of plugins by path with which an entry is trained."""
    sources = [own.read(path) for path in copies(store)]
    for source in sources:
        if source.mark != source.path.parent.name:
            raise StoreError(
                f"{source.path} is not what it was when it was copied: restore it, or give the plugin itself with "
                "--plugin FILE"
            )
    return [own.load_source(source) for source in sources]


def declare_same(store: EntryStore, current: CodeIdentity, reason: str) -> None:
    """Record the author's word that this code and the other codes of an entry's seeds are equal in effect."""
    if not reason.strip() or not reason.isprintable():
        raise OptionError(
            "--same: say in one line why nothing changed in effect, for example --same 'renamed'"
        )
    changed = others(store, current)
    if not changed:
        return
    said = {
        "codes": sorted({current.digest, *(digest for group in changed for digest in group.codes)}),
        "reason": reason.strip(),
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    record = store.record()
    store.write_record(record.changed(same=[*record.same, said]))


def set_aside(
    runs: Path, store: EntryStore, current: CodeIdentity, queued: Collection[int] = ()
) -> tuple[Path | None, Path | None]:
    """Move an entry's folder with seeds of another code to `<entry>@<mark>`; nothing is deleted.

    A folder of this code's seeds that was set aside before takes its place.

    Parameters
    ----------
    queued:
        The seeds that a queue still has.

    Returns
    -------
    tuple
        Where the old seeds are now, and where this code's seeds were; None where there are none.
    """
    changed = others(store, current)
    if not changed:
        return None, None
    survey.require_movable(runs, store, queued)
    target = store.path.with_name(f"{store.path.name}@{changed[0].mark}")
    if store.record().plan is not None:
        raise StoreError(
            f"{store.path} is of a study with looks that has begun: its seeds stay; write another study"
        )
    if len(changed) > 1 or len(of_seeds(store)) > 1:
        seeds = format_seeds(changed[0].seeds)
        raise StoreError(
            f"{store.path} has seeds of several codes: move the folders of seeds {seeds} to {target} beside a copy of "
            "entry.json, and repeat the command"
        )
    if target.exists():
        raise StoreError(f"{target} is there already: move it out of {runs}, and repeat the command")
    move_away(store, target)
    earlier = EntryStore(store.path.with_name(f"{store.path.name}@{current.digest[:8]}"))
    if not (earlier.path / "entry.json").exists() or others(earlier, current):
        return target, None
    move_away(earlier, store.path)
    return target, earlier.path
