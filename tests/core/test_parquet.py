"""Files that decode to more than anything honest holds are refused before they are decoded."""

from __future__ import annotations

import contextlib
import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qrlsuite.errors import StoreError
from qrlsuite.leaderboard.shelf import published
from qrlsuite.results import parquet
from qrlsuite.results.store import read_table, table_bytes

COUNT = 400_000_000
"""Values of a bomb: 3.2 GB of float64."""


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def integer(value: int) -> bytes:
    return varint(value << 1 ^ value >> 63)


def structure(**fields: bytes) -> bytes:
    """Encode a structure whose fields are named by number and type, as `_1i`: (type, content) in order."""
    out, last = b"", 0
    for name, content in fields.items():
        number, kind = int(name[1:-1]), {"i": 5, "q": 6, "b": 8, "l": 9, "s": 12}[name[-1]]
        out += bytes([(number - last) << 4 | kind]) + content
        last = number
    return out + b"\0"


def listed(*members: bytes, kind: int = 12) -> bytes:
    return bytes([len(members) << 4 | kind]) + b"".join(members)


def text(value: str) -> bytes:
    return varint(len(value)) + value.encode()


def runs_of(count: int, width: int, value: int) -> bytes:
    """A run of one value, as levels and places in a dictionary are written."""
    return varint(count << 1) + value.to_bytes((width + 7) // 8, "little")


def bomb(path: Path, values: int, stated: int | None = None) -> Path:
    """Write one row with a list of so many zeros: its page is a dictionary of one and a run of places in it.

    Parameters
    ----------
    stated:
        Values that the footer says there are.
    """
    dictionary = struct.pack("<d", 0.0)
    repeated = runs_of(1, 1, 0) + runs_of(values - 1, 1, 1)
    defined = runs_of(values, 2, 3)
    levels = b"".join(struct.pack("<I", len(part)) + part for part in (repeated, defined))
    data = levels + b"\x01" + runs_of(values, 1, 0)
    described = structure(_1i=integer(1), _2i=integer(0))
    head = structure(_1i=integer(2), _2i=integer(8), _3i=integer(8), _7s=described)
    first = head + dictionary
    described = structure(_1i=integer(values), _2i=integer(8), _3i=integer(3), _4i=integer(3))
    size = integer(len(data))
    second = structure(_1i=integer(0), _2i=size, _3i=size, _5s=described) + data
    length = integer(len(first) + len(second))
    column = structure(
        _1i=integer(5),
        _2l=listed(integer(0), integer(8), kind=5),
        _3l=listed(text("scores"), text("list"), text("element"), kind=8),
        _4i=integer(0),
        _5q=integer(values if stated is None else stated),
        _6q=length,
        _7q=length,
        _9q=integer(4 + len(first)),
        _11q=integer(4),
    )
    group = structure(_1l=listed(structure(_2q=integer(4), _3s=column)), _2q=length, _3q=integer(1))
    schema = listed(
        structure(_4b=text("schema"), _5i=integer(1)),
        structure(_3i=integer(1), _4b=text("scores"), _5i=integer(1), _6i=integer(3)),
        structure(_3i=integer(2), _4b=text("list"), _5i=integer(1)),
        structure(_1i=integer(5), _3i=integer(1), _4b=text("element")),
    )
    footer = structure(_1i=integer(1), _2l=schema, _3q=integer(1), _4l=listed(group))
    path.write_bytes(b"PAR1" + first + second + footer + struct.pack("<I", len(footer)) + b"PAR1")
    return path


def test_a_list_of_this_form_is_read(tmp_path: Path) -> None:
    """The bomb's form is what pyarrow reads, and what it reads does not depend on what the footer says."""
    path = bomb(tmp_path / "small.parquet", 1000)
    assert parquet.read(path).to_pydict() == {"scores": [[0.0] * 1000]}
    path = bomb(tmp_path / "lying.parquet", 1000, stated=1)
    assert parquet._decoded(path.read_bytes()) == 1001
    assert pyarrow.parquet.ParquetFile(path).metadata.row_group(0).column(0).num_values == 1


PROGRAM = """
import json, resource, sys
from pathlib import Path
from qrlsuite.errors import StoreError
from qrlsuite.results import parquet, store
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
parquet.read(Path(sys.argv[1]))
before = peak()
for path in sys.argv[2:]:
    try:
        store.read_table(Path(path))
    except StoreError as error:
        print(error)
print(json.dumps(peak() / before))
"""


def written(path: Path, table: Any, **options: Any) -> Path:
    pyarrow.parquet.write_table(pyarrow.table(table), path, **options)
    return path


def test_bombs_take_no_memory(tmp_path: Path) -> None:
    """Decoded, each takes gigabytes; here the process stays as large as a file of one value made it."""
    one = written(tmp_path / "one.parquet", {"epoch": [1]})
    many = bomb(tmp_path / "many.parquet", COUNT)
    lying = bomb(tmp_path / "lying.parquet", COUNT, stated=1)
    long = pyarrow.array(["x" * 1_000_000]).dictionary_encode()
    places = pyarrow.DictionaryArray.from_arrays(np.zeros(5000, np.int32), long.dictionary)
    texts = written(tmp_path / "texts.parquet", {"epoch": range(1, 5001), "text": places}, compression="zstd")
    paths = [many, lying, texts]
    assert max(path.stat().st_size for path in paths) < 20_000
    words = [sys.executable, "-P", "-c", PROGRAM, *map(str, [one, *paths])]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    *said, ratio = done.stdout.splitlines()
    assert [line.count("unpacks to more than 20,000,000 values: refused") for line in said] == [1, 1, 1]
    assert json.loads(ratio) < 1.5


def test_a_published_table_has_the_values_of_its_seeds_and_epochs(tmp_path: Path) -> None:
    columns = {name: np.zeros(1000, np.int64) for name in ("seed", "epoch")}
    path = written(tmp_path / "curves.parquet", {**columns, "score": np.zeros(1000)})
    types = {"seed": "int64", "epoch": "int64", "score": "double"}
    assert len(published._table(path, types, 1000, 3)["seed"]) == 1000
    with pytest.raises(StoreError, match="unpacks to more than 600 values"):
        published._table(path, types, 100, 3)


def deep(path: Path) -> Path:
    column = pyarrow.array([[[[[[1]]]]]])
    return written(path, {"epoch": column})


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (deep, "nested deeper than a list"),
        (lambda path: written(path, {f"c{i}": [1] for i in range(5001)}), "it has 5002 columns"),
        (
            lambda path: written(
                path, {"a": ["x", "xy"]}, use_dictionary=False, column_encoding={"a": "DELTA_BYTE_ARRAY"}
            ),
            "a column has the encoding 7",
        ),
        (lambda path: path.write_bytes(b"PAR1" + b"\xff" * 40 + struct.pack("<I", 40) + b"PAR1"), "parquet"),
        (lambda path: path.write_bytes(b"PAR1PAR1"), "begin and end"),
        (
            lambda path: path.write_bytes(b"PAR1" + bytes(20) + struct.pack("<I", 10**9) + b"PAR1"),
            "its footer",
        ),
    ],
)
def test_forms_that_no_table_here_has_are_refused(write: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "strange.parquet"
    write(path)
    with pytest.raises(StoreError, match=message):
        parquet.read(path)


def test_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    array = pyarrow.array([1])
    table = pyarrow.Table.from_arrays([array, array], names=["epoch", "epoch"])
    pyarrow.parquet.write_table(table, tmp_path / "two.parquet")
    with pytest.raises(StoreError, match="two of its columns have one name"):
        read_table(tmp_path / "two.parquet")


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.integers(0, 10**6), value=st.integers(0, 255))
def test_any_changed_byte_is_read_or_refused(place: int, value: int, tmp_path: Path) -> None:
    content = bytearray(table_bytes([{"epoch": e, "scores": [0.5, e / 7], "note": "x"} for e in (1, 2, 3)]))
    content[place % len(content)] = value
    path = tmp_path / "changed.parquet"
    path.write_bytes(content)
    with contextlib.suppress(StoreError):
        parquet.read(path)


def test_every_published_table_is_counted_as_it_is() -> None:
    paths = sorted(published.PUBLISHED.rglob("*.parquet"))
    assert len(paths) > 50
    for path in paths:
        there = pyarrow.parquet.ParquetFile(path).metadata
        columns = [there.row_group(0).column(i).num_values for i in range(there.num_columns)]
        counted = parquet._decoded(path.read_bytes())
        assert sum(columns) <= counted <= 2 * sum(columns), path


def test_nothing_else_decodes_parquet() -> None:
    root = Path(__file__).parents[2]
    readers = ("ParquetFile", "parquet.read_table", "ParquetDataset", "pyarrow.dataset", "read_parquet")
    folders = ("qrlsuite", "leaderboard", "plugins", "tasks", "extras")
    sources = [path for folder in folders for path in (root / folder).rglob("*.py")]
    found = {path.name for path in sources if any(reader in path.read_text() for reader in readers)}
    assert found == {"parquet.py"}
