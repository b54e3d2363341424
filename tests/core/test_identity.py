"""Code is part of an entry's name: seeds of another code are neither continued nor ranked as the same entry."""

from __future__ import annotations

import ast
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
from qrlsuite.engine.where import Where
from qrlsuite.errors import StoreError
from qrlsuite.experiment import identity, source
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.results import codes
from qrlsuite.results.claims import acquire
from qrlsuite.results.records import SameCodeRecord
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

    def board(self, *words: str) -> dict[str, int]:
        done = self.command("leaderboard", "--format", "json", *words)
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
    unchanged = trained.run("--same", "nothing was edited", model="line")
    assert "--same changes nothing: there are no seeds of another code here" in unchanged.stderr
    trained.edit("own_helper", "filled(layer, generator):", "filled(layer, generator, more=None):")
    assert trained.run("--same", " ", model="line").returncode == 2
    joined = trained.run("--same", "an argument that nobody gives", model="line", seeds="4")
    assert joined.returncode == 0
    assert "changes nothing" not in joined.stderr
    assert list(trained.board().values()) == [4]
    (name,) = trained.entries()
    (said,) = read_json(trained.runs / "tiny" / name / "entry.json")["same"]
    assert said["reason"] == "an argument that nobody gives"
    assert len(said["codes"]) == 2
    assert trained.run(model="line", seeds="5").returncode == 0  # it is said once
    assert list(trained.board().values()) == [5]


def test_nothing_is_the_same_whose_checkpoint_does_not_load(trained: Author) -> None:
    trained.edit(
        "own_model", "return filled(layer, generator)", "return nn.Sequential(filled(layer, generator))"
    )
    refused = trained.run("--same", "a name", model="line", seeds="3")
    assert refused.returncode == 2
    assert "loading the checkpoint of seed 0 fails: the checkpoint does not fit: " in refused.stderr
    (name,) = trained.entries()
    assert "same" not in read_json(trained.runs / "tiny" / name / "entry.json")
    anew = trained.run(model="line", seeds="3")
    assert anew.returncode == 0
    (mark,) = {entry.removeprefix(name) for entry in trained.entries()} - {""}
    assert f"{Path('runs', 'tiny', name)} has seeds 0:2 of another code: own_model.py of own" in anew.stderr
    assert f' {mark}\'; --same "REASON" continues the old seeds' in anew.stderr
    assert "another code" not in trained.run(model="line", seeds="3").stderr, "it is said once"
    [(label, seeds)] = trained.board().items()
    assert (label.endswith(f" {mark}"), seeds) == (True, 3)
    assert list(trained.board("--all-codes").values()) == [2, 3]
    assert f"left out: 1 entry of other code than '{label}'" in trained.command("leaderboard").stderr
    trained.edit(
        "own_model", "return nn.Sequential(filled(layer, generator))", "return filled(layer, generator)"
    )
    assert trained.run(model="line", seeds="4").returncode == 0
    assert trained.board() == {label.removesuffix(f" {mark}"): 4}, "the newest code has the newest epoch"
    assert len(trained.entries()) == 2


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
    assert "the file 'model.data' has another content" in author.run(*words, model="line", seeds="3").stderr
    assert len(author.entries()) == 2


def test_a_plugins_seeds_from_before_need_a_word(trained: Author) -> None:
    (name,) = trained.entries()
    store = EntryStore(trained.runs / "tiny" / name)
    for seed in store.seeds():
        edit_json(store.seed(seed).path / "run.json", code=None)
    assert "before the code of plugins was recorded" in trained.run(model="line", seeds="3").stderr
    assert list(trained.board("--all-codes").values()) == [2, 3]
    assert trained.run("--same", "it was never edited", model="line", seeds="4").returncode == 0
    assert store.seeds() == [0, 1, 2, 3]


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


def test_other_code_neither_plays_nor_exports_what_was_trained_and_imports_it_apart(trained: Author) -> None:
    assert trained.command("export", "line", "--out", "out").returncode == 0
    trained.edit("own_helper", "rand(", "randn(")
    for words in (("evaluate", "line", "--best", "1", "--episodes", "4"), ("export", "line", "--out", "out")):
        refused = trained.command(*words)
        assert refused.returncode == 2
        assert "own_helper.py of own (model 'line') has changed" in refused.stderr
    before, trained.runs = trained.runs, trained.folder / "more"
    assert trained.run(model="line", seeds="2:5").returncode == 0
    for folder in (before, trained.folder / "out"):
        assert trained.command("import", str(folder)).returncode == 0
    assert sorted(trained.board("--all-codes").values()) == [2, 3]


def test_a_results_folder_is_taken_over_with_all_codes(trained: Author) -> None:
    trained.edit("own_helper", "rand(", "randn(")
    assert trained.run(model="line").returncode == 0
    first, *_ = sorted(trained.runs.glob("tiny/*"))
    assert "has seeds of the installed code" in trained.command("evaluate", str(first)).stderr
    before, trained.runs = trained.runs, trained.folder / "more"
    held = sorted(path.relative_to(before) for path in before.glob("*/*/seed-*/run.json"))
    assert len(held) == 4
    for _ in range(2):  # again, there is nothing new
        done = trained.command("import", str(before))
        assert done.returncode == 0, done.stdout + done.stderr
        found = [path.relative_to(trained.runs) for path in trained.runs.glob("*/*/seed-*/run.json")]
        assert sorted(found) == held
    assert list(trained.board("--all-codes").values()) == [2, 2]


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


def test_searches_studies_and_python_begin_anew_as_well(author: Author) -> None:
    (author.folder / "lines.toml").write_text(STUDY)
    budget = ("--seeds", "1", "--epochs", "1", "--workers", "1")
    tune = ("tune", "line", "--task", str(author.task), "--vary", "lr=1e-2,1e-3", *budget)
    study = ("study", "run", "lines.toml", *budget)
    for words in (tune, study):
        assert (done := author.command(*words)).returncode == 0, done.stderr
    author.edit("own_helper", "rand(", "randn(")
    said = [author.command(*words).stderr for words in (tune, study)]
    assert all(text.count("own_helper.py of own (model 'line') has changed") == 1 for text in said)
    assert "(and so for 1 more entry)" in said[0]
    assert len(author.entries()) == 2
    assert len(list((author.runs / "tuning").glob("*/*@*/entry.json"))) == 2
    author.edit("own_helper", "randn(", "normal(0.0, 1.0, ")
    program = f"""if True:
        import qrlsuite
        words = dict(seeds=1, epochs=1, workers=1, runs={str(author.runs)!r}, progress=False)
        print("@" in qrlsuite.train("tiny.toml", "line", **words).name)
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
    assert done.stdout == "True\n", done.stderr
    assert len(author.entries()) == 3


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
    anew = author.run(model="line", seeds="3")
    assert "own_rules.py of unknown (environment 'own_world:own/World-v0') has changed" in anew.stderr


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
    assert train("runs", range(3), epochs=2) == folder
    assert "code" not in read_json(folder / "seed-0000" / "run.json")
    entry = collect.read(EntryStore(folder))
    assert entry is not None
    assert (entry.seeds, entry.refused) == ((0, 1, 2), ())

    with_numerics(monkeypatch, "algorithms", "ddqn", 2)
    anew, store = (
        codes.place(folder.parents[1], EntryStore(folder).entry(), current(folder)),
        EntryStore(folder),
    )
    assert anew.path.name == f"{folder.name}@{current(folder).digest[:8]}"
    assert codes.change(store, current(folder)) == "algorithm 'ddqn' has numerics 2, and had 1"
    with pytest.raises(
        StoreError, match="has seeds of another code: algorithm 'ddqn' has numerics 2, and had 1"
    ):
        codes.require(EntryStore(folder), current(folder), "here")


def current(folder: Path) -> identity.CodeIdentity:
    return identity.of(EntryStore(folder).entry())


def test_seeds_of_other_code_in_one_folder_do_not_count(kept: Train, tmp_path: Path) -> None:
    folder = kept("runs", range(4), epochs=1)
    parts = read_json(folder / "seed-0000" / "run.json")["code"]["parts"]
    other = identity.CodeIdentity((*parts[:2], {**parts[2], "numerics": 3}))
    for seed in (1, 3):
        edit_json(folder / f"seed-{seed:04d}" / "run.json", code=other.record())
    (entry,), refused = collect.collect(collect.Selection(tmp_path / "runs"))
    assert entry.seeds == (0, 2)
    assert [line.partition(":")[0] for line in refused] == ["seed 1", "seed 3"]
    assert all("of another code than that of its first seed" in line for line in refused)
    codes.link(EntryStore(folder), other, "renamed")
    (entry,), _ = collect.collect(collect.Selection(tmp_path / "runs"))
    assert entry.seeds == (0, 1, 2, 3)


def test_a_board_shows_the_newest_code_with_enough_seeds(tmp_path: Path) -> None:
    first, second = (
        identity.CodeIdentity(({"role": "model", "name": name, "distribution": "x"},)) for name in "ab"
    )
    for day in "12":
        seed = EntryStore(tmp_path / day).seed(0)
        seed.path.mkdir(parents=True)
        seed.timings.write_text(json.dumps({"time": f"2026-01-0{day}"}) + "\n")
    shutil.copytree(tmp_path / "1" / "seed-0000", tmp_path / "1" / "seed-0001")
    (tmp_path / "1" / "seed-0001" / "timings.jsonl").write_text("damaged\n")
    newer = replace(boards.changed(boards.entry("mlp", 19), code=second), folder=tmp_path / "2")
    for seeds, expected in ((19, [newer]), (20, None)):
        older = replace(boards.changed(boards.entry("mlp", seeds), code=first), folder=tmp_path / "1")
        assert collect.by_code([older, newer])[0] == (expected or [older])
    link = SameCodeRecord(codes=[first.digest, second.digest])
    assert len(collect.by_code([boards.changed(older, same=[link]), newer])) == 1


def test_what_somebody_trains_is_not_begun_with_other_code(
    tiny_task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry, runs = resolve(tiny_task, "mlp width=16"), tmp_path / "runs"
    store = EntryStore.create(runs, entry)
    codes.prepare(store, identity.of(entry))
    claim = acquire(store, [0])  # of a seed that is being built, and has no record yet
    with_numerics(monkeypatch, "models", "mlp", 3)
    mark = f"@{identity.of(entry).digest[:8]}"
    assert missing.find(runs, entry, Where.create(workers=1), [0, 1], 1).store.mark == mark
    claim.release()
    assert missing.find(runs, entry, Where.create(workers=1), [0, 1], 1).store.mark == ""


@pytest.mark.parametrize(
    "code",
    [{}, "text", {"digest": "0", "parts": []}, {"digest": "0" * 16, "parts": [{"role": 1, "name": "x"}]}],
)
def test_a_damaged_identity_is_named(kept: Train, tmp_path: Path, code: Any) -> None:
    folder = kept("runs", range(2), epochs=1)
    edit_json(folder / "seed-0001" / "run.json", code=code)
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
    for python in filter(None, (shutil.which(f"python3.{minor}") for minor in range(11, 16))):
        words = [python, "-I", "-c", READ, source.__file__]
        done = subprocess.run(words, input=SAMPLE, capture_output=True, check=False)
        if done.returncode != 127:  # a shim of a version that is not in use
            assert hashlib.sha256(done.stdout).hexdigest() == GOLDEN, done.stderr


@pytest.mark.parametrize("lazy", [0, 1])
def test_an_import_as_python_3_15_reads_it_is_the_same_unless_it_is_lazy(
    lazy: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, parse = source.canonical(SAMPLE), ast.parse

    def later(text: bytes) -> ast.Module:
        tree = parse(text)
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                vars(node).update(is_lazy=lazy, _fields=(*node._fields, "is_lazy"))
        return tree

    with monkeypatch.context() as patch:
        patch.setattr(ast, "parse", later)
        read = source.canonical(SAMPLE)
    assert (read == plain) == (not lazy)


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
