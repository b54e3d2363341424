"""The results of a calibration as tables, one per part."""

from __future__ import annotations

from collections.abc import Sequence

from qrlsuite.leaderboard.calibration import PARTS, CalibrationResult

TITLES = {
    "halves": "random halves of one entry's runs: every winner is false",
    "pairs": "two equal entries, simulated: every winner is false",
    "boards": "boards of equal entries, simulated: every winner is false",
    "power": "one entry is slower, simulated: found, and found in the wrong direction",
    "decisions": "plans of `qrlsuite decide`, simulated: differences found, between equals falsely",
}


def tables(results: Sequence[CalibrationResult]) -> list[tuple[str, list[list[str]]]]:
    """Return a title and rows for every part that was measured; the first row is the head."""
    found = []
    for part in PARTS:
        lines = [each for each in results if each.part == part]
        if not lines:
            continue
        rows = [_row(each) for each in lines]
        if part == "halves":  # splits of an entry share its runs: only the spread over entries is an error
            for rule in dict.fromkeys(each.rule for each in lines):
                rates = [each.winner for each in lines if each.rule == rule]
                if len(rates) > 1:
                    spread = {"entry": f"over {len(rates)} entries", "rule": rule, "a winner": _range(rates)}
                    rows.append(dict.fromkeys(rows[0], "") | spread)
        found.append((f"{part}: {TITLES[part]}", [list(rows[0]), *(list(row.values()) for row in rows)]))
    return found


def _row(each: CalibrationResult) -> dict[str, str]:
    """Return the cells of one result by column."""
    draws, error = str(each.draws), f"{100 * each.winner:.1f} ± {each.error:.1%}"
    slower = "equal" if each.factor is None else f"{each.factor - 1:.0%} slower"
    if each.part in ("halves", "pairs"):
        mean, worst, anywhere = (
            f"{value or 0:.1%}" for value in (each.cell_mean, each.cell_worst, each.any_cell)
        )
        return {
            "entry": each.entry,
            "seeds": f"{each.n_runs[0]},{each.n_runs[1]}",
            "rule": each.rule,
            "draws": draws,
            "cell, worst": f"{mean.removesuffix('%')}, {worst}",
            "any cell": anywhere,
            "a winner": f"{each.winner:.1%}" if each.part == "halves" else error,
        }
    if each.part == "boards":
        seeds = str(each.n_runs[0])
        return {
            "entry": each.entry, "seeds": seeds, "rule": each.rule, "draws": draws, "a winner": error
        }  # fmt: skip
    wrong = "" if each.wrong is None else f"{each.wrong:.1%}"
    row = {"entry": each.entry, "seeds": str(each.n_runs[0]), "other entries": slower, "draws": draws}
    if each.part == "power":
        return {**row, "rule": each.rule, "found": error, "wrong": wrong}
    equal, seeds = f"{each.equal or 0:.1%}", f"{each.mean_seeds or 0:.0f}"
    return {
        **row, "entries": str(each.entries), "differ": error, "wrong": wrong, "equal": equal, "mean seeds": seeds
    }  # fmt: skip


def _range(rates: Sequence[float]) -> str:
    """Write the spread of rates over entries."""
    low, high = f"{min(rates):.1%}", f"{max(rates):.1%}"
    return low if low == high else f"{low} to {high}"
