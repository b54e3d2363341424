"""Whole epochs of DDQN on `beam6g` on a GPU (`QRLSUITE_CAPTURE=1`), beside the earlier path, in one run.

    python benchmarks/gpu.py [--seconds 500]
    python benchmarks/gpu.py --tiny          # a dry run: the same checks on the CPU

First bits: 20 epochs with copies to targets and a buffer that wraps, by the earlier path; with graphs; and with graphs,
saved and restored after the sixth. What is unequal of losses, scores, counted executions and checkpoints is printed.
Then, for each row of the table, seconds of an epoch by the clock (medians of four, after one), and by torch's profiler
how long the GPU was busy in one more, and its kernels.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from qrlsuite import options
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.training.trainer import Epoch, Trainer

WRAPS = ("algorithm.buffer=1500", "algorithm.target_steps=150")
TABLE = (
    ("mlp", "width=64", 100), ("vqc-native", "qubits=6", 100), ("vqc-native", "qubits=10", 100),
    ("vqc-native", "qubits=10", 400), ("vqc-native", "qubits=14", 30),
)  # fmt: skip
TINY = (("mlp", "width=16", 3), ("vqc-native", "qubits=2", 2))


def trainer(made: Entry, seeds: int, device: str, captured: bool) -> Trainer:
    os.environ["QRLSUITE_CAPTURE"] = str(int(captured))
    return Trainer(made, range(seeds), device)


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
        with profile(activities=[ProfilerActivity.CUDA]) as profiler:
            group.train_epoch()
            torch.cuda.synchronize()
        kernels = [each for each in profiler.key_averages() if each.self_device_time_total > 0]
        result["busy"] = round(sum(each.self_device_time_total for each in kernels) / 1e6, 3)
        result["kernels"] = sum(each.count for each in kernels)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description="Whole epochs on a GPU: bits, seconds, kernels.")
    parser.add_argument("--seconds", type=float, default=500, help="begin nothing after so many")
    parser.add_argument("--tiny", action="store_true", help="a dry run on the CPU")
    given, began = parser.parse_args(), time.perf_counter()
    device = "cpu" if given.tiny else "cuda"

    def say(**line: Any) -> None:
        print(json.dumps({**line, "at": round(time.perf_counter() - began)}), flush=True)

    say(torch=torch.__version__, card=torch.cuda.get_device_name() if device != "cpu" else "none")
    table, epochs, seeds = (TINY, 3, 2) if given.tiny else (TABLE, 20, 20)
    jobs = [("bits", *each[:2], seeds) for each in table[:3]]
    jobs[1:1] = [("times", *row) for row in table]  # first the bits of networks, then times, then other bits
    for kind, model, word, many in jobs:
        if time.perf_counter() - began > given.seconds:
            say(left_out=[kind, model, word, many])
            continue
        words = (word, *(WRAPS if kind == "bits" else ()))
        made = resolve("beam6g", model, "ddqn", [options.parse_setting(each) for each in words], None)
        groups = [(made, many, device, captured) for captured in (False, True)]
        try:
            if kind == "times":
                before, now = (measured(epochs // 6 + 1, *each) for each in groups)
                say(times=f"{model} {word}", seeds=many, before=before, now=now)
            else:
                before, now = (run(epochs, 0, *each) for each in groups)
                resumed = run(epochs, epochs // 3, *groups[1])
                say(bits=f"{model} {word}", graphs=unequal(before, now), resumed=unequal(now, resumed))
        except Exception as error:  # the next job may do
            say(failed=[kind, model, word, many], error=f"{type(error).__name__}: {error}"[:500])


if __name__ == "__main__":
    main()
