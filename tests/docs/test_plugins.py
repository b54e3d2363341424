"""docs/plugins.md is a package that works: its blocks are files of `tests/third_party/acme-qrl`.

`tests/third_party/test_stranger.py` installs that package, and runs the commands of the page.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from qrlsuite import hookspecs, scaffold
from qrlsuite.specs import KINDS
from tests.testing.test_builtins import RULES

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "plugins.md").read_text()
PACKAGE = ROOT / "tests" / "third_party" / "acme-qrl"
FILES = re.findall(r"\*\*`(\S+)`\*\*\n\n```(?:python|toml)\n(.*?)```\n", PAGE, re.DOTALL)
HOOKS = list(hookspecs.HOOKS)


@pytest.mark.parametrize(("path", "text"), FILES, ids=[path for path, _ in FILES])
def test_a_block_is_the_packages_file(path: str, text: str) -> None:
    assert text == (PACKAGE / path).read_text()


def test_no_block_is_left_out() -> None:
    fences = re.findall(r"^```(\w+)\n", PAGE, re.MULTILINE)
    assert len(FILES) == len([fence for fence in fences if fence != "sh"]) > 5
    shown = {path for path, _ in FILES}
    files = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*") if path.suffix in (".py", ".toml")}
    assert shown == files, "every file of the package is on the page"


@pytest.mark.parametrize("hook", HOOKS)
def test_every_hook_is_on_the_page(hook: str) -> None:
    assert f"`{hook}`" in PAGE


@pytest.mark.parametrize("kind", RULES)
def test_the_rules_on_the_page_are_the_checks(kind: str) -> None:
    word = KINDS[kind].kind.replace("_", " ")
    (row,) = re.findall(rf"^\| {word} \| (.*) \|$", PAGE, re.MULTILINE)
    assert re.findall(r"`([^`]+)`", row) == RULES[kind]


def test_kinds_of_new_plugins_are_on_the_page() -> None:
    for kind in scaffold.Kind:
        assert f"`{kind}`" in PAGE
