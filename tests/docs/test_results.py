"""The pages of results are made from the published files; README, findings and judgments agree with them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.results.store import read_lines
from qrlsuite.studies.looks import FILE, LOG, Study
from qrlsuite.studies.study import load as load_study
from tests.conftest import cases
from tests.docs import load, percent

ROOT = Path(__file__).parents[2]
README, FINDINGS = (" ".join((ROOT / page).read_text().split()) for page in ("README.md", "docs/findings.md"))
tables, results = load("tables"), load("results")


def test_the_pages_are_what_the_published_files_say() -> None:
    made = results.pages()
    assert {path.name: path.read_text() for path in results.PAGES.iterdir()} == made, "run `make pictures`"
    assert set(results.names()) < {name.removesuffix(".md") for name in made}


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_are_what_the_published_files_say(page: Path) -> None:
    text = page.read_text()
    assert tables.TABLE.search(text)
    assert tables.filled(text) == text, "run `make pictures`"


def test_a_stale_table_is_replaced() -> None:
    text = (ROOT / "docs" / "findings.md").read_text()
    stale = text.replace("| +43% (", "| +44% (", 1)
    assert stale != text
    assert tables.filled(stale) == text


def test_judgments_are_short_and_each_has_its_page() -> None:
    for file in sorted(results.JUDGMENTS.iterdir()):
        judgment, _ = results.judged(file.stem)
        assert 0 < len(judgment.split()) <= results.MOST, file.name
        text = results.PAGES.joinpath(file.name).read_text()
        assert judgment in text
    assert {file.stem for file in results.JUDGMENTS.iterdir()} >= set(results.names())


@pytest.mark.parametrize("name", results.names())
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


# --- what README and docs/findings.md say


def test_one_size_on_several_tasks() -> None:
    verdicts = {
        (name.removeprefix("equal-size-"), pair.second): pair.verdict
        for name in results.TOGETHER["equal-size"]
        for pair in tables.published(name).pairs
    }
    ahead = {key for key, verdict in verdicts.items() if verdict == "circuit needs fewer"}
    assert ahead == {(task, "network") for task in ("beam6g", "frozenlake", "pulse")} | {("pulse", "sines")}
    behind = {key for key, verdict in verdicts.items() if verdict == f"{key[1]} needs fewer"}
    assert behind == {(task, "sines") for task in ("vqe-h2", "beam6g-a3-0", "frozenlake")}
    assert "with up to 60 seeds, showed it [on none of the seven tasks, either]" in FINDINGS
    network, sines, mean_field = list(tables.of_several("equal-size"))[1:]
    assert {row[1] for row in (network, sines, mean_field)} == {"not told apart"}


def test_larger_studies_say_what_readme_and_findings_say() -> None:
    pairs = {
        (outcome.study.task, pair.second): pair
        for outcome in tables.several("advantage")
        for pair in outcome.pairs
    }
    planted = {rival: pairs.pop(("planted", rival)) for rival in ("mean-field", "network", "sines")}
    assert [round(100 * pair.difference) for pair in planted.values()][:2] == [86, 53]
    assert "the mean-field control needs at least 86% more steps, the network 53% more." in FINDINGS
    assert [max(map(abs, pair.interval)) < 0.06 for pair in planted.values()] == [False, False, True]
    tasks = {task for task, _ in pairs}
    assert tasks == set(tables.SEVEN)
    leads = {key for key, pair in pairs.items() if pair.verdict == "circuit needs fewer"}
    control = {task for task in tasks if (task, "mean-field") in leads}
    assert control == tasks - {"pulse", "beam6g-a3-0", "beam6g-degree5"}
    assert {(task, "network") for task in tasks} < leads
    assert leads - {(task, "network") for task in tasks} - {(task, "mean-field") for task in control} == {
        ("pulse", "sines")
    }
    assert sorted(round(100 * pairs[task, "mean-field"].difference) for task in control) == [7, 8, 9, 13]
    assert [round(100 * pairs["pulse", name].difference) for name in ("mean-field", "sines", "network")] == [
        2,
        4,
        7,
    ]
    assert {task for task in tasks if pairs[task, "sines"].verdict == "sines needs fewer"} == {
        "cartpole",
        "vqe-h2",
    }
    [most, _] = tables.averaged("advantage").claim_lines
    assert most.endswith("established on none (by all looks; error 0.05 over the tasks, Holm)")
    mean_field, _, sines = list(tables.of_several("advantage"))[1:]
    assert (mean_field[1], sines[1]) == ("circuit needs fewer", "sines needs fewer")
    assert (mean_field[2].split()[0], sines[2].split()[0]) == ("+8.7%", "-5.5%")
    assert {min(outcome.taken) for outcome in tables.several("advantage")} == {50}
    [own] = {
        outcome.study.task
        for outcome in tables.several("advantage")
        if any(each.established for each in outcome.decision.claims if each.claim.at_most is None)
    }
    assert own == "pulse"
    excluded = [each.excluded for outcome in tables.several("advantage") for each in outcome.decision.claims]
    assert max(excluded) < 0.1
    assert (
        "beats the ReLU network on all seven tasks, and its mean-field control on four, by 7 to 13 percent. 3. Sines "
        "beat the circuit on two tasks. On `pulse` alone the circuit beats all three, by 2 to 7 percent"
        in README
    )
    assert "for seven tasks, we can show it [on none of them]" in README
    assert "shown to beat all three [on none of them]" in FINDINGS
    assert (
        "beats its mean-field control on four of seven tasks. Its mean lead over the seven is 9% after 50 seeds, and "
        "sines need 5.5% fewer steps than the circuit. No study claimed these means in advance." in FINDINGS
    )


def test_a_larger_batch_takes_a_third_of_the_steps() -> None:
    pairs = {(pair.first, pair.second): pair.difference for pair in tables.published("larger-batch").pairs}
    assert all(2 < pairs[name, f"{name}, batch 64"] < 2.5 for name in ("6 qubits", "width 10"))
    assert "both need about a third of the steps." in README
    assert "saves both models two thirds of their steps" in FINDINGS


ON_BOARDS = """
vqe-h2: iqp => ahead => width 6, iqp mean-field, iqp separable
vqe-h2: width 16 => ahead => iqp
pulse: iqp => level => width 8, sines, iqp mean-field
pulse: jerbi => level => width 8, sines, jerbi mean-field
pulse: iqp => ahead => iqp separable
vqe-ising: iqp => ahead => width 5, iqp mean-field
vqe-ising: jerbi => ahead => width 5
vqe-ising: iqp separable => ahead => width 5, iqp mean-field, jerbi mean-field
vqe-ising: jerbi separable => ahead => width 5, iqp mean-field, jerbi mean-field
vqe-ising: iqp => level => iqp separable, sines
vqe-ising: jerbi => level => jerbi separable
vqe-ising: sines => ahead => jerbi, width 5
clifford: tanh => ahead => iqp
clifford: sines => ahead => iqp
clifford: iqp => level => width 6, iqp separable
clifford: iqp => ahead => iqp mean-field
clifford: iqp separable => ahead => iqp mean-field
cartpole: iqp => level => width 8, tanh, sines, iqp mean-field, iqp separable
cartpole: sines => ahead => width 8
channel: tanh => ahead => iqp
channel: sines => ahead => iqp
channel: iqp separable => ahead => iqp
channel: iqp => level => width 6, iqp mean-field
"""
"""What judgments, README and findings rest on: a board, an entry, and which others it is ahead of or level with."""


@pytest.mark.parametrize(("first", "relation", "others"), cases(ON_BOARDS))
def test_a_judgment_is_what_its_board_decides(first: str, relation: str, others: str) -> None:
    task, _, first = first.partition(": ")
    facts = tables.main_facts(task)
    names = tables.short_names(task)
    order = [names[row["entry"]] for row in facts["times"]["entries"]]
    for other in others.split(", "):
        p = facts["times"]["adjusted_p"][order.index(first)][order.index(other)]
        assert (p <= 0.05) == (relation == "ahead"), other
        if relation == "ahead":
            assert order.index(first) < order.index(other)


def test_the_regrets_that_judgments_speak_of() -> None:
    regrets = {
        each.name: each.tuning.regret.expected
        for each in tables.published("equal-size-beam6g-ppo").study.file.entries
    }
    circuit = regrets.pop("circuit")
    assert circuit > 2 * max(regrets.values())
    pairs = {pair.second: pair for pair in tables.published("equal-size-beam6g-ppo").pairs}
    assert all(-circuit < pairs[name].difference < 0 for name in ("network", "sines"))


def test_what_a_note_says_of_ten_qubits() -> None:
    outcome = tables.published("ten-qubits")
    notes = " ".join(results.judged("ten-qubits")[1].split())

    def times(study: str, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Steps below each threshold in 30 epochs, mean over seeds."""
        curves = tables.published(study).curves[name].values[:, :30, None]
        return 2000 * (curves < np.array(outcome.study.grid.thresholds)).sum(axis=1).mean(axis=0)

    hand, ours = times("larger-batch", "width 14"), times("ten-qubits", "10 qubits")
    assert f"needed {hand.mean() / 1000:.1f}k steps in 30 epochs" in notes
    more = [percent(a / b - 1) for a, b in ((hand.mean(), ours.mean()), (hand[0], ours[0]))]
    assert f"{more[0]} more than 10 qubits (16% to 44%), {more[1]} more to reach 0.9" in notes


def test_seeds_that_learned_are_those_of_the_study() -> None:
    learned = {
        name: (int((np.max(curves.values, axis=1) >= 0.6).sum()), len(curves.values))
        for name, curves in tables.published("dissecting").curves.items()
    }
    notes = " ".join(results.judged("dissecting")[1].split())
    assert (learned["hsiao, ring of CNOTs"], learned["hsiao"]) == ((0, 40), (17, 40))
    assert "none of 40 seeds reached a score of 0.6; without them, 17 of 40 did" in notes
    assert [learned[f"skolik {n}"] for n in ("5 layers", "2 layers", "1 layer")] == [
        (21, 80),
        (5, 40),
        (0, 40),
    ]
    assert re.search(r"21 of 80 seeds with five layers reach 0.6, 5 of 40 with two, none with one", notes)


def test_the_family_says_what_findings_say() -> None:
    read = tables.averaged(tables.FAMILY)
    assert len(read.tasks) == 20
    assert [round(100 * pair.ratio.difference, 1) for pair in read.pairs] == [2.6, 4.2, 0.0]
    assert {pair.drawn_verdict for pair in read.pairs} == {"not told apart"}
    assert all(low < 0 < high for low, high in (pair.ratio.drawn_interval for pair in read.pairs))
    said = "control needs 2.6 percent more steps than the circuit, the network 4.2 and the sines as many."
    assert said in FINDINGS
