"""Whatever the files hold, a command answers with one clear line at most: never with a traceback."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from typer.main import get_command

from qrlsuite.cli.app import build
from qrlsuite.errors import QrlSuiteError
from qrlsuite.experiment.task import load
from qrlsuite.results import store
from tests.conftest import TINY, trainer

FEW = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
FILES = (
    "entry.json",
    "seed-0000/run.json",
    "seed-0000/epochs.parquet",
    "seed-0000/timings.jsonl",
    "seed-0001/epochs.jsonl",
    "seed-0001/run.json",
    "claims/x.json",
    "slurm/submitted.json",
    "groups/g/progress.json",
    "groups/g/checkpoint.safetensors",
)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.just(10**400),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from(["nan", "finished", "\x1b[2J", "../../x", "[bold]"]),
)
values = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from(["epoch", "scores", "status", "a.b", ""]), inner, max_size=3),
    ),
    max_leaves=5,
)


@pytest.fixture(scope="module", autouse=True)
def no_queue(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Where a SLURM is installed, a thousand commands would ask it, and wait long if it does not run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(tmp_path_factory.mktemp("empty")))
        yield


@pytest.fixture(scope="module")
def entry(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An entry with a finished and an interrupted seed, a claim, a submitted task and a checkpoint."""
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "tiny.toml").write_text(TINY)
    kept = store.EntryStore(trainer(str(folder / "tiny.toml"), folder)("runs", [0, 1], 2))
    kept.seed(1).cut(1)
    kept.seed(1).write_record(kept.seed(1).record().changed(status="running", epochs=1))
    for path in kept.groups.glob("*"):
        path.rename(kept.groups / "g")
    claim = {"host": "elsewhere", "pid": 1, "started": "1", "token": "x", "seeds": [1]}
    (kept.claims / "x.json").write_text(json.dumps(claim))
    store.write_json(
        kept.path / "slurm" / "submitted.json", {"tasks": [{"job": "1_0", "seeds": [5], "epochs": 2}]}
    )
    return kept.path


class OneLine(Exception):
    """A command ended with an error of one line, as it may."""


@functools.cache
def application() -> Any:
    """The command line, made once: to make it takes ten times as long as most commands do."""
    return get_command(build())


def call(*words: str) -> str:
    """Run a command as `qrlsuite` does, but for the last line of an error; what it prints."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            code = application().main(list(words), prog_name="qrlsuite", standalone_mode=False)
    except QrlSuiteError as error:
        if "\n" in str(error).strip():
            raise
        raise OneLine from error
    assert not code, printed.getvalue()
    return printed.getvalue()


def answers(entry: Path, runs: Path) -> None:
    """Run every command that reads results; fails on a traceback."""
    for words in (
        ["runs"],
        ["runs", "--json"],
        ["runs", "gc"],
        ["leaderboard"],
        ["leaderboard", "--format", "json"],
        ["show", entry.name],
    ):
        with contextlib.suppress(OneLine):
            call(*words, "--runs", str(runs))


def damaged(entry: Path, tmp_path: Path, file: str, content: bytes) -> None:
    runs = tmp_path / "runs"
    shutil.rmtree(runs, ignore_errors=True)
    copy = runs / entry.parent.name / entry.name
    shutil.copytree(entry, copy)
    (copy / file).write_bytes(content)
    answers(copy, runs)


def places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every path into a JSON value."""
    found = [at]
    if isinstance(value, dict):
        for key, inner in value.items():
            found += places(inner, (*at, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value[:3]):
            found += places(inner, (*at, index))
    return found


def replaced(value: Any, at: tuple[Any, ...], new: Any) -> Any:
    if not at:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[at[0]] = replaced(value[at[0]], at[1:], new)
    return copy


def test_what_is_undamaged_is_shown(entry: Path) -> None:
    assert "1 finished, 1 running, 1 submitted" in call("runs", "--runs", str(entry.parent.parent))
    answers(entry, entry.parent.parent)


@FEW
@given(file=st.sampled_from(FILES), data=st.data())
def test_damaged_bytes(entry: Path, tmp_path: Path, file: str, data: st.DataObject) -> None:
    original = (entry / file).read_bytes()
    start = data.draw(st.integers(0, len(original)))
    stop = data.draw(st.integers(start, len(original)))
    content = original[:start] + data.draw(st.binary(max_size=20)) + original[stop:]
    damaged(entry, tmp_path, file, content)


@FEW
@given(file=st.sampled_from([f for f in FILES if "json" in f]), data=st.data())
def test_json_that_means_something_else(entry: Path, tmp_path: Path, file: str, data: st.DataObject) -> None:
    lines = (
        (entry / file).read_bytes().splitlines() if file.endswith("jsonl") else [(entry / file).read_bytes()]
    )
    value = json.loads(lines[-1])
    at = data.draw(st.sampled_from(places(value)))
    changed = replaced(value, at, data.draw(values))
    damaged(entry, tmp_path, file, b"\n".join([*lines[:-1], json.dumps(changed).encode(), b""]))


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("content", [b"", b"[" * 100_000, b"{}", b"[]\n", b"\xff\xfe", b"1" * 5000])
def test_usual_damage(entry: Path, tmp_path: Path, file: str, content: bytes) -> None:
    damaged(entry, tmp_path, file, content)


@pytest.mark.parametrize(
    "rows",
    [
        [{"scores": [0.5]}],
        [{"epoch": "1", "scores": [0.5]}],
        [{"epoch": 1, "scores": "text"}],
        [{"epoch": 1, "scores": [0.5], "a": 1, "a.b": 2}],
        [{"epoch": 1, "scores": []}],
        [{"epoch": 2, "scores": [0.5]}],
    ],
)
def test_tables_of_something_else(entry: Path, tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    import pyarrow
    import pyarrow.parquet

    path = tmp_path / "t.parquet"
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), path)
    damaged(entry, tmp_path, "seed-0000/epochs.parquet", path.read_bytes())


@FEW
@example(data=None)
@given(data=st.one_of(st.none(), st.data()))
def test_task_files(tmp_path: Path, data: Any) -> None:
    path = tmp_path / "fuzz.toml"
    content = TINY.encode()
    if data is not None:
        start = data.draw(st.integers(0, len(content)))
        stop = data.draw(st.integers(start, min(len(content), start + 40)))
        content = (
            content[:start] + data.draw(st.one_of(st.binary(max_size=8), st.just(b"nan"))) + content[stop:]
        )
    path.write_bytes(content)
    with contextlib.suppress(QrlSuiteError):
        load(str(path))
        tomllib.loads(content.decode())
