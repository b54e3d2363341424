"""Plugins by path in this process: what is recognized, what is refused and how, and what belongs to them."""

from __future__ import annotations

import importlib.util
import marshal
import os
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

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
from qrlsuite.studies.looks import FILE, FOLDER, in_folder
from qrlsuite.testing import check
from qrlsuite.training.trainer import Trainer, build_envs, first_network, require_trainable
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


def test_an_environment_may_bring_its_lanes() -> None:
    own.load(
        write(
            "fast.py",
            """
            from types import SimpleNamespace
            import numpy as np
            from gymnasium.spaces import Box, Discrete
            from qrlsuite.environment import EpisodeLanes, OneLane

            class FastLanes(EpisodeLanes):
                name = "fast"

                def __init__(self, options, num_envs):
                    super().__init__(options, num_envs, Box(0, 1, (1,)), Discrete(2))
                    self.value = np.zeros(num_envs)

                def _arrays(self):
                    return {"value": self.value}

                def _draw(self, stream, count):
                    return stream.random(count)

                def _begin(self, lanes, drawn):
                    self.value[lanes] = drawn

                def _act(self, actions, running):
                    return (actions == self.value.round()) * 1.0, np.zeros(self.num_envs, np.bool_)

                def _seen(self):
                    return self.value[:, None].astype(np.float32)

                def _scores(self):
                    return self.value * 0

            class Fast(OneLane):
                lanes = FastLanes

                def __init__(self, steps: int = 5):
                    super().__init__(FastLanes(SimpleNamespace(steps=steps), 1))
            """,
        )
    )
    entry = resolve("fast", "mlp steps=7")
    envs = build_envs(entry, 6, lambda: None).inner
    assert (type(envs).__name__, envs.num_envs, envs.options.steps) == ("FastLanes", 6, 7)
    assert [finding for finding in check("environment", "fast") if not finding.ok] == []


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
import qrlsuite\nqrlsuite.register('x.py')\n => /bad.py:2: ''x.py'' cannot be registered: write a
import qrlsuite\nqrlsuite.register(3)\n => /bad.py:2: '3' cannot be registered: write a function
import qrlsuite\n@qrlsuite.register\nclass Net: pass\n => /bad.py:2: 'Net' cannot be registered: write a
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
    """The identity also describes the loaded code, even if the file changes later."""
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
    with pytest.raises(FileError, match=r"no file in a results folder may load code from there"):
        published_studies.load(Path("theirs"))
    write(f"runs/{FOLDER}/theirs/{FILE}", Path(f"theirs/{FILE}").read_text())
    outcomes, (line,) = in_folder(Path("runs"))
    assert not outcomes
    assert "no file in a results folder may load code from there" in line


HELPED = """
import json
from pathlib import Path
import torch
from helper import wide

files = ["config.json"]


class Scaled(torch.nn.Module):
    def __init__(self, inputs, outputs):
        super().__init__()
        self.layer = torch.nn.Linear(wide(inputs), outputs)
        self.scale = json.loads(Path(__file__).with_name("config.json").read_text())["scale"]

    def forward(self, x):
        return self.layer(x) * self.scale
"""


def helped(folder: str = ".") -> str:
    """Write a file with a module beside it and data."""
    write(f"{folder}/config.json", '{"scale": 2}')
    write(f"{folder}/helper.py", "from parts.more import times\ndef wide(n): return n * times\n")
    write(f"{folder}/parts/__init__.py", "")
    write(f"{folder}/parts/more.py", "times = 1\n")
    write(f"{folder}/parts/notes.txt", "not imported")
    write(f"{folder}/stranger.py", "not = read\n")
    return write(f"{folder}/scaled.py", HELPED)


def test_a_file_brings_the_modules_beside_it_that_it_imports_and_the_data_that_it_declares() -> None:
    made = own.load(helped())
    parts = {"parts/__init__.py", "parts/more.py", "parts/notes.txt"}
    assert set(made.source.files) == {"scaled.py", "helper.py", "config.json"} | parts
    entry = resolve("beam6g", "scaled")
    before = identity.of(entry)
    for path in ("config.json", "helper.py", "parts/more.py", "scaled.py"):
        Path(path).unlink()
    assert first_network(entry).scale == 2
    assert identity.of(entry) == before, "what was read runs"
    assert identity.plugins(entry) == [made.source]


def test_the_module_beside_a_file_is_meant_where_python_has_another(monkeypatch: pytest.MonkeyPatch) -> None:
    write("elsewhere/helper.py", "raise SystemExit\n")
    monkeypatch.syspath_prepend(Path("elsewhere").absolute())
    own.load(helped())
    assert first_network(resolve("beam6g", "scaled")).scale == 2


def test_an_option_named_ansatz_is_a_word_of_the_models_own(tmp_path: Path) -> None:
    own.load(
        write(
            "tiny.py",
            """
            import torch


            class Tiny(torch.nn.Linear):
                def __init__(self, inputs, outputs, ansatz: str = "line"):
                    super().__init__(inputs, outputs)
            """,
        )
    )
    entry = resolve("beam6g", "tiny ansatz=square")
    assert EntryStore.create(tmp_path / "runs", entry).entry().hash == entry.hash


def test_a_network_that_calls_a_qnode_is_told_what_to_do() -> None:
    own.load(
        write(
            "net.py",
            """
            import gymnasium
            import pennylane as qml
            import torch

            weight_shapes = {"weights": (2,)}


            @qml.qnode(qml.device("default.qubit", wires=2))
            def swirl(inputs, weights):
                qml.RX(inputs[0] * weights[0], wires=0)
                qml.RY(inputs[1] * weights[1], wires=1)
                return qml.expval(qml.Z(0)), qml.expval(qml.Z(1))


            class Calls(torch.nn.Module):
                def __init__(self, inputs, outputs):
                    super().__init__()
                    self.weights = torch.nn.Parameter(torch.rand(2))
                    self.last = torch.nn.Linear(2, outputs)

                def forward(self, x):
                    return self.last(torch.stack(swirl(x.T, self.weights), -1))


            class Torch(torch.nn.Sequential):
                def __init__(self, inputs, outputs):
                    super().__init__(torch.nn.Linear(inputs, 2), qml.qnn.TorchLayer(swirl, weight_shapes))


            class Chamber(gymnasium.Env):  # no network
                def reset(self, *, seed=None, options=None):
                    return swirl([0, 0], [0, 0])
            """,
        )
    )
    assert [note.partition(",")[0] for note in shortforms.notes(sys.modules["net"])] == [
        "note: Calls calls the QNode swirl"
    ]
    with pytest.raises(
        PluginError, match=r"self.1 is a TorchLayer of PennyLane.*: write self.1 = qrlsuite.layer\(QNODE\)"
    ):
        require_trainable([resolve("beam6g", "torch")])


@pytest.mark.parametrize(
    ("path", "text", "counts"),
    [
        ("config.json", '{"scale": 30}', True),
        ("parts/more.py", "times = 2\n", True),
        (
            "helper.py",
            '"""Text."""\nfrom parts.more import times\ndef wide(n): return n * times  # so\n',
            False,
        ),
        ("stranger.py", "x = 1\n", False),
        ("parts/README.md", "read", False),
        ("parts/tests/test_more.py", "x = 1\n", False),
        ("parts/__pycache__/more.pyc", "x", False),
        ("parts/.notes", "x", False),
        ("parts/notes.txt", "imported?", True),
    ],
)
def test_the_identity_covers_what_belongs_to_a_file(path: str, text: str, counts: bool) -> None:
    own.load(helped())
    entry = resolve("beam6g", "scaled")
    before = identity.of(entry).digest
    write(path, text)
    own.load("scaled.py")
    assert (identity.of(entry).digest != before) == counts


def test_a_module_of_the_same_name_beside_another_file_is_refused() -> None:
    own.load(helped("a"))
    write("b/helper.py", "x = 1\n")
    said = refusal(write("b/net.py", "import helper\ndef ring(qubits, layers): ...\n"))
    assert "/b/helper.py and " in said
    assert "are two modules of one name: rename one of them" in said


@pytest.mark.parametrize("data", ["../secret", "/etc/hostname", "link"])
def test_data_outside_of_the_files_folder_is_not_read(data: str) -> None:
    write("secret", "x")
    Path("here").mkdir()
    Path("here/link").symlink_to(Path("secret").absolute())
    text = f"files = [{data!r}]\ndef ring(qubits, layers): ...\n"
    assert f"files names {data}, which is not in " in refusal(write("here/ring.py", text))


def test_data_is_named_by_its_place_however_it_is_written() -> None:
    write("here/w.txt", "x")
    Path("here/loop").symlink_to("loop")
    write("here/.hidden/w.txt", "x")
    text = "files = ['../here/w.txt', 'none/../w.txt', '.hidden/w.txt']\n"
    source = own.read(write("here/ring.py", text))
    assert set(source.files) == {"ring.py", "w.txt", ".hidden/w.txt"}
    assert source.copy.with_name(".hidden").joinpath("w.txt").read_text() == "x"
    for name in ("loop", "w\\0"):
        said = refusal(write("here/ring.py", f"files = ['{name}']\ndef ring(qubits, layers): ...\n"))
        assert "and there is no such file" in said


def test_undeclared_data_is_said_with_what_to_write() -> None:
    write("data.txt", "1")
    head = "from pathlib import Path\nfrom qrlsuite.circuit import Circuit\n"
    read = "Path(__file__).with_name('data.txt').read_text()"
    expected = f"{Path.cwd()}/data.txt'; no such file belongs to the plugin: declare it at the top of the code, files"
    said = refusal(write("ring.py", f"{head}{read}\ndef ring(qubits, layers) -> Circuit: ...\n"))
    assert expected in said
    assert said.startswith(f"{Path.cwd()}/ring.py:3: FileNotFoundError")
    own.load(write("ring.py", f"{head}def ring(qubits, layers) -> Circuit:\n    return {read}\n"))
    with pytest.raises(PluginError, match=r'files = \["data.txt"\] \(ring.py, line 4: return Path'):
        circuit.ansatz("ring", 1, 1)
    own.load(
        write("ring.py", f"files = ['data.txt']\n{head}{read}\ndef ring(qubits, layers) -> Circuit: ...\n")
    )
    assert "files names none, and there is no such file" in refusal(write("net.py", "files = ['none']\n"))


def test_a_copy_that_was_changed_is_written_anew() -> None:
    made = own.load(write("ring.py", RING))
    own.unload(made)
    made.source.copy.write_text("raise SystemExit\n")
    made.source.copy.with_name("math.py").write_text("raise SystemExit\n")
    assert own.load("ring.py").source.copy.read_text() == RING
    assert not made.source.copy.with_name("math.py").exists()
    own.unload(made)
    again = own.load(made.source.copy)  # as the probe's process does
    assert again.source.mark == made.source.mark
    own.unload(again)
    made.source.copy.write_text("raise SystemExit\n")
    assert "is a copy that was changed" in refusal(str(made.source.copy))
    made.source.copy.with_name("math.py").symlink_to(write("math.py", "raise SystemExit\n"))
    own.load("ring.py")
    assert not made.source.copy.with_name("math.py").is_symlink()


def test_a_pipe_or_device_is_no_plugin() -> None:
    os.mkfifo("pipe.py")
    assert "plugin pipe.py cannot be read: not a regular file" in refusal("pipe.py")
    Path("zero.py").symlink_to("/dev/zero")
    assert "plugin zero.py cannot be read: not a regular file" in refusal("zero.py")


def test_bytecode_beside_a_copy_does_not_run() -> None:
    made = own.load(write("ring.py", RING))
    own.unload(made)
    other = compile("raise SystemExit('other code')", "ring.py", "exec")
    place = Path(importlib.util.cache_from_source(made.source.copy))
    place.parent.mkdir(exist_ok=True)
    head = importlib.util.MAGIC_NUMBER + bytes(4)  # of a source file with this time and size
    about = made.source.copy.stat()
    head += int(about.st_mtime).to_bytes(4, "little") + about.st_size.to_bytes(4, "little")
    place.write_bytes(head + marshal.dumps(other))
    own.load("ring.py")


def test_a_copy_that_is_changed_while_it_is_used_does_not_run() -> None:
    write("side.py", "WIDTH = 2\n")
    late = "from qrlsuite.circuit import Circuit\ndef ring(qubits, layers) -> Circuit:\n    import side\n"
    made = own.load(write("ring.py", f"{late}    return Circuit(side.WIDTH)\n"))
    made.source.copy.with_name("side.py").write_text("raise SystemExit\n")
    assert circuit.ansatz("ring", 2, 1).qubits == 2


def test_copies_lie_somewhere_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("QRLSUITE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "~nobody-of-this-name/cache")
    folder = own._cache.__wrapped__()
    assert folder.is_absolute()
    assert folder.is_dir()


def test_what_is_not_in_a_file_is_not_registered() -> None:
    with pytest.raises(
        PluginError, match=r"^'two' is registered from its file: begin .* with %%writefile mine.py"
    ):

        @api.register
        def two(qubits: int, layers: int) -> None: ...


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
            r"^ZeroDivisionError.*, line 17: return self.layer\(x\) \*.*: fix it",
        ),
        ("walk", "mlp", r"RuntimeError: it fell \(mistakes.py, line 27: raise"),
        ("beam6g", "idle mlp", r"^AttributeError.*\(mistakes.py, line 33: def act.*: fix it and rerun"),
    ],
)
def test_a_mistake_in_a_users_file_is_one_line_that_names_its_place(
    task: str, entry: str, expected: str
) -> None:
    own.load(write("mistakes.py", MISTAKES))

    def train() -> None:
        require_trainable([resolve(task, entry)])
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
    assert study.load("studies/ring.toml").looks is not None
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
