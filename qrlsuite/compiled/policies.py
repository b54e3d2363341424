"""The compiled losses of policies and their derivatives: seed by seed, sample by sample.

Numbers are read and stored in float32 and computed in float64. Sums run over samples in rising order, so that a seed's
numbers depend on no other seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.compiled.cache import rounded

Array = NDArray[Any]
Pull = Callable[[Array, float], Array]
"""Returns the derivatives by outputs, given those of a loss by log pi (S, B) and by the entropy of every sample."""


def judge_choices(outputs: Array, sizes: Sequence[int], chosen: Array) -> tuple[Array, Array, Pull]:
    """Return log pi of choices (S, B, K) of independent softmaxes, pi's entropy, both (S, B), and their `Pull`.

    Parameters
    ----------
    outputs:
        Logits (S, B, O).
    sizes:
        Choices of each softmax; K numbers that sum to O.
    """
    (policy, logs), counts = np.empty((2, *outputs.shape), np.float32), np.array(sizes)
    log_probs, entropies = np.empty((2, *outputs.shape[:2]), np.float32)
    if not choices(outputs, counts, chosen, policy, logs, log_probs, entropies):
        raise ValueError(f"choose one of {', '.join(map(str, sizes))} outputs of each sample")

    def pull(slopes: Array, entropy_slope: float) -> Array:
        cotangents = np.empty_like(outputs)
        pull_choices(policy, logs, counts, chosen, slopes, entropy_slope, cotangents)
        return cotangents

    return log_probs, entropies, pull


@rounded
def choices(
    outputs: Any, sizes: Any, chosen: Any, policy: Any, logs: Any, log_probs: Any, entropies: Any
) -> bool:
    """Write what `judge_choices` returns, probabilities and their logarithms (S, B, O); return whether all are some."""
    for s in range(outputs.shape[0]):
        for b in range(outputs.shape[1]):
            first, log_prob, entropy = 0, 0.0, 0.0
            for k in range(len(sizes)):
                last, place = first + sizes[k], first + chosen[s, b, k]
                if place < first or place >= last:
                    return False
                largest, total, mean = np.float64(outputs[s, b, first]), 0.0, 0.0
                for j in range(first + 1, last):
                    largest = max(largest, np.float64(outputs[s, b, j]))
                for j in range(first, last):
                    logit = outputs[s, b, j] - largest
                    weight = math.exp(logit)
                    total += weight
                    mean += weight * logit
                    policy[s, b, j] = weight
                log_total = math.log(total)
                for j in range(first, last):
                    policy[s, b, j] /= total
                    logs[s, b, j] = outputs[s, b, j] - largest - log_total
                log_prob += outputs[s, b, place] - largest - log_total
                entropy += log_total - mean / total
                first = last
            log_probs[s, b], entropies[s, b] = log_prob, entropy
    return True


@rounded
def pull_choices(
    policy: Any, logs: Any, sizes: Any, chosen: Any, slopes: Any, entropy_slope: float, cotangents: Any
) -> None:
    """Write the derivatives by logits (S, B, O) of the sum of slopes (S, B) times log pi, and a slope times entropy."""
    for s in range(logs.shape[0]):
        for b in range(logs.shape[1]):
            first, slope = 0, np.float64(slopes[s, b])
            for k in range(len(sizes)):
                last, entropy = first + sizes[k], 0.0
                for j in range(first, last):
                    entropy -= np.float64(policy[s, b, j]) * logs[s, b, j]
                for j in range(first, last):
                    cotangents[s, b, j] = -policy[s, b, j] * (
                        slope + entropy_slope * (logs[s, b, j] + entropy)
                    )
                cotangents[s, b, first + chosen[s, b, k]] += slope
                first = last


@rounded
def proximal(
    log_probs: Any, entropies: Any, old_log_probs: Any, advantages: Any, returns: Any, values: Any, low: Any,
    high: Any, value_clip: float, value_coefficient: float, slopes: Any, value_slopes: Any, measured: Any,
) -> None:  # fmt: skip
    """Write the derivatives of PPO's loss, see `qrlsuite.plugins.algorithms.ppo`, but for the one by the entropy.

    Parameters
    ----------
    log_probs, entropies, old_log_probs, advantages, returns:
        (S, B); advantages are normalized here.
    values, value_slopes:
        (S, B, 1), and where the derivatives by values are written.
    low, high:
        The ratios beyond which nothing is earned (S,).
    value_clip:
        Values this far from the collected ones learn no more; infinity: all do.
    slopes:
        Where the derivatives by log_probs are written, (S, B).
    measured:
        Where policy loss, value loss, entropy and divergence are written, (4, S).
    """
    batch = log_probs.shape[1]
    for s in range(log_probs.shape[0]):
        mean, square, policy_loss, value_loss, entropy, moved = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for b in range(batch):
            mean += advantages[s, b] / batch
        for b in range(batch):
            square += (advantages[s, b] - mean) ** 2
        scale = 1.0 / (math.sqrt(square / max(batch - 1, 1)) + 1e-8)
        for b in range(batch):
            log_ratio = np.float64(log_probs[s, b]) - old_log_probs[s, b]
            advantage, ratio = (advantages[s, b] - mean) * scale, math.exp(log_ratio)
            free, held = ratio * advantage, min(max(ratio, low[s]), high[s]) * advantage
            slopes[s, b] = 0.0 if held < free else -free / batch
            value, collected = np.float64(values[s, b, 0]), np.float64(returns[s, b]) - advantages[s, b]
            error = value - returns[s, b]
            near = collected + min(max(value - collected, -value_clip), value_clip) - returns[s, b]
            clipped = abs(value - collected) > value_clip and abs(near) > abs(error)
            value_slopes[s, b, 0] = 0.0 if clipped else 2.0 * value_coefficient * error / batch
            policy_loss -= min(free, held) / batch
            value_loss += (near * near if clipped else error * error) / batch
            entropy += entropies[s, b] / batch
            moved -= log_ratio / batch
        measured[0, s], measured[1, s], measured[2, s], measured[3, s] = (
            policy_loss,
            value_loss,
            entropy,
            moved,
        )
