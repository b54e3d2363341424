"""Options: one rule broken per test, the message asserted."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from qrlsuite.errors import OptionError
from qrlsuite.options import plain
from qrlsuite.plugins.environments.beam6g import BeamManagement6G
from qrlsuite.plugins.environments.beam6g.options import MAIN, BeamOptions, parse

HERE = ((1.0, 1.0), (1.0, 0.0))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"antennas": [HERE]}, "at least 2 are needed: the action is the choice of an antenna"),
        ({"antennas": []}, "at least 2 are needed"),
        ({"antennas": [HERE, ((6.01, 1), (1, 0))]}, "antenna 1 stands at (6.01, 1), outside the field"),
        ({"antennas": [((1, -0.1), (1, 0)), HERE]}, "antenna 0 stands at (1, -0.1), outside the field"),
        ({"antennas": [HERE, ((2, 2), (0, 0))]}, "antenna 1 has the orientation (0, 0), which is no direction"),
        ({"antennas": [HERE, ((math.nan, 2), (1, 0))]}, "antenna 1 has a value that is not a finite number"),
        ({"antennas": [HERE, ((2, 2), (math.inf, 0))]}, "antenna 1 has a value that is not a finite number"),
        ({"antennas": [HERE, ((2, 2),)]}, "antennas.1.1: Field required"),
        ({"degree": 1}, "degree = 1: at least 2 is needed"),
        ({"degree": 33}, "degree = 33: at most 32 is allowed"),
        ({"degree": 2.5}, "degree = 2.5: Input should be a valid integer"),
        ({"steps": 0}, "steps = 0: Input should be greater than or equal to 1"),
        ({"physics": "real"}, "physics = 'real': Input should be 'released' or 'text'"),
        ({"rejection": "none"}, "rejection = 'none': Input should be 'tolerant' or 'released'"),
        ({"stack": 0}, "stack = 0: Input should be greater than or equal to 1"),
        ({"step": 3}, "no option 'step'; did you mean 'steps'?"),
        ({"degree": 1, "steps": 0}, "steps = 0"),
    ],
)  # fmt: skip
def test_bad_values(values, message):
    with pytest.raises(OptionError, match=re.escape(message)):
        parse(values)


def test_unknown_render_mode():
    with pytest.raises(OptionError, match="render_mode = 'html': Input should be 'human' or 'rgb_array' or"):
        BeamManagement6G(render_mode="html")


def test_orientations_are_normalized_and_then_stay_as_they_are():
    options = parse({"antennas": [HERE, ((2, 2), (0.3, -0.7))]})
    assert math.hypot(*options.antennas[1][1]) == pytest.approx(1.0, abs=1e-15)
    assert parse(plain(options)) == options


def test_unit_orientations_keep_their_bits():
    angles = np.random.default_rng(0).uniform(0, 6, 200)
    given = tuple(((1.0, 1.0), (float(np.cos(a)), float(np.sin(a)))) for a in angles)
    assert parse({"antennas": given}).antennas == given


def test_defaults_are_the_standard_instance():
    assert BeamOptions() == BeamOptions(antennas=MAIN, degree=3, steps=200, physics="released", stack=1)
    assert MAIN == (((1.5, 1.0), (1.0, 0.0)), ((1.5, 5.0), (-1.0, 0.0)), ((4.5, 3.0), (0.0, 1.0)))
