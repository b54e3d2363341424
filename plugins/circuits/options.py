"""Options of the circuit backends, apart from the backends so that reading them imports no simulator."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

DiffMethod = Literal["auto", "backprop", "adjoint", "parameter-shift"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PennyLaneOptions:
    """Options of the PennyLane backend."""

    device: Annotated[
        str,
        Field(min_length=1, description="PennyLane device: default.qubit, lightning.qubit, or a plugin's"),
    ] = "default.qubit"
    diff_method: Annotated[
        DiffMethod,
        Field(description="auto: backprop on default.qubit, adjoint on lightning.*, else parameter-shift"),
    ] = "auto"
    shots: Annotated[
        int | None, Field(ge=1, description="repetitions per expectation value; absent: exact")
    ] = None


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class QiskitOptions:
    """Options of the Qiskit backend."""

    estimator: Annotated[
        Literal["statevector", "aer"],
        Field(description="V2 primitive: statevector (exact), or aer (needs an extra)"),
    ] = "statevector"
    gradient: Annotated[
        Literal["auto", "reverse", "parameter-shift", "lin-comb", "spsa"],
        Field(
            description="auto: where exact, reverse if qiskit-algorithms is installed, else lin-comb (linear "
            "combination of unitaries); with shots or aer, parameter-shift"
        ),
    ] = "auto"
    shots: Annotated[
        int | None, Field(ge=1, description="repetitions per expectation value; absent: exact")
    ] = None
    noise_model: Annotated[
        str | None,
        Field(description="with aer: depolarizing, or a fake backend such as FakeManilaV2; absent: none"),
    ] = None
    noise_rate: Annotated[
        float,
        Field(
            ge=0.0,
            le=1.0,
            description="depolarizing probability of a two-qubit gate; a tenth of it of one-qubit gates",
        ),
    ] = 0.01
