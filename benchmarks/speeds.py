"""Reference speeds: processor seconds of one epoch of one seed, for the entries that estimates are scaled from.

    python benchmarks/speeds.py [--only qubits=14] [--write tasks/speeds/reference.toml]

Every entry is trained for a few epochs in a group of the size that stands beside it, and a seed of it alone; the first
half of the epochs (compilation, an empty replay buffer, episodes that end at once) does not count, of the others the
median does. CartPole's episodes become longer with training: give it `--epochs 100`. Processor time, one thread: other
work on the machine changes it little. `--write` puts the rows into the file, in the place of those for the same
entries, and this machine's calibration beside them.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.results import provenance, speed
from qrlsuite.results.store import EntryStore, read_lines
from qrlsuite.training.group import GroupRun

HEADER = """\
# Processor seconds of one epoch of one seed, training and validation: `seconds` as its share of a group of `group`
# seeds, `alone` for a seed trained by itself (without it, the size of the group makes no difference). Measured by
# benchmarks/speeds.py where no source is given. They serve estimates before anything was measured on a machine, and
# for the ratios between entries and sizes of groups after that. Sizes between those measured are near enough to one
# of them. `calibration` is what qrlsuite.results.speed.measure_calibration() returns on this machine (processor time;
# the median of three calls): where it returns twice as much, estimates from these speeds are twice as long.
format_version = 1
"""

WIDTHS = [("beam6g", "ddqn", "mlp", {"width": width, "depth": 2}, 50) for width in (16, 32, 64, 128, 256)]
DEPTHS = [
    ("beam6g", "ddqn", "mlp", {"width": width, "depth": depth}, 50) for width in (32, 64) for depth in (1, 4)
]
CIRCUITS = [
    ("beam6g", "ddqn", "vqc-native", {"qubits": qubits, "layers": 4}, seeds)
    for qubits, seeds in ((4, 20), (6, 20), (8, 20), (10, 10), (12, 4), (14, 2))
]
DEEPER = [("beam6g", "ddqn", "vqc-native", {"qubits": qubits, "layers": 6}, 10) for qubits in (8, 10)]
ON_POLICY = [
    ("beam6g", "ppo", "mlp", {"width": 16, "depth": 2}, 20),
    ("beam6g", "ppo", "mlp", {"width": 64, "depth": 2}, 20),
    ("beam6g", "ppo", "vqc-native", {"qubits": 6, "layers": 4}, 20),
    ("beam6g", "ppo", "vqc-native", {"qubits": 10, "layers": 4}, 20),
]
CARTPOLE = [
    ("cartpole", "reinforce", "mlp", {"width": 16, "depth": 1}, 50),
    ("cartpole", "reinforce", "vqc-native", {"qubits": 4, "layers": 1}, 50),
    ("cartpole", "ppo", "mlp", {"width": 64, "depth": 2}, 20),
    ("cartpole", "ddqn", "mlp", {"width": 64, "depth": 2}, 20),
]
SMALL_CIRCUITS = [
    (task, "ddqn", model, options, 50)
    for task in ("vqe-h2", "pulse")
    for model, options in (
        ("mlp", {"width": 16, "depth": 2}),
        ("mlp", {"width": 64, "depth": 2}),
        ("vqc-native", {"model.qubits": 4, "layers": 4}),
    )
]
SMALL_CIRCUITS += [
    (task, "ppo", model, {**options, "repeats": 20}, 50)
    for task in ("vqe-ising", "clifford")
    for model, options in (
        ("mlp", {"width": 6, "depth": 2}),
        ("mlp", {"width": 64, "depth": 2}),
        ("vqc-native", {"model.qubits": 4, "layers": 4}),
    )
]
ENTRIES = WIDTHS + DEPTHS + CIRCUITS + DEEPER + ON_POLICY + CARTPOLE + SMALL_CIRCUITS

Row = dict[str, Any]


def measure(task: str, algorithm: str, model: str, options: dict[str, int], seeds: int, epochs: int) -> Row:
    """Train a group, and a seed alone, and return their row."""
    entry = resolve(
        task, model, algorithm, [parse_setting(f"{name}={value}") for name, value in options.items()]
    )
    together, alone = (_seconds(entry, size, epochs) for size in (seeds, 1))
    return {
        "environment": entry.task.environment.name,
        "algorithm": algorithm,
        "model": model,
        "options": {name.removeprefix("model."): value for name, value in options.items()},
        "seconds": float(f"{together:.2g}"),
        "group": seeds,
        "alone": float(f"{alone:.2g}"),
    }


def _seconds(entry: Entry, seeds: int, epochs: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        store = EntryStore.create(Path(folder), entry)
        GroupRun([(entry, store, range(seeds))], epochs).run()
        lines = read_lines(store.seed(0).timings)
    return statistics.median(float(line["cpu"]) for line in lines[len(lines) // 2 :])


def written(row: Row) -> str:
    """Return a row as TOML."""
    options = ", ".join(f"{name} = {json.dumps(value)}" for name, value in row["options"].items())
    names = "".join(f'{name} = "{row[name]}"\n' for name in ("environment", "algorithm", "model"))
    numbers = "".join(f"{name} = {row[name]}\n" for name in ("seconds", "group", "alone") if name in row)
    source = f'source = "{row["source"]}"\n' if "source" in row else ""
    return f"\n[[speeds]]\n{names}options = {{ {options} }}\n{numbers}{source}"


def merge(path: Path, machine: str, calibration: float, rows: list[Row]) -> str:
    """Return the file's text with new rows; rows of other entries stay if they are of the same machine."""
    before = tomllib.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    kept = before.get("speeds", []) if before.get("machine") == machine else []

    def key(row: Row) -> tuple[Any, ...]:
        return (row["environment"], row["algorithm"], row["model"], sorted(row["options"].items()))

    new = {str(key(row)) for row in rows}
    merged = sorted(
        [*(row for row in kept if str(key(row)) not in new), *rows], key=lambda row: str(key(row)[:3])
    )
    start = f'{HEADER}machine = "{machine}"\ncalibration = {calibration:.3g}\n'
    return start + "".join(map(written, merged))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--epochs", type=int, default=4)
    parser.add_argument(
        "--only", default="", help="entries that have this in their name, for example qubits=14"
    )
    parser.add_argument("--write", type=Path, help="a file of reference speeds")
    arguments = parser.parse_args()
    machine = f"one core of {provenance.processor()}"
    calibration = statistics.median(speed.measure_calibration() for _ in range(3))
    rows: list[Row] = []
    for task, algorithm, model, options, seeds in ENTRIES:
        name = " ".join([task, algorithm, model, *(f"{key}={value}" for key, value in options.items())])
        if arguments.only not in name:
            continue
        rows.append(measure(task, algorithm, model, options, seeds, arguments.epochs))
        print(
            f"{name}: {rows[-1]['seconds']} s per epoch and seed, {seeds} seeds together; {rows[-1]['alone']} s alone",
            flush=True,
        )
        if arguments.write:
            arguments.write.write_text(merge(arguments.write, machine, calibration, rows), encoding="utf-8")


if __name__ == "__main__":
    main()
