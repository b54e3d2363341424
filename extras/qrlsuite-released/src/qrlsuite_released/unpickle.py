"""Reads result files of the paper's released code: the only module that reads a pickle.

A pickle is a program, and here none is run. Its instructions are listed (`pickletools.genops`) and followed with plain
data alone: where one names a function or calls it, what it names and with what is noted, and nothing is looked up,
imported, called or built. From these notes the answer is read: validation scores, training returns, arguments, and the
shapes of the model's tensors. Numbers come from bytes of which type, shape and length were compared. A file that names
what a released file does not need, or has an instruction that it does not need, is refused.

Nothing in it repeats itself at a small price, so memory and time follow the file's length. As a second fence the file
is read in its own process (this file, run as a script) with limited memory, time and files.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import pickletools
import resource
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
        If the file asks for a name that is not in the table, needs more memory or time than it may have, or does not
        hold what a released result file holds.
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


NAMES = {
    "argparse.Namespace",
    "collections.OrderedDict",
    "_codecs.encode",
    "numpy.ndarray",
    "numpy.dtype",
    "torch._utils._rebuild_tensor_v2",
    "torch._utils._rebuild_parameter",
    "torch.storage._load_from_bytes",
    "torch.device",
    *(
        f"{core}.{name}"
        for core in ("numpy.core", "numpy._core")
        for name in ("multiarray._reconstruct", "multiarray.scalar", "numeric._frombuffer")
    ),
    *(
        f"{module}.{name}"
        for module in ("builtins", "__builtin__")
        for name in ("set", "frozenset", "list", "dict", "bytearray", "complex")
    ),
}
"""All that a file may name; none of it is ever looked up."""

NUMBERS = {
    "b1",
    *(f"i{size}" for size in (1, 2, 4, 8)),
    *(f"u{size}" for size in (1, 2, 4, 8)),
    "f2",
    "f4",
    "f8",
}
"""Types of numbers that arrays may have."""


@dataclass(frozen=True)
class _Name:
    """Stands for what a file names."""

    text: str


@dataclass(eq=False)
class _Items:
    """Stands for a dictionary: its pairs, in order. Keys are not hashed, for a hash descends into them."""

    pairs: list[tuple[Any, Any]] = field(default_factory=list)

    def texts(self) -> dict[str, Any]:
        """Return the values whose keys are text."""
        return {key: value for key, value in self.pairs if type(key) is str}


@dataclass(eq=False)
class _Call(_Items):
    """Stands for what a call would return, with the state and the pairs that it was given then."""

    name: str = ""
    arguments: tuple[Any, ...] = ()
    state: Any = None


_PLAIN = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}


class _Reader:
    """Follows a pickle's instructions with plain data."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def read(self, content: bytes) -> Any:
        """Return what the file holds.

        Raises
        ------
        _Refused
            If it names something, or has an instruction, that a released file does not need.
        ValueError, IndexError, KeyError, TypeError
            If it is no pickle.
        """
        for opcode, argument, _ in pickletools.genops(content):
            name = opcode.name
            if name in _PLAIN:
                self.stack.append(argument)
            elif name in _CONSTANTS:
                self.stack.append(_CONSTANTS[name])
            elif name not in ("PROTO", "FRAME", "STOP"):
                step = getattr(self, f"_{name.lower()}", None)
                if step is None:
                    raise _Refused(
                        f"it has the instruction {name}, which a released result file does not need: refused"
                    )
                step(argument)
        return self._take()

    def _take(self) -> Any:
        """Take the last value, never one below the last mark."""
        if self.marks and len(self.stack) <= self.marks[-1]:
            raise ValueError("a value is missing")
        return self.stack.pop()

    def _taken(self) -> list[Any]:
        """Take all values since the last mark."""
        mark = self.marks.pop()
        values = self.stack[mark:]
        del self.stack[mark:]
        return values

    def _mark(self, argument: Any) -> None:
        self.marks.append(len(self.stack))

    def _pop(self, argument: Any) -> None:
        if self.marks and self.marks[-1] == len(self.stack):
            self.marks.pop()
        else:
            self.stack.pop()

    def _pop_mark(self, argument: Any) -> None:
        self._taken()

    def _dup(self, argument: Any) -> None:
        self.stack.append(self.stack[-1])

    def _put(self, place: int) -> None:
        self.memo[place] = self.stack[-1]

    _binput = _long_binput = _put

    def _memoize(self, argument: Any) -> None:
        self._put(len(self.memo))

    def _get(self, place: int) -> None:
        self.stack.append(self.memo[place])

    _binget = _long_binget = _get

    def _tuple(self, argument: Any) -> None:
        self.stack.append(tuple(self._taken()))

    def _tuple1(self, argument: Any) -> None:
        self._last(1)

    def _tuple2(self, argument: Any) -> None:
        self._last(2)

    def _tuple3(self, argument: Any) -> None:
        self._last(3)

    def _last(self, count: int) -> None:
        self.stack.append(tuple([self._take() for _ in range(count)][::-1]))

    def _empty_list(self, argument: Any) -> None:
        self.stack.append([])

    _empty_set = _empty_list

    def _list(self, argument: Any) -> None:
        self.stack.append(self._taken())

    _frozenset = _list

    def _append(self, argument: Any) -> None:
        value = self._take()
        self._extend([value])

    def _appends(self, argument: Any) -> None:
        self._extend(self._taken())

    _additems = _appends

    def _extend(self, values: list[Any]) -> None:
        if type(self.stack[-1]) is not list:
            raise ValueError("values are added to what is no list")
        self.stack[-1].extend(values)

    def _empty_dict(self, argument: Any) -> None:
        self.stack.append(_Items())

    def _dict(self, argument: Any) -> None:
        values = self._taken()
        self.stack.append(_Items())
        self._update(values)

    def _setitem(self, argument: Any) -> None:
        self._last(2)
        self._update(self.stack.pop())

    def _setitems(self, argument: Any) -> None:
        self._update(self._taken())

    def _update(self, values: Sequence[Any]) -> None:
        if not isinstance(self.stack[-1], _Items) or len(values) % 2:
            raise ValueError("pairs are added to what is no dictionary")
        self.stack[-1].pairs += zip(values[::2], values[1::2])

    def _global(self, argument: str) -> None:
        self._named(*argument.split(" ", 1))

    def _stack_global(self, argument: Any) -> None:
        name, module = self._take(), self._take()
        self._named(module, name)

    def _named(self, module: Any, name: Any) -> None:
        text = f"{module}.{name}" if type(module) is type(name) is str else "what is no text"
        if text not in NAMES:
            raise _Refused(
                f"it asks for {text[:100]!r}, which a released result file does not need: refused, nothing was run"
            )
        self.stack.append(_Name(text))

    def _reduce(self, argument: Any) -> None:
        arguments, called = self._take(), self._take()
        if type(called) is not _Name or type(arguments) is not tuple:
            raise _Refused("it calls what is no name: refused, nothing was run")
        self.stack.append(_Call(name=called.text, arguments=arguments))

    _newobj = _reduce

    def _build(self, argument: Any) -> None:
        state = self._take()
        if type(self.stack[-1]) is not _Call:
            raise _Refused("it changes what is no object of its own: refused, nothing was run")
        self.stack[-1].state = state


def _is_call(value: Any, *names: str) -> bool:
    return type(value) is _Call and value.name.endswith(names)


def _bytes(value: Any) -> bytes:
    """Return bytes as the protocols write them: plain, as text of latin1, as a bytearray of either."""
    if _is_call(value, ".bytearray") and len(value.arguments) == 1:
        (value,) = value.arguments
    if _is_call(value, "_codecs.encode") and len(value.arguments) == 2 and value.arguments[1] == "latin1":
        value = value.arguments[0].encode("latin1") if type(value.arguments[0]) is str else None
    if type(value) not in (bytes, bytearray):
        raise ValueError("no bytes")
    return bytes(value)


def _type(value: Any) -> np.dtype[Any]:
    """Return a type of numbers."""
    if not (_is_call(value, "numpy.dtype") and value.arguments and type(value.state) is tuple):
        raise ValueError("no type")
    code, order = value.arguments[0], value.state[1]
    if code not in NUMBERS or order not in ("<", ">", "|", "="):
        raise ValueError(f"no type of numbers: {code!r:.40}")
    return np.dtype(order + code)


def _array(value: _Call) -> NDArray[Any]:
    """Build an array of numbers from bytes; a number has no dimension."""
    if _is_call(value, ".scalar"):
        kind, data = value.arguments
        shape, order = (), "C"
    elif _is_call(value, "._frombuffer"):
        data, kind, shape, order = value.arguments[:4]
    elif _is_call(value, "._reconstruct") and type(value.state) is tuple:
        _, shape, kind, fortran, data = value.state
        order = "F" if fortran is True else "C"
    else:
        raise ValueError(f"{value.name} is no array")
    numbers, content = _type(kind), _bytes(data)
    if len(content) != numbers.itemsize * math.prod(_shape(shape)) or order not in ("C", "F"):
        raise ValueError("an array's shape does not have its bytes")
    return np.frombuffer(content, numbers).reshape(shape, order=order)


def _shape(value: Any) -> tuple[int, ...]:
    if (
        type(value) is not tuple
        or len(value) > 8
        or not all(type(n) is int and 0 <= n < 1 << 40 for n in value)
    ):
        raise ValueError("no shape")
    return value


def _tensor_shape(value: Any) -> tuple[int, ...] | None:
    """Return the shape of a tensor, a parameter or an array; None for anything else."""
    if _is_call(value, "_rebuild_parameter") and value.arguments:
        value = value.arguments[0]
    if _is_call(value, "_rebuild_tensor_v2") and len(value.arguments) > 2:
        return _shape(value.arguments[2])
    return _array(value).shape if _is_call(value, "._reconstruct", "._frombuffer") else None


def _number(value: Any) -> Any:
    """Return a number, text or None as it is, one of numpy as Python's."""
    return _array(value).item() if _is_call(value, ".scalar") else value


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
    if not isinstance(content, _Items):
        raise _Refused("it does not hold a dictionary: not a released result file")
    parts = content.texts()
    if "val_returns" not in parts:
        raise _Refused(f"it has no 'val_returns': not a released result file (it has {_names(parts)})")
    try:
        returns = _numbers(parts["val_returns"])
    except (ValueError, OverflowError):
        raise _Refused("val_returns is not an array of numbers") from None
    if returns.ndim != 2 or returns.shape[0] < 2 or returns.shape[1] < 1 or returns.size > LARGEST:
        raise _Refused(f"val_returns has shape {returns.shape}, not (epochs + 1, validation episodes)")
    if not np.isfinite(returns).all():
        raise _Refused("val_returns has values that are not finite")
    model = parts.get("model")
    tensors = model.texts() if isinstance(model, _Items) else {}
    shapes = {name: _tensor_shape(value) for name, value in tensors.items()}
    return {
        "returns": returns[1:].tolist(),
        "train_returns": _train_returns(parts.get("train_returns"), len(returns) - 1),
        "arguments": _arguments(parts.get("args")),
        "shapes": {name: shape for name, shape in shapes.items() if shape is not None},
    }


def _arguments(value: Any) -> dict[str, Any]:
    """Return the arguments that are numbers, short text, truth values or None."""
    if _is_call(value, "argparse.Namespace"):
        value = value.state
    given = value.texts() if isinstance(value, _Items) else {}
    numbers = {name: _number(argument) for name, argument in given.items()}
    return {name: argument for name, argument in numbers.items() if _short(argument)}


def _short(value: Any) -> bool:
    if type(value) is float:
        return math.isfinite(value)
    if type(value) is int:
        return value.bit_length() < 600
    return value is None or type(value) is bool or (type(value) is str and len(value) <= 200)


def _names(content: Mapping[str, Any]) -> str:
    return ", ".join(sorted(key[:40] for key in list(content)[:20])) or "nothing"


def _numbers(value: Any) -> NDArray[np.float64]:
    """Return an array of numbers, or a list of numbers or of such arrays and lists, of one length, as an array.

    Lists in lists in lists are refused: one that holds another twice, and so on, is longer than any memory.
    """
    if type(value) is _Call:
        return _array(value).astype(np.float64)
    rows, size = [], 0
    for each in _members(value):
        rows.append(_row(each))
        size += rows[-1].size
        if size > LARGEST:
            raise ValueError("too many numbers")
    return np.array(rows, np.float64)


def _row(value: Any) -> NDArray[np.float64]:
    if type(value) in (list, tuple):
        return np.array([float(_plain(each)) for each in _members(value)], np.float64)
    return np.array(
        _array(value) if _is_call(value, "._reconstruct", "._frombuffer") else _plain(value), np.float64
    )


def _members(value: Any) -> Sequence[Any]:
    if type(value) not in (list, tuple) or len(value) > LARGEST:
        raise ValueError("no list of numbers")
    members: Sequence[Any] = value
    return members


def _plain(value: Any) -> float:
    number = _number(value)
    if type(number) not in (bool, int, float):
        raise ValueError("no number")
    return float(number)


def _train_returns(value: Any, epochs: int) -> list[float] | None:
    """Return one mean per epoch, None where there is not one value or row per epoch."""
    try:
        array = _numbers(value)
    except (ValueError, OverflowError):
        return None
    if array.ndim == 0 or array.size == 0 or array.shape[0] not in (epochs, epochs + 1):
        return None
    means = array.reshape(len(array), -1).mean(axis=1)[-epochs:]
    return [float(mean) for mean in means] if np.isfinite(means).all() else None


def answer(content: bytes) -> dict[str, Any]:
    """Return what a file holds, or under `refused` why it is not read."""
    try:
        return _extract(_Reader().read(content))
    except _Refused as refusal:
        return {"refused": str(refusal)}
    except MemoryError:
        return {"refused": f"it needs more than {MEMORY >> 30} GB of memory: refused"}
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        return {"refused": f"it is not a readable pickle ({type(error).__name__}: {str(error)[:200]})"}


def main() -> int:
    """Read the file named on the command line and print what it holds as JSON."""
    content = Path(sys.argv[1]).read_bytes()
    _limit()
    sys.stdout.write(json.dumps(answer(content)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
