"""The planted circuit: its episodes, and that it is a positive control."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded

from benchmarks.planted import fit
from qrlsuite.circuit import ansatz, expectations
from qrlsuite.errors import OptionError
from qrlsuite.plugins.environments.planted import MARGIN, SCALING, THRESHOLDS, WEIGHTS, Planted, classify


def test_classes_are_those_of_the_circuit_on_another_backend() -> None:
    points = np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 2))
    parameters = {"scaling": SCALING, "weights": WEIGHTS}
    above = expectations(ansatz("cx", 2, 5), points, parameters, "pennylane").numpy() - THRESHOLDS
    classes, clear = classify(points)
    assert classes.tolist() == [int(a > 0) + 2 * int(b > 0) for a, b in above]
    assert clear.tolist() == [bool(min(abs(a), abs(b)) > MARGIN) for a, b in above]
    assert {*clear.tolist()} == {True, False}


def test_right_answers_are_rewarded_and_points_are_clear() -> None:
    env = Planted(steps=8)
    observation, _ = env.reset(seed=1)
    for step in range(8):
        classes, clear = classify(observation[None])
        assert clear[0]
        wrong = step >= 6
        observation, reward, terminated, truncated, info = env.step((classes[0] + wrong) % 4)
        assert reward == 1 - wrong
        assert (terminated, truncated) == (step == 7, False)
    assert info == {"score": 6 / 8}
    with pytest.raises(ResetNeeded, match=r"reset\(\)"):
        env.step(0)


def test_classes_are_about_equally_frequent() -> None:
    env = gymnasium.make("qrlsuite/Planted-v1", steps=4000).unwrapped
    env.reset(seed=0)
    shares = np.bincount(env.classes, minlength=4) / 4000  # type: ignore[attr-defined]
    assert (np.abs(shares - 0.25) < 0.05).all()


def test_bad_input() -> None:
    with pytest.raises(OptionError, match="environment 'planted': steps = 0"):
        Planted(steps=0)
    env = Planted()
    with pytest.raises(ResetNeeded, match=r"reset\(\)"):
        env.step(0)
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match="one of 0, 1, 2, 3, not 4"):
        env.step(4)


@pytest.mark.parametrize(
    ("controls", "starts", "steps"),
    [
        (("mean-field, teacher's own", "mlp"), 1, 300),
        pytest.param(("mean-field", "separable", "sin, gain 2"), 2, 500, marks=pytest.mark.long),
    ],
)
def test_the_circuit_fits_the_classes_and_matched_controls_do_not(
    controls: tuple[str, ...], starts: int, steps: int
) -> None:
    """The best of several random starts of each; mean-field is also given the teacher's parameters to start from."""
    circuit_size, circuit = fit("circuit", starts, steps)
    for control in controls:
        size, right = fit(control, starts, steps)
        gap = 0.1 if "mean-field" in control or control == "separable" else 0.01
        assert right[-1] < circuit[-1] - gap, control
        assert circuit_size <= size <= 1.2 * circuit_size, control
