"""The circuit and its classical rivals on a family of 20 tasks that no setting was searched on; some 3 core-hours.

    OMP_NUM_THREADS=1 python benchmarks/family.py --runs DIR [--workers 2]

The tasks are placements and path degrees of `beam6g`, by a rule that was fixed before the first seed: 2 to 5 antennas,
and of each number the placements 5 to 9 of the suite's own rule, whose 0 to 4 are the tasks `beam6g-a2-0` to
`beam6g-a5-4`. The paths of placement i of n antennas have the degree 3 + (n + i) mod 4. The settings are those that
the searches for `advantage-beam6g` found, on `beam6g`. Each task has one look, after 40 seeds, at the horizon of that
study. The answer is the mean over tasks like these: each task is one observation.

Like any study, it goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

from qrlsuite.plugins.environments.beam6g.placements import placement

OPTIONS = "epsilon=.2 buffer=16000 batch=512 target_steps=300"
ENTRIES = (
    f"circuit: ddqn vqc-native model.qubits=6 init_scale=.674 lr=.00373 quantum_lr=.00424 {OPTIONS}",
    "mean-field: ddqn vqc-native model.qubits=6 ansatz_options={entangled='mean-field'} init_scale=.398 lr=.0094 "
    f"quantum_lr=.00451 {OPTIONS}",
    f"network: ddqn mlp width=10 input_scale=5.08 lr=.00193 {OPTIONS}",
    f"sines: ddqn mlp width=10 activation=sin input_scale=8 lr=.00214 {OPTIONS}",
)
QUESTION = "Does the circuit need fewer steps than every classical model of its size?"
PAIRS = f"""[[looks.questions]]
text = "{QUESTION}"
pairs = [["circuit", "mean-field"], ["circuit", "network"], ["circuit", "sines"]]

"""
LOOKS = "40 first_seed=300000"
EPOCHS = 30


def write_task(folder: Path, antennas: int, index: int) -> Path:
    """Write a task file."""
    degree = 3 + (antennas + index) % 4
    path = folder / f"beam6g-a{antennas}-{index}-degree{degree}.toml"
    rows = "".join(f"    [[{x}, {y}], [{u}, {v}]],\n" for (x, y), (u, v) in placement(antennas, index))
    path.write_text(
        f'format_version = 1\nextends = "beam6g-a{antennas}-0"\nname = "{path.stem}"\n'
        f'summary = "{antennas} antennas, placement {index}, paths of degree {degree}"\n\n'
        f"[environment.options]\ndegree = {degree}\nantennas = [\n{rows}]\n"
    )
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--runs", type=Path, required=True, help="the results folder; task and study files lie in it"
    )
    parser.add_argument("--workers", default="2")
    arguments = parser.parse_args()

    folder = arguments.runs.resolve() / "family"
    folder.mkdir(parents=True, exist_ok=True)

    def suite(*words: str) -> None:
        command = sys.executable, "-m", "qrlsuite", *words, "--runs", str(folder.parent)
        subprocess.run(command, check=True, cwd=folder)

    studies = []
    for antennas in range(2, 6):
        for index in range(5, 10):
            study = f"family-a{antennas}-{index}.toml"
            path = folder / study
            if not path.exists():
                task = write_task(folder, antennas, index).name
                own = f"--task {task} --epochs {EPOCHS}".split()
                suite("study", "new", study, *ENTRIES, *own, "--looks", LOOKS)
            if PAIRS not in (text := path.read_text()):
                text = re.sub("^summary = .*", f'summary = "{QUESTION}"', text, flags=re.M)
                path.write_text(text.replace("[[entries]]", f"{PAIRS}[[entries]]", 1))
            studies.append(study)
    for study in studies:
        suite("study", "run", study, "--workers", arguments.workers)
    suite("show", *studies)


if __name__ == "__main__":
    main()
