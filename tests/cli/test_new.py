"""`qrlsuite new plugin`: a file's package installs, passes its own test, and is clean for linters."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from qrlsuite import __version__, scaffold
from qrlsuite.cli import main
from qrlsuite.errors import QrlSuiteError
from tests import commands
from tests.commands import Command, start
from tests.conftest import HANGS, install_from_source, installed
from tests.core.test_own import ALL, RING

HOOKED = """
from pathlib import Path

from qrlsuite import hookimpl, specs
from qrlsuite.circuit import Circuit

files = ["data/task.toml"]


@hookimpl
def register_ansatzes(register):
    options = "qrlsuite.plugins.circuits.ansatz:NoOptions"
    register(specs.AnsatzSpec("hooked", "By a hook", options, "hooked:build"))


@hookimpl
def register_tasks(register):
    register(specs.TaskSpec("of-acme", "A task", str(Path(__file__).parent / "data" / "task.toml")))


@hookimpl
def register_trackers(register):
    register(specs.TrackerSpec("acme-lines", "A line for each epoch", "hooked:Lines"))


class Lines:
    def __init__(self, target):
        self.target = target

    def epoch_finished(self, run, record):
        with Path(self.target or "lines.txt").open("a") as file:
            file.write("an epoch\\n")


def build(qubits, layers, options):
    return Circuit(qubits)
"""
TASK = 'format_version = 1\nname = "of-acme"\nsummary = "A task"\nextends = "cartpole"\n'
NAMES = ("mine", "acme-ring", "hooked")


def qrlsuite(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """Run a command in this process; returns exit code, output, errors."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["qrlsuite", *words])
        with pytest.raises(SystemExit) as stopped:
            main()
    out, err = capsys.readouterr()
    return int(stopped.value.code or 0), out, err


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with packages of three files, all of them installed into its subfolder `site`."""
    folder = tmp_path_factory.mktemp("packages")
    (folder / "mine.py").write_text(ALL)
    (folder / "ring.py").write_text(f"from qrlsuite import register\n{RING.strip()}\n\n\nregister(ring)\n")
    (folder / "data").mkdir()
    (folder / "data" / "task.toml").write_text(TASK)
    (folder / "hooked.py").write_text(HOOKED)
    for name, file in zip(NAMES, ("mine.py", "ring.py", "hooked.py"), strict=True):
        scaffold.write(scaffold.package(folder / file, name), folder)
    install_from_source(folder / "site", *(folder / name for name in NAMES))
    return folder


def test_a_package_of_a_file_registers_what_the_file_did(packages: Path) -> None:
    """Its circuits, options and classes are those of the file; hooks and specs stay as they are written."""
    assert (packages / "hooked" / "src" / "hooked" / "__init__.py").read_text() == HOOKED
    assert (packages / "hooked" / "src" / "hooked" / "data" / "task.toml").read_text() == TASK
    written = (packages / "acme-ring" / "src" / "ring" / "ring.py").read_text()
    assert "register(" not in written
    assert written.startswith("from qrlsuite.circuit import Circuit\n")
    for name in NAMES:
        assert tomllib.loads((packages / name / "pyproject.toml").read_text())["project"]["name"] == name
    rows = json.loads(start("list", "--json", env=installed(packages / "site")).communicate()[0])
    assert sorted((row["distribution"], row["name"]) for row in rows if row["distribution"] in NAMES) == [
        ("acme-ring", "ring"),
        *(("hooked", name) for name in ("acme-lines", "hooked", "of-acme")),
        *(("mine", name) for name in ("http-net2", "line-walk", "quantum", "slow", "two-rings")),
    ]


def test_data_of_any_name_is_listed_in_toml(tmp_path: Path) -> None:
    Path(tmp_path, 'w.n"x').write_text("1")
    Path(tmp_path, "ring.py").write_text(f"files = ['w.n\"x']\n{RING}")
    written = scaffold.package(tmp_path / "ring.py", None).files["pyproject.toml"]
    project = tomllib.loads(written.decode())
    assert project["tool"]["setuptools"]["package-data"] == {"ring": ['**/*.n"x', "py.typed"]}


def test_its_code_is_checked_and_trained(packages: Path, tmp_path: Path) -> None:
    environment = installed(packages / "site")
    checked = start("check", "ansatz:ring", env=environment, cwd=packages / "site").communicate()[0]
    assert "all 13 rules hold" in checked, checked
    words = ["run", "slow http-net2 lr=0.1 scale=2", "--task", "line-walk", "--seeds", "1", "--epochs", "1"]
    done = commands.qrlsuite(*words, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_new_packages_pass_their_own_tests(packages: Path) -> None:
    words = ["-q", "-W", "error", "--import-mode=importlib", "-p", "no:cacheprovider"]
    tests = Command(words, installed(packages / "site"), packages / "acme-ring", program="pytest")
    out, _ = tests.communicate()
    assert tests.returncode == 0, out
    assert "1 passed" in out


def test_the_commands_of_a_readme_run(packages: Path, tmp_path: Path) -> None:
    """Word for word, but that seeds, epochs and workers are fewer; its tests and checks run elsewhere."""
    lines = [line for name in NAMES for line in (packages / name / "README.md").read_text().splitlines()]
    trained = [line for line in lines if line.startswith("qrlsuite run ")]
    assert len(trained) == 9
    for line in trained:
        words = [*shlex.split(line)[1:], "--seeds", "2", "--epochs", "1", "--workers", "1"]
        if any(
            each in line
            for each in ("http-net2", "slow", "line-walk", "ansatz=ring", "of-acme", "acme-lines")
        ):
            done = commands.qrlsuite(*words, env=installed(packages / "site"), cwd=tmp_path)
            assert done.returncode == 0, f"{line}: {done.stderr}"
    assert (tmp_path / "lines.txt").read_text() == "an epoch\n" * 2


def test_new_packages_are_clean(packages: Path) -> None:
    folder = str(packages / "acme-ring")
    for words in (["check", "--select", "E,F,W,I,UP,B,RUF"], ["format", "--check"]):
        command = [sys.executable, "-m", "ruff", words[0], "--isolated", *words[1:], folder]
        done = subprocess.run(command, capture_output=True, text=True, timeout=HANGS)
        assert done.returncode == 0, done.stdout


def test_the_command_writes_a_package_and_says_what_to_type_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ring.py").write_text(RING)
    words = ["new", "plugin", "acme-ring", "--from", "ring.py", "--out", "a b"]
    code, out, err = qrlsuite(capsys, *words)
    assert code == 0, err
    folder = Path("a b", "acme-ring")
    written = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert written == {
        "README.md",
        "pyproject.toml",
        "src/ring/__init__.py",
        "src/ring/ring.py",
        "src/ring/py.typed",
        "tests/test_ring.py",
    }
    assert all(path in out for path in written)
    assert out.index("pip install -e") < out.index("\n  pytest\n") < out.index("qrlsuite check ansatz:ring")
    assert f"cd '{folder}'" in out
    command = "qrlsuite run --task beam6g --model vqc-native --set ansatz=ring --quick"
    assert command in (folder / "README.md").read_text()
    assert [path.name for path in folder.parent.iterdir()] == ["acme-ring"]  # no draft is left
    code, _, err = qrlsuite(capsys, *words)
    assert code == 2
    assert "exists already and is left unchanged" in err
    content = json.loads(qrlsuite(capsys, "new", "plugin", "--from", "ring.py", "--json", "--out", "c")[1])
    assert content["folder"] == "c/ring"
    assert "src/ring/__init__.py" in content["files"]
    assert content["next"][-1] == command


def test_a_folder_that_cannot_be_written_is_an_error_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(QrlSuiteError, match="acme-ring cannot be written: "):
        scaffold.write(scaffold.Package("acme-ring", [], {}), tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Acme_Ring", "cannot be the name of a package: .*for example acme-ring"),
        ("../escape", "cannot be the name of a package: .*for example escape"),
        ("a" * 41, "40 characters at most"),
        ("x\n", "cannot be the name of a package"),
        ("class", "'class' is a word of Python; for example acme-class"),
        ("json", "'json' is a word of Python"),
        ("torch", "a module 'torch' is installed already"),
        ("qrlsuite", "a module 'qrlsuite' is installed already"),
    ],
)
def test_unusable_names_are_refused_with_one_that_would_do(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "ring.py").write_text(RING)
    with pytest.raises(QrlSuiteError, match=message):
        scaffold.package(tmp_path / "ring.py", name)


@pytest.mark.parametrize(
    ("version", "expected"),
    [("0.9.3", ">=0.9,<0.10"), ("1.2.0", ">=1.2,<2"), ("12.0.1", ">=12.0,<13"), (__version__, "")],
)
def test_the_version_range_is_what_stays_compatible(
    version: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("qrlsuite.__version__", version)
    found = scaffold.compatible_versions()
    assert version in SpecifierSet(found)
    assert found == (expected or found)
