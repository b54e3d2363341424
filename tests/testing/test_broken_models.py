"""Models that break one rule each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import population
from qrlsuite.specs import ModelSpec
from tests.testing.broken import Broken, assert_breaks, own_rules

HERE = __name__


@dataclass(frozen=True)
class Options:
    pass


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


def nothing(obs: int, out: int, options: Options, generator: torch.Generator) -> None:
    Good(obs, out, generator)


def narrow(obs: int, out: int, options: Options, generator: torch.Generator) -> nn.Module:
    return Good(obs, out - 1, generator)


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


class Unseeded(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.linear.bias.data += np.random.rand()  # noqa: NPY002


class Constant(Good):
    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, torch.Generator().manual_seed(0))


class Greedy(Good):
    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        torch.rand(1)


class InPlace(Good):
    def forward(self, x: Tensor) -> Tensor:
        y = super().forward(x.clone())
        with torch.no_grad():
            x.mul_(0.5)
        return y


class Unused(Good):
    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__(obs, out, generator)
        self.unused = nn.Parameter(torch.rand(2, generator=generator))


class HalfGradient(Good):
    def forward(self, x: Tensor) -> Tensor:
        y = super().forward(x)
        return y + (y.detach() - y) / 2


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


def spec(build: str = f"{HERE}:good", **more: Any) -> ModelSpec:
    given = {"family": "classical", "options": f"{HERE}:Options", **more}
    return ModelSpec(name="broken", summary="Breaks a rule", build=build, **given)


BROKEN = {
    "builds": Broken(spec(f"{HERE}:nothing"), r"returned NoneType, not a torch.nn.Module: is `return` there"),
    "shapes": Broken(spec(f"{HERE}:narrow"), r"maps \(6, 4\) to \(6, 2\), and it must give \(6, 3\)"),
    "parameters registered": Broken(spec(build_of(Hidden)), r"self.scales is a tensor .* nn.ParameterList"),
    "nothing hidden": Broken(
        spec(build_of(Drawn)), r"self\.offsets\['all'\] differs between seeds.*self\.register_buffer"
    ),
    "quantum parameters": Broken(spec(build_of(Mislabeled)), r"names \['linear.weight'\]: is it 'quantum'"),
    "same seed": Broken(
        spec(build_of(Unseeded)),
        r"same seed differ in 'linear.bias': draw every number",
        frozenset({"population"}),
    ),
    "different seed": Broken(spec(build_of(Constant)), r"different seeds give the same parameters"),
    "global randomness": Broken(spec(build_of(Greedy)), r"draws from torch's global generator"),
    "pure": Broken(
        spec(build_of(InPlace)),
        r"changes its input in place: avoid",
        frozenset({"finite differences", "copies", "population"}),
    ),
    "gradients": Broken(
        spec(build_of(Unused)), r"'unused' gets no gradient", frozenset({"seed independence"})
    ),
    "finite differences": Broken(spec(build_of(HalfGradient)), r"finite differences give .*backward pass"),
    "copies": Broken(spec(build_of(Shared)), r"deep copy shares 'linear.weight' with its original"),
    "population": Broken(
        spec(population=f"{HERE}:reversed_population"),
        r"slice 0 of the population differs from agent 0 alone",
    ),
    "seed independence": Broken(
        spec(population=f"{HERE}:coupled"), r"among themselves compute other values", frozenset({"state"})
    ),
    "state": Broken(spec(population=f"{HERE}:forgetful"), r"is not in state_dict\(\); register it"),
}


@pytest.mark.parametrize("rule", BROKEN)
def test_one_rule_is_broken(rule: str) -> None:
    assert_breaks("models", rule, BROKEN[rule])


def test_every_rule_has_a_model_that_breaks_it() -> None:
    findings = own_rules("models", spec())
    assert all(finding.ok for finding in findings), findings
    assert {finding.rule for finding in findings} == BROKEN.keys()
