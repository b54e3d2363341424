"""A circuit as a PyTorch layer in other people's loops."""

from __future__ import annotations

import copy
import io
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import qrlsuite
from qrlsuite.circuit import Circuit, ansatz, expectations
from qrlsuite.errors import QrlSuiteError
from qrlsuite.population import gradients, stack


def made(**changes: Any) -> Any:
    torch.manual_seed(3)
    return qrlsuite.layer("cz", **{"qubits": 3, "layers": 2, "dtype": torch.float64, **changes})


def values_of(layer: Any) -> dict[str, Tensor]:
    return {name: value.detach() for name, value in layer.circuit.items()}


def test_values_and_gradients_are_those_of_pennylane() -> None:
    layer = made()
    x = torch.linspace(-2, 2, 12, dtype=torch.float64).reshape(2, 2, 3).requires_grad_()
    result = layer(x)
    assert result.shape == (2, 2, 3)
    peer = {name: value.clone().requires_grad_() for name, value in values_of(layer).items()}
    y = x.detach().clone().requires_grad_()
    expected = expectations(layer.description, y.reshape(4, 3), peer, backend="pennylane")
    torch.testing.assert_close(result.reshape(4, 3), expected, rtol=0, atol=1e-12)
    weight = torch.linspace(0.5, 1.5, 12, dtype=torch.float64)
    (result.reshape(-1) * weight).sum().backward()
    (expected.reshape(-1) * weight).sum().backward()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(x.grad, y.grad, rtol=0, atol=1e-12)
    for name, value in layer.circuit.items():
        torch.testing.assert_close(value.grad, peer[name].grad, rtol=0, atol=1e-12)


def test_manual_seed_decides_the_parameters_and_they_differ_without_it() -> None:
    first, second = made(), made()
    third = qrlsuite.layer("cz", 3, 2, dtype=torch.float64)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters()))
    assert not any(torch.equal(a, b) for a, b in zip(first.parameters(), third.parameters()))
    given = [qrlsuite.layer("cz", 3, generator=torch.Generator().manual_seed(9)) for _ in range(2)]
    assert all(torch.equal(a, b) for a, b in zip(given[0].parameters(), given[1].parameters()))


def test_copies_and_saved_layers_compute_the_same_and_train_apart() -> None:
    layer = made()
    x = torch.ones(4, 3, dtype=torch.float64)
    target = copy.deepcopy(layer)
    stored = io.BytesIO()
    torch.save(layer.state_dict(), stored)
    stored.seek(0)
    fresh = qrlsuite.layer("cz", 3, 2, dtype=torch.float64)
    fresh.load_state_dict(torch.load(stored, weights_only=True))
    sent = pickle.loads(pickle.dumps(layer))  # as vectorized environments and data loaders send a policy
    for other in (target, fresh, sent):
        assert torch.equal(other(x), layer(x))
    with torch.no_grad():
        next(layer.parameters()).add_(0.5)
    assert not torch.equal(target(x), layer(x))


def test_a_circuit_of_ones_own_is_a_layer() -> None:
    circuit = Circuit(2, inputs=1)
    circuit.append("RX", 0, circuit.input(0))
    circuit.measure([0])
    layer = qrlsuite.layer(circuit)
    circuit.append("X", 0)  # later changes have no effect
    assert list(layer.parameters()) == []
    torch.testing.assert_close(layer(torch.tensor([0.0, torch.pi])[:, None]), torch.tensor([[1.0], [-1.0]]))
    assert layer(torch.zeros(0, 1)).shape == (0, 1)


def test_shots_follow_manual_seed_and_differ_from_pass_to_pass() -> None:
    layer = made(backend_options={"shots": 50})
    x = torch.ones(2, 3, dtype=torch.float64)
    torch.manual_seed(1)
    first, second = layer(x), layer(x)
    torch.manual_seed(1)
    assert torch.equal(layer(x), first)
    assert not torch.equal(second, first)


def test_float32_inputs_give_float32_and_the_type_is_the_default_one() -> None:
    assert made()(torch.zeros(2, 3)).dtype == torch.float32
    assert {p.dtype for p in qrlsuite.layer("cz", 3).parameters()} == {torch.float32}
    assert "qubits=3, in_features=3, out_features=3, backend='native'" in repr(made())


def hybrid(seed: int, **options: Any) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(4, 3), qrlsuite.layer("iqp", 3, 2, **options), nn.Linear(3, 2))


def test_agents_of_a_population_run_together_and_each_is_the_same_bits_alone() -> None:
    x = torch.randn(5, 6, 4, generator=torch.Generator().manual_seed(0))
    together = stack([hybrid(seed) for seed in range(5)])
    values = together(x)
    gradients(values.square().sum(), together)
    assert together.problem is None
    for seed in (0, 3):
        alone = stack([hybrid(seed)])
        own = alone(x[seed : seed + 1])
        gradients(own.square().sum(), alone)
        assert torch.equal(own[0], values[seed])
        for mine, theirs in zip(alone.parameters(), together.parameters()):
            assert torch.equal(mine.grad[0], theirs.grad[seed])  # type: ignore[index]
        single = hybrid(seed)
        torch.testing.assert_close(single(x[seed]), values[seed])
        single(x[seed]).square().sum().backward()
        for plain, theirs in zip(single.parameters(), together.parameters()):
            torch.testing.assert_close(plain.grad, theirs.grad[seed])  # type: ignore[index]
    with pytest.raises(RuntimeError, match="the layer has only vmap"):
        torch.func.grad(lambda each: hybrid(0)(each).sum())(x[0])


def test_samples_of_shots_are_drawn_one_agent_after_the_other() -> None:
    together = stack([hybrid(seed, backend_options={"shots": 20}) for seed in range(2)])
    assert together(torch.zeros(2, 3, 4)).shape == (2, 3, 2)
    assert "samples are drawn for each agent in its turn" in str(together.problem)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: qrlsuite.layer("cz"), r"say how many qubits: layer\('cz', qubits=6\)"),
        (lambda: qrlsuite.layer(ansatz("cz", 2, 1), 2), "has its size and options already"),
        (lambda: qrlsuite.layer("cz", 2, dtype=torch.float16), "float32 or float64"),
        (lambda: made()(torch.zeros(2, 4)), "the last axis must be 3"),
        (lambda: made()(torch.full((2, 3), torch.nan)), "not finite"),
        (lambda: qrlsuite.layer("cy", 2), "cy"),
    ],
)
def test_what_cannot_be_is_said(build: Any, message: str) -> None:
    with pytest.raises(QrlSuiteError, match=message):
        build()


def test_stable_baselines3_trains_it_as_a_features_extractor() -> None:
    """Every parameter of the circuit gets a gradient from PPO, and moves."""
    import gymnasium
    from stable_baselines3 import PPO
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class CircuitFeatures(BaseFeaturesExtractor):
        def __init__(self, space: gymnasium.spaces.Box) -> None:
            super().__init__(space, features_dim=4)
            self.net = nn.Sequential(nn.Linear(4, 4), qrlsuite.layer("cz", qubits=4, layers=2))

        def forward(self, observations: Tensor) -> Tensor:
            result: Tensor = self.net(observations)
            return result

    model = PPO(
        "MlpPolicy", "CartPole-v1", n_steps=64, batch_size=32, n_epochs=1, seed=0, device="cpu",
        policy_kwargs={"features_extractor_class": CircuitFeatures, "net_arch": []},
    )  # fmt: skip
    before = [p.detach().clone() for p in model.policy.features_extractor.parameters()]
    model.learn(64)
    after = list(model.policy.features_extractor.parameters())
    assert len(after) == 4
    assert not any(torch.equal(a, b) for a, b in zip(before, after))
    action, _ = model.predict(model.get_env().reset(), deterministic=True)  # type: ignore[union-attr]
    assert action.shape == (1,)
