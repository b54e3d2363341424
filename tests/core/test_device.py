"""Where populations are trained, and what is said of a device that is not there."""

import numpy as np
import pytest
import torch

from qrlsuite import options, population, registry, specs
from qrlsuite.device import LateChecks
from qrlsuite.errors import OptionError
from qrlsuite.experiment import entry as entries
from qrlsuite.training import devices
from qrlsuite.training.trainer import Trainer
from tests.algorithms.worlds import Contexts, Group


@pytest.mark.parametrize("name", ["cpu", "cuda", "cuda:1"])
def test_devices_that_there_can_be(name):
    assert devices.check(name) == name


@pytest.mark.parametrize("name", ["cudda", "mps", "meta", "cuda:", "cuda:-1", "cuda:1\n", "", "CPU"])
def test_devices_that_there_cannot_be(name):
    with pytest.raises(OptionError, match="give cpu, cuda, or one GPU of several as cuda:1") as caught:
        devices.find(name)
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
        assert devices.find(name) == torch.device(name)
    else:
        with pytest.raises(OptionError, match=message):
            devices.find(name)


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


@pytest.mark.parametrize("name", ["beam6g", "cartpole", "clifford", "channel"])
def test_a_round_reads_nothing_from_the_device(name):
    """A whole epoch of rounds; then the actions are read."""
    spec, there = registry.get(specs.EnvironmentSpec, name), torch.device("meta")
    envs = specs.resolve(spec.vector)(specs.resolve(spec.options)(), 4)
    group = Group("ddqn", [0, 1], envs, device="meta", buffer=5, target_steps=2).start()
    envs.on_device = specs.resolve(spec.device)(envs, there)
    with pytest.raises(NotImplementedError, match="Cannot copy out of meta tensor"):
        group.algorithm.train_epoch(3)
    assert group.algorithm.replay.stored == 6
    with pytest.raises(NotImplementedError, match="Cannot copy out of meta tensor"):
        envs.on_device.actions()


@pytest.mark.parametrize(
    ("task", "model", "settings"),
    [
        ("beam6g", "mlp", {"buffer": 170, "target_steps": 90, "epsilon_steps": 3000}),
        ("cartpole", "mlp", {"epsilon_steps": 300}),
        ("clifford", "mlp", {"buffer": 1000}),
        ("channel", "mlp", {"target_steps": 30}),
        ("beam6g-stack", "vqc-native", {"buffer": 2000, "decay_steps": 4000}),
    ],
)
def test_epochs_on_a_device_have_the_same_bits_and_are_continued(monkeypatch, task, model, settings):
    """Rounds on the device or not, killed after the first epoch or not, and continued in another way."""
    words = [f"algorithm.{name}={value}" for name, value in settings.items()]
    words += ["qubits=2"] if model != "mlp" else ["width=16"]
    entry = entries.resolve(task, model, "ddqn", [options.parse_setting(word) for word in words], None)

    def trained(*ways, stopped=False):
        epochs, saved = [], None
        trainer = Trainer(entry, [3, 8])
        for number, way in enumerate(ways):
            monkeypatch.setenv("QRLSUITE_CAPTURE", way)
            if number in (0, 1) and (stopped or not number):
                trainer = Trainer(entry, [3, 8])
                if saved is None:
                    trainer.start()
                else:
                    trainer.restore(number, saved)
            assert (trainer.envs.on_device is not None) == (way == "1")
            epochs.append(trainer.train_epoch())
            saved = trainer.capture()
        return epochs, saved

    epochs, arrays = trained("", "", "")
    for ways, stopped in (("111", False), ("1  ", True), (" 11", True)):
        others, found = trained(*ways, stopped=stopped)
        for one, other in zip(epochs, others):
            assert np.array_equal(one.scores, other.scores)
            assert one.executions == other.executions
            for name, values in one.metrics.items():
                assert np.array_equal(values, other.metrics[name], equal_nan=True), name
        assert found.keys() == arrays.keys()
        assert all(np.array_equal(found[name], value, equal_nan=True) for name, value in arrays.items())


@pytest.mark.parametrize(("task", "algorithm"), [("pong", "ddqn"), ("beam6g", "ppo")])
def test_what_takes_no_epochs_to_the_device_goes_on_as_ever_and_says_so(monkeypatch, task, algorithm):
    monkeypatch.setenv("QRLSUITE_CAPTURE", "1")
    trainer = Trainer(entries.resolve(task, "mlp", algorithm, [], None), [0])
    trainer.start()
    trainer.train_epoch()
    part = "environment 'pong'" if algorithm == "ddqn" else "algorithm 'ppo'"
    assert [each for each in trainer.progress.warnings if "QRLSUITE_CAPTURE" in each] == [
        f"QRLSUITE_CAPTURE=1 has no effect: {part} takes no whole epochs to the device"
    ]


def test_numbers_on_a_device_are_checked_where_the_block_ends():
    checks, owner = LateChecks(), object()

    def note(*found):
        with checks:
            assert all(LateChecks.note(owner, torch.tensor(each), OptionError("late")) for each in found)
            if not found:
                raise KeyError

    assert not LateChecks.note(owner, torch.tensor(True), OptionError("late"))
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
