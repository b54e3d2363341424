"""Numbers and names as the page writes them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def listed(items: Sequence[str]) -> str:
    """Join words: `a, b and c`."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


def ranges(numbers: Iterable[int]) -> str:
    """Write whole numbers as ranges: `0-19, 21`."""
    parts: list[list[int]] = []
    for number in sorted(set(numbers)):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
