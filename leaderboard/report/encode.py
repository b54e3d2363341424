"""Makes foreign strings harmless and curves small before they enter a page.

Names come from other people's files. Jinja escapes them in HTML; here they lose the characters that no escaping
helps against (control characters, writing-direction overrides, lone surrogates), and data for scripts is
written so that nothing in it can end the script element.
"""

from __future__ import annotations

import base64
import json
import unicodedata
from typing import Any

import numpy as np
from numpy.typing import NDArray

LONGEST = 200
"""Characters of a string that a page shows."""
MISSING = 4095
"""The 12-bit code of a value that is not a finite number."""

_UNWANTED = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


def clean(text: object, longest: int = LONGEST) -> str:
    """Return text on one line: without control, direction and surrogate characters, cut to a length."""
    spaced = " ".join(str(text)[: 4 * longest].split())
    kept = "".join("\ufffd" if unicodedata.category(c) in _UNWANTED else c for c in spaced)
    return kept if len(kept) <= longest else kept[: longest - 1] + "…"


def script_json(content: Any) -> str:
    """Return JSON that can stand inside a script element: without `<`, `>`, `&` and line separators."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def scale(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the smallest and the largest finite value, different from each other."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    return (low, high) if high > low else (low, low + 1.0)


def pack(values: NDArray[np.float64], low: float, high: float) -> str:
    """Return values as two base64 characters each: 12 bits, a four-thousandth of `high - low`.

    Parameters
    ----------
    values:
        Any shape, flattened row by row. Finite values are clipped to [low, high]; others become `MISSING`.
    """
    flat = np.asarray(values, np.float64).ravel()
    finite = np.isfinite(flat)
    share = np.clip((np.where(finite, flat, low) - low) / (high - low), 0, 1)
    codes = np.where(finite, np.rint(share * (MISSING - 1)), MISSING).astype(np.uint32)
    odd = len(codes) % 2
    pairs = np.append(codes, [0] * odd).astype(np.uint32).reshape(-1, 2)
    joined = (pairs[:, 0] << 12) | pairs[:, 1]
    octets = np.stack([joined >> 16, (joined >> 8) & 255, joined & 255], axis=1).astype(np.uint8)
    text = base64.b64encode(octets.tobytes()).decode("ascii")
    return text[: len(text) - 2 * odd]


def thinned(curves: NDArray[np.float64], keep: int) -> NDArray[np.float64]:
    """Return at most `keep` of (N, T) curves, evenly spaced in the order of their last scores."""
    count = curves.shape[0]
    if count <= keep:
        return curves
    order = np.argsort(np.nan_to_num(curves[:, -1]), kind="stable")
    kept: NDArray[np.float64] = curves[order[np.linspace(0, count - 1, keep).round().astype(int)]]
    return kept
