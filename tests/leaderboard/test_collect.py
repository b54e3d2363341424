"""Entries whose seeds differ in length, and tasks whose files do not agree about the cells."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from qrlsuite.errors import EnvironmentFailure, OptionError
from qrlsuite.experiment import task as tasks
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.leaderboard.boards import board, ranked
from qrlsuite.leaderboard.boards.compared import compare_entries
from qrlsuite.leaderboard.pictures.compose import compose
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.curves import DifferentCurvesError, EntryResults
from qrlsuite.results.records import EntryRecord
from qrlsuite.results.store import EntryStore
from tests.commands import say
from tests.conftest import TINY, Train, trainer
from tests.leaderboard import boards
from tests.leaderboard.boards import entry as drawn
from tests.leaderboard.boards import refused


def test_extending_a_few_seeds_hides_no_other(train: Train) -> None:
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


def test_every_horizon_shows_the_seeds_that_reach_it(tiny_task: str, train: Train) -> None:
    Path(tiny_task).write_text(TINY.replace("[180]", "[180, 240]"))
    path = train("runs", range(4), 3)
    train("runs", [2], 4)
    found = collect.read_entry(EntryStore(path))
    assert found is not None
    sections = board.build([found]).sections
    assert [(s.horizon, s.rows[0].entry.seeds) for s in sections] == [(180, (0, 1, 2, 3)), (240, (2,))]
    assert sections[1].rows[0].entry.left_out == (0, 1, 3)


def test_entries_are_compared_at_what_both_have_reached(train: Train) -> None:
    long = train("runs", range(4), 4)
    short = train("runs", range(4), 3, settings=("width=8",))
    train("runs", [0], 4, settings=("width=8",))
    first, second = (collect.read_entry(EntryStore(path)) for path in (long, short))
    assert first is not None
    assert second is not None
    compared = compare_entries(first, second)
    assert compared.pair.times.horizon == 180


def test_the_cells_are_those_of_the_registered_task_whatever_an_entry_brings() -> None:
    task = tasks.load("beam6g")
    ranking = task.file.ranking
    cell = ranking.reference.model_copy(update={"epsilon": 0.4, "delta": 0.3})
    other = ranking.model_copy(update={"epsilons": [0.4], "deltas": [0.3], "reference": cell})
    lying = task.file.model_copy(update={"ranking": other})
    told = {"task_file": lying, "task_name": "beam6g", "task_hash": task.hash}
    assert collect.current(EntryRecord.model_construct(**told)).ranking == ranking
    for change in ({"task_hash": "another definition"}, {"task_name": "not-installed"}):
        assert collect.current(EntryRecord.model_construct(**{**told, **change})) is lying
    several = [drawn("mlp a"), drawn("mlp b"), drawn("mlp c")]
    object.__setattr__(several[0], "task_file", lying)
    for order in (several, several[::-1]):
        assert ranked.ranking_of(order) == ranking
        assert board.build(order).sections[0].ranking.cell == ranking.cell
    assert ranked.ranking_of(several[:2]) == ranked.ranking_of(several[1::-1])


def test_scores_that_no_board_would_rank_end_the_run_at_once(tiny_task: str, train: Train) -> None:
    scored = '[score]\nsource = "return"\nmax_return = 0.01\n[ranking]'
    Path(tiny_task).write_text(TINY.replace("[ranking]", scored))
    with pytest.raises(EnvironmentFailure, match=r"has the score [\d.]+, outside \[0, 1\]: is score.max"):
        train("runs", [0], 2)


def test_versions_that_mix_are_pointed_out(train: Train, tmp_path: Path) -> None:
    path = train("runs", range(2), 3)
    run = path / "seed-0001" / "run.json"
    record = json.loads(run.read_text())
    record["provenance"][0]["versions"]["torch"] = "2.0"
    run.write_text(json.dumps(record))
    said = say("leaderboard", "--explain", "--runs", str(tmp_path / "runs")).output
    several = "made with several versions, see `qrlsuite show ENTRY`: ddqn mlp width=16 (torch)"
    assert several in " ".join(said.split())
    shown = say("show", path.name, "--runs", str(tmp_path / "runs")).output
    assert '"torch": "2.0"' in shown
    assert np.__version__ in shown


@pytest.fixture(scope="module")
def with_smoke(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with runs of a published entry: one epoch of three seeds, as a smoke test leaves them."""
    root = tmp_path_factory.mktemp("smoke")
    return trainer("beam6g", root)("runs", range(3), 1).parents[1]


def test_a_smoke_run_cuts_no_picture(with_smoke: Path, tmp_path: Path) -> None:
    words = ("--task", "beam6g", "--runs", str(with_smoke), "--out", str(tmp_path / "p.svg"))

    def plot(kind: str, *more: str) -> tuple[str, str]:
        done = say("plot", kind, *words, *more)
        assert done.exit_code == 0, done.output
        return done.output, (tmp_path / "p.svg").read_text()

    for kind in ("bars", "tiers"):
        output, picture = plot(kind, "--published")
        assert "left out: ddqn mlp width=16: ends at 2000 steps; --horizon 2000 shows it" in output
        assert "all cut to" not in picture
        among = collect.Selection.create(with_smoke, "beam6g", True)
        made = compose(kind, among, settings={}, environment={})
        assert [entry.color for entry in made.entries] == list(range(len(made.entries))), "of those drawn"
    output, picture = plot("bars", "--published", "--horizon", "2000")
    assert "left out" not in output
    output, _ = plot("curves", "--published")  # which cuts nothing
    assert "left out" not in output
    output, _ = plot("bars", "epsilons=[0.2]", "--published", "--seeds", "20")
    assert "left out: ddqn mlp width=16: 3 seeds, and not all that were asked for" in output
    output, _ = plot("bars")  # alone it cuts nobody
    assert "left out" not in output


def test_a_shorter_own_entry_stands_beside_the_published_one(with_smoke: Path) -> None:
    def rows(*words: str) -> dict[int, list[tuple[str, int]]]:
        done = say("leaderboard", "--runs", str(with_smoke), "--format", "json", "--published", *words)
        sections = [each for each in json.loads(done.stdout)["sections"] if each["task"] == "beam6g"]
        return {each["horizon"]: [(row["label"], row["seeds"]) for row in each["rows"]] for each in sections}

    own, other = ("ddqn mlp width=16", 3), ("ddqn mlp width=16 (published)", 100)
    both = rows("--entry", "beam6g/mlp width=16")
    assert both == {2000: [own], 200_000: [other]}
    cut = rows("--entry", "mlp width=16", "--task", "beam6g", "--horizon", "2000")
    assert sorted(cut[2000]) == [own, other]
    everything = rows("--horizon", "2000")  # the epochs of vqe-h2 have 600 steps
    said = say("leaderboard", "--runs", str(with_smoke), "--published", "--horizon", "2000").output
    assert "an epoch of task 'vqe-h2' has 600 steps" in " ".join(said.split())
    assert list(everything) == [2000]
    assert {own, other} <= set(everything[2000])
    assert own not in rows("--horizon", "200000")[200_000]
    assert 2000 not in rows("--horizon", "200000")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--horizon", "2500"), "task 'beam6g' has 2000 steps; write a multiple of it, such as --horizon 2000"),
        (("--horizon", "4000"), "no entry is left: ddqn mlp width=16: ends at 2000 of 4000 steps"),
    ],
)  # fmt: skip
def test_what_leaves_nothing_says_why(words: tuple[str, ...], message: str, with_smoke: Path) -> None:
    for command in (("leaderboard",), ("plot", "bars")):
        assert message in refused(*command, "--runs", with_smoke, *words)


def test_of_entries_below_every_horizon_the_length_of_half_of_them_counts() -> None:
    lengths = {"mlp a": 30, "mlp b": 20, "mlp c": 20, "mlp d": 5}
    kept, lines = collect.equally_long([drawn(label, epochs=epochs) for label, epochs in lengths.items()])
    assert [entry.label for entry in kept] == ["mlp a", "mlp b", "mlp c"]
    assert lines == ["mlp d: ends at 10000 steps; --horizon 10000 shows it"]
    kept, lines = collect.equally_long([drawn("mlp a"), *(drawn(f"mlp {i}", epochs=20) for i in range(3))])
    assert [entry.label for entry in kept] == ["mlp a"], "the others do not reach the task's horizon"


CODE = CodeIdentity(({"role": "model", "name": "a", "distribution": "x"},))
CURVES = np.random.default_rng(0).random((6, 5)).round(3)


@st.composite
def parts(draw: st.DrawFn) -> EntryResults:
    """Some seeds of one entry, each with the first epochs of its curve."""
    lengths = draw(st.dictionaries(st.integers(0, 5), st.integers(1, 5), min_size=1))
    entry, folder = boards.entry("mlp a", 1), Path(draw(st.sampled_from("abc")))
    results = {
        seed: replace(
            entry.records[0],
            seed=seed,
            scores=CURVES[seed, :length, None],
            folder=folder,
            published=draw(st.booleans()),
        )
        for seed, length in sorted(lengths.items())
    }
    return EntryResults.of(entry.record, folder, results)


def seen(entry: EntryResults) -> tuple[dict[int, tuple[float, ...]], int, list[list[float]]]:
    return (
        {seed: tuple(result.curve) for seed, result in entry.records.items()},
        entry.epochs,
        entry.curves.tolist(),
    )


@given(parts(), parts(), parts())
def test_results_of_an_entry_add(a: EntryResults, b: EntryResults, c: EntryResults) -> None:
    assert seen(a + b) == seen(b + a)
    assert seen((a + b) + c) == seen(a + (b + c))
    assert seen(a + a) == seen(a)
    first_epochs = [each.cut(1) for each in (a, b, a + b)]
    assert None not in first_epochs
    assert seen(first_epochs[0] + first_epochs[1]) == seen(first_epochs[2])
    whole = a + b
    assert list(whole.records) == sorted({*a.records, *b.records})
    for seed, result in whole.records.items():
        assert len(result.curve) == max(len(p.records[seed].curve) for p in (a, b) if seed in p.records)
        assert any(result is p.records.get(seed) for p in (a, b)), "it says where it was read"


@given(parts(), parts())
def test_a_seed_with_two_curves_does_not_add_and_both_folders_are_named(
    a: EntryResults, b: EntryResults
) -> None:
    assume(a.records.keys() & b.records.keys())
    here = boards.changed(a, folder=Path("here"))
    results = {s: replace(r, scores=r.scores + 1, folder=Path("there")) for s, r in b.records.items()}
    there = replace(b, records=results)
    for one, other in ((here, there), (there, here)):
        with pytest.raises(DifferentCurvesError, match=r"seed \d has one curve in here and another in there"):
            one + other


def test_results_of_two_entries_do_not_add() -> None:
    with pytest.raises(OptionError, match="'mlp a' and 'mlp b' are not the same entry"):
        boards.entry("mlp a") + boards.entry("mlp b")
    coded = boards.changed(boards.entry("mlp a"), code=CODE)
    with pytest.raises(OptionError, match="are not the same entry"):
        boards.entry("mlp a") + coded


def test_published_seeds_that_end_before_own_ones_are_named() -> None:
    own, there = boards.entry("mlp a"), boards.changed(boards.entry("mlp a", 30, 50), published=True)
    shown = "20 seeds of 100 epochs of the same entry, from mlp a"
    assert collect.united([own, there]) == (own, f"mlp a: 30 seeds of 50 epochs; shown are {shown}")
