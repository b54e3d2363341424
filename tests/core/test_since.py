"""An option that a later version adds leaves every hash, label and stored result as it was, until it is used."""

from __future__ import annotations

import dataclasses
import json
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pydantic
import pytest
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite import options, registry, specs
from qrlsuite.errors import PluginError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import Since
from qrlsuite.plugins.algorithms import ddqn
from qrlsuite.plugins.circuits import ansatz
from qrlsuite.plugins.environments.beam6g import options as beam6g
from qrlsuite.plugins.models import mlp, vqc
from qrlsuite.results.records import EntryRecord

FROZEN = ConfigDict(extra="forbid")


@dataclass(frozen=True, config=FROZEN)
class Layer:
    size: int = 2
    norm: Annotated[bool, Field(description="normalize"), Since("0.2.0")] = False


@dataclass(frozen=True, config=FROZEN)
class LaterModel(mlp.MLPOptions):
    dropout: Annotated[float, Field(description="dropped"), Since("0.2.0")] = 0
    layers: Annotated[tuple[Layer, ...], Field(description="layers"), Since("0.2.0")] = (Layer(),)


@dataclass(frozen=True, config=FROZEN)
class LaterAlgorithm(ddqn.DDQNOptions):
    warm_up: Annotated[int, Field(description="steps before learning"), Since("0.2.0")] = 0


@dataclass(frozen=True, config=FROZEN)
class LaterEnvironment(beam6g.BeamOptions):
    wind: Annotated[list[float], Field(description="m/s"), Since("0.2.0")] = dataclasses.field(
        default_factory=list
    )


@dataclass(frozen=True, config=FROZEN)
class LaterAnsatz(ansatz.GateOptions):
    twirl: Annotated[bool, Field(description="twirled"), Since("0.2.0")] = False


LATER = {
    ("models", "mlp"): LaterModel,
    ("algorithms", "ddqn"): LaterAlgorithm,
    ("environments", "beam6g"): LaterEnvironment,
    ("ansatzes", "iqp"): LaterAnsatz,
}


@pytest.fixture
def upgrade(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Replace the options of four built-ins by those of a later version."""
    module = types.ModuleType("later")
    for cls in LATER.values():
        setattr(module, cls.__name__, cls)
    monkeypatch.setitem(sys.modules, "later", module)

    def apply() -> None:
        for (kind, name), cls in LATER.items():
            known = registry.load().entries[specs.kind(kind)]
            found = known[name]
            spec = dataclasses.replace(found.spec, options=f"later:{cls.__name__}")
            monkeypatch.setitem(known, name, dataclasses.replace(found, spec=spec))

    return apply


def words(*settings: str) -> list[options.Setting]:
    return [options.parse_setting(word) for word in settings]


def facts(entry: Entry) -> tuple[Any, ...]:
    return entry.hash, entry.name, entry.label, entry.task.hash, entry.identity


def test_at_their_defaults_they_change_nothing(tiny_task: str, upgrade: Callable[[], None]) -> None:
    before = facts(resolve(tiny_task, "mlp")), facts(resolve(tiny_task, "vqc-native"))
    record = EntryRecord.of(
        resolve(tiny_task, "mlp", settings=words("degree=4", "width=32", "lr=1e-3"))
    ).content
    upgrade()
    assert (facts(resolve(tiny_task, "mlp")), facts(resolve(tiny_task, "vqc-native"))) == before
    given = words("dropout=0.0", "warm_up=0", "wind=[]", "layers=[{}]")
    assert facts(resolve(tiny_task, "mlp", settings=given)) == before[0]
    given = words("ansatz_options={twirl = false}")
    assert facts(resolve(tiny_task, "vqc-native", settings=given)) == before[1]
    stored = json.loads(json.dumps(record))
    assert facts(EntryRecord.read(stored, "record").entry("record")) == (
        *(stored[name] for name in ("hash", "name", "label", "task_hash", "identity")),
    )


@pytest.mark.parametrize(
    ("setting", "label", "task_changes"),
    [
        ("dropout=0.5", "dropout=0.5", False),
        ("layers=[{norm = true}]", "norm", False),
        ("warm_up=3", "warm_up=3", False),
        ("wind=[1.0]", "", True),
    ],
)
def test_at_other_values_they_are_covered(
    setting: str, label: str, task_changes: bool, tiny_task: str, upgrade: Callable[[], None]
) -> None:
    before = resolve(tiny_task, "mlp")
    upgrade()
    changed = resolve(tiny_task, "mlp", settings=words(setting))
    assert changed.hash != before.hash
    assert label in changed.label
    assert (changed.task.hash != before.task.hash) == task_changes
    assert facts(EntryRecord.of(changed).entry("record")) == facts(changed)


def test_options_of_an_ansatz_are_covered_where_they_are_used(
    tiny_task: str, upgrade: Callable[[], None]
) -> None:
    before = resolve(tiny_task, "vqc-native")
    upgrade()
    changed = vqc.VQCOptions["native"](ansatz_options={"twirl": True})
    assert options.identity(changed)["ansatz_options"] == {"twirl": True}
    assert "twirl" not in str(before.identity)


def test_nested_options_are_left_out_at_any_depth() -> None:
    made = LaterModel(layers=(Layer(size=3), Layer(norm=True)))
    assert options.identity(made)["layers"] == [{"size": 3}, {"size": 2, "norm": True}]
    assert options.plain(made)["layers"] == [{"size": 3, "norm": False}, {"size": 2, "norm": True}]

    class Table(pydantic.BaseModel):
        inner: dict[str, Layer] = {"a": Layer()}

    assert options.identity(Table()) == {"inner": {"a": {"size": 2}}}


def test_a_preset_that_sets_one_shows_in_the_label_of_those_who_use_it(
    tiny_task: str, upgrade: Callable[[], None]
) -> None:
    """The label of an entry from before must stay, whatever the preset says later."""
    before = resolve(tiny_task, "mlp")
    upgrade()
    usual = "gamma = 0.95\nlr = 5e-4\nbuffer = 2000\nbatch = 64\ntarget_steps = 2000\n"
    text = Path(tiny_task).read_text() + f"[presets.new.ddqn.all]\n{usual}warm_up = 9\n"
    Path(tiny_task).write_text(text.replace('"ddqn"\n', '"ddqn"\ndefault_preset = "new"\n', 1))
    assert resolve(tiny_task, "mlp").label == f"{before.label} warm_up=9"
    assert facts(resolve(tiny_task, "mlp", settings=words("warm_up=0")))[:3] == facts(before)[:3]


def test_it_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("qrlsuite.__version__", "0.1.1")
    (row,) = [row for row in options.describe(LaterAlgorithm) if row["name"] == "warm_up"]
    assert row["description"] == "steps before learning"
    monkeypatch.setattr("qrlsuite.__version__", "0.2.0")
    rows = {row["name"]: row for row in options.describe(LaterAlgorithm)}
    assert rows["warm_up"]["since"] == "0.2.0"
    assert rows["warm_up"]["description"] == "steps before learning (since 0.2.0)"
    assert "since" not in rows["gamma"]


@pytest.mark.parametrize("version", ["", "next", "v0.2", "0", "0.2.", 0.2])
def test_a_version_is_a_version(version: Any) -> None:
    with pytest.raises(PluginError, match=r"such as 0\.2\.0"):
        Since(version)


def test_it_needs_a_default() -> None:
    @dataclass(frozen=True)
    class Wrong:
        warm_up: Annotated[int, Since("0.2.0")]

    with pytest.raises(PluginError, match=r"Wrong\.warm_up was added in 0\.2\.0 and needs a default"):
        options.identity(Wrong(warm_up=1))


def test_a_plain_dataclass_may_have_one() -> None:
    @dataclasses.dataclass(frozen=True)
    class Standard:
        width: int = 1
        warm_up: Annotated[int, Since("0.2.0")] = 0

    assert options.identity(Standard()) == {"width": 1}
    assert options.identity(Standard(warm_up=1)) == {"width": 1, "warm_up": 1}
