"""Reads result files of the paper's released code: the only module that reads a pickle.

A pickle is a program. It is read in its own process (this file, run as a script) with limited memory, time and files.
There it can reach a closed table of names only: arrays, plain containers, `argparse.Namespace` and the rebuilding of
tensors. A file that names anything else is refused before anything is called. The answer is JSON: validation scores,
training returns, arguments, and the shapes of the model's tensors. The tensors themselves are not rebuilt, so torch
need not be imported.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import io
import json
import math
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.errors import StoreError

MEMORY = 2 << 30
"""Bytes of address space for reading one file."""

SECONDS = 60
"""Seconds of processor time for reading one file."""

LARGEST = 10_000_000
"""Validation returns in one file, at most."""


@dataclass(frozen=True)
class Released:
    """The content of a released result file.

    Attributes
    ----------
    returns:
        (T, validation episodes) float64: `val_returns` without its first row, which is before training.
    train_returns:
        (T,) float64, mean return of each epoch's training episodes; None where the file's do not fit T epochs.
    arguments:
        The script's arguments, those that are numbers, text, truth values or None.
    shapes:
        Shape of every tensor of the model by name.
    sha256:
        Digest of the file.
    """

    returns: NDArray[np.float64]
    train_returns: NDArray[np.float64] | None
    arguments: Mapping[str, Any]
    shapes: Mapping[str, tuple[int, ...]]
    sha256: str


def read(path: Path) -> Released:
    """Read a file in a process of its own.

    Raises
    ------
    StoreError
        If the file asks for a name that is not in the table (nothing was called then), needs more memory or time than
        it may have, or does not hold what a released result file holds.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror or error}") from None
    command = [sys.executable, "-P", __file__, str(path)]
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    try:
        result = subprocess.run(
            command,
            capture_output=True,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **single},
            timeout=4 * SECONDS,
        )
    except subprocess.TimeoutExpired:
        raise StoreError(f"{path}: took longer than {4 * SECONDS} seconds to read; refused") from None
    if result.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise StoreError(f"{path}: needs more than {SECONDS} seconds or {MEMORY >> 30} GB to read; refused")
    try:
        answer = json.loads(result.stdout)
    except ValueError:
        raise StoreError(
            f"{path}: the process that read it ended with code {result.returncode}; refused"
        ) from None
    if "refused" in answer:
        raise StoreError(f"{path}: {answer['refused']}")
    train = answer["train_returns"]
    return Released(
        returns=np.asarray(answer["returns"], np.float64),
        train_returns=None if train is None else np.asarray(train, np.float64),
        arguments=answer["arguments"],
        shapes={name: tuple(shape) for name, shape in answer["shapes"].items()},
        sha256=digest,
    )


class _Refused(Exception):
    """A refused file; the message says why."""


@dataclass(frozen=True)
class _Tensor:
    """Stands for a tensor: only its shape is of interest."""

    shape: tuple[int, ...]


def _tensor(storage: Any, offset: Any, size: Any, *rest: Any) -> _Tensor:
    return _Tensor(tuple(int(length) for length in size))


def _first(value: Any, *rest: Any) -> Any:
    return value


def _nothing(*arguments: Any) -> None:
    """Stand for a tensor's storage or device, which are not rebuilt."""


def _latin(text: Any, encoding: Any = "latin1") -> bytes:
    """Rebuild bytes as pickles of protocol 2 hold them."""
    if encoding != "latin1" or not isinstance(text, str):
        raise _Refused("it holds bytes in another encoding than latin1")
    return text.encode("latin1")


def _table() -> dict[tuple[str, str], Any]:
    """Return everything that a file may name."""
    reconstruct: Callable[..., Any] = np.empty(0).__reduce__()[0]  # type: ignore[assignment]
    scalar: Callable[..., Any] = np.float64(0).__reduce__()[0]  # type: ignore[assignment]
    buffer: Callable[..., Any] = np.empty(1).__reduce_ex__(5)[0]  # type: ignore[assignment]
    table: dict[tuple[str, str], Any] = {
        ("argparse", "Namespace"): argparse.Namespace,
        ("collections", "OrderedDict"): collections.OrderedDict,
        ("_codecs", "encode"): _latin,
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("torch._utils", "_rebuild_tensor_v2"): _tensor,
        ("torch._utils", "_rebuild_parameter"): _first,
        ("torch.storage", "_load_from_bytes"): _nothing,
        ("torch", "device"): _nothing,
    }
    for module in ("numpy.core", "numpy._core"):
        table[f"{module}.multiarray", "_reconstruct"] = reconstruct
        table[f"{module}.multiarray", "scalar"] = scalar
        table[f"{module}.numeric", "_frombuffer"] = buffer
    for module in ("builtins", "__builtin__"):
        table |= {(module, kind.__name__): kind for kind in (set, frozenset, list, dict, bytearray, complex)}
    return table


class _Unpickler(pickle.Unpickler):
    """An unpickler that knows the table and nothing else."""

    table = _table()

    def find_class(self, module: str, name: str) -> Any:
        """Look a name up.

        Raises
        ------
        _Refused
            If it is not in the table.
        """
        try:
            return self.table[module, name]
        except KeyError:
            raise _Refused(
                f"it asks for '{module}.{name}', which a released result file does not need: refused, nothing was run"
            ) from None


def _limit() -> None:
    """Limit this process: memory, time, no file written, no process started."""
    limits = {
        resource.RLIMIT_AS: MEMORY,
        resource.RLIMIT_CPU: SECONDS,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NPROC: 0,
    }
    for which, limit in limits.items():
        _, hard = resource.getrlimit(which)
        ceiling = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(which, (ceiling, ceiling))


def _extract(content: Any) -> dict[str, Any]:
    """Pick what is needed from a file's content.

    Raises
    ------
    _Refused
        If it is not the content of a released result file.
    """
    if not isinstance(content, dict):
        raise _Refused("it does not hold a dictionary: not a released result file")
    if "val_returns" not in content:
        raise _Refused(f"it has no 'val_returns': not a released result file (it has {_names(content)})")
    returns = _numbers(content["val_returns"], "val_returns")
    if returns.ndim != 2 or returns.shape[0] < 2 or returns.shape[1] < 1 or returns.size > LARGEST:
        raise _Refused(f"val_returns has shape {returns.shape}, not (epochs + 1, validation episodes)")
    if not np.isfinite(returns).all():
        raise _Refused("val_returns has values that are not finite")
    arguments = content.get("args", {})
    if isinstance(arguments, argparse.Namespace):
        arguments = dict(arguments.__dict__)
    model = content.get("model", {})
    shapes = model if isinstance(model, dict) else {}
    return {
        "returns": returns[1:].tolist(),
        "train_returns": _train_returns(content.get("train_returns"), len(returns) - 1),
        "arguments": {
            str(k): v
            for k, v in (arguments.items() if isinstance(arguments, dict) else ())
            if (v is None or isinstance(v, bool | int | float | str)) and len(str(v)) <= 200 and not _wild(v)
        },
        "shapes": {str(k): list(v.shape) for k, v in shapes.items() if isinstance(v, _Tensor | np.ndarray)},
    }


def _wild(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _names(content: Mapping[Any, Any]) -> str:
    return ", ".join(sorted(str(key)[:40] for key in list(content)[:20])) or "nothing"


def _numbers(value: Any, name: str) -> NDArray[np.float64]:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise _Refused(f"{name} is not an array of numbers") from None


def _train_returns(value: Any, epochs: int) -> list[float] | None:
    """Return one mean per epoch, None where there is not one value or row per epoch."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return None
    if array.ndim == 0 or array.size == 0 or array.shape[0] not in (epochs, epochs + 1):
        return None
    means = array.reshape(len(array), -1).mean(axis=1)[-epochs:]
    return [float(mean) for mean in means] if np.isfinite(means).all() else None


def main() -> int:
    """Read the file named on the command line and print what it holds as JSON."""
    try:
        content = Path(sys.argv[1]).read_bytes()
        _limit()
        answer = _extract(_Unpickler(io.BytesIO(content)).load())
    except _Refused as refusal:
        answer = {"refused": str(refusal)}
    except MemoryError:
        answer = {"refused": f"it needs more than {MEMORY >> 30} GB of memory: refused"}
    except Exception as error:  # whatever a malformed pickle makes the unpickler raise
        answer = {"refused": f"it is not a readable pickle ({type(error).__name__}: {str(error)[:200]})"}
    sys.stdout.write(json.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
