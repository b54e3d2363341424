"""The native simulator as Qiskit's V2 primitives, in the place of `StatevectorEstimator` and `StatevectorSampler`.

All parameter values of a circuit run as lanes of one pass. Gates that the kernels know run in them, gates without
parameters on few qubits by their matrix, and all others by Qiskit's own definitions. With a seed, Qiskit's primitives
draw the same numbers. A measurement within a circuit is made at its end, on a further qubit if the measured one is used
again; gates that depend on it are controlled gates, and a reset takes a further qubit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from qiskit.circuit import Clbit, ControlFlowOp, Gate, ParameterExpression, QuantumCircuit
from qiskit.circuit.library import CXGate
from qiskit.primitives import (
    BaseEstimatorV2,
    BaseSamplerV2,
    BitArray,
    DataBin,
    PrimitiveJob,
    PrimitiveResult,
    PubResult,
    SamplerPubResult,
)
from qiskit.primitives.containers.estimator_pub import EstimatorPub
from qiskit.primitives.containers.sampler_pub import SamplerPub
from qiskit.quantum_info import Operator

from qrlsuite.errors import CircuitError
from qrlsuite.plugins.circuits.native.states import (
    MATRIX_WIRES,
    Observables,
    Rule,
    Samples,
    StateProgram,
    Word,
    compiled,
    refuse_width,
)

STATE_BYTES = 256 << 20
"""States that are sampled together take up to this size."""

RULES = {
    "rx": Rule("RX", (0,)),
    "ry": Rule("RY", (0,)),
    "rz": Rule("RZ", (0,)),
    "p": Rule("RZ", (0,)),
    "u": Rule("U3", (0, 1, 2)),
    "crx": Rule("RX", (0,), controlled=True),
    "cry": Rule("RY", (0,), controlled=True),
    "crz": Rule("RZ", (0,), controlled=True),
    "cp": Rule("U3", (0.0, 0, 0.0), controlled=True),
    "id": Rule(""),
    "h": Rule("H"),
    "x": Rule("X"),
    "y": Rule("Y"),
    "z": Rule("Z"),
    "s": Rule("S"),
    "t": Rule("T"),
    "sdg": Rule("RZ", (-math.pi / 2,)),
    "tdg": Rule("RZ", (-math.pi / 4,)),
    "sx": Rule("RX", (math.pi / 2,)),
    "sxdg": Rule("RX", (-math.pi / 2,)),
    "cx": Rule("CNOT"),
    "cz": Rule("CZ"),
    "swap": Rule("SWAP"),
}
"""Gates that run in the kernels, by Qiskit's names; up to a global phase, which no mean and no bit shows."""


@dataclass
class Plan:
    """A circuit whose parameter values run all together.

    Attributes
    ----------
    program, samples:
        The compiled gates, and angles of all B parameter values.
    bits:
        By a register's name, the wire that is measured into each of its bits, None for no wire.
    wires:
        The wire of every qubit: resets move it.
    """

    program: StateProgram
    samples: Samples
    bits: dict[str, list[int | None]]
    wires: list[int]


class EstimatorV2(BaseEstimatorV2):  # type: ignore[misc]  # Qiskit has no types
    """Means of observables, as `qiskit.primitives.StatevectorEstimator` computes them.

    Parameters
    ----------
    default_precision:
        Standard deviation of Gaussian noise on every mean, by default of `run`; 0 for exact means.
    seed:
        Seed of that noise: an integer, a generator, or None for fresh entropy.
    """

    def __init__(self, *, default_precision: float = 0.0, seed: Any = None) -> None:
        self.default_precision = default_precision
        self.seed = seed

    def run(self, pubs: Iterable[Any], *, precision: float | None = None) -> Any:
        """Return a job with the means of every pub, see Qiskit's `BaseEstimatorV2.run`."""
        wanted = self.default_precision if precision is None else precision
        work = [
            (pub, _plan(pub, _turned(pub))) for pub in (EstimatorPub.coerce(each, wanted) for each in pubs)
        ]
        job = PrimitiveJob(lambda: PrimitiveResult(list(map(self._result, work)), metadata={"version": 2}))
        job._submit()
        return job

    def _result(self, work: tuple[Any, Plan]) -> Any:
        pub, plan = work
        means = _means(pub, plan)
        if pub.precision:
            means = np.asarray(np.random.default_rng(self.seed).normal(means, pub.precision))
        data = DataBin(evs=means, stds=np.zeros_like(means), shape=means.shape)
        metadata = {"target_precision": pub.precision, "circuit_metadata": pub.circuit.metadata}
        return PubResult(data, metadata=metadata)


class SamplerV2(BaseSamplerV2):  # type: ignore[misc]
    """Measured bits, as `qiskit.primitives.StatevectorSampler` draws them.

    Parameters
    ----------
    default_shots:
        Repetitions of every circuit, by default of `run`.
    seed:
        Seed of the draws: an integer, a generator, or None for fresh entropy.
    """

    def __init__(self, *, default_shots: int = 1024, seed: Any = None) -> None:
        self.default_shots = default_shots
        self.seed = seed

    def run(self, pubs: Iterable[Any], *, shots: int | None = None) -> Any:
        """Return a job with the bits of every pub, see Qiskit's `BaseSamplerV2.run`."""
        wanted = self.default_shots if shots is None else shots
        work = [(pub, _plan(pub)) for pub in (SamplerPub.coerce(each, wanted) for each in pubs)]
        job = PrimitiveJob(lambda: PrimitiveResult(list(map(self._result, work)), metadata={"version": 2}))
        job._submit()
        return job

    def _result(self, work: tuple[Any, Plan]) -> Any:
        pub, plan = work
        read = sorted({q for bits in plan.bits.values() for q in bits if q is not None})
        drawn = [
            np.random.default_rng(self.seed).choice(len(p), size=pub.shots, p=p)
            for p in _probabilities(plan, read)
        ]
        outcomes = np.array(drawn, np.int64).reshape(-1, pub.shots, 1)
        arrays = {}
        for name, bits in plan.bits.items():
            places = [-1 if q is None else read.index(q) for q in bits]
            values = (outcomes >> np.maximum(places, 0)) & (np.array(places) >= 0)
            shaped = values.astype(bool).reshape(*pub.shape, pub.shots, len(bits))
            arrays[name] = BitArray.from_bool_array(shaped, order="little")
        metadata = {"shots": pub.shots, "circuit_metadata": pub.circuit.metadata}
        return SamplerPubResult(DataBin(**arrays, shape=pub.shape), metadata=metadata)


class _Deferred:
    """Operations as they come, without measurements, resets and conditions in between.

    Attributes
    ----------
    bits:
        Of every bit that is measured the wire that has it.
    """

    def __init__(self, circuit: QuantumCircuit) -> None:
        self.wires = list(range(circuit.num_qubits))
        self.count = circuit.num_qubits
        self.bits: dict[int, int] = {}
        self._measured: set[int] = set()  # wires that nothing has acted on since
        self._touched: set[int] = set()

    def operations(
        self, circuit: QuantumCircuit, qubits: Sequence[int], clbits: Sequence[int]
    ) -> Iterator[tuple[Any, tuple[int, ...]]]:
        """Yield gates and their wires."""
        for operation, on, into in _flat(circuit, qubits, clbits):
            if operation.name == "measure":
                self.bits[into[0]] = self.wires[on[0]]
                self._measured.add(self.wires[on[0]])
            elif operation.name == "reset":
                if self.wires[on[0]] in self._touched:
                    self._measured.discard(self.wires[on[0]])
                    self.wires[on[0]] = self._further()
            elif isinstance(operation, ControlFlowOp):
                yield from self._conditional(operation, on, into)
            else:
                yield from self.keep(on)
                self._touched.update(self.wires[q] for q in on)
                yield operation, tuple(self.wires[q] for q in on)

    def keep(self, qubits: Iterable[int]) -> Iterator[tuple[Any, tuple[int, ...]]]:
        """Yield gates that copy measured bits to further wires if qubits are used again."""
        for wire in self._measured.intersection(self.wires[q] for q in qubits):
            copied = self._further()
            self._measured.remove(wire)
            self.bits = {bit: copied if each == wire else each for bit, each in self.bits.items()}
            yield CXGate(), (wire, copied)

    def _further(self) -> int:
        self.count += 1
        return self.count - 1

    def _conditional(
        self, operation: Any, on: tuple[int, ...], asked: tuple[int, ...]
    ) -> Iterator[tuple[Any, tuple[int, ...]]]:
        """Yield the gates of an `if_else`, each controlled by the measured bits."""
        if operation.name != "if_else" or not asked:
            raise CircuitError(
                f"'{operation.name}' cannot be written with controlled gates: write out loops, and compare a measured "
                "bit or register with a number"
            )
        value = int(operation.condition[1])
        for body, holds in zip(operation.blocks, (True, False)):
            yield from self.keep(on)
            for found in range(1 << len(asked)):
                if (found == value) == holds:
                    yield from self._controlled(
                        body, on, {bit: found >> k & 1 for k, bit in enumerate(asked)}
                    )

    def _controlled(
        self, body: QuantumCircuit, on: tuple[int, ...], found: dict[int, int]
    ) -> Iterator[tuple[Any, tuple[int, ...]]]:
        """Yield gates that act where bits have been found so."""
        if any(bit not in self.bits and value for bit, value in found.items()):
            return  # it was not measured, so it is 0
        controls = {self.bits[bit]: value for bit, value in found.items() if bit in self.bits}
        state = sum(value << k for k, value in enumerate(controls.values()))
        for item in body.data:
            operation = item.operation
            if not isinstance(operation, Gate):
                raise CircuitError(f"'{operation.name}' depends on measured bits: only gates may")
            inner = QuantumCircuit(len(controls) + operation.num_qubits)
            gate = (
                operation.control(len(controls), ctrl_state=state, annotated=False) if controls else operation
            )
            inner.append(gate, range(inner.num_qubits))
            wires = [self.wires[on[body.find_bit(q).index]] for q in item.qubits]
            self._touched.update(wires)
            for each, where, _ in _flat(inner, [*controls, *wires], ()):
                yield each, where


def _turned(pub: Any) -> set[int]:
    """Return the qubits on which an observable has another Pauli than Z."""
    labels = {label for each in pub.observables.ravel().tolist() for label in each}
    return {q for label in labels for q, pauli in enumerate(reversed(label)) if pauli in "XY"}


def _plan(pub: Any, turned: Iterable[int] = ()) -> Plan:
    """Translate a circuit and all its parameter values; outcomes on turned qubits are copied before these turn."""
    circuit = pub.circuit
    _refuse_width(circuit.num_qubits)
    values = pub.parameter_values
    table = values.as_array(circuit.parameters).reshape(math.prod(values.shape), circuit.num_parameters)
    known = {parameter: table[:, i] for i, parameter in enumerate(circuit.parameters)}
    gates: list[tuple[Rule | None, tuple[int, ...]]] = []
    angles: list[Any] = []
    matrices: list[NDArray[np.complex128]] = []
    deferred = _Deferred(circuit)
    every = deferred.operations(circuit, range(circuit.num_qubits), range(circuit.num_clbits))
    for operation, wires in itertools.chain(every, deferred.keep(turned)):
        rule = RULES.get(operation.name)
        if rule is None:
            gates.append((None, tuple(reversed(wires))))
            matrices.append(Operator(operation).data)
        else:
            gates.append((rule, wires))
            if rule.gate and any(isinstance(a, int) for a in rule.angles):
                angles += [_angle(value, known) for value in operation.params]
    _refuse_width(deferred.count)
    columns = np.empty((len(table), len(angles)))
    for column, angle in enumerate(angles):
        columns[:, column] = angle
    bits: dict[str, list[int | None]] = {
        register.name: [deferred.bits.get(circuit.find_bit(bit).index) for bit in register]
        for register in circuit.cregs
    }
    program = compiled(deferred.count, False, tuple(gates))
    return Plan(program, Samples(columns, matrices), bits, deferred.wires)


def _refuse_width(qubits: int) -> None:
    try:
        refuse_width(qubits)
    except ValueError as error:
        raise CircuitError(str(error)) from None


def _flat(
    circuit: QuantumCircuit, qubits: Sequence[int], clbits: Sequence[int]
) -> Iterator[tuple[Any, tuple[int, ...], tuple[int, ...]]]:
    """Yield operations with their qubits and bits; operations that cannot run are replaced by their definitions.

    The bits of a condition are the bits that it compares.
    """
    for item in circuit.data:
        operation = item.operation
        if operation.name in ("barrier", "delay"):
            continue
        on = tuple(qubits[circuit.find_bit(q).index] for q in item.qubits)
        into = tuple(clbits[circuit.find_bit(c).index] for c in item.clbits)
        if isinstance(operation, ControlFlowOp):
            condition = getattr(operation, "condition", None)
            asked = condition[0] if isinstance(condition, tuple) else ()
            bits = [asked] if isinstance(asked, Clbit) else asked  # the lowest first
            yield operation, on, tuple(clbits[circuit.find_bit(bit).index] for bit in bits)
            continue
        plain = all(not isinstance(value, ParameterExpression) for value in operation.params)
        positive = getattr(operation, "ctrl_state", None) in (None, 1)
        known = operation.name in ("measure", "reset") or (operation.name in RULES and positive)
        matrix = plain and len(on) <= MATRIX_WIRES and not into and hasattr(operation, "__array__")
        if known or matrix:
            yield operation, on, into
        elif getattr(operation, "definition", None) is None:
            raise CircuitError(
                f"operation '{operation.name}' on {len(on)} qubits has no definition by other gates: it cannot run here"
            )
        else:
            yield from _flat(operation.definition, on, into)


def _angle(value: Any, known: dict[Any, NDArray[np.float64]]) -> Any:
    """Return a gate's angle of every sample (B,), or a number."""
    if not isinstance(value, ParameterExpression):
        return float(value)
    if value in known:
        return known[value]
    names = list(value.parameters)
    slopes = [value.gradient(name) for name in names]
    if all(isinstance(slope, int | float) for slope in slopes):
        start = float(value.bind(dict.fromkeys(names, 0.0)))
        return start + sum(slope * known[name] for slope, name in zip(slopes, names))
    rows = np.stack([known[name] for name in names], axis=1)
    return np.array([float(value.bind(dict(zip(names, row)))) for row in rows.tolist()])


def _means(pub: Any, plan: Plan) -> NDArray[np.float64]:
    shape = pub.shape
    given = pub.observables.ravel()
    sums = [_words(given[(i,)], plan.wires) for i in range(given.size)]
    count = len(plan.samples.angles)
    rows = np.broadcast_to(np.arange(count).reshape(pub.parameter_values.shape), shape).reshape(-1)
    columns = np.broadcast_to(np.arange(len(sums)).reshape(pub.observables.shape), shape).reshape(-1)
    means = np.zeros(len(rows))
    if count * len(sums) == len(rows):  # every observable of every sample
        words = [Word(paulis, weight, o) for o, each in enumerate(sums) for paulis, weight in each]
        table = plan.program.expectations(plan.samples, Observables(len(sums), words))
        means[:] = table[rows, columns]
    else:
        for o, each in enumerate(sums):
            which = np.flatnonzero(columns == o)
            some = Samples(plan.samples.angles[rows[which]], plan.samples.matrices)
            words = [Word(paulis, weight, 0) for paulis, weight in each]
            means[which] = plan.program.expectations(some, Observables(1, words))[:, 0]
    return means.reshape(shape)


def _words(observable: Any, wires: Sequence[int]) -> list[tuple[dict[int, str], float]]:
    """Return Pauli words by wire with their coefficients."""
    words = []
    for label, coefficient in observable.items():
        if set(label) - set("IXYZ"):
            raise CircuitError(
                f"observable '{label}': write projectors as sums of the Pauli matrices I, X, Y and Z"
            )
        paulis = {wires[q]: pauli for q, pauli in enumerate(reversed(label)) if pauli != "I"}
        words.append((paulis, float(np.real(coefficient))))
    return words


def _probabilities(plan: Plan, read: list[int]) -> Iterator[NDArray[np.float64]]:
    """Yield, sample by sample, the probabilities of the bits of some qubits, the first of which is the lowest."""
    qubits = plan.program.qubits
    step = max(1, STATE_BYTES // (16 << qubits))
    for first in range(0, len(plan.samples.angles), step):
        for state in plan.program.states(plan.samples.part(first, first + step)):
            table = (state.real**2 + state.imag**2).reshape([2] * qubits)
            other = tuple(q for q in range(qubits) if q not in read)
            p = table.sum(axis=other).transpose().reshape(-1)
            yield p / p.sum()
