"""Entries whose seeds differ in length, and tasks whose files do not agree about the cells."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from qrlsuite.cli.app import build
from qrlsuite.errors import EnvironmentFailure
from qrlsuite.experiment import task as tasks
from qrlsuite.leaderboard import board, collect
from qrlsuite.results.store import EntryStore
from tests.conftest import TINY
from tests.leaderboard.boards import entry as drawn


def test_extending_a_few_seeds_hides_no_other(train: Callable[..., Path]) -> None:
    path = train("runs", range(5), 3)
    train("runs", [1, 3], 4)
    found = collect.read_entry(EntryStore(path))
    assert found is not None
    assert (found.curves.shape, found.left_out) == ((5, 3), ())
    (section,) = board.build([found]).sections
    assert (section.horizon, section.rows[0].entry.seeds) == (180, (0, 1, 2, 3, 4))
    train("runs", [0, 4], 4)  # now most have four epochs
    found = collect.read_entry(EntryStore(path))
    assert found is not None
    assert (found.curves.shape, found.left_out, found.longest) == ((4, 4), (2,), 4)
    (section,) = board.build([found]).sections
    assert section.rows[0].entry.seeds == (0, 1, 2, 3, 4)
    assert section.rows[0].entry.left_out == ()


def test_every_horizon_shows_the_seeds_that_reach_it(tiny_task: str, train: Callable[..., Path]) -> None:
    Path(tiny_task).write_text(TINY.replace("[180]", "[180, 240]"))
    path = train("runs", range(4), 3)
    train("runs", [2], 4)
    found = collect.read_entry(EntryStore(path))
    assert found is not None
    sections = board.build([found]).sections
    assert [(s.horizon, s.rows[0].entry.seeds) for s in sections] == [(180, (0, 1, 2, 3)), (240, (2,))]
    assert sections[1].rows[0].entry.left_out == (0, 1, 3)


def test_entries_are_compared_at_what_both_have_reached(train: Callable[..., Path]) -> None:
    long = train("runs", range(4), 4)
    short = train("runs", range(4), 3, settings=("width=8",))
    train("runs", [0], 4, settings=("width=8",))
    first, second = (collect.read_entry(EntryStore(path)) for path in (long, short))
    assert first is not None
    assert second is not None
    compared = board.compare_entries(first, second)
    assert compared.horizon == 180


def test_the_cells_are_those_of_the_registered_task_whatever_an_entry_brings() -> None:
    task = tasks.load("beam6g")
    ranking = task.file.ranking
    cell = ranking.reference.model_copy(update={"epsilon": 0.4, "delta": 0.3})
    lying = task.file.model_copy(
        update={"ranking": ranking.model_copy(update={"epsilons": [0.4], "deltas": [0.3], "reference": cell})}
    )
    assert collect.current(lying, "beam6g", task.hash).ranking == ranking
    assert collect.current(lying, "beam6g", "another definition") is lying
    assert collect.current(lying, "not-installed", task.hash) is lying
    several = [drawn("mlp a"), drawn("mlp b"), drawn("mlp c")]
    object.__setattr__(several[0], "task_file", lying)
    for order in (several, several[::-1]):
        assert board.ranking_of(order) == ranking
        assert board.build(order).sections[0].cell == board.cell_text(ranking)
    one, two = several[0], several[1]
    assert board.ranking_of([one, two]) == board.ranking_of([two, one])


def test_scores_that_no_board_would_rank_end_the_run_at_once(
    tiny_task: str, train: Callable[..., Path]
) -> None:
    Path(tiny_task).write_text(
        TINY.replace("[ranking]", '[score]\nsource = "return"\nmax_return = 0.01\n[ranking]')
    )
    with pytest.raises(
        EnvironmentFailure, match=r"has the score [\d.]+, outside \[0, 1\]: is score.max_return"
    ):
        train("runs", [0], 2)


def test_versions_that_mix_are_pointed_out(train: Callable[..., Path], tmp_path: Path) -> None:
    path = train("runs", range(2), 3)
    run = path / "seed-0001" / "run.json"
    record = json.loads(run.read_text())
    record["provenance"][0]["versions"]["torch"] = "2.0"
    run.write_text(json.dumps(record))
    said = CliRunner().invoke(build(), ["leaderboard", "--runs", str(tmp_path / "runs")]).output
    assert "made with several versions, see `qrlsuite show ENTRY`: ddqn mlp width=16 (torch)" in " ".join(
        said.split()
    )
    shown = CliRunner().invoke(build(), ["show", path.name, "--runs", str(tmp_path / "runs")]).output
    assert '"torch": "2.0"' in shown
    assert np.__version__ in shown
