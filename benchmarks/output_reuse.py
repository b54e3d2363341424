"""Why outputs that are given sixteen times to a linear layer learn faster: `python benchmarks/output_reuse.py`.

Under Adam, sixteen copies of a weight move as their sum with sixteen times the rate. The script first trains PPO with
`output_reuse=16`, and PPO with a 16-fold rate of the weights alone, from the same sums, and prints how far apart
their parameters are after six epochs in float64. Then it trains 20 seeds of each of four variants, from 1,000,000 up,
and prints the steps below threshold of docs/results/dissecting.md: mean and 95% interval. Four core-minutes. The rate
of the weights alone, and the size of the first biases, are no options of the suite: they are set here by replacing
two functions.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from qrlsuite.engine.worker import train_group
from qrlsuite.experiment.entry import resolve
from qrlsuite.plugins.models import vqc
from qrlsuite.results.store import EntryStore
from qrlsuite.statistics import Grid, LearningCurves
from qrlsuite.statistics.times import mean_time
from qrlsuite.training.trainer import Trainer

ENTRY = (
    "ppo vqc-native preset=released qubits=4 layers=1 ansatz=hsiao encoding=single linear=behind gamma=.99 lr=2.5e-4 "
    "quantum_lr=2.5e-4 clip=.2 repeats=4 batch=128 environment.normalization=arctan"
)
TIMES = 16
VARIANTS = {  # name: options, whether the rate is that of the weights alone, factor on the first biases
    "outputs given 16 times": (f"output_reuse={TIMES}", False, 1.0),
    "16-fold rate of the weights, first biases a quarter": (f"output_rate={TIMES}", True, TIMES**-0.5),
    "16-fold rate of weights and biases": (f"output_rate={TIMES}", False, 1.0),
    "16-fold rate of the weights": (f"output_rate={TIMES}", True, 1.0),
}


@contextmanager
def changed(weights_alone: bool, biases: float) -> Iterator[None]:
    """Apply `output_rate` to the weights alone, and multiply the initial biases."""
    rates, initial = vqc._Hybrid.learning_rates, vqc.initial

    def of_weights(model: Any) -> dict[str, float]:
        return {name: rate for name, rate in rates(model).items() if name == "output.weight"}

    def scaled(*arguments: Any) -> dict[str, torch.Tensor]:
        state = initial(*arguments)
        state["output.bias"] *= biases
        return state

    with (
        mock.patch.object(vqc._Hybrid, "learning_rates", of_weights if weights_alone else rates),
        mock.patch.object(vqc, "initial", scaled),
    ):
        yield


def summed(value: torch.Tensor) -> torch.Tensor:
    """Return the sums of copies (..., 16 n) -> (..., n)."""
    return value.unflatten(-1, (TIMES, -1)).sum(-2)


def apart(epochs: int = 6) -> float:
    """Return how far apart the parameters are that begin alike."""
    with changed(True, 1.0):
        both = [
            Trainer(resolve("cartpole", f"{ENTRY} dtype=float64 {option}"), [5])
            for option in (f"output_reuse={TIMES}", f"output_rate={TIMES}")
        ]
    networks = [(getattr(both[0].algorithm, n), getattr(both[1].algorithm, n)) for n in ("actor", "critic")]

    def pairs() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        for reused, plain in networks:
            own = dict(plain.named_parameters())
            for name, value in reused.named_parameters():
                yield (summed(value) if name == "output.weight" else value).detach(), own[name]

    with torch.no_grad():
        for theirs, own in pairs():
            own.copy_(theirs)
    for trainer in both:
        trainer.envs.seed_lanes(
            [np.random.Generator(np.random.Philox(key=lane)) for lane in range(trainer.E)]
        )
        trainer.algorithm.start()
        for _ in range(epochs):
            trainer.algorithm.train_epoch(100)
    return max(float((theirs - own.detach()).abs().max()) for theirs, own in pairs())


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    print(f"largest difference of a parameter after 6 epochs: {apart():.1g}")
    for name, (option, weights_alone, biases) in VARIANTS.items():
        with tempfile.TemporaryDirectory() as folder, changed(weights_alone, biases):
            store = EntryStore.create(Path(folder), resolve("cartpole", f"{ENTRY} {option}"))
            seeds = [1_000_000 + k for k in range(arguments.seeds)]
            train_group(store.path, seeds, 100)
            curves = LearningCurves(np.array([store.seed(seed).read().curve for seed in seeds]), 1000, name)
        ranking = resolve("cartpole", ENTRY).task.file.ranking
        found = mean_time(curves, Grid.relative(ranking.epsilons, [0.5]))
        low, high = (end / 1e3 for end in found.interval)
        print(f"{name}: {found.mean / 1e3:.1f}k ({low:.1f}k to {high:.1f}k)", flush=True)


if __name__ == "__main__":
    main()
