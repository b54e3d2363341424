"""`--plugin PATH`: processes of a plugin that is a file; `tests/journeys` types, edits and reads it as a user does."""

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


def entry_of(folder: Path) -> Path:
    (found,) = (folder / "runs" / "tiny").iterdir()
    return found


def test_a_worker_finds_the_plugin_in_the_entrys_folder_alone(folder: Path) -> None:
    """As a queue starts one, on a machine without the file."""
    run(folder, "--seeds", "1")
    (folder / "ring.py").rename(folder / "elsewhere")
    worker = start_worker(str(entry_of(folder)), "--seeds", "1:3", "--epochs", "2")
    assert worker.wait() == 0, worker.communicate()
    assert json.loads((entry_of(folder) / "seed-0002" / "run.json").read_text())["status"] == "finished"


def test_a_record_that_names_other_files_is_refused(folder: Path) -> None:
    run(folder)
    entry = entry_of(folder)
    (folder / "evil.py").write_text("open('it-ran', 'w')\n")
    path = entry / "entry.json"
    record = json.loads(path.read_text())
    for place in ("../../../evil.py", str(folder / "evil.py"), "plugins/../../../../evil.py"):
        record["plugins"] = {code: [place] for code in record["plugins"]}
        path.write_text(json.dumps(record))
        said = run(folder, plugin=str(entry), code=2)
        assert place[:20] in said
        assert "no copy of a plugin; restore the file" in said
    assert not (folder / "it-ran").exists()
    run(folder, "--seeds", "3", code=2)


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


def test_an_environment_that_its_file_registers_with_gymnasium_beside_an_algorithm_of_another(
    folder: Path,
) -> None:
    """Neither file refers to the other, and workers, the probe and the next command need both."""
    (folder / "mine.py").write_text(ALL)
    (folder / "games.py").write_text(
        "import gymnasium\n"
        "from gymnasium.envs.classic_control.cartpole import CartPoleEnv\n\n\n"
        "class Pole(CartPoleEnv):\n    pass\n\n\n"
        'gymnasium.register("own/Pole-v0", entry_point=Pole, max_episode_steps=20)\n'
    )
    both, entry = ("--plugin=games.py", "--plugin=mine.py", "--task=gym:own/Pole-v0"), "slow mlp width=2"
    done = qrlsuite("run", entry, *both, "--seeds=2", "--epochs=1", "--engine=command", cwd=folder)
    assert done.returncode == 0, done.stderr
    (record,) = (json.loads(path.read_text()) for path in folder.glob("runs/*/*/entry.json"))
    (copies,) = record["plugins"].values()
    assert sorted(Path(copy).name for copy in copies) == ["games.py", "mine.py"]
    tuned = qrlsuite("tune", entry, *both, "--seeds=1", "--epochs=1", "--sampler=random trials=1", cwd=folder)
    assert tuned.returncode == 0, tuned.stderr
    assert "slow marks no option for tuning (lr): write --vary" in " ".join(tuned.stderr.split())
    assert f"--plugin {folder / 'games.py'} --plugin {folder / 'mine.py'}" in tuned.stdout
