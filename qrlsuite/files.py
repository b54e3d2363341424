"""TOML files of users and plugins: tasks, presets, studies, grids. Every error names the file and the place."""

from __future__ import annotations

import errno
import functools
import os
import stat
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, TypeVar, cast, get_args, get_origin

import pydantic

from qrlsuite.errors import FileError, nearest

Model = TypeVar("Model", bound=pydantic.BaseModel)


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes, see `open_regular`."""
    with open_regular(path) as file:
        return file.read()


def open_regular(path: Path) -> IO[bytes]:
    """Open a file of a results folder to read it. A pipe in its place would keep the reader waiting for ever.

    Raises
    ------
    OSError
        If it cannot be read, or is a pipe or a device.
    """
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    if stat.S_ISREG(os.fstat(handle).st_mode):
        return os.fdopen(handle, "rb")
    os.close(handle)
    raise OSError(errno.EINVAL, "not a regular file", str(path))


def load(path: Path, model: type[Model], what: str) -> Model:
    """Read and validate a file; `what` names its kind in messages: `preset file`."""
    return validate(parse(read(path, what), f"{what} {path}"), model, f"{what} {path}")


def read(path: Path, what: str) -> str:
    """Return a file's text."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileError(f"{what} {path} cannot be read: {reason}") from None


def parse(text: str, source: str) -> dict[str, Any]:
    """Return the tables of a text; `source` is where it came from, for messages."""
    try:
        return read_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{source}: not valid TOML: {error}") from None


def validate(data: Any, model: type[Model], source: str) -> Model:
    """Validate a file's content; the error lists every problem with its path in the file."""
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as error:
        raise FileError(f"{source}: {'; '.join(problems(error, model))}") from None


def read_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises
    ------
    tomllib.TOMLDecodeError
        If it is not valid, or Python cannot hold it: hundreds of nested arrays, integers of thousands of digits.
    """
    return cast(dict[str, Any], _copied(_tables(text)))


@functools.lru_cache(maxsize=256)
def _tables(text: str) -> dict[str, Any]:
    """Return the tables of a text, read once: a study names its task's file for each of its entries."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except (RecursionError, ValueError) as error:
        raise tomllib.TOMLDecodeError(f"too large a value: {error}") from None


def _copied(value: Any) -> Any:
    """Return a value of a TOML text; its tables and arrays may be changed without changing it."""
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    return [_copied(item) for item in value] if isinstance(value, list) else value


def validation_lines(error: pydantic.ValidationError) -> list[str]:
    """Turn a pydantic error into lines `path = value: problem`."""
    lines = []
    for item in error.errors(include_url=False):
        path = ".".join(str(part) for part in item["loc"])
        value = item.get("input")
        value_text = "" if isinstance(value, Mapping) or item["type"] == "missing" else f" = {_short(value)}"
        message = str(item["msg"]).removeprefix("Value error, ")
        lines.append(f"{path}{value_text}: {message}" if path else message)
    return lines


def problems(error: pydantic.ValidationError, model: type[pydantic.BaseModel]) -> list[str]:
    """Turn the error of a whole file into lines with paths, and the nearest known key for each unknown one.

    Parameters
    ----------
    model:
        The model that validated the file.
    """
    lines = []
    for item, line in zip(error.errors(include_url=False), validation_lines(error)):
        path = [str(part) for part in item["loc"]]
        if item["type"] == "extra_forbidden":
            *parents, key = path
            table = f" in [{'.'.join(parents)}]" if parents else ""
            lines.append(f"unknown key '{key}'{table}{nearest(key, _keys(model, parents))}")
        elif item["type"] == "missing":
            lines.append(f"missing key '{'.'.join(path)}'")
        else:
            lines.append(line)
    return lines


def _keys(model: Any, path: Sequence[str]) -> list[str]:
    """Return the known keys of a (nested) section of a file; `path` may lead through lists, tables and options."""
    for part in path:
        if part.isdecimal():
            continue
        if get_origin(model) is dict:
            model = get_args(model)[1]
        else:
            info = getattr(model, "model_fields", {}).get(part)
            model = info.annotation if info is not None else None
        while get_origin(model) is not dict and (
            arguments := [each for each in get_args(model) if each is not type(None)]
        ):
            model = arguments[0]
    return list(getattr(model, "model_fields", {}))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
