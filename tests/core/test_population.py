"""Populations: S agents in one module, each bitwise the agent it is alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from torch import Tensor, nn

from qrlsuite import population
from qrlsuite.population import Adam, linear

STACK = 101
SLICES = [(1, 0), (1, 7), (1, 100), (2, 3), (17, 5), (100, 1)]
WIDTHS = (16, 32, 64, 128, 256)
MLP_LAYERS = [(3, w) for w in WIDTHS] + [(w, w) for w in WIDTHS] + [(w, o) for w in WIDTHS for o in (1, 2, 3)]
VQC_LAYERS = [(i, n) for n in (2, 4, 6, 8, 10, 12, 14, 16, 20) for i in (3, 4)]
VQC_LAYERS += [(n, o) for n in (2, 4, 6, 8, 10, 12, 14, 16, 20) for o in (1, 2, 3)]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.mark.parametrize(("inputs", "outputs"), MLP_LAYERS + VQC_LAYERS)
def test_linear_layers_do_not_depend_on_their_place_in_the_stack(inputs: int, outputs: int) -> None:
    source = torch.Generator().manual_seed(inputs * 1000 + outputs)
    weight = torch.randn(STACK, outputs, inputs, generator=source)
    bias = torch.randn(STACK, outputs, generator=source)
    hidden = inputs > 4  # only later layers pass a gradient on to their input
    for batch in (10, 64, 80, 100):
        x = torch.randn(STACK, batch, inputs, generator=source)
        cotangent = torch.randn(STACK, batch, outputs, generator=source)

        def run(size: int, offset: int, x: Tensor = x, cotangent: Tensor = cotangent) -> list[Tensor]:
            part = slice(offset, offset + size)
            w, b = weight[part].clone().requires_grad_(), bias[part].clone().requires_grad_()
            given = x[part].clone().requires_grad_(hidden)
            y = linear(given, w, b)
            gradients = torch.autograd.grad(y, [w, b, *([given] if hidden else [])], cotangent[part])
            return [y.detach(), *gradients]

        whole = run(STACK, 0)
        for size, offset in SLICES:
            for name, one, all_ in zip(("output", "weight", "bias", "input"), run(size, offset), whole):
                assert torch.equal(one, all_[offset : offset + size]), (
                    f"{name}, batch {batch}, {size} at {offset}"
                )


def test_linear_is_the_linear_layer() -> None:
    layer = nn.Linear(5, 7)
    x = torch.randn(11, 5)
    torch.testing.assert_close(linear(x[None], layer.weight[None], layer.bias[None])[0], layer(x))


def modules(count: int) -> list[nn.Module]:
    return [nn.Sequential(nn.Linear(3, 20), nn.Tanh(), nn.Linear(20, 2)) for _ in range(count)]


class Branching(nn.Module):
    """A module that cannot be vmapped: its control flow depends on the data."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.rand(3))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale if float(x.sum()) > 0 else x + self.scale


@pytest.mark.parametrize("kind", ["vmapped", "looped"])
def test_a_stacked_population_is_its_modules(kind: str) -> None:
    agents = modules(5) if kind == "vmapped" else [Branching() for _ in range(5)]
    together = population.stack(agents)
    x = torch.randn(5, 8, 3)
    expected = torch.stack([agent(x[s]) for s, agent in enumerate(agents)])
    torch.testing.assert_close(together(x), expected)
    assert [n for n, _ in together.named_parameters()] == [n for n, _ in agents[0].named_parameters()]
    together(x).square().sum().backward()
    for s, agent in enumerate(agents):
        agent(x[s]).square().sum().backward()
        for (_, mine), (_, theirs) in zip(together.named_parameters(), agent.named_parameters()):
            assert mine.grad is not None
            torch.testing.assert_close(mine.grad[s], theirs.grad)
    assert isinstance(together, population.StackedPopulation)
    assert together._vmap == (kind == "vmapped")


class Foreign(torch.autograd.Function):
    """Doubles, without a rule for vmap."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return 2 * x

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return 2 * gradients[0]


UNBATCHABLE: dict[str, Callable[[Tensor], Tensor]] = {
    "control flow": lambda x: x if x.sum() > 0 else -x,
    "item": lambda x: x * x.sum().item(),
    "numpy": lambda x: torch.from_numpy(x.detach().numpy()),
    "tolist": lambda x: torch.tensor(x.tolist()),
    "mask": lambda x: x + x[x > 0.5].sum(),
    "unique": lambda x: x + torch.unique(x).sum(),
    "nonzero": lambda x: x + len(torch.nonzero(x)),
    "foreign": lambda x: cast(Tensor, Foreign.apply(x)),
    "sparse": lambda x: x.to_sparse().to_dense(),
}


class Through(nn.Module):
    """A linear layer of what a function gives."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function
        self.weight = nn.Parameter(torch.rand(2, 3))

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x) @ self.weight.T


@pytest.mark.parametrize("name", UNBATCHABLE)
@pytest.mark.filterwarnings("ignore:.*nvoking.*:UserWarning", "ignore:.*parse.*:UserWarning")
def test_what_cannot_be_vmapped_is_looped_over_and_said(name: str) -> None:
    agents = [Through(UNBATCHABLE[name]) for _ in range(3)]
    together, x = population.stack(agents), torch.rand(3, 4, 3)
    for _ in range(2):
        torch.testing.assert_close(together(x), torch.stack([agent(x[s]) for s, agent in enumerate(agents)]))
    assert isinstance(together, population.StackedPopulation)
    assert together.problem is not None
    assert together.problem.startswith("cannot be run by torch.vmap, so its agents are computed one by one")


def fail(error: Exception) -> Callable[[Tensor], Tensor]:
    def function(x: Tensor) -> Tensor:
        if torch._C._functorch.maybe_get_level(x) > 0:  # alone it would run: the loop must not hide the error
            raise error
        return x

    return function


@pytest.mark.parametrize(
    ("function", "kind", "message"),
    [
        (fail(RuntimeError("my own")), RuntimeError, "my own"),
        (fail(ValueError("my own")), ValueError, "my own"),
        (fail(NotImplementedError("my own")), NotImplementedError, "my own"),
        (
            fail(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate")),
            RuntimeError,
            "CUDA out of memory",
        ),
        (lambda x: x + torch.empty(10**15).sum(), RuntimeError, "can't allocate memory"),
        (lambda x: x @ torch.ones(5, 5), RuntimeError, "cannot be multiplied|size mismatch"),
    ],
    ids=["runtime", "value", "not implemented", "gpu memory", "memory", "shapes"],
)
def test_other_errors_are_raised(
    function: Callable[[Tensor], Tensor], kind: type[Exception], message: str
) -> None:
    together = population.stack([Through(function) for _ in range(3)])
    with pytest.raises(kind, match=message):
        together(torch.rand(3, 4, 3))
    assert isinstance(together, population.StackedPopulation)
    assert together.problem is None


def test_a_module_that_is_a_linear_layer_is_exact() -> None:
    """A single output, which a batched product sums in an order that depends on its place."""
    agents, x = [nn.Linear(10, 1) for _ in range(STACK)], torch.randn(STACK, 64, 10)
    whole = population.stack(agents)(x)
    for s, agent in enumerate(agents):
        assert torch.equal(population.stack([agent])(x[s : s + 1])[0], whole[s])
    assert all(type(agent) is nn.Linear for agent in agents)


def test_a_second_name_of_a_layer_is_the_same_layer() -> None:
    class Named(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = nn.Linear(3, 2)
            self.layers = [self.inner]

        def forward(self, x: Tensor) -> Tensor:
            y: Tensor = self.layers[0](x)
            return y

    agents, x = [Named() for _ in range(3)], torch.randn(3, 8, 3)
    torch.testing.assert_close(
        population.stack(agents)(x), torch.stack([agent(x[s]) for s, agent in enumerate(agents)])
    )


def test_modules_of_different_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="same parameters with the same shapes"):
        population.stack([nn.Linear(2, 3), nn.Linear(3, 2)])


def test_adam_is_torchs_adam_for_every_agent() -> None:
    agents = modules(4)
    ours = population.stack(agents)
    optimizer = Adam(ours, 1e-2, 1e-2)
    references = [torch.optim.Adam(agent.parameters(), lr=1e-2) for agent in agents]
    for _ in range(20):
        x = torch.randn(4, 8, 3)
        optimizer.zero_grad()
        ours(x).square().mean((1, 2)).sum().backward()
        optimizer.step()
        for s, (agent, reference) in enumerate(zip(agents, references)):
            reference.zero_grad()
            agent(x[s]).square().mean().backward()
            reference.step()
    for s, agent in enumerate(agents):
        for (_, mine), (_, theirs) in zip(ours.named_parameters(), agent.named_parameters()):
            torch.testing.assert_close(mine[s], theirs, rtol=1e-4, atol=1e-6)


def test_a_masked_agent_stays_as_if_the_step_had_not_been() -> None:
    source = torch.Generator().manual_seed(0)
    gradients = [torch.randn(3, 2, 5, generator=source) for _ in range(6)]

    class One(nn.Module):
        def __init__(self, s: slice) -> None:
            super().__init__()
            self.w = nn.Parameter(torch.ones(3, 2, 5)[s].clone())

    masked, alone = One(slice(0, 3)), One(slice(1, 2))
    optimizers = Adam(masked, 1e-2, 1e-2), Adam(alone, 1e-2, 1e-2)
    for i, gradient in enumerate(gradients):
        active = torch.tensor([True, i % 2 == 0, False])
        masked.w.grad = gradient.clone()
        optimizers[0].step(active)
        if i % 2 == 0:
            alone.w.grad = gradient[1:2].clone()
            optimizers[1].step(torch.tensor([True]))
    assert torch.equal(masked.w[1:2], alone.w)
    assert torch.equal(masked.w[2], torch.ones(2, 5))
    assert optimizers[0].steps.tolist() == [6, 3, 0]


def test_quantum_parameters_get_their_own_rate_and_count() -> None:
    class Hybrid(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.a, self.q = nn.Parameter(torch.zeros(1, 2)), nn.Parameter(torch.zeros(1, 3))

        def quantum_parameters(self) -> set[str]:
            return {"q"}

    module = Hybrid()
    assert population.count_parameters(module) == (2, 3)
    optimizer = Adam(module, classical_lr=0.1, quantum_lr=0.5)
    module.a.grad, module.q.grad = torch.ones(1, 2), torch.ones(1, 3)
    optimizer.step()
    torch.testing.assert_close(module.a.detach(), torch.full((1, 2), -0.1))
    torch.testing.assert_close(module.q.detach(), torch.full((1, 3), -0.5))


def test_state_round_trip() -> None:
    one = population.stack(modules(3))
    first, second = Adam(one, 1e-2, 1e-2), Adam(one, 1e-2, 1e-2)
    one(torch.randn(3, 4, 3)).sum().backward()
    first.step()
    second.load_state_dict({name: value.clone() for name, value in first.state_dict().items()})
    for (a, x), (b, y) in zip(first.state_dict().items(), second.state_dict().items()):
        assert a == b
        assert torch.equal(x, y)
    merged = population.prefixed(x=first.state_dict(), y=second.state_dict())
    assert set(population.part(merged, "x")) == set(first.state_dict())


class Scaled(nn.Linear):
    """A layer whose bias learns three times as fast."""

    def learning_rates(self) -> dict[str, float]:
        return {"bias": 3.0}


def test_a_module_says_how_fast_its_parameters_learn() -> None:
    together = population.stack([Scaled(4, 2), Scaled(4, 2)])
    before = {name: value.detach().clone() for name, value in together.named_parameters()}
    adam = Adam(together, 0.01, 1.0)
    together(torch.ones(2, 3, 4)).sum().backward()  # Adam's first step is the learning rate
    adam.step()
    for name, rate in (("weight", 0.01), ("bias", 0.03)):
        change = (before[name] - together.get_parameter(name)).abs()
        torch.testing.assert_close(change, torch.full_like(change, rate), rtol=1e-4, atol=1e-7)
    for wrong in ({"nothing": 1.0}, {"bias": 0.0}):
        layer = Scaled(4, 2)
        layer.learning_rates = lambda wrong=wrong: wrong  # type: ignore[method-assign, assignment, misc]
        with pytest.raises(ValueError, match="name one of bias, weight, and a number above 0"):
            Adam(population.stack([layer]), 0.01, 1.0)


class Abroad(nn.Linear):
    """Leaves torch for numpy and comes back, without gradients."""

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(torch.from_numpy(input.numpy() * 2))


def test_a_loop_runs_modules_as_they_are() -> None:
    modules = [Abroad(4, 2) for _ in range(3)]
    together, x = population.loop(modules), torch.randn(3, 5, 4)
    for s, module in enumerate(modules):
        torch.testing.assert_close(together(x)[s], module(x[s]))
    assert together.problem is None
    assert {name: tuple(p.shape) for name, p in together.named_parameters()} == {
        "weight": (3, 2, 4), "bias": (3, 2)
    }  # fmt: skip
    with pytest.raises(ValueError, match="at least one module"):
        population.loop([])


@pytest.mark.parametrize(
    ("inputs", "outputs", "batch"),
    [(3, 18, 10), (3, 21, 14), (5, 128, 2), (6, 64, 3), (7, 64, 3), (33, 7, 14)],
)
def test_linear_layers_of_odd_sizes_do_not_depend_on_their_place(
    inputs: int, outputs: int, batch: int
) -> None:
    x, w, b, g = (
        torch.randn(5, *size) for size in ((batch, inputs), (outputs, inputs), (outputs,), (batch, outputs))
    )
    w.requires_grad_()
    results = []
    for members in ([0, 1, 2, 3, 4], [4, 1, 3]):
        y = linear(x[members], w[members], b[members])
        (gradient,) = torch.autograd.grad(y, w, g[members])
        results.append((y.detach(), gradient[members]))
    for whole, part in zip(*results):
        assert torch.equal(whole[[4, 1, 3]], part)
