"""The parameter-shift rule on stacked angles: one batch of evaluations for the gradient of all angles.

Uncontrolled rotations exp(-i a P / 2) have the two-term rule (Mitarai et al. 2018, Phys. Rev. A 98, 032309;
Schuld et al. 2019, Phys. Rev. A 99, 032331), controlled ones, whose generator has eigenvalues -1/2, 0, 1/2, the
four-term rule (Wierichs et al. 2022, Quantum 6, 677).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

TWO_TERM = ((math.pi / 2, 0.5), (-math.pi / 2, -0.5))
_ROOT = math.sqrt(2.0)
_NEAR, _FAR = (_ROOT + 1) / (4 * _ROOT), (_ROOT - 1) / (4 * _ROOT)
FOUR_TERM = (
    (math.pi / 2, _NEAR),
    (-math.pi / 2, -_NEAR),
    (3 * math.pi / 2, -_FAR),
    (-3 * math.pi / 2, _FAR),
)
"""Pairs (shift in radians, coefficient): the derivative is the sum of coefficient * value(angle + shift)."""


class ShiftPlan(NamedTuple):
    """Of every evaluation, in order: the angle that is shifted (K,) and its coefficient (K,); and A angles in all."""

    angle: Tensor
    coefficient: Tensor
    angles: int


def shifted_angles(angles: Tensor, controlled: Sequence[bool]) -> tuple[Tensor, ShiftPlan]:
    """Return the angles of every evaluation that the rule needs.

    Parameters
    ----------
    angles:
        (A, B) radians.
    controlled:
        Of every angle, whether its gate is controlled.

    Returns
    -------
    tuple
        Angles (A, K * B), evaluation k of sample b in column k * B + b, and the plan of the K evaluations.
    """
    count, lanes = angles.shape
    rules = [FOUR_TERM if c else TWO_TERM for c in controlled]
    index = torch.tensor([a for a, rule in enumerate(rules) for _ in rule], dtype=torch.int64)
    shift = angles.new_tensor([shift for rule in rules for shift, _ in rule])
    coefficient = angles.new_tensor([c for rule in rules for _, c in rule])
    K = len(index)
    stacked = angles[:, None].repeat(1, K, 1)
    stacked[index, torch.arange(K)] += shift[:, None]
    return stacked.reshape(count, K * lanes), ShiftPlan(index, coefficient, count)


def vector_jacobian(values: Tensor, grad: Tensor, plan: ShiftPlan) -> Tensor:
    """Combine evaluations (K * B, O) and a cotangent (B, O) to the gradient of the angles (A, B)."""
    lanes = grad.shape[0]
    weighted = (values.reshape(-1, lanes, grad.shape[1]) * grad).sum(2) * plan.coefficient[:, None]
    return torch.zeros(plan.angles, lanes, dtype=values.dtype).index_add_(0, plan.angle, weighted)
