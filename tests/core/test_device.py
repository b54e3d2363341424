"""Where populations are trained, and what is said of a device that is not there."""

import pytest
import torch

from qrlsuite import population
from qrlsuite.device import LateChecks
from qrlsuite.errors import OptionError
from qrlsuite.training import device
from tests.algorithms.worlds import Contexts, Group


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


@pytest.mark.parametrize(("model", "decay_steps"), [("mlp", None), ("vqc-native", None), ("mlp", 7)])
def test_an_update_reads_nothing_from_the_device(monkeypatch, model, decay_steps):
    """Tensors of the device `meta` have no numbers: `item`, `bool`, `numpy`, `nonzero` and `cpu` of them raise."""
    monkeypatch.setattr(LateChecks, "_open", LateChecks())
    ddqn = Group(
        "ddqn", [0, 1], Contexts(4), model, device="meta", decay_steps=decay_steps, buffer=5
    ).algorithm
    seen, value = torch.zeros((2, 2, ddqn.obs_dim), device="meta"), torch.zeros((2, 2), device="meta")
    ddqn._hold(seen)
    for epoch in range(3):
        ddqn.adam.decay(epoch, decay_steps)
        ddqn.replay.add(seen=seen, after=seen, action=value, reward=value, alive=value)
        assert ddqn._learn(torch.zeros((2, 8), dtype=torch.float64, device="meta")).is_meta
    assert ddqn.replay.stored == 6
    assert len(LateChecks._open._flags) == (model == "vqc-native")


def test_numbers_on_a_device_are_checked_where_the_block_ends():
    checks, owner = LateChecks(), object()

    def note(*found):
        with checks:
            assert all(
                LateChecks.note(owner, torch.tensor(each), lambda: OptionError("late")) for each in found
            )
            if not found:
                raise KeyError

    assert not LateChecks.note(owner, torch.tensor(True), OptionError)
    with pytest.raises(OptionError, match="late"):
        note(False, True)
    note(True)
    with pytest.raises(KeyError):  # is not hidden
        note()


@pytest.mark.parametrize("agents", [1, 3, 100])
@pytest.mark.parametrize("betas", [(0.9, 0.999), (0.0, 0.99)])
def test_the_corrections_of_a_device_are_those_of_the_cpu(agents, betas):
    table = population._correction_table(betas, torch.device("cpu"))
    for steps in (1, 2, 999, 36_000, 50_000, 10**7):
        for kept, computed in zip(table, population._corrected(betas, torch.full((agents,), steps))):
            assert torch.equal(kept[min(steps, len(kept) - 1)].expand(agents), computed)
