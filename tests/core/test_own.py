"""Plugins by path in this process: what is recognized, what is refused and how, and cells of a notebook."""

from __future__ import annotations

import linecache
import os
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

from qrlsuite import api, circuit, options, own, registry, shortforms, specs
from qrlsuite.errors import EnvironmentFailure, FileError, OptionError, PluginError, UnknownNameError
from qrlsuite.experiment import identity, task
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard.shelf import published_studies
from qrlsuite.results import probes
from qrlsuite.results.records import EntryRecord, ProbeRecord
from qrlsuite.results.store import EntryStore
from qrlsuite.studies import study
from qrlsuite.studies.looks import FILE, FOLDER
from qrlsuite.studies.outcome import in_folder
from qrlsuite.training.trainer import Trainer, first_network
from tests.conftest import cases

RING = '''
from qrlsuite.circuit import Circuit


def ring(qubits, layers, depth: int = 1, turn="RY"):
    """A ring."""
    circuit = Circuit(qubits)
    weights = circuit.parameter("weights", (layers, qubits, depth))
    for layer in range(layers):
        for q in range(qubits):
            circuit.append("RX", q, circuit.input(q))
            for d in range(depth):
                circuit.append(turn, q, weights[layer, q, d])
        for q in range(qubits if qubits > 2 else qubits - 1):
            circuit.append("CZ", (q, (q + 1) % qubits))
    return circuit
'''
ALL = '''
import gymnasium
import numpy as np
import torch
from qrlsuite import layer
from qrlsuite.circuit import Circuit
from qrlsuite.plugins.algorithms.reinforce import Reinforce, REINFORCEOptions


class LineWalk(gymnasium.Env):
    def __init__(self, size: int = 4):
        self.size = size
        self.observation_space = gymnasium.spaces.Box(0, 1, (1,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(2))
        return np.array([self.place / self.size], np.float32), {}

    def step(self, action):
        self.place = max(0, self.place + (1 if action else -1))
        done = self.place >= self.size
        return np.array([min(1, self.place / self.size)], np.float32), float(done) - 0.01, done, False, {}


class Block(torch.nn.Module):
    def __init__(self, width):
        super().__init__()


class HTTPNet2(torch.nn.Module):
    """A network.

    Of one layer.
    """

    def __init__(self, inputs, outputs, scale: float = 1.0, *, role="", generator=None):
        super().__init__()
        assert role
        assert generator is not None
        self.inner, self.scale = torch.nn.Linear(inputs, outputs), float(scale)

    def forward(self, x):
        return self.inner(x) * self.scale


class Quantum(torch.nn.Module):
    def __init__(self, n, m):
        super().__init__()
        self.circuit = layer("cz", qubits=2)


class Slow(Reinforce):
    def __init__(self, envs, build_model, streams, device, lr: float = 0.01):
        super().__init__(envs, build_model, REINFORCEOptions(lr=lr), streams, device)


def two_rings(qubits: int, layers: int) -> "Circuit":
    return Circuit(qubits)


def helper(qubits: int, layers: int) -> int:
    return qubits * layers


def _hidden(qubits, layers):
    return Circuit(qubits)
'''


@pytest.fixture(autouse=True)
def _alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    yield
    for each in own.loaded():
        own.unload(each)


def write(path: str, text: str) -> str:
    place = Path(path)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(textwrap.dedent(text))
    return path


def names() -> dict[str, list[str]]:
    """What plugins by path have registered."""
    found: dict[str, list[str]] = {}
    for each in registry.load():
        if own.of_distribution(each.distribution) is not None:
            found.setdefault(each.spec.kind, []).append(each.spec.name)
    return found


def refusal(path: str) -> str:
    """Load what is refused; what is said must be one line, and nothing may be left of it."""
    before, modules = names(), set(sys.modules)
    with pytest.raises(PluginError) as caught:
        own.load(path)
    assert "\n" not in str(caught.value)
    assert names() == before
    left = {name for name in set(sys.modules) - modules if name.partition(".")[0] == Path(path).stem}
    assert not left
    return str(caught.value)


def test_a_function_is_an_ansatz_with_its_parameters_as_options() -> None:
    """3 qubits, 2 layers, 2 deep: 2 * (3 RX + 6 RY + 3 CZ)."""
    made = own.load(write("ring.py", RING))
    assert made.sentence == "ring.py: ansatz ring"
    built = circuit.ansatz("ring", 3, 2, depth=2)
    assert len(list(built)) == 24
    rows = options.describe(specs.resolve(registry.get(specs.AnsatzSpec, "ring").options))
    assert [(row["name"], row["values"], row["default"]) for row in rows] == [
        ("depth", "integer", 1),
        ("turn", "string", "RY"),
    ]
    assert registry.get(specs.AnsatzSpec, "ring").summary == "A ring."
    assert registry.load().get(specs.AnsatzSpec, "ring").place.endswith("ring.py:5")


def test_every_short_form_is_recognized_and_nothing_else() -> None:
    own.load(write("all_of_it.py", ALL))
    assert names() == {
        "environment": ["line-walk"],
        "model": ["http-net2", "quantum"],
        "algorithm": ["slow"],
        "ansatz": ["two-rings"],
    }
    assert registry.get(specs.ModelSpec, "http-net2").family == "classical"
    assert registry.get(specs.ModelSpec, "http-net2").summary == "A network."
    assert registry.get(specs.ModelSpec, "quantum").family == "quantum"
    assert registry.get(specs.ModelSpec, "quantum").summary == "Quantum of all_of_it.py"


def test_names_are_in_kebab_case() -> None:
    cases = {
        "ring": "ring",
        "ry_ring": "ry-ring",
        "RingNet": "ring-net",
        "HTTPNet2": "http-net2",
        "Net_": "net",
    }
    assert {name: shortforms.kebab(name) for name in cases} == cases


def test_an_environment_has_a_task_of_its_name_for_a_quick_look() -> None:
    own.load(write("all_of_it.py", ALL))
    quick = task.load("line-walk")
    before = quick.file.ranking.thresholds
    own.load(write("all_of_it.py", ALL.replace("float(done) - 0.01", "float(done) + 1")))
    assert task.load("line-walk").file.ranking.thresholds != before, "random actions reach more"
    own.load(write("all_of_it.py", ALL))
    assert (quick.name, quick.environment.name) == ("line-walk", "line-walk")
    assert quick.with_environment({"size": 5}).environment_options.size == 5
    entry = resolve("line-walk", "slow http-net2 lr=0.1 scale=2")
    assert entry.algorithm_options.lr == 0.1
    assert first_network(entry).scale == 2, "and it is given what it asks for"


def test_an_options_class_is_taken_as_it_is() -> None:
    own.load(
        write(
            "whole.py",
            """
            from typing import Annotated
            from pydantic import ConfigDict, Field
            from pydantic.dataclasses import dataclass
            from qrlsuite.circuit import Circuit

            @dataclass(frozen=True, config=ConfigDict(extra="forbid"))
            class Options:
                depth: Annotated[int, Field(ge=1, description="how deep")] = 2

            def whole(qubits: int, layers: int, options: Options) -> Circuit:
                circuit = Circuit(qubits)
                circuit.append("H", 0)
                return circuit
            """,
        )
    )
    assert registry.get(specs.AnsatzSpec, "whole").options == "whole:Options"
    assert len(list(circuit.ansatz("whole", 1, 1, depth=1))) == 1


def test_calls_of_register_say_what_is_registered() -> None:
    """By either name, and specs too; what is not named is not registered."""
    own.load(
        write(
            "named.py",
            """
            import qrlsuite
            from qrlsuite import register, specs
            from qrlsuite.circuit import Circuit

            @register
            def first(qubits, layers): return Circuit(qubits)

            def second(qubits, layers): return Circuit(qubits)

            qrlsuite.register(specs.AnsatzSpec("third", "A spec", "qrlsuite.plugins.circuits.ansatz:NoOptions",
                                               "named:second"))
            """,
        )
    )
    assert names() == {"ansatz": ["first", "third"]}
    assert registry.load().get(specs.AnsatzSpec, "third").place.endswith("named.py:11")


def test_a_packages_folder_with_hooks_is_used_as_it_lies_there() -> None:
    write(
        "src/acme/__init__.py",
        """
        from qrlsuite import hookimpl, specs

        @hookimpl
        def register_ansatzes(register):
            options = "qrlsuite.plugins.circuits.ansatz:NoOptions"
            register(specs.AnsatzSpec("acme", "A ring", options, "acme.part:build"))
        """,
    )
    write("src/acme/part.py", "from acme.inner import Circuit\ndef build(q, l, o): return Circuit(q)\n")
    write("src/acme/inner.py", "from qrlsuite.circuit import Circuit\n")
    assert "did you mean src/acme?" in refusal("src")
    assert own.load("src/acme").sentence == "acme: ansatz acme"
    assert circuit.ansatz("acme", 2, 1).qubits == 2
    assert not list(Path("src").rglob("__pycache__"))


BAD = r"""
x = 1\nraise ValueError('no' + chr(10) + 'way')\n => /bad.py:2: ValueError: no way
import no_such_module\n => /bad.py:1: ModuleNotFoundError: No module named 'no_such_module'
def f(:\n => /bad.py:1: SyntaxError:
import sys\nsys.exit('bye')\n => /bad.py:2: SystemExit: bye
x = 1\n => /bad.py registers nothing: write a function (qubits, layers)
class A:\n    def act(self): ...\n => registers nothing: class A has act, and lacks start, train_epoch, state_dict
def ring(qubits, layers, depth): ...\n => /bad.py:1: 'ring': parameter 'depth' needs a default, for example
def ring(qubits, layers, d=None): ...\n => /bad.py:1: 'ring': parameter 'd' needs a type, for example d: int
def ring(qubits, layers, d: 'Nothing' = 1): ...\n => 'ring': its annotations cannot be read: NameError
def iqp(qubits, layers): ...\n => /bad.py:1: ansatz 'iqp' is registered already, by qrlsuite (
import qrlsuite\nqrlsuite.register('x.py')\n => /bad.py:2: ''x.py'' cannot be registered: it is neither
import qrlsuite\nqrlsuite.register(3)\n => /bad.py:2: '3' cannot be registered: it is neither a spec nor
import qrlsuite\n@qrlsuite.register\nclass Net: pass\n => /bad.py:2: 'Net' cannot be registered: it is neither
from qrlsuite import hookimpl\n@hookimpl\ndef register_modles(register): ...\n => did you mean 'register_models'?
"""


@pytest.mark.parametrize(("text", "expected"), cases(BAD))
def test_what_cannot_be_loaded_is_refused_in_a_line(text: str, expected: str) -> None:
    assert expected in refusal(write("bad.py", text))


NO_PLUGINS = """
none.py => there is no plugin none.py
ring => there is no plugin ring; did you mean ring.py?
notes.ipynb => is a notebook
data.csv => give a Python file, or the folder of a package
my-ring.py => cannot import a module 'my-ring': rename it, for example my_ring
json.py => Python has another module 'json' (
numpy.py => Python has another module 'numpy' (
"""


@pytest.mark.parametrize(("path", "expected"), cases(NO_PLUGINS))
def test_a_path_that_is_no_plugin_is_refused(path: str, expected: str) -> None:
    for name in ("ring.py", "notes.ipynb", "data.csv", "my-ring.py", "json.py", "numpy.py"):
        write(name, RING)
    with pytest.raises(PluginError) as caught:
        own.load(path)
    assert expected in str(caught.value)


def test_a_folder_of_its_name_beside_it_is_no_module(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `qrlsuite new plugin --from ring.py` makes one, in the folder where a notebook runs."""
    monkeypatch.syspath_prepend(Path.cwd())
    write("ring/pyproject.toml", "")
    write("code/ring.py", RING)
    assert own.load("code/ring.py").sentence == "ring.py: ansatz ring"


def test_two_plugins_of_one_name_are_refused_unless_they_are_equal() -> None:
    own.load(write("a/ring.py", RING))
    own.load(write("b/ring.py", RING))
    assert "two plugins are called ring: " in refusal(write("c/ring.py", RING + "x = 1\n"))
    assert "by ring.py (" in refusal(write("other.py", RING))


def test_an_edited_file_takes_its_own_place_and_a_broken_one_does_not() -> None:
    own.load(write("ring.py", RING))
    own.load(write("ring.py", RING.replace('"RY"', '"RZ"')))
    assert {each.gate for each in circuit.ansatz("ring", 2, 1)} == {"RX", "RZ", "CZ"}
    assert "ring.py:1: " in refusal(write("ring.py", "raise ValueError\n"))
    assert {each.gate for each in circuit.ansatz("ring", 2, 1)} == {"RX", "RZ", "CZ"}


def test_what_is_loaded_is_what_was_read() -> None:
    """The identity, too, is that of the code which runs, whatever becomes of the file."""
    own.load(write("all_of_it.py", ALL))
    entry = resolve("beam6g", "http-net2")
    before = identity.of(entry).digest
    write("all_of_it.py", ALL + "\nx = 1\n")
    assert identity.of(entry).digest == before
    own.load("all_of_it.py")
    assert identity.of(entry).digest != before
    write("all_of_it.py", ALL + "\nx = 1  # a comment\n")
    after = identity.of(entry).digest
    own.load("all_of_it.py")
    assert identity.of(entry).digest == after


def test_an_entry_needs_the_plugins_that_its_code_reaches() -> None:
    own.load(
        write(
            "parts.py",
            "from qrlsuite.circuit import Circuit\ndef two(qubits, layers): return Circuit(qubits)\n",
        )
    )
    text = "from parts import Circuit\ndef ring(qubits, layers) -> Circuit:\n    return Circuit(qubits)\n"
    own.load(write("uses.py", text))
    own.load(write("ring_net.py", ALL))
    needed = identity.plugins(resolve("beam6g", "vqc-native ansatz=ring"))
    assert {source.name for source in needed} == {"parts.py", "uses.py"}
    assert identity.plugins(resolve("beam6g", "mlp")) == []


def test_a_task_file_names_its_plugins(tiny_task: str) -> None:
    text = Path(tiny_task).read_text()
    write("code/ring.py", RING)
    here = write("here.toml", f'plugins = ["code/ring.py"]\n{text}')
    assert task.load(here).hash == task.load(tiny_task).hash
    assert names() == {"ansatz": ["ring"]}
    assert "plugins" not in EntryRecord.of(resolve(here, "mlp")).content["task_file"]
    for bad in ('"ring.py"', "[1]", '[""]'):
        with pytest.raises(FileError, match=r"plugins = .*name files and folders"):
            task.load(write("bad.toml", f"plugins = {bad}\n{text}"))


def test_a_file_beside_results_imports_nothing(tiny_task: str) -> None:
    text = Path(tiny_task).read_text()
    write("theirs/tiny/ddqn-mlp/entry.json", "{}")
    write("theirs/evil.py", "raise SystemExit('it runs')\n")
    named = write("theirs/here.toml", f'plugins = ["evil.py"]\n{text}')
    with pytest.raises(FileError, match=r"if you trust it, add --plugin theirs/evil.py"):
        task.load(named)
    write("evil.py", RING)
    own.load("evil.py")
    assert task.load(named).name == "tiny", "what is loaded already is not loaded again"


def test_a_published_study_imports_nothing() -> None:
    """It may have been published before its first seed, so that no entry lies there."""
    write("theirs/evil.py", "raise SystemExit('it runs')\n")
    write(f"theirs/{FILE}", 'plugins = ["evil.py"]\nformat_version = 1\nname = "theirs"\n')
    with pytest.raises(FileError, match=r"what lies beside results is not imported"):
        published_studies.load(Path("theirs"))
    write(f"runs/{FOLDER}/theirs/{FILE}", Path(f"theirs/{FILE}").read_text())
    outcomes, (line,) = in_folder(Path("runs"))
    assert not outcomes
    assert "what lies beside results is not imported" in line


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Run cells as a notebook does: in `__main__`, with their source where Python looks for it."""
    main = ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", main)
    count = iter(range(1000))

    def run(text: str) -> None:
        text, name = textwrap.dedent(text), f"<cell {next(count)}>"
        linecache.cache[name] = (len(text), None, text.splitlines(True), name)
        exec(compile(text, name, "exec", dont_inherit=True), vars(main))

    run("from qrlsuite import api\nfrom qrlsuite.circuit import Circuit\nimport math as m\nGATE = 'RY'\n")
    return run


CELL = '''
def pairs(n):
    """Neighbors."""
    return [(q, (q + 1) % n) for q in range(n)] if n > 2 else []

@api.register
def my_ring(qubits: int, layers: int, depth: int = STEP) -> Circuit:
    """A ring."""
    circuit = Circuit(qubits)
    for q in range(qubits):
        circuit.append(GATE, q, circuit.input(q))
        circuit.append("RX", q, m.pi)
    for pair in pairs(qubits):
        circuit.append("CZ", pair)
    return circuit
'''


def test_a_cell_registers_with_what_it_names(
    cell: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    cell("STEP = 2\n")
    cell(CELL)
    shown = capsys.readouterr().out
    assert shown.startswith("my_ring.py: ansatz my-ring\n4 qubits, 2 layers:\n")
    assert "RY" in shown
    (made,) = own.loaded()
    text = made.source.files["my_ring.py"].decode()
    assert "register" not in text
    assert text.startswith("from qrlsuite.circuit.description import Circuit\n")
    assert "GATE = 'RY'\n" in text
    assert "STEP = 2\n" in text
    assert len(list(circuit.ansatz("my-ring", 3, 1))) == 9


def test_a_cell_may_be_run_again(cell: Callable[[str], None]) -> None:
    text = CELL.replace("STEP", "1")
    cell(text)
    entry = resolve("beam6g", "vqc-native ansatz=my-ring")
    before = identity.of(entry).digest
    cell(text)
    assert identity.of(entry).digest == before
    cell("GATE = 'RZ'\n" + text)
    assert identity.of(entry).digest != before
    assert {each.gate for each in circuit.ansatz("my-ring", 3, 1)} == {"RX", "RZ", "CZ"}
    cell("GATE = 'RY'\n" + text)
    assert identity.of(entry).digest == before


def test_a_class_of_a_cell_is_a_model(
    cell: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    cell(
        """
        import torch
        from torch import nn
        SIZES: list[int] = [4, 4]
        scale = torch.tensor(0.5)

        class Base(nn.Module):
            def forward(self, x):
                return self.inner(x) * float(scale)

        @api.register
        class RingNet(Base):
            def __init__(self, inputs, outputs, width: int = len(SIZES)):
                super().__init__()
                self.inner = nn.Linear(inputs, outputs)
        """
    )
    assert "ring_net.py: model ring-net\nclassical, 3 inputs, 3 outputs:\nRingNet(" in capsys.readouterr().out
    assert resolve("beam6g", "ring-net").model_options.width == 2


def test_a_spec_of_a_cell_refers_to_what_the_cell_defines(cell: Callable[[str], None]) -> None:
    cell(
        """
        from qrlsuite import specs
        def build(qubits, layers, options): return Circuit(qubits)
        api.register(specs.AnsatzSpec("by-spec", "A spec", "qrlsuite.plugins.circuits.ansatz:NoOptions",
                                      "__main__:build"))
        """
    )
    assert circuit.ansatz("by-spec", 2, 1).qubits == 2


def test_what_workers_could_not_have_is_refused(cell: Callable[[str], None]) -> None:
    cell("thing = object()\n")
    head = "@api.register\ndef f(qubits, layers):\n    "
    for text, expected in (
        (head + "return thing\n", "'f' uses 'thing', a object, which workers cannot have"),
        (head + "return late(1)\n\ndef late(x): ...\n", "'f' uses 'late', which is defined after it"),
        (
            "@api.register\ndef iqp(qubits, layers): ...\n",
            r"<cell \d+>:1: ansatz 'iqp' is registered already, by qrl",
        ),
        ("api.register(print)\n", "'print' cannot be registered: it is neither a spec"),
        ("api.register('none.py')\n", "there is no plugin none.py"),
        (
            "from qrlsuite.plugins.circuits.ansatz import cx\napi.register(cx)\n",
            "'cx' is defined in module qrlsuite.",
        ),
    ):
        with pytest.raises(PluginError, match=expected) as caught:
            cell(text)
        assert "\n" not in str(caught.value)
    assert names() == {}
    with pytest.raises(
        PluginError, match=r"the source of 'f' cannot be read here .*qrlsuite.register\('f.py'\)"
    ):
        exec(head + "return Circuit(qubits)\n", vars(sys.modules["__main__"]))


def test_a_builder_that_fails_is_named_with_its_line() -> None:
    own.load(
        write("bad.py", "def worse(qubits, layers):\n    return qubits.foo\ndef none(qubits, layers): ...\n")
    )
    with pytest.raises(
        PluginError,
        match=r"^ansatz 'worse' cannot be built: AttributeError.*bad.py, line 2: return qubits.foo\)$",
    ):
        resolve("beam6g", "vqc-native ansatz=worse")
    with pytest.raises(
        PluginError, match=r"^ansatz 'none' returns NoneType, and must return a Circuit of qrlsuite"
    ):
        resolve("beam6g", "vqc-native ansatz=none")


def test_a_clash_with_another_file_names_it(cell: Callable[[str], None]) -> None:
    own.load(write("other.py", RING.replace("def ring", "def my_ring")))
    with pytest.raises(
        PluginError, match=r"<cell \d+>:\d+: ansatz 'my-ring' is registered already, by other.py \("
    ):
        cell(CELL.replace("STEP", "1"))


def test_a_file_is_registered_from_python(capsys: pytest.CaptureFixture[str]) -> None:
    assert api.register(write("ring.py", RING)) == "ring.py"
    assert capsys.readouterr().out.startswith("ring.py: ansatz ring\n4 qubits, 2 layers:\n")
    assert api.register(Path("ring.py")) == Path("ring.py")


def test_without_the_plugin_nothing_is_left() -> None:
    made = own.load(write("ring.py", RING))
    own.unload(made)
    with pytest.raises(UnknownNameError, match="unknown ansatz 'ring'"):
        circuit.ansatz("ring", 2, 1)
    assert not any(each.distribution == "ring.py" for each in registry.load().plugins)
    assert os.path.exists("ring.py")


MISTAKES = """
import gymnasium, numpy, torch
from qrlsuite.circuit import Circuit

def chain(qubits, layers, far: int = 0):
    circuit = Circuit(qubits)
    circuit.append("RX", qubits - 1 + far, circuit.input(0))
    return circuit

class Net(torch.nn.Module):
    def __init__(self, inputs, outputs, mistake: str = "none"):
        super().__init__()
        self.mistake, self.layer = mistake, torch.nn.Linear(inputs, outputs)

    def forward(self, x):
        if self.mistake == "divides":
            return self.layer(x) * (1 / 0)
        return {"flat": self.layer(x)[:, 0], "zero": self.layer(x) / 0}.get(self.mistake)

class Walk(gymnasium.Env):
    observation_space, action_space = gymnasium.spaces.Box(-1, 1, (2,)), gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return numpy.zeros(2, numpy.float32), {}

    def step(self, action):
        raise RuntimeError("it fell")

class Idle:
    def __init__(self, envs, build_model, streams, device): self.network = build_model(2)
    def start(self): ...
    def train_epoch(self, rounds): return {}
    def act(self, observations): return observations.missing
    def state_dict(self): return {}
    def load_state_dict(self, state): ...
    def policy_state(self): return {}
"""


@pytest.mark.parametrize(
    ("task", "entry", "expected"),
    [
        (
            "beam6g",
            "vqc-native qubits=3 ansatz=chain ansatz.far=1",
            r"^RX on qubits \(3,\).*line 7: circuit.app",
        ),
        ("beam6g", "net mistake=flat", r"forward returns the shape \(2,\), and must .*line 15: def forward"),
        ("beam6g", "net mistake=zero", r"forward returns -?(inf|nan) before any training"),
        (
            "beam6g",
            "net mistake=divides",
            r"^ZeroDivisionError.*, line 17: return self.layer\(x\) \*.*: mend",
        ),
        ("walk", "mlp", r"RuntimeError: it fell \(mistakes.py, line 27: raise"),
        ("beam6g", "idle mlp", r"^AttributeError.*\(mistakes.py, line 33: def act.*: mend it, and repeat"),
    ],
)
def test_a_mistake_in_a_users_file_is_one_line_that_names_its_place(
    task: str, entry: str, expected: str
) -> None:
    own.load(write("mistakes.py", MISTAKES))

    def train() -> None:
        trainer = Trainer(resolve(task, entry), [0])
        trainer.start()
        trainer.train_epoch()

    with pytest.raises((OptionError, PluginError, EnvironmentFailure), match=expected) as caught:
        train()
    assert "\n" not in str(caught.value)


def test_a_new_study_names_the_plugins_of_its_entries() -> None:
    ring = own.load(write("ring.py", RING))
    Path("studies").mkdir()
    entries = ["vqc-native qubits=3 ansatz=ring", "mlp width=16"]
    api.new_study("studies/ring.toml", entries, task="beam6g", runs="none")
    own.unload(ring)
    assert Path("studies/ring.toml").read_text().startswith('plugins = ["../ring.py"]\n')
    assert study.load("studies/ring.toml").file.looks is not None
    assert names() == {"ansatz": ["ring"]}


@pytest.mark.parametrize(("entry", "expected"), [("idle none", "algorithm:idle"), ("net", "model:net")])
def test_whoever_is_to_check_dependent_seeds_is_told_what_and_by_which_plugin(
    entry: str, expected: str
) -> None:
    own.load(write("a b/mistakes.py", MISTAKES))
    store = EntryStore.create(Path("runs"), resolve("beam6g", entry))
    said = str(probes.refusal(store, ProbeRecord(result="differs", seed=6)))
    assert (
        f"`qrlsuite check {expected} --plugin '{Path('a b/mistakes.py').absolute()}'` looks for them" in said
    )
