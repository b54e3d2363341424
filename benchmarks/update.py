"""One DDQN update of the hybrid network (batch 64), per backend, for 1 and 16 seeds together; and of the MLP.

    python benchmarks/update.py --qubits 4 6 10
    python benchmarks/update.py --controls 6 10 > table.md

An update is what training repeats: two forward passes for the target, one forward and backward pass, one step of
Adam. Milliseconds of processor time per update and seed, medians, one thread, one run; ratios are to PennyLane at the
same number of seeds. Qiskit is measured up to 6 qubits.
Of the native backend, milliseconds of a round of training (choose actions, step the environment, update) and of a
pass of validation (100 episodes a seed) are printed, too, and what part of the round is the network's kernel, the
environment, and the rest, which is Python. 200 of each are an epoch.

`--controls` prints the table of docs/controls.md instead: of the circuits of these sizes, of every control and of
networks of equal size the numbers of trained and of fixed parameters, the rank of the circuit's Jacobian, and the
milliseconds per update and seed, 10 seeds together.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np
import torch
from circuits import Call, median_ms

from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.results.seeds import parse_seeds
from qrlsuite.seeding import Streams
from qrlsuite.specs import resolve as reference
from qrlsuite.training.trainer import ModelBuilder, build_envs

BATCH = 64


def training(model: str, settings: list[str], seeds: int) -> tuple[Any, torch.Tensor]:
    """Return a population's DDQN on the standard task, its replay buffer filled, and a batch's draws from it."""
    settings_text = [*settings, f"algorithm.batch={BATCH}"]
    entry = resolve("beam6g", model, settings=[parse_setting(word) for word in settings_text])
    streams = [Streams(entry.task.hash, seed) for seed in parse_seeds(f"0:{seeds}")]
    envs = build_envs(entry, 10 * seeds, lambda: None)
    envs.seed_lanes([s.numpy("environment", lane) for s in streams for lane in range(10)])
    build = ModelBuilder(entry, envs, streams)
    ddqn = reference(entry.algorithm.factory)(
        envs, build, entry.algorithm_options, streams, torch.device("cpu")
    )
    ddqn.start()
    for _ in range(7):  # fills the replay buffer without learning
        ddqn._interact(torch.zeros((seeds, 10), dtype=torch.int64))
    return ddqn, torch.rand((seeds, BATCH), dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def update(model: str, settings: list[str], seeds: int) -> Call:
    """Return a call that makes one update of a population."""
    ddqn, picked = training(model, settings, seeds)
    return lambda: ddqn._learn(picked)


def parts(qubits: int, seeds: int, seconds: float) -> tuple[float, dict[str, float]]:
    """Return the milliseconds of a round of training, and what part is the network, the environment and Python."""
    from qrlsuite.plugins.circuits.native import hybrid

    ddqn, picked = training("vqc-native", [f"qubits={qubits}"], seeds)
    spent = dict.fromkeys(("network", "environment"), 0.0)

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            start = time.process_time()
            result = function(*arguments, **named)
            spent[part] += time.process_time() - start
            return result

        return call

    def one_round() -> float:
        start = time.process_time()
        ddqn._interact(ddqn._greedy(ddqn.observations))
        ddqn._learn(picked)
        return time.process_time() - start

    original = hybrid.passes
    hybrid.passes = timed("network", original)
    ddqn.envs.step = timed("environment", ddqn.envs.step)
    try:
        one_round()
        spent.update(network=0.0, environment=0.0)
        rounds: list[float] = []
        while sum(rounds) < seconds:
            rounds.append(one_round())
    finally:
        hybrid.passes = original
    shares = {name: part / sum(rounds) for name, part in spent.items()}
    return 1e3 * statistics.median(rounds), {**shares, "Python": 1.0 - sum(shares.values())}


def controls(qubits: int) -> list[tuple[str, list[str]]]:
    """Return model and settings of a circuit, its controls, and classical models of as many trained parameters."""
    circuit = [f"qubits={qubits}"]
    trained = 31 * qubits + 3  # with 3 inputs, 3 actions and 4 layers
    width = min(range(1, 64), key=lambda w: abs(w * w + 8 * w + 3 - trained))
    return [
        ("vqc-native", circuit),
        *(("vqc-native", [*circuit, f"entangled={kind}"]) for kind in ("mean-field", "separable")),
        *(("vqc-native", [*circuit, f"train={part}"]) for part in ("scaling", "weights", "linear")),
        ("mlp", [f"width={width}"]),
        ("mlp", [f"width={round((trained - 3) / 7)}", "depth=1", "activation=sin"]),
        ("mlp", [f"width={qubits}", "depth=1", "activation=sin"]),
        ("fourier", [f"frequencies={round((trained - 3) / 9)}"]),
        ("fourier", [f"frequencies={round((trained - 3) / 6)}", "train=linear"]),
    ]


def print_controls(sizes: list[int], seconds: float) -> None:
    """Print the table of circuits, controls and networks of equal size as Markdown."""
    from qrlsuite.circuit.resources import jacobian_rank

    print("| model | trained | fixed | rank of the circuit | ms per update |\n|---|---|---|---|---|")
    seeds = 10
    for model, settings in (row for qubits in sizes for row in controls(qubits)):
        ddqn, picked = training(model, settings, seeds)
        counts = {name: p.numel() // seeds for name, p in ddqn.online.named_parameters() if p.requires_grad}
        fixed = sum(p.numel() for p in ddqn.online.parameters() if not p.requires_grad) // seeds
        circuit = getattr(getattr(ddqn.online, "_runner", None), "circuit", None)
        rank = "-" if circuit is None else f"{jacobian_rank(circuit)} of {circuit.parameter_count}"
        ms = median_ms(lambda ddqn=ddqn, picked=picked: ddqn._learn(picked), seconds) / seeds
        name = " ".join(f"`{word}`" for word in (model, *settings))
        print(f"| {name} | {sum(counts.values())} | {fixed or '-'} | {rank} | {ms:.3f} |", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--qubits", type=int, nargs="+", default=[4, 6, 10])
    parser.add_argument("--seconds", type=float, default=2.0, help="per measurement")
    parser.add_argument(
        "--controls", type=int, nargs="+", metavar="QUBITS", help="print the table of controls"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.controls:
        print_controls(arguments.controls, arguments.seconds)
        return
    for seeds in (1, 16, 100):
        print(
            f"mlp width=64, {seeds} seeds: {median_ms(update('mlp', [], seeds), arguments.seconds) / seeds:.3f} ms"
        )
    for n in arguments.qubits:
        base: dict[int, float] = {}
        for model in ("vqc-pennylane", "vqc-native", *(("vqc-qiskit",) if n <= 6 else ())):
            for seeds in (1, 8, 16):
                ms = median_ms(update(model, [f"qubits={n}"], seeds), arguments.seconds) / seeds
                base.setdefault(seeds, ms)
                print(
                    f"{model} qubits={n}, {seeds} seeds: {ms:.3f} ms per seed (ratio {base[seeds] / ms:.3g})",
                    flush=True,
                )
        for seeds in (1, 10, 50):
            ms, divided = parts(n, seeds, arguments.seconds)
            shares = ", ".join(f"{name} {share:.0%}" for name, share in divided.items())
            ddqn, _ = training("vqc-native", [f"qubits={n}"], seeds)
            seen = np.zeros((seeds, 100, ddqn.obs_dim), np.float32)
            played = median_ms(lambda ddqn=ddqn, seen=seen: ddqn.act(seen), arguments.seconds)
            print(
                f"vqc-native qubits={n}, {seeds} seeds: {ms:.3f} ms a round of training ({shares}), "
                f"{played:.3f} ms a pass of validation",
                flush=True,
            )


if __name__ == "__main__":
    main()
