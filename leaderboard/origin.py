"""Where an entry's runs come from: versions, code revisions, processors and devices, over all seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from qrlsuite.results import provenance as machine


def all_of(made_with: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the record of a published seed's last epochs, and those of earlier ones that were made otherwise."""
    before = made_with.get("before")
    return [
        made_with,
        *(each for each in (before if isinstance(before, list) else []) if isinstance(each, dict)),
    ]


def versions(provenance: Iterable[Mapping[str, Any]]) -> dict[str, tuple[str, ...]]:
    """Return every version that occurs, by distribution; Python's under "python"."""
    by_package: dict[str, set[str]] = {}
    for origin in provenance:
        packages = origin.get("versions")
        named = {**(packages if isinstance(packages, Mapping) else {}), "python": origin.get("python")}
        for name, version in named.items():
            if isinstance(version, str):
                by_package.setdefault(str(name), set()).add(version)
    return {name: tuple(sorted(by_package[name])) for name in sorted(by_package)}


def texts(provenance: Iterable[Mapping[str, Any]], name: str) -> tuple[str, ...]:
    """Return every text that stands under a name, sorted, each once."""
    return tuple(sorted({value for origin in provenance if isinstance(value := origin.get(name), str)}))


def devices(provenance: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return every kind of device that occurs (`cpu`, `cuda`), sorted; what names none was trained on the CPU."""
    return tuple(sorted({machine.device_kind(origin) for origin in provenance}))
