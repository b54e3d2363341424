"""The Fisher information of a normal policy: that of its means, and of its spreads where the network gives them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from qrlsuite.experiment.entry import resolve
from qrlsuite.training.trainer import Trainer


@pytest.mark.parametrize(
    ("words", "diagonal"),
    [
        ("ppo mlp width=2 log_spread=-1", [np.exp(2.0)]),
        ("sac mlp width=2", [np.exp(-1.0), 2.0]),  # outputs: mean 3, logarithm of the spread 0.5
    ],
)
def test_information_of_a_normal_policy(words: str, diagonal: list[float]) -> None:
    algorithm: Any = Trainer(resolve("pendulum", words), [0, 1]).algorithm
    outputs = np.broadcast_to([3.0, 0.5][: len(diagonal)], (2, 3, len(diagonal)))
    found = algorithm.information(outputs)
    np.testing.assert_allclose(found, np.broadcast_to(np.diag(diagonal), found.shape), rtol=1e-6)
    assert found.shape == (2, 3, len(diagonal), len(diagonal))
