"""How often permutation tests, boards by mean times and studies with looks err, and how much they find.

    OPENBLAS_NUM_THREADS=1 python benchmarks/verdicts_calibration.py [--pairs 10000] [PART ...]

Fresh runs are drawn from smoothed models (`SmoothedRuns`) of the published entries of task beam6g, on the 49 cells of
its surface grid. `--pairs` is the number of simulated pairs or studies per line (parts equals, decisions,
equality); a tenth of it for power, seeds and studies of five entries, 1/25 for coverage, a hundredth for boards. Many
tables of docs/error-rates.md are its output. `benchmarks/calibration.py` measures entries of
your own, and `benchmarks/laws.py` rule `steps` on generated runs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from simulated import judge, simulated_pairs

from qrlsuite.leaderboard.shelf.published import PUBLISHED, read
from qrlsuite.statistics import (
    Decided,
    Grid,
    IntervalRule,
    LearningCurves,
    SequentialDesign,
    SmoothedRuns,
    TimesRule,
    bootstrap_interval,
    decision_rates,
    mean_time,
    outperformance,
    sample_complexity,
    slower,
    times_below,
    times_board,
)
from qrlsuite.statistics.permutation import with_half_epoch
from qrlsuite.statistics.simulation import draw_steps, draw_times, judge_steps, play

EPSILONS, DELTAS = [0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4], [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]
GRID = Grid.relative(EPSILONS, DELTAS)
W16, W32, W64, W128 = (f"ddqn mlp width={width}" for width in (16, 32, 64, 128))
Q6, Q8, Q10 = (f"ddqn vqc-native qubits={qubits}" for qubits in (6, 8, 10))
POPULATIONS = (W64, W16, Q10)
SIZES = (20, 50, 100)
HORIZON = 200_000
RULES = (IntervalRule(), TimesRule())


def published() -> dict[str, LearningCurves]:
    """Return the published entries of beam6g by name."""
    entries = [read(folder).entry_results() for folder in sorted((PUBLISHED / "beam6g").iterdir())]
    return {each.label: LearningCurves(each.curves, each.steps_per_epoch, each.label) for each in entries}


ENTRIES = published()
MODELS = {name: SmoothedRuns(entry) for name, entry in ENTRIES.items()}


def line(*cells: object) -> None:
    """Print a row of a table; fractions as percentages."""
    shown = [f"{100 * cell:.2f}%" if isinstance(cell, float) else str(cell) for cell in cells]
    print(f"| {' | '.join(shown)} |", flush=True)


def head(title: str, *columns: str) -> None:
    print(f"\n{title}\n")
    line(*columns)
    print("|" + "---|" * len(columns), flush=True)


def print_replication(pairs: int) -> None:
    """How much of the published board comes out again with 100 fresh runs per entry, by either rule."""
    count, generator = max(10, pairs // 10), np.random.default_rng(12)
    entries = list(ENTRIES.values())
    now, tiers = times_board(entries, GRID), _tiers(entries)
    decided = np.argwhere(np.triu(now.adjusted <= 0.05))
    again, all_again, order, tiering = 0, 0, 0, 0
    for _ in range(count):
        fresh = [
            LearningCurves(np.clip(_mixed(entry, 100, generator), 0, 1), entry.steps_per_epoch, entry.name)
            for entry in entries
        ]
        board = times_board(fresh, GRID)
        same = [board.directions[i][j] is now.directions[i][j] for i, j in decided]
        again, all_again = again + np.mean(same), all_again + all(same)
        order += board.order == now.order
        tiering += _tiers(fresh) == tiers
    n_pairs = len(entries) * (len(entries) - 1) // 2
    columns = ("of the published board", f"comes out again, of {count} replications")
    head(f"{len(entries)} entries, 100 fresh runs each (published runs mixed with near neighbors)", *columns)
    line(f"a decision by `steps` ({len(decided)} of {n_pairs} pairs)", float(again / count))
    line("all of these decisions at once", all_again / count)
    line("the order by mean", order / count)
    line(f"the {len(tiers)} tiers of the paper's rule", tiering / count)


def print_decisions(pairs: int) -> None:
    design = SequentialDesign(("a", "b"))
    head(f"Study with looks, two equals, {pairs} studies", "entry", "differ", "equal within 10%", "mean runs")
    for name in (*POPULATIONS, W128, Q8):
        rates = decision_rates(
            [MODELS[name]] * 2, design, GRID, pairs if name in POPULATIONS else pairs // 10, seed=1
        )
        line(name, rates.any_difference, rates.verdicts[0][Decided.EQUAL], f"{rates.mean_runs[0]:.0f}")


def print_five(pairs: int) -> None:
    design = SequentialDesign(tuple("abcde"))
    head(f"Study with looks, five equals, {pairs // 10} studies", "entry", "any pair differs", "mean runs")
    for name in POPULATIONS:
        rates = decision_rates([MODELS[name]] * 5, design, GRID, pairs // 10, seed=2)
        line(name, rates.any_difference, f"{np.mean(rates.mean_runs):.0f}")


def print_equality(pairs: int) -> None:
    """The second's times are the first's law times 1.1: differences are not looked for (alpha is next to nothing)."""
    design = SequentialDesign(("a", "b"))
    head(f"Equality at a true ratio of 1.1, {pairs} studies", "entry", "wrongly within 10%")
    for name in POPULATIONS:
        generator = np.random.default_rng(3)
        first, second = (draw_times(MODELS[name], 100, pairs, GRID, generator) for _ in range(2))
        rates = play(design, [first, second * 11 // 10])
        line(name, rates.within_margin[0])


def rivals(entries: dict[str, LearningCurves]) -> list[tuple[str, SmoothedRuns, SmoothedRuns]]:
    """Return pairs of known direction: the first needs fewer."""
    late = {factor: SmoothedRuns(slower(entries[W64], factor)) for factor in (1.1, 1.25, 1.5)}
    return [
        *((f"{W64}, {100 * (f - 1):.0f}% slower", MODELS[W64], late[f]) for f in late),
        ("10 against 8 qubits", MODELS[Q10], MODELS[Q8]),
        ("width 32 against 10 qubits", MODELS[W32], MODELS[Q10]),
        ("width 64 against 32", MODELS[W64], MODELS[W32]),
        ("10 qubits against width 16", MODELS[Q10], MODELS[W16]),
    ]


def print_populations(pairs: int) -> None:
    """Rule `steps` on width 64 against itself 10 percent slower, its runs drawn in three ways."""
    count, generator = pairs // 10, np.random.default_rng(10)
    entries = ENTRIES[W64], slower(ENTRIES[W64], 1.1)
    sides = [times_below(entry.values, GRID, entry.steps_per_epoch) for entry in entries]
    print(
        f"\nM of the published runs: the second's is {sides[1].mean() / sides[0].mean():.4f} times the first's"
    )
    columns = ("runs drawn", "second's M / first's", *(f"{n_runs} runs" for n_runs in SIZES))
    head(f"Rule `steps`, width 64 against itself 10% slower, {count} pairs: first needs fewer", *columns)
    for name, draw in (("from the published ones", _resampled), ("mixed with a neighbor", _mixed)):
        large = [_times(draw(entry, 5000, generator)).mean() for entry in entries]
        power = []
        for n_runs in SIZES:
            drawn = [_steps(draw(entry, count * n_runs, generator)) for entry in entries]
            ours, theirs = (each.reshape(count, n_runs, -1) for each in drawn)
            power.append(judge_steps(ours, theirs).first)
        line(name, f"{large[1] / large[0]:.3f}", *power)
    models = [SmoothedRuns(entry) for entry in entries]
    large = [draw_times(model, 5000, 1, GRID, generator).mean() for model in models]
    power = []
    for n_runs in SIZES:
        ours, theirs = (draw_steps(model, n_runs, count, GRID, generator) for model in models)
        power.append(judge_steps(ours, theirs).first)
    line("smoothed (SmoothedRuns)", f"{large[1] / large[0]:.3f}", *power)


def _resampled(entry: LearningCurves, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return runs of the entry, with replacement."""
    return entry.values[generator.integers(0, entry.n_runs, count)]


def _mixed(entry: LearningCurves, count: int, generator: np.random.Generator, nearest: int = 5) -> np.ndarray:
    """Return runs on the line between a run of the entry and one of its nearest neighbors."""
    values = entry.values.astype(np.float64)
    distance = ((values[:, None] - values[None]) ** 2).sum(axis=2)
    np.fill_diagonal(distance, np.inf)
    neighbors = np.argsort(distance, axis=1)[:, :nearest]
    first = generator.integers(0, entry.n_runs, count)
    second = neighbors[first, generator.integers(0, nearest, count)]
    share = generator.random((count, 1))
    return share * values[first] + (1 - share) * values[second]


def _steps(values: np.ndarray) -> np.ndarray:
    return with_half_epoch(_times(values), 2000).sum(axis=1, keepdims=True)


def _times(values: np.ndarray) -> np.ndarray:
    return times_below(np.clip(values, 0, 1), GRID, 2000)


def print_seeds(pairs: int) -> None:
    count = pairs // 10
    design = SequentialDesign(("a", "b"))
    head(f"Study with looks, {count} studies", "pair", "first", "second", "trade-off", "equal", "mean runs")
    for name, first, second in rivals(ENTRIES):
        rates = decision_rates([first, second], design, GRID, count, seed=5)
        shares = rates.verdicts[0]
        kinds = (Decided.FIRST, Decided.SECOND, Decided.TRADE_OFF, Decided.EQUAL)
        line(name, *(shares[kind] for kind in kinds), f"{rates.mean_runs[0]:.0f}")


def print_equals(pairs: int) -> None:
    columns = ("entry", "runs", "rule", "a difference", "a winner")
    head(f"All rules, equals, the same {pairs} pairs for each rule", *columns)
    for name in POPULATIONS:
        for n_runs in SIZES:
            drawn = simulated_pairs(MODELS[name], MODELS[name], n_runs, n_runs, pairs, seed=6)
            for rates in judge(drawn, GRID, RULES):
                line(name, n_runs, rates.rule, rates.any_cell, rates.winner)


def print_power(pairs: int) -> None:
    count = pairs // 10
    columns = ("pair", "runs", "rule", "first wins", "second wins", "trade-off")
    head(f"All rules, the same {count} pairs for each rule", *columns)
    for pair, first, second in rivals(ENTRIES)[:5]:
        for n_runs in SIZES:
            drawn = simulated_pairs(first, second, n_runs, n_runs, count, seed=7)
            for rates in judge(drawn, GRID, RULES):
                shares = rates.first_wins, rates.second_wins, rates.any_cell - rates.winner
                line(pair, n_runs, rates.rule, *shares)


def print_boards(pairs: int) -> None:
    count, generator = max(10, pairs // 100), np.random.default_rng(8)
    equals = sum(
        (board.adjusted <= 0.05).any()
        for board in (
            times_board([_named(MODELS[W64].draw(100, generator), k) for k in range(8)], GRID)
            for _ in range(count)
        )
    )
    print(f"\nBoards of eight equals with any decided pair, of {count}: {equals}", flush=True)
    entries = list(ENTRIES.values())
    now, tiers = times_board(entries, GRID), _tiers(entries)
    same, again, total, tiering = 0, 0, 0, 0
    size = range(len(entries))
    decided = [(i, j) for i in size for j in size if i < j and now.adjusted[i, j] <= 0.05]
    for _ in range(count):
        fresh = [model.draw(100, generator) for model in MODELS.values()]
        board = times_board(fresh, GRID)
        same += all(board.directions[i][j] is now.directions[i][j] for i, j in decided)
        again += sum(board.directions[i][j] is now.directions[i][j] for i, j in decided)
        total += len(decided)
        tiering += _tiers(fresh) == tiers
    print(
        f"Published board: {len(decided)} of 28 pairs decided by steps; of {count} replications with 100 fresh"
    )
    print(
        f"runs each, {again / total:.1%} of these decisions came out again, all of them in {same / count:.1%};"
    )
    print(f"the tiers of the paper's rule in {tiering / count:.1%}", flush=True)
    for i in now.order:
        mean = now.means[i]
        low, high = (f"{end:.0f}" for end in mean.interval)
        places = f"{now.ranks[i, 0]} to {now.ranks[i, 1]}"
        tier = next(k for k, names in enumerate(tiers, 1) if now.names[i] in names)
        line(now.names[i], tier, f"{mean.mean:.0f}", f"{low} to {high}", float(mean.at_cap.mean()), places)
    print(f"order at half the horizon: {[now.names[i] for i in now.order_at_half]}", flush=True)


def _named(entry: LearningCurves, index: int) -> LearningCurves:
    return LearningCurves(entry.values, entry.steps_per_epoch, str(index))


def _tiers(entries: list[LearningCurves]) -> list[set[str]]:
    ranking = outperformance(entries, GRID).ranking
    return [{each.name for each in tier} for tier in ranking.tiers]


def print_coverage(pairs: int) -> None:
    """Of the S and M that 20,000 runs of the model have."""
    count = max(10, pairs // 25)
    columns = ("entry", "runs", "S, mean over cells", "S, worst cell", "M (95%)")
    head(
        f"Coverage of the 5 to 95 percentile interval of S_hat and of the interval of M, {count} entries",
        *columns,
    )
    for name in POPULATIONS:
        generator = np.random.default_rng(9)
        many = MODELS[name].draw(20_000, generator)
        true = sample_complexity(many.values, GRID, many.steps_per_epoch)
        true_mean = mean_time(many, GRID).mean
        for n_runs in SIZES:
            inside, means = np.zeros(GRID.shape), 0
            for _ in range(count):
                entry = MODELS[name].draw(n_runs, generator)
                interval = bootstrap_interval(entry.values, GRID, entry.steps_per_epoch)
                inside += (interval[..., 0] <= true) & (true <= interval[..., 1])
                low, high = mean_time(entry, GRID).interval
                means += low <= true_mean <= high
            line(name, n_runs, float(inside.mean() / count), float(inside.min() / count), means / count)


PARTS: dict[str, Callable[[int], None]] = {
    "replication": print_replication,
    "equality": print_equality,
    "power": print_power,
    "decisions": print_decisions,
    "populations": print_populations,
    "seeds": print_seeds,
    "boards": print_boards,
    "coverage": print_coverage,
    "five": print_five,
    "equals": print_equals,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all by default")
    parser.add_argument("--pairs", type=int, default=10_000)
    arguments = parser.parse_args()
    for part in arguments.parts or PARTS:
        if part not in PARTS:
            parser.error(f"part '{part}': expected one of {', '.join(PARTS)}")
    for part in arguments.parts or PARTS:
        begun = time.process_time()
        PARTS[part](arguments.pairs)
        print(f"\n({part}: {time.process_time() - begun:.0f} seconds of one core)", flush=True)


if __name__ == "__main__":
    main()
