"""Golden curves: two networks of 30 runs each, with numbers that the paper's released code printed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from qrlsuite.statistics import Grid, LearningCurves
from tests.conftest import golden

GOLDEN: list[dict[str, Any]] = golden("statistics")
EPSILONS = GOLDEN[0]["epsilons"]
DELTAS = GOLDEN[0]["deltas"]
SURFACE = Grid.relative(EPSILONS, DELTAS)


def entry(index: int) -> LearningCurves:
    return LearningCurves(
        np.array(GOLDEN[index]["curves"]), GOLDEN[index]["steps_per_epoch"], GOLDEN[index]["name"]
    )


@pytest.fixture
def wide() -> LearningCurves:
    return entry(0)


@pytest.fixture
def narrow() -> LearningCurves:
    return entry(1)
