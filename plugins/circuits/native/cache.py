"""Numba's compile cache, in a folder whose name covers everything that the kernels are made of.

Numba judges a cached kernel by the file of the called function alone; here the folder's name hashes the source of
every module of this package, the versions of numba and LLVM, and the processor that numba compiles for (its own
variables NUMBA_CPU_NAME and NUMBA_CPU_FEATURES included), so that a stale kernel is never served. Files are written
atomically by numba, so that processes that compile at once do no harm.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core import config as _config
from numba.core.registry import cpu_target

config: Any = _config  # its attributes are made at run time


def folder() -> Path:
    """Return the cache folder: below `QRLSUITE_CACHE`, the user's cache folder, or a temporary one."""
    content = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        content.update(path.name.encode() + b"\0" + path.read_bytes())
    target = cpu_target.target_context.codegen().magic_tuple()
    machine = [numba.__version__, llvmlite.__version__, platform.python_version(), *target]
    content.update("/".join(map(str, machine)).encode())
    name = f"qrlsuite/native-{content.hexdigest()[:16]}"
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


FOLDER = folder()


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function without the interpreter's lock, cached in `FOLDER`."""
    previous, config.CACHE_DIR = config.CACHE_DIR, str(FOLDER)
    try:
        return numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")(function)
    finally:
        config.CACHE_DIR = previous


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into its callers."""
    return numba.njit(forceinline=True, fastmath={"contract"}, error_model="numpy")(function)


def announce() -> None:
    """Say once, before the first compilation for this processor, why the next seconds pass."""
    if not any(FOLDER.rglob("*.nbc")):
        print(
            "qrlsuite: compiling the circuit simulator for this processor, once ...",
            file=sys.stderr,
            flush=True,
        )
