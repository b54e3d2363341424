"""Gradients from circuit executions alone, for shots, noise and devices: one batch of circuits for all angles.

`measured` runs a batch of circuits and differentiates it by one of two rules. The parameter-shift rule is exact up to
sampling and takes two or four circuits per angle and input. SPSA takes two circuits per input, whatever the number of
angles, and is a noisy guess in a random direction (Spall 1992, IEEE Trans. Autom. Control 37, 332).

Uncontrolled rotations exp(-i a P / 2) have the two-term rule (Mitarai et al. 2018, Phys. Rev. A 98, 032309;
Schuld et al. 2019, Phys. Rev. A 99, 032331), controlled ones, whose generator has eigenvalues -1/2, 0, 1/2, the
four-term rule (Wierichs et al. 2022, Quantum 6, 677).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
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


SPSA_STEP = 0.05
"""Radians by which SPSA moves every angle. A larger step has less shot noise and more bias: with A angles the gradient
shrinks by about cos(step)^A."""

Execute = Callable[[Tensor, int], Tensor]
"""Runs circuits: angles (A, L) and the number of the call to values (L, O). Call 0 is the forward pass, 1, 2, ... are
the parts of the backward pass; each draws its own samples."""

Combine = Callable[[Tensor, Tensor], Tensor]
Rule = Callable[[Tensor], tuple[Tensor, Combine]]
"""From angles (A, B) to the angles of K evaluations (A, K * B), and a function that combines their values (K * B, O)
and a cotangent (B, O) to the gradient (A, B)."""


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
    stacked = angles.T.repeat(K, 1, 1)  # an evaluation's angles side by side, as simulators read them
    stacked[torch.arange(K), :, index] += shift[:, None]
    return stacked.reshape(K * lanes, count).T, ShiftPlan(index, coefficient, count)


def vector_jacobian(values: Tensor, grad: Tensor, plan: ShiftPlan) -> Tensor:
    """Combine evaluations (K * B, O) and a cotangent (B, O) to the gradient of the angles (A, B)."""
    lanes = grad.shape[0]
    weighted = (values.reshape(-1, lanes, grad.shape[1]) * grad).sum(2) * plan.coefficient[:, None]
    return torch.zeros(plan.angles, lanes, dtype=values.dtype).index_add_(0, plan.angle, weighted)


def shift_rule(controlled: Sequence[bool]) -> Rule:
    """Return the parameter-shift rule of angles, some of them of controlled gates."""

    def rule(angles: Tensor) -> tuple[Tensor, Combine]:
        shifted, plan = shifted_angles(angles, controlled)
        return shifted, lambda values, grad: vector_jacobian(values, grad, plan)

    return rule


def stream(entropy: Any, *path: int) -> np.random.SeedSequence:
    """Return the random stream of one part of one pass; `entropy` is a seed's, see `numpy.random.SeedSequence`."""
    return np.random.SeedSequence(entropy, spawn_key=path)


def random_signs(seed: np.random.SeedSequence) -> Callable[[tuple[int, ...]], Tensor]:
    """Return a function that draws tensors of +1 and -1."""
    source = np.random.default_rng(seed)
    return lambda shape: torch.from_numpy(source.choice([-1.0, 1.0], shape))


def spsa_rule(signs: Callable[[tuple[int, ...]], Tensor]) -> Rule:
    """Return the rule that moves all angles at once, each up or down.

    Divided by 2 sin(step) and not by 2 step, the difference is exact for a single uncontrolled rotation.

    Parameters
    ----------
    signs:
        Draws a tensor of +1 and -1 of a shape.
    """

    def rule(angles: Tensor) -> tuple[Tensor, Combine]:
        direction = signs(tuple(angles.shape)).to(angles)
        moved = torch.cat([angles + SPSA_STEP * direction, angles - SPSA_STEP * direction], dim=1)

        def combine(values: Tensor, grad: Tensor) -> Tensor:
            up, down = values.reshape(2, *grad.shape)
            slope: Tensor = ((up - down) * grad).sum(1) / (2 * math.sin(SPSA_STEP))
            return slope * direction

        return moved, combine

    return rule


def measured(angles: Tensor, execute: Execute, rule: Rule, most: int = 2**62) -> Tensor:
    """Run circuits, differentiably by the rule.

    Parameters
    ----------
    angles:
        (A, B) radians.
    most:
        Lanes that one call of the backward pass may have.

    Returns
    -------
    Tensor
        Values (B, O).
    """
    result: Tensor = _Measured.apply(angles, execute, rule, most)  # type: ignore[no-untyped-call]
    return result


class _Measured(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, angles: Tensor, execute: Execute, rule: Rule, most: int) -> Tensor:
        ctx.save_for_backward(angles)
        ctx.execute, ctx.rule, ctx.most = execute, rule, most
        return execute(angles.detach(), 0)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        (angles,) = ctx.saved_tensors
        stacked, combine = ctx.rule(angles)
        with torch.no_grad():
            parts = torch.split(stacked, ctx.most, dim=1)
            values = [ctx.execute(part, 1 + number) for number, part in enumerate(parts)]
        return combine(torch.cat(values), grads[0]), None, None, None
