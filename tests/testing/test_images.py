"""The model of images in a loop over agents and on a task of its own, and its convolutions beside those of torch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from qrlsuite import registry, specs
from qrlsuite.population import stack
from qrlsuite.testing import check
from tests.testing.broken import assert_all_good, edit, module, own_rules


def test_a_loop_over_agents_keeps_every_rule_of_a_population() -> None:
    """Seeds alone, in pairs and among five: to the last bit, though torch's own convolutions are not."""
    spec = replace(
        registry.get(specs.ModelSpec, "cnn"), name="in-a-loop", population="qrlsuite.population:loop"
    )
    assert "seed independence" in assert_all_good(spec)


def test_a_tasks_observations_take_the_place_of_the_image() -> None:
    [first] = [finding for finding in check("model", "cnn", task="cartpole") if not finding.ok]
    assert (first.rule, "model 'cnn' needs images" in first.message) == ("builds", True)


EYES = """
from pydantic.dataclasses import dataclass
from torch import nn
from qrlsuite.errors import OptionError


@dataclass(frozen=True)
class Options:
    pass


class Eyes(nn.Module):
    def __init__(self, outputs, shape):
        super().__init__()
        self.shape = shape
        self.first, self.last = nn.Conv2d(shape[-1], 4, 3), nn.Linear(4, outputs)

    def forward(self, x):
        images = x.view(*x.shape[:-1], *self.shape).movedim(-1, -3)
        return self.last(self.first(images).relu().mean((-2, -1)))


def build(inputs, outputs, options, generator, space):
    if space.shape is None or len(space.shape) != 3 or space.shape[0] < 3:
        raise OptionError("not such an image")
    return Eyes(outputs, space.shape)
"""


@pytest.mark.parametrize(
    ("edits", "broken"),
    [
        ((), {}),
        ((" or space.shape[0] < 3", ""), {"an image, channels first": "Kernel size can't be greater than"}),
        (("space.shape is None or", ""), {"a Dict": "TypeError"}),
    ],
    ids=["good", "channels-first", "dict"],
)
def test_all_observations_that_a_model_does_not_refuse_are_tried(
    edits: tuple[str, ...], broken: dict[str, str]
) -> None:
    name = module(edit("", "", *edits).of(EYES))
    findings = own_rules(
        specs.ModelSpec("eyes", "Sees", "classical", options=f"{name}:Options", build=f"{name}:build")
    )
    messages = {finding.rule: finding.message for finding in findings if not finding.ok}
    assert messages.keys() == broken.keys()
    assert all(text in messages[rule] for rule, text in broken.items()), messages


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
