"""Tables of published boards and studies with looks. `make pictures` writes them anew, with the pages of results.

On a page by hand, a comment names the task or the studies and the kind of the table that follows it:

    <!-- table: beam6g tiers -->
    <!-- table: equal-size rivals -->
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from statements import MODELS, each_model, load

from qrlsuite import api
from qrlsuite.engine.sheet import Sheet
from qrlsuite.leaderboard.boards.tables import main_section
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.leaderboard.shelf.published import PUBLISHED, read
from qrlsuite.results.text import hours_text, interval_text, mean_text, steps_text
from qrlsuite.studies.state import State, by_question, difference_text, versus
from qrlsuite.studies.together import StudiesTogether, together
from qrlsuite.training.trainer import count_parameters

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / page
    for page in (
        "docs/compare.md",
        "docs/fidelity.md",
        "docs/findings.md",
        "leaderboard/README.md",
    )
]
TABLE = re.compile(r"(?<=<!-- table: )([\w+-]+) (\w+) -->\n\n(?:\|.*\n)*\n*")

Rows = Iterator[Sequence[str]]


def settings(outcome: State) -> Rows:
    """What tuning found for each entry, and M of these settings on the tuning's last seeds."""
    tuned = [(str(each.name), each.tuning) for each in outcome.study.file.entries if each.tuning is not None]
    regrets = any(tuning.regret for _, tuning in tuned)
    last = ("expected regret", "M in the search") if regrets else ("M",)
    yield "entry", "parameters", "settings", "trials", *last
    for name, tuning in tuned:
        if tuning.value is None:  # the task's own settings
            continue
        entry = outcome.study.entries[name]
        found = []
        for option in tuning.space or ():
            side, _, own = option.partition(".")
            options = entry.model_options if side == "model" else entry.algorithm_options
            found.append(f"{own} {getattr(options, own):g}")
        parameters = str(sum(count_parameters(entry)))
        regret = [f"{tuning.regret.expected:.0%}"] if tuning.regret else [""] * regrets
        trials, steps = str(tuning.trials), steps_text(tuning.value)
        yield name.removesuffix(", tuned"), parameters, ", ".join(found), trials, *regret, steps


def verdicts(outcome: State) -> Rows:
    """Every pair below its question."""
    yield "pair A / B", "verdict", "seeds", "B against A", "interval"
    for question, pairs in by_question(outcome.study, outcome.pairs):
        yield f"**{question}**", "", "", "", ""
        for pair in pairs:
            seeds = str(pair.n_runs) if pair.n_runs else ""
            yield versus(pair), outcome.verdict(pair), seeds, *difference_text(pair, outcome.study.grid)


def entries(outcome: State) -> Rows:
    """Mean times and costs of the entries that a look has reached."""
    folder = outcome.study.folder
    yield "entry", "seeds", "steps below threshold (95%)", "core-hours", "circuits per seed"
    for entry in outcome.as_dict()["entries"]:
        if entry["mean_time"] is not None:
            took = interval_text(mean_text, entry["mean_time"], *entry["mean_time_interval"])
            trained = outcome.study.entries[entry["name"]]
            executed = read(folder / trained.task.name / trained.name).executions.mean()
            circuits = f"{executed / 1e6:.1f} million" if executed else ""
            yield (
                entry["name"],
                str(outcome.looked[entry["name"]]),
                took,
                hours_text(entry["core_hours"]),
                circuits,
            )


SEVEN = ("beam6g", "beam6g-degree5", "beam6g-a3-0", "cartpole", "frozenlake", "vqe-h2", "pulse")
_BEGUN = published_studies.names(begun=True)
FAMILY = "family"
"""The studies of `benchmarks/family.py`, in a folder of their own: no list and no page names each of them."""
TOGETHER: dict[str, tuple[str, ...]] = {
    "advantage": tuple(name for task in (*SEVEN, "planted") if (name := f"advantage-{task}") in _BEGUN),
    "equal-size": tuple(f"equal-size-{task}" for task in SEVEN),
    "equal-size-ppo": ("equal-size-beam6g-ppo", "equal-size-cartpole-ppo"),
    "quantum-or-not-elsewhere": ("quantum-or-not-degree5", "quantum-or-not-a3-0"),
    FAMILY: tuple(sorted(path.name for path in (ROOT / "leaderboard" / FAMILY).iterdir())),
}
"""Studies of one question on several tasks, by the name of their page."""


MOST_TASKS = 8
"""Tasks that are columns of a table."""


def several(names: str) -> list[State]:
    """Read the studies of a name in `TOGETHER`, or the studies whose names `+` joins."""
    return [published(name) for name in TOGETHER.get(names) or names.split("+")]


def averaged(names: str) -> StudiesTogether:
    """Average over the studies of a page of several."""
    return together(several(names))


def of_several(names: str) -> Rows:
    """The pairs that several studies share, on average over their tasks."""
    read = averaged(names)
    sheet = Sheet("", read.columns(), read.pairs)
    shown = len(sheet.columns)
    if len(read.tasks) > MOST_TASKS:
        shown -= len(read.tasks)  # the last columns
    yield [column.title for column in sheet.columns[:shown]]
    yield from (cells[:shown] for cells in sheet.cells)


def means(names: str) -> Rows:
    """The steps of the entries that several studies share, a row for each study's task."""
    outcomes = several(names)
    entries = [str(each.name) for each in outcomes[0].study.file.entries]
    yield "task", "seeds", *entries
    for outcome in outcomes:
        times, seeds = outcome.mean_times(), sorted(set(outcome.looked.values()))
        steps = (steps_text(times[entry].mean) for entry in entries)
        counts = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
        yield f"`{outcome.study.task}`", counts, *steps


def rivals(names: str) -> Rows:
    """How many more steps each rival needs than the first entry; where it is claimed, the smallest excluded lead."""
    outcomes = several(names)
    first, *others = [str(each.name) for each in outcomes[0].study.file.entries]
    claimed = bool(outcomes[0].decision.claims)
    yield "task", *others, *["excluded lead"] * claimed, "after seeds"
    for outcome in outcomes:
        found = {pair.second: pair for pair in outcome.pairs if pair.first == first}
        cells = []
        for pair in (found[other] for other in others):
            share, interval = difference_text(pair, outcome.study.grid)
            said = "" if pair.verdict.startswith("not told") else f", {outcome.verdict(pair)}"
            cells.append(f"{share} ({interval}){said}")
        leads = [each.excluded for each in outcome.decision.claims if each.claim.at_most is None]
        cells += [f"above {100 * lead:.0f}%" if lead > 0 else "any" for lead in leads]
        seeds = sorted({pair.n_runs for pair in found.values()})
        yield f"`{outcome.study.task}`", *cells, " to ".join(map(str, sorted({seeds[0], seeds[-1]})))


def _chosen(sheet: Sheet, heads: Sequence[str]) -> Rows:
    """Some columns of a sheet, in this order."""
    yield heads
    columns = {column.title: cells for column, cells in zip(sheet.columns, zip(*sheet.cells))}
    yield from zip(*(columns[head] for head in heads))


def board(task: str) -> Rows:
    """The board as `qrlsuite leaderboard` prints it."""
    [sheet] = api.board(task, published=True, runs="none").sheets()
    heads = [
        column.title for column in sheet.columns if column.title not in ("core-hours", "settings", "spread")
    ]
    return _chosen(sheet, heads)


PAIRS: dict[str, tuple[tuple[str, tuple[tuple[str, str], ...]], ...]] = {
    task: (
        (
            f"Does a circuit beat {'the network' if len(networks) == 1 else 'networks'} of its size?",
            tuple((circuit, network) for circuit in circuits for network in networks),
        ),
        ("Does entanglement help?", tuple((circuit, f"{circuit} mean-field") for circuit in circuits)),
        ("Do gates on two qubits help?", tuple((circuit, f"{circuit} separable") for circuit in circuits)),
        ("Do larger networks need fewer steps?", (("iqp", "width 16"), ("iqp", "width 64"))),
    )
    for task, circuits, networks in (
        ("vqe-h2", ("iqp", "jerbi"), ("width 6",)),
        ("pulse", ("iqp", "jerbi"), ("width 8", "sines")),
        ("vqe-ising", ("iqp", "jerbi"), ("width 5", "sines")),
        ("clifford", ("iqp",), ("width 6", "tanh", "sines")),
        ("cartpole", ("iqp",), ("width 8", "tanh", "sines")),
        ("channel", ("iqp",), ("width 6", "tanh", "sines")),
    )
}
"""The pairs of boards of small circuits that answer a question, by short names of the entries."""


def _short(label: str) -> str:
    """Name an entry of these boards: `width 6`, `sines`, `jerbi mean-field`."""
    words = label.split()
    if "mlp" in words:
        activation = next((word.partition("=")[2] for word in words if word.startswith("activation=")), "")
        return {"": words[2].replace("=", " "), "sin": "sines"}.get(activation, activation)
    control = next((word.partition("=")[2] for word in words if word.startswith("entangled=")), "")
    return f"{'jerbi' if 'ansatz=jerbi' in words else 'iqp'} {control}".strip()


def short_names(task: str) -> dict[str, str]:
    """Return the short names of a board's entries; of another algorithm than most, with it."""
    records = [json.loads(path.read_text()) for path in sorted((PUBLISHED / task).glob("*/entry.json"))]
    labels = {record["name"]: record["label"] for record in records}
    [(most, _)] = Counter(label.split()[0] for label in labels.values()).most_common(1)
    return {
        name: _short(label) if label.startswith(most) else f"{label.split()[0]} {_short(label)}"
        for name, label in labels.items()
    }


def pairs(task: str) -> Rows:
    """The pairs that answer the questions of a board: each by itself, and what the board decides."""
    yield "question", "pair", "difference (95%)", "on the board"
    facts = main_facts(task)
    order = [row["entry"] for row in facts["times"]["entries"]]
    [(algorithm, _)] = Counter(row["label"].split()[0] for row in facts["rows"]).most_common(1)
    rows = {_short(row["label"]): row for row in facts["rows"] if row["label"].split()[0] == algorithm}
    for question, asked in PAIRS[task]:
        for place, (first, second) in enumerate(asked):
            one, two = rows[first], rows[second]
            compared = api.compare(load(one["label"], task), load(two["label"], task))
            times = compared.as_dict()["times"]
            p = facts["times"]["adjusted_p"][order.index(one["entry"])][order.index(two["entry"])]
            own = second.startswith(first)
            other = f"its {second.removeprefix(f'{first} ')} control" if own else second
            yield (
                "" if place else question,
                f"`{first}` against {other}",
                f"`{first}` needs {_fewer_or_more(times['difference'], *times['difference_interval'])}",
                "decided" if p <= 0.05 else "not told apart",
            )


def _fewer_or_more(difference: float, low: float, high: float) -> str:
    """Write how many more steps one needs: `25% fewer (12% to 36%)`, `2% fewer (6% fewer to 1% more)`."""
    near, far = sorted((abs(low), abs(high)))
    span = f"{near:.0%} to {far:.0%}" if low * high > 0 else f"{-low:.0%} fewer to {high:.0%} more"
    return f"{abs(difference):.0%} {'fewer' if difference < 0 else 'more'} ({span})"


def tiers(task: str) -> Rows:
    """The same by the paper's definition."""
    [sheet] = api.board(task, rule="paper", published=True, runs="none").sheets()
    first = ("tier", "rests on", "entry", "parameters", "seeds")
    return _chosen(sheet, (*first, "sample complexity (5%-95%)", "final score"))


def executions(task: str) -> Rows:
    """The entries that execute circuits, by what these cost."""
    [section] = api.board(task, by="executions", published=True, runs="none").sections
    kept = replace(section, rows=tuple(row for row in section.rows if not row.price.problem))
    return _chosen(kept.sheet(), [column.title for column in kept.columns() if column.shown][:5])


def changes(task: str) -> Rows:
    """What three settings change for four models: M, and who needs more steps."""
    yield "changed", "model", "seeds", "M, ours", "M, changed", "changed against ours"
    for title, other, options in (
        ("the released rejection of paths", f"{task}+476ac3d2", ""),
        ("the text's buffer and copies", task, " buffer=1000 target_steps=1000"),
        ("a buffer of 10,000", task, " buffer=10000"),
    ):
        pairs = [(f"ddqn {model}{options}", f"ddqn {model}") for model in MODELS]
        entries = [(load(changed, other), load(usual, task)) for changed, usual in pairs]
        for label, board, _, said in each_model(entries, title, "ours"):
            after, before = (steps_text(mean.mean, digits=3) for mean in board.means)
            yield title, label.removeprefix("ddqn "), str(board.n_runs[0]), before, after, said


TABLES: dict[str, Callable[[str], Rows]] = {
    "tiers": tiers,
    "executions": executions,
    "changes": changes,
    "rivals": rivals,
}


def _padded(cell: str) -> str:
    return f" {cell} ".replace("\\", "\\\\").replace("|", "\\|") if cell else " "


@cache
def published(name: str) -> State:
    """Return what a published study has decided."""
    in_family = ROOT / "leaderboard" / FAMILY / name
    return published_studies.read(in_family if in_family.is_dir() else published_studies.PUBLISHED / name)


@cache
def main_facts(task: str) -> dict[str, Any]:
    """Return the board of a task at its main horizon, as plain values."""
    return main_section(api.board(task, published=True, runs="none").sections).as_dict()


def markdown(rows: Iterable[Sequence[str]]) -> str:
    """Return rows as a table; the first one is its head."""
    header, *body = rows
    lines = [header, ["---"] * len(header), *body]
    return "\n".join("|" + "|".join(map(_padded, line)) + "|" for line in lines).replace(" --- ", "---")


def filled(text: str) -> str:
    """Return a page with every table as the published entries and studies now give it."""

    def table(found: re.Match[str]) -> str:
        name, kind = found.groups()
        asked = found[0].partition(" -->")[0]
        return f"{asked} -->\n\n{markdown(TABLES[kind](name))}\n\n"

    return TABLE.sub(table, text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
