"""Everything that the published results say, kept in `tests/golden/published/`: a change of it is seen, value by value.

    python -m tests.golden.published [GROUP ...]

computes it anew, prints every changed value (`where: before -> now`) and stores it: a commit of its own, with that
list in its message.

A group is a file of questions and their answers: commands as one types them, and the data that they print. Wording is
not kept (of sentences only their numbers), nor what depends on the machine (folders, speeds and hours estimated of
them). Numbers are equal within `TOLERANCE`, since processors add in different orders; all else is equal. A value, key,
row or question that is gone or new is a change, too; the order of keys and columns is not.
`tests/leaderboard/test_golden_published.py` reads it.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import itertools
import json
import lzma
import math
import re
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from qrlsuite import api
from qrlsuite.errors import QrlSuiteError
from qrlsuite.leaderboard.shelf import published_studies
from tests.commands import answer, say

ROOT = Path(__file__).parents[2]
FOLDER = Path(__file__).parent / "published"
MAKE = "python -m tests.golden.published"
TOLERANCE = 1e-9
"""Relative. Numbers below a millionth of it are noise around 0."""

AXES = ("steps", "executions", "shots", "core-hours", "energy-error")
AXES_OF_SCORES = ("score", "area", "spread")
RULES = ("paper", "times", "steps")
DEGREES = ("beam6g", "beam6g-degree4", "beam6g-degree5", "beam6g-degree6")
TOGETHER = (
    "quantum-or-not-degree5 quantum-or-not-a3-0",
    "quantum-or-not-degree5 quantum-or-not-a3-0 quantum-or-not",
    "equal-size-beam6g equal-size-beam6g-a3-0 equal-size-beam6g-degree5",
    "equal-size-cartpole equal-size-pulse equal-size-vqe-h2 equal-size-frozenlake",
)

SENTENCES = {
    "left_out", "message", "notes", "problem", "promise", "refused", "remarks", "reports",
    "sentence", "summary", "words",
}  # fmt: skip
OF_THE_MACHINE = {
    "basis", "complete_estimate", "core_hours_at_most", "core_hours_left", "core_hours_range", "core_hours_saved",
    "core_seconds_left", "core_seconds_range", "folder", "hours_left", "next_core_hours", "seconds_per_seed_epoch",
    "workers",
}  # fmt: skip
NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?%?|\.\d+")


def _names(folder: str) -> list[str]:
    """Return what is in a folder of published results: tasks with entries, or studies that have taken a look."""
    if folder == "plans":
        return published_studies.names(begun=True)
    return sorted(path.name for path in (ROOT / "leaderboard" / folder).iterdir())


def _studies() -> list[str]:
    only_planned = {*published_studies.names()} - {*published_studies.names(begun=True)}
    return [study["name"] for study in answer("list", "studies") if study["name"] not in only_planned]


def _boards() -> Iterator[str]:
    board = "leaderboard --published --format json"
    yield from (f"{board} --by {axis}" for axis in AXES)
    yield from (f"{board} --rule {rule}" for rule in RULES)
    yield f"{board} --task beam6g --horizon 100000"
    yield f"{board} --task vqe-ising --alpha 0.2"
    several = " ".join(f"--task {task}" for task in DEGREES)
    yield from (f"{board} {several} --by {axis}" for axis in AXES[:-1])


def _rows() -> Iterator[str]:
    rows = "leaderboard --published --format csv"
    for task in _names("entries"):
        yield f"{rows} --task {task}"
    yield from (f"{rows} --task {task} --rule paper" for task in ("beam6g", "vqe-ising"))
    yield from (f"{rows} --by {axis}" for axis in AXES[1:])
    yield f"{rows} {' '.join(f'--task {task}' for task in DEGREES)}"


def _boards_of_studies() -> Iterator[str]:
    """Of those without looks: the entries of others have no board."""
    with_looks = _names("plans")
    for study in _studies():
        if study not in with_looks:
            yield f"leaderboard --published --format json --study {study}"


def _boards_by_score() -> Iterator[str]:
    for task, axis, kind in itertools.product(_names("entries"), AXES_OF_SCORES, ("json", "csv")):
        yield f"leaderboard --published --format {kind} --task {task} --by {axis}"


def _pairs() -> Iterator[str]:
    """Each entry against the next one of its board."""
    for section in read("boards")[f"leaderboard --published --format json --by {AXES[0]}"]["sections"]:
        names = [row["entry"] for row in section["times"]["entries"]]
        for first, second in itertools.pairwise(names):
            yield f"compare {first} {second} --task {section['task']} --published --rule paper"


def _studies_shown() -> Iterator[str]:
    family = " ".join(f"leaderboard/family/{name}" for name in _names("family"))
    yield from (f"show {words} --published" for words in (*_studies(), *TOGETHER, family))


def _entries_shown() -> Iterator[str]:
    for record in sorted((ROOT / "leaderboard").glob("**/entry.json")):
        yield f"show {record.parent.relative_to(ROOT).as_posix()}"


def _folders_verified() -> Iterator[str]:
    for folder in ("entries", "unranked", "plans", "family"):
        yield from (f"verify leaderboard/{folder}/{name}" for name in _names(folder))


GROUPS: Mapping[str, Callable[[], Iterator[str]]] = {
    "boards": _boards,
    "rows": _rows,
    "studies": _studies_shown,
    "page": lambda: iter(["leaderboard --published --format html"]),
    "tables": lambda: iter([f"api.table {rows}" for rows in ("entries", "seeds", "epochs")]),
    "boards-by-score": _boards_by_score,
    "boards-of-studies": _boards_of_studies,
    "pairs": _pairs,
    "entries": _entries_shown,
    "verification": _folders_verified,
}
"""The questions of each group, in an order in which the answers of an earlier one may be read."""


def ask(question: str) -> Any:
    """Return the data with which a question is answered, or the name of the error with which it is refused."""
    words = shlex.split(question)
    if words[0] == "api.table":
        return _table(words[1])
    if words[0] != "verify":
        words += ["--runs", "no-results-here"]
    try:
        with contextlib.chdir(ROOT):
            if words[0] != "leaderboard":
                found = answer(*words)
            elif "html" in words:
                found = _inside_page(words)
            else:
                done = say(*words)
                assert done.exit_code == 0, done.output
                read = json.loads if "json" in words else _csv
                found = read(done.stdout)
    except QrlSuiteError as error:
        return {"error": type(error).__name__}
    if words[0] == "compare":
        found["verdict"] = _numbers(found["verdict"])
    return _plain(found)


def _csv(text: str) -> list[dict[str, Any]]:
    return [{name: _cell(value) for name, value in row.items()} for row in csv.DictReader(io.StringIO(text))]


def _cell(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def _inside_page(words: list[str]) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        assert say(*words, "--out", str(path)).exit_code == 0
        page = path.read_text(encoding="utf-8")
    data = re.findall(r'<script type="application/json" id="([\w-]+)">(.*?)</script>', page, re.DOTALL)
    return {name: json.loads(text) for name, text in data}


def _table(rows: str) -> Any:
    """Return the table of entries in full, of seeds and epochs each entry's columns in brief."""
    table = api.table(rows, runs=ROOT / "no-results-here", published=True)  # type: ignore[arg-type]
    types = {field.name: str(field.type) for field in table.schema}
    if rows == "entries":
        return _plain({"columns": types, "rows": table.to_pylist()})
    names = [
        f"{task}/{name}"
        for task, name in zip(table.column("task").to_pylist(), table.column("name").to_pylist())
    ]
    starts = [place for place, name in enumerate(names) if place == 0 or name != names[place - 1]]
    brief = {}
    for start, end in itertools.pairwise([*starts, len(names)]):
        part = table.slice(start, end - start)
        brief[names[start]] = {
            "rows": part.num_rows,
            **{name: _brief(part.column(name)) for name in types if name not in ("task", "name")},
        }
    return _plain({"columns": types, "entries": brief})


def _brief(column: Any) -> Any:
    """Return the one value of a column; else a digest, or two sums of fractions, which processors round differently."""
    first = column[0].as_py()
    if len(column.unique()) == 1:
        return first
    values = column.to_pylist()
    if str(column.type) != "double":
        return _digest(json.dumps(values))
    numbers = [math.nan if value is None else value for value in values]
    known = [(place, value) for place, value in enumerate(numbers, 1) if not math.isnan(value)]
    sums = math.fsum(value for _, value in known), math.fsum(place * value for place, value in known)
    return {"known": len(known), "sum": sums[0], "sum by place": sums[1]}


def _plain(value: Any) -> Any:
    """Return data without wording and machine, long texts as digests, and numbers to 12 digits."""
    if isinstance(value, dict):
        return {
            name: _without_words(part) if name in SENTENCES else _plain(part)
            for name, part in value.items()
            if name not in OF_THE_MACHINE
        }
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, float) and math.isfinite(value):
        return float(f"{value:.12g}")
    if isinstance(value, str) and len(value) > 200 and " " not in value:
        return _digest(value)
    return value


def _without_words(value: Any) -> Any:
    if isinstance(value, str):
        return _numbers(value)
    if isinstance(value, list | tuple):
        return [_without_words(part) for part in value]
    return _plain(value)


def _numbers(text: str) -> str:
    return " ".join(NUMBER.findall(text))


def _digest(text: str) -> str:
    return f"sha256 {hashlib.sha256(text.encode()).hexdigest()[:16]}"


def read(group: str) -> dict[str, Any]:
    """Return the stored answers of a group by question; nothing where it was never made."""
    path = FOLDER / f"{group}.json.xz"
    stored: dict[str, Any] = json.loads(lzma.decompress(path.read_bytes())) if path.exists() else {}
    return stored


def write(group: str, answers: Mapping[str, Any]) -> None:
    """Store the answers of a group."""
    FOLDER.mkdir(exist_ok=True)
    text = json.dumps(answers, separators=(",", ":"), ensure_ascii=False)
    (FOLDER / f"{group}.json.xz").write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))


def changes(before: Any, now: Any, where: str = "") -> Iterator[str]:
    """Say of every value that differs where it is, what it was and what it is."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in dict.fromkeys((*before, *now)):
            place = f"{where}.{name}" if where else name
            if name not in now:
                yield f"{place}: {_short(before[name])} -> gone"
            elif name not in before:
                yield f"{place}: new -> {_short(now[name])}"
            else:
                yield from changes(before[name], now[name], place)
    elif isinstance(before, list) and isinstance(now, list):
        if len(before) != len(now):
            yield f"{where}: {len(before)} values -> {len(now)}"
        for place, (one, other) in enumerate(zip(before, now)):
            yield from changes(one, other, f"{where}[{_name(one, place)}]")
    elif not _same(before, now):
        begin = _difference(before, now)
        yield f"{where}: {_short(before, begin)} -> {_short(now, begin)}"


def _name(row: Any, place: int) -> Any:
    """Call a row by its entry, where it has one."""
    return row["entry"] if isinstance(row, dict) and isinstance(row.get("entry"), str) else place


def _same(before: Any, now: Any) -> bool:
    numbers = [isinstance(value, int | float) and not isinstance(value, bool) for value in (before, now)]
    if all(numbers):
        both_nan = math.isnan(before) and math.isnan(now)
        return both_nan or math.isclose(before, now, rel_tol=TOLERANCE, abs_tol=1e-6 * TOLERANCE)
    return type(before) is type(now) and bool(before == now)


def _difference(before: Any, now: Any) -> int:
    """Return a place shortly before the first difference of two texts."""
    if not (isinstance(before, str) and isinstance(now, str)):
        return 0
    different = (place for place, (one, other) in enumerate(zip(before, now)) if one != other)
    return max(0, next(different, 0) - 20)


def _short(value: Any, begin: int = 0) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return (
        text
        if len(text) <= 100
        else f"{'…' * (begin > 0)}{text[begin : begin + 99]}{'…' * (begin + 99 < len(text))}"
    )


def differences(group: str, every: int = 1) -> list[str]:
    """Return what is said otherwise than it is stored, by all questions of a group or by every so many of them."""
    stored = read(group)
    if every == 1:
        return list(changes(stored, {question: ask(question) for question in GROUPS[group]()}))
    asked = list(stored)[every // 2 :: every]
    return list(changes({question: stored[question] for question in asked}, {q: ask(q) for q in asked}))


def main(groups: list[str]) -> None:
    """Store the groups anew whose answers have changed; print every change."""
    for group in groups or GROUPS:
        stored = read(group)
        now = {question: ask(question) for question in GROUPS[group]()}
        changed = list(changes(stored, now))
        print(f"{group}: {len(now)} questions, {len(changed)} changes", flush=True)
        for line in changed if stored else ():
            print(f"  {line}")
        if changed:
            write(group, now)


if __name__ == "__main__":
    main(sys.argv[1:])
