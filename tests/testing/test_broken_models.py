"""Models that break one rule each."""

from __future__ import annotations

import itertools
import os
import random
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import pytest
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import population
from qrlsuite.options import Tuned
from qrlsuite.specs import ModelSpec
from qrlsuite.testing import model as rules
from qrlsuite.testing.common import Subject
from tests.testing.broken import Broken, Cases, assert_breaks, ids, own_rules

HERE = __name__


@dataclass(frozen=True)
class Options:
    pass


@dataclass(frozen=True)
class GainOptions:
    gain: Annotated[float, Tuned(0.1, 10, per_agent=True)] = 1.0


CALLS = itertools.count(0, 1000)


class Good(nn.Module):
    """A linear layer, drawn from the generator."""

    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.linear = nn.utils.skip_init(nn.Linear, obs, out)
        for parameter in self.linear.parameters():
            parameter.data = torch.rand(parameter.shape, generator=generator) - 0.5

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.linear(x)
        return y


def good(obs: int, out: int, options: Options, generator: torch.Generator) -> nn.Module:
    return Good(obs, out, generator)


@dataclass(frozen=True)
class WidthOptions:
    width: Annotated[int, Field(ge=1)] = 32


class Curved(nn.Module):
    """A hidden layer whose function torch rounds differently at the end of a tensor, which 32 units never show."""

    def __init__(self, obs: int, out: int, options: WidthOptions, generator: torch.Generator) -> None:
        super().__init__()
        self.hidden = Good(obs, options.width, generator)
        self.out = Good(options.width, out, generator)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.out(nn.functional.silu(self.hidden(x)))
        return y


class Amplified(Good):
    """Multiplies its inputs by an option, which a stack of agents has from the first."""

    def __init__(self, obs: int, out: int, options: GainOptions, generator: torch.Generator) -> None:
        super().__init__(obs, out, generator)
        self.options = options

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x * self.options.gain)


def nothing(obs: int, out: int, options: Options, generator: torch.Generator) -> None:
    Good(obs, out, generator)


def narrow(obs: int, out: int, options: Options, generator: torch.Generator) -> nn.Module:
    return Good(obs, out - 1, generator)


class Pair(Good):
    def forward(self, x: Tensor) -> Any:
        return super().forward(x), x


class Double(Good):
    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x).double()


class Infinite(Good):
    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) / 0


class Listed(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.layers = [nn.utils.skip_init(nn.Linear, 1, 1)]
        for parameter in self.layers[0].parameters():
            parameter.data = torch.ones_like(parameter)


class Frozen(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.requires_grad_(False)


class Hidden(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.scales = [torch.ones(3, requires_grad=True)]

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * self.scales[0]


class Drawn(Good):
    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, generator)
        self.offsets = {"all": torch.rand(out, generator=generator)}


class Mislabeled(Good):
    def quantum_parameters(self) -> set[str]:
        return {"linear.weight"}


class Misspelled(Good):
    def quantum_parameters(self) -> set[str]:
        return {"weights"}


class Unseeded(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.linear.bias.data += os.urandom(1)[0] + next(CALLS)


class Constant(Good):
    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, torch.Generator().manual_seed(0))


class Reseeded(Good):
    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, torch.Generator().manual_seed(generator.initial_seed()))


class Greedy(Good):
    def forward(self, x: Tensor) -> Tensor:
        random.random()
        return super().forward(x)


class InPlace(Good):
    def forward(self, x: Tensor) -> Tensor:
        y = super().forward(x.clone())
        with torch.no_grad():
            x.mul_(0.5)
        return y


class Counting(Good):
    count: Tensor

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.register_buffer("count", torch.zeros(1))

    def forward(self, x: Tensor) -> Tensor:
        self.count += 1
        return super().forward(x) * self.count


class Centered(Good):
    def forward(self, x: Tensor) -> Tensor:
        y = super().forward(x)
        return y - y.mean(0)


SCALES: dict[tuple[int, ...], float] = {}


class Cached(Good):
    def forward(self, x: Tensor) -> Tensor:
        if tuple(x.shape) not in SCALES:
            SCALES[tuple(x.shape)] = float(x.detach().abs().max())
        return super().forward(x) / SCALES[tuple(x.shape)]


class Detached(Good):
    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x).detach()


class Steep(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.edge = nn.Parameter(torch.zeros(1))

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) + self.edge.sqrt()


class Flat(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.edge = nn.Parameter(torch.zeros(1))

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) + 0 * self.edge


class Unused(Good):
    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, generator)
        self.unused = nn.Parameter(torch.rand(2, generator=generator))


class HalfGradient(Good):
    def forward(self, x: Tensor) -> Tensor:
        y = super().forward(x)
        return y + (y.detach() - y) / 2


class Redrawn(Good):
    def __deepcopy__(self, memo: Any) -> Redrawn:
        return Redrawn(4, 3, torch.Generator().manual_seed(99))


class Shared(Good):
    def __deepcopy__(self, memo: Any) -> Shared:
        return self


def build_of(cls: type[Good]) -> str:
    """Register `build_<class>` in this module and return the reference."""

    def build(obs: int, out: int, options: Options, generator: torch.Generator) -> nn.Module:
        return cls(obs, out, generator)

    globals()[f"build_{cls.__name__}"] = build
    return f"{HERE}:build_{cls.__name__}"


def reversed_population(agents: Sequence[nn.Module], options: Options) -> nn.Module:
    return population.stack(list(agents)[::-1])


def coupled(agents: Sequence[nn.Module], options: Options) -> nn.Module:
    together = population.stack(list(agents))
    together.register_forward_hook(lambda module, given, y: y + 1e-6 * y.mean(0))
    return together


def forgetful(agents: Sequence[nn.Module], options: Options) -> nn.Module:
    together = population.stack(list(agents))
    offset = torch.stack([agent.linear.bias.detach().sum() for agent in agents])  # type: ignore[union-attr]
    together.register_forward_hook(lambda module, given, y: y + 1e-6 * offset[:, None, None])
    return together


def short(agents: Sequence[nn.Module], options: Options) -> nn.Module:
    together = population.stack(list(agents))
    together.register_forward_hook(lambda module, given, y: y[:, :, :2])
    return together


class Wrapped(nn.Module):
    def __init__(self, together: nn.Module) -> None:
        super().__init__()
        self.inner = together

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.inner(x)
        return y


def wrapped(agents: Sequence[nn.Module], options: Options) -> nn.Module:
    return Wrapped(population.stack(list(agents)))


class Quantum(Good):
    def quantum_parameters(self) -> set[str]:
        return {"linear.weight"}


def classical_population(agents: Sequence[nn.Module], options: Options) -> nn.Module:
    together = population.stack(list(agents))
    together.quantum_parameters = set  # type: ignore[assignment]
    return together


def deaf(agents: Sequence[nn.Module], options: Options) -> nn.Module:
    together = population.stack(list(agents))
    together.load_state_dict = lambda state: None  # type: ignore[method-assign,assignment,misc]
    return together


class WithOneCounter(nn.Module):
    """A population written by hand, whose counter has no axis of seeds."""

    def __init__(self, agents: Sequence[Any], options: Options) -> None:
        super().__init__()
        self.linear = nn.Module()
        self.linear.weight = nn.Parameter(torch.stack([agent.linear.weight.detach() for agent in agents]))
        self.linear.bias = nn.Parameter(torch.stack([agent.linear.bias.detach() for agent in agents]))
        self.register_buffer("steps", torch.tensor(0))

    def forward(self, x: Tensor) -> Tensor:
        return population.linear(x, self.linear.weight, self.linear.bias)


def spec(build: str = f"{HERE}:good", **more: Any) -> ModelSpec:
    given = {"family": "classical", "options": f"{HERE}:Options", **more}
    return ModelSpec(name="broken", summary="Breaks a rule", build=build, **given)


NO_GRADIENT = frozenset({"gradients", "seed independence"})
COUNTS = frozenset({"finite differences", "nothing hidden", "rows apart", "no cache"})

BROKEN: Cases = [
    ("builds", Broken(spec(f"{HERE}:nothing"), r"returned NoneType, not a torch.nn.Module: is `return` there")),
    ("shapes", Broken(spec(f"{HERE}:narrow"), r"maps \(6, 4\) to \(6, 2\), and it must give \(6, 3\)")),
    ("parameters registered", Broken(spec(build_of(Hidden)), r"self.scales is a tensor .* nn.ParameterList")),
    ("nothing hidden", Broken(
        spec(build_of(Drawn)), r"self\.offsets\['all'\] differs between seeds.*self\.register_buffer"
    )),
    ("quantum parameters", Broken(spec(build_of(Mislabeled)), r"names \['linear.weight'\]: is it 'quantum'")),
    ("same seed", Broken(
        spec(build_of(Unseeded)),
        r"same seed differ in 'linear.bias': draw every number",
        frozenset({"population"}),
    )),
    ("different seed", Broken(spec(build_of(Constant)), r"different seeds give the same parameters")),
    ("global randomness", Broken(spec(build_of(Greedy)), r"a pass: it moved Python's `random`")),
    ("rows apart", Broken(
        spec(build_of(Centered)), r"row 0 of a batch of 6 gives another output alone", frozenset({"no cache"})
    )),
    ("no cache", Broken(
        spec(build_of(Cached)), r"earlier pass with inputs of the same shape", frozenset({"rows apart"})
    )),
    ("pure", Broken(
        spec(build_of(InPlace)),
        r"changes its input in place: avoid",
        frozenset({"finite differences", "copies", "population", "rows apart", "no cache"}),
    )),
    ("gradients", Broken(
        spec(build_of(Unused)), r"'unused' gets no gradient", frozenset({"seed independence"})
    )),
    ("finite differences", Broken(spec(build_of(HalfGradient)), r"finite differences give .*backward pass")),
    ("copies", Broken(spec(build_of(Shared)), r"deep copy shares 'linear.weight' with its original")),
    ("population", Broken(
        spec(population=f"{HERE}:reversed_population"),
        r"slice 0 of the population differs from agent 0 alone",
    )),
    ("seed independence", Broken(
        spec(population=f"{HERE}:coupled"), r"among themselves compute other values", frozenset({"state"})
    )),
    ("seed independence", Broken(
        spec(f"{HERE}:Curved", options=f"{HERE}:WidthOptions"),
        r"among themselves compute other values than among all 5 \(width = 5\): torch rounds .*silu.*: use relu.* tanh",
    )),
    ("options per agent", Broken(
        spec(f"{HERE}:Amplified", options=f"{HERE}:GainOptions"),
        r"gain = 10 computes something else beside one with another value than alone",
    )),
    ("state", Broken(spec(population=f"{HERE}:forgetful"), r"is not in state_dict\(\); register it")),
    ("shapes", Broken(spec(build_of(Pair)), r"forward returned tuple, not a tensor")),
    ("shapes", Broken(spec(build_of(Double)), r"float32 give torch.float64: end forward with \.to\(x\.dtype\)")),
    ("shapes", Broken(spec(build_of(Infinite)), r"outputs are not finite")),
    ("parameters registered", Broken(spec(build_of(Listed)), r"self\.layers holds a module .* use nn.ModuleList")),
    ("parameters registered", Broken(spec(build_of(Frozen)), r"no trainable parameter", NO_GRADIENT)),
    ("quantum parameters", Broken(
        spec(build_of(Misspelled), family="quantum"), r"names \['weights'\], which are none of \['linear.bias'"
    )),
    ("quantum parameters", Broken(spec(family="quantum"), r"no parameter is declared quantum.* quantum_lr")),
    ("different seed", Broken(spec(build_of(Reseeded)), r"second network from one generator .* only read its seed")),
    ("pure", Broken(spec(build_of(Counting)), r"two passes over the same input differ: dropout", COUNTS)),
    ("gradients", Broken(spec(build_of(Detached)), r"outputs have no gradient: is there a \.detach\(\)", NO_GRADIENT)),
    ("gradients", Broken(spec(build_of(Steep)), r"gradient of 'edge' is not finite")),
    ("gradients", Broken(spec(build_of(Flat)), r"gradient of 'edge' is zero for 6 random inputs")),
    ("copies", Broken(spec(build_of(Redrawn)), r"copy\.deepcopy, which makes target networks, changes 'linear")),
    ("population", Broken(spec(population=f"{HERE}:short"), r"population maps \(5, 6, 4\) to \(5, 6, 2\)")),
    ("population", Broken(spec(population=f"{HERE}:wrapped"), r"same names, with a leading axis of seeds")),
    ("population", Broken(
        spec(build_of(Quantum), family="quantum", population=f"{HERE}:classical_population"),
        r"declares other quantum parameters than its agents",
    )),
    ("state", Broken(spec(population=f"{HERE}:deaf"), r"is not restored by load_state_dict")),
    ("state", Broken(spec(population=f"{HERE}:WithOneCounter"), r"'steps' of shape \(\) has no leading axis")),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "case"), BROKEN, ids=ids(BROKEN))
def test_one_rule_is_broken(rule: str, case: Broken) -> None:
    assert_breaks("models", rule, case)


def test_every_rule_has_a_model_that_breaks_it() -> None:
    findings = own_rules("models", spec())
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == {rule for rule, _ in BROKEN}


SHARING = """
import torch
from pydantic.dataclasses import dataclass


@dataclass(frozen=True)
class Options:
    pass


WEIGHTS = {}


def good(obs, out, options, generator):
    return torch.nn.Linear(obs, out)  # from torch's own generator, which `build` may use


def shared(obs, out, options, generator):
    network = torch.nn.Sequential(torch.nn.Linear(obs, 5), torch.nn.Linear(5, out))
    with torch.no_grad():
        network[0].weight.copy_(WEIGHTS.setdefault("body", network[0].weight.detach().clone()))
    return network
"""


def test_weights_that_all_seeds_share_show_in_the_order_of_building(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a process of its own for either order: here, and in any other rule, all seeds have the first one's alike."""
    (tmp_path / "acme_sharing.py").write_text(SHARING)
    monkeypatch.syspath_prepend(tmp_path)
    broken = {}
    for name in ("good", "shared"):
        given = spec(f"acme_sharing:{name}", options="acme_sharing:Options")
        findings = rules.check(Subject("models", given, "acme", ("acme_sharing",), {}))
        broken[name] = {finding.rule: finding.message for finding in findings if not finding.ok}
    assert broken["good"] == {}
    assert broken["shared"].keys() == {"build order"}
    assert re.match(
        r"seed \d has other parameters where another seed is built before", broken["shared"]["build order"]
    )
