"""Honest and fast benchmarks of quantum and classical reinforcement learning.

Importing this package is cheap: torch, PennyLane and Qiskit are imported only by what needs them.
"""

__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    if name == "hookimpl":
        from qrlsuite.hookspecs import hookimpl

        return hookimpl
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
