"""README, docs/plans.md, docs/quantum-or-not.md and docs/claims.md say what the published studies with looks say."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.results.store import read_lines
from qrlsuite.studies.looks import FILE, LOG, Study
from qrlsuite.studies.state import State
from qrlsuite.studies.study import load as load_study
from tests.conftest import cases
from tests.docs import load, percent

DOCS = Path(__file__).parents[2] / "docs"
STUDIES = (DOCS / "plans.md").read_text()
README, PROSE, CLAIMS = (
    " ".join((DOCS / page).read_text().split()) for page in ("../README.md", "quantum-or-not.md", "claims.md")
)
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
    assert set(outcome.decision.wanted.values()) == expected
    own = Study(published_studies.load(published_studies.PUBLISHED / name), tmp_path)
    own.begin()
    assert Study(load_study(str(own.folder / FILE)), tmp_path).hash == outcome.study.hash
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


SENTENCES = """
larger-batch: 6 qubits => 6 qubits, batch 64 => first => need {d} more steps (6 qubits, {low} to {high}) and
larger-batch: width 10 => width 10, batch 64 => first => and {d} more (width 10, {low} to {high})
larger-batch: 6 qubits => width 10 => first => which needs {d} more ({low} to {high}; to reach 0.9, {D}, {LOW} to {HIGH})
larger-batch: 6 qubits => 6 qubits mean-field => not told apart by 100 => (+{d}, {low} to {high})
larger-batch: 6 qubits => width 14 => not told apart by 100 => ({d}, {low} to {high})
equal-size-beam6g: circuit => network => first => needs {d} more steps ({low} to {high}; to reach 0.9, {D}, {LOW} to {HIGH})
equal-size-beam6g-a3-0: circuit => sines => second => {fewer} fewer on `beam6g-a3-0` ({least} to {most}; to reach 0.9, {FEWER}, {LEAST} to {MOST})
equal-size-beam6g-a3-0: circuit => mean-field => equal within 10 percent => , {low} to {high} and
equal-size-frozenlake: circuit => network => first => on `frozenlake` {d} more ({low} to {high})
equal-size-frozenlake: circuit => sines => second => {fewer} fewer on `frozenlake` ({least} to {most})
equal-size-frozenlake: circuit => mean-field => equal within 10 percent => and {low} to {high})
equal-size-vqe-h2: circuit => sines => second => They need {fewer} fewer steps on `vqe-h2` ({least} to {most})
equal-size-pulse: circuit => network => first => on `pulse` {d} more ({low} to {high})
equal-size-pulse: circuit => sines => first => on `pulse`: {d} ({low} to {high}; to reach 0.98, {D}, {LOW} to {HIGH})
equal-size-pulse: circuit => mean-field => equal within 10 percent => ({low} to {high},
equal-size-beam6g-ppo: circuit => network => second => they need {FEWER} and
equal-size-beam6g-ppo: circuit => sines => second => and {FEWER} fewer steps to reach 0.85 (on average over the thresholds,
equal-size-beam6g-ppo: circuit => network => second => (on average over the thresholds, {fewer} and
equal-size-beam6g-ppo: circuit => sines => second => and {fewer})
equal-size-beam6g-ppo: circuit => network => second => The network needs {fewer} fewer steps ({least} to {most}; to reach 0.85, {FEWER}, {LEAST} to {MOST})
equal-size-beam6g-ppo: circuit => sines => second => sines {fewer} fewer ({least} to {most}; to reach 0.85, {FEWER}, {LEAST} to {MOST})
equal-size-beam6g-ppo: circuit => mean-field => first => Mean-field needs {d} more ({low} to {high}; to reach 0.7, {D}, {LOW} to {HIGH})
equal-size-cartpole-ppo: circuit => network => first => which needs {d} more steps ({low} to {high}; to reach 0.95, {D}, {LOW} to {HIGH})
equal-size-cartpole-ppo: circuit => sines => not told apart by 60 => Sines need {fewer} fewer ({least} to {most})
equal-size-cartpole-ppo: circuit => mean-field => not told apart by 60 => mean-field {fewer} fewer ({least} to {most})
ten-qubits: 10 qubits => 10 qubits mean-field => not told apart by 60 => by 60 seeds ({d}, {low} to {high})
ten-qubits: 10 qubits => 6 qubits => first => 6 qubits need {d} more ({low} to {high})
ten-qubits: 10 qubits => width 14 => first => Width 14 needs {d} more ({low} to {high}; to reach 0.9, {D}, {LOW} to {HIGH})
ten-qubits: 10 qubits => width 14 => first => which needs {D} more steps to reach 0.9 (
ten-qubits: 10 qubits => sines 14 => second => They need {fewer} fewer steps ({least} to {most}; to reach 0.9, {FEWER}, {LEAST} to {MOST})
ten-qubits: 10 qubits => width 64 => second => Width 64 needs {fewer} fewer ({least} to {most})
dissecting: hsiao, outputs 16 times => hsiao => first => Hsiao's circuit needs {d} more steps ({low} to {high})
dissecting: hsiao, outputs 16 times => hsiao, output rate x 16 => first => needs {d} more steps ({low} to {high})
dissecting-layers: 5 layers, outputs 16 times => 5 layers => first => Skolik's {d} ({low} to {high})
dissecting-layers: 5 layers => 2 layers => first => needs {d} more steps than with five ({low} to {high}; to reach 0.6, {D}, {LOW} to {HIGH})
dissecting-layers: 5 layers => 5 layers, separable => first => without its CZs, {d} more steps ({low} to {high}; to reach 0.6, {D}, {LOW} to {HIGH})
dissecting-layers: 5 layers => 5 layers, mean-field => first => needs {d} more steps ({low} to {high})
pong-entanglement: 8 qubits, trained ZZ => 8 qubits, separable => first => needs {d} more steps ({low} to {high}) than
pong-entanglement: 8 qubits, CZ => 8 qubits, separable => first => {d} more than with CZs ({low} to {high}; to reach 0.4, {D}, {LOW} to {HIGH})
pong-entanglement: 8 qubits, CZ => width 6 => second => a network of its size needs {fewer} fewer than the CZs ({least} to {most})
"""  # noqa: E501
"""Study, pair, verdict, and a sentence on a page: `d` is how many more steps the second entry of the pair needs, with
its interval, `fewer` how many fewer; in capitals at the leading threshold."""


@pytest.mark.parametrize(("names", "second", "verdict", "sentence"), cases(SENTENCES))
def test_a_sentence_is_what_its_study_says(names: str, second: str, verdict: str, sentence: str) -> None:
    study, _, first = names.partition(": ")
    [pair] = [pair for pair in tables.published(study).pairs if (pair.first, pair.second) == (first, second)]
    said = {"first": f"{first} needs fewer", "second": f"{second} needs fewer"}.get(verdict)
    assert pair.verdict == said if said else pair.verdict.startswith(verdict)
    shares = (pair.difference, *pair.interval, pair.leading_difference, *pair.leading_interval)
    words = ("d", "low", "high", "D", "LOW", "HIGH"), ("fewer", "most", "least", "FEWER", "MOST", "LEAST")
    numbers = {
        word: percent(sign * share).replace("-0%", "0%")
        for sign, each in zip((1, -1), words)
        for word, share in zip(each, shares)
    }
    page = CLAIMS if study.startswith(("dissecting", "pong")) else PROSE
    assert sentence.format(**numbers) in (page + README if study.endswith(("-ppo", "ten-qubits")) else page)


def test_what_a_larger_batch_takes() -> None:
    outcome = tables.published("larger-batch")
    pairs = {(pair.first, pair.second): pair.difference for pair in outcome.pairs}
    names = [name for each in ("6 qubits", "width 10") for name in (each, f"{each}, batch 64")]
    assert all(2 < pairs[pair] < 2.5 for pair in (tuple(names[:2]), tuple(names[2:])))
    assert "both need about a third of the steps" in README
    facts = {each["name"]: each for each in outcome.as_dict()["entries"]}
    seconds = [3600 * facts[name]["core_hours"] / outcome.looked[name] for name in names]
    said = "takes {:.0f} core-seconds for 6 qubits in place of {:.0f}, and {:.0f} in place of {:.0f} for width 10"
    assert said.format(*seconds) in PROSE


FIRST_FOUR = ("beam6g", "beam6g-degree5", "vqe-h2", "pulse")
ONE_SIZE = ("beam6g", "beam6g-degree5", "beam6g-a3-0", "cartpole", "frozenlake", "vqe-h2", "pulse")


def test_one_size_on_several_tasks() -> None:
    verdicts = {
        (task, pair.second): pair.verdict
        for task in ONE_SIZE
        for pair in tables.published(f"equal-size-{task}").pairs
    }
    ahead = {key for key, verdict in verdicts.items() if verdict == "circuit needs fewer"}
    assert ahead == {(task, "network") for task in ("beam6g", "frozenlake", "pulse")} | {("pulse", "sines")}
    behind = {key for key, verdict in verdicts.items() if verdict == f"{key[1]} needs fewer"}
    assert behind == {(task, "sines") for task in ("vqe-h2", "beam6g-a3-0", "frozenlake")}
    equal = {key for key, verdict in verdicts.items() if verdict == "equal within 10 percent"}
    assert equal == {(task, "mean-field") for task in ("beam6g-a3-0", "frozenlake", "pulse")}
    assert len(verdicts) - len(ahead | behind | equal) == sum(
        "by 60 seeds" in each for each in verdicts.values()
    )
    assert "**On none of the seven could we show it.**" in README
    assert "On none of the seven tasks is the circuit shown to beat all three" in PROSE
    assert "The circuit beats the network on three tasks, and its mean-field control on none." in README
    assert "Sines beat it on three, and it beats them on one." in README


def test_the_mean_over_tasks_decides_nothing() -> None:
    names = "+".join(f"equal-size-{task}" for task in ONE_SIZE)
    assert f"<!-- table: {names} together -->" in PROSE
    _, network, sines, mean_field = tables.of_several(names)
    assert {row[1] for row in (network, sines, mean_field)} == {"not told apart"}
    for part, words in (
        (ONE_SIZE, "the seven give {} ({} to {}, p {})"),
        (FIRST_FOUR, "the network {} more steps"),
    ):
        row = next(
            row
            for row in tables.of_several("+".join(f"equal-size-{task}" for task in part))
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
    assert "the network and sines beat the 6-qubit circuit: they need" in README
    assert "a 4-qubit circuit beats the network, and is not told apart from sines or its mean-field" in README
    hours = 0.0
    for task in ("beam6g", "cartpole"):
        tunings = [entry.tuning for entry in tables.published(f"equal-size-{task}-ppo").study.file.entries]
        hours += sum(tuning.core_hours for tuning in tunings)
        cells = " | ".join(percent(tuning.regret.expected) for tuning in tunings)
        assert f"| `{task}` with PPO | {cells} |" in PROSE
    assert f"The searches took {hours:.1f} core-hours together" in PROSE


def test_ten_qubits() -> None:
    outcome, circuit = tables.published("ten-qubits"), "10 qubits"
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

    def times(name: str, study: State) -> NDArray[np.float64]:
        """Steps below each threshold in 30 epochs, mean over seeds."""
        curves = study.curves[name].values[:, :30, None]
        return 2000 * (curves < np.array(outcome.study.grid.thresholds)).sum(axis=1).mean(axis=0)

    hand, ours = times("width 14", tables.published("larger-batch")), times(circuit, outcome)
    more = [percent(a / b - 1) for a, b in ((hand.mean(), ours.mean()), (hand[0], ours[0]))]
    assert f"needed {hand.mean() / 1000:.1f}k in 30 epochs" in PROSE
    assert "these settings need {} more (16% to 44%), and {} more to reach 0.9".format(*more) in PROSE
    assert f"with settings that were set by hand, we saw {more[1]} afterwards" in README
    first = outcome.curves[circuit].values[:20]
    thresholds = np.array(outcome.study.grid.thresholds)
    below = [
        (curves[:, :, None] < thresholds).sum(axis=(0, 1))
        for curves in (outcome.curves["sines 14"].values, first)
    ]
    low = (below[0] / below[1] - 1)[thresholds <= 0.7]
    assert f"they needed {percent(min(low))} to {percent(max(low))} more on the same 20 seeds" in PROSE


def test_seeds_that_learned_and_hours_are_those_of_the_studies() -> None:
    both = [tables.published(name) for name in ("dissecting", "dissecting-layers")]
    hours = sum(each["core_hours"] for outcome in both for each in outcome.as_dict()["entries"])
    assert f"| {hours:.2f} for three claims |" in CLAIMS
    learned = {
        name: (int((np.max(curves.values, axis=1) >= 0.6).sum()), len(curves.values))
        for name, curves in both[0].curves.items()
    }
    assert learned["hsiao, ring of CNOTs"] == (0, 40)
    assert learned["hsiao"] == (17, 40)
    assert "none of 40 seeds reached a score of 0.6; without them, 17 of 40 did" in CLAIMS
    assert [learned[f"skolik {n}"] for n in ("5 layers", "2 layers", "1 layer")] == [
        (21, 80),
        (5, 40),
        (0, 40),
    ]
    assert "21 of 80 seeds with five layers, 5 of 40 with two, none with one" in CLAIMS


def test_the_hours_and_times_of_pong() -> None:
    outcome = tables.published("pong-entanglement")
    assert f"| {sum(each['core_hours'] for each in outcome.as_dict()['entries']):.2f} |" in CLAIMS
    times = [f"{time.mean / 1000:.0f}k" for time in outcome.mean_times().values()]
    assert f"is at {times[3]} steps, the circuits at {times[1]} to {times[2]}" in CLAIMS
