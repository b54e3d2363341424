"""Measures of pure states of n qubits: how entangled they are, and how well random ones fill the space.

- Meyer & Wallach (2002), in the form of Brennen (2003): Q = 2 (1 - mean over qubits of Tr rho_q^2), from 0 for products
  to 1 where every qubit is maximally entangled with the rest;
- the half-cut entropy: the von Neumann entropy, in bits, of the first n // 2 qubits, from 0 to n // 2;
- expressibility (after Sim, Johnson & Aspuru-Guzik 2019, arXiv:1905.10876): the divergence of the fidelities of random
  pairs of states from the fidelities of states drawn by Haar's measure.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
States = NDArray[np.complexfloating]
BINS = 75
"""Of the fidelities, as in the paper."""


def meyer_wallach(states: States) -> Array:
    """Return the measure of Meyer and Wallach (...) of states (..., 2^n)."""
    n = states.shape[-1].bit_length() - 1
    purities = []
    for q in range(n):
        parts = np.moveaxis(states.reshape(*states.shape[:-1], 1 << q, 2, -1), -2, -3)
        parts = parts.reshape(*states.shape[:-1], 2, -1)
        rho = parts @ np.swapaxes(parts.conj(), -1, -2)
        purities.append(np.square(np.abs(rho)).sum(axis=(-2, -1)))
    return np.asarray(2.0 * (1.0 - np.mean(purities, axis=0)), np.float64)


def half_cut_entropy(states: States) -> Array:
    """Return the entropy, in bits, (...) of the first n // 2 qubits of states (..., 2^n)."""
    n = states.shape[-1].bit_length() - 1
    matrix = states.reshape(*states.shape[:-1], 1 << (n // 2), -1)
    weights = np.square(np.linalg.svd(matrix, compute_uv=False).astype(np.float64))
    bits = np.where(weights > 0, -weights * np.log2(np.where(weights > 0, weights, 1.0)), 0.0).sum(axis=-1)
    return np.asarray(bits)


def fidelities(first: States, second: States) -> Array:
    """Return |<a|b>|^2 (N,) of states (N, 2^n)."""
    return np.asarray(np.square(np.abs((first.conj() * second).sum(axis=-1))), np.float64)


def expressibility(found: Array, qubits: int, bins: int = BINS) -> float:
    """Return the divergence of fidelities of random pairs of states from Haar's, in natural units.

    The fidelity of two states drawn by Haar's measure in d = 2^n dimensions has the density (d - 1) (1 - F)^(d - 2).
    Fidelities are counted in bins of equal width, and the Kullback-Leibler divergence of the counts is taken. It is 0
    for Haar's states and (d - 1) log(bins) for one that never changes: the smaller, the more expressive. N pairs make
    it too large by about (occupied bins - 1) / (2 N).

    Parameters
    ----------
    found:
        (N,), in [0, 1].
    """
    edges = np.linspace(0.0, 1.0, bins + 1)
    counts = np.histogram(np.clip(found, 0.0, 1.0), edges)[0]
    part = counts / counts.sum()
    d = 1 << qubits
    with np.errstate(divide="ignore"):
        below = (d - 1) * np.log1p(-edges)  # log of the probability of a fidelity above each edge
    haar = below[:-1] + np.log1p(-np.exp(np.diff(below)))
    seen = part > 0
    return float((part[seen] * (np.log(part[seen]) - haar[seen])).sum())


def most_expressible(bins: int = BINS) -> int:
    """Return up to how many qubits the bins tell states apart; beyond, 99 of 100 pairs of Haar's share the first."""
    return int(math.log2(1.0 + math.log(0.01) / math.log1p(-1.0 / bins)))
