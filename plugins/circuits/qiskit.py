"""Circuits in Qiskit, executed by Aer: all lanes (seeds x batch) in one call of a V2 primitive.

The circuit is written in elementary gates (`qrlsuite.circuit.elementary`), and every rotation angle is a parameter of
its own; a fixed linear map in torch leads from the circuit's angles to them. Controlled rotations are avoided because
reverse gradients refuse them and Aer 0.18 with run-time parameters gives wrong values for them.

Exact expectation values are differentiated by the adjoint method of the native simulator: the same function, computed
by other means, which takes milliseconds instead of minutes. Everything else (shots, noise) is differentiated by
executing circuits: the parameter-shift rule with all shifted circuits of a batch in one call, or SPSA.

With shots every seed gets primitives of its own, seeded by it. `estimator = "aer"` draws bit strings, and all
observables of an input come from the same ones. `estimator = "statevector"` does not sample: it adds Gaussian noise of
standard deviation 1/sqrt(shots), the most that sampling can have (as `qiskit.primitives.StatevectorEstimator` does).
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from qiskit import QuantumCircuit, transpile
from qiskit.circuit import ParameterVector
from qiskit.quantum_info import SparsePauliOp
from torch import Tensor

from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.description import Circuit
from qrlsuite.circuit.elementary import Elementary
from qrlsuite.circuit.shifts import measured, random_signs, shift_rule, spsa_rule, stream
from qrlsuite.errors import OptionError, nearest
from qrlsuite.plugins.circuits.native import NativeBackend
from qrlsuite.plugins.circuits.options import NOISE_FACTORS, QiskitOptions
from qrlsuite.plugins.circuits.runtime import Runtime, fake_device, open_device

DENSITY_QUBITS = 12
"""Qubits up to which noise is simulated exactly, as a density matrix; beyond, shots are needed."""

LANES_PER_CALL = 20_000
"""Circuits of one call; their results are a few kB each."""

ONE_QUBIT, TWO_QUBIT = ["rx", "ry", "rz", "h", "x", "y", "z", "s", "t"], ["cx", "cz", "swap"]


def quantum_circuit(elementary: Elementary, qubits: int) -> QuantumCircuit:
    """Return elementary gates as a Qiskit circuit with one parameter per rotation, in order."""
    circuit = QuantumCircuit(qubits)
    parameters = ParameterVector("angle", elementary.rotations)
    for name, wires, rotation in elementary.gates:
        append = getattr(circuit, "cx" if name == "CNOT" else name.lower())
        append(*wires) if rotation is None else append(parameters[rotation], *wires)
    return circuit


class QiskitBackend:
    """A circuit on a simulator of Qiskit's, see `qrlsuite.circuit.CircuitBackend`."""

    def __init__(self, circuit: Circuit, options: QiskitOptions) -> None:
        self.options = options
        self.shots: int | None = options.shots
        self.noisy = options.noise_model is not None or options.device is not None
        self.gradient = _gradient(options)
        self.draws = self.shots is not None or self.gradient == "spsa"
        self.table = AngleTable(circuit)
        self.elementary = Elementary(circuit, self.table)
        self.gradient_circuits = 2 if self.gradient == "spsa" else 2 * self.elementary.rotations
        self._native = NativeBackend(circuit) if self.gradient == "adjoint" else None
        self._circuit = quantum_circuit(self.elementary, circuit.qubits)
        self._products = circuit.measured
        self._measured = sorted({q for qubits in self._products for q in qubits})
        self._simulator: Any = None if options.device else _simulator(options, circuit.qubits)
        self._samples = self.shots is not None and options.estimator == "aer"
        self.observables = [
            SparsePauliOp.from_sparse_list([("Z" * len(qubits), qubits, 1.0)], circuit.qubits)
            for qubits in self._products
        ]
        self._executed = self._circuit
        if self._samples:
            self._executed = QuantumCircuit(circuit.qubits, len(self._measured))
            self._executed.compose(self._circuit, inplace=True)
            self._executed.measure(self._measured, range(len(self._measured)))
        if options.noise_model not in (None, "depolarizing"):  # a fake device
            self._executed = transpile(
                self._executed, self._simulator, seed_transpiler=0, optimization_level=1
            )
            self.observables = [o.apply_layout(self._executed.layout) for o in self.observables]
        self._runtime: Runtime | None = None
        if options.device:
            device = _device(options.device, circuit.qubits)
            self._runtime = Runtime(options, device, self._circuit, self.observables)
            self.simulator = fake_device(options.device)
            self.terms = self._runtime.terms
            self.repeats = len(NOISE_FACTORS) if options.mitigation == "zero-noise" else 1

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None = None
    ) -> Tensor:
        """Return expectation values (S, B, observables), see `qrlsuite.circuit.CircuitBackend`."""
        S, B = inputs.shape[:2]
        names = list(parameters)
        exact = [inputs.double().cpu(), *(parameters[name].double().cpu() for name in names)]
        if self.gradient == "adjoint":
            values: Tensor = _Adjoint.apply(self, names, *exact)  # type: ignore[no-untyped-call]
            return values.to(inputs)
        rotations = self._rotations(exact[0], dict(zip(names, exact[1:])))
        if self.gradient == "lin-comb":
            values = _Network.apply(rotations.reshape(-1, S * B), self.network())  # type: ignore[no-untyped-call]
            values = values.reshape(S, B, -1)
        elif self.draws and (self._runtime is None or rotations.requires_grad):
            entropy: Sequence[int | None] = [None] * S if seeds is None else seeds
            values = torch.stack([self._sampled(rotations[:, s], seed) for s, seed in enumerate(entropy)])
        else:
            rule = shift_rule([False] * self.elementary.rotations)
            flat = rotations.reshape(-1, S * B)
            values = measured(flat, lambda some, call: self._execute(some), rule).reshape(S, B, -1)
        return values.to(inputs)

    def network(self) -> Any:
        """Return the circuit as an `EstimatorQNN` of qiskit-machine-learning whose inputs are the rotation angles.

        It computes exact values with Qiskit's own `StatevectorEstimator`; `TorchConnector(network)` makes a torch
        module of it.
        """
        from qiskit_machine_learning.gradients import LinCombEstimatorGradient, ParamShiftEstimatorGradient
        from qiskit_machine_learning.neural_networks import EstimatorQNN
        from qiskit_machine_learning.primitives import QMLEstimator

        primitive = QMLEstimator(default_precision=0.0)
        kind = LinCombEstimatorGradient if self.gradient == "lin-comb" else ParamShiftEstimatorGradient
        return EstimatorQNN(
            circuit=self._circuit,
            estimator=primitive,
            observables=self.observables,
            input_params=list(self._circuit.parameters),
            weight_params=[],
            gradient=kind(primitive),
            input_gradients=True,
            default_precision=0.0,
        )

    def _rotations(self, inputs: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return rotation angles (R, S, B) in float64."""
        angles = self.table(inputs, parameters)
        count, S, B = angles.shape
        return self.elementary(angles.reshape(count, S * B)).reshape(-1, S, B)

    def _sampled(self, rotations: Tensor, seed: int | None) -> Tensor:
        """Return one seed's values (B, observables) from its rotation angles (R, B), drawn from its own stream."""
        own = np.random.SeedSequence(seed).entropy
        rule = shift_rule([False] * self.elementary.rotations)
        if self.gradient == "spsa":
            rule = spsa_rule(random_signs(stream(own, 0, 0, 0)))
        return measured(rotations, lambda some, call: self._execute(some, own, call), rule)

    def _execute(self, rotations: Tensor, entropy: Any = 0, call: int = 0) -> Tensor:
        """Run the circuit once per lane: rotation angles (R, lanes) to expectation values (lanes, observables)."""
        values = [
            self._call(some.T.numpy(), stream(entropy, call, number))
            for number, some in enumerate(torch.split(rotations, LANES_PER_CALL, dim=1))
        ]
        return torch.from_numpy(np.concatenate(values))

    def _call(self, rotations: NDArray[np.float64], stream: np.random.SeedSequence) -> NDArray[np.float64]:
        """Return expectation values (lanes, observables) of rotation angles (lanes, R) from one call."""
        from qiskit_aer.primitives import EstimatorV2

        number = int(stream.generate_state(1)[0] >> 1)
        if self._runtime is not None:
            return self._runtime(rotations, number)
        if self._samples:
            return self._count(rotations, number)
        precision = 0.0 if self.shots is None else 1.0 / math.sqrt(self.shots)
        options = {"default_precision": precision, "run_options": {"seed_simulator": number}}
        estimator = EstimatorV2.from_backend(self._simulator, options=options)
        # A circuit without parameters has one result, whatever the number of lanes.
        pub = (self._executed, [[o] for o in self.observables], *([rotations] if rotations.shape[1] else []))
        (result,) = estimator.run([pub]).result()
        means = np.asarray(result.data.evs, np.float64).reshape(len(self.observables), -1).T
        if self.options.noise_model is not None:  # the density matrix is before the readout
            weights = [len(qubits) for qubits in self._products]
            means = means * (1.0 - 2.0 * self.options.readout_error) ** np.array(weights)
        return np.broadcast_to(means, (len(rotations), len(self.observables)))

    def _count(self, rotations: NDArray[np.float64], number: int) -> NDArray[np.float64]:
        """Return the means of observables (lanes, observables), each lane's from the same bit strings.

        Counts, because Aer's `SamplerV2` keeps every shot as a text: 60 kB for 1000 shots of one circuit.
        """
        lanes, shots = len(rotations), self.shots
        binds = {p: rotations[:, i].tolist() for i, p in enumerate(self._circuit.parameters)}
        given = {"parameter_binds": [binds]} if binds else {}
        copies = self._executed if binds else [self._executed] * lanes
        result = self._simulator.run(copies, shots=shots, seed_simulator=number, **given).result()
        place = {qubit: bit for bit, qubit in enumerate(self._measured)}
        members = np.zeros((len(place), len(self._products)), np.int64)
        for o, qubits in enumerate(self._products):
            members[[place[q] for q in qubits], o] = 1
        means = np.empty((lanes, len(self._products)))
        for lane, experiment in enumerate(result.results):
            counts = experiment.data.counts
            outcomes = np.array([int(outcome, 16) for outcome in counts])
            odd = ((outcomes[:, None] >> np.arange(len(place)) & 1) @ members) % 2
            means[lane] = 1.0 - 2.0 * np.array(list(counts.values())) @ odd / shots
        return means


class _Adjoint(torch.autograd.Function):
    """Qiskit's values, and the gradient of the same function by the native simulator, both in float64."""

    @staticmethod
    def forward(ctx: Any, backend: QiskitBackend, names: list[str], *given: Tensor) -> Tensor:
        ctx.save_for_backward(*given)
        ctx.backend, ctx.names = backend, names
        S, B = given[0].shape[:2]
        rotations = backend._rotations(given[0], dict(zip(names, given[1:])))
        return backend._execute(rotations.reshape(-1, S * B)).reshape(S, B, -1)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        leaves = [each.detach().requires_grad_(True) for each in ctx.saved_tensors]
        with torch.enable_grad():
            values = ctx.backend._native(leaves[0], dict(zip(ctx.names, leaves[1:])))
        return None, None, *torch.autograd.grad(values, leaves, grads[0])


class _Network(torch.autograd.Function):
    """An `EstimatorQNN` in float64; `TorchConnector` hands everything over in float32."""

    @staticmethod
    def forward(ctx: Any, rotations: Tensor, network: Any) -> Tensor:
        ctx.save_for_backward(rotations)
        ctx.network = network
        return torch.from_numpy(network.forward(rotations.T.numpy(), []))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (rotations,) = ctx.saved_tensors
        jacobian, _ = ctx.network.backward(rotations.T.numpy(), [])
        return torch.einsum("bo,bor->rb", grads[0], torch.from_numpy(jacobian)), None


def _gradient(options: QiskitOptions) -> str:
    """Choose the fastest way to differentiate, or say why the one asked for cannot be done."""
    _check_device(options)
    if options.noise_model is not None and options.estimator != "aer":
        raise OptionError(f"noise_model = '{options.noise_model}' needs estimator = 'aer'")
    if options.readout_error > 0 and options.noise_model != "depolarizing":
        raise OptionError(f"readout_error = {options.readout_error:g} needs noise_model = 'depolarizing'")
    exact = options.shots is None and options.noise_model is None
    if options.gradient == "reverse":
        raise OptionError(
            "gradient = 'reverse' of qiskit-algorithms is no longer there: 'adjoint' gives the same slopes, faster"
        )
    if options.gradient == "auto":
        return "adjoint" if exact else "parameter-shift"
    if options.gradient in ("adjoint", "lin-comb") and not exact:
        raise OptionError(
            f"gradient = '{options.gradient}' needs exact states, without shots and noise; use 'parameter-shift', "
            "'spsa' or 'auto'"
        )
    return options.gradient


def _check_device(options: QiskitOptions) -> None:
    """Refuse options that a device does not have, or only a device has."""
    if options.device is None:
        if options.mitigation != "none":
            raise OptionError(
                f"mitigation = '{options.mitigation}' needs a device, such as device=FakeManilaV2"
            )
        return
    if options.shots is None:
        raise OptionError(f"device = '{options.device}' measures: say how often, such as shots=1000")
    if options.noise_model is not None or options.estimator != "statevector":
        raise OptionError(
            f"device = '{options.device}' has its own noise: leave out noise_model and estimator, which are Aer's"
        )


def _device(name: str, qubits: int) -> Any:
    """Return an IBM device, or a fake one, by its name."""
    _package("qiskit_ibm_runtime.executor_estimator", f"device = '{name}'", "qiskit-ibm-runtime")
    if fake_device(name):
        return _fake_backend(name, qubits, "device")
    return open_device(name)


def _simulator(options: QiskitOptions, qubits: int) -> Any:
    """Return an Aer simulator with the noise that the options ask for."""
    from qiskit_aer import AerSimulator, noise

    if options.noise_model is None:
        # Angles bound in the simulator take half the time, but then Aer simulates shot by shot.
        binds = options.shots is None or options.estimator == "statevector"
        return AerSimulator(method="statevector", runtime_parameter_bind_enable=binds, max_parallel_threads=1)
    method = "automatic" if options.shots is not None else "density_matrix"
    if options.noise_model == "depolarizing":
        _needs_shots(options, qubits, f"{qubits} qubits")
        model = noise.NoiseModel()
        model.add_all_qubit_quantum_error(noise.depolarizing_error(options.noise_rate / 10, 1), ONE_QUBIT)
        model.add_all_qubit_quantum_error(noise.depolarizing_error(options.noise_rate, 2), TWO_QUBIT)
        wrong = options.readout_error
        model.add_all_qubit_readout_error([[1 - wrong, wrong], [wrong, 1 - wrong]])
        return AerSimulator(noise_model=model, method=method, max_parallel_threads=1)
    fake = _fake_backend(options.noise_model, qubits)
    if fake.num_qubits < qubits:
        raise OptionError(
            f"noise_model = '{options.noise_model}' has {fake.num_qubits} qubits, the circuit {qubits}"
        )
    _needs_shots(options, fake.num_qubits, f"the {fake.num_qubits} qubits of '{options.noise_model}'")
    return AerSimulator.from_backend(fake, method=method, max_parallel_threads=1)


def _needs_shots(options: QiskitOptions, qubits: int, setting: str) -> None:
    """Refuse density matrices that do not fit into memory."""
    if options.shots is None and qubits > DENSITY_QUBITS:
        raise OptionError(
            f"noise on {setting} cannot be simulated exactly (at most {DENSITY_QUBITS}); give a number of shots"
        )


def _fake_backend(name: str, qubits: int, option: str = "noise_model") -> Any:
    if name == "GenericBackendV2":
        from qiskit.providers.fake_provider import GenericBackendV2

        size = max(2, qubits)
        line = [[q + up, q + 1 - up] for q in range(size - 1) for up in (0, 1)]
        return GenericBackendV2(size, coupling_map=line, seed=0)
    setting = f"{option} = '{name}' (not 'depolarizing' or 'GenericBackendV2', hence a fake backend)"
    fake_provider = _package("qiskit_ibm_runtime.fake_provider", setting, "qiskit-ibm-runtime")
    known = [n for n in dir(fake_provider) if n.startswith("Fake") and n != "FakeProviderForBackendV2"]
    if name not in known:
        choices = [*(["depolarizing"] if option == "noise_model" else []), "GenericBackendV2", *known]
        raise OptionError(f"{option} = '{name}' is unknown{nearest(name, choices)}")
    return getattr(fake_provider, name)()


def _package(module: str, setting: str, pip: str) -> Any:
    """Import an optional package, or say how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise OptionError(f"{setting}: package '{error.name}' is missing; pip install {pip}") from error
