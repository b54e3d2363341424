"""Can the matched controls represent the planted teacher? Supervised fits of its classes.

    python benchmarks/planted.py [--starts 8] [--steps 4000]

Every model learns the classes of the same 4000 points by cross-entropy with Adam, from several random starts at once;
printed are the shares of right classes of 2000 other points. `mean-field, teacher's own` begins with the teacher's
parameters and an exact output layer, where the circuit would be perfect.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from torch import nn

from qrlsuite import registry, specs
from qrlsuite.plugins.environments.planted import (
    LAYERS,
    QUBITS,
    SCALING,
    THRESHOLDS,
    WEIGHTS,
    Planted,
)

CIRCUIT = {"ansatz": "cx", "qubits": QUBITS, "layers": LAYERS, "init_scale": 0.2}
MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "circuit": ("vqc-native", CIRCUIT),
    "mean-field": ("vqc-native", CIRCUIT | {"ansatz_options": {"entangled": "mean-field"}}),
    "mean-field, teacher's own": ("vqc-native", CIRCUIT | {"ansatz_options": {"entangled": "mean-field"}}),
    "separable": ("vqc-native", CIRCUIT | {"ansatz_options": {"entangled": "separable"}}),
    "sin": ("mlp", {"width": 11, "depth": 1, "activation": "sin", "input_scale": 1.0}),
    "sin, gain 2": ("mlp", {"width": 11, "depth": 1, "activation": "sin", "input_scale": 2.0}),
    "sin, depth 2, width 6": ("mlp", {"width": 6, "depth": 2, "activation": "sin", "input_scale": 2.0}),
    "sin, depth 2, width 5": ("mlp", {"width": 5, "depth": 2, "activation": "sin", "input_scale": 2.0}),
    "fourier": ("fourier", {"frequencies": 8, "bandwidth": 1.0}),
    "mlp": ("mlp", {"width": 6, "depth": 2}),
}
"""Models of about as many parameters as the circuit's 78, and their options."""


def examples(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return `count` points (N, 2) of the environment and their classes (N,)."""
    env = Planted(steps=count)
    env.reset(seed=0)
    return torch.from_numpy(env.points), torch.from_numpy(env.classes)


def fit(name: str, starts: int, steps: int, seed: int = 0) -> tuple[int, list[float]]:
    """Return the number of parameters, and the share of right classes of unseen points after every start, ascending."""
    points, classes = examples(6000)
    model, options = MODELS[name]
    spec = registry.get(specs.ModelSpec, model)
    built = specs.resolve(spec.options)(**options)
    modules = [
        specs.resolve(spec.build)(2, 4, built, torch.Generator().manual_seed(1000 * seed + s))
        for s in range(starts)
    ]
    population: nn.Module = specs.resolve(spec.population)(modules, built)
    if name == "mean-field, teacher's own":
        _teach(population, torch.Generator().manual_seed(seed))
    optimizer = torch.optim.Adam(population.parameters(), lr=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 0.02, total_steps=steps)
    source = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        batch = torch.randint(0, 4000, (starts, 128), generator=source)
        logits = population(points[batch])
        loss = nn.functional.cross_entropy(logits.flatten(0, 1), classes[batch].flatten()) * starts
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        answers = population(points[4000:].expand(starts, -1, -1)).argmax(-1)
    right = (answers == classes[4000:]).double().mean(1)
    return sum(p.numel() for p in modules[0].parameters()), sorted(right.tolist())


@torch.no_grad()
def _teach(population: nn.Module, generator: torch.Generator) -> None:
    """Give start 0 the teacher's parameters, and the others these with noise on the angles."""
    state = dict(population.named_parameters())
    starts = len(state["output.bias"])
    signs = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    state["input.weight"].copy_(torch.eye(2).expand(starts, 2, 2))
    state["input.bias"].zero_()
    state["circuit.scaling"].copy_(torch.tensor(SCALING))
    noise = torch.randn(state["circuit.weights"].shape, generator=generator)
    amount = torch.linspace(0, 0.1, starts).reshape(-1, 1, 1, 1)
    state["circuit.weights"].copy_(torch.tensor(WEIGHTS) + amount * noise)
    state["output.weight"].copy_(2 * signs)
    state["output.bias"].copy_(-2 * signs @ torch.tensor(THRESHOLDS))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=8)
    parser.add_argument("--steps", type=int, default=4000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| model | parameters | best | median | worst |\n|---|---|---|---|---|")
    for name in MODELS:
        count, right = fit(name, arguments.starts, arguments.steps)
        print(f"| {name} | {count} | {right[-1]:.3f} | {np.median(right):.3f} | {right[0]:.3f} |", flush=True)


if __name__ == "__main__":
    main()
