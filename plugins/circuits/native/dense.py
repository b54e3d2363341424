"""Runs the same programs in plain torch operations on any device, such as a GPU.

States are complex tensors (lanes, 2^n), complex64 for float32 inputs and complex128 for float64. Gradients are
adjoint, as on the CPU (see `sweeps`): memory does not grow with depth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from qrlsuite.circuit import Circuit
from qrlsuite.circuit.api import extended
from qrlsuite.circuit.description import without_products
from qrlsuite.plugins.circuits.native.program import (
    AXIS_X,
    AXIS_Y,
    HADAMARD,
    NONE,
    ON_CONTROL,
    ON_TARGET,
    PERMUTE,
    PHASE,
    ROTATE,
    Component,
    Program,
    compile_circuit,
)

if TYPE_CHECKING:
    from qrlsuite.plugins.circuits.native.mean_field import MeanFieldProgram

COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}


def expectations(program: Program, inputs: Tensor, flat: Tensor) -> Tensor:
    """Return expectation values (S, B, O) of inputs (S, B, I) and flat parameters (S, P), differentiably."""
    angles = _angles(program, inputs, flat)
    result: Tensor = _DenseExpectations.apply(  # type: ignore[no-untyped-call]
        angles.reshape(inputs.shape[0] * inputs.shape[1], -1 if angles.shape[2] else 0), program
    )
    return result.reshape(*inputs.shape[:2], len(program.observables))


def states(circuit: Circuit, inputs: Tensor, flat: Tensor) -> Tensor:
    """Return final states (S, B, 2^n) of inputs (S, B, I) and flat parameters (S, P), up to a global phase.

    Qubit 0 is the highest bit of a basis state's index.
    """
    plain, factors = without_products(circuit)
    program = compile_circuit(plain)
    angles = _angles(program, extended(inputs, factors), flat)
    angles = angles.reshape(inputs.shape[0] * inputs.shape[1], -1 if angles.shape[2] else 0)
    together = torch.ones(len(angles), 1, dtype=COMPLEX[angles.dtype], device=angles.device)
    for component in _components(program):
        state = _begin(component, angles)
        for step in _steps(program, component):
            _apply(program, component.qubits, state, step, angles)
        together = (together[:, :, None] * state[:, None, :]).flatten(1)
    # the qubits come component by component
    order = [q for qubits in circuit.components() for q in qubits]
    axes = [1 + order.index(q) for q in range(circuit.qubits)]
    shaped = together.reshape(len(angles), *[2] * circuit.qubits).permute(0, *axes)
    return shaped.reshape(*inputs.shape[:2], -1)


def mean_field_expectations(program: MeanFieldProgram, inputs: Tensor, flat: Tensor) -> Tensor:
    """Return the mean-field values (S, B, O) of inputs (S, B, I) and flat parameters (S, P), see `mean_field`.

    Gradients are autograd's: a step is a handful of numbers per lane.
    """
    angles = _angles(program, inputs, flat)
    angles = angles.reshape(inputs.shape[0] * inputs.shape[1], angles.shape[2])
    up = torch.zeros(len(angles), 3, dtype=angles.dtype, device=angles.device)
    up[:, 2] = 1.0
    vectors = [up] * program.qubits
    for kind, control, target, block, _ in program.steps.tolist():
        r = vectors[target]
        if kind == HADAMARD:
            vectors[target] = torch.stack([r[:, 2], -r[:, 1], r[:, 0]], 1)
        elif kind == ROTATE:
            a, b, phase = _block(program, block, angles)
            axis = torch.stack([-b.imag, b.real, -a.imag], 1)
            across = torch.linalg.cross(axis, r)
            turned = r + 2 * (a.real[:, None] * across + torch.linalg.cross(axis, across))
            if control == NONE:
                vectors[target] = turned
                continue
            c = vectors[control]
            vectors[target] = r + 0.5 * (1 - c[:, 2:]) * (turned - r)
            trace = phase * torch.complex(a.real, -(axis * r).sum(1))
            coherence = torch.complex(c[:, 0], c[:, 1]) * trace
            vectors[control] = torch.stack([coherence.real, coherence.imag, c[:, 2]], 1)
        else:
            vectors[control], vectors[target] = r, vectors[control]
    values = torch.stack([vectors[q][:, 2] for q in program.observables.tolist()], 1)
    return values.reshape(*inputs.shape[:2], -1)


def _angles(program: Program | MeanFieldProgram, inputs: Tensor, flat: Tensor) -> Tensor:
    """Return constant + scale * input + weight of every angle, (S, B, A)."""
    table = torch.from_numpy(program.angles).to(inputs.device)
    angles = torch.from_numpy(program.constants).to(inputs).expand(*inputs.shape[:2], -1)
    which, scale, weight = table.T
    if (program.angles[:, 0] >= 0).any():
        x = inputs[..., which.clamp(min=0)]
        factor = torch.where(scale >= 0, _pick(flat, scale), torch.ones_like(inputs[:, :1, :1]))
        angles = angles + torch.where(which >= 0, x * factor, torch.zeros_like(x))
    if (program.angles[:, 2] >= 0).any():
        angles = angles + torch.where(weight >= 0, _pick(flat, weight), torch.zeros_like(flat[:, None, :1]))
    return angles


def _pick(flat: Tensor, index: Tensor) -> Tensor:
    """Return flat parameters (S, 1, A) at an index; where it is -1 the value means nothing."""
    if flat.shape[1] == 0:  # no parameter at all, so every index is -1
        return flat.new_zeros(len(flat), 1, len(index))
    return flat[:, index.clamp(min=0)][:, None]


class _DenseExpectations(torch.autograd.Function):
    """Expectation values (L, O) of angles (L, A), with adjoint gradients."""

    @staticmethod
    def forward(ctx: Any, angles: Tensor, program: Program) -> Tensor:
        states = [_begin(component, angles) for component in _components(program)]
        for component, state in zip(_components(program), states):
            for step in _steps(program, component):
                _apply(program, component.qubits, state, step, angles)
        ctx.program = program
        ctx.save_for_backward(angles, *states)
        total = angles.new_zeros((len(angles), len(program.observables)))
        for state, diagonal in zip(states, diagonals(program, angles)):
            total += state.abs().square() @ diagonal
        return total

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None]:
        angles, *finals = ctx.saved_tensors
        program: Program = ctx.program
        gradient = torch.zeros_like(angles)
        for component, final in zip(_components(program), finals):
            psi = final.clone()
            lam = (cotangents[0] @ _diagonals(program, component, angles).T) * psi
            for step in reversed(_steps(program, component)):
                if step[0] == ROTATE:
                    _collect(program, psi, lam, step, angles, gradient)
                for state in (psi, lam):
                    _apply(program, component.qubits, state, step, angles, inverse=True)
        return gradient, None


def _components(program: Program) -> list[Component]:
    return [Component(*row) for row in program.components.tolist()]


def _steps(program: Program, component: Component) -> list[list[int]]:
    """Return a component's steps, Hadamards behind a block as steps of their own, with their factor."""
    steps: list[list[int]] = []
    for step in program.steps[component.first : component.last].tolist():
        steps.append(step)
        for bit, here in ((step[2], ON_TARGET), (step[1], ON_CONTROL)):
            if step[5] & here:
                steps.append([HADAMARD, bit, NONE, NONE, 0, 0])
    return steps


def diagonals(program: Program, like: Tensor) -> list[Tensor]:
    """Return every component's diagonals of all observables, (2^n, O) each; type and device as of `like`."""
    return [_diagonals(program, component, like) for component in _components(program)]


def _diagonals(program: Program, component: Component, angles: Tensor) -> Tensor:
    """Return the diagonals of the observables on a component, (2^n, O): +1 or -1, 0 where one is not on it."""
    basis = torch.arange(1 << component.qubits, device=angles.device)
    number = [tuple(row) for row in program.components.tolist()].index(component)
    columns = []
    for index in program.observables.tolist():
        bit = index - component.bit
        owner, mask = (
            program.products[index - program.qubits]
            if index >= program.qubits
            else (number, 1 << max(bit, 0))
        )
        if owner != number or (index < program.qubits and not 0 <= bit < component.qubits):
            columns.append(torch.zeros_like(basis))
            continue
        odd = torch.zeros_like(basis)
        for place in range(component.qubits):
            if mask >> place & 1:
                odd ^= basis >> place & 1
        columns.append(1 - 2 * odd)
    return torch.stack(columns, dim=1).to(angles)


def _begin(component: Component, angles: Tensor) -> Tensor:
    """Return |0...0> with the opening Hadamards applied, (L, 2^n)."""
    states = torch.arange(1 << component.qubits, device=angles.device)
    amplitude = 2.0 ** (-0.5 * component.opening.bit_count())
    first = (states & ~component.opening == 0).to(angles.dtype) * amplitude
    state: Tensor = first.to(COMPLEX[angles.dtype]).repeat(len(angles), 1)
    return state


def _apply(
    program: Program, qubits: int, state: Tensor, step: list[int], angles: Tensor, inverse: bool = False
) -> None:
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
        source = torch.from_numpy(program.source(step[1], step[2], qubits)).to(state.device)
        state.copy_(state[:, source.argsort() if inverse else source])
    else:
        state[:, torch.from_numpy(program.negative[step[1] : step[2]]).to(state.device)] *= -1


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


def _block(program: Program | MeanFieldProgram, block: int, angles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
