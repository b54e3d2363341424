"""The glossary leads to the code: every term has a module that is there, and says the term."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROWS = re.findall(
    r"^\| \*\*(.+?)\*\* \| (.+?) \| `(.+?)` \|$", (ROOT / "docs" / "glossary.md").read_text(), re.MULTILINE
)


def test_there_are_ten_to_fifteen_terms_each_once() -> None:
    terms = [term for term, _, _ in ROWS]
    assert 10 <= len(terms) == len(set(terms)) <= 15


@pytest.mark.parametrize(
    ("term", "module"),
    [(term, module) for term, _, modules in ROWS for module in modules.split("`, `")],
)
def test_a_term_is_found_where_the_glossary_says(term: str, module: str) -> None:
    found = importlib.util.find_spec(module)
    assert found is not None
    assert found.origin is not None
    word = term.split()[-1]
    code = Path(found.origin).read_text().lower()
    assert word in code or {"tolerance": "epsilon", "cell": "cell"}.get(word, word) in code
