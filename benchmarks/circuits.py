"""Circuit layers side by side: milliseconds for forward and backward of a batch of 64, one thread, one run.

    python benchmarks/circuits.py --qubits 4 6 8 10 --plot circuits.png

Work: the paper's hybrid circuit (`iqp`, `rot`, 4 layers), gradients by inputs, scalings and weights. Peers are
PennyLane's default.qubit with backprop (the paper's choice, the whole batch in one broadcast), lightning.qubit with
adjoint gradients, Qiskit's EstimatorQNN (4 samples, extrapolated) and JAX, jit and vmap, written by hand
(`pip install jax`). Figures are medians of processor time: on shared cores the clock charges long calls for their
neighbors, and short ones not, which would flatter the faster side. Ratios are to PennyLane's default.qubit.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import torch

from qrlsuite.circuit import Circuit, ansatz, create_backend

BATCH = 64
Call = Callable[[], object]


def torch_call(
    circuit: Circuit, backend: str, dtype: torch.dtype, batch: int = BATCH, **options: object
) -> Call:
    """Return one forward and backward pass through a registered backend."""
    run = create_backend(backend, circuit, **options)
    source = torch.Generator().manual_seed(0)
    x = torch.rand(1, batch, circuit.inputs, dtype=dtype, generator=source).requires_grad_()
    parameters = {
        name: (6.28 * torch.rand(1, *p.shape, dtype=dtype, generator=source)).requires_grad_()
        for name, p in circuit.parameters.items()
    }
    cotangent = torch.rand(1, batch, len(circuit.observables), dtype=dtype, generator=source)
    return lambda: run(x, parameters).backward(cotangent)


def jax_call(qubits: int, layers: int) -> Call:
    """Return the same pass in JAX: one sample's circuit by hand, vmap over the batch, jit over all."""
    import jax
    import jax.numpy as jnp

    n = qubits

    def rot(a: object) -> object:
        p, t, o = a[0], a[1], a[2]
        c, s = jnp.cos(t / 2), jnp.sin(t / 2)
        return jnp.array(
            [
                [jnp.exp(-0.5j * (p + o)) * c, -jnp.exp(0.5j * (p - o)) * s],
                [jnp.exp(-0.5j * (p - o)) * s, jnp.exp(0.5j * (p + o)) * c],
            ]
        )

    hadamard = jnp.array([[1, 1], [1, -1]]) / jnp.sqrt(2.0)

    def one(x: object, scaling: object, weights: object) -> object:
        state = jnp.full((2,) * n, 2.0 ** (-n / 2), dtype=jnp.complex64)
        for layer in range(layers):
            for q in range(n):
                target = (q + 1) % n
                state = jnp.moveaxis(state, (q, target), (0, 1))
                u = rot(scaling[layer, q] * x[q] + weights[layer, q]).astype(jnp.complex64)
                state = jnp.stack([state[0], jnp.tensordot(u, state[1], axes=1)])
                state = jnp.moveaxis(state, (0, 1), (q, target))
            if layer < layers - 1:
                for q in range(n):
                    state = jnp.moveaxis(jnp.tensordot(hadamard, state, axes=(1, q)), 0, q)
        probability = jnp.abs(state) ** 2
        marginals = [probability.sum(axis=tuple(k for k in range(n) if k != q)) for q in range(n)]
        return jnp.array([m[0] - m[1] for m in marginals])

    def loss(x: object, scaling: object, weights: object, cotangent: object) -> object:
        return (jax.vmap(one, in_axes=(0, None, None))(x, scaling, weights) * cotangent).sum()

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))
    keys = jax.random.split(jax.random.PRNGKey(0), 4)
    x, cotangent = jax.random.normal(keys[0], (BATCH, n)), jax.random.normal(keys[1], (BATCH, n))
    scaling, weights = (6.28 * jax.random.uniform(k, (layers, n, 3)) for k in keys[2:])
    return lambda: jax.block_until_ready(gradient(x, scaling, weights, cotangent))


def median_ms(call: Call, seconds: float, scale: float = 1.0) -> float:
    """Return the median processor milliseconds of calls repeated for some seconds, after a warm-up, at least thrice."""
    call()
    times: list[float] = []
    began = time.process_time()
    while len(times) < 3 or time.process_time() - began < seconds:
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * scale * statistics.median(times)


def main() -> None:
    """Measure, print the table, and draw it where asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--qubits", type=int, nargs="+", default=[4, 6, 8, 10, 12, 14])
    parser.add_argument("--layers", type=int, default=4)
    parser.add_argument("--ansatz", default="iqp")
    parser.add_argument("--gate", default="rot")
    parser.add_argument("--seconds", type=float, default=2.0, help="per measurement")
    parser.add_argument("--quick", action="store_true", help="native and PennyLane only")
    parser.add_argument("--plot", help="draw milliseconds against qubits to this file")
    given = parser.parse_args()
    torch.set_num_threads(1)
    table: dict[str, dict[int, float]] = {}
    for n in given.qubits:
        circuit = ansatz(given.ansatz, qubits=n, layers=given.layers, gate=given.gate)
        peers: dict[str, tuple[Call, float]] = {
            "PennyLane default.qubit": (torch_call(circuit, "pennylane", torch.float32), 1.0),
            "native float32": (torch_call(circuit, "native", torch.float32), 1.0),
            "native float64": (torch_call(circuit, "native", torch.float64), 1.0),
        }
        if not given.quick:
            lightning = torch_call(
                circuit, "pennylane", torch.float64, batch=4, device="lightning.qubit", diff_method="adjoint"
            )
            peers["lightning.qubit adjoint"] = (lightning, BATCH / 4)
            if n <= 4:
                peers["Qiskit EstimatorQNN"] = (torch_call(circuit, "qiskit", torch.float64, batch=1), BATCH)
            if n <= 12 and (given.ansatz, given.gate) == ("iqp", "rot"):
                try:
                    peers["JAX jit + vmap"] = (jax_call(n, given.layers), 1.0)
                except ImportError:
                    print("JAX is not installed (pip install jax): left out")
        for name, (call, scale) in peers.items():
            table.setdefault(name, {})[n] = median_ms(call, given.seconds, scale)
            print(f"  n = {n}: {name} {table[name][n]:.3f} ms", flush=True)
    reference = table["PennyLane default.qubit"]
    print("\nms for forward and backward (ratio: PennyLane default.qubit / this)")
    print(f"{'':26}" + "".join(f"{f'n = {n}':>20}" for n in given.qubits))
    for name, row in table.items():
        cells = (f"{row[n]:.3g} ({reference[n] / row[n]:.3g})" if n in row else "-" for n in given.qubits)
        print(f"{name:26}" + "".join(f"{cell:>20}" for cell in cells))
    if given.plot:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.4, 4), layout="constrained")
        axes = figure.subplots()
        for name, row in table.items():
            axes.semilogy(list(row), list(row.values()), marker="o", label=name)
        axes.set_xlabel("qubits")
        axes.set_ylabel("ms, forward and backward, batch 64")
        axes.grid(alpha=0.3)
        axes.set_xticks(given.qubits)
        figure.legend(frameon=False, loc="outside right upper")
        figure.savefig(given.plot, dpi=160)


if __name__ == "__main__":
    main()
