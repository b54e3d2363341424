"""Whole epochs of DDQN on `beam6g`, and circuits, on a GPU with `QRLSUITE_CAPTURE=1` beside those without it.

    python benchmarks/gpu.py [--seconds 500]
    python benchmarks/gpu.py --tiny          # a dry run: the same checks on the CPU

First bits: 20 epochs with copies to targets and a buffer that wraps, by the earlier path; with graphs; and with graphs,
saved and restored after the sixth, all with numba-cuda's kernels. What is unequal of losses, scores, counted executions
and checkpoints is printed.

Then kernels: for each circuit of `KERNELS`, how far values and gradients by numba-cuda's kernels and by those in
registers are off from the CPU's in float64; whether a seed has the same bits beside others; and milliseconds of a pass
there and back, by the clock and by torch's profiler, kernel by kernel. Values may be off by 1e-6, gradients by 2e-5.

Then, for each row of the table, seconds of an epoch by the clock (medians of four, after one), and by torch's profiler
how long the GPU was busy in one more, and its kernels: by the earlier path, with graphs, and with registers, too.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from qrlsuite import options
from qrlsuite.circuit import ansatz
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.plugins.circuits.native import NativeBackend, backend, gpu, registers
from qrlsuite.training.trainer import Epoch, Trainer

WRAPS = ("algorithm.buffer=1500", "algorithm.target_steps=150")
TABLE = (
    ("mlp", "width=64", 100), ("vqc-native", "qubits=6", 100), ("vqc-native", "qubits=10", 100),
    ("vqc-native", "qubits=10", 400), ("vqc-native", "qubits=14", 30),
)  # fmt: skip
KERNELS = (("iqp", 6, 100), ("iqp", 10, 100), ("cx", 10, 100), ("iqp", 12, 50), ("iqp", 14, 30))
TINY = (("mlp", "width=16", 3), ("vqc-native", "qubits=2", 2))


def trainer(made: Entry, seeds: int, device: str, path: str) -> Trainer:
    """Return a trainer whose circuits run by the kernels of a path: "earlier", "graphs", or "registers" with graphs."""
    os.environ["QRLSUITE_CAPTURE"] = str(int(path != "earlier"))
    backend.registers_trouble = (lambda: "left out") if path != "registers" else TROUBLE
    return Trainer(made, range(seeds), device)


TROUBLE = backend.registers_trouble


def run(epochs: int, saved_after: int, *group_of: Any) -> Any:
    """Return the epochs and the checkpoint after them."""
    group, found = trainer(*group_of), []
    group.start()
    for number in range(1, epochs + 1):
        found.append(group.train_epoch())
        if number == saved_after:
            saved, group = group.capture(), trainer(*group_of)
            group.restore(saved_after, saved)
    return found, group.capture()


def unequal(first: tuple[list[Epoch], Any], second: tuple[list[Epoch], Any]) -> dict[str, Any]:
    """Return what differs between two runs: from which epoch on, or by how much at most in the checkpoint."""
    different: dict[str, Any] = {}
    for one, other in zip(first[0], second[0], strict=True):
        for name, value in {"scores": one.scores, "executions": one.executions, **one.metrics}.items():
            theirs = {"scores": other.scores, "executions": other.executions, **other.metrics}[name]
            if not (value == theirs if isinstance(value, list) else np.array_equal(value, theirs, True)):
                different.setdefault(name, f"from epoch {one.number} on")
    for name, value in first[1].items():
        gap = np.abs(value.astype(np.float64) - second[1][name].astype(np.float64))
        different |= {name: float(np.nanmax(gap))} if (gap > 0).any() else {}
    return different


def measured(epochs: int, *group_of: Any) -> dict[str, Any]:
    """Return seconds of an epoch, of its parts, and what the profiler saw of one."""
    group = trainer(*group_of)
    group.start()
    parts = [group.train_epoch().seconds for _ in range(1 + epochs)]
    result = {
        name: round(statistics.median(each[name] for each in parts[1:]), 3) for name in ("train", "validate")
    }
    result |= {"first": round(sum(parts[0].values()), 2), "epoch": round(sum(result.values()), 3)}
    if group.device.type != "cpu":
        kernels = profiled(group.train_epoch)
        result["busy"] = round(sum(each.self_device_time_total for each in kernels) / 1e6, 3)
        result["kernels"] = sum(each.count for each in kernels)
    return result


def profiled(work: Callable[[], Any]) -> list[Any]:
    """Return what torch's profiler says of each kernel in some work."""
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        work()
        torch.cuda.synchronize()
    return [each for each in profiler.key_averages() if each.self_device_time_total > 0]


def passes(name: str, qubits: int, seeds: int, device: str) -> dict[str, Any]:
    """Return errors and milliseconds of a circuit's kernels, 64 samples a seed; on the CPU of the two paths there."""
    circuit = ansatz(name, qubits=qubits, layers=4)
    native, source = NativeBackend(circuit), torch.Generator().manual_seed(qubits)
    x, cotangent = (2 * torch.rand(seeds, 64, qubits, generator=source) - 1 for _ in range(2))
    given = (x, 6.28 * torch.rand(seeds, circuit.parameter_count, generator=source), cotangent)

    def both(work: Callable[[Any, Any], Any], x: Any, p: Any, cotangent: Any) -> list[Any]:
        leaves = [x.detach().requires_grad_(), p.detach().requires_grad_()]
        values = work(*leaves)
        return [values.detach(), *torch.autograd.grad(values, leaves, cotangent)]

    few = tuple(each[:2].double() for each in given)
    right, result = both(native.simulator(), *few), {}
    makes = {"numba-cuda": gpu.GPUSimulator, "registers": registers.RegisterSimulator}
    paths = {"torch": native.by_torch, "compiled": native.simulator()}
    for path, work in (
        paths.items() if device == "cpu" else ((k, make(native.program)) for k, make in makes.items())
    ):
        there = tuple(each.to(device) for each in given)
        if device != "cpu" and not work.takes(there[0]):
            result[path] = "does not take it"
            continue
        found, alone = both(work, *there), both(work, *(each[1:2] for each in there))
        errors = [float((f[:2].cpu() - r).abs().max()) for f, r in zip(found, right)]
        times = []
        for _ in range(11):
            begun = time.perf_counter()
            float(both(work, *there)[0].sum())  # waits for the GPU
            times.append(1e3 * (time.perf_counter() - begun))
        result[path] = {
            "values_off": errors[0], "gradients_off": max(errors[1:]),
            "right": errors[0] < 1e-6 and max(errors[1:]) < 2e-5,
            "same_in_company": all(torch.equal(a, f[1:2]) for a, f in zip(alone, found)),
            "call": round(statistics.median(times), 3),
        }  # fmt: skip
        if device != "cpu":
            kernels = profiled(lambda work=work, there=there: both(work, *there))
            result[path]["kernels"] = {k.key[:60]: round(k.self_device_time_total / 1e3, 3) for k in kernels}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Whole epochs and circuits on a GPU: bits, seconds, kernels."
    )
    parser.add_argument("--seconds", type=float, default=500, help="begin nothing after so many")
    parser.add_argument("--tiny", action="store_true", help="a dry run on the CPU")
    given, began = parser.parse_args(), time.perf_counter()
    device = "cpu" if given.tiny else "cuda"

    def say(**line: Any) -> None:
        print(json.dumps({**line, "at": round(time.perf_counter() - began)}), flush=True)

    say(torch=torch.__version__, card=torch.cuda.get_device_name() if device != "cpu" else "none")
    table, epochs, seeds = (TINY, 3, 2) if given.tiny else (TABLE, 20, 20)
    jobs: list[tuple[str, str, Any, int]] = [("bits", *each[:2], seeds) for each in table[:3]]
    circuits = (("cx", 3, 2), ("iqp", 2, 2)) if given.tiny else KERNELS
    # first the bits of networks, then kernels, then times, then other bits
    jobs[1:1] = [*(("kernels", *each) for each in circuits), *(("times", *row) for row in table)]
    for kind, model, word, many in jobs:
        if time.perf_counter() - began > given.seconds:
            say(left_out=[kind, model, word, many])
            continue
        try:
            if kind == "kernels":
                say(kernels=f"{model} {word}", seeds=many, **passes(model, word, many, device))
                continue
            words = (word, *(WRAPS if kind == "bits" else ()))
            made = resolve("beam6g", model, "ddqn", [options.parse_setting(each) for each in words], None)
            groups = [(made, many, device, path) for path in ("earlier", "graphs", "registers")]
            if kind == "times":
                groups = groups[:2] if model == "mlp" else groups
                found = {each[3]: measured(epochs // 6 + 1, *each) for each in groups}
                say(times=f"{model} {word}", seeds=many, **found)
            else:
                before, now = (run(epochs, 0, *each) for each in groups[:2])
                resumed = run(epochs, epochs // 3, *groups[1])
                say(bits=f"{model} {word}", graphs=unequal(before, now), resumed=unequal(now, resumed))
        except Exception as error:  # the next job may do
            say(failed=[kind, model, word, many], error=f"{type(error).__name__}: {error}"[:500])


if __name__ == "__main__":
    main()
