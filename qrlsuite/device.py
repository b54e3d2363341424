"""Rounds on a GPU, without host reads.

A *host read* is an operation whose result Python sees, such as `item()` or `if tensor:`. It waits until the GPU has
done all its work.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor


class LateChecks:
    """A block within which checks of numbers on a device are only noted there, and read once, at its end.

    One object serves all epochs of a training, since captured rounds write into its flags.
    """

    _open: ClassVar[LateChecks | None] = None

    def __init__(self) -> None:
        self._flags: dict[int, tuple[Tensor, Callable[[], Exception]]] = {}

    def __enter__(self) -> None:
        LateChecks._open = self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        LateChecks._open = None
        for flag, refusal in self._flags.values():
            right = kind is not None or bool(flag)
            flag.fill_(True)
            if not right:
                raise refusal()

    @classmethod
    def note(cls, owner: object, holds: Tensor, refusal: Callable[[], Exception]) -> bool:
        """Note whether a check of `owner` holds, a bool on a device; return False where no block is open."""
        if cls._open is None:
            return False
        flags = cls._open._flags
        if id(owner) not in flags:
            flags[id(owner)] = torch.ones_like(holds), refusal
        flags[id(owner)][0].logical_and_(holds)
        return True
