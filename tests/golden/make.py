"""Writes `tests/golden/v<version>/`: what every later version must find unchanged.

    python -m tests.golden.make [VERSION]

    hashes.json             hashes of all tasks, of the entries that plain commands name, and the published entries
    interrupted/TASK/ENTRY  runs that were stopped in the middle of an epoch, with their checkpoint
    finished/TASK/ENTRY     the epochs' lines and the trained agents with which they end
    machine.json            what made them: their bits are those of one kind of processor and of some versions

Run once per release, or with the next VERSION as soon as bits change; a folder that is there is never written again.
`tests/core/test_earlier_versions.py` reads it.
"""

from __future__ import annotations

import itertools
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

import qrlsuite
from qrlsuite import registry, specs
from qrlsuite.engine.worker import train_group
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.task import load
from qrlsuite.leaderboard.shelf.published import PUBLISHED
from qrlsuite.options import parse_setting
from qrlsuite.results import provenance
from qrlsuite.results.progress import Progress
from qrlsuite.results.store import EntryStore, json_line
from qrlsuite.training.group import GroupRun
from tests.conftest import POLE, TINY

GOLDEN = Path(__file__).parent
SEEDS, EPOCHS, STOPPED_AFTER = (0, 1), 6, 3

SMALL = {
    "mlp": ("width=8",),
    "vqc-native": ("qubits=3", "layers=2"),
    "ddqn": ("buffer=100", "batch=16", "target_steps=10"),
    "ppo": ("repeats=3", "batch=20"),
    "reinforce": ("baseline=mean", "memory=12"),
}
RUNNING = POLE.replace("steps = 30\n", 'steps = 30\nnormalization = "running"\n', 1)
RUNS = [
    *(
        (TINY, algorithm, model)
        for algorithm in ("ddqn", "ppo", "reinforce")
        for model in ("mlp", "vqc-native")
    ),
    (RUNNING, "reinforce", "mlp"),
]


def machine() -> dict[str, Any]:
    """Return what the bits of floating-point results depend on: the processor, and who computes on it."""
    from numba.core.registry import cpu_target

    made = provenance.collect([])
    return {
        "system": made.system,
        "processor": made.processor,
        "torch kernels": torch.backends.cpu.get_cpu_capability(),
        "numba target": cpu_target.target_context.codegen().magic_tuple()[1],
        **{name: made.versions[name] for name in ("torch", "numpy", "numba")},
    }


def hashes() -> dict[str, Any]:
    """Return the hashes of tasks and of entries at their defaults, and the records of the published entries."""
    known = registry.load().of(specs.TaskSpec)
    tasks = {name: load(name).hash for name in sorted(known) if known[name].distribution == "qrlsuite"}
    models = ("mlp", "vqc-native", "vqc-pennylane", "vqc-qiskit")
    named = {
        " ".join(words): resolve(words[0], words[2], words[1]).hash
        for words in itertools.product(("beam6g", "cartpole"), ("ddqn", "ppo", "reinforce"), models)
    }
    published = []
    for path in sorted(PUBLISHED.glob("*/*/entry.json")):
        record = EntryStore(path.parent).record().content
        published.append(
            {name: value for name, value in record.items() if name not in ("published", "tuning")}
        )
    return {"tasks": tasks, "entries": named, "published": published}


def stop(entry: Entry, store: EntryStore) -> None:
    """Train until the middle of an epoch."""

    def interrupt(progress: Progress) -> None:
        if progress.epoch == STOPPED_AFTER and progress.phase == "training" and progress.done == 5:
            raise KeyboardInterrupt

    try:
        GroupRun([(entry, store, SEEDS)], EPOCHS, report=interrupt).run()
    except KeyboardInterrupt:
        return
    raise RuntimeError("the run was not interrupted")


def write(folder: Path) -> None:
    """Write everything."""
    interrupted, finished = folder / "interrupted", folder / "finished"
    with tempfile.TemporaryDirectory() as temporary:
        task = Path(temporary) / "task.toml"
        for text, algorithm, model in RUNS:
            task.write_text(text)
            words = [*SMALL[model], *SMALL[algorithm]]
            entry = resolve(str(task), model, algorithm, [parse_setting(word) for word in words])
            store = EntryStore.create(interrupted, entry)
            stop(entry, store)
            shutil.copytree(store.path, Path(temporary) / "copy")
            ended = EntryStore(Path(temporary) / "copy")
            train_group(ended.path, SEEDS, EPOCHS)
            for seed in SEEDS:
                there = finished / entry.task.name / entry.name / f"seed-{seed:04d}"
                there.mkdir(parents=True)
                (there / "epochs.jsonl").write_bytes(
                    b"".join(json_line(line.content) for line in ended.seed(seed).epochs())
                )
                shutil.copy(ended.seed(seed).path / "final.safetensors", there)
            shutil.rmtree(ended.path)
    for path in [*interrupted.rglob("timings.jsonl"), *interrupted.rglob("progress.json")]:
        path.unlink()  # times and host names
    for name, content in (("hashes.json", hashes()), ("machine.json", machine())):
        (folder / name).write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    target = GOLDEN / f"v{next(iter(sys.argv[1:]), qrlsuite.__version__)}"
    if target.exists():
        sys.exit(f"{target} is there, and its files are never changed: raise the version first")
    write(target)
