"""Models that take one property out of the circuits: trained parameters, gain at the input, the circuit itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from qrlsuite import population, registry, specs
from qrlsuite.circuit import Circuit, ansatz
from qrlsuite.circuit.resources import jacobian_rank
from qrlsuite.errors import OptionError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.leaderboard.shelf.collect import Selection, collect
from qrlsuite.options import parse_setting
from qrlsuite.plugins.circuits.ansatz import NoOptions
from qrlsuite.plugins.models.tmlp import contracted
from qrlsuite.results.store import EntryStore
from qrlsuite.specs import AnsatzSpec
from qrlsuite.training.trainer import Trainer
from qrlsuite.tuning.space import declared
from tests.conftest import Train, results


def entry(model: str, *words: str) -> Entry:
    return resolve("beam6g", model, settings=[parse_setting(word) for word in words])


def agent(model: str, *words: str, seed: int = 0) -> nn.Module:
    made = entry(model, *words)
    build = specs.resolve(made.model.build)
    return build(3, 3, made.model_options, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("model", "words", "counts", "fixed"),
    [
        ("vqc-native", (), (73, 240), 0),
        ("vqc-native", ("train=scaling",), (73, 120), 120),
        ("vqc-native", ("train=weights",), (73, 120), 120),
        ("vqc-native", ("train=linear",), (73, 0), 240),
        ("mlp", ("width=44", "depth=1", "activation=sin"), (311, 0), 0),
        ("mlp", ("width=10", "depth=1", "activation=sin"), (73, 0), 0),
        ("fourier", (), (309, 0), 0),
        ("fourier", ("frequencies=51", "train=linear"), (309, 0), 153),
        ("tmlp", (), (64 * (3 + 3 + 1) + 3 + 64 + 2 * 64 * 4, 0), 0),
    ],
)
def test_trainable_and_fixed_numbers(
    model: str, words: tuple[str, ...], counts: tuple[int, int], fixed: int
) -> None:
    made = agent(model, *words)
    assert (population.count_parameters(made), population.count_fixed(made)) == (counts, fixed)


def test_fourier_features_are_cosines_and_sines() -> None:
    made = agent("fourier", "frequencies=2", "bandwidth=3.0")
    x = torch.tensor([[0.1, 0.5, 0.9]])
    angles = x @ made.frequencies.T
    expected = torch.cat([angles.cos(), angles.sin()], 1) @ made.weight.T + made.bias
    torch.testing.assert_close(made(x), expected)
    many = agent("fourier", "frequencies=4000", "bandwidth=3.0").frequencies
    assert many.std().item() == pytest.approx(3.0, rel=0.03)
    assert many.mean().item() == pytest.approx(0.0, abs=0.15)


def test_a_tensor_network_stands_for_a_weight() -> None:
    """By the definition: a sum over the bonds of products of the cores; as wide as the weight of a linear layer."""
    made = agent("tmlp", "width=27", "cores=3", "bond=2", "activation=sin")
    p = dict(made.named_parameters())
    cores = [p[f"a1_{j}"] for j in range(3)]
    weight = torch.einsum("zaib,bcjd,dekz->aceijk", *cores).reshape(27, 27)
    x = torch.rand(5, 3, generator=torch.Generator().manual_seed(1))
    inner = torch.sin(torch.sin(x @ p["w0"].T + p["b0"]) @ weight.T + p["b1"])
    torch.testing.assert_close(made(x), inner @ p["w2"].T + p["b2"])
    wide = agent("tmlp", "width=1024", "bond=8")
    entries = contracted([wide.get_parameter(f"a1_{j}")[None] for j in range(2)])
    assert entries.std().item() == pytest.approx((3 * 1024) ** -0.5, rel=0.2)


def test_the_gain_at_the_input() -> None:
    """The same random numbers: a factor on the observation, on the scalings, on the frequencies."""
    x = torch.rand(5, 3, generator=torch.Generator().manual_seed(1))
    for words in (("activation=sin",), ("activation=relu", "depth=1")):
        plain, scaled = agent("mlp", *words), agent("mlp", *words, "input_scale=2.5")
        torch.testing.assert_close(scaled(x), plain(2.5 * x))
    plain, scaled = agent("vqc-native", "qubits=2"), agent("vqc-native", "qubits=2", "init_scale=0.25")
    torch.testing.assert_close(scaled.circuit["scaling"], 0.25 * plain.circuit["scaling"])
    for name, value in plain.state_dict().items():
        assert name == "circuit.scaling" or torch.equal(value, scaled.state_dict()[name])
    plain, scaled = agent("fourier"), agent("fourier", "bandwidth=4")
    torch.testing.assert_close(scaled.frequencies, 4 * plain.frequencies)


def test_siren_s_initial_weights() -> None:
    """Sitzmann et al. (2020): uniform to 1/in in the first layer, to sqrt(6/in) in the others."""
    made = agent("mlp", "width=200", "init=siren", "activation=sin")
    for name, bound in (("w0", 1 / 3), ("w1", (6 / 200) ** 0.5), ("w2", (6 / 200) ** 0.5)):
        largest = float(made.get_parameter(name).detach().abs().max())
        assert 0.95 * bound < largest <= bound, name


@pytest.mark.parametrize("batch", [1, 7, 64])
@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("fourier", ("frequencies=5",)),
        ("fourier", ("frequencies=34",)),
        ("fourier", ("frequencies=51", "train=linear")),
        ("mlp", ("width=10", "depth=1", "activation=sin", "input_scale=3.0")),
        ("mlp", ("width=44", "depth=1", "activation=sin", "init=siren")),
        ("tmlp", ("width=9", "bond=3", "activation=tanh")),
        ("tmlp", ("width=27", "cores=3", "depth=3")),
        ("vqc-native", ("qubits=3", "layers=2", "train=scaling", "readout=all-pairs", "output_reuse=2")),
        ("vqc-native", ("qubits=3", "layers=1", "output_scale=2.0")),
        ("vqc-native", ("qubits=3", "layers=2", "train=linear", "entangled=mean-field")),
    ],
)
def test_an_agent_has_the_same_bits_alone_and_in_company(
    model: str, words: tuple[str, ...], batch: int
) -> None:
    made = entry(model, *words)
    together = specs.resolve(made.model.population)
    agents = [agent(model, *words, seed=seed) for seed in range(17)]
    source = torch.Generator().manual_seed(1)
    x, cotangent = (torch.randn(17, batch, 3, generator=source) for _ in range(2))

    def evaluate(first: int, last: int) -> dict[str, Tensor]:
        module = together(agents[first:last], made.model_options)
        values = module(x[first:last])
        values.backward(cotangent[first:last])
        trained = {name: p.grad for name, p in module.named_parameters() if p.requires_grad}
        assert all(gradient is not None for gradient in trained.values())
        return {"": values.detach(), **trained}

    whole = evaluate(0, 17)
    for first, last in ((0, 1), (16, 17), (3, 5), (4, 17)):
        for name, part in evaluate(first, last).items():
            assert torch.equal(part, whole[name][first:last]), name


SMALL = {
    "fourier": ("frequencies=5", "train=linear"),
    "vqc-native": ("qubits=2", "layers=2", "train=weights", "entangled=mean-field"),
}
FIXED = {"fourier": ("frequencies", 15), "vqc-native": ("circuit.scaling", 12)}


@pytest.mark.parametrize("model", SMALL)
def test_fixed_parameters_stay_and_a_resumed_run_ends_alike(model: str, train: Train) -> None:
    straight = train("straight", [0, 1], 4, model=model, settings=SMALL[model])
    resumed = train("resumed", [0, 1], 2, model=model, settings=SMALL[model])
    name, size = FIXED[model]
    made = agent_of(straight, model)
    after_two = load_file(resumed / "seed-0000" / "final.safetensors")
    train("resumed", [0, 1], 4, model=model, settings=SMALL[model])
    for seed in (0, 1):
        assert results(straight, seed) == results(resumed, seed)
    final = load_file(straight / "seed-0000" / "final.safetensors")
    [kept] = [value for stored, value in final.items() if stored.endswith(name)]
    assert torch.equal(kept.reshape(-1), made.get_parameter(name).detach()[0].reshape(-1))
    moved = [stored for stored, value in final.items() if not torch.equal(value, after_two[stored])]
    assert moved
    assert not any(stored.endswith(name) for stored in moved)
    record = EntryStore(straight).seed(0).record()
    assert record is not None
    assert record.parameters["fixed"] == size


def agent_of(folder: Path, model: str) -> nn.Module:
    """The untrained population of an entry's first seed."""
    made = EntryStore(folder).entry()
    trainer = Trainer(made, [0])
    return trainer.models.built[0]


def test_boards_tell_fixed_numbers_apart(train: Train, tmp_path: Path) -> None:
    train("board", [0], 2, model="fourier", settings=("frequencies=5", "train=linear"))
    train("board", [0], 2, settings=("width=4",))
    found = {e.model: e for e in collect(Selection(tmp_path / "board"))[0]}
    assert (found["fourier"].parameters, found["fourier"].fixed) == ((33, 0), 15)
    assert found["fourier"].facts["parameters"] == "33 (15 fixed)"
    assert found["mlp"].fixed == 0
    assert "fixed" not in found["mlp"].facts["parameters"]


@pytest.mark.parametrize(
    ("name", "options", "missing"),
    [
        ("iqp", {}, lambda n: 2 * (n - 1)),
        ("iqp", {"entangled": "separable"}, lambda n: 2 * n),
        ("cx", {}, lambda n: 2 * n),
        ("cz", {}, lambda n: 8 * n),
    ],
)
def test_parameters_without_effect_at_four_layers(
    name: str, options: dict[str, str], missing: Callable[[int], int]
) -> None:
    """`cz`: the last RZ of a layer commutes with the CZs and merges with the next layer's first."""
    for qubits in (3, 4):
        circuit = ansatz(name, qubits, 4, **options)
        assert jacobian_rank(circuit) == circuit.parameter_count - missing(qubits)


def test_the_rank_by_hand() -> None:
    """RZ does nothing to |0>, two RY in a row are one; without parameters there is nothing to count."""
    circuit = Circuit(1)
    weights = circuit.parameter("weights", (3,))
    circuit.append("RZ", 0, weights[0])
    circuit.append("RY", 0, weights[1] + circuit.input(0))
    circuit.append("RY", 0, weights[2])
    assert jacobian_rank(circuit) == 1
    assert jacobian_rank(Circuit(1)) == 0
    large = Circuit(13)
    weights = large.parameter("weights", (1,))
    for q in range(12):
        large.append("RX", q, weights[0], control=q + 1)
    assert jacobian_rank(large) is None


def unscaled(qubits: int, layers: int, options: NoOptions) -> Circuit:
    circuit = Circuit(qubits)
    turns = circuit.parameter("turns", (qubits,))
    for q in range(qubits):
        circuit.append("RX", q, circuit.input(q) + turns[q])
    return circuit


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("train=weigths",), "train = 'weigths': the circuit of ansatz 'iqp' .* did you mean 'weights'"),
        (("ansatz=unscaled", "train=scaling"), "ansatz 'unscaled' has no such parameter.* turns"),
        (("ansatz=unscaled", "init_scale=0.5"), "init_scale = 0.5: .* 'unscaled' multiplies no input"),
        (("init_scale=0",), "init_scale = 0: Input should be greater than 0"),
        (("init_scale=nan",), "init_scale = nan"),
    ],
)
def test_circuits_without_that_parameter(
    words: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = registry.load().entries[specs.AnsatzSpec]
    no_options = "qrlsuite.plugins.circuits.ansatz:NoOptions"
    spec = AnsatzSpec("unscaled", "Nothing scaled", no_options, f"{__name__}:unscaled")
    monkeypatch.setitem(known, "unscaled", replace(known["iqp"], spec=spec))
    with pytest.raises(OptionError, match=message) as refused:
        entry("vqc-native", *words)
    assert "\n" not in str(refused.value)
    assert "model.init_scale" in declared(entry("vqc-native"))
    assert "model.init_scale" not in declared(entry("vqc-native", "ansatz=unscaled")), "nothing to tune"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("frequencies=100000000",), "frequencies = 100000000: Input should be less than or equal to 65536"),
        (("bandwidth=0",), "bandwidth = 0: Input should be greater than 0"),
        (("train=frequencies",), "train = 'frequencies': Input should be 'all' or 'linear'"),
        (("width=60",), "width = 60: with cores = 2 it is a number to the power 2, such as 64"),
        (("width=4", "cores=3"), "such as 8"),
    ],
)
def test_options_of_fourier_and_tmlp(words: tuple[str, ...], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        entry("tmlp" if words[0].startswith("width") else "fourier", *words)
