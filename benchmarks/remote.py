"""What engine `dask` costs: processor time against the local engine, and memory where many groups are queued.

    python benchmarks/remote.py overhead [--model mlp] [--set width=16] [--epochs 100] [--seeds 20] [--workers 2]
    python benchmarks/remote.py task [--model mlp] [--set width=16] [--seeds 20] [--repeat 5]
    python benchmarks/remote.py queue [--groups 1000] [--minutes 1]

`overhead` runs `qrlsuite run` with each engine in turn and counts the processor seconds of the command with all that it
started (for dask a scheduler and its workers on this machine), which other work on the same cores does not stretch.
A run of one epoch before, which is not counted, compiles the kernels.
`task` has this process work on tasks of one epoch, and counts the processor seconds that are not the epoch's: building
the agents and environments, decoding, restoring, encoding, and at the client decoding and saving the checkpoint.
`queue` starts a scheduler and two workers, has one command send a task for each of many groups of one seed, and prints
the largest memory (RSS) of the command and of the scheduler.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
ENVIRONMENT = {**os.environ, **ONE_THREAD}
HERE = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")


def command(runs: Path, model: str, settings: list[str], *more: str) -> list[str]:
    words = [
        sys.executable,
        "-m",
        "qrlsuite",
        "run",
        "--task",
        "beam6g",
        "--model",
        model,
        "--runs",
        str(runs),
    ]
    return [*words, *(word for each in settings for word in ("--set", each)), *more, "--yes", "--json"]


def spent() -> float:
    """Return the processor seconds of all processes that were started and have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def overhead(given: argparse.Namespace) -> dict[str, Any]:
    seconds: dict[str, list[float]] = {"local": [], "dask": []}
    clock: dict[str, list[float]] = {"local": [], "dask": []}
    for repeat in range(given.repeat + 1):
        epochs = given.epochs if repeat else 1
        for engine in seconds:
            with tempfile.TemporaryDirectory() as folder:
                more = ["--seeds", str(given.seeds), "--epochs", str(epochs), "--engine", engine]
                words = command(Path(folder), given.model, given.set, *more, "--workers", str(given.workers))
                before, began = spent(), time.monotonic()
                subprocess.run(words, check=True, env=ENVIRONMENT, capture_output=True)
                if repeat:
                    seconds[engine].append(spent() - before)
                    clock[engine].append(time.monotonic() - began)
    medians = {engine: round(statistics.median(values), 1) for engine, values in seconds.items()}
    return {
        "processor seconds": medians,
        "ratio": round(medians["dask"] / medians["local"], 3),
        "seconds by the clock": {engine: round(statistics.median(v), 1) for engine, v in clock.items()},
    }


def task(given: argparse.Namespace) -> dict[str, Any]:
    from qrlsuite.engine.remote import POLICY
    from qrlsuite.experiment.entry import resolve
    from qrlsuite.options import parse_setting
    from qrlsuite.results import checkpoint
    from qrlsuite.results.records import EntryRecord
    from qrlsuite.results.store import EntryStore
    from qrlsuite.training.remote_task import pack, unpack, work_on

    entry = resolve("beam6g", given.model, settings=[parse_setting(word) for word in given.set])
    seeds, arrays, beside, size = list(range(given.seeds)), {}, [], 0
    header = {
        "token": "",
        "entry": EntryRecord.of(entry).content,
        "seeds": seeds,
        "seconds": 0,
        "device": "cpu",
        "versions": {},
    }
    with tempfile.TemporaryDirectory() as folder:
        store = EntryStore.create(Path(folder), entry)
        for epoch in range(given.repeat + 1):  # the first imports and compiles
            began = time.process_time()
            content = work_on(pack({**header, "epoch": epoch, "epochs": given.repeat + 2}, arrays))
            answer, arrays = unpack(content)
            arrays = {name: array for name, array in arrays.items() if not name.startswith(POLICY)}
            checkpoint.save(store, seeds, epoch + 1, arrays)
            training = sum(timing["cpu"] * given.seeds for timing in answer["timings"])
            beside.append(time.process_time() - began - training)
            size = len(content)
    seconds = statistics.median(beside[1:])
    return {
        "seconds beside training": round(seconds, 2),
        "of a minute": f"{seconds / 60:.1%}",
        "MB": round(size / 2**20, 1),
    }


def queue(given: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        dask = [sys.executable, "-c", "import sys; from dask.__main__ import main; main()"]
        scheduler = subprocess.Popen(
            [*dask, "scheduler", *HERE, "--port", "0", "--scheduler-file", str(file)],
            env=ENVIRONMENT,
            stderr=subprocess.DEVNULL,
        )
        while not file.exists() or not file.read_bytes().endswith(b"}"):
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        worker = [
            *dask,
            "worker",
            address,
            *HERE,
            "--no-nanny",
            "--nthreads",
            "1",
            "--local-directory",
            folder,
        ]
        workers = [subprocess.Popen(worker, env=ENVIRONMENT, stderr=subprocess.DEVNULL) for _ in range(2)]
        more = [
            "--seeds",
            str(given.groups),
            "--workers",
            str(given.groups),
            "--budget",
            f"{given.minutes}min",
        ]
        more += ["--engine", f"dask scheduler={address}"]
        words = command(Path(folder) / "runs", given.model, given.set, *more)
        client = subprocess.Popen(
            words, env={**ENVIRONMENT, "QRLSUITE_CHECKPOINT_SECONDS": str(given.seconds)}
        )
        most = {"client": 0, "scheduler": 0}
        try:
            while client.poll() is None:
                for name, process in (("client", client), ("scheduler", scheduler)):
                    most[name] = max(most[name], psutil.Process(process.pid).memory_info().rss)
                time.sleep(0.2)
        finally:
            for process in (client, *workers, scheduler):
                process.kill()
                process.wait()
        answers = len(list(Path(folder).glob("runs/*/*/seed-*/timings.jsonl")))
    return {"groups": given.groups, "begun": answers, **{k: f"{v / 2**20:.0f} MB" for k, v in most.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["overhead", "task", "queue"])
    parser.add_argument("--model", default="mlp")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--epochs", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--groups", type=int, default=1000)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seconds", type=float, default=60.0, help="of a task, for `queue`")
    given = parser.parse_args()
    print(json.dumps({"overhead": overhead, "task": task, "queue": queue}[given.what](given)))


if __name__ == "__main__":
    main()
