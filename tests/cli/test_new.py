"""`qrlsuite new plugin`: every kind of package installs, passes its own test, and is clean for linters."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from qrlsuite import __version__, scaffold
from qrlsuite.cli import main
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment.task import parse
from qrlsuite.scaffold import Kind
from tests import commands
from tests.commands import Command, start
from tests.conftest import HANGS, install_from_source, installed
from tests.core.test_own import ALL, RING

ROOT = Path(__file__).parents[2]


def qrlsuite(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """Run a command in this process; returns exit code, output, errors."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["qrlsuite", *words])
        with pytest.raises(SystemExit) as stopped:
            main()
    out, err = capsys.readouterr()
    return int(stopped.value.code or 0), out, err


def run(*words: str, **more: object) -> str:
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=HANGS, **more)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout + done.stderr
    return str(done.stdout)


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a new package of every kind, all of them installed into its subfolder `site`."""
    folder = tmp_path_factory.mktemp("packages")
    for kind in Kind:
        scaffold.write(scaffold.package(f"acme-{kind}", kind), folder)
    install_from_source(folder / "site", *(folder / f"acme-{kind}" for kind in Kind))
    return folder


@pytest.mark.long
def test_new_packages_pass_their_own_tests(packages: Path) -> None:
    words = ["-q", "-W", "error", "--import-mode=importlib", "-p", "no:cacheprovider"]
    words += [f"acme-{kind}" for kind in Kind]
    tests = Command(words, installed(packages / "site"), packages, program="pytest")
    out, _ = tests.communicate()
    assert tests.returncode == 0, out
    assert "9 passed" in out


def test_a_package_of_a_file_registers_what_the_file_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its circuits, options and classes are those of the file; hooks and specs stay as they are written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(ALL)
    (tmp_path / "ring.py").write_text(
        "from qrlsuite import register, specs\n" + RING + "\n\nregister(ring)\n"
    )
    hooks = """
from qrlsuite import hookimpl, specs
from qrlsuite.circuit import Circuit

@hookimpl
def register_ansatzes(register):
    options = "qrlsuite.plugins.circuits.ansatz:NoOptions"
    register(specs.AnsatzSpec("hooked", "By a hook", options, "hooked:build"))

def build(qubits, layers, options):
    return Circuit(qubits)
"""
    (tmp_path / "hooked.py").write_text(hooks)
    for words in (["--from", "mine.py"], ["acme-ring", "--from", "ring.py"], ["--from", "hooked.py"]):
        code, out, err = qrlsuite(capsys, "new", "plugin", *words)
        assert code == 0, err
    assert "  qrlsuite run --task beam6g --model vqc-native --set ansatz=hooked --quick" in out
    assert (tmp_path / "hooked" / "src" / "hooked" / "__init__.py").read_text() == hooks
    written = (tmp_path / "acme-ring" / "src" / "ring" / "ring.py").read_text()
    assert "register(" not in written
    assert written.startswith("import typing\n\nimport pydantic\nfrom qrlsuite import specs\n")
    names = ("mine", "acme-ring", "hooked")
    for name in names:
        assert tomllib.loads((tmp_path / name / "pyproject.toml").read_text())["project"]["name"] == name
    install_from_source(tmp_path / "site", *(tmp_path / name for name in names))
    environment = installed(tmp_path / "site")
    rows = json.loads(start("list", "--json", env=environment).communicate()[0])
    assert sorted((row["distribution"], row["name"]) for row in rows if row["distribution"] in names) == [
        ("acme-ring", "ring"),
        ("hooked", "hooked"),
        *(("mine", name) for name in ("http-net2", "line-walk", "quantum", "slow", "two-rings")),
    ]
    checked = start("check", "ansatz:ring", env=environment, cwd=tmp_path / "site").communicate()[0]
    assert "all 14 rules hold" in checked, checked
    words = ["run", "slow http-net2 lr=0.1", "--task", "line-walk", "--seeds", "1", "--epochs", "1"]
    trained = start(*words, env=environment, cwd=tmp_path)
    assert trained.communicate()[0] is not None
    assert trained.returncode == 0


def test_new_packages_are_found_and_say_where_they_come_from(packages: Path) -> None:
    rows = json.loads(start("list", "--json", env=installed(packages / "site")).communicate()[0])
    found = {(row["kind"], row["name"]) for row in rows if row["distribution"].startswith("acme-")}
    assert found == {
        ("ansatzes", "acme-ansatz"),
        ("models", "acme-model"),
        ("environments", "acme-environment"),
        ("tasks", "acme-environment"),
        ("algorithms", "acme-algorithm"),
        ("tasks", "acme-task"),
        ("trackers", "acme-tracker"),
    }


@pytest.mark.parametrize("kind", Kind)
def test_the_commands_of_a_readme_run(packages: Path, kind: Kind, tmp_path: Path) -> None:
    """Word for word, but that seeds, epochs and workers are fewer; its tests and checks run elsewhere."""
    lines = (packages / f"acme-{kind}" / "README.md").read_text().splitlines()
    shown = [line for line in lines if line.startswith("qrlsuite show ")]
    trained = [line for line in lines if line.startswith("qrlsuite run ")]
    assert trained
    fewer = " --seeds 2 --epochs 1 --workers 1"
    for line in (*shown, *(line + fewer for line in trained)):
        done = commands.qrlsuite(*line.split()[1:], env=installed(packages / "site"), cwd=tmp_path)
        assert done.returncode == 0, f"{line}: {done.stderr}"
    assert len([*tmp_path.glob("runs/*/*/seed-*/run.json")]) == 2
    if kind is Kind.tracker:
        assert len((tmp_path / "epochs.csv").read_text().splitlines()) == 2


def test_new_packages_are_clean(packages: Path) -> None:
    folders = [str(packages / f"acme-{kind}") for kind in Kind]
    src = f"src = {[f'{folder}/src' for folder in folders]}"
    ruff = (sys.executable, "-m", "ruff")
    run(*ruff, "check", "--isolated", "--config", src, "--select", "E,F,W,I,UP,B,RUF", *folders)
    run(*ruff, "format", "--isolated", "--check", *folders)


def test_new_packages_have_their_types(packages: Path) -> None:
    """With the options, folder and cache of `make test`, which has just checked the suite that they import."""
    package = Path(sys.prefix, "package", "qrlsuite")
    package.mkdir(parents=True, exist_ok=True)
    mapped = [ROOT / name for name in ("plugins", "leaderboard", "tasks")]
    for source in (*(ROOT / "qrlsuite").iterdir(), *mapped):
        link = package / source.name
        if not link.is_symlink() or link.readlink() != source:
            link.unlink(missing_ok=True)
            link.symlink_to(source)
    words = ["--config-file", str(ROOT / "pyproject.toml"), *(f"{packages}/acme-{kind}/src" for kind in Kind)]
    env = {**os.environ, "MYPYPATH": "package"}
    run(sys.executable, "-m", "mypy", *words, cwd=sys.prefix, env=env)


def test_the_command_writes_a_package_and_says_what_to_type_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = qrlsuite(
        capsys, "new", "plugin", "acme-ring", "--kind", "ansatz", "--out", str(tmp_path / "a b")
    )
    assert code == 0
    folder = tmp_path / "a b" / "acme-ring"
    written = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert written == {
        "README.md",
        "pyproject.toml",
        "src/acme_ring/__init__.py",
        "src/acme_ring/ansatz.py",
        "src/acme_ring/py.typed",
        "tests/test_acme_ring.py",
    }
    assert all(path in out for path in written)
    assert (
        out.index("pip install -e") < out.index("\n  pytest\n") < out.index("qrlsuite check ansatz:acme-ring")
    )
    assert f"cd '{folder}'" in out
    readme = (folder / "README.md").read_text()
    assert "qrlsuite run --task beam6g --model vqc-native --set ansatz=acme-ring --quick" in readme
    assert [path.name for path in folder.parent.iterdir()] == ["acme-ring"]  # no draft is left


def test_json_names_what_was_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["new", "plugin", "qrlsuite-csv", "--kind", "tracker", "--out", str(tmp_path), "--json"]
    code, out, _ = qrlsuite(capsys, *words)
    assert code == 0
    content = json.loads(out)
    assert content["folder"] == str(tmp_path / "qrlsuite-csv")
    assert "src/qrlsuite_csv/__init__.py" in content["files"]
    assert "--track csv=epochs.csv" in content["next"][-1]


RANDOM = """
import sys
from qrlsuite.experiment.entry import resolve
from qrlsuite.training.evaluation import references
for name in sys.argv[1:]:
    print(references(resolve(name, "mlp"), episodes=500)[-1].scores.mean())
"""


@pytest.fixture(scope="module")
def random_scores(packages: Path) -> dict[Kind, float]:
    """The score of random actions in the tasks that new packages register."""
    kinds = (Kind.task, Kind.environment)
    words = (sys.executable, "-c", RANDOM, *(f"acme-{kind}" for kind in kinds))
    return dict(zip(kinds, map(float, run(*words, env=installed(packages / "site")).split())))


@pytest.mark.parametrize(("kind", "stated"), [(Kind.task, 0.11), (Kind.environment, 0.65)])
def test_a_new_tasks_thresholds_begin_above_random_actions(
    packages: Path, kind: Kind, stated: float, random_scores: dict[Kind, float]
) -> None:
    measured = random_scores[kind]
    text = (packages / f"acme-{kind}" / f"src/acme_{kind}/task.toml").read_text()
    assert f"Random actions have the score {stated}, the best policy known has 1.0." in text
    assert measured == pytest.approx(stated, abs=0.03)
    ranking = tomllib.loads(text)["ranking"]
    lowest, highest = 1 - max(ranking["epsilons"]), 1 - min(ranking["epsilons"])
    assert lowest == pytest.approx(stated + 0.3 * (1 - stated), abs=0.001)
    assert measured + 0.05 < lowest < highest < 1
    checked = commands.qrlsuite("check", f"task:acme-{kind}", env=installed(packages / "site"))
    assert checked.returncode == 0


@pytest.mark.parametrize("kind", [Kind.task, Kind.environment])
@pytest.mark.parametrize(
    ("scores", "unit", "expected", "reference"),
    [
        (("0.2", "0.7"), "epsilon", [0.325, 0.35, 0.4, 0.45, 0.55, 0.65], 0.35),
        (("-500", "-80"), "threshold", [-374, -290, -206, -164, -122, -101], -122),
        (("10000", "10010"), "threshold", [10003, 10005, 10007, 10008, 10009, 10009.5], 10009),
    ],
)
def test_a_range_sets_the_thresholds(
    kind: Kind,
    scores: tuple[str, str],
    unit: str,
    expected: list[float],
    reference: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Relative scores within 0 and 1, otherwise returns, which need no maximum."""
    words = ["new", "plugin", "acme-x", "--kind", str(kind), "--out", str(tmp_path), "--range", *scores]
    code, _, err = qrlsuite(capsys, *words)
    assert code == 0, err
    file = tmp_path / "acme-x" / "src" / "acme_x" / "task.toml"
    text = file.read_text()
    ranking = tomllib.loads(text)["ranking"]
    assert ranking[f"{unit}s"] == pytest.approx(expected)
    assert ranking["reference"] == {unit: pytest.approx(reference), "delta": 0.75}
    assert ("max_return = 200" in text) == (unit == "epsilon" and kind is Kind.task)
    beam6g = '[environment]\nname = "beam6g"\n\n'  # acme-x is not installed
    assert parse(re.sub(r"\[environment\](.|\n)*(?=\[protocol\])", beam6g, text), str(file)).name == "acme-x"


@pytest.mark.parametrize(
    ("kind", "scores", "message"),
    [
        (Kind.task, (1.0, 0.2), "--range 1 0.2: give two numbers"),
        (Kind.task, (0.2, 0.2), "--range 0.2 0.2: give two numbers"),
        (Kind.environment, (float("nan"), 1.0), "--range nan 1: give two numbers"),
        (Kind.environment, (0.0, float("inf")), "--range 0 inf: give two numbers"),
        (
            Kind.ansatz,
            (0.2, 1.0),
            "--range: a new ansatz has no task; it goes with --kind task or environment",
        ),
    ],
)
def test_what_is_no_range_is_refused(kind: Kind, scores: tuple[float, float], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        scaffold.package("acme-x", kind, scores)


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "acme-ring").mkdir()
    (tmp_path / "acme-ring" / "notes.txt").write_text("mine")
    code, _, err = qrlsuite(capsys, "new", "plugin", "acme-ring", "--kind", "model", "--out", str(tmp_path))
    assert code == 2
    assert "exists already and is left unchanged" in err
    assert [path.name for path in (tmp_path / "acme-ring").iterdir()] == ["notes.txt"]


def test_a_folder_that_cannot_be_written_is_an_error_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(QrlSuiteError, match="acme-ring cannot be written: "):
        scaffold.write(scaffold.package("acme-ring", Kind.task), tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("Acme_Ring", Kind.ansatz, "cannot be the name of a package: .*for example acme-ring"),
        ("../escape", Kind.ansatz, "cannot be the name of a package: .*for example escape"),
        ("a" * 41, Kind.ansatz, "40 characters at most"),
        ("", Kind.ansatz, "'' cannot be the name of a package"),
        ("x\n", Kind.ansatz, "cannot be the name of a package"),
        ("class", Kind.ansatz, "'class' is a word of Python; for example acme-class"),
        ("json", Kind.ansatz, "'json' is a word of Python"),
        ("torch", Kind.model, "a module 'torch' is installed already"),
        ("qrlsuite", Kind.model, "a module 'qrlsuite' is installed already"),
        ("mlp", Kind.model, "there is a model 'mlp' already .`qrlsuite list models`.*acme-mlp"),
        ("qrlsuite-iqp", Kind.ansatz, "there is an ansatz 'iqp' already"),
        ("acrobot", Kind.environment, "there is a task 'acrobot' already"),
    ],
)
def test_unusable_names_are_refused_with_one_that_would_do(name: str, kind: Kind, message: str) -> None:
    with pytest.raises(QrlSuiteError, match=message):
        scaffold.package(name, kind)


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
    assert f'["qrlsuite{found}"]' in scaffold.package("acme-x", Kind.model).files["pyproject.toml"]
