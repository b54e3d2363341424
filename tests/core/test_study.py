"""Study files: every error at once with its place, and the entries that the benchmark's studies stand for."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from qrlsuite.errors import FileError, OptionError, UnknownNameError
from qrlsuite.experiment.entry import resolve
from qrlsuite.options import parse_setting
from qrlsuite.studies import looks, study
from qrlsuite.studies.sizes import nearest_size, parameters
from tests.conftest import cases

ROOT = Path(__file__).parents[2]
SMALL = """
format_version = 1
name = "small"
summary = "A study for tests"

[[entries]]
name = "vqc"
task = "beam6g"
model = "vqc-native"
grid = { qubits = [2, 3] }

[[entries]]
name = "mlp"
task = ["beam6g", "beam6g-text"]
model = "mlp"
match = { option = "width", group = "vqc" }

[[pictures]]
kind = "curves"
"""


def test_entries_are_those_of_plain_runs() -> None:
    plain = resolve("beam6g", "mlp width=16")
    assert plain.name in {m.entry.name for m in study.load("fig6").members()}
    shared = {m.entry.name for m in study.load("fig6").members()} - {
        m.entry.name for m in study.load("fig7").members()
    }
    assert shared == set(), "fig6 shares every entry with fig7"


def test_a_group_names_entries_in_their_notation() -> None:
    text = SMALL.replace(
        'model = "vqc-native"\ngrid',
        'model = ["ppo mlp width=8 depth=1", "vqc-native"]\noptions = { lr = 2e-3 }\ngrid',
    )
    text = (
        text.replace("{ qubits = [2, 3] }", "{ gamma = [0.9] }")
        .replace("match = {", "#")
        .replace('"beam6g-text"]', "]")
    )
    found = [m.entry.label for m in study.parse(text, "small.toml").members()]
    assert found[0] == "ppo mlp width=8 depth=1 gamma=0.9 lr=0.002"
    with pytest.raises(OptionError, match=r"small\.toml, group 'vqc': entry 'a b c': write"):
        study.parse(text.replace("ppo mlp width=8 depth=1", "a b c"), "small.toml").members()


def test_core_hours_follow_from_the_papers_run_times() -> None:
    """15 s per epoch and run for networks, the table of run times for circuits; 100 epochs, 100 runs."""
    table = {(n, 4): s for n, s in {6: 44, 8: 59, 10: 95, 12: 250, 14: 761}.items()}
    table |= {(8, 3): 48, (8, 5): 69, (8, 6): 117, (10, 3): 79, (10, 5): 117, (10, 6): 137}
    for name in ("fig1", "fig6", "fig7", "fig8", "ablation", "degree", "antennas", "few-runs"):
        loaded = study.load(name)
        unique = {m.entry.name: m.entry for m in loaded.members()}
        seconds = [
            15 if e.model.name == "mlp" else table[e.model_options.qubits, e.model_options.layers]
            for e in unique.values()
        ]
        assert loaded.core_hours == round(sum(seconds) * 100 * 100 / 3600)


def test_matched_sizes_are_the_nearest_of_all() -> None:
    members = study.load("matched").members()
    circuits = [m.entry for m in members if m.group == "vqc"]
    networks = [m.entry for m in members if m.group == "mlp"]
    counts = {w: parameters(resolve("beam6g", f"mlp width={w}")) for w in range(1, 25)}
    assert counts[16] == 16**2 + 8 * 16 + 3
    for circuit, network in zip(circuits, networks, strict=True):
        wanted = 31 * circuit.model_options.qubits + 3  # 6 L n + 7 n + 3 with 4 layers
        assert parameters(circuit) == wanted
        assert network.model_options.width == min(counts, key=lambda w: abs(counts[w] - wanted))


def test_sizes_that_cannot_be_matched() -> None:
    target, small = (resolve("beam6g", f"mlp width={width}") for width in (64, 16))
    with pytest.raises(OptionError, match="no size up to 4096 has the 4611 parameters of ddqn mlp width=64"):
        nearest_size(lambda size: small, target)


def test_a_grid_is_expanded_tasks_first_and_nothing_twice() -> None:
    parsed = study.parse(SMALL, "small.toml")
    found = [(m.group, m.entry.task.name, m.entry.label) for m in parsed.members()]
    assert found[:2] == [
        ("vqc", "beam6g", "ddqn vqc-native qubits=2"),
        ("vqc", "beam6g", "ddqn vqc-native qubits=3"),
    ]
    assert Counter(task for group, task, _ in found if group == "mlp") == {"beam6g": 2, "beam6g-text": 2}
    twice = study.parse(SMALL.replace("[2, 3]", "[2, 2]"), "small.toml").members()
    assert [m.group for m in twice] == ["vqc", "mlp", "mlp"]


def test_settings_replace_the_studys_own_where_an_entry_has_them() -> None:
    parsed = study.parse(SMALL, "small.toml")
    members = parsed.members([parse_setting("qubits=4"), parse_setting("algorithm.gamma=.5")])
    assert [m.entry.label for m in members if m.group == "vqc"] == ["ddqn vqc-native qubits=4 gamma=0.5"]
    assert all(m.entry.algorithm_options.gamma == 0.5 for m in members)
    assert {
        m.entry.model_options.width for m in parsed.members([parse_setting("width=7")]) if m.group == "mlp"
    } == {7}
    with pytest.raises(OptionError, match="--set widht: no entry of study 'small'"):
        parsed.members([parse_setting("widht=7")])
    with pytest.raises(OptionError, match="sides are environment, model, algorithm"):
        parsed.members([parse_setting("modl.width=7")])


def test_models_are_replaced() -> None:
    parsed = study.parse(SMALL, "small.toml")
    members = parsed.members(models={"vqc-native": "vqc-pennylane"})
    assert {m.entry.model.name for m in members} == {"vqc-pennylane", "mlp"}
    with pytest.raises(OptionError, match="no entry with model 'vqc-nativ'; did you mean 'vqc-native'"):
        parsed.members(models={"vqc-nativ": "vqc-pennylane"})


def test_every_error_of_a_file_is_named_with_its_place() -> None:
    broken = (
        SMALL.replace("summary", "sumary")
        .replace("option =", "options =")
        .replace('kind = "curves"', "kind = 3")
    )
    broken = broken.replace("grid = { qubits = [2, 3] }", "gird = { qubits = [] }")
    with pytest.raises(FileError) as caught:
        study.parse(broken, "broken.toml")
    message = str(caught.value)
    for part in (
        "broken.toml: ",
        "missing key 'summary'",
        "unknown key 'sumary'; did you mean 'summary'",
        "unknown key 'gird' in [entries.0]; did you mean 'grid'",
        "unknown key 'options' in [entries.1.match]; did you mean 'option'",
        "missing key 'entries.1.match.option'",
        "pictures.0.kind = 3",
    ):
        assert part in message, message


CONTRADICTIONS = r"""
group = "vqc" => group = "vcq" => entries.1.match.group = 'vcq' is no earlier group; did you mean 'vqc'
group = "vqc" => group = "mlp" => entries.1.match.group = 'mlp' is no earlier group
name = "vqc" => name = "mlp" => two groups are named 'mlp'
"curves" => "curves"\nentries = ["mpl"] => pictures.0.entries: no group 'mpl'; did you mean 'mlp'
"curves" => "curves"\n[[pictures]]\nkind = "bars" => two pictures are named 'picture'
"curves" => "deployed"\nevaluation.deployed = { backend = "native", values = [1] } => evaluation.deployed.vary'
qubits = [2, 3] => qubits = [] => entries.0.grid.qubits
format_version = 1 => format_version = 2 => format_version = 2
[[entries]] => [[entries => not valid TOML
"""


@pytest.mark.parametrize(("old", "new", "message"), cases(CONTRADICTIONS))
def test_studies_that_contradict_themselves(old: str, new: str, message: str) -> None:
    with pytest.raises(FileError) as caught:
        study.parse(SMALL.replace(old, new), "broken.toml")
    assert message in str(caught.value)


def test_unknown_names() -> None:
    with pytest.raises(UnknownNameError, match="unknown study 'fig66'; did you mean 'fig6'"):
        study.load("fig66")
    with pytest.raises(FileError, match="cannot be read"):
        study.load("no/such.toml")
    with pytest.raises(UnknownNameError, match="unknown model 'mpl'"):
        study.parse(SMALL.replace('model = "mlp"', 'model = "mpl"'), "small.toml").members()
    with pytest.raises(OptionError, match=r"small\.toml, group 'vqc': grid\.qubit: .* did you mean 'qubits'"):
        study.parse(SMALL.replace("qubits = [", "qubit = ["), "small.toml").members()


def test_a_study_with_looks_compares_what_agents_see(tmp_path: Path) -> None:
    """Stacked observations are another task of the same world; paths of another degree are another world."""
    words = ["mlp width=64", "mlp width=64 environment.stack=8"]
    made = looks.new("memory", "beam6g", words, tmp_path)
    assert [entry.task.file.environment.options.get("stack", 1) for entry in made.entries.values()] == [1, 8]
    with pytest.raises(OptionError, match=r"beam6g and beam6g\+\w+: a study with looks has one task"):
        looks.new("degree", "beam6g", [words[0], "mlp width=64 environment.degree=4"], tmp_path)
