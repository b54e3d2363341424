"""The glossary leads to the code, and words that it replaced are written nowhere with their old meaning."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from qrlsuite.cli.app import BUILT_IN, load

ROOT = Path(__file__).parents[2]
ROWS = re.findall(
    r"^\| \*\*(.+?)\*\* \| (.+?) \| `(.+?)` \|$", (ROOT / "docs" / "glossary.md").read_text(), re.MULTILINE
)


def test_there_are_ten_to_twenty_terms_each_once() -> None:
    terms = [term for term, _, _ in ROWS]
    assert 10 <= len(terms) == len(set(terms)) <= 20


@pytest.mark.parametrize(
    ("term", "module"), [(term, module) for term, _, modules in ROWS for module in modules.split("`, `")]
)
def test_a_term_is_found_where_the_glossary_says(term: str, module: str) -> None:
    found = importlib.util.find_spec(module)
    assert found is not None
    assert found.origin is not None
    word = term.split()[-1]
    code = Path(found.origin).read_text().lower()
    assert word in code or {"tolerance": "epsilon", "cell": "cell"}.get(word, word) in code


REPLACED = {
    r"plans?": "study with looks",
    r"significance[ _]tests?": "rule",
    r"unranked": "entries of a study",
    r"standings|times board": "board",
    r"hyper-?parameters?": "option, or setting where it is tuned",
    r"survey|takeover": "a verb with its object",
    r"calibrat(?:e|ed|es|ion|ions)": "speed of a machine, error rate of a rule",
    r"ansaetze": "ansatzes",
    r"EntryCurves|TaskError|SignificanceTestSpec|api\.decide|api\.costs": "the name of now",
}
"""Words that had a second meaning or a second name, and what is written now."""
ALLOWED = {
    "docs/error-rates.md": ("plans rather too many seeds", "benchmarks/calibration.py"),
    "docs/statistics.md": ("How many runs to plan",),
    "docs/tuning.md": ('"Hyperparameter optimization"',),  # the paper's title of a table
}
"""By file or folder: phrases in which a word is the right one."""
NAMES = re.compile(r"\(plans\.md[^)]*\)|leaderboard/(?:plans|unranked)|(?:plans|unranked)/<|plan\.toml")
"""Files and folders, whose names stay."""
SOURCES = ("qrlsuite", "plugins", "leaderboard")


def pages() -> Iterator[tuple[str, str]]:
    """Return every page with its text; of a notebook the sentences."""
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")):
        yield str(path.relative_to(ROOT)), path.read_text()
    for path in (ROOT / "leaderboard").glob("*.md"):
        yield str(path.relative_to(ROOT)), path.read_text()
    for path in (ROOT / "docs").rglob("*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        yield str(path.relative_to(ROOT)), text


def helps() -> Iterator[tuple[str, str]]:
    """Return the help of every built-in command and of its options."""
    waiting = [(name, load(target)) for name, target in BUILT_IN.items()]
    while waiting:
        name, command = waiting.pop()
        options = [getattr(option, "help", "") or "" for option in command.params]
        yield f"{name} --help", "\n".join([command.help or "", *options])
        waiting += [(f"{name} {word}", each) for word, each in getattr(command, "commands", {}).items()]


def messages() -> Iterator[tuple[str, str]]:
    """Return what each file of the suite may print: its texts of several words, docstrings left out."""
    for path in (path for folder in SOURCES for path in (ROOT / folder).rglob("*.py")):
        tree = ast.parse(path.read_text())
        silent = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        texts = [
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in silent
        ]
        yield str(path.relative_to(ROOT)), "\n".join(text for text in texts if " " in text)


def replaced_words(place: str, text: str) -> list[str]:
    """Return where a text has a word that was replaced, with its neighbors and the word of now."""
    text = NAMES.sub("", " ".join(text.split()))
    for phrase in (each for file, phrases in ALLOWED.items() if place.startswith(file) for each in phrases):
        text = text.replace(phrase, "")
    return [
        f"{place}: '...{text[max(found.start() - 30, 0) : found.end() + 30]}...': {now}"
        for word, now in REPLACED.items()
        for found in re.finditer(rf"(?<!\w)(?:{word})(?!\w)", text, re.IGNORECASE)
    ]


def test_a_replaced_word_is_found_and_told() -> None:
    assert replaced_words("docs/x.md", "as a survey did") == [
        "docs/x.md: '...as a survey did...': a verb with its object",
    ]
    assert len(replaced_words("docs/x.md", "How many runs to plan, and Hyperparameters")) == 2
    assert replaced_words("docs/statistics.md", "How many runs to plan") == []
    assert replaced_words("docs/x.md", "[pairs](plans.md#a), `leaderboard/plans/a`, planned, explains") == []


@pytest.mark.parametrize("texts", [pages, helps, messages], ids=lambda texts: texts.__name__)
def test_replaced_words_are_written_nowhere(texts: type[Iterator[tuple[str, str]]]) -> None:
    assert [line for place, text in texts() for line in replaced_words(place, text)] == []
