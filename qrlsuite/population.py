"""Populations: S agents of one architecture as one module (S, B, in) -> (S, B, out).

Every parameter has a leading axis S and keeps the name it has in one agent's module, so that slice s of a
population's state is the state that agent s has when trained alone. The loss of a population is the sum of its
agents' mean losses: gradients do not mix, and one elementwise optimizer serves all.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from qrlsuite.device import upload
from qrlsuite.errors import PluginError
from qrlsuite.options import Since, per_agent

if TYPE_CHECKING:
    from qrlsuite.compiled.perceptron import Sweep

NARROW = 16
"""Layers below this width on both sides multiply in a fixed order, see `linear`."""

DecaySteps = Annotated[
    int | None,
    Field(
        ge=1,
        description="interactions of a seed after which learning rates have fallen to 0, linearly, epoch "
        "by epoch; absent: they are constant",
    ),
    Since("0.2.0"),
]
"""An algorithm's option, see `Adam.decay`."""


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Apply S independent linear layers.

    A batched matrix product is bitwise independent of a slice's position in the stack for most shapes, not for
    all (measured with torch 2.13 on one thread: the exceptions are layers narrower than 16 on both sides, a
    single output, and the input gradient of a narrow input layer). Those are summed in a fixed order instead,
    input feature by input feature. Where slices of the stack do not begin at multiples of four numbers, inputs of 0 are
    appended. A test goes through the layer shapes of every built-in model.

    Parameters
    ----------
    x:
        (S, B, in).
    weight, bias:
        (S, out, in) and (S, out), the layout of `torch.nn.Linear` with a leading axis.

    Returns
    -------
    Tensor
        (S, B, out).
    """
    outputs, inputs = weight.shape[1:]
    exact = max(inputs, outputs) >= NARROW and outputs > 1 and not (inputs < NARROW and x.requires_grad)
    if exact:
        misplaced = inputs == 5 or inputs > 6 or inputs * outputs % 4 or (inputs == 6 and x.shape[1] == 3)
        if inputs % 4 and misplaced:
            x, weight = (functional.pad(each, (0, -inputs % 4)) for each in (x, weight))
        return torch.baddbmm(bias[:, None], x, weight.transpose(1, 2))
    return (x[..., None] * weight.transpose(1, 2)[:, None]).sum(2) + bias[:, None]


ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": torch.relu,
    "tanh": torch.tanh,
    "sin": torch.sin,
    "none": lambda x: x,
}


def layers(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], activation: str = "none"
) -> Tensor:
    """Apply the layers of S networks, with an activation after each but the last.

    On the CPU and in float32 the products are compiled sweeps: one through all layers, or with `tanh` one a layer.
    Elsewhere, and within a transform of `torch.func`, layers are `linear`. Both are bitwise independent of a seed's
    place in the population; they round differently.

    Parameters
    ----------
    x:
        (S, B, in).
    weights, biases:
        Of every layer (S, out, in) and (S, out).
    activation:
        One of `ACTIVATIONS`.

    Returns
    -------
    Tensor
        (S, B, out); of a compiled sweep, it can be differentiated once.

    Raises
    ------
    ValueError
        If the shapes of a compiled sweep do not fit.
    """
    compiled = compilable(x, *weights, *biases)
    if compiled:
        from qrlsuite.compiled.perceptron import perceptron

        if activation in ("none", "relu", "sin"):
            return perceptron(x, weights, biases, activation)
    for i, (weight, bias) in enumerate(zip(weights, biases)):
        x = perceptron(x, [weight], [bias]) if compiled else linear(x, weight, bias)
        if i < len(weights) - 1:
            x = ACTIVATIONS[activation](x)
    return x


def sweep(
    population: nn.Module, parameters: Sequence[Tensor], make: Callable[[Sequence[Tensor]], Sweep]
) -> Sweep | None:
    """Return a population as the compiled sweep that `make(parameters)` is, kept in it; None where torch has to.

    The population's method `sweep` returns it, so that `chosen_errors` need not go through autograd.

    Parameters
    ----------
    parameters:
        All of them, in the sweep's order. They are moved in memory, so that they lie one behind the other.
    """
    kept: Sweep | None = population.__dict__.get("_sweep")
    if kept is not None and kept.places == [each.data_ptr() for each in parameters]:
        return kept
    if not compilable(*parameters):
        return None
    from qrlsuite.compiled.perceptron import in_one_block

    in_one_block(parameters)
    kept = population.__dict__["_sweep"] = make(parameters)
    return kept


def _sweep_of(population: nn.Module) -> Sweep | None:
    """Return the sweep of a population that does nothing else to its inputs."""
    if population._forward_hooks or population._forward_pre_hooks:
        return None
    found: Callable[[], Sweep | None] | None = getattr(population, "sweep", None)
    return None if found is None else found()


def sweeps(*populations: nn.Module) -> list[Sweep] | None:
    """Return populations as compiled sweeps, so that an algorithm need not go through autograd; None if one is none."""
    found = [_sweep_of(each) for each in populations]
    return None if None in found else cast("list[Sweep]", found)


def best(population: nn.Module, x: Tensor) -> Tensor:
    """Return which output is the largest (S, B), the first of equal ones, for x (S, B, in)."""
    whole = _sweep_of(population)
    if whole is None or not compilable(x) or x.requires_grad:
        with torch.no_grad():
            found: Tensor = population(x).argmax(2)
        return found
    return torch.from_numpy(whole.best(x.contiguous().numpy()))


def chosen_errors(
    population: nn.Module, x: Tensor, chosen: Tensor, aims: Tensor, weight: float = 1.0
) -> Tensor:
    """Set the gradients of a mean squared error, summed over the agents, in a population's parameters.

    A population of one compiled sweep does without autograd; the bits are equal.

    Parameters
    ----------
    x:
        (S, B, in).
    chosen:
        The output of each sample that should equal its aim (S, B).
    aims:
        (S, B).
    weight:
        Factor on the error.

    Returns
    -------
    Tensor
        (S, B): the chosen outputs minus the aims.
    """
    compiled = _sweep_of(population)
    if compiled is None or not compilable(x, aims):
        values: Tensor = population(x)
        errors = values.gather(2, chosen[..., None]).squeeze(2) - aims
        gradients(weight * errors.square().mean(1).sum(), population)
        return errors.detach()
    seen, places, wanted = (each.detach().contiguous().numpy() for each in (x, chosen, aims))
    return torch.from_numpy(compiled.chosen_errors(seen, places, wanted, weight))


@contextlib.contextmanager
def held(*populations: nn.Module) -> Iterator[None]:
    """Let gradients pass through populations, and not be computed for their parameters."""
    parameters = [p for each in populations for p in each.parameters() if p.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)


def compilable(*tensors: Tensor) -> bool:
    """Return whether tensors are float32 on the CPU, and in no transform of `torch.func`."""
    right = all(each.dtype == torch.float32 and each.is_cpu for each in tensors)
    return right and not torch._C._are_functorch_transforms_active()


def quantum_parameters(module: nn.Module) -> set[str]:
    """Return the names of a module's quantum parameters: its `quantum_parameters()`, else none."""
    declared: Callable[[], set[str]] | None = getattr(module, "quantum_parameters", None)
    return set() if declared is None else set(declared())


def remembers(module: nn.Module) -> int:
    """Return how many numbers a module, or each agent of a population, remembers from step to step; 0 for most.

    A module that remembers has an attribute `remembers`, a whole number M. `forward(x, state)` then returns outputs
    (B, out) and the next state (B, M) for x (B, in) and the state so far (B, M), which is 0 where an episode begins.
    `forward(x)` returns the outputs of an episode's first step alone.
    """
    return int(getattr(module, "remembers", 0))


def remember(population: nn.Module, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """Return outputs (S, B, out) and the next state (S, B, M) for x (S, B, in); without a memory M is 0.

    Raises
    ------
    PluginError
        If the module returns no next state, or one of another shape.
    """
    if not remembers(population):
        return population(x), state
    result = population(x, state)
    if not (isinstance(result, tuple) and len(result) == 2 and result[1].shape == state.shape):
        raise PluginError(
            f"a model with `remembers` = {remembers(population)} returns from forward(x, state) its outputs and the "
            f"next state, (B, {remembers(population)}) like the one before: `return outputs, after`"
        )
    return result


def unroll(population: nn.Module, seen: Tensor, begins: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """Show a population sequences of K steps.

    Parameters
    ----------
    seen:
        Observations (S, B, K, in).
    begins:
        1 where an episode begins, which clears the memory, else 0 (S, B, K).
    state:
        The memory before (S, B, M).

    Returns
    -------
    tuple
        Outputs (S, B, K, out), and the memory after every step (S, B, K, M).
    """
    outputs, states = [], []
    for k in range(seen.shape[2]):
        before = state * (1.0 - begins[:, :, k, None])
        each, state = remember(population, seen[:, :, k].contiguous(), before)
        outputs.append(each)
        states.append(state)
    return torch.stack(outputs, 2), torch.stack(states, 2)


def learning_rates(module: nn.Module) -> dict[str, float]:
    """Return a module's factors on its learning rates by the name of a parameter: its `learning_rates()`, else none.

    The parameter is then trained with the algorithm's learning rate, classical or quantum, times the factor.

    Raises
    ------
    ValueError
        If a name is no parameter's, or a factor is not above 0.
    """
    declared: Callable[[], Mapping[str, float]] | None = getattr(module, "learning_rates", None)
    factors = {} if declared is None else {name: float(factor) for name, factor in declared().items()}
    known = {name for name, _ in module.named_parameters()}
    for name, factor in factors.items():
        if name not in known or not 0 < factor < math.inf:
            raise ValueError(
                f"learning_rates() gives '{name}' the factor {factor:g}: name one of {', '.join(sorted(known))}, "
                "and a number above 0"
            )
    return factors


def count_parameters(module: nn.Module) -> tuple[int, int]:
    """Return the numbers of classical and quantum trainable scalars of one agent's module."""
    quantum = quantum_parameters(module)
    sizes = {name: p.numel() for name, p in module.named_parameters() if p.requires_grad}
    of_circuit = sum(n for name, n in sizes.items() if name in quantum)
    return sum(sizes.values()) - of_circuit, of_circuit


def count_fixed(module: nn.Module) -> int:
    """Return the number of scalars of one agent's module that stay as drawn."""
    return sum(p.numel() for p in module.parameters() if not p.requires_grad)


class _FixedOrderLinear(nn.Linear):
    """A linear layer whose narrow shapes are summed in a fixed order, see `linear`; S = 1 under vmap."""

    def forward(self, input: Tensor) -> Tensor:
        """Map (B, in) to (B, out)."""
        bias = self.bias if self.bias is not None else torch.zeros_like(self.weight[:, 0])
        return linear(input[None], self.weight[None], bias[None])[0]


class _FixedOrderConv2d(nn.Conv2d):
    """A convolution as a linear layer of its patches, which is exact in any stack, see `linear`; S = 1 under vmap."""

    def forward(self, input: Tensor) -> Tensor:
        """Map (..., channels, height, width) to (..., out channels, new height, new width)."""
        images = input if input.dim() == 4 else input[None]
        kernel, stride, dilation = self.kernel_size, self.stride, self.dilation
        padding = cast("tuple[int, int]", self.padding)
        patches = functional.unfold(images, kernel, dilation, padding, stride).transpose(
            1, 2
        )  # (B, places, in)
        height, width = (
            (images.shape[2 + i] + 2 * padding[i] - dilation[i] * (kernel[i] - 1) - 1) // stride[i] + 1
            for i in range(2)
        )
        weight, more = self.weight.flatten(1), -patches.shape[2] % NARROW
        weight, patches = (functional.pad(each, (0, more)) for each in (weight, patches))
        bias = self.bias if self.bias is not None else torch.zeros_like(weight[:, 0])
        values = linear(patches.reshape(1, -1, patches.shape[2]), weight[None], bias[None])[0]
        result = values.view(len(images), height * width, -1).transpose(1, 2)
        result = result.reshape(len(images), -1, height, width)
        return result if input.dim() == 4 else result[0]


class StackedPopulation(nn.Module):
    """S ordinary modules (B, in) -> (B, out) with their parameters stacked, run by `torch.vmap`.

    Modules that cannot be vmapped (data-dependent control flow, foreign code) are run in a loop over their
    slices instead; that is found out at the first forward pass, and `problem` says why. Other errors are the
    module's own, and raised. Buffers are read, never written.

    Parameters
    ----------
    modules:
        S built modules.
    vmap:
        False: run in a loop from the beginning, see `loop`.
    """

    problem: str | None = None

    def __init__(self, modules: Sequence[nn.Module], vmap: bool = True) -> None:
        super().__init__()
        first = modules[0]
        self.__dict__["_skeleton"] = _exact(copy.deepcopy(first))  # not a submodule: it owns no agent's state
        self._size = len(modules)
        self._quantum = frozenset(quantum_parameters(first))
        self._rates = learning_rates(first)
        self.remembers = remembers(first)
        self._vmap = vmap
        holder = copy.deepcopy(first)
        for name, _ in list(holder.named_parameters()):
            stacked = torch.stack([m.get_parameter(name).detach() for m in modules])
            owner, _, leaf = name.rpartition(".")
            trainable = first.get_parameter(name).requires_grad
            setattr(holder.get_submodule(owner), leaf, nn.Parameter(stacked, requires_grad=trainable))
        for name, _ in list(holder.named_buffers()):
            owner, _, leaf = name.rpartition(".")
            holder.get_submodule(owner)._buffers[leaf] = torch.stack([m.get_buffer(name) for m in modules])
        for name, child in holder.named_children():
            self.add_module(name, child)
        for name, parameter in holder.named_parameters(recurse=False):
            self.register_parameter(name, parameter)
        for name, buffer in holder.named_buffers(recurse=False):
            self.register_buffer(name, buffer)

    def quantum_parameters(self) -> set[str]:
        """Return the names of the quantum parameters."""
        return set(self._quantum)

    def learning_rates(self) -> dict[str, float]:
        """Return the factors on learning rates, see the function of that name."""
        return dict(self._rates)

    def forward(self, x: Tensor, state: Tensor | None = None) -> Any:
        """Map (S, B, in) to (S, B, out); with a state (S, B, M), return the next one, too (see `remembers`)."""
        own = {**dict(self.named_parameters()), **dict(self.named_buffers())}
        inputs = (x,) if state is None else (x, state)
        if self._vmap:
            try:
                return torch.vmap(self._call)(own, *inputs)
            except RuntimeError as error:
                if _NOT_VMAPPABLE.search(str(error)) is None:  # the module's own, or memory is exhausted
                    raise
                self._vmap = False
                reason = " ".join(str(error).split())[:200]
                self.problem = (
                    f"cannot be run by torch.vmap, so its agents are computed one by one, slowly: {reason}"
                )
        results = [
            self._call({k: v[s] for k, v in own.items()}, *(each[s] for each in inputs))
            for s in range(self._size)
        ]
        if state is None:
            return torch.stack(results)
        return tuple(torch.stack(part) for part in zip(*results))

    def _call(self, state: Mapping[str, Tensor], *inputs: Tensor) -> Any:
        return torch.func.functional_call(self.__dict__["_skeleton"], dict(state), inputs)


_NOT_VMAPPABLE = re.compile(
    r"vmap|functorch|batching rule|data pointer of Tensor|broadcast shape|Could not run 'aten::",
    re.IGNORECASE,
)
"""Messages of torch 2.4 to 2.13 if one agent's module can be run and a stack of modules cannot."""


def _exact(module: nn.Module) -> nn.Module:
    """Make the linear layers and convolutions of a module exact in any stack; a second name for a layer stays one."""
    for part in module.modules():
        if type(part) is nn.Linear:
            part.__class__ = _FixedOrderLinear
        plain = type(part) is nn.Conv2d and part.groups == 1 and part.padding_mode == "zeros"
        if plain and not isinstance(part.padding, str):
            part.__class__ = _FixedOrderConv2d
    return module


def stack(modules: Sequence[nn.Module]) -> nn.Module:
    """Turn S modules of one architecture into a population (S, B, in) -> (S, B, out).

    Raises
    ------
    ValueError
        If there is no module, or their parameters differ in name or shape.
    """
    _require_alike(modules)
    return StackedPopulation(modules)


def _require_alike(modules: Sequence[nn.Module]) -> None:
    if not modules:
        raise ValueError("a population needs at least one module")
    shapes = [{name: tuple(p.shape) for name, p in m.named_parameters()} for m in modules]
    if any(s != shapes[0] for s in shapes):
        raise ValueError("the modules of a population must have the same parameters with the same shapes")


def loop(modules: Sequence[nn.Module], options: Any = None) -> nn.Module:
    """Turn S modules of one architecture into a population that runs them one by one.

    For modules that cannot be run by `torch.vmap`, code of another framework say: `population` of a model's spec is
    then `"qrlsuite.population:loop"`, and the first pass tries nothing else. It takes S times as long.

    Raises
    ------
    ValueError
        As `stack` does.
    """
    _require_alike(modules)
    return StackedPopulation(modules, vmap=False)


def joined(options: Sequence[Any]) -> Any:
    """Return the options of S agents as one object, as an algorithm or a population gets them.

    Parameters
    ----------
    options:
        S objects of one options class.

    Returns
    -------
    Any
        Such an object, in which an option that differs between the agents is a float64 tensor (S,).

    Raises
    ------
    ValueError
        If an option differs that is not marked `per_agent` (`qrlsuite.options.Tuned`).
    """
    first = options[0]
    values = {f.name: [getattr(each, f.name) for each in options] for f in dataclasses.fields(first)}
    different = [name for name, own in values.items() if any(value != own[0] for value in own)]
    shared = sorted(set(different) - per_agent(type(first)))
    if shared:
        raise ValueError(f"agents of one population cannot differ in {', '.join(shared)}")
    together = copy.copy(first)
    for name in different:  # past the validation of a frozen class, which admits single numbers only
        object.__setattr__(together, name, torch.tensor(values[name], dtype=torch.float64))
    return together


class Adam:
    """Adam for a population: elementwise, with a step count per agent and two learning rates.

    Equal to `torch.optim.Adam` (Kingma & Ba 2015, no weight decay) for every agent that takes part in every
    step. An agent that is left out of a step keeps its parameters, moments and step count, as if the step
    had not been. Plain elementwise operations only: fused optimizers round differently at the end of a
    tensor, so that an agent would depend on its place in the stack. For a population with an attribute `compiled =
    True` the step is a compiled loop, which rounds differently; on the CPU and in float32.

    Parameters
    ----------
    population:
        Module with parameters (S, ...).
    classical_lr, quantum_lr:
        Learning rates of the parameters outside and inside `quantum_parameters(population)`: of all agents, or float64
        tensors (S,). A population's factors multiply them (`learning_rates`).
    betas, eps:
        Adam's constants.

    Attributes
    ----------
    rates:
        Learning rates by parameter name: of all agents, or float64 tensors (S,). Every step reads them, so that an
        algorithm may change them while it trains.
    """

    def __init__(
        self,
        population: nn.Module,
        classical_lr: float | Tensor,
        quantum_lr: float | Tensor,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        quantum, factors = quantum_parameters(population), learning_rates(population)
        self._named = [(name, p) for name, p in population.named_parameters() if p.requires_grad]
        if not self._named:
            raise ValueError("a population without trainable parameters has nothing to optimize")
        self._parameters = [p for _, p in self._named]
        self.rates = {
            name: (quantum_lr if name in quantum else classical_lr) * factors.get(name, 1.0)
            for name, _ in self._named
        }
        self._first_rates = dict(self.rates)
        self._quantum = quantum
        self.betas = betas
        self.eps = eps
        self._population = population
        self._compiled = getattr(population, "compiled", False) is True
        first = self._named[0][1]
        self.steps = torch.zeros(first.shape[0], dtype=torch.int64, device=first.device)
        self.mean = {name: torch.zeros_like(p) for name, p in self._named}
        self.square = {name: torch.zeros_like(p) for name, p in self._named}
        self._blocks: tuple[Any, ...] | None = None
        self._uploaded: dict[str, float | Tensor] = {}
        self._on_device: dict[str, Tensor] = {}

    def decay(self, interactions: int, decay_steps: int | None) -> None:
        """Lower the learning rates linearly: `interactions` of `decay_steps` interactions are over."""
        if decay_steps is not None:
            left = max(0.0, 1.0 - interactions / decay_steps)
            self.rates = {name: rate * left for name, rate in self._first_rates.items()}
            for name in self._on_device:  # also those that a captured step reads
                self._rate(name)

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for _, parameter in self._named:
            parameter.grad = None

    def step(self, active: Tensor | None = None) -> None:
        """Move every agent, or only the ones with a true `active` (S,), along its gradient."""
        self.steps += 1 if active is None else active.to(self.steps)
        if not (self._compiled and self.steps.is_cpu and self._move(active)):
            self._move_by_torch(active)

    @torch.no_grad()
    def _move_by_torch(self, active: Tensor | None) -> None:
        beta1, beta2 = self.betas
        count = self.steps.clamp(min=1)
        if self.steps.is_cpu:
            scale, root = _corrected(self.betas, count)
        else:  # whose powers round differently
            table = _correction_table(self.betas, self.steps.device)
            scale, root = table[:, count.clamp(max=table.shape[1] - 1)]
        for name, parameter in self._named:
            if parameter.grad is None:
                continue
            axes = (-1, *[1] * (parameter.dim() - 1))
            rate = (self._rate(name) * scale).to(parameter).view(axes)
            correction = root.to(parameter).view(axes)
            mean, square = self.mean[name], self.square[name]
            if active is None:
                mean.lerp_(parameter.grad, 1.0 - beta1)
                square.mul_(beta2).addcmul_(parameter.grad, parameter.grad, value=1.0 - beta2)
                parameter.sub_((mean * rate).div_(square.sqrt().mul_(correction).add_(self.eps)))
                continue
            mask = active.view(axes).to(parameter.device)
            new_mean = mean.lerp(parameter.grad, 1.0 - beta1)
            new_square = (square * beta2).addcmul_(parameter.grad, parameter.grad, value=1.0 - beta2)
            change = (new_mean * rate).div_(new_square.sqrt().mul_(correction).add_(self.eps))
            parameter.copy_(torch.where(mask, parameter - change, parameter))
            mean.copy_(torch.where(mask, new_mean, mean))
            square.copy_(torch.where(mask, new_square, square))

    def _rate(self, name: str) -> float | Tensor:
        """Return a parameter's learning rate, on its device."""
        rate = self.rates[name]
        if self.steps.is_cpu:
            return rate
        if self._uploaded.get(name) is not rate:
            self._uploaded[name] = rate
            upload(self._on_device, self.steps.device, **{name: torch.as_tensor(rate, dtype=torch.float64)})
        return self._on_device[name]

    def _move(self, active: Tensor | None) -> bool:
        """Make the step in one compiled pass, for which parameters come to lie in one block; False if torch has to."""
        whole = _sweep_of(self._population)  # first: it may move parameters
        gradients = None if whole is None else whole.gradients_of(self._parameters)
        if gradients is None and any(p.grad is None for p in self._parameters):
            return False
        if self._blocks is None or self._blocks[0] != [p.data_ptr() for p in self._parameters]:
            if not compilable(*self._parameters):
                return False
            self._blocks = self._lay_out(self._parameters)
        _, move, block, means, squares, sizes, rates, roots, everyone, constants = self._blocks
        if gradients is None:
            from qrlsuite.compiled.perceptron import joined

            gradients = joined([cast("Tensor", p.grad) for p in self._parameters])
        for row, (name, _) in zip(rates, self._named):
            row[:] = self.rates[name]
        counts = self.steps.tolist()
        scale: Any
        if counts.count(counts[0]) == len(counts):
            scale, roots[:] = _corrections(*self.betas, max(counts[0], 1))
        else:
            scale, roots[:] = np.array([_corrections(*self.betas, max(count, 1)) for count in counts]).T
        moved = everyone if active is None else active.cpu().numpy()
        corrected = (rates * scale).astype(np.float32)
        move(block, gradients, means, squares, sizes, corrected, roots, moved, *constants)
        return True

    def _lay_out(self, parameters: Sequence[Tensor]) -> tuple[Any, ...]:
        """Return where parameters are, and the arguments of the compiled step, for which all lie in blocks."""
        from qrlsuite.compiled.networks import adam
        from qrlsuite.compiled.perceptron import in_one_block, joined

        self.mean, self.square = (
            {name: each.contiguous() for name, each in own.items()} for own in (self.mean, self.square)
        )
        moments = [list(own.values()) for own in (self.mean, self.square)]
        for part in (parameters, *moments):
            in_one_block(part)
        agents = len(self.steps)
        rates, roots = np.empty((len(parameters), agents)), np.empty(agents, np.float32)
        everyone = np.ones(agents, np.bool_)
        sizes = np.array([p[0].numel() for p in parameters])
        blocks = (joined(part) for part in (parameters, *moments))
        beta1, beta2 = self.betas
        constants = [np.float32(each) for each in (1.0 - beta1, beta2, 1.0 - beta2, self.eps)]
        return [p.data_ptr() for p in parameters], adam, *blocks, sizes, rates, roots, everyone, constants

    def gradient_norms(self) -> dict[str, NDArray[np.float64]]:
        """Return the norms of each agent's gradients, for the metrics of an epoch.

        A norm is the root of the mean square over the last steps, about a thousand, by the second moments: it takes no
        part in training.

        Returns
        -------
        dict
            `gradient_norm_classical` and `gradient_norm_quantum` (S,), as far as there are such parameters; NaN before
            the first step.
        """
        squares: dict[str, NDArray[np.float64]] = {}
        for name, square in self.square.items():
            rows = square.detach().cpu().double().reshape(len(self.steps), -1).numpy()
            own = np.array(
                [row.sum() for row in rows]
            )  # each alone: the bits of an agent do not depend on others
            part = "gradient_norm_quantum" if name in self._quantum else "gradient_norm_classical"
            squares[part] = squares.get(part, 0.0) + own
        weight = 1.0 - self.betas[1] ** self.steps.cpu().double().numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            norms = {part: np.sqrt(total / weight) for part, total in squares.items()}
        return {part: np.where(np.isfinite(norm), norm, np.nan) for part, norm in norms.items()}

    def state_dict(self) -> dict[str, Tensor]:
        """Return step counts (S,) and both moments of every parameter (S, ...)."""
        state = {"steps": self.steps}
        state.update({f"mean.{name}": value for name, value in self.mean.items()})
        state.update({f"square.{name}": value for name, value in self.square.items()})
        return state

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self.steps.copy_(state["steps"])
        for name in self.mean:
            self.mean[name].copy_(state[f"mean.{name}"])
            self.square[name].copy_(state[f"square.{name}"])


@functools.lru_cache(4)
def _corrections(beta1: float, beta2: float, count: int) -> tuple[float, float]:
    """Return the bias corrections of Adam's moments after some steps: of the first, and of the root of the second."""
    return 1.0 / (1.0 - beta1**count), 1.0 / math.sqrt(1.0 - beta2**count)


def _corrected(betas: tuple[float, float], count: Tensor) -> tuple[Tensor, Tensor]:
    """Return the corrections of Adam's moments after `count` steps, float64: of the first, and of the second's root."""
    steps = count.to(torch.float64)
    return 1.0 / (1.0 - betas[0] ** steps), 1.0 / torch.sqrt(1.0 - betas[1] ** steps)


@functools.lru_cache(4)
def _correction_table(betas: tuple[float, float], device: torch.device) -> Tensor:
    """Return the corrections after 0, 1, ... steps, (2, N), as the CPU rounds them; the last ones are 1."""
    steps = math.ceil(math.log(2.0**-54) / math.log(max(betas))) + 1
    return torch.stack(_corrected(betas, torch.arange(steps))).to(device)


def gradients(loss: Tensor, population: nn.Module) -> None:
    """Set the gradients of a loss in a population's trainable parameters, and in no other parameters."""
    parameters = [p for p in population.parameters() if p.requires_grad]
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters, allow_unused=True)):
        parameter.grad = gradient


@torch.no_grad()
def clip_gradients(longest: float, *populations: nn.Module) -> None:
    """Scale the gradients of an agent in all these networks together down to the norm `longest`, where it is greater.

    Squares are added one by one, in an order that other agents do not change.
    """
    own = [p.grad for each in populations for p in each.parameters() if p.grad is not None]
    squares = [gradient.double().square().flatten(1).cumsum(1)[:, -1:] for gradient in own]
    scale = (longest / torch.cat(squares, 1).cumsum(1)[:, -1].sqrt()).clamp(max=1.0)
    for gradient in own:
        gradient.mul_(scale.to(gradient).view(-1, *[1] * (gradient.dim() - 1)))


@torch.no_grad()
def follow(target: nn.Module, population: nn.Module, tau: float) -> None:
    """Move a target network's parameters by `tau` of the way to the parameters of the network that it copies."""
    for slow, parameter in zip(target.parameters(), population.parameters()):
        slow.lerp_(parameter, tau)


@torch.no_grad()
def renew(target: nn.Module, population: nn.Module, steps: Tensor, every: Tensor) -> None:
    """Copy agents into their target networks after every so many `steps`; both (S,) int64 on the networks' device."""
    if steps.is_cpu and not (steps.numpy() % every.numpy() == 0).any():
        return
    due, online = steps % every == 0, population.state_dict()
    for name, held in target.state_dict().items():
        held.copy_(torch.where(due.view(-1, *[1] * (held.dim() - 1)), online[name], held))


def by_seed(lanes: NDArray[Any], seeds: int, device: torch.device) -> Tensor:
    """Return values of seed-major lanes, (S * E, ...) of any type, as float32 of shape (S, E, features)."""
    values = np.ascontiguousarray(lanes, np.float32).reshape(seeds, len(lanes) // seeds, -1)
    return torch.from_numpy(values).to(device)


def prefixed(**parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Merge state dicts under dotted prefixes: `prefixed(online=a, adam=b)`."""
    return {f"{part}.{name}": value for part, state in parts.items() for name, value in state.items()}


def part(state: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    """Return the entries of a merged state under one prefix, without it."""
    return {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(f"{name}.")}
