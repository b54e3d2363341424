"""The native simulator as a PennyLane device: `qml.device("qrlsuite.native", wires=n)`.

Gates that the kernels know run in them, gates without angles on few wires by their matrix, and all others in
PennyLane's own decomposition. Broadcast samples, and circuits of one execution that differ in their angles alone (as
in the parameter-shift rule), run as lanes of one pass. Expectation values of Pauli words are measured in kernels; all
else, and everything with shots, by the functions with which `default.qubit` measures its state.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pennylane as qml
from numpy.typing import NDArray
from pennylane.devices import Device, ExecutionConfig
from pennylane.devices.default_qubit import (
    accepted_analytic_measurement,
    accepted_sample_measurement,
    adjoint_state_measurements,
)
from pennylane.devices.modifiers import simulator_tracking, single_tape_support
from pennylane.devices.preprocess import (
    decompose,
    device_resolve_dynamic_wires,
    no_sampling,
    validate_device_wires,
    validate_measurements,
)
from pennylane.devices.qubit import measure_final_state
from pennylane.exceptions import DecompositionUndefinedError, DeviceError
from pennylane.math import Interface
from pennylane.measurements import ClassicalShadowMP, ExpectationMP, ShadowExpvalMP, StateMP
from pennylane.operation import StatePrepBase
from pennylane.ops import Controlled, SparseHamiltonian
from pennylane.transforms import broadcast_expand, defer_measurements
from pennylane.transforms.core import TransformProgram, transform

from qrlsuite.plugins.circuits.native.states import (
    MATRIX_WIRES,
    MatrixObservable,
    Observables,
    Rule,
    Samples,
    StateProgram,
    Word,
    compiled,
    refuse_width,
)

Circuit = Any
NAME = "qrlsuite.native"
STATE_BYTES = 256 << 20
"""States of circuits that run together take up to this size."""

RULES = {
    "RX": Rule("RX", (0,)),
    "RY": Rule("RY", (0,)),
    "RZ": Rule("RZ", (0,)),
    "Rot": Rule("Rot", (0, 1, 2)),
    "CRX": Rule("RX", (0,), controlled=True),
    "CRY": Rule("RY", (0,), controlled=True),
    "CRZ": Rule("RZ", (0,), controlled=True),
    "CRot": Rule("Rot", (0, 1, 2), controlled=True),
    "C(U3)": Rule("U3", (0, 1, 2), controlled=True),
    "PhaseShift": Rule("RZ", (0,), phase=0.5),
    "ControlledPhaseShift": Rule("U3", (0.0, 0, 0.0), controlled=True),
    "GlobalPhase": Rule("", phase=-1.0),
    "Identity": Rule(""),
    "Hadamard": Rule("H"),
    "PauliX": Rule("X"),
    "PauliY": Rule("Y", phase=math.pi / 2),
    "PauliZ": Rule("Z"),
    "S": Rule("S", phase=math.pi / 4),
    "T": Rule("T", phase=math.pi / 8),
    "Adjoint(S)": Rule("RZ", (-math.pi / 2,), phase=-math.pi / 4),
    "Adjoint(T)": Rule("RZ", (-math.pi / 4,), phase=-math.pi / 8),
    "CNOT": Rule("CNOT"),
    "CZ": Rule("CZ"),
    "SWAP": Rule("SWAP"),
}
"""Gates that run in the kernels, by PennyLane's names."""


@dataclass
class Job:
    """A circuit, ready to run.

    Attributes
    ----------
    samples:
        Angles and matrices of B samples, 1 where the circuit is not broadcast.
    phases:
        (B,) or a number: the states' phase.
    columns:
        Of every parameter of the circuit the angle that it is, or None.
    turns:
        Of every parameter its factor in the states' phase.
    batched:
        Whether the circuit is broadcast.
    """

    circuit: Circuit
    program: StateProgram
    samples: Samples
    phases: Any
    columns: list[int | None]
    turns: list[float]
    batched: bool


@simulator_tracking
@single_tape_support
class NativeDevice(Device):  # type: ignore[misc]  # PennyLane has no types
    """State vectors in double precision, with adjoint gradients and broadcasting.

    Parameters
    ----------
    wires:
        Number of wires or their labels; None for each circuit's own wires.
    shots:
        As of every PennyLane device; None for exact values.
    seed:
        Seed of the shots: an integer, None for fresh entropy, or "global" for a draw from numpy's global generator.
    """

    def __init__(self, wires: Any = None, shots: Any = None, seed: Any = "global") -> None:
        super().__init__(wires=wires, shots=shots)
        _require_width(len(self.wires or ()))
        drawn = np.random.randint(0, high=10_000_000) if isinstance(seed, str) and seed == "global" else seed  # noqa: NPY002
        self._rng = np.random.default_rng(drawn)

    @property
    def name(self) -> str:
        """The name under which PennyLane opens it."""
        return NAME

    def supports_derivatives(
        self, execution_config: ExecutionConfig | None = None, circuit: Circuit | None = None
    ) -> bool:
        """Return whether adjoint gradients of a circuit can be computed: of exact values."""
        if execution_config is None:
            return True
        if execution_config.gradient_method not in ("adjoint", "best", "device"):
            return False
        return circuit is None or self._has_adjoint(circuit)

    def setup_execution_config(
        self, config: ExecutionConfig | None = None, circuit: Circuit | None = None
    ) -> ExecutionConfig:
        """Choose adjoint gradients where PennyLane asks for the best."""
        config = config or ExecutionConfig()
        if config.device_options:
            raise DeviceError(f"{NAME} has no options for an execution, given are {config.device_options}")
        if config.mcm_config.mcm_method not in (None, "deferred", "device"):
            raise DeviceError(
                f"mcm_method = '{config.mcm_config.mcm_method}': {NAME} defers mid-circuit measurements to the end, "
                "with a wire more for each; use 'deferred'"
            )
        adjoint = config.gradient_method in ("adjoint", "best", "device")
        changed: dict[str, Any] = {"mcm_config": replace(config.mcm_config, mcm_method="deferred")}
        if config.interface in (Interface.TORCH, Interface.AUTOGRAD):
            changed["convert_to_numpy"] = (
                False  # angles are read out once, here, instead of in copies of all gates
            )
        if adjoint:
            changed |= {
                "gradient_method": "adjoint",
                "use_device_gradient": True,
                "use_device_jacobian_product": True,
                "grad_on_execution": False,
            }
        return replace(config, **changed)

    def preprocess_transforms(self, execution_config: ExecutionConfig | None = None) -> Any:
        """Return PennyLane's transforms of circuits before they run here."""
        config = execution_config or ExecutionConfig()
        program = TransformProgram()
        program.add_transform(defer_measurements, allow_postselect=False)
        adjoint = config.gradient_method == "adjoint"
        self._add_decompose(program, skip_prep=not adjoint)
        program.add_transform(device_resolve_dynamic_wires, wires=self.wires, allow_resets=False)
        program.add_transform(validate_device_wires, self.wires, name=NAME)
        program.add_transform(
            validate_measurements,
            analytic_measurements=accepted_analytic_measurement,
            sample_measurements=accepted_sample_measurement,
            name=NAME,
        )
        program.add_transform(_width_checked)
        program.add_transform(_expanded_for_shadows)
        if adjoint:
            self._add_adjoint(program)
        return program

    def execute(self, circuits: Sequence[Circuit], execution_config: ExecutionConfig | None = None) -> Any:
        """Return the results of circuits, see PennyLane's `Device.execute`."""
        jobs = [_job(circuit) for circuit in circuits]
        exact = [_observables(job) for job in jobs]
        results: list[Any] = [None] * len(jobs)
        for group in _groups(jobs, exact):
            first = jobs[group[0]]
            samples, ends = _stacked([jobs[i].samples for i in group])
            observables = exact[group[0]]
            if observables is None:
                for i, states in zip(group, np.split(first.program.states(samples), ends)):
                    results[i] = self._measured(jobs[i], states)
            else:
                for i, means in zip(group, np.split(first.program.expectations(samples, observables), ends)):
                    results[i] = _unpacked(jobs[i], means)
        return tuple(results)

    def compute_vjp(
        self, circuits: Sequence[Circuit], cotangents: Any, execution_config: ExecutionConfig | None = None
    ) -> Any:
        """Return vector-Jacobian products by the adjoint method, see PennyLane's `Device.compute_vjp`."""
        return tuple(_vjp(_job(circuit), given) for circuit, given in zip(circuits, cotangents))

    def execute_and_compute_vjp(
        self, circuits: Sequence[Circuit], cotangents: Any, execution_config: ExecutionConfig | None = None
    ) -> Any:
        """Return results and vector-Jacobian products."""
        return self.execute(circuits, execution_config), self.compute_vjp(
            circuits, cotangents, execution_config
        )

    def compute_derivatives(
        self, circuits: Sequence[Circuit], execution_config: ExecutionConfig | None = None
    ) -> Any:
        """Return Jacobians by the adjoint method, one pass per value; see PennyLane's `Device.compute_derivatives`."""
        return tuple(_jacobian(_job(circuit)) for circuit in circuits)

    def execute_and_compute_derivatives(
        self, circuits: Sequence[Circuit], execution_config: ExecutionConfig | None = None
    ) -> Any:
        """Return results and Jacobians."""
        return self.execute(circuits, execution_config), self.compute_derivatives(circuits, execution_config)

    def _measured(self, job: Job, states: NDArray[np.complex128]) -> Any:
        """Return a circuit's results from its states (B, 2^n), as `default.qubit` computes them."""
        states = states * np.exp(1j * np.reshape(job.phases, (-1, 1)))
        shape = [2] * len(job.circuit.wires)
        state = states.reshape(-1, *shape) if job.batched else states.reshape(shape)
        return measure_final_state(job.circuit, state, job.batched, rng=self._rng)

    def _add_decompose(self, program: Any, skip_prep: bool) -> None:
        program.add_transform(
            decompose,
            stopping_condition=_runs,
            skip_initial_state_prep=skip_prep,
            device_wires=self.wires,
            target_gates=set(RULES),
            name=NAME,
        )

    def _add_adjoint(self, program: Any) -> None:
        program.add_transform(no_sampling, name=f"adjoint + {NAME}")
        program.add_transform(adjoint_state_measurements, device_vjp=True)

    def _has_adjoint(self, circuit: Circuit) -> bool:
        if any(isinstance(m.obs, SparseHamiltonian) for m in circuit.measurements):
            return False
        program = TransformProgram()
        program.add_transform(defer_measurements, allow_postselect=False)
        program.add_transform(validate_device_wires, self.wires, name=NAME)
        self._add_decompose(program, skip_prep=False)
        program.add_transform(validate_measurements, name=NAME)
        self._add_adjoint(program)
        try:
            program((circuit,))
        except (DecompositionUndefinedError, DeviceError, AttributeError):
            return False
        return True


def _rule(op: Any) -> Rule | None:
    """Return how the kernels know a gate, if they do."""
    if op.name == "C(U3)" and (len(op.control_wires) > 1 or not all(op.control_values)):
        return None
    return RULES.get(op.name)


def _runs(op: Any) -> bool:
    if _rule(op) is not None:
        return True
    if len(op.wires) > MATRIX_WIRES or not op.has_matrix:
        return False
    if op.num_params == 0:
        return True
    if any(qml.math.requires_grad(each) for each in op.data):
        return False
    # of broadcast controlled gates PennyLane 0.45 does not always find the decomposition
    return op.name == "QubitUnitary" or isinstance(op, Controlled) or not op.has_decomposition


@transform
def _width_checked(tape: Circuit) -> Any:
    """Refuse circuits that are too wide, also after deferring measurements."""
    _require_width(len(tape.wires))
    return (tape,), _first


@transform
def _expanded_for_shadows(tape: Circuit) -> Any:
    """Run the samples of classical shadows one by one, because PennyLane draws no broadcast shadows."""
    if any(isinstance(m, ClassicalShadowMP | ShadowExpvalMP) for m in tape.measurements):
        return broadcast_expand(tape)
    return (tape,), _first


def _first(results: Any) -> Any:
    return results[0]


def _require_width(wires: int) -> None:
    try:
        refuse_width(wires)
    except ValueError as error:
        raise DeviceError(f"{NAME}: {error}") from None


def _job(circuit: Circuit) -> Job:
    """Translate a circuit that has been through `preprocess_transforms`."""
    circuit = circuit.map_to_standard_wires()
    gates: list[tuple[Rule | None, tuple[int, ...]]] = []
    angles: list[Any] = []
    matrices: list[Any] = []
    columns: list[int | None] = []
    turns: list[float] = []
    phases: Any = 0.0
    operations = circuit.operations
    initial = None
    if operations and isinstance(operations[0], StatePrepBase):
        prep = operations[0]
        initial = _vector(prep, len(circuit.wires))
        columns += [None] * len(prep.data)
        turns += [0.0] * len(prep.data)
        operations = operations[1:]
    for op in operations:
        rule = _rule(op)
        wires = tuple(op.wires)
        if rule is None:
            gates.append((None, wires))
            matrices.append(np.asarray(qml.math.unwrap([op.matrix()])[0], np.complex128))
            columns += [None] * op.num_params
            turns += [0.0] * op.num_params
            continue
        gates.append((rule, wires))
        for value in op.data:
            columns.append(len(angles) if rule.gate else None)
            turns.append(rule.phase)
            number = value if isinstance(value, float | np.ndarray) else qml.math.unwrap([value])[0]
            if rule.gate:
                angles.append(number)
            if rule.phase:
                phases = phases + rule.phase * np.real(number)
        if rule.phase and not op.data:
            phases = phases + rule.phase
    sizes = {len(value) for value in angles if np.ndim(value)} | {len(m) for m in matrices if m.ndim == 3}
    sizes |= {len(phases)} if np.ndim(phases) else set()
    sizes |= {len(initial)} if initial is not None and initial.ndim == 2 else set()
    if len(sizes) > 1:
        raise DeviceError(
            f"{NAME}: gates of one circuit are broadcast over {sorted(sizes)} samples; use one number"
        )
    table = np.empty((next(iter(sizes), 1), len(angles)))
    for column, value in enumerate(angles):
        table[:, column] = np.real(value)
    program = compiled(len(circuit.wires), initial is not None, tuple(gates))
    return Job(circuit, program, Samples(table, matrices, initial), phases, columns, turns, bool(sizes))


def _vector(prep: Any, qubits: int) -> NDArray[np.complex128]:
    """Return a prepared state, (2^n,) or (B, 2^n)."""
    vector = prep.state_vector(wire_order=range(qubits))
    if hasattr(vector, "toarray"):
        vector = vector.toarray()
    flat = np.asarray(qml.math.unwrap([vector])[0], np.complex128)
    return flat.reshape(-1, 1 << qubits) if prep.batch_size is not None else flat.reshape(-1)


def _observables(job: Job) -> Observables | None:
    """Return the observables that the kernels measure; None if PennyLane measures the states."""
    circuit = job.circuit
    if circuit.shots or not all(type(m) is ExpectationMP and m.obs is not None for m in circuit.measurements):
        return None
    words: list[Word] = []
    matrices: list[MatrixObservable] = []
    for number, measurement in enumerate(circuit.measurements):
        sentence = measurement.obs.pauli_rep
        if sentence is not None:
            words += [_word(word, c, number, measurement) for word, c in sentence.items()]
        elif len(measurement.obs.wires) <= MATRIX_WIRES and measurement.obs.has_matrix:
            matrix = np.asarray(qml.math.unwrap([measurement.obs.matrix()])[0], np.complex128)
            if not np.allclose(matrix, matrix.conj().T):
                raise DeviceError(f"{measurement}: its matrix is not Hermitian, so its mean is not real")
            matrices.append(MatrixObservable(matrix, tuple(measurement.obs.wires), number))
        else:
            return None
    return Observables(len(circuit.measurements), words, matrices)


def _word(word: Any, coefficient: Any, number: int, measurement: Any) -> Word:
    exact = complex(qml.math.unwrap([coefficient])[0])
    if abs(exact.imag) > 1e-12 * max(1.0, abs(exact)):
        raise DeviceError(
            f"{measurement}: the coefficient {exact:g} of {word} is complex, so the observable is not Hermitian and "
            "its mean is not real; make its coefficients real"
        )
    return Word(dict(word), exact.real, number)


def _groups(jobs: list[Job], exact: list[Observables | None]) -> Iterable[list[int]]:
    """Put circuits of the same gates and measurements together, so that they run in one pass."""
    groups: dict[Any, list[int]] = {}
    for i, (job, observables) in enumerate(zip(jobs, exact)):
        alone = bool(job.samples.matrices) or job.samples.initial is not None
        measured: Any = None
        if observables is not None:
            measured = tuple((tuple(w.paulis.items()), *w[1:]) for w in observables.words)
            alone = alone or bool(observables.matrices)
        groups.setdefault((id(job.program), measured, i if alone else None), []).append(i)
    for group in groups.values():
        lanes = max(len(jobs[i].samples.angles) for i in group)
        step = max(1, STATE_BYTES // (lanes * (16 << jobs[group[0]].program.qubits)))
        for first in range(0, len(group), step):
            yield group[first : first + step]


def _stacked(samples: list[Samples]) -> tuple[Samples, list[int]]:
    """Return samples of several circuits as one, and where all but the last end."""
    if len(samples) == 1:
        return samples[0], []
    ends = np.cumsum([len(each.angles) for each in samples])[:-1]
    return Samples(np.concatenate([each.angles for each in samples])), ends.tolist()


def _unpacked(job: Job, values: NDArray[np.float64]) -> Any:
    """Return expectation values (B, O) as PennyLane's results."""
    results = tuple(values.T) if job.batched else tuple(values[0])
    return results[0] if len(results) == 1 else results


class Gradients(tuple[Any, ...]):
    """Arrays of several shapes, one per parameter.

    PennyLane 0.45 asks torch's gradients for their shape with `numpy.squeeze`, which calls this method, and else fails
    where some parameters are broadcast and others are not.
    """

    def squeeze(self) -> Any:
        """Return an array of the same length."""
        return np.empty(len(self))


def _vjp(job: Job, cotangents: Any) -> Any:
    """Return the vector-Jacobian product of a circuit, an array per trainable parameter."""
    circuit = job.circuit
    count = len(job.samples.angles)
    weights: dict[int, Any] = {}
    if any(isinstance(m, StateMP) for m in circuit.measurements):
        gradient, phase = _state_gradient(job, cotangents)
    else:
        observables = _observables(job)
        if observables is None:
            raise DeviceError(
                f"{NAME} has no adjoint gradient of {circuit.measurements}; use 'parameter-shift'"
            )
        given = cotangents if isinstance(cotangents, tuple | list) else [cotangents]
        table = np.stack([np.broadcast_to(np.real(np.asarray(c)).reshape(-1), count) for c in given], axis=1)
        gradient, phase = job.program.gradients(job.samples, observables, table), np.zeros(count)
        weights = _weight_gradients(job, table)
    return Gradients(
        weights[index] if index in weights else _parameter_gradient(job, index, gradient, phase)
        for index in circuit.trainable_params
    )


def _weight_gradients(job: Job, cotangents: NDArray[np.float64]) -> dict[int, Any]:
    """Return the gradients by parameters of the observables, by the parameters' indices in the circuit.

    An observable is linear in each of its coefficients: its slope is the difference of two values.
    """
    words: list[Word] = []
    owners: dict[int, int] = {}
    index = len(job.columns)
    for number, measurement in enumerate(job.circuit.measurements):
        observable = measurement.obs
        for place in range(len(observable.data)):
            if index in job.circuit.trainable_params:
                moved = list(observable.data)
                moved[place] = moved[place] + 1.0
                sentence = qml.ops.functions.bind_new_parameters(observable, moved).pauli_rep
                if sentence is None:
                    raise DeviceError(
                        f"{measurement}: {NAME} has no adjoint gradient by the entries of a matrix; use "
                        "'parameter-shift', or coefficients of Pauli matrices"
                    )
                before = observable.pauli_rep
                words += [
                    _word(word, c - before.get(word, 0.0), len(owners), measurement)
                    for word, c in sentence.items()
                    if c != before.get(word, 0.0)
                ]
                owners[index] = number
            index += 1
    if not owners:
        return {}
    slopes = job.program.expectations(job.samples, Observables(len(owners), words))
    return {index: slopes[:, i] @ cotangents[:, number] for i, (index, number) in enumerate(owners.items())}


def _state_gradient(job: Job, cotangents: Any) -> tuple[Any, Any]:
    """Return gradients by angles (B, A) and by the phase (B,), of the circuit's state, which is all it measures."""
    circuit = job.circuit
    qubits = len(circuit.wires)
    given = np.asarray(cotangents[0] if isinstance(cotangents, tuple | list) else cotangents, np.complex128)
    wires = list(circuit.measurements[0].wires)
    shaped = given.reshape(-1, *[2] * qubits)
    if wires != list(range(qubits)):
        shaped = shaped.transpose(0, *(1 + wires.index(q) for q in range(qubits)))
    flat = shaped.reshape(-1, 1 << qubits) * np.exp(1j * np.reshape(job.phases, (-1, 1)))
    states = job.program.states(job.samples)
    flat = np.broadcast_to(flat, states.shape)
    return job.program.state_gradients(job.samples, flat), 1j * (flat * states).sum(1)


def _parameter_gradient(job: Job, index: int, gradient: Any, phase: Any) -> Any:
    """Return the gradient by one parameter of the circuit: of every sample where the parameter is broadcast."""
    column, turn = job.columns[index], job.turns[index]
    value = job.circuit.get_parameters(trainable_only=False)[index]
    if column is None and not turn:
        raise DeviceError(
            f"{NAME} has no adjoint gradient by the entries of a matrix or state; use 'parameter-shift'"
        )
    total = turn * phase if turn else 0.0
    if column is not None:
        total = total + gradient[:, column]
    return total if np.ndim(value) else np.sum(total)


def _jacobian(job: Job) -> Any:
    """Return the Jacobian of a circuit that is not broadcast, in PennyLane's nesting."""
    circuit = job.circuit
    if job.batched:
        raise DeviceError(f"{NAME} has no Jacobian of broadcast circuits, only products with it")
    measured = len(circuit.measurements)
    if isinstance(circuit.measurements[0], StateMP):
        size = 1 << len(circuit.wires)
        rows = [_vjp(job, unit) for unit in np.eye(size)]
        nested: list[Any] = [tuple(np.stack(column) for column in zip(*rows))]
    else:
        nested = [_vjp(job, tuple(unit)) for unit in np.eye(measured)]
    nested = [each[0] if len(each) == 1 else each for each in nested]
    return nested[0] if measured == 1 else tuple(nested)
