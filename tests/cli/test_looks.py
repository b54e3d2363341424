"""Studies with looks at work: written, run look by look, interrupted, refused, drawn, published."""

from __future__ import annotations

import functools
import json
import math
import os
import re
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from qrlsuite import api, registry, specs
from qrlsuite.cli import main
from qrlsuite.cli.commands.runs import _unfinished
from qrlsuite.engine.status import EntryStatus
from qrlsuite.engine.work import EngineOutcome, Show, Work
from qrlsuite.engine.worker import train_group
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.preset import PresetFile, TuningRecord, dumps
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.pictures import outcome as drawing
from qrlsuite.leaderboard.report import looks as looks_report
from qrlsuite.results.records import RunRecord
from qrlsuite.results.store import EntryStore, json_line, table_bytes
from qrlsuite.results.survey import GroupStatus
from qrlsuite.specs import EngineSpec
from qrlsuite.studies.looks import Study
from qrlsuite.studies.state import needs_text
from qrlsuite.studies.study import load
from tests.commands import answer, qrlsuite, say, start
from tests.conftest import HANGS, TINY, Hold, cases, results

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
    entry = store.entry()
    record = RunRecord(plan=entry.study, seed=seed, **store.names, status="finished", epochs=epochs)
    folder.write_record(record.changed(code=identity.of(entry).record()))


class Scripted:
    """An engine whose runs are known: each reaches the goal when `STARTS` says."""

    trained: list[tuple[str, int, int]] = []
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
            width = work.store.record().label.split()[-1]
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
    known = registry.load().entries[specs.EngineSpec]
    for name, cls in (("scripted", Scripted), ("queue", Queue)):
        spec = EngineSpec(name, "for tests", f"{__name__}:{cls.__name__}")
        monkeypatch.setitem(known, name, registry.Registered(spec, "tests"))
    Scripted.trained.clear()
    monkeypatch.setattr(Scripted, "interrupt_at", -1)
    monkeypatch.chdir(tmp_path)
    text = TINY.replace("seeds = 4\nepochs = 3", "seeds = 100\nepochs = 20\nalgorithm_epochs = { ppo = 30 }")
    Path("tiny.toml").write_text(text)


def run(study: str = "widths.toml", *words: str) -> Any:
    return answer("study", "run", study, "--engine", "scripted", *words)


def write(*words: str, study: str = "widths.toml") -> str:
    entries = [word for word in words if "width" in word] or ["mlp width=16", "mlp width=8", "mlp width=4"]
    others = [word for word in words if "width" not in word]
    answer("study", "new", study, *entries, "--task", "tiny.toml", *others)
    return study


def edit(study: str, old: str, new: str) -> None:
    text = Path(study).read_text()
    assert text.count(old) == 1, text
    Path(study).write_text(text.replace(old, new))


Refused = Callable[..., str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Refused:
    """Run a command that refuses its input, in one line and without touching a file; returns the line."""

    def error(*words: str) -> str:
        before = {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
        monkeypatch.setattr(sys, "argv", ["qrlsuite", *words])
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main()
        printed = capsys.readouterr()
        assert stopped.value.code == 2
        assert len(printed.err.strip().splitlines()) == 1, printed.err
        assert printed.out == ""
        assert before == {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
        return printed.err

    return error


def test_an_entry_stops_when_all_its_pairs_are_closed() -> None:
    """Width 4 is slower in every run: 20 seeds show it. Widths 16 and 8 are equal: that takes 40."""
    found = run(write())
    assert sorted(Scripted.trained) == [
        ("width=16", 10000, 20),
        ("width=16", 10020, 20),
        ("width=4", 10000, 20),
        ("width=8", 10000, 20),
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
    times = [
        found["looks"]["written"].replace("Z", "+00:00"),
        found["begun_at"],
        *found["looks_taken"].values(),
    ]
    assert times == sorted(times)

    log = Path("runs/decisions/widths/looks.jsonl").read_bytes()
    again = run()
    assert len(Scripted.trained) == 5, "all is decided: nothing is trained"
    assert again == found == answer("show", "widths.toml")
    assert Path("runs/decisions/widths/looks.jsonl").read_bytes() == log
    shown = say("show", "widths.toml").stdout
    assert "equal within 10 percent" in shown
    assert "used 100 seeds, 1 core-hours; the protocol has 300 seeds: 200 saved" in shown


def test_ctrl_c_between_groups_changes_no_decision() -> None:
    write()
    straight = run("widths.toml", "--runs", "straight")
    for interrupted in (1, 3, 4):  # in the first look, before the second one, and in it
        Scripted.trained.clear()
        Scripted.interrupt_at = interrupted
        words = ("widths.toml", "--runs", f"runs-{interrupted}")
        assert say("study", "run", *words, "--engine", "scripted").exit_code == 130
        Scripted.interrupt_at = -1
        rows = [line for line in say("runs", *words[1:]).output.splitlines() if line.startswith("widths: ")]
        assert (len(rows), "  none of 20  " in rows[-1]) == (min(interrupted + 1, 3), interrupted == 1)
        assert run(*words)["pairs"] == straight["pairs"]
        assert len(Scripted.trained) == 5, "nothing is trained twice"


def test_a_stopped_group_names_the_command_that_goes_on() -> None:
    groups = (GroupStatus((0, 1), "stopped", "nobody"),)
    for study, command in ((None, "run"), ("widths", "study run")):
        (line,) = _unfinished(EntryStatus(SimpleNamespace(), groups, study=study))  # type: ignore[arg-type]
        assert line.endswith(f"seeds 0:2  continued by the same `qrlsuite {command}`")


def test_a_study_goes_on_with_the_code_that_began_it(
    refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    write()
    straight = run("widths.toml", "--runs", "straight")
    Scripted.interrupt_at = len(Scripted.trained) + 1
    assert say("study", "run", "widths.toml", "--engine", "scripted").exit_code == 130
    Scripted.interrupt_at = -1
    known = registry.load().entries[specs.ModelSpec]
    changed = replace(known["mlp"].spec, numerics=3)  # type: ignore[call-arg]
    monkeypatch.setitem(known, "mlp", replace(known["mlp"], spec=changed))
    message = refused("study", "run", "widths.toml", "--engine", "scripted")
    assert "model 'mlp' has numerics 3, and had 2" in message
    assert "Restore that code, or write another study" in message
    assert run("widths.toml", "--same", "no bit of a score")["pairs"] == straight["pairs"]


def test_the_example_on_the_page_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    [example] = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "decisions.md").read_text(), re.DOTALL)
    spec = EngineSpec("local", "for tests", f"{__name__}:Scripted")
    monkeypatch.setitem(
        registry.load().entries[specs.EngineSpec], "local", registry.Registered(spec, "tests")
    )
    example = example.replace("beam6g", "tiny.toml").replace("width=64", "width=2")
    exec(example, {})
    assert "mlp width=2 mlp width=16 " in capsys.readouterr().out


def test_python_compares_as_the_command_does() -> None:
    written = api.new_study("widths.toml", ["mlp width=16", "mlp width=8", "mlp width=4"], task="tiny.toml")
    assert [pair.verdict for pair in written.pairs] == ["open"] * 3
    assert not Path("runs").exists()
    found = api.run_study("widths.toml", engine="scripted", progress=False)
    read = api.read_study("widths.toml")
    assert isinstance(found, studies.State)
    assert isinstance(read, studies.State)
    assert found.finished
    assert found.pairs == read.pairs
    assert json.loads(json.dumps(found.as_dict())) == answer("show", "widths.toml")
    assert "mlp width=16 needs fewer" in found._repr_html_()
    with pytest.raises(OptionError, match="has looks, which fix what is trained: leave --seeds out"):
        api.run_study("widths.toml", seeds=3)
    with pytest.raises(OptionError, match=r"widths.toml is there already"):
        api.new_study("widths.toml", ["mlp", "mlp width=8"], task="tiny.toml")


def test_entries_are_named_where_they_are_written() -> None:
    words = ["wide, tuned: mlp width=16", "mlp width=8", "small: mlp width=4"]
    written = api.new_study("widths.toml", words, task="tiny.toml")
    assert {pair.first for pair in written.pairs} == {"wide, tuned", "mlp width=8"}
    assert {pair.second for pair in written.pairs} == {"mlp width=8", "small"}
    assert "Which needs fewer steps, wide, tuned, mlp width=8 or small?" in Path("widths.toml").read_text()
    assert api.read_study("widths.toml").study.hash == written.study.hash
    for name, problem in (("a: b", "unknown algorithm 'b:'"), ("wide; tuned", "name = 'wide; tuned'")):
        with pytest.raises(QrlSuiteError, match=problem):
            api.new_study("others.toml", [f"{name}: mlp width=16", "mlp width=8"], task="tiny.toml")
    with pytest.raises(QrlSuiteError, match="two groups are named 'wide'"):
        api.new_study("others.toml", ["wide: mlp width=16", "wide: mlp width=8"], task="tiny.toml")
    assert not Path("others.toml").exists()


def test_a_killed_worker_changes_no_byte(hold: Hold) -> None:
    Path("tiny.toml").write_text(TINY)
    write("mlp width=4", "mlp width=2", "--epochs", "2", "--looks", "2 reason=test")
    words = ("study", "run", "widths.toml", "--workers", "1", "--json", "--runs")
    process = start(*words, "killed", env=hold.environment)
    hold.wait(process)
    os.kill(process.pid, signal.SIGINT)
    process.communicate(timeout=HANGS)
    assert process.returncode == 130
    assert not list(Path("killed").glob("**/epochs.parquet"))
    resumed, straight = (json.loads(qrlsuite(*words, runs).stdout) for runs in ("killed", "straight"))
    assert resumed["pairs"] == straight["pairs"]
    assert resumed["finished"]
    for one in Path("killed/decisions/widths/tiny").iterdir():
        other = Path("straight/decisions/widths/tiny") / one.name
        for seed in (10000, 10001):
            assert results(one, seed) == results(other, seed)
            record = json.loads((one / f"seed-{seed}" / "run.json").read_text())
            assert record["plan"] == resumed["hash"]


def test_show_says_what_an_open_pair_needs() -> None:
    write("mlp width=16", "mlp width=2")
    assert answer("show", "widths.toml")["pairs"][0]["verdict"] == "open"
    assert set(studies.read_outcome("widths.toml", Path("runs")).looked.values()) == {0}
    assert "not begun" in say("show", "widths.toml").stdout
    assert not Path("runs").exists()
    Scripted.interrupt_at = 2
    assert say("study", "run", "widths.toml", "--engine", "scripted").exit_code == 130
    found = answer("show", "widths.toml")
    (pair,) = found["pairs"]
    assert (pair["verdict"], pair["seeds"]) == ("open", 20)
    assert pair["needs"]["seeds"] == 40
    assert pair["needs"]["level"] == pytest.approx(0.0152, abs=1e-4)
    assert found["next_core_hours"] == pytest.approx([40 * 0.01] * 2)
    assert [each["missing"] for each in found["entries"]] == [20, 20]
    assert found["seeds_saved"] == 0
    shown = say("show", "widths.toml").stdout
    assert "next look: 40 seeds missing, about 0.4 core-hours" in shown
    assert "p <= 0.015 at 40 seeds" in " ".join(shown.split())


def test_an_ended_study_stays_as_it_is(refused: Refused) -> None:
    write("mlp width=16", "mlp width=2")
    assert "has not begun" in refused("study", "end", "widths.toml")
    Scripted.interrupt_at = 2
    say("study", "run", "widths.toml", "--engine", "scripted")
    assert say("study", "end", "widths.toml").exit_code == 0
    assert "was ended on 2" in refused("study", "run", "widths.toml", "--engine", "scripted")
    assert "was ended on 2" in refused("study", "end", "widths.toml")
    assert "open pairs stay open" in say("show", "widths.toml").stdout
    Scripted.interrupt_at = -1
    run(write(study="done.toml"))
    assert "nothing to end" in refused("study", "end", "done.toml")


def test_a_queue_is_waited_for() -> None:
    write()
    found = answer("study", "run", "widths.toml", "--engine", "queue")
    assert found["submitted"] == ["20 seeds submitted"] * 3
    assert not found["looks_taken"]
    shown = say("study", "run", "widths.toml", "--engine", "queue").stdout
    assert "others train 20 seeds of mlp width=16, 20 seeds of mlp width=8" in shown


def test_a_new_study_takes_the_first_unused_seeds() -> None:
    assert answer("show", write())["looks"]["first_seed"] == 10000
    run()
    assert answer("show", write(study="again.toml"))["looks"]["first_seed"] == 11000
    shown = say("show", "again.toml").stdout
    assert "seeds 11000:11100; any false difference with probability 0.05 (3 pairs, pocock spending)" in shown
    assert "look at 20 seeds: different at p <= 0.0049 while all pairs are open" in shown
    assert "Which needs fewer steps, mlp width=16, mlp width=8 or mlp width=4?" in shown


def test_a_new_study_prints_the_commands_that_measure_its_cost() -> None:
    new = say("study", "new", "new.toml", "mlp width=8", "mlp width=4", "--task", "tiny.toml").stdout
    assert "at most 200 seeds, of unknown cost. To measure it, on seeds that no board counts:" in new
    commands = [line for line in new.splitlines() if line.startswith("  qrlsuite run")]
    assert len(commands) == 2
    for line in commands:
        say(*shlex.split(line)[1:])
    assert re.search(r"at most 200 seeds: [\d.]+( to [\d.]+)? core-hours\n", say("show", "new.toml").stdout)


def test_names_of_a_new_study_leave_out_what_all_entries_share() -> None:
    shared = "lr=0.002 gamma=0.9 batch=32 target_steps=100"
    study = write(
        *(f"mlp width={width} {shared}" for width in (16, 8, 4, 3)), "mlp width=16 lr=0.002 gamma=0.9"
    )
    found = answer("show", study)
    pairs = [name for pair in found["pairs"] for name in (pair["first"], pair["second"])]
    assert list(dict.fromkeys(pairs)) == [
        "mlp width=16 batch=32 target_steps=100",
        "mlp width=8 batch=32 target_steps=100",
        "mlp width=4 batch=32 target_steps=100",
        "mlp width=3 batch=32 target_steps=100",
        "mlp width=16",
    ]
    shown = say("show", study).stdout
    assert "Which of 5 entries needs the fewest steps? All have gamma=0.9 lr=0.002." in " ".join(
        shown.split()
    )
    text = Path(study).read_text()
    assert 'name = "mlp width=8 batch=32 target_steps=100"' in text
    assert 'summary = "Which of 5 entries needs the fewest steps? All have gamma=0.9 lr=0.002."' in text
    assert found["hash"] == answer("show", study)["hash"]


def test_any_study_with_a_table_of_looks_compares_its_entries() -> None:
    """Groups and grids are those of every study; what is not said is the task's, and a picture is drawn if named."""
    Path("grid.toml").write_text(
        'format_version = 1\nname = "grid"\nsummary = "Widths"\n[looks]\nlooks = [20, 40]\n[[entries]]\n'
        'name = "small"\ntask = "tiny.toml"\nmodel = "mlp"\ngrid = { width = [4, 16] }\n'
        '[[pictures]]\nkind = "curves"\n'
    )
    found = run("grid.toml")
    assert [pair["verdict"] for pair in found["pairs"]] == ["mlp width=16 needs fewer"]
    kept = Path("runs/decisions/grid/plan.toml").read_text()
    assert "epochs = 20" in kept
    assert kept.count("hash = ") == 2, "what was compared is written out where it began"
    assert len(answer("plot", "picture", "--study", "grid.toml")["seeds"]) == 2


def test_a_changed_study_is_refused_once_it_began(refused: Refused) -> None:
    write()
    edit("widths.toml", "alpha = 0.05", "alpha = 0.01")
    assert answer("show", "widths.toml")["looks"]["alpha"] == 0.01, "before its first seed it may be changed"
    run()
    edit("widths.toml", "alpha = 0.01", "alpha = 0.05")
    for command in (("study", "run"), ("show",), ("study", "end"), ("export",)):
        message = refused(*command, "widths.toml")
        assert "widths.toml: alpha (was 0.01, is 0.05) changed after the study began. End this" in message


def test_seeds_of_others_are_refused(refused: Refused) -> None:
    write("mlp width=16", "mlp width=4", "--epochs", "1")
    put(EntryStore.create(Path("runs"), _entry("width=4")), 10003, 1, 1)
    message = refused("study", "run", "widths.toml", "--engine", "scripted")
    assert "seeds 10003:10004 of 'mlp width=4' were trained already (runs/tiny/ddqn-mlp-" in message
    assert "first_seed = 11000" in message
    edit("widths.toml", "first_seed = 10000", "first_seed = 10004")
    run()
    own = EntryStore(next(Path("runs/decisions/widths/tiny").iterdir()))
    record = json.loads((own.seed(10004).path / "run.json").read_text())
    without = {key: value for key, value in record.items() if key != "plan"}
    for stranger in ({**record, "plan": "0" * 16}, without):
        (own.seed(10004).path / "run.json").write_text(json.dumps(stranger))
        assert "seed 10004 of 'mlp width=" in (message := refused("show", "widths.toml"))
        assert "was not trained by study" in message


def test_a_study_that_begins_again_needs_other_seeds(refused: Refused) -> None:
    """Its entries' folders are deleted, and it is changed: the log beside them has seen its seeds."""
    run(write("mlp width=16", "mlp width=4"))
    folder, first = Path("runs/decisions/widths"), answer("show", "widths.toml")
    shutil.rmtree(folder / "tiny")
    edit("widths.toml", "margin = 0.1", "margin = 0.3")
    seen = f"study {first['hash']} has seen these seeds ({folder / 'looks.jsonl'})"
    assert seen in (message := refused("study", "run", "widths.toml", "--engine", "scripted"))
    assert "with first_seed = 11000 it has others" in message
    write("mlp width=16", "mlp width=8", study="again.toml")
    edit("again.toml", "first_seed = 11000", "first_seed = 10090")
    assert seen in refused("study", "run", "again.toml", "--engine", "scripted"), "under another name, too"
    edit("widths.toml", "first_seed = 10000", "first_seed = 11000")
    assert answer("show", "widths.toml")["looks_taken"] == {}, "the looks of another study are not its own"
    assert run()["looks_taken"].keys() == {"20"}
    shutil.rmtree(folder / "tiny")
    edit("widths.toml", "first_seed = 11000", "first_seed = 10099")
    assert seen in refused("study", "run", "widths.toml", "--engine", "scripted")
    log = folder / "looks.jsonl"
    log.write_text(re.sub(r',"seeds":\[\d+,\d+\]', "", log.read_text()))
    assert seen in refused("study", "run", "widths.toml", "--engine", "scripted"), "logs of earlier versions"
    log.write_text(re.sub(r'("begun":[^}]*)\}', r'\1,"seeds":[5,5]}', log.read_text()))
    assert not list(Study(load("widths.toml"), Path("runs")).seen_before()), "a block of no seeds"


def test_seeds_that_a_study_lost_are_named() -> None:
    run(write("mlp width=16", "mlp width=4"))
    assert "lost" not in answer("show", "widths.toml")
    folder = Path("runs/decisions/widths")
    store = next(s for s in map(EntryStore, (folder / "tiny").iterdir()) if "width=16" in s.record().label)
    shutil.rmtree(store.seed(10003).path)
    said = "1 of 20 seeds is missing: 10003"
    assert answer("show", "widths.toml")["lost"] == {"mlp width=16": said}
    assert f"incomplete: {said} (mlp width=16)" in say("show", "widths.toml").stdout
    read = studies.read_outcome("widths.toml", Path("runs"))
    assert looks_report.view(read)["note"].startswith(f"incomplete: {said}")
    (folder / "looks.jsonl").unlink()
    assert "its log is missing" in say("show", "widths.toml").stdout


def test_curves_that_changed_after_a_look_are_refused(refused: Refused) -> None:
    run(write())
    stores = map(EntryStore, Path("runs/decisions/widths/tiny").iterdir())
    slow = next(store for store in stores if store.record().label.endswith("width=4"))
    for seed in range(10000, 10020):
        put(slow, seed, 20, STARTS["width=16"](seed))
    message = refused("show", "widths.toml")
    assert (
        "the look at 20 seeds saw other curves than are there now; it found 'first needs fewer' for "
        in message
    )
    assert "mlp width=16 and mlp width=4, now it is 'None'" in message


def test_a_look_stores_its_relabelings_and_a_later_reading_checks_them(refused: Refused) -> None:
    """A stored p that 10,000 relabelings allow stands; a p that they contradict, and other curves, do not."""
    run(write("mlp width=16", "mlp width=2"))
    log = Path("runs/decisions/widths/looks.jsonl")
    _, first, *_ = lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert (first["seed"], len(first["curves"])) == (0, 16)
    [pair] = first["pairs"]
    found = pair["p"]
    assert pair["relabelings"] == 10_000
    assert 0.1 < found < 0.9
    for p, shown in ((found + 0.001, found + 0.001), (found / 3, found)):
        pair |= {"p": round(p, 6), "relabelings": 1_000_000}
        log.write_text("".join(json.dumps(line) + "\n" for line in lines))
        assert answer("show", "widths.toml")["pairs"][0]["p"][0] == pytest.approx(shown, abs=1e-6)
    store = EntryStore(next(Path("runs/decisions/widths/tiny").glob("*mlp*")))
    put(store, 10000, 20, 1 + STARTS[store.record().label.split()[-1]](10000))
    assert refused("show", "widths.toml").endswith(
        "saw other curves than are there now: results were changed since; restore them\n"
    )
    for line in lines:
        line.pop("curves", None)  # as in the log of an earlier version, which is read
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert answer("show", "widths.toml")["looks_taken"].keys() == {"20", "40", "60"}


def test_every_record_of_a_seed_has_the_hash_of_its_study() -> None:
    entry = _entry("width=4")
    tables = []
    for runs, subject in (("planned", replace(entry, study="ab" * 8)), ("runs", entry)):
        store = EntryStore.create(Path(runs), subject)
        train_group(store.path, [0], 1)
        expected = {"plan": "ab" * 8} if runs == "planned" else {}
        record = json.loads((store.seed(0).path / "run.json").read_text())
        assert {key: value for key, value in record.items() if key == "plan"} == expected
        assert (subject.hash, subject.name) == (entry.hash, entry.name)
        tables.append(store.seed(0).table.read_bytes())
    assert tables[0] == tables[1]


def _entry(setting: str) -> Entry:
    return resolve("tiny.toml", f"mlp {setting}")


QUESTIONS = """
[[looks.questions]]
text = "Does width help?"
pairs = [["wide", "narrow"]]

[[looks.questions]]
text = "Is 16 too much?"
pairs = [["mlp width=8", "wide"]]
"""
CLAIMS = """
[[looks.claims]]
entry = "mlp width=8"
rivals = ["narrow", "wide"]
tasks = 2

[[looks.claims]]
entry = "mlp width=8"
rivals = ["narrow", "wide"]
at_most = 0.1
"""


def ask(claims: str = "") -> str:
    """Write a study of three entries that asks two questions and calls two entries by names of its own."""
    study = write()
    head, *tables = Path(study).read_text().split("\n[[entries]]\n")
    named = [
        f'name = "{name}"\n{table}' if name else table for name, table in zip(("wide", "", "narrow"), tables)
    ]
    Path(study).write_text("\n[[entries]]\n".join([head + QUESTIONS + claims, *named]))
    return study


WRONG = r"""
alpha = 0.05 => alpha = 1.5 => widths.toml: alpha = 1.5 is outside (0, 1)
first_seed = 10000 => first_seed = 10000\nfrist_seed = 1 => unknown key 'frist_seed'
width = 8 => width = 5 => widths.toml: entries.1.hash is '
width = 8 => width = "wide" => widths.toml, entries.1:
rule = "steps" => rule = "intervals" => rule
    20,\n    40, =>     40,\n    20, => looks = [40, 20, 60, 80, 100]: each must be at more runs
"wide", "narrow" => "wide", "narow" => pairs: 'narow' is not one of the entries
"mlp width=8", "wide" => "narrow", "wide" => a pair is repeated
"mlp width=8", "wide" => "wide" => looks.questions.1.pairs.0
[["wide", "narrow"]] => [] => looks.questions.0.pairs
at_most = 0.1 => at_most = 0 => looks.claims.1.at_most
"narrow", "wide"]\ntasks => "narow", "wide"]\ntasks => claims: 'narow' is not one of the entries
"wide"]\ntasks => "mlp width=8"]\ntasks => a name is repeated
rule = "steps" => rule = "times" => claims are tested by rule 'steps'
name = "narrow" => name = "wide" => two groups are named 'wide'
name = "narrow" => name = "\u001b[31m" => entries.2.name
"""


@pytest.mark.parametrize(("old", "new", "message"), cases(WRONG))
def test_a_wrong_study_file_is_refused_in_one_line(
    old: str, new: str, message: str, refused: Refused
) -> None:
    edit(ask(CLAIMS), old, new)
    assert message in refused("show", "widths.toml")


def test_what_would_change_a_study_with_looks_is_refused(refused: Refused) -> None:
    write()
    for option in (("--seeds", "20"), ("width=3",), ("mlp",), ("--epochs", "2"), ("--dry-run",)):
        message = refused("study", "run", "widths.toml", *option)
        assert f"has looks, which fix what is trained: leave {option[0]} out" in message


def test_a_study_may_ask_about_some_pairs_only() -> None:
    """Two of three pairs are the family, and the narrow network stops when its only pair is closed."""
    assert "(2 pairs, pocock spending)" in say("show", ask()).stdout
    found = run()
    assert [
        (pair["question"], pair["first"], pair["second"], pair["verdict"]) for pair in found["pairs"]
    ] == [
        ("Does width help?", "wide", "narrow", "wide needs fewer"),
        ("Is 16 too much?", "mlp width=8", "wide", "equal within 10 percent"),
    ]
    assert {each["name"]: each["seeds"] for each in found["entries"]} == {
        "wide": 40,
        "mlp width=8": 40,
        "narrow": 20,
    }
    times = {entry["name"]: entry["mean_time"] for entry in found["entries"]}
    expected = {  # 60 steps an epoch, all below the thresholds until the epoch that reaches them
        name: 60 * (np.mean([STARTS[width](seed) for seed in range(10000, 10000 + seeds)]) - 1)
        for name, width, seeds in (("wide", "width=16", 40), ("narrow", "width=4", 20))
    }
    assert {name: times[name] for name in expected} == pytest.approx(expected)
    screen = say("show", "widths.toml").stdout
    assert re.search(r"wide +40 +", screen)
    assert screen.index("Does width help?") < screen.index("wide / narrow") < screen.index("Is 16 too much?")


def test_pictures_have_a_row_for_each_pair_and_each_entry(refused: Refused) -> None:
    study = ask()
    assert "widths has taken no look yet: there is nothing to draw" in refused(
        "plot", "pairs", "--study", study
    )
    run(study)
    for kind in ("pairs", "entries"):
        assert say("plot", kind, "--study", study).stdout == f"wrote runs/study-widths-{kind}.png\n"
    outcome = studies.read_outcome(study, Path("runs"))
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
    assert "open markers" not in figure.get_supxlabel()
    first, second = outcome.pairs
    unbounded = (
        replace(first, interval=(-1.0, math.inf)),
        replace(second, difference=math.nan, interval=(-1.0, math.inf)),
    )
    decision = replace(outcome.decision, pairs=unbounded)
    figure = drawing.draw(replace(outcome, decision=decision))
    [axes] = figure.axes
    assert next(list(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 2) == [0.1, 10]
    assert {text.get_text() for text in axes.texts} == {"20", "both entries spend no step below a threshold"}
    assert "cut at a factor of 10" in " ".join(figure.get_supxlabel().split())

    [axes] = drawing.draw_entries(outcome).axes
    times = outcome.mean_times()
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names[-1] == "narrow"
    assert names == sorted(times, key=lambda name: times[name].mean)
    lines = {line.get_ydata()[0]: line for line in axes.lines if len(line.get_xdata()) == 2}
    for row, name in enumerate(names):
        assert lines[row].get_xdata() == pytest.approx(times[name].interval)
    assert [text.get_text() for text in axes.texts] == ["40", "40", "20"]
    by_threshold = replace(
        first, interval=(-0.1, 0.5), leading_difference=0.7, leading_interval=(0.2, 1.0)
    )  # as `times` decides
    decision = replace(outcome.decision, pairs=(by_threshold, second))
    figure = drawing.draw(replace(outcome, decision=decision))
    [axes] = figure.axes
    drawn = next(list(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 2)
    assert drawn == pytest.approx([1.2, 2.0]), "no colored line across 0"
    assert "open markers: at the threshold that decided" in figure.get_supxlabel()


def test_a_study_keeps_the_values_and_the_record_of_a_preset_file() -> None:
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
    write("mlp width=16 preset=tuned.toml", "mlp width=16", study="p.toml")
    Path("tuned.toml").unlink()
    found = answer("study", "run", "p.toml", "--engine", "queue")
    plain, tuned = sorted((entry["name"] for entry in found["entries"]), key=len)
    assert (plain, tuned) == ("mlp width=16", "mlp width=16 input_scale=3.0 lr=0.002")
    stores = [EntryStore(path) for path in Path("runs/decisions/p/tiny").iterdir()]
    records = {store.record().label.split(" ", 1)[1]: store.record().tuned for store in stores}
    assert records[plain] is None
    assert (records[tuned]["trials"], records[tuned]["preset"]) == (3, "tuned.toml")


@pytest.fixture
def exported() -> Path:
    """A study of a few seeds, published."""
    write("mlp width=16", "mlp width=4", "--looks", "3,5 reason='a test'", study="p.toml")
    run("p.toml")
    assert "next: " in say("export", "p.toml", "--out", "plans").stdout
    return Path("plans/p")


def test_a_study_published_before_its_first_seed_keeps_its_file(exported: Path) -> None:
    file = exported / "plan.toml"
    file.write_text(f"# committed before the first seed\n{file.read_text()}")
    say("export", "p.toml", "--out", "plans")
    assert file.read_text().startswith("# committed before the first seed\n")


def test_a_published_study_is_read_without_its_task_file(exported: Path, refused: Refused) -> None:
    [pair] = answer("show", str(exported))["pairs"]
    Path("tiny.toml").unlink()
    shutil.rmtree("runs")
    assert answer("show", str(exported))["pairs"] == [pair]
    say("import", str(exported), "--runs", "others")
    assert answer("study", "run", str(exported / "plan.toml"), "--runs", "others")["pairs"] == [pair]
    for entry in exported.glob("tiny/*"):
        shutil.rmtree(entry)
    assert "task file tiny.toml cannot be read" in refused("show", str(exported))
    Path("evil.py").write_text("raise SystemExit('code of a stranger ran')")
    Path("tiny.toml").write_text(f'plugins = ["evil.py"]\n{TINY}')
    assert "add --plugin evil.py" in refused("show", str(exported))
    file = exported / "plan.toml"
    file.write_text(re.sub("^hash = .*", "", file.read_text(), flags=re.M))
    assert "add --plugin evil.py" in refused("show", str(exported))


def test_a_damaged_published_study_is_refused(exported: Path, refused: Refused) -> None:
    edit(str(exported / "plan.toml"), "alpha = 0.05", "alpha = 0.5")
    assert "was not trained by study" in refused("show", str(exported))
    assert "holds another study" in refused("export", "p.toml", "--out", "plans")
    assert "with separate commands" in refused("export", "p.toml", "mlp width=16")


def test_a_published_study_is_known_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    run(study := ask())
    say("export", study, "--out", "published")
    Path(study).unlink()
    for place in ("shelf.PLANS", "shelf.published_studies.PUBLISHED"):
        monkeypatch.setattr(f"qrlsuite.leaderboard.{place}", Path("published").absolute())
    published = answer("show", "widths", "--runs", "none")
    assert published["pairs"][0]["decided"] is not None
    assert re.search(r"widths +Which needs fewer steps", say("list", "studies").stdout)
    run("widths", "--runs", "own")
    assert answer("show", "widths", "--runs", "own")["pairs"] == published["pairs"]
    assert Path("own", "decisions", "widths").is_dir()


@pytest.mark.parametrize(("seeds", "said"), [(157, "about 157 if the"), (601, "over 600 if the")])
def test_far_more_seeds_than_the_last_look_are_not_counted(seeds: int, said: str) -> None:
    study = SimpleNamespace(design=SimpleNamespace(looks=(20, 40, 60)))
    outcome: Any = SimpleNamespace(study=study, ended=None)
    needs = {"level": 0.0021, "seeds": 40, "seeds_at_this_difference": seeds}
    assert needs_text(outcome, needs) == f"p <= 0.0021 at 40 seeds; {said} difference stays as it is now"


def test_verdicts_of_entries_that_hardly_leave_the_horizon_say_so() -> None:
    """By the published study, of which some pairs are equal because neither learns in time."""
    outcome = api.read_study("dissecting")
    late = {name for name, time in outcome.mean_times().items() if time.mean >= 90_000}
    pairs = {f"{pair['first']} / {pair['second']}": pair for pair in outcome.as_dict()["pairs"]}
    for pair in pairs.values():
        equal = pair["decided"] in ("equal", "not told apart")
        assert pair["at_horizon"] == (equal and {pair["first"], pair["second"]} <= late)
    assert [name for name, pair in pairs.items() if pair["at_horizon"]] == [
        "skolik 5 layers, outputs 16 times / skolik 5 layers",
        "skolik 5 layers, outputs 16 times / skolik 5 layers, output rate x 16",
        "skolik 5 layers / skolik 2 layers",
        "skolik 5 layers / skolik 5 layers, separable",
    ]
    assert pairs["hsiao, ring of CNOTs / hsiao"]["verdict"] == "hsiao needs fewer", (
        "known to differ all the same"
    )
    shown = " ".join(say("show", "dissecting").stdout.split())
    assert (
        shown.count("at the horizon: both entries are below the thresholds for 90% or more of the steps") == 1
    )
    assert "at the horizon" not in say("show", "quantum-or-not").stdout
    page = looks_report.view(outcome)
    assert [line["verdict"].endswith(", at the horizon") for line in page["pairs"]] == [
        pair["at_horizon"] for pair in pairs.values()
    ]
    assert "neither had time to learn" in page["note"]


def test_studies_that_cannot_be_read_together_are_refused(refused: Refused) -> None:
    write()
    for names, said in (
        (("quantum-or-not", "quantum-or-not"), "two studies are of task 'beam6g'"),
        (("quantum-or-not", "memory"), "two studies are of task 'beam6g'"),
        (("quantum-or-not", "quantum-or-not-cartpole"), "have no pair of entries in common"),
        (("quantum-or-not", "fig7"), "study 'fig7' has no looks"),
        (
            ("quantum-or-not", "widths.toml"),
            "'widths' has not taken its first look: qrlsuite study run widths",
        ),
        (("quantum-or-not", "mlp"), "unknown study 'mlp'"),
        (("mlp", "gru", "drqn"), "or several studies"),
    ):
        assert said in refused("show", *names)


def test_claims_are_fixed_stored_shown_and_checked(refused: Refused) -> None:
    """The best rival is as fast: at most 10 percent is established at 40 seeds, and the lead stays open to the end."""
    plain = answer("show", ask())["hash"]
    Path("widths.toml").unlink()
    assert answer("show", ask(CLAIMS))["hash"] != plain
    shown = say("show", "widths.toml").stdout
    assert "claim: mlp width=8 needs fewer steps than each of narrow, wide: open" in shown
    assert "power: unknown until 10 seeds" in shown
    found = run()
    beats, at_most = found["claims"]
    assert (beats["established"], beats["closed"], beats["n_runs"]) == (None, True, 100)
    assert (at_most["established"], at_most["closed"]) == (20, True)
    assert 0 < beats["excluded"] < at_most["excluded"] <= 0.1
    assert [each["seeds"] for each in found["entries"]] == [100, 100, 100], (
        "the pairs were closed by 20 and 40"
    )
    log = Path("runs/decisions/widths/looks.jsonl")
    looks = [json.loads(line) for line in log.read_text().splitlines()][1:]
    assert [[each["established"] for each in look.get("claims", [])] for look in looks] == [
        [False, True], [False], [False], [False], [False]
    ]  # fmt: skip
    assert [len(look["pairs"]) for look in looks] == [2, 1, 0, 0, 0]
    before = log.read_bytes()
    assert run() == answer("show", "widths.toml") == found
    assert log.read_bytes() == before
    shown = say("show", "widths.toml", "--label", "wide=Wide").stdout
    best = "claim: the best of narrow, Wide needs at most 10 percent more steps than mlp width=8"
    assert f"{best}: established at 20 seeds; leads above " in shown
    assert before.count(b'"established":true') == 1
    log.write_bytes(before.replace(b'"established":true', b'"established":false'))
    assert "a claim about mlp width=8 was not established" in refused("show", "widths.toml")
