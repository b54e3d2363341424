"""Studies that break one rule each."""

from __future__ import annotations

from pathlib import Path

import pytest

from qrlsuite.specs import StudySpec
from tests.testing.broken import Broken, assert_breaks, own_rules
from tests.testing.edits import Edit

STUDY = """
format_version = 1
name = "small"
summary = "Two sizes of a network"

[[entries]]
name = "mlp"
task = "beam6g"
model = "mlp"
grid = { width = [8, 16] }

[[entries]]
name = "deep"
task = "beam6g"
model = "mlp"
options = { depth = 3 }

[[pictures]]
kind = "bars"
entries = ["mlp", "deep"]
settings = { epsilons = [0.2], deltas = [0.5] }
"""
SPEEDS = """
format_version = 1
machine = "a laptop"

[[speeds]]
environment = "beam6g"
algorithm = "ddqn"
model = "mlp"
options = { width = 8 }
seconds = 0.1
"""

BROKEN = {
    "key": Edit("format", "summary", "sumary", r"^small.toml: .*unknown key 'sumary'.*'summary'"),
    "toml": Edit("format", "[[pictures]]", "[[pictures]", r"^small.toml: not valid TOML"),
    "group": Edit("format", '["mlp", "deep"]', '["mlp", "dep"]', r"no group 'dep'; did you mean 'deep'"),
    "latin": Edit("format", "Two sizes", "Zwei Größen", r"^small.toml is not text in UTF-8, as TOML is"),
    "name": Edit("says what is registered", '"small"', '"tiny"', r"as 'small', .* name = 'tiny': `qrlsuite study"),
    "summary": Edit("says what is registered", "Two sizes", "Sizes", r"with the summary .* read it from the file"),
    "task": Edit("entries", '"beam6g"', '"beam5g"', r"group 'mlp': unknown task 'beam5g'; did you mean 'beam6g"),
    "model": Edit("entries", '"mlp"\ngrid', '"mpl"\ngrid', r"group 'mlp': unknown model 'mpl'; did you mean 'mlp'"),
    "option": Edit("entries", "width =", "widht =", r"group 'mlp': grid.widht: no option of that name; did you mean"),
    "value": Edit("entries", "[8, 16]", "[8, 0]", r"group 'mlp': .*width"),
    "hidden": Edit("all shown", '["mlp", "deep"]', '["mlp"]', r"^deep: trained, and in no picture"),
    "kind": Edit("pictures", '"bars"', '"bar"', r"pictures.0.kind: unknown picture 'bar'; did you mean 'bars'"),
    "setting": Edit("pictures", "epsilons", "epsilon", r"pictures.0.settings.*'epsilon'; did you mean 'epsilons'"),
}  # fmt: skip


def spec(path: Path, text: str = STUDY, speeds: str | None = None) -> StudySpec:
    path.write_bytes(text.encode("latin-1"))
    return StudySpec(name="small", summary="Two sizes of a network", path=str(path), speeds=speeds)


@pytest.mark.parametrize("name", BROKEN)
def test_one_rule_is_broken(name: str, tmp_path: Path) -> None:
    edit = BROKEN[name]
    case = Broken(spec(tmp_path / "small.toml", edit.of(STUDY)), edit.message)
    assert_breaks("studies", edit.rule, case)


def test_a_file_that_was_not_packaged(tmp_path: Path) -> None:
    missing = StudySpec(name="small", summary="Not there", path=str(tmp_path / "small.toml"))
    assert_breaks(
        "studies", "file", Broken(missing, r"small.toml is not there: is the TOML file among the package")
    )


def test_a_relative_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec(tmp_path / "small.toml")
    monkeypatch.chdir(tmp_path)
    relative = StudySpec(name="small", summary="Here only", path="small.toml")
    assert_breaks("studies", "file", Broken(relative, r"path = 'small.toml' is relative to the folder"))


@pytest.mark.parametrize(
    ("speeds", "message"),
    [
        ("speeds.toml", r"^speeds = 'speeds.toml' is relative to the folder"),
        ("{folder}/missing.toml", r"missing.toml"),
        ("{folder}/wrong.toml", r"unknown key 'second'.*'seconds'"),
    ],
)
def test_speeds_that_cannot_be_read(speeds: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text(SPEEDS.replace("seconds =", "second ="))
    broken = spec(tmp_path / "small.toml", speeds=speeds.format(folder=tmp_path))
    assert_breaks("studies", "speeds", Broken(broken, message))


def test_every_rule_has_a_study_that_breaks_it(tmp_path: Path) -> None:
    (tmp_path / "speeds.toml").write_text(SPEEDS)
    findings = own_rules("studies", spec(tmp_path / "small.toml", speeds=str(tmp_path / "speeds.toml")))
    assert all(finding.ok for finding in findings), findings
    assert {f.rule for f in findings} == {"file", "speeds", *(edit.rule for edit in BROKEN.values())}
