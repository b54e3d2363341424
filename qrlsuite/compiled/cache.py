"""Numba's compile cache, in folders whose names cover everything that the kernels are made of.

Numba judges a cached kernel by the file of the called function alone; here the name of a package's folder hashes the
source of every module of that package and of this one, the versions of numba and LLVM, and the processor that numba
compiles for (its own variables NUMBA_CPU_NAME and NUMBA_CPU_FEATURES included), so that a stale kernel is never served.
Files are written atomically by numba, so that processes that compile at once do no harm.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core import config as _config
from numba.core.registry import cpu_target

config: Any = _config  # its attributes are made at run time


@cache
def folder(package: Path) -> Path:
    """Return a package's cache folder: below `QRLSUITE_CACHE`, the user's cache folder, or a temporary one."""
    content = hashlib.sha256()
    for source in dict.fromkeys((Path(__file__).parent, package)):
        for path in sorted(source.glob("*.py")):
            content.update(path.name.encode() + b"\0" + path.read_bytes())
    target = cpu_target.target_context.codegen().magic_tuple()
    machine = [numba.__version__, llvmlite.__version__, platform.python_version(), *target]
    content.update("/".join(map(str, machine)).encode())
    name = f"qrlsuite/{package.name}-{content.hexdigest()[:16]}"
    standard = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    for base in (os.environ.get("QRLSUITE_CACHE"), standard, tempfile.gettempdir()):
        if not base:
            continue
        path = Path(base).expanduser() / name
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path):
                return path
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="qrlsuite-"))


def _package(function: Callable[..., Any]) -> Path:
    return Path(function.__code__.co_filename).parent


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function without the interpreter's lock, cached in its package's `folder`."""
    return _cached(function, {"contract"})


def rounded(function: Callable[..., Any]) -> Any:
    """Compile a function as `kernel` does; every operation is rounded by itself, as numpy's are."""
    return _cached(function, False)


def _cached(function: Callable[..., Any], fastmath: Any) -> Any:
    previous, config.CACHE_DIR = config.CACHE_DIR, str(folder(_package(function)))
    try:
        return numba.njit(cache=True, nogil=True, fastmath=fastmath, error_model="numpy")(function)
    finally:
        config.CACHE_DIR = previous


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into its callers."""
    return numba.njit(forceinline=True, fastmath={"contract"}, error_model="numpy")(function)


def announce(package: Path, what: str) -> None:
    """Say once, before the first compilation of a package for this processor, why the next seconds pass."""
    if not any(folder(package).rglob("*.nbc")):
        print(f"qrlsuite: compiling {what} for this processor, once ...", file=sys.stderr, flush=True)
