"""Python on the pages runs, and the plugins by path conform."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.algorithm import Algorithm
from tests.commands import qrlsuite
from tests.conftest import Train

pytestmark = pytest.mark.usefixtures("forked_workers")
ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {
    "decisions.md": "tests/cli/test_looks.py",
    "statistics.md": "tests/statistics/test_docs.py",
}
"""Pages whose blocks other tests run."""
PRINTED = (("index.md", 0),)
"""Blocks whose output is on the page, too."""
OWN_FILE = ("# ring.py\n", "# mine.py\n", "# swirl.py\n", "# agent.py\n")


def blocks() -> list[Any]:
    found = []
    for page in PAGES:
        texts = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
        found += [
            pytest.param(text, id=f"{page.name}-{number}")
            for number, text in enumerate(texts)
            if page.name not in ELSEWHERE
            and (page.name, number) not in PRINTED
            and not text.startswith(OWN_FILE)
        ]
    return found


@pytest.fixture
def results(train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of a user who has trained an entry of beam6g."""
    entry = train("runs", [0, 1])
    shutil.copytree(entry, tmp_path / "user" / "runs" / "beam6g" / "ENTRY")
    monkeypatch.chdir(tmp_path / "user")
    return tmp_path / "user"


BLOCKS = blocks()
assert len(BLOCKS) >= 6


@pytest.mark.parametrize("text", BLOCKS)
def test_a_block_runs(text: str, results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    exec(text, names)
    if "curves" in names:
        table = names["curves"].to_pydict()
        assert table["epoch"] == [1, 2, 3] * 2
        assert len(set(table["__filename"])) == 2
    if "env" in names:
        names["env"].close()


def test_what_the_first_lines_print_is_below_them(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs/index.md").read_text()
    code, printed = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", text, re.DOTALL)[0]
    exec(code, {})
    assert capsys.readouterr().out == printed


def test_the_ring_is_what_its_summary_says_and_conforms(tmp_path: Path) -> None:
    """RX of every input, RY of every weight, and a ring: each qubit has two CZs, the last one with the first."""
    text = (ROOT / "docs" / "your-circuit.md").read_text()
    (code,) = re.findall(rf"```python\n{OWN_FILE[0]}(.*?)```", text, re.DOTALL)
    space: dict[str, Any] = {}
    exec(compile(code, "your-circuit.md", "exec"), space)
    assert space["ry_ring"].__doc__ == "RX re-uploading, RY weights and a ring of CZs."
    circuit = space["ry_ring"](4, 1)
    gates = [(step.gate, step.wires) for step in circuit.operations]
    assert gates[:2] == [("RX", (0,)), ("RY", (0,))]
    assert [qubits for name, qubits in gates if name == "CZ"] == [(0, 1), (1, 2), (2, 3), (3, 0)]
    (tmp_path / "ring.py").write_text(code)
    checked = qrlsuite("check", "ansatz:ry-ring", "--plugin", "ring.py", cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout + checked.stderr


@pytest.mark.parametrize(
    ("page", "name", "registers"),
    [
        ("plugins", "mine", "ansatz chain, model hybrid"),
        ("your-algorithm", "agent", "algorithm actor-critic"),
        ("your-circuit", "swirl", "ansatz swirl"),
    ],
)
def test_the_plugins_by_path_conform(page: str, name: str, registers: str, tmp_path: Path) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text()
    (code,) = re.findall(rf"```python\n# {name}.py\n(.*?)```", text, re.DOTALL)
    (tmp_path / f"{name}.py").write_text(code)
    checked = qrlsuite("check", f"{name}.py", "--plugin", f"{name}.py", cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert checked.stderr == f"{name}.py: {registers}\n"


def test_the_methods_on_the_page_are_those_of_an_algorithm() -> None:
    table = (
        (ROOT / "docs" / "your-algorithm.md")
        .read_text()
        .partition("| Method | What it does |\n")[2]
        .partition("\n\n")[0]
    )
    assert sorted(re.findall(r"^\| `(\w+)\(", table, re.MULTILINE)) == sorted(
        name for name in vars(Algorithm) if not name.startswith("_")
    )
