"""The page: templates, style and scripts put into one file that needs nothing else."""

from __future__ import annotations

import base64
import datetime
import hashlib
from collections.abc import Sequence
from importlib import resources

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

import qrlsuite
from qrlsuite.leaderboard.boards.board import Leaderboard
from qrlsuite.leaderboard.boards.tables import main_section
from qrlsuite.leaderboard.report import entries, rows, sections, winners
from qrlsuite.leaderboard.report import looks as looks_report
from qrlsuite.leaderboard.report.encode import clean, script_json
from qrlsuite.results.text import counted
from qrlsuite.statistics import MIN_RUNS
from qrlsuite.studies.state import State

PAPER = "https://arxiv.org/abs/2501.15893"
SCRIPTS = ("page.js", "curves.js", "picked.js")
LIVE = "live.js"
LONGEST_REASON = 600


def render(
    board: Leaderboard,
    title: str = "Leaderboard",
    studies: Sequence[State] = (),
    beside: Leaderboard | None = None,
    live: bool = False,
) -> str:
    """Return a leaderboard as one self-contained HTML page.

    It loads nothing: style, scripts and the learning curves are inside, and its content security policy forbids
    connections and any script but its own.

    Parameters
    ----------
    board:
        As `qrlsuite.leaderboard.boards.board.build` returns it.
    title:
        The page's heading.
    studies:
        Studies with looks, for a section of their own.
    beside:
        The same entries by another axis or over several tasks, for sections of their own.
    live:
        Whether `qrlsuite.leaderboard.report.live` serves it: it then asks its server for the progress of runs, and for
        a newer page.
    """
    curves = {id(row.entry): row.entry for section in board.sections for row in section.tiers}
    shown = entries.views(list(curves.values()))
    by_curves = {id(entry.curves): entry for entry in shown}
    boards = [sections.view(section, number, by_curves) for number, section in enumerate(board.sections)]
    tasks = dict.fromkeys(section.task for section in board.sections)
    each_task = [[section for section in board.sections if section.task == task] for task in tasks]
    main = [boards[board.sections.index(main_section(each))] for each in each_task]
    entries.paint(shown)
    scripts = [_file(name) for name in (*SCRIPTS, *[LIVE] * live)]
    data = {"entries": entries.curves_data(shown), "sections": [view.data for view in boards]}
    now = datetime.datetime.now(datetime.UTC)
    return (
        _environment()
        .get_template("page.html.jinja")
        .render(
            title=clean(title),
            version=qrlsuite.__version__,
            date=f"{now.day} {now:%B %Y}",
            outcome=winners.outcome(view.winners for view in main),
            main=main,
            heads=list(dict.fromkeys(head for view in main for head, row in view.winners.cells if row)),
            extent=sections.extent(boards, shown),
            sections=boards,
            entries=shown,
            studies=[looks_report.view(study) for study in studies],
            beside=[] if beside is None else beside.sheets(explain=True),
            tasks=len(tasks),
            refused=[clean(line, LONGEST_REASON) for line in board.refused],
            min_runs=MIN_RUNS,
            rule=board.rule,
            promise=clean(board.promise, LONGEST_REASON),
            paper=PAPER,
            live=live,
            policy=_policy(scripts) + "; connect-src 'self'" * live,
            css=Markup(_file("style.css")),
            data=Markup(script_json(data)),
            scripts=[Markup(script) for script in scripts],
            clean=clean,
            counted=counted,
            sentence=rows.sentence,
            cell=rows.cell,
            sorted_by=rows.sorted_by,
        )
    )


def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("qrlsuite.leaderboard.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _file(name: str) -> str:
    return resources.files("qrlsuite.leaderboard.report").joinpath(name).read_text(encoding="utf-8")


def _policy(scripts: list[str]) -> str:
    """Return a content security policy that allows these scripts and nothing from elsewhere."""
    digests = (hashlib.sha256(script.encode()).digest() for script in scripts)
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )
