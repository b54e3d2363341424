"""The progress display: what it says from what the groups report."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import pytest

from qrlsuite import registry, specs
from qrlsuite.engine.display import Bar, CostEstimate, RunDisplay
from qrlsuite.engine.missing import summarize
from qrlsuite.engine.terminal import as_command
from qrlsuite.engine.work import Missing
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.results.progress import Progress, ProgressFile
from qrlsuite.results.seeds import SeedGroup
from qrlsuite.results.store import EntryStore
from tests.commands import qrlsuite, say

PAIR = [SeedGroup((0, 1, 2), 0), SeedGroup((3, 4), 0)]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What the display takes for the time."""
    now = [1000.0]
    monkeypatch.setattr("qrlsuite.engine.display.time.monotonic", lambda: now[0])
    return now


@pytest.fixture
def entry(tiny_task: str) -> Entry:
    return resolve(tiny_task, "mlp width=16")


@pytest.mark.parametrize(("columns", "left_out"), [(80, 5), (100, 2), (165, 0)])
def test_a_narrow_terminal_shows_fewer_columns_and_says_which(columns: int, left_out: int) -> None:
    words = ["leaderboard", "--task", "beam6g", "--published", "--explain"]
    done = say(*words, FORCE_COLOR="1", COLUMNS=str(columns))
    lines = [re.sub("\x1b\\[[0-9;]*m", "", line).rstrip() for line in done.output.splitlines()]
    assert max(map(len, lines)) <= columns
    assert any("42.6k (40.8k to 44.4k)" in line for line in lines), "no number is broken over lines"
    told = " ".join(lines).partition("or --format markdown, also shows ")[2]
    heads = ("final score", "seeds", "core-hours", "parameters", "settings")
    assert [name for name in heads if name in told] == list(heads[len(heads) - left_out :])


def test_seeds_of_a_longer_run_take_no_time_in_a_shorter_one(entry: Entry, tmp_path: Path) -> None:
    groups = [SeedGroup((0, 1), 8), SeedGroup((2,), 3)]
    assert Missing(tmp_path, entry, EntryStore(tmp_path), range(3), 5, groups=groups).left == 2


def test_the_last_median_shown_is_the_summary_s(train, entry, tmp_path, capsys, monkeypatch) -> None:
    path: Path = train("runs", [0, 1, 2])
    train("runs", [3, 4])
    store = EntryStore(path)
    snapshot = {group.id: ProgressFile(store, group.id).read() for group in PAIR}
    monkeypatch.setattr("qrlsuite.engine.display.PLAIN_SECONDS", 0.0)
    plan = Missing(path.parents[1], entry, store, range(5), 3, groups=PAIR)
    RunDisplay(plan, 2).update(snapshot)
    shown = re.search(r"median score (\S+)", capsys.readouterr().err)
    expected = summarize(plan)["median_score"]
    assert shown is not None
    assert shown[1] == f"{expected:.3f}"
    assert len({state["median_score"] for state in snapshot.values()}) == 2, "the groups must differ"


@pytest.mark.parametrize(("again", "limit"), [("command", "--budget"), ("call", "`budget`")])
def test_the_end_of_the_time_is_explained_in_the_words_of_the_caller(
    again: str, limit: str, entry: Entry, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = Missing(tmp_path, entry, EntryStore(tmp_path / "tiny" / entry.name), range(5), 3, groups=PAIR)
    with as_command() if again == "command" else contextlib.nullcontext():
        RunDisplay(plan, 1).out_of_time("90s")
    message = capsys.readouterr().err
    assert "stopped after 90s, at epoch 0 of 3" in message
    assert f"The same {again} continues from there, and without {limit} to the end." in message


def test_a_short_first_epoch_is_no_measure() -> None:
    """The first took a minute to start and compile; the second group waits for the only worker."""
    estimate = CostEstimate(PAIR, epochs=10, workers=1)
    first = PAIR[0].id

    def left(epoch: int, now: float, phase: str = "training") -> float | None:
        return estimate.remaining({first: {"phase": phase, "epoch": epoch, "done": 1, "total": 9}}, now)

    assert [left(0, 0.0, "compiling"), left(0, 50.0), left(1, 66.0), left(1, 68.0)] == [None] * 4
    once, other = 60.0, 2 / 3 * 10 * 6.0
    assert left(2, 72.0) == pytest.approx(8 * 6.0 + once + other)
    assert left(2, 76.0) == pytest.approx(8 * 6.0 - 4 + once + other)
    assert left(2, 82.0) == pytest.approx(8 * 10.0 - 10 + once + other), "an epoch is as long as it has taken"
    assert left(10, 120.0, "finished") == pytest.approx(once + 2 / 3 * 10 * 6.0, rel=0.1)


def test_seeds_that_are_trained_later_count_in_the_time_that_is_left(
    clock: list[float], entry: Entry, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two of four seeds are trained at a time, ten epochs of a second each; so the second half begins at epoch 0."""
    group = SeedGroup((0, 1, 2, 3), 0)
    display = RunDisplay(Missing(tmp_path, entry, EntryStore(tmp_path), range(4), 10, groups=[group]), 1)
    drawn: list[float] = []
    display.bar = Bar(display.console)
    display.bar.update = lambda done, *_: drawn.append(done)  # type: ignore[method-assign]
    display.bar._cell = True
    left = []
    for turn, epoch in [(0, 1), (0, 2), (0, 10), (1, 0), (1, 5), (1, 10)]:
        clock[0] = 1000.0 + 10 * turn + epoch
        state = {"phase": "training", "epoch": epoch, "turn": turn, "turns": 2}
        left.append(display.estimate.remaining({group.id: state}, clock[0]))
        display.update({group.id: state})
    assert left == [None, *map(pytest.approx, [18.0, 10.0, 10.0, 5.0, 0.0])]
    assert drawn == [2.0, 4.0, 20.0, 20.0, 30.0, 40.0]


def test_the_pace_is_that_of_the_later_half() -> None:
    """Something else begins on the machine after epoch 10."""
    estimate = CostEstimate(PAIR[:1], epochs=100, workers=1)
    now = 0.0
    for epoch in range(41):
        left = estimate.remaining({PAIR[0].id: {"phase": "training", "epoch": epoch}}, now)
        now += 1.0 if epoch < 10 else 3.0
    assert left == pytest.approx(60 * 3.0)


@pytest.mark.parametrize(
    ("states", "said"),
    [
        ({}, "starting"),
        ({"phase": "compiling"}, "compiling circuits: once per machine"),
        ({"phase": "training", "epoch": 1}, "measuring"),
    ],
)
def test_phases_before_the_first_measure_have_names(
    states, said, entry, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr("qrlsuite.engine.display.PLAIN_SECONDS", 0.0)
    display = RunDisplay(Missing(tmp_path, entry, EntryStore(tmp_path), range(3), 9, groups=PAIR[:1]), 1)
    display.update({PAIR[0].id: states})
    assert f"  {said}" in capsys.readouterr().err


def test_resumed_groups_say_where_they_stand(entry, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("qrlsuite.engine.display.PLAIN_SECONDS", 0.0)
    groups = [SeedGroup((0, 1, 2), 10), SeedGroup((3, 4), 3), SeedGroup((5,), 0)]
    display = RunDisplay(Missing(tmp_path, entry, EntryStore(tmp_path), range(6), 20, groups=groups), 1)
    display.begin()
    display.update({})
    said = " ".join(capsys.readouterr().err.split())
    assert "6 seeds to epoch 20, 1 process; 5 resume at epoch 3 to 10." in said
    assert "epoch 0 to 10/20" in said


@pytest.mark.parametrize(
    ("rounds", "said"),
    [
        (lambda second: second // 5, "25 min or more left, by the first rounds"),
        (lambda second: 100 * (second > 0), "80 s or more left, by the first rounds"),
    ],
    ids=["learns at every round", "learns when all are done"],
)
def test_the_first_rounds_tell_what_is_left_and_two_epochs_whether_that_is_long(
    rounds, said, entry, tmp_path, capsys, clock
) -> None:
    """Compilation apart: DDQN takes 500 s an epoch; of PPO, which learns after its rounds, the least is known."""
    epochs = 3 if "25" in said else 5
    display = RunDisplay(Missing(tmp_path, entry, EntryStore(tmp_path), range(3), epochs, groups=PAIR[:1]), 1)
    state = {"phase": "compiling", "epoch": 0}

    def show(seconds: int) -> str:
        clock[0] += seconds
        display.update({PAIR[0].id: state})
        return " ".join(capsys.readouterr().err.split())

    assert "left" not in show(0) + show(500)
    state |= {"phase": "training", "total": 100}
    lines = ""
    for second in range(41):
        state["done"] = rounds(second)
        lines += show(1)
    assert said in lines
    assert "faster: " not in lines


@pytest.mark.parametrize("backend", ["pennylane", "qiskit", "native"])
def test_a_slow_simulator_names_the_fast_one_before_it_trains(
    backend: str, tiny_task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = resolve(tiny_task, f"vqc-{backend} qubits=2 layers=1")
    plan = Missing(tmp_path, entry, EntryStore(tmp_path / "tiny" / entry.name), range(5), 3, groups=PAIR)
    RunDisplay(plan, 1).begin(submits=True)
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("faster: ")]
    assert len(said) == (backend != "native")
    for line in said:
        assert re.match(r"faster: --model vqc-native computes the same, \d+ to \d+ times faster", line)
        assert ("--set device=qrlsuite.native" in line) == (backend == "pennylane")


SHIPPED = [
    each.spec.name
    for each in registry.load().of(specs.ModelSpec).values()
    if each.distribution == "qrlsuite" and each.spec.name != specs.NO_MODEL
]


@pytest.mark.long
@pytest.mark.parametrize("model", SHIPPED)
def test_a_quick_run_of_every_shipped_model_ends(model: str, tmp_path: Path) -> None:
    task = "room" if model == "cnn" else "beam6g"
    remembers = model.startswith(("qlstm", "qfwp", "gru", "lstm"))
    words = ["run", f"{'drqn ' * remembers}{model}", "--task", task, "--quick", "--workers", "2"]
    done = qrlsuite(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    seeds, epochs = registry.get(specs.ModelSpec, model).quick
    assert re.search(rf"{seeds} seeds complete, .* after epoch {epochs}\n", done.stderr)


def test_more_than_a_day_is_an_alarm_from_the_second_epoch_on(entry, tmp_path, capsys, clock) -> None:
    late = RunDisplay(Missing(tmp_path, entry, EntryStore(tmp_path), range(3), 10_000, groups=PAIR[:1]), 1)
    for second in range(46):
        state = {"phase": "training", "epoch": second // 15, "done": second % 15, "total": 15}
        late.update({PAIR[0].id: state})
        clock[0] += 1.0
        assert late.endless is (second >= 30)
    assert capsys.readouterr().err.count("faster: ") == 1


def test_the_last_round_of_training_is_always_on_disk(tmp_path: Path) -> None:
    """What follows it may be long, and a display knows by it that no round is under way."""
    file = ProgressFile(EntryStore(tmp_path), "g")
    for done in range(1, 5):
        file.write(Progress(phase="training", done=done, total=4))
        assert file.read()["done"] == (4 if done == 4 else 1)


@pytest.mark.parametrize("submits", [False, True])
def test_what_is_submitted_cannot_be_stopped_by_ctrl_c(entry, tmp_path, capsys, submits) -> None:
    plan = Missing(tmp_path, entry, EntryStore(tmp_path), range(7), 3, frozenset({5, 6}), PAIR)
    display = RunDisplay(plan, 2)
    display.begin(submits)
    display.close()
    shown = " ".join(capsys.readouterr().err.split())
    assert ("Ctrl-C saves" in shown) is not submits
    assert ("5 seeds to epoch 3, 2 tasks" in shown) is submits
    assert ("2 seeds wait in the queue" in shown) is submits


@pytest.mark.parametrize(("epsilons", "said"), [("[0.6, 0.8]", False), ("[0.0001, 0.0002]", True)])
def test_the_end_says_that_no_threshold_was_reached(
    epsilons: str, said: bool, train, tiny_task: str, capsys
) -> None:
    path: Path = train("runs", [0, 1, 2])
    task = Path(tiny_task)
    lowered = task.read_text().replace("epsilons = [0.6, 0.8]", f"epsilons = {epsilons}")
    task.write_text(lowered.replace("epsilon = 0.6", f"epsilon = {epsilons[1:].partition(',')[0]}"))
    entry = resolve(tiny_task, "mlp width=16")
    plan = Missing(path.parents[1], entry, EntryStore(path), range(3), 3, groups=PAIR[:1])
    summary = summarize(plan)
    assert summary["threshold_reached"] is not said
    RunDisplay(plan, 1).finished(summary)
    end = capsys.readouterr().err
    line = (
        f"no seed reached a threshold: the lowest is {summary['lowest_threshold']:.4g}, the best score seen "
        f"{summary['best_score']:.4g}."
    )
    assert (line in end) is said
    assert ("(leaderboard --by area)" in end) is said
    assert ("([ranking] in the task file)" in end) is said
