"""Layers of networks as one compiled sweep: torch's numbers, and the same bits in any company."""

from __future__ import annotations

import copy
import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from qrlsuite.compiled import networks, perceptron, vectors
from qrlsuite.plugins.models import mlp
from qrlsuite.population import ACTIVATIONS, Adam, best, chosen_errors, held, layers

SIZES = [(3, 16, 16, 3), (3, 10, 1), (5, 7), (1, 1, 1), (2, 33, 18, 64, 4), (40, 8, 2)]


def network(sizes: tuple[int, ...], seeds: int, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    g = torch.Generator().manual_seed(1)
    pairs = list(itertools.pairwise(sizes))
    shapes = [(seeds, o, i) for i, o in pairs] + [(seeds, o) for _, o in pairs]
    return [(torch.randn(shape, generator=g) / 2).to(dtype).requires_grad_(True) for shape in shapes]


def passes(parameters: list[Tensor], x: Tensor, cotangents: Tensor, activation: str) -> list[Tensor]:
    """Return values and all gradients."""
    x = x.detach().requires_grad_(True)
    half = len(parameters) // 2
    values = layers(x, parameters[:half], parameters[half:], activation)
    return [values.detach(), *torch.autograd.grad(values, [x, *parameters], cotangents)]


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("batch", [1, 10, 31, 64, 100])
def test_numbers_are_those_of_torch_in_double_precision(
    sizes: tuple[int, ...], batch: int, activation: str
) -> None:
    g = torch.Generator().manual_seed(batch)
    x, cotangents = (
        torch.randn(3, batch, sizes[0], generator=g),
        torch.randn(3, batch, sizes[-1], generator=g),
    )
    ours = passes(network(sizes, 3), x, cotangents, activation)
    theirs = passes(network(sizes, 3, torch.float64), x.double(), cotangents.double(), activation)
    for mine, exact in zip(ours, theirs):
        largest = max(float(exact.abs().max()), 1.0)
        torch.testing.assert_close(mine.double(), exact, rtol=0, atol=3e-6 * largest)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("sizes", SIZES)
def test_a_seed_has_the_same_bits_alone_and_at_any_place(sizes: tuple[int, ...], activation: str) -> None:
    g = torch.Generator().manual_seed(0)
    x, cotangents = torch.randn(17, 45, sizes[0], generator=g), torch.randn(17, 45, sizes[-1], generator=g)
    parameters = network(sizes, 17)
    together = passes(parameters, x, cotangents, activation)
    for part in (slice(0, 1), slice(5, 7), slice(16, 17)):
        own = [p.detach()[part].clone().requires_grad_(True) for p in parameters]
        apart = passes(own, x[part], cotangents[part], activation)
        assert all(torch.equal(alone, all_[part]) for alone, all_ in zip(apart, together))


def test_a_pass_without_gradients_has_the_same_bits_and_keeps_nothing() -> None:
    parameters, x = network((3, 16, 3), 2), torch.randn(2, 70, 3)
    with torch.no_grad():
        values = layers(x, parameters[:2], parameters[2:], "relu")
    assert not values.requires_grad
    assert torch.equal(values, layers(x, parameters[:2], parameters[2:], "relu").detach())


def test_two_passes_before_their_gradients_do_not_share_memory() -> None:
    parameters = network((3, 16, 3), 2)
    first, second = torch.randn(2, 64, 3), torch.randn(2, 64, 3)
    expected = [
        torch.autograd.grad(layers(x, parameters[:2], parameters[2:], "relu").sum(), parameters)
        for x in (first, second)
    ]
    values = [layers(x, parameters[:2], parameters[2:], "relu").sum() for x in (first, second)]
    for value, gradients in zip(values, expected):
        found = torch.autograd.grad(value, parameters)
        assert all(torch.equal(a, b) for a, b in zip(found, gradients))


def test_what_is_not_finite_stays_with_its_seed() -> None:
    parameters, x = network((3, 16, 3), 3), torch.randn(3, 10, 3)
    x[1, 4, 0] = torch.nan
    values, *gradients = passes(parameters, x, torch.ones(3, 10, 3), "relu")
    assert values[1, 4].isnan().all()
    assert values.isfinite().sum() == values.numel() - 3
    assert all(g[[0, 2]].isfinite().all() for g in gradients)


@pytest.mark.parametrize("compiled", [True, False])
def test_adam_is_torchs_reads_its_rates_and_leaves_agents_that_rest_alone(compiled: bool) -> None:
    population = torch.nn.Module()
    population.w = torch.nn.Parameter(torch.randn(3, 5, 7))
    population.compiled = compiled
    other = population.w.detach().clone().requires_grad_(True)
    ours, theirs = Adam(population, 0.01, 0.01), torch.optim.Adam([other], 0.01)
    for rate in (0.01, 0.01, 0.003, 0.001, 0.02):
        gradient = torch.randn(3, 5, 7)
        population.w.grad, other.grad = gradient, gradient.clone()
        theirs.param_groups[0]["lr"] = rate
        ours.rates["w"] = rate if rate > 0.001 else torch.full((3,), rate, dtype=torch.float64)
        ours.step()
        theirs.step()
    torch.testing.assert_close(population.w.detach(), other.detach(), rtol=1e-5, atol=1e-6)
    before = {name: value.clone() for name, value in ours.state_dict().items()} | {
        "w": population.w.detach().clone()
    }
    ours.step(torch.tensor([True, False, True]))
    after = ours.state_dict() | {"w": population.w.detach()}
    assert all(torch.equal(before[name][1], after[name][1]) for name in before)
    assert all((before[name][[0, 2]] != after[name][[0, 2]]).any() for name in before)


@pytest.mark.parametrize("compiled", [True, False])
def test_gradient_norms_are_the_mean_over_steps_of_each_kind_of_parameter(compiled: bool) -> None:
    population = torch.nn.Module()
    population.compiled = compiled
    population.quantum_parameters = lambda: {"angles"}
    population.w, population.angles = (torch.nn.Parameter(torch.zeros(2, *shape)) for shape in ((3, 4), (5,)))
    adam = Adam(population, 0.01, 0.01)
    assert all(np.isnan(norms).all() for norms in adam.gradient_norms().values())
    for size in (3.0, 4.0):
        population.w.grad = torch.full((2, 3, 4), size)
        population.angles.grad = torch.tensor([[size], [2 * size]]).expand(2, 5).contiguous()
        adam.step(torch.tensor([True, size == 3.0]))
    both = np.sqrt((0.999 * 9 + 16) / 1.999)  # the later step weighs more
    norms = adam.gradient_norms()
    np.testing.assert_allclose(
        norms["gradient_norm_classical"], np.sqrt(12) * np.array([both, 3.0]), rtol=1e-5
    )
    np.testing.assert_allclose(norms["gradient_norm_quantum"], np.sqrt(5) * np.array([both, 6.0]), rtol=1e-5)


def test_an_agent_makes_the_same_step_alone_and_at_any_place() -> None:
    def step(agents: slice) -> list[Tensor]:
        population = torch.nn.Module()
        population.compiled = True
        for i, p in enumerate(network((3, 33, 5), 7)):
            population.register_parameter(f"p{i}", torch.nn.Parameter(p.detach()[agents].clone()))
        adam, g = Adam(population, 0.01, 0.01), torch.Generator().manual_seed(2)
        for _ in range(3):
            for p in population.parameters():
                p.grad = torch.randn((7, *p.shape[1:]), generator=g)[agents]
            adam.step()
        return [*population.parameters(), *adam.state_dict().values()]

    together = step(slice(0, 7))
    assert all(torch.equal(alone, all_[3:4]) for alone, all_ in zip(step(slice(3, 4)), together))


@pytest.mark.parametrize(("seeds", "batch"), [(2, 0), (1, 1)])
def test_an_empty_batch_has_gradients_of_zero(seeds: int, batch: int) -> None:
    x, cotangents = torch.zeros(seeds, batch, 3), torch.ones(seeds, batch, 2)
    values, x_gradient, *gradients = passes(network((3, 5, 2), seeds), x, cotangents, "relu")
    assert values.shape == (seeds, batch, 2)
    assert x_gradient.shape == x.shape
    assert all(bool((g != 0).any()) == bool(batch) for g in gradients[2:])


def test_inputs_and_weights_may_lie_in_any_order_in_memory() -> None:
    parameters, x, cotangents = network((3, 7, 2), 4), torch.randn(4, 9, 3), torch.randn(4, 9, 2)
    expected = passes(parameters, x, cotangents, "sin")

    def turned(each: Tensor) -> Tensor:
        return each.detach().transpose(0, -1).contiguous().transpose(0, -1)

    other = [turned(p).requires_grad_(True) for p in parameters]
    assert not other[0].is_contiguous()
    found = passes(other, turned(x), turned(cotangents), "sin")
    assert all(torch.equal(a, b) for a, b in zip(found, expected))
    x = turned(x)[:, ::2]
    assert torch.equal(layers(x, parameters[:2], parameters[2:]), layers(x.clone(), other[:2], other[2:]))


@pytest.mark.parametrize("wrong", range(6))
def test_shapes_that_do_not_fit_are_refused(wrong: int) -> None:
    w0, w1, b0, b1 = (p.detach() for p in network((3, 7, 2), 4))
    x, weights, biases = [
        (torch.zeros(4, 9, 2), [w0, w1], [b0, b1]),
        (torch.zeros(3, 9, 3), [w0, w1], [b0, b1]),
        (torch.zeros(9, 3), [w0, w1], [b0, b1]),
        (torch.zeros(4, 9, 3), [w0, w1[:, :, :5]], [b0, b1]),
        (torch.zeros(4, 9, 3), [w0, w1], [b0, b1[:, :1]]),
        (torch.zeros(4, 9, 3), [w0, w1], [b0]),
    ][wrong]
    with pytest.raises(ValueError, match="layers of S seeds take x"):
        layers(x, weights, biases, "relu")


def test_transforms_and_other_numbers_are_left_to_torch_and_a_second_derivative_is_refused() -> None:
    parameters, x = [p.detach() for p in network((3, 7, 2), 4)], torch.randn(4, 9, 3)
    plain = layers(x, parameters[:2], parameters[2:], "sin")

    def one(scale: Tensor) -> Tensor:
        return layers(x * scale, parameters[:2], parameters[2:], "sin")

    many = torch.vmap(one)(torch.tensor([1.0, 2.0]))
    torch.testing.assert_close(many[0], plain)
    second = torch.func.grad(torch.func.grad(lambda scale: one(scale).sum()))(torch.tensor(1.0))
    assert second.isfinite()
    assert second != 0
    assert layers(x.double(), parameters[:2], parameters[2:], "relu").dtype == torch.float64
    x.requires_grad_(True)
    values = layers(x, parameters[:2], parameters[2:], "sin")
    with pytest.raises(RuntimeError, match="leave out create_graph=True"):
        torch.autograd.grad(values.sum(), x, create_graph=True)


def test_threads_do_not_share_records() -> None:
    inputs = [torch.randn(2, 100, 3, generator=torch.Generator().manual_seed(i)) for i in range(8)]

    def work(x: Tensor) -> list[Tensor]:
        return [passes(network((3, 24, 3), 2), x, torch.ones(2, 100, 3), "relu") for _ in range(20)][-1]

    expected = [work(x) for x in inputs]
    with ThreadPoolExecutor(4) as pool:
        for found, own in zip(pool.map(work, inputs), expected):
            assert all(torch.equal(a, b) for a, b in zip(found, own))


class Behind(torch.nn.Module):
    """A population of which nobody knows that it is one sweep."""

    def __init__(self, population: torch.nn.Module) -> None:
        super().__init__()
        self.inner = population
        self.compiled = True

    def forward(self, x: Tensor) -> Tensor:
        return self.inner(x)


@pytest.mark.parametrize("activation", ["relu", "tanh", "sin", "none"])
@pytest.mark.parametrize(("seeds", "batch", "scale"), [(3, 64, 1.0), (1, 7, 1.0), (2, 50, 0.5)])
def test_errors_without_autograd_have_its_bits_and_those_of_the_steps_that_follow(
    activation: Literal["relu", "tanh", "sin", "none"], seeds: int, batch: int, scale: float
) -> None:
    options = mlp.MLPOptions(width=12, activation=activation, input_scale=scale)
    g = torch.Generator().manual_seed(3)
    ours = mlp.population([mlp.build(3, 4, options, g) for _ in range(seeds)], options)
    theirs = Behind(copy.deepcopy(ours))
    adams = [Adam(each, 0.01, 0.01) for each in (ours, theirs)]
    for weight in (1.0, 0.5, 0.3):
        x, aims = torch.randn(seeds, batch, 3, generator=g), torch.randn(seeds, batch, generator=g)
        chosen = torch.randint(4, (seeds, batch), generator=g)
        errors = [chosen_errors(each, x, chosen, aims, weight) for each in (ours, theirs)]
        assert torch.equal(*errors)
        assert torch.equal(*(best(each, x) for each in (ours, theirs)))
        if (sweep := ours.sweep()) is not None:
            found = torch.from_numpy(sweep.chosen(x.numpy(), chosen.numpy()))
            assert torch.equal(found, theirs(x).gather(2, chosen[..., None])[..., 0])
        for p, q in zip(ours.parameters(), theirs.parameters()):
            assert torch.equal(p.grad, q.grad)  # type: ignore[arg-type]
        for adam in adams:
            adam.step()
        assert all(torch.equal(p, q) for p, q in zip(ours.parameters(), theirs.parameters()))
    (expected,) = torch.autograd.grad(theirs(x.requires_grad_()).square().sum(), x)
    with held(ours):
        passed = ours(x).square().sum()
        assert torch.equal(torch.autograd.grad(passed, x)[0], expected)
        assert not any(p.requires_grad for p in ours.parameters())
    assert all(p.requires_grad for p in ours.parameters())
    x = x.detach()
    x[0, 0] = torch.nan
    assert torch.equal(*(best(each, x) for each in (ours, theirs)))
    assert (ours.sweep() is None) == (activation == "tanh")


@pytest.mark.parametrize(
    "chosen", [torch.full((2, 5), 4), torch.full((2, 5), -1), torch.zeros(2, 4, dtype=torch.int64)]
)
def test_what_is_no_output_is_not_chosen(chosen: Tensor) -> None:
    options, g = mlp.MLPOptions(width=12), torch.Generator()
    population = mlp.population([mlp.build(3, 4, options, g) for _ in range(2)], options)
    sweep, x = population.sweep(), torch.zeros(2, 5, 3)
    assert sweep is not None
    for call in (
        lambda: sweep.chosen(x.numpy(), chosen.numpy()),
        lambda: chosen_errors(population, x, chosen, torch.zeros(2, 5)),
    ):
        with pytest.raises(ValueError, match="choose one of 4 outputs of each sample"):
            call()


def test_a_moved_or_changed_parameter_is_seen() -> None:
    options = mlp.MLPOptions(width=12)
    g = torch.Generator().manual_seed(3)
    population = mlp.population([mlp.build(3, 4, options, g) for _ in range(2)], options)
    x = torch.randn(2, 5, 3)
    before = population(x)
    population.w1.data = population.w1.data * 2.0  # type: ignore[operator, union-attr]
    moved = population(x)
    assert not torch.equal(before, moved)
    population.load_state_dict({name: p * 0.5 for name, p in population.state_dict().items()})
    torch.testing.assert_close(population(x).double(), copy.deepcopy(population).double()(x.double()))
    assert population.double()(x.double()).dtype == torch.float64


def test_records_are_used_again() -> None:
    parameters, x = network((3, 24, 3), 2), torch.randn(2, 64, 3)
    passes(parameters, x, torch.ones(2, 64, 3), "relu")
    kept = {key: [each.ctypes.data for each in rooms] for key, rooms in perceptron._spare.items()}
    passes(parameters, x, torch.ones(2, 64, 3), "relu")
    assert {key: [each.ctypes.data for each in rooms] for key, rooms in perceptron._spare.items()} == kept


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_squares_are_transposed(dtype: type) -> None:
    v = vectors.lanes(dtype)
    source, target = np.arange(2.0 * v * v, dtype=dtype).reshape(v, 2 * v), np.zeros(2 * v * v, dtype)
    networks._turn(source, 0, v, 1, 2 * v, target)
    np.testing.assert_array_equal(target.reshape(2 * v, v), source.T)
