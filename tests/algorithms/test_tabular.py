"""An algorithm without a network: it keeps the rules, is trained as an entry with model `none`, and no other."""

from __future__ import annotations

from dataclasses import replace

import pytest

from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.testing import check
from qrlsuite.training.trainer import Trainer
from tests.algorithms.tabular import SPEC, Options


def entry(model: str) -> Entry:
    return replace(resolve("gym:FrozenLake-v1", model), algorithm=SPEC, algorithm_options=Options())


def test_it_keeps_every_rule() -> None:
    assert not [finding for finding in check("algorithm", SPEC) if not finding.ok]


def test_it_is_trained_without_a_model() -> None:
    trainer = Trainer(entry("none"), [0, 1])
    trainer.start()
    epoch = trainer.train_epoch()
    assert epoch.scores.shape == (2, trainer.V)
    assert trainer.models.trained() == {"classical": 0, "quantum": 0, "networks": 0}
    state = trainer.capture()
    resumed = Trainer(entry("none"), [1])
    resumed.restore(1, {name: array[1:] for name, array in state.items()})
    assert (resumed.train_epoch().scores == trainer.train_epoch().scores[1:]).all()


def test_a_model_that_nothing_uses_is_refused_and_so_is_none_where_one_is_used(tiny_task: str) -> None:
    with pytest.raises(
        OptionError, match=r"'tabular' builds no network, so that model 'mlp' .* write 'tabular none'"
    ):
        Trainer(entry("mlp"), [0])
    with pytest.raises(
        OptionError, match="model 'none' is for algorithms that build no network, and this one does"
    ):
        Trainer(resolve(tiny_task, "none", "ddqn"), [0])
