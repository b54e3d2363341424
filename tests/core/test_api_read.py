"""The functions that read, from Python: on the published entries, and on bad input."""

from __future__ import annotations

import doctest
import io
import subprocess
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute
import pytest
from rich.console import Console

import qrlsuite
from qrlsuite import api
from qrlsuite.errors import OptionError, QrlSuiteError, UnknownNameError
from qrlsuite.experiment import identity
from qrlsuite.leaderboard.shelf import collect, published, published_studies
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.plugins.models import vqc
from qrlsuite.results.store import EntryStore
from qrlsuite.studies import study
from tests.conftest import cases
from tests.leaderboard import boards

WHERE: dict[str, Any] = {"runs": "no-results-yet", "published": True}


@pytest.fixture(scope="module")
def small() -> EntryResults:
    return api.load("mlp width=16", task="beam6g", **WHERE)


@pytest.fixture(scope="module")
def large() -> EntryResults:
    return api.load("beam6g/mlp width=64", **WHERE)


def printed(thing: object, width: int = 200) -> str:
    """What rich prints of something."""
    console = Console(file=io.StringIO(), width=width)
    console.print(thing)
    text = console.file
    assert isinstance(text, io.StringIO)
    return text.getvalue()


def test_an_entry_is_read_with_its_curves_and_records(small: EntryResults) -> None:
    assert small.curves.shape == (100, 100)
    assert small.curves.dtype == np.float64
    assert list(small.records) == list(small.seeds) == list(range(100))
    assert {record.epochs for record in small.records.values()} == {100}
    assert sum(record.hours for record in small.records.values()) == pytest.approx(small.hours)


def test_a_table_has_a_row_per_seed_and_epoch(small: EntryResults) -> None:
    table = api.table("epochs", entries=[small], **WHERE)
    assert {"task", "entry", "seed", "epoch", "steps", "score"} <= {*table.column_names}
    assert table.num_rows == small.curves.size
    seventh = table.filter(pyarrow.compute.equal(table["seed"], 7)).to_pydict()
    assert seventh["epoch"] == list(range(1, 101))
    assert seventh["steps"] == [2000 * epoch for epoch in range(1, 101)]
    assert seventh["score"] == small.curves[7].tolist()
    assert set(seventh["entry"]) == {"ddqn mlp width=16"}


def test_a_table_is_a_data_frame(small: EntryResults) -> None:
    pandas = pytest.importorskip("pandas", reason="needs pandas: pip install pandas")
    frame = api.table("epochs", entries=[small], **WHERE).to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame.pivot(index="seed", columns="epoch", values="score").to_numpy() == pytest.approx(
        small.curves
    )


def test_a_comparison_is_numbers_and_a_sentence(small: EntryResults, large: EntryResults) -> None:
    found = api.compare(large, small)
    low, high = found.interval
    assert low < found.difference < high < 0 < found.p < 0.05
    assert f"{-found.difference:.0%} fewer steps" in found.sentence
    assert found.as_dict()["verdict"] == str(found.sentence)


def test_nothing_is_appended_to_a_name_of_one_s_own() -> None:
    circuit = api.load("vqc-native qubits=6", task="beam6g", **WHERE)
    assert circuit.legend.endswith(" ansatz=iqp")
    assert {circuit.labeled("mine").legend, circuit.labeled("mine").short, circuit.labeled("mine").label} == {
        "mine"
    }


def test_the_first_names_are_for_users() -> None:
    assert set(dir(qrlsuite)) == set(qrlsuite.__all__) >= {"compare", "power"}
    assert "power" in dir(api)


def test_a_board_ranks_what_it_is_given(small: EntryResults, large: EntryResults) -> None:
    board = api.board("beam6g", entries=[large, "mlp width=16"], **WHERE)
    (section,) = board.sections
    assert [(row.tier, row.entry.label) for row in section.tiers] == [
        (1, "ddqn mlp width=64"),
        (2, "ddqn mlp width=16"),
    ]
    assert board.as_dict()["rule"] == "intervals"
    assert api.board(["beam6g"], entries=[small], horizon=20_000, **WHERE).sections[0].horizon == 20_000


def test_what_is_left_out_of_a_board_is_named(large: EntryResults) -> None:
    with pytest.raises(UnknownNameError, match=r"no entry is left: .*ends at 200000 of 202000 steps"):
        api.board(entries=[large], horizon=202_000, **WHERE)


def test_an_entry_with_fewer_seeds_is_one_that_has_these_alone(small: EntryResults) -> None:
    few = small.with_seeds([7, 3])
    assert few.seeds == (3, 7)
    assert np.array_equal(few.curves, small.curves[[3, 7]])
    assert few.hours == pytest.approx(sum(small.records[seed].hours for seed in (3, 7)))
    assert small.with_seeds("0:20").seeds == small.with_seeds(20).seeds == tuple(range(20))
    cells = api.compare(small.with_seeds(19), small, rule="paper").cells
    assert cells is not None
    assert cells.outcome == "undecided"
    with pytest.raises(OptionError, match="'ddqn mlp width=16' has no complete run of seed 100"):
        small.with_seeds([0, 100])


def test_results_show_themselves(small: EntryResults, large: EntryResults) -> None:
    board = api.board("beam6g", entries=[small, large], **WHERE)
    comparison = api.compare(large, small)
    for shown in (board._repr_html_(), printed(board), repr(board), str(board)):
        assert "beam6g, ddqn, 200k steps" in shown
        assert "42.6k (40.8k to 44.4k)" in shown
        assert "1 of 1 pair of 2 entries decided" in shown, (
            "entries that were read are compared by themselves"
        )
    for shown in (comparison._repr_html_(), printed(comparison), repr(comparison), str(comparison)):
        said = " ".join(unescape(shown).split())
        assert comparison.sentence in said
    assert all("<td" in shown._repr_html_() for shown in (board, comparison, small)), "tables, not drawn ones"
    assert "ddqn-mlp-" in small._repr_html_()
    assert "387" in printed(small)
    assert repr(small).startswith("task        beam6g\nentry       ddqn mlp width=16 (ddqn-mlp-")
    heads = [
        next(line for line in printed(board, width).splitlines() if "rank" in line) for width in (80, 200)
    ]
    assert ["settings" in head for head in heads] == [False, True], "80 columns have no room for it"


def test_html_holds_nothing_but_text(large: EntryResults) -> None:
    hostile = replace(boards.changed(large, label="<script>alert(1)</script>"), folder=Path("<img src=x>"))
    for shown in (
        hostile._repr_html_(),
        api.board(entries=[hostile], **WHERE)._repr_html_(),
        api.compare(hostile, large)._repr_html_(),
    ):
        assert "<script" not in shown
        assert "<img" not in shown
        assert "&lt;script&gt;" in shown


def calls(patch: pytest.MonkeyPatch, owner: Any, name: str) -> list[Any]:
    """The first argument of each call of a function or method from now on."""
    made, function = [], getattr(owner, name)

    def counted(first: Any, *arguments: Any, **named: Any) -> Any:
        made.append(first)
        return function(first, *arguments, **named)

    patch.setattr(owner, name, counted)
    return made


def test_work_is_done_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny_task: str, forked_workers: None
) -> None:
    """Entries are resolved once, tasks loaded once for all of them, names read once, and code looked at once."""
    resolved, loaded = calls(monkeypatch, study, "resolve"), calls(monkeypatch, study, "load_task")
    api.read_study("memory", runs=tmp_path)
    assert (len(resolved), loaded) == (4, ["beam6g"])
    published_studies.import_study(published_studies.PUBLISHED / "memory", tmp_path)
    resolved.clear()
    assert api.read_study("memory", runs=tmp_path).study.folder.is_relative_to(tmp_path), "it has begun there"
    assert len(resolved) == 4
    read = calls(monkeypatch, EntryStore, "record")
    api.compare("mlp width=64", "mlp width=16", task="beam6g", **WHERE)
    assert {store.path.parent.name for store in read} == {"beam6g"}
    named = [path for at in published.folders() for path in (at / "beam6g").iterdir()]
    on_board = len(list((published.PUBLISHED / "beam6g").iterdir()))
    assert len(read) == len(named) + 2 + on_board, "names once; both entries, and the board with both"
    identified, built = calls(monkeypatch, identity, "of"), calls(monkeypatch, vqc, "build_circuit")
    options = {"qubits": 2, "layers": 1}
    assert api.train(
        tiny_task, "vqc-native", options=options, seeds=1, epochs=1, runs=tmp_path, progress=False
    )
    assert (len(identified), len(built)) == (1, 1)


def test_names_and_entries_are_compared_alike(small: EntryResults, large: EntryResults) -> None:
    by_name = api.compare("mlp width=64", "mlp width=16", task="beam6g", **WHERE)
    assert api.compare(large, small).as_dict() == {**by_name.as_dict(), "board": None}
    assert by_name.cells is None
    strict = api.compare(large, small, rule="times")
    assert strict.cells is not None
    assert str(strict.cells.outcome) == "outperforms"
    assert strict.cells.points.shape == (2, *strict.cells.grid.shape)
    assert "+ significantly fewer samples" in printed(strict)
    assert "+ significantly fewer samples" in strict._repr_html_()


@pytest.mark.parametrize("kind", ["curves", "bars", "tiers"])
def test_pictures_are_figures(kind: str, small: EntryResults, large: EntryResults) -> None:
    figure = api.plot(kind, entries=[small, large], **WHERE)
    texts = " ".join(text.get_text() for text in figure.findobj() if hasattr(text, "get_text"))
    assert "mlp width=64" in texts


def test_a_picture_of_equal_numbers(small: EntryResults, large: EntryResults) -> None:
    figure = api.plot("bars", entries=[small, large], seeds=30, **WHERE)
    shown = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert ["30 seeds*" in text for text in shown] == [True, True]
    with pytest.warns(UserWarning, match="qubits=14: 30 seeds, and not all that were asked for"):
        api.plot("bars", task="beam6g", seeds=iter(range(40)), **WHERE)
    with pytest.raises(OptionError, match=r"plot takes `task`, one or several: write task='beam6g'"):
        api.plot("bars", tasks="beam6g", **WHERE)


def test_pictures_of_an_environment_take_its_options() -> None:
    assert api.plot("field", task="beam6g", environment={"degree": 5}, resolution=20).axes


def test_a_picture_names_what_it_leaves_out(
    small: EntryResults, large: EntryResults, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = small.cut(50)
    assert short is not None
    monkeypatch.setattr(collect, "collect", lambda *_, **__: ([large, short], []))
    with pytest.warns(
        UserWarning, match=r"left out: ddqn mlp width=16: ends at 100000 steps; --horizon 100000"
    ):
        api.plot("bars", task="beam6g", **WHERE)


REFUSED = """
load("mlp width=17", task="beam6g", **WHERE) => no entry 'mlp width=17'
load("mlp", task="beam7g", **WHERE) => did you mean 'beam6g
load("mlp", runs="no-results-yet") => no results folder no-results-yet
board("beam6g", horizon=2001, **WHERE) => has 2000 steps
board("beam6g", rule="interval", **WHERE) => did you mean 'intervals'
compare("beam6g/mlp width=64", "cartpole/reinforce mlp", **WHERE) => only entries of one task can be compared
plot("curve", task="beam6g", **WHERE) => did you mean 'curves'
plot("curves", **WHERE) => holds several tasks
plot("field", task="beam6g", seeds=3) => picture 'field' shows no results: leave --seeds out
plot("bars", entries=["mlp width=64"], task="beam6g", seeds=101, **WHERE) => has no complete run of seed 100
plot("bars", task="beam6g", epsilon=[0.1], **WHERE) => did you mean 'epsilons'
plot("bars", task="beam6g", environment={"degree": 5}, **WHERE) => shows what was trained
"""


@pytest.mark.parametrize(("call", "message"), cases(REFUSED))
def test_bad_input_says_what_to_type(call: str, message: str) -> None:
    with pytest.raises(QrlSuiteError, match=message):
        eval(f"api.{call}")


def test_the_examples_are_right() -> None:
    modules = {sys.modules[getattr(api, name).__module__] for name in api.__all__}
    results = [doctest.testmod(module) for module in modules]
    assert sum(result.attempted for result in results) >= 5
    assert not any(result.failed for result in results)


def test_curves_are_judged_without_torch_pennylane_and_qiskit(tmp_path: Path) -> None:
    """They take seconds, and nothing is computed with them."""
    rows = [
        f"{entry},{seed},{10 * k},{k * by + seed / 9}"
        for entry, by in (("a", 1), ("b", 1.1))
        for seed in (0, 1)
        for k in range(1, 6)
    ]
    (tmp_path / "curves.csv").write_text("\n".join(["entry,seed,step,score", *rows]))
    code = """
import sys
from qrlsuite import api
from qrlsuite.cli import main
where = dict(task="beam6g", runs="runs", published=True)
api.board(**where).sheets(explain=True)
api.compare("mlp width=64", "mlp width=16", **where)
for words in ("import curves.csv maximum=6", "compare a b", "plot curves", "power a b --draws 20", "leaderboard"):
    sys.argv = ["qrlsuite", *words.split()]
    try:
        main()
    except SystemExit as end:
        assert not end.code, words
sys.exit(", ".join({"torch", "pennylane", "qiskit"} & sys.modules.keys()) or 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
