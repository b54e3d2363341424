"""A tiny task, and training on it in this process: what most tests of the core need."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hypothesis
import pytest

from tests.commands import FORKED, Command, popen
from tests.commands import HANGS as HANGS  # tests take it from here

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every command compiles the suite again
sys.dont_write_bytecode = False
for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # as in workers; more would wait for each other, at twice the cost
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job begins with it ignored,
# and so would every command that a test interrupts

for variable in [name for name in os.environ if name.startswith("QRLSUITE_") and name != "QRLSUITE_CACHE"]:
    del os.environ[variable]  # a user's results folder, trackers, strictness
os.environ["PATH"] = (
    f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # as in an active environment
)
# else every run builds hypothesis's table of characters anew
os.environ.setdefault(
    "HYPOTHESIS_STORAGE_DIRECTORY", str(Path(__file__).parents[1] / ".pytest_cache" / "hypothesis")
)
# how long drawing examples takes says nothing: no test depends on the machine's speed
hypothesis.settings.register_profile(
    "suite", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("suite")
os.environ["QRLSUITE_LOAD_PLUGINS"] = ""  # whatever is installed; tests name the packages that they install


@pytest.fixture(scope="session", autouse=True)
def _elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Run everything in an empty folder: the checkout's `runs/` is the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("elsewhere"))
        yield


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A running headless Chromium, the installed one, never a download; skips where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install '.[dev]'")
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"needs a browser on the path ({', '.join(BROWSERS)}): apt-get install chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


LONGEST = (
    "journeys/test_journeys.py",
    "testing/test_builtins.py",
    "cli/test_new.py",
    "cli/test_cli.py",
    "leaderboard/test_report_page.py",
    "engine/test_dask.py",
    "trackers/test_killed_runs.py",
    "cli/test_study.py",
    "docs/test_use.py",
    "engine/test_command.py",
)
"""Begun first, for a file is one process's: the last one would be waited for by an idle core."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ranks = {Path(__file__).parent / name: rank for rank, name in enumerate(LONGEST)}
    assert all(path.exists() for path in ranks), "LONGEST names a file that is no longer there"
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))


def pytest_collection_finish() -> None:
    """Fresh processes of probes and checks in the tests' own process are forks."""
    for name in ("qrlsuite.engine.probe", "qrlsuite.testing.fresh"):
        if name in sys.modules:
            sys.modules[name].subprocess = FORKED  # type: ignore[attr-defined]


TINY = """
format_version = 1
name = "tiny"
summary = "A beam management task of seconds, for tests"
default_algorithm = "ddqn"

[environment]
name = "beam6g"
[environment.options]
antennas = [[[1.5, 1.0], [1.0, 0.0]], [[1.5, 5.0], [-1.0, 0.0]], [[4.5, 3.0], [0.0, 1.0]]]
degree = 3
steps = 20

[protocol]
seeds = 4
epochs = 3
environments = 4
interactions = 60
validation_episodes = 5

[ranking]
epsilons = [0.6, 0.8]
deltas = [0.5, 0.75]
reference = { epsilon = 0.6, delta = 0.5 }
horizons = [180]
"""


def cases(table: str) -> list[list[str]]:
    r"""Divide each line of a table at ` => `; `\n` stands for the end of a line."""
    return [line.replace("\\n", "\n").split(" => ") for line in table.strip().splitlines()]


POLE = """
format_version = 1
name = "pole"
summary = "CartPole of 30 steps"
[environment]
name = "cartpole"
[environment.options]
steps = 30
[protocol]
environments = 4
interactions = 60
validation_episodes = 5
[score]
source = "return"
max_return = 30
[ranking]
epsilons = [0.5]
deltas = [0.5]
reference = { epsilon = 0.5, delta = 0.5 }
horizons = [180]
"""
"""Episodes that end at different times."""


def install(site: Path, name: str, code: str, requires: str = "qrlsuite>=0.1") -> None:
    """Leave a distribution with one plugin module as pip would."""
    (site / f"{name}.py").write_text(code)
    info = site / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\nRequires-Dist: {requires}\n"
    )
    (info / "entry_points.txt").write_text(f"[qrlsuite]\nmain = {name}\n")


BUILD = """
import os, sys
from setuptools import build_meta
wheels, *folders = map(os.path.abspath, sys.argv[1:])
for folder in folders:
    os.chdir(folder)
    build_meta.build_wheel(wheels)
"""
"""Builds wheels as pip does, all of them in one process."""


def install_from_source(site: Path, *folders: Path) -> None:
    """Build the distributions of these folders, and leave what is in their wheels in `site`, a new folder."""
    site.mkdir()
    words = [sys.executable, "-c", BUILD, str(site), *map(str, folders)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=HANGS)
    assert done.returncode == 0, done.stdout + done.stderr
    for wheel in list(site.iterdir()):
        with zipfile.ZipFile(wheel) as content:
            content.extractall(site)
        wheel.unlink()


def installed(site: Path) -> dict[str, str]:
    """Return the environment in which the distributions of a folder are found, and no others."""
    names = [distribution.name for distribution in metadata.distributions(path=[str(site)])]
    own = ",".join(name for name in names if name != "qrlsuite")
    return {**os.environ, "PYTHONPATH": str(site), "QRLSUITE_LOAD_PLUGINS": own}


HOLDING = """
import os
import shutil
import signal
import time
from pathlib import Path
from types import SimpleNamespace

from qrlsuite import hookimpl, specs

SITE = Path(__file__).parent


@hookimpl
def register_trackers(register):
    register(specs.TrackerSpec("hold", "Holds a worker", f"{__name__}:Holding", always=True))


class Holding:
    def __init__(self, target):
        pass

    def epoch_finished(self, run, record):
        mark = SITE / f"held-{os.getpid()}"
        if mark.exists() or record["epoch"] < int(os.environ.get("HOLD_IN_EPOCH", "1")):
            return
        asked = []
        before = signal.signal(signal.SIGTERM, lambda *given: asked.append(given))
        mark.touch()
        while not asked and not (SITE / "released").exists():
            time.sleep(0.01)
        signal.signal(signal.SIGTERM, before)
        if asked:
            before(*asked[0])
"""


class Hold:
    """A plugin that holds each worker at the end of its first epoch, until it is stopped or all are released.

    `HOLD_IN_EPOCH` of a command's environment names a later epoch.
    However fast or slow a machine is, what is to be interrupted has begun and has not ended.

    Attributes
    ----------
    environment:
        For the commands whose workers are to be held.
    """

    def __init__(self, folder: Path) -> None:
        self.site = folder / "holding"
        self.site.mkdir()
        install(self.site, "holding", HOLDING)
        self.environment = installed(self.site)
        self._seen = 0

    def wait(self, *processes: subprocess.Popen[str] | Command, workers: int = 1) -> None:
        """Return when so many more workers are held: all of them, where they are then to be stopped."""
        while len(list(self.site.glob("held-*"))) < self._seen + workers:
            assert all(process.poll() is None for process in processes), "it ended before a worker was held"
            time.sleep(0.02)
        self._seen = len(list(self.site.glob("held-*")))

    def release(self) -> None:
        """Let all workers go on."""
        (self.site / "released").touch()


@pytest.fixture
def hold(tmp_path: Path) -> Iterator[Hold]:
    held = Hold(tmp_path)
    yield held
    held.release()


@pytest.fixture
def tiny_task(tmp_path: Path) -> str:
    """The path of a task file whose episodes (20 steps) do not end with its epochs (15 steps per environment)."""
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return str(path)


@pytest.fixture
def forked_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that the local engine starts from the test's own process are forks, and begin at once."""
    from qrlsuite.engine import local

    stand_in = SimpleNamespace(
        Popen=popen, DEVNULL=subprocess.DEVNULL, TimeoutExpired=subprocess.TimeoutExpired
    )
    monkeypatch.setattr(local, "subprocess", stand_in)


Train = Callable[..., Path]
"""Trains seeds as one group in this process, and returns the entry's folder."""


def trainer(task: str, root: Path) -> Train:
    """Return a function that trains seeds as one group in this process, and returns the entry's folder."""

    def run(
        folder: str,
        seeds: Sequence[int],
        epochs: int = 3,
        model: str = "mlp",
        settings: Sequence[str] = ("width=16",),
    ) -> Path:
        from qrlsuite.engine.worker import train_group
        from qrlsuite.experiment.entry import resolve
        from qrlsuite.results.store import EntryStore

        store = EntryStore.create(root / folder, resolve(task, " ".join([model, *settings])))
        train_group(store.path, seeds, epochs)
        return store.path

    return run


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 48 kB of its own: twelve pages, two seeds need nine at once."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=48k", "tmpfs", str(path)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"a small tmpfs cannot be mounted here: {done.stderr.strip()}")
    yield path
    subprocess.run(["umount", "-l", str(path)], check=True)


@pytest.fixture
def train(tiny_task: str, tmp_path: Path) -> Train:
    return trainer(tiny_task, tmp_path)


@pytest.fixture(scope="session")
def _once(tmp_path_factory: pytest.TempPathFactory) -> Train:
    """Train in a folder of the session, what was trained there already aside; returns the entry's folder."""
    root, made = tmp_path_factory.mktemp("kept"), {}
    (root / "tiny.toml").write_text(TINY)

    def train(*given: Any, **named: Any) -> Path:
        key = str((given, named))
        if key not in made:
            made[key] = trainer(str(root / "tiny.toml"), root)(str(len(made)), *given, **named)
        return made[key]

    return train


@pytest.fixture
def kept(_once: Train, tmp_path: Path) -> Train:
    """Return a copy of an entry's folder, which is trained once for all tests."""

    def copy(folder: str, *given: Any, **named: Any) -> Path:
        entry = _once(*given, **named)
        place = tmp_path / folder / entry.parent.name / entry.name
        return Path(shutil.copytree(entry, place))

    return copy


def results(entry: Path, seed: int) -> tuple[bytes, bytes]:
    """The bytes that must not depend on anything but the seed: its curve and its trained agent."""
    folder = entry / f"seed-{seed:04d}"
    return (folder / "epochs.parquet").read_bytes(), (folder / "final.safetensors").read_bytes()


def most_epochs(entry: Path) -> int:
    """How far the farthest seed of an entry has come; 0 where none has begun."""
    from qrlsuite.results.store import EntryStore

    store = EntryStore(entry)
    return max((len(store.seed(seed).epochs()) for seed in store.seeds()), default=0)


def golden(name: str) -> Any:
    """Numbers that the paper's released code printed."""
    with gzip.open(Path(__file__).parent / "golden" / f"{name}.json.gz") as file:
        return json.load(file)
