"""`qrlsuite evaluate` as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from qrlsuite.errors import OptionError, QrlSuiteError
from tests.commands import qrlsuite, say
from tests.conftest import Train


def test_table_json_and_picture(kept: Train, tmp_path: Path) -> None:
    folder = kept("runs", [0, 1, 2], 1)
    kept("runs", [0, 1], 1, settings=("width=8",))
    picture = tmp_path / "h.svg"
    words = ["evaluate", str(folder), "mlp width=8", "--best", "2", "--episodes", "30"]
    words += ["--runs", str(tmp_path / "runs")]
    done = qrlsuite(*words, "--out", str(picture))
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    assert "ddqn mlp width=16: the 2 of 3 runs with the best last validation score" in said
    assert picture.read_text().startswith("<?xml")

    printed = say(*words, "--json").stdout
    by_name = {each["policy"]: each for each in json.loads(printed)["policies"]}
    assert list(by_name) == [
        "ddqn mlp width=16", "ddqn mlp width=8", "optimal", "nearest antenna", "random"
    ]  # fmt: skip
    assert by_name["optimal"]["score"]["mean"] == 1.0
    assert len(by_name["ddqn mlp width=16"]["seeds"]) == 2
    assert by_name["random"]["episodes"] == 30
    assert say(*words, "--json").stdout == printed


def test_a_tasks_reference_policies_play_without_entries(tmp_path: Path) -> None:
    words = ["evaluate", "--task", "beam6g", "--episodes", "20", "--runs", str(tmp_path)]
    played = json.loads(say(*words, "--json").stdout)["policies"]
    assert [each["policy"] for each in played] == ["optimal", "nearest antenna", "random"]
    assert played[0]["score"]["mean"] == 1.0
    known = json.loads(
        say("evaluate", "--task", "beam6g+476ac3d2", "--published", "--episodes", "5", "--json").stdout
    )
    assert known["task"] == "beam6g+476ac3d2", "a task that only entries have"
    for more in (["--backend", "native shots=10"], ["--perturb", ".1"]):
        with pytest.raises(OptionError, match="name at least one entry to evaluate, or --task alone"):
            say(*words, *more)


def test_what_cannot_be_played_is_refused(kept: Train, tmp_path: Path) -> None:
    folder = kept("runs", [0], 1)
    (folder / "seed-0000" / "final.safetensors").unlink()

    def refused(message: str, *words: str) -> None:
        with pytest.raises(QrlSuiteError, match=message):
            say("evaluate", *words, "--runs", str(tmp_path / "runs"))

    refused("no trained parameters", "mlp")
    refused("no entry 'mpl'", "mpl")
    path = folder / "entry.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "imported": True}))
    refused("train the entry here", str(folder))
