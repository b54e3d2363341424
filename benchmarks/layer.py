"""Stable-Baselines3's PPO with a circuit as its features extractor: our layer beside PennyLane's.

    pip install '.[bench]' && python benchmarks/layer.py --qubits 4 6 8

The work is the same: CartPole, the same circuit (`cz`, `rot`, 4 layers) with the same initial parameters behind a
linear layer, `--steps` environment steps and 4 passes over them in batches of 64. The peers are `qrlsuite.layer` on the
native simulator, and the program that `qrlsuite show --export pennylane` prints, on default.qubit with backprop.
Figures are processor time on one thread, medians of `--repeats` in turns. The last column is the largest difference of
the two policies' logits after training.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

import qrlsuite
from qrlsuite.circuit.export import export

LAYERS = 4


def pennylane_layer(qubits: int) -> nn.Module:
    """Return the circuit of `qrlsuite.layer('cz', qubits, LAYERS)` as PennyLane's own layer, parameters equal."""
    ours = qrlsuite.layer("cz", qubits, LAYERS)
    program: dict[str, Any] = {}
    exec(export(ours.description, "pennylane"), program)  # what `qrlsuite show --export` prints
    node = program["circuit"]

    class Layer(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.circuit = ours.circuit

        def forward(self, inputs: Tensor) -> Tensor:
            return torch.stack(node(inputs, **self.circuit), dim=-1).to(inputs.dtype)

    return Layer()


def features(kind: str, qubits: int) -> type[BaseFeaturesExtractor]:
    """Return a features extractor with the circuit in its middle."""

    class Features(BaseFeaturesExtractor):
        def __init__(self, space: gymnasium.spaces.Box) -> None:
            super().__init__(space, features_dim=qubits)
            layer: Any = (
                qrlsuite.layer("cz", qubits, LAYERS) if kind == "qrlsuite" else pennylane_layer(qubits)
            )
            self.net = nn.Sequential(nn.Linear(4, qubits), layer)

        def forward(self, observations: Tensor) -> Tensor:
            result: Tensor = self.net(observations)
            return result

    return Features


def trained(kind: str, qubits: int, steps: int) -> tuple[float, Tensor]:
    """Train once and return seconds of processor time, and the policy's logits of fixed observations."""
    torch.manual_seed(0)
    settings = {"features_extractor_class": features(kind, qubits), "net_arch": []}
    model = PPO(
        "MlpPolicy", "CartPole-v1", n_steps=128, n_epochs=4, seed=0, device="cpu", policy_kwargs=settings
    )
    start = time.process_time()
    model.learn(steps)
    seconds = time.process_time() - start
    observations = torch.linspace(-1, 1, 32).reshape(8, 4)
    with torch.no_grad():
        logits = model.policy.get_distribution(observations).distribution.logits
    return seconds, logits


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--qubits", type=int, nargs="+", default=[4, 6, 8])
    parser.add_argument("--steps", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=3)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    print(f"PPO of Stable-Baselines3, {chosen.steps} steps of CartPole, core-seconds")
    print(f"{'qubits':>6} {'qrlsuite':>9} {'PennyLane':>10} {'ratio':>6}  largest difference of logits")
    for qubits in chosen.qubits:
        trained("qrlsuite", qubits, 128)  # compiles the kernels
        runs = [(trained("qrlsuite", qubits, chosen.steps), trained("pennylane", qubits, chosen.steps))
                for _ in range(chosen.repeats)]  # fmt: skip
        ours, theirs = (statistics.median(run[side][0] for run in runs) for side in (0, 1))
        apart = float((runs[0][0][1] - runs[0][1][1]).abs().max())
        print(f"{qubits:>6} {ours:>9.2f} {theirs:>10.2f} {theirs / ours:>6.1f}  {apart:.1e}")


if __name__ == "__main__":
    main()
