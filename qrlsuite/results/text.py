"""Formats steps, differences, p, times, sizes and counts for tables, pictures and messages."""

from __future__ import annotations

import math
from collections.abc import Callable


def steps_text(steps: float, position: object = None, digits: int = 4) -> str:
    """Write environment steps in the unit that fits: 500, 44k, 107.9k, 1.25M, 8.6 billion.

    Parameters
    ----------
    steps:
        A number of environment steps.
    position:
        Ignored: with it, the function is a matplotlib formatter of tick labels.
    digits:
        Written at most. Means have three: their intervals are wider than a fourth could say.

    >>> steps_text(107_900)
    '107.9k'
    """
    for size, unit in ((1e9, " billion"), (1e6, "M"), (1e3, "k")):
        if abs(steps) >= size:
            return f"{steps / size:.{digits}g}{unit}"
    return f"{steps:.{digits}g}"


def hours_text(hours: float) -> str:
    """Write core-hours with two digits, large numbers as whole ones: 0.044, 1.2, 1,234."""
    return f"{hours:,.0f}" if hours >= 10 else f"{hours:.2g}"


def share_text(share: float) -> str:
    """Write a share in percent, with a digit more below ten: 12%, 3.4%."""
    return f"{100 * share:.{0 if abs(100 * share) >= 9.95 else 1}f}%"


def percent(share: float) -> str:
    """Write a difference in percent, with its sign: +12%, -3.4%; an infinite one is +inf or -100%."""
    if math.isinf(share):
        return "+inf" if share > 0 else "-100%"
    text = share_text(share)
    return text if text[0] == "-" else f"+{text}"


def p_text(p: float) -> str:
    """Write a p value with two digits: .021, .0004, <.0001; nothing where there is none."""
    if math.isnan(p):
        return ""
    if p < 1e-4:
        return "<.0001"
    return f"{p:.2g}".replace("0.", ".") if p >= 0.001 else f"{p:.4f}".replace("0.", ".")


def said(p: float) -> str:
    """Write a p value in a sentence: `p = .021`, `p < .0001`; empty where there is none."""
    text = p_text(p)
    return text and (f"p < {text[1:]}" if text[0] == "<" else f"p = {text}")


def score_text(score: float) -> str:
    """Write a score: 0.712."""
    return f"{round(score, 3) + 0.0:.3f}"  # no -0.000


def interval_text(write: Callable[[float], str], value: float, low: float, high: float) -> str:
    """Write a number with its interval: 64k (52k to 200k)."""
    return f"{write(value)} ({write(low)} to {write(high)})"


def mean_text(steps: float) -> str:
    """Write a mean of steps: with three digits, since its interval is wider than a fourth could say."""
    return steps_text(steps, digits=3)


def duration(seconds: float) -> str:
    """Write a time span in the unit that fits it: 80 s, 30 min, 2.5 h, 3.0 days."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    if seconds < 36 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def duration_range(low: float, high: float) -> str:
    """Write a range of time spans: 3 min to 27 min; a single span if both read the same."""
    return " to ".join(dict.fromkeys(map(duration, (low, high))))


def hours_range(low: float, high: float) -> str:
    """Write a range of core-hours: 0.5 to 4.5; a single number if both read the same."""
    return " to ".join(dict.fromkeys(map(hours_text, (low, high))))


def size_text(size: int) -> str:
    """Write a number of bytes: 812 B, 9.3 kB, 42 MB."""
    amount = float(size)
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if amount >= 10 or unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Write a number of things: `1 seed`, `2 seeds`, `3 entries`, `2 processes`."""
    if number == 1:
        return f"1 {noun}"
    return f"{number:,} {plural or (f'{noun[:-1]}ies' if noun.endswith('y') else f'{noun}s')}"
