"""Loops over the lanes of `vqe`, compiled: energies of circuits, and their best angles."""

from __future__ import annotations

from typing import Any

import numpy as np

from qrlsuite.compiled.cache import rounded

FLAT = 1e-9
"""Where an angle changes the energy by less, it stays."""


@rounded
def energy(h: Any, gates: Any, angles: Any, count: int, pairs: Any, qubits: int, state: Any) -> Any:
    """Return <state| h |state> after the first `count` gates on |0..0>; `state` (2^qubits,) is filled.

    Gate g < qubits is RY on qubit g, others are CX on `pairs[g - qubits]` (control, target). Qubit 0 is the first bit.
    """
    size = 1 << qubits
    state[:] = 0.0
    state[0] = 1.0
    for k in range(count):
        gate = gates[k]
        if gate < qubits:
            bit = 1 << (qubits - 1 - gate)
            c, s = np.cos(angles[k] / 2), np.sin(angles[k] / 2)
            for i in range(size):
                if not i & bit:
                    a, b = state[i], state[i | bit]
                    state[i] = c * a - s * b
                    state[i | bit] = s * a + c * b
        else:
            control = 1 << (qubits - 1 - pairs[gate - qubits, 0])
            bit = 1 << (qubits - 1 - pairs[gate - qubits, 1])
            for i in range(size):
                if i & control and not i & bit:
                    state[i], state[i | bit] = state[i | bit], state[i]
    total = 0.0
    for i in range(size):
        row = 0.0
        for j in range(size):
            row += h[i, j] * state[j]
        total += state[i] * row
    return total


@rounded
def optimize(
    hamiltonians: Any, which: Any, gates: Any, angles: Any, counts: Any, pairs: Any, qubits: int, sweeps: int,
    energies: Any,
) -> None:  # fmt: skip
    """Set each angle to where the energy is lowest, given the others, in `sweeps` passes from the first gate on.

    The energy is A + B cos(angle) + C sin(angle), so three energies give the minimum.

    Parameters
    ----------
    hamiltonians, which:
        (K, d, d) real symmetric matrices, and each lane's index among them, (L,).
    gates, angles:
        (L, steps); angles are changed in place.
    counts:
        How many gates each lane has, (L,).
    energies:
        Filled with the energies, (L,).
    """
    state = np.zeros(1 << qubits)
    for lane in range(len(which)):
        h, own, turns, count = hamiltonians[which[lane]], gates[lane], angles[lane], counts[lane]
        for _ in range(sweeps):
            for k in range(count):
                if own[k] >= qubits:
                    continue
                before = turns[k]
                turns[k] = 0.0
                zero = energy(h, own, turns, count, pairs, qubits, state)
                turns[k] = np.pi / 2
                plus = energy(h, own, turns, count, pairs, qubits, state)
                turns[k] = -np.pi / 2
                minus = energy(h, own, turns, count, pairs, qubits, state)
                b, c = zero - (plus + minus) / 2, (plus - minus) / 2
                turns[k] = before
                if b * b + c * c > FLAT * FLAT:
                    turns[k] = np.arctan2(-c, -b)
        energies[lane] = energy(h, own, turns, count, pairs, qubits, state)
