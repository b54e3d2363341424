"""How a board is cited: BibTeX with version and hash, and a badge to save."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

from markupsafe import Markup, escape

import qrlsuite
from qrlsuite.engine.sheet import escaped
from qrlsuite.leaderboard.boards.steps import Section
from qrlsuite.leaderboard.report.encode import clean
from qrlsuite.leaderboard.report.rows import RowView
from qrlsuite.results.text import counted, steps_text

CHARACTER = 6.6
"""Pixels that a character of a badge takes, on average."""
LONGEST = 48
"""Characters of either half of a badge."""


@dataclass(frozen=True)
class Citation:
    """A board's BibTeX, and its badge as a picture and as an address that holds it."""

    bibtex: str
    badge: Markup

    @property
    def saved(self) -> str:
        """The badge's address: the picture itself, so that saving it needs no server."""
        return f"data:image/svg+xml,{quote(self.badge)}"


def cite(section: Section, rows: Sequence[RowView]) -> Citation:
    """Return how a section is cited; `rows` are in the order of the board."""
    entries, steps = counted(len(rows), "entry"), steps_text(section.horizon)
    task = clean(section.task, LONGEST)
    fields = {
        "title": f"{{qrlsuite leaderboard: {escaped(task)}, {steps} environment steps}}",
        "author": "{The qrlsuite authors}",
        "year": str(datetime.datetime.now(datetime.UTC).year),
        "version": qrlsuite.__version__,
        "note": f"{entries}, content hash {section.hash}",
    }
    key = re.sub(r"[^A-Za-z0-9]+", "-", f"qrlsuite-{task}-{section.hash[:8]}")
    lines = "".join(f"  {name} = {{{value}}},\n" for name, value in fields.items())
    first = rows[0].time.rank_text
    best = f"{clean(rows[0].name, LONGEST)}: rank {first} of {entries}" if first != "-" else entries
    title = f"qrlsuite {qrlsuite.__version__}, {section.hash}"
    return Citation(f"@misc{{{key},\n{lines}}}", _badge(f"{task}, {steps}", best, title))


def _badge(left: str, right: str, title: str) -> Markup:
    """Draw two halves of text."""
    one, other = (round(CHARACTER * len(text)) + 14 for text in (left, right))
    words = "".join(
        f'<text x="{x}" y="14" textLength="{width - 14}" lengthAdjust="spacingAndGlyphs">{escape(text)}</text>'
        for x, width, text in ((7, one, left), (one + 7, other, right))
    )
    return Markup(
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{one + other}" height="20" role="img">'
        f"<title>{escape(f'{left}: {right} ({title})')}</title>"
        f'<path fill="#3a4149" d="M0 0h{one}v20H0z"/><path fill="#0a5796" d="M{one} 0h{other}v20H{one}z"/>'
        f'<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">{words}</g></svg>'
    )
