"""The errors a user can cause.

Everything raised on purpose derives from `QrlSuiteError`; the command line turns it into one clear line and
exit code 2. Anything else that escapes is a bug and keeps its traceback.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


class QrlSuiteError(Exception):
    """Invalid input; the message names the fault, its place, and a valid input."""


class UnknownNameError(QrlSuiteError):
    """No task, model, algorithm, ansatz, option or entry has that name."""


class FileError(QrlSuiteError):
    """A file (task, preset, study, grid) cannot be read, or is malformed; the message lists every problem."""


class OptionError(QrlSuiteError):
    """An option has an invalid value."""


class CircuitError(OptionError):
    """A circuit has an invalid gate, wire, angle or parameter."""


class PluginError(QrlSuiteError):
    """A plugin broke a rule of registration; the message names its distribution."""


class StoreError(QrlSuiteError):
    """A results folder or file cannot be read or written; nothing in it was changed."""


class EnvironmentFailure(QrlSuiteError):
    """An environment raised while it was being stepped; the message carries the environment's own."""


def listed(names: Sequence[str], most: int = 20) -> str:
    """Join words with commas; the first `most` of them, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `"; did you mean 'x'?"` for the closest known name, the first of several, else the list of known names.

    Parameters
    ----------
    known:
        Every name that would have been accepted.
    """
    names = sorted(set(known))
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    if close:
        best = difflib.SequenceMatcher(None, close[0], name).ratio()
        equal = [each for each in close if difflib.SequenceMatcher(None, each, name).ratio() == best]
        return f"; did you mean '{min(equal)}'?"
    return f"; known: {listed(names)}" if names else "; none is registered"
