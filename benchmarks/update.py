"""One DDQN update of the hybrid network (batch 64), per backend, for 1 and 16 seeds together; and of the MLP.

    python benchmarks/update.py --qubits 4 6 10

An update is what training repeats: two forward passes for the target, one forward and backward pass, one step of
Adam. Milliseconds per update and seed, medians, one thread, one run.
"""

from __future__ import annotations

import argparse
import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import torch
from circuits import median_ms

from qrlsuite.engine.groups import parse_seeds
from qrlsuite.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.run import ModelBuilder, build_envs
from qrlsuite.seeding import Streams
from qrlsuite.specs import resolve as reference


def update(model: str, settings: list[str], seeds: int) -> object:
    """Return a call that makes one update of a population on the standard task."""
    entry = resolve("beam6g", model, settings=[parse_setting(word) for word in settings])
    streams = [Streams(entry.task.hash, seed) for seed in parse_seeds(f"0:{seeds}")]
    envs = build_envs(entry, 10 * seeds, lambda: None)
    envs.seed_lanes([s.numpy("environment", lane) for s in streams for lane in range(10)])
    build = ModelBuilder(entry, 3, streams)
    ddqn = reference(entry.algorithm.factory)(
        envs, build, entry.algorithm_options, streams, torch.device("cpu")
    )
    ddqn.start()
    ddqn.train_epoch(7)
    picked = torch.randint(70, (seeds, 64), generator=torch.Generator().manual_seed(0))
    return lambda: ddqn._learn(picked)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--qubits", type=int, nargs="+", default=[4, 6, 10])
    parser.add_argument("--seconds", type=float, default=2.0, help="per measurement")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for seeds in (1, 16, 100):
        print(
            f"mlp width=64, {seeds} seeds: {median_ms(update('mlp', [], seeds), given.seconds) / seeds:.3f} ms"
        )
    for n in given.qubits:
        base: dict[int, float] = {}
        for model in ("vqc-pennylane", "vqc-native"):
            for seeds in (1, 16) if n < 10 else (1, 4):
                ms = median_ms(update(model, [f"qubits={n}"], seeds), given.seconds) / seeds
                base.setdefault(seeds, ms)
                print(
                    f"{model} qubits={n}, {seeds} seeds: {ms:.3f} ms per seed (ratio {base[seeds] / ms:.3g})",
                    flush=True,
                )


if __name__ == "__main__":
    main()
