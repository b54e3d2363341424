"""Decision plans at work: written, run look by look, interrupted, refused."""

from __future__ import annotations

import functools
import json
import math
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from qrlsuite import api, registry
from qrlsuite.cli import main
from qrlsuite.cli.app import build
from qrlsuite.engine.api import EngineOutcome, Show, Work
from qrlsuite.engine.worker import train_group
from qrlsuite.errors import TaskError
from qrlsuite.experiment import identity
from qrlsuite.experiment.preset import PresetFile, TuningRecord, dumps
from qrlsuite.leaderboard.pictures import outcome as drawing
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.results.store import EntryStore, json_line, table_bytes
from qrlsuite.specs import EngineSpec
from qrlsuite.studies import outcome as outcomes
from tests.commands import qrlsuite, start
from tests.conftest import HANGS, TINY, Hold, results

ROOT = Path(__file__).parents[2]

STARTS = {
    "width=16": lambda seed: 11 + seed % 2,
    "width=8": lambda seed: 11 + (seed + 1) % 2,
    "width=4": lambda seed: 16 + seed % 3,
    "width=2": lambda seed: 4 + 7 * seed % 20,
}
"""The epoch at which a run of an entry reaches every threshold, and stays there."""


@functools.cache
def curve(epochs: int, start: int) -> bytes:
    rows = [{"epoch": t, "scores": [0.5 * (t >= start)] * 5} for t in range(1, epochs + 1)]
    return table_bytes(rows)


def put(store: EntryStore, seed: int, epochs: int, start: int) -> None:
    """Leave a finished run as a worker would, of 36 core-seconds."""
    folder = store.seed(seed)
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.table.write_bytes(curve(epochs, start))
    timings = [json_line({"epoch": t, "cpu": 36 / epochs}) for t in range(1, epochs + 1)]
    folder.timings.write_bytes(b"".join(timings))
    planned = {"plan": plan} if (plan := store.entry().plan) else {}
    names = {"seed": seed, **store.names}
    began = {
        **planned,
        **names,
        "code": identity.of(store.entry()).record(),
        "parameters": {},
        "provenance": [],
    }
    folder.write_record({**began, "status": "finished", "epochs": epochs})


class Scripted:
    """An engine whose runs are known: each reaches the goal when `STARTS` says."""

    trained: list[tuple[str, int, int]] = []  # noqa: RUF012 - emptied by the fixture
    interrupt_at = -1
    """The group before which Ctrl-C comes."""

    def __init__(self, options: None = None) -> None:
        pass

    def workers(self, asked: int | None) -> int:
        return 1

    def queued(self, store: EntryStore) -> set[int]:
        return set()

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        [work] = works
        for group in work.groups:
            if len(self.trained) == self.interrupt_at:
                raise KeyboardInterrupt
            width = work.store.record()["label"].split()[-1]
            for seed in group.seeds:
                put(work.store, seed, work.epochs, STARTS[width](seed))
            self.trained.append((width, group.seeds[0], len(group.seeds)))
        return EngineOutcome()


class Queue(Scripted):
    """An engine that hands work over and leaves."""

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        [work] = works
        return EngineOutcome(submitted=f"{sum(len(group.seeds) for group in work.groups)} seeds submitted")


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    known = registry.load().entries["engines"]
    for name, cls in (("scripted", Scripted), ("queue", Queue)):
        spec = EngineSpec(name, "for tests", f"{__name__}:{cls.__name__}")
        monkeypatch.setitem(known, name, registry.Registered(spec, "tests"))
    Scripted.trained.clear()
    monkeypatch.setattr(Scripted, "interrupt_at", -1)
    monkeypatch.chdir(tmp_path)
    text = TINY.replace("seeds = 4\nepochs = 3", "seeds = 100\nepochs = 20\nalgorithm_epochs = { ppo = 30 }")
    Path("tiny.toml").write_text(text)


def say(*words: str) -> Result:
    return CliRunner().invoke(build(), ["decide", *words], catch_exceptions=False)


def answer(*words: str) -> dict[str, Any]:
    result = say(*words, "--json")
    assert result.exit_code == 0, result.output
    content: dict[str, Any] = json.loads(result.stdout)
    return content


def write(*words: str, plan: str = "widths.toml") -> str:
    entries = [word for word in words if "width" in word] or ["mlp width=16", "mlp width=8", "mlp width=4"]
    answer("new", plan, *entries, "--task", "tiny.toml", *(word for word in words if "width" not in word))
    return plan


def edit(plan: str, old: str, new: str) -> None:
    text = Path(plan).read_text()
    assert text.count(old) == 1
    Path(plan).write_text(text.replace(old, new))


def error(*words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """Run a command that refuses its input, in one line and without touching a file; returns the line."""
    before = {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
    monkeypatch.setattr(sys, "argv", ["qrlsuite", "decide", *words])
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main()
    printed = capsys.readouterr()
    assert stopped.value.code == 2
    assert len(printed.err.strip().splitlines()) == 1, printed.err
    assert printed.out == ""
    assert before == {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
    return printed.err


Refused = Callable[..., str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Refused:
    return lambda *words: error(*words, capsys=capsys, monkeypatch=monkeypatch)


def test_an_entry_stops_when_all_its_pairs_are_closed() -> None:
    """Width 4 is slower in every run: 20 seeds show it. Widths 16 and 8 are equal: that takes 40."""
    found = answer("run", write(), "--engine", "scripted")
    assert Scripted.trained == [
        ("width=16", 10000, 20),
        ("width=8", 10000, 20),
        ("width=4", 10000, 20),
        ("width=16", 10020, 20),
        ("width=8", 10020, 20),
    ]
    verdicts = {(pair["first"], pair["second"]): (pair["verdict"], pair["seeds"]) for pair in found["pairs"]}
    assert verdicts == {
        ("mlp width=16", "mlp width=8"): ("equal within 10 percent", 40),
        ("mlp width=16", "mlp width=4"): ("mlp width=16 needs fewer", 20),
        ("mlp width=8", "mlp width=4"): ("mlp width=8 needs fewer", 20),
    }
    assert found["finished"]
    assert [each["seeds"] for each in found["entries"]] == [40, 40, 20]
    assert [each["core_hours"] for each in found["entries"]] == pytest.approx([0.4, 0.4, 0.2])
    assert found["protocol_seeds"] == 300
    assert found["seeds_saved"] == 60 + 60 + 80
    assert found["core_hours_saved"] == pytest.approx([2.0, 2.0])
    assert list(found["looks_taken"]) == ["20", "40"]
    written = answer("show", "widths.toml")["written"]
    times = [written.replace("Z", "+00:00"), found["begun_at"], *found["looks_taken"].values()]
    assert times == sorted(times)

    log = Path("runs/decisions/widths/looks.jsonl").read_bytes()
    again = answer("run", "widths.toml", "--engine", "scripted")
    assert len(Scripted.trained) == 5, "all is decided: nothing is trained"
    assert again == found == {**answer("status", "widths.toml"), "submitted": []}
    assert Path("runs/decisions/widths/looks.jsonl").read_bytes() == log
    shown = say("status", "widths.toml").stdout
    assert "equal within 10 percent" in shown
    assert "used 100 seeds, 1 core-hours; the protocol has 300 seeds: 200 saved" in shown


def test_ctrl_c_between_groups_changes_no_decision() -> None:
    write()
    straight = answer("run", "widths.toml", "--engine", "scripted", "--runs", "straight")
    for interrupted in (1, 3, 4):  # in the first look, before the second one, and in it
        runs = f"runs-{interrupted}"
        Scripted.trained.clear()
        Scripted.interrupt_at = interrupted
        stopped = say("run", "widths.toml", "--engine", "scripted", "--runs", runs)
        assert stopped.exit_code == 130
        Scripted.interrupt_at = -1
        resumed = answer("run", "widths.toml", "--engine", "scripted", "--runs", runs)
        assert resumed["pairs"] == straight["pairs"]
        assert len(Scripted.trained) == 5, "nothing is trained twice"


def test_a_plan_goes_on_with_the_code_that_began_it(
    refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    write()
    straight = answer("run", "widths.toml", "--engine", "scripted", "--runs", "straight")
    Scripted.interrupt_at = len(Scripted.trained) + 1
    assert say("run", "widths.toml", "--engine", "scripted").exit_code == 130
    Scripted.interrupt_at = -1
    known = registry.load().entries["models"]
    changed = replace(known["mlp"].spec, numerics=2)  # type: ignore[call-arg]
    monkeypatch.setitem(known, "mlp", replace(known["mlp"], spec=changed))
    begun = len(Scripted.trained)
    message = refused("run", "widths.toml", "--engine", "scripted")
    assert "model 'mlp' has numerics 2, and had 1" in message
    assert "Restore that code, or write another plan" in message
    assert len(Scripted.trained) == begun
    resumed = answer("run", "widths.toml", "--engine", "scripted", "--same", "no bit of a score")
    assert resumed["pairs"] == straight["pairs"]


def test_the_example_on_the_page_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    [example] = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "decisions.md").read_text(), re.DOTALL)
    monkeypatch.setitem(
        registry.load().entries["engines"],
        "local",
        registry.Registered(EngineSpec("local", "for tests", f"{__name__}:Scripted"), "tests"),
    )
    write("mlp width=16", "mlp width=2", plan="width.toml")
    exec(example, {})
    assert "mlp width=16 mlp width=2 " in capsys.readouterr().out


def test_python_decides_as_the_command_does() -> None:
    write()
    open_ = api.decide("widths.toml", train=False)
    assert [pair.verdict for pair in open_.pairs] == ["open"] * 3
    assert not Path("runs").exists()
    found = api.decide("widths.toml", engine="scripted", progress=False)
    assert found.finished
    assert json.loads(json.dumps(found.as_dict())) == answer("status", "widths.toml")
    assert "mlp width=16 needs fewer" in found._repr_html_()
    assert api.decide("widths.toml", train=False).pairs == found.pairs
    with pytest.raises(TaskError, match=r"plan nowhere.toml cannot be read"):
        api.decide("nowhere.toml")


def test_a_killed_worker_changes_no_byte(hold: Hold, tmp_path: Path) -> None:
    Path("tiny.toml").write_text(TINY)
    write("mlp width=4", "mlp width=2", "--epochs", "2", "--looks", "2", "--reason", "a test")
    words = ("decide", "run", "widths.toml", "--workers", "1", "--json", "--runs")
    process = start(*words, "killed", env=hold.environment)
    hold.wait(process)
    os.kill(process.pid, signal.SIGINT)
    process.communicate(timeout=HANGS)
    assert process.returncode == 130
    assert not list(Path("killed").glob("**/epochs.parquet"))
    resumed, straight = (json.loads(qrlsuite(*words, runs).stdout) for runs in ("killed", "straight"))
    assert resumed["pairs"] == straight["pairs"]
    assert resumed["finished"]
    hash_ = answer("show", "widths.toml", "--runs", "killed")["hash"]
    for one in Path("killed/decisions/widths/tiny").iterdir():
        other = Path("straight/decisions/widths/tiny") / one.name
        for seed in (10000, 10001):
            assert results(one, seed) == results(other, seed)
            assert json.loads((one / f"seed-{seed}" / "run.json").read_text())["plan"] == hash_


def test_status_says_what_an_open_pair_needs() -> None:
    write("mlp width=16", "mlp width=2")
    assert answer("status", "widths.toml")["pairs"][0]["verdict"] == "open"
    assert "not begun" in say("status", "widths.toml").stdout
    assert not Path("runs").exists()
    Scripted.interrupt_at = 2
    assert say("run", "widths.toml", "--engine", "scripted").exit_code == 130
    found = answer("status", "widths.toml")
    (pair,) = found["pairs"]
    assert (pair["verdict"], pair["seeds"]) == ("open", 20)
    assert pair["needs"]["seeds"] == 40
    assert pair["needs"]["level"] == pytest.approx(0.0152, abs=1e-4)
    assert found["next_core_hours"] == pytest.approx([40 * 0.01] * 2)
    assert [each["missing"] for each in found["entries"]] == [20, 20]
    assert found["seeds_saved"] == 0
    shown = say("status", "widths.toml").stdout
    assert "next look: 40 seeds missing, about 0.4 core-hours" in shown
    assert "p <= 0.015 at 40 seeds" in " ".join(shown.split())


def test_an_ended_plan_stays_as_it_is(refused: Refused) -> None:
    write("mlp width=16", "mlp width=2")
    assert "has not begun" in refused("end", "widths.toml")
    Scripted.interrupt_at = 2
    say("run", "widths.toml", "--engine", "scripted")
    assert say("end", "widths.toml").exit_code == 0
    assert "was ended on 2" in refused("run", "widths.toml", "--engine", "scripted")
    assert "was ended on 2" in refused("end", "widths.toml")
    assert "open pairs stay open" in say("status", "widths.toml").stdout
    write(plan="done.toml")
    Scripted.interrupt_at = -1
    say("run", "done.toml", "--engine", "scripted")
    assert "nothing to end" in refused("end", "done.toml")


def test_a_queue_is_waited_for() -> None:
    found = answer("run", write(), "--engine", "queue")
    assert found["submitted"] == ["20 seeds submitted"] * 3
    assert not found["looks_taken"]
    shown = say("run", "widths.toml", "--engine", "queue").stdout
    assert "others train 20 seeds of mlp width=16, 20 seeds of mlp width=8" in shown


def test_a_new_plan_takes_the_first_unused_seeds() -> None:
    assert answer("show", write())["first_seed"] == 10000
    say("run", "widths.toml", "--engine", "scripted")
    assert answer("show", write(plan="again.toml"))["first_seed"] == 11000
    shown = say("show", "again.toml").stdout
    assert re.search(r"at most 300 seeds: [\d.]+ to [\d.]+ core-hours", shown), (
        "as little is known as elsewhere"
    )
    assert "seeds 11000:11100; any false difference with probability 0.05 (3 pairs, pocock spending)" in shown
    assert "look at 20 seeds: different at p <= 0.0049 while all pairs are open" in shown
    assert "not begun" in shown


def test_a_changed_plan_is_refused_once_it_began(refused: Refused) -> None:
    write()
    edit("widths.toml", "alpha = 0.05", "alpha = 0.01")
    assert answer("show", "widths.toml")["alpha"] == 0.01, "before its first seed it may be changed"
    say("run", "widths.toml", "--engine", "scripted")
    edit("widths.toml", "alpha = 0.01", "alpha = 0.05")
    for command in ("run", "status", "show", "end"):
        message = refused(command, "widths.toml")
        assert "widths.toml: alpha (was 0.01, is 0.05) changed after the plan began. End this plan" in message


def test_seeds_of_others_are_refused(refused: Refused) -> None:
    write("mlp width=16", "mlp width=4", "--epochs", "1")
    subject = EntryStore.create(Path("runs"), _entry("width=4"))
    put(subject, 10003, 1, 1)
    message = refused("run", "widths.toml", "--engine", "scripted")
    assert "seeds 10003:10004 of 'mlp width=4' were trained already (runs/tiny/ddqn-mlp-" in message
    assert "first_seed = 11000" in message
    edit("widths.toml", "first_seed = 10000", "first_seed = 10004")
    say("run", "widths.toml", "--engine", "scripted")
    own = EntryStore(next(Path("runs/decisions/widths/tiny").iterdir()))
    record = json.loads((own.seed(10004).path / "run.json").read_text())
    planless = {key: value for key, value in record.items() if key != "plan"}
    for stranger in ({**record, "plan": "0" * 16}, planless):
        (own.seed(10004).path / "run.json").write_text(json.dumps(stranger))
        assert "seed 10004 of 'mlp width=" in (message := refused("status", "widths.toml"))
        assert "was not trained by plan" in message


def test_curves_that_changed_after_a_look_are_refused(refused: Refused) -> None:
    write()
    say("run", "widths.toml", "--engine", "scripted")
    slow = next(
        store
        for path in Path("runs/decisions/widths/tiny").iterdir()
        if (store := EntryStore(path)).record()["label"].endswith("width=4")
    )
    for seed in range(10000, 10020):
        put(slow, seed, 20, STARTS["width=16"](seed))
    message = refused("status", "widths.toml")
    assert "the look at 20 seeds found 'first needs fewer' for mlp width=16 and mlp width=4" in message
    assert "now give 'None'" in message


def test_every_record_of_a_seed_has_the_hash_of_its_plan() -> None:
    entry = _entry("width=4")
    for runs, subject in (("planned", replace(entry, plan="ab" * 8)), ("runs", entry)):
        store = EntryStore.create(Path(runs), subject)
        train_group(store.path, [0], 1)
        expected = {"plan": "ab" * 8} if runs == "planned" else {}
        record = json.loads((store.seed(0).path / "run.json").read_text())
        assert {key: value for key, value in record.items() if key == "plan"} == expected
        assert (subject.hash, subject.name) == (entry.hash, entry.name)
    planned, plain = (
        EntryStore(Path(runs) / "tiny" / entry.name).seed(0).path for runs in ("planned", "runs")
    )
    assert (planned / "epochs.parquet").read_bytes() == (plain / "epochs.parquet").read_bytes()


def test_no_rule_for_a_fixed_number_of_seeds_judges_a_plans_entries() -> None:
    write()
    say("run", "widths.toml", "--engine", "scripted")
    where = ("--runs", "runs/decisions/widths")
    ranked = CliRunner().invoke(build(), ["leaderboard", *where, "--format", "json"])
    assert json.loads(ranked.stdout)["sections"] == []
    assert ranked.output.count("trained by a decision plan") == 3
    compared = CliRunner().invoke(build(), ["compare", "mlp width=16", "mlp width=4", *where])
    assert "'ddqn mlp width=16' was trained by a decision plan" in str(compared.exception)


def _entry(setting: str) -> Any:
    from qrlsuite.experiment.entry import resolve
    from qrlsuite.options import parse_setting

    return resolve("tiny.toml", "mlp", settings=[parse_setting(setting)])


NEW = ("new", "p.toml", "--task", "tiny.toml")
TWO = (*NEW, "mlp width=16", "mlp width=4")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((*NEW, "mlp"), "1 of two or more entries: write each as"),
        (
            (*NEW, "mlp", "mlp width=16", "ddqn mlp width=16"),
            "entries.1 and entries.2 are the same, 'ddqn mlp width=16': leave one out",
        ),
        ((*NEW, "mlp", "mpl"), "unknown model 'mpl'; did you mean 'mlp'"),
        ((*NEW, "mlp", "mlp widht=4"), "did you mean 'width'"),
        ((*NEW, "mlp", "width=4 mlp"), "entry 'width=4 mlp': mlp: write name=value"),
        (
            (*NEW, "mlp", "ppo mlp"),
            "different horizons: 'ddqn mlp width=64' at 1200 steps, 'ppo mlp width=64' at 1800",
        ),
        ((*TWO, "--alpha", "1"), "alpha = 1.0 is outside (0, 1)"),
        ((*TWO, "--alpha", "0"), "alpha = 0.0 is outside (0, 1)"),
        ((*TWO, "--looks", "20,40,40"), "each must be at more runs than the one before"),
        ((*TWO, "--looks", "40,20"), "each must be at more runs than the one before"),
        ((*TWO, "--looks", "10,20"), "the first is below 20 runs"),
        ((*TWO, "--looks", "20;40"), "--looks 20;40: write numbers of seeds"),
        ((*TWO, "--margin", "0"), "margin = 0.0 is not a positive number"),
        ((*TWO, "--first-seed", "50"), "seeds 0:100 are the protocol's"),
        ((*TWO, "--first-seed", "999950"), "seeds from 1000000 up are those of tuning"),
        (("new", "p", "mlp", "mlp width=4", "--task", "tiny.toml"), "p: a plan's name ends in .toml"),
        (("new", "tiny.toml", "mlp", "mlp width=4", "--task", "tiny.toml"), "tiny.toml is there already"),
        (("new", "p q.toml", "mlp", "mlp width=4", "--task", "tiny.toml"), "name"),
        (("run", "nowhere.toml"), "plan nowhere.toml cannot be read"),
        (("show", "tiny.toml"), "tiny.toml: missing key 'written'"),
    ],
)
def test_wrong_input_is_refused_in_one_line(words: tuple[str, ...], message: str, refused: Refused) -> None:
    assert message in refused(*words)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("alpha = 0.05", "alpha = 1.5", "p.toml: alpha = 1.5 is outside (0, 1)"),
        (
            "first_seed = 10000",
            "first_seed = 10000\nfrist_seed = 1",
            "unknown key 'frist_seed'; did you mean",
        ),
        ("width = 4", "width = 5", "p.toml: entries.1.hash is '"),
        ("width = 4", 'width = "wide"', "p.toml: entries.1: "),
        ('rule = "times"', 'rule = "intervals"', "rule"),
        ("margin = 0.1", "margin = 0.1\nthresholds = [1]", "give either epsilons"),
        (
            "    20,\n    40,",
            "    40,\n    20,",
            "p.toml: looks = [40, 20, 60, 80, 100]: each must be at more runs",
        ),
        (
            "    20,\n    40,",
            "    10,\n    40,",
            "p.toml: looks = [10, 40, 60, 80, 100]: the first is below 20",
        ),
    ],
)
def test_a_wrong_plan_file_is_refused_in_one_line(old: str, new: str, message: str, refused: Refused) -> None:
    write("mlp width=16", "mlp width=4", plan="p.toml")
    edit("p.toml", old, new)
    assert message in refused("status", "p.toml")


def test_a_plan_file_of_one_entry_is_refused_in_one_line(refused: Refused) -> None:
    write("mlp width=16", "mlp width=4", plan="p.toml")
    Path("p.toml").write_text(re.sub(r".*width = 4.*\n", "", Path("p.toml").read_text()))
    message = "p.toml: entries = ['mlp width=16']: a decision needs two or more"
    assert message in refused("run", "p.toml")


ASKED = """
[[questions]]
text = "Does width help?"
pairs = [["wide", "narrow"]]

[[questions]]
text = "Is 16 too much?"
pairs = [["mlp width=8", "wide"]]
"""


def ask() -> str:
    """Write a plan of three entries that asks two questions and calls two entries by names of its own."""
    plan = write()
    for width, name in ((16, "wide"), (4, "narrow")):
        edit(plan, f"{{ width = {width} }}", f'{{ width = {width} }}, name = "{name}"')
    Path(plan).write_text(Path(plan).read_text() + ASKED)
    return plan


def test_a_plan_may_ask_about_some_pairs_only() -> None:
    """Two of three pairs are the family, and the narrow network stops when its only pair is closed."""
    found = answer("run", ask(), "--engine", "scripted")
    assert [
        (pair["question"], pair["first"], pair["second"], pair["verdict"]) for pair in found["pairs"]
    ] == [
        ("Does width help?", "wide", "narrow", "wide needs fewer"),
        ("Is 16 too much?", "mlp width=8", "wide", "equal within 10 percent"),
    ]
    assert {entry["name"]: entry["seeds"] for entry in found["entries"]} == {
        "wide": 40,
        "mlp width=8": 40,
        "narrow": 20,
    }
    shown = say("show", "widths.toml").stdout
    assert "widths: 2 questions, 2 pairs" in shown
    assert "Does width help? wide / narrow" in shown
    assert "(2 pairs, pocock spending)" in shown
    times = {entry["name"]: entry["mean_time"] for entry in found["entries"]}
    expected = {  # 60 steps an epoch, all below the thresholds until the epoch that reaches them
        name: 60 * (np.mean([STARTS[width](seed) for seed in range(10000, 10000 + seeds)]) - 1)
        for name, width, seeds in (("wide", "width=16", 40), ("narrow", "width=4", 20))
    }
    assert {name: times[name] for name in expected} == pytest.approx(expected)
    screen = say("status", "widths.toml").stdout
    assert re.search(r"wide +40 +", screen)
    assert screen.index("Does width help?") < screen.index("wide / narrow") < screen.index("Is 16 too much?")


def test_the_picture_has_a_row_for_each_pair_below_its_question(refused: Refused) -> None:
    plan = ask()
    assert "widths has taken no look yet: there is nothing to draw" in refused("plot", plan)
    answer("run", plan, "--engine", "scripted")
    assert say("plot", plan, "--out", "pairs.svg").stdout == "wrote pairs.svg\n"
    assert Path("pairs.svg").read_bytes().startswith(b"<?xml")
    outcome = outcomes.read(Path(plan), Path("runs"))
    figure = drawing.draw(outcome)
    [axes] = figure.axes
    rows = [label.get_text() for label in axes.get_yticklabels()]
    assert rows == ["Does width help?", "wide / narrow", "Is 16 too much?", "mlp width=8 / wide"]
    lines = {line.get_ydata()[0]: line for line in axes.lines if len(line.get_xdata()) == 2}
    for row, pair in zip((1, 3), outcome.pairs):
        assert lines[row].get_xdata() == pytest.approx([1 + end for end in pair.interval])
    [legend] = figure.legends
    assert [text.get_text() for text in legend.texts] == ["A needs fewer steps", "equal within the margin"]
    assert {text.get_text() for text in axes.texts} == {"20", "40"}
    assert "cut at" not in figure.get_supxlabel()
    first, second = outcome.pairs
    unbounded = (
        replace(first, interval=(-1.0, math.inf)),
        replace(second, difference=math.nan, interval=(-1.0, math.inf)),
    )
    figure = drawing.draw(replace(outcome, decision=replace(outcome.decision, pairs=unbounded)))
    [axes] = figure.axes
    assert next(list(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 2) == [0.1, 10]
    assert {text.get_text() for text in axes.texts} == {"20", "both mean times are 0"}
    assert "cut at a factor of 10" in " ".join(figure.get_supxlabel().split())


def test_the_picture_of_entries_has_the_shortest_mean_time_first(refused: Refused) -> None:
    plan = ask()
    assert "nothing to draw" in refused("plot", plan, "--entries")
    answer("run", plan, "--engine", "scripted")
    assert say("plot", plan, "--entries", "--out", "entries.svg").stdout == "wrote entries.svg\n"
    outcome = outcomes.read(Path(plan), Path("runs"))
    [axes] = drawing.draw_entries(outcome).axes
    times = outcome.mean_times()
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names[-1] == "narrow"
    assert names == sorted(times, key=lambda name: times[name].mean)
    lines = {line.get_ydata()[0]: line for line in axes.lines if len(line.get_xdata()) == 2}
    for row, name in enumerate(names):
        assert lines[row].get_xdata() == pytest.approx(times[name].interval)
    assert [text.get_text() for text in axes.texts] == ["40", "40", "20"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"wide", "narrow"', '"wide", "narow"', "pairs: 'narow' is not one of the entries"),
        ('"mlp width=8", "wide"', '"narrow", "wide"', "a pair is repeated"),
        ('"mlp width=8", "wide"', '"wide"', "questions.1.pairs.0"),
        ('[["wide", "narrow"]]', "[]", "questions.0.pairs"),
        ('name = "narrow"', 'name = "wide"', "the name 'wide' is repeated"),
        ('name = "narrow"', 'name = "\\u001b[31m"', "entries.2.name"),
    ],
)
def test_a_wrong_question_is_refused_in_one_line(old: str, new: str, message: str, refused: Refused) -> None:
    edit(ask(), old, new)
    assert message in refused("status", "widths.toml")


def test_a_plan_keeps_the_values_and_the_record_of_a_preset_file() -> None:
    """What is compared does not change when the preset file does, and every seed's entry says how it was tuned."""
    content = PresetFile(
        format_version=1,
        algorithm="ddqn",
        model="mlp",
        algorithm_options={"lr": 2e-3},
        model_options={"width": 16, "input_scale": 3.0},
        tuning=TuningRecord(task="tiny", seeds="1000000:1000004", trials=3, runs=12, steps=100),
    )
    Path("tuned.toml").write_text(dumps(content))
    write("mlp width=16 preset=tuned.toml", "mlp width=16", plan="p.toml")
    Path("tuned.toml").unlink()
    plain, tuned = sorted(answer("show", "p.toml")["names"], key=len)
    assert (plain, tuned) == ("mlp width=16", "mlp width=16 input_scale=3.0 lr=0.002")
    say("run", "p.toml", "--engine", "queue")
    stores = [EntryStore(path) for path in Path("runs/decisions/p/tiny").iterdir()]
    records = {store.record()["label"].split(" ", 1)[1]: store.record().get("tuning") for store in stores}
    assert records[plain] is None
    assert (records[tuned]["trials"], records[tuned]["preset"]) == (3, "tuned.toml")


@pytest.fixture
def exported() -> Path:
    """A plan of a few seeds, published."""
    write("mlp width=16", "mlp width=4", "--looks", "3,5", "--reason", "a test", plan="p.toml")
    answer("run", "p.toml", "--engine", "scripted")
    result = say("export", "p.toml", "--out", "plans")
    assert "next: " in result.stdout
    return Path("plans/p")


def test_a_published_plan_is_decided_by_its_curves_and_goes_on_elsewhere(exported: Path) -> None:
    before = answer("status", "p.toml")
    after = answer("status", str(exported))
    for outcome in (before, after):
        del outcome["next_core_hours"], outcome["core_hours_saved"]
    assert [round(entry.pop("core_hours"), 6) for entry in before["entries"]] == [
        round(entry.pop("core_hours"), 6) for entry in after["entries"]
    ]
    assert after == before
    runner = CliRunner()
    taken = runner.invoke(build(), ["import", str(exported), "--runs", "elsewhere"], catch_exceptions=False)
    assert taken.output.count("imported seeds 10000:10005") == 2, taken.output
    there = answer("status", "p.toml", "--runs", "elsewhere")
    assert [pair["p"] for pair in there["pairs"]] == [pair["p"] for pair in before["pairs"]]
    assert [there[key] for key in ("begun_at", "looks_taken")] == [before["begun_at"], before["looks_taken"]]
    page = ["leaderboard", "--runs", "elsewhere", "--format", "html", "--out", "page.html"]
    runner.invoke(build(), page, catch_exceptions=False)
    assert "p: which needs fewer steps" in Path("page.html").read_text()
    verified = runner.invoke(build(), ["verify", str(exported)])
    assert "2 of 2 entries ok" in verified.output, verified.output


def test_a_plan_published_before_its_first_seed_keeps_its_file(exported: Path) -> None:
    plan = exported / "plan.toml"
    plan.write_text(f"# committed before the first seed\n{plan.read_text()}")
    say("export", "p.toml", "--out", "plans")
    assert plan.read_text().startswith("# committed before the first seed\n")


def test_a_damaged_published_plan_is_refused(exported: Path, refused: Refused) -> None:
    text = (exported / "plan.toml").read_text()
    (exported / "plan.toml").write_text(text.replace("alpha = 0.05", "alpha = 0.5"))
    assert "was not trained by plan" in refused("status", str(exported))
    assert "holds another plan" in refused("export", "p.toml", "--out", "plans")
    (exported / "plan.toml").unlink()
    assert "plans/p holds no plan.toml" in refused("status", str(exported))


def test_looks_below_20_seeds_are_marked() -> None:
    write("mlp width=16", "mlp width=4", "--looks", "10,20", "--reason", "runs are dear")
    assert "NOTE: it looks below 20 seeds" in (shown := say("show", "widths.toml").stdout)
    assert "Reason given: runs are dear" in shown
    say("run", "widths.toml", "--engine", "scripted")
    assert "Reason given: runs are dear" in say("status", "widths.toml").stdout


def test_every_part_explains_itself() -> None:
    for command in ("new", "run", "status", "show", "end"):
        assert "Example" in say(command, "--help").stdout


def test_a_published_plan_is_known_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = ask()
    answer("run", plan, "--engine", "scripted")
    say("export", plan, "--out", "published")
    Path(plan).unlink()
    monkeypatch.setattr(published_studies, "PUBLISHED", Path("published").absolute())
    published = say("status", "widths", "--json", "--runs", "none").stdout
    assert json.loads(published)["pairs"][0]["decided"] is not None
    assert "2 pairs" in say("show", "widths", "--runs", "none").stdout
    answer("run", "widths", "--runs", "own", "--engine", "scripted")
    own = say("status", "widths", "--json", "--runs", "own").stdout
    assert json.loads(own)["pairs"] == json.loads(published)["pairs"]
    assert Path("own", "decisions", "widths").is_dir()


def test_a_plan_that_is_not_there(refused: Refused) -> None:
    assert "'quantum-or-no'; did you mean 'quantum-or-not'?" in refused("status", "quantum-or-no")
    Path("quantum-or-no.toml").write_text("x = 1")
    assert "'quantum-or-no'; did you mean 'quantum-or-no.toml'?" in refused("run", "quantum-or-no")


def test_a_file_goes_before_a_published_plan_of_its_name(refused: Refused) -> None:
    Path("quantum-or-not").write_text("x = 1")
    assert "quantum-or-not" in refused("show", "quantum-or-not")


@pytest.mark.parametrize(("seeds", "said"), [(157, "about 157 if the"), (601, "over 600 if the")])
def test_far_more_seeds_than_planned_are_not_counted(seeds: int, said: str) -> None:
    study: Any = SimpleNamespace(ended=False, plan=SimpleNamespace(looks=(20, 40, 60)))
    needs = {"level": 0.0021, "seeds": 40, "seeds_at_this_difference": seeds}
    assert (
        outcomes.needs_text(study, needs) == f"p <= 0.0021 at 40 seeds; {said} difference stays as it is now"
    )
