"""A circuit backend made of another: native's values, damped as by depolarizing noise."""

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from qrlsuite.circuit import create_backend


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    """Options of `damped`."""

    strength: Annotated[float, Field(ge=0, le=1, description="probability per two-qubit gate of losing a value")] = 0.0


class Damped:
    shots = None  # exact

    def __init__(self, circuit, options):
        pairs = sum(len(operation.qubits) == 2 for operation in circuit)
        self.factor = (1.0 - options.strength) ** pairs
        self.native = create_backend("native", circuit)

    def __call__(self, inputs, parameters, seeds=None):
        """Return (S, B, observables) for inputs (S, B, inputs) and parameters (S, ...)."""
        return self.factor * self.native(inputs, parameters, seeds)
