"""Kinds of algorithms, models and actions on the contract: alone as in company, killed as never stopped."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.training.trainer import Trainer

TASK = """
extends = "{task}"
name = "short"
summary = "A few steps"

[environment.options]
max_episode_steps = 10

[protocol]
environments = 2
interactions = 12
validation_episodes = 2

[ranking]
horizons = [24]
"""


def entry(folder: Path, task: str, text: str) -> Entry:
    """An entry in its notation, on a task of short episodes."""
    file = folder / "task.toml"
    file.write_text(TASK.format(task=task), encoding="utf-8")
    return resolve(str(file), text)


def trained(made: Entry, seeds: Sequence[int], pause: bool = False) -> dict[str, NDArray[Any]]:
    """Everything after two epochs, seed-first; with a pause another process, as it were, goes on after the first."""
    trainer = Trainer(made, seeds)
    trainer.start()
    scores = [trainer.train_epoch().scores]
    if pause:
        saved, trainer = trainer.capture(), Trainer(made, seeds)
        trainer.restore(1, saved)
    scores.append(trainer.train_epoch().scores)
    return {**trainer.capture(), **trainer.policy(), "scores": np.stack(scores, 1)}


def assert_contract(made: Entry) -> None:
    whole = trained(made, [0, 1, 2])
    for seeds in ([1], [2, 0]):
        for name, value in trained(made, seeds, pause=True).items():
            np.testing.assert_array_equal(value, whole[name][seeds], err_msg=f"{name} of {seeds}")


SMALL = {"sac": "batch=7 warm_up=4", "td3": "batch=7 warm_up=4", "ppo": "batch=5 repeats=2"}
CIRCUIT = "qubits=3 layers=1"


@pytest.mark.parametrize(
    ("algorithm", "model"),
    [
        *((algorithm, f"vqc-native {CIRCUIT}") for algorithm in SMALL),
        ("sac", "fourier"),
        ("sac", f"vqc-pennylane {CIRCUIT}"),
        ("sac", f"vqc-qiskit {CIRCUIT}"),
        ("sac", f"vqc-native {CIRCUIT} linear=false critic=mlp output_rate=100"),
    ],
)
def test_circuits_and_features_of_continuous_actions(algorithm: str, model: str, tmp_path: Path) -> None:
    assert_contract(entry(tmp_path, "pendulum", f"{algorithm} {model} {SMALL[algorithm]}"))


def test_heads_of_circuits(tmp_path: Path) -> None:
    """Factors on what is behind the circuit, perceptrons as critics, and what does not fit."""
    text = f"td3 vqc-native {CIRCUIT} linear=false {SMALL['td3']}"
    with pytest.raises(OptionError, match="the critic 4 inputs and 1 outputs: set critic=mlp"):
        Trainer(entry(tmp_path, "pendulum", text), [0])
    trainer = Trainer(entry(tmp_path, "pendulum", f"{text} critic=mlp output_rate=100"), [0])
    assert trainer.models.trained() == {
        "classical": 1 + 2 * (5 * 64 + 65 * 64 + 65),
        "quantum": 18,
        "networks": 3,
    }
    rates = trainer.algorithm.actor_adam._lr
    assert rates["output.weight"] == pytest.approx(100 * rates["circuit.weights"])
