"""Studies with looks as the page shows them: verdicts, looks, and p against the levels that it was compared with."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from typing import Any

from qrlsuite.leaderboard.report.encode import clean
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import p_text
from qrlsuite.studies.state import (
    TURNED,
    State,
    difference_text,
    finals_text,
    horizon_note,
    lost_note,
    needs_text,
    reason_note,
    versus,
)

WIDTH, HEIGHT = 380, 230
LEFT, RIGHT, TOP, BOTTOM = 46, 12, 12, 38
"""Margins around the plot, in the picture's units."""


def view(state: State) -> dict[str, Any]:
    """Return the parts of a study with looks that the template shows; texts of strangers are cleaned.

    `pairs` are rows of the table of verdicts; `looks` rows of seeds, when, alpha spent by then, its level, and of each
    pair p (empty where it was closed before, or the look was not taken) and whether it decided.
    """
    study, facts = state.study, state.as_dict()
    pairs = []
    for pair, each in zip(state.pairs, facts["pairs"]):
        difference, interval = (text.replace("-", "−") for text in difference_text(pair, study.grid))
        needs = needs_text(state, each["needs"]).replace("<=", "≤")
        names = {"question": clean(each["question"] or "", 300), "pair": clean(versus(pair))}
        finals = f"final score {finals_text(state, pair)}" * bool(pair.p)
        row = {"finals": finals, "verdict": clean(state.verdict(pair)), "seeds": pair.n_runs, "needs": needs}
        pairs.append({**names, **row, "difference": difference, "interval": interval})
    notes = reason_note(study), lost_note(state), horizon_note(state), TURNED.get(study.hash), *state.notes
    return {
        "name": clean(study.name),
        "question": clean(study.file.summary, 300),
        "facts": [(term, clean(value, 600)) for term, value in _facts(state, facts)],
        "note": ". ".join(clean(note, 3000) for note in notes if note),
        "pairs": pairs,
        "looks": [_look(state, index) for index in range(len(study.design.looks))],
        "picture": _picture(state),
    }


def _facts(outcome: State, plain: dict[str, Any]) -> list[tuple[str, str]]:
    study = outcome.study
    entry, looks, ended = next(iter(study.entries.values())), study.looks, outcome.ended
    steps = study.epochs * entry.task.file.protocol.interactions
    saved, used = plain["seeds_saved"], sum(each["seeds"] for each in plain["entries"])
    if ended:
        state = f"ended {_minute(ended)}, with open pairs"
    elif outcome.finished:
        state = "finished"
    else:
        state = f"goes on: next look at {max(outcome.decision.wanted.values())} seeds"
    return [
        ("State", state),
        ("Task", f"{entry.task.name}, {steps} environment steps"),
        *(
            [("Study written", f"{looks.written.astimezone(datetime.UTC):%Y-%m-%d %H:%M} UTC")]
            if looks.written
            else []
        ),
        *([("First seed begun", _minute(outcome.begun_at))] if outcome.begun_at else []),
        ("Hash of the study", study.hash),
        (
            "Seeds",
            f"{format_seeds(looks.block)}, {used} used" + (f", {saved} saved" if saved > 0 else ""),
        ),
        ("Any false difference", f"with probability {looks.alpha:g} ({looks.spending} spending)"),
        ("Equal", f"within {100 * looks.margin:g} percent"),
        *(("Claim, with an error of its own", text.removeprefix("claim: ")) for text in outcome.claims),
    ]


def _look(outcome: State, index: int) -> dict[str, Any]:
    design, taken = outcome.study.design, outcome.taken
    seeds = design.looks[index]
    spent = 2 * design.spending.spent([seeds / design.looks[-1]], design.alpha / 2)[0]
    cells = []
    for pair in outcome.pairs:
        has_p = index < len(pair.p)
        last = index == len(pair.p) - 1
        cells.append((p_text(pair.p[index]) if has_p else "", has_p and last and pair.differs))
    return {
        "seeds": seeds,
        "taken": _minute(taken[seeds]) if seeds in taken else "–",
        "spent": f"{spent:.3f}",
        "level": f"{design.level(index, len(design.family)):.4f}",
        "p": cells,
    }


def _picture(outcome: State) -> dict[str, Any]:
    """Return p of every pair at each look, upwards by -log10, and the levels, in coordinates of an SVG.

    `band` is the area between the levels while all pairs are open and while one is, `seeds` and `powers` are ticks, and
    `lines` has of each pair its color, the points of its line, and its dots (x, y, decided).
    """
    design = outcome.study.design
    looks = range(len(design.looks))
    strict = [design.level(look, len(design.family)) for look in looks]
    loose = [design.level(look, 1) for look in looks]
    smallest = min([*strict, *(p for pair in outcome.pairs for p in pair.p)])
    top = max(3, math.ceil(-math.log10(smallest) + 0.2))

    def x(seeds: float) -> float:
        return round(LEFT + (WIDTH - LEFT - RIGHT) * seeds / design.looks[-1], 1)

    def y(p: float) -> float:
        return round(HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * -math.log10(p) / top, 1)

    def points(levels: Sequence[float], order: Sequence[int]) -> str:
        return " ".join(f"{x(design.looks[look])},{y(levels[look])}" for look in order)

    lines = []
    for color, pair in enumerate(outcome.pairs):
        dots = tuple(
            (x(seeds), y(p), pair.differs and look == len(pair.p) - 1)
            for look, (seeds, p) in enumerate(zip(design.looks, pair.p))
        )
        if dots:
            lines.append((color, " ".join(f"{a},{b}" for a, b, _ in dots), dots))
    return {
        "band": f"{points(strict, looks)} {points(loose, looks[::-1])}",
        "seeds": [(x(seeds), seeds) for seeds in design.looks],
        "powers": [(y(10.0**-power), "1" if power == 0 else f"{10.0**-power:g}") for power in range(top + 1)],
        "lines": lines,
    }


def _minute(when: str) -> str:
    try:
        return f"{datetime.datetime.fromisoformat(when).astimezone(datetime.UTC):%Y-%m-%d %H:%M} UTC"
    except ValueError:
        return when
