"""A stranger's package: built, installed beside the suite's wheel, used, ranked, and uninstalled again."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from tests.commands import Command, qrlsuite
from tests.conftest import HANGS
from tests.docs.test_plugins import PAGES
from tests.docs.test_release import SUITE

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
TINY = ("--seeds", "1", "--epochs", "1", "--workers", "1")
PIP = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check")


def environment() -> dict[str, str]:
    """Return an environment in which everything that is installed is loaded."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "QRLSUITE_LOAD_PLUGINS")}


def run(*words: str | Path, cwd: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=HANGS,
    )
    assert done.returncode == code, f"{words}\n{done.stdout}{done.stderr}"
    return done


class Installation:
    """A virtual environment with the suite and the package from wheels; heavy packages are borrowed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.python = folder / "venv" / "bin" / "python"
        run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
        sources = folder / "sources"
        junk = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
        for name in SUITE:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            more: dict[str, Any] = {"ignore": junk} if copy is shutil.copytree else {}
            (sources / "qrlsuite").mkdir(parents=True, exist_ok=True)
            copy(ROOT / name, sources / "qrlsuite" / name, **more)
        shutil.copytree(Path(__file__).parent / "acme-qrl", sources / "acme-qrl", ignore=junk)
        packages = (sources / "qrlsuite", sources / "acme-qrl")
        wheels = folder / "wheels"
        run(
            sys.executable,
            "-m",
            "pip",
            "wheel",
            *PIP,
            "--no-build-isolation",
            "-w",
            wheels,
            *packages,
            cwd=folder,
        )
        self.pip("install", *PIP, "--no-compile", *wheels.glob("*.whl"))
        # after pip has run, which would otherwise take the borrowed packages for installed ones
        site = Path(
            run(
                self.python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder
            ).stdout.strip()
        )
        (site / "borrowed.pth").write_text(f"{self._borrowed()}\n")
        self.site = site

    def _borrowed(self) -> Path:
        """Make a folder of links to what is installed beside the suite, without other packages' plugins."""
        borrowed = self.folder / "borrowed"
        borrowed.mkdir()
        for place in (path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")):
            plugins = {
                Path(str(found.locate_file(file))).relative_to(place).parts[0]
                for found in metadata.distributions(path=[place])
                if found.entry_points.select(group="qrlsuite")
                for file in found.files or []
                if Path(os.path.normpath(str(found.locate_file(file)))).is_relative_to(place)
            }
            for path in Path(place).iterdir():
                if path.name not in plugins and not (borrowed / path.name).exists():
                    (borrowed / path.name).symlink_to(path)
        return borrowed

    def pip(self, *words: str | Path) -> None:
        run(sys.executable, "-m", "pip", "--python", self.python, *words, cwd=self.folder)

    def script(self, *words: str) -> str:
        """Run the installed command as a shell does; returns what it prints."""
        return run(self.folder / "venv" / "bin" / "qrlsuite", *words, cwd=self.folder).stdout

    def qrlsuite(self, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        """Run a command in a fork of a process of this installation."""
        done = qrlsuite(*words, env=environment(), cwd=self.folder, python=str(self.python))
        assert done.returncode == code, f"{words}\n{done.stdout}{done.stderr}"
        return done

    def listed(self) -> dict[str, set[str]]:
        """Return the names that are registered by distributions other than the suite, by kind."""
        found: dict[str, set[str]] = {}
        for row in json.loads(self.qrlsuite("list", "--json").stdout):
            if row["distribution"] == "acme-qrl":
                found.setdefault(row["kind"], set()).add(row["name"])
        return found


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installation:
    return Installation(tmp_path_factory.mktemp("stranger"))


def test_the_package_is_found_without_a_line_changed_in_the_suite(installed: Installation) -> None:
    found = run(
        installed.python, "-P", "-c", "import qrlsuite; print(qrlsuite.__file__)", cwd=installed.folder
    )
    assert Path(found.stdout.strip()).is_relative_to(installed.site), "the suite must come from its wheel"
    assert installed.listed() == {
        "ansatzes": {"rzz-ring"},
        "circuit_backends": {"damped"},
        "environments": {"channel-hop"},
        "models": {"waves"},
        "rules": {"half"},
        "tasks": {"channel-hop"},
        "trackers": {"acme-log"},
    }
    assert installed.script("rzz-cost", "--qubits", "3", "--layers", "2") == "12\n"
    assert "RZZ" in installed.qrlsuite("show", "ansatz", "rzz-ring", "qubits=3").stdout


def test_the_scaffold_is_in_the_wheel(installed: Installation) -> None:
    (installed.folder / "following.py").write_text("def following(qubits, layers): ...\n")
    installed.qrlsuite("new", "plugin", "acme-next", "--from", "following.py")
    assert (installed.folder / "acme-next" / "src" / "following" / "__init__.py").exists()


def test_it_passes_its_own_test(installed: Installation) -> None:
    """As its author runs it; the slow kinds are left to `qrlsuite check acme-qrl`, with the same rules."""
    shutil.copytree(Path(__file__).parent / "acme-qrl" / "tests", installed.folder / "tests")
    words = ["-q", "-W", "error", "-p", "no:cacheprovider", "tests", "-k", "waves or half or log"]
    tests = Command(words, environment(), installed.folder, str(installed.python), program="pytest")
    assert "3 passed" in tests.communicate()[0]


@pytest.fixture(scope="module")
def ranked(installed: Installation) -> Path:
    """The page's two entries of 20 seeds, as it trains them."""
    budget = ("--seeds", "20", "--epochs", "12", "--workers", "1", "--runs", "ranked")
    for model in ("waves", "mlp"):
        installed.qrlsuite("run", "--task", "channel-hop", "--model", model, *budget)
    return installed.folder / "ranked"


def test_the_commands_of_the_page_run(installed: Installation, ranked: Path) -> None:
    """Pages of plugins, in their order; `new` and installing have tests of their own."""
    shutil.copytree(ranked, installed.folder / "runs")
    page = "".join((ROOT / "docs" / f"{page}.md").read_text() for page in PAGES)
    files = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", page, re.DOTALL))
    assert set(files) == {"mine.py", "agent.py"}
    for name, code in files.items():
        (installed.folder / name).write_text(code)
    blocks = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    lines = [shlex.split(line) for line in "".join(blocks).splitlines()]
    outputs = {}
    for program, *words in lines:
        if program == "qrlsuite" and words[0] != "new":
            more = ["--workers", "1"] if words[0] == "run" else []
            outputs[" ".join(words)] = installed.qrlsuite(*words, *more).stdout
    assert len(outputs) > 10
    checked = outputs["check acme-qrl"]
    for title in ("ansatz 'rzz-ring'", "circuit backend 'damped'", "rule 'half'", "tracker 'acme-log'"):
        assert title in checked
    assert "rules hold" in checked
    assert len((installed.folder / "scores.txt").read_text().splitlines()) == 4  # 2 seeds of 2 epochs


def test_its_backend_computes_a_model(installed: Installation) -> None:
    words = (
        "run",
        "--task",
        "channel-hop",
        "--model",
        "vqc-damped",
        "--set",
        "ansatz=rzz-ring",
        "--set",
        "qubits=2",
    )
    done = installed.qrlsuite(*words, "--set", "strength=0.1", *TINY, "--runs", "circuits", "--json")
    summary = json.loads(done.stdout)
    assert summary["seeds"] == 1
    assert "ansatz=rzz-ring" in summary["label"]
    assert "strength=0.1" in summary["label"]


@pytest.mark.usefixtures("ranked")
def test_it_is_ranked_and_stays_ranked_when_it_is_uninstalled(installed: Installation) -> None:
    def board() -> dict[str, Any]:
        out = installed.qrlsuite("leaderboard", "--runs", "ranked", "--format", "json").stdout
        (section,) = json.loads(out)["sections"]
        return {row["label"]: row for row in section["rows"]}

    before = board()
    assert set(before) == {"ddqn waves features=24", "ddqn mlp width=64"}
    assert {row["tier"] for row in before.values()} <= {1, 2}  # decided: 20 seeds each
    assert "not installed" not in installed.qrlsuite("leaderboard", "--explain", "--runs", "ranked").stdout

    installed.pip("uninstall", "--yes", "--quiet", "acme-qrl")
    assert installed.listed() == {}
    assert board() == before
    table = " ".join(installed.qrlsuite("leaderboard", "--explain", "--runs", "ranked").stdout.split())
    assert (
        "not installed here, so judged from the stored curves: environment 'channel-hop', model 'waves'"
        in table
    )
    circuits = installed.qrlsuite(
        "leaderboard", "--runs", "circuits", "--format", "markdown", "--explain"
    ).stdout
    assert "ansatz 'rzz-ring'" in circuits
    assert "waves" in installed.qrlsuite("runs", "--runs", "ranked").stdout
    compared = installed.qrlsuite("compare", "waves", "mlp", "--runs", "ranked").stdout
    assert "waves" in compared

    gone = installed.qrlsuite("run", "--task", "channel-hop", "--model", "waves", "--runs", "ranked", code=2)
    assert "unknown task 'channel-hop'" in gone.stderr
    gone = installed.qrlsuite("run", "--task", "beam6g", "--model", "waves", "--runs", "ranked", code=2)
    assert "unknown model 'waves'" in gone.stderr
    installed.qrlsuite("run", "--task", "cartpole", "--model", "mlp", *TINY, "--runs", "others")
