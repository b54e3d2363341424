"""Circuit layers side by side: milliseconds for forward and backward of a batch of 64, one thread, one run.

    python benchmarks/circuits.py --qubits 4 6 8 10 --plot circuits.png
    python benchmarks/circuits.py --bound
    python benchmarks/circuits.py --gates --qubits 10
    python benchmarks/circuits.py --device cuda

With `--bound`: the native simulator alone, every built-in ansatz, 10 seeds together, as a share of the processor's
bound: of what a loop of fused multiply-adds on the same vectors reaches, measured in turn with it. Work is counted
as in a plain list of gates: 28 operations per amplitude pair that a block of rotations touches (80 backward), 2 per
amplitude and Hadamard (4 backward), nothing for CNOT and CZ. Shares are medians: of the kernels forward, backward and
both, and of the whole call from torch.

With `--gates`: every built-in ansatz on PennyLane's default.qubit and on the native simulator, called in turn. Ratios
are to `rot` in the same structure on the same simulator; above 1 is slower.

With `--device cuda`: the native simulator on a GPU, 100 seeds together (50 of 12 qubits, 30 of 14), by the clock,
against one core of the machine that the GPU is in.

Work: the paper's hybrid circuit (`iqp`, `rot`, 4 layers), gradients by inputs, scalings and weights. Peers are
PennyLane's default.qubit with backprop (the paper's choice, the whole batch in one broadcast), the native simulator
as a PennyLane device, lightning.qubit with adjoint gradients, Qiskit (values by Aer, native gradients), JAX by hand
and TensorCircuit-NG, both by jit and vmap, and qulacs, whose backprop takes one sample (`pip install '.[bench]'`).
Figures are medians of processor time: on shared cores the clock charges long calls for their neighbors, and short
ones not, which would flatter the faster side. Ratios are to PennyLane's default.qubit.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import os
import statistics
import time
from collections.abc import Callable

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import numpy as np
import torch

from qrlsuite.circuit import Circuit, ansatz, create_backend

BATCH, SEEDS = 64, 10
NINE = [(name, gate) for name in ("iqp", "cx", "cz") for gate in ("rot", "xyz", "u3")]
Call = Callable[[], object]


def torch_call(
    circuit: Circuit,
    backend: str,
    dtype: torch.dtype,
    batch: int = BATCH,
    seeds: int = 1,
    where: str = "cpu",
    **options: object,
) -> Call:
    """Return one forward and backward pass through a registered backend, with its options."""
    run = create_backend(backend, circuit, **options)
    source = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(seeds, *shape, dtype=dtype, generator=source)

    x = drawn(batch, circuit.inputs).to(where).requires_grad_()
    parameters = {
        name: (6.28 * drawn(*p.shape)).to(where).requires_grad_() for name, p in circuit.parameters.items()
    }
    cotangent = drawn(batch, len(circuit.observables)).to(where)
    return lambda: run(x, parameters).backward(cotangent)


def jax_call(qubits: int, layers: int, library: str = "") -> Call:
    """Return the same pass in JAX: a sample's circuit by hand or by a library, vmap over the batch, jit over all."""
    import jax
    import jax.numpy as jnp

    n = qubits
    if library:
        import tensorcircuit

        tensorcircuit.set_backend("jax")

    def rot(a: object) -> object:
        p, t, o = a[0], a[1], a[2]
        c, s = jnp.cos(t / 2), jnp.sin(t / 2)
        rows = [
            [jnp.exp(-0.5j * (p + o)) * c, -jnp.exp(0.5j * (p - o)) * s],
            [jnp.exp(-0.5j * (p - o)) * s, jnp.exp(0.5j * (p + o)) * c],
        ]
        return jnp.array(rows).astype(jnp.complex64)

    hadamard = jnp.array([[1, 1], [1, -1]]) / jnp.sqrt(2.0)

    def by_hand(x: object, scaling: object, weights: object) -> object:
        state = jnp.full((2,) * n, 2.0 ** (-n / 2), dtype=jnp.complex64)
        for layer in range(layers):
            for q in range(n):
                target = (q + 1) % n
                state = jnp.moveaxis(state, (q, target), (0, 1))
                u = rot(scaling[layer, q] * x[q] + weights[layer, q])
                state = jnp.stack([state[0], jnp.tensordot(u, state[1], axes=1)])
                state = jnp.moveaxis(state, (0, 1), (q, target))
            if layer < layers - 1:
                for q in range(n):
                    state = jnp.moveaxis(jnp.tensordot(hadamard, state, axes=(1, q)), 0, q)
        probability = jnp.abs(state) ** 2
        marginals = [probability.sum(axis=tuple(k for k in range(n) if k != q)) for q in range(n)]
        return jnp.array([m[0] - m[1] for m in marginals])

    def by_tensorcircuit(x: object, scaling: object, weights: object) -> object:
        circuit = tensorcircuit.Circuit(n)
        for layer in range(layers):
            for q in range(n):
                circuit.h(q)
            for q in range(n):
                u = rot(scaling[layer, q] * x[q] + weights[layer, q])
                circuit.unitary(q, (q + 1) % n, unitary=jnp.eye(4, dtype=jnp.complex64).at[2:, 2:].set(u))
        return jnp.array([jnp.real(circuit.expectation_ps(z=[q])) for q in range(n)])

    one = by_tensorcircuit if library else by_hand

    def loss(x: object, scaling: object, weights: object, cotangent: object) -> object:
        return (jax.vmap(one, in_axes=(0, None, None))(x, scaling, weights) * cotangent).sum()

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))
    keys = jax.random.split(jax.random.PRNGKey(0), 4)
    x, cotangent = jax.random.normal(keys[0], (BATCH, n)), jax.random.normal(keys[1], (BATCH, n))
    scaling, weights = (6.28 * jax.random.uniform(k, (layers, n, 3)) for k in keys[2:])
    return lambda: jax.block_until_ready(gradient(x, scaling, weights, cotangent))


def qulacs_call(qubits: int, layers: int) -> Call:
    """Return the same pass in qulacs, sample by sample: a controlled rotation is one by P and one by ZP."""
    from qulacs import Observable, ParametricQuantumCircuit

    n, source = qubits, np.random.default_rng(0)
    circuit = ParametricQuantumCircuit(n)
    for _ in range(layers):
        for q in range(n):
            circuit.add_H_gate(q)
        for q in range(n):
            target = (q + 1) % n
            for pauli in (3, 2, 3):
                circuit.add_parametric_multi_Pauli_rotation_gate([target], [pauli], 0.0)
                circuit.add_parametric_multi_Pauli_rotation_gate([q, target], [3, pauli], 0.0)
    x, cotangent = source.normal(size=(2, BATCH, n))
    scaling, weights = 6.28 * source.random((2, layers, n, 3))

    def call() -> None:
        gradients = np.empty((BATCH, layers, n, 3))
        for sample in range(BATCH):
            angles = scaling * x[sample, :, None] + weights
            for place, angle in enumerate(np.stack([-angles / 2, angles / 2], axis=-1).ravel().tolist()):
                circuit.set_parameter(place, angle)
            observable = Observable(n)
            for q in range(n):
                observable.add_operator(cotangent[sample, q], f"Z {q}")
            slopes = np.reshape(circuit.backprop(observable), (layers, n, 3, 2))
            gradients[sample] = (slopes[..., 1] - slopes[..., 0]) / 2
        _ = (
            (gradients * scaling).sum(axis=(1, 3)),
            (gradients * x[:, None, :, None]).sum(axis=0),
            gradients.sum(axis=0),
        )

    return call


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


def fma_loop() -> tuple[Call, float]:
    """Return a loop of independent fused multiply-adds on the simulator's vectors, and its operations."""
    import numba

    from qrlsuite.compiled import vectors
    from qrlsuite.compiled.vectors import fma, load, store

    @numba.njit(nogil=True, fastmath={"contract"}, error_model="numpy")
    def loop(rows: np.ndarray, count: int) -> None:
        x, y = load(rows, 0), load(rows, 1)
        a = b = c = d = e = f = g = h = i = j = k = m = load(rows, 2)
        for _ in range(count):
            a, b, c, d = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y)
            e, f, g, h = fma(e, x, y), fma(f, x, y), fma(g, x, y), fma(h, x, y)
            i, j, k, m = fma(i, x, y), fma(j, x, y), fma(k, x, y), fma(m, x, y)
        store(rows, 3, a + b + c + d + e + f + g + h + i + j + k + m)

    count, lanes = 300_000, vectors.lanes(np.float32)
    rows = vectors.aligned((4, lanes), np.float32)
    rows[:] = 0.5
    return lambda: loop(rows, count), 2.0 * 12 * count * lanes


def operations(circuit: Circuit) -> tuple[float, float]:
    """Return the operations of one sample, forward and backward, in the plain list of gates."""
    from qrlsuite.plugins.circuits.native.program import HADAMARD, NONE, ROTATE, compile_circuit

    forward = backward = 0.0
    for kind, first, second, third, _, behind in compile_circuit(circuit).steps.tolist():
        hadamards = behind.bit_count()
        if kind == ROTATE:
            pairs = (1 << circuit.qubits) / (2 if first == NONE else 4)
            forward, backward = forward + 28 * pairs, backward + 80 * pairs
        elif kind == HADAMARD:
            hadamards = sum(bit != NONE for bit in (first, second, third))
        amplitudes = hadamards << circuit.qubits
        forward, backward = forward + 2 * amplitudes, backward + 4 * amplitudes
    return forward, backward


def seconds_of(call: Call) -> float:
    """Return the processor time of one call."""
    start = time.process_time()
    call()
    return time.process_time() - start


def shares(circuit: Circuit, seconds: float, bound: Call, bound_operations: float) -> list[float]:
    """Return the shares of the bound: kernels forward, backward, both, whole call; and the whole call's ms per seed."""
    from qrlsuite.plugins.circuits.native import NativeBackend

    backend = NativeBackend(circuit)
    kernels = backend.simulator().kernels
    inside = {"forward": 0.0, "backward": 0.0}
    original = {name: getattr(kernels, name) for name in inside}

    def timed(name: str) -> Callable[..., None]:
        def call(*arguments: object) -> None:
            inside[name] = seconds_of(lambda: original[name](*arguments))

        return call

    source = torch.Generator().manual_seed(0)
    x = torch.rand(SEEDS, BATCH, circuit.inputs, generator=source)
    parameters = {
        name: (6.28 * torch.rand(SEEDS, *p.shape, generator=source)).requires_grad_()
        for name, p in circuit.parameters.items()
    }
    cotangent = torch.rand(SEEDS, BATCH, len(circuit.observables), generator=source)

    def whole() -> None:
        torch.autograd.grad(backend(x, parameters), list(parameters.values()), cotangent)

    forward, backward = (count * SEEDS * BATCH for count in operations(circuit))
    for name in inside:
        setattr(kernels, name, timed(name))
    try:
        whole()
        rows: list[tuple[float, ...]] = []
        began = time.process_time()
        while len(rows) < 5 or time.process_time() - began < seconds:
            peak = bound_operations / seconds_of(bound)
            total = seconds_of(whole)
            f, b = inside["forward"], inside["backward"]
            both = forward + backward
            rows.append(
                (forward / f / peak, backward / b / peak, both / (f + b) / peak, both / total / peak, total)
            )
    finally:
        for name, function in original.items():
            setattr(kernels, name, function)
    *medians, total = np.median(rows, axis=0).tolist()
    return [*medians, 1e3 * total / SEEDS]


def print_shares(qubits: list[int], layers: int, seconds: float) -> None:
    """Print how close to the bound every built-in ansatz comes."""
    bound, count = fma_loop()
    bound()
    print(
        f"{'':>10}{'qubits':>8}{'forward':>10}{'backward':>10}{'both':>8}{'torch call':>12}{'ms a seed':>11}"
    )
    for name, gate in NINE:
        for n in qubits:
            row = shares(ansatz(name, qubits=n, layers=layers, gate=gate), seconds, bound, count)
            cells = "{:>10.0%}{:>10.0%}{:>8.0%}{:>12.0%}{:>11.3g}".format(*row)
            print(f"{f'{name} {gate}':>10}{n:>8}{cells}", flush=True)


def print_gates(qubits: list[int], layers: int, seconds: float) -> None:
    """Print milliseconds of every built-in ansatz, and how much slower each is than `rot` in its structure."""
    for n in qubits:
        calls = {
            (backend, *pair): torch_call(
                ansatz(pair[0], qubits=n, layers=layers, gate=pair[1]), backend, torch.float32
            )
            for pair in NINE
            for backend in ("pennylane", "native")
        }
        for call in calls.values():
            call()
        rounds: list[list[float]] = []
        began = time.process_time()
        while len(rounds) < 5 or time.process_time() - began < seconds * len(calls):
            rounds.append([1e3 * seconds_of(call) for call in calls.values()])
        row = dict(zip(calls, np.median(rounds, axis=0).tolist()))
        print(f"n = {n}{'PennyLane default.qubit':>34}{'native':>26}")
        for name, gate in NINE:
            cells = "".join(
                f"{row[b, name, gate]:>16.3g} ms ({row[b, name, gate] / row[b, name, 'rot']:.2f})"
                for b in ("pennylane", "native")
            )
            print(f"{f'{name} {gate}':>12}{cells}", flush=True)


def print_gpu(qubits: list[int], layers: int, seconds: float, device: str) -> None:
    """Print milliseconds of a population on a GPU, by the clock, and of the same work on one core."""
    print(f"{'qubits':>6} {'seeds':>5} {device:>10} {'one core':>10} {'ratio':>6}")
    for n in qubits:
        circuit = ansatz("iqp", qubits=n, layers=layers)
        seeds = 100 if n <= 10 else 50 if n <= 12 else 30
        call = torch_call(circuit, "native", torch.float32, seeds=seeds, where=device)
        times: list[float] = []
        call()  # compiles
        while sum(times) < seconds or len(times) < 3:
            began = time.perf_counter()
            call()
            if device != "cpu":
                torch.cuda.synchronize(device)
            times.append(time.perf_counter() - began)
        there = 1e3 * statistics.median(times)
        here = seeds * median_ms(torch_call(circuit, "native", torch.float32), seconds)
        print(f"{n:>6} {seeds:>5} {there:>10.3g} {here:>10.3g} {here / there:>6.3g}", flush=True)


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
    parser.add_argument("--bound", action="store_true", help="shares of the processor's bound, native alone")
    parser.add_argument("--gates", action="store_true", help="every built-in ansatz against its `rot`")
    parser.add_argument("--device", help="cuda: the native simulator there, against one core")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.device:
        print_gpu(arguments.qubits, arguments.layers, arguments.seconds, arguments.device)
        return
    if arguments.bound:
        print_shares(arguments.qubits, arguments.layers, arguments.seconds)
        return
    if arguments.gates:
        print_gates(arguments.qubits, arguments.layers, arguments.seconds)
        return
    table: dict[str, dict[int, float]] = {}
    for n in arguments.qubits:
        circuit = ansatz(arguments.ansatz, qubits=n, layers=arguments.layers, gate=arguments.gate)
        peers: dict[str, tuple[Call, float]] = {
            "PennyLane default.qubit": (torch_call(circuit, "pennylane", torch.float32), 1.0),
            "PennyLane qrlsuite.native": (
                torch_call(circuit, "pennylane", torch.float64, device="qrlsuite.native"),
                1.0,
            ),
            "native float32": (torch_call(circuit, "native", torch.float32), 1.0),
            "native float64": (torch_call(circuit, "native", torch.float64), 1.0),
        }
        if not arguments.quick:
            lightning = torch_call(
                circuit, "pennylane", torch.float64, batch=4, device="lightning.qubit", diff_method="adjoint"
            )
            peers["lightning.qubit adjoint"] = (lightning, BATCH / 4)
            if n <= 10:
                peers["Qiskit Aer"] = (torch_call(circuit, "qiskit", torch.float64), 1.0)
            if n <= 12 and (arguments.ansatz, arguments.gate) == ("iqp", "rot"):
                for name, package, make in (
                    ("JAX jit + vmap", "jax", jax_call),
                    (
                        "TensorCircuit-NG",
                        "tensorcircuit",
                        functools.partial(jax_call, library="tensorcircuit"),
                    ),
                    ("qulacs backprop", "qulacs", qulacs_call),
                ):
                    if importlib.util.find_spec(package) is None:
                        print(f"{name} is not installed (pip install '.[bench]'): left out")
                    else:
                        peers[name] = make(n, arguments.layers), 1.0
        for name, (call, scale) in peers.items():
            table.setdefault(name, {})[n] = median_ms(call, arguments.seconds, scale)
            print(f"  n = {n}: {name} {table[name][n]:.3f} ms", flush=True)
    reference = table["PennyLane default.qubit"]
    print("\nms for forward and backward (ratio: PennyLane default.qubit / this)")
    print(f"{'':26}" + "".join(f"{f'n = {n}':>20}" for n in arguments.qubits))
    for name, row in table.items():
        cells = (f"{row[n]:.3g} ({reference[n] / row[n]:.3g})" if n in row else "-" for n in arguments.qubits)
        print(f"{name:26}" + "".join(f"{cell:>20}" for cell in cells))
    if arguments.plot:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.4, 4), layout="constrained")
        axes = figure.subplots()
        for name, row in table.items():
            axes.semilogy(list(row), list(row.values()), marker="o", label=name)
        axes.set_xlabel("qubits")
        axes.set_ylabel("ms, forward and backward, batch 64")
        axes.grid(alpha=0.3)
        axes.set_xticks(arguments.qubits)
        figure.legend(frameon=False, loc="outside right upper")
        figure.savefig(arguments.plot, dpi=160)


if __name__ == "__main__":
    main()
