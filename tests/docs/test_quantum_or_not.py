"""docs/plans.md and docs/quantum-or-not.md say what the published studies with looks say."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.results.store import read_lines
from qrlsuite.studies.looks import FILE, LOG, StudyWithLooks
from qrlsuite.studies.outcome import StudyOutcome
from qrlsuite.studies.study import load as load_study
from tests.docs import load, percent

DOCS = Path(__file__).parents[2] / "docs"
STUDIES = (DOCS / "plans.md").read_text()
PROSE = " ".join((DOCS / "quantum-or-not.md").read_text().split())
NAMES = sorted(folder.name for folder in published_studies.PUBLISHED.iterdir())

tables = load("tables")


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_are_what_the_published_files_say(page: Path) -> None:
    text = page.read_text()
    assert tables.TABLE.search(text)
    assert tables.filled(text) == text, "run `make pictures`"


def test_a_table_that_was_empty_stands_apart_from_what_follows() -> None:
    text = tables.filled("<!-- table: quantum-or-not settings -->\n\n## Next\n")
    assert re.search(r"<!-- .* -->\n\n\| entry \|.*\n(\|.*\n)+\n## Next\n$", text)
    assert tables.filled(text) == text


def test_a_stale_table_is_replaced() -> None:
    stale = STUDIES.replace("| 313 |", "| 312 |", 1)
    assert stale != STUDIES
    assert tables.filled(stale) == STUDIES


@pytest.mark.parametrize("name", NAMES)
def test_every_published_study_is_on_the_page(name: str) -> None:
    study = tables.published(name).study
    prose = " ".join(STUDIES.split())
    assert f"<!-- table: {name} verdicts -->" in STUDIES
    assert f"`{study.hash}`" in prose
    assert f"{len(tables.published(name).pairs)} pairs" in prose
    assert f"seeds {study.looks.block.start} to {study.looks.block.stop - 1}" in prose
    *looks, last = study.looks.looks
    assert f"Looks after {', '.join(map(str, looks))} and {last} seeds" in prose


@pytest.mark.parametrize("name", NAMES)
def test_hash_permutations_and_next_look_are_those_of_the_log(name: str, tmp_path: Path) -> None:
    """Studies that version 0.1 wrote as plans keep all that decides, and go on with `study run`."""
    outcome = tables.published(name)
    log = read_lines(published_studies.PUBLISHED / name / LOG)
    looks = [line for line in log if "look" in line]
    assert {line["plan"] for line in log if "plan" in line} == {outcome.study.hash}
    p = {(pair.first, pair.second): pair.p for pair in outcome.pairs}
    for index, line in enumerate(looks):
        for pair in line["pairs"]:
            assert p[tuple(pair["pair"])][index] == pair["p"]
    every = outcome.study.design.looks
    expected = set() if outcome.finished else {every[len(looks)]}
    assert set(outcome.state.decision.wanted.values()) == expected
    own = StudyWithLooks(published_studies.load(published_studies.PUBLISHED / name), tmp_path)
    own.begin()
    assert StudyWithLooks(load_study(str(own.folder / FILE)), tmp_path).hash == outcome.study.hash
    assert set(own.look().decision.wanted.values()) == {every[0]}


def test_the_state() -> None:
    outcome = tables.published("quantum-or-not")
    verdicts = [pair.verdict for pair in outcome.pairs]
    equal, apart = (sum(each.startswith(word) for each in verdicts) for word in ("equal", "not told apart"))
    differ = sum(each.endswith("needs fewer") for each in verdicts)
    assert differ + equal + apart == len(verdicts)
    assert (
        f"{differ} of {len(verdicts)} pairs differ, {equal} are equal within 10 percent, {apart} are not"
        in PROSE
    )
    seeds = sum(outcome.looked.values())
    hours = sum(each["core_hours"] for each in outcome.as_dict()["entries"])
    assert f"The study took {seeds} seeds and {hours:.1f} core-hours" in PROSE


@pytest.mark.parametrize(
    ("study", "sentence"),
    [
        ("quantum-or-not", "{} core-hours for all"),
        ("quantum-or-not-cartpole", "whole runs of 500 epochs, in {} core-hours"),
    ],
)
def test_the_hours_of_tuning(study: str, sentence: str) -> None:
    tunings = [entry.tuning for entry in tables.published(study).study.file.entries]
    hours = sum(each.core_hours or 0 for each in tunings if each is not None and each.value is not None)
    assert sentence.format(f"{hours:.1f}") in PROSE


def test_what_a_larger_batch_changes() -> None:
    outcome = tables.published("larger-batch")
    readme = " ".join((DOCS.parent / "README.md").read_text().split())
    pairs = {(pair.first, pair.second): pair for pair in outcome.pairs}
    verdicts = {name: pair.verdict for name, pair in pairs.items()}
    circuit, network = "6 qubits", "width 10"
    spans = []
    for name in (circuit, network):
        pair = pairs[name, f"{name}, batch 64"]
        spans += [percent(value) for value in (pair.difference, *pair.interval)]
        assert 2 < pair.difference < 2.5
    said = "tuned entries of `quantum-or-not` need {} more steps (6 qubits, {} to {}) and {} more (width 10, {} to {})"
    assert said.format(*spans) in PROSE
    assert "both need about a third of the steps" in readme
    assert verdicts[circuit, network] == f"{circuit} needs fewer"
    pair = pairs[circuit, network]
    values = (pair.difference, *pair.interval, pair.leading_difference, *pair.leading_interval)
    said = "which needs {} more ({} to {}; to reach 0.9, {}, {} to {})".format(*map(percent, values))
    assert said in PROSE
    for other, said in ((f"{circuit} mean-field", "(+16%, -2% to 37%)"), ("width 14", "(-9%, -24% to 10%)")):
        pair = pairs[circuit, other]
        assert verdicts[circuit, other].startswith("not told apart by 100 seeds")
        low, high = map(percent, pair.interval)
        assert said == f"({100 * pair.difference:+.0f}%, {low} to {high})"
        assert said in PROSE
    facts = {each["name"]: each for each in outcome.as_dict()["entries"]}
    names = (circuit, f"{circuit}, batch 64", network, f"{network}, batch 64")
    seconds = [3600 * facts[name]["core_hours"] / outcome.looked[name] for name in names]
    said = "takes {:.0f} core-seconds for 6 qubits in place of {:.0f}, and {:.0f} in place of {:.0f} for width 10"
    assert said.format(*seconds) in PROSE


FIRST_FOUR = ("beam6g", "beam6g-degree5", "vqe-h2", "pulse")
ONE_SIZE = ("beam6g", "beam6g-degree5", "beam6g-a3-0", "cartpole", "frozenlake", "vqe-h2", "pulse")


def test_one_size_on_several_tasks() -> None:
    readme = " ".join((DOCS.parent / "README.md").read_text().split())
    outcomes = {task: tables.published(f"equal-size-{task}") for task in ONE_SIZE}
    pairs = {(task, pair.second): pair for task, outcome in outcomes.items() for pair in outcome.pairs}
    verdicts = {key: pair.verdict for key, pair in pairs.items()}
    assert all(
        any(verdicts[task, other] != "circuit needs fewer" for other in ("network", "sines", "mean-field"))
        for task in outcomes
    )
    assert "**On none of the seven could we show it.**" in readme
    assert "On none of the seven tasks is the circuit shown to beat all three" in PROSE
    assert {verdicts[task, "mean-field"].partition(" by ")[0] for task in outcomes} == {
        "not told apart",
        "equal within 10 percent",
    }
    equal = [task for task in outcomes if verdicts[task, "mean-field"] == "equal within 10 percent"]
    assert equal == ["beam6g-a3-0", "frozenlake", "pulse"]
    ahead = {(task, other) for (task, other), verdict in verdicts.items() if verdict == "circuit needs fewer"}
    assert ahead == {(task, "network") for task in ("beam6g", "frozenlake", "pulse")} | {("pulse", "sines")}
    behind = {key for key, verdict in verdicts.items() if verdict == f"{key[1]} needs fewer"}
    assert behind == {(task, "sines") for task in ("vqe-h2", "beam6g-a3-0", "frozenlake")}
    assert "The circuit beats the network on three tasks, and its mean-field control on none." in readme
    assert "Sines beat it on three, and it beats them on one." in readme
    for task in ("beam6g-degree5", "cartpole"):
        assert all(verdicts[task, other].startswith("not told apart by 60") for other in ("network", "sines"))

    def said(task: str, other: str) -> list[str]:
        pair = pairs[task, other]
        numbers = (pair.difference, *pair.interval, pair.leading_difference, *pair.leading_interval)
        return [percent(number) for number in numbers]

    found = said("beam6g", "network"), said("pulse", "network"), said("pulse", "sines")
    assert "needs {} more steps ({} to {}; to reach 0.9, {}, {} to {})".format(*found[0]) in PROSE
    assert "on `pulse` {} more ({} to {})".format(*found[1]) in PROSE
    assert "on `frozenlake` {} more ({} to {})".format(*said("frozenlake", "network")) in PROSE
    fewer, high, low = (number.removeprefix("-") for number in said("frozenlake", "sines")[:3])
    assert f"{fewer} fewer on `frozenlake` ({low} to {high})" in PROSE
    spans = [
        "{1} to {2}".format(*said(task, "mean-field")) for task in ("pulse", "beam6g-a3-0", "frozenlake")
    ]
    assert "({}, {} and {})".format(*spans) in PROSE
    assert "on `pulse`: {} ({} to {}; to reach 0.98, {}, {} to {})".format(*found[2]) in PROSE
    fewer, high, low = (number.removeprefix("-") for number in said("vqe-h2", "sines")[:3])
    assert f"They need {fewer} fewer steps on `vqe-h2` ({low} to {high})" in PROSE
    fewer, high, low, at, most, least = (each.removeprefix("-") for each in said("beam6g-a3-0", "sines"))
    assert f"{fewer} fewer on `beam6g-a3-0` ({low} to {high}; to reach 0.9, {at}, {least} to {most})" in PROSE


def test_the_mean_over_tasks_decides_nothing() -> None:
    names = "+".join(f"equal-size-{task}" for task in ONE_SIZE)
    assert f"<!-- table: {names} together -->" in PROSE
    _, network, sines, mean_field = tables.together(names)
    assert {row[1] for row in (network, sines, mean_field)} == {"not told apart"}
    for part, words in (
        (ONE_SIZE, "the seven give {} ({} to {}, p {})"),
        (FIRST_FOUR, "the network {} more steps"),
    ):
        row = next(
            row
            for row in tables.together("+".join(f"equal-size-{task}" for task in part))
            if "network" in row[0]
        )
        values = [
            f"{'-' * (each[0] == '-')}{each.lstrip('+-')}" for each in re.findall(r"[+-][\d.]+%", row[2])
        ]
        assert words.format(*values, row[3].removeprefix("0")) in PROSE
        assert f"p {row[3].removeprefix('0')})" in PROSE
    mean, high, low = re.findall(r"[\d.]+%", sines[2])
    p = sines[3].removeprefix("0")
    assert f"Sines need {mean} fewer steps than the circuit ({low} to {high} by itself, p {p} over" in PROSE


def test_the_regrets_of_the_searches_of_one_size() -> None:
    for task in ("beam6g", "cartpole", "frozenlake", "vqe-h2", "pulse"):
        expected = [
            100 * entry.tuning.regret.expected
            for entry in tables.published(f"equal-size-{task}").study.file.entries
        ]
        cells = (f"{each:.1f}%" if 5 < each < 5.5 else f"{each:.0f}%" for each in expected)
        assert f"| `{task}` | {' | '.join(cells)} |" in PROSE


def test_the_hours_of_the_searches_of_one_size() -> None:
    tunings = {
        (entry.tuning.task, entry.name): entry.tuning.core_hours
        for task in ("beam6g", "cartpole", "frozenlake", "vqe-h2", "pulse")
        for entry in tables.published(f"equal-size-{task}").study.file.entries
    }
    assert len(tunings) == 20
    assert f"with {sum(tunings.values()):.1f} core-hours in all" in PROSE


def test_one_size_with_ppo() -> None:
    readme = " ".join((DOCS.parent / "README.md").read_text().split())
    outcomes = {task: tables.published(f"equal-size-{task}-ppo") for task in ("beam6g", "cartpole")}
    pairs = {(task, pair.second): pair for task, outcome in outcomes.items() for pair in outcome.pairs}
    winners = {key: pair.verdict for key, pair in pairs.items() if pair.verdict.endswith("needs fewer")}
    assert winners == {
        ("beam6g", "network"): "network needs fewer",
        ("beam6g", "sines"): "sines needs fewer",
        ("beam6g", "mean-field"): "circuit needs fewer",
        ("cartpole", "network"): "circuit needs fewer",
    }
    ahead = [pairs["beam6g", other] for other in ("network", "sines")]
    leads = [percent(-lead) for pair in ahead for lead in (pair.leading_difference, pair.difference)]
    said = "they need {0} and {2} fewer steps to reach 0.85 (on average over the thresholds, {1} and {3})"
    assert f"the network and sines beat the 6-qubit circuit: {said.format(*leads)}" in readme
    assert "a 4-qubit circuit beats the network, and is not told apart from sines or its mean-field" in readme

    def numbers(task: str, other: str) -> list[str]:
        pair = pairs[task, other]
        ends = (pair.difference, *pair.interval, pair.leading_difference, *pair.leading_interval)
        return [percent(each) for each in ends]

    def turned(text: str) -> str:
        return text.removeprefix("-") if text.startswith("-") else f"-{text}"

    for other, words in (
        ("network", "The network needs {} fewer steps ({} to {}; to reach 0.85, {}, {} to {})"),
        ("sines", "sines {} fewer ({} to {}; to reach 0.85, {}, {} to {})"),
    ):
        mean, low, high, at, least, most = map(turned, numbers("beam6g", other))
        assert words.format(mean, high, low, at, most, least) in PROSE
    said = "Mean-field needs {} more ({} to {}; to reach 0.7, {}, {} to {})"
    assert said.format(*numbers("beam6g", "mean-field")) in PROSE
    said = "which needs {} more steps ({} to {}; to reach 0.95, {}, {} to {})"
    assert said.format(*numbers("cartpole", "network")) in PROSE
    for other, words in (
        ("sines", "Sines need {} fewer ({} to {})"),
        ("mean-field", "mean-field {} fewer ({} to {})"),
    ):
        mean, low, high = map(turned, numbers("cartpole", other)[:3])
        assert words.format(mean, high, low) in PROSE
    hours = 0.0
    for task, outcome in outcomes.items():
        tunings = [entry.tuning for entry in outcome.study.file.entries]
        hours += sum(tuning.core_hours for tuning in tunings)
        cells = " | ".join(percent(tuning.regret.expected) for tuning in tunings)
        assert f"| `{task}` with PPO | {cells} |" in PROSE
    assert f"The searches took {hours:.1f} core-hours together" in PROSE


def test_ten_qubits() -> None:
    readme = " ".join((DOCS.parent / "README.md").read_text().split())
    outcome = tables.published("ten-qubits")
    pairs = {pair.second: pair for pair in outcome.pairs}
    circuit = "10 qubits"
    assert {pair.first for pair in outcome.pairs} == {circuit}
    winners = {other: pair.verdict for other, pair in pairs.items() if pair.verdict.endswith("needs fewer")}
    assert winners == {
        "width 14": f"{circuit} needs fewer",
        "sines 14": "sines 14 needs fewer",
        "width 64": "width 64 needs fewer",
        "6 qubits": f"{circuit} needs fewer",
    }
    pair = pairs["10 qubits mean-field"]
    low, high = map(percent, pair.interval)
    assert pair.verdict.startswith("not told apart by 60 seeds")
    assert f"by 60 seeds ({percent(pair.difference)}, {low} to {high})" in PROSE
    pair = pairs["6 qubits"]
    assert (
        "6 qubits need {} more ({} to {})".format(*map(percent, (pair.difference, *pair.interval))) in PROSE
    )
    pair = pairs["width 14"]
    numbers = (pair.difference, *pair.interval, pair.leading_difference, *pair.leading_interval)
    assert (
        "Width 14 needs {} more ({} to {}; to reach 0.9, {}, {} to {})".format(*map(percent, numbers))
        in PROSE
    )
    assert f"which needs {percent(pair.leading_difference)} more steps to reach 0.9 (" in readme
    pair = pairs["sines 14"]
    low, high = pair.interval
    least, most = sorted(-end for end in pair.leading_interval)
    numbers = (-pair.difference, -high, -low, -pair.leading_difference, least, most)
    assert (
        "They need {} fewer steps ({} to {}; to reach 0.9, {}, {} to {})".format(*map(percent, numbers))
        in PROSE
    )
    pair = pairs["width 64"]
    low, high = pair.interval
    assert f"Width 64 needs {percent(-pair.difference)} fewer ({percent(-high)} to {percent(-low)})" in PROSE
    tunings = {each.name: each.tuning for each in outcome.study.file.entries}
    regrets = {name: percent(tuning.regret.expected) for name, tuning in tunings.items()}
    assert regrets == {
        circuit: "6%",
        "10 qubits mean-field": "5%",
        "width 14": "4%",
        "sines 14": "3%",
        "width 64": "3%",
        "6 qubits": "9%",
    }
    said = "6% for 10 qubits ({} trials, on an NVIDIA H200), 5% for mean-field ({}), 4% for width 14"
    assert said.format(tunings[circuit].trials, tunings["10 qubits mean-field"].trials) in PROSE
    assert tunings[circuit].note.endswith("trials trained on NVIDIA H200")

    def times(name: str, study: StudyOutcome) -> NDArray[np.float64]:
        """Steps below each threshold in 30 epochs, mean over seeds."""
        curves = study.state.curves[name].values[:, :30, None]
        return 2000 * (curves < np.array(outcome.study.grid.thresholds)).sum(axis=1).mean(axis=0)

    hand, ours = times("width 14", tables.published("larger-batch")), times(circuit, outcome)
    more = [percent(a / b - 1) for a, b in ((hand.mean(), ours.mean()), (hand[0], ours[0]))]
    assert f"needed {hand.mean() / 1000:.1f}k in 30 epochs" in PROSE
    assert "these settings need {} more (16% to 44%), and {} more to reach 0.9".format(*more) in PROSE
    assert f"with settings that were set by hand, we saw {more[1]} afterwards" in readme
    first = outcome.state.curves[circuit].values[:20]
    thresholds = np.array(outcome.study.grid.thresholds)
    below = [
        (curves[:, :, None] < thresholds).sum(axis=(0, 1))
        for curves in (outcome.state.curves["sines 14"].values, first)
    ]
    low = (below[0] / below[1] - 1)[thresholds <= 0.7]
    assert f"they needed {percent(min(low))} to {percent(max(low))} more on the same 20 seeds" in PROSE
