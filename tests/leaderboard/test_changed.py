"""What a change brings to the published entries: read from git by a command that no name reaches a shell of."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard.shelf import published, published_studies
from qrlsuite.leaderboard.shelf.changed import PLACES, _problem, changed
from tests.commands import qrlsuite

ROOT = Path(__file__).parents[2]
ENTRY = sorted((published.PUBLISHED / "beam6g").glob("ddqn-mlp-*"))[0]
PLACE = f"leaderboard/entries/beam6g/{ENTRY.name}"
PLAN = "quantum-or-not-degree5"


def git(folder: Path, *words: str) -> str:
    author = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    return subprocess.run(
        ["git", *author, *words], cwd=folder, check=True, capture_output=True, text=True
    ).stdout


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository with one published entry, all of it committed."""
    folder = tmp_path / "clone"
    shutil.copytree(ENTRY, folder / PLACE)
    git(tmp_path, "init", "-q", str(folder))
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "one entry")
    return folder


def propose(repository: Path, name: str, content: Path = ENTRY / "entry.json") -> None:
    """Commit a file of any name."""
    path = repository / name
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(content, path)
    git(repository, "add", "-A")
    git(repository, "commit", "-qm", "a proposal")


INJECTED = "leaderboard/entries/beam6g/$(touch ${HOME}pwned)/entry.json"


def test_a_folder_named_like_a_command_is_refused_and_runs_nothing(repository: Path) -> None:
    """`make verify` as reviewers type it; only the installation is left out."""
    shutil.copyfile(ROOT / "Makefile", repository / "Makefile")
    (repository / "bin").mkdir()
    program = repository / "bin" / "qrlsuite"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -P -m qrlsuite "$@"\n')
    program.chmod(0o755)
    git(repository, "add", "-A")
    git(repository, "commit", "-qm", "tools")
    before = {path.name for path in repository.iterdir()}
    propose(repository, INJECTED)
    environment = {**os.environ, "HOME": ""}
    words = ["make", "verify", "-o", "install", "BIN=bin", "BASE=HEAD~1"]
    done = subprocess.run(words, cwd=repository, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert "is no valid name" in done.stderr
    words[-1] = "BASE=HEAD'; touch pwned; '"
    done = subprocess.run(words, cwd=repository, env=environment, capture_output=True, text=True, timeout=120)
    assert "names no commit here" in done.stderr
    assert {path.name for path in repository.iterdir()} == before


@pytest.mark.parametrize(
    ("name", "message"),
    [
        *(
            (f"leaderboard/entries/beam6g/{name}/entry.json", "is no valid name")
            for name in ("`id`", "x;id", "-rf", ".x", "two words", "two\nlines", "\x1b[2J", "\udcff", "Ddqn")
        ),
        ("leaderboard/unranked/$(id)/x/entry.json", "is no valid name"),
        ("leaderboard/plans/$(id)/plan.toml", "is no valid name"),
        ("leaderboard/family/$(id)/plan.toml", "is no valid name"),
        ("leaderboard/entries/beam6g/entry.json", "holds TASK/ENTRY/"),
        ("leaderboard/entries/beam6g/x/more/entry.json", "holds TASK/ENTRY/"),
        ("leaderboard/entries/beam6g/x/conftest.py", "holds TASK/ENTRY/"),
        ("leaderboard/plans/width/beam6g/looks.jsonl", "holds NAME/"),
        ("leaderboard/plans/width/beam6g/x/__init__.py", "is no valid name"),
    ],
)
def test_names_and_places_that_no_published_file_has_are_refused(
    repository: Path, name: str, message: str
) -> None:
    propose(repository, name)
    with pytest.raises(QrlSuiteError, match=message):
        changed("HEAD~1", repository)


@pytest.mark.parametrize(
    "link", [PLACE + "/seeds.parquet", PLACE, "leaderboard/entries/beam6g", "leaderboard/unranked"]
)
def test_links_are_refused(repository: Path, link: str) -> None:
    path = repository / link
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    path.symlink_to("/etc")
    with pytest.raises(QrlSuiteError, match=r"is a link|holds TASK/ENTRY/"):
        changed("HEAD", repository)


@pytest.mark.parametrize(
    "base", ["--output=pwned", "-h", "no-such-branch", "", "HEAD~7", "a\0b", "HEAD:leaderboard"]
)
def test_what_names_no_commit_is_refused(repository: Path, base: str) -> None:
    with pytest.raises(OptionError, match="names no commit here: write one, such as origin/main"):
        changed(base, repository)
    assert not (repository / "pwned").exists()


def test_a_folder_that_is_no_repository(tmp_path: Path) -> None:
    with pytest.raises(QrlSuiteError, match="git rev-parse failed in"):
        changed("HEAD", tmp_path)


def test_what_differs_is_found(repository: Path) -> None:
    """Committed, changed, not added yet, and gone in part."""
    assert changed("HEAD", repository) == ([], [])
    propose(repository, "leaderboard/unranked/beam6g+7d1167f1/one/curves.parquet")
    propose(repository, f"leaderboard/plans/{PLAN}/plan.toml")
    propose(repository, "leaderboard/family/one/looks.jsonl")
    (repository / "leaderboard/plans/new/task/entry").mkdir(parents=True)
    (repository / "leaderboard/plans/new/task/entry/entry.json").touch()
    (repository / PLACE / "seeds.parquet").unlink()
    entries, plans = changed("HEAD~3", repository / "leaderboard")
    added = ["leaderboard/plans/new/task/entry", "leaderboard/unranked/beam6g+7d1167f1/one"]
    assert [str(path.relative_to(repository)) for path in entries] == [PLACE, *added]
    assert [path.name for path in plans] == ["one", PLAN]


def test_a_badly_named_file_can_be_removed(repository: Path) -> None:
    propose(repository, INJECTED)
    (repository / INJECTED).unlink()
    assert changed("HEAD", repository) == ([], [])


def test_the_command_checks_entries_and_studies_that_differ(repository: Path) -> None:
    done = qrlsuite("verify", "--base", "HEAD", cwd=repository)
    assert (done.returncode, done.stdout) == (0, "no entry differs from HEAD\n")
    shutil.copytree(published_studies.PUBLISHED / PLAN, repository / "leaderboard" / "plans" / PLAN)
    done = qrlsuite("verify", "--base", "HEAD", cwd=repository)
    assert f"ok     {PLAN}: study sound" in done.stdout
    assert "10 of 10 entries ok" in done.stdout
    (repository / "leaderboard" / "plans" / PLAN / "plan.toml").write_text("format_version = 2\n")
    done = qrlsuite("verify", "--base", "HEAD", "--json", cwd=repository)
    assert done.returncode == 1
    (study,) = json.loads(done.stdout)["studies"]
    assert not study["ok"]
    done = qrlsuite("verify", PLACE, "--base", "HEAD", cwd=repository)
    assert "give PATH or --base, not both" in done.stderr


def test_what_another_has_published_is_not_removed_unseen(repository: Path) -> None:
    shutil.rmtree(repository / PLACE)
    done = qrlsuite("verify", "--base", "HEAD", cwd=repository)
    assert done.returncode == 1
    assert f"{PLACE}: it is gone: restore it" in done.stdout


def test_every_published_name_is_one() -> None:
    tracked = git(ROOT, "ls-files", "-z", "--", "leaderboard")
    names = [name for name in tracked.split("\0") if name.startswith(tuple(f"{place}/" for place in PLACES))]
    assert len(names) > 500
    assert not [name for name in names if _problem(ROOT, name)]
