"""`--plugin PATH`: commands, workers and later readers of a plugin that is a file, as a user types and edits it."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.commands import qrlsuite, start, start_worker
from tests.conftest import HANGS, TINY, results
from tests.core.test_own import ALL, RING

ENTRY = "vqc-native ansatz=ring qubits=2 layers=1"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "tiny.toml").write_text(TINY)
    (tmp_path / "ring.py").write_text(RING)
    return tmp_path


def run(
    folder: Path, *words: str, plugin: str = "ring.py", code: int = 0, epochs: int = 2, entry: str = ENTRY
) -> str:
    """Train two seeds, and return what was said."""
    seeds = () if "--seeds" in words else ("--seeds", "2")
    command = ["run", entry, "--task", "tiny.toml", *seeds, "--epochs", str(epochs), "--workers", "2", *words]
    done = qrlsuite(*command, *(("--plugin", plugin) if plugin else ()), cwd=folder)
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which two seeds were trained."""
    made = tmp_path_factory.mktemp("once")
    (made / "tiny.toml").write_text(TINY)
    (made / "ring.py").write_text(RING)
    run(made)
    return made


@pytest.fixture
def trained(once: Path, tmp_path: Path) -> Path:
    """The same, in a copy."""
    return Path(shutil.copytree(once, tmp_path / "once"))


def entry_of(folder: Path) -> Path:
    (found,) = (folder / "runs" / "tiny").iterdir()
    return found


def test_train_edit_and_read_without_the_file(folder: Path) -> None:
    said = run(folder)
    assert said.startswith("ring.py: ansatz ring\n")
    entry = entry_of(folder)
    before = results(entry, 0)
    (copy,) = entry.glob("plugins/*/ring.py")
    assert copy.read_text() == RING

    ring = folder / "ring.py"
    ring.write_text(RING.replace("A ring.", "The same, in other words."))
    assert "0 of 2 seeds" not in run(folder)
    ring.write_text(RING.replace('"RX"', '"RY"'))
    refused = run(folder, code=2)
    assert "the circuit of ansatz 'ring' of ring.py has changed" in refused
    assert "--fresh trains anew" in refused
    assert len(refused.splitlines()) == 2
    assert "are now in" in run(folder, "--fresh")
    aside = next(path for path in entry.parent.iterdir() if "@" in path.name)
    assert results(aside, 0) == before
    ring.write_text(RING)
    run(folder, "--fresh")
    assert results(entry, 0) == before

    ring.rename(folder / "elsewhere")
    board = qrlsuite("leaderboard", "--task", "tiny", "--format", "csv", cwd=folder)
    assert board.returncode == 0
    assert board.stdout.count("ansatz=ring") == 2
    assert qrlsuite("show", entry.name, cwd=folder).returncode == 0
    both = [path.name for path in sorted(entry.parent.iterdir())]
    assert qrlsuite("compare", *both, cwd=folder).returncode == 0
    for words in (("evaluate", entry.name, "--episodes", "2"), ("show", entry.name, "--identity")):
        lacking = qrlsuite(*words, cwd=folder)
        assert lacking.returncode == 2
        path = f"runs/tiny/{entry.name}"
        assert lacking.stderr.endswith(
            f"; {path} has a copy of ring.py: if you trust it, add --plugin {path}\n"
        )
        assert qrlsuite(*words, "--plugin", path, cwd=folder).returncode == 0
    assert f"has a copy of ring.py: if you trust it, add --plugin runs/tiny/{entry.name}" in run(
        folder, plugin="", code=2
    )
    run(folder, "--seeds", "3", plugin=str(entry))
    assert len(list(entry.glob("seed-*"))) == 3
    assert results(entry, 0) == before


def test_a_copy_that_was_altered_is_not_imported(trained: Path) -> None:
    entry = entry_of(trained)
    (copy,) = entry.glob("plugins/*/ring.py")
    copy.write_text("open('it-ran', 'w')\n" + RING)
    (trained / "ring.py").rename(trained / "elsewhere")
    for words in (("leaderboard",), ("show", entry.name), ("runs",)):
        assert qrlsuite(*words, cwd=trained).returncode == 0
    assert "is not what it was when it was copied" in run(trained, "--seeds", "3", plugin=str(entry), code=2)
    assert not list(trained.rglob("it-ran"))
    (trained / "elsewhere").rename(trained / "ring.py")
    run(trained, "--seeds", "3")
    assert copy.read_text() == RING, "a command with the plugin makes the copy anew"


def test_a_worker_finds_the_plugin_in_the_entrys_folder_alone(folder: Path) -> None:
    """As a queue starts one, on a machine without the file."""
    run(folder, "--seeds", "1")
    (folder / "ring.py").rename(folder / "elsewhere")
    worker = start_worker(str(entry_of(folder)), "--seeds", "1:3", "--epochs", "2")
    assert worker.wait() == 0, worker.communicate()
    assert json.loads((entry_of(folder) / "seed-0002" / "run.json").read_text())["status"] == "finished"


def test_an_import_takes_the_copy_along(trained: Path) -> None:
    entry, theirs = entry_of(trained), trained / "theirs"
    (trained / "runs").rename(theirs)
    (trained / "ring.py").rename(trained / "elsewhere")
    given = theirs / "tiny" / entry.name
    lacking = qrlsuite("import", str(given), cwd=trained)
    assert (lacking.returncode, "if you trust it, add --plugin " in lacking.stderr) == (2, True)
    taken = qrlsuite("import", str(given), "--plugin", str(given), cwd=trained)
    assert taken.returncode == 0, taken.stderr
    shutil.rmtree(theirs)
    played = qrlsuite("evaluate", entry.name, "--episodes", "2", "--plugin", str(entry), cwd=trained)
    assert played.returncode == 0, played.stderr


def test_a_record_that_names_other_files_is_refused(trained: Path) -> None:
    entry = entry_of(trained)
    (trained / "evil.py").write_text("open('it-ran', 'w')\n")
    path = entry / "entry.json"
    record = json.loads(path.read_text())
    for place in ("../../../evil.py", str(trained / "evil.py"), "plugins/../../../../evil.py"):
        record["plugins"] = {code: [place] for code in record["plugins"]}
        path.write_text(json.dumps(record))
        assert f"{place!r}: no copy of a plugin; restore the file" in run(trained, plugin=str(entry), code=2)
    assert not (trained / "it-ran").exists()
    run(trained, "--seeds", "3", code=2)


@pytest.mark.parametrize("engine", ["local", "command"])
def test_a_killed_run_goes_on_to_the_same_bytes(folder: Path, engine: str) -> None:
    """The file is gone in between: workers have the entry's copy, and the entry says where it is."""
    (folder / "mine.py").write_text(ALL)
    words = ("run", "http-net2", "--task", "tiny.toml", "--seeds", "2", "--workers", "2", "--engine", engine)
    command = start(*words, "--epochs", "100000", "--plugin", "mine.py", cwd=folder)
    deadline = time.monotonic() + HANGS
    while not [
        path for path in folder.glob("runs/tiny/*/seed-*/epochs.jsonl") if path.read_text().count("\n") > 1
    ]:
        assert command.poll() is None, command.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    command.send_signal(signal.SIGINT if engine == "command" else signal.SIGKILL)
    command.wait()
    entry = entry_of(folder)
    (folder / "mine.py").rename(folder / "elsewhere")
    while qrlsuite("runs", "--json", cwd=folder).stdout.count('"training"') and time.monotonic() < deadline:
        time.sleep(0.05)
    epochs = 1 + max(len(path.read_text().splitlines()) for path in entry.glob("seed-*/epochs.jsonl"))
    run(folder, "--engine", engine, epochs=epochs, plugin=str(entry), entry="http-net2")
    shutil.move(folder / "runs", folder / "killed")
    shutil.move(folder / "elsewhere", folder / "mine.py")
    run(folder, epochs=epochs, plugin="mine.py", entry="http-net2")
    for seed in (0, 1):
        assert results(entry_of(folder), seed) == results(folder / "killed" / "tiny" / entry.name, seed)


def test_an_environment_a_model_and_an_algorithm_of_one_file_in_processes_of_their_own(folder: Path) -> None:
    """Nothing is forked here: the command, its worker and the probe are started as a user's are."""
    (folder / "mine.py").write_text(ALL)
    words = ["run", "slow http-net2 scale=2 lr=0.02", "--task", "line-walk", "--seeds", "2", "--epochs", "1"]
    command = [sys.executable, "-P", "-m", "qrlsuite", *words, "--workers", "1", "--plugin=mine.py"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "mine.py: ansatz two-rings" not in done.stderr
    assert done.stderr.startswith(
        "mine.py: environment line-walk, model http-net2, model quantum, algorithm slow"
    )
    (entry,) = (folder / "runs" / "line-walk").iterdir()
    record = json.loads((entry / "entry.json").read_text())
    owners = {part["role"]: part["distribution"] for part in record["code"]["parts"]}
    assert owners == {"environment": "mine.py", "algorithm": "mine.py", "model": "mine.py"}
    assert json.loads((entry / "seed-0000" / "run.json").read_text())["status"] == "finished"


def test_a_study_and_a_task_name_their_plugins(folder: Path) -> None:
    (folder / "code").mkdir()
    (folder / "ring.py").rename(folder / "code" / "ring.py")
    (folder / "tiny.toml").write_text('plugins = ["code/ring.py"]\n' + TINY)
    assert run(folder, plugin="").startswith("ring.py: ansatz ring\n")
    (folder / "tiny.toml").write_text(TINY)
    (folder / "two.toml").write_text(
        f"""
        format_version = 1
        name = "two"
        summary = "Two circuits"
        plugins = ["code/ring.py"]
        [[entries]]
        task = "tiny.toml"
        model = "{ENTRY}"
        [[pictures]]
        kind = "curves"
        """
    )
    words = ("study", "run", "two.toml", "--seeds", "2", "--epochs", "2")
    done = qrlsuite(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert len(list((folder / "runs" / "tiny").iterdir())) == 1, "the entry is the same"


def test_a_board_says_that_a_file_was_edited_between_its_entries(trained: Path) -> None:
    words = ("--task", "tiny", "--runs", "runs")
    other = ENTRY.replace("layers=1", "layers=2")
    run(trained, entry=other)
    first, second = (f"vqc-native qubits=2 layers={layers} ansatz=ring" for layers in (1, 2))
    compare = ("compare", first, second, *words)
    said = "ring.py was edited between these entries"
    before = qrlsuite(*compare, cwd=trained)
    assert (before.returncode, said in before.stdout) == (0, False), before.stderr
    (trained / "ring.py").write_text(RING.replace('"RX"', '"RY"'))
    run(trained, "--fresh", entry=other)
    assert said in " ".join(qrlsuite(*compare, cwd=trained).stdout.split())
    board = " ".join(qrlsuite("leaderboard", *words, cwd=trained).stdout.split())
    assert f"{said} (its text is not the same): " in board
    assert " | " in board


WALK = """
import gymnasium
import numpy as np


class Walk(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 5
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.left -= 1
        return np.zeros(1, np.float32), float(action) * 0.5, self.left == 0, False, {}
"""


def test_entries_of_an_edited_environment_are_not_compared(tmp_path: Path) -> None:
    (tmp_path / "walk.py").write_text(WALK)
    words = ("--task", "walk", "--plugin", "walk.py", "--seeds", "2", "--epochs", "1", "--workers", "1")
    first = qrlsuite("run", "mlp width=2", *words, cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    (tmp_path / "walk.py").write_text(WALK.replace("* 0.5", "* 0.25"))
    assert qrlsuite("run", "mlp width=3", *words, cwd=tmp_path).returncode == 0
    refused = qrlsuite("compare", "mlp width=2", "mlp width=3", *words[:4], cwd=tmp_path)
    assert refused.returncode == 2
    assert "the code of environment 'walk' was edited between" in refused.stderr
    board = qrlsuite("leaderboard", *words[:4], "--format", "json", cwd=tmp_path)
    (section,), (left_out,) = (json.loads(board.stdout)[each] for each in ("sections", "refused"))
    assert len(section["rows"]) == 1
    assert "the code of environment 'walk' was edited between" in left_out
    drawn = qrlsuite("plot", "curves", *words[:4], cwd=tmp_path)
    assert drawn.returncode == 2
    assert (
        "their scores cannot be compared; train the one of the earlier code again with --fresh"
        in drawn.stderr
    )
    assert qrlsuite("run", "mlp width=2", *words, "--fresh", cwd=tmp_path).returncode == 0
    compared = qrlsuite("compare", "mlp width=2", "mlp width=3", *words[:4], cwd=tmp_path)
    assert compared.returncode == 0, compared.stderr


def test_a_projects_folder_means_its_package_and_agents_say_where_its_copy_is(tmp_path: Path) -> None:
    (tmp_path / "acme/src/walk").mkdir(parents=True)
    (tmp_path / "acme/src/walk/__init__.py").write_text(WALK)
    words = ("run", "mlp width=2", "--task", "walk", "--seeds", "1", "--epochs", "1", "--workers", "1")
    done = qrlsuite(*words, "--plugin", "acme", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    asked = ("evaluate", "mlp width=2", "--task", "walk", "--episodes", "1")
    refused = qrlsuite(*asked, cwd=tmp_path)
    assert refused.returncode == 2
    copy = refused.stderr.split("if you trust it, add --plugin ")[1].strip()
    assert qrlsuite(*asked, "--plugin", copy, cwd=tmp_path).returncode == 0


def test_a_control_of_a_circuit_without_one_is_refused_with_the_page(folder: Path) -> None:
    said = run(folder, entry=f"{ENTRY} entangled=mean-field", code=2)
    assert "give its function a parameter `entangled`: docs/controls.md" in said


def test_power_reads_curves_without_the_plugin(trained: Path) -> None:
    done = qrlsuite("power", "vqc-native", "--task", "tiny", "--draws", "20", cwd=trained)
    assert done.returncode == 0, done.stderr
    assert "Core-hours are not known without the plugin of " in done.stdout


def test_the_hash_of_a_study_with_looks_covers_the_code(folder: Path) -> None:
    words = ("--task", "tiny.toml", "--plugin", "ring.py")
    looks = "2,4 first_seed=200 reason=a-test"
    done = qrlsuite("study", "new", "s.toml", ENTRY, "mlp width=4", *words, "--looks", looks, cwd=folder)
    assert done.returncode == 0, done.stderr
    shown = json.loads(qrlsuite("show", "s.toml", "--json", "--plugin", "ring.py", cwd=folder).stdout)
    again = qrlsuite("study", "new", "again.toml", ENTRY, "mlp width=4", *words, "--looks", looks, cwd=folder)
    assert again.returncode == 0, again.stderr
    ring = folder / "ring.py"
    ring.write_text(RING.replace('"RX"', '"RY"'))
    for command in (("study", "run"), ("show",)):
        edited = qrlsuite(*command, "s.toml", cwd=folder)
        assert edited.returncode == 2
        assert "is not what it was when the study was written, and its hash covers it" in edited.stderr
    ring.write_text(RING)
    assert qrlsuite("study", "run", "s.toml", cwd=folder).returncode == 0
    begun = qrlsuite("show", "s.toml", cwd=folder).stdout
    assert f"hash {shown['hash']}, first seed begun" in begun
    for entry in (folder / "runs" / "decisions" / "s" / "tiny").glob("*vqc*"):
        shutil.rmtree(entry)  # as after an interruption, where only the other entry has seeds
    ring.write_text(RING.replace('"RX"', '"RY"'))
    other = qrlsuite("study", "run", "s.toml", cwd=folder)
    assert other.returncode == 2
    assert "is not what it was when the study was written" in other.stderr


def test_other_commands_take_it_too(folder: Path) -> None:
    for words, expected in (
        (("show", "ansatz", "ring"), "distribution: ring.py"),
        (("list", "ansatzes"), "A ring.  [ring.py]"),
        (("list", "plugins"), "ring.py"),
        (("check", "ring"), "rules hold"),
        (("check", "ring.py"), "rules hold"),
        (("show", "ring", "--identity"), "circuit"),
    ):
        done = qrlsuite(*words, "--plugin", "ring.py", cwd=folder)
        assert done.returncode == 0, done.stderr
        assert expected in done.stdout
        assert done.stderr == "ring.py: ansatz ring\n"
    first = qrlsuite("--plugin", "ring.py", "list", "ansatzes", cwd=folder)
    assert "[ring.py]" in first.stdout
    for words in (("run", "--help"), ("study", "run", "--help"), ("--help",), ("check", "-h")):
        assert "--plugin PATH" in qrlsuite(*words, cwd=folder).stdout


def test_a_plugin_by_path_may_add_commands(folder: Path) -> None:
    (folder / "hello.py").write_text(
        "from qrlsuite import hookimpl\n\n@hookimpl\ndef register_commands(app):\n"
        "    @app.command('hello')\n    def hello() -> None:\n        print('hello')\n"
    )
    done = qrlsuite("hello", "--plugin", "hello.py", cwd=folder)
    assert (done.stdout, done.stderr) == ("hello\n", "hello.py: commands alone\n")
