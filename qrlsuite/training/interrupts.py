"""Turns Ctrl-C and SIGTERM into KeyboardInterrupt, delayed while results are being written."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType, TracebackType
from typing import Any


class Interruptible:
    """While entered, SIGINT and SIGTERM raise KeyboardInterrupt, inside `deferred()` only at its end.

    Where other code swallows the exception, a finalizer or a compiled call, the end of the next `deferred()` raises it
    again.

    Outside the main thread, where signals cannot be handled, it changes nothing.
    """

    def __init__(self) -> None:
        self._deferring = 0
        self._pending = False
        self._old: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interruptible:
        if threading.current_thread() is threading.main_thread():
            end_children_by_sigterm()
            for number in (signal.SIGINT, signal.SIGTERM):
                self._old[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._pending = True
        if not self._deferring:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """Hold an interruption back until the block has been left."""
        self._deferring += 1
        try:
            yield
        finally:
            self._deferring -= 1
        if self._pending and not self._deferring:
            self._pending = False
            raise KeyboardInterrupt


@functools.cache
def end_children_by_sigterm() -> None:
    """Let forked children, such as those of a plugin's pool, end by SIGTERM as any process does, from now on."""
    os.register_at_fork(after_in_child=_end_by_sigterm)


def _end_by_sigterm() -> None:
    handler = signal.getsignal(signal.SIGTERM)
    ours = isinstance(getattr(handler, "__self__", None), Interruptible)
    if ours or handler is signal.default_int_handler:
        with contextlib.suppress(ValueError):  # forked by another thread: its handlers cannot be changed
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
