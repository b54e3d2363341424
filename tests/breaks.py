"""Breaks of the product, and whether a test finds each of them: `make breaks`, or `breaks.py PREFIX` for some files.

`breaks.py --draw SEED COUNT` drew breaks.toml: at least one break of each package, of a drawn kind in a drawn file.
A break is kept as text, and so outlives a file that is moved; one whose line is no more is gone, and another is drawn.
"""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".toml")
LIMIT = 900
"""Seconds for the tests of one break."""
SLOW = (
    "tests/cli",
    "tests/docs",
    "tests/engine",
    "tests/leaderboard/test_published",
    "tests/testing/test_builtins",
)
"""Tests that begin late: they start commands and workers, or check every entry."""
OPPOSITE = {
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}

Function = ast.FunctionDef | ast.AsyncFunctionDef
Break = dict[str, str]


def sources(prefix: str = "") -> list[Path]:
    """Return the files of the product whose path begins so, without those whose tests need a GPU."""
    files = [p for top in ("qrlsuite", "plugins", "leaderboard") for p in sorted((ROOT / top).rglob("*.py"))]
    return [
        path
        for path in files
        if str(path.relative_to(ROOT)).startswith(prefix) and not path.name.startswith("gpu")
    ]


def functions(node: ast.AST, within: str = "") -> Iterator[tuple[str, Function]]:
    """Yield the functions of a module or class with their qualified names."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Function):
            yield within + child.name, child
        elif isinstance(child, ast.ClassDef):
            yield from functions(child, f"{within}{child.name}.")


def nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what is evaluated in a function: no annotations, and nothing in f-strings, whose places are not known."""
    yield node
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if name not in ("annotation", "returns", "decorator_list") and not isinstance(
                child, ast.JoinedStr
            ):
                yield from nodes(child) if isinstance(child, ast.AST) else ()


def edit(node: ast.AST, line: str) -> str | None:
    """Return the broken text of the line on which a node begins, or None where it is nothing to break."""
    start, end = getattr(node, "col_offset", 0), getattr(node, "end_col_offset", 0)
    match node:
        case ast.Compare(left=left, ops=[operator], comparators=[right]):
            parts = left, operator, right
        case ast.BinOp(left=left, op=(ast.Add() | ast.Sub()) as operator, right=right):
            parts = left, operator, right
        case ast.BoolOp(op=operator, values=[left, right, *_]):
            parts = left, operator, right
        case ast.Raise():
            return f"{line[:start]}if False: {line[start:]}"
        case ast.Return(value=ast.expr() as value) if node.lineno == node.end_lineno:
            return None if ast.unparse(value) == "None" else f"{line[:start]}return None{line[end:]}"
        case ast.UnaryOp(op=ast.Not(), operand=operand) if node.lineno == operand.lineno:
            return line[:start] + line[operand.col_offset :]
        case ast.Constant(value=int() as value) if not isinstance(value, bool) and line[start:end] == str(
            value
        ):
            return f"{line[:start]}{value + 1}{line[end:]}"
        case _:
            return None
    if not parts[0].lineno == parts[0].end_lineno == parts[2].lineno:
        return None
    old, new = OPPOSITE[type(parts[1])]
    cut = slice(parts[0].end_col_offset, parts[2].col_offset)
    return line[: cut.start] + line[cut].replace(old, new, 1) + line[cut.stop :]


def possible(path: Path) -> dict[str, dict[str, list[Break]]]:
    """Return the breaks of a file by kind and function, where the line is the only one of its text there."""
    text = path.read_text()
    lines = text.splitlines()
    found: dict[str, dict[str, list[Break]]] = {}
    for name, function in functions(ast.parse(text)):
        inside = [line.strip() for line in lines[function.lineno - 1 : function.end_lineno]]
        for node in (part for statement in function.body for part in nodes(statement)):
            line = lines[getattr(node, "lineno", 1) - 1]
            after = edit(node, line) if line.isascii() and inside.count(line.strip()) == 1 else None
            if after is not None:
                place = {"file": str(path.relative_to(ROOT)), "function": name}
                change = {"before": line.strip(), "after": after.strip()}
                found.setdefault(type(node).__name__, {}).setdefault(name, []).append(place | change)
    return found


def draw(seed: int | str, count: int, prefix: str = "") -> list[Break]:
    """Draw breaks: one of each package, and the others over all files."""
    generator = random.Random(seed)
    files = [path for path in sources(prefix) if possible(path)]
    packages = [
        [path for path in files if path.parent == parent] for parent in sorted({p.parent for p in files})
    ]
    generator.shuffle(packages)
    drawn: list[Break] = []
    while len(drawn) < count:
        choice: object = possible(
            generator.choice(packages[len(drawn)] if len(drawn) < len(packages) else files)
        )
        while isinstance(choice, dict):
            choice = choice[generator.choice(sorted(choice))]
        assert isinstance(choice, list)
        drawn += [one for one in [generator.choice(choice)] if one not in drawn]
    return sorted(drawn, key=lambda one: (one["file"], one["function"]))


def locate(one: Break) -> tuple[Path, str] | None:
    """Return the file in which a break's line stands today, and its broken text."""
    places = []
    for path in sources():
        text = path.read_text()
        lines = text.splitlines(keepends=True)
        for name, function in functions(ast.parse(text)) if one["before"] in text else ():
            here = range(function.lineno - 1, function.end_lineno or 0)
            numbers = [number for number in here if lines[number].strip() == one["before"]]
            same = (
                path == ROOT / one["file"],
                name == one["function"],
                name.split(".")[-1] == one["function"].split(".")[-1],
            )
            places += [(same, path, number) for number in numbers if any(same)]
    if not places:
        return None
    _, path, number = max(places, key=lambda place: place[0])
    lines = path.read_text().splitlines(keepends=True)
    lines[number] = lines[number].replace(one["before"], one["after"])
    return path, "".join(lines)


def related(one: Break, path: Path) -> list[str]:
    """Return the test files that mention what a break is in, most related first."""
    module = path.with_suffix("").relative_to(ROOT)
    dotted = ".".join(part for part in module.parts if part != "__init__")
    names = one["function"].split(".")
    worth = {
        rf"\b{re.escape(dotted)}\b": 4,
        rf"\b{names[0]}\b": 3,
        rf"\b{names[-1]}\b": 2,
        rf"\b{module.name}\b": 2,
    }
    worth |= {rf"\b{part}\b": 1 for part in module.parts[:-1] if part != "qrlsuite"}
    ranks = {}
    for test in map(str, sorted(path.relative_to(ROOT) for path in ROOT.glob("tests/**/test_*.py"))):
        text = re.sub(r"[/_.]", " ", test) + test + (ROOT / test).read_text()
        rank = sum(value for word, value in worth.items() if re.search(word, text))
        ranks[test] = rank - 4 * test.startswith(SLOW) if rank else 0
    first = one.get("test", "").split("::")[0]
    ranks |= {first: 99} if first in ranks else {}
    return sorted((name for name, rank in ranks.items() if rank), key=lambda name: -ranks[name])


def failing(tests: list[str], limit: float) -> str:
    """Return the first test that fails, or nothing."""
    command = [sys.executable, "-m", "pytest", "-xq", "-p", "no:cacheprovider", *tests]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        out = process.communicate(timeout=limit)[0]
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        out = process.communicate()[0]
    failed = re.findall(r"^(?:FAILED|ERROR) (tests/[^\[ ]+)", out, re.M)
    return failed[0] if failed else ""


def replace(path: Path, text: str) -> None:
    path.write_text(text)
    Path(importlib.util.cache_from_source(path)).unlink(missing_ok=True)


def find(one: Break) -> str | None:
    """Return the first test that fails only where the product is broken, or nothing; None for a break that is gone."""
    place = locate(one)
    if place is None:
        return None
    path, broken = place
    whole, began = path.read_text(), time.monotonic()
    tests = related(one, path)
    for part in (tests[:1], tests[1:4], tests[4:12], tests[12:]):
        failed = ""
        while part and time.monotonic() - began < LIMIT:
            try:
                replace(path, broken)
                failed = failing(part, began + LIMIT - time.monotonic())
            finally:
                replace(path, whole)
            if not failed or not failing([failed], LIMIT):
                break
            print(f"    fails without the break, too: {failed}")
            part, failed = [f"--deselect={failed}", *part], ""
        if failed:
            return failed
    return ""


def write(breaks: list[Break]) -> None:
    keys = "file", "function", "before", "after", "test"
    parts = ["".join(f"{key} = {json.dumps(one[key])}\n" for key in keys if key in one) for one in breaks]
    LIST.write_text("\n".join("[[break]]\n" + part for part in parts))


def main(*words: str) -> int:
    if words[:1] == ("--draw",):
        write(draw(words[1], int(words[2]), *words[3:]))
        return 0
    breaks, lost = tomllib.loads(LIST.read_text())["break"], 0
    signal.signal(signal.SIGTERM, lambda *given: sys.exit(1))  # what is broken is mended
    os.nice(5)
    for one in breaks:
        if one["file"].startswith(words or ("",)):
            test, before = find(one), one.get("test", "")
            said = "gone" if test is None else f"found by {test}" if test else "NOT FOUND"
            print(
                f"{one['file']} {one['function']}: {one['before']}  ->  {one['after']}\n    {said}",
                flush=True,
            )
            lost += before > "" == test
            one.update({"test": test} if test is not None else {})
            write(breaks)
    print(f"{lost} breaks that were found are found no more")
    return int(lost > 0)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
