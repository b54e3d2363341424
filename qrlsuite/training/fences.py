"""The global random generators (`random`, numpy's, torch's): no call into a plugin may depend on them or move them.

All seeds of a process share them, so a seed that draws from one gives another result in other company. Models are built
with their own states of them (`seeded`); every other call is refused where it moves one (`Fence`).
"""

from __future__ import annotations

import contextlib
import random
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from qrlsuite.errors import PluginError
from qrlsuite.results.claims import HEARTBEAT_THREAD

FINE_CALLS = 50
"""Calls of each kind that are watched one by one; later ones by the whole epoch, which costs nothing."""

_GENERATORS = ("Python's `random`", "numpy's `np.random`", "torch's default generator")


def _states() -> tuple[Any, Any, torch.Tensor]:
    return random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002


def _moved(before: tuple[Any, Any, torch.Tensor], others_draw: bool) -> list[str]:
    """Return the generators that are not in the state that `_states` returned.

    Parameters
    ----------
    others_draw:
        Whether other threads may draw from Python's and numpy's meanwhile.
    """
    after = _states()
    same = (
        others_draw or before[0] == after[0],
        others_draw or (before[1][2:] == after[1][2:] and bool(np.array_equal(before[1][1], after[1][1]))),
        torch.equal(before[2], after[2]),
    )
    return [name for name, equal in zip(_GENERATORS, same) if not equal]


def _other_threads() -> bool:
    """Return whether other threads than the suite's run, such as a tracker's."""
    main = threading.main_thread()
    return any(thread is not main and thread.name != HEARTBEAT_THREAD for thread in threading.enumerate())


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Give the global generators states that follow from a seed, and afterwards the states that they had."""
    kept = _states()
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    torch.default_generator.manual_seed(seed % 2**63)
    try:
        yield
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002
        torch.set_rng_state(kept[2])


_OPEN: contextlib.AbstractContextManager[None] = contextlib.nullcontext()


class Fence:
    """Refuses calls into plugins that move a global generator; built-in things are not watched.

    Attributes
    ----------
    closed:
        Whether calls are watched.
    alone:
        Whether no other thread is thought to draw meanwhile; None looks which threads there are.
    """

    def __init__(self, closed: bool, alone: bool | None = None) -> None:
        self.closed, self.alone = closed, alone
        self._calls: Counter[str] = Counter()

    def around(self, call: str, fine: bool = True) -> contextlib.AbstractContextManager[None]:
        """Watch a call.

        Parameters
        ----------
        call:
            Name of the call, for the message: `model 'waves', forward`.
        fine:
            Whether it is one of many calls; only the first of them are watched.
        """
        if not self.closed:
            return _OPEN
        self._calls[call] += 1
        return _OPEN if fine and self._calls[call] > FINE_CALLS else self._watched(call)

    @contextlib.contextmanager
    def _watched(self, call: str) -> Iterator[None]:
        before = _states()
        yield
        if moved := _moved(before, _other_threads() if self.alone is None else not self.alone):
            raise PluginError(
                f"{call}: it moved {' and '.join(moved)}, which all seeds of a process share, so that no seed would be "
                "what it is alone; draw from the generator or the streams that are handed to the plugin; leave out "
                "layers that draw, such as Dropout"
            )

    def watch(self, module: torch.nn.Module, call: str) -> None:
        """Watch the passes of a module, and of its copies."""
        if not self.closed:
            return
        begin, end = self._hooks(call)
        module.register_forward_pre_hook(begin)
        module.register_forward_hook(end)

    def _hooks(self, call: str) -> tuple[Callable[..., None], Callable[..., None]]:
        """Return the hooks before and after a pass; plain functions, since a deep copy would copy a method's object."""
        entered: list[contextlib.AbstractContextManager[None]] = []

        def begin(module: torch.nn.Module, inputs: Any) -> None:
            entered.append(self.around(call))
            entered[-1].__enter__()

        def end(module: torch.nn.Module, inputs: Any, outputs: Any) -> None:
            entered.pop().__exit__(None, None, None)

        return begin, end
