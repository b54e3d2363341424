"""Circuits written once, run on every backend: `ansatz`, `expectations`, and the parts of circuits.

Importing this package imports numpy and nothing heavier; registry, torch and simulators load when called.
"""

from __future__ import annotations

from qrlsuite.circuit.api import CircuitBackend, ansatz, create_backend, expectations, options_on
from qrlsuite.circuit.description import GATES, Angle, Circuit, Element, Operation, Parameter
from qrlsuite.circuit.executions import ExecutionCounter
from qrlsuite.circuit.model import CircuitModel

__all__ = [
    "GATES",
    "Angle",
    "Circuit",
    "CircuitBackend",
    "CircuitModel",
    "Element",
    "ExecutionCounter",
    "Operation",
    "Parameter",
    "ansatz",
    "create_backend",
    "expectations",
    "options_on",
]
