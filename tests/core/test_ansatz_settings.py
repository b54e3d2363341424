"""`--set` reaches the options of the chosen ansatz, and makes the entry that the table `ansatz_options` makes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from qrlsuite import registry, specs
from qrlsuite.circuit import Circuit
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.specs import AnsatzSpec
from qrlsuite.studies import study
from qrlsuite.tuning import search, space
from tests.commands import answer, say
from tests.core.test_study import SMALL


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    coupling: Literal["xx", "zz"] = "xx"
    lr: float = 1.0
    gate: Literal["rot", "xyz", "u3"] = "rot"


def ising(qubits: int, layers: int, options: Options) -> Circuit:
    circuit = Circuit(qubits)
    for q in range(qubits):
        circuit.append("RX" if options.coupling == "xx" else "RZ", q, circuit.input(q))
    return circuit


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    known = registry.load().entries[specs.AnsatzSpec]
    spec = AnsatzSpec("ising", "an ansatz with options", f"{__name__}:Options", f"{__name__}:ising")
    monkeypatch.setitem(known, "ising", replace(known["iqp"], spec=spec))


def entry(*words: str, model: str = "vqc-native", preset: str | None = None) -> Entry:
    return resolve("beam6g", model, settings=[parse_setting(word) for word in words], preset=preset)


@pytest.mark.parametrize("word", ["coupling=zz", "ansatz.coupling=zz"])
def test_an_option_of_the_ansatz_is_set_by_name(word: str) -> None:
    table = entry("qubits=2", "ansatz=ising", "ansatz_options={ coupling = 'zz' }")
    for words in (("ansatz=ising", word), (word, "model.ansatz=ising")):
        assert entry("qubits=2", *words).identity == table.identity
    assert entry("qubits=2", *words).label == table.label
    both = entry("ansatz=ising", "ansatz_options={ lr = 2.0 }", word)
    assert both.model_options.ansatz_options == {"lr": 2.0, "coupling": "zz"}
    before = entry("ansatz=ising", "ansatz_options={ coupling = 'xx' }", word)
    assert before.model_options.ansatz_options == {"coupling": "zz"}, "the option's own setting is nearer"


def test_an_option_that_the_model_hands_on_stays_the_models() -> None:
    for word in ("gate=xyz", "ansatz.gate=xyz", "model.gate=xyz"):
        assert entry(word).model_options.ansatz_options == {}
        assert entry(word).hash == entry("gate=xyz").hash


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("ansatz=ising", "lr=2"), r"write algorithm\.lr=\.\.\. or ansatz\.lr="),
        (("ansatz=ising", "couplng=zz"), "--set couplng: no option of that name; did you mean 'coupling'"),
        (
            ("ansatz=ising", "ansatz.couplng=zz"),
            "ansatz 'ising' has no option 'couplng'; did you mean 'coupling'",
        ),
        (("ansatz=ising", "coupling=yy"), "ansatz 'ising': coupling = 'yy'"),
        (("ansatz=isng", "coupling=zz"), "unknown ansatz 'isng'; did you mean 'ising'"),
        (("ansatz=ising", "ansatz_options.coupling=zz"), "did you mean 'ansatz'"),
        (("coupling=zz",), "--set coupling: no option of that name"),
    ],
)
def test_mistakes_say_what_to_type(words: tuple[str, ...], message: str) -> None:
    with pytest.raises(QrlSuiteError, match=message):
        entry(*words)


def test_a_model_without_circuit_has_no_such_side() -> None:
    with pytest.raises(OptionError, match="sides are environment, model, algorithm"):
        entry("ansatz.coupling=zz", model="mlp")


def test_a_preset_file_chooses_the_ansatz(tmp_path: Path) -> None:
    path = tmp_path / "found.toml"
    path.write_text(
        'format_version = 1\nalgorithm = "ddqn"\nmodel = "vqc-native"\n'
        '[model_options]\nansatz = "ising"\nansatz_options = { lr = 3.0 }\n'
    )
    found = entry("coupling=zz", preset=str(path)).model_options
    assert (found.ansatz, found.ansatz_options) == ("ising", {"lr": 3.0, "coupling": "zz"})


def test_studies_and_searches_take_them_too() -> None:
    parsed = study.parse(SMALL, "small.toml")
    for word in ("coupling=zz", "ansatz.coupling=zz"):
        members = parsed.members([parse_setting("ansatz=ising"), parse_setting(word)])
        assert {
            m.entry.model_options.ansatz_options.get("coupling") for m in members if m.group == "vqc"
        } == {"zz"}
    fixed = (parse_setting("ansatz=ising"), parse_setting("ansatz.coupling=zz"))
    request = search.Request(
        "beam6g", "vqc-native", settings=fixed, varied=(space.parse_varied("qubits=2,3"),)
    )
    assert [d.name for d in space.space(entry("ansatz=ising"), None, request.varied, fixed)] == [
        "model.qubits"
    ]


def test_show_says_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    output = say("show", "ansatz", "ising").output
    (line,) = [line for line in output.splitlines() if line.startswith("options (change with ")]
    command = line.removeprefix("options (change with ").removesuffix(")")
    words = command.replace("NAME=VALUE", "coupling=zz").split()
    settings = [words[i + 1] for i, w in enumerate(words) if w == "--set"]
    assert entry(*settings, model=words[words.index("--model") + 1]).model_options.ansatz_options == {
        "coupling": "zz"
    }
    assert answer("show", "ansatz", "ising")["set_with"] == command
    assert "options (change with --set NAME=VALUE)" in say("show", "mlp").output
