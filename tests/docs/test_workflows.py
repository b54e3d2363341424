"""What runs on the public repository: workflows and forms are valid, and do what `make` does here."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from qrlsuite.cli.commands import demo
from qrlsuite.leaderboard.shelf.changed import PLACES
from tests.commands import qrlsuite

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


@pytest.mark.parametrize(
    ("schema", "files"), [("github-workflows", WORKFLOWS), ("github-issue-forms", FORMS)]
)
def test_files_follow_the_schema_of_the_host(schema: str, files: list[Path]) -> None:
    assert files
    words = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}"]
    checked = subprocess.run([*words, *map(str, files)], capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def targets() -> set[str]:
    return set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_every_workflow_does_its_work_by_make(workflow: Path) -> None:
    called = re.findall(r"\bmake ([\w-]+)", workflow.read_text())
    assert called
    assert set(called) <= targets()


def loaded(workflow: Path) -> dict[str, Any]:
    content: dict[str, Any] = yaml.load(workflow.read_text(), yaml.BaseLoader)  # which leaves `on` a word
    return content


def jobs(workflow: Path) -> list[tuple[dict[str, Any], dict[str, str]]]:
    """Return a workflow's jobs with what each may write and read."""
    content = loaded(workflow)
    return [(job, job.get("permissions", content["permissions"])) for job in content["jobs"].values()]


EVERY_JOB = [
    pytest.param(job, may, id=f"{path.stem}-{place}")
    for path in WORKFLOWS
    for place, (job, may) in enumerate(jobs(path))
]


def test_actions_are_pinned_by_commit() -> None:
    """Each with the version that it is, and one commit for a version everywhere."""
    used: dict[str, set[str]] = {}
    for workflow in WORKFLOWS:
        text = workflow.read_text()
        pinned = re.findall(r"uses: ([\w-]+/[\w-]+)@([0-9a-f]{40}) # (v\d+\.\d+\.\d+)\n", text)
        assert len(pinned) == len(re.findall(r"^ +(?:- )?uses:", text, re.MULTILINE)), (
            f"{workflow.name}: an action without a commit and its version"
        )
        for action, commit, version in pinned:
            used.setdefault(action, set()).add(f"{commit} {version}")
    assert used
    assert all(len(commits) == 1 for commits in used.values()), used


def test_a_workflow_may_nothing_but_read_unless_a_job_says_so() -> None:
    for workflow in WORKFLOWS:
        assert loaded(workflow)["permissions"] in ({}, {"contents": "read"}), workflow.name
        text = workflow.read_text()
        assert "pull_request_target" not in text
        assert "secrets." not in text


WITHOUT_OTHERS_CODE = ("actions/download-artifact", "actions/deploy-pages", "pypa/gh-action-pypi-publish")


@pytest.mark.parametrize(("job", "may"), EVERY_JOB)
def test_what_may_write_runs_no_code_of_the_repository_or_of_packages(
    job: dict[str, Any], may: dict[str, str]
) -> None:
    """It has no checkout, and installs and builds nothing: what it publishes was built by a job that may only read."""
    if "write" not in may.values():
        return
    assert job["needs"] in ("build", "verify")
    for step in job["steps"]:
        if "uses" in step:
            assert step["uses"].partition("@")[0] in WITHOUT_OTHERS_CODE
        else:
            assert re.match(r"gh api \S+ -f ", step["run"])


@pytest.mark.parametrize(("job", "may"), EVERY_JOB)
def test_no_name_is_pasted_into_a_script(job: dict[str, Any], may: dict[str, str]) -> None:
    """What an event carries comes in variables, which a shell does not read as a program where they are quoted."""
    for step in job["steps"]:
        script = step.get("run", "")
        assert "${{" not in script
        quoted = re.sub(r'"[^"]*"', "", script)
        assert not re.search(r"\$\{?[A-Z]", quoted.replace("$GITHUB_STEP_SUMMARY", "")), script
        if step.get("uses", "").startswith("actions/checkout@"):
            assert step["with"]["persist-credentials"] == "false"
            assert not {"ref", "repository"} & set(step["with"])


def test_a_pull_request_cannot_change_what_judges_its_entries() -> None:
    """The host takes a workflow that begins with another one from the default branch, and so is all that it runs.

    It is begun for every pull request, and takes what is published from all places, after the installation.
    """
    judge = loaded(ROOT / ".github" / "workflows" / "entries.yml")
    assert judge["on"] == {"workflow_run": {"workflows": ["tests"], "types": ["requested"]}}
    begun = loaded(ROOT / ".github" / "workflows" / "tests.yml")
    assert begun["name"] == "tests"
    assert begun["on"]["pull_request"] == "", "of any path"
    verify = judge["jobs"]["verify"]
    assert verify["permissions"] == {"contents": "read"}
    _, _, install, take, check, _ = [step.get("run", "") for step in verify["steps"]]
    assert install.startswith("make install ")
    assert [take.count(place) for place in PLACES] == [2] * len(PLACES)
    assert check.startswith("make verify -o install BASE=")


def test_who_judges_has_to_approve_what_judges() -> None:
    owners = (ROOT / ".github" / "CODEOWNERS").read_text().splitlines()
    owned = {line.split()[0] for line in owners if line and not line.startswith("#")}
    assert {"/.github/", "/Makefile", "/pyproject.toml", "/leaderboard/*.py", "/SECURITY.md"} <= owned
    assert all((ROOT / place.strip("/")).exists() for place in owned if "*" not in place)


def test_the_lowest_versions_are_tested() -> None:
    """By files that are there, in a job of the workflow of every change."""
    text = (ROOT / "Makefile").read_text().replace("\\\n", "")
    assert re.search(r"^test-lowest:\n(?:\t.*\n)*\t.* --resolution lowest-direct ", text, re.MULTILINE)
    (files,) = re.findall(r"^LOWEST := (.*)$", text, re.MULTILINE)
    assert all((ROOT / file).is_file() for file in files.split())
    steps = loaded(ROOT / ".github" / "workflows" / "tests.yml")["jobs"]["lowest"]["steps"]
    assert steps[-1]["run"].startswith("make test-lowest ")


def git(folder: Path, *words: str) -> str:
    author = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    return subprocess.run(
        ["git", *author, *words], cwd=folder, check=True, capture_output=True, text=True
    ).stdout


DATA = {
    "leaderboard/entries/beam6g/one/entry.json": "FAILED beam6g/one: ",
    "leaderboard/plans/one/plan.toml": "FAILED one: ",
}
NAMES = {
    "leaderboard/entries/beam6g/$(touch pwned)/entry.json": "is no valid name",
    "leaderboard/plans/`touch pwned`/plan.toml": "is no valid name",
}


@pytest.mark.parametrize(
    "brought", [DATA, NAMES, {"Makefile": "no entry differs from"}], ids=("data", "names", "code")
)
def test_the_judge_takes_data_alone(brought: dict[str, str], tmp_path: Path) -> None:
    """Its scripts, as they are, on a repository whose pull request brings files; only the host is another."""
    clone, fork = tmp_path / "clone", tmp_path / "host" / "someone" / "fork"
    for path in ("Makefile", "leaderboard/entries/beam6g/old/entry.json"):
        (clone / path).parent.mkdir(parents=True, exist_ok=True)
        (clone / path).write_text("{}")
    shutil.copyfile(ROOT / "Makefile", clone / "Makefile")
    git(tmp_path, "init", "-q", "clone")
    git(clone, "add", "-A")
    git(clone, "commit", "-qm", "main")
    git(tmp_path, "clone", "-q", str(clone), str(fork))
    for name in brought:
        (fork / name).parent.mkdir(parents=True, exist_ok=True)
        (fork / name).write_text("verify:\n\ttouch pwned\n")
    git(fork, "add", "-A")
    git(fork, "commit", "-qm", "proposed")
    (clone / "later").write_text("after the pull request was begun")
    git(clone, "add", "-A")
    git(clone, "commit", "-qm", "later")
    program = clone / ".venv" / "bin" / "qrlsuite"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -P -m qrlsuite "$@"\n')
    program.chmod(0o755)
    environment = {
        **os.environ,
        "REPOSITORY": "someone/fork",
        "COMMIT": git(fork, "rev-parse", "HEAD").strip(),
        "GIT_CONFIG_COUNT": "1",
        "GIT_CONFIG_KEY_0": f"url.{tmp_path}/host/.insteadOf",
        "GIT_CONFIG_VALUE_0": "https://github.com/",
    }
    steps = loaded(ROOT / ".github" / "workflows" / "entries.yml")["jobs"]["verify"]["steps"]
    before = {path.name for path in clone.iterdir()}
    taken, checked = (
        subprocess.run(
            ["bash", "-eo", "pipefail", "-c", step["run"]],
            cwd=clone,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
        )
        for step in steps[-3:-1]
    )
    assert taken.returncode == 0, taken.stderr
    assert [said for said in brought.values() if said not in checked.stdout + checked.stderr] == []
    assert (checked.returncode == 0) == ("Makefile" in brought)
    assert {path.name for path in clone.iterdir()} == {*before, "report.txt"}


def test_the_demo_ends_with_a_sentence_for_each_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At an epoch and at few seeds it is the same demo, and its sentences say that this is too short."""
    monkeypatch.setattr(demo, "EPOCHS", 1)
    monkeypatch.setattr(demo, "SEEDS", 2)
    assert re.search(
        r"^quickstart: install\n\t\$\(BIN\)/qrlsuite demo ", (ROOT / "Makefile").read_text(), re.M
    )
    demo.demo(runs=tmp_path / "runs")
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if line.startswith("$ ")]
    assert [re.findall(r"qrlsuite (\w+)", line)[-1] for line in lines] == ["run"] * 3 + [
        "leaderboard",
        "plot",
    ]
    assert "times as fast). Their values differ by" in said.err
    assert (tmp_path / "runs" / "beam6g-curves.png").exists()
    verdicts = [line for line in said.out.splitlines() if line.startswith("- ")]
    assert len(verdicts) == 3
    assert all("neither reached any of the 7 thresholds within 2k steps" in line for line in verdicts), (
        verdicts
    )
    assert "Your 2 seeds, pair by pair, after 2k of 200k steps:" in said.out


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("qrlsuite lea", "leaderboard"),
        ("qrlsuite run --model four", "fourier"),
        ("qrlsuite run --mod", "--model"),
        ("qrlsuite compare beam6g/ddqn-mlp-90", "beam6g/ddqn-mlp-90e7f8d4"),
    ],
)
def test_shells_complete_commands_options_and_names(line: str, expected: str) -> None:
    env = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_QRLSUITE_COMPLETE": "complete_bash"}
    done = qrlsuite(env={**os.environ, **env})
    assert done.stdout.split() == [expected], done.stderr
