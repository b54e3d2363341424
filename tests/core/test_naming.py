"""What an entry answers to on the command line, and what is said where a name fits none or several."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from qrlsuite import notation
from qrlsuite.errors import UnknownNameError
from qrlsuite.experiment.entry import resolve
from qrlsuite.results import lookup
from qrlsuite.results.store import entries
from tests.commands import say
from tests.conftest import TINY, cases, trainer


class Entry(NamedTuple):
    label: str
    task: str
    name: str


SEVERAL = [
    Entry("ddqn mlp width=16", "beam6g", "ddqn-mlp-11111111"),
    Entry("ddqn mlp width=16", "beam6g-degree4", "ddqn-mlp-22222222"),
    Entry("ppo mlp width=16", "beam6g", "ppo-mlp-33333333"),
    Entry("ddqn mlp width=8", "beam6g", "ddqn-mlp-66666666"),
    Entry("ddqn mlp width=8", "beam6g", "ddqn-mlp-77777777"),
    Entry("ddqn mlp width=64", "beam6g", "ddqn-mlp-44444444"),
    Entry("ddqn mlp width=64 depth=3", "beam6g", "ddqn-mlp-55555555"),
]


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("ddqn mlp width=64", 5),
        ("mlp width=64", 5),
        ("mlp width=64 d", 6),
        ("44444444", 5),
        ("ddqn-mlp-5", 6),
        ("beam6g-degree4/mlp width=16", 1),
        ("beam6g/ddqn mlp width=16", 0),
        ("beam6g-degree4/", 1),
        ("beam6g/mlp depth=3 width=64", 6),
        ("mlp depth=3.0 width=6.4e1", 6),
    ],
)
def test_an_entry_answers_to(name: str, found: int) -> None:
    assert lookup.choose(SEVERAL, name, "runs") is SEVERAL[found]


def test_an_entry_answers_to_what_run_was_given() -> None:
    typed = "mlp lr=0.01"  # its label has the options of CartPole's preset, too
    entry = resolve("cartpole", notation.parse_entry(typed))
    assert typed not in entry.label
    known = [Entry(entry.label, "cartpole", entry.name), *SEVERAL]
    assert lookup.choose(known, typed, "runs") is known[0]
    usual = [resolve("cartpole", words) for words in ("vqc-native", "vqc-native layers=2")]
    known = [Entry(each.label, "cartpole", each.name) for each in usual]
    assert lookup.choose(known, "vqc-native", "runs") is known[0]
    known = [Entry(f"ddqn mlp width={width}", "beam6g", f"ddqn-mlp-{width}") for width in (16, 64)]
    assert lookup.choose(known, "mlp", "runs") is known[1]
    assert lookup.fitting(known, "mlp") == known, "where several are asked for, it is the beginning of both"


def test_a_default_that_was_not_typed_is_not_needed_where_the_plugin_is_gone() -> None:
    known = [
        Entry(f"my-ppo mlp width={width} norm=none", "beam6g", f"my-ppo-mlp-{width}") for width in (16, 64)
    ]
    assert lookup.choose(known, "my-ppo mlp norm=none", "runs") is known[1]
    with pytest.raises(UnknownNameError, match=r"(no entry|begins with) .my-ppo mlp norm=x"):
        lookup.choose(known, "my-ppo mlp norm=x", "runs")
    with pytest.raises(UnknownNameError, match="no entry"):
        lookup.choose(known, "mlp lr=0.02", "runs")


SEVERAL_OR_NONE = """
ddqn mlp width=16 => may be any of 'beam6g-degree4/ddqn mlp width=16', 'beam6g/ddqn mlp width=16': write
beam6g/mlp width=16 => may be any of 'beam6g/ddqn mlp width=16', 'ppo mlp width=16': write one of these
width=64 => no entry begins with 'width=64'; did you mean 'ddqn mlp width=64', 'ddqn mlp width=64 depth=3'?
mpl width=64 => no entry 'mpl width=64' in runs; did you mean 'mlp width=64'?
x => no entry 'x' in runs; known: mlp width=16, mlp width=64, mlp width=64 depth=3, mlp width=8
"""


@pytest.mark.parametrize(("name", "message"), cases(SEVERAL_OR_NONE))
def test_a_name_that_fits_none_or_several(name: str, message: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        lookup.choose(SEVERAL, name, "runs")
    assert str(caught.value).removeprefix(f"'{name}' ").startswith(message)


def test_what_is_offered_is_found() -> None:
    """Labels are told apart by the task; where one task has two entries of a label, by the name."""
    with pytest.raises(UnknownNameError) as caught:
        lookup.choose(SEVERAL, "ddqn", "runs")
    offered = str(caught.value).split("'")[3::2]
    found = {lookup.choose(SEVERAL, word, "runs").name for word in offered}
    assert found == {e.name for e in SEVERAL if e.label.startswith("ddqn")}


def test_long_lists_are_cut() -> None:
    many = [Entry(f"ddqn mlp width={width}", "beam6g", f"ddqn-mlp-{width}") for width in range(100, 160)]
    for name in ("mlp", "q"):
        with pytest.raises(UnknownNameError, match=r"mlp width=119'? and 40 more"):
            lookup.choose(many, name, "runs")


def test_a_task_is_known_by_registration_or_by_its_results(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    assert lookup.task_names(tmp_path, ["mine", "beam6g"]) == ["mine", "beam6g"]
    assert lookup.task_names(tmp_path / "nowhere", ["beam6g"]) == ["beam6g"]
    assert lookup.task_name(tmp_path, None) is None
    (tmp_path / "own.toml").write_text(TINY)
    assert lookup.task_names(tmp_path, [str(tmp_path / "own.toml"), "gym:CartPole-v1"]) == [
        "tiny",
        "gym-cartpole-v1",
    ]
    with pytest.raises(UnknownNameError, match="unknown task 'mime'; did you mean 'mine'"):
        lookup.task_names(tmp_path, ["mine", "mime"])


def test_a_damaged_entry_is_called_by_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "beam6g" / "ddqn-mlp-88888888"
    folder.mkdir(parents=True)
    (folder / "entry.json").write_text("{")
    (found,) = lookup.stored(entries(tmp_path))
    assert lookup.choose([found], "ddqn-mlp-8", tmp_path).store.path == folder
    with pytest.raises(UnknownNameError, match="known: ddqn-mlp-88888888"):
        lookup.choose([found], "x", tmp_path)


@pytest.fixture(scope="module")
def two_tasks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of two tasks with entries of the same labels."""
    root = tmp_path_factory.mktemp("two")
    for name in ("tiny", "other"):
        (root / "tiny.toml").write_text(
            TINY.replace('"tiny"', f'"{name}"').replace("degree = 3", f"degree = {len(name)}")
        )
        for width in (8, 16):
            trainer(str(root / "tiny.toml"), root)("runs", [0, 1], 1, settings=(f"width={width}",))
    return root


@pytest.mark.parametrize(
    "words",
    [
        ("compare", "mlp width=8", "mlp width=16"),
        ("evaluate", "mlp width=8", "mlp width=16", "--episodes", "2"),
        ("export", "mlp width=8", "--out", "out"),
        ("plot", "curves", "--entry", "mlp width=8", "--out", "p.png"),
    ],
)
def test_a_task_narrows_the_search(
    words: tuple[str, ...], two_tasks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(two_tasks)
    with pytest.raises(
        UnknownNameError, match="may be any of 'other/ddqn mlp width=8', 'tiny/ddqn mlp width=8'"
    ):
        say(*words)
    for task in ("tiny", "other"):
        assert say(*words, "--task", task).exit_code == 0
    if words[0] == "compare":  # the task of one says which the other is
        assert say("compare", "mlp width=8", "other/mlp width=16").exit_code == 0
    with pytest.raises(UnknownNameError, match="did you mean 'tiny'"):
        say(*words, "--task", "tny")
    with pytest.raises(UnknownNameError, match="no entry 'ddqn vqc' in runs, task tiny"):
        say(*(word.replace("mlp width=8", "ddqn vqc") for word in words), "--task", "tiny")


def test_an_entry_of_later_code_is_meant_where_its_mark_is_written() -> None:
    known = [
        Entry("ddqn vqc-native qubits=4 layers=2", "beam6g", "ddqn-vqc-native-1"),
        Entry("ddqn vqc-native qubits=4 layers=2 @ad9d", "beam6g", "ddqn-vqc-native-1@ad9d"),
    ]
    assert lookup.choose(known, "vqc-native qubits=4 layers=2", "runs") is known[0]
    for name in ("vqc-native", "vqc-native layers=2 qubits=4"):
        with pytest.raises(UnknownNameError, match=r"any of 'ddqn vqc-native .*=2', '.*=2 @ad9d': write one"):
            lookup.choose(known, name, "runs")
    assert lookup.choose(known, "vqc-native qubits=4 layers=2 @a", "runs") is known[1]
    assert lookup.choose(known, "beam6g/vqc-native layers=2 qubits=4 @a", "runs") is known[1]
    assert lookup.choose(known[1:], "vqc-native", "runs") is known[1]
