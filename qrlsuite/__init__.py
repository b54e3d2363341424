"""Honest and fast benchmarks of quantum and classical reinforcement learning.

Importing this package is cheap: torch, PennyLane and Qiskit are imported only by what needs them. Where
Gymnasium was imported before it, every environment of the suite and its plugins becomes known to
`gymnasium.make`; `register_environments()` does the same at any time.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from qrlsuite.hookspecs import hookimpl as hookimpl

__version__ = "0.1.0"

__all__ = ["__version__", "hookimpl", "register_environments"]

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
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def register_environments() -> None:
    """Make every registered environment known to `gymnasium.make` under its Gymnasium id; again does nothing."""
    import gymnasium

    from qrlsuite import registry, specs

    for registered in registry.load().entries["environments"].values():
        spec = registered.spec
        if not isinstance(spec, specs.EnvironmentSpec) or spec.entry_point is None:
            continue
        if spec.gymnasium_id not in gymnasium.registry:
            gymnasium.register(spec.gymnasium_id, entry_point=spec.entry_point)


if "gymnasium" in sys.modules:
    register_environments()
