"""Task files: every one loads, and every mistake is named with its path and the nearest match."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qrlsuite import registry, specs
from qrlsuite.errors import FileError, OptionError, QrlSuiteError
from qrlsuite.experiment import entry, task
from qrlsuite.hookspecs import hookimpl
from tests.conftest import TINY, cases


def test_the_hash_covers_the_definition_and_nothing_else() -> None:
    base = task.parse(TINY, "t")
    assert task.parse(TINY.replace("A beam", "Another beam"), "t").hash == base.hash
    assert task.parse(TINY.replace("epochs = 3", "epochs = 7"), "t").hash == base.hash
    assert task.parse(TINY.replace("degree = 3", "degree = 4"), "t").hash != base.hash
    assert task.parse(TINY.replace("episodes = 5", "episodes = 6"), "t").hash != base.hash


MISTAKES = r"""
epochs = 3 => epoch = 3 => t.toml: unknown key 'epoch' in [protocol]; did you mean 'epochs'
[protocol] => [protocoll] => unknown key 'protocoll'; did you mean 'protocol'
interactions = 60 =>  => missing key 'protocol.interactions'
interactions = 60 => interactions = 61 => interactions = 61 is not a multiple of environments = 4
seeds = 4 => seeds = 'four' => protocol.seeds = 'four'
seeds = 4 => seeds = 9{5000} => not valid TOML: too large a value
name = "beam6g" => name = "beam6h" => t.toml: environment.name: unknown environment 'beam6h'; did you mean 'beam6g'
name = "tiny" => name = "tiny task" => name = 'tiny task'
degree = 3 => degre = 3 => no option 'degre'; did you mean 'degree'
degree = 3 => degree = [{5000}]{5000} => not valid TOML: too large a value: maximum recursion
deltas = [0.5, 0.75] => deltas = [0.5, 1.5] => ranking.deltas.1 = 1.5
deltas = [0.5, 0.75] => deltas = [0.5]\npolicies = {random = nan} => ranking.policies.random = nan
deltas = [0.5, 0.75] => deltas = [0.5]\npolicies = {"<b>" = 0.1} => ranking.policies
deltas = [0.5, 0.75] => deltas = [0.5]\npolicies = {random = 22.0} => random = 22: scores of this task
deltas = [0.5, 0.75] => deltas = [0.5]\npolicies = {random = true} => ranking.policies.random = True
deltas = [0.5, 0.75] => deltas = [0.5, 0.5] => deltas: 0.5 is there twice
epsilons = [0.6, 0.8] =>  => give either epsilons
epsilons = [0.6, 0.8] => epsilons = [0.6, 0.8, 0.60] => epsilons: 0.6 is there twice, and its cells would
epsilon = 0.6, delta => threshold = 0.6, delta => the reference cell needs epsilon and delta
horizons = [180] => horizons = [180, 180] => horizons: 180 is there twice
format_version = 1 => format_version = 2 => format_version = 2
steps = 20 => steps = 20 = 3 => not valid TOML
[ranking] => [score]\nsource = 'return'\nmax_return = -5\n[ranking] => score.max_return = -5: Input should be greater
[ranking] => [score]\nsource = 'return'\nmax_return = nan\n[ranking] => max_return = nan: Input should be a finite
[ranking] => [score]\nsource = 'return'\nmax_return = inf\n[ranking] => max_return = inf: Input should be a finite
default_algorithm = "ddqn" => default_preset = "relesed" => default_preset 'relesed'; none is registered
"""
THRESHOLDS = """
thresholds = [1.0, nan, 1.0] => thresholds[1] = nan is not finite
thresholds = [1.0, inf, 1.0] => thresholds[1] = inf is not finite
thresholds = [1.0, 2.5, 1.0] => thresholds: 1.0 is there twice
thresholds = [1.0, 2.5]; threshold = nan => nan is not finite
"""


@pytest.mark.parametrize(("thresholds", "message"), cases(THRESHOLDS))
def test_mistakes_in_thresholds_are_named(thresholds: str, message: str) -> None:
    every, _, reference = thresholds.partition("; ")
    text = TINY.replace("epsilons = [0.6, 0.8]", every).replace(
        "epsilon = 0.6", reference or "threshold = 1.0"
    )
    with pytest.raises(QrlSuiteError, match=re.escape(message)):
        task.parse(text, "t.toml")


@pytest.mark.parametrize(("old", "new", "message"), cases(MISTAKES))
def test_mistakes_are_named(old: str, new: str, message: str) -> None:
    assert old in TINY
    new = re.sub(r"(.)\{5000\}", lambda many: many[1] * 5000, new)
    with pytest.raises(QrlSuiteError, match=re.escape(message)):
        task.parse(TINY.replace(old, new), "t.toml")


def test_all_mistakes_are_named_at_once() -> None:
    text = (
        TINY.replace("epochs = 3", "epoch = 3")
        .replace("seeds = 4", "seeds = 0")
        .replace("interactions = 60", "")
        .replace("degree = 3", "degree = 1\nstep = 20")
    )
    with pytest.raises(FileError) as caught:
        task.parse(text, "t.toml")
    for part in ("'epoch'", "protocol.seeds = 0", "protocol.interactions", "environment.options: degree = 1"):
        assert part in str(caught.value)
    assert "environment.options has no option 'step'; did you mean 'steps'" in str(caught.value)
    with pytest.raises(
        FileError, match=r"protocol\.seeds = 0.*environment\.name: unknown environment 'beam6h'"
    ):
        task.parse(TINY.replace("seeds = 4", "seeds = 0").replace('name = "beam6g"', 'name = "beam6h"'), "t")


def test_a_preset_that_says_nothing_of_an_algorithm_is_not_its_preset() -> None:
    """An entry of an algorithm of somebody's own is not called `tuned` by the task's default preset."""
    presets = "[presets.tuned.ppo.quantum]\nlr = 0.1\n[presets.tuned.ddqn.all]\nlr = 0.2\n"
    text = TINY.replace("[environment]", 'default_preset = "tuned"\n[environment]', 1) + presets
    read = task.parse(text, "t.toml")
    field = task.starting_values("ddqn")  # of options that the preset leaves out
    assert field["target_steps"] == 50
    assert read.preset(None, "ddqn", "classical") == ("tuned", {**field, "lr": 0.2})
    assert read.preset(None, "ppo", "quantum") == ("tuned", {"lr": 0.1})
    assert read.preset(None, "ppo", "classical") == (None, {})
    assert read.preset(None, "mine", "classical") == (None, {})
    named = task.parse(TINY + presets.replace("tuned", "default"), "t.toml")
    assert named.preset(None, "ddqn", "classical") == ("default", {**field, "lr": 0.2}), (
        "chosen where the file names none"
    )
    with pytest.raises(
        FileError, match=r"'tuned' says nothing about algorithm 'mine', only about ppo, ddqn: leave"
    ):
        read.preset("tuned", "mine", "classical")
    with pytest.raises(FileError, match=r"says nothing about algorithm 'ppo' with classical models, only"):
        read.preset("tuned", "ppo", "classical")


def test_a_mistake_in_a_preset_is_named_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "t.toml"
    path.write_text(
        TINY
        + "\n[presets.mine.ddqn.all]\ngama = 0.9\n[presets.other.ddqn.quantum]\nlr = -1\n[presets.other.ppo.all]\n"
    )
    with pytest.raises(FileError) as caught:
        entry.resolve(str(path), "mlp")  # although it takes neither
    assert str(caught.value).startswith(
        "t.toml: presets.mine.ddqn has no option 'gama'; did you mean 'gamma'?; "
    )
    assert "presets.other.ddqn: lr = -1" in str(caught.value)
    assert str(caught.value).count("gama") == 1


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("nine.ddqn.all", "tuning: no preset 'nine'; did you mean 'mine'"),
        ("mine.ddpn.all", "tuning.mine: the preset says nothing of 'ddpn'; did you mean 'ddqn'"),
        ("mine.ddqn.quantm", "tuning.mine.ddqn.quantm"),
        ("mine.ddqn.all]\ntrails = 3\n[score", "unknown key 'trails' in .*; did you mean 'trials'"),
    ],
)
def test_a_mistake_in_what_tuning_took_is_named(table: str, message: str) -> None:
    with pytest.raises(FileError, match=message):
        task.parse(f"{TINY}[presets.mine.ddqn.all]\nlr = 0.1\n[tuning.{table}]\n", "t.toml")


def test_a_bad_setting_is_not_blamed_on_the_file() -> None:
    with pytest.raises(OptionError, match=r"^environment 'beam6g': degree = 1: at least 2"):
        task.parse(TINY, "t.toml").with_environment({"degree": 1})


def test_a_file_that_is_not_there() -> None:
    with pytest.raises(FileError, match="cannot be read"):
        task.load("nowhere/at-all.toml")


@given(st.text(max_size=200))
def test_no_text_gives_a_traceback(text: str) -> None:
    with pytest.raises(QrlSuiteError):
        task.parse(text, "t.toml")


@given(st.integers(0, len(TINY) - 1), st.characters(codec="utf-8"))
def test_no_changed_character_gives_a_traceback(position: int, character: str) -> None:
    with contextlib.suppress(QrlSuiteError):
        task.parse(TINY[:position] + character + TINY[position + 1 :], "t.toml")


def test_other_environment_options_make_another_task(tmp_path: Path) -> None:
    base = task.parse(TINY, "t")
    other = base.with_environment({"degree": 4})
    assert other.hash != base.hash
    assert other.name == f"tiny+{other.hash[:8]}"
    assert base.with_environment({"degree": 3}).name == "tiny"


def test_scores_of_policies_are_no_part_of_a_task_and_hold_in_its_own_environment_alone() -> None:
    stated = TINY.replace("[ranking]\n", "[ranking]\npolicies = { random = 0.4 }\n")
    base = task.parse(stated, "t")
    assert base.hash == task.parse(TINY, "t").hash
    assert base.file.ranking.policies == base.with_environment({"degree": 3}).file.ranking.policies != {}
    assert base.with_environment({"degree": 4}).file.ranking.policies == {}
    assert "policies" not in task.parse(TINY, "t").file.ranking.model_dump()
    head = 'format_version = 1\nextends = "pulse"\nname = "other"\nsummary = "Another"\n'
    assert task.parse(head, "t").file.ranking.policies == task.load("pulse").file.ranking.policies != {}
    longer = task.parse(f"{head}[environment.options]\nsteps = 30\n", "t")
    assert longer.file.ranking.policies == {}


def test_tasks_that_extend_beam6g_are_those_they_were_when_their_files_were_whole() -> None:
    later = {"beam6g-angle", "beam6g-stack"}  # they never had whole files
    known = registry.load().names(specs.TaskSpec)
    names = [name for name in known if name.startswith("beam6g-") and name not in later]
    assert len(names) == 24
    assert task.digest({name: task.load(name).hash for name in names}) == "9ceffffafc875806"


def test_a_task_extends_another() -> None:
    head = 'format_version = 1\nextends = "beam6g-degree4"\nname = "longer"\nsummary = "Longer"\n'
    base, longer = task.load("beam6g-degree4"), task.parse(f"{head}[environment.options]\nsteps = 300\n", "t")
    assert longer.file.environment.options == {**base.file.environment.options, "degree": 4, "steps": 300}
    assert longer.file.presets == base.file.presets
    assert (longer.name, longer.hash == base.hash) == ("longer", False)
    assert task.parse(head, "t").hash == base.hash, "a name is no part of the definition"
    assert task.parse(f"{head}[ranking]\nepsilons = [0.5]\n", "t").file.ranking.epsilons == [0.5], (
        "lists are whole"
    )


@pytest.mark.parametrize(
    ("extends", "message"),
    [
        ('"beam6h"', "t.toml: extends: unknown task 'beam6h'; did you mean 'beam6g'"),
        ("3", "t.toml: extends = 3: name a task"),
    ],
)
def test_what_cannot_be_extended_is_named(extends: str, message: str) -> None:
    with pytest.raises(FileError, match=message):
        task.parse(f"extends = {extends}\n{TINY}", "t.toml")


class Circle:
    """Registers two tasks that extend each other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @hookimpl
    def register_tasks(self, register: Callable[[specs.TaskSpec], None]) -> None:
        for name, other in (("one", "two"), ("two", "one")):
            path = self.folder / f"{name}.toml"
            path.write_text(f'extends = "{other}"\nname = "{name}"\n')
            register(specs.TaskSpec(name=name, summary="A circle", path=str(path)))


def test_tasks_that_extend_each_other_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fresh = registry.create(strict=True)
    fresh.add_plugin(Circle(tmp_path), "circle")
    monkeypatch.setattr(registry, "load", lambda: fresh)
    with pytest.raises(FileError, match=r"one\.toml: a task extends itself: two -> one -> two"):
        task.load("one")
