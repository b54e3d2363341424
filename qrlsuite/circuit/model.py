"""The attributes of a network with a circuit, beside the ones of `torch.nn.Module`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from qrlsuite.circuit.description import Circuit
from qrlsuite.circuit.executions import ExecutionCounter

if TYPE_CHECKING:
    import torch


@runtime_checkable
class CircuitModel(Protocol):
    """Attributes of a model with a circuit, which `build` and `population` return, beside `torch.nn.Module`'s.

    The suite recognizes such a network by these attributes: it counts executions, prepares the circuit before the first
    epoch, evaluates the agents on other backends and diagnoses them. A network that has `executions` must
    have the others, too.

    If its `draws` is true, outputs or gradients are random, and `qrlsuite check` does not compare two passes.
    """

    @property
    def executions(self) -> ExecutionCounter:
        """Counts each agent's executions so far; deep copies share it."""
        ...

    @property
    def description(self) -> Circuit:
        """The circuit, without values of its parameters."""
        ...

    @property
    def simulator(self) -> bool:
        """Whether circuits are only simulated; else executions may cost money."""
        ...

    def compile_circuits(self) -> None:
        """Compile the code of the first pass, if there is any to compile; executes nothing on a device."""
        ...

    def circuit_states(self, x: torch.Tensor) -> torch.Tensor:
        """Return the circuit's final states (S, B, 2^n) for observations (S, B, in); qubit 0 is the highest bit."""
        ...
