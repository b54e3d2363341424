"""The code that an entry's seeds are of, which is part of the entry's name, and the copies of plugins in its folder.

Under `code`, `run.json` has the identity of the code that began the seed, and `entry.json` the identity of the code
that trains now. A folder is of the code of its first seed, and of codes that `--same` links to it (`same` in
`entry.json`). Seeds of other code lie beside it, in `NAME@1a2b3c4d`. Older seeds have no identity: they have the
suite's first bits, or unknown code of a plugin.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qrlsuite import own
from qrlsuite.errors import PluginError, StoreError, listed
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.results import genuine
from qrlsuite.results.claims import certain
from qrlsuite.results.records import PLUGINS, EntryRecord
from qrlsuite.results.store import EntryStore, copies_of_plugins

UNKNOWN = ""
"""The digest of seeds whose code was not recorded."""


class ChangedCodeError(StoreError):
    """An entry has seeds of another code than the installed one."""


@dataclass(frozen=True)
class CodeOfFolder:
    """The code that the seeds of an entry's folder are of.

    Attributes
    ----------
    first:
        The identity of its first seed's code; None if it was not recorded.
    digests:
        Of this code, and of those that `--same` links to it.
    """

    first: CodeIdentity | None
    digests: tuple[str, ...]

    def __contains__(self, code: CodeIdentity | None) -> bool:
        if code is not None and self.first is not None:
            return code.digest in self.digests
        # seeds without an identity may have the suite's first bits
        original = all(each.original for each in (code, self.first) if each is not None)
        return original or (UNKNOWN if code is None else code.digest) in self.digests


def of(store: EntryStore) -> CodeOfFolder | None:
    """Return the code of an entry's folder; None without a seed.

    A seed without a finished epoch or a probe does not count: any code may begin it anew.
    """
    for seed in store.seeds() if (store.path / "entry.json").exists() else ():
        folder = store.seed(seed)
        try:
            record = folder.record()
        except StoreError:  # is said where the seed is read
            continue
        if record is None:
            continue
        if record.epochs or record.probe is not None or folder.lines.exists() or folder.table.exists():
            digest = UNKNOWN if record.code is None else record.code.digest
            return CodeOfFolder(record.code_identity, linked(store.record(), [digest]))
    return None


def change(store: EntryStore, current: CodeIdentity) -> str:
    """Say how a code differs from the code of an entry's folder."""
    held = of(store)
    before = None if held is None else held.first
    if before is None and all("numerics" in part or part["role"] == "file" for part in current.parts):
        before = CodeIdentity(
            tuple({**part, **({"numerics": 1} if "numerics" in part else {})} for part in current.parts)
        )
    if before is None:
        return "begun before the code of plugins was recorded, so nobody knows whether it is the same"
    return listed(identity.differences(before.parts, current.parts))


def linked(record: EntryRecord, digests: Iterable[str]) -> tuple[str, ...]:
    """Return digests of codes, and the digests that `--same` links to them."""
    found = dict.fromkeys(digests)
    for link in record.same_codes:
        if not found.keys().isdisjoint(link):
            found |= dict.fromkeys(link)
    return tuple(found)


def place(runs: Path, entry: Entry, code: CodeIdentity | None) -> EntryStore:
    """Return the folder of an entry's seeds of one code, existing or not.

    The first code has the entry's name, another one a mark behind it.
    """
    stores = EntryStore.of_name(runs, entry)
    found = next((store for store in stores if _may_train(store, code)), None)
    mark = f"@{'0' * 8 if code is None else code.digest[:8]}"
    return found or EntryStore.find(runs, entry, mark if stores else "")


def _may_train(store: EntryStore, code: CodeIdentity | None) -> bool:
    """Return whether a folder is of a code; one without a seed is of any code, unless somebody begins it now."""
    if (held := of(store)) is not None:
        return code in held
    return not certain(store) or store.record().code_identity in (None, code)


def other(runs: Path, entry: Entry, code: CodeIdentity) -> EntryStore | None:
    """Return the folder of an entry's seeds of another code, the newest of several; None without one."""
    others = {store: held for store in EntryStore.of_name(runs, entry) if (held := of(store)) is not None}
    others = {store: held for store, held in others.items() if code not in held}
    return max(others, key=lambda store: store.trained, default=None)


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


def require(store: EntryStore, current: CodeIdentity, host: str) -> None:
    """Refuse to train a folder with code that differs from its seeds' code, or from the starting machine's code."""
    sent = store.record().code_identity
    if sent is not None and sent != current:
        differing = listed(identity.differences(sent.parts, current.parts))
        raise ChangedCodeError(
            f"{host} would train {store.path} with another code than the machine that started it: {differing}; "
            "install the same on both, and repeat the command"
        )
    if not _may_train(store, current):
        raise ChangedCodeError(f"{store.path} has seeds of another code: {change(store, current)}")


def require_installed(store: EntryStore, current: CodeIdentity) -> None:
    """Refuse to build trained agents with a plugin's code that has changed since; `numerics` do not count."""
    held = of(store)
    if held is None or held.first is None or current in held:
        return
    if changed := identity.differences(held.first.parts, current.parts, numerics=False):
        now = store.path.with_name(f"{store.name}@{current.digest[:8]}")
        beside = f"; {now} has seeds of the installed code" if now.is_dir() else ""
        raise ChangedCodeError(
            f"{store.path}: its seeds were trained by another code than is installed: {listed(changed)}; install that "
            f"code, or say with `qrlsuite run --same` that nothing changed{beside}"
            f"{copies_of_plugins(store, store.record())}"
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
                f"{source.path} has changed since it was copied: restore it, or give the plugin itself with "
                "--plugin FILE"
            )
    return [own.load_source(source) for source in sources]


def link(store: EntryStore, current: CodeIdentity, reason: str) -> None:
    """Record the author's word that a code and the code of an entry's seeds are equal in effect."""
    held = of(store)
    said = {
        "codes": sorted({current.digest, *(() if held is None else held.digests)}),
        "reason": reason.strip(),
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    record = store.record()
    store.write_record(record.changed(same=[*record.same, said]))
