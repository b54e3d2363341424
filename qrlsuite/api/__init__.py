"""The suite from Python: the functions behind the commands; each returns its results as an object.

    from qrlsuite import api

    small = api.train("beam6g", "mlp", options={"width": 16}, seeds=8, epochs=10)
    large = api.load("mlp width=64", task="beam6g", published=True)
    api.compare(large, small)
    api.board("beam6g", published=True)
    api.board("beam6g", by="executions", published=True)
    api.plot("curves", entries=[small, large])
    api.evaluate("mlp width=16", best=4)
    api.diagnose("mlp width=16")
    api.diagnose_ansatz("iqp", qubits="4:12")
    api.play("mlp width=16").save("episode.gif")
    api.agent("mlp width=16").act(observations)
    api.run_study("width.toml")
    api.power("mlp width=16")

Results are shown as tables: printed, at a Python prompt, and in a notebook, which shows figures, too. Errors are
from `qrlsuite.errors`; if a message names an option of a command, such as `--task`, the function's argument has that
name.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qrlsuite.api.diagnosis import diagnose, diagnose_ansatz
    from qrlsuite.api.entries import board, compare, load, plot
    from qrlsuite.api.external import import_curves
    from qrlsuite.api.needs import power
    from qrlsuite.api.own import register
    from qrlsuite.api.playing import agent, play
    from qrlsuite.api.studies import new_study, read_study, run_study
    from qrlsuite.api.tables import table
    from qrlsuite.api.training import evaluate, train, tune

__all__ = [
    "agent", "board", "compare", "diagnose", "diagnose_ansatz", "evaluate", "import_curves", "load", "new_study",
    "play", "plot", "power", "read_study", "register", "run_study", "table", "train", "tune",
]  # fmt: skip

_MODULES = {
    "diagnosis": ("diagnose", "diagnose_ansatz"),
    "entries": ("board", "compare", "load", "plot"),
    "external": ("import_curves",),
    "needs": ("power",),
    "own": ("register",),
    "playing": ("agent", "play"),
    "studies": ("new_study", "read_study", "run_study"),
    "tables": ("table",),
    "training": ("evaluate", "train", "tune"),
}
"""Where the functions are; a module is imported when the first of its functions is asked for."""

if "IPython" in sys.modules:
    from qrlsuite.engine.terminal import show_figures_in_notebook

    show_figures_in_notebook()


def __getattr__(name: str) -> Any:
    for module, functions in _MODULES.items():
        if name in functions:
            found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{module}"), name)
            return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
