"""The documentation says what is: names of commands, options, tasks and presets in it exist."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import itertools
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from qrlsuite import options, registry, specs
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard import studies
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.published import PUBLISHED
from qrlsuite.notation import joined
from qrlsuite.options import parse_setting
from tests.core.test_dependencies import FOLDERS

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "results").glob("*.md")),
    *sorted((ROOT / "leaderboard").glob("*.md")),
]
SENTENCE = re.compile(r"qrlsuite (?!is\b)([a-z]+)((?: [^\n`|]*)?)")


def commands() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        text = page.read_text()
        fenced = r"^```([^\n]*)\n(.*?)^```$"  # of any language: the end of one block begins no other
        blocks = [
            block
            for language, block in re.findall(fenced, text, re.DOTALL | re.MULTILINE)
            if language in ("", "sh", "bash", "console", "text")
        ]
        text = re.sub(fenced, "", text, flags=re.DOTALL | re.MULTILINE)
        blocks += re.findall(r"((?:^    .*\n)+)|`(qrlsuite [^`\n]+)`", text, re.MULTILINE)
        whole = ("".join(each).replace("\\\n", " ") for each in blocks)
        lines = (line.strip().removeprefix("$ ") for each in whole for line in each.splitlines())
        found += [(page.name, line) for line in lines if line.startswith("qrlsuite ")]
    return found


def test_nothing_is_installed_by_a_name_that_is_free_for_anyone() -> None:
    """The suite is on no index yet. What messages install instead are packages of its extras."""
    code = [path for folder in FOLDERS.values() for path in [*folder.rglob("*.py"), *folder.rglob("*.toml")]]
    for path in [*PAGES, *code, *(ROOT / "benchmarks").glob("*.py"), ROOT / "CHANGELOG.md"]:
        assert not re.search(r"pip install[^`\n]*[ ']qrlsuite\b|qrlsuite\[[a-z]", path.read_text()), path
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    offered = {Requirement(each).name for extra in extras.values() for each in extra}
    for kind in (specs.EngineSpec, specs.TrackerSpec):
        for registered in registry.create().of(kind).values():
            assert {each.removeprefix("pip install ") for each in registered.spec.extras.values()} <= offered


OF_PLUGINS = {"rzz-cost"}
"""Commands on the pages that a plugin brings."""
IN_SENTENCES = {
    (page.name, code)
    for page in PAGES
    for code in re.findall(r"(?<!`)`(qrlsuite [^`\n]+)`", page.read_text())
}
"""Commands within running text."""


@functools.cache
def application() -> tuple[Any, Any]:
    """Return the command line as a tree of commands, and the module they come from: click, or typer's copy of it.

    Parsing calls the program's own options (`--version`, `--install-completion`, which edits the shell's files): here
    they do nothing.
    """
    from typer.main import get_command

    from qrlsuite.cli.app import build

    tree = get_command(build())
    for option in tree.params:
        option.callback = None
    return tree, importlib.import_module(type(tree).make_context.__module__)


def parse(words: list[str]) -> str:
    """Parse a command line without running it; returns what is wrong with it: an unknown command, option or choice."""
    return parsed(words)[0]


def parsed(words: list[str]) -> tuple[str, dict[str, Any]]:
    """Parse a command line without running it; returns what is wrong with it, and its arguments and options by name."""
    command, core = application()
    context = core.Context(command, info_name="qrlsuite")
    try:
        while hasattr(command, "commands") and words and not words[0].startswith("-"):
            name, command, words = command.resolve_command(context, list(words))
            context = core.Context(command, info_name=name, parent=context)
        made = command.make_context(context.info_name, list(words), parent=context.parent)
    except core.Exit:  # --version, --help
        return "", {}
    except core.UsageError as error:
        return str(error.format_message() or type(error).__name__), {}
    return "", made.params


def test_the_parser_finds_what_is_wrong() -> None:
    assert not parse(["run", "--task", "beam6g", "--model", "mlp", "--quick"])
    assert not parse(["new", "plugin", "x", "--from", "ring.py"])
    assert "No such command" in parse(["runn"])
    assert "No such option" in parse(["run", "--task", "beam6g", "--model", "mlp", "--quickly"])
    assert "is not one of" in parse(["leaderboard", "--format", "pdf"])
    assert "Missing option '--task'" in parse(["run", "mlp"])


def test_commands_after_code_of_another_language_are_found() -> None:
    lines = [line for page, line in commands() if page == "your-circuit.md"]
    assert len([line for line in lines if line.startswith(("qrlsuite check", "qrlsuite run"))]) == 4


def test_the_parser_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An option that acts while it is parsed once edited the files of the shell that ran the tests."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for option in ("--install-completion", "--show-completion", "--version"):
        assert not parse([option])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("page", "line"), commands())
def test_every_command_in_the_documentation_exists_with_its_options(page: str, line: str) -> None:
    words = shlex.split(line.split("#")[0].replace(" ...", ""))[1:]
    if words[0] in OF_PLUGINS:
        return
    problem = parse(words) if words[0].islower() or words[0].startswith("-") else ""  # not `qrlsuite COMMAND`
    if problem.startswith("Missing") and (page, line) in IN_SENTENCES:
        problem = ""  # a sentence may leave out what it is not about
    assert not problem, f"{page}: {line}: {problem}"
    if page in ("plugins.md", "your-algorithm.md", "your-environment.md") or "--plugin" in words:
        return  # names of a package that its own test installs
    named = dict(itertools.pairwise(words))
    for flag, kind in (("--task", "tasks"), ("--model", "models")):
        if (
            flag in named
            and not named[flag].startswith(("gym:", "my-", "external"))
            and not named[flag].endswith(".toml")
            and not ("--published" in words and (PUBLISHED / named[flag]).is_dir())
        ):
            registry.get(specs.kind(kind), named[flag].split()[0].partition("+")[0])
    if words[0] not in ("run", "tune") or "--task" not in named or "my-" in line or "gym:" in line:
        return
    plain = list(itertools.takewhile(lambda word: not word.startswith("-"), words[1:]))
    settings = [parse_setting(value) for key, value in itertools.pairwise(words) if key == "--set"]
    entries = plain if words[0] == "tune" else [named.get("--model") or joined(plain)]
    if entries == [""] and (page, line) in IN_SENTENCES:
        return
    for entry in entries:
        resolve(named["--task"], entry, settings=settings)


def examples() -> list[tuple[str, str]]:
    """Return the commands with --published, on the pages and in the help of commands."""
    from qrlsuite.cli.app import BUILT_IN, load

    helps = [(f"{name} --help", load(target).help or "") for name, target in BUILT_IN.items()]
    more = [
        (name, line.strip())
        for name, text in helps
        for line in re.findall(r"qrlsuite [^;`]+", " ".join(text.split()).partition("Example")[2])
    ]
    return [
        (place, line)
        for place, line in [*commands(), *more]
        if "--published" in line.partition("#")[0].split()
    ]


@pytest.mark.parametrize(("place", "line"), examples())
def test_published_entries_in_examples_exist(place: str, line: str) -> None:
    """A name that an example uses means one entry, whatever else is published."""
    problem, values = parsed(shlex.split(line.partition("#")[0])[1:])
    if problem:
        return  # a sentence that leaves things out
    task = values.get("task")
    tasks = [task] if isinstance(task, str) else list(task or ())
    named = (
        [values.get(key) for key in ("first", "second")] if line.split()[1] in ("compare", "power") else []
    )
    written = values.get("entry") or ()
    for name in [*filter(None, named), *([written] if isinstance(written, str) else written)]:
        if name.isupper():
            continue  # compare FIRST SECOND
        assert collect.find(collect.Selection.create("none", tasks, published=True), name)
    of_study = values.get("name" if line.split()[1] == "study" else "study") or ()
    named_studies = [*([of_study] if isinstance(of_study, str) else of_study), *(values.get("names") or ())]
    for study in [name for name in named_studies if name and not name.isupper()]:
        assert studies.select(study, collect.Selection.create("none", tasks, published=True))[0]


def test_every_command_is_documented() -> None:
    text = "\n".join(page.read_text() for page in PAGES)
    missing = [name for name in application()[0].commands if not re.search(rf"\bqrlsuite {name}\b", text)]
    assert not missing


@functools.cache
def every_option() -> set[str]:
    """Return the options of all commands, built-in ones imported."""
    from qrlsuite.cli.app import BUILT_IN, load

    waiting, found = [application()[0], *map(load, BUILT_IN.values())], {"--help"}
    while waiting:
        command = waiting.pop()
        found |= {
            word for parameter in command.params for word in (*parameter.opts, *parameter.secondary_opts)
        }
        waiting += getattr(command, "commands", {}).values()
    return found


OTHERS = {"--config-settings", "--pairs"}
"""Options of other programs."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_in_running_text_exist(page: Path) -> None:
    known = every_option() | OTHERS
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for code in re.findall(r"`([^`]+)`", " ".join(text.split())):
        if code.startswith(
            (
                "pip ",
                "pl-device-test",
                "kubectl ",
                "mlflow",
                "tensorboard",
                "OPENBLAS",
                "python benchmarks",
                "benchmarks/",
            )
        ):
            continue
        for word in re.findall(r"(?<![\w-])--[a-z][a-z-]*", re.sub(r'command="[^"]*"', "", code)):
            assert word in known, f"{page.name}: `{code}`"


def test_variables_and_make_targets_exist() -> None:
    code = "".join(path.read_text() for path in (ROOT / "qrlsuite").rglob("*.py"))
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for page in PAGES:
        text = page.read_text()
        named = {"".join(two) for two in re.findall(r"^make ([a-z-]+)$|`make ([a-z-]+)`", text, re.MULTILINE)}
        assert named <= set(targets), page.name
        assert [name for name in re.findall(r"\bQRLSUITE_[A-Z_]+\b", text) if name not in code] == [], (
            page.name
        )


def test_the_fidelity_pages_options_exist() -> None:
    text = (ROOT / "docs" / "fidelity.md").read_text()
    environment = options.field_names(specs.resolve(registry.get(specs.EnvironmentSpec, "beam6g").options))
    for name in re.findall(r"`(\w+) = \"", text):
        assert name in environment
    assert "init" in options.field_names(specs.resolve(registry.get(specs.ModelSpec, "mlp").options))
    for preset in re.findall(r"preset=(\w+)", text):
        resolve("beam6g", "mlp", preset=preset)


def test_links_between_pages_resolve() -> None:
    for page in PAGES:
        for target, place in re.findall(r"\]\(([^)#:]+)(?:#([^)]*))?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
            assert not place or place in places(page.parent / target), (
                f"{page.name} links to {target}#{place}"
            )


def places(page: Path) -> set[str]:
    """Return the names of a page's headings and folds in its address, as GitHub and mkdocs make them."""
    heads = re.findall(r"^#+ (.*)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads} | {
        *re.findall(r'<details id="([\w-]+)"', page.read_text())
    }


def sections(docstring: str | None) -> dict[str, list[str]]:
    """Return the lines of a numpy-style docstring by section, `Parameters` and such."""
    lines, found, name = (docstring or "").splitlines(), {"": []}, ""
    for line, below in itertools.zip_longest(lines, lines[1:], fillvalue=""):
        if below and set(below.strip()) == {"-"} and len(below.strip()) == len(line.strip()):
            name = line.strip()
            found[name] = []
        else:
            found[name].append(line)
    return found


def parameters(docstring: str | None) -> set[str]:
    """Return the names that a docstring documents as parameters."""
    lines = [
        line for line in sections(inspect.cleandoc(docstring or "")).get("Parameters", []) if ":" in line
    ]
    heads = [line.split(":")[0] for line in lines if not line.startswith((" ", "-"))]
    return {name.strip(" *`") for head in heads for name in head.split(",")}


def taken(node: ast.AST) -> set[str]:
    """Return the names of a function's parameters; of a class, those of `__init__`, else its fields."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        a = node.args
        every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
        return {argument.arg for argument in every}
    assert isinstance(node, ast.ClassDef)
    made = [
        taken(item) for item in node.body if isinstance(item, ast.FunctionDef) and item.name == "__init__"
    ]
    fields = {
        item.target.id
        for item in node.body
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)
    }
    return set().union(*made) if made else fields


SOURCES = [
    path
    for folder in ("qrlsuite", "plugins", "leaderboard", "tasks")
    for path in (ROOT / folder).rglob("*.py")
]


def test_documented_parameters_exist() -> None:
    wrong, documented = [], 0
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                names = parameters(ast.get_docstring(node))
                documented += len(names)
                wrong += [
                    f"{path.name}:{node.lineno} {node.name}: {name}" for name in sorted(names - taken(node))
                ]
    assert documented > 500
    assert not wrong


def test_parameters_are_found_in_a_docstring() -> None:
    text = "Do it.\n\nParameters\n----------\na, b:\n    Two: numbers.\n*c:\n    More.\n\nReturns\n-------\nint:\n    1"
    assert parameters(text) == {"a", "b", "c"}
