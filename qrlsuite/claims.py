"""Claims: two workers never train the same seed, and the claim of a dead worker is taken over.

A claim is a file with host, process and seeds. Its holder refreshes the file's time. On the holder's own host
a claim lives exactly as long as the process; elsewhere it is abandoned when it has not been refreshed for
`ABANDONED` seconds by the file system's own clock, so that clocks that differ or jump do no harm.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import socket
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from qrlsuite.errors import StoreError
from qrlsuite.store import EntryStore

ABANDONED = 120.0
"""Seconds without a refresh after which another host's claim is taken over."""


class SeedsClaimedError(StoreError):
    """Another worker is training some of the seeds."""


@dataclass(frozen=True)
class Claim:
    """Who holds which seeds."""

    path: Path
    host: str
    pid: int
    started: str
    token: str
    seeds: tuple[int, ...]

    def refresh(self) -> bool:
        """Show that the holder is alive; returns False where the claim was taken over."""
        try:
            if json.loads(self.path.read_bytes()).get("token") != self.token:
                return False
            os.utime(self.path)
        except (OSError, ValueError, AttributeError):
            return False
        return True

    def release(self) -> None:
        """Give the seeds back, if they are still held."""
        if self.refresh():
            self.path.unlink(missing_ok=True)


def _process_start(pid: int) -> str | None:
    """Return something that tells a process from a later one with the same number; None if it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        pass
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    return "unknown"


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock for the moment it takes to look and claim."""
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def living(store: EntryStore) -> list[Claim]:
    """Return the claims whose holders are alive."""
    if not store.claims.is_dir():
        return []
    with tempfile.NamedTemporaryFile(dir=store.claims) as probe:
        now = os.stat(probe.name).st_mtime
    return [
        claim for path in sorted(store.claims.glob("*.json")) if (claim := _read(path)) and _alive(claim, now)
    ]


def _read(path: Path) -> Claim | None:
    try:
        content = json.loads(path.read_bytes())
        return Claim(
            path=path,
            host=str(content["host"]),
            pid=int(content["pid"]),
            started=str(content["started"]),
            token=str(content["token"]),
            seeds=tuple(int(seed) for seed in content["seeds"]),
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None  # gone, or torn by a killed writer: nobody holds it


def _alive(claim: Claim, now: float) -> bool:
    if claim.host == socket.gethostname():
        return _process_start(claim.pid) == claim.started
    try:
        return now - claim.path.stat().st_mtime < ABANDONED
    except OSError:
        return False


def acquire(store: EntryStore, seeds: Sequence[int]) -> Claim:
    """Claim seeds for this process.

    Raises
    ------
    SeedsClaimedError
        If a living worker holds any of them; the message says who.
    StoreError
        If the folder cannot be written.
    """
    try:
        store.claims.mkdir(parents=True, exist_ok=True)
        with _locked(store.claims):
            holders = living(store)
            for holder in holders:
                shared = sorted(set(holder.seeds) & set(seeds))
                if shared:
                    raise SeedsClaimedError(
                        f"{len(shared)} of these seeds (from {shared[0]}) are being trained by process {holder.pid} "
                        f"on {holder.host}: wait for it, or stop it; this command can be repeated at any time"
                    )
            for path in set(store.claims.glob("*.json")) - {holder.path for holder in holders}:
                path.unlink(missing_ok=True)
            token = secrets.token_hex(8)
            claim = Claim(
                path=store.claims / f"{token}.json",
                host=socket.gethostname(),
                pid=os.getpid(),
                started=_process_start(os.getpid()) or "unknown",
                token=token,
                seeds=tuple(int(seed) for seed in seeds),
            )
            content = {"host": claim.host, "pid": claim.pid, "started": claim.started}
            claim.path.write_text(json.dumps({**content, "token": token, "seeds": list(claim.seeds)}))
    except OSError as error:
        raise StoreError(f"cannot write {store.claims}: {error.strerror or error}") from None
    return claim
