"""One name is one thing: seeds of another code are neither continued nor ranked as the same entry."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from qrlsuite import registry, specs
from qrlsuite.engine import missing
from qrlsuite.engine.display import RunDisplay
from qrlsuite.engine.where import Where
from qrlsuite.errors import StoreError, UnknownNameError
from qrlsuite.experiment import identity, source
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.results import codes
from qrlsuite.results.claims import acquire
from qrlsuite.results.store import EntryStore, read_json, write_json
from tests.commands import qrlsuite, start_worker
from tests.conftest import TINY, Train, install, installed
from tests.leaderboard import boards

PLUGIN = """
from qrlsuite import hookimpl, specs

@hookimpl
def register_ansatzes(register):
    register(specs.AnsatzSpec("own", "a circuit", "own_circuit:Options", "own_circuit:build"))


@hookimpl
def register_models(register):
    register(specs.ModelSpec("line", "a layer", "classical", "own_model:Options", "own_model:build"))
"""
CIRCUIT = '''
"""A circuit."""
from pydantic.dataclasses import dataclass
from qrlsuite.circuit import Circuit

@dataclass(frozen=True)
class Options:
    """None."""

def build(qubits, layers, options):
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q))
            circuit.append("RY", q, weights[layer, q])
        circuit.append("CZ", (0, 1))
    return circuit
'''
MODEL = '''
from dataclasses import field
from pydantic.dataclasses import dataclass
from torch import nn
from own_helper import filled

@dataclass(frozen=True)
class Options:
    """None."""
    data: str = "none"

def build(obs_dim, out_dim, options, generator):
    layer = nn.utils.skip_init(nn.Linear, obs_dim, out_dim)
    return filled(layer, generator)
'''
HELPER = '''
import torch

def filled(layer, generator):
    """Fill it."""
    for parameter in layer.parameters():
        parameter.data = torch.rand(parameter.shape, generator=generator)
    return layer
'''
WORLD = """
import gymnasium, numpy
from own_rules import STEPS

class World(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), numpy.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = STEPS
        return numpy.zeros(2, numpy.float32), {}

    def step(self, action):
        self.left -= 1
        return self.np_random.uniform(-1, 1, 2).astype(numpy.float32), float(action), self.left == 0, False, {}

gymnasium.register("own/World-v0", "own_world:World")
"""
GYM = """
[environment]
name = "gym"
[environment.options]
id = "own_world:own/World-v0"
[score]
source = "return"
max_return = 6

"""
FILES = {"own_circuit": CIRCUIT, "own_model": MODEL, "own_helper": HELPER, "own_aside": "SIZE = 1\n"}


class Author:
    """A package of one's own in the making: its files are edited between commands."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.site, self.runs = folder, folder / "site", folder / "runs"
        self.task, self.edits = folder / "tiny.toml", 100
        if not self.site.exists():
            self.site.mkdir()
            install(self.site, "own", PLUGIN)
            self.edits = 0
            for name, text in FILES.items():
                self.write(name, text)
            self.task.write_text(TINY)

    def write(self, name: str, text: str) -> None:
        """Write a module; its time moves on, so that no compiled copy stands for it."""
        path = self.site / f"{name}.py"
        path.write_text(text)
        self.edits += 10
        os.utime(path, (1e9 + self.edits, 1e9 + self.edits))

    def edit(self, name: str, old: str, new: str) -> None:
        text = (self.site / f"{name}.py").read_text()
        assert old in text
        self.write(name, text.replace(old, new))

    def command(self, *words: str) -> subprocess.CompletedProcess[str]:
        return qrlsuite(*words, "--runs", str(self.runs), env=installed(self.site), cwd=self.folder)

    def run(self, *words: str, seeds: str = "2", model: str = "circuit") -> subprocess.CompletedProcess[str]:
        chosen = {
            "circuit": ("vqc-native", "--set", "ansatz=own", "--set", "qubits=2", "--set", "layers=1"),
            "line": ("line",),
        }[model]
        budget = ("--seeds", seeds, "--epochs", "1", "--workers", "1")
        return self.command("run", "--task", str(self.task), "--model", *chosen, *budget, *words)

    def entries(self) -> list[str]:
        return sorted(path.parent.name for path in self.runs.glob("*/*/entry.json"))

    def board(self) -> dict[str, int]:
        done = self.command("leaderboard", "--format", "json")
        assert done.returncode == 0, done.stderr
        (section,) = json.loads(done.stdout)["sections"]
        return {row["label"]: row["seeds"] for row in section["rows"]}


@pytest.fixture
def author(tmp_path: Path) -> Author:
    return Author(tmp_path)


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an author who has trained two seeds of model `line`."""
    made = Author(tmp_path_factory.mktemp("line"))
    assert made.run(model="line").returncode == 0
    return made.folder


@pytest.fixture
def trained(line: Path, tmp_path: Path) -> Author:
    """The same, in a copy."""
    return Author(Path(shutil.copytree(line, tmp_path / "line")))


def test_its_author_may_say_that_nothing_changed(trained: Author) -> None:
    trained.edit("own_helper", "filled(layer, generator):", "filled(layer, generator, more=None):")
    refused = trained.run(model="line", seeds="4")
    assert refused.returncode == 2
    assert "own_helper.py of own (model 'line') has changed" in refused.stderr
    assert trained.run("--same", " ", model="line").returncode == 2
    both = trained.run("--same", "no", "--fresh", model="line")
    assert both.returncode == 2
    assert "give one of them" in both.stderr
    assert trained.run("--same", "an argument that nobody gives", model="line", seeds="4").returncode == 0
    assert list(trained.board().values()) == [4]
    (name,) = trained.entries()
    (said,) = read_json(trained.runs / "tiny" / name / "entry.json")["same"]
    assert said["reason"] == "an argument that nobody gives"
    assert len(said["codes"]) == 2
    assert trained.run(model="line", seeds="5").returncode == 0  # it is said once


def test_docstrings_and_other_modules_do_not_count(trained: Author) -> None:
    trained.edit("own_helper", '"""Fill it."""', '"""Fill all of it."""  # at random')
    trained.edit("own_aside", "1", "2")
    trained.edit("own", "a circuit", "my circuit")
    assert trained.run(model="line", seeds="3").returncode == 0


def test_a_file_that_an_option_names_counts(author: Author) -> None:
    data = author.folder / "weights.bin"
    data.write_bytes(b"1")
    words = ("--set", f"data={data}")
    assert author.run(*words, model="line").returncode == 0
    data.write_bytes(b"2")
    refused = author.run(*words, model="line", seeds="3")
    assert refused.returncode == 2
    assert "the file 'model.data' has another content" in refused.stderr


def test_a_plugins_seeds_from_before_need_a_word(trained: Author) -> None:
    (name,) = trained.entries()
    store = EntryStore(trained.runs / "tiny" / name)
    for seed in store.seeds():
        edit_json(store.seed(seed).path / "run.json", code=None)
    refused = trained.run(model="line", seeds="3")
    assert refused.returncode == 2
    assert "before the code of plugins was recorded" in refused.stderr
    assert trained.run("--fresh", model="line").returncode == 0
    assert trained.entries() == sorted([name, f"{name}@00000000"])
    assert len(trained.board()) == 2


def test_a_worker_with_other_code_refuses(trained: Author) -> None:
    trained.edit("own_helper", "rand(", "randn(")
    (name,) = trained.entries()
    folder = trained.runs / "tiny" / name
    for seed in (0, 1):
        shutil.rmtree(folder / f"seed-{seed:04d}")
    worker = start_worker(str(folder), "--seeds", "0:2", "--epochs", "1", env=installed(trained.site))
    message = worker.communicate()[1]
    assert worker.returncode == 2
    assert "than the machine that started it" in message
    assert "own_helper.py of own (model 'line') has changed" in message


def test_an_export_carries_the_code_and_is_verified_with_it(trained: Author) -> None:
    assert trained.command("export", "line", "--out", "out").returncode == 0
    (path,) = (trained.folder / "out").glob("*/*/entry.json")
    assert [part["role"] for part in json.loads(path.read_text())["code"]["parts"]][-1] == "model"
    verify = ("verify", str(path.parent), "--rerun", "1")
    good = qrlsuite(*verify, env=installed(trained.site), cwd=trained.folder)
    assert good.returncode == 0, good.stdout + good.stderr
    trained.edit("own_helper", "rand(", "randn(")
    other = qrlsuite(*verify, env=installed(trained.site), cwd=trained.folder)
    assert other.returncode != 0
    assert "own_helper.py of own" in other.stdout + other.stderr


def test_other_code_neither_plays_nor_exports_nor_takes_over_what_was_trained(trained: Author) -> None:
    assert trained.command("export", "line", "--out", "out").returncode == 0
    trained.edit("own_helper", "rand(", "randn(")
    for words in (("evaluate", "line", "--best", "1", "--episodes", "4"), ("export", "line", "--out", "out")):
        refused = trained.command(*words)
        assert refused.returncode == 2
        assert "own_helper.py of own (model 'line') has changed" in refused.stderr
    before, trained.runs = trained.runs, trained.folder / "more"
    assert trained.run(model="line", seeds="2:4").returncode == 0
    for folder in (before, trained.folder / "out"):
        refused = trained.command("import", str(folder))
        assert "are not all of one code" in refused.stdout + refused.stderr
        assert "own_helper.py of own" in refused.stdout + refused.stderr
    assert list(trained.board().values()) == [2]


def test_a_results_folder_is_taken_over_with_the_seeds_that_fresh_put_aside(trained: Author) -> None:
    trained.edit("own_helper", "rand(", "randn(")
    assert trained.run("--fresh", model="line").returncode == 0
    before, trained.runs = trained.runs, trained.folder / "more"
    held = sorted(path.relative_to(before) for path in before.glob("*/*/seed-*/run.json"))
    assert len(held) == 4
    for _ in range(2):  # again, there is nothing new
        done = trained.command("import", str(before))
        assert done.returncode == 0, done.stdout + done.stderr
        found = [path.relative_to(trained.runs) for path in trained.runs.glob("*/*/seed-*/run.json")]
        assert sorted(found) == held
    assert list(trained.board().values()) == [2, 2]


STUDY = """
format_version = 1
name = "lines"
summary = "One layer"
[[entries]]
name = "line"
task = "tiny.toml"
model = "line"
[[pictures]]
name = "curves"
kind = "curves"
"""


def test_searches_studies_and_python_stop_as_well(author: Author) -> None:
    (author.folder / "lines.toml").write_text(STUDY)
    budget = ("--seeds", "1", "--epochs", "1", "--workers", "1")
    tune = ("tune", "line", "--task", str(author.task), "--vary", "lr=1e-2,1e-3", *budget)
    study = ("study", "run", "lines.toml", *budget)
    for words in (tune, study):
        assert (done := author.command(*words)).returncode == 0, done.stderr
    author.edit("own_helper", "rand(", "randn(")
    for words in (tune, study):
        refused = author.command(*words)
        assert refused.returncode == 2
        assert "own_helper.py of own (model 'line') has changed" in refused.stderr
        assert "Nothing was trained" in refused.stderr
    program = f"""if True:
        import qrlsuite
        words = dict(seeds=1, epochs=1, workers=1, runs={str(author.runs)!r}, progress=False)
        try:
            qrlsuite.train("tiny.toml", "line", **words)
        except qrlsuite.errors.StoreError as error:
            assert "has changed" in str(error)
        else:
            raise SystemExit("it goes on")
        print(qrlsuite.train("tiny.toml", "line", fresh=True, **words).seeds)
    """
    environment = installed(author.site)
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        capture_output=True,
        text=True,
        env=environment,
        cwd=author.folder,
        check=False,
    )
    assert done.stdout == "(0,)\n", done.stderr
    for words in (tune, study):
        assert (done := author.command(*words, "--fresh")).returncode == 0, done.stderr
    assert len(author.entries()) == 2
    assert len(list((author.runs / "tuning").glob("*/*@*/entry.json"))) == 2


def test_the_steps_to_the_identity_can_be_read(author: Author) -> None:
    assert author.run().returncode == 0
    (name,) = author.entries()
    content = json.loads(author.command("show", name, "--identity", "--json").stdout)
    circuit = content["circuit"]
    assert "RY 0 0.0+weights[0]" in circuit
    (part,) = [part for part in json.loads(content["text"]) if part["role"] == "ansatz"]
    assert part["circuit"] == hashlib.sha256(circuit.encode()).hexdigest()
    assert content["digest"] == hashlib.sha256(content["text"].encode()).hexdigest()[:16]
    assert content["seeds"] == {"0:2": [content["digest"]]}
    model = json.loads(author.command("show", "line", "--identity", "--json").stdout)
    assert set(model["files"]) == {"own_model.py", "own_helper.py"}
    text = (author.site / "own_helper.py").read_bytes()
    assert model["files"]["own_helper.py"] == hashlib.sha256(source.canonical(text)).hexdigest()


def test_an_environment_of_another_package_counts(author: Author) -> None:
    author.write("own_world", WORLD)
    author.write("own_rules", "STEPS = 5\n")
    author.task.write_text(TINY.replace(TINY[TINY.index("[environment]") : TINY.index("[protocol]")], GYM))
    assert author.run(model="line").returncode == 0, author.run(model="line").stderr
    author.edit("own_rules", "5", "6")
    refused = author.run(model="line", seeds="3")
    assert refused.returncode == 2
    assert "own_rules.py of unknown (environment 'own_world:own/World-v0') has changed" in refused.stderr


def edit_json(path: Path, **values: Any) -> None:
    kept = {**read_json(path), **values}
    write_json(path, {name: value for name, value in kept.items() if value is not None})


def with_numerics(monkeypatch: pytest.MonkeyPatch, kind: str, name: str, number: int) -> None:
    known = registry.load().entries[specs.kind(kind)]
    each = known[name]
    monkeypatch.setitem(known, name, replace(each, spec=replace(each.spec, numerics=number)))


def test_seeds_of_the_suites_own_parts_go_on_until_their_bits_change(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_numerics(monkeypatch, "models", "mlp", 1)
    folder = train("runs", range(2), epochs=1)
    record = read_json(folder / "seed-0000" / "run.json")
    assert record["provenance"][0]["numerics"] == {"environment": 1, "algorithm": 1, "model": 1}
    edit_json(folder / "seed-0000" / "run.json", code=None)  # as earlier versions left it
    train("runs", range(3), epochs=2)
    assert "code" not in read_json(folder / "seed-0000" / "run.json")
    assert [group.seeds for group in codes.of_seeds(EntryStore(folder))] == [(0, 1, 2)]

    with_numerics(monkeypatch, "algorithms", "ddqn", 2)
    with pytest.raises(StoreError, match="algorithm 'ddqn' has numerics 2, and had 1"):
        train("runs", range(4), epochs=2)
    only_old = EntryStore(folder)
    for seed in (1, 2):
        edit_json(only_old.seed(seed).path / "run.json", code=None)
    with pytest.raises(StoreError, match="algorithm 'ddqn' has numerics 2, and had 1"):
        train("runs", range(4), epochs=2)


def test_a_folder_of_two_codes_is_two_entries(kept: Train, tmp_path: Path) -> None:
    folder = kept("runs", range(4), epochs=1)
    store = EntryStore(folder)
    parts = read_json(folder / "seed-0000" / "run.json")["code"]["parts"]
    other = identity.CodeIdentity((*parts[:2], {**parts[2], "numerics": 3}))
    for seed in (1, 3):
        edit_json(store.seed(seed).path / "run.json", code=other.record())
    found, refused = collect.collect(collect.Selection(tmp_path / "runs"))
    first = read_json(folder / "seed-0000" / "run.json")["code"]["digest"]
    assert not refused
    assert {entry.label: entry.seeds for entry in found} == {
        f"ddqn mlp width=16 @{first[:8]}": (0, 2),
        f"ddqn mlp width=16 @{other.digest[:8]}": (1, 3),
    }
    with pytest.raises(
        UnknownNameError, match=f"write 'ddqn mlp width=16 @{first[:8]}', 'ddqn mlp width=16 @"
    ):
        collect.find(collect.Selection(tmp_path / "runs"), "mlp")
    assert collect.find(collect.Selection(tmp_path / "runs"), f"mlp width=16 @{other.digest[:4]}").seeds == (
        1,
        3,
    )
    assert collect.find(collect.Selection(tmp_path / "runs"), f"{folder}@{first[:8]}").seeds == (0, 2)
    with pytest.raises(StoreError, match="several entries"):
        collect.read(store)


def test_a_published_entry_of_other_code_is_another_entry(kept: Train, tmp_path: Path) -> None:
    folder = kept("runs", range(2), epochs=1)
    entry = collect.read(EntryStore(folder))
    assert entry is not None
    assert entry.codes == (identity.of(resolve("beam6g", "mlp width=16")).digest,)
    entry = boards.changed(entry, code=None)  # as an entry published before codes were recorded
    other = identity.CodeIdentity(({"role": "model", "name": "other", "distribution": "x"},))
    copies = [entry, boards.changed(entry, code=other), boards.changed(entry, published=True)]
    assert [[copy.label for copy in same] for same in collect.told_apart(copies)] == [
        ["ddqn mlp width=16 @00000000"] * 2,
        [f"ddqn mlp width=16 @{other.digest[:8]}"],
    ]


def test_seeds_are_set_aside_only_where_nobody_has_them(
    train: Train, tiny_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = train("runs", range(2), epochs=1)
    store, entry = EntryStore(folder), resolve(tiny_task, "mlp width=16")
    with_numerics(monkeypatch, "models", "mlp", 3)
    now, runs = identity.of(entry), tmp_path / "runs"
    claim = acquire(store, [0])
    with pytest.raises(StoreError, match="are being trained by process"):
        codes.set_aside(runs, store, now)
    claim.release()
    edit_json(folder / "entry.json", plan="1a2b3c4d5e6f7a8b")
    with pytest.raises(StoreError, match="write another study"):
        codes.set_aside(runs, store, now)
    with pytest.raises(StoreError, match="Restore that code, or write another study"):
        codes.require(store, now)
    edit_json(folder / "entry.json", plan=None)
    submitted = store.path / "slurm" / "submitted.json"
    write_json(submitted, {"tasks": [{"job": "7", "seeds": [2], "epochs": 1}]})
    with pytest.raises(StoreError, match="waits in a queue"):
        codes.set_aside(runs, store, now, {2})
    submitted.unlink()
    mark = codes.of_seeds(store)[0].mark
    taken = folder.with_name(f"{folder.name}@{mark}")
    taken.mkdir()
    with pytest.raises(StoreError, match="is there already"):
        codes.set_aside(runs, store, now)
    taken.rmdir()
    assert codes.set_aside(runs, store, now) == (taken, None)
    assert codes.set_aside(runs, store, now) == (None, None)
    assert EntryStore(taken).seeds() == [0, 1]


def test_what_somebody_trains_is_not_begun_with_other_code(
    tiny_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry, runs = resolve(tiny_task, "mlp width=16"), tmp_path / "runs"
    store = EntryStore.create(runs, entry)
    codes.prepare(store, identity.of(entry))
    claim = acquire(store, [0])  # of a seed that is being built, and has no record yet
    with_numerics(monkeypatch, "models", "mlp", 3)
    here = Where.create(workers=1)
    work = missing.find(runs, entry, here, [0, 1], 1)
    with pytest.raises(
        StoreError, match="than the machine that started it: model 'mlp' has numerics 3, and had 2"
    ):
        missing.train(work, here, RunDisplay(work, 1, quiet=True))
    claim.release()
    assert not store.seeds()


def test_all_entries_are_looked_at_before_one_is_trained(
    train: Train,
    tiny_task: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    train("runs", range(2), epochs=1)
    with_numerics(monkeypatch, "models", "mlp", 3)
    entries = [resolve(tiny_task, "mlp width=8"), resolve(tiny_task, "mlp width=16")]
    with pytest.raises(StoreError, match="model 'mlp' has numerics 3, and had 2"):
        missing.require_same_code(tmp_path / "runs", entries, Where.create())
    missing.require_same_code(tmp_path / "runs", entries, replace(Where.create(), fresh=True))
    assert capsys.readouterr().err.count("the seeds of another code are now in") == 1


@pytest.mark.parametrize(
    "code",
    [{}, "text", {"digest": "0", "parts": []}, {"digest": "0" * 16, "parts": [{"role": 1, "name": "x"}]}],
)
def test_a_damaged_identity_is_named(kept: Train, tmp_path: Path, code: Any) -> None:
    folder = kept("runs", range(2), epochs=1)
    edit_json(folder / "seed-0001" / "run.json", code=code)
    assert [group.seeds for group in codes.of_seeds(EntryStore(folder))] == [(0,)]
    _, (line,) = collect.collect(collect.Selection(tmp_path / "runs"))
    assert re.match(r"seed 1: .*seed-0001/run\.json is not a run's record: .*code", line)


SAMPLE = b'''"""Of every kind of syntax that versions of Python have changed, or might."""
from __future__ import annotations
from . import x
from ..z import *
def f(a, /, b=1, *c, d=2, **e) -> int:
    """Left out."""
    return f"a{a}" "b" f"{b!r:>{c}} {d=} {e = :.3f}" f"" f"{g:}" f"{{}}"
class K(Base, metaclass=M):
    \'left out\'
    x: int = -1_000
    async def g(self):
        return [k async for k in await l if k]
    def only(self):
        """Left out."""
match x:
    case {"a": 1, **rest} if q: pass
    case [1, *_] | K(a=3) | None | 2+3j: ...
try:
    pass
except* ValueError as e:
    raise X from e
s = u"\xc3\xa9\\u0378" if 0 else "\\ud800"
n = 10**3 + 0xFFFFFFFFFFFFFFFFFFFFFFFFFFFFF + 1e999 + .1 + 1j
d = {**a, "k": 1, None: ..., w: (y := 3), True: x[1:2, ::3]}
'''
GOLDEN = "99bd9bd594424c699a56b192791693d83450f28fdc609f5b031def858f025be1"
READ = (
    "import sys, importlib.util as u; s = u.spec_from_file_location('source', sys.argv[1]); "
    "m = u.module_from_spec(s); s.loader.exec_module(m); "
    "sys.stdout.buffer.write(m.canonical(sys.stdin.buffer.read()))"
)


def test_every_python_reads_the_same_tree() -> None:
    """The walk needs the standard library only, so that interpreters without the suite can be asked."""
    assert hashlib.sha256(source.canonical(SAMPLE)).hexdigest() == GOLDEN
    for python in filter(None, (shutil.which(f"python3.{minor}") for minor in (11, 12, 13, 14))):
        words = [python, "-I", "-c", READ, source.__file__]
        done = subprocess.run(words, input=SAMPLE, capture_output=True, check=False)
        if done.returncode != 127:  # a shim of a version that is not in use
            assert hashlib.sha256(done.stdout).hexdigest() == GOLDEN, done.stderr


@pytest.mark.parametrize(
    ("before", "after", "alike"),
    [
        ("x = 1  # one\n", "x = (\n    1\n)", True),
        ("def f():\n    'Text.'\n    return 1", "def f(): return 1", True),
        ("s = 'a' 'b'", 's = "ab"', True),
        ("x = 1", "x = 1.0", False),
        ("x = 1", "x = True", False),
        ("x = a + b", "x = b + a", False),
        ("x = 'a'", "x = b'a'", False),
        ("'text'\nx = 1", "x = 1", True),
        ("x = 0.1", "x = 0.10000000000000002", False),
        ("f(a)", "f(*a)", False),
        ("a = [b, c]", "a = [b]; c", False),
    ],
)
def test_a_tree_says_what_code_does_and_no_more(before: str, after: str, alike: bool) -> None:
    assert (source.canonical(before.encode()) == source.canonical(after.encode())) == alike


def test_only_a_distributions_own_imports_are_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "acme_reach" / "deep"
    package.mkdir(parents=True)
    (tmp_path / "acme_reach" / "__init__.py").write_text("import acme_reach.never\nTHING = 1\n")
    for name, text in {
        "one": "from . import two\nfrom .deep.three import f\nimport numpy, acme_other\n",
        "two": "def late():\n    import acme_reach.four\n",
        "four": "",
        "never": "",
        "deep/__init__": "",
        "deep/three": "from ..one import *\n",
    }.items():
        (tmp_path / "acme_reach" / f"{name}.py").write_text(text)
    (tmp_path / "acme_other.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)

    def reached(name: str) -> set[str]:
        return set(source.reached([f"acme_reach.{name}"], lambda top, _: top == "acme_reach"))

    assert reached("one") == {f"acme_reach/{n}.py" for n in ("one", "two", "four", "deep/three")}
    (tmp_path / "acme_reach" / "four.py").write_text("from acme_reach import THING\n")
    assert {"acme_reach/__init__.py", "acme_reach/never.py"} < reached("one")
    assert "acme_reach.one" not in sys.modules
    assert "acme_reach" not in sys.modules
