"""Networks as one compiled sweep, by itself and behind a `torch.autograd.Function`; first of all their layers."""

from __future__ import annotations

import functools
import itertools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qrlsuite.compiled import networks, vectors

SPARE_BYTES = 64 << 20
"""Working memory up to this size is kept for a later pass, as much as passes at a time took: fresh pages cost time."""

WIDE = 2 * vectors.lanes(np.float32)
"""Samples of a chunk."""

_spare: dict[tuple[str, int, int], list[Any]] = {}

Array = NDArray[np.float32]
_NOTHING: Array = np.empty(1, np.float32)
_NOWHERE: Array = np.empty((1, 1, 1), np.float32)


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
    """
    return LayersSweep(weights, biases, activation)(x)


class Sweep(ABC):
    """A population of S networks whose passes are compiled: (S, B, in) to (S, B, out).

    Parameters
    ----------
    tensors:
        All parameters (S, ...), float32 on the CPU. They are read where they lie if they lie one behind the other
        (`in_one_block`), else copied.
    inputs:
        Numbers of a sample.

    Attributes
    ----------
    parameters:
        All numbers of `tensors`, one behind the other. Gradients of a pass are laid out as they are.
    places:
        Where the tensors lie: a sweep serves as long as they stay there.
    """

    def __init__(self, tensors: Sequence[Tensor], inputs: int) -> None:
        self.tensors, self.inputs = list(tensors), inputs
        self.shapes = [each.shape for each in tensors]
        self.seeds = self.shapes[0][0]
        self.parameters = joined(tensors)
        self.places = [each.data_ptr() for each in tensors]
        self.kept_gradients: Array | None = None
        self._kept_parts: list[Tensor] = []

    @abstractmethod
    def values(self, x: Array, keep: bool) -> tuple[Array, Any]:
        """Return outputs (S, B, out) of x (S, B, in), and the records of the pass, all of them if `keep`."""

    @abstractmethod
    def pull(self, records: Any, cotangents: Array, gradients: Array, x_gradient: Array | None) -> None:
        """Write the gradients of the parameters (in their layout) and of x, given cotangents (S, B, out)."""

    def pull_x(self, records: Any, cotangents: Array) -> Array:
        """Return the gradient of x alone (S, B, in), given cotangents (S, B, out)."""
        x_gradient = np.empty((*cotangents.shape[:2], self.inputs), np.float32)
        self.pull(records, cotangents, np.empty_like(self.parameters), x_gradient)
        return x_gradient

    def __call__(self, x: Tensor) -> Tensor:
        """Map (S, B, in) to (S, B, out)."""
        if torch.is_grad_enabled() and (x.requires_grad or any(each.requires_grad for each in self.tensors)):
            result: Tensor = _Swept.apply(x, self, *self.tensors)  # type: ignore[no-untyped-call]
            return result
        return torch.from_numpy(self.values(array(x), False)[0])

    def best(self, x: Array) -> NDArray[np.int64]:
        """Return which output is the largest (S, B), the first of equal ones."""
        values, _ = self.values(x, False)
        places = np.empty(values.shape[:2], np.int64)
        networks.largest(values, places)
        return places

    def chosen(self, x: Array, places: NDArray[np.int64]) -> Array:
        """Return one output of each sample (S, B)."""
        values, _ = self.values(x, False)
        found = np.empty(values.shape[:2], np.float32)
        if places.shape != found.shape or not networks.chosen(values, places, found):
            raise unchosen(places, values)
        return found

    def chosen_errors(self, x: Array, places: NDArray[np.int64], aims: Array, weight: float = 1.0) -> Array:
        """Return one output of each sample minus its aim (S, B); set the gradients of their mean squares' sum."""
        values, records = self.values(x, True)
        errors, cotangents = np.empty(values.shape[:2], np.float32), np.empty_like(values)
        share = np.float32(weight) / np.float32(values.shape[1])
        fits = places.shape == aims.shape == errors.shape
        if not fits or not networks.chosen_errors(values, places, aims, share, errors, cotangents):
            raise unchosen(places, values)
        self.set_gradients(records, cotangents)
        return errors

    def set_gradients(self, records: Any, cotangents: Array) -> None:
        """Write the gradients of cotangents (S, B, out) to `grad` of trained parameters, in memory used again."""
        self.pull(records, cotangents, self.own_gradients(), None)
        self.show_gradients()

    def own_gradients(self) -> Array:
        """Return memory for gradients, always the same."""
        if self.kept_gradients is None:
            self.kept_gradients = np.empty_like(self.parameters)
            self._kept_parts = self.parts(self.kept_gradients)
        return self.kept_gradients

    def show_gradients(self) -> None:
        """Let `grad` of the trained parameters be their arrays in `own_gradients`."""
        for tensor, part in zip(self.tensors, self._kept_parts):
            tensor.grad = part if tensor.requires_grad else None

    def add_gradients(self, records: Any, cotangents: Array) -> None:
        """Like `set_gradients`, but add to gradients that are there, as autograd does."""
        trained = [(each, part) for each, part in zip(self.tensors, self._kept_parts) if each.requires_grad]
        if self.kept_gradients is None or any(each.grad is not part for each, part in trained):
            self.set_gradients(records, cotangents)
        else:
            more = np.empty_like(self.parameters)
            self.pull(records, cotangents, more, None)
            self.kept_gradients += more

    def gradients_of(self, parameters: Sequence[Tensor]) -> Array | None:
        """Return all parameters' gradients, if the arguments are these parameters with gradients of `set_gradients`."""
        if len(parameters) != len(self._kept_parts):
            return None
        same = zip(parameters, self.tensors, self._kept_parts)
        return self.kept_gradients if all(p is own and p.grad is part for p, own, part in same) else None

    def parts(self, gradients: Array) -> list[Tensor]:
        """Return the gradients of each parameter, in their order."""
        parts = torch.from_numpy(gradients).split([shape.numel() for shape in self.shapes])
        return [part.view(shape) for part, shape in zip(parts, self.shapes)]


class LayersSweep(Sweep):
    """The layers of S networks.

    Parameters
    ----------
    weights, biases:
        Of every layer (S, out, in) and (S, out), float32 on the CPU; one block has a layer's bias behind its weights.
    activation:
        "none", "relu" or "sin", after every layer but the last.
    scale:
        Factor of all inputs, or of each network's (S, 1, 1).
    """

    def __init__(
        self,
        weights: Sequence[Tensor],
        biases: Sequence[Tensor],
        activation: str,
        scale: float | Tensor = 1.0,
    ) -> None:
        self.scale = None if isinstance(scale, float) and scale == 1.0 else np.asarray(scale, np.float32)
        self.sizes = _sizes(weights, biases)
        super().__init__([each for pair in zip(weights, biases) for each in pair], int(self.sizes[0]))
        self.activation = activation
        self.code, self.rows, self.shapes_of_work = _plan(tuple(self.sizes.tolist()), activation)

    def values(self, x: Array, keep: bool) -> tuple[Array, Records]:
        """Return outputs and records, see `Sweep`."""
        if x.ndim != 3 or x.shape[0] != self.seeds or x.shape[2] != self.inputs:
            raise _misfit(x.shape, self.shapes)
        if self.scale is not None:
            x = x * self.scale
        chunks = self.seeds * -(-x.shape[1] // WIDE) if keep else 1
        records = Records("records", chunks, self.rows, WIDE)
        out = np.empty((*x.shape[:2], self.shapes[-1][1]), np.float32)
        networks.forward(x, self.parameters, self.sizes, self.code, records.array, keep, out)
        return out, records

    def pull(self, records: Records, cotangents: Array, gradients: Array, x_gradient: Array | None) -> None:
        """Write gradients, see `Sweep`."""
        self._pull(records, cotangents, gradients, x_gradient)

    def pull_x(self, records: Records, cotangents: Array) -> Array:
        """Return the gradient of x alone, without gradients of parameters."""
        x_gradient = np.empty((*cotangents.shape[:2], self.inputs), np.float32)
        self._pull(records, cotangents, None, x_gradient)
        return x_gradient

    def _pull(
        self, records: Records, cotangents: Array, gradients: Array | None, x_gradient: Array | None
    ) -> None:
        pair, turned, sums = (Records(*shape) for shape in self.shapes_of_work)
        networks.backward(
            cotangents, self.parameters, self.sizes, self.code, records.array, pair.array, turned.array.reshape(-1),
            sums.array.reshape(-1), _NOTHING if gradients is None else gradients, gradients is not None,
            _NOWHERE if x_gradient is None else x_gradient, x_gradient is not None,
        )  # fmt: skip
        if x_gradient is not None and self.scale is not None:
            x_gradient *= self.scale


def array(tensor: Tensor) -> Array:
    """Return a tensor on the CPU as a contiguous array."""
    found: Array = tensor.detach().contiguous().numpy()
    return found


def block_of(tensors: Sequence[Tensor]) -> Array | None:
    """Return the numbers of contiguous float32 tensors that lie one behind the other in one memory; None of others."""
    first, place, numbers = tensors[0].data_ptr(), tensors[0].data_ptr(), 0
    for each in tensors:
        if each.data_ptr() != place or each.dtype != torch.float32 or not each.is_contiguous():
            return None
        numbers += each.numel()
        place = first + 4 * numbers
    storage = tensors[0].untyped_storage()
    if place > storage.data_ptr() + storage.nbytes():
        return None
    found: Array = tensors[0].detach().as_strided((numbers,), (1,)).numpy()
    return found


@torch.no_grad()
def in_one_block(parameters: Sequence[Tensor]) -> None:
    """Let float32 parameters on the CPU lie one behind the other in one memory; their values stay."""
    if block_of(parameters) is not None:
        return
    block = torch.from_numpy(joined(parameters))
    for parameter, part in zip(parameters, block.split([each.numel() for each in parameters])):
        parameter.data = part.view(parameter.shape)


def joined(tensors: Sequence[Tensor]) -> Array:
    """Return the numbers of float32 tensors one behind the other: where they lie, if they do so, else in a copy."""
    block = block_of(tensors)
    return np.concatenate([array(each).reshape(-1) for each in tensors]) if block is None else block


@functools.lru_cache(256)
def _plan(sizes: tuple[int, ...], activation: str) -> tuple[int, int, list[tuple[str, int, int, int]]]:
    """Return the activation's code, the rows of a record, and the shapes of a backward pass's working memory."""
    code = {"none": networks.NOTHING, "relu": networks.RELU, "sin": networks.SINE}[activation]
    vector = vectors.lanes(np.float32)
    widest = -(-max(sizes) // vector) * vector
    sums = sum(min(pair) * -(-max(pair) // vector) for pair in itertools.pairwise(sizes))
    shapes = [("pair", 2, widest, 2 * vector), ("turned", 1, 2 * vector, widest), ("sums", 1, sums, vector)]
    return code, networks.record_rows(sizes, code, vector), shapes


def _sizes(weights: Sequence[Tensor], biases: Sequence[Tensor]) -> NDArray[np.int64]:
    """Return inputs and outputs of the layers."""
    shapes = [each.shape for pair in zip(weights, biases) for each in pair]
    fits = len(weights) == len(biases) > 0 and all(len(shape) == 3 for shape in shapes[::2])
    sizes = [shapes[0][-1], *(shape[1] for shape in shapes[::2])] if fits else []
    for weight, bias, i, o in zip(shapes[::2], shapes[1::2], sizes, sizes[1:]):
        fits = fits and weight == (shapes[0][0], o, i) and bias == (shapes[0][0], o)
    if not fits:
        raise _misfit(None, [each.shape for each in (*weights, *biases)])
    return np.array(sizes)


def _misfit(x: Sequence[int] | None, shapes: Sequence[Sequence[int]]) -> ValueError:
    seen = "" if x is None else f"x is {tuple(x)}, "
    return ValueError(
        f"layers of S seeds take x (S, B, in), weights (S, out, in) and biases (S, out); {seen}weights and biases are "
        f"{', '.join(str(tuple(shape)) for shape in shapes)}"
    )


def unchosen(places: NDArray[np.int64], values: Array) -> ValueError:
    """Return the error of choices (S, B) that are no outputs (S, B, out)."""
    return ValueError(
        f"choose one of {values.shape[2]} outputs of each sample, of shape {values.shape[:2]}: the choice has the "
        f"shape {places.shape} and goes from {places.min(initial=0)} to {places.max(initial=0)}"
    )


class Records:
    """Memory (n, rows, wide) of a pass, such as a chunk's values in every layer; it then serves another pass."""

    def __init__(self, purpose: str, number: int, rows: int, wide: int) -> None:
        self.spare = _spare.setdefault((purpose, rows, wide), [])
        room = self.spare.pop() if self.spare else None
        if room is None or len(room) < number:
            room = vectors.aligned((number, rows, wide), np.float32)
        self.array = room

    def __del__(
        self, most: int = SPARE_BYTES
    ) -> None:  # names of the module may be gone when the interpreter ends
        if self.array.nbytes <= most:
            self.spare.append(self.array)


class _Swept(torch.autograd.Function):
    """Outputs of a sweep, with the gradients of inputs and parameters."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, sweep: Sweep, *parameters: Tensor) -> Tensor:
        values, ctx.records = sweep.values(array(x), True)
        ctx.sweep = sweep
        ctx.save_for_backward(*parameters)
        return torch.from_numpy(values)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "compiled passes of a network are differentiated once: leave out create_graph=True, or compute in "
                "float64, which torch differentiates any number of times"
            )
        _ = ctx.saved_tensors  # refuses those that changed since
        sweep, cotangent = ctx.sweep, array(cotangents[0])
        x_gradient = None
        if not any(ctx.needs_input_grad[2:]):
            return (
                torch.from_numpy(sweep.pull_x(ctx.records, cotangent)),
                None,
                *[None for _ in sweep.tensors],
            )
        if ctx.needs_input_grad[0]:
            x_gradient = np.empty((*cotangent.shape[:2], sweep.inputs), np.float32)
        gradients = np.empty_like(sweep.parameters)
        sweep.pull(ctx.records, cotangent, gradients, x_gradient)
        return None if x_gradient is None else torch.from_numpy(x_gradient), None, *sweep.parts(gradients)
