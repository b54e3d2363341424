"""Reads parquet files of others: the decoded size of a file is computed before anything is decoded.

A few bytes can stand for billions of values: a value is repeated by its count, a page is packed, a text is named by its
place in a dictionary. Here the file's footer and the head of every page are read, since these alone state sizes, and a
file that holds too much is refused. The footer's statements about pages are not believed. Only then pyarrow decodes,
and it decodes no more than the pages' heads state.

Footer and heads are written in Thrift's compact protocol, see
https://github.com/apache/parquet-format/blob/master/src/main/thrift/parquet.thrift.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.parquet

from qrlsuite.errors import StoreError
from qrlsuite.files import read_bytes

MOST_VALUES = 20_000_000
"""Values in a file, at most: 100,000 epochs of 200 numbers."""

MOST_BYTES = 200_000_000
"""Bytes of a file, packed or unpacked, at most."""

_MOST_FOOTER = 4_000_000
_MOST_COLUMNS, _MOST_DEPTH, _MOST_PAGES = 5000, 4, 100_000
_TEXTS = (6, 7)
"""Types of a column whose values are bytes, of their own length or all of one."""
_DICTIONARY_PAGE = 2
_DESCRIBED = {0: (5, 2), _DICTIONARY_PAGE: (7, 2), 3: (8, 4)}
"""Field of a page's head that describes its values, and field in it with their encoding, by the page's type."""
_ENCODINGS = (0, 2, 3, 8)
"""Plain, by dictionary, by run length. In other encodings a text may repeat parts of the text before it."""


def read(path: Path, values: int = MOST_VALUES) -> pyarrow.Table:
    """Read a parquet file.

    Parameters
    ----------
    values:
        How many it may hold at most, over all columns; a list counts as its members.
    """
    try:
        size = path.stat().st_size
        content = read_bytes(path) if size <= MOST_BYTES else b""
        if size > MOST_BYTES or _decoded(content) > values:
            raise StoreError(f"{path}: unpacks to more than {min(values, MOST_BYTES // 8):,} values: refused")
        table = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(content)).read(use_threads=False)
        if len(set(table.column_names)) < table.num_columns:
            raise _Damaged("two of its columns have one name")
        return table
    except (OSError, ValueError, pyarrow.ArrowException, _Damaged) as error:
        raise StoreError(
            f"{path} is not a readable parquet file: {' '.join(str(error).split())[:200]}"
        ) from None


class _Damaged(Exception):
    """The file does not follow the format."""


def _decoded(content: bytes) -> int:
    """Return the values that a file decodes to, counted in its pages; text as the bytes that it may take, by eights."""
    footer = _footer(content)
    _require_flat(footer)
    columns = (column.get(3) for group in _structures(footer, 4) for column in _structures(group, 1))
    return max(_count(footer, 3), sum(_column(content, column) for column in columns))


def _footer(content: bytes) -> Mapping[int, Any]:
    """Return the fields of the file's last part."""
    if len(content) < 12 or content[:4] != b"PAR1" or content[-4:] != b"PAR1":
        raise _Damaged("it does not begin and end with PAR1")
    (length,) = struct.unpack("<I", content[-8:-4])
    if length > min(len(content) - 12, _MOST_FOOTER):
        raise _Damaged(f"its footer has {length} bytes")
    return _Thrift(content, len(content) - 8 - length, len(content) - 8).fields()


def _structures(fields: Mapping[int, Any], field: int) -> list[dict[int, Any]]:
    found = fields.get(field, [])
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise _Damaged("its footer has other parts than a footer")
    return found


def _require_flat(footer: Mapping[int, Any]) -> None:
    """Refuse a schema of many columns, or of columns in columns, which readers descend into."""
    elements = _structures(footer, 2)
    if not 0 < len(elements) <= _MOST_COLUMNS:
        raise _Damaged(f"it has {len(elements)} columns")
    open_groups: list[int] = []
    for element in elements:
        while open_groups and open_groups[-1] == 0:
            open_groups.pop()
        if open_groups:
            open_groups[-1] -= 1
        if len(open_groups) > _MOST_DEPTH:
            raise _Damaged("its columns are nested deeper than a list")
        if children := _count(element, 5):
            open_groups.append(children)


def _column(content: bytes, column: Any) -> int:
    """Count the values of one column in a row group."""
    data, dictionary, length = (_count(column, field) for field in (9, 11, 7))
    start = dictionary if 0 < dictionary < data else data
    if start + length > len(content):
        raise _Damaged("a column lies outside the file")
    total = unpacked = largest = 0
    for kind, size, count in _pages(content, start, start + length):
        unpacked += size
        total += count
        if kind == _DICTIONARY_PAGE:
            largest = max(largest, size)
    if _count(column, 1) in _TEXTS:  # each of which may name the dictionary's longest text
        unpacked += total * largest
    return max(total, unpacked // 8)


def _pages(content: bytes, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield type, unpacked size and number of values of every page of a column."""
    for _ in range(_MOST_PAGES):
        if start >= end:
            return
        reader = _Thrift(content, start, end)
        head = reader.fields()
        kind = _count(head, 1)
        if kind not in _DESCRIBED:
            raise _Damaged(f"it has a page of type {kind}")
        field, encoding = _DESCRIBED[kind]
        values = head.get(field, {})
        if _count(values, encoding) not in _ENCODINGS:
            raise _Damaged(f"a column has the encoding {values[encoding]}")
        yield kind, _count(head, 2), _count(values, 1)
        start = reader.place + _count(head, 3)
    raise _Damaged(f"a column has more than {_MOST_PAGES} pages")


def _count(fields: Any, field: int) -> int:
    """Return a structure's number that cannot be negative, 0 where it is absent."""
    value = fields.get(field, 0) if isinstance(fields, dict) else None
    if type(value) is not int or value < 0:
        raise _Damaged(f"{value!r} is no number of its parts")
    return value


class _Thrift:
    """Reads one structure of the compact protocol.

    Attributes
    ----------
    place:
        Where reading goes on.
    """

    def __init__(self, content: bytes, place: int, end: int) -> None:
        self._content, self.place, self._end = content, place, end

    def fields(self, depth: int = 0) -> dict[int, Any]:
        """Read a structure: its fields by number."""
        found: dict[int, Any] = {}
        field = 0
        while head := self._byte():
            field = field + (head >> 4) if head >> 4 else self._integer()
            found[field] = self._value(head & 15, depth, False)
        return found

    def _byte(self) -> int:
        if self.place >= self._end:
            raise _Damaged("a part of it ends early")
        self.place += 1
        return self._content[self.place - 1]

    def _unsigned(self) -> int:
        if (result := self._byte()) < 128:
            return result
        result &= 127
        for shift in range(7, 70, 7):
            byte = self._byte()
            result |= (byte & 127) << shift
            if byte < 128:
                return result
        raise _Damaged("a number in it has no end")

    def _integer(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)

    def _skip(self, length: int) -> bytes:
        if length > self._end - self.place:
            raise _Damaged("a part of it ends early")
        self.place += length
        return self._content[self.place - length : self.place]

    def _value(self, kind: int, depth: int, member: bool) -> Any:
        """Read a value of a type: a truth value in a field is its type, and a byte as a list's member."""
        if depth > 8:
            raise _Damaged("its parts are nested too deep")
        match kind:
            case 1 | 2:
                return self._byte() if member else kind == 1
            case 3:
                return self._byte()
            case 4 | 5 | 6:
                return self._integer()
            case 7:
                return self._skip(8)
            case 8:
                return self._skip(self._unsigned())
            case 9 | 10:
                head = self._byte()
                length = head >> 4 if head >> 4 < 15 else self._unsigned()
                if length > self._end - self.place:  # each takes a byte
                    raise _Damaged("a part of it ends early")
                return [self._value(head & 15, depth + 1, True) for _ in range(length)]
            case 12:
                return self.fields(depth + 1)
        raise _Damaged(f"it has a part of type {kind}")
