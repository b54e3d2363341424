"""The commands under "Every command once" run one after the other in an empty folder, on budgets of seconds."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from tests.commands import qrlsuite

ROOT = Path(__file__).parents[2]
SMALL = {
    "run": ("--seeds", "2", "--epochs", "1", "--workers", "1"),
    "evaluate": ("--episodes", "5"),
    "tune": ("--sampler", "random trials=1", "--seeds", "2", "--epochs", "1", "--workers", "1"),
    "study": ("--seeds", "2", "--epochs", "1", "qubits=2", "layers=1", "--workers", "1"),
}
"""What is appended to a command, so that it takes seconds; the last of two equal options counts."""
CIRCUIT = ("qubits=2", "layers=1", "--seeds", "1")
ELSEWHERE = {"doctor", "view"}
"""`doctor` looks at this machine, and `view` ends with Ctrl-C: cli/test_doctor.py, leaderboard/test_live.py."""


def commands(page: str = "docs/start.md", section: str = "Every command once") -> list[list[str]]:
    text = (ROOT / page).read_text().partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    (block,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    return [shlex.split(line, comments=True)[1:] for line in block.splitlines()]


def small(words: list[str]) -> list[str]:
    """Return a command with a small budget."""
    more = SMALL.get(words[0], ())
    if words[0] == "run" and any(word.startswith("vqc-") for word in words):
        more += CIRCUIT
    return [*words, *more]


def test_the_examples_run_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("QRLSUITE_RUNS", raising=False)
    assert {words[0] for words in commands()} >= {
        "run",
        "evaluate",
        "export",
        "import",
        "tune",
        "study",
        "compare",
        "plot",
    }
    for words in commands():
        if words[0] in ELSEWHERE:
            continue
        done = qrlsuite(*small(words), cwd=tmp_path)
        assert done.returncode == 0, f"{shlex.join(words)}\n{done.stdout}{done.stderr}"
    for written in ("board.html", "curves.pdf"):
        assert (tmp_path / written).stat().st_size > 1000
    assert len(list((tmp_path / "entries" / "beam6g").iterdir())) == 1


def test_the_readmes_three_commands_print_what_is_below_them(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "docs" / "tutorials" / "data", tmp_path / "docs" / "tutorials" / "data")
    said = ""
    for words in commands("README.md", "Three commands"):
        done = qrlsuite(*words, cwd=tmp_path)
        assert done.returncode == 0, f"{shlex.join(words)}\n{done.stdout}{done.stderr}"
        said += " ".join(done.stdout.split())
    (printed,) = re.findall(r"```text\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    verdicts = [" ".join(verdict.split()) for verdict in printed.split("\n\n")]
    assert len(verdicts) == 2
    assert [verdict for verdict in verdicts if verdict not in said] == []


def test_the_search_starts_as_printed(tmp_path: Path) -> None:
    (words,) = [words for words in commands() if words[0] == "tune"]
    done = qrlsuite(*words, "--dry-run", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    planned = [search["planned"] for search in json.loads(done.stdout)["searches"]]
    assert min(planned) > 1
