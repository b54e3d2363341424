"""The notation of an entry: what boards print is what commands read."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from qrlsuite import notation, options
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.task import load

SHELF = Path(__file__).parents[2] / "leaderboard"
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(PLAIN)
@example("two words")
@example("it's")
@example("6")
@example("02:00:00")
@example("True")
@example("C:\\new")
@example("a\nb = 1")
@example({"entangled": "mean-field"})
def test_every_value_is_read_as_it_was_written(value: Any) -> None:
    words = notation.split(f"mlp {notation.write_setting('a', value)} b=2")
    assert len(words) == 3
    read = options.parse_setting(words[1])
    assert (read.name, repr(read.value)) == ("a", repr(value))


MODELS = {
    "mlp": {"width": st.integers(1, 64), "depth": st.integers(1, 3), "activation": st.sampled_from(["relu", "tanh"])},
    "vqc-native": {
        "qubits": st.integers(2, 8),
        "train": st.sampled_from(["all", "linear"]),
        "entangled": st.sampled_from(["mean-field", "separable"]),
    },
}  # fmt: skip
ALGORITHMS = {"gamma": st.floats(0, 1), "lr": st.floats(1e-5, 1)}


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_an_entry_is_made_again_of_its_label(data: st.DataObject) -> None:
    task = data.draw(st.sampled_from(["beam6g", "cartpole"]))
    model = data.draw(st.sampled_from(sorted(MODELS)))
    drawn = data.draw(st.fixed_dictionaries({}, optional={**MODELS[model], **ALGORITHMS}))
    algorithm = data.draw(st.sampled_from([None, "ddqn", "ppo", "reinforce"]))
    entry = resolve(task, model, algorithm, options.from_mapping(drawn))
    again = resolve(task, entry.label)
    assert again.label == entry.label
    assert (again.hash, again.preset) == (entry.hash, entry.preset)


def test_published_labels_make_the_published_entries() -> None:
    """One entry per folder of results: labels are what earlier versions wrote, byte by byte.

    But the options of an ansatz, which were written as a table.
    """
    files = [  # but the family's: its tasks are files, and have no name here
        file for place in ("entries", "unranked", "plans") for file in SHELF.glob(f"{place}/**/entry.json")
    ]
    records = [json.loads(file.read_text()) for file in files]
    kept = {
        record["label"]: record for record in records if record["task_hash"] == task_hash(record["task_name"])
    }
    assert len(kept) > 50
    for label, record in kept.items():
        entry = resolve(record["task_name"], label)
        assert entry.hash == record["hash"]
        assert entry.label == re.sub(r"ansatz_options={'(\w+)': '(\S+)'}", r"\1=\2", label)


@functools.cache
def task_hash(name: str) -> str:
    return load(name.partition("+")[0]).hash


def test_algorithm_options_and_preset_are_read(tmp_path: Path) -> None:
    written = notation.parse_entry("  ppo  mlp width=64 algorithm.lr=1e-3 preset=tuned.toml ")
    assert (written.algorithm, written.model, written.preset) == ("ppo", "mlp", "tuned.toml")
    assert [(each.side, each.name, each.value) for each in written.settings] == [
        (None, "width", 64),
        ("algorithm", "lr", 1e-3),
    ]
    assert written.given("ppo").algorithm == "ppo"
    with pytest.raises(OptionError, match="algorithm 'ddqn', and 'ppo' in the entry"):
        written.given("ddqn")


def test_a_name_with_options() -> None:
    assert notation.parse_named("slurm partition=gpu time=2:00:00 gpus=1") == (
        "slurm",
        {"partition": "gpu", "time": "2:00:00", "gpus": 1},
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "write \\[ALGORITHM\\] MODEL"),
        ("width=16", "write \\[ALGORITHM\\] MODEL"),
        ("a b c width=16", "write \\[ALGORITHM\\] MODEL"),
        ("mlp width=16 depth", "entry 'mlp width=16 depth': depth: write name=value"),
        ("mlp =16", "write name=value"),
        ("mlp widths=[1, 2", "'\\]' is missing"),
        ("mlp title='two", "a quote is open: 'two"),
    ],
)
def test_what_is_no_entry(text: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        notation.parse_entry(text)


def test_an_option_is_given_once() -> None:
    with pytest.raises(OptionError, match="entry 'mlp width=4 width=5': width is given twice: leave one out"):
        notation.parse_entry("mlp width=4 width=5")
    assert len(notation.parse_entry("mlp lr=nan lr=nan").settings) == 2
    assert len(notation.parse_entry("mlp width=4 width=4 algorithm.width=5").settings) == 3
