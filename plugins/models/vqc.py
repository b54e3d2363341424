"""Hybrid variational quantum circuit: linear layer, circuit, linear layer, on any circuit backend.

Source: the paper's quantum models (section 'Experimental Setup'): Linear(obs -> n), a data re-uploading circuit
whose expectation values <Z_q> are read off every qubit, Linear(n -> out). For 3 inputs and 3 outputs these are
6 L n + 7 n + 3 parameters on n qubits with L layers. Quantum parameters start uniform in [0, 2 pi), linear
layers as `torch.nn.Linear` does. Without linear layers (`linear = false`), as in earlier work on CartPole (Jerbi
et al. 2021; Skolik, Jerbi & Dunjko 2022), each output is a trained factor, 1 at first, times an expectation value.
With `linear = "behind"`, as in SimplyQRL, there is the second linear layer alone.

`readout` measures other products of Z than the circuit's own: pairs as in Skolik, Jerbi & Dunjko (2022) on CartPole, or
the product of all as in Jerbi et al. (2021). `output_reuse` and `output_scale` are the classes OutputReuse and
OutputScale of SimplyQRL (Lazaro, Vazquez & Bringas 2025, arXiv:2511.17112; scales begin at 2 there). Repeated values
before a linear layer add no function: each weight becomes a sum of several, with other initial values and steps.

Logits, values, means and logarithms of spreads are outputs like any other. Expectation values lie in -1 .. 1, and the
layer behind the circuit maps them to other ranges. Means are in halves of an action's range, or pass through a
hyperbolic tangent, so they are needed there. Values may be hundreds, and Adam moves a weight by its learning rate per
step: in 20,000 steps of 0.001 four qubits and a bias reach 100 at most. `output_rate` is a factor on the learning rate
of the layer behind the circuit; Skolik et al. have 0.1 there, for Q-values, beside 0.001: a factor of 100.
`critic = "mlp"` takes a perceptron for networks of values, as Lan (2021, "Variational quantum soft actor-critic",
arXiv:2112.11921), whose policy alone is hybrid; also for a critic of (s, a), which the circuit may not fit.

One module serves all backends; the models differ in which backend computes the circuit.
"""

from __future__ import annotations

import copy
import functools
import itertools
from collections.abc import Sequence
from dataclasses import field, fields
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

import numpy as np
import torch
from pydantic import ConfigDict, Field, ValidationInfo, field_validator
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit, CircuitBackend, ExecutionCounter, ansatz, create_backend, options_on
from qrlsuite.circuit.api import require_computable
from qrlsuite.circuit.description import in_bases
from qrlsuite.circuit.resources import shift_evaluations
from qrlsuite.errors import OptionError, QrlSuiteError, nearest
from qrlsuite.options import Since, Tuned, field_names, without_later
from qrlsuite.plugins.models import mlp
from qrlsuite.plugins.models.mlp import initial_layer
from qrlsuite.population import ACTIVATIONS, compilable, linear, sweep

if TYPE_CHECKING:
    from qrlsuite.compiled.perceptron import Sweep
    from qrlsuite.plugins.circuits.native import NativeBackend
    from qrlsuite.plugins.circuits.native.hybrid import HybridSweep

Activation = Literal["none", "relu", "tanh"]
Readout = Literal["ansatz", "single", "pairs", "neighbors", "all-pairs", "product"]
Linear = Literal[True, False, "behind"]
OptionValue = bool | int | float | str


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class VQCOptions:
    """Options of every hybrid circuit model; `VQCOptions["native"]` has the options of `vqc-native` and its backend."""

    backend: ClassVar[str]
    passes_on: ClassVar[tuple[str, ...]] = ("gate",)
    """Options that are handed to an ansatz which has them: `--set gate=xyz` means this model's, and the ansatz's."""

    qubits: Annotated[int, Field(ge=1, description="qubits of the circuit")] = 10
    layers: Annotated[int, Field(ge=1, le=256, description="layers of the circuit")] = 4
    ansatz: Annotated[str, Field(description="circuit family, see qrlsuite list ansatzes")] = "iqp"
    gate: Annotated[
        Literal["rot", "xyz", "u3"], Field(description="variational gate, for the ansatzes that offer it")
    ] = "rot"
    ansatz_options: Annotated[
        dict[str, OptionValue],
        Field(
            description="further options of the ansatz; --set NAME=VALUE or --set ansatz.NAME=VALUE puts one here"
        ),
    ] = field(default_factory=dict)
    activation_in: Annotated[Activation, Field(description="between linear layer and circuit")] = "none"
    activation_out: Annotated[Activation, Field(description="between circuit and linear layer")] = "none"
    dtype: Annotated[
        Literal["float32", "float64"], Field(description="precision of parameters and circuit values")
    ] = "float32"
    train: Annotated[
        str,
        Field(
            description="which parameters of the circuit learn, beside the linear layers: all, one by name (scaling or "
            "weights), or linear: none; others stay as drawn"
        ),
        Since("0.2.0"),
    ] = "all"
    init_scale: Annotated[
        float,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="factor on the initial values of parameters that multiply inputs: iqp, cx and cz draw their "
            "scalings from [0, init_scale 2 pi)",
        ),
        Since("0.2.0"),
        Tuned(0.1, 10, per_agent=True),
    ] = 1.0
    linear: Annotated[
        Linear,
        Field(
            description="linear layers before and behind the circuit; behind: observations are its inputs; false: "
            "these too, and output i is a trained factor times expectation value i"
        ),
        Since("0.2.0"),
    ] = True
    output_rate: Annotated[
        float,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="learning rate of the layer behind the circuit, as a factor; for values far beyond -1..1",
        ),
        Since("0.2.0"),
    ] = 1.0
    readout: Annotated[
        Readout,
        Field(
            description="observables: ansatz, its own (mostly Z of each qubit); single, Z of each qubit; "
            "products of Z: pairs (Z0 Z1, Z2 Z3, ...), neighbors in a ring, all-pairs, or the product of all"
        ),
        Since("0.2.0"),
    ] = "ansatz"
    input_reuse: Annotated[
        bool,
        Field(
            description="without linear layers, where the circuit has more inputs than there are "
            "observations: it gets the observations again, in their order"
        ),
        Since("0.2.0"),
    ] = False
    output_reuse: Annotated[
        int,
        Field(ge=1, le=64, description="copies of the expectation values for the layer behind the circuit"),
        Since("0.2.0"),
    ] = 1
    output_scale: Annotated[
        float | None,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="initial value of a trained factor on each output; without linear layers there is one "
            "anyway, at first 1",
        ),
        Since("0.2.0"),
    ] = None
    critic: Annotated[
        Literal["circuit", "mlp"],
        Field(
            description="networks that estimate values beside a policy: circuits too, or perceptrons of 64 x 64 units"
        ),
        Since("0.2.0"),
    ] = "circuit"

    @field_validator("ansatz_options")
    @classmethod
    def _ansatz_options(cls, values: dict[str, OptionValue], info: ValidationInfo) -> dict[str, OptionValue]:
        """Leave out options that the hash does not cover, see `qrlsuite.options.Since`."""
        try:
            return (
                without_later(
                    specs.resolve(registry.get(specs.AnsatzSpec, info.data["ansatz"]).options), values
                )
                if values
                else {}
            )
        except (
            KeyError,
            QrlSuiteError,
        ):  # an ansatz that cannot be found is refused by `check`, in better words
            return values

    def __class_getitem__(cls, backend: str) -> type[VQCOptions]:
        return options_on(cls, backend)

    @functools.cached_property
    def _circuit(self) -> Circuit:
        """The circuit, shared by all models with these options."""
        return build_circuit(self)

    def check(self) -> None:
        """Build the circuit, so that one that cannot be built is refused before anything is trained."""
        circuit = self._circuit
        if self.train not in ("all", "linear", *circuit.parameters):
            choices = ("all", "linear", *circuit.parameters)
            raise OptionError(
                f"train = '{self.train}': the circuit of ansatz '{self.ansatz}' has no such parameter"
                f"{nearest(self.train, choices)}"
            )
        if self.init_scale != 1.0 and not _scales(circuit):
            raise OptionError(
                f"init_scale = {self.init_scale:g}: the circuit of ansatz '{self.ansatz}' multiplies no input by a "
                "parameter"
            )
        if self.input_reuse and self.linear is True:
            raise OptionError(
                "input_reuse = true needs linear = false or behind: a linear layer gives the circuit all its inputs"
            )
        require_computable(circuit, self.backend)


class _Runner:
    """A circuit, its backend and its counter, shared by deep copies of a model."""

    def __init__(self, options: VQCOptions) -> None:
        self.options = options
        self.circuit = options._circuit
        shots: int | None = getattr(options, "shots", None)
        self.executions = ExecutionCounter(
            shots, shift_evaluations(self.circuit), self.circuit.mean_field, len(in_bases(self.circuit))
        )
        self._backend: CircuitBackend | None = None

    @property
    def backend(self) -> CircuitBackend:
        """The backend, prepared when it is first needed."""
        if self._backend is None:
            self._backend = create_backend(
                self.options.backend, self.circuit, **_backend_options(self.options)
            )
            repeats = getattr(self._backend, "repeats", 1)
            self.executions.bases *= repeats
            if self.draws:
                self.executions.per_gradient = repeats * getattr(
                    self._backend, "gradient_circuits", self.executions.per_gradient
                )
        return self._backend

    @property
    def draws(self) -> bool:
        """Whether the backend's results are random."""
        return bool(getattr(self.backend, "draws", self.backend.shots is not None))

    def __deepcopy__(self, memo: dict[int, Any]) -> _Runner:
        return self


class _Affine(nn.Module):
    """Holds `weight` (S, out, in), `bias` (S, out) and perhaps `factor` (S, out); one agent's module has no S."""

    def __init__(self, weight: Tensor, bias: Tensor, factor: Tensor | None = None) -> None:
        super().__init__()
        self.weight = nn.Parameter(weight)
        self.bias = nn.Parameter(bias)
        if factor is not None:
            self.factor = nn.Parameter(factor)


class _Factors(nn.Module):
    """Holds `weight` (S, out), or without S in one agent's module: a factor for each output."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.weight = nn.Parameter(weight)


class _Hybrid(nn.Module):
    """The common part of one agent's module and a population; parameters `input.*, circuit.*, output.*`."""

    shot_key: Tensor
    shot_count: Tensor

    def __init__(self, runner: _Runner, state: dict[str, Tensor]) -> None:
        super().__init__()
        self._runner = runner
        self._copies = 0
        if runner.options.linear is True:
            self.input = _Affine(state["input.weight"], state["input.bias"])
        self.circuit = nn.ParameterDict(
            {
                name: nn.Parameter(
                    state[f"circuit.{name}"], requires_grad=runner.options.train in ("all", name)
                )
                for name in runner.circuit.parameters
            }
        )
        self.output: nn.Module = (
            _Affine(state["output.weight"], state["output.bias"], state.get("output.factor"))
            if runner.options.linear
            else _Factors(state["output.weight"])
        )
        self.register_buffer("shot_key", state["shot_key"])
        self.register_buffer("shot_count", state["shot_count"])

    @property
    def executions(self) -> ExecutionCounter:
        """Circuit executions of each agent so far, shared with deep copies."""
        return self._runner.executions

    @property
    def description(self) -> Circuit:
        """The circuit."""
        return self._runner.circuit

    @property
    def draws(self) -> bool:
        """Whether outputs or gradients are random: of shots, of noise, or guessed."""
        return self._runner.draws

    @property
    def simulator(self) -> bool:
        """Whether the circuits are only simulated; else executions may cost money."""
        return bool(getattr(self._runner.backend, "simulator", True))

    def terms(self, circuits: int) -> str:
        """Return the queue at the circuit's device and the price of a number of circuits; empty for a simulator."""
        said = getattr(self._runner.backend, "terms", None)
        return "" if said is None else said(circuits)

    def compile_circuits(self) -> None:
        """Let the circuit's backend compile the code of the first pass, if it can."""
        compile_for = getattr(self._runner.backend, "compile_for", None)
        if compile_for is not None and self.simulator:
            compile_for(next(self.output.parameters()))

    def circuit_states(self, x: Tensor) -> Tensor:
        """Return the circuit's final states (S, B, 2^n) for observations (S, B, in); qubit 0 is the highest bit."""
        from qrlsuite.plugins.circuits.native import dense  # the state is no backend's business but native's

        require_computable(self._runner.circuit, "native")
        inner = self._circuit_inputs(x, dict(self.named_parameters()))
        parameters = [value.reshape(len(value), -1) for value in self.circuit.values()]
        return dense.states(self._runner.circuit, inner, torch.cat(parameters, dim=1))

    def _circuit_inputs(self, x: Tensor, state: dict[str, Tensor]) -> Tensor:
        """Map (S, B, in) to the circuit's inputs, (S, B, circuit.inputs)."""
        inner = x.to(state["output.weight"].dtype)
        if self._runner.options.linear is True:
            inner = linear(inner, state["input.weight"], state["input.bias"])
        elif self._runner.options.input_reuse:
            inner = inner[..., torch.arange(self._runner.circuit.inputs) % inner.shape[-1]]
        return ACTIVATIONS[self._runner.options.activation_in](inner)

    def quantum_parameters(self) -> set[str]:
        """Return the names of the circuit's parameters."""
        return {f"circuit.{name}" for name in self._runner.circuit.parameters}

    def learning_rates(self) -> dict[str, float]:
        """Return the factor on the learning rate of the layer behind the circuit."""
        rate = self._runner.options.output_rate
        return {} if rate == 1.0 else {f"output.{name}": rate for name, _ in self.output.named_parameters()}

    def _stacked(self, x: Tensor, state: dict[str, Tensor]) -> Tensor:
        """Map (S, B, in) to (S, B, out) with parameters (S, ...)."""
        runner, options = self._runner, self._runner.options
        inner = self._circuit_inputs(x, state)
        parameters = {name: state[f"circuit.{name}"] for name in runner.circuit.parameters}
        values = runner.backend(inner, parameters, self._shot_seeds())
        executions, inputs = runner.executions, x.shape[1]
        executions.count_forward(inputs)
        if values.requires_grad:
            values.register_hook(lambda grad: executions.count_backward(inputs))  # type: ignore[no-untyped-call]
        return self._shown(ACTIVATIONS[options.activation_out](values), state).to(x.dtype)

    def _shown(self, values: Tensor, state: dict[str, Tensor]) -> Tensor:
        """Return outputs (S, B, out) of the layer behind the circuit."""
        options = self._runner.options
        if options.output_reuse > 1:
            values = values.repeat(1, 1, options.output_reuse)
        if options.linear:
            outputs = linear(values, state["output.weight"], state["output.bias"])
            return outputs if options.output_scale is None else outputs * state["output.factor"][:, None]
        factors = state["output.weight"][:, None]  # (S, 1, out)
        return values[..., : factors.shape[2]] * factors

    def _shot_seeds(self) -> list[int] | None:
        """Return this pass's sampling seed of every agent, from its key and the number of its passes so far."""
        if not self._runner.draws:
            return None
        keys, counts = self.shot_key.reshape(-1).tolist(), self.shot_count.reshape(-1).tolist()
        self.shot_count += 1
        return [_derived(key, count, self._copies) for key, count in zip(keys, counts)]

    def __deepcopy__(self, memo: dict[int, Any]) -> _Hybrid:
        copied = type(self).__new__(type(self))
        memo[id(self)] = copied
        held = {name: value for name, value in self.__dict__.items() if name != "_sweep"}
        copied.__dict__.update(copy.deepcopy(held, memo))
        # A target network follows its original's shot count, but must not draw the same samples.
        copied._copies = self._copies + 1
        return copied


class VQC(_Hybrid):
    """One agent's hybrid model: (B, in) -> (B, out)."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, in) to (B, out)."""
        return self._stacked(x[None], {name: p[None] for name, p in self.named_parameters()})[0]


class VQCPopulation(_Hybrid):
    """S hybrid models: (S, B, in) -> (S, B, out); parameters and buffers as in `VQC` with a leading axis S.

    `compiled`: all of a network is one compiled sweep on the CPU, and Adam's step is compiled, too.
    """

    def __init__(self, modules: Sequence[VQC], options: VQCOptions) -> None:
        runner = _Runner(options)
        _ = runner.backend  # prepared now, so that what it cannot do is known before training
        states = [{**dict(m.named_parameters()), **dict(m.named_buffers())} for m in modules]
        super().__init__(
            runner, {name: torch.stack([s[name].detach() for s in states]) for name in states[0]}
        )
        self.compiled = _is_sweep(runner)

    def forward(self, x: Tensor) -> Tensor:
        """Map (S, B, in) to (S, B, out)."""
        whole = self.sweep() if compilable(x) else None
        return self._stacked(x, dict(self.named_parameters())) if whole is None else whole(x)

    def sweep(self) -> HybridSweep | None:
        """Return it as one compiled sweep, see `qrlsuite.population.sweep`."""
        if not self.compiled:
            return None
        layers = (self.input, self.circuit, self.output)
        parameters = [cast("Tensor", each) for layer in layers for each in layer._parameters.values()]
        return cast("HybridSweep | None", sweep(self, parameters, self._made))

    def compile_circuits(self) -> None:
        """Let the code of the first pass be compiled, if it can."""
        whole = self.sweep()
        if whole is None:
            super().compile_circuits()
        else:
            whole.compile()

    def _made(self, parameters: Sequence[Tensor]) -> Sweep:
        from qrlsuite.plugins.circuits.native.hybrid import HybridSweep

        runner = self._runner
        simulator = cast("NativeBackend", runner.backend).simulator()
        return HybridSweep(parameters, simulator, runner.executions, self._refuse)

    def _refuse(self, x: Tensor) -> None:
        """Say why expectation values at x (S, B, in) are not finite."""
        with torch.no_grad():
            inner = linear(x, self.input.weight, self.input.bias)
            self._runner.backend(inner, dict(self.circuit))


def _is_sweep(runner: _Runner) -> bool:
    """Return whether networks with exact circuits of `native` are what a hybrid sweep computes."""
    own, backend = runner.options, runner.backend
    plain = (own.linear, own.activation_in, own.activation_out, own.output_reuse, own.output_scale)
    if plain != (True, "none", "none", 1, None) or (own.train, own.dtype) != ("all", "float32"):
        return False
    from qrlsuite.plugins.circuits.native import NativeBackend

    return type(backend) is NativeBackend and backend.sweeps


def build_circuit(options: VQCOptions) -> Circuit:
    """Build the circuit that the options describe."""
    ansatz_options: dict[str, Any] = dict(options.ansatz_options)
    if "gate" in field_names(specs.resolve(registry.get(specs.AnsatzSpec, options.ansatz).options)):
        ansatz_options.setdefault("gate", options.gate)
    elif options.gate != "rot":
        raise OptionError(f"gate = '{options.gate}': ansatz '{options.ansatz}' has no option 'gate'")
    circuit = ansatz(options.ansatz, options.qubits, options.layers, **ansatz_options)
    if options.readout != "ansatz":
        circuit.measure(_observables(options.qubits, options.readout))
    return circuit


def _observables(qubits: int, readout: Readout) -> list[tuple[int, ...]]:
    """Return the qubits of every product of Z that a readout measures."""
    if readout == "single":
        return [(q,) for q in range(qubits)]
    if readout == "product":
        return [tuple(range(qubits))]
    if qubits < 2 or (readout == "pairs" and qubits % 2):
        needed = "an even number of qubits" if readout == "pairs" else "2 qubits or more"
        raise OptionError(f"readout = '{readout}' with qubits = {qubits}: it needs {needed}")
    if readout == "pairs":
        return [(q, q + 1) for q in range(0, qubits, 2)]
    if readout == "neighbors":
        return [(q, (q + 1) % qubits) for q in range(qubits if qubits > 2 else 1)]
    return list(itertools.combinations(range(qubits), 2))


def _scales(circuit: Circuit) -> set[str]:
    """Return the names of the parameters that multiply inputs."""
    angles = [angle for operation in circuit for angle in operation.angles]
    return {a.scale.parameter for a in angles if a.scale is not None and a.input is not None}


def build(
    obs_dim: int, out_dim: int, options: VQCOptions, generator: torch.Generator, role: str = "network"
) -> VQC | mlp.MLP:
    """Build one agent's model with every random number drawn from `generator`.

    Parameters
    ----------
    obs_dim, out_dim:
        Numbers of inputs and outputs.
    options:
        Options of one of the `vqc-*` models; their class says which backend runs the circuit.
    generator:
        Source of the initial parameters and of the key of shot noise.
    role:
        `"critic"` may be a perceptron, as the options say.
    """
    if role == "critic" and options.critic == "mlp":
        return mlp.build(obs_dim, out_dim, mlp.MLPOptions(), generator)
    runner = _Runner(options)
    circuit = runner.circuit
    if options.linear is not True:
        _require_fit(runner, obs_dim, out_dim, role)
    return VQC(runner, initial(runner, obs_dim, len(circuit.observables), out_dim, (), generator))


def initial(
    runner: _Runner,
    inputs: int,
    values: int,
    outputs: int,
    copies: tuple[int, ...],
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Draw an agent's parameters.

    Parameters
    ----------
    inputs, values, outputs:
        Numbers before the circuits, of their expectation values that are shown, and behind the last layer.
    copies:
        How many values each parameter of the circuit has, as a shape.
    """
    circuit, options = runner.circuit, runner.options
    state: dict[str, Tensor] = {}
    if options.linear is True:
        state["input.weight"], state["input.bias"] = initial_layer(inputs, circuit.inputs, "torch", generator)
    for name, parameter in circuit.parameters.items():
        uniform = torch.rand((*copies, *parameter.shape), generator=generator)
        state[f"circuit.{name}"] = parameter.low + (parameter.high - parameter.low) * uniform
        if name in _scales(circuit):
            state[f"circuit.{name}"] *= options.init_scale
    if options.linear:
        state["output.weight"], state["output.bias"] = initial_layer(
            values * options.output_reuse, outputs, "torch", generator
        )
        if options.output_scale is not None:
            state["output.factor"] = torch.full((outputs,), options.output_scale)
    else:
        state["output.weight"] = torch.full((outputs,), options.output_scale or 1.0)
    state = {name: value.to(getattr(torch, options.dtype)) for name, value in state.items()}
    state["shot_key"] = torch.randint(2**63 - 1, (), generator=generator)
    state["shot_count"] = torch.zeros((), dtype=torch.int64)
    return state


def _require_fit(runner: _Runner, inputs: int, outputs: int, role: str) -> None:
    """Refuse a circuit that cannot stand without a linear layer before it, or without both."""
    circuit, linear = runner.circuit, runner.options.linear
    values = len(circuit.observables) * runner.options.output_reuse
    enough = circuit.inputs >= inputs if runner.options.input_reuse else circuit.inputs == inputs
    shown = linear == "behind" or values >= outputs
    if enough and shown:
        return
    advice = f"choose qubits, or options of the ansatz, so that inputs are {inputs}" + (
        "" if linear else f", and expectation values {outputs} or more"
    )
    if circuit.inputs > inputs and shown:
        advice = "choose fewer qubits, or set input_reuse=true, and observations are given several times"
    if role == "critic":
        advice = "set critic=mlp, which takes a perceptron for it, or linear=true"
    raise OptionError(
        f"linear = {'behind' if linear else 'false'}: the circuit has {circuit.inputs} inputs and {values} expectation "
        f"values, the {role} {inputs} inputs and {outputs} outputs: {advice}"
    )


def population(modules: Sequence[VQC | mlp.MLP], options: VQCOptions) -> VQCPopulation | mlp.MLPPopulation:
    """Stack built models."""
    if isinstance(modules[0], mlp.MLP):
        return mlp.population(cast("Sequence[mlp.MLP]", modules), mlp.MLPOptions())
    return VQCPopulation(cast("Sequence[VQC]", modules), options)


def _backend_options(options: VQCOptions) -> dict[str, Any]:
    """Return the options that are the backend's, not the model's."""
    own = {option.name for option in fields(VQCOptions)}
    return {name: getattr(options, name) for name in field_names(type(options)) if name not in own}


def _derived(*path: int) -> int:
    """Return 63 bits derived from integers."""
    return int(np.random.SeedSequence(path).generate_state(1, np.uint64)[0] >> np.uint64(1))
