"""The model of images in a loop over agents and on a task of its own, and its convolutions beside those of torch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from qrlsuite import registry, specs
from qrlsuite.population import stack
from qrlsuite.testing import check
from tests.testing.broken import assert_all_good


def test_a_loop_over_agents_keeps_every_rule_of_a_population() -> None:
    """Seeds alone, in pairs and among five: to the last bit, though torch's own convolutions are not."""
    spec = replace(
        registry.get(specs.ModelSpec, "cnn"), name="in-a-loop", population="qrlsuite.population:loop"
    )
    assert "seed independence" in assert_all_good(spec)


def test_a_tasks_observations_take_the_place_of_the_image() -> None:
    [first] = [finding for finding in check("model", "cnn", task="cartpole") if not finding.ok]
    assert (first.rule, "model 'cnn' needs images" in first.message) == ("builds", True)


@pytest.mark.parametrize(
    "form",
    [
        {"in_channels": 3, "out_channels": 5, "kernel_size": (3, 2), "stride": (2, 1), "padding": (1, 0)},
        {"in_channels": 1, "out_channels": 20, "kernel_size": 4, "bias": False, "dilation": (1, 2)},
        {"in_channels": 4, "out_channels": 4, "kernel_size": 3, "groups": 2},
        {"in_channels": 2, "out_channels": 3, "kernel_size": 3, "padding": "same"},
    ],
)
def test_a_convolution_of_a_population_is_that_of_torch(form: dict[str, object]) -> None:
    agents = [nn.Conv2d(**form) for _ in range(3)]  # type: ignore[arg-type]
    x = torch.randn(3, 7, agents[0].in_channels, 11, 12)
    expected = torch.stack([agent(each) for agent, each in zip(agents, x)])
    together = stack(agents)
    torch.testing.assert_close(together(x), expected, rtol=1e-4, atol=1e-5)
    assert together.problem is None
