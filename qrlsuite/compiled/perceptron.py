"""Layers of networks as one compiled sweep behind a `torch.autograd.Function`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

SPARE_BYTES = 64 << 20
"""Records up to this size are kept from one pass to the next: fresh pages cost more time than a small network."""

_spare: dict[tuple[int, int], Any] = {}


def perceptron(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], activation: str = "none"
) -> Tensor:
    """Apply the layers of S networks, with "none", "relu" or "sin" after each but the last; float32 on the CPU.

    Parameters
    ----------
    x:
        (S, B, in).
    weights, biases:
        Of every layer (S, out, in) and (S, out).

    Returns
    -------
    Tensor
        (S, B, out), differentiable once. A seed's numbers have the same bits in any population.

    Raises
    ------
    ValueError
        If shapes do not fit: compiled loops would read what is beside an array.
    """
    parameters = (*weights, *biases)
    _require_fitting(x, weights, biases)
    if torch.is_grad_enabled() and any(each.requires_grad for each in (x, *parameters)):
        result: Tensor = _Perceptron.apply(x, activation, *parameters)  # type: ignore[no-untyped-call]
        return result
    return _outputs(x, _arrays(parameters), activation, False)[0]


def _require_fitting(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
    shape = tuple(x.shape)
    fits = len(shape) == 3 and len(weights) == len(biases) > 0
    for weight, bias in zip(weights, biases):
        outputs = weight.shape[1] if weight.dim() == 3 else 0
        fits = fits and weight.shape == (shape[0], outputs, shape[2]) and bias.shape == (shape[0], outputs)
        shape = (*shape[:2], outputs)
    if not fits:
        weight_shapes, bias_shapes = ([tuple(each.shape) for each in part] for part in (weights, biases))
        raise ValueError(
            f"layers of S seeds take x (S, B, in), weights (S, out, in) and biases (S, out); x is {tuple(x.shape)}, "
            f"weights are {weight_shapes}, biases {bias_shapes}"
        )


def _arrays(tensors: Sequence[Tensor]) -> list[Any]:
    return [each.detach().contiguous().numpy() for each in tensors]


def _code(activation: str) -> int:
    from qrlsuite.compiled import networks

    return {"none": networks.NOTHING, "relu": networks.RELU, "sin": networks.SINE}[activation]


def _outputs(x: Tensor, arrays: list[Any], activation: str, keep: bool) -> tuple[Tensor, _Records]:
    """Return outputs (S, B, out) of weights and biases, and the records of the pass, all of them if `keep`."""
    from qrlsuite.compiled import networks, vectors

    weights, biases = arrays[: len(arrays) // 2], arrays[len(arrays) // 2 :]
    vector = vectors.lanes(np.float32)
    code = _code(activation)
    rows = networks.record_rows([x.shape[2], *(w.shape[1] for w in weights)], code, vector)
    records = _Records(len(x) * -(-x.shape[1] // (2 * vector)) if keep else 1, rows, 2 * vector)
    out = np.empty((*x.shape[:2], weights[-1].shape[1]), np.float32)
    inputs = x.detach().contiguous().numpy()
    networks.forward(inputs, tuple(weights), tuple(biases), code, records.array, keep, out)
    return torch.from_numpy(out), records


class _Records:
    """What a chunk of samples is in every layer, (chunks, rows, 2 V); its memory then serves another pass."""

    def __init__(self, chunks: int, rows: int, wide: int) -> None:
        from qrlsuite.compiled.vectors import aligned

        self.key = rows, wide
        room = _spare.pop(self.key, None)
        if room is None or len(room) < chunks:
            room = aligned((chunks, rows, wide), np.float32)
        self.array = room

    def __del__(self, spare: dict[tuple[int, int], Any] = _spare, most: int = SPARE_BYTES) -> None:
        if self.array.nbytes <= most:  # names of the module may be gone when the interpreter ends
            spare[self.key] = self.array


class _Perceptron(torch.autograd.Function):
    """Outputs of layers, with the gradients of inputs, weights and biases."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, activation: str, *parameters: Tensor) -> Tensor:
        values, ctx.records = _outputs(x, _arrays(parameters), activation, True)
        ctx.activation, ctx.inputs = activation, x.shape[2]
        ctx.save_for_backward(*parameters)
        return values

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        from qrlsuite.compiled import networks, vectors

        if torch.is_grad_enabled():
            raise RuntimeError(
                "compiled layers of a network are differentiated once: leave out create_graph=True, or compute in "
                "float64, which torch differentiates any number of times"
            )
        held = _arrays(ctx.saved_tensors)
        weights, biases = tuple(held[: len(held) // 2]), tuple(held[len(held) // 2 :])
        cotangent = cotangents[0].contiguous()
        vector = vectors.lanes(np.float32)
        gradients = [np.empty_like(each) for each in held]
        sides = [(w.shape[1], w.shape[2]) for w in weights]
        widest = -(-max(max(side) for side in sides) // vector) * vector
        numbers = sum(min(side) * -(-max(side) // vector) * vector for side in sides)
        needed = ctx.needs_input_grad[0]
        x_gradient = np.empty((*cotangent.shape[:2], ctx.inputs) if needed else (1, 1, 1), np.float32)
        networks.backward(
            cotangent.numpy(),
            weights,
            biases,
            _code(ctx.activation),
            ctx.records.array,
            vectors.aligned((2, widest, 2 * vector), np.float32),
            vectors.aligned((2 * vector * widest,), np.float32),
            vectors.aligned((numbers,), np.float32),
            tuple(gradients[: len(weights)]),
            tuple(gradients[len(weights) :]),
            x_gradient,
            needed,
        )
        return torch.from_numpy(x_gradient) if needed else None, None, *map(torch.from_numpy, gradients)
