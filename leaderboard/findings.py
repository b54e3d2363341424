"""Tables of what a calibration measured."""

from __future__ import annotations

from collections.abc import Sequence

from qrlsuite.leaderboard.calibration import PARTS, CalibrationResult

HEAD = ["entry", "seeds", "rule", "cell, worst", "any cell", "a winner"]


def tables(results: Sequence[CalibrationResult], cells: int, board: int) -> list[tuple[str, list[list[str]]]]:
    """Return what was found as tables: a sentence, and rows of which the first is the head."""
    parts = {name: [each for each in results if each.part == name] for name in PARTS}
    result = []
    if halves := parts["halves"]:
        rows = [[each.entry, _seeds(each), each.rule, *_cells(each), f"{each.winner:.1%}"] for each in halves]
        for name in dict.fromkeys(each.rule for each in halves):
            rates = [each.winner for each in halves if each.rule == name]
            if len(rates) > 1:
                rows.append([f"over {len(rates)} entries", "", name, "", "", _range(rates)])
        sentence = (
            f"Real runs: random halves of one entry, {halves[0].draws} splits each. Every winner is false. Splits "
            "of an entry share its runs: only the spread over entries says how sure a rate is."
        )
        result.append((sentence, [HEAD, *rows]))
    if pairs := parts["pairs"]:
        rows = [[each.entry, _seeds(each), each.rule, *_cells(each), _winner(each)] for each in pairs]
        sentence = (
            f"Simulated: two entries that are equal, {pairs[0].draws} pairs each. Every winner is false. `cell`: "
            f"different in a given one of the {cells} cells, on average and in the worst; `a winner`: one seems to "
            "outperform the other."
        )
        result.append((sentence, [HEAD, *rows]))
    if boards := parts["boards"]:
        rows = [[each.entry, str(each.n_runs[0]), each.rule, _winner(each)] for each in boards]
        sentence = (
            f"Simulated: boards of {board} equal entries ({board * (board - 1) // 2} pairs), {boards[0].draws} "
            "boards each. How often any of them seems to outperform another:"
        )
        result.append((sentence, [["entry", "seeds", "rule", "boards with a winner"], *rows]))
    if strong := parts["power"]:
        rows = [
            [
                each.entry,
                str(each.n_runs[0]),
                _slower(each),
                each.rule,
                _winner(each),
                f"{each.wrong or 0:.1%}",
            ]
            for each in strong
        ]
        sentence = (
            f"Simulated: one entry takes longer to get as far, {strong[0].draws} pairs each. How often the other is "
            "found to outperform it (power), and how often it is found to outperform the other (wrong direction):"
        )
        head = ["entry", "seeds", "slower by", "rule", "found", "wrong"]
        result.append((sentence, [head, *rows]))
    if plans := parts["decisions"]:
        result.append(_plans(plans))
    return result


def _plans(plans: Sequence[CalibrationResult]) -> tuple[str, list[list[str]]]:
    rows = [
        [
            each.entry,
            f"{each.entries} equals" if each.factor is None else f"{_slower(each)} slower",
            _winner(each),
            "" if each.wrong is None else f"{each.wrong:.1%}",
            f"{each.equal or 0:.1%}",
            f"{each.mean_seeds or 0:.0f}",
        ]
        for each in plans
    ]
    few, many = min(each.draws for each in plans), max(each.draws for each in plans)
    sentence = (
        f"Simulated decision plans (qrlsuite decide) with the default looks, at most {plans[0].n_runs[0]} seeds, "
        f"{many if few == many else f'{many} or {few}'} plans each. `differ`: between equals any pair does, which is "
        "false; else the better entry is found. `equal`: pairs found equal within 10 percent. `seeds`: of each "
        "entry of a pair, on average."
    )
    return sentence, [["entry", "against", "differ", "wrong", "equal", "seeds"], *rows]


def summary(results: Sequence[CalibrationResult], rule: str, board: int) -> str:
    """Return in one sentence what was found about a rule."""
    own = [each for each in results if each.rule == rule]
    equal = [each for each in own if each.part == "pairs" and each.n_runs[0] == each.n_runs[1]]
    parts = []
    if equal:
        seeds = max(each.n_runs[0] for each in equal)
        rates = [each.winner for each in equal if each.n_runs[0] == seeds]
        parts.append(
            f"declares a false winner between two equal entries of {seeds} seeds in {_range(rates)} of cases"
        )
    halves = [each.winner for each in own if each.part == "halves"]
    if halves and not equal:
        parts.append(f"declares a false winner between halves of one entry in {_range(halves)} of splits")
    boards = [each.winner for each in own if each.part == "boards"]
    if boards:
        parts.append(f"finds one somewhere on {_range(boards)} of boards of {board} equals")
    strong = [each for each in own if each.part == "power"]
    for factor in sorted({each.factor for each in strong if each.factor is not None})[:2]:
        rates = [each.winner for each in strong if each.factor == factor]
        parts.append(f"finds an entry that takes {factor - 1:.0%} longer to be worse in {_range(rates)}")
    plans = [each for each in own if each.part == "decisions"]
    if equals := [each.winner for each in plans if each.factor is None]:
        parts.append(f"as a decision plan finds a false difference in {_range(equals)}")
        worst = max(each.factor or 1 for each in plans)
        needed = [each.mean_seeds or 0.0 for each in plans if each.factor == worst]
        low, high = f"{min(needed):.0f}", f"{max(needed):.0f}"
        parts.append(
            f"as a plan needs {low if low == high else f'{low} to {high}'} seeds on average, not "
            f"{plans[0].n_runs[0]}, where an entry takes {worst - 1:.0%} longer"
        )
    return f"'{rule}' " + "; ".join(parts) if parts else ""


def _range(rates: Sequence[float]) -> str:
    """Write the spread of rates over entries."""
    low, high = f"{min(rates):.1%}", f"{max(rates):.1%}"
    return low if low == high else f"{low} to {high}"


def _seeds(finding: CalibrationResult) -> str:
    return f"{finding.n_runs[0]},{finding.n_runs[1]}"


def _slower(finding: CalibrationResult) -> str:
    return f"{(finding.factor or 1) - 1:.0%}"


def _winner(finding: CalibrationResult) -> str:
    return f"{100 * finding.winner:.1f} ± {finding.error:.1%}"


def _cells(finding: CalibrationResult) -> tuple[str, str]:
    mean, worst, anywhere = (
        f"{value or 0:{digits}%}"
        for value, digits in ((finding.cell_mean, ".2"), (finding.cell_worst, ".1"), (finding.any_cell, ".1"))
    )
    return f"{mean.removesuffix('%')}, {worst}", anywhere
