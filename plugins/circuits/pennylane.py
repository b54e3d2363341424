"""Circuits on any PennyLane device.

Angles are computed in torch for all operations at once (`qrlsuite.circuit.angles`) and enter one QNode on PennyLane's
broadcast axis, seeds and batch together (lane = s * B + b). `default.qubit` simulates the whole axis in one pass and is
differentiated by backpropagation, as in the paper. `qrlsuite.native` does the same: the suite's own simulator, with
adjoint gradients. Devices that do not broadcast get PennyLane's own expansion into single circuits.

With a finite number of shots every seed is executed by itself, on a device seeded for it, and differentiated by
the parameter-shift rule. PennyLane's rule refuses broadcast circuits, so the shifted angles are put on the
broadcast axis here: one execution for the gradient of all angles of all samples.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pennylane as qml
import torch
from pennylane.exceptions import DeviceError, QuantumFunctionError
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from qrlsuite.circuit.angles import AngleTable
from qrlsuite.circuit.description import Circuit, Operation
from qrlsuite.circuit.shifts import measured, shift_rule
from qrlsuite.errors import OptionError, nearest
from qrlsuite.plugins.circuits.options import NOISE_FACTORS, PennyLaneOptions

BACKPROP = "default.qubit"
"""The device through which torch can differentiate.
`default.mixed` broadcasts too, but copies angles on the way (PennyLane 0.45), which cuts off their gradient."""

BROADCASTING = (BACKPROP, "qrlsuite.native")
"""The devices that simulate the broadcast axis in one pass."""

ADJOINT = ("lightning.", "qrlsuite.native")
"""Beginnings of the names of devices with adjoint gradients of their own."""

MEMORY = 2**30
"""Bytes that the states of one differentiated pass may take; more seeds are recomputed in the backward pass."""

LANE_MULTIPLE = 64 if torch.backends.cpu.get_cpu_capability() == "AVX512" else 16
"""Every seed's lanes are padded to a multiple of this. torch multiplies complex numbers with fused operations in
vectors and without them in the rest at the end, so that a lane's bits would depend on its place. Vectors of AVX-512
are twice as long as vectors of AVX2, and so is the rest: with 32, some lanes differed."""

SIMULATORS = (
    "default.",
    "lightning.",
    "qrlsuite.",
    "reference.",
    "null.",
    "simulator",
    "aer",
    "basicsim",
    "local",
    "qulacs",
    "qsim",
)
"""Words in the names of devices that only simulate; any other device is taken for hardware."""

PACKAGES = {
    "braket": "amazon-braket-pennylane-plugin",
    "cirq": "pennylane-cirq",
    "ionq": "pennylane-ionq",
    "lightning.gpu": "pennylane-lightning-gpu",
    "lightning.kokkos": "pennylane-lightning-kokkos",
    "qiskit": "pennylane-qiskit",
    "qulacs": "pennylane-qulacs",
}

GATES: dict[tuple[str, bool], Callable[..., Any]] = {
    ("RX", True): qml.CRX,
    ("RY", True): qml.CRY,
    ("RZ", True): qml.CRZ,
    ("Rot", True): qml.CRot,
    ("H", False): qml.Hadamard,
    ("X", False): qml.PauliX,
    ("Y", False): qml.PauliY,
    ("Z", False): qml.PauliZ,
}
"""Gates by name and whether they are controlled, where PennyLane's class of that name is not it."""


class PennyLaneBackend:
    """A circuit on a PennyLane device, see `qrlsuite.circuit.CircuitBackend`."""

    def __init__(self, circuit: Circuit, options: PennyLaneOptions) -> None:
        self.circuit = circuit
        self.options = options
        self.shots: int | None = options.shots
        self.simulator = not _on_braket(options) and any(word in options.device for word in SIMULATORS)
        self.table = AngleTable(circuit)
        self.diff_method = _diff_method(options)
        self._device = _device(options, circuit.qubits, None)
        self._qnode = self._compile()
        if _on_braket(options):
            self.terms = functools.partial(braket_terms, self._device.target_device._device, self.shots)
        if options.mitigation == "zero-noise":
            self.repeats = len(NOISE_FACTORS)

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None = None
    ) -> Tensor:
        """Return expectation values (S, B, observables), see `qrlsuite.circuit.CircuitBackend`."""
        # PennyLane's states are complex128 whatever the angles are, so float64 angles cost nothing.
        exact = {name: value.double() for name, value in parameters.items()}
        angles = self.table(inputs.double(), exact)
        if self.diff_method != "backprop":
            angles = angles.cpu()  # only default.qubit itself computes where torch's tensors are
        return self._evaluate(angles, seeds).to(inputs)

    def _evaluate(self, angles: Tensor, seeds: Sequence[int] | None) -> Tensor:
        """Return expectation values (S, B, observables) from angles (A, S, B)."""
        S, B = angles.shape[1:]
        if self.shots is not None:
            entropy = [None] * S if seeds is None else seeds
            return torch.stack(
                [self._shifted(angles[:, s], _entropy(seed)) for s, seed in enumerate(entropy)]
            )
        if self.diff_method == "parameter-shift":
            return torch.stack([self._shifted(angles[:, s], None) for s in range(S)])
        step = self._seeds_per_pass(B, angles.requires_grad)
        if step >= S:
            return self._pass(angles)
        passes = []
        for start in range(0, S, step):
            some = angles[:, start : start + step]
            if angles.requires_grad:
                passes.append(checkpoint(self._pass, some, use_reentrant=False, preserve_rng_state=False))
            else:
                passes.append(self._pass(some))
        return torch.cat(passes)

    def execute(self, angles: Tensor, lanes: int, seed: int | None = None) -> Tensor:
        """Run the circuit once per lane: angles (A, lanes) to expectation values (lanes, observables).

        Parameters
        ----------
        angles:
            Radians; differentiable as the device differentiates.
        lanes:
            Number of lanes, needed where no angle is variable.
        seed:
            Seed of the device's sampling; None draws fresh entropy.
        """
        qnode = self._qnode
        if self.shots is not None and "seed" in self._device_arguments():
            qnode = self._build(_device(self.options, self.circuit.qubits, _entropy(seed)))
        try:
            with _float64():
                values = [torch.as_tensor(value).to(angles.dtype) for value in qnode(angles)]
        except (DeviceError, QuantumFunctionError) as error:
            raise self._refusal(error) from error
        return torch.stack([value.expand(lanes) for value in values], dim=1)

    def _pass(self, angles: Tensor) -> Tensor:
        """Return (S, B, observables) from angles (A, S, B) in one execution."""
        count, S, B = angles.shape
        if self.diff_method == "adjoint":
            flat = angles.reshape(count, S * B)
            lanes: Tensor = _DeviceGradient.apply(flat, self, S * B)  # type: ignore[no-untyped-call]
            return lanes.reshape(S, B, -1)
        padded = torch.nn.functional.pad(angles, (0, -B % LANE_MULTIPLE))
        width = padded.shape[2]
        return self.execute(padded.reshape(count, S * width), S * width).reshape(S, width, -1)[:, :B]

    def _shifted(self, angles: Tensor, seed: int | None) -> Tensor:
        """Return one seed's values (B, observables) from its angles (A, B), differentiated by shifts."""

        def execute(some: Tensor, call: int) -> Tensor:
            own = seed if seed is None or call == 0 else _entropy(seed, 1, call - 1)
            return self.execute(some, some.shape[1], own)

        return measured(angles, execute, shift_rule(self.table.controlled), self.lanes_per_pass())

    def lanes_per_pass(self) -> int:
        """Return how many lanes one execution without gradients takes, so that its states fit in memory."""
        return max(1, MEMORY // (4 * 16 * (1 << self.circuit.qubits)))

    def _seeds_per_pass(self, B: int, differentiated: bool) -> int:
        """Return how many seeds one execution takes, so that its states fit in memory."""
        states = len(self.circuit) // 2 if differentiated and self.diff_method == "backprop" else 1
        return max(1, self.lanes_per_pass() // (max(1, states) * B))

    def _build(self, device: Any) -> Any:

        def measure(angles: Tensor) -> list[Any]:
            rows = list(angles) if self.table.count else []
            for operation, indices in zip(self.circuit, self.table.rows):
                _apply(operation, _arguments(indices, rows))
            return [
                qml.expval(qml.prod(*map(qml.PauliZ, qubits)) if len(qubits) > 1 else qml.PauliZ(qubits[0]))
                for qubits in self.circuit.measured
            ]

        # The shift rule is applied outside, so that the QNode need not be differentiable.
        method = None if self.diff_method == "parameter-shift" else self.diff_method
        qnode = qml.QNode(measure, device, interface="torch", diff_method=method, shots=self.shots)
        if self.options.device in BROADCASTING:
            return qnode
        alone = qml.transforms.broadcast_expand(qnode)
        if self.options.mitigation == "none":
            return alone
        noise = qml.noise
        return noise.mitigate_with_zne(alone, NOISE_FACTORS, noise.fold_global, noise.richardson_extrapolate)

    def _device_arguments(self) -> set[str]:
        return set(inspect.signature(type(self._device)).parameters)

    def _compile(self) -> Any:
        """Return the QNode, tried on the device, which finds gates and gradients that it lacks."""
        angles = torch.zeros(self.table.count, 2, dtype=torch.float64)
        angles.requires_grad_(self.table.count > 0)
        try:
            qnode = self._build(self._device)
            qml.workflow.construct_batch(qnode, level="device")(angles)
        except Exception as error:
            raise self._refusal(error) from error
        return qnode

    def _refusal(self, error: Exception) -> OptionError:
        return OptionError(
            f"device = {self.options.device!r} with diff_method = {self.diff_method!r} cannot run this circuit: "
            f"{_one_line(error)}"
        )


class _DeviceGradient(torch.autograd.Function):
    """Values of all lanes, and their gradient as PennyLane and the device compute it, both in float64."""

    @staticmethod
    def forward(ctx: Any, angles: Tensor, backend: PennyLaneBackend, lanes: int) -> Tensor:
        ctx.angles = angles.detach().requires_grad_(angles.requires_grad)
        with torch.set_grad_enabled(angles.requires_grad):
            values = backend.execute(ctx.angles, lanes)
        ctx.values = values
        return values.detach()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        with _float64():
            (result,) = torch.autograd.grad(ctx.values, ctx.angles, grads)
        return result, None, None


@contextlib.contextmanager
def _float64() -> Iterator[None]:
    """Let torch read a device's Python floats as float64; PennyLane converts them by torch's default type."""
    previous = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(previous)


def _arguments(indices: Sequence[int | float], rows: Sequence[Tensor]) -> list[Tensor | float]:
    """Return a gate's angles; beside variable ones constants are tensors too, Rot refuses a mixture."""
    if not any(isinstance(i, int) for i in indices):
        return list(indices)
    return [rows[i] if isinstance(i, int) else torch.full_like(rows[0], i) for i in indices]


def _apply(operation: Operation, angles: list[Any]) -> None:
    gate, wires, control = operation.gate, list(operation.wires), operation.control
    factory = GATES.get((gate, control is not None))
    if control is None:
        (factory or getattr(qml, gate))(*angles, wires=wires)
    elif factory is not None:
        factory(*angles, wires=[control, *wires])
    else:
        qml.ctrl(getattr(qml, gate), control=control)(*angles, wires=wires)


def _diff_method(options: PennyLaneOptions) -> str:
    """Choose how to differentiate, or say why it cannot be done."""
    backprop = options.device == BACKPROP
    if options.mitigation != "none" and (backprop or options.device.startswith(ADJOINT)):
        raise OptionError(f"mitigation = '{options.mitigation}': device '{options.device}' has no noise")
    if options.diff_method == "auto":
        if options.shots is not None:
            return "parameter-shift"
        return (
            "backprop" if backprop else "adjoint" if options.device.startswith(ADJOINT) else "parameter-shift"
        )
    if options.shots is not None and options.diff_method != "parameter-shift":
        raise OptionError(
            f"diff_method = '{options.diff_method}' needs exact states; with shots = {options.shots} "
            "use 'parameter-shift' or 'auto'"
        )
    if options.diff_method == "backprop" and not backprop:
        raise OptionError(
            f"diff_method = 'backprop' is not possible on device '{options.device}', only on '{BACKPROP}'; "
            "use 'adjoint', 'parameter-shift' or 'auto'"
        )
    return options.diff_method


def _device(options: PennyLaneOptions, qubits: int, seed: int | None) -> Any:
    seeded: dict[str, Any] = {} if seed is None else {"seed": seed}
    name = options.device
    if _on_braket(options):
        name, seeded = "braket.aws.qubit", {**seeded, "device_arn": options.device}
    state = np.random.get_state()  # noqa: NPY002 - without a seed, a device draws one from this generator
    try:
        return qml.device(name, wires=qubits, **seeded)
    except Exception as error:
        known = sorted(qml.plugin_devices)
        message = f"device = {options.device!r} cannot be opened"
        if name in known:
            reason = _one_line(error)
            if _on_braket(options):
                reason += " (`aws configure` sets region and account)"
            raise OptionError(f"{message} with {qubits} qubits: {reason}") from error
        for prefix, package in PACKAGES.items():
            if name == prefix or name.startswith(f"{prefix}."):
                raise OptionError(f"{message}: its package is missing; pip install {package}") from error
        raise OptionError(
            f"{message}: PennyLane knows no such device{nearest(options.device, known)}"
        ) from error
    finally:
        np.random.set_state(state)  # noqa: NPY002


def _on_braket(options: PennyLaneOptions) -> bool:
    """Return whether the device is Amazon's, where simulators cost money, too."""
    return options.device.startswith("arn:")


def braket_terms(device: Any, shots: int | None, circuits: int) -> str:
    """Return the number of tasks that wait at an `AwsDevice` and the price of a number of circuits, in words."""
    cost = device.properties.service.deviceCost
    waiting = ", ".join(
        f"{kind.value}: {count}" for kind, count in device.queue_depth().quantum_tasks.items()
    )
    whole = f", ${cost.price * circuits * (shots or 0):,.2f} in all" if cost.unit == "shot" else ""
    return f"tasks that wait: {waiting}; ${cost.price:g} a {cost.unit}{whole}, and Amazon's price of {circuits:,} tasks"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _entropy(seed: int | None, *path: int) -> int:
    """Return 63 bits derived from a seed and a path of integers; fresh ones where the seed is None."""
    state = np.random.SeedSequence(None if seed is None else [seed, *path])
    return int(state.generate_state(1, np.uint64)[0] >> np.uint64(1))
