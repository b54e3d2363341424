"""`qrlsuite evaluate` as a user meets it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qrlsuite.cli.app import build
from qrlsuite.errors import QrlSuiteError
from tests.commands import qrlsuite


def test_table_json_and_picture(train: Callable[..., Path], tmp_path: Path) -> None:
    folder = train("runs", [0, 1, 2], 1)
    train("runs", [0, 1], 1, settings=("width=8",))
    runs = str(tmp_path / "runs")
    picture = tmp_path / "h.svg"
    words = ["evaluate", str(folder), "mlp width=8", "--best", "2", "--episodes", "30", "--runs", runs]
    done = qrlsuite(*words, "--out", str(picture))
    assert done.returncode == 0, done.stderr
    assert "ddqn mlp width=16: the 2 of 3 runs with the best last validation score" in " ".join(
        done.stdout.split()
    )
    assert "nearest antenna" in done.stdout
    assert picture.read_text().startswith("<?xml")

    result = CliRunner().invoke(build(), [*words, "--json"])
    content = json.loads(result.stdout)
    by_name = {each["policy"]: each for each in content["policies"]}
    assert list(by_name) == [
        "ddqn mlp width=16", "ddqn mlp width=8", "optimal", "nearest antenna", "random"
    ]  # fmt: skip
    assert by_name["optimal"]["score"]["mean"] == 1.0
    assert len(by_name["ddqn mlp width=16"]["seeds"]) == 2
    assert by_name["random"]["episodes"] == 30
    assert CliRunner().invoke(build(), [*words, "--json"]).stdout == result.stdout


def test_wrong_input(train: Callable[..., Path], tmp_path: Path) -> None:
    folder = train("runs", [0], 1)
    (folder / "seed-0000" / "final.safetensors").unlink()
    runs = str(tmp_path / "runs")
    for words, message in (
        (["mlp", "--runs", runs], "no trained parameters"),
        (["mpl", "--runs", runs], "no entry 'mpl'"),
        (["mlp", "--runs", runs, "--out", "h.txt"], "the file's ending must be .png, .pdf or .svg"),
    ):
        result = CliRunner().invoke(build(), ["evaluate", *words])
        assert isinstance(result.exception, QrlSuiteError), result.output
        assert message in str(result.exception)


@pytest.mark.parametrize("field", ["imported"])
def test_an_imported_entry_has_no_policies(field: str, train: Callable[..., Path], tmp_path: Path) -> None:
    folder = train("runs", [0], 1)
    path = folder / "entry.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), field: True}))
    result = CliRunner().invoke(build(), ["evaluate", str(folder), "--runs", str(tmp_path / "runs")])
    assert "train the entry here" in str(result.exception)
