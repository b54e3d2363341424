"""Rules of models: the generator decides initial values, gradients reach all parameters, seeds are independent."""

from __future__ import annotations

import copy
import functools
import inspect
import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from gymnasium.spaces import Box, Dict, Discrete, Space
from gymnasium.spaces.utils import flatten_space
from torch import Tensor, nn

from qrlsuite import population as populations
from qrlsuite import specs
from qrlsuite.errors import OptionError
from qrlsuite.testing.common import Subject, check_cases
from qrlsuite.testing.findings import SIZES, Checklist, Finding, one_thread, require
from qrlsuite.testing.group import World
from qrlsuite.training import questions, unregistered
from qrlsuite.training.fences import seeded
from qrlsuite.training.trainer import build_agent, observed_space

OUT, B, S = 3, 6, 5
FLAT = Box(-1.0, 1.0, (4,))
SPACES: dict[str, Space[Any]] = {
    "an image": Box(0.0, 1.0, (10, 9, 2)),
    "an image, channels first": Box(0.0, 1.0, (2, 10, 9)),
    "a Dict": Dict({"place": Box(-1.0, 1.0, (3,)), "kind": Discrete(4)}),
    "numbers": FLAT,
}
"""Observations for models that ask for their space; others get numbers."""
ODD = 5
"""A number of units (or other counts in options) that no vector of the processor divides."""
BATCHES = (B, 1, 3, 7, 13)


class Subjects:
    """Builds agents and populations of the model that is checked."""

    def __init__(self, subject: Subject, space: Space[Any]) -> None:
        spec = subject.spec
        assert isinstance(spec, specs.ModelSpec)
        self.spec, self.options, self.per_agent = spec, subject.options(), subject.per_agent()
        self.build, self.space = specs.resolve(spec.build), space
        self.inputs = math.prod(flatten_space(self.space).shape or ())
        self._counting = subject.counting(ODD)

    @functools.cached_property
    def odd(self) -> dict[str, Any]:
        """Options by the name of one that is an odd number, where the model can be built with it."""
        return {name: own for name, own in self._counting.items() if self._builds(own)}

    @functools.cached_property
    def sampled(self) -> bool:
        """Whether outputs or gradients are random, as of a circuit with shots or noise."""
        drawn = any(getattr(part, "draws", False) for part in self._raw(0).modules())
        return drawn or getattr(self.options, "shots", None) is not None

    def _builds(self, options: Any) -> bool:
        try:
            self.population([0], [options])(self.x(1))
        except Exception:  # a value that the model does not allow
            return False
        return True

    def agent(self, seed: int, options: Any = None) -> nn.Module:
        """Return one agent, from a generator of that seed."""
        return self._told(self._raw(seed, options))

    def _raw(self, seed: int, options: Any = None) -> nn.Module:
        own = self.options if options is None else options
        with seeded(seed):  # as `run` builds it
            return self.make(own, torch.Generator().manual_seed(seed))

    @functools.cached_property
    def remembered(self) -> int:
        """How many numbers an agent remembers from step to step."""
        return populations.remembers(self._raw(0))

    def _told(self, module: nn.Module) -> nn.Module:
        """Let a module that remembers take its state behind the inputs, and return the next one behind the outputs."""
        if not self.remembered:
            return module
        inputs, forward = self.inputs, type(module).forward

        def told(self: nn.Module, x: Tensor) -> Tensor:
            return torch.cat(forward(self, x[..., :inputs], x[..., inputs:]), -1)

        module.__class__ = type(type(module).__name__, (type(module),), {"forward": told})
        return module

    def make(self, options: Any, generator: torch.Generator) -> nn.Module:
        """Return one agent from a generator."""
        return build_agent(self.build, self.inputs, OUT, options, generator, self.space)

    def x(self, *lead: int, seed: int = 0, batch: int = B) -> Tensor:
        """Return inputs (*lead, batch, inputs) with the memory behind them."""
        size = self.inputs + self.remembered
        drawn = torch.rand(*lead, batch, size, generator=torch.Generator().manual_seed(seed))
        return drawn * 2 - 1

    def population(self, seeds: Sequence[int], options: Sequence[Any] | None = None) -> nn.Module:
        """Return a population of freshly built agents, each with its own options if given."""
        own = [self.options] * len(seeds) if options is None else options
        agents = [self._raw(*each) for each in zip(seeds, own)]
        if self.spec.population is None:
            return self._told(populations.stack(agents))
        population: nn.Module = specs.resolve(self.spec.population)(agents, populations.joined(own))
        return self._told(population)


def check(subject: Subject, task: str | None = None) -> list[Finding]:
    """Check a model with 4 inputs and 3 outputs; one that asks for the observations' space, with all that it takes.

    Parameters
    ----------
    task:
        A task, or its file, whose observations are taken instead.
    """
    if subject.spec.name == specs.NO_MODEL:  # there is nothing to build
        return []
    spaces = _spaces(subject, task)
    subjects, rules = Subjects(subject, next(iter(spaces.values()))), Checklist()
    with one_thread():
        if not rules.run(
            "builds", "a torch.nn.Module from (4, 3, options, generator)", lambda: _builds(subjects)
        ):
            return rules.findings
        cause = "forward takes (B, inputs) and returns (B, outputs)"
        if not rules.run("shapes", "(B, 4) to (B, 3), float32, finite", lambda: _shapes(subjects), cause):
            return rules.findings
        rules.run(
            "parameters registered", "what wants a gradient is known to torch", lambda: _registered(subjects)
        )
        rules.run(
            "nothing unregistered",
            "what differs between seeds, or is changed by a pass, is registered",
            lambda: _unregistered(subjects),
        )
        rules.run("quantum parameters", "declared where the family is quantum", lambda: _quantum(subjects))
        rules.run("same seed", "the generator alone decides the parameters", lambda: _same(subjects))
        rules.run("different seed", "every generator gives other parameters", lambda: _different(subjects))
        rules.run("global randomness", "a pass moves no global generator", lambda: _global(subjects))
        rules.run("pure", "a pass changes neither inputs nor results of the next", lambda: _pure(subjects))
        if not subjects.sampled:
            rules.run("rows apart", "an input alone and in a batch: equal outputs", lambda: _rows(subjects))
            rules.run("no cache", "nothing is kept from a pass of the same shape", lambda: _cache(subjects))
        flows = rules.run("gradients", "reach every trainable parameter", lambda: _flow(subjects))
        if flows and not subjects.sampled:
            rules.run("finite differences", "equal the gradients", lambda: _differences(subjects))
        rules.run("copies", "deep copies are independent and equal", lambda: _copies(subjects))
        if not rules.run(
            "population", "(S, B, 4) to (S, B, 3), each slice its agent", lambda: _population(subjects)
        ):
            return rules.findings
        rules.run(
            "seed independence", "alone, in pairs, shuffled: the same bits", lambda: _independence(subjects)
        )
        cause = (
            "an option marked per_agent is a float64 tensor (S,) for `population` where agents differ in it"
        )
        rules.run(
            "options per agent",
            "two values in one population: the bits of each alone",
            lambda: _per_agent(subjects),
            cause,
        )
        rules.run("state", "saved, sliced and restored exactly", lambda: _state(subjects))
        further = dict(list(spaces.items())[1:])
        check_cases(rules, further, lambda space: _works(Subjects(subject, space)))
        check_cases(rules, subject.choices(), lambda chosen: _works(Subjects(chosen, subjects.space)))
    return rules.findings


def _spaces(subject: Subject, task: str | None) -> dict[str, Space[Any]]:
    """Return the observations to check with: a task's, numbers, or those that the model does not refuse in words."""
    assert isinstance(subject.spec, specs.ModelSpec)
    if task is not None:
        return {task: observed_space(World.of_task(task).one)}
    if "space" not in inspect.signature(specs.resolve(subject.spec.build)).parameters:
        return {"numbers": FLAT}
    taken = dict(SPACES)
    for name, space in SPACES.items():
        try:
            Subjects(subject, space).agent(0)
        except OptionError:
            del taken[name]
        except Exception:  # is named where it is built again
            pass
    return taken or SPACES


def _works(subjects: Subjects) -> None:
    """Check an agent and a population in a pass."""
    for rule in (_builds, _shapes, _registered, _flow, _population):
        rule(subjects)


def _builds(subjects: Subjects) -> None:
    agent = subjects.agent(0)
    require(
        isinstance(agent, nn.Module),
        f"build returned {type(agent).__name__}, not a torch.nn.Module: is `return` there?",
    )


def _shapes(subjects: Subjects) -> None:
    agent = subjects.agent(0)
    for batch in (B, 1):
        values = agent(subjects.x()[:batch])
        require(isinstance(values, Tensor), f"forward returned {type(values).__name__}, not a tensor")
        require(
            tuple(values.shape) == (batch, OUT + subjects.remembered),
            f"forward maps ({batch}, {subjects.inputs}) to {tuple(values.shape)}, and it must give ({batch}, {OUT}): "
            "the last layer has as many outputs as there are actions, and the batch comes first",
        )
        require(
            values.dtype == torch.float32,
            f"inputs of float32 give {values.dtype}: end forward with .to(x.dtype), or losses mix types",
        )
        require(
            bool(torch.isfinite(values).all()), "outputs are not finite: what do large or zero weights do?"
        )


def _inside(value: Any) -> Iterator[Any]:
    """Go through lists, tuples and dicts."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from _inside(item)
    else:
        yield value


def _registered(subjects: Subjects) -> None:
    agent = subjects.agent(0)
    known = {id(m) for m in agent.modules()}
    tensors = {id(t) for t in [*agent.parameters(), *agent.buffers()]}
    for path, module in agent.named_modules():
        for name, attribute in vars(module).items():
            if name.startswith("_") and name in vars(nn.Module()):
                continue
            full_name = f"{path}.{name}".lstrip(".")
            for item in _inside(attribute):
                require(
                    not isinstance(item, nn.Module) or id(item) in known,
                    f"self.{full_name} holds a module in a plain list or dict, so torch does not see its "
                    "parameters and nothing trains them: use nn.ModuleList or nn.ModuleDict",
                )
                require(
                    not (isinstance(item, Tensor) and item.requires_grad) or id(item) in tensors,
                    f"self.{full_name} is a tensor that wants a gradient and is no registered parameter, so nothing "
                    "trains or saves it: write self.name = nn.Parameter(...), or nn.ParameterList for several",
                )
    trainable = [name for name, p in agent.named_parameters() if p.requires_grad]
    require(bool(trainable), "there is no trainable parameter: write self.name = nn.Parameter(...)")


def _unregistered(subjects: Subjects) -> None:
    unregistered.require_none(
        subjects.agent,
        subjects.inputs + subjects.remembered,
        subjects.spec.name,
        subjects.spec.population is None,
    )


def _quantum(subjects: Subjects) -> None:
    agent = subjects.agent(0)
    declared = populations.quantum_parameters(agent)
    known = {name for name, _ in agent.named_parameters()}
    require(
        declared <= known,
        f"quantum_parameters() names {sorted(declared - known)}, which are none of {sorted(known)}",
    )
    if subjects.spec.family == "quantum":
        require(
            bool(declared),
            "family = 'quantum' and no parameter is declared quantum, so that quantum_lr reaches none: define "
            "quantum_parameters(self) -> set[str]",
        )
    else:
        require(
            not declared,
            f"family = 'classical', and quantum_parameters() names {sorted(declared)}: is it 'quantum'?",
        )


def _values(module: nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def _equal(a: dict[str, Tensor], b: dict[str, Tensor]) -> str | None:
    """Return the first name that differs, or None."""
    if a.keys() != b.keys():
        return ", ".join(sorted(a.keys() ^ b.keys()))
    return next((name for name, value in a.items() if not torch.equal(value, b[name])), None)


_DRAW = (
    "draw every number from the generator that build is given, or from torch's default one as layers of torch.nn do: "
    "while build runs, it follows from the seed, too"
)


def _same(subjects: Subjects) -> None:
    name = _equal(*(_values(subjects.agent(7)) for _ in range(2)))
    require(name is None, f"two builds from generators of the same seed differ in '{name}': {_DRAW}")


def _different(subjects: Subjects) -> None:
    questions.require_own_weights(subjects.agent, subjects.spec)
    generator, built = torch.Generator().manual_seed(7), []
    for call in range(2):
        with seeded(call):
            built.append(_values(subjects.make(subjects.options, generator)))
    require(
        _equal(*built) is not None,
        "the second network from one generator (a critic, say) equals the first: draw from the generator, do not "
        "only read its seed",
    )


def _global(subjects: Subjects) -> None:
    questions.require_no_global_draw(subjects.agent(0), subjects.x(), subjects.spec)


def _require_close(values: Tensor, others: Tensor, message: str) -> None:
    """Require equal outputs up to rounding: products round differently by the size of a batch."""
    difference = float((values - others).detach().abs().max())
    require(
        difference <= 1e-4 * max(1.0, float(others.detach().abs().max())), f"{message} (by {difference:.2g})"
    )


def _rows(subjects: Subjects) -> None:
    agent, x = subjects.agent(0), subjects.x()
    values = agent(x)
    for row in (0, B - 1):
        _require_close(
            agent(x[row : row + 1]),
            values[row : row + 1],
            f"row {row} of a batch of {B} gives another output alone: batch normalization, or a mean, maximum or "
            "softmax over the first axis, lets episodes that run side by side change each other",
        )


def _cache(subjects: Subjects) -> None:
    first, second = subjects.x(seed=0), subjects.x(seed=1)
    subjects.agent(0)(first)
    agent = subjects.agent(1)
    values = agent(second)
    _require_close(
        agent(torch.cat([second, second[:-1]]))[:B],  # a shape that nothing has had yet
        values,
        "the output depends on an earlier pass with inputs of the same shape, perhaps another agent's: a cache by "
        "shape holds only what follows from the shape alone",
    )


def _pure(subjects: Subjects) -> None:
    agent, x = subjects.agent(0), subjects.x()
    kept = x.clone()
    first = agent(x).detach().clone()
    require(
        torch.equal(x, kept),
        "forward changes its input in place: avoid x += ..., x.mul_(...), relu(inplace=True)",
    )
    if not subjects.sampled:
        require(
            torch.equal(first, agent(x).detach()),
            "two passes over the same input differ: dropout, batch normalization and other state have no place here, "
            "for target networks and greedy validation rely on a function",
        )


def _gradients(module: nn.Module, x: Tensor) -> dict[str, Tensor | None]:
    for parameter in module.parameters():
        parameter.grad = None
    values = module(x)
    require(
        bool(values.requires_grad),
        "the outputs have no gradient: is there a .detach(), .item(), .numpy() or torch.no_grad() in forward?",
    )
    values.square().sum().backward()
    return {name: p.grad for name, p in module.named_parameters() if p.requires_grad}


def _flow(subjects: Subjects) -> None:
    for name, gradient in _gradients(subjects.agent(0), subjects.x()).items():
        require(
            gradient is not None,
            f"parameter '{name}' gets no gradient: forward does not use it, or detaches what it gave",
        )
        assert gradient is not None
        require(bool(torch.isfinite(gradient).all()), f"the gradient of '{name}' is not finite")
        require(
            bool((gradient != 0).any()),
            f"the gradient of '{name}' is zero for {B} random inputs: do the outputs depend on it?",
        )


def _differences(subjects: Subjects) -> None:
    agent = subjects.agent(0).double()
    x = subjects.x().double()
    gradients = {name: g.clone() for name, g in _gradients(agent, x).items() if g is not None}
    exact_type = next(iter(gradients.values())).dtype == torch.float64
    step, tolerance = (1e-6, 1e-4) if exact_type else (1e-2, 5e-2)
    source = torch.Generator().manual_seed(1)
    for name, parameter in agent.named_parameters():
        if name not in gradients:
            continue
        direction = torch.randn(parameter.shape, generator=source, dtype=torch.float64)
        kept, sides = parameter.detach().clone(), []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                parameter.copy_(kept + sign * step * direction)
                sides.append(float(agent(x).square().sum()))
        with torch.no_grad():
            parameter.copy_(kept)
        numeric = (sides[0] - sides[1]) / (2 * step)
        exact = float((gradients[name] * direction).sum())
        require(
            abs(numeric - exact) <= tolerance * max(1.0, abs(exact)),
            f"the derivative by '{name}' is {exact:.6g}, finite differences give {numeric:.6g}: is a backward pass "
            "written by hand wrong, or a part of forward detached?",
        )


def _copies(subjects: Subjects) -> None:
    agent, x = subjects.agent(0), subjects.x()
    agent(x)
    copied = copy.deepcopy(agent)
    name = _equal(_values(agent), _values(copied))
    require(name is None, f"copy.deepcopy, which makes target networks, changes '{name}'")
    if not subjects.sampled:
        require(torch.equal(agent(x), copied(x)), "a deep copy computes something else than its original")
    before = _values(agent)
    with torch.no_grad():
        for parameter in copied.parameters():
            parameter.add_(1.0)
    name = _equal(before, _values(agent))
    require(
        name is None, f"a deep copy shares '{name}' with its original: target networks would follow at once"
    )


def _population(subjects: Subjects) -> None:
    together, x = subjects.population(range(S)), subjects.x(S)
    values = together(x)
    require(
        tuple(values.shape) == (S, B, OUT + subjects.remembered),
        f"the population maps ({S}, {B}, {subjects.inputs}) to {tuple(values.shape)}, and it must give "
        f"({S}, {B}, {OUT})",
    )
    agent = subjects.agent(2)
    mine = {name: tuple(p.shape) for name, p in agent.named_parameters()}
    theirs = {name: tuple(p.shape) for name, p in together.named_parameters()}
    require(
        theirs == {name: (S, *shape) for name, shape in mine.items()},
        f"one agent's parameters are {mine}, the population's {theirs}: same names, with a leading axis of seeds",
    )
    require(
        populations.quantum_parameters(together) == populations.quantum_parameters(agent),
        "the population declares other quantum parameters than its agents: hand quantum_parameters() on",
    )
    for seed in range(0 if subjects.sampled else S):
        difference = float((values[seed] - subjects.agent(seed)(x[seed])).detach().abs().max())
        require(
            difference < 1e-4,
            f"slice {seed} of the population differs from agent {seed} alone by {difference:.2g}: are slices mixed, or "
            "initial parameters drawn again?",
        )


_EXACT = (
    "torch rounds sigmoid, silu, softplus, elu and gelu differently at the end of a tensor than before it: use relu, "
    "leaky_relu, tanh, sin, cos or exp; products of narrow matrices round by the size of the stack: use "
    "torch.nn.Linear (which is replaced by an exact form) or qrlsuite.population.linear"
)


def _independence(subjects: Subjects) -> None:
    """Compare agents alone and among others, at the options that are checked and at odd ones, for several batches."""
    for batch in BATCHES:
        _independent(subjects, subjects.options, batch, "")
    for name, own in subjects.odd.items():
        for batch in BATCHES:
            _independent(subjects, own, batch, f" ({name} = {ODD})")


def _independent(subjects: Subjects, own: Any, batch: int, at: str) -> None:
    """Compare agents with options `own`, alone and among others, for a batch; `at` names the options in messages."""
    x = 3 * subjects.x(S, batch=batch)  # where functions bend
    gradients = _gradients(subjects.population(range(S), [own] * S), x)
    values = subjects.population(range(S), [own] * S)(x).detach()
    for members in SIZES:
        chosen, options = list(members), [own] * len(members)
        require(
            torch.equal(subjects.population(chosen, options)(x[chosen]).detach(), values[chosen]),
            f"seeds {chosen} among themselves compute other values than among all {S}{at}: {_EXACT}, and no reduction "
            "over seeds",
        )
        for name, gradient in _gradients(subjects.population(chosen, options), x[chosen]).items():
            expected = gradients[name]
            require(
                gradient is not None and expected is not None and torch.equal(gradient, expected[chosen]),
                f"seeds {chosen} among themselves get another gradient of '{name}' than among all {S}{at}: slices must "
                f"not mix, and sums must not depend on the size of the stack; {_EXACT}",
            )


def _per_agent(subjects: Subjects) -> None:
    """Build one seed with two values of each marked option: as two agents, and alone."""
    x = subjects.x()
    for option, both in subjects.per_agent.items():
        together = subjects.population([0, 0], both)
        values, gradients = together(x.expand(2, -1, -1)).detach(), _gradients(together, x.expand(2, -1, -1))
        for place, own in enumerate(both):
            alone = subjects.population([0], [own])
            same = torch.equal(alone(x[None]).detach(), values[[place]])
            for name, gradient in _gradients(alone, x[None]).items():
                beside = gradients[name]
                same &= gradient is not None and beside is not None and torch.equal(gradient, beside[[place]])
            require(
                same,
                f"an agent with {option} = {getattr(own, option):g} computes something else beside one with another "
                "value than alone: an option that is used after `build` is not the same for all agents of a "
                "population, so keep it per agent, as a buffer, or give the model a `population` that takes it as a "
                "float64 tensor (S,); or leave per_agent out",
            )


def _state(subjects: Subjects) -> None:
    first, second = subjects.population(range(S)), subjects.population(range(10, 10 + S))
    x = subjects.x(S)
    first(x)  # a pass may advance a counter
    state = _values(first)
    for name, value in state.items():
        require(
            value.dim() > 0 and value.shape[0] == S,
            f"state '{name}' of shape {tuple(value.shape)} has no leading axis of {S} seeds: checkpoints are sliced",
        )
    second.load_state_dict(state)
    lost = _equal(state, _values(second))
    require(lost is None, f"state '{lost}' is not restored by load_state_dict")
    require(
        torch.equal(first(x).detach(), second(x).detach()),
        "a population with restored state computes something else: something it depends on is not in state_dict(); "
        "register it with register_buffer",
    )
    alone = subjects.population([99])
    alone.load_state_dict({name: value[3:4] for name, value in state.items()})
    first.load_state_dict(state)
    require(
        torch.equal(first(x)[3:4].detach(), alone(x[3:4]).detach()),
        "slice 3 of the state, restored as a population of one, computes something else",
    )
