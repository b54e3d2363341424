"""`qrlsuite import` of curves that other programs made: external entries, compared and drawn as any."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest

from qrlsuite import api
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.results import points, run_files
from qrlsuite.results.store import EntryStore
from tests.commands import say
from tests.leaderboard.boards import refused

STEPS = np.arange(1, 11) * 1000


def learned(seed: int, reached: int) -> list[float]:
    """Return ten scores of a run that is good from one of them on."""
    noise = np.random.default_rng(seed).uniform(0, 5, 10)
    return [float(value) for value in np.where(np.arange(10) < reached + seed % 3, 20, 90) + noise]


def write_csv(
    path: Path, entries: dict[str, Sequence[list[float]]], steps: Sequence[int] = tuple(STEPS)
) -> Path:
    rows = [
        f"{entry},{seed},{step},{score}"
        for entry, runs in entries.items()
        for seed, curve in enumerate(runs)
        for step, score in zip(steps, curve)
    ]
    path.write_text("\n".join(["entry,seed,step,score", *rows]) + "\n")
    return path


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    """2 x 20 runs, one entry faster than the other."""
    fast, slow = ([learned(100 * k + seed, k) for seed in range(20)] for k in (2, 6))
    return write_csv(tmp_path / "curves.csv", {"fast lr=0.1": fast, "slow lr=0.01": slow})


@pytest.fixture
def qrlsuite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    monkeypatch.chdir(tmp_path)

    def run(*words: object) -> Any:
        return say(*map(str, words))

    return run


def lines(points: Sequence[tuple[int, int, int]]) -> str:
    """A csv file of entry a, from (seed, step, score)."""
    return "entry,seed,step,score\n" + "".join(f"a,{seed},{step},{score}\n" for seed, step, score in points)


def ending(path: Path, *lasts: int) -> Path:
    """Seeds that are scored every 10 steps until their last: seed plus step."""
    path.write_text(lines([(s, t, s + t) for s, last in enumerate(lasts) for t in range(10, last + 1, 10)]))
    return path


def test_unequal_steps_take_the_last_score_at_or_before_each_grid_point(tmp_path: Path) -> None:
    path = tmp_path / "curves.csv"
    path.write_text(lines([(0, 0, 9), (0, 7, 1), (0, 19, 2), (0, 40, 3), (0, 45, 4)]))
    [a] = api.import_curves(path, thresholds=[2.5], every=10, runs=tmp_path / "runs")
    curve = a.store.seed(0).read().curve
    # at 10, 20, 30, 40: not the 9 before training, and nothing after 40
    assert curve.tolist() == [1, 2, 2, 3]
    assert a.notes == ("'a' has 1 seed: a verdict needs 4 of each entry, a rank on a board 20",)


def test_a_grid_is_round_where_every_run_has_begun(tmp_path: Path) -> None:
    runs = {"a": ([0, 1], [[1.0, 2.0, 4.0], [1.5, 2.5, 3.0]])}
    [a] = api.import_curves(runs, steps=[130, 900, 1500], thresholds=[2], runs=tmp_path)
    assert a.store.record().task_file.protocol.interactions == 200
    assert a.store.seed(0).read().curve.tolist() == [1, 1, 1, 1, 2, 2, 2]


def test_runs_that_end_early_are_what_the_user_says(tmp_path: Path) -> None:
    """Without the fast runs that were stopped, or the slow ones that crashed, a verdict is wrong."""
    path = ending(tmp_path / "curves.csv", 30, 30, 20, 0)
    path.write_text(path.read_text() + "a,3,7,18\n")  # before the first grid point

    def take(early: Any = None) -> tuple[list[list[float]], tuple[str, ...]]:
        [a] = api.import_curves(path, thresholds=[15], early=early, every=10, runs=tmp_path / f"runs-{early}")
        return [a.store.seed(seed).read().curve.tolist() for seed in range(4)], a.notes

    said = r"seeds 2:4 of 'a' from step 0 on, others at 30\. Type early=solved if they"
    with pytest.raises(QrlSuiteError, match=said):
        take()
    whole = [[10, 20, 30], [11, 21, 31]]
    assert take("solved")[0] == [*whole, [12, 22, 22], [18, 18, 18]]
    curves, notes = take("failed")
    assert curves == [*whole, [12, 22, 10], [10, 10, 10]], "the worst score, at which no threshold is reached"
    assert "'a': seeds 2:4 end early: they crashed or never learned" in notes[0]
    assert (
        api.load("a", runs=tmp_path / "runs-failed").ended_early == "2 seeds that ended early taken as failed"
    )
    record = api.load("a", runs=tmp_path / "runs-failed").records[3].record
    assert record is not None
    assert record.imported["early"] == "failed"
    with pytest.raises(QrlSuiteError, match=r"a run of 'a' ends at step 20, .*: type every=20"):
        api.import_curves(ending(path, 30, 20), thresholds=[15], every=40, runs=tmp_path)
    with pytest.raises(OptionError, match="early = 'died': Input should be 'solved', 'failed' or 'cut'"):
        take("died")


def test_all_runs_are_cut_at_a_common_horizon(tmp_path: Path) -> None:
    path = ending(tmp_path / "curves.csv", 30, 30, 20)
    path.write_text(path.read_text() + "".join(f"b,0,{step},{step}\n" for step in (10, 20, 30, 40)))
    done = api.import_curves(path, thresholds=[15], early="cut", runs=tmp_path / "runs")
    assert [api.load(name, runs=tmp_path / "runs").curves.shape for name in "ab"] == [(3, 2), (1, 2)]
    assert done[1].notes[0] == "'b': all cut to step 20; the longest goes on to 40"
    with pytest.raises(QrlSuiteError, match=r"seeds 4:5 of 'a' from step 10 on, others at 20"):
        api.import_curves(ending(path, 0, 0, 0, 0, 10), runs=tmp_path / "runs")  # beside those of before


def test_runs_that_end_a_little_apart_are_cut_to_one_length(tmp_path: Path) -> None:
    """Episodes end where they end: no seed is left out for that."""
    path = ending(tmp_path / "curves.csv", 200, 190, 180)
    [a] = api.import_curves(path, thresholds=[15], runs=tmp_path / "runs")
    assert a.notes[0] == "'a': all cut to step 180; the longest goes on to 200"
    entry = api.load("a", runs=tmp_path / "runs")
    assert (entry.curves.shape, entry.seeds) == ((3, 18), (0, 1, 2))
    assert a.store.record().task_file.ranking.horizons == [180]


def test_one_score_for_all_entries(sb3: Path, tmp_path: Path) -> None:
    """Evaluations of one agent against training returns of the other: 66 percent fewer steps between equals."""
    one, other = sb3 / "small" / "seed-3" / "evaluations.npz", sb3 / "large" / "seed-3" / "monitor.csv"
    said = "score of 'large' is rollout/ep_rew_mean, that of 'small' eval/mean_reward: curves of different scores"
    with pytest.raises(QrlSuiteError, match=said):
        api.import_curves([one, other], maximum=500, units="same", runs=tmp_path)
    for seed, column in enumerate(("score", "charts/episodic_return")):
        (tmp_path / f"{seed}.csv").write_text(f"entry,seed,step,{column}\na,{seed},10,3\n")
    with pytest.raises(
        QrlSuiteError, match="score of 'a' is charts/episodic_return, in another file score: curves"
    ):
        api.import_curves([tmp_path / "0.csv", tmp_path / "1.csv"], maximum=500, runs=tmp_path)
    [small] = api.import_curves([one], maximum=500, runs=tmp_path)
    assert small.store.record().imported.metric == "eval/mean_reward"  # type: ignore[union-attr]
    with pytest.raises(QrlSuiteError, match="that of 'external small', imported before, eval/mean_reward"):
        api.import_curves([other], runs=tmp_path)
    with pytest.raises(QrlSuiteError, match="task 'cartpole' a validation without exploration"):
        api.import_curves([other], task="cartpole", runs=tmp_path)


def test_scales_that_differ_tenfold(tmp_path: Path) -> None:
    def take(scores: dict[str, float], by: int = 1, **options: Any) -> None:
        curves = {entry: ([0], [[best / 4, best / 2, best]]) for entry, best in scores.items()}
        api.import_curves(curves, steps=[10 * by, 20 * by, 30 * by], runs=tmp_path, **options)

    same = ": if they are in one unit, type units=same; if not, write one unit in all files"
    with pytest.raises(QrlSuiteError, match="the largest score of 'b' is 500, that of 'a' 0.9" + same):
        take({"a": 0.9, "b": 500}, maximum=500)
    take({"a": 60, "b": 500}, maximum=500)
    with pytest.raises(QrlSuiteError, match="step of 'c' is 3000, that of 'external a', imported before, 30"):
        take({"c": 500}, by=100)
    take({"c": 0.9}, units="same")
    take({"d": 500})  # as was said before


def test_scores_and_grid_of_a_task_of_the_suite(tmp_path: Path) -> None:
    """CartPole's best return is 500 and its epochs have 1000 steps: neither is asked for."""
    runs = {"a": ([0], [[100.0, 250.0]])}
    api.import_curves(runs, steps=[900, 2000], task="cartpole", runs=tmp_path)
    entry = api.load("a", runs=tmp_path)
    file = entry.task_file
    assert entry.steps_per_epoch == file.protocol.interactions
    assert entry.curves[0, -1] == 250 / (file.score.max_return or 1)
    with pytest.raises(OptionError, match="every: task 'cartpole' has 1000; leave it out"):
        api.import_curves(runs, steps=[900, 2000], task="cartpole", every=7, runs=tmp_path)
    with pytest.raises(QrlSuiteError, match="are not between 0 and 1"):
        api.import_curves({"a": ([0], [[5.0]])}, steps=[2000], task="beam6g", runs=tmp_path)


def test_more_seeds_are_added_and_those_here_stay(tmp_path: Path) -> None:
    def take(curves: dict[str, Any], **options: Any) -> Any:
        return api.import_curves(curves, steps=[10, 20, 30], runs=tmp_path, **options)[0]

    take({"a": ([0], [[1, 2, 3]])}, maximum=10)
    more = take({"a": ([0, 1], [[1, 2, 4], [2, 3, 4]])})  # the task of the folder says all
    assert (more.new, more.known) == ((1,), (0,))
    assert "seeds 0:1 have other curves in " in more.notes[0]
    assert f" than in {more.store.path}: yours stay, until `qrlsuite runs rm` removes" in more.notes[0]
    longer = {"a": ([0, 1], [[1, 2, 3, 4], [2, 3, 4, 5]])}
    [after] = api.import_curves(longer, steps=[10, 20, 30, 40], runs=tmp_path)
    assert (after.new, api.load("a", runs=tmp_path).records[0].epochs) == ((0, 1), 4), "the longer curve wins"
    for options, message in (
        ({"maximum": 20}, "maximum: task 'external' has 10; leave it out, or give another --task NAME"),
        ({"thresholds": [5]}, "task 'external' has 6, 7, 8, 9; leave it out"),
        ({"every": 20}, "every: task 'external' has 10; leave it out"),
    ):
        with pytest.raises(OptionError, match=message):
            take({"b": ([0], [[1, 2, 3]])}, **options)
    with pytest.raises(QrlSuiteError, match="begins at step 20, after the first grid point at 10"):
        api.import_curves({"b": ([0], [[1, 2]])}, steps=[20, 30], runs=tmp_path)


def test_tables_and_data_frames(tmp_path: Path) -> None:
    table = pyarrow.table(
        {"entry": ["a", "a"], "seed": [0, 0], "step": [10, 20], "return": [1.0, 2.0], "x": [0, 0]}
    )
    [a] = api.import_curves(table, maximum=2, metric="return", runs=tmp_path)
    assert a.store.seed(0).read().curve.tolist() == [0.5, 1]
    with pytest.raises(OptionError, match="curves of type int: give files"):
        api.import_curves(3, runs=tmp_path)


GOOD = "entry,seed,step,score\n"
BAD = {
    "holes": (GOOD + "a,0,10,1\na,0,,2\n", "line 3: no step: every row has an entry"),
    "a short row": (GOOD + "a,0,10\n", "line 2: 3 cells, and 4 in the first line"),
    "NaN": (GOOD + "a,0,10,nan\n", "the score of 'a', seed 0, at step 10 is nan"),
    "inf": (GOOD + "a,0,10,inf\n", "at step 10 is inf"),
    "twice": (GOOD + "a,0,10,1\na,1,10,1\na,0,10,2\n", "'a', seed 0: step 10 is there twice"),
    "decreasing": (GOOD + "a,0,10,1\na,0,5,2\n", "step 5 follows step 10"),
    "negative": (GOOD + "a,0,-10,1\n", "step -10 is negative"),
    "columns": (
        "name,seed,step,reward\n",
        "expected the columns entry, seed, step, score, each once; found name, seed",
    ),
    "two steps": ("entry,seed,steps,timesteps,score\n", "rename all of steps, timesteps but one"),
    "no score": ("entry,seed,step,r\n", "type metric=NAME, where NAME is the score: r"),
    "empty": ("", "found none"),
    "no rows": (GOOD, "there is no score after step 0"),
    "only before training": (GOOD + "a,0,0,1\n", "there is no score after step 0"),
    "no number": (GOOD + "a,0,10,high\n", r"line 2: 'a', '0', '10', 'high': seed and step are whole numbers"),
    "half a seed": (GOOD + "a,0.5,10,1\n", "seed and step are whole numbers"),
    "a tuning seed": (GOOD + "a,1000000,10,1\n", "number the runs of an entry 0, 1, 2"),
    "a path": (GOOD + "../a,0,10,1\n", "without slashes"),
    "controls": (GOOD + "a\x1b[2J,0,10,1\n", r"entry 'a\\x1b\[2J': a name is one line"),
    "a long name": (GOOD + "a" * 81 + ",0,10,1\n", "1 to 80 characters"),
    "a long line": (GOOD + "a" * run_files._LONGEST_LINE, "a line of it has 1,000,000 characters"),
    "copies": (lines([(s, t, t) for s in (0, 1) for t in (1, 2, 3)]), "seeds 0 and 1 of 'a' have the same"),
    "below 0": (
        GOOD + "a,0,10,-1\n",
        "at step 10 is -1, and .* leave maximum out, and type thresholds=60,75,90",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_csv_is_refused_and_nothing_is_written(case: str, tmp_path: Path) -> None:
    content, message = BAD[case]
    path = tmp_path / "curves.csv"
    path.write_text(content)
    with pytest.raises(QrlSuiteError, match=message) as refused:
        api.import_curves(path, maximum=100, runs=tmp_path / "runs")
    assert str(refused.value).isprintable()
    assert not (tmp_path / "runs").exists()


def test_thresholds_and_scores_are_rounded_alike(tmp_path: Path) -> None:
    """6 of 11 reaches 6 / 11, and 4e-8 is not 1e-9."""
    generator = np.random.default_rng(0)
    wins = {
        name: (range(20), 6.0 * (generator.random((20, 30)) < share))
        for name, share in (("a", 0.9), ("b", 0.3))
    }
    verdicts = []
    for task, options in (("raw", {}), ("share", {"maximum": 11})):
        api.import_curves(
            wins, steps=10 * np.arange(1, 31), task=task, thresholds=[6], runs=tmp_path, **options
        )
        found = api.compare("a", "b", task=task, runs=tmp_path, rule="paper")
        assert found.cells is not None
        said = found.sentence.partition("; final")[0]
        verdicts.append((said, str(found.cells.outcome), found.pair.times.means.tolist()))
    assert verdicts[0] == verdicts[1]
    assert verdicts[0][0].startswith("a needs")
    steps, noise = 10 * np.arange(1, 4), 1 + generator.random((20, 1))
    losses = {"good": (range(20), [1e-1, 1e-9, 1e-9] * noise), "bad": (range(20), [1e-1, 4e-8, 4e-8] * noise)}
    api.import_curves(losses, steps=steps, task="loss", thresholds=[1e-8], goal="below", runs=tmp_path)
    assert api.compare("good", "bad", task="loss", runs=tmp_path).pair.times.means.ravel().tolist() == [
        10,
        30,
    ]


COLUMNS = {
    "Model,run,global_step,charts/episodic_return": "a,1,10,3",
    "run,seed,global_step,charts/episodic_return": "a,1,10,3",
    "run,seed,timesteps,charts/episodic_return": "x__a__1__1700000000,1,10,3",
    "group,run_name,seed,Step,validation/score,loss": "a,a_1,1,10,3,7",
    "exp_name,run_name,seed,episode,score": "a,x__a__1__1700000000,1,10,3",
    "Step,a_1 - rollout/ep_rew_mean,a_1 - rollout/ep_rew_mean__MIN,a_2 - rollout/ep_rew_mean": "10,3,0,",
    "global_step,x__a__1__1700000000 - charts/episodic_return": "10,3",
}


@pytest.mark.parametrize("columns", COLUMNS)
def test_columns_may_have_their_usual_other_names(columns: str, tmp_path: Path) -> None:
    path = tmp_path / "curves.csv"
    path.write_text(f"{columns}\n{COLUMNS[columns]}\n")
    [((entry, seed), own)] = points.read_files([path]).items()
    assert (entry.rpartition("__")[2], seed, own.steps.tolist(), own.scores.tolist()) == ("a", 1, [10], [3])
    assert own.metric.partition(" by ")[0] in columns


def test_files_of_one_run_are_named_by_their_paths(tmp_path: Path) -> None:
    """As two programs leave them: entries and seeds stand in no column, other metrics in rows of their own."""
    for name, head, row in (
        (
            "cleanrl/CartPole-v1__ppo__1__1700000000.csv",
            "global_step,loss,charts/episodic_return",
            "10,,3\n10,,4\n11,1,",
        ),
        ("mine/seed_1.csv", "step,charts/episodic_return", "10,5"),
    ):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(f"{head}\n{row}\n")
    found = points.read_files(sorted(tmp_path.glob("*/*.csv")))
    assert {run: own.scores.tolist() for run, own in found.items()} == {
        ("cleanrl CartPole-v1__ppo", 1): [4],
        ("mine", 1): [5],
    }
    (tmp_path / "mine" / "seed_1.csv").write_text("step,score\n10,\n")
    with pytest.raises(QrlSuiteError, match="line 2: no step and score: '10,'"):
        points.read_files([tmp_path / "mine" / "seed_1.csv"])


def test_curves_of_racetraq_as_they_are_published(qrlsuite: Callable[..., Any]) -> None:
    """Eight real runs each, as their author wrote them; some evaluations are one or two episodes late.

    Numbers of `data/studies/chicane_4q/cells.json` in github.com/JanLahmann/racetraQ, commit a9f936f (Apache-2.0,
    doi 10.5281/zenodo.23270600), copied one by one into csv.
    """
    path = Path(__file__).with_name("racetraq_chicane_4q.csv")
    assert "type metric=NAME, where NAME is the score: lapped_share, mean_return" in refused("import", path)
    done = qrlsuite("import", path, "metric=lapped_share", "maximum=1")
    said = done.stdout
    assert "note" not in done.stderr, "eight seeds are enough for a verdict"
    assert "score: lapped_share by episode\ngrid: every 50 steps" in said
    shares = {entry: api.load(entry).curves for entry in ("quantum base", "mlp")}
    assert {entry: curves.shape for entry, curves in shares.items()} == dict.fromkeys(shares, (8, 16))
    assert [round(float(curves[:, -1].mean()), 4) for curves in shares.values()] == [0.3854, 0.9792]
    verdict = api.compare("quantum base", "mlp").sentence
    assert verdict.startswith(
        "quantum base needs 282% more steps than mlp (172% to 481%, 8 seeds each, p = .0002)"
    )


def test_a_copy_of_a_seed_that_was_imported_before_is_refused(tmp_path: Path) -> None:
    first, later = tmp_path / "first.csv", tmp_path / "later.csv"
    first.write_text(lines([(0, t, t) for t in (1, 2, 3)]))
    later.write_text(
        lines([(s, t, t + s) for s in (7, 8) for t in (1, 2, 3)] + [(9, t, t) for t in (1, 2, 3)])
    )
    api.import_curves(first, maximum=100, runs=tmp_path / "runs")
    with pytest.raises(QrlSuiteError, match="seeds 0 and 9 of 'a' have the same curve"):
        api.import_curves(later, maximum=100, runs=tmp_path / "runs")
    assert len(list((tmp_path / "runs").glob("*/*/seed-*"))) == 1
    [again] = api.import_curves(first, maximum=100, runs=tmp_path / "runs")
    assert again.known == (0,)


def test_what_a_good_score_is_has_to_be_said(csv: Path, tmp_path: Path) -> None:
    for options, message in (
        ({}, "'external' is a new task: say what a good score is with maximum"),
        ({"maximum": -1.0}, "maximum = -1.0: Input should be greater than 0"),
        ({"maximum": 10.0, "thresholds": [20]}, "up to maximum=10"),
        ({"thresholds": [20, 20]}, "give each once"),
        ({"maximum": 100.0, "thresholds": [0.1, 0.2]}, "every run is above them .* which lie between"),
        ({"maximum": 100.0, "task": "../up"}, "--task ../up: name"),
        ({"maximum": 100.0, "every": 0}, "every = 0"),
    ):
        with pytest.raises(QrlSuiteError, match=message):
            api.import_curves(csv, runs=tmp_path / "runs", **options)
    assert not (tmp_path / "runs").exists()


def test_huge_files_are_refused_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "huge.csv"
    with path.open("wb") as file:
        file.truncate(run_files.MOST_BYTES + 1)
    with pytest.raises(QrlSuiteError, match="larger than 1000 MB"):
        points.read_files([path])
    os.mkfifo(tmp_path / "pipe.csv")  # to open it would take for ever
    with pytest.raises(QrlSuiteError, match=r"pipe\.csv cannot be read: not a regular file"):
        points.read_files([tmp_path / "pipe.csv"])
    monkeypatch.setattr(points, "MOST_POINTS", 10)
    with pytest.raises(QrlSuiteError, match="more than 10 points"):
        points.read_files([write_csv(tmp_path / "a.csv", {"a": [[1.0] * 11]}, range(1, 12))])


@pytest.fixture(scope="module")
def sb3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of Stable-Baselines3, with every file that it writes."""
    sb = pytest.importorskip("stable_baselines3")
    import gymnasium
    from stable_baselines3.common import logger
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.monitor import Monitor

    logs = tmp_path_factory.mktemp("logs")
    for name, width in (("small", 4), ("large", 8)):
        folder = logs / name / "seed-3"
        folder.mkdir(parents=True)
        env, test = (Monitor(gymnasium.make("CartPole-v1"), where) for where in (f"{folder}/", None))
        model = sb.PPO(
            "MlpPolicy", env, n_steps=64, n_epochs=1, seed=3, policy_kwargs={"net_arch": [width]},
            device="cpu",
        )  # fmt: skip
        model.set_logger(logger.configure(str(folder / "PPO_1"), ["csv", "tensorboard"]))
        check = EvalCallback(test, log_path=str(folder), eval_freq=100, n_eval_episodes=2, verbose=0)
        model.learn(256, callback=check)
        model.get_env().close()
        model.logger.close()
    return logs


def test_evaluations_of_stable_baselines3(sb3: Path, tmp_path: Path) -> None:
    done = api.import_curves(sorted(sb3.glob("*/*/evaluations.npz")), maximum=500, runs=tmp_path)
    assert [(each.label, each.new) for each in done] == [("external large", (3,)), ("external small", (3,))]
    evaluated = np.load(sb3 / "small" / "seed-3" / "evaluations.npz")
    assert evaluated["timesteps"].tolist() == [100, 200]
    curve = EntryStore(done[1].store.path).seed(3).read().curve
    np.testing.assert_allclose(curve, evaluated["results"].mean(axis=1) / 500, atol=1e-7)


def test_monitor_files_of_stable_baselines3(sb3: Path) -> None:
    found = points.read_files(sorted(sb3.glob("*/*/monitor.csv")))
    assert sorted(found) == [("large", 3), ("small", 3)]
    frame = (sb3 / "small" / "seed-3" / "monitor.csv").read_text().splitlines()[2:]
    lengths = [int(line.split(",")[1]) for line in frame]
    own = found["small", 3]
    assert own.steps.tolist() == np.cumsum(lengths).tolist()
    np.testing.assert_allclose(own.scores, [np.mean(lengths[: k + 1]) for k in range(len(lengths))])


@pytest.mark.parametrize("name", ["events*", "progress.csv"])
def test_scalars_that_stable_baselines3_logs(sb3: Path, name: str) -> None:
    """A run's folder is called PPO_1, and it is seed 1; evaluations come before training episodes."""
    pytest.importorskip("tensorboard")
    files = sorted(sb3.glob(f"*/*/PPO_1/{name}"))
    found = points.read_files(files)
    assert sorted(found) == [("large", 1), ("small", 1)]
    evaluated = np.load(sb3 / "small" / "seed-3" / "evaluations.npz")
    assert found["small", 1].steps.tolist() == [100, 200]
    np.testing.assert_allclose(found["small", 1].scores, evaluated["results"].mean(axis=1), rtol=1e-6)
    assert points.read_files(files, "rollout/ep_rew_mean")["small", 1].steps.tolist() == [64, 128, 192, 256]
    with pytest.raises(QrlSuiteError, match=r"metric=NAME.*eval/mean_reward"):
        points.read_files(files, "reward")


def test_event_files_without_records(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    torn = tmp_path / "seed-1" / "events.out.tfevents.torn"
    torn.parent.mkdir()
    torn.write_bytes(b"no records")
    with pytest.raises(QrlSuiteError, match="name the scalar that is the score"):
        points.read_files([torn])


def test_progress_files_are_told_by_their_columns(tmp_path: Path) -> None:
    path = tmp_path / "seed-1" / "progress.csv"
    path.parent.mkdir()
    path.write_text("time/total_timesteps,note,rollout/ep_rew_mean\n,a callback,\n32,,5\n64,,high\n")
    with pytest.raises(QrlSuiteError, match=r"line 4: no step and score: '64,,high'"):
        points.read_files([path])
    path.write_text("entry,seed,step,score\nmine,1,10,0.5\n")
    assert list(points.read_files([path])) == [("mine", 1)], "a name alone says nothing"


def test_what_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    path = tmp_path / "seed-1" / "events.out.tfevents.1"
    path.parent.mkdir()
    path.touch()
    with pytest.raises(QrlSuiteError, match=r"pip install tensorboard"):
        points.read_files([path])


def test_names_come_from_what_differs_between_paths(sb3: Path, tmp_path: Path) -> None:
    content = (sb3 / "small" / "seed-3" / "evaluations.npz").read_bytes()

    def named(*paths: str) -> list[tuple[str, int]]:
        for name in paths:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes(content)
        return sorted(points.read_files([tmp_path / name for name in paths]))

    file = "evaluations.npz"
    assert named(f"x/ppo/CartPole-v1_1/{file}", f"x/a2c/CartPole-v1_2/{file}") == [("a2c", 2), ("ppo", 1)]
    assert named(f"y/small_seed3/{file}", f"y/large_seed3/{file}") == [("large", 3), ("small", 3)]
    assert named("z/small-0.npz", "z/small-1.npz") == [("small", 0), ("small", 1)]
    with pytest.raises(QrlSuiteError, match="which seed is 'alone'"):
        named(f"alone/{file}")
    with pytest.raises(QrlSuiteError, match="are both seed 1 of 'v' by their paths"):
        named(f"v/run-1/{file}", f"v/run_1/{file}")


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def bomb() -> bytes:
    """Return an npz file of which an array's head promises a billion numbers."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**9,)})
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("timesteps.npy", head.getvalue())
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"PK nonsense", "is not a readable npz file"),
        (npz(timesteps=np.array([1, 2])), "found timesteps.npy"),
        (npz(timesteps=np.array([{}]), results=np.ones((1, 1))), "Python objects, which are never unpickled"),
        (npz(timesteps=np.array([1, 2]), results=np.ones(2)), r"results of shape \(2,\)"),
        (npz(timesteps=np.array([1]), results=np.full((1, 1), np.nan)), "is nan"),
        (bomb(), "does not have the bytes of an array of shape"),
    ],
)
def test_bad_npz_is_refused(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "seed-0" / "evaluations.npz"
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(QrlSuiteError, match=message):
        points.read_files([path])


def test_files_and_folders_are_told_apart(qrlsuite: Callable[..., Any], csv: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").touch()
    for words, message in (
        (("empty",), "holds no entry"),
        (("empty", csv), "import folders and files with separate commands"),
        (("empty", "maximum=3"), "maximum is for files with curves"),
        (("notes.txt",), "give a csv file with the columns entry,seed,step,score"),
        (("none.csv",), "none.csv cannot be read: No such file or directory"),
        ((csv, "thresholds=high"), "thresholds.0 = 'high': Input should be a valid number"),
    ):
        assert message in refused("import", *words), words


@pytest.mark.parametrize("options", [(), ("maximum=500",)])
def test_a_folder_of_other_programs_is_answered_with_what_to_type(
    tmp_path: Path, options: tuple[str, ...]
) -> None:
    logs = tmp_path / "my logs"
    for name in ("a/seed-0", "a/seed-1", "b/seed-0", ".old/seed-0"):
        (logs / name).mkdir(parents=True)
        (logs / name / "evaluations.npz").touch()
        (logs / name / "progress.csv").touch()
    said = (
        f"{logs} holds 3 evaluations.npz: qrlsuite import '{logs}'/*/*/evaluations.npz maximum=500, where 500"
    )
    assert said in refused("import", logs, *options)


def test_seeds_are_planned_like_those_of_a_file(
    qrlsuite: Callable[..., Any], csv: Path, tmp_path: Path
) -> None:
    words = ("power", "--like", csv, "maximum=100", "--draws", 20)
    assert "external slow lr=0.01 against external fast lr=0.1: 1" in qrlsuite(*words).stdout
    assert "against" not in qrlsuite(*words, "fast").stdout
    assert not (tmp_path / "runs").exists(), "nothing is imported"
    assert "'external' is a new task: say what a good score is" in refused("power", "--like", csv)
    assert "name one or two entries: qrlsuite power" in refused("power")


def test_names_of_one_s_own_are_shown_as_they_are(
    qrlsuite: Callable[..., Any], csv: Path, tmp_path: Path
) -> None:
    qrlsuite("import", csv, "maximum=100")
    own = ["--label", "fast=Ours, lr=0.1", "--label", "slow lr=0.01=external baseline"]
    assert qrlsuite("compare", "fast", "slow", *own).stdout.startswith("Ours, lr=0.1 needs")
    table = qrlsuite("leaderboard", *own, "--format", "csv").stdout
    assert [name in table for name in ("Ours, lr=0.1", "external baseline", "slow lr")] == [True, True, False]
    assert json.loads(qrlsuite("compare", "fast", "slow", *own, "--out", "verdict.tex", "--json").stdout)
    verdict = (tmp_path / "verdict.tex").read_text()
    assert r"\caption{Ours, lr=0.1 needs 53\% fewer steps than external baseline (" in verdict
    qrlsuite("leaderboard", *own, "--out", "board.tex")
    assert r"& Ours, lr=0.1 & $" not in (board := (tmp_path / "board.tex").read_text())
    assert "1 & Ours, lr=0.1 & " in board
    assert "end it with .html, .tex, .md" in refused("leaderboard", "--out", "board.txt")
    qrlsuite("plot", "curves", *own, "--out", tmp_path / "curves.svg")
    figure = api.plot(
        "curves", entries=[api.load("fast").labeled("a" * 70 + "1"), api.load("slow").labeled("a" * 70 + "2")]
    )
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [text.partition("  ")[0][-1] for text in texts[:2]] == ["1", "2"], (
        "never cut so that two are alike"
    )
    for words, message in (
        (["--label", "fest=x"], "no entry 'fest' in runs"),
        (["--label", "fast=x", "--label", "slow=x"], "another text for each entry"),
        (["--label", "fast"], "--label fast: write ENTRY=TEXT"),
    ):
        assert message in refused("compare", "fast", "slow", *words)
