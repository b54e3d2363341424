"""The table of the paper's statements, `docs/statements.csv`: `make statements` computes it from what is published.

A row's evidence begins with what it compares: a pair of entries, two tasks or two algorithms, or a study. Its verdict
and its numbers follow. Numbers inside sentences are those of `FACTS` and `ANTENNAS`. A row without any of these is
prose. `expected` says what the paper expects of the first entry: fewer steps than the second, as many in most cells or
in nearly all, no fewer, or slightly more.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qrlsuite import api
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.shelf.published import PUBLISHED, read
from qrlsuite.results.text import percent
from qrlsuite.statistics import Comparison, Direction, LearningCurves, TimesBoard, Verdict, times_board
from qrlsuite.statistics.estimator import sample_complexity
from qrlsuite.statistics.times import times_below
from qrlsuite.statistics.times_board import holm
from qrlsuite.studies.state import versus

if TYPE_CHECKING:
    from qrlsuite.leaderboard.boards.times import TimeRanking
    from qrlsuite.leaderboard.shelf.curves import EntryResults

DOCS = Path(__file__).parent
FILE = DOCS / "statements.csv"
COLUMNS = ("paper", "statement", "expected", "kind", "verdict", "seeds", "evidence", "error")
PAIR = re.compile(
    r"(?:study `(?P<study>[\w-]+)`, )?(?P<task>[\w+-]+): `(?P<first>[^`]+)` against `(?P<second>[^`]+)`"
)
EVERY_MODEL = re.compile(r"`(?P<first>[^`]+)` against `(?P<second>[^`]+)`(?: on `(?P<task>[^`]+)`)?: ")
STUDY = re.compile(r"study \[([\w-]+)\]")
PLANNED = re.compile(r"`(?P<pair>[^`/]+ / [^`/]+)`: (?P<verdict>[^;]+?)(?=;|$)")
NUMBER = r"[-+]?\d+(?:\.\d+)?%?"
RETUNED = " lr=0.002"
FEW_CELLS = "only in that most cells show no difference"
MODELS = ("mlp width=16", "mlp width=32", "mlp width=64", "vqc-native qubits=10")
COUNTS = (2, 3, 4, 5)
"""Numbers of antennas of the random placements."""

Row = dict[str, str]
Numbers = NDArray[np.float64]


@cache
def load(label: str, task: str) -> EntryResults:
    """Return a published entry."""
    return api.load(label, task=task, published=True, runs="none")


@cache
def board_of(study: str | None, task: str) -> TimeRanking:
    """Return a published board by mean times, at its longest horizon."""
    times = api.board(task, study=study, published=True, runs="none").sections[-1].times
    assert times is not None
    return times


# --- pairs


def places(signs: NDArray[np.int64], kind: str, levels: Iterable[str]) -> str:
    """Write where fewer or more steps are significant: `, fewer at epsilon 0.1, 0.15`; empty where nowhere."""
    text = ""
    for word, sign in (("fewer", 1), ("more", -1)):
        if found := [level for level, each in zip(levels, signs) if each == sign]:
            every = len(found) == len(signs)
            text += f", {word} at every {kind}" if every else f", {word} at {kind} {', '.join(found)}"
    return text


def judged(board: TimeRanking, first: str, second: str, expected: str, cells: Comparison) -> str:
    """Return the verdict on a statement about a pair, by rule `steps` with Holm's correction."""
    labels = [row.entry.label for row in board.rows]

    def direction(other: str) -> Direction:
        return board.board.directions[board.order[labels.index(first)]][board.order[labels.index(other)]]

    decided, wins, losses = direction(second), cells.count(Verdict.WIN), cells.count(Verdict.LOSS)
    if decided is Direction.NOT_TOLD_APART:
        word = "a trade-off" if wins and losses else "fewer" if wins else "more" if losses else None
        return f"not told apart by `steps`; {word} by the paper's rule" if word else "not told apart"
    if expected.startswith("as many"):
        share = (wins + losses) / sum(len(line) for line in cells.verdicts)
        return FEW_CELLS if share < (0.5 if expected == "as many" else 0.1) else "does not hold"
    if expected == "slightly more":
        return (
            "holds; whether *slightly* is not decided"
            if decided is Direction.MORE and not wins
            else "does not hold"
        )
    if {"fewer": Direction.FEWER, "no fewer": Direction.MORE}.get(expected) is not decided:
        return "does not hold"
    if losses if expected == "fewer" else wins:
        return "holds by `steps`, not by the paper's rule"
    if second + RETUNED in labels and direction(second + RETUNED) is not decided:
        return "holds at the released rates only"
    return "holds"


def pair(row: Row, match: re.Match[str]) -> Row:
    """Return the row of a pair of entries."""
    task, first, second = match["task"], match["first"], match["second"]
    board = board_of(match["study"], task)
    cells = api.compare(load(first, task), load(second, task), rule="paper").cells
    assert cells is not None
    entries = {each.entry.label: each.entry for each in board.rows}
    i, j = (board.order[list(entries).index(label)] for label in (first, second))
    change = f"steps below threshold {percent(board.board.difference[i, j])}"
    error = f".05 for {board.n_pairs} pair" + "s" * (board.n_pairs > 1)
    return {
        "verdict": judged(board, first, second, row["expected"], cells),
        "seeds": " and ".join(str(len(entries[label].seeds)) for label in (first, second)),
        "evidence": f"{match[0]}: fewer in {cells.count(Verdict.WIN)} cells, more in {cells.count(Verdict.LOSS)} of "
        f"{sum(len(line) for line in cells.verdicts)}; {change}; p {board.board.adjusted[i, j]:.4f}",
        "error": f"about {error}: unequal numbers" if board.board.few[i, j] else error,
    }


# --- every model, in two places

Compared = list[tuple[str, TimesBoard, Direction, str]]


def each_model(found: Iterable[tuple[EntryResults, EntryResults]], first: str, second: str) -> Compared:
    """Compare the entries of each pair by `steps`, with Holm's correction over the pairs.

    Returns
    -------
    Label, board, direction and `+14%, p 0.0004` of each pair, the largest model first.
    """
    found = sorted(found, key=lambda pair: sum(pair[1].parameters), reverse=True)
    pairs = []
    for entry, other in found:
        n, length = min(len(entry.seeds), len(other.seeds)), other.curves.shape[1]
        assert entry.seeds[:n] == other.seeds[:n] == tuple(range(n))
        curves = [
            LearningCurves(each.curves[:n, :length], each.steps_per_epoch, name)
            for name, each in ((first, entry), (second, other))
        ]
        grid = ranking_of([other]).grid
        pairs.append((other.label, times_board(curves, grid)))
    compared: Compared = []
    for p, (label, board) in zip(holm([board.p[0, 1] for _, board in pairs]), pairs):
        direction = board.directions[0][1] if p <= 0.05 else Direction.NOT_TOLD_APART
        compared.append((label, board, direction, f"{percent(board.difference[0, 1])}, p {p:.4f}"))
    return compared


def twice(first: str, second: str, task: str | None) -> Iterator[tuple[EntryResults, EntryResults]]:
    """Yield every model on one task and on another, or with one algorithm and with another on `task`."""
    if task is None:
        for folder in (PUBLISHED / first).iterdir():
            entry = read(folder).entry_results()
            yield entry, load(entry.label, second)
        return
    for row in api.board(task, study=first, published=True, runs="none").sections[-1].rows:
        yield row.entry, load(f"{second} {row.entry.label.removeprefix(f'{first} ')}", task)


def every_model(row: Row, match: re.Match[str]) -> Row:
    """Return the row of all models that are published in two places."""
    first, second = match["first"], match["second"]
    compared = each_model(twice(**match.groupdict()), first, second)
    directions = [direction for _, _, direction, _ in compared]
    against = directions.count(Direction.FEWER)
    if set(directions) == {Direction.MORE}:
        text = "holds"
    elif row["expected"] == "more":
        text = f"holds for {directions.count(Direction.MORE)} of {len(directions)} models"
    else:
        text = f"does not hold for {against} of {len(directions)} models" if against else "not told apart"
    seeds = [str(board.n_runs[0]) for _, board, _, _ in compared]
    each = (f"`{label.removeprefix(f'{second} ')}` {said}" for label, _, _, said in compared)
    return {
        "verdict": text,
        "seeds": f"{seeds[0]} of each" if len(set(seeds)) == 1 else ", ".join(seeds),
        "evidence": match[0] + "; ".join(each),
        "error": f".05 for {len(compared)} models",
    }


# --- studies with looks


def of_study(row: Row, match: re.Match[str]) -> Row:
    """Return the row of some pairs of a published study with looks: each has the study's verdict."""
    pairs = {
        versus(each): each for each in published_studies.read(published_studies.PUBLISHED / match[1]).pairs
    }
    named = [found["pair"] for found in PLANNED.finditer(row["evidence"])]
    assert len(named) == row["evidence"].count(" / ") > 0, row["statement"]
    evidence = PLANNED.sub(
        lambda found: f"`{found['pair']}`: {pairs[found['pair']].verdict}", row["evidence"]
    )
    verdict = row["verdict"]
    if verdict.endswith(" percent"):
        better = [pairs[name] for name in named if pairs[name].verdict == f"{pairs[name].second} needs fewer"]
        sizes = iter(f"{100 * abs(each.difference):.0f}" for each in better)
        verdict = re.sub(r"(?<=by |nd )\d+(?= and| percent)", lambda _: next(sizes), verdict)
    return {**row, "verdict": verdict, "evidence": evidence, "error": f".05 for {len(pairs)} pairs"}


# --- random placements


@cache
def placements(model: str, count: int) -> tuple[EntryResults, ...]:
    """Return the five entries of a model with so many antennas, of 20 seeds each."""
    entries = tuple(load(f"ddqn {model}", f"beam6g-a{count}-{place}") for place in range(5))
    assert {entry.curves.shape for entry in entries} == {(20, 100)}
    return entries


def mean_times(model: str) -> Numbers:
    """Return a model's steps below threshold on every placement: shape (numbers of antennas, 5)."""
    grid = ranking_of(placements(model, 2)[:1]).grid
    return np.array(
        [
            [
                times_below(entry.curves, grid, entry.steps_per_epoch).mean()
                for entry in placements(model, count)
            ]
            for count in COUNTS
        ]
    )


def complexities(count: int) -> dict[tuple[float, float], NDArray[np.int64]]:
    """Return sample complexity by epsilon and delta: of each model on the placements of a count, shape (4, 5)."""
    grid = ranking_of(placements(MODELS[0], count)).grid
    found = np.array(
        [
            [
                sample_complexity(entry.curves, grid, entry.steps_per_epoch)
                for entry in placements(model, count)
            ]
            for model in MODELS
        ]
    )
    return {
        (float(level), float(delta)): found[:, :, i, j]
        for i, level in enumerate(grid.levels)
        for j, delta in enumerate(grid.deltas)
    }


def thousands(values: Iterable[float]) -> str:
    """Write steps: `12k, 34k and 56k`."""
    texts = [f"{value / 1000:.0f}k" for value in values]
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def slopes() -> tuple[str, str, str]:
    """How steps below threshold rise with antennas: placements are permuted among the numbers, Holm over the models."""
    antennas = np.repeat(COUNTS, 5) - np.mean(COUNTS)
    order = np.random.default_rng(0).random((10_000, len(antennas))).argsort(1)
    rises, p = [], []
    for times in (mean_times(model).ravel() for model in MODELS):
        rises.append(times @ antennas / (antennas @ antennas))
        p.append((1 + (times[order] @ antennas >= times @ antennas).sum()) / (1 + len(order)))
    largest = max(holm(p))
    return (
        "holds" if largest <= 0.05 else "not told apart",
        "by the slopes of lines, steps below threshold of widths 16, 32, 64 and of 10 qubits rise by "
        f"{thousands(rises)} steps per antenna; placements permuted among the numbers of antennas, "
        f"largest p {largest:.4f}",
        ".05 for 4 models",
    )


@cache
def against(count: int) -> tuple[list[int], list[str], Counter[Verdict]]:
    """Return signs, texts and the paper's cells of 10 qubits against each network, across a count's placements."""
    tasks = [f"beam6g-a{count}-{place}" for place in range(5)]
    board = api.board(tasks, runs="none", published=True).sections[0].results
    circuit = board.names.index(f"ddqn {MODELS[3]}")
    signs, texts, verdicts = [], [], Counter[Verdict]()
    for model in MODELS[:3]:
        network = board.names.index(f"ddqn {model}")
        signs.append(int(board.better[circuit, network]))
        word = {1: "fewer", 0: "not told apart", -1: "more"}[signs[-1]]
        change = percent(board.mean[circuit] / board.mean[network] - 1)
        texts.append(f"{change} ({word}, p {board.adjusted[circuit, network]:.4f})")
        for task in tasks:
            pair = load(f"ddqn {MODELS[3]}", task), load(f"ddqn {model}", task)
            cells = api.compare(*pair, rule="paper").cells
            assert cells is not None
            verdicts.update(each for line in cells.verdicts for each in line)
    return signs, texts, verdicts


def against_networks() -> tuple[str, str, str]:
    """10 qubits against each network, by the boards across the placements of each number of antennas."""
    signs = [sign for count in COUNTS for sign in against(count)[0]]
    cells = sum((against(count)[2] for count in COUNTS), Counter[Verdict]())
    wins, losses, behind = cells[Verdict.WIN], cells[Verdict.LOSS], signs.count(-1)
    told = wins + losses + cells[Verdict.TIE]
    text = f"holds for {len(signs) - behind} of {len(signs)} pairs" if behind else "holds"
    if behind and 2 * (wins + losses) < told:
        text = f"{FEW_CELLS}: behind in {behind} of {len(signs)} pairs"
    return (
        text,
        "steps below threshold of 10 qubits against widths 16, 32 and 64, across the five placements: "
        f"{'; '.join(f'{count} antennas ' + ', '.join(against(count)[1]) for count in COUNTS)}. By the paper's rule "
        f"fewer samples in {wins} and more in {losses} of the {told} cells in which not both are at the cap",
        ".05 for 6 pairs of each number of antennas",
    )


def two_antennas() -> tuple[str, str, str]:
    """The one cell in which the paper sees 10 qubits behind width 16, and width 64 struggle."""
    means = {cell: found.mean(1) for cell, found in complexities(2).items()}
    there = means[0.1, 0.75]
    assert there[0] < min(there[2:]), "not even in that cell"
    behind = [cell for cell, found in means.items() if found[0] < found[3]]
    verdict = "holds" if behind == [(0.1, 0.75)] else "holds there, but not only there"
    return (
        f"{verdict}, without a test",
        f"mean sample complexity of the placements there: {thousands(there)} for widths 16, 32, 64 and 10 qubits "
        f"(counted as 200k where it is at the cap); 10 qubits are behind width 16 in {len(behind)} of {len(means)} "
        "cells, though",
        "-",
    )


def five_antennas() -> tuple[str, str, str]:
    """In how many placements of five antennas each model gets below the cap."""
    texts = []
    for cell in ((0.2, 0.5), (0.3, 0.5)):
        counts = (complexities(5)[cell] < 200_000).sum(1)
        texts.append(f"at epsilon {cell[0]} in {', '.join(map(str, counts[:3]))} and {counts[3]}")
    return (
        "not told, without a test",
        "placements in which sample complexity at delta 0.5 is below the cap, of five, for widths 16, 32, 64 and 10 "
        f"qubits: {'; '.join(texts)}. The paper does not say for which cell, and its placements are others",
        "-",
    )


def harder() -> tuple[str, str, str]:
    """How steps below threshold rise with antennas, and with the degree of the paths, at equal thresholds."""
    rises = []
    grid = ranking_of(placements(MODELS[0], 3)[:1]).grid
    for model in MODELS:
        few, many = mean_times(model)[1:3].mean(1)
        easy, hard = (
            times_below(entry.curves[:20], grid, entry.steps_per_epoch).mean()
            for entry in (load(f"ddqn {model}", task) for task in ("beam6g", "beam6g-degree6"))
        )
        rises.append((many / few - 1, hard / easy - 1))
    antennas, degrees = (", ".join(map(percent, column)) for column in zip(*rises))
    holds = "holds" if all(antenna > degree for antenna, degree in rises) else "does not hold"
    return (
        f"{holds}, without a test",
        f"steps below threshold of widths 16, 32, 64 and of 10 qubits, at epsilon 0.3, 0.2 and 0.1: {antennas} from 3 "
        f"antennas to 4 (means of five placements), {degrees} from degree 3 to 6",
        "-",
    )


ANTENNAS: dict[str, Callable[[], tuple[str, str, str]]] = {
    "Sample complexity rises clearly with the number of antennas, for every model": slopes,
    "More antennas make the task significantly more difficult, compared with the degree of the paths": harder,
    "10 qubits are competitive in most cells": against_networks,
    "Only with 2 antennas, at epsilon 0.1 and delta 0.75, they are worse than width 16, and there width 64 struggles, "
    "too": two_antennas,
    "With 5 antennas only width 64 succeeds, in one placement": five_antennas,
}
"""Verdict, evidence and error of statements about random placements."""

# --- numbers inside sentences


def bias() -> tuple[str, str]:
    """How far few runs are from many, by the table of docs/error-rates.md."""
    table = (DOCS / "error-rates.md").read_text()
    found = {
        (network, int(runs)): np.array([float(cell) for cell in cells.split(" | ")])
        for network, runs, cells in re.findall(r"^\| (width\d+) \| (\d+) \| (.*) \|$", table, re.M)
    }
    few, many = (
        max(abs(found[name, runs] / found[name, 1000] - 1).max() for name in ("width16", "width64"))
        for runs in (5, 100)
    )
    return f"{100 * many:.0f}", f"{100 * few:.0f}"


def five_runs() -> tuple[str, ...]:
    """Of draws of five runs, how many order two entries against what all runs say."""
    entries = [load(f"ddqn {label}", "beam6g") for label in ("vqc-native qubits=10", "mlp width=32")]
    levels = 1 - np.array(ranking_of(entries[:1]).grid.levels)
    times = [(entry.curves[:, :, None] < levels).sum(1).mean(1) for entry in entries]
    assert times[0].mean() > times[1].mean()
    source = np.random.default_rng(0)
    fives = [each[source.random((10_000, len(each))).argsort(1)[:, :5]].mean(1) for each in times]
    return (f"{100 * (fives[0] < fives[1]).mean():.0f}",)


def cut() -> tuple[str, ...]:
    """The cells of CartPole at epsilon 0.05."""
    first, second = "reinforce vqc-native qubits=4 layers=1", "reinforce mlp width=16 depth=1"
    found = api.compare(load(first, "cartpole"), load(second, "cartpole"), rule="paper").cells
    assert found is not None
    cells = found.verdicts[0]
    won, lost = cells.count(Verdict.WIN), cells.count(Verdict.LOSS)
    assert won + lost < len(cells), (
        "every cell is significant: the statement about epsilon 0.05 does not hold"
    )
    return str(won), str(lost), str(len(cells))


def end(label: str, task: str = "beam6g") -> float:
    """Return the median score after the last epoch."""
    return float(np.median(load(f"ddqn {label}", task).curves[:, -1]))


def ends(*labels: str, task: str = "beam6g") -> tuple[str, ...]:
    """Return the median scores after the last epoch."""
    return tuple(f"{end(label, task):.3f}" for label in labels)


def u3() -> list[Numbers]:
    """Return 20 learning curves of 10 qubits with `u3`, and with `rot`."""
    return [load(f"ddqn {MODELS[3]}{gate}", "beam6g").curves[:20] for gate in (" gate=u3", "")]


def in_placements(model: str, count: int) -> str:
    """Return the final score of a model with so many antennas."""
    return f"{np.mean([np.median(each.curves[:, -1]) for each in placements(model, count)]):.3f}"


def extremes() -> tuple[str, ...]:
    """The lowest and the highest final score with paths of degree 6."""
    found = [
        np.median(read(folder).entry_results().curves[:, -1])
        for folder in (PUBLISHED / "beam6g-degree6").iterdir()
    ]
    return f"{min(found):.3f}", f"{max(found):.3f}"


BOTH = ("mlp width=64", "vqc-native qubits=10")
FACTS: dict[str, Callable[[], tuple[str, ...]]] = {
    "than width 32 in {} percent of draws": five_runs,
    "at most {} percent from that of 1000, the one of 5 runs by up to {} ": bias,
    "of the row above: fewer in {} cells, more in {} of {}": cut,
    "ends at {} of the optimum (median)": lambda: ends("mlp width=16"),
    "of width 64 end at {} and of 14 qubits at {} of the optimum": lambda: ends(
        "mlp width=64", "vqc-native qubits=14"
    ),
    "end at {} and {} of the optimum with paths of degree 4": lambda: ends(*BOTH, task="beam6g-degree4"),
    "at {} and {} with degree 5": lambda: ends(*BOTH, task="beam6g-degree5"),
    "at {} and {} with degree 6": lambda: ends(*BOTH, task="beam6g-degree6"),
    "means of the five placements, at {}, {}, {}, {} and at {}, {}, {}, {}": lambda: tuple(
        in_placements(model, count) for model in BOTH for count in COUNTS
    ),
    "{} of the optimum with `u3` and {} with `rot`": lambda: tuple(
        f"{np.median(curves[:, -1]):.3f}" for curves in u3()
    ),
    "scatter by {} and {} ": lambda: tuple(f"{np.median(curves[:, -20:].std(1)):.3f}" for curves in u3()),
    "all four models end at {} to {} of the optimum": extremes,
    "with 3, 4 and 5 antennas (rows below); with 2 antennas {} (more, p {})": lambda: tuple(
        re.fullmatch(r"(.*) \(more, p (.*)\)", against(2)[1][0]).groups()
    ),
}
"""Sentences of the evidence, each in one row, and the numbers in them."""


def with_facts(row: Row) -> tuple[Row, set[str]]:
    """Return a row with its numbers as they are now, and the sentences that it has."""
    found = set()
    for sentence, numbers in FACTS.items():
        pattern = re.escape(sentence).replace(r"\{\}", NUMBER)
        if re.search(pattern, row["evidence"]):
            found.add(sentence)
            text = sentence.format(*numbers())
            row = {**row, "evidence": re.sub(pattern, lambda _, text=text: text, row["evidence"], count=1)}
    return row, found


# --- the table


def table() -> list[Row]:
    """Return the rows of the file."""
    with FILE.open(newline="") as file:
        return list(csv.DictReader(file))


def computed(rows: list[Row]) -> list[Row]:
    """Return the rows as the published entries and studies now give them."""
    result, facts = [], Counter[str]()
    for row in rows:
        evidence = row["evidence"]
        if row["statement"] in ANTENNAS:
            verdict, text, error = ANTENNAS[row["statement"]]()
            new: Row = {"verdict": verdict, "seeds": "20 of each", "evidence": text, "error": error}
        elif match := PAIR.match(evidence):
            new = pair(row, match)
        elif match := EVERY_MODEL.match(evidence):
            new = every_model(row, match)
        elif match := STUDY.match(evidence):
            new = of_study(row, match)
        else:
            new, found = with_facts(row)
            facts.update(found)
        new = {**row, **new}
        result.append({**new, "kind": kind_of(new["verdict"])})
    wrong = [sentence for sentence in FACTS if facts[sentence] != 1]
    assert not wrong, f"sentences that are not in one row: {wrong}"
    assert set(ANTENNAS) <= {row["statement"] for row in rows}
    return result


def kind_of(verdict: str) -> str:
    """Return how the summary counts a verdict."""
    if verdict in ("holds", "holds, without a test"):
        return "holds"
    if verdict.startswith(("not run", "not comparable")):
        return "not measured"
    for start, kind in (("does not hold", "does not hold"), ("not told", "not told apart")):
        if verdict.startswith(start):
            return kind
    return "in part"


def summary(rows: list[Row]) -> str:
    """Count the verdicts on the paper's own statements."""
    kinds = Counter(row["kind"] for row in rows if not row["statement"].startswith("Ours"))
    return (
        f"Of {kinds.total()} statements of the paper, {kinds['holds']} hold, {kinds['in part']} hold in part, "
        f"{kinds['does not hold']} do not hold, {kinds['not told apart']} are not told apart, and "
        f"{kinds['not measured']} are not measured"
    )


def main() -> None:
    """Write the file anew."""
    rows = computed(table())
    with FILE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
