"""Where populations are trained, and what is said of a device that is not there."""

import pytest
import torch

from qrlsuite.errors import OptionError
from qrlsuite.training import device


@pytest.mark.parametrize("name", ["cpu", "cuda", "cuda:1"])
def test_devices_that_there_can_be(name):
    assert device.check(name) == name


@pytest.mark.parametrize("name", ["cudda", "mps", "meta", "cuda:", "cuda:-1", "cuda:1\n", "", "CPU"])
def test_devices_that_there_cannot_be(name):
    with pytest.raises(OptionError, match="give cpu, cuda, or one GPU of several as cuda:1") as caught:
        device.find(name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("count", "name", "message"),
    [
        (0, "cuda", "torch sees no GPU here .*; train on --device cpu"),
        (0, "cuda:1", "torch sees no GPU here"),
        (2, "cuda:2", "this machine has GPUs 0 to 1"),
        (2, "cuda:1", None),
        (1, "cuda", None),
        (0, "cpu", None),
    ],
)
def test_gpus_are_looked_for_where_training_is_done(monkeypatch, count, name, message):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    if message is None:
        assert device.find(name) == torch.device(name)
    else:
        with pytest.raises(OptionError, match=message):
            device.find(name)
