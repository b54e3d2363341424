"""The commit that a run records: of the suite's own working copy, of no other repository."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
import torch

import qrlsuite
from qrlsuite.device import NUMERICS
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.results import provenance
from qrlsuite.results.provenance import commit_of
from qrlsuite.results.records import DeviceRecord, Provenance


def git(folder: Path, *words: str) -> str:
    author = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    done = subprocess.run(["git", "-C", folder, *author, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def repository(top: Path, package: Path) -> Path:
    """Return a package below the top of a new repository, which does not track it yet."""
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (top / "README.md").write_text("")
    git(top, "init", "-q")
    git(top, "add", "README.md")
    git(top, "commit", "-q", "-m", "begin")
    return package


def tracked(top: Path) -> Path:
    package = repository(top, top / "qrlsuite")
    git(top, "add", "-A")
    git(top, "commit", "-q", "-m", "code")
    return package


def test_the_commit_and_whether_a_file_was_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tracked(tmp_path / "own")
    head = git(package, "rev-parse", "--short", "HEAD")
    assert commit_of(package) == head
    other = tracked(tmp_path / "other")
    monkeypatch.setenv("GIT_DIR", str(other.parent / ".git"))  # as in a hook of another repository
    assert commit_of(package) == head
    (package / "__init__.py").write_text("changed = True\n")
    assert commit_of(package) == f"{head}-dirty"


def test_a_second_working_copy_has_its_own(tmp_path: Path) -> None:
    """There, `.git` is a file."""
    tracked(tmp_path / "own")
    git(tmp_path / "own", "worktree", "add", "-q", "--detach", str(tmp_path / "second"))
    head = git(tmp_path / "second", "rev-parse", "--short", "HEAD")
    assert commit_of(tmp_path / "second" / "qrlsuite") == head


def test_another_repository_is_not_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (
        commit_of(repository(tmp_path / "a", tmp_path / "a" / ".venv" / "site-packages" / "qrlsuite")) is None
    )
    assert commit_of(repository(tmp_path / "b", tmp_path / "b" / "qrlsuite")) is None, (
        "installed, not tracked"
    )
    package = tracked(tmp_path / "c")
    monkeypatch.setenv("PATH", "")
    assert commit_of(package) is None, "no git"


def test_the_suite_s_own_working_copy_is_recorded() -> None:
    package = Path(qrlsuite.__file__).resolve().parent
    if not (package.parent / ".git").exists():
        pytest.skip("not a working copy")
    head = git(package.parent, "rev-parse", "HEAD")
    provenance._commit.cache_clear()  # an earlier test of this process may have hidden git
    recorded = provenance.collect([]).commit
    assert recorded is not None
    assert head.startswith(recorded.removesuffix("-dirty").rpartition("-g")[2])


def test_every_version_is_told_once() -> None:
    made = [Provenance(versions={"numpy": v}, python="3.11", commit=None) for v in ("2.4", "2.3", "2.4")]
    assert provenance.versions(made) == {"numpy": ("2.3", "2.4"), "python": ("3.11",)}
    assert provenance.distinct(origin.commit for origin in made) == ()


def test_a_gpus_other_kernels_are_recorded_and_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = resolve("beam6g", "vqc-native", settings=[parse_setting("qubits=2")])
    monkeypatch.setattr(provenance, "_device", lambda device: DeviceRecord(kind="cuda"))
    before = provenance.of(entry, torch.device("cuda"))
    monkeypatch.setitem(NUMERICS, "circuit kernels", 2)
    now = provenance.of(entry, torch.device("cuda"))
    assert now.numerics == {**before.numerics, "circuit kernels": 2}
    assert provenance.of(entry, torch.device("cpu")).numerics == before.numerics
    assert "circuit kernels" not in provenance.of(resolve("beam6g", "mlp"), torch.device("cuda")).numerics
    assert provenance.difference(now, before) == "numerics 2 of the circuit kernels here, 1 there"
    assert provenance.difference(before, now) == "numerics 1 of the circuit kernels here, 2 there"
    assert provenance.difference(now, now) is None
