"""Finds the size option at which a model has as many parameters as another entry's."""

from __future__ import annotations

import functools
from collections.abc import Callable

from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry

LARGEST_SIZE = 4096


def parameters(entry: Entry) -> int:
    """Return the number of parameters of an entry's first network, classical and quantum together."""
    from qrlsuite.training.trainer import count_parameters  # torch is slow to import

    return sum(count_parameters(entry))


def nearest_size(make: Callable[[int], Entry], target: Entry) -> int:
    """Return the size at which an entry has as many parameters as a target, or as nearly as can be.

    Parameters
    ----------
    make:
        Builds the entry of a size 1, 2, ...; its parameter count grows with the size.
    target:
        The entry to be matched. Where two sizes are equally near, the smaller is taken.
    """
    target_size = parameters(target)
    size_of = functools.cache(lambda size: parameters(make(size)))
    low, high = 1, 1
    while size_of(high) < target_size:
        low, high = high, 2 * high
        if high > LARGEST_SIZE:
            raise OptionError(
                f"no size up to {LARGEST_SIZE} has the {target_size} parameters of {target.label}"
            )
    while low < high:
        middle = (low + high) // 2
        if size_of(middle) < target_size:
            low = middle + 1
        else:
            high = middle
    return min((size for size in (low - 1, low) if size >= 1), key=lambda s: abs(size_of(s) - target_size))
