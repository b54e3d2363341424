"""What runs on the public repository: workflows and forms are valid, and do what `make` does here."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from qrlsuite.cli.commands import demo
from tests.commands import qrlsuite
from tests.core.test_docs import parse

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


@pytest.mark.parametrize(
    ("schema", "files"), [("github-workflows", WORKFLOWS), ("github-issue-forms", FORMS)]
)
def test_files_follow_the_schema_of_the_host(schema: str, files: list[Path]) -> None:
    words = [
        sys.executable,
        "-m",
        "check_jsonschema",
        "--builtin-schema",
        f"vendor.{schema}",
        *map(str, files),
    ]
    assert files
    checked = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def targets() -> set[str]:
    return set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_every_workflow_does_its_work_by_make(workflow: Path) -> None:
    called = re.findall(r"\bmake ([\w-]+)", workflow.read_text())
    assert called
    assert set(called) <= targets()


def test_pull_requests_get_no_secret_and_write_nothing() -> None:
    for workflow in WORKFLOWS:
        text = workflow.read_text()
        assert "pull_request_target" not in text
        assert "secrets." not in text
        if "pull_request:" in text:
            assert re.findall(r"^permissions:\n((?:  .*\n)+)", text, re.MULTILINE) == ["  contents: read\n"]


@pytest.mark.parametrize("fails", [False, True])
def test_the_demo_is_four_commands(
    fails: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They exist with their options; where no epoch of both models was finished, the picture has what there is."""
    lines: list[list[str]] = []

    def application() -> object:
        def run(words: list[str], **_: object) -> None:
            lines.append(words)
            if fails and words[0] == "plot" and "--entry" in words:
                raise demo.QrlSuiteError("no such entry")

        return run

    monkeypatch.setattr(demo, "build", application)
    demo.demo(minutes=2, runs=Path("elsewhere"))
    assert [words[0] for words in lines] == ["run", "run", *["plot"] * (1 + fails), "leaderboard"]
    assert not any(parse(words) for words in lines)
    assert all(words[-2:] == ["--runs", "elsewhere"] for words in lines)
    said = capsys.readouterr().err
    assert ("no such entry\nshowing what there is; to train on, type" in said) == fails
    assert "demo --runs elsewhere\n" in said or not fails


def test_make_starts_the_demo() -> None:
    assert re.search(
        r"^quickstart: install\n\t\$\(BIN\)/qrlsuite demo ", (ROOT / "Makefile").read_text(), re.M
    )


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("qrlsuite lea", "leaderboard"),
        ("qrlsuite run --model four", "fourier"),
        ("qrlsuite run --mod", "--model"),
    ],
)
def test_shells_complete_commands_options_and_names(line: str, expected: str) -> None:
    env = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_QRLSUITE_COMPLETE": "complete_bash"}
    done = qrlsuite(env={**os.environ, **env})
    assert done.stdout.split() == [expected], done.stderr
