"""Claims: files that keep two workers from training the same seed; a dead worker's claim is taken over.

A claim is a file with machine, process and seeds. Its holder refreshes the file's time every few seconds. On the
holder's own machine, known by host name, boot and installation, a claim lives exactly as long as the process. Elsewhere
it is suspect when, by the file system's clock, it was not refreshed for `ABANDONED` seconds, or was refreshed in the
future. That clock may have jumped. So a suspect claim is watched for `WATCH` seconds of this process's monotonic clock,
and taken over only if nobody refreshes it meanwhile.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import json
import os
import secrets
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from qrlsuite.errors import StoreError
from qrlsuite.files import read_bytes
from qrlsuite.results.store import EntryStore, cause

HEARTBEAT = 5.0
"""Seconds between two refreshes of a claim."""

HEARTBEAT_THREAD = "qrlsuite heartbeat"
"""Name of the threads that refresh claims."""

ABANDONED = 120.0
"""Seconds without a refresh after which another host's claim is suspected to be abandoned."""

WATCH = 3 * HEARTBEAT
"""Seconds for which a suspect claim is watched before it is taken over."""


class SeedsClaimedError(StoreError):
    """Another worker is training some of the seeds."""


@dataclass(frozen=True)
class Claim:
    """The holders of seeds."""

    path: Path
    host: str
    pid: int
    namespace: str
    machine: str
    started: str
    token: str
    seeds: tuple[int, ...]

    def refresh(self) -> bool:
        """Show that the holder is alive; returns False where the claim was taken over.

        A file system that does not answer for a moment is no reason to give up.
        """
        try:
            if json.loads(read_bytes(self.path)).get("token") != self.token:
                return False
            os.utime(self.path)
        except (FileNotFoundError, ValueError, AttributeError):
            return False
        except OSError:
            return True
        return True

    def request_stop(self) -> None:
        """Ask the holder, on whatever machine, to save and end; it looks with every refresh."""
        with contextlib.suppress(OSError):  # it has just ended, or nothing can be written
            self._stop.touch()

    @property
    def stop_requested(self) -> bool:
        """Whether somebody asked the holder to save and end."""
        return self._stop.exists()

    @property
    def _stop(self) -> Path:
        return self.path.with_suffix(".stop")

    @property
    def local(self) -> bool:
        """Whether the holder runs where this process can see it: same machine, same process numbers."""
        return (self.host, self.namespace, self.machine) == (socket.gethostname(), _namespace(), _machine())

    def release(self) -> None:
        """Give the seeds back, if they are still held."""
        if self.refresh():
            self.path.unlink(missing_ok=True)
            self._stop.unlink(missing_ok=True)


def _process_start(pid: int) -> str | None:
    """Return when a process started; a later process of that number started later. None if no such process runs."""
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
    try:  # macOS has no /proc
        command = ["ps", "-o", "lstart=", "-p", str(pid)]
        started = subprocess.run(command, capture_output=True, text=True, timeout=10, env={"LC_ALL": "C"})
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return started.stdout.strip() or "unknown"


@functools.cache
def _machine() -> str:
    """Return the ids of this boot and this installation, which differ between machines of one host name; "" if unknown.

    A boot id is needed since process numbers begin anew with each boot. The process namespace of a machine itself does
    not help: its number is equal on every Linux.
    """
    parts = []
    for path in ("/proc/sys/kernel/random/boot_id", "/etc/machine-id"):
        with contextlib.suppress(OSError):
            parts.append(Path(path).read_text().strip())
    return " ".join(parts)


def _namespace() -> str:
    """Return the process namespace, which differs between containers of one host, as their process numbers do."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


@contextlib.contextmanager
def locked(store: EntryStore) -> Iterator[None]:
    """Hold an entry's lock for the moment it takes to look and claim, or to append a line."""
    try:
        store.claims.mkdir(parents=True, exist_ok=True)
        with (store.claims / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
    except OSError as error:
        raise StoreError(f"cannot write {store.claims}: {cause(error)}") from None


def living(store: EntryStore) -> list[Claim]:
    """Return the claims whose holders are or may be alive: suspect claims are included and not watched.

    A folder that cannot be written is read, too.
    """
    now = _file_system_time(store.claims)
    return [claim for claim in claims(store) if _state(claim, now) != "dead"]


def certain(store: EntryStore) -> list[Claim]:
    """Return the claims whose holders are alive for certain: refreshed a while ago, or processes seen here."""
    now = _file_system_time(store.claims)
    return [claim for claim in claims(store) if _state(claim, now) == "alive"]


def claims(store: EntryStore) -> list[Claim]:
    """Return every claim that can be read, alive or not."""
    if not store.claims.is_dir():
        return []
    return [claim for path in sorted(store.claims.glob("*.json")) if (claim := _read(path))]


def _file_system_time(folder: Path) -> float:
    """Return the time that a file written now would get, which is the file server's."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder) as probe:
            return os.stat(probe.name).st_mtime
    except OSError:
        return time.time()


def _read(path: Path) -> Claim | None:
    try:
        content = json.loads(read_bytes(path))
        return Claim(
            path=path,
            host=str(content["host"]),
            pid=int(content["pid"]),
            namespace=str(content.get("namespace", "")),
            machine=str(content.get("machine", "not recorded")),  # by earlier versions
            started=str(content["started"]),
            token=str(content["token"]),
            seeds=tuple(int(seed) for seed in content["seeds"]),
        )
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None  # gone, or torn by a killed writer: nobody holds it


def _state(claim: Claim, now: float) -> Literal["alive", "suspect", "dead"]:
    if claim.local:
        return "alive" if _process_start(claim.pid) == claim.started else "dead"
    try:
        age = now - claim.path.stat().st_mtime
    except OSError:
        return "dead"
    return "alive" if abs(age) < ABANDONED else "suspect"


def _abandoned(suspects: Sequence[Claim]) -> list[Claim]:
    """Watch suspect claims, all at once; returns the claims that nobody refreshed."""
    seen = {claim: _refreshed(claim) for claim in suspects}
    deadline = time.monotonic() + WATCH
    while seen and time.monotonic() < deadline:
        time.sleep(0.2)
        seen = {claim: before for claim, before in seen.items() if _refreshed(claim) == before}
    return list(seen)


def _refreshed(claim: Claim) -> int | None:
    try:
        return claim.path.stat().st_mtime_ns
    except OSError:
        return None


def acquire(store: EntryStore, seeds: Sequence[int]) -> Claim:
    """Claim seeds for this process; raises a `SeedsClaimedError` where a living worker holds one of them."""
    wanted = set(seeds)
    with locked(store):
        now = _file_system_time(store.claims)
        states = {claim: _state(claim, now) for claim in claims(store)}
        suspects = [c for c, state in states.items() if state == "suspect" and wanted & set(c.seeds)]
        states |= dict.fromkeys(_abandoned(suspects), "dead")
        holders = [claim for claim, state in states.items() if state != "dead"]
        for path in set(store.claims.glob("*.json")) - {holder.path for holder in holders}:
            path.unlink(missing_ok=True)
            path.with_suffix(".stop").unlink(missing_ok=True)
        for holder in holders:
            if shared := wanted & set(holder.seeds):
                raise SeedsClaimedError(_refusal(holder, sorted(shared)))
        return _write(store, seeds)


def _write(store: EntryStore, seeds: Sequence[int]) -> Claim:
    token = secrets.token_hex(8)
    claim = Claim(
        path=store.claims / f"{token}.json",
        host=socket.gethostname(),
        pid=os.getpid(),
        namespace=_namespace(),
        machine=_machine(),
        started=_process_start(os.getpid()) or "unknown",
        token=token,
        seeds=tuple(int(seed) for seed in seeds),
    )
    written = ("host", "pid", "namespace", "machine", "started", "token")
    content = {name: getattr(claim, name) for name in written}
    claim.path.write_text(json.dumps({**content, "seeds": list(claim.seeds)}))
    return claim


def move_away(store: EntryStore, target: Path) -> None:
    """Rename an entry's folder while nobody trains it; who comes for its seeds later finds no entry."""
    with locked(store):
        for holder in living(store):
            raise SeedsClaimedError(_refusal(holder, holder.seeds or (0,)))
        try:
            store.path.rename(target)
        except OSError as error:
            raise StoreError(f"cannot move {store.path}: {error.strerror or error}") from None


def _refusal(holder: Claim, shared: Sequence[int]) -> str:
    if holder.local:
        advice = "wait for it, or stop it"
    else:
        advice = (
            f"wait for it, or stop it there; if it no longer exists (it was killed, or this folder is a copy), "
            f"its seeds are free {ABANDONED:.0f} seconds after its last sign of life"
        )
    return (
        f"{len(shared)} of these seeds (from {shared[0]}) are being trained by process {holder.pid} "
        f"on {holder.host}: {advice}; this command can be repeated at any time"
    )
