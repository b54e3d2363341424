"""Studies with looks of several tasks: read together, drawn task by task."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from qrlsuite import api
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import outcome as drawing
from qrlsuite.statistics import across
from qrlsuite.statistics.sequential import Claim, ClaimDecision, Decided
from qrlsuite.statistics.times_board import holm
from qrlsuite.studies import together as studies_together
from qrlsuite.studies.state import State
from qrlsuite.studies.together import StudiesTogether, together
from tests.commands import answer, say
from tests.leaderboard.boards import refused

TOGETHER = ("quantum-or-not", "quantum-or-not-degree5", "quantum-or-not-a3-0")


def test_pairs_that_several_studies_share_are_read_on_average_over_their_tasks(tmp_path: Path) -> None:
    found = answer("show", *TOGETHER)
    outcomes = [api.read_study(name) for name in TOGETHER]
    assert found["tasks"] == ["beam6g", "beam6g-degree5", "beam6g-a3-0"]
    assert found["seeds"] == [20, 20, 20]
    assert {"10 qubits", "width 14"} <= set(found["changed"]), "untuned on beam6g, tuned elsewhere"
    assert answer("show", *TOGETHER[1:])["changed"] == []
    pair = next(each for each in found["pairs"] if each["second"] == "width 32")
    first, second = (
        np.mean([outcomes[0].curves[pair[side]].values[:20] < t for t in outcomes[0].study.grid.thresholds])
        for side in ("first", "second")
    )  # of all epochs
    own = next(each for each in outcomes[0].pairs if (each.first, each.second) == ("10 qubits", "width 32"))
    assert own.n_runs == 100, "it went on, and counts with its first look"
    assert pair["differences"]["beam6g"] == pytest.approx(second / first - 1)
    shown = say("show", "study", *TOGETHER).stdout
    assert "nothing follows for other tasks" in shown
    assert shown.count("10 qubits / width 14") == 1
    named = ("--label", "10 qubits=Ten = 10", "--label", "width 14=Small")
    assert "Ten = 10 / Small" in say("show", TOGETHER[0], *named).stdout
    assert answer("plot", "pairs", "--study", TOGETHER[0], *named, "--runs", str(tmp_path))["picture"]
    for wrong in ("10 qubit=Ten", "10 qubits=width 14", "10 qubits= "):
        assert "write ENTRY=TEXT, and another text" in refused(
            "plot", "pairs", "--study", TOGETHER[0], "--label", wrong
        )
    assert "only entries of a study with looks" in say("show", "study", *TOGETHER, "--label", "a=b").output
    say("show", "study", *TOGETHER, "--out", str(tmp_path / "table.tex"))
    assert (tmp_path / "table.tex").read_text().count("10 qubits / width 14 & ") == 1
    captions = {
        "fig7": "Scaling with size: networks",
        "equal-size-pulse": "Does a circuit need fewer steps than",
    }
    for study, caption in captions.items():
        say("show", study, "--out", str(tmp_path / "one.tex"))
        assert f"\\caption{{{caption}" in (tmp_path / "one.tex").read_text()
        assert f"\\label{{tab:{study}}}" in (tmp_path / "one.tex").read_text()
    assert json.loads(say("show", "ten-qubits", "--out", str(tmp_path / "one.tex"), "--json").stdout)
    labels = re.findall(r"\\label{tab:(.*)}", (tmp_path / "one.tex").read_text())
    assert labels == ["ten-qubits-1", "ten-qubits-2", "ten-qubits-3"], "a table for each question"
    assert say("show", "equal-size-pulse").stdout.count("Does a circuit need fewer steps than") == 1


def test_pairs_that_several_studies_share_are_drawn_task_by_task(tmp_path: Path) -> None:
    words = [word for name in TOGETHER for word in ("--study", name)]
    drawn = Path(answer("plot", "pairs", *words, "--runs", str(tmp_path))["picture"])
    assert drawn.read_bytes().startswith(b"\x89PNG")
    read = api.read_study(*TOGETHER)
    assert isinstance(read, StudiesTogether)
    [axes] = drawing.draw_together(read).axes
    names = [label.get_text() for label in axes.get_yticklabels()]
    lines = {line.get_ydata()[0]: line for line in axes.lines if len(line.get_xdata()) == 2}
    size = len(TOGETHER) + 2
    assert len(names) == size * len(read.pairs)
    for place, shared in enumerate(read.pairs):
        head, *tasks, mean = names[place * size : (place + 1) * size]
        assert head == f"{shared.first} / {shared.second}"
        assert tuple(tasks) == read.tasks
        assert mean == f"mean of 3 tasks: {shared.verdict}"
        own = [
            pair.shown[1:]
            for study in read.studies
            for pair in study.pairs
            if (pair.first, pair.second) == (shared.first, shared.second)
        ]
        for row, interval in enumerate((*own, shared.ratio.interval), start=place * size + 1):
            assert lines[row].get_xdata() == pytest.approx([1 + end for end in interval])
    pair = next(each for each in read.studies[0].pairs if each.decided is Decided.FIRST)
    turned = drawing._reversed(pair)
    assert (turned.first, turned.second) == (pair.second, pair.first)
    assert turned.decided is Decided.SECOND
    ratios = [1 / (1 + each) - 1 for each in (pair.difference, *reversed(pair.interval))]
    assert [turned.difference, *turned.interval] == pytest.approx(ratios)
    unbounded = drawing._reversed(replace(pair, interval=(-1.0, math.inf)))
    assert unbounded.interval == (-1.0, math.inf)


def test_the_mean_of_many_tasks_is_that_of_tasks_like_them(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (across, studies_together):
        monkeypatch.setattr(module, "DRAWN", len(TOGETHER))
    read = api.read_study(*TOGETHER)
    assert isinstance(read, StudiesTogether)
    drawn = [ttest_1samp(np.log1p(pair.ratio.differences), 0).pvalue for pair in read.pairs]
    assert [pair.ratio.drawn_p for pair in read.pairs] == pytest.approx(holm(drawn).tolist())
    for pair in read.pairs:
        assert (pair.drawn_verdict == "not told apart") == (pair.ratio.drawn_p > 0.05)
    assert any(pair.drawn_verdict != pair.verdict for pair in read.pairs), (
        "one of the tasks, the other of their like"
    )
    assert "the conclusion for all tasks" in " ".join(repr(read).split())
    assert read.as_dict()["pairs"][0]["drawn_interval"] == list(read.pairs[0].ratio.drawn_interval)
    [axes] = drawing.draw_together(read).axes
    names = [label.get_text() for label in axes.get_yticklabels()]
    lines = {line.get_ydata()[0]: line for line in axes.lines if len(line.get_xdata()) == 2}
    size = len(TOGETHER) + 3
    for row, pair in zip(range(size - 1, len(names), size), read.pairs, strict=True):
        assert names[row] == f"over such tasks: {pair.drawn_verdict}"
        assert lines[row].get_xdata() == pytest.approx([1 + end for end in pair.ratio.drawn_interval])


def test_a_task_that_was_made_for_one_model_is_drawn_and_counts_in_no_mean() -> None:
    control, *outcomes = [api.read_study(name) for name in TOGETHER]
    whole = together(outcomes)  # type: ignore[arg-type]
    entry = next(iter(control.study.entries.values()))  # type: ignore[union-attr]
    entry.task.environment = replace(entry.task.environment, made_for="quantum")
    read = together([control, *outcomes])  # type: ignore[list-item]
    means = {(pair.first, pair.second): pair.ratio.difference for pair in whole.pairs}
    assert [pair.ratio.difference for pair in read.pairs] == [means[p.first, p.second] for p in read.pairs]
    assert read.as_dict()["controls"] == [TOGETHER[0]]
    assert f"not averaged: {TOGETHER[0]}, whose environment was made for quantum models" in repr(read)
    [axes] = drawing.draw_together(read).axes
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names[3].endswith(", made for quantum models")
    assert names[4].startswith("mean of 2 tasks: ")
    with pytest.raises(OptionError, match="two tasks or more that were not made for one kind of model"):
        together([control, outcomes[0]])  # type: ignore[list-item]


def test_a_pair_without_a_ratio_is_left_out_alone() -> None:
    outcomes = [api.read_study(name) for name in TOGETHER[1:]]
    whole = together(outcomes)  # type: ignore[arg-type]
    for outcome in outcomes:
        outcome.curves["sine 44"].values[:] = 1  # below no threshold
    read = together(outcomes)  # type: ignore[arg-type]
    assert len(read.pairs) == len(whole.pairs) - 2
    assert [line.partition(":")[0] for line in read.left_out] == ["10 qubits / sine 44", "sine 44 / width 14"]
    assert "left out: 10 qubits / sine 44: " in repr(read)
    assert "left out: 10 qubits / sine 44: " in " ".join(drawing.draw_together(read).get_supxlabel().split())


def test_a_claim_that_all_studies_make_names_the_tasks_where_it_holds() -> None:
    def claiming(name: str, p: float, tasks: int = 1) -> State:
        state = api.read_study(name)
        assert isinstance(state, State)
        claim = Claim("10 qubits", ("width 14",), tasks=tasks)
        other = replace(claim, rivals=(f"width {tasks}",))
        decided = [ClaimDecision(claim, ((p,),), ((0,),), 20), ClaimDecision(other, ((0.0,),), ((0,),), 20)]
        return replace(state, decision=replace(state.decision, claims=tuple(decided)))

    level = api.read_study(TOGETHER[1]).study.design.claim_level(0, 2)  # type: ignore[union-attr]
    text = "on at least one of {} tasks 10 qubits needs fewer steps than width 14"
    both = together([claiming(TOGETHER[1], 0.9 * level), claiming(TOGETHER[2], 1.1 * level)])
    assert {text.format(2): ("beam6g-degree5", "beam6g-a3-0")}.items() <= both.claims.items()
    seven = together([claiming(TOGETHER[1], 0.9 * level, 7), claiming(TOGETHER[2], 1.1 * level)])
    assert seven.claims == {text.format(7): ()}, "of seven planned studies two are given"
    assert f"claim: {text.format(7)}: established on none (by all looks; " in " ".join(repr(seven).split())
