"""Numbers and names as the page writes them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def short(steps: float) -> str:
    """Write environment steps with at most four digits: 62k, 58.2k, 1.25M."""
    for size, letter in ((1_000_000, "M"), (1000, "k")):
        if abs(steps) >= size:
            return f"{steps / size:.4g}{letter}"
    return f"{steps:.4g}"


def in_unit(steps: float, unit: int) -> str:
    """Write steps in multiples of a unit, with at most three digits."""
    value = steps / unit
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def counted(count: int, thing: str) -> str:
    """Write a number of things: `1 entry`, `3 entries`."""
    if count == 1:
        return f"1 {thing}"
    return f"{count:,} {thing[:-1]}ies" if thing.endswith("y") else f"{count:,} {thing}s"


def listed(words: Sequence[str]) -> str:
    """Join words: `a, b and c`."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def ranges(numbers: Iterable[int]) -> str:
    """Write whole numbers as ranges: `0-19, 21`."""
    parts: list[list[int]] = []
    for number in sorted(set(numbers)):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
