"""Options of the circuit backends, apart from the backends so that reading them imports no simulator."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.options import Since

NOISE_FACTORS = (1, 3, 5)
"""How many times the noise is there where it is extrapolated to zero: circuits are folded."""

DiffMethod = Literal["auto", "backprop", "adjoint", "parameter-shift"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PennyLaneOptions:
    """Options of the PennyLane backend."""

    device: Annotated[
        str,
        Field(
            min_length=1,
            description="PennyLane device: default.qubit, qrlsuite.native (fast), lightning.qubit, a plugin's, or the "
            "ARN of one of Amazon Braket's",
        ),
    ] = "default.qubit"
    diff_method: Annotated[
        DiffMethod,
        Field(
            description="auto: backprop on default.qubit, adjoint on qrlsuite.native and lightning.*, else "
            "parameter-shift"
        ),
    ] = "auto"
    shots: Annotated[
        int | None, Field(ge=1, description="repetitions per expectation value; absent: exact")
    ] = None
    mitigation: Annotated[
        Literal["none", "zero-noise"],
        Field(description="zero-noise: every circuit with 1, 3 and 5 times the noise, extrapolated to none"),
        Since("0.2.0"),
    ] = "none"


NOISE_RATE = "depolarizing probability of a two-qubit gate; a tenth of it of one-qubit gates"
READOUT_ERROR = "probability that a measured bit is read wrongly, with noise_model = depolarizing"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NativeOptions:
    """Options of the native simulator: exact, unless shots or noise are asked for."""

    shots: Annotated[
        int | None,
        Field(ge=1, description="repetitions per expectation value; absent: exact"),
        Since("0.2.0"),
    ] = None
    gradient: Annotated[
        Literal["auto", "parameter-shift", "spsa"],
        Field(
            description="auto: without shots adjoint, with shots parameter-shift (every shifted circuit is sampled). "
            "spsa: a guess from two circuits"
        ),
        Since("0.2.0"),
    ] = "auto"
    noise_model: Annotated[
        Literal["depolarizing"] | None,
        Field(description="depolarizing: random Pauli errors after every gate; absent: none"),
        Since("0.2.0"),
    ] = None
    noise_rate: Annotated[float, Field(ge=0.0, le=1.0, description=NOISE_RATE), Since("0.2.0")] = 0.01
    readout_error: Annotated[float, Field(ge=0.0, le=0.5, description=READOUT_ERROR), Since("0.2.0")] = 0.0
    trajectories: Annotated[
        int,
        Field(
            ge=1,
            description="draws of all errors of a circuit over which noise is averaged; shots are shared among them",
        ),
        Since("0.2.0"),
    ] = 100


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class QiskitOptions:
    """Options of the Qiskit backend."""

    estimator: Annotated[
        Literal["statevector", "aer"],
        Field(
            description="V2 primitive of Aer: statevector (exact; with shots, Gaussian noise), or aer (with shots, bit "
            "strings; takes a noise model)"
        ),
    ] = "statevector"
    gradient: Annotated[
        Literal["auto", "adjoint", "reverse", "parameter-shift", "lin-comb", "spsa"],
        Field(
            description="auto: where exact, adjoint (the same function, differentiated by the native simulator); with "
            "shots or noise, parameter-shift. spsa: a guess from two circuits. lin-comb (linear combination of "
            "unitaries) is Qiskit's own: exact and slow. reverse: of results of earlier versions only"
        ),
    ] = "auto"
    shots: Annotated[
        int | None, Field(ge=1, description="repetitions per expectation value; absent: exact")
    ] = None
    noise_model: Annotated[
        str | None,
        Field(
            description="with aer: depolarizing, or the device whose noise is simulated: GenericBackendV2 (a chain of "
            "qubits), or a fake backend such as FakeManilaV2; absent: none"
        ),
    ] = None
    noise_rate: Annotated[float, Field(ge=0.0, le=1.0, description=NOISE_RATE)] = 0.01
    readout_error: Annotated[float, Field(ge=0.0, le=0.5, description=READOUT_ERROR), Since("0.2.0")] = 0.0
    device: Annotated[
        str | None,
        Field(
            min_length=1,
            description="IBM device that Qiskit Runtime executes circuits on, such as ibm_fez; a fake one, such as "
            "FakeManilaV2, is simulated. Absent: Aer",
        ),
        Since("0.2.0"),
    ] = None
    runtime: Annotated[
        Literal["batch", "session", "job"],
        Field(description="how jobs share the device: in a batch, in a session, or each for itself"),
        Since("0.2.0"),
    ] = "batch"
    mitigation: Annotated[
        Literal["none", "readout", "zero-noise"],
        Field(
            description="Runtime's error mitigation. readout: of wrongly read bits (TREX); zero-noise: of "
            "wrongly read bits and of gates, extrapolated from 1, 3 and 5 times the noise"
        ),
        Since("0.2.0"),
    ] = "none"
