"""Small environments, and an algorithm on them without task, store or command: what these tests stand on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from torch import Tensor, nn

from qrlsuite import options, population, registry, specs
from qrlsuite.environment import LaneEnv, batched_spaces
from qrlsuite.seeding import Streams, pack, unpack
from qrlsuite.testing.group import Toy

torch.set_num_threads(1)


class Contexts(Toy):
    """The toy of discrete actions: reward 1 for the action of the context that is shown, beside the step over 10."""

    def __init__(self, lanes: int) -> None:
        super().__init__(lanes)
        self.history: list[NDArray[np.int64]] = []

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.history.append(actions.copy())
        return super().step(actions)


class Clock(LaneEnv):
    """Episodes of known length: the reward of step t is t + 1, whatever the action.

    Observations are (t / 10, lane / 10, 1). An episode of lane l ends after lengths[l] steps; it terminates, or is
    truncated with `cut`.
    """

    def __init__(self, lengths: Sequence[int], cut: bool = False) -> None:
        batched_spaces(self, Box(0, 100, (3,)), Discrete(2), len(lengths))
        self.lengths, self.cut = np.array(lengths), cut
        self.t = np.zeros(self.num_envs, dtype=np.int64)
        self.history: list[NDArray[np.int64]] = []

    def _observe(self) -> NDArray[np.float32]:
        lanes = np.arange(self.num_envs)
        return np.column_stack([self.t / 10, lanes / 10, np.ones(self.num_envs)]).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        self.t[:] = 0
        return self._observe(), {}

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.history.append(actions.copy())
        self.t += 1
        rewards, ended, final = self.t.astype(np.float64), self.t >= self.lengths, self._observe()
        self.t[ended] = 0
        infos = {"final_obs": final, "_final_obs": ended} if ended.any() else {}
        never = np.zeros_like(ended)
        return self._observe(), rewards, *((never, ended) if self.cut else (ended, never)), infos


class Group:
    """A group of seeds of an algorithm, with what the core does for it: streams, models, checkpoints."""

    def __init__(
        self,
        algorithm: str,
        seeds: Sequence[int],
        envs: LaneEnv,
        model: str = "mlp",
        model_options: Mapping[str, Any] | None = None,
        device: str = "cpu",
        **settings: Any,
    ) -> None:
        self.seeds, self.envs = list(seeds), envs
        self.streams = [Streams("tests", seed) for seed in seeds]
        self.E = envs.num_envs // len(self.seeds)
        self.model = registry.get(specs.ModelSpec, model)
        defaults = {"mlp": {"width": 16, "depth": 1}, "gru": {"width": 16}, "lstm": {"width": 16}}.get(
            model, {"qubits": 2, "layers": 2}
        )
        self.model_options = options.build(
            specs.resolve(self.model.options), {**defaults, **(model_options or {})}, "model"
        )
        self.modules: list[nn.Module] = []
        spec = registry.get(specs.AlgorithmSpec, algorithm)
        self.algorithm = specs.resolve(spec.factory)(
            envs,
            self._build,
            options.build(specs.resolve(spec.options), settings, "algorithm"),
            self.streams,
            torch.device(device),
        )

    def _build(self, outputs: int, inputs: int | None = None, role: str = "network") -> nn.Module:
        build = specs.resolve(self.model.build)
        given = int(np.prod(self.envs.single_observation_space.shape)) if inputs is None else inputs
        agents = [
            build(given, outputs, self.model_options, streams.torch("init", len(self.modules)))
            for streams in self.streams
        ]
        if self.model.population is None:
            self.modules.append(population.stack(agents))
        else:
            self.modules.append(specs.resolve(self.model.population)(agents, self.model_options))
        return self.modules[-1]

    def executions(self) -> list[dict[str, int]]:
        """The circuit executions of each network of an agent; nothing for classical ones."""
        return [m.executions.as_dict() for m in self.modules if hasattr(m, "executions")]

    def start(self) -> Group:
        self.envs.seed_lanes([s.numpy("environment", lane) for s in self.streams for lane in range(self.E)])
        self.algorithm.start()
        return self

    def save(self) -> dict[str, NDArray[Any]]:
        """Everything that the rest of the run depends on, seed-first."""
        arrays = {f"algorithm.{k}": v.numpy().copy() for k, v in self.algorithm.state_dict().items()}
        for name, array in self.envs.state_dict().items():
            arrays[f"environment.{name}"] = array.reshape(len(self.seeds), self.E, *array.shape[1:]).copy()
        arrays["streams"] = pack(self.envs.streams).reshape(len(self.seeds), self.E, -1)
        return arrays

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> Group:
        lanes = self.envs.num_envs
        self.envs.seed_lanes(unpack(arrays["streams"].reshape(lanes, -1)))
        parts = {k.partition(".")[2]: v for k, v in arrays.items() if k.startswith("environment.")}
        self.envs.load_state_dict({k: v.reshape(lanes, *v.shape[2:]) for k, v in parts.items()})
        self.algorithm.load_state_dict(
            {
                k.partition(".")[2]: torch.from_numpy(v.copy())
                for k, v in arrays.items()
                if k.startswith("algorithm.")
            }
        )
        return self


class Perceptron:
    """Seed s of a population of perceptrons with one hidden layer of rectifiers, in numpy and float64."""

    def __init__(self, module: nn.Module, s: int = 0) -> None:
        state = module.state_dict()
        self.w0, self.b0, self.w1, self.b1 = (
            state[k][s].numpy().astype(np.float64) for k in ("w0", "b0", "w1", "b1")
        )

    def __call__(self, x: NDArray[Any]) -> NDArray[np.float64]:
        """Map (B, in) to (B, out)."""
        self.x = np.asarray(x, np.float64)
        self.h = np.maximum(self.x @ self.w0.T + self.b0, 0)
        result: NDArray[np.float64] = self.h @ self.w1.T + self.b1
        return result

    def gradients(self, d: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Gradients of a loss whose derivative by the last output is d (B, out)."""
        dh = (d @ self.w1) * (self.h > 0)
        return {"w0": dh.T @ self.x, "b0": dh.sum(0), "w1": d.T @ self.h, "b1": d.sum(0)}

    def assert_updated(self, module: nn.Module, d: NDArray[np.float64], lr: float, s: int = 0) -> None:
        """Compare gradients, and the parameters after Adam's first step: lr g / (|g| + eps)."""
        for name, gradient in self.gradients(d).items():
            parameter = module.get_parameter(name)
            assert parameter.grad is not None
            given = parameter.grad[s].numpy()
            np.testing.assert_allclose(given, gradient, rtol=2e-3, atol=2e-6 * max(1, np.abs(gradient).max()))
            step = lr * given / (np.abs(given) + 1e-8)
            np.testing.assert_allclose(
                parameter.detach()[s].numpy(), getattr(self, name) - step, rtol=1e-5, atol=1e-6
            )


class Table(nn.Module):
    """S tables of outputs, (S, inputs, out): the output for a one-hot input is its row."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = nn.Parameter(values.clone())

    def forward(self, x: Tensor) -> Tensor:
        return torch.bmm(x, self.values)


def log_softmax(z: NDArray[np.float64]) -> NDArray[np.float64]:
    shifted = z - z.max(1, keepdims=True)
    result: NDArray[np.float64] = shifted - np.log(np.exp(shifted).sum(1, keepdims=True))
    return result
