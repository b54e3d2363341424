"""The suite's own circuit simulator: compiled kernels on the CPU, torch on a GPU."""

from __future__ import annotations

from qrlsuite.plugins.circuits.native.backend import NativeBackend
from qrlsuite.plugins.circuits.options import NativeOptions

__all__ = ["NativeBackend", "NativeOptions"]
