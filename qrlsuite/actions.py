"""Actions in lanes: each in the shape and type of its space. Four kinds are taken.

| Kind | Space of Gymnasium | Actions of L lanes |
|---|---|---|
| `discrete` | `Discrete(n)` | (L,) int64, 0 .. n - 1 |
| `multi-discrete` | `MultiDiscrete(nvec)` | (L, *nvec.shape) int64, each 0 .. its number - 1 |
| `multi-binary` | `MultiBinary(n)` | (L, n) int8, 0 or 1 |
| `box` | `Box(low, high)` of floats, with finite bounds | (L, *shape), of the box's type and within its bounds |

Whole numbers count from 0, even if the environment's do not. An algorithm's kinds of actions are in its spec
(`qrlsuite.specs.AlgorithmSpec.actions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import InvalidAction
from numpy.typing import NDArray

from qrlsuite.errors import OptionError

KINDS: dict[str, type[spaces.Space[Any]]] = {
    "discrete": spaces.Discrete,
    "multi-discrete": spaces.MultiDiscrete,
    "multi-binary": spaces.MultiBinary,
    "box": spaces.Box,
}
UNBOUNDED = 1e30
"""Bounds from here on are none."""


def kind(space: spaces.Space[Any]) -> str:
    """Return the kind of an action space: a key of `KINDS`.

    Raises
    ------
    qrlsuite.errors.OptionError
        If it is none of these, a box of whole numbers, or a box without bounds; without the name of the environment.
    """
    found = next((name for name, cls in KINDS.items() if isinstance(space, cls)), None)
    if found is None or (isinstance(space, spaces.Box) and space.dtype.kind != "f"):
        raise OptionError(
            f"the action space {space} is not supported: use Discrete, MultiDiscrete, MultiBinary or a Box of floats"
        )
    if isinstance(space, spaces.Box) and max(np.abs(space.low).max(), np.abs(space.high).max()) >= UNBOUNDED:
        raise OptionError(
            f"the action space {space} has no bounds: state finite ones, gymnasium.spaces.Box(-1.0, 1.0, "
            f"{space.shape}), or wrap the environment with gymnasium.wrappers.TransformAction"
        )
    return found


def from_zero(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return the space of an environment's actions as lanes have it: whole numbers count from 0."""
    if isinstance(space, spaces.Discrete):
        return spaces.Discrete(int(space.n))
    if isinstance(space, spaces.MultiDiscrete):
        return spaces.MultiDiscrete(space.nvec)
    return space


def check_actions(actions: NDArray[Any], lanes: int, space: spaces.Space[Any] | int) -> None:
    """Check actions of `lanes` lanes in a space that `from_zero` returned.

    Parameters
    ----------
    space:
        The space, or the number of choices of a discrete one.

    Raises
    ------
    gymnasium.error.InvalidAction
        If their shape, their type or a value is another one.
    """
    if isinstance(space, int):
        shape: tuple[int, ...] = (lanes,)
        low, high = np.int64(0), np.int64(space - 1)
    else:
        shape = (lanes, *(space.shape or ()))
        low, high = limits(space)
    floats = low.dtype.kind == "f"
    if actions.shape != shape or actions.dtype.kind not in ("f" if floats else "iu"):
        what = "numbers" if floats else "integers"
        form = "" if len(shape) == 1 else f" of shape {shape[1:]} each"
        raise InvalidAction(
            f"actions must be {lanes} {what}{form}, not {actions.dtype} of shape {actions.shape}"
        )
    wrong = ~((actions >= low) & (actions <= high))  # NaN is neither
    if wrong.any():
        first = np.argmax(wrong.reshape(-1))
        bounds = [np.broadcast_to(each, shape).reshape(-1)[first] for each in (low, high)]
        if floats:
            raise InvalidAction(
                f"actions must lie in {bounds[0]:g}..{bounds[1]:g}, not {actions.reshape(-1)[first]:g}: "
                "qrlsuite.actions.from_units maps any numbers into a box"
            )
        raise InvalidAction(
            f"actions must lie in {bounds[0]}..{bounds[1]}, not {actions.min()}..{actions.max()}"
        )


def limits(space: spaces.Space[Any]) -> tuple[Any, Any]:
    """Return the lowest and the highest action of a space that `from_zero` returned, arrays of its shape and type."""
    if isinstance(space, spaces.Discrete):
        return np.int64(0), np.int64(space.n - 1)
    if isinstance(space, spaces.MultiDiscrete):
        return np.zeros_like(space.nvec), space.nvec - 1
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, np.int8), np.ones(space.shape, np.int8)
    assert isinstance(space, spaces.Box)
    return space.low, space.high


def size(space: spaces.Space[Any]) -> int:
    """Return how many numbers an action has: 1 where it is a single one."""
    return int(np.prod(space.shape or (), dtype=np.int64))


def choices(space: spaces.Space[Any]) -> list[int]:
    """Return the number of choices for each number of an action; empty for a box."""
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, spaces.MultiDiscrete):
        return [int(n) for n in space.nvec.reshape(-1)]
    return [2] * size(space) if isinstance(space, spaces.MultiBinary) else []


def information_of_choices(logits: NDArray[np.float64], sizes: Sequence[int]) -> NDArray[np.float64]:
    """Return the Fisher information of independent softmaxes by their logits.

    For one softmax with probabilities p it is diag(p) - p p^T: the mean, over drawn choices, of the outer product of
    the gradient of log p.

    Parameters
    ----------
    logits:
        (..., outputs).
    sizes:
        How many choices each softmax has, as `choices` returns them; they sum to the outputs.

    Returns
    -------
    NDArray
        (..., outputs, outputs).
    """
    found = np.zeros((*logits.shape, logits.shape[-1]))
    start = 0
    for count in sizes:
        part = slice(start, start + count)
        p = np.exp(logits[..., part] - logits[..., part].max(axis=-1, keepdims=True))
        p /= p.sum(axis=-1, keepdims=True)
        found[..., part, part] = p[..., None] * (np.eye(count) - p[..., None, :])
        start += count
    return found


def from_units(units: NDArray[np.floating[Any]], space: spaces.Box) -> NDArray[Any]:
    """Map numbers in -1 .. 1 linearly to a box; numbers beyond are clipped, and NaN becomes the middle.

    A seed that diverged thus goes on acting, and the seeds that are trained with it do, too.

    Parameters
    ----------
    units:
        (..., numbers), as many as `size` says.

    Returns
    -------
    NDArray
        (..., *shape) of the box's type, within its bounds.
    """
    u = np.clip(np.nan_to_num(units.astype(np.float64), nan=0.0), -1.0, 1.0)
    u = u.reshape(*units.shape[:-1], *space.shape)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    inside = (low + high) / 2 + u * ((high - low) / 2)
    result: NDArray[Any] = np.clip(inside.astype(space.dtype), space.low, space.high)
    return result


def draw(space: spaces.Space[Any], generator: np.random.Generator, *shape: int) -> NDArray[Any]:
    """Draw uniform actions (*shape, ...) of a space that `from_zero` returned."""
    if isinstance(space, spaces.Discrete):
        return generator.integers(int(space.n), size=shape)
    low, high = limits(space)
    full = (*shape, *(space.shape or ()))
    if low.dtype.kind == "f":
        return from_units(generator.uniform(-1.0, 1.0, (*shape, size(space))), space)  # type: ignore[arg-type]
    return generator.integers(low, high, size=full, endpoint=True, dtype=low.dtype)
