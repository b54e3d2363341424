"""Honest and fast benchmarks of quantum and classical reinforcement learning.

Importing this package is cheap: torch, PennyLane and Qiskit are imported only when they are needed. Once
this package and Gymnasium are both imported, in either order, `gymnasium.make` knows every environment of the suite
and its plugins.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

    from qrlsuite import api as api
    from qrlsuite.api import agent as agent
    from qrlsuite.api import board as board
    from qrlsuite.api import compare as compare
    from qrlsuite.api import diagnose as diagnose
    from qrlsuite.api import diagnose_ansatz as diagnose_ansatz
    from qrlsuite.api import evaluate as evaluate
    from qrlsuite.api import import_curves as import_curves
    from qrlsuite.api import load as load
    from qrlsuite.api import new_study as new_study
    from qrlsuite.api import play as play
    from qrlsuite.api import plot as plot
    from qrlsuite.api import power as power
    from qrlsuite.api import read_study as read_study
    from qrlsuite.api import register as register
    from qrlsuite.api import run_study as run_study
    from qrlsuite.api import table as table
    from qrlsuite.api import train as train
    from qrlsuite.api import tune as tune
    from qrlsuite.circuit import Circuit as Circuit
    from qrlsuite.circuit.layer import layer as layer
    from qrlsuite.hookspecs import hookimpl as hookimpl
    from qrlsuite.registry import Registry

__version__ = "0.2.0"

__all__ = [
    "Circuit", "__version__", "agent", "api", "board", "compare", "diagnose", "diagnose_ansatz", "evaluate", "hookimpl",
    "import_curves", "layer", "load", "new_study", "play", "plot", "power", "read_study", "register",
    "register_environments", "run_study", "table", "train", "tune",
]  # fmt: skip

_FROM_API = frozenset(__all__) - {
    "Circuit",
    "__version__",
    "api",
    "hookimpl",
    "layer",
    "register_environments",
}
"""Functions of `qrlsuite.api` that are attributes here too: no submodule may have one of these names."""

# Python started in a checkout finds this folder before an installed package, and without the folders that an
# installation maps below it (`qrlsuite.plugins` and others); there they lie beside it.
_CHECKOUT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
if all(
    os.path.isfile(os.path.join(_CHECKOUT, *path))
    for path in (("pyproject.toml",), ("plugins", "__init__.py"))
):
    __path__.append(_CHECKOUT)


def __getattr__(name: str) -> object:
    if name == "hookimpl":
        from qrlsuite.hookspecs import hookimpl

        return hookimpl
    if name == "Circuit":
        from qrlsuite.circuit import Circuit

        return Circuit
    if name == "layer":
        from qrlsuite.circuit.layer import layer

        return layer
    if name == "register":
        from qrlsuite import own

        if own.is_loading():  # by a plugin's file, for which the api is long to import
            return own.note
    if name == "api" or name in _FROM_API:
        import importlib

        module = importlib.import_module("qrlsuite.api")
        return module if name == "api" else getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)


def register_environments() -> None:
    """Make every registered environment known to `gymnasium.make` under its Gymnasium id; again does nothing."""
    from qrlsuite import registry

    if not registry.is_loading():  # by a plugin that imports Gymnasium: `registry.load` registers at its end
        _register(registry.load())


def _register(known: Registry) -> None:
    import gymnasium

    from qrlsuite import specs

    for registered in known.of(specs.EnvironmentSpec).values():
        spec = registered.spec
        if spec.entry_point is not None and spec.gymnasium_id not in gymnasium.registry:
            gymnasium.register(spec.gymnasium_id, entry_point=spec.entry_point)


class _AfterGymnasium:
    """Finder that waits for the import of Gymnasium, registers the environments after it, and removes itself."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return Gymnasium's own spec with a loader that registers the environments too, None for any other module."""
        if name != "gymnasium":
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)
        spec = find_spec(name)  # of the finders that are left
        if spec is None or spec.loader is None:
            sys.meta_path.insert(0, self)  # it may be installed later
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            register_environments()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


if "gymnasium" in sys.modules:
    register_environments()
else:
    sys.meta_path.insert(0, _AfterGymnasium())
