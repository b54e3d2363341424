"""A task that ranks a metric of its environment, less is better: from training to boards, and back from an export."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from qrlsuite import api
from qrlsuite.errors import EnvironmentFailure, FileError, OptionError, StoreError
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.task import Task, parse
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.boards import board
from qrlsuite.leaderboard.boards.compared import compare_entries
from qrlsuite.leaderboard.report import render
from qrlsuite.leaderboard.shelf import collect, fields, import_curves, import_seeds, published, verify
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.leaderboard.shelf.export import export
from qrlsuite.results.store import EntryStore
from qrlsuite.statistics import Grid, times_below
from qrlsuite.training.evaluation import best_runs
from qrlsuite.training.trainer import Trainer
from tests.conftest import trainer
from tests.environments.strangers import HERE
from tests.leaderboard import boards

WALK = f"""
format_version = 1
name = "walk"
summary = "a walk that should be short"
[environment]
name = "gym"
options = {{ id = "{HERE}:Walk-v0", arguments = {{ measured = "steps-taken" }} }}
[protocol]
seeds = 20
epochs = 2
environments = 2
interactions = 20
validation_episodes = 30
[score]
metric = "steps-taken"
goal = "below"
[ranking]
thresholds = [9, 7.5, 7.4]
deltas = [0.5]
reference = {{ threshold = 7.5, delta = 0.5 }}
horizons = [40]
costs = ["late"]
"""


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, EntryResults]:
    """A folder with 20 seeds in `runs`, and their entry."""
    root = tmp_path_factory.mktemp("walked")
    (root / "walk.toml").write_text(WALK)
    entry = collect.read_entry(EntryStore(trainer(str(root / "walk.toml"), root)("runs", range(20), 2)))
    assert entry is not None
    return root, entry


def turned(entry: EntryResults, shift: float) -> EntryResults:
    """Another entry, which takes `shift` steps more."""
    results = {
        seed: replace(
            result, scores=result.scores + shift, measured={"late": result.measured["late"] + shift}
        )
        for seed, result in entry.records.items()
    }
    other = boards.changed(entry, name="other", label="ddqn other")
    return replace(other, records=results, folder=Path("other"))


def test_steps_above_a_threshold_by_hand() -> None:
    """It is reached where V <= V*; a run that is there at once has no step before it, one that never is has all."""
    curves, levels = [[5.0, 3.0, 2.0], [2.0, 2.5, 2.0]], [2, 4]
    assert times_below(curves, Grid.absolute(levels, [0.5], "below"), 10).tolist() == [[20, 10], [10, 0]]
    assert times_below(curves, Grid.absolute(levels, [0.5]), 10).tolist() == [[0, 20], [0, 30]]


def test_a_metric_is_ranked_and_less_is_better(walked: tuple[Path, EntryResults]) -> None:
    _, entry = walked
    worse = turned(entry, 2.0)
    np.testing.assert_array_equal(entry.curves, np.round(entry.metrics["steps-taken"], 7))
    assert (entry.metrics["late"] == 1).all()
    assert best_runs(EntryStore(entry.folder), 3)[1] == sorted(entry.curves[:, -1])[:3]

    made = board.build([worse, entry])
    rows = made.sections[0].times.rows
    assert [row.entry.name for row in rows] == [entry.name, "other"]
    times = times_below(entry.curves, entry.task_file.ranking.grid, 20)
    assert rows[0].mean.mean == pytest.approx(times.mean())
    heads = [column.title for column in made.sheets()[0].columns]
    assert {"steps above threshold (95%)", "final steps-taken", "late"} <= set(heads)
    assert made.as_dict()["sections"][0]["rows"][0]["costs"] == {"late": 1.0}
    assert made.flat()[0]["cost_late"] == 1.0
    for by, what in (("score", "final steps-taken"), ("area", "area"), ("late", "final late")):
        [section] = board.build([worse, entry], by=by).sections
        assert what in section.title
        assert [section.entries[i].name for i in section.order] == [entry.name, "other"], by
        assert [section.ranks[i] for i in section.order] == [(1, 1), (2, 2)], by
        assert section.sheet().cells[1][5].startswith("2.000"), "above the first"
    of_epochs = fields.table([entry], "epochs")
    assert of_epochs["measured.steps-taken"].to_pylist() == entry.metrics["steps-taken"].ravel().tolist()
    for rows, count in (("entries", 1), ("seeds", 20), ("epochs", 40)):
        assert fields.table([entry], rows)["measured.late"].to_pylist() == [1.0] * count
    page = render(made)
    for text in ("Steps above threshold", "Final steps-taken", ">Late</th>", "validation steps-taken"):
        assert text in page, text

    verdict = compare_entries(entry, worse)
    assert re.match(r"mlp width=16 needs .* fewer steps than ", verdict.sentence.removeprefix("ddqn ")), (
        verdict.sentence
    )
    assert "; final steps-taken " in verdict.sentence
    assert verdict.pair.notes[0].startswith("steps above threshold")
    drawn = pictures.draw("curves", [entry, worse])
    assert drawn.axes[0].get_ylabel() == "validation steps-taken"
    assert pictures.draw("bars", [entry]).axes[0].get_xticklabels()[0].get_text() == "steps-taken = 9"


def test_an_export_holds_metrics_which_are_checked(walked: tuple[Path, EntryResults], tmp_path: Path) -> None:
    _, entry = walked
    folder = export(entry, tmp_path / "entries")
    read = published.read(folder).entry_results()
    for name, values in entry.metrics.items():
        np.testing.assert_array_equal(read.metrics[name], values)
    assert verify.verify(folder, rerun=2, choice=1).ok
    import_seeds.import_seeds(EntryStore(folder), tmp_path / "runs")
    [again], _ = collect.select(collect.Selection(tmp_path / "runs"))
    np.testing.assert_array_equal(again.metrics["late"], entry.metrics["late"])

    table = pyarrow.parquet.read_table(folder / published.CURVES)
    late = pyarrow.array(np.full(len(table), 0.5))
    place = table.column_names.index("measured.late")
    pyarrow.parquet.write_table(
        table.set_column(place, "measured.late", late), folder / published.CURVES, compression="zstd"
    )
    found = verify.verify(folder, rerun=2, choice=1)
    assert (found.ok, "other values of the metric 'late'" in found.message) == (False, True), found.message
    pyarrow.parquet.write_table(table.drop_columns(["measured.late"]), folder / published.CURVES)
    with pytest.raises(StoreError, match="columns are"):
        published.read(folder)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('metric = "steps-taken"', 'metric = "regret"', r"no info\['metrics'\]\['regret'\] at the end .*steps-taken"),
        ('metric = "steps-taken"', 'metric = "late"', "ranking.costs: 'late' is shown twice"),
        ('goal = "below"\n', 'goal = "below"  # nan\n', r"\['late'\] (= nan, which cannot be ranked|at the end)"),
        ('metric = "steps-taken"\n', "", "goal = 'below' is for a metric: scores and returns should be high"),
        ('goal = "below"', 'goal = "under"', "score.goal"),
        ('goal = "below"', 'goal = "below"\nsource = "return"', "comes from the environment's info: source ="),
        ("thresholds = [9, 7.5, 7.4]", "epsilons = [0.1]", "has no known maximum|the reference cell needs"),
        ('costs = ["late"]', 'costs = ["steps-taken"]', "'steps-taken' is shown twice"),
        ('costs = ["late"]', 'costs = ["Late"]', "ranking.costs.0"),
    ],
)  # fmt: skip
def test_what_cannot_be_ranked_is_refused(old: str, new: str, problem: str, tmp_path: Path) -> None:
    assert old in WALK
    text = WALK.replace(old, new)
    if "# nan" in new:  # `late` is measured of late episodes alone
        text = text.replace('costs = ["late"]', "").replace('steps-taken"\ngoal', 'late"\ngoal')
    (tmp_path / "walk.toml").write_text(text)

    def train() -> None:
        made = Trainer(resolve(str(tmp_path / "walk.toml"), "mlp", None, []), [0])
        made.start()
        made.train_epoch()

    with pytest.raises((FileError, EnvironmentFailure), match=problem):
        train()


def test_a_cost_that_was_not_measured_is_none(walked: tuple[Path, EntryResults]) -> None:
    _, entry = walked
    without = boards.changed(entry, measured={})
    assert board.build([without]).as_dict()["sections"][0]["rows"][0]["costs"] == {"late": None}
    with pytest.raises(OptionError, match="--by late: not every epoch of 'ddqn mlp"):
        board.build([without], by="late")
    with pytest.raises(OptionError, match=r"choose among steps, .*, late; did you mean 'late'"):
        board.build([entry], by="lat")


def test_thresholds_take_the_place_of_tolerances(tmp_path: Path) -> None:
    """A task that extends one with tolerances, and earlier files, which say nothing of metrics."""
    changes = 'extends = "beam6g"\nname = "lost"\n[score]\nmetric = "regret"\ngoal = "below"\n[ranking]\n'
    task = parse(f"{changes}thresholds = [60, 30]\nreference = {{ threshold = 30 }}\n", "lost.toml")
    assert isinstance(task, Task)
    ranking = task.file.ranking
    assert (ranking.epsilons, ranking.goal, ranking.cell) == (None, "below", "regret 30, delta 0.75")
    assert (
        "metric"
        not in api.load("mlp width=64", task="beam6g", published=True, runs=tmp_path).identity["task"][
            "score"
        ]
    )


def test_curves_of_other_programs_may_be_costs(tmp_path: Path) -> None:
    lines = [f"{name},{seed},{step},{base - step / 10 - seed / 8}" for name, base in (("a", 9), ("b", 12))
             for seed in range(3) for step in (10, 20, 30)]  # fmt: skip
    (tmp_path / "curves.csv").write_text("\n".join(["entry,seed,step,Regret", *lines]))
    asked = {"metric": "Regret", "goal": "below", "thresholds": [7, 8.5], "runs": tmp_path}
    done = api.import_curves(tmp_path / "curves.csv", **asked)
    file = collect.find(collect.Selection(tmp_path), "a").task_file
    assert (file.score.metric, file.score.goal, file.ranking.cell) == (
        "regret",
        "below",
        "regret 7, delta 0.5",
    )
    assert "thresholds 7, 8.5 on regret, less is better" in import_curves.told(done)[-1]
    [section] = api.board(runs=tmp_path).sections
    assert [row.entry.label for row in section.times.rows] == ["external a", "external b"]
    for more, problem in (
        ({"maximum": 12.0}, "in place of maximum"),
        ({"goal": "down"}, "goal = 'down': Input should be 'above' or 'below'"),
        ({"thresholds": [20, 30], "task": "new"}, "every run is below them from its first"),
        ({"goal": "above"}, "has below; leave it out"),
    ):
        with pytest.raises(OptionError, match=problem):
            api.import_curves(tmp_path / "curves.csv", **{**asked, **more})
