"""The same programs in plain torch operations, on any device: what runs on a GPU.

States are complex tensors (lanes, 2^n), complex64 for float32 inputs and complex128 for float64. Gradients are
adjoint, as on the CPU (see `sweeps`): memory does not grow with depth.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from qrlsuite.plugins.circuits.native.program import (
    AXIS_X,
    AXIS_Y,
    HADAMARD,
    NONE,
    PERMUTE,
    PHASE,
    ROTATE,
    Program,
)

COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}


def expectations(program: Program, inputs: Tensor, flat: Tensor) -> Tensor:
    """Return expectation values (S, B, O) of inputs (S, B, I) and flat parameters (S, P), differentiably."""
    angles = _angles(program, inputs, flat)
    result: Tensor = _Expectations.apply(  # type: ignore[no-untyped-call]
        angles.reshape(inputs.shape[0] * inputs.shape[1], -1 if angles.shape[2] else 0), program
    )
    return result.reshape(*inputs.shape[:2], len(program.observables))


def _angles(program: Program, inputs: Tensor, flat: Tensor) -> Tensor:
    """Return constant + scale * input + weight of every angle, (S, B, A)."""
    table = torch.from_numpy(program.angles).to(inputs.device)
    angles = torch.from_numpy(program.constants).to(inputs).expand(*inputs.shape[:2], -1)
    which, scale, weight = table.T
    if bool((which >= 0).any()):
        x = inputs[..., which.clamp(min=0)]
        factor = torch.where(scale >= 0, _pick(flat, scale), torch.ones_like(inputs[:, :1, :1]))
        angles = angles + torch.where(which >= 0, x * factor, torch.zeros_like(x))
    if bool((weight >= 0).any()):
        angles = angles + torch.where(weight >= 0, _pick(flat, weight), torch.zeros_like(flat[:, None, :1]))
    return angles


def _pick(flat: Tensor, index: Tensor) -> Tensor:
    """Return flat parameters (S, 1, A) at an index; where it is -1 the value means nothing."""
    return flat[:, index.clamp(min=0)][:, None]


class _Expectations(torch.autograd.Function):
    """Expectation values (L, O) of angles (L, A), with adjoint gradients."""

    @staticmethod
    def forward(ctx: Any, angles: Tensor, program: Program) -> Tensor:
        state = _begin(program, angles)
        for step in program.steps.tolist():
            _apply(program, state, step, angles)
        ctx.program = program
        ctx.save_for_backward(angles, state)
        return state.abs().square() @ _diagonals(program, angles)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None]:
        angles, final = ctx.saved_tensors
        program: Program = ctx.program
        psi = final.clone()
        lam = (cotangents[0] @ _diagonals(program, angles).T) * psi
        gradient = torch.zeros_like(angles)
        for step in reversed(program.steps.tolist()):
            if step[0] == ROTATE:
                _collect(program, psi, lam, step, angles, gradient)
            _apply(program, psi, step, angles, inverse=True)
            _apply(program, lam, step, angles, inverse=True)
        return gradient, None


def _diagonals(program: Program, angles: Tensor) -> Tensor:
    """Return the diagonals of the observables, (2^n, O), +1 or -1."""
    states = torch.arange(1 << program.qubits, device=angles.device)
    bits = torch.from_numpy(program.observables).to(angles.device)
    return (1 - 2 * ((states[:, None] >> bits) & 1)).to(angles.dtype)


def _begin(program: Program, angles: Tensor) -> Tensor:
    """Return |0...0> with the opening Hadamards applied, (L, 2^n)."""
    states = torch.arange(1 << program.qubits, device=angles.device)
    closed = ~sum(1 << bit for bit in program.start.tolist())
    amplitude = 2.0 ** (-0.5 * len(program.start))
    first = (states & closed == 0).to(angles.dtype) * amplitude
    state: Tensor = first.to(COMPLEX[angles.dtype]).repeat(len(angles), 1)
    return state


def _apply(program: Program, state: Tensor, step: list[int], angles: Tensor, inverse: bool = False) -> None:
    """Apply a step, or its inverse, in place."""
    kind = step[0]
    if kind == ROTATE:
        a, b, phase = _block(program, step[3], angles)
        if inverse:
            a, b, phase = a.conj(), -b, phase.conj()
        p0, p1 = _halves(state, step[1], step[2])
        shape = (-1, *[1] * (p0.dim() - 1))
        a, b, phase = a.view(shape), b.view(shape), phase.view(shape)
        new0, new1 = (a * p0 - b.conj() * p1) * phase, (b * p0 + a.conj() * p1) * phase
        p0.copy_(new0)
        p1.copy_(new1)
    elif kind == HADAMARD:
        for bit in step[1:4]:
            if bit != NONE:
                p0, p1 = _halves(state, NONE, bit)
                new0, new1 = (p0 + p1) * 0.5**0.5, (p0 - p1) * 0.5**0.5
                p0.copy_(new0)
                p1.copy_(new1)
    elif kind == PERMUTE:
        source = torch.from_numpy(program.source(step[1], step[2])).to(state.device)
        state.copy_(state[:, source.argsort() if inverse else source])
    else:
        state.mul_(torch.from_numpy(program.signs[step[1]]).to(state.device))


def _halves(state: Tensor, control: int, target: int) -> tuple[Tensor, Tensor]:
    """Return views of the amplitudes whose target bit is 0 and 1, and whose control bit, if any, is 1."""
    size = state.shape[1]
    if control == NONE:
        parts = state.view(len(state), size >> (target + 1), 2, 1 << target)
        return parts[:, :, 0], parts[:, :, 1]
    high, low = max(control, target), min(control, target)
    parts = state.view(len(state), size >> (high + 1), 2, 1 << (high - low - 1), 2, 1 << low)
    if control == high:
        return parts[:, :, 1, :, 0], parts[:, :, 1, :, 1]
    return parts[:, :, 0, :, 1], parts[:, :, 1, :, 1]


def _block(program: Program, block: int, angles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (a, b) of a block's matrix in SU(2), and its phase, each (L,) complex."""
    kind = COMPLEX[angles.dtype]
    a = torch.ones(len(angles), dtype=kind, device=angles.device)
    b, phase = torch.zeros_like(a), torch.ones_like(a)
    for r in range(int(program.blocks[block]), int(program.blocks[block + 1])):
        axis, index = program.rotations[r].tolist()
        angle = angles[:, index] * float(program.factors[r])
        if axis == PHASE:
            phase = phase * torch.polar(torch.ones_like(angle), angle)
            continue
        c, s = torch.cos(0.5 * angle), torch.sin(0.5 * angle)
        if axis == AXIS_X:
            a, b = c * a - 1j * s * b, c * b - 1j * s * a
        elif axis == AXIS_Y:
            a, b = c * a - s * b, s * a + c * b
        else:
            turn = torch.polar(torch.ones_like(angle), 0.5 * angle)
            a, b = turn.conj() * a, turn * b
    return a, b, phase


def _collect(
    program: Program, psi: Tensor, lam: Tensor, step: list[int], angles: Tensor, gradient: Tensor
) -> None:
    """Add a block's gradients by its angles: `psi` and `lam` are the states after the block."""
    p0, p1 = _halves(psi, step[1], step[2])
    l0, l1 = _halves(lam, step[1], step[2])
    axes = tuple(range(1, p0.dim()))
    m00, m01 = (l0.conj() * p0).sum(axes), (l0.conj() * p1).sum(axes)
    m10, m11 = (l1.conj() * p0).sum(axes), (l1.conj() * p1).sum(axes)
    x, y, z = (m01 + m10).imag, (m10 - m01).real, (m00 - m11).imag
    for r in range(int(program.blocks[step[3] + 1]) - 1, int(program.blocks[step[3]]) - 1, -1):
        axis, index = program.rotations[r].tolist()
        factor = float(program.factors[r])
        angle = angles[:, index] * factor
        c, s = torch.cos(angle), torch.sin(angle)
        if axis == AXIS_X:
            slope = x
            y, z = c * y + s * z, c * z - s * y
        elif axis == AXIS_Y:
            slope = y
            z, x = c * z + s * x, c * x - s * z
        elif axis == PHASE:
            slope = -2.0 * (m00 + m11).imag
        else:
            slope = z
            x, y = c * x + s * y, c * y - s * x
        gradient[:, index] += factor * slope
