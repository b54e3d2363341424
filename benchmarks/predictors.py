"""Does a diagnostic of an untrained circuit predict how fast it learns? Exploratory; the plan is this text.

    python benchmarks/predictors.py --qubits 6 8 [--runs DIR] [--workers N] [--out FILE.png]

Written before the first of its seeds. Task beam6g, DDQN with the released settings, hybrid circuits of 4 layers with
6 and with 8 qubits: every built-in ansatz with every gate or state it has, 16 circuits of each size
(`wang` with its states; its rings came later).

1. *Learning rates.* Each circuit gets three: the released ones times 1, 2, and 4. The best has the fewest mean steps
   below threshold on seeds 40,000 to 40,007.
2. *Outcome.* The steps below threshold (mean over the task's thresholds) on seeds 30,000 to 30,019, with that rate;
   their mean is a circuit's outcome. Both stages train 100 epochs.
3. *Diagnostics*, of the untrained circuit, by `qrlsuite diagnose ansatz` with its defaults: variance of the gradient
   with a local and with a global readout, rank of the Fisher information, effective dimension, mean frequency,
   expressibility, entanglement. The number of parameters stands beside them, and is no hypothesis.
4. *Verdict.* Spearman's rank correlation of a diagnostic with the outcome within one size; p by 100,000 permutations of
   the circuits; Holm's correction over the diagnostics of both sizes. Intervals: 10,000 times, circuits are drawn with
   replacement, and of each drawn circuit its seeds.

A correlation over 16 circuits is significant from about 0.7 on: smaller ones are not found. Circuits differ in more
than their diagnostics, so a correlation is no cause.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from qrlsuite import api

CIRCUITS = [
    *(f"ansatz={name} gate={gate}" for name in ("iqp", "cx", "cz") for gate in ("rot", "xyz", "u3")),
    "ansatz=skolik",
    "ansatz=jerbi",
    "ansatz=hsiao",
    "ansatz=perez-salinas",
    "ansatz=wang coupling=ghz",
    "ansatz=wang coupling=graph",
    "ansatz=basic",
]
RATES = [(5e-4, 1e-3), (1e-3, 2e-3), (2e-3, 4e-3)]
TUNING, JUDGED = range(40_000, 40_008), range(30_000, 30_020)
DIAGNOSTICS = {
    "gradient variance, local": lambda row: row["gradient_variance"]["local"]["value"],
    "gradient variance, global": lambda row: row["gradient_variance"]["global"]["value"],
    "rank of the Fisher information": lambda row: row["rank"],
    "effective dimension": lambda row: row["effective_dimension"],
    "mean frequency": lambda row: row["mean_frequency"],
    "expressibility": lambda row: row["expressibility"],
    "entanglement": lambda row: row["meyer-wallach"],
    "parameters": lambda row: row["parameters"],
}
LOGARITHMIC = ("gradient variance, local", "gradient variance, global", "expressibility")
HYPOTHESES = len(DIAGNOSTICS) - 1
SIZES = 2  # planned: 6 and 8 qubits


def options_of(circuit: str, qubits: int, rates: tuple[float, float]) -> dict[str, Any]:
    """Return an entry's options: the circuit's, its size and the learning rates."""
    own = dict(word.split("=") for word in circuit.split())
    return {**own, "qubits": qubits, "algorithm.lr": rates[0], "algorithm.quantum_lr": rates[1]}


def steps(circuit: str, qubits: int, rates: tuple[float, float], seeds: range, **where: Any) -> list[float]:
    """Return the steps below threshold of each seed; trains what is missing."""
    entry = api.train(
        "beam6g", "vqc-native", options=options_of(circuit, qubits, rates), seeds=list(seeds), **where
    )
    if entry is None:
        raise SystemExit("stopped; the same command continues")
    rows = api.table("seeds", "beam6g", entries=[entry], runs=where["runs"]).to_pylist()
    return [row["steps_below_threshold"] for row in rows if row["seed"] in seeds]


def correlations(values: NDArray[np.float64], outcomes: NDArray[np.float64]) -> dict[str, tuple[float, ...]]:
    """Return of each diagnostic rho, p, and the ends of the interval.

    Parameters
    ----------
    values:
        (diagnostics, circuits).
    outcomes:
        Steps (circuits, seeds).
    """
    source = np.random.default_rng(0)
    means = stats.rankdata(outcomes.mean(1))
    if means.std() == 0 or (values.std(1) == 0).any():
        raise SystemExit(
            "all circuits have the same outcome, or the same diagnostic: there is no rank correlation"
        )
    circuits, seeds = outcomes.shape
    shuffled = np.array([source.permutation(means) for _ in range(100_000)])
    picks = source.integers(circuits, size=(10_000, circuits))
    inner = source.integers(seeds, size=(10_000, circuits, seeds))
    drawn = np.take_along_axis(outcomes[picks], inner, 2).mean(2)
    found = {}
    for name, row in zip(DIAGNOSTICS, values):
        ranks = stats.rankdata(row)
        rho = np.corrcoef(ranks, means)[0, 1]
        centered = (ranks - ranks.mean()) / (ranks.std() * means.std() * circuits)
        p = (1 + np.sum(np.abs((shuffled - means.mean()) @ centered) >= abs(rho) - 1e-12)) / 100_001
        again = [stats.spearmanr(row[pick], each).statistic for pick, each in zip(picks, drawn)]
        found[name] = (float(rho), float(p), *np.nanpercentile(again, [2.5, 97.5]).tolist())
    return found


def holm(values: list[float], planned: int) -> list[float]:
    """Return p values corrected for as many as were planned; those that are missing count as the largest."""
    order = np.argsort(values)
    corrected = np.empty(len(values))
    largest = 0.0
    for place, index in enumerate(order):
        largest = max(largest, min(1.0, (planned - place) * values[index]))
        corrected[index] = largest
    return corrected.tolist()


def main() -> None:
    """Train what is missing, print the tables, and draw the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--qubits", type=int, nargs="+", default=[6, 8])
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--workers", type=int)
    parser.add_argument("--out", type=Path, help="draw outcomes against diagnostics to this file")
    arguments = parser.parse_args()
    where = {"runs": arguments.runs, "workers": arguments.workers, "epochs": 100}
    found, drawn = {}, {}
    for n in arguments.qubits:
        values, outcomes = [], []
        print(f"\n| {n} qubits | rate | steps below threshold | " + " | ".join(DIAGNOSTICS) + " |")
        print("|---" * (3 + len(DIAGNOSTICS)) + "|")
        for circuit in CIRCUITS:
            tried = [float(np.mean(steps(circuit, n, rates, TUNING, **where))) for rates in RATES]
            best = int(np.argmin(tried))
            outcomes.append(steps(circuit, n, RATES[best], JUDGED, **where))
            own = dict(word.split("=") for word in circuit.split())
            row = api.diagnose_ansatz(own.pop("ansatz"), n, options=own, progress=False).as_dict()["sizes"][0]
            values.append([float(of(row)) for of in DIAGNOSTICS.values()])
            cells = " | ".join(f"{value:.3g}" for value in values[-1])
            mean = f"{np.mean(outcomes[-1]) / 1e3:.1f}k"
            print(f"| {circuit} | x{2**best} | {mean} | {cells} |", flush=True)
        drawn[n] = np.array(values).T, np.array(outcomes)
        found[n] = correlations(*drawn[n])
    corrected = iter(
        holm(
            [each[name][1] for each in found.values() for name in list(DIAGNOSTICS)[:HYPOTHESES]],
            HYPOTHESES * max(SIZES, len(found)),
        )
    )
    print(
        "\n| diagnostic | qubits | rank correlation | 95% interval | p | p, Holm |\n|---|---|---|---|---|---|"
    )
    for n, each in found.items():
        for k, (name, (rho, p, low, high)) in enumerate(each.items()):
            holms = f"{next(corrected):.3f}" if k < HYPOTHESES else "(no hypothesis)"
            print(f"| {name} | {n} | {rho:+.2f} | {low:+.2f} to {high:+.2f} | {p:.4f} | {holms} |")
    if arguments.out:
        draw(drawn, arguments.out)


def draw(drawn: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]], out: Path) -> None:
    """Draw outcomes against every diagnostic, two rows for each size."""
    from matplotlib.figure import Figure

    figure = Figure((10, 4.6 * len(drawn)), layout="constrained")
    axes = figure.subplots(2 * len(drawn), 4, squeeze=False, sharey=True)
    for n, (values, outcomes), lines in zip(drawn, drawn.values(), axes.reshape(len(drawn), 8)):
        error = outcomes.std(1, ddof=1) / np.sqrt(outcomes.shape[1])
        for ax, name, row in zip(lines, list(DIAGNOSTICS)[:HYPOTHESES], values):
            ax.errorbar(row, outcomes.mean(1) / 1e3, error / 1e3, fmt="o", ms=4)
            ax.set_xlabel(name)
            if name in LOGARITHMIC:
                ax.set_xscale("log")
        lines[HYPOTHESES].axis("off")
        for ax in lines[::4]:
            ax.set_ylabel(f"{n} qubits: steps below\nthreshold, thousands")
    figure.savefig(out, dpi=150)


if __name__ == "__main__":
    main()
