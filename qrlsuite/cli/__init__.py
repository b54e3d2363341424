"""The command line: one file per command, everything heavy imported inside them."""

from __future__ import annotations

import atexit
import gc
import io
import itertools
import os
import signal
import sys
import warnings
from typing import Any

from typer import Abort, BadParameter

from qrlsuite import registry
from qrlsuite.cli.app import build, split_plugins
from qrlsuite.engine.terminal import printable, printable_lines
from qrlsuite.errors import PluginError, QrlSuiteError
from qrlsuite.registry import STRICT, PluginWarning
from qrlsuite.training.interrupts import end_children_by_sigterm


def main() -> None:
    """Run `qrlsuite`; exits with 0 (done), 2 (wrong input) or 130 (interrupted, everything saved)."""
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: save, and say so
        end_children_by_sigterm()
    # imports make a million objects that stay: to look for garbage among them takes a third of a short command's time
    gc.set_threshold(20_000, 20, 20)
    atexit.register(gc.freeze)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that cannot show a character shows another
    UsageError: Any = BadParameter.__base__  # click's, or Typer's own copy of it
    options = itertools.takewhile(lambda word: word.startswith("-"), sys.argv[1:])
    if "--strict" in options:
        os.environ[STRICT] = "1"  # workers inherit it
    with warnings.catch_warnings():
        original = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            if issubclass(category, PluginWarning):
                print(f"qrlsuite: warning: {printable(message)}", file=sys.stderr)
            else:
                original(message, category, *rest, **more)

        warnings.simplefilter("always", PluginWarning)
        warnings.showwarning = show
        try:
            words, paths = split_plugins(sys.argv[1:])
            registry.load().announce = lambda line: print(printable(line), file=sys.stderr)
            _load_plugins(paths)
            sys.exit(build()(words, prog_name="qrlsuite", standalone_mode=False))
        except UsageError as error:
            if error.ctx is None or type(error).__name__ == "NoArgsIsHelpError":
                error.show()
            else:
                message = printable(error.format_message()).removesuffix(".").replace("Value error, ", "")
                print(f"qrlsuite: {message}; see `{error.ctx.command_path} --help`", file=sys.stderr)
            sys.exit(2)
        except KeyboardInterrupt:  # before the command began
            sys.exit(130)
        except Abort:
            sys.exit("Aborted!")
        except QrlSuiteError as error:
            shown = printable if isinstance(error, PluginError) else printable_lines
            print(f"qrlsuite: {shown(error)}", file=sys.stderr)
            sys.exit(2)
        except BrokenPipeError:
            sys.stderr.close()  # the reader (head, less) has gone
            sys.exit(0)


def _load_plugins(paths: list[str]) -> None:
    if not paths:
        return
    from qrlsuite.results import codes

    for path in paths:
        codes.load_plugins(path)
