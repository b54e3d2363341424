"""Released result files: listed and not run, in a limited process; shown with a mark, never trained further."""

from __future__ import annotations

import argparse
import ast
import collections
import importlib
import json
import os
import pickle
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from qrlsuite import registry
from qrlsuite.errors import StoreError
from qrlsuite.experiment.task import load
from qrlsuite.leaderboard.shelf.collect import Selection, collect
from qrlsuite.results.claims import acquire
from qrlsuite.results.store import EntryStore, entries, learning_curve
from qrlsuite_released import entries as imports
from qrlsuite_released import unpickle as released
from qrlsuite_released.entries import import_files
from tests.commands import say

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
    shapes = {"inner.weight": (4, 3), "inner.bias": (4,), "vqc.weight": (3, 4), "vqc.bias": (3,)}
    assert dict(read.shapes) == shapes


class Calls:
    """Pickles to a call of something."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize(
    ("function", "name", "arguments"),
    [
        (os.system, "posix.system", ("touch {}",)),
        (eval, "builtins.eval", ("open('{}', 'w')",)),
        (__import__, "builtins.__import__", ("{}",)),
        (open, "io.open", ("{}", "w")),
    ],
)
def test_a_malicious_pickle_is_refused_and_nothing_is_run(
    function: Callable[..., Any], name: str, arguments: tuple[str, ...], tmp_path: Path
) -> None:
    mark = tmp_path / "mark"
    called = Calls(function, *(word.format(mark) for word in arguments))
    bad = write(tmp_path / "bad.pkl", content(optim=called))
    with pytest.raises(StoreError, match=rf"asks for '{name}'.*refused, nothing was run"):
        released.read(bad)
    assert not mark.exists()
    with pytest.raises(StoreError):
        say("import-released", str(bad), "--task", "beam6g", "--runs", str(tmp_path / "runs"))
    assert not (tmp_path / "runs").exists(), "a refused file leaves nothing behind"
    pickle.loads(bad.read_bytes()) if name == "posix.system" else None
    assert mark.exists() or name != "posix.system", "the file of this test is harmless: it proves nothing"


def test_names_with_dots_reach_nothing(tmp_path: Path) -> None:
    bad = tmp_path / "dotted.pkl"
    bad.write_bytes(b"\x80\x04\x8c\x05numpy\x8c\x0bctypeslib.x\x93.")
    with pytest.raises(StoreError, match=r"asks for 'numpy\.ctypeslib\.x'"):
        released.read(bad)


def limited(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, change: str) -> None:
    """Read files under other limits."""
    program = tmp_path / "limited.py"
    program.write_text(
        f"import sys; sys.path.insert(0, {str(PACKAGE / 'src')!r}); from qrlsuite_released import unpickle as r; "
        f"{change}; sys.exit(r.main())"
    )
    run = released.subprocess.run

    def other(command: list[str], **options: Any) -> Any:
        return run([command[0], str(program), command[-1]], **options)

    monkeypatch.setattr(released.subprocess, "run", other)


def test_too_much_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = "int(open('/proc/self/statm').read().split()[0]) * 4096"
    limited(monkeypatch, tmp_path, f"r.MEMORY = {here} + (64 << 20)")
    (tmp_path / "large.pkl").write_bytes(b"\x80\x04(" + b"]" * 2_000_000 + b"l.")
    with pytest.raises(StoreError, match="of memory: refused"):
        released.read(tmp_path / "large.pkl")


def test_too_much_time_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, tmp_path, "r.SECONDS = 1")
    (tmp_path / "slow.pkl").write_bytes(b"\x80\x04" + b"N0" * 6_000_000 + b"N.")
    with pytest.raises(StoreError, match="needs more than 60 seconds"):
        released.read(tmp_path / "slow.pkl")


def short(text: str) -> bytes:
    return b"\x8c" + bytes([len(text)]) + text.encode()


def name(module: str, attribute: str) -> bytes:
    return short(module) + short(attribute) + b"\x93"


def dtype(code: str, order: str = "<") -> bytes:
    state = b"(K\x03" + short(order) + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00t"
    return name("numpy", "dtype") + short(code) + b"\x89\x88\x87R" + state + b"b"


def array(shape: bytes, kind: bytes, data: bytes) -> bytes:
    """An array as protocol 4 writes it."""
    begun = name("numpy._core.multiarray", "_reconstruct") + NDARRAY + b"K\x00\x85C\x01b\x87R"
    return begun + b"(K\x01" + shape + kind + b"\x89" + data + b"tb"


def holding(value: bytes, key: str = "val_returns") -> bytes:
    """A file that holds a good array of returns and, under a key, a value."""
    good = array(b"K\x02K\x02\x86", dtype("f8"), b"C\x20" + bytes(32))
    return b"\x80\x04}(" + short("val_returns") + good + short(key) + value + b"u."


def large(count: int) -> bytes:
    return b"\x8a\x08" + count.to_bytes(8, "little", signed=True)


DEEP = 200_000
NDARRAY = name("numpy", "ndarray")
HOSTILE = {
    # arrays without numbers in them: the first two ended the process that read them, the third told addresses
    "objects from bytes": NDARRAY + b"K\x01\x85" + short("O") + name("builtins", "bytearray") + b"K\x08\x85R\x87R",
    "objects from a buffer": name("numpy._core.numeric", "_frombuffer")
    + b"(C\x08AAAAAAAA" + dtype("O8", "|") + b"K\x01\x85" + short("C") + b"tR",
    "addresses of objects": NDARRAY
    + b"K\x02\x85"
    + short("u8")
    + array(b"K\x02\x85", dtype("O8", "|"), b"](NNe")
    + b"\x87R",
    "objects in an array's state": array(b"K\x01\x85", dtype("O8", "|"), b"C\x08AAAAAAAA"),
    "a list as an array's bytes": array(b"K\x02K\x02\x86", dtype("f8"), b"](NNNNe"),
    "fields": array(b"K\x01\x85", dtype("V8", "|"), b"C\x08AAAAAAAA"),
    "text as numbers": array(b"K\x01\x85", dtype("U2"), b"C\x08AAAAAAAA"),
    "a type by its name": array(b"K\x01\x85", dtype("object"), b"C\x08AAAAAAAA"),
    "a type of two letters": array(b"K\x01\x85", dtype("f8,O"), b"C\x08AAAAAAAA"),
    "another order of bytes": array(b"K\x01\x85", dtype("f8", "O"), b"C\x08AAAAAAAA"),
    # shapes that are not those of their bytes
    "a shape beyond the bytes": array(b"K\xffK\xff\x86", dtype("f8"), b"C\x08AAAAAAAA"),
    "a negative shape": array(b"J\xff\xff\xff\xffJ\xff\xff\xff\xff\x86", dtype("f8"), b"C\x08AAAAAAAA"),
    "a shape that overflows": array(large(1 << 62) + b"K\x04\x86", dtype("f8"), b"C\x00"),
    "a shape of text": array(short("x") + b"\x85", dtype("f8"), b"C\x08AAAAAAAA"),
    "a number of many bytes": name("numpy._core.multiarray", "scalar") + dtype("f8") + b"C\x10" + bytes(16) + b"\x86R",
    "too many bytes": array(b"K\x01\x85", dtype("f8"), b"\x8e" + (1 << 62).to_bytes(8, "little")),
    # what a call or a state would change
    "a state of a class": name("argparse", "Namespace") + b"}" + short("x") + b"K\x01sb",
    "a state of a function": name("_codecs", "encode") + b"}" + short("__globals__") + b"}sb",
    "a state of a list": b"]}" + short("x") + b"K\x01sb",
    "a call of a result": name("argparse", "Namespace") + b")R)R",
    "a call of text": short("os.system") + short("id") + b"\x85R",
    "a class of its own": b"(" + b"cposix\nsystem\n" + short("id") + b"o",
    "an instance": b"(iposix\nsystem\n",
    "an extension": b"\x82\x01",
    "what the reader is to fetch": short("x") + b"Q",
    "a buffer from elsewhere": b"\x97",
    "a name in a name": name("numpy", "ndarray.__class__"),
    "a name of a number": b"K\x01K\x02\x93",
    "an attribute of a dictionary": name("builtins", "getattr"),
    # what is endless
    "a list in itself": b"]\x94h\x00a",
    "lists in lists": b"]" * DEEP + b"a" * (DEEP - 1),
    "tuples in tuples": b")" + b"\x85" * DEEP,
    "a key of tuples in tuples": b"})" + b"\x85" * DEEP + b"Ns",
    "a list of a list of a list twice, forty times": b"]\x94" + b"".join(
        b"]\x94(h" + bytes([i, ord("h"), i]) + b"e" for i in range(40)
    ),
    "a long row again and again": b"](K\x00\x94" + b"h\x00" * 100_000 + b"e\x94](" + b"h\x01" * 100_000 + b"e",
    "a long number": b"\x8b" + (100_000).to_bytes(4, "little") + b"\x7f" * 100_000,
    "a key that is a list": b"}]Ns",
    "a place that nothing was put in": b"h\x63",
    "nothing to take": b"000000000",
    "a mark that is not there": b"0000t",
    "pairs without a half": b"}(Nu",
}  # fmt: skip


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What becomes of each hostile file, in one process with the limits of any file."""
    files = tmp_path_factory.mktemp("hostile") / "files.json"
    files.write_text(json.dumps({case: holding(value).hex() for case, value in HOSTILE.items()}))
    program = (
        f"import json, sys; sys.path.insert(0, {str(PACKAGE / 'src')!r}); "
        "from qrlsuite_released import unpickle as r; r.LARGEST = 10**6; "
        "files = json.load(open(sys.argv[1])); r._limit(); "
        "print(json.dumps({case: r.answer(bytes.fromhex(value)) for case, value in files.items()}))"
    )
    words = [sys.executable, "-P", "-c", program, str(files)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, ""), "the process that read them has ended"
    answers: dict[str, Any] = json.loads(done.stdout)
    return answers


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_file_is_refused_and_nothing_ends(case: str, answers: dict[str, Any]) -> None:
    assert set(answers[case]) == {"refused"}


def test_what_is_not_asked_for_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same values beside good returns: most are refused, what is plain data is left where it is."""
    monkeypatch.setattr(released, "LARGEST", 10**6)
    answers = {case: released.answer(holding(value, "else")) for case, value in HOSTILE.items()}
    good = {case for case, answer in answers.items() if "refused" not in answer}
    assert "lists in lists" in good
    assert not good & {"a call of text", "a state of a class", "an instance", "a name in a name"}
    assert released.answer(holding(b"N", "else"))["returns"] == [[0.0, 0.0]]


def test_reading_looks_nothing_up() -> None:
    """No name of a file is ever an attribute, a module or a function here."""
    tree = ast.parse(Path(released.__file__).read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    called = [getattr(call.func, "id", "") for call in calls]
    assert not {*called} & {"eval", "exec", "__import__", "setattr", "globals", "vars"}
    assert called.count("getattr") == 1
    looked_up = ast.unparse(calls[called.index("getattr")])
    assert looked_up == "getattr(self, f'_{name.lower()}', None)", "the instruction's own name"


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
    words = ["import-released", *map(str, files), "--task", tiny_task, "--quantum", "vqc.*"]
    words += ["--runs", str(tmp_path / "runs")]
    first = say(*words, "--json")
    assert json.loads(first.output)["seeds"] == [0, 1, 2]
    again = say(*words)
    assert "3 of 3 files were imported before" in again.output

    (found,), refused = collect(Selection(tmp_path / "runs"))
    assert refused == []
    assert found.label == "ddqn hybrid (imported)"
    assert found.parameters == (16, 15)
    expected = learning_curve(np.float32(content(1)["val_returns"][1:]))
    assert (found.curves[1] == expected).all()
    (store,) = entries(tmp_path / "runs")
    record = store.seed(1).record()
    assert record is not None
    assert record.imported["file"] == "1.pkl"
    assert record.imported["arguments"]["lr"] == 5e-4
    with pytest.raises(StoreError, match="holds curves that another program made"):
        store.entry()
    listed = say("runs", "--runs", str(tmp_path / "runs"))
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
    "pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "jsonpickle",
}  # fmt: skip


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
    files = [done.store.seed(seed).record().imported["file"] for seed in done.store.seeds()]
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
