"""A model that hides state from torch would train seeds that are not what they are alone: it is refused."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from qrlsuite import registry, specs
from qrlsuite.errors import PluginError
from qrlsuite.experiment.entry import Entry
from qrlsuite.registry import Registered
from qrlsuite.results.checkpoint import group_id
from qrlsuite.results.progress import ProgressFile
from qrlsuite.results.store import EntryStore
from qrlsuite.specs import ModelSpec
from qrlsuite.training import unregistered
from tests.commands import say
from tests.conftest import Train, results


@dataclass(frozen=True)
class Options:
    pass


class Base(nn.Module):
    """A linear layer, and whatever a case adds."""

    def __init__(self, obs: int, out: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.rand(out, obs, generator=generator))
        self.add(obs, generator)

    def add(self, obs: int, generator: torch.Generator) -> None:
        """Add what the case is about."""

    def forward(self, x: Tensor) -> Tensor:
        return x @ self.weight.T


def linear(generator: torch.Generator) -> nn.Module:
    layer = nn.utils.skip_init(nn.Linear, 2, 2)
    for parameter in layer.parameters():
        parameter.data = torch.rand(parameter.shape, generator=generator)
    return layer


class Attribute(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.w = torch.randn(obs, generator=generator)

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x * self.w)


class ArraysInAList(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.frequencies = [torch.randn(obs, generator=generator).numpy() for _ in range(2)]


class ModuleInADict(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.heads = {"left": linear(generator)}


class InASubmodule(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.body = nn.Sequential(Attribute(obs, 2, generator))


class Nested(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.all = ({"a": [torch.rand(2, generator=generator)]},)


class Alias(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.trained = [self.weight]  # torch.func gives the registered one another value, this one stays


class Float(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.scale = float(torch.rand((), generator=generator))


class Source(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.generator = generator


class Remembers(Base):
    last: Tensor | None = None

    def forward(self, x: Tensor) -> Tensor:
        self.last = super().forward(x)
        return self.last


class Counts(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.passes = np.zeros(1)

    def forward(self, x: Tensor) -> Tensor:
        self.passes += 1
        return super().forward(x)


class Recurrent(Base):
    state: Tensor

    def add(self, obs: int, generator: torch.Generator) -> None:
        self.register_buffer("state", torch.zeros(obs))

    def forward(self, x: Tensor) -> Tensor:
        self.state = torch.tanh(self.state + x.mean(0))
        return super().forward(x + self.state)


class Normalized(Base):
    def add(self, obs: int, generator: torch.Generator) -> None:
        self.norm = nn.BatchNorm1d(obs)

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(self.norm(x))


REFUSED: dict[type[Base], str] = {
    Attribute: r"self\.w differs between seeds.*self\.register_buffer\('name', tensor\)",
    ArraysInAList: r"self\.frequencies\[0\] differs between seeds.*register_buffer",
    ModuleInADict: r"self\.heads\['left'\]\.weight differs between seeds.*nn\.ModuleDict",
    InASubmodule: r"self\.body\.0\.w differs between seeds",
    Nested: r"self\.all\[0\]\['a'\]\[0\] differs between seeds",
    Alias: r"self\.trained\[0\] differs between seeds",
    Float: r"self\.scale differs between seeds",
    Source: r"self\.generator differs between seeds.*draw what is random in `build`",
    Remembers: r"self\.last is changed by a forward pass.*register_buffer",
    Counts: r"self\.passes is changed by a forward pass",
    Recurrent: r"the buffer self\.state is changed by a forward pass.*would lose what the pass writes",
    Normalized: r"the buffer self\.norm\.running_mean is changed by a forward pass",
}


class Legal(Base):
    """Constants, counters, shared objects, second names of submodules, buffers, and a recurrent layer."""

    backend = types.SimpleNamespace(cache=torch.zeros(1))

    def add(self, obs: int, generator: torch.Generator) -> None:
        self.grid = torch.linspace(0, 1, 5)
        self.tables = {"a": [np.arange(3), float("nan")]}
        self.shared = self.backend
        self.passes = 0
        self.inner = linear(generator)
        self.layers = [self.inner, nn.ReLU()]
        self.recurrent = nn.GRU(obs, 2)
        for parameter in self.recurrent.parameters():
            parameter.data = torch.rand(parameter.shape, generator=generator)
        self.register_buffer("key", torch.rand(2, generator=generator))

    def forward(self, x: Tensor) -> Tensor:
        self.passes += 1
        self.shared.cache = self.shared.cache + 1
        return super().forward(x)


def of(cls: type[Base]) -> Callable[[int], nn.Module]:
    return lambda seed: cls(3, 2, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("cls", REFUSED)
def test_unregistered_state_is_refused(cls: type[Base]) -> None:
    with pytest.raises(PluginError, match=f"^model 'acme': {REFUSED[cls]}"):
        unregistered.require_none(of(cls), 3, "acme")


def test_constants_and_shared_objects_are_legal() -> None:
    unregistered.require_none(of(Legal), 3, "acme")


def test_a_population_of_its_own_may_count_passes_in_a_buffer() -> None:
    unregistered.require_none(of(Recurrent), 3, "acme", stacked=False)


def test_global_randomness_is_not_disturbed() -> None:
    class Noisy(Base):
        def forward(self, x: Tensor) -> Tensor:
            return super().forward(x + torch.rand(3))

    before = torch.get_rng_state()
    unregistered.require_none(of(Noisy), 3, "acme")
    assert torch.equal(torch.get_rng_state(), before)


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[Base]], ModelSpec]:
    """Register a model named `acme`."""

    def register(cls: type[Base]) -> ModelSpec:
        module = types.ModuleType("acme_unregistered")
        vars(module).update(
            Options=Options, build=lambda obs, out, options, generator: cls(obs, out, generator)
        )
        monkeypatch.setitem(sys.modules, "acme_unregistered", module)
        spec = ModelSpec(
            "acme",
            "hides",
            family="classical",
            options="acme_unregistered:Options",
            build="acme_unregistered:build",
        )
        monkeypatch.setitem(registry.load().entries[specs.ModelSpec], "acme", Registered(spec, "qrlsuite"))
        return spec

    return register


@pytest.mark.parametrize("cls", [Attribute, ArraysInAList, ModuleInADict, Remembers, Recurrent])
def test_run_refuses_it_before_training(
    cls: type[Base], install: Callable[..., Any], tiny_task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(cls)
    monkeypatch.setattr(Entry, "third_party", lambda self: ["acme"])
    with pytest.raises(PluginError, match=REFUSED[cls]):
        say("run", "acme", "--task", tiny_task)
    assert not list(Path(tiny_task).parent.rglob("epochs.jsonl"))


def test_what_is_registered_trains_as_alone(install: Callable[..., Any], train: Train) -> None:
    class Registers(Base):
        w: Tensor

        def add(self, obs: int, generator: torch.Generator) -> None:
            self.register_buffer("w", torch.randn(obs, generator=generator))

        def forward(self, x: Tensor) -> Tensor:
            return super().forward(x * self.w)

    install(Registers)
    together, alone = (
        train(name, seeds, model="acme", settings=()) for name, seeds in (("a", (0, 1)), ("b", (1,)))
    )
    assert results(together, 1) == results(alone, 1)


def test_a_model_that_cannot_be_vmapped_is_said_once(install: Callable[..., Any], train: Train) -> None:
    class Branching(Base):
        def forward(self, x: Tensor) -> Tensor:
            return super().forward(x if float(x.sum()) > 0 else -x)

    install(Branching)
    folder = train("runs", (0, 1), model="acme", settings=())
    (warning,) = ProgressFile(EntryStore(folder), group_id((0, 1))).read()["warnings"]
    assert warning.startswith(
        "model 'acme' cannot be run by torch.vmap, so its agents are computed one by one"
    )
