"""What groups need in memory, by cases computed by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from pydantic.dataclasses import dataclass

from qrlsuite.errors import OptionError, PluginError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.specs import AlgorithmSpec, ModelSpec
from qrlsuite.training import memory
from qrlsuite.training.memory import PROCESS, group_bytes
from tests.commands import say

GB = 10**9
HERE = __name__
BUFFER = 2000 * 11 * 4 * 3
"""Of one seed of beam6g: 2000 rows of two observations of 4 numbers and 3 more, of 4 bytes, with their copies."""
DRAWS = 200 * 64 * 8
"""Of one seed of beam6g: 200 rounds of 64 places in its buffer, of 8 bytes."""


def entry(model: str, *words: str, algorithm: str = "ddqn") -> Entry:
    return resolve("beam6g", " ".join((algorithm, model, *words)))


def test_networks_and_replay_buffers() -> None:
    wide = entry("mlp", "width=4096", "depth=3")
    weights = 2 * 4096**2 * 4  # bytes of one network; 13 = 4 networks and moments, three times, and gradients
    assert group_bytes(wide, 1) == PROCESS + 13 * weights + BUFFER + DRAWS
    assert group_bytes(wide, 10) - PROCESS == 10 * (group_bytes(wide, 1) - PROCESS)
    long = entry("mlp", "width=1", "depth=1", "buffer=1000000")
    assert group_bytes(long, 1) == PROCESS + 500 * BUFFER + DRAWS
    assert group_bytes(entry("mlp", "width=100", "depth=2", algorithm="ppo"), 1) == PROCESS + 19 * 40_000


def test_circuit_states() -> None:
    def states(made: Entry, seeds: int) -> int:
        return group_bytes(made, seeds) - PROCESS - seeds * (BUFFER + DRAWS)

    ten = 2**10
    assert states(entry("vqc-native", "qubits=10"), 5) == (5 * 64 * 8 + 384) * ten
    assert states(entry("vqc-native", "qubits=10", "dtype=float64"), 5) == (5 * 64 * 16 + 384) * ten
    assert states(entry("vqc-native", "qubits=20"), 5) == 384 * 2**20, "too many to be kept: computed again"
    lane = 64 * 4 * 10 * ten
    assert states(entry("vqc-pennylane", "qubits=10"), 2) == 2 * 64 * lane
    assert states(entry("vqc-pennylane", "qubits=10"), 50) == 2**30, "seeds in turns"
    assert states(entry("vqc-pennylane", "qubits=16"), 50) == 64 * 64 * 4 * 16 * 2**16, "one seed at a time"
    assert states(entry("vqc-pennylane", "qubits=10", "device=lightning.qubit"), 2) == 0
    assert states(entry("vqc-pennylane", "qubits=10", "shots=100"), 2) == 0


def test_what_does_not_fit_is_refused_with_what_would() -> None:
    big = entry("mlp", "width=4096", "depth=3")  # 1.75 GB for a seed, .31 for a process
    groups = [range(5), range(5, 10)]
    memory.require(big, groups, 2, 100 * GB)
    memory.require(big, groups, 2, None)
    memory.require(big, groups, 1, 12 * GB)  # one group at a time
    with pytest.raises(OptionError, match=r"10 seeds at a time takes 18 GB .* 12 GB are free here") as said:
        memory.require(big, groups, 2, 12 * GB)
    assert "first --seeds 0:6; what is trained stays" in str(said.value)
    with pytest.raises(OptionError, match=r"first --seeds 0:1 --workers 1; "):
        memory.require(big, groups, 2, 3 * GB)
    with pytest.raises(
        OptionError, match=r"not even one seed fits: make the model smaller .`qrlsuite show model mlp`"
    ):
        memory.require(big, groups, 2, 1 * GB)


@dataclass(frozen=True)
class OwnOptions:
    width: int = 5
    qubits: str = "many"
    frequencies: str = "all"
    buffer: str = "none"


def bytes_of_mine(options: OwnOptions, agents: int, batch: int, copies: int) -> int:
    return agents * options.width


def none_of_mine(*given: object) -> float:
    return 0.5


def broken(*given: object) -> int:
    raise ValueError("no width")


def strange(memory: str | None) -> Entry:
    spec = ModelSpec("mine", "Mine", "classical", f"{HERE}:OwnOptions", f"{HERE}:broken", memory=memory)
    return replace(entry("mlp"), model=spec, model_options=OwnOptions())


def test_a_third_party_s_options_mean_what_they_mean_to_it() -> None:
    """No option is taken for a built-in's of that name: what a spec does not say is unknown."""
    assert group_bytes(strange(None), 3) == PROCESS + 3 * (BUFFER + DRAWS)
    assert group_bytes(strange(f"{HERE}:bytes_of_mine"), 3) == group_bytes(strange(None), 3) + 15
    learner = AlgorithmSpec("learner", "Mine", f"{HERE}:OwnOptions", f"{HERE}:broken")
    own = replace(entry("mlp", "width=100"), algorithm=learner, algorithm_options=OwnOptions())
    assert group_bytes(own, 1) == PROCESS + 4 * 40_000, "its weights: saved three times, and gradients"


@pytest.mark.parametrize(
    ("memory", "message"),
    [("broken", "fails: ValueError: no width"), ("none_of_mine", "returned 0.5, and must return a whole")],
)
def test_memory_that_is_no_number_is_named(memory: str, message: str) -> None:
    with pytest.raises(PluginError, match=f"^'mine': memory = '{HERE}:{memory}' {message}"):
        group_bytes(strange(f"{HERE}:{memory}"), 1)


def test_what_is_free_is_read_or_at_least_what_the_machine_has(tmp_path: Path) -> None:
    file = tmp_path / "meminfo"
    file.write_text("MemTotal:       24576 kB\nMemFree:  100 kB\nMemAvailable:   2048 kB\n")
    assert memory.available(file) == 2 << 20
    for damaged in ("", "MemAvailable:\n", "MemAvailable: x kB\n"):
        file.write_text(damaged)
        whole = memory.available(file)
        assert whole is None or whole > 1 << 24
    assert memory.available(tmp_path / "gone") == whole


def test_it_is_refused_before_an_entry_s_folder_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "available", lambda: GB)
    runs = tmp_path / "runs"
    where = ["--task", "beam6g", "--runs", str(runs), "--seeds", "4"]
    for words in (
        ["run", "mlp", "width=4096", *where],
        ["tune", "mlp width=4096", *where, "--vary", "lr=[1e-2, 1e-3]"],
    ):
        with pytest.raises(OptionError, match=r"of memory or more, and 1\.0 GB are free here"):
            say(*words)
        assert not [*runs.rglob("entry.json")]
