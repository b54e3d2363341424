"""Images in the forms that environments have them are one image to the network."""

from __future__ import annotations

import pytest
import torch
from gymnasium.spaces import Box, Discrete

from qrlsuite.errors import OptionError
from qrlsuite.gymlanes import GymLanes
from qrlsuite.plugins.models.cnn import CNN, CNNOptions, build
from tests.environments.strangers import HERE


def network(space: Box, inputs: int = 60, **options: int) -> CNN:
    return build(inputs, 3, CNNOptions(channels=4, **options), torch.Generator().manual_seed(0), space)


def test_bounds_and_the_place_of_channels_do_not_matter() -> None:
    images = torch.randint(256, (3, 6, 5, 2), generator=torch.Generator().manual_seed(1)).float()
    values = network(Box(0, 255, (6, 5, 2)))(images.flatten(1))
    torch.testing.assert_close(network(Box(-1, 1, (6, 5, 2)))(images.flatten(1) / 127.5 - 1), values)
    first = images.movedim(3, 1).flatten(1)
    torch.testing.assert_close(network(Box(0, 255, (2, 6, 5)))(first), values)
    gray = network(Box(0, 255, (6, 10)))
    torch.testing.assert_close(gray(first), network(Box(0, 255, (6, 10, 1)))(first))


def test_an_action_behind_the_image_counts() -> None:
    critic = network(Box(0, 1, (6, 5, 2)), inputs=62)
    x = torch.rand(4, 62, generator=torch.Generator().manual_seed(1))
    assert not torch.equal(critic(x), critic(torch.cat([x[:, :60], x[:, :2]], 1)))


def test_lanes_that_normalize_say_so_in_the_image_s_space() -> None:
    envs = GymLanes(f"{HERE}:Walk-v0", 1, {"kind": "image"}, normalization="bounds")
    assert envs.unflattened_space == Box(-1, 1, (2, 2))


@pytest.mark.parametrize(
    ("space", "options", "message"),
    [
        (Box(0, 1, (60,)), {}, r"needs images, a Box of \(height, width\) .*are Box.*take model 'mlp'"),
        (Discrete(60), {}, "observations are Discrete"),
        (Box(0, 1, (6, 5, 2)), {"depth": 3}, r"sides of \[2, 1\] at convolution 3, below kernel = 3: set depth=2"),
    ],
)  # fmt: skip
def test_what_is_no_image_or_too_small_is_refused(space: Box, options: dict[str, int], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        network(space, **options)
