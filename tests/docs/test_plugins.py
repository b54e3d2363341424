"""Pages show a package that works: the files of `tests/third_party/acme-qrl`, put in when they are built.

`tests/third_party/test_stranger.py` installs that package, and runs the commands of the pages.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from qrlsuite import hookspecs
from qrlsuite.specs import KINDS
from tests.testing.test_builtins import RULES

ROOT = Path(__file__).parents[2]
PAGES = ("your-algorithm", "your-environment", "plugins")
PAGE = "\n".join((ROOT / "docs" / f"{page}.md").read_text() for page in PAGES)
PACKAGE = ROOT / "tests" / "third_party" / "acme-qrl"
FILES = re.findall(r'\*\*`(\S+)`\*\*\n\n``` {\.(?:python|toml)}\n--8<-- "(\S+)"\n```\n', PAGE)
"""The name above each block, and the file that is put into it."""
HOOKS = list(hookspecs.HOOKS)


def test_every_file_of_the_package_is_shown_once_below_its_name() -> None:
    assert all(name == shown for name, shown in FILES)
    files = [str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*") if path.suffix in (".py", ".toml")]
    assert sorted(name for name, _ in FILES) == sorted(files)
    assert PAGE.count("\n--8<-- ") == len(FILES)


@pytest.mark.parametrize("kind", RULES)
def test_the_rules_on_the_page_are_the_checks(kind: str) -> None:
    word = KINDS[kind].kind.replace("_", " ")
    (row,) = re.findall(rf"^\| {word} \| (.*) \|$", PAGE, re.MULTILINE)
    assert re.findall(r"`([^`]+)`", row) == RULES[kind]


def test_hooks_are_on_the_page() -> None:
    assert [name for name in HOOKS if f"`{name}`" not in PAGE] == []
