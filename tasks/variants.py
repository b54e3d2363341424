"""Writes the task files that are `beam6g.toml` but for a few lines: degrees, the text's physics, random placements.

    python -m qrlsuite.tasks.variants

`beam6g.toml` is the one source of protocol and presets: after a change in it, run this again.
"""

from __future__ import annotations

import re
from pathlib import Path

from qrlsuite.plugins.environments.beam6g.placements import COUNTS, PER_COUNT, SEED, placement

DEGREES = (4, 5, 6)
_BASE = Path(__file__).parent / "beam6g.toml"


def files() -> dict[str, str]:
    """Return the content of every such task file by its name."""
    base = _BASE.read_text(encoding="utf-8")
    texts = {"beam6g-text.toml": _text(base)}
    for degree in DEGREES:
        texts[f"beam6g-degree{degree}.toml"] = _degree(base, degree)
    for antennas in COUNTS:
        for index in range(PER_COUNT):
            texts[f"beam6g-a{antennas}-{index}.toml"] = _placement(base, antennas, index)
    return texts


def _text(base: str) -> str:
    """Return `beam6g-text.toml`."""
    changed = _headed(
        base,
        "# a3-main with the intensity of the paper's text, where it falls with R^2, and its codebook of 5 beams.",
        "beam6g-text",
        "Beam management with the intensity and the codebook of the paper's text, else as beam6g",
    )
    physics = '\n# The text\'s intensity and codebook; the published results come from "released".\nphysics = "text"'
    return _replaced(changed, r"^steps = 200$", f"steps = 200{physics}")


def _degree(base: str, degree: int) -> str:
    """Return the task file of paths of another degree."""
    changed = _headed(
        base,
        f"# a3-main with paths through {degree} support points (the paper's appendix on task complexity).",
        f"beam6g-degree{degree}",
        f"Beam management with paths of degree {degree}, else as beam6g",
    )
    return _replaced(changed, r"^degree = 3$", f"degree = {degree}")


def _placement(base: str, antennas: int, index: int) -> str:
    """Return the task file of one random placement."""
    changed = _headed(
        base,
        f"# Random placement a{antennas}-{index}. The paper's own instances are not known to us: these numbers are\n"
        f"# ours, drawn by the paper's rule with seed ({SEED}, {antennas}, {index}).\n"
        "# Written by `python -m qrlsuite.tasks.variants`.",
        f"beam6g-a{antennas}-{index}",
        f"Beam management with {antennas} antennas at random, placement {index} of 0 to {PER_COUNT - 1} (ours)",
    )
    rows = "\n".join(f"    [[{x}, {y}], [{u}, {v}]]," for (x, y), (u, v) in placement(antennas, index))
    for pattern, text in (
        (
            r"^# The paper's standard instance: antennas as .*$",
            "# Antennas as ((x, y), (orientation x, orientation y)).",
        ),
        (r"^antennas = \[\n(?:    .*\n)+\]$", f"antennas = [\n{rows}\n]"),
        (r"^# The paper's surface grid, the cell", "# The paper's grid for random placements, the cell"),
        (r"^epsilons = .*$", "epsilons = [0.30, 0.20, 0.10]"),
        (r"^deltas = .*$", "deltas = [0.5, 0.75]"),
        (r"^reference = .*$", "reference = { epsilon = 0.20, delta = 0.75 }"),
    ):
        changed = _replaced(changed, pattern, text)
    return changed


def _headed(base: str, comment: str, name: str, summary: str) -> str:
    """Return a task file with another first comment, name and summary."""
    changed = _replaced(base, r"\A(?:#.*\n)+", f"{comment}\n")
    changed = _replaced(changed, r'\A((?:.*\n)*?)name = "beam6g"$', rf'\g<1>name = "{name}"')
    return _replaced(changed, r"^summary = .*$", f'summary = "{summary}"')


def _replaced(text: str, pattern: str, replacement: str) -> str:
    """Return text with the one match of a pattern replaced.

    Raises
    ------
    ValueError
        If there is not exactly one match: `beam6g.toml` has changed its form, and this module must follow.
    """
    changed, count = re.subn(pattern, replacement, text, flags=re.MULTILINE)
    if count != 1:
        raise ValueError(f"{_BASE.name}: {pattern!r} matches {count} times, not once")
    return changed


if __name__ == "__main__":
    for name, content in files().items():
        (_BASE.parent / name).write_text(content, encoding="utf-8")
