"""The documentation says what is: names of commands, options, tasks and presets in it exist."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qrlsuite import options, registry, specs
from qrlsuite.entry import resolve
from qrlsuite.options import parse_setting

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "leaderboard").glob("*.md")),
]
SENTENCE = re.compile(r"qrlsuite (?!is\b)([a-z]+)((?: [^\n`|]*)?)")


def commands() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        for block in re.findall(
            r"```(?:sh|bash|console|text)?\n(.*?)```|`(qrlsuite [^`\n]+)`", page.read_text(), re.DOTALL
        ):
            lines = (line.strip().removeprefix("$ ") for line in "".join(block).splitlines())
            found += [(page.name, line) for line in lines if line.startswith("qrlsuite ")]
    return found


@pytest.mark.parametrize(("page", "line"), commands())
def test_every_command_in_the_documentation_exists_with_its_options(page: str, line: str) -> None:
    import shlex

    from qrlsuite.cli.app import build

    words = shlex.split(line.split("#")[0].replace("...", ""))[1:]
    result = CliRunner().invoke(build(), [words[0], "--help"] if not words[0].startswith("-") else ["--help"])
    assert result.exit_code == 0, f"{page}: {line}"
    for word in words[1:]:
        if word.startswith("--"):
            assert word.partition("=")[0] in result.output, f"{page}: {line}: no option {word}"
    named = dict(itertools.pairwise(words))
    for flag, kind in (("--task", "tasks"), ("--model", "models"), ("--algorithm", "algorithms")):
        if (
            flag in named
            and not named[flag].startswith(("gym:", "my-"))
            and not named[flag].endswith(".toml")
        ):
            registry.load().get(kind, named[flag])
    if (
        words[0] == "run"
        and "--task" in named
        and "--model" in named
        and "my-" not in line
        and "gym:" not in line
    ):
        settings = [parse_setting(value) for key, value in itertools.pairwise(words) if key == "--set"]
        resolve(named["--task"], named["--model"], named.get("--algorithm"), settings, named.get("--preset"))


def test_the_fidelity_pages_options_exist() -> None:
    text = (ROOT / "docs" / "fidelity.md").read_text()
    environment = options.field_names(specs.resolve(registry.environment("beam6g").options))
    for name in re.findall(r"`(\w+) = \"", text):
        assert name in environment
    assert "init" in options.field_names(specs.resolve(registry.model("mlp").options))
    for preset in re.findall(r"--preset (\w+)", text):
        resolve("beam6g", "mlp", preset=preset)


def test_links_between_pages_resolve() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
