"""The random placements: the paper's rule, and the same numbers for ever."""

from __future__ import annotations

import itertools
import math
import tomllib

import pytest

from qrlsuite.plugins.environments.beam6g import placements
from qrlsuite.plugins.environments.beam6g.options import parse

NAMES = list(itertools.product(placements.COUNTS, range(placements.PER_COUNT)))


@pytest.mark.parametrize(("antennas", "index"), NAMES)
def test_rule(antennas, index):
    placement = placements.placement(antennas, index)
    assert len(placement) == antennas
    assert all(0 <= value <= 6 for position, _ in placement for value in position)
    assert all(math.dist(p[0], q[0]) > 1.5 for p, q in itertools.combinations(placement, 2))
    assert all(math.hypot(*orientation) == pytest.approx(1, abs=2e-6) for _, orientation in placement)
    parse({"antennas": placement})


def test_the_numbers_are_fixed():
    assert placements.placement(5, 4)[0] == ((2.134286, 1.397794), (0.72011, 0.69386))


def test_lines_are_toml():
    lines = [line for line in placements.toml().splitlines() if not line.startswith("#")]
    parsed = [parse(tomllib.loads(line)).antennas for line in lines]
    assert parsed == [parse({"antennas": placements.placement(*name)}).antennas for name in NAMES]
