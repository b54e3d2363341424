"""Numbers in docs/leaderboard.md are those that the published entries give."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from qrlsuite import api
from qrlsuite.cli.app import build
from qrlsuite.leaderboard.boards.tables import main_section
from qrlsuite.leaderboard.shelf.published import PUBLISHED, read
from qrlsuite.statistics import Comparison, LearningCurves, Verdict, compare
from tests.docs import load
from tests.statistics.conftest import SURFACE

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "leaderboard.md").read_text()
LOAD = load("statements").load
BOARD = PAGE.partition("\n## The published board\n")[2].partition("\n## ")[0]


def printed(*options: str) -> str:
    """Return what `qrlsuite leaderboard --published --task beam6g` prints."""
    words = ["leaderboard", "--published", "--task", "beam6g", "--runs", "none", *options]
    return CliRunner().invoke(build(), words).stdout


def compared_cells(first: str, second: str) -> Comparison:
    cells = api.compare(LOAD(first, "beam6g"), LOAD(second, "beam6g"), rule="paper").cells
    assert cells is not None
    return cells


def test_the_decided_pairs_are_the_boards() -> None:
    [section] = json.loads(printed("--format", "json"))["sections"]
    labels = {row["entry"]: row["label"].removeprefix("ddqn ") for row in section["rows"]}
    times = section["times"]
    order = [labels[row["entry"]] for row in times["entries"]]
    pairs = times["adjusted_p"][order.index("mlp width=16 lr=0.002")]
    p = [f"{pairs[order.index(f'vqc-native qubits={n}')]:.3f}".removeprefix("0") for n in (10, 8)]
    compared = compared_cells("vqc-native qubits=10", "mlp width=16 lr=0.002")
    cells = f"{compared.count(Verdict.WIN)} of {sum(len(line) for line in compared.verdicts)}"
    text = PAGE.replace("\n", " ")
    assert f"{times['decided']} of {times['pairs']} pairs are decided." in text
    assert f"are not told apart (adjusted p {p[0]}), although" in text
    assert f"into different tiers, by {cells} cells." in text
    assert f"That network and 8 qubits are not told apart either ({p[1]})." in text


def test_the_core_hours_are_the_boards() -> None:
    [section] = api.board("beam6g", published=True, runs="none").sections
    hours = sum(row.entry.hours for row in section.rows)
    assert f"{hours:.1f} core-hours for all {len(section.rows)}," in BOARD


@pytest.mark.parametrize(
    ("first", "second", "sentence"),
    [
        ("mlp width=16 lr=0.002", "vqc-native qubits=6", "beats the 6-qubit circuit ({} of 49 cells)"),
        ("mlp width=16 lr=0.002", "vqc-native qubits=8", "and the 8-qubit one ({} cells)"),
        ("vqc-native qubits=10", "mlp width=16 lr=0.002", "but loses to 10 qubits ({} cells)"),
        ("vqc-native qubits=12", "mlp width=16 lr=0.002", "and to 12 ({} cells)."),
    ],
)
def test_the_cells_of_the_retuned_network(first: str, second: str, sentence: str) -> None:
    comparison = compared_cells(first, second)
    assert comparison.count(Verdict.LOSS) == 0
    assert sentence.format(comparison.count(Verdict.WIN)) in BOARD.replace("\n", " ")


def test_the_two_halves_of_the_seeds() -> None:
    published = [read(folder).entry_results() for folder in sorted((PUBLISHED / "beam6g").iterdir())]
    entries = {entry.label: entry for entry in published}
    circuit, network = entries["ddqn vqc-native qubits=10"], entries["ddqn mlp width=16 lr=0.002"]

    def ahead(seeds: slice) -> int:
        pair = [LearningCurves(entry.curves[seeds], 2000, entry.label) for entry in (circuit, network)]
        comparison = compare(*pair, SURFACE)
        assert comparison.count(Verdict.LOSS) == 0
        return comparison.count(Verdict.WIN)

    first, second = ahead(slice(0, 50)), ahead(slice(50, 100))
    text = BOARD.replace("\n", " ")
    assert f"the 10-qubit circuit is ahead in {first} cell;" in text
    assert f"on seeds 50 to 99 the circuit is ahead in {second} cells" in text


def about(title: str) -> str:
    """Return a section of the page as one line."""
    return " ".join(PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0].split())


def records(task: str) -> list[Any]:
    return [json.loads(path.read_text()) for path in sorted((PUBLISHED / task).glob("*/entry.json"))]


@pytest.mark.parametrize(
    ("task", "title", "sentence"),
    [
        ("pulse", "Pulses", "It took {:.2f} core-hours, and the 500 runs {:.2f}."),
        ("vqe-ising", "Three spins", "The searches took {:.2f} core-hours, the 500 runs {:.2f}."),
        ("clifford", "Clifford operations", "The searches took {:.2f} core-hours, the 400 runs {:.2f}."),
        ("cartpole", "CartPole with PPO", "The searches took {:.2f} core-hours, the 400 runs {:.2f}."),
        ("channel", "Error channels", "The searches took {:.2f} core-hours, the 400 runs {:.2f}."),
    ],
)
def test_what_searches_and_runs_took(task: str, title: str, sentence: str) -> None:
    section = main_section(api.board(task, published=True, runs="none").sections)
    rows = section.as_dict()["rows"]
    [(algorithm, _)] = Counter(row["label"].split()[0] for row in rows).most_common(1)
    rows = [row for row in rows if row["label"].startswith(f"{algorithm} ")]
    hours = [
        sum(float(each["core_hours"]) for each in taken) for taken in ([row["tuning"] for row in rows], rows)
    ]
    assert sentence.format(*hours) in about(title)


def test_what_the_board_of_pulse_took() -> None:
    text = about("Pulses")
    tunings = [record["tuning"] for record in records("pulse")]
    assert all(tuning["regret"]["expected"] <= 0.05 for tuning in tunings)
    runs = [tuning["runs"] for tuning in tunings]
    assert f"All entries reached it, after {min(runs)} to {max(runs)} runs each" in text


def test_what_the_board_of_three_spins_says() -> None:
    text = about("Three spins")
    tunings = [record["tuning"] for record in records("vqe-ising")]
    reached = [t["budget"] == "expected regret 3%" for t in tunings]
    assert sum(reached) == 2
    late = [t for t, done in zip(tunings, reached) if not done]
    regrets = [round(100 * t["regret"]["expected"]) for t in late]
    assert f"were stopped at {min(regrets)} to {max(regrets)} percent" in text
    runs = [t["runs"] for t in late]
    assert f"after {min(runs)} to {max(runs)} runs each" in text
    [section] = api.board("vqe-ising", published=True, runs="none").sections
    rows = section.as_dict()["rows"]

    def called(words: str) -> str:
        (found,) = (row["label"] for row in rows if row["label"].startswith(f"ppo {words}"))
        return str(found)

    sines, width = called("mlp width=5 activation=sin "), called("mlp width=5 input_scale")
    said = api.compare(LOAD(sines, "vqe-ising"), LOAD(width, "vqe-ising")).sentence
    assert "needs 32% fewer steps" in said
    assert "(26% to 37%, 50 seeds each" in said
    assert "with sines it needs 32% fewer steps (26% to 37%)" in text
    for circuit in ("vqc-native model.qubits=4 init", "vqc-native model.qubits=4 layers=5 ansatz=jerbi init"):
        (record,) = (each for each in records("vqe-ising") if each["label"] == called(circuit))
        assert record["identity"]["algorithm_options"]["quantum_lr"] < 1e-4
        assert round(record["identity"]["algorithm_options"]["lr"], 2) == 0.03

    times, labels = section.as_dict()["times"], {row["entry"]: row["label"] for row in rows}
    ranked = [labels[row["entry"]] for row in times["entries"]]
    controls = {
        kind: [place for place, label in enumerate(ranked) if kind in label]
        for kind in ("separable", "mean-field")
    }
    for ahead in controls["separable"]:
        for behind in (*controls["mean-field"], ranked.index(width)):
            assert ahead < behind
            assert times["adjusted_p"][ahead][behind] <= 0.05


def test_what_the_board_of_clifford_says() -> None:
    text = about("Clifford operations")
    tunings = {record["label"]: record["tuning"] for record in records("clifford")}
    reached = {label for label, tuning in tunings.items() if tuning["budget"] == "expected regret 3%"}
    assert {label.split()[1] for label in reached} == {"mlp", "vqc-native"}
    assert len(reached) == 3
    regrets = {
        name: (round(100 * tuning["regret"]["expected"]), tuning["runs"])
        for label, tuning in tunings.items()
        for name in ("width=16", "separable", "mean-field", "width=64", "tanh")
        if name in label
    }
    assert (
        f"width 16 at {regrets['width=16'][0]} percent ({regrets['width=16'][1]} runs), separable at "
        f"{regrets['separable'][0]}, mean-field at {regrets['mean-field'][0]}, width 64 at {regrets['width=64'][0]}, "
        f"and tanh at {regrets['tanh'][0]}, after {regrets['tanh'][1]} runs alone."
    ) in text
    pairs = {row[1]: row[2] for row in load("tables").pairs("clifford")}
    for asked, share in (("tanh", "36% more"), ("sines", "29% more"), ("width 6", "4% fewer")):
        assert share in pairs[f"`iqp` against {asked}"]
    assert "It needs 36% and 29% more steps." in text


@pytest.mark.parametrize(
    ("task", "title", "shares"),
    [
        ("cartpole", "CartPole with PPO", {"width 8": "30% fewer", "its mean-field control": "26% more"}),
        ("channel", "Error channels", {"tanh": "17% more", "sines": "18% more"}),
    ],
)
def test_what_the_boards_with_ppo_say(task: str, title: str, shares: dict[str, str]) -> None:
    text = about(title)
    section = main_section(api.board(task, published=True, runs="none").sections)
    facts = section.as_dict()
    rows = {row["entry"]: row for row in facts["rows"] if row["label"].startswith("ppo ")}
    pairs = {row[1]: row[2:] for row in load("tables").pairs(task)}
    for asked, share in shares.items():
        assert share in pairs[f"`iqp` against {asked}"][0]
    order = [row["entry"] for row in facts["times"]["entries"]]
    names = [load("tables")._short(rows[entry]["label"]) if entry in rows else "" for entry in order]
    better = {
        (names[one], names[other])
        for one, row in enumerate(facts["times"]["adjusted_p"])
        for other, p in enumerate(row)
        if p is not None and p <= 0.05 and one < other
    }
    if task == "cartpole":
        ahead = {"sines", "iqp mean-field", "iqp separable"}
        assert {one for one, other in better if other == "width 8"} >= ahead
        assert not better & {
            ("iqp", "width 8"),
            ("tanh", "width 8"),
            ("iqp mean-field", "iqp"),
            ("iqp separable", "iqp"),
            ("iqp", "iqp separable"),
            ("tanh", "iqp"),
            ("sines", "iqp"),
        }
        times = dict(zip(names, (row["mean_time"] for row in facts["times"]["entries"])))
        slow = [row["mean_time"] for row in facts["times"]["entries"] if row["entry"] not in rows]
        assert (
            f"{times['width 64'] / max(slow):.0%} to {times['width 8'] / min(slow):.0%} of the steps" in text
        )
    else:
        assert {("tanh", "iqp"), ("sines", "iqp"), ("iqp separable", "iqp")} <= better
        assert not better & {("width 6", "iqp"), ("iqp", "width 6"), ("iqp", "iqp mean-field")}
        assert (
            f"names {max(row['final_score'] for row in rows.values()):.0%}".replace("%", " percent") in text
        )
