"""Findings of a conformance check: one per rule."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass

from qrlsuite.errors import QrlSuiteError

SIZES: tuple[tuple[int, ...], ...] = ((0,), (3,), (1, 2), (4, 1, 3), (3, 0, 4, 2, 1))
"""Groups in which an agent of 0..4 is compared with itself among all five: alone, in pairs, shuffled."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one rule.

    Attributes
    ----------
    ok:
        Whether it holds.
    message:
        The tested facts if the rule holds; else the fault, and its likely cause.
    """

    rule: str
    ok: bool
    message: str


class BrokenRuleError(Exception):
    """A rule does not hold; the message names the fault and its likely cause."""


def require(holds: bool, message: str) -> None:
    """Raise `BrokenRuleError(message)` unless a condition holds."""
    if not holds:
        raise BrokenRuleError(message)


_watcher: ContextVar[Callable[[str | Finding], None]] = ContextVar("_watcher", default=lambda seen: None)


@contextlib.contextmanager
def watching(call: Callable[[str | Finding], None]) -> Iterator[None]:
    """Let `call` be called with the name of every rule before its check, and with its finding afterwards."""
    token = _watcher.set(call)
    try:
        yield
    finally:
        _watcher.reset(token)


class Checklist:
    """Runs rules one by one; a rule that raises becomes a finding.

    Attributes
    ----------
    findings:
        One per rule, in order.
    """

    def __init__(self) -> None:
        self.findings: list[Finding] = []

    def run(self, rule: str, looked_at: str, check: Callable[[], object], cause: str = "") -> bool:
        """Check one rule; returns whether it holds.

        Parameters
        ----------
        looked_at:
            What a passing check has established.
        check:
            Raises `BrokenRuleError` or an error of the suite where the rule is broken. Any other exception breaks it
            too. A returned text is what else it has established.
        cause:
            The likely cause of another exception.
        """
        _watcher.get()(rule)
        try:
            more = check()
        except (BrokenRuleError, QrlSuiteError) as error:  # these say the place and the remedy
            self.findings.append(Finding(rule, False, str(error)))
        except Exception as error:  # whatever a stranger's code raises is the stranger's to read
            hint = f"; {cause}" if cause else ""
            self.findings.append(Finding(rule, False, f"{type(error).__name__}: {error}{hint}"))
        else:
            self.findings.append(
                Finding(rule, True, f"{looked_at}; {more}" if isinstance(more, str) else looked_at)
            )
        _watcher.get()(self.findings[-1])
        return self.findings[-1].ok


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread, as runs do: sums are otherwise cut into parts that depend on the machine."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
