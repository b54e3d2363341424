"""`qrlsuite demo`: a first comparison, command by command, that ends with its answer in sentences."""

from __future__ import annotations

import statistics
import time
from itertools import combinations
from pathlib import Path

import typer

from qrlsuite.cli.app import build
from qrlsuite.cli.arguments import RunsOption
from qrlsuite.engine.terminal import command
from qrlsuite.results.text import steps_text

TASK = "beam6g"
ENTRIES = ("mlp width=16", "mlp width=64", "vqc-native qubits=6")
SEEDS, EPOCHS = 20, 30
"""Chosen from the published curves before a demo was run: at 60,000 steps, in each of 150 blocks of 20 seeds drawn from
the 100 published, width 64 was told apart from width 16 and from 6 qubits (Holm over three pairs, 5 percent)."""


def demo(runs: RunsOption = Path("runs")) -> None:
    """Train two networks and a circuit on beam6g, rank them beside the published entries, and print the result.

    It takes about two minutes, and prints each command before it runs it. Stop with Ctrl-C at any time; the same
    command continues.

    Example: qrlsuite demo
    """
    from qrlsuite import api

    for entry in ENTRIES:
        model, option = entry.split()
        size = ("--seeds", str(SEEDS), "--epochs", str(EPOCHS))
        if _do("run", "--task", TASK, "--model", model, "--set", option, *size, runs=runs):
            raise typer.Exit(130)  # Ctrl-C
    typer.echo(f"\n{_one_circuit_twice()}", err=True)
    own = [api.load(f"{TASK}/{entry}", runs=runs).cut(EPOCHS) for entry in ENTRIES]
    trained = [entry.with_seeds(SEEDS) for entry in own if entry is not None]
    horizon = EPOCHS * trained[0].steps_per_epoch
    _do("leaderboard", "--task", TASK, "--published", "--horizon", str(horizon), runs=runs)
    _do("plot", "curves", "--task", TASK, *(word for e in ENTRIES for word in ("--entry", e)), runs=runs)
    whole = min(trained[0].task_file.ranking.horizons)
    typer.echo(
        f"\nYour {SEEDS} seeds, pair by pair, after {steps_text(horizon)} of {steps_text(whole)} steps:"
    )
    for first, second in combinations(trained, 2):
        typer.echo(f"- {api.compare(first, second).pair.said}")
    typer.echo(
        "Next, a circuit of your own: put a QNode into mine.py, and type: qrlsuite check mine.py --plugin mine.py"
    )


def _do(*words: str, runs: Path) -> int | None:
    """Print a command and run it; returns its exit code, None for 0."""
    typer.echo(f"\n$ {command(*words, runs=runs)}", err=True)
    code: int | None = build()([*words, "--runs", str(runs)], prog_name="qrlsuite", standalone_mode=False)
    return code


def _one_circuit_twice() -> str:
    """Run a 6-qubit circuit with its gradients on PennyLane and on the native simulator; say how they compare."""
    import torch

    from qrlsuite.circuit import ansatz, expectations

    circuit = ansatz("iqp", qubits=6, layers=4)
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    inputs = drawn(64, circuit.inputs)
    parameters = {name: drawn(*each.shape) for name, each in circuit.parameters.items()}
    values, seconds = {}, {}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # products of small matrices, as PennyLane's, are slower on several
    for backend in ("pennylane", "native"):
        timed = []
        for _ in range(4):  # the first compiles, or fills caches
            leaves = {name: value.clone().requires_grad_() for name, value in parameters.items()}
            began = time.perf_counter()
            found = expectations(circuit, inputs, leaves, backend=backend)
            torch.autograd.backward(found.sum())
            timed.append(time.perf_counter() - began)
        values[backend], seconds[backend] = found.detach(), statistics.median(timed[1:])
    torch.set_num_threads(threads)
    away = float((values["pennylane"] - values["native"]).abs().max())
    slow, fast = (1e3 * seconds[backend] for backend in ("pennylane", "native"))
    return (
        f"One 6-qubit circuit, 64 inputs, values and gradients, one thread: PennyLane {slow:.0f} ms, native simulator "
        f"{fast:.2g} ms ({slow / fast:.0f} times as fast). Their values differ by {away:.0e} at most."
    )
