"""The mean-field approximation of a circuit: one Bloch vector (x, y, z) per qubit, correlations dropped.

A gate on one qubit turns its vector. After a gate on two qubits each keeps its reduced state alone. Let control and
target have the vectors c and r, let U be applied to the target where the control is 1, and R turn vectors as U turns
states. Then, exactly for two uncorrelated qubits,

    r                 becomes  (1 + c_z)/2 r + (1 - c_z)/2 R r
    c_x + i c_y       becomes  (c_x + i c_y) Tr(U rho_target)
    c_z               stays

CNOT and CZ are such gates with U = X and U = Z; SWAP exchanges the two vectors. In terms of the matrix
U = e^{i theta} (u_0 - i u . sigma),

    R r = r + 2 u_0 (u x r) + 2 u x (u x r)
    Tr(U rho) = e^{i theta} (u_0 - i u . r)

A step costs the same whatever the number of qubits, so a circuit costs in proportion to its gates. The steps cannot be
undone as unitary ones can (a coherence may have become zero), so the forward pass keeps the vectors before each step.
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.circuit.description import Angle, Circuit, Operation
from qrlsuite.compiled.cache import inlined, kernel
from qrlsuite.compiled.vectors import aligned, constant, load, splat, store, total
from qrlsuite.plugins.circuits.native.kernels import (
    Scratch,
    chain,
    fill_inputs,
    prepare,
    split,
)
from qrlsuite.plugins.circuits.native.program import AXIS_X, AXIS_Z, HADAMARD, NONE, PHASE, ROTATE, Compiler

__all__ = [
    "MeanFieldProgram",
    "backward",
    "compile_circuit",
    "forward",
    "record_rows",
    "scratch",
    "tables",
]

EXCHANGE = 4
"""The kind of step that SWAP is, beside ROTATE and HADAMARD."""

FIXED = {"X": AXIS_X, "CNOT": AXIS_X, "Z": AXIS_Z, "CZ": AXIS_Z}
"""Gates that are half turns, by axis. Controlled ones have a phase too: X = i RX(pi)."""

MeanFieldTables = namedtuple("MeanFieldTables", "steps angles constants rotations factors blocks observables")
"""A program's arrays, see `MeanFieldProgram` for each, in the form that kernels take."""


@dataclass(frozen=True)
class MeanFieldProgram:
    """A compiled circuit.

    Attributes
    ----------
    qubits, inputs, parameters:
        Numbers n of qubits, I of input features and P of trainable scalars.
    steps:
        (M, 5) int64, one step per gate: kind, control or first qubit (-1 where none), target, block, whether the
        block has a phase.
    angles, constants, rotations, factors, blocks:
        As in `qrlsuite.plugins.circuits.native.program.Program`, one block per gate.
    observables:
        (O,) int64: the measured qubits.
    """

    qubits: int
    inputs: int
    parameters: int
    steps: NDArray[np.int64]
    angles: NDArray[np.int64]
    constants: NDArray[np.float64]
    rotations: NDArray[np.int64]
    factors: NDArray[np.float64]
    blocks: NDArray[np.int64]
    observables: NDArray[np.int64]


def compile_circuit(circuit: Circuit) -> MeanFieldProgram:
    """Compile a circuit description into one step per gate.

    Gates are never collected: CRX and CRY in a row drop correlations twice.
    """
    compiler = Compiler(circuit.parameters)
    steps: list[tuple[int, ...]] = []
    for operation in circuit:
        if operation.gate == "H":
            steps.append((HADAMARD, NONE, operation.wires[0], NONE, 0))
        elif operation.gate == "SWAP":
            steps.append((EXCHANGE, *operation.wires, NONE, 0))
        else:
            rotations = _rotations(compiler, operation)
            control = operation.qubits[0] if len(operation.qubits) == 2 else NONE
            phase = any(axis == PHASE for axis, _, _ in rotations)
            steps.append((ROTATE, control, operation.wires[-1], len(compiler.blocks) - 1, int(phase)))
            compiler.rotations += rotations
            compiler.blocks.append(len(compiler.rotations))
    return MeanFieldProgram(
        qubits=circuit.qubits,
        inputs=circuit.inputs,
        parameters=circuit.parameter_count,
        steps=np.array(steps, np.int64).reshape(-1, 5),
        angles=np.array(compiler.angles, np.int64).reshape(-1, 3),
        constants=np.array(compiler.constants, np.float64),
        rotations=np.array([r[:2] for r in compiler.rotations], np.int64).reshape(-1, 2),
        factors=np.array([r[2] for r in compiler.rotations], np.float64),
        blocks=np.array(compiler.blocks, np.int64),
        observables=np.array(circuit.observables, np.int64),
    )


def _rotations(compiler: Compiler, operation: Operation) -> list[tuple[int, int, float]]:
    """Write a gate on its target as (axis, angle, factor) in order of application."""
    axis = FIXED.get(operation.gate)
    if axis is None:
        return compiler.as_rotations(operation)
    half_turn = [(axis, compiler.angle(Angle(constant=math.pi)), 1.0)]
    if len(operation.qubits) == 1:
        return half_turn
    return [*half_turn, (PHASE, compiler.angle(Angle(constant=math.pi / 2)), 1.0)]


def tables(program: MeanFieldProgram) -> MeanFieldTables:
    """Return a program's arrays for the kernels."""
    return MeanFieldTables(*(getattr(program, name) for name in MeanFieldTables._fields))


def scratch(program: MeanFieldProgram, lanes: int, dtype: Any) -> Scratch:
    """Allocate working memory: inputs (I, V); values and results are not needed."""
    return Scratch(*(aligned((count, lanes), dtype) for count in (program.inputs, 1, 1)))


def record_rows(program: MeanFieldProgram) -> tuple[int, int, int]:
    """Return how many rows of lanes a chunk's record has: vectors, sines and cosines, blocks.

    The vectors are 3 rows per qubit, and 6 per step: the vectors of its two qubits before it.
    """
    vectors = 3 * program.qubits + 6 * len(program.steps)
    return vectors, 2 * len(program.rotations), 6 * (len(program.blocks) - 1)


@inlined
def _vector(state: Any, row: int) -> Any:
    return load(state, row), load(state, row + 1), load(state, row + 2)


@inlined
def _put(state: Any, row: int, x: Any, y: Any, z: Any) -> None:
    store(state, row, x)
    store(state, row + 1, y)
    store(state, row + 2, z)


@inlined
def _cross(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any) -> Any:
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inlined
def _unitary(gates: Any, block: int) -> Any:
    """Return u_0, u, and cosine and sine of theta of a block: see the module."""
    zero = splat(gates, 0.0)
    u = load(gates, 6 * block)
    z, y, x = zero - load(gates, 6 * block + 1), load(gates, 6 * block + 2), zero - load(gates, 6 * block + 3)
    return u, x, y, z, load(gates, 6 * block + 4), load(gates, 6 * block + 5)


@inlined
def _turn(u: Any, ux: Any, uy: Any, uz: Any, x: Any, y: Any, z: Any) -> Any:
    """Return R r, and u x r."""
    two = constant(u, 2.0)
    cx, cy, cz = _cross(ux, uy, uz, x, y, z)
    dx, dy, dz = _cross(ux, uy, uz, cx, cy, cz)
    return x + two * (u * cx + dx), y + two * (u * cy + dy), z + two * (u * cz + dz), cx, cy, cz


@inlined
def _run(t: Any, states: Any, gates: Any, qubits: int) -> None:
    """Bring every qubit from (0, 0, 1) to its final vector, and keep the vectors before each step."""
    zero, one, half = splat(states, 0.0), splat(states, 1.0), splat(states, 0.5)
    for q in range(qubits):
        _put(states, 3 * q, zero, zero, one)
    for m in range(t.steps.shape[0]):
        kind, control, target, block = t.steps[m, 0], 3 * t.steps[m, 1], 3 * t.steps[m, 2], t.steps[m, 3]
        kept = 3 * qubits + 6 * m
        x, y, z = _vector(states, target)
        _put(states, kept + 3, x, y, z)
        if kind == HADAMARD:
            _put(states, target, z, zero - y, x)
        elif kind == ROTATE:
            u, ux, uy, uz, phase_c, phase_s = _unitary(gates, block)
            rx, ry, rz, _, _, _ = _turn(u, ux, uy, uz, x, y, z)
            if control < 0:
                _put(states, target, rx, ry, rz)
            else:
                cx, cy, cz = _vector(states, control)
                _put(states, kept, cx, cy, cz)
                p = half * (one - cz)
                _put(states, target, x + p * (rx - x), y + p * (ry - y), z + p * (rz - z))
                s = ux * x + uy * y + uz * z
                re, im = phase_c * u + phase_s * s, phase_s * u - phase_c * s
                store(states, control, cx * re - cy * im)
                store(states, control + 1, cx * im + cy * re)
        else:
            cx, cy, cz = _vector(states, control)
            _put(states, control, x, y, z)
            _put(states, target, cx, cy, cz)


@kernel
def forward(t: Any, inputs: Any, flat: Any, records: Any, keep: int, w: Any, out: Any) -> None:
    """Compute <Z> values out (S, B, O) from inputs (S, B, I) and parameters (S, P).

    `records` (K, R, V), see `record_rows`, receive vectors and gates of every chunk where `keep` is 1; else K = 1
    serves all.
    """
    lanes = w.inputs.shape[1]
    chunks = (inputs.shape[1] + lanes - 1) // lanes
    for seed in range(inputs.shape[0]):
        for chunk in range(chunks):
            first = chunk * lanes
            states, trig, gates = split(t, records[seed * chunks + chunk if keep else 0])
            qubits = states.shape[0] // 3 - 2 * t.steps.shape[0]
            fill_inputs(inputs, seed, first, w.inputs)
            prepare(t, flat, seed, w.inputs, trig, gates)
            _run(t, states, gates, qubits)
            for v in range(min(lanes, inputs.shape[1] - first)):
                for o in range(t.observables.shape[0]):
                    out[seed, first + v, o] = states[3 * t.observables[o] + 2, v]


@inlined
def _unrotate(
    states: Any, mu: Any, gates: Any, kept: int, control: int, target: int, block: int, overlap: Any
) -> None:
    """Pull the gradient `mu` by vectors after a gate back to the vectors before it, and by its angles to `overlap`.

    An infinitesimal rotation by e after the gate changes U by -i/2 (e . sigma) U, and R r by e x R r; `overlap` is
    the gradient by e, and -1/2 that by theta.
    """
    one, half = splat(states, 1.0), splat(states, 0.5)
    x, y, z = _vector(states, kept + 3)
    u, ux, uy, uz, phase_c, phase_s = _unitary(gates, block)
    rx, ry, rz, wx, wy, wz = _turn(u, ux, uy, uz, x, y, z)
    gx, gy, gz = _vector(mu, target)
    bx, by, bz, _, _, _ = _turn(splat(states, 0.0) - u, ux, uy, uz, gx, gy, gz)  # R backwards
    tx, ty, tz = _cross(rx, ry, rz, gx, gy, gz)
    if control < 0:
        _put(mu, target, bx, by, bz)
        _put(overlap, 0, tx, ty, tz)
        return
    cx, cy, cz = _vector(states, kept)
    p = half * (one - cz)
    by_p = gx * (rx - x) + gy * (ry - y) + gz * (rz - z)
    # the factor Tr(U rho) = e^{i theta} (u - i s) of the coherence cx + i cy
    s = ux * x + uy * y + uz * z
    re, im = phase_c * u + phase_s * s, phase_s * u - phase_c * s
    hx, hy = load(mu, control), load(mu, control + 1)
    factor_re, factor_im = cx * hx + cy * hy, cx * hy - cy * hx
    store(mu, control, re * hx + im * hy)
    store(mu, control + 1, re * hy - im * hx)
    store(mu, control + 2, load(mu, control + 2) - half * by_p)
    by_u = phase_c * factor_re + phase_s * factor_im
    by_s = phase_s * factor_re - phase_c * factor_im
    q = one - p
    _put(mu, target, q * gx + p * bx + by_s * ux, q * gy + p * by + by_s * uy, q * gz + p * bz + by_s * uz)
    store(overlap, 0, p * tx + half * (by_s * (u * x + wx) - by_u * ux))
    store(overlap, 1, p * ty + half * (by_s * (u * y + wy) - by_u * uy))
    store(overlap, 2, p * tz + half * (by_s * (u * z + wz) - by_u * uz))
    store(overlap, 3, half * (im * factor_re - re * factor_im))


@kernel
def backward(
    t: Any,
    inputs: Any,
    flat: Any,
    cotangent: Any,
    records: Any,
    kept: int,
    pair: Any,
    w: Any,
    overlap: Any,
    sums: Any,
    slopes: Any,
    grad_inputs: Any,
    grad_flat: Any,
) -> None:
    """Compute gradients of sum(cotangent * values): grad_inputs (S, B, I), grad_flat (S, P).

    `records` are the records of `forward`; if `kept` is 0 they are computed again. `pair[0]` holds the gradients by
    the vectors, `overlap` (4, V) by a gate, `sums` (P, V) and `slopes` (I, V) by parameters and inputs.
    """
    lanes = w.inputs.shape[1]
    chunks = (inputs.shape[1] + lanes - 1) // lanes
    mu, zero = pair[0], splat(w.inputs, 0.0)
    for seed in range(inputs.shape[0]):
        for p in range(flat.shape[1]):
            store(sums, p, zero)
        for chunk in range(chunks):
            first = chunk * lanes
            states, trig, gates = split(t, records[seed * chunks + chunk if kept else 0])
            qubits = states.shape[0] // 3 - 2 * t.steps.shape[0]
            fill_inputs(inputs, seed, first, w.inputs)
            if not kept:
                prepare(t, flat, seed, w.inputs, trig, gates)
                _run(t, states, gates, qubits)
            for row in range(3 * qubits):
                store(mu, row, zero)
            for o in range(t.observables.shape[0]):
                for v in range(min(lanes, inputs.shape[1] - first)):
                    mu[3 * t.observables[o] + 2, v] = cotangent[seed, first + v, o]
            for i in range(slopes.shape[0]):
                store(slopes, i, zero)
            for m in range(t.steps.shape[0] - 1, -1, -1):
                kind, control, target = t.steps[m, 0], 3 * t.steps[m, 1], 3 * t.steps[m, 2]
                x, y, z = _vector(mu, target)
                if kind == HADAMARD:
                    _put(mu, target, z, zero - y, x)
                elif kind == ROTATE:
                    store(overlap, 3, zero)
                    block = t.steps[m, 3]
                    _unrotate(states, mu, gates, 3 * qubits + 6 * m, control, target, block, overlap)
                    chain(t, block, overlap, flat, seed, w.inputs, trig, sums, slopes)
                else:
                    cx, cy, cz = _vector(mu, control)
                    _put(mu, control, x, y, z)
                    _put(mu, target, cx, cy, cz)
            for v in range(min(lanes, inputs.shape[1] - first)):
                for i in range(slopes.shape[0]):
                    grad_inputs[seed, first + v, i] = slopes[i, v]
        for p in range(flat.shape[1]):
            grad_flat[seed, p] = total(load(sums, p))
