import copy

import pytest
import torch
from pydantic.dataclasses import dataclass

from qrlsuite import options, population, registry, specs
from qrlsuite.circuit import ansatz, create_backend
from qrlsuite.circuit.api import _joined
from qrlsuite.errors import OptionError, PluginError
from qrlsuite.plugins.models import vqc
from qrlsuite.plugins.models.vqc import VQCOptions

CLASSES = {backend: VQCOptions[backend] for backend in ("pennylane", "native", "qiskit")}
BACKENDS = [name for name in CLASSES if name in registry.load().names(specs.CircuitBackendSpec)]


def small(backend="pennylane", **values):
    return options.build(CLASSES[backend], {"qubits": 3, "layers": 2, **values}, f"model 'vqc-{backend}'")


def agents(count, given, obs=3, out=3):
    return [vqc.build(obs, out, given, torch.Generator().manual_seed(s)) for s in range(count)]


def observations(*shape, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1), dtype=dtype)


@pytest.mark.parametrize(("qubits", "total"), [(6, 189), (8, 251), (10, 313), (12, 375), (14, 437)])
def test_the_papers_parameter_counts(qubits, total):
    module = agents(1, small(qubits=qubits, layers=4))[0]
    classical, quantum = population.count_parameters(module)
    assert classical + quantum == total == 6 * 4 * qubits + 7 * qubits + 3
    assert quantum == 6 * 4 * qubits


def test_activations_sit_on_both_sides_of_the_circuit():
    with_both = {"activation_in": "tanh", "activation_out": "relu"}
    plain, both = (agents(1, small(dtype="float64", **v))[0] for v in ({}, with_both))
    x = observations(6, 3, dtype=torch.float64)
    p = dict(both.named_parameters())
    inner = torch.tanh(x @ p["input.weight"].T + p["input.bias"])
    quantum = {name: p[f"circuit.{name}"][None] for name in ("scaling", "weights")}
    values = torch.relu(create_backend("pennylane", ansatz("iqp", 3, 2))(inner[None], quantum)[0])
    torch.testing.assert_close(both(x), values @ p["output.weight"].T + p["output.bias"], atol=1e-9, rtol=0)
    assert not torch.allclose(both(x), plain(x))


def test_initial_parameters_come_from_the_generator_and_lie_in_their_ranges():
    first, again, other = (
        vqc.build(3, 3, small(qubits=10, layers=4), torch.Generator().manual_seed(s)) for s in (1, 1, 2)
    )
    for name, value in first.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
        assert name == "shot_count" or not torch.equal(value, other.state_dict()[name])
    for name in ("scaling", "weights"):
        value = first.circuit[name].detach()
        assert value.shape == (4, 10, 3)
        assert 0 <= float(value.min()) < 0.3
        assert 2 * torch.pi - 0.3 < float(value.max()) < 2 * torch.pi
    assert float(first.input.weight.detach().abs().max()) <= 3**-0.5
    assert float(first.output.weight.detach().abs().max()) <= 10**-0.5
    assert first.input.weight.shape == (10, 3)  # the layout of torch.nn.Linear
    assert torch.equal(agents(1, small(ansatz="skolik"))[0].circuit["scaling"], torch.ones(2, 3))


@pytest.mark.parametrize("backend", ["pennylane", "native"])
def test_deep_copies_are_independent_but_share_the_counter(backend):
    given = small(backend)
    together = vqc.population(agents(2, given), given)
    target = copy.deepcopy(together)
    x = observations(2, 4, 3)
    before = together(x).detach()
    assert torch.equal(target(x), before)
    with torch.no_grad():
        for parameter in together.parameters():
            parameter.add_(0.1)
    assert torch.equal(target(x), before)
    target.load_state_dict(together.state_dict())
    assert torch.equal(target(x), together(x))
    assert target.executions is together.executions
    assert together.executions.forward == 5 * 4
    assert together.shot_count.tolist() == [0, 0], "exact models do not count passes"


@pytest.mark.parametrize("backend", ["pennylane", "native"])
@pytest.mark.parametrize("name", ["iqp", "cz"])
def test_executions_are_those_of_each_agent(name, backend):
    given = small(backend, ansatz=name)
    together = vqc.population(agents(5, given), given)
    assert together.executions.as_dict() == {"forward": 0, "parameter_shift": 0}
    x = observations(5, 7, 3)
    with torch.no_grad():
        together(x)
    assert together.executions.as_dict() == {"forward": 7, "parameter_shift": 0}
    together(x).sum().backward()
    per_input = 2 * 3 * 3 * (4 if name == "iqp" else 2)  # layers, qubits, angles, evaluations
    assert together.executions.as_dict() == {"forward": 14, "parameter_shift": 7 * per_input}
    together(x)[..., 0].sum().backward()
    assert (together.executions.forward, together.executions.gradient) == (21, 14 * per_input)


def test_shots_are_counted_with_both_kinds_of_executions():
    given = small(qubits=2, layers=1, ansatz="cz", shots=10)
    together = vqc.population(agents(2, given), given)
    together(observations(2, 3, 3)).sum().backward()
    assert together.executions.as_dict() == {"forward": 3, "parameter_shift": 36, "shots": 390}


@pytest.mark.parametrize(
    ("backend", "random"),
    [
        ("pennylane", {"shots": 20}),
        ("native", {"shots": 20}),
        ("native", {"noise_model": "depolarizing", "noise_rate": 0.9, "trajectories": 5}),
    ],
)
def test_shot_noise_is_new_in_every_pass_and_resumes_exactly(backend, random):
    given = small(backend, qubits=2, layers=1, **random)
    x = observations(3, 4, 3)
    together = vqc.population(agents(3, given), given)
    first = together(x)
    state = copy.deepcopy(together.state_dict())
    assert state["shot_count"].tolist() == [1, 1, 1]
    second = together(x)
    assert not torch.equal(first, second)
    resumed = vqc.population(agents(3, given), given)
    resumed.load_state_dict(state)
    assert torch.equal(resumed(x), second)


def test_shot_noise_of_an_agent_does_not_depend_on_its_place():
    given = small(qubits=2, layers=1, shots=20)
    modules = agents(3, given)
    x = observations(3, 4, 3)
    together = vqc.population(modules, given)(x)
    assert torch.equal(vqc.population([modules[2], modules[0]], given)(x[[2, 0]]), together[[2, 0]])
    same = [copy.deepcopy(modules[0]) for _ in range(2)]
    with torch.no_grad():
        same[1].shot_key += 1
    a, b = vqc.population(same, given)(x[[0, 0]])
    assert not torch.equal(a, b)


def test_a_target_network_draws_its_own_samples():
    given = small(qubits=2, layers=1, shots=20)
    together = vqc.population(agents(1, given), given)
    target = copy.deepcopy(together)
    target.load_state_dict(together.state_dict())
    x = observations(1, 30, 3)
    assert not torch.equal(together(x), target(x))


def test_other_backends_have_nothing_to_compile():
    for backend in BACKENDS:
        vqc.population(agents(1, small(backend)), small(backend)).compile_circuits()


@pytest.mark.parametrize("shots", [None, 10])
def test_compiling_ahead_leaves_no_trace(shots):
    """Else the first epoch would hold the compiler's time, and every estimate that rests on it."""
    given = small("native", shots=shots)
    model = vqc.population(agents(2, given), given)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    model.compile_circuits()
    assert set(model.executions.as_dict().values()) == {0}
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())
    if shots is None:
        assert torch.float32 in model._runner.backend.simulator()._workspaces


def test_options_of_a_model_are_those_of_its_backend_and_the_circuit():
    own = set(options.field_names(VQCOptions))
    assert own == {
        "qubits", "layers", "ansatz", "gate", "ansatz_options", "activation_in", "activation_out", "dtype", "train",
        "init_scale", "linear", "output_rate", "critic", "readout", "input_reuse", "output_reuse", "output_scale",
    }  # fmt: skip
    for name in BACKENDS:
        theirs = specs.resolve(registry.get(specs.CircuitBackendSpec, name).options)
        assert set(options.field_names(CLASSES[name])) == own | set(options.field_names(theirs))
    default = VQCOptions["pennylane"]()
    assert (default.qubits, default.layers, default.ansatz) == (10, 4, "iqp")


def test_options_of_a_backend_join_those_of_the_model():
    """Of two that have one name, it is not known which is meant."""

    @dataclass
    class Theirs:
        bond: int = 1

    @dataclass(frozen=True)
    class Clash:
        layers: int = 1

    both = _joined(VQCOptions, Theirs, "mps")(bond=4, qubits=3)
    assert (both.bond, both.qubits, both.backend) == (4, 3, "mps")
    with pytest.raises(PluginError, match="backend 'mps': 'layers' of its options is one of the model's"):
        _joined(VQCOptions, Clash, "mps")


def test_ansatz_options_reach_the_ansatz():
    circuit = vqc.build_circuit(small(ansatz_options={"gate": "xyz"}))
    assert {op.gate for op in circuit} == {"H", "RX", "RY", "RZ"}
    with pytest.raises(OptionError, match="'iqp' has no option 'gates'"):
        vqc.build_circuit(small(ansatz_options={"gates": "xyz"}))


def test_a_gate_is_refused_where_the_ansatz_has_none():
    assert {op.gate for op in vqc.build_circuit(small(ansatz="skolik"))} == {"RX", "RY", "RZ", "CZ"}
    with pytest.raises(OptionError, match="gate = 'u3': ansatz 'skolik' has no option 'gate'"):
        vqc.build_circuit(small(ansatz="skolik", gate="u3"))


def test_a_population_finds_out_at_once_that_its_backend_cannot_run():
    given = small(device="lightning.gpu")
    with pytest.raises(OptionError, match="pip install pennylane-lightning-gpu"):
        vqc.population(agents(1, given), given)


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_linear_layers_the_circuit_stands_alone(backend):
    options = small(backend, qubits=3, layers=1, dtype="float64", linear=False)
    modules = agents(2, options, obs=3, out=2)
    names = ["circuit.scaling", "circuit.weights", "output.weight"]
    assert [name for name, _ in modules[0].named_parameters()] == names
    assert population.count_parameters(modules[0]) == (2, 18)
    with torch.no_grad():
        modules[1].output.weight.copy_(torch.tensor([2.0, -3.0]))
    together = vqc.population(modules, options)
    x = observations(2, 5, 3, dtype=torch.float64)
    for s, module in enumerate(modules):
        p = dict(module.named_parameters())
        quantum = {name: p[f"circuit.{name}"][None] for name in ("scaling", "weights")}
        values = create_backend("pennylane", ansatz("iqp", 3, 1))(x[s][None], quantum)[0]
        expected = values[:, :2] * p["output.weight"]
        torch.testing.assert_close(module(x[s]), expected, atol=1e-9, rtol=0)
        torch.testing.assert_close(together(x)[s], expected, atol=1e-9, rtol=0)
    together(x).square().sum().backward()
    assert all(bool((parameter.grad != 0).any()) for parameter in together.parameters())


@pytest.mark.parametrize("structure", sorted(registry.load().of(specs.AnsatzSpec)))
def test_an_ansatz_may_have_more_qubits_than_inputs_and_outputs(structure):
    """Without linear layers the circuit is given the observations again, and the first values are the outputs."""
    given = {"qubits": 4, "layers": 2, "ansatz": structure, "linear": False, "readout": "single"}
    options = small("native", **given, dtype="float64", input_reuse=True)
    made = vqc.population(agents(2, options, obs=3, out=2), options)
    x = observations(2, 5, 3, dtype=torch.float64)
    circuit = made.description
    quantum = {name: made.circuit[name] for name in circuit.parameters}
    several = torch.cat([x, x], dim=-1)[..., : circuit.inputs]
    expected = create_backend("native", circuit)(several, quantum)[..., :2]
    torch.testing.assert_close(made(x), expected, atol=1e-12, rtol=0)
    assert (circuit.qubits, len(circuit.observables)) == (4, 4)


@pytest.mark.parametrize(
    ("obs", "out", "advice"), [(4, 2, "choose"), (3, 4, "choose"), (2, 2, "input_reuse=true")]
)
def test_without_linear_layers_sizes_must_fit(obs, out, advice):
    message = f"3 expectation values, the network {obs} inputs and {out} out.*{advice}"
    with pytest.raises(OptionError, match=message):
        agents(1, small(qubits=3, linear=False), obs=obs, out=out)
    with pytest.raises(OptionError, match="input_reuse = true needs linear = false"):
        small(input_reuse=True).check()
    with pytest.raises(OptionError, match=r"linear = behind: the circuit has 3 inputs .* 4 inputs"):
        agents(1, small(qubits=3, linear="behind"), obs=4, out=2)


def test_a_linear_layer_behind_the_circuit_alone():
    given = small("native", qubits=3, linear="behind")
    modules = agents(2, given, obs=3, out=5)
    population, x = vqc.population(modules, given), observations(4, 3)
    assert sorted(name for name, _ in modules[0].named_parameters()) == [
        "circuit.scaling",
        "circuit.weights",
        "output.bias",
        "output.weight",
    ]
    shown = torch.stack([module(x) for module in modules])
    torch.testing.assert_close(population(x.expand(2, -1, -1)), shown)
    # With the identity and no bias before the circuit, both layers compute the same.
    both = agents(1, small("native", qubits=3), obs=3, out=5)[0]
    with torch.no_grad():
        both.input.weight.copy_(torch.eye(3))
        both.input.bias.zero_()
    for name, value in modules[0].named_parameters():
        both.get_parameter(name).data.copy_(value)
    torch.testing.assert_close(both(x), shown[0])


def test_reused_outputs_are_a_larger_step_of_the_layer_behind():
    """Adam moves each copy of a weight alike, so their sum moves as one weight with a rate as many times as large."""
    times, rate, x = 8, 0.01, observations(6, 3)
    reused = agents(1, small("native", output_reuse=times, dtype="float64"))[0]
    plain = agents(1, small("native", dtype="float64"))[0]
    for name, value in reused.named_parameters():
        if name == "output.weight":
            value = value.unflatten(1, (times, -1)).sum(dim=1)
        plain.get_parameter(name).data.copy_(value)
    target = torch.linspace(-2, 2, 18, dtype=torch.float64).reshape(6, 3)
    for module, factor in ((reused, 1), (plain, times)):
        groups = [
            {"params": [value], "lr": rate * (factor if name == "output.weight" else 1)}
            for name, value in module.named_parameters()
        ]
        optimizer = torch.optim.Adam(groups, eps=0)
        for _ in range(50):
            optimizer.zero_grad()
            (module(x) - target).square().mean().backward()
            optimizer.step()
    torch.testing.assert_close(reused(x), plain(x), atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("readout", "qubits", "observables"),
    [
        ("ansatz", 3, (0, 1, 2)),
        ("single", 3, (0, 1, 2)),
        ("pairs", 4, ((0, 1), (2, 3))),
        ("neighbors", 3, ((0, 1), (1, 2), (2, 0))),
        ("neighbors", 2, ((0, 1),)),
        ("all-pairs", 3, ((0, 1), (0, 2), (1, 2))),
        ("product", 3, ((0, 1, 2),)),
        ("product", 1, (0,)),
    ],
)
def test_readouts_are_products_of_z(readout, qubits, observables):
    given = small("native", ansatz="skolik", qubits=qubits, readout=readout)
    assert vqc.build_circuit(given).observables == observables
    module = agents(1, given)[0]
    assert module.output.weight.shape == (3, len(observables))
    assert module(observations(5, 3)).shape == (5, 3)
    assert ("readout" in options.identity(given)) == (readout != "ansatz")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"readout": "pairs"}, "readout = 'pairs' with qubits = 3: it needs an even number of qubits"),
        ({"readout": "neighbors", "qubits": 1}, "'neighbors' with qubits = 1: it needs 2 qubits or more"),
        ({"readout": "product", "ansatz_options": {"entangled": "mean-field"}}, "has no correlations"),
    ],
)
def test_readouts_that_cannot_be_are_refused_at_once(values, message):
    with pytest.raises(OptionError, match=message):
        small("native", ansatz="cz", **values).check()


@pytest.mark.parametrize("linear", [True, False])
def test_values_are_repeated_and_outputs_scaled(linear):
    """The definitions of SimplyQRL: copies side by side, then a layer, then a trained factor for each output."""
    given = small(
        "native", dtype="float64", linear=linear, readout="neighbors", output_reuse=3, output_scale=2.0
    )
    modules = agents(2, given, out=5)
    name = "output.factor" if linear else "output.weight"
    assert torch.equal(modules[0].get_parameter(name), torch.full((5,), 2.0, dtype=torch.float64))
    with torch.no_grad():
        modules[0].get_parameter(name).copy_(torch.tensor([3.0, -1.0, 0.5, 2.0, -4.0]))
    together, x = vqc.population(modules, given), observations(2, 5, 3, dtype=torch.float64)
    for s, module in enumerate(modules):
        p = dict(module.named_parameters())
        inner = x[s] @ p["input.weight"].T + p["input.bias"] if linear else x[s]
        circuit = vqc.build_circuit(given)
        quantum = {key: p[f"circuit.{key}"][None] for key in circuit.parameters}
        shown = torch.cat([create_backend("pennylane", circuit)(inner[None], quantum)[0]] * 3, dim=1)
        shown = shown @ p["output.weight"].T + p["output.bias"] if linear else shown[:, :5]
        torch.testing.assert_close(module(x[s]), shown * p[name], atol=1e-9, rtol=0)
        assert torch.equal(together(x)[s], module(x[s]))
    faster = agents(1, small("native", output_rate=10.0, output_scale=2.0))[0].learning_rates()
    assert faster == dict.fromkeys(("output.weight", "output.bias", "output.factor"), 10.0)


def hybrid(seeds=3, obs=3, out=3, **values):
    given = small("native", **values)
    return vqc.population(agents(seeds, given, obs, out), given)


def passes(model, x, cotangents):
    """Return outputs, and gradients of inputs and parameters."""
    x = x.detach().requires_grad_(True)
    outputs = model(x)
    return [outputs.detach(), *torch.autograd.grad(outputs, [x, *model.parameters()], cotangents)]


@pytest.mark.parametrize(
    ("obs", "out", "values"),
    [
        (3, 3, {}),
        (5, 1, {"qubits": 4, "ansatz": "cz", "readout": "all-pairs"}),
        (2, 4, {"qubits": 5, "gate": "u3"}),
        (1, 2, {"ansatz": "skolik", "readout": "product"}),
        (3, 3, {"ansatz": "cx", "ansatz_options": {"entangled": "separable"}}),
    ],
)
def test_a_sweep_computes_what_torch_does_in_double_precision(obs, out, values):
    swept, plain = hybrid(obs=obs, out=out, **values), hybrid(obs=obs, out=out, dtype="float64", **values)
    assert swept.sweep() is not None
    assert plain.sweep() is None
    plain.load_state_dict({name: value.double() for name, value in swept.state_dict().items()})
    for batch in (1, 16, 41):
        x, cotangents = observations(3, batch, obs), observations(3, batch, out)
        for mine, exact in zip(passes(swept, x, cotangents), passes(plain, x.double(), cotangents.double())):
            torch.testing.assert_close(mine.double(), exact, rtol=2e-5, atol=2e-5)


def test_a_seed_of_a_sweep_has_the_same_bits_alone_and_however_its_gradients_are_computed(monkeypatch):
    given = small("native")
    modules = agents(17, given)
    x, cotangents, aims = observations(17, 45, 3), observations(17, 45, 3), observations(17, 45, 1)[..., 0]
    chosen = (aims > 0).long()
    together = vqc.population(modules, given)
    expected = passes(together, x, cotangents)
    errors = population.chosen_errors(together, x, chosen, aims)
    gradients = [parameter.grad.clone() for parameter in together.parameters()]
    values = together(x).gather(2, chosen[..., None])[..., 0]
    by_torch = torch.autograd.grad((values - aims).square().mean(1).sum(), list(together.parameters()))
    assert torch.equal(errors, (values - aims).detach())
    assert all(torch.equal(mine, theirs) for mine, theirs in zip(gradients, by_torch))
    for own in (slice(0, 1), slice(5, 7), slice(16, 17)):
        alone = vqc.population(modules[own], given)
        assert all(torch.equal(a, b[own]) for a, b in zip(passes(alone, x[own], cotangents[own]), expected))
        population.chosen_errors(alone, x[own], chosen[own], aims[own])
        assert all(torch.equal(a.grad, b[own]) for a, b in zip(alone.parameters(), gradients))
    monkeypatch.setattr("qrlsuite.plugins.circuits.native.hybrid.KEEP_BYTES", 0)  # computed again
    assert all(torch.equal(a, b) for a, b in zip(passes(together, x, cotangents), expected))


@pytest.mark.parametrize(
    "values",
    [{"shots": 10}, {"gradient": "spsa"}, {"dtype": "float64"}, {"linear": "behind"}, {"linear": False},
     {"activation_in": "tanh"}, {"activation_out": "relu"}, {"output_reuse": 2}, {"output_scale": 2.0},
     {"train": "scaling"}, {"ansatz": "cz", "ansatz_options": {"entangled": "mean-field"}}],
)  # fmt: skip
def test_other_networks_are_no_sweep_and_keep_their_optimizer(values):
    model = hybrid(**values)
    assert model.sweep() is None
    assert not model.compiled
    assert hybrid().compiled
    pennylane = vqc.population(agents(1, small()), small())
    assert pennylane.sweep() is None


def test_fixed_parameters_of_a_sweep_stay():
    """Adam then has a block of its own, and moves parameters into it at each step."""
    model, x = hybrid(), observations(3, 5, 3)
    model.circuit["weights"].requires_grad_(False)
    adam, chosen = population.Adam(model, 0.1, 0.1), torch.zeros((3, 5), dtype=torch.int64)
    for _ in range(2):
        before = copy.deepcopy(model.state_dict())
        population.chosen_errors(model, x, chosen, x[..., 0])
        adam.step()
        still = {name for name, value in model.state_dict().items() if torch.equal(value, before[name])}
        assert still == {"circuit.weights", "shot_key", "shot_count"}
    assert model.circuit["weights"].grad is None


def test_a_sweep_says_what_is_wrong_with_its_inputs():
    model, x = hybrid(), observations(3, 5, 3)
    with pytest.raises(ValueError, match=r"take x \(3, B, 3\); x is \(3, 5, 4\)"):
        model(observations(3, 5, 4))
    with pytest.raises(ValueError, match=r"x is \(3, 5, 2\)"):
        population.chosen_errors(
            model, observations(3, 5, 2), torch.zeros((3, 5), dtype=torch.int64), x[..., 0]
        )
    with pytest.raises(ValueError, match=r"choose one of 3 outputs .* goes from 0 to 3"):
        population.chosen_errors(model, x, torch.tensor([[0, 1, 2, 3, 0]] * 3), x[..., 0])
    x[1, 4, 0] = torch.nan
    for call in (model, lambda seen: population.best(model, seen)):
        with pytest.raises(OptionError, match="the circuit's inputs or parameters are not finite"):
            call(x)
