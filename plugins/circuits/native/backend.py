"""`NativeBackend`: the suite's own simulator behind the interface of every circuit backend."""

from __future__ import annotations

import copy
import importlib.util
import os
import sys
from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from qrlsuite.circuit import Circuit
from qrlsuite.device import LateChecks
from qrlsuite.errors import CircuitError, OptionError
from qrlsuite.plugins.circuits.native import dense
from qrlsuite.plugins.circuits.native.program import Program, compile_circuit
from qrlsuite.plugins.circuits.options import NativeOptions

if TYPE_CHECKING:
    from qrlsuite.plugins.circuits.native import gpu
    from qrlsuite.plugins.circuits.native.cpu import Simulator
    from qrlsuite.plugins.circuits.native.sampling import ShotSampler

NOT_FINITE = "the circuit's inputs or parameters are not finite (NaN or infinite)"
NOT_FINITE_LATE = f"{NOT_FINITE}, or an angle is too large: make learning rates or initial parameters smaller"
ROUNDED = {torch.float32: "1e7", torch.float64: "1e15"}
"""Angles from which on a number is rounded by about a radian: sine and cosine of it mean nothing."""


class NativeBackend:
    """Batched statevector simulation, see `qrlsuite.circuit.CircuitBackend`.

    Exact values have adjoint gradients; shots and noise are described in `sampling`, and computed on the CPU. There
    compiled kernels run on one thread. Tensors on an NVIDIA GPU are computed there, by kernels of its own (see `gpu`);
    mean-field approximations, circuits of more than 14 connected qubits, and everything where package `numba-cuda` is
    missing, by plain torch operations. Memory is constant in depth: 2^(n + 1) numbers per lane and state. Mean-field
    approximations of circuits take 3 numbers per qubit and 6 per gate.

    Parameters
    ----------
    circuit:
        The circuit to run; its whole content is copied here, later changes have no effect.
    options:
        Shots, noise and gradient; by default values are exact.

    Attributes
    ----------
    draws, gradient_circuits:
        Whether results are random, and if so how many circuits a gradient takes per input.
    """

    def __init__(self, circuit: Circuit, options: NativeOptions | None = None) -> None:
        if not circuit.measures_z:
            raise CircuitError("observables of other Paulis are measured as Pauli Z by `create_backend`")
        self.options = NativeOptions() if options is None else options
        _check(self.options, circuit)
        self.shots = self.options.shots
        self.noisy = self.options.noise_model is not None
        self.draws = self.shots is not None or self.noisy or self.options.gradient == "spsa"
        self.circuit = copy.deepcopy(circuit)
        self.shapes = {name: p.shape for name, p in circuit.parameters.items()}
        self._simulator: Simulator | None = None
        self._sampler: ShotSampler | None = None
        if self.draws or self.options.gradient != "auto":
            from qrlsuite.plugins.circuits.native.sampling import ShotSampler

            self._sampler = ShotSampler(self.circuit, self.options)
            self.gradient_circuits = self._sampler.gradient_circuits

    def __call__(
        self, inputs: Tensor, parameters: Mapping[str, Tensor], seeds: Sequence[int] | None = None
    ) -> Tensor:
        """Return expectation values (S, B, O), differentiable by inputs and parameters.

        Parameters
        ----------
        inputs:
            (S, B, I), float32 or float64.
        parameters:
            Every declared parameter by name, (S, *shape), of the inputs' dtype and device.
        seeds:
            One per seed where shots or noise are simulated; see `qrlsuite.circuit.CircuitBackend`.
        """
        self._check(inputs, parameters)
        if self._sampler is not None:
            there = {name: value.cpu() for name, value in parameters.items()}
            if not all(bool(torch.isfinite(v.detach().sum())) for v in (inputs, *there.values())):
                raise OptionError(NOT_FINITE)
            return self._sampler(inputs.cpu(), there, seeds).to(inputs)
        flat = self._flat(inputs, parameters)
        result = self._run(inputs, flat)
        finite = torch.isfinite(result.detach().sum())
        late = not result.is_cpu and LateChecks.note(self, finite, OptionError(NOT_FINITE_LATE))
        if not late and not bool(finite):
            raise OptionError(_cause(inputs, flat))
        return result

    def states(self, inputs: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the final states (S, B, 2^n), see `qrlsuite.circuit.CircuitBackend`."""
        if self.circuit.mean_field:
            raise OptionError("the mean-field approximation of a circuit has no state of all qubits")
        self._check(inputs, parameters)
        return dense.states(self.circuit, inputs, self._flat(inputs, parameters))

    def _flat(self, inputs: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return all parameters of every seed in a row (S, P)."""
        size = inputs.shape[0]
        if not self.shapes:
            return inputs.new_zeros((size, 0))
        return torch.cat([parameters[name].reshape(size, -1) for name in self.shapes], dim=1)

    @property
    def sweeps(self) -> bool:
        """Whether circuits are computed by the kernels that a hybrid network's sweep has (`hybrid`)."""
        return self._sampler is None and not self.circuit.mean_field

    def compile_for(self, like: Tensor) -> None:
        """Compile the kernels, or load them, by a pass there and back of one sample of that dtype and device."""
        inputs = torch.zeros(
            (1, 1, self.circuit.inputs), dtype=like.dtype, device=like.device, requires_grad=True
        )
        parameters = {
            name: torch.zeros((1, *shape), dtype=like.dtype, device=like.device, requires_grad=True)
            for name, shape in self.shapes.items()
        }
        values = self(inputs, parameters, [0])
        if values.requires_grad:
            values.sum().backward()

    def _run(self, inputs: Tensor, flat: Tensor) -> Tensor:
        """Return expectation values (S, B, O) of inputs and flat parameters (S, P), computed where these are."""
        if inputs.device.type == "cpu":
            return self.simulator()(inputs, flat)
        for simulator in self.gpu_simulators:
            if simulator.takes(inputs):
                return simulator(inputs, flat)
        return self.by_torch(inputs, flat)

    def by_torch(self, inputs: Tensor, flat: Tensor) -> Tensor:
        """Return the same by torch operations, on any device."""
        if self.circuit.mean_field:
            from qrlsuite.plugins.circuits.native import mean_field

            return dense.mean_field_expectations(mean_field.compile_circuit(self.circuit), inputs, flat)
        return dense.expectations(self.program, inputs, flat)

    @cached_property
    def program(self) -> Program:
        """The program for devices other than the CPU: steps on the whole state, made when first needed."""
        return compile_circuit(self.circuit)

    @cached_property
    def gpu_simulators(self) -> list[gpu.GPUSimulator]:
        """The simulators on NVIDIA GPUs, the first choice first; none of mean-field circuits, or where all fail."""
        made: list[gpu.GPUSimulator] = []
        if self.circuit.mean_field or trouble() is not None:
            return made
        from qrlsuite.plugins.circuits.native import gpu, registers

        if os.environ.get("QRLSUITE_CAPTURE") == "1" and registers_trouble() is None:
            made.append(registers.RegisterSimulator(self.program))
        return [*made, gpu.GPUSimulator(self.program)]

    def gpu_trouble(self) -> str | None:
        """Return why circuits do not run by kernels on a GPU here, None where they do."""
        return trouble()

    def simulator(self) -> Simulator:
        """Return the CPU simulator, made when first needed."""
        if self._simulator is None:
            from qrlsuite.plugins.circuits.native.cpu import Simulator

            self._simulator = Simulator(self.circuit)
        return self._simulator

    def _check(self, inputs: Tensor, parameters: Mapping[str, Tensor]) -> None:
        if inputs.dim() != 3 or inputs.shape[2] != self.circuit.inputs or 0 in inputs.shape[:2]:
            raise OptionError(
                f"inputs have shape {tuple(inputs.shape)}: this circuit needs (seeds, batch, {self.circuit.inputs})"
            )
        if inputs.dtype not in (torch.float32, torch.float64):
            raise OptionError(
                f"inputs have dtype {inputs.dtype}: circuits are computed in float32 or float64"
            )
        for name, shape in self.shapes.items():
            value = parameters.get(name)
            if value is None:
                raise OptionError(f"parameter '{name}' of shape {(inputs.shape[0], *shape)} is missing")
            if tuple(value.shape) != (inputs.shape[0], *shape):
                expected = (inputs.shape[0], *shape)
                raise OptionError(
                    f"parameter '{name}' has shape {tuple(value.shape)}, expected is {expected}"
                )
            if value.dtype != inputs.dtype:
                raise OptionError(f"parameter '{name}' has dtype {value.dtype}, the inputs {inputs.dtype}")

    def __deepcopy__(self, memo: dict[int, Any]) -> NativeBackend:
        return self


@cache
def trouble() -> str | None:
    """Return why kernels do not run on a GPU here, None where they do; said once, for torch operations are slower."""
    if importlib.util.find_spec("numba_cuda") is None:
        problem = "pip install 'numba-cuda[cu13]' 'numpy<2.5'"
    else:
        try:
            from qrlsuite.plugins.circuits.native import gpu

            if gpu.computes_right():
                return None
            problem = "numba-cuda computes wrong numbers here"
        except Exception as error:  # whatever a driver, a toolkit, or another version of numpy makes of it
            problem = f"numba-cuda fails here with {type(error).__name__}: {error}"
    print(
        f"qrlsuite: circuits run on this GPU by plain torch operations, many times slower than by kernels: {problem}",
        file=sys.stderr,
        flush=True,
    )
    return problem


@cache
def registers_trouble() -> str | None:
    """Return why kernels in registers do not run on a GPU here, None where they do; said once."""
    try:
        from qrlsuite.plugins.circuits.native import gpu, registers

        if gpu.computes_right(make=registers.RegisterSimulator):
            return None
        problem = "wrong numbers"
    except Exception as error:  # whatever a driver, a compiler, or another version of cuda-core makes of it
        problem = f"{type(error).__name__}: {error}"
    said = f"qrlsuite: circuits run by numba-cuda's kernels, for those in registers fail here: {problem}"
    print(said, file=sys.stderr, flush=True)
    return problem


def _check(options: NativeOptions, circuit: Circuit) -> None:
    """Refuse options without effect, and shots or noise of a mean-field approximation."""
    if options.noise_model is None:
        defaults = NativeOptions()
        for name in ("noise_rate", "readout_error", "trajectories"):
            if getattr(options, name) != getattr(defaults, name):
                raise OptionError(f"{name} = {getattr(options, name):g} needs noise_model = 'depolarizing'")
    if circuit.mean_field and options != NativeOptions():
        raise OptionError(
            "the mean-field approximation of a circuit is none, so it has no shots, noise or gradient rule; leave out "
            "shots, noise_model and gradient"
        )


def _cause(inputs: Tensor, flat: Tensor) -> str:
    """Say why expectation values are not finite."""
    if not all(bool(torch.isfinite(values).all()) for values in (inputs, flat)):
        return NOT_FINITE
    precision = str(inputs.dtype).removeprefix("torch.")
    return (
        f"an angle of the circuit is too large: {precision} holds angles up to about {ROUNDED[inputs.dtype]}, and the "
        f"largest input is {float(inputs.abs().max()):.2g}, the largest parameter "
        f"{float(flat.abs().max() if flat.numel() else 0):.2g}: make inputs (observations), learning rates or initial "
        "parameters smaller" + (", or compute in float64" if inputs.dtype == torch.float32 else "")
    )
