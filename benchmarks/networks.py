"""Layers of networks as one compiled sweep (`qrlsuite.compiled.networks`), beside batched matrix products of torch.

    python benchmarks/networks.py [--width 16 64 256] [--seeds 50]
    python benchmarks/networks.py --training [--width 16 64] [--seeds 10]

Printed are microseconds of processor time per seed for a batch of 64, forward and backward, billions of operations per
second, and their share of the bound, a loop of independent fused multiply-adds; medians, one thread, one run. Values
and gradients are compared with torch's in double precision first, and one seed alone with the same seed among others.

With `--training` it is DDQN on CartPole, with the settings of its preset `tuned`: milliseconds of processor time for a
seed and an epoch of 1000 interactions, without validation, here and by JAX (`jax_ddqn.py`, compilation not counted).
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import numpy as np
import torch
from circuits import fma_loop, median_ms

from qrlsuite.compiled.networks import NOTHING, RELU, backward, forward, record_rows
from qrlsuite.compiled.vectors import aligned, lanes
from qrlsuite.experiment.entry import resolve
from qrlsuite.population import linear
from qrlsuite.training.trainer import Trainer

Arrays = list[Any]


def sweep(weights: Arrays, biases: Arrays, x: Any, cotangents: Any, relu: bool = True) -> tuple[Any, Any]:
    """Return functions that compute outputs, and gradients of weights and biases."""
    v, how = lanes(np.float32), RELU if relu else NOTHING
    sizes = [weights[0].shape[2], *(w.shape[1] for w in weights)]
    chunks = len(x) * -(-x.shape[1] // (2 * v))
    records = aligned((chunks, record_rows(sizes, how, v), 2 * v), np.float32)
    widest = -(-max(sizes) // v) * v
    numbers = sum(min(w.shape[1:]) * -(-max(w.shape[1:]) // v) * v for w in weights)
    room = [aligned(shape, np.float32) for shape in ((2, widest, 2 * v), (2 * v * widest,), (numbers,))]
    out = np.empty((*x.shape[:2], sizes[-1]), np.float32)
    arrays = [each for pair in zip(weights, biases) for each in pair]
    parameters = np.concatenate([each.ravel() for each in arrays])
    gradients, layers = np.empty_like(parameters), np.array(sizes, np.int64)
    ends = np.cumsum([each.size for each in arrays])[:-1]
    parts = [part.reshape(each.shape) for part, each in zip(np.split(gradients, ends), arrays)]

    def values() -> Any:
        forward(x, parameters, layers, how, records, True, out)
        return out

    def slopes() -> Any:
        nothing = np.empty((1, 1, 1), np.float32)
        backward(cotangents, parameters, layers, how, records, *room, gradients, nothing, False)
        return tuple(parts[::2]), tuple(parts[1::2])

    return values, slopes


def by_torch(
    weights: Sequence[torch.Tensor], biases: Sequence[torch.Tensor], x: torch.Tensor
) -> torch.Tensor:
    """Return outputs by products of torch."""
    for i, (w, b) in enumerate(zip(weights, biases)):
        x = linear(x, w, b)
        x = torch.relu(x) if i < len(weights) - 1 else x
    return x


def measure(width: int, seeds: int, bound: float, seconds: float) -> None:
    """Check, measure and print one size."""
    sizes, g = [3, width, width, 3], torch.Generator().manual_seed(0)
    pairs = list(itertools.pairwise(sizes))
    weights = [(torch.rand((seeds, o, i), generator=g) * 2 - 1) / i**0.5 for i, o in pairs]
    biases = [torch.rand((seeds, o), generator=g) - 0.5 for _, o in pairs]
    x, cotangents = torch.randn((seeds, 64, 3), generator=g), torch.randn((seeds, 64, 3), generator=g)
    arrays = [[each.numpy() for each in part] for part in (weights, biases)]
    values, slopes = sweep(*arrays, x.numpy(), cotangents.numpy())

    exact = [[each.double().requires_grad_(True) for each in part] for part in (weights, biases)]
    expected = by_torch(*exact, x.double())
    expected.backward(cotangents.double())
    np.testing.assert_allclose(values(), expected.detach().numpy(), rtol=0, atol=1e-5)
    for found, part in zip(slopes(), exact):
        for one, other in zip(found, part):
            np.testing.assert_allclose(
                one, other.grad.numpy(), rtol=0, atol=1e-5 * float(other.grad.abs().max())
            )
    alone = sweep(*([each[1:2] for each in part] for part in arrays), x[1:2].numpy(), cotangents[1:2].numpy())
    assert np.array_equal(alone[0](), values()[1:2])
    assert all(np.array_equal(a, b[1:2]) for a, b in zip(sum(alone[1](), ()), sum(slopes(), ())))

    for each in (*weights, *biases):
        each.requires_grad_(True)

    def torch_forward() -> None:
        with torch.no_grad():
            by_torch(weights, biases, x)

    def torch_both() -> None:
        by_torch(weights, biases, x).backward(cotangents)

    def both() -> None:
        values()
        slopes()

    products = sum(i * o for i, o in pairs)
    work = {"forward": 2.0 * 64 * products, "both": 2.0 * 64 * (3 * products - 3 * width)}
    for name, ours, theirs in (("forward", values, torch_forward), ("both", both, torch_both)):
        mine, other = (median_ms(call, seconds) / seeds for call in (ours, theirs))
        rate = work[name] / mine / 1e6
        print(
            f"width {width}, {seeds} seeds, {name}: {1e3 * mine:.1f} us a seed, torch {1e3 * other:.1f} (ratio "
            f"{other / mine:.2f}); {rate:.0f} GF/s, {rate / bound:.0%} of the bound, torch "
            f"{work[name] / other / 1e6 / bound:.0%}",
            flush=True,
        )


def training(width: int, seeds: int, epochs: int = 12) -> None:
    """Print what an epoch of DDQN on CartPole takes a seed, beside JAX's."""
    import jax
    import jax_ddqn

    entry = resolve("cartpole", f"mlp width={width}", "ddqn", preset="tuned")
    trainer = Trainer(entry, range(seeds))
    trainer.start()
    o, model = entry.algorithm_options, entry.model_options
    begin, epoch, _ = jax_ddqn.compiled(
        jax_ddqn.Settings(
            width=model.width, depth=model.depth, lr=o.lr, gamma=o.gamma, epsilon=o.epsilon, buffer=o.buffer,
            batch=o.batch, target_steps=o.target_steps, environments=10, rounds=100,
        )
    )  # fmt: skip
    agents = begin(jax.vmap(jax.random.key)(np.arange(seeds)))

    def by_jax() -> None:
        nonlocal agents
        agents = jax.block_until_ready(epoch(agents))

    by_jax()  # compiles
    ours, theirs = (
        _epoch_ms(run, epochs) / seeds for run in (lambda: trainer.algorithm.train_epoch(100), by_jax)
    )
    print(f"width {width}, {seeds} seeds: {ours:.1f} ms a seed and epoch, JAX {theirs:.1f}", flush=True)


def _epoch_ms(run: Callable[[], Any], epochs: int) -> float:
    """Return the median of processor milliseconds."""
    times = []
    for _ in range(epochs):
        begun = time.process_time()
        run()
        times.append(1e3 * (time.process_time() - begun))
    return statistics.median(times)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, nargs="+", default=[10, 16, 64, 256])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=1.0, help="per measurement")
    parser.add_argument("--training", action="store_true", help="whole epochs of DDQN, beside JAX's")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.training:
        for width in arguments.width:
            training(width, arguments.seeds)
        return
    loop, operations = fma_loop()
    bound = operations / median_ms(loop, arguments.seconds) / 1e6
    print(f"bound: {bound:.0f} GF/s")
    for width in arguments.width:
        measure(width, arguments.seeds, bound, arguments.seconds)


if __name__ == "__main__":
    main()
