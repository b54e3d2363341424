"""Scripts as entries: run unedited, killed at every moment, and never started from a results folder."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import json
import os
import shutil
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qrlsuite import api
from qrlsuite.engine import script as engine_script
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment import script as scripts
from qrlsuite.experiment.entry import resolve
from qrlsuite.results import points
from qrlsuite.results.claims import claims
from qrlsuite.results.progress import Progress
from qrlsuite.results.store import EntryStore
from tests import commands
from tests.engine.stress import children

SCRIPTS = Path(__file__).with_name("scripts")

WALK = """
import os, sys, time
from rate import RATE
seed, steps, pause = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
with open(f"starts-{seed}.txt", "a") as starts:
    starts.write(f"{os.getpid()}\\n")
with open(f"curve-{seed}.csv", "w") as curve:
    curve.write("step,score\\n")
    for step in range(10, steps + 1, 10):
        curve.write(f"{step},{step * RATE + seed}\\n")
        curve.flush()
        time.sleep(pause)
time.sleep(5 * pause)
"""
"""A script with a file beside it. It notes each start, and writes a curve that only its seed decides."""


@pytest.fixture
def walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with the script, which is the current one."""
    (tmp_path / "walk.py").write_text(WALK)
    (tmp_path / "rate.py").write_text("RATE = 0.5\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def words(pause: float = 0, seeds: int = 3, *more: str) -> list[str]:
    command = f"command={sys.executable} walk.py {{seed}} {{steps}} {pause}"
    task = ["steps=100", "every=20", "thresholds=20,40", "curve=curve-{seed}.csv", "--task", "walks"]
    return ["run", "script", "walk", command, *task, "--seeds", str(seeds), "--workers", "2", *more]


def the_entry(runs: Path) -> EntryStore:
    [path] = runs.glob("*/script-*/entry.json")
    return EntryStore(path.parent)


def starts(folder: Path, seed: int) -> list[int]:
    return [int(line) for line in (folder / f"starts-{seed}.txt").read_text().split()]


@pytest.mark.parametrize(
    ("name", "words", "curve", "task"),
    [
        ("ppo", "ppo.py --seed {seed} --total-timesteps {steps} --num-envs 1", [], "cartpole+training"),
        (
            "dqn",
            "dqn.py --seed {seed} --total-timesteps {steps}",
            ["curve=logs/dqn-seed-{seed}.csv", "metric=charts/episodic_return"],
            "cartpole+training",
        ),
        ("sb3", "sb3.py {seed} {steps}", ["curve=sb3/{seed}/monitor.csv"], "cartpole+training-mean"),
        ("sb3", "sb3.py {seed} {steps}", ["curve=sb3/{seed}/evaluations.npz", "kind=validation"], "cartpole"),
    ],
)
def test_scripts_run_as_they_are(
    name: str, words: str, curve: list[str], task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if importlib.util.find_spec("stable_baselines3") is None and name == "sb3":
        pytest.skip("pip install stable-baselines3")
    shutil.copytree(SCRIPTS, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    typed = [
        "run",
        "script",
        f"{name}-mine",
        f"command={sys.executable} {words}",
        *curve,
        "--task",
        "cartpole",
    ]
    done = commands.qrlsuite(*typed, "--seeds", "1", "--epochs", "3", "--runs", "results", "--json")
    assert done.returncode == 0, done.stderr
    found = api.load(f"{name}-mine", runs="results")
    assert (found.task, found.label, found.curves.shape) == (task, f"script {name}-mine steps=3000", (1, 3))
    assert ((found.curves > 0) & (found.curves < 1)).all()
    assert found.hours > 0
    assert found.record.code is not None
    files = found.record.code.parts[0].files
    assert set(files) == {"dqn.py", "replay.py"} if name == "dqn" else {f"{name}.py"}


def kill(moment: str, run: commands.Command, folder: Path, runs: Path) -> None:
    """End something of a command at work: the script, its worker, or the command, by signals of three kinds."""
    if moment == "script":
        os.kill(starts(folder, 0)[-1], signal.SIGKILL)
    elif moment == "worker":
        os.kill(next(claim.pid for claim in claims(the_entry(runs)) if 0 in claim.seeds), signal.SIGKILL)
    else:
        run.send_signal(
            {"Ctrl-C": signal.SIGINT, "command": signal.SIGKILL, "SIGTERM": signal.SIGTERM}[moment]
        )


MOMENTS = ("script", "worker", "Ctrl-C", "command", "SIGTERM")
SMALL = list(zip(MOMENTS, (1, 5, 10, 5, 10)))
REST = [pair for pair in itertools.product(MOMENTS, (1, 5, 10)) if pair not in SMALL]


@pytest.mark.parametrize(
    ("moment", "lines"), SMALL + [pytest.param(*pair, marks=pytest.mark.long) for pair in REST]
)
def test_a_killed_seed_begins_again_and_none_is_lost_or_doubled(moment: str, lines: int, walk: Path) -> None:
    """At the first line, amid the curve, and when it is whole but the script has not ended."""
    runs = walk / "results"
    typed = words(0.2, 3, "--runs", str(runs))
    run = commands.start(*typed, cwd=walk)
    curve = walk / "curve-0.csv"
    while not (curve.exists() and curve.read_text().count("\n") > lines):
        assert run.poll() is None, "it has ended before"
        time.sleep(0.02)
    kill(moment, run, walk, runs)
    code = run.wait()
    assert code == {"script": 0, "worker": 0, "Ctrl-C": 130, "command": -9, "SIGTERM": 130}[moment]
    if code:
        again = commands.qrlsuite(*words(0.2, 3, "--runs", str(runs)), cwd=walk)
        while "being trained" in again.stderr:  # a killed command's worker was still ending
            again = commands.qrlsuite(*words(0.2, 3, "--runs", str(runs)), cwd=walk)
        assert again.returncode == 0, again.stderr
    store = the_entry(runs)
    assert store.seeds() == [0, 1, 2]
    for seed in range(3):
        assert store.seed(seed).read().curve.tolist() == [
            10 + seed,
            20 + seed,
            30 + seed,
            40 + seed,
            50 + seed,
        ]
    assert len(starts(walk, 0)) == 2  # killed once
    for pid in (pid for seed in range(3) for pid in starts(walk, seed)):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, 0)
            pytest.fail(f"{pid} survives")
    assert not children(os.getpid()) or all(path.name[0] != "." for path in store.path.iterdir())


def test_a_finished_seed_is_not_started_again_and_other_code_is_another_entry(walk: Path) -> None:
    assert commands.qrlsuite(*words()).returncode == 0
    assert commands.qrlsuite(*words(0, 4)).returncode == 0
    assert [len(starts(walk, seed)) for seed in range(4)] == [1, 1, 1, 1]
    (walk / "rate.py").write_text("# the same in effect\nRATE = 0.5\n")
    assert commands.qrlsuite(*words(0, 4)).returncode == 0
    assert len(starts(walk, 0)) == 1
    (walk / "rate.py").write_text("RATE = 0.4\n")
    done = commands.qrlsuite(*words())
    assert "rate.py of walk (script 'walk') has changed" in done.stderr
    assert len(list(Path("runs/walks+training").glob("script-walk-*@*/seed-*"))) == 3
    other = commands.qrlsuite(*words(0.001))
    assert "of another command: give this one another name" in other.stderr


def test_failures_say_what_to_do(walk: Path) -> None:
    def refusal(**changes: str) -> str:
        typed = words(0, 1)
        for name, value in changes.items():
            typed = [f"{name}={value}" if word.startswith(f"{name}=") else word for word in typed]
        done = commands.qrlsuite(*typed, "--runs", f"runs-{len(changes)}-{len(str(changes))}")
        assert done.returncode in (1, 2), done.stderr
        return done.stderr

    python = sys.executable
    assert "write {seed} where the seed belongs" in refusal(command=f"{python} walk.py 1 100 0")
    assert "invalid literal for int()" in refusal(command=f"{python} walk.py {{seed}} many 0")
    assert "say where its curve is, as in curve=logs/{seed}.csv" in refusal(curve="elsewhere-{seed}.csv")
    assert "its curve ends at step 50 of 100" in refusal(command=f"{python} walk.py {{seed}} 50 0")
    assert "scores are not carried backward: say every=10" in refusal(every="5")
    assert "cannot be started" in refusal(command="no-such-program {seed}")
    words_of_a_shell = [f"{word} ; touch pwned" if "command=" in word else word for word in words()]
    assert commands.qrlsuite(*words_of_a_shell).returncode == 0
    assert not (walk / "pwned").exists()


def test_a_script_is_planned_without_a_measurement_and_not_tuned(walk: Path) -> None:
    entries = [f"script {name} command='walk.py {{seed}}' steps=100 thresholds=20" for name in ("walk", "b")]
    planned = commands.qrlsuite("study", "new", "walks.toml", *entries, "--task", "walks", "--looks", "20")
    assert "at most 40 seeds, of unknown cost\n" in planned.stdout + planned.stderr
    tuned = commands.qrlsuite("tune", entries[0], "--task", "walks", "--vary", "steps=100,200")
    assert "'script walk' is not tuned here: its settings are in its command" in tuned.stderr


def test_a_long_word_is_no_file_and_a_link_is_not_written_through(walk: Path) -> None:
    typed = [f"{word} {'x' * 300}" if "command=" in word else word for word in words(0, 1)]
    typed[typed.index("curve=curve-{seed}.csv")] = "curve=my curves/{seed}.csv"
    (walk / "my curves").mkdir()
    (walk / "my curves" / "0.csv").symlink_to("../curve-0.csv")
    assert commands.qrlsuite(*typed).returncode == 0
    store, secret = the_entry(walk / "runs"), walk / "secret"
    secret.write_text("mine")
    shutil.rmtree(store.seed(0).path)
    [output] = store.path.glob("groups/*/output.txt")
    output.unlink()
    output.symlink_to(secret)
    assert commands.qrlsuite(*typed).returncode == 0
    assert (store.seeds(), secret.read_text()) == ([0], "mine")


def test_no_command_is_started_that_was_found_in_a_results_folder(walk: Path) -> None:
    entry = """
[[entries]]
task = "walks"
model = "script NAME"
[entries.options]
command = "PYTHON walk.py {seed} {steps} PAUSE"
curve = "curve-{seed}.csv"
steps = 100
every = 20
thresholds = [20]
""".replace("PYTHON", sys.executable)
    head = """format_version = 1
name = "walks"
summary = "Which?"
[looks]
looks = [4]
reason = "a test"
"""
    both = entry.replace("NAME", "walk").replace("PAUSE", "0") + entry.replace("NAME", "b").replace(
        "PAUSE", "0.0"
    )
    study = head + both
    (walk / "walks.toml").write_text(study)
    assert commands.qrlsuite("study", "run", "walks.toml", "--workers", "1").returncode == 0
    assert commands.qrlsuite(*words()).returncode == 0
    begun = {path: path.read_text() for path in walk.glob("starts-*.txt")}
    assert len(begun) == 7
    for exported in ("walk", "walks.toml"):
        assert commands.qrlsuite("export", exported, "--out", "out").returncode == 0
    assert commands.qrlsuite("import", "out/walks", "--runs", "third").returncode == 0
    for place in ("out/walks", "out/walks/plan.toml"):
        assert "found in a results folder" in commands.qrlsuite("study", "run", place).stderr
    store = the_entry(walk / "runs")
    shutil.rmtree(store.seed(0).path)
    shutil.rmtree(next(walk.glob("runs/decisions/walks/*/*/seed-10001")))
    kept = store.record().entry("entry.json")
    with pytest.raises(QrlSuiteError, match="found in a results folder"):
        engine_script.words(kept)
    worker = ["--seeds", "0:1", "--epochs", "5"]
    assert commands.start_worker(str(store.path), *worker).wait() == 2
    command = f"{sys.executable} walk.py {{seed}} {{steps}} 0.5"  # of the same files
    other = {"folder": str(walk), "command": command, "steps": 100, "curve": "curve-{seed}.csv"}
    assert commands.start_worker(str(store.path), *worker, "--script", json.dumps(other)).wait() == 2
    for place in ("runs/decisions/walks", "runs/decisions/walks/plan.toml"):
        assert "found in a results folder" in commands.qrlsuite("study", "run", place).stderr
    for typed in (
        ["import", "runs", "--runs", "copy"],
        ["verify", "out", "--rerun", "1"],
        ["leaderboard", "--html", "page.html"],
        ["show", "walks.toml"],
        ["compare", "walks/walk", "walks/walk"],
        ["runs"],
    ):
        commands.qrlsuite(*typed)
    assert {path: path.read_text() for path in walk.glob("starts-*.txt")} == begun
    assert not list(walk.glob("pwned*"))
    published = commands.qrlsuite("verify", "out", "--rerun", "1")
    assert "not repeatable here: a script trained it" in published.stdout + published.stderr
    assert api.load("walk", runs="copy").seeds == (1, 2)


def test_a_number_that_is_half_written_ends_no_run(tmp_path: Path) -> None:
    options = "curve={seed}.csv steps=100 every=10 maximum=1"
    entry = replace(resolve("walks", f"script x command='a {{seed}}' {options}"), folder=tmp_path)
    run, progress = engine_script._Run(entry, 0, tmp_path / "output"), Progress(size=1)
    (tmp_path / "0.csv").write_text("step,score\n10,0.5\n20,9.5")  # of 9.5e-05
    run._look(progress, 1.0)
    assert (progress.epoch, progress.seed_scores) == (2, [0.5])
    (tmp_path / "0.csv").write_text("step,score\n10,0.5\n20,9.5\n30,1")
    with pytest.raises(QrlSuiteError, match="the task's from 0 to 1"):
        run._look(progress, 1.0)


def test_scores_of_another_kind_are_another_task() -> None:
    def task_of(**options: str) -> str:
        settings = " ".join(f"{name}={value}" for name, value in options.items())
        return resolve("cartpole", f"script ppo command='python x.py {{seed}}' {settings}").task.name

    assert task_of() == "cartpole+training"
    assert task_of(curve="a/{seed}/evaluations.npz") == "cartpole+evaluation"
    assert task_of(curve="a/{seed}/0.monitor.csv") == "cartpole+training-mean"
    assert task_of(kind="validation") == "cartpole"
    with pytest.raises(OptionError, match="says that itself"):
        task_of(maximum="500")
    with pytest.raises(OptionError, match="in place of maximum"):
        task_of(maximum="500", goal="below")


def test_what_a_command_names_and_imports_is_its_code(tmp_path: Path) -> None:
    for name, text in {
        "lab/train.py": "import net, numpy, random\nfrom parts.layers import Layer\nfrom src.deep import buffers\n",
        "lab/random.py": "",
        "lab/src/deep/buffers.py": "",
        "lab/net.py": "",
        "lab/parts/__init__.py": "",
        "lab/parts/layers.py": "from . import sizes\n",
        "lab/parts/sizes.py": "",
        "lab/other.py": "",
        "config.yaml": "lr: 1",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    parts = ["lab/parts/__init__.py", "lab/parts/layers.py", "lab/parts/sizes.py"]
    own = ["config.yaml", "lab/net.py", *parts, "lab/random.py", "lab/src/deep/buffers.py"]
    for command in (
        "python lab/train.py --seed {seed} --config=config.yaml",
        "python lab/train.py {seed} config.yaml",
    ):
        files = scripts.code("x", scripts.build("x", {"command": command}), tmp_path)["files"]
        assert list(files) == [*own, "lab/train.py"]
    files = scripts.code("x", scripts.build("x", {"command": "python -m lab.net {seed}"}), tmp_path)["files"]
    assert list(files) == ["lab/net.py"]


def test_a_pattern_finds_the_seed_alone_and_equal_steps_count_once(tmp_path: Path) -> None:
    for name in ("seed-1.csv", "seed-10.csv", "seed-21.csv"):
        (tmp_path / name).write_text("global_step,r\n5,1\n5,2\n9,3\n")
    script = scripts.build("x", {"command": "a {seed}", "curve": "*{seed}*.csv"})
    assert [path.name for path in script.files(1, tmp_path)] == ["seed-1.csv"]
    below = scripts.build("x", {"command": "a {seed}", "curve": "**/seed-{seed}.csv"})
    assert below.files(10, tmp_path) == [tmp_path / "seed-10.csv"]
    read = points.read_run([tmp_path / "seed-1.csv"], "r")
    assert np.column_stack([read.steps, read.scores]).tolist() == [[5, 2], [9, 3]]
