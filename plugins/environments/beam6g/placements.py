"""The random placements a2-0 .. a5-4, five for each number of antennas from 2 to 5.

The paper refers to its repository for its own instances, which we do not know; these are ours, made by the paper's
rule (appendix A.2, "Antenna configuration"): positions uniform in the field, all drawn again until every pair is
further apart than 1.5; both components of an orientation uniform in [-1, 1], then normalized. Rounded to 6 decimals, so
that the numbers in a task file are the definition. Print them for a task file with

    python -m qrlsuite.plugins.environments.beam6g.placements
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from qrlsuite.plugins.environments.beam6g.physics import FIELD, Antenna

SEED = 2025
"""The seed of all placements; a placement's seed is (SEED, antennas, index)."""
DISTANCE = 1.5
"""Pairs of antennas stand further apart than this."""
COUNTS = (2, 3, 4, 5)
PER_COUNT = 5


def placement(antennas: int, index: int) -> tuple[Antenna, ...]:
    """Return placement `a{antennas}-{index}`: the same at every call, whichever was made before."""
    generator = np.random.default_rng((SEED, antennas, index))
    while True:
        positions = generator.uniform(0.0, FIELD, (antennas, 2)).round(6)
        if all(math.dist(p, q) > DISTANCE for p, q in itertools.combinations(positions.tolist(), 2)):
            break
    orientations = generator.uniform(-1.0, 1.0, (antennas, 2))
    orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)
    return tuple(
        ((x, y), (d_x, d_y)) for (x, y), (d_x, d_y) in zip(positions.tolist(), orientations.round(6).tolist())
    )


def toml() -> str:
    """Return all placements as lines `antennas = [...]`, each after a comment with its name."""
    lines = []
    for antennas in COUNTS:
        for index in range(PER_COUNT):
            rows = ", ".join(f"[[{x}, {y}], [{u}, {v}]]" for (x, y), (u, v) in placement(antennas, index))
            lines.append(f"# a{antennas}-{index}\nantennas = [{rows}]")
    return "\n".join(lines)


if __name__ == "__main__":
    print(toml())
