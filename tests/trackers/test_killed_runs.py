"""A run that was killed and goes on is one run in every tracker, read back with each tracker's own reader."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from qrlsuite.errors import QrlSuiteError, StoreError
from qrlsuite.plugins.trackers import common
from qrlsuite.results.store import EntryStore
from qrlsuite.testing.tracker import RECORD, RUN
from tests.commands import start_worker
from tests.conftest import Hold, Train, most_epochs
from tests.trackers.test_tensorboard import read as read_tensorboard

Curves = dict[str, list[tuple[int, float]]]


def read_wandb(folder: Path) -> Curves:
    """Read the offline run below a seed's folder with `wandb leet`: there must be one, of the seed's id."""
    [run] = folder.glob("wandb/offline-run-*")
    assert run.name.endswith((folder / "tracking-id").read_text())
    command = [str(Path(sys.executable).parent / "wandb"), "leet", "inspect", "--json", str(run)]
    env = {**os.environ, "WANDB_ERROR_REPORTING": "false"}
    printed = subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout
    curves: Curves = {}
    for line in printed.splitlines():
        record = json.loads(line)
        if record["type"] == "history":
            for name, value in record["history"]["item"].items():
                if not name.startswith("_"):
                    curves.setdefault(name, []).append((int(record["history"]["step"]["num"]), value))
    return curves


def read_mlflow(folder: Path) -> Curves:
    """Read the runs of a results folder with MLflow's client: a seed has one, which is finished."""
    from qrlsuite.plugins.trackers.mlflow import TAG, MlflowClient

    client = MlflowClient(tracking_uri=f"sqlite:///{folder.parents[2] / 'mlflow.db'}")
    [experiment] = [found for found in client.search_experiments() if found.name == folder.parents[1].name]
    name = (folder / "tracking-id").read_text()
    [run] = client.search_runs([experiment.experiment_id], f"tags.`{TAG}` = '{name}'")
    assert run.info.status == "FINISHED"
    assert run.data.params["model.width"] == "16"
    histories = {name: client.get_metric_history(run.info.run_id, name) for name in run.data.metrics}
    return {name: [(point.step, point.value) for point in points] for name, points in histories.items()}


TRACKED = f"""
import sys
from pathlib import Path
from qrlsuite import registry, specs

folder = Path("runs", "task", "entry", "seed-0007")
folder.mkdir(parents=True)
run = {RUN} | {{"folder": str(folder), "epochs": 0, "history": []}}
tracker = specs.resolve(registry.get(specs.TrackerSpec, sys.argv[1]).factory)(None)
tracker.run_started(run)
tracker.epoch_finished(run, {RECORD})
tracker.run_finished(run)
"""


@pytest.mark.long
@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_nothing_is_sent_over_the_network(name: str, tmp_path: Path) -> None:
    with socket.create_server(
        ("127.0.0.1", 0)
    ) as proxy:  # whatever wants to reach a host connects to it first
        proxy.setblocking(False)
        address = f"http://127.0.0.1:{proxy.getsockname()[1]}"
        # nothing else: both send less where they find that they are tested
        kept = {name: os.environ[name] for name in ("PATH", "HOME", "PYTHONPATH") if name in os.environ}
        env = {**kept, "HTTP_PROXY": address, "HTTPS_PROXY": address, "ALL_PROXY": address}
        subprocess.run([sys.executable, "-c", TRACKED, name], env=env, cwd=tmp_path, check=True)
        with pytest.raises(BlockingIOError):
            proxy.accept()
    assert list(
        tmp_path.glob(
            "runs/task/entry/seed-0007/wandb/offline-run-*" if name == "wandb" else "runs/mlflow.db"
        )
    )


@pytest.mark.parametrize(
    "others", [("wandb",), pytest.param(("wandb", "mlflow"), marks=pytest.mark.long)], ids="-".join
)
def test_a_killed_run_goes_on_as_the_same_run(others: tuple[str, ...], train: Train) -> None:
    entry = train("runs", [0, 1], epochs=1)  # without trackers: they are given its epoch when it goes on
    env = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("WANDB_", "MLFLOW_"))},
        "QRLSUITE_TRACK": "\n".join(["tensorboard", *others]),
        "QRLSUITE_CHECKPOINT_SECONDS": "0",
    }
    words = (str(entry), "--seeds", "0:2", "--epochs")
    process = start_worker(*words, "1000000", env=env)
    while most_epochs(entry) < 4:
        assert process.poll() is None
        time.sleep(0.2)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    ids = [(entry / f"seed-000{seed}" / "tracking-id").read_text() for seed in (0, 1)]

    epochs = most_epochs(entry) + 2
    assert start_worker(*words, str(epochs), env=env).wait() == 0
    [progress] = entry.glob("groups/*/progress.json")
    assert json.loads(progress.read_text())["warnings"] == []
    for seed, name in enumerate(ids):
        folder = entry / f"seed-000{seed}"
        assert (folder / "tracking-id").read_text() == name
        curves = {name: {"wandb": read_wandb, "mlflow": read_mlflow}[name](folder) for name in others}
        expected = EntryStore(entry).seed(seed).read().curve
        for tracked in curves.values():
            assert [step for step, _ in tracked["validation/score"]] == list(range(1, epochs + 1))
            assert [score for _, score in tracked["validation/score"]] == pytest.approx(list(expected))
            assert {name: [step for step, _ in points] for name, points in tracked.items()} == {
                name: [step for step, _ in points] for name, points in curves["wandb"].items()
            }
        shown = read_tensorboard(folder / "tensorboard")
        assert shown.keys() == curves["wandb"].keys()
        last = [step for step, _ in curves["wandb"]["training/loss"]][-2:]
        assert [step for step, _ in shown["training/loss"]][-2:] == last


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_folder_that_cannot_be_written_stops_no_run(
    name: str, train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("QRLSUITE_TRACK", f"{name}={tmp_path / 'file' / 'folder'}")
    entry = train("runs", [0, 1], epochs=2)
    assert all(EntryStore(entry).seed(seed).read().finished for seed in (0, 1))
    [message] = [record.getMessage() for record in caplog.records if f"'{name}'" in record.getMessage()]
    assert "failed in run_started and is left out: NotADirectoryError" in message


def test_the_end_of_the_service_of_wandb_stops_no_run(train: Train, hold: Hold) -> None:
    entry = train("runs", [0], epochs=1)
    other = f"3-{os.getpid()}-unix-/gone"  # as a notebook leaves it that has runs of its own
    env = {**hold.environment, "QRLSUITE_TRACK": "wandb", "WANDB_SERVICE": other}
    process = start_worker(str(entry), "--seeds", "0:1", "--epochs", "4", env=env)
    hold.wait(process)
    [service] = _children(process.pid, "wandb-core")
    os.kill(service, signal.SIGKILL)
    hold.release()
    assert process.wait() == 0
    assert EntryStore(entry).seed(0).read().finished
    [progress] = entry.glob("groups/*/progress.json")
    [warning] = json.loads(progress.read_text())["warnings"]
    assert "tracker 'wandb' failed in epoch_finished and is left out" in warning


def _children(parent: int, name: str) -> list[int]:
    """Return the processes that a process started and that run a program of this name."""
    command = ["ps", "-ww", "-e", "-o", "pid=,ppid=,comm="]  # ww: whole names, however narrow the terminal is
    rows = [line.split(None, 2) for line in subprocess.check_output(command, text=True).splitlines()]
    return [int(pid) for pid, ppid, program in rows if int(ppid) == parent and Path(program).name == name]


def test_wandb_asks_nobody_to_log_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from qrlsuite.plugins.trackers.wandb import WandB

    monkeypatch.setenv("WANDB_MODE", "online")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    with pytest.raises(QrlSuiteError, match="nobody is logged in: type `wandb login` first"):
        WandB()


@pytest.mark.parametrize("content", ["", "/../../x", "0123456g", "0123456\n"])
def test_a_name_that_is_none_is_refused(content: str, tmp_path: Path) -> None:
    """It becomes part of a pattern of folders that are deleted, and of a filter."""
    (tmp_path / "tracking-id").write_text(content)
    with pytest.raises(StoreError, match="tracking-id does not hold the 8 characters"):
        common.identity({"folder": str(tmp_path)})
