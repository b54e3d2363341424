"""Where an entry's runs come from: versions, code revisions, processors and circuit executions, over all seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from qrlsuite.errors import StoreError
from qrlsuite.results.store import SeedStore, read_lines


def versions(provenance: Iterable[Mapping[str, Any]]) -> dict[str, tuple[str, ...]]:
    """Return every version that occurs, by distribution; Python's under "python"."""
    found: dict[str, set[str]] = {}
    for origin in provenance:
        packages = origin.get("versions")
        named = {**(packages if isinstance(packages, Mapping) else {}), "python": origin.get("python")}
        for name, version in named.items():
            if isinstance(version, str):
                found.setdefault(str(name), set()).add(version)
    return {name: tuple(sorted(found[name])) for name in sorted(found)}


def texts(provenance: Iterable[Mapping[str, Any]], name: str) -> tuple[str, ...]:
    """Return every text that stands under a name, sorted, each once."""
    return tuple(sorted({value for origin in provenance if isinstance(value := origin.get(name), str)}))


def executions(store: SeedStore) -> int:
    """Return the circuit executions of one seed's run so far: training, gradients and validation together.

    A circuit that is sampled with many shots is executed once.

    Raises
    ------
    StoreError
        If a file is damaged or holds counts that are no counts.
    """
    counts = [count for line in read_lines(store.lines) for count in _counts(line.get("executions"))]
    if store.table.exists():
        last, compacted = _table(store)
        newer = [line for line in read_lines(store.lines) if line.get("epoch", 0) > last]
        counts = [*compacted, *(count for line in newer for count in _counts(line.get("executions")))]
    total = 0
    for count in counts:
        if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count < 2**63:
            raise StoreError(f"{store.path}: {count!r} is not a number of circuit executions")
        total += count
    return total


def _counts(value: Any) -> list[Any]:
    return [value[name] for name in value if name != "shots"] if isinstance(value, Mapping) else []


def _table(store: SeedStore) -> tuple[int, list[Any]]:
    """Return a table's last epoch and its counts; only the columns that hold them are read."""
    import pyarrow
    import pyarrow.parquet

    try:
        file = pyarrow.parquet.ParquetFile(store.table)
        names = [
            name
            for name in file.schema_arrow.names
            if name.startswith("executions.") and name != "executions.shots"
        ]
        columns = file.read(columns=["epoch", *names]).to_pydict()
        last = max(columns["epoch"])
    except (OSError, KeyError, TypeError, ValueError, pyarrow.ArrowException) as error:
        raise StoreError(f"{store.table} is not a readable parquet file: {error}") from None
    return last, [count for name in names for count in columns[name] if count is not None]
