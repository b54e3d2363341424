"""What the tests of broken tasks and studies share: a good file, and the edit that breaks it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Edit:
    """A file that breaks a rule: a good one with `old` replaced by `new`, and what is said about it."""

    rule: str
    old: str
    new: str
    message: str

    def of(self, good: str) -> str:
        """Return the broken file."""
        assert self.old in good
        return good.replace(self.old, self.new, 1)
