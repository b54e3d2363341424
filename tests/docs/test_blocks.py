"""Python on the pages runs, and the README's plugin is a package that installs and conforms."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.specs import AnsatzSpec
from tests.commands import qrlsuite
from tests.conftest import install_from_source, installed

pytestmark = pytest.mark.usefixtures("forked_workers")
ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {
    "decisions.md": "tests/cli/test_looks.py",
    "plugins.md": "test_plugins.py",
    "statistics.md": "tests/statistics/test_docs.py",
}
"""Pages whose blocks other tests run."""
OWN_FILE = "# my_ansatz.py\n"


def blocks() -> list[Any]:
    found = []
    for page in PAGES:
        texts = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
        found += [
            pytest.param(text, id=f"{page.name}-{number}")
            for number, text in enumerate(texts)
            if page.name not in ELSEWHERE and not text.startswith(OWN_FILE)
        ]
    return found


@pytest.fixture
def results(train: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of a user who has trained an entry of beam6g."""
    entry = train("runs", [0, 1])
    shutil.copytree(entry, tmp_path / "user" / "runs" / "beam6g" / "ENTRY")
    monkeypatch.chdir(tmp_path / "user")
    return tmp_path / "user"


@pytest.mark.parametrize("text", blocks())
def test_a_block_runs(text: str, results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    exec(text, names)
    if "curves" in names:
        table = names["curves"].to_pydict()
        assert table["epoch"] == [1, 2, 3] * 2
        assert len(set(table["__filename"])) == 2
    if "env" in names:
        names["env"].close()


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_what_the_first_lines_print_is_below_them(
    page: str, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / page).read_text()
    code, printed = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", text, re.DOTALL)[0]
    exec(code, {})
    assert capsys.readouterr().out == printed


def test_there_are_blocks_to_run() -> None:
    assert len(blocks()) >= 6


def test_the_readmes_plugin_is_what_its_summary_says() -> None:
    """RX of every input, RY of every weight, and a ring: each qubit has two CZs, the last one with the first."""
    text = (ROOT / "README.md").read_text()
    (code,) = re.findall(rf"```python\n{OWN_FILE}(.*?)```", text, re.DOTALL)
    space: dict[str, Any] = {}
    exec(compile(code, "README.md", "exec"), space)
    specs: list[AnsatzSpec] = []
    space["register_ansatzes"](specs.append)
    assert specs[0].summary == "RX re-uploading, RY weights and a ring of CZs"
    circuit = space["ry_ring"](4, 1, None)
    gates = [(step.gate, step.wires) for step in circuit.operations]
    assert gates[:2] == [("RX", (0,)), ("RY", (0,))]
    assert [qubits for name, qubits in gates if name == "CZ"] == [(0, 1), (1, 2), (2, 3), (3, 0)]


def test_the_readmes_plugin_is_a_package(tmp_path: Path) -> None:
    text = (ROOT / "README.md").read_text()
    (code,) = re.findall(rf"```python\n{OWN_FILE}(.*?)```", text, re.DOTALL)
    (project,) = re.findall(r"```toml\n# pyproject.toml\n(.*?)```", text, re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= 22, "twenty lines, give or take"
    (tmp_path / "runs").mkdir()  # of commands that were typed here
    (tmp_path / "my_ansatz.py").write_text(code)
    (tmp_path / "pyproject.toml").write_text(project)
    site = tmp_path / "site"
    install_from_source(site, tmp_path)
    checked = qrlsuite("check", "ansatz:ry-ring", env=installed(site), cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout + checked.stderr
