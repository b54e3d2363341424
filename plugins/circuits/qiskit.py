"""Circuits in Qiskit: `EstimatorQNN` and `TorchConnector` of qiskit-machine-learning over a V2 primitive.

The circuit is decomposed into rx, ry, rz and fixed gates: controlled rotations (crx, cry, crz) are avoided because
reverse gradients refuse them and Aer 0.18 with run-time parameters gives wrong values for them. Each remaining
rotation angle is an input parameter of the QNN, and a fixed linear map in torch leads from the circuit's angles
to them; that is twice as fast as parameter expressions inside the circuit.

`TorchConnector` hands values and gradients over in float32 whatever it is given (qiskit-machine-learning 0.9), so
it serves float32 models; in float64 the same network is connected by a function of our own. Exact values and
gradients depend on nothing but their own sample. With shots every seed gets primitives of its own, seeded by it.
The statevector primitive does not sample: it adds Gaussian noise of standard deviation 1/sqrt(shots), the most that
sampling can have (qiskit.primitives.StatevectorEstimator); `aer` samples.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from qiskit import QuantumCircuit
from qiskit.circuit import Parameter
from qiskit.primitives import BackendEstimatorV2
from qiskit.quantum_info import SparsePauliOp
from qiskit_machine_learning.connectors import TorchConnector
from qiskit_machine_learning.gradients import (
    LinCombEstimatorGradient,
    ParamShiftEstimatorGradient,
    SPSAEstimatorGradient,
)
from qiskit_machine_learning.neural_networks import EstimatorQNN
from qiskit_machine_learning.primitives import QMLEstimator
from torch import Tensor

from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.description import Circuit
from qrlsuite.errors import OptionError, nearest
from qrlsuite.plugins.circuits.options import QiskitOptions

DENSITY_QUBITS = 12
"""Qubits up to which noise is simulated exactly, as a density matrix; beyond, shots are needed."""

FIXED = {"H": "h", "X": "x", "Y": "y", "Z": "z", "S": "s", "T": "t", "CNOT": "cx", "CZ": "cz", "SWAP": "swap"}
ONE_QUBIT, TWO_QUBIT = ["rx", "ry", "rz", "h", "x", "y", "z", "s", "t"], ["cx", "cz", "swap"]


class Rotations:
    """A circuit in Qiskit's gates, and the linear map from its angles to theirs.

    Attributes
    ----------
    circuit:
        The circuit of rx, ry, rz with one `Parameter` each, h, cx and the other fixed gates.
    parameters:
        The parameters in order, R of them.
    """

    def __init__(self, circuit: Circuit, table: AngleTable) -> None:
        self.circuit = QuantumCircuit(circuit.qubits)
        self.parameters: list[Parameter] = []
        self._table = table
        self._terms: list[list[tuple[float, int | float]]] = []
        for operation, rows in zip(circuit, table.rows):
            self._append(operation.gate, operation.wires, rows, operation.control)

    def _append(
        self, gate: str, wires: tuple[int, ...], rows: tuple[int | float, ...], control: int | None
    ) -> None:
        """Append one gate. Controlled ones follow Nielsen & Chuang (2010), corollary 4.2."""
        target = wires[0]
        if gate in FIXED:
            getattr(self.circuit, FIXED[gate])(*wires)
        elif gate == "U3":
            theta, phi, delta = rows
            if control is not None:  # U3 is a phase (phi + delta) / 2 times Rot(delta, theta, phi)
                self._rotate("rz", control, (0.5, phi), (0.5, delta))
            self._append("Rot", wires, (delta, theta, phi), control)
        elif gate == "Rot":
            first, middle, last = rows
            if control is None:
                self._rotate("rz", target, (1.0, first))
                self._rotate("ry", target, (1.0, middle))
                self._rotate("rz", target, (1.0, last))
                return
            self._rotate("rz", target, (0.5, first), (-0.5, last))
            self.circuit.cx(control, target)
            self._rotate("rz", target, (-0.5, first), (-0.5, last))
            self._rotate("ry", target, (-0.5, middle))
            self.circuit.cx(control, target)
            self._rotate("ry", target, (0.5, middle))
            self._rotate("rz", target, (1.0, last))
        elif control is None:
            self._rotate(gate.lower(), target, (1.0, rows[0]))
        else:
            axis = "ry" if gate == "RY" else "rz"
            if gate == "RX":
                self.circuit.h(target)
            self._rotate(axis, target, (0.5, rows[0]))
            self.circuit.cx(control, target)
            self._rotate(axis, target, (-0.5, rows[0]))
            self.circuit.cx(control, target)
            if gate == "RX":
                self.circuit.h(target)

    def _rotate(self, name: str, qubit: int, *terms: tuple[float, int | float]) -> None:
        """Append a rotation by a linear combination of angles (rows of the table, or constants)."""
        parameter = Parameter(f"a{len(self._terms):05d}")
        self._terms.append(list(terms))
        self.parameters.append(parameter)
        getattr(self.circuit, name)(parameter, qubit)

    def __call__(self, angles: Tensor) -> Tensor:
        """Return rotation angles (lanes, R) from angles (A, lanes)."""
        # A product in fixed order: a matrix product's bits could depend on the number of lanes.
        return torch.stack([self._combine(terms, angles) for terms in self._terms], dim=1)

    def _combine(self, terms: list[tuple[float, int | float]], angles: Tensor) -> Tensor:
        total = angles.new_zeros(angles.shape[1])
        for factor, source in terms:
            total = total + factor * (angles[source] if isinstance(source, int) else source)
        return total


class QiskitBackend:
    """A circuit as an `EstimatorQNN`, see `qrlsuite.circuit.CircuitBackend`.

    Raises
    ------
    OptionError
        If options contradict each other, a noise model is unknown, or an optional package is missing.
    """

    def __init__(self, circuit: Circuit, options: QiskitOptions) -> None:
        circuit.require_simulable("qiskit")
        self.options = options
        self.shots: int | None = options.shots
        self.gradient = _gradient(options)
        self.table = AngleTable(circuit)
        self.rotations = Rotations(circuit, self.table)
        self.observables: list[Any] = [
            SparsePauliOp.from_sparse_list([("Z", [q], 1.0)], circuit.qubits) for q in circuit.observables
        ]
        self._circuit = self.rotations.circuit
        self._simulator = None if options.estimator == "statevector" else _simulator(options, circuit.qubits)
        if self._simulator is not None and _is_fake(options):
            from qiskit.transpiler import generate_preset_pass_manager

            manager = generate_preset_pass_manager(1, backend=self._simulator, seed_transpiler=0)
            self._circuit = manager.run(self._circuit)
            self.observables = [o.apply_layout(self._circuit.layout) for o in self.observables]

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None = None
    ) -> Tensor:
        """Return expectation values (S, B, observables), see `qrlsuite.circuit.CircuitBackend`."""
        S, B = inputs.shape[:2]
        exact = {name: value.double() for name, value in parameters.items()}
        angles = self.table(inputs.double(), exact).cpu()
        if self.shots is None:
            values = self._run(self._exact, self.rotations(angles.reshape(-1, S * B)), inputs.dtype)
            values = values.reshape(S, B, -1)
        else:
            entropy: Sequence[int | None] = [None] * S if seeds is None else seeds
            values = torch.stack(
                [
                    self._run(self._network(seed), self.rotations(angles[:, s]), inputs.dtype)
                    for s, seed in enumerate(entropy)
                ]
            )
        result: Tensor = values.to(inputs)
        return result

    @staticmethod
    def _run(network: EstimatorQNN, rotations: Tensor, dtype: torch.dtype) -> Tensor:
        """Return expectation values (lanes, observables) from rotation angles (lanes, R)."""
        values: Tensor
        if dtype == torch.float32:
            values = TorchConnector(network, initial_weights=np.zeros(0))(rotations)
        else:
            values = _Float64Connector.apply(rotations, network)  # type: ignore[no-untyped-call]
        return values

    @functools.cached_property
    def _exact(self) -> EstimatorQNN:
        """The network without sampling; it has no state, so that one serves every call."""
        return self._network(None)

    def _network(self, seed: int | None) -> EstimatorQNN:
        """Return a network whose primitives and gradient draw from one seed."""
        sequence = np.random.SeedSequence(seed)
        precision = 0.0 if self.shots is None else 1.0 / math.sqrt(self.shots)
        primitives = [self._estimator(precision, child) for child in sequence.spawn(2)]
        return EstimatorQNN(
            circuit=self._circuit,
            estimator=primitives[0],
            observables=self.observables,
            input_params=self.rotations.parameters,
            weight_params=[],
            gradient=self._differentiator(primitives[1], sequence),
            input_gradients=True,
            default_precision=precision,
        )

    def _estimator(self, precision: float, seed: np.random.SeedSequence) -> Any:
        """Return a V2 estimator primitive."""
        if self._simulator is None:
            return QMLEstimator(default_precision=precision, seed=np.random.default_rng(seed))
        if self.shots is not None:
            number = int(seed.generate_state(1)[0] >> 1)
            return BackendEstimatorV2(
                backend=self._simulator,
                options={"default_precision": precision, "seed_simulator": number},
            )
        from qiskit_aer.primitives import EstimatorV2

        return EstimatorV2.from_backend(self._simulator, options={"default_precision": 0.0})

    def _differentiator(self, estimator: Any, sequence: np.random.SeedSequence) -> Any:
        """Return what computes gradients."""
        if self.gradient == "reverse":
            return importlib.import_module("qiskit_algorithms.gradients").ReverseEstimatorGradient()
        if self.gradient == "lin-comb":
            return LinCombEstimatorGradient(estimator)
        if self.gradient == "spsa":
            return SPSAEstimatorGradient(estimator, epsilon=0.01, seed=int(sequence.generate_state(1)[0]))
        return ParamShiftEstimatorGradient(estimator)


class _Float64Connector(torch.autograd.Function):
    """What `TorchConnector` does, in float64, for a network without weights."""

    @staticmethod
    def forward(ctx: Any, rotations: Tensor, network: EstimatorQNN) -> Tensor:
        ctx.save_for_backward(rotations)
        ctx.network = network
        return torch.from_numpy(network.forward(rotations.detach().numpy(), []))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (rotations,) = ctx.saved_tensors
        jacobian, _ = ctx.network.backward(rotations.numpy(), [])
        return torch.einsum("bo,bor->br", grads[0], torch.from_numpy(jacobian)), None


def _gradient(options: QiskitOptions) -> str:
    """Choose the fastest way to differentiate, or say why the one asked for cannot be done.

    Measured at 4 qubits, exact: reverse 2.1 s, lin-comb 7.7 s, parameter-shift 12.8 s for 5 inputs.
    """
    if options.noise_model is not None and options.estimator != "aer":
        raise OptionError(f"noise_model = '{options.noise_model}' needs estimator = 'aer'")
    exact = options.shots is None and options.estimator == "statevector"
    if options.gradient == "reverse" and not exact:
        raise OptionError(
            "gradient = 'reverse' needs estimator = 'statevector' without shots; use 'parameter-shift'"
        )
    if options.gradient == "reverse":
        _package("qiskit_algorithms", "gradient = 'reverse'", "qiskit-algorithms")
    if options.gradient == "auto" and exact:
        return "lin-comb" if importlib.util.find_spec("qiskit_algorithms") is None else "reverse"
    return "parameter-shift" if options.gradient == "auto" else options.gradient


def _is_fake(options: QiskitOptions) -> bool:
    return options.noise_model not in (None, "depolarizing")


def _simulator(options: QiskitOptions, qubits: int) -> Any:
    """Return an Aer simulator with the noise that the options ask for."""
    aer = _package("qiskit_aer", "estimator = 'aer'", "'qrlsuite[aer]'")
    _package("psutil", "estimator = 'aer'", "'qrlsuite[aer]'")
    noise = _package("qiskit_aer.noise", "estimator = 'aer'", "'qrlsuite[aer]'")
    if options.noise_model is None:
        return aer.AerSimulator(method="statevector")
    exact = {} if options.shots is not None else {"method": "density_matrix"}
    if options.noise_model == "depolarizing":
        _needs_shots(options, qubits, f"{qubits} qubits")
        model = noise.NoiseModel()
        model.add_all_qubit_quantum_error(noise.depolarizing_error(options.noise_rate / 10, 1), ONE_QUBIT)
        model.add_all_qubit_quantum_error(noise.depolarizing_error(options.noise_rate, 2), TWO_QUBIT)
        return aer.AerSimulator(noise_model=model, **exact)
    fake = _fake_backend(options.noise_model)
    if fake.num_qubits < qubits:
        raise OptionError(
            f"noise_model = '{options.noise_model}' has {fake.num_qubits} qubits, the circuit {qubits}"
        )
    _needs_shots(options, fake.num_qubits, f"the {fake.num_qubits} qubits of '{options.noise_model}'")
    return aer.AerSimulator.from_backend(fake, **exact)


def _needs_shots(options: QiskitOptions, qubits: int, setting: str) -> None:
    """Refuse density matrices that do not fit into memory."""
    if options.shots is None and qubits > DENSITY_QUBITS:
        raise OptionError(
            f"noise on {setting} cannot be simulated exactly (at most {DENSITY_QUBITS}); give a number of shots"
        )


def _fake_backend(name: str) -> Any:
    """Return a snapshot of a device by the name of its class."""
    setting = f"noise_model = '{name}' (not 'depolarizing', hence a fake backend)"
    fake_provider = _package("qiskit_ibm_runtime.fake_provider", setting, "qiskit-ibm-runtime")
    known = [n for n in dir(fake_provider) if n.startswith("Fake") and n != "FakeProviderForBackendV2"]
    if name not in known:
        raise OptionError(f"noise_model = '{name}' is unknown{nearest(name, ['depolarizing', *known])}")
    return getattr(fake_provider, name)()


def _package(module: str, setting: str, pip: str) -> Any:
    """Import an optional package, or say how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise OptionError(f"{setting}: package '{error.name}' is missing; pip install {pip}") from error
