"""The pages of docs/results, one a study with looks, a board, or studies of one question: `make pictures` writes them.

All of it is made from what is published but a judgment of at most 120 words, `leaderboard/judgments/NAME.md`. What
stands below its line `---`, how settings were tried by hand and when, is folded at the end of the page.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache

from tables import (
    FAMILY,
    PAIRS,
    ROOT,
    TOGETHER,
    averaged,
    board,
    entries,
    main_facts,
    markdown,
    means,
    of_several,
    pairs,
    published,
    rivals,
    settings,
    verdicts,
)

from qrlsuite.api.needs import study_power
from qrlsuite.errors import listed
from qrlsuite.experiment import task as tasks
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.results.text import hours_text
from qrlsuite.studies.state import State

PAGES = ROOT / "docs" / "results"
JUDGMENTS = ROOT / "leaderboard" / "judgments"
MOST = 120
"""Words of a judgment."""
BOARDS = ("beam6g", *PAIRS)
READING = """
A [study](../decisions.md) fixes its entries, pairs, seeds and error before its first seed is trained, and compares
after 20 seeds, after 40, and so on. A [board](../compare.md) compares all entries of a task, mostly by 50 seeds, and
with settings of searches that had no last round. Where a [larger study](advantage.md) asks the same question, its
answer is the better one.

- *B against A* is how many more steps B needs, as a mean over the task's thresholds: +52% means that B is slower. Each
  threshold is tested separately. Where the interval of a decided pair includes 0, the threshold that decided follows
  with its own interval.
- Intervals of a study hold for all of its pairs and looks together. An early stop overstates a difference.
- *Equal within 10 percent* has an error of .05 for each pair by itself. *At the horizon*, neither entry had time to
  learn. *Not told apart* is no evidence of equality: the interval says which differences remain possible.
"""


@cache
def names() -> tuple[str, ...]:
    """Return the published studies."""
    return tuple(published_studies.names(begun=True))


def judged(name: str) -> tuple[str, str]:
    """Return the judgment of a page, and the notes below it."""
    file = JUDGMENTS / f"{name}.md"
    judgment, _, notes = file.read_text().partition("\n---\n") if file.is_file() else ("", "", "")
    return judgment.strip(), notes.strip()


def _folded(title: str, text: str) -> str:
    name = "-".join(title.lower().split())
    head = f'<details id="{name}" markdown="1"><summary>{title}</summary>'
    return f"{head}\n\n{text}\n\n</details>" if text else ""


def _page(title: str, *blocks: str) -> str:
    return "\n\n".join([f"# {title}", *filter(None, (block.strip() for block in blocks))]) + "\n"


def _code(*lines: str) -> str:
    return "```sh\n" + "\n".join(lines) + "\n```"


def _listed(numbers: Sequence[int]) -> str:
    *first, last = map(str, numbers)
    return f"{', '.join(first)} and {last}" if first else last


def of_study(name: str) -> str:
    """Return the page of a study."""
    outcome = published(name)
    study, looks = outcome.study, outcome.study.looks
    facts = outcome.as_dict()
    judgment, notes = judged(name)
    tunings = [each.tuning for each in study.file.entries if each.tuning is not None]
    searched = sum(each.core_hours or 0 for each in tunings if each.value is not None)
    trained = sum(each["core_hours"] for each in facts["entries"])
    design = (
        f"{len(outcome.pairs)} pairs on seeds {looks.block.start} to {looks.block.stop - 1} of `{study.task}`, "
        f"{study.epochs} epochs. Looks after {_listed(looks.looks)} seeds; taken: {_listed(list(outcome.taken))}. "
        f"Error {looks.alpha:g} over all pairs and looks, rule `{looks.rule}`. First seed {outcome.begun_at}, hash "
        f"`{study.hash}`."
    )
    ended = f" Ended on {outcome.ended[:10]}: open pairs stay open." if outcome.ended else ""
    cost = f"{sum(outcome.looked.values())} seeds took {hours_text(trained)} core-hours" + (
        f", the searches for settings {hours_text(searched)}." if searched else "."
    )
    found = list(settings(outcome))
    return _page(
        name,
        f"**{study.file.summary}**",
        judgment,
        f"![{study.file.summary}](../images/study-{name}.png)",
        _code(f"qrlsuite show {name}", f"qrlsuite plot pairs --study {name}"),
        markdown(verdicts(outcome)),
        design + ended,
        *claims(outcome),
        _folded("Every entry", f"{cost}\n\n{markdown(entries(outcome))}"),
        _folded("What the searches found", markdown(found) if len(found) > 1 else ""),
        _folded("Notes", notes),
    )


def claims(outcome: State) -> Iterator[str]:
    """Say what a study claims, what is known of it, and how often such a study establishes it."""
    decided = outcome.decision.claims
    power = study_power(outcome.study) if decided else None
    if power is None:
        return
    rows = [(each.claim.sentence, each.verdict) for each in decided]
    yield markdown([("claim", "after the last look"), *rows])
    yield (
        f"Each claim has an error of {outcome.study.looks.alpha:g} of its own, on one side. Of 100 such studies, this "
        f"many establish it by each look, if the seeds' steps spread by {power.spread:.0%} of their mean, as in "
        f"`{power.pilot}`:"
    )
    looks = [f"{look} seeds" for look in outcome.study.looks.looks]
    found = [(claim, *(f"{100 * each:.0f}" for each in shares)) for claim, shares in power.claims.items()]
    yield markdown([("claim", *looks), *found])


def searches(task: str) -> Iterator[Sequence[str]]:
    """How the settings of a board's entries were found."""
    yield "entry", "regret", "trials", "runs", "ended by", "core-hours"
    for row in main_facts(task)["rows"]:
        if tuning := row["tuning"]:
            regret = f"{tuning['regret']['expected']:.0%}" if tuning.get("regret") else ""
            counts = str(tuning.get("trials") or ""), str(tuning.get("runs") or "")
            yield (
                row["label"],
                regret,
                *counts,
                tuning.get("budget") or "",
                hours_text(tuning.get("core_hours") or 0),
            )


def of_board(task: str) -> str:
    """Return the page of a board."""
    facts, (judgment, notes) = main_facts(task), judged(f"board-{task}")
    times, found = facts["times"], list(searches(task))
    hours = sum(row["core_hours"] for row in facts["rows"])
    searched = sum(row["tuning"].get("core_hours") or 0 for row in facts["rows"] if row["tuning"])
    cost = f"The seeds took {hours_text(hours)} core-hours" + (
        f", the searches {hours_text(searched)}." if len(found) > 1 else "."
    )
    asked = (
        "The pairs that answer a question, each by itself at 95%, and what the board decides:\n\n"
        + markdown(pairs(task))
        if task in PAIRS
        else ""
    )
    return _page(
        f"Board of {task}",
        f"**{tasks.load(task).file.summary}. Which entries need the fewest steps?**",
        judgment,
        f"![Learning curves on {task}](../images/board-{task}.png)",
        _code(
            f"qrlsuite leaderboard --task {task} --published",
            f"qrlsuite plot curves --task {task} --published",
        ),
        markdown(board(task)),
        f"{times['decided']} of {times['pairs']} pairs are decided, with an error of {times['alpha']:g} over all. "
        f"{cost}",
        asked,
        _folded("What the searches took", markdown(found) if len(found) > 1 else ""),
        _folded("Notes", notes),
    )


def of_tasks(name: str) -> str:
    """Return the page of studies that ask one question on several tasks."""
    asked = averaged(name)
    judgment, notes = judged(name)
    summary = asked.studies[0].study.file.summary
    links = ", ".join(f"[`{each}`]({each}.md)" for each in TOGETHER[name])
    studies = " ".join(TOGETHER[name])
    if name == FAMILY:
        links, studies = (
            f"`leaderboard/{FAMILY}`, written by `benchmarks/family.py`",
            f"leaderboard/{FAMILY}/*",
        )
    picture = f"![{summary}](../images/study-{name}-tasks.png)" if name != "quantum-or-not-elsewhere" else ""
    shared = means(name) if name != "quantum-or-not-elsewhere" else ()
    return _page(
        f"{name}: several tasks",
        f"**{summary}** Studies: {links}.",
        judgment,
        picture,
        _code(f"qrlsuite show {studies}"),
        f"Steps below threshold, mean over seeds and thresholds:\n\n{markdown(shared)}" if shared else "",
        f"The mean over tasks, from the first look of each study:\n\n{markdown(of_several(name))}",
        "\n".join(f"- {line}" for line in asked.claim_lines),
        f"Each task, with the interval of its own study:\n\n{markdown(rivals(name))}"
        if name == FAMILY
        else "",
        _folded("Notes", notes),
    )


def _outcome(name: str) -> str:
    """Say how many pairs of a study have which verdict."""
    kinds = Counter(
        next(
            (
                word
                for word in ("equal", "not told apart", "open", "trade-off")
                if pair.verdict.startswith(word)
            ),
            "",
        )
        for pair in published(name).pairs
    )
    words = {
        "": "differ",
        "equal": "equal",
        "trade-off": "trade-off",
        "not told apart": "not told apart",
        "open": "open",
    }
    return ", ".join(f"{kinds[kind]} {word}" for kind, word in words.items() if kinds[kind])


def index() -> str:
    """Return the page that leads to the others."""
    rows = [
        (
            f"[{name}]({name}.md)",
            f"`{published(name).study.task}`",
            published(name).study.file.summary,
            _outcome(name),
        )
        for name in names()
    ]
    several = [(f"[{name}]({name}.md)", listed(members, 8)) for name, members in TOGETHER.items()]
    boards = []
    for task in BOARDS:
        facts = main_facts(task)
        decided = f"{facts['times']['decided']} of {facts['times']['pairs']}"
        boards.append(
            (f"[{task}](board-{task}.md)", str(len(facts["rows"])), decided, tasks.load(task).file.summary)
        )
    families = len(rows) + len(boards) + len(TOGETHER[FAMILY])
    return _page(
        "Results",
        "One page for each study and board that comes with the suite, made from its files. [Findings](../findings.md) "
        "says what they mean.",
        _code(
            "qrlsuite list studies",
            "qrlsuite show equal-size-beam6g",
            "qrlsuite leaderboard --task vqe-h2 --published",
        ),
        "## How to read a page",
        READING,
        f"Each study and each board holds its own error of .05, and these are {families} families of tests. If all "
        f"entries were equal, we would expect {0.05 * families:.1f} families with a false difference.",
        "## Studies",
        markdown([("study", "task", "question", "pairs"), *rows]),
        "## One question on several tasks",
        markdown([("page", "studies"), *several]),
        "## Boards",
        markdown([("board", "entries", "pairs decided", "task"), *boards]),
    )


def pages() -> dict[str, str]:
    """Return every page by its file name."""
    made = {"index": index()}
    made |= {name: of_study(name) for name in names()}
    made |= {name: of_tasks(name) for name in TOGETHER}
    made |= {f"board-{task}": of_board(task) for task in BOARDS}
    return {f"{name}.md": text for name, text in made.items()}


if __name__ == "__main__":
    PAGES.mkdir(exist_ok=True)
    made = pages()
    for path in PAGES.glob("*.md"):
        if path.name not in made:
            path.unlink()
    for name, text in made.items():
        PAGES.joinpath(name).write_text(text)
