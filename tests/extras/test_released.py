"""Released result files: read through a closed table in a limited process, shown with a mark, never trained further."""

from __future__ import annotations

import argparse
import ast
import collections
import importlib
import json
import os
import pickle
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from qrlsuite import registry
from qrlsuite.cli.app import build
from qrlsuite.errors import StoreError
from qrlsuite.experiment.task import load
from qrlsuite.leaderboard.collect import collect
from qrlsuite.results.claims import acquire
from qrlsuite.results.store import EntryStore, entries, learning_curve
from qrlsuite_released import entries as imports
from qrlsuite_released import unpickle as released
from qrlsuite_released.entries import import_files

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "extras" / "qrlsuite-released"


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plugin is loaded from its folder, by the entry point that its `pyproject.toml` declares."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    (module,) = project["entry-points"]["qrlsuite"].values()
    known = registry.create(strict=True)
    known.add_plugin(importlib.import_module(module), project["name"])
    monkeypatch.setattr(registry, "load", lambda: known)


def content(seed: int = 0, epochs: int = 6, **replaced: Any) -> dict[str, Any]:
    """What the paper's scripts wrote at the end of a run."""
    torch.manual_seed(seed)
    model = torch.nn.Sequential(
        collections.OrderedDict(inner=torch.nn.Linear(3, 4), vqc=torch.nn.Linear(4, 3))
    )
    optim = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 3)).sum().backward()
    optim.step()
    rng = np.random.default_rng(seed)
    return {
        "val_returns": rng.random((epochs + 1, 100)),
        "train_returns": rng.random(epochs),
        "env_configuration": {"antennas": [[1.5, 1.0]], "codebook": np.arange(9), "ids": {1, 2}},
        "args": argparse.Namespace(lr=5e-4, seed=seed, model="hybrid", layers=[1, 2], cuda=False),
        "model": model.state_dict(),
        "optim": optim.state_dict(),
        "timings": {"train": [np.float64(1.5)] * epochs},
        **replaced,
    }


def write(path: Path, value: Any, protocol: int = 4) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_every_pickle_protocol_is_read(protocol: int, tmp_path: Path) -> None:
    given = content()
    read = released.read(write(tmp_path / "a.pkl", given, protocol))
    assert (read.returns == given["val_returns"][1:]).all(), "the row before training is dropped"
    assert read.train_returns is not None
    assert (read.train_returns == given["train_returns"]).all()
    assert read.arguments == {"lr": 5e-4, "seed": 0, "model": "hybrid", "cuda": False}
    assert dict(read.shapes) == {
        "inner.weight": (4, 3),
        "inner.bias": (4,),
        "vqc.weight": (3, 4),
        "vqc.bias": (3,),
    }


class Calls:
    """Pickles to a call of something."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (os.system, "posix.system"),
        (eval, "builtins.eval"),
        (__import__, "builtins.__import__"),
        (open, "io.open"),
    ],
)
def test_a_malicious_pickle_is_refused_and_nothing_is_run(
    function: Callable[..., Any], name: str, tmp_path: Path
) -> None:
    mark = tmp_path / "mark"
    argument = {"posix.system": f"touch {mark}", "builtins.eval": f"open({str(mark)!r}, 'w')"}.get(
        name, str(mark)
    )
    extra = (argument, "w") if name == "io.open" else (argument,)
    bad = write(tmp_path / "bad.pkl", content(optim=Calls(function, *extra)))
    with pytest.raises(StoreError, match=rf"asks for '{name}'.*refused, nothing was run"):
        released.read(bad)
    assert not mark.exists()
    result = CliRunner().invoke(
        build(), ["import-released", str(bad), "--task", "beam6g", "--runs", str(tmp_path / "runs")]
    )
    assert isinstance(result.exception, StoreError)
    assert not (tmp_path / "runs").exists(), "a refused file leaves nothing behind"
    pickle.loads(bad.read_bytes()) if name == "posix.system" else None
    assert mark.exists() or name != "posix.system", "the file of this test is harmless: it proves nothing"


def test_names_with_dots_reach_nothing(tmp_path: Path) -> None:
    bad = tmp_path / "dotted.pkl"
    bad.write_bytes(b"\x80\x04\x8c\x05numpy\x8c\x0bctypeslib.x\x93.")
    with pytest.raises(StoreError, match=r"asks for 'numpy\.ctypeslib\.x'"):
        released.read(bad)


def test_too_much_memory_is_refused(tmp_path: Path) -> None:
    bad = write(tmp_path / "big.pkl", {"val_returns": Calls(bytearray, 1 << 40)})
    with pytest.raises(StoreError, match="needs more than 2 GB of memory: refused"):
        released.read(bad)


def test_too_much_time_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill = b"\x80\x04\x8c\x08builtins\x8c\x09bytearray\x93"  # 500 MB filled and dropped, again and again
    slow = fill + b"2J\x00\x65\xcd\x1d\x85R0" * 200 + b"0N."
    (tmp_path / "slow.pkl").write_bytes(slow)
    program = tmp_path / "limited.py"
    program.write_text(
        f"import sys; sys.path.insert(0, {str(PACKAGE / 'src')!r}); from qrlsuite_released import unpickle as r; "
        "r.SECONDS = 1; sys.exit(r.main())"
    )
    run = released.subprocess.run

    def limited(command: list[str], **options: Any) -> Any:
        return run([command[0], str(program), command[-1]], **options)

    monkeypatch.setattr(released.subprocess, "run", limited)
    with pytest.raises(StoreError, match="needs more than 60 seconds"):
        released.read(tmp_path / "slow.pkl")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1, 2], "does not hold a dictionary"),
        ({"a": 1, "b": 2}, r"has no 'val_returns'.*it has a, b"),
        ({"val_returns": [1, 2]}, r"shape \(2,\), not \(epochs \+ 1, validation episodes\)"),
        ({"val_returns": np.full((3, 2), np.nan)}, "not finite"),
        ({"val_returns": ["x"]}, "not an array of numbers"),
    ],
)
def test_other_content_is_named(value: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=message):
        released.read(write(tmp_path / "other.pkl", value))


@pytest.mark.parametrize("data", [b"", b"hello", b"\x80\x04", None], ids=["empty", "text", "start", "cut"])
def test_what_is_no_pickle_is_named(data: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "no.pkl"
    path.write_bytes(pickle.dumps(content())[:-100] if data is None else data)
    with pytest.raises(StoreError, match="not a readable pickle"):
        released.read(path)


def test_import_shows_on_the_leaderboard_with_a_mark_and_can_be_repeated(
    tiny_task: str, tmp_path: Path
) -> None:
    files = [write(tmp_path / "hybrid" / f"{seed}.pkl", content(seed)) for seed in range(3)]
    words = [
        "import-released",
        *map(str, files),
        "--task",
        tiny_task,
        "--quantum",
        "vqc.*",
        "--runs",
        str(tmp_path / "runs"),
    ]
    first = CliRunner().invoke(build(), [*words, "--json"])
    assert json.loads(first.output)["seeds"] == [0, 1, 2]
    again = CliRunner().invoke(build(), words)
    assert "3 of 3 files were imported before" in again.output

    (found,), refused = collect(tmp_path / "runs")
    assert refused == []
    assert found.label == "ddqn hybrid (imported)"
    assert found.parameters == (16, 15)
    expected = learning_curve(np.float32(content(1)["val_returns"][1:]))
    assert (found.curves[1] == expected).all()
    (store,) = entries(tmp_path / "runs")
    record = store.seed(1).record() or {}
    assert record["imported"]["file"] == "1.pkl"
    assert record["imported"]["arguments"]["lr"] == 5e-4
    with pytest.raises(StoreError, match="was imported from other files"):
        store.entry()
    listed = CliRunner().invoke(build(), ["runs", "--runs", str(tmp_path / "runs")])
    assert "ddqn hybrid (imported)  3 finished  6" in listed.output


def test_returns_that_are_no_scores_are_refused(tiny_task: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.pkl", content(val_returns=np.full((3, 2), 140.0)))
    with pytest.raises(StoreError, match=r"lie between 140 and 140.*not of this task"):
        import_files([path], load(tiny_task), "ddqn", "x", tmp_path / "runs")


def test_runs_that_differ_are_pointed_out(tiny_task: str, tmp_path: Path) -> None:
    files = [
        write(tmp_path / f"{lr}.pkl", content(seed, args=argparse.Namespace(lr=lr, seed=seed)))
        for seed, lr in enumerate((0.1, 0.2))
    ]
    done = import_files(files, load(tiny_task), "ddqn", "x", tmp_path / "runs")
    assert done.differing == ("lr",)
    assert EntryStore(done.store.path).seeds() == [0, 1]


def test_a_pattern_that_matches_no_tensor(tiny_task: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.pkl", content())
    with pytest.raises(StoreError, match=r"no tensor of its model matches 'q\*'; it has inner.weight"):
        import_files([path], load(tiny_task), "ddqn", "x", tmp_path / "runs", quantum="q*")


UNPICKLERS = {
    "pickle",
    "_pickle",
    "cPickle",
    "cloudpickle",
    "dill",
    "joblib",
    "shelve",
    "marshal",
    "jsonpickle",
}


def test_nothing_else_reads_pickles() -> None:
    """Static: no unpickler is imported outside the fence, and no library is asked to unpickle."""
    fence = PACKAGE / "src" / "qrlsuite_released" / "unpickle.py"
    read = 0
    for folder in ("qrlsuite", "plugins", "leaderboard", "tasks", "extras"):
        for path in (ROOT / folder).rglob("*.py"):
            read += 1
            for node in ast.walk(ast.parse(path.read_text())):
                names: set[str] = set()
                if isinstance(node, ast.Import):
                    names = {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom):
                    names = {(node.module or "").partition(".")[0]}
                elif isinstance(node, ast.keyword):
                    assert node.arg != "allow_pickle" or not getattr(node.value, "value", True), path
                    assert node.arg != "weights_only", path
                elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                    assert (node.value.id, node.attr) != ("torch", "load"), path
                assert path == fence or not names & UNPICKLERS, f"{path} imports {names & UNPICKLERS}"
    assert read > 50


def test_an_import_in_between_is_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another import begins and ends right before this one claims its seeds."""
    task, runs = load("beam6g"), tmp_path / "runs"
    first, second = (write(tmp_path / f"{seed}.pkl", content(seed)) for seed in (1, 2))
    acquire, begun = imports.acquire, []

    def late(*given: Any) -> Any:
        if not begun:
            begun.append(True)
            import_files([second], task, "ddqn", "theirs", runs)
        return acquire(*given)

    monkeypatch.setattr(imports, "acquire", late)
    done = import_files([first], task, "ddqn", "theirs", runs)
    assert done.new == (1,)
    files = [(done.store.seed(seed).record() or {})["imported"]["file"] for seed in done.store.seeds()]
    assert files == ["2.pkl", "1.pkl"]


def test_an_import_waits_for_no_other(tmp_path: Path) -> None:
    task, runs = load("beam6g"), tmp_path / "runs"
    files = [write(tmp_path / f"{seed}.pkl", content(seed)) for seed in (1, 2)]
    store = import_files(files[:1], task, "ddqn", "theirs", runs).store
    claim = acquire(store, [0])
    try:
        with pytest.raises(StoreError, match=r"another import into .* is going on: repeat this command"):
            import_files(files[1:], task, "ddqn", "theirs", runs)
    finally:
        claim.release()
    assert store.seeds() == [0]
    assert import_files(files, task, "ddqn", "theirs", runs).new == (1,)
