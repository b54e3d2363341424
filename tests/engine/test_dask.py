"""Engine `dask`: a real scheduler and real workers on one results folder, killed at any moment."""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest

from qrlsuite import api
from qrlsuite.engine.status import survey
from qrlsuite.engine.where import Where
from qrlsuite.errors import QrlSuiteError
from qrlsuite.plugins.engines.dask import DaskEngine, DaskOptions
from qrlsuite.results import claims
from qrlsuite.results.store import EntryStore
from tests.commands import Command, qrlsuite, start
from tests.conftest import TINY, Train, most_epochs, results
from tests.engine.stress import compare, undisturbed

pytest.importorskip("distributed", reason="pip install '.[dask]'")

import dask
import psutil

from tests.engine.cluster import Cluster

SEEDS = 3
ENDLESS = 1_000_000


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with Cluster(tmp_path / "cluster") as started:
        yield started


@pytest.fixture
def task(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def words(task: Path, runs: Path, scheduler: str, epochs: int, *more: str) -> list[str]:
    given = ["run", "--task", str(task), "--model", "mlp", "--set", "width=16", "--seeds", str(SEEDS)]
    given += ["--epochs", str(epochs), "--workers", str(SEEDS), "--runs", str(runs)]
    return [*given, "--engine", f"dask scheduler={scheduler}", *more]


def environment(seconds: float = 0.3) -> dict[str, str]:
    """Checkpoints of less than a second, and a scheduler that is gone is noticed soon."""
    more = {"QRLSUITE_CHECKPOINT_SECONDS": str(seconds), "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "2s"}
    return {**os.environ, **more}


def only_line(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("qrlsuite: ")]
    return line


def further(entry: Path, run: Command) -> int:
    """Wait until an epoch more has been trained; returns how many there are."""
    before = most_epochs(entry) if entry.exists() else 0
    while not entry.exists() or most_epochs(entry) <= before:
        assert run.poll() is None, run.communicate()[1]
        time.sleep(0.02)
    return most_epochs(entry)


def ended(entry: Path) -> None:
    """Wait until nobody trains seeds of an entry: workers end with their task, and tasks with the command."""
    while claims.living(EntryStore(entry)):
        time.sleep(0.02)


@pytest.mark.parametrize("kills", [3, pytest.param(100, marks=pytest.mark.long)])
def test_killed_again_and_again(kills: int, task: Path, cluster: Cluster, tmp_path: Path) -> None:
    """Workers above all; the client and the scheduler once in the short form, and now and then in the long one."""
    dice, runs = random.Random(4), tmp_path / "killed"
    straight = undisturbed(task, tmp_path / "straight", SEEDS, 1, SEEDS)
    entry = runs / "tiny" / straight.name
    for _ in range(3):
        cluster.add()
    run = start(*words(task, runs, cluster.address, ENDLESS), env=environment())
    for kill in range(1, kills + 1):
        further(entry, run)
        if kill == 1:
            (status,) = survey(runs)
            assert ENDLESS in {g.progress.get("epochs") for g in status.groups if g.state == "running"}
            while sorted(seed for group in status.groups for seed in group.seeds) != list(range(SEEDS)):
                assert run.poll() is None, run.communicate()[
                    1
                ]  # others are further before the last one begins
                (status,) = survey(runs)
        time.sleep(dice.uniform(0, 0.3))
        cluster.kill(dice.choice(cluster.workers))
        if dice.random() < 0.2 and len(cluster.workers) < 4:
            cluster.add()  # one more than was killed
        if dice.random() < 0.8 or len(cluster.workers) < 2:
            cluster.add()  # else there is one less from now on
        if kill % 33 == 1:
            further(entry, run)
            run.kill()
            run.wait()
            ended(entry)
            run = start(*words(task, runs, cluster.address, ENDLESS), env=environment())
        if kill % 33 == 2:
            further(entry, run)
            cluster.kill_all()
            _, said = run.communicate()
            assert re.search(
                rf"^qrlsuite: .*the Dask scheduler at {cluster.address} is gone; fin", said, re.M
            ), said
            assert run.returncode == 2
            assert "Traceback" not in said
            ended(entry)
            cluster.start_scheduler()
            for _ in range(3):
                cluster.add()
            run = start(*words(task, runs, cluster.address, ENDLESS), env=environment())
    further(entry, run)
    run.send_signal(signal.SIGINT)
    assert run.wait() == 130
    assert claims.claims(EntryStore(entry)) == [], "the workers have saved and ended before the command does"
    assert len(list(entry.glob("dask-*"))) == 1 + kills // 33, "a killed command leaves its mark"
    epochs = most_epochs(entry) + 1
    done = qrlsuite(*words(task, runs, cluster.address, epochs), env=environment())
    assert done.returncode == 0, done.stderr
    compare(undisturbed(task, tmp_path / "straight", SEEDS, epochs, SEEDS), entry, SEEDS, epochs)


def test_ctrl_c_waits_for_workers_that_have_not_claimed_their_seeds(
    task: Path, cluster: Cluster, tmp_path: Path
) -> None:
    for _ in range(SEEDS):
        cluster.add()
    run = start(*words(task, tmp_path / "runs", cluster.address, ENDLESS), env=environment())
    dask_workers = [psutil.Process(worker.pid) for worker in cluster.workers]
    while not any(dask_worker.children() for dask_worker in dask_workers):
        assert run.poll() is None, run.communicate()[1]
        time.sleep(0.002)
    run.send_signal(signal.SIGINT)
    assert run.wait() == 130
    assert not [child for dask_worker in dask_workers for child in dask_worker.children()]


def test_over_tls_from_python(
    task: Path, train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By Dask's own settings."""
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    make = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "1",
        "-subj",
        "/CN=localhost",
    ]
    subprocess.run([*make, "-keyout", str(key), "-out", str(certificate)], check=True, capture_output=True)
    settings = {"ca-file": str(certificate)}
    for role in ("scheduler", "worker", "client"):
        settings |= {f"{role}.cert": str(certificate), f"{role}.key": str(key)}
    tls = {f"distributed.comm.tls.{name}": value for name, value in settings.items()}
    variables = {
        f"DASK_{name.replace('.', '__').replace('-', '_').upper()}": value for name, value in tls.items()
    }
    with Cluster(tmp_path / "cluster", variables, "tls") as cluster, dask.config.set(tls):
        assert cluster.address.startswith("tls://127.0.0.1:")
        cluster.add(variables)
        engine = Where.create(f"dask scheduler={cluster.address}", 2)
        done = api.train(
            str(task), "mlp", options={"width": 16}, seeds=2, epochs=2, engine=engine, runs=tmp_path / "runs"
        )
        refused = pytest.raises(QrlSuiteError, match=f"no Dask scheduler answers at {cluster.address} .*TLS")
        with dask.config.set({"distributed.comm.tls.ca-file": None}), refused:
            DaskEngine(DaskOptions(cluster.address)).connected(1).__enter__()
    straight = train("straight", [0, 1], 2)
    assert [results(Path(done.folder), seed) for seed in (0, 1)] == [
        results(straight, seed) for seed in (0, 1)
    ]


def test_what_the_engine_starts_itself_listens_here_only() -> None:
    with DaskEngine(DaskOptions()).connected(1):
        own = psutil.Process()
        listening = {
            connection.laddr.ip
            for process in (own, *own.children(recursive=True))
            for connection in process.net_connections("inet")
            if connection.status == psutil.CONN_LISTEN
        }
    assert listening == {"127.0.0.1"}


def shadow(folder: Path, distribution: str, version: str) -> dict[str, str]:
    """Return the environment of a process that finds another version of a distribution."""
    site = folder / f"{distribution}-{version}"
    info = site / f"{distribution}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
    return {"PYTHONPATH": str(site)}


def start_without_suite(cluster: Cluster) -> subprocess.Popen[bytes]:
    """Start a worker in a Python that has everything but the suite."""
    site = cluster.folder / "site"
    site.mkdir()
    for folder in sys.path:
        if folder.endswith("site-packages"):
            for path in Path(folder).iterdir():
                if "qrlsuite" not in path.name and not (site / path.name).exists():
                    (site / path.name).symlink_to(path)
    program = "from distributed.cli.dask_worker import main; main()"
    given = [cluster.address, "--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0", "--no-nanny"]
    return subprocess.Popen(
        [sys.executable, "-S", "-c", program, *given, "--local-directory", str(site.parent)],
        env={**os.environ, "PYTHONPATH": str(site)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def test_a_worker_without_the_suite(task: Path, cluster: Cluster, tmp_path: Path) -> None:
    bare = start_without_suite(cluster)
    try:
        line = only_line(qrlsuite(*words(task, tmp_path / "runs", cluster.address, 2), env=environment()))
        assert line == (
            f"qrlsuite: a worker of the Dask scheduler at {cluster.address} has no qrlsuite: install the same "
            "version there"
        )
        assert bare.poll() is None, "nothing was sent to it that it cannot read"
    finally:
        bare.kill()
        bare.wait()


def test_a_worker_that_does_not_see_the_folder(task: Path, cluster: Cluster, tmp_path: Path) -> None:
    """Each process has a folder of its own at that path."""
    cluster.add()
    runs = Path("/proc/self/cwd/runs")
    done = qrlsuite(*words(task, runs, cluster.address, 2), env=environment(), cwd=tmp_path)
    line = only_line(done)
    (entry,) = (tmp_path / "runs" / "tiny").iterdir()
    assert line == (
        f"qrlsuite: the Dask worker on {os.uname().nodename} does not see {runs / 'tiny' / entry.name}: share the "
        "results folder with the cluster, or repeat the command there without --engine, and take over its results here "
        "with `qrlsuite import FOLDER`"
    )
    assert not [*entry.glob("seed-*")]


def test_what_a_worker_says_is_said(task: Path, cluster: Cluster, tmp_path: Path) -> None:
    cluster.add()
    given = {**os.environ, "QRLSUITE_CHECKPOINT_SECONDS": "soon"}
    line = only_line(qrlsuite(*words(task, tmp_path / "runs", cluster.address, 2), env=given))
    assert line.endswith("QRLSUITE_CHECKPOINT_SECONDS=soon is not a number of seconds")


def test_a_scheduler_of_another_version(task: Path, tmp_path: Path) -> None:
    with Cluster(tmp_path / "cluster", env=shadow(tmp_path, "distributed", "2020.1.0")) as cluster:
        line = only_line(qrlsuite(*words(task, tmp_path / "runs", cluster.address, 1)))
    ours = metadata.version("distributed")
    assert line == (
        f"qrlsuite: the Dask scheduler at {cluster.address} has distributed 2020.1.0 instead of {ours}: Dask needs the "
        "same on both sides"
    )


@pytest.mark.parametrize("scheduler", ["tcp://127.0.0.1:1", "nowhere://x"])
def test_a_scheduler_that_is_not_there(scheduler: str, task: Path, tmp_path: Path) -> None:
    line = only_line(qrlsuite(*words(task, tmp_path / "runs", f"{scheduler} timeout=0.5", 1)))
    assert line.startswith(f"qrlsuite: no Dask scheduler answers at {scheduler} within 0.5 s (")
    assert line.endswith("): is it running there, and can this machine reach it?")
