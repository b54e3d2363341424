"""The command line: one file per command, everything heavy imported inside them."""

from __future__ import annotations

import sys
import warnings

from qrlsuite.errors import QrlSuiteError


def main() -> None:
    """Run `qrlsuite`; exits with 0 (done), 2 (wrong input) or 130 (interrupted, everything saved)."""
    from qrlsuite.cli.app import build
    from qrlsuite.registry import PluginWarning

    def one_line(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        print(f"qrlsuite: warning: {message}", file=sys.stderr)

    warnings.simplefilter("always", PluginWarning)
    original = warnings.showwarning
    warnings.showwarning = lambda message, category, *rest, **more: (
        one_line(message, category)
        if issubclass(category, PluginWarning)
        else original(message, category, *rest, **more)
    )
    try:
        build()()
    except QrlSuiteError as error:
        print(f"qrlsuite: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        sys.stderr.close()  # the reader (head, less) has gone
        sys.exit(0)
