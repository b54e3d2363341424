"""Rules of studies: entries can be resolved, pictures can be drawn."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from qrlsuite import specs
from qrlsuite.results import speed
from qrlsuite.studies.study import Study, parse
from qrlsuite.testing.common import Subject
from qrlsuite.testing.findings import BrokenRuleError, Checklist, Finding, require
from qrlsuite.testing.fresh import environment
from qrlsuite.testing.toml import check_format, check_names, check_path, in_its_words


def check(subject: Subject) -> list[Finding]:
    """Check a study's file, its entries and its pictures; nothing is trained."""
    spec = subject.spec
    assert isinstance(spec, specs.StudySpec)
    rules = Checklist()
    study = check_format(rules, spec, parse, "valid, and groups that pictures name exist")
    if study is None:
        return rules.findings
    elsewhere = "`qrlsuite list studies` and the pictures' files would have different names"
    check_names(rules, spec, study.name, study.file.summary, elsewhere)
    usable = rules.run(
        "entries", "tasks, models and options exist, as a run needs them", lambda: _entries(study)
    )
    rules.run("all shown", "every group of entries is in a picture", lambda: _all_shown(study))
    if spec.speeds is not None:
        rules.run("speeds", "reference speeds can be read", lambda: _speeds(spec))
    if usable:
        rules.run(
            "pictures",
            "they exist and take the settings; `qrlsuite show STUDY` shows it",
            lambda: _show(spec),
        )
    return rules.findings


def _entries(study: Study) -> None:
    with in_its_words():
        study.members()


def _all_shown(study: Study) -> None:
    if any(not picture.entries for picture in study.file.pictures):
        return
    shown = {group for picture in study.file.pictures for group in picture.entries}
    hidden = [
        group.name or "a group without a name" for group in study.file.entries if group.name not in shown
    ]
    require(
        not hidden,
        f"{', '.join(hidden)}: trained, and in no picture. Name the group among a picture's entries, or remove it",
    )


def _speeds(spec: specs.StudySpec) -> None:
    assert spec.speeds is not None
    check_path("speeds", spec.speeds)
    with in_its_words():
        speed.load(Path(spec.speeds))


def _show(spec: specs.StudySpec) -> None:
    """Let the command show the file: only the drawing part knows the kinds of pictures."""
    command = [sys.executable, "-W", "ignore", "-m", "qrlsuite", "show", "study", spec.path, "--json"]
    with tempfile.TemporaryDirectory() as runs:
        done = subprocess.run(
            [*command, "--runs", runs], capture_output=True, text=True, check=False, env=environment()
        )
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}, and no message"]
        raise BrokenRuleError(" ".join(lines).removeprefix("qrlsuite: "))
