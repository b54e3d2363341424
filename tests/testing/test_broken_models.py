"""Models that break one rule each: edits of a good one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from qrlsuite import population
from qrlsuite.specs import ModelSpec
from tests.testing.broken import Edit, assert_all_good, assert_breaks, edit, good, ids, module, own_rules

HERE = __name__
GOOD = good("model").replace("import torch\n", "import random\n\nimport torch\n", 1)
WIDTH = 'Annotated[int, Field(ge=1, description="units of the hidden layer")] = 32'
INIT, FORWARD = "self.out = nn.Linear(width, outputs)", "y: Tensor = self.out(torch.tanh(self.hidden(x)))"
EDGE = f"{INIT}; self.edge = nn.Parameter(torch.zeros(1))"
QUANTUM = "def quantum_parameters(self):\n        return {'out.weight'}\n\n    def forward"


def stacked(agents: Sequence[nn.Module], change: Any) -> nn.Module:
    together = population.stack(list(agents))
    together.register_forward_hook(lambda module, given, y: change(y))
    return together


def reversed_population(agents: Sequence[nn.Module], options: Any) -> nn.Module:
    return population.stack(list(agents)[::-1])


def coupled(agents: Sequence[nn.Module], options: Any) -> nn.Module:
    return stacked(agents, lambda y: y + 1e-6 * y.mean(0))


def steeper(agents: Sequence[nn.Module], options: Any) -> nn.Module:
    return stacked(agents, lambda y: y + (len(y) - 1) * (y - y.detach()))


def forgetful(agents: Sequence[Any], options: Any) -> nn.Module:
    offset = torch.stack([agent.out.bias.detach().sum() for agent in agents])
    return stacked(agents, lambda y: y + 1e-6 * offset[:, None, None])


def short(agents: Sequence[nn.Module], options: Any) -> nn.Module:
    return stacked(agents, lambda y: y[:, :, :2])


def wrapped(agents: Sequence[nn.Module], options: Any) -> nn.Module:
    return nn.Sequential(population.stack(list(agents)))


def classical_population(agents: Sequence[nn.Module], options: Any) -> nn.Module:
    together = population.stack(list(agents))
    together.quantum_parameters = set  # type: ignore[assignment]
    return together


def deaf(agents: Sequence[nn.Module], options: Any) -> nn.Module:
    together = population.stack(list(agents))
    together.load_state_dict = lambda state: None  # type: ignore[method-assign,assignment,misc]
    return together


class WithOneCounter(nn.Module):
    """A population whose counter has no axis of seeds."""

    def __init__(self, agents: Sequence[Any], options: Any) -> None:
        super().__init__()
        for name in ("hidden", "out"):
            layers = [getattr(agent, name) for agent in agents]
            self.register_module(name, nn.Module())
            for part in ("weight", "bias"):
                values = torch.stack([getattr(layer, part).detach() for layer in layers])
                setattr(getattr(self, name), part, nn.Parameter(values))
        self.register_buffer("steps", torch.tensor(0))

    def forward(self, x: Tensor) -> Tensor:
        hidden, out = (self.get_submodule(name) for name in ("hidden", "out"))
        y = torch.tanh(population.linear(x, hidden.weight, hidden.bias))  # type: ignore[arg-type]
        return population.linear(y, out.weight, out.bias)  # type: ignore[arg-type]


class InVectors(torch.autograd.Function):
    """As torch's `silu` on most processors: numbers behind the last full vector, here of 16, are rounded otherwise."""

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        y = x.flatten().clone()
        y[len(y) // 16 * 16 :] *= 1 + 1e-6
        return y.view(x.shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None: ...

    @staticmethod
    def backward(ctx: Any, y: Tensor) -> Tensor:
        return y

    @staticmethod
    def vmap(info: Any, in_dims: Any, x: Tensor) -> tuple[Tensor, int]:
        return InVectors.apply(x), in_dims[0]  # all agents' numbers at once, as torch's own functions


def made(name: str) -> str:
    return f"{HERE}:{name}"


NO_GRADIENT = ("gradients", "seed independence")
EDITS = [
    edit("builds", r"returned NoneType, not a torch.nn.Module: is `return` there", "return Network(", "Network("),
    edit("shapes", r"maps \(6, 4\) to \(6, 2\), and it must give \(6, 3\)", "out_dim, options", "out_dim - 1, options"),
    edit("shapes", r"forward returned tuple, not a tensor", "return y", "return y, x"),
    edit("shapes", r"float32 give torch.float64: end forward with \.to\(x\.dtype\)", "return y", "return y.double()"),
    edit("shapes", r"outputs are not finite", "return y", "return y / 0"),
    edit("parameters registered", r"self.scales is a tensor .* nn.ParameterList", INIT,
         f"{INIT}; self.scales = [torch.ones(3, requires_grad=True)]", "return y", "return y * self.scales[0]"),
    edit("parameters registered", r"self\.layers holds a module .* use nn.ModuleList", INIT,
         f"{INIT}; self.layers = [nn.Linear(1, 1)]; nn.init.ones_(self.layers[0].weight).requires_grad_(False); "
         "nn.init.ones_(self.layers[0].bias)"),
    edit("parameters registered", r"no trainable parameter", INIT, f"{INIT}; self.requires_grad_(False)",
         also=NO_GRADIENT),
    edit("nothing unregistered", r"self\.offsets\['all'\] differs between seeds.*self\.register_buffer",
         INIT, f"{INIT}; self.offsets = {{'all': torch.rand(outputs)}}"),
    edit("quantum parameters", r"names \['out.weight'\]: is it 'quantum'", "def forward", QUANTUM),
    edit("quantum parameters", r"names \['weights'\], which are none of \['hidden.bias'",
         "def forward", QUANTUM.replace("out.weight", "weights"), family="quantum"),
    edit("quantum parameters", r"no parameter is declared quantum.* quantum_lr", family="quantum"),
    edit("same seed", r"same seed differ in 'out.bias': draw every number",
         INIT, f"{INIT}; self.out.bias.data += random.SystemRandom().random()", also=["population"]),
    edit("different seed", r"all seeds begin with the same 'hidden.weight', .*: draw it from the `generator`",
         "return Network", "torch.manual_seed(0); return Network"),
    edit("different seed", r"all seeds begin with the same 'out.weight', .* shared = \('out.weight',\)", INIT,
         f"{INIT}; nn.init.normal_(self.out.weight, generator=torch.Generator().manual_seed(42))"),
    edit("different seed", r"all seeds begin with the same 'hidden.weight'",
         "class Network", "FIRST = {}\n\n\nclass Network",
         INIT, f"{INIT}; w = self.hidden.weight.data; w.copy_(FIRST.setdefault(w.shape, w.clone()))"),
    edit("different seed", r"second network from one generator .* only read its seed",
         "return Network", "torch.manual_seed(generator.initial_seed()); return Network"),
    edit("global randomness", r"a pass moves Python's `random`", "return y", "random.random(); return y"),
    edit("rows apart", r"row 0 of a batch of 6 gives another output alone", "return y", "return y - y.mean(0)",
         also=["no cache"]),
    edit("no cache", r"earlier pass with inputs of the same shape",
         "class Network", "SCALES = {}\n\n\nclass Network", "return y",
         "return y / SCALES.setdefault(tuple(x.shape), float(x.detach().abs().max()))", also=["rows apart"]),
    edit("pure", r"changes its input in place: avoid", FORWARD,
         f"{FORWARD.replace('(x)', '(x.clone())')}; x.detach().mul_(0.5)",
         also=["finite differences", "copies", "population", "rows apart", "no cache"]),
    edit("pure", r"two passes over the same input differ: dropout",
         INIT, f"{INIT}; self.register_buffer('count', torch.zeros(1))",
         "return y", "self.count += 1; return y * self.count",
         also=["finite differences", "nothing unregistered", "rows apart", "no cache"]),
    edit("gradients", r"'unused' gets no gradient", INIT, f"{INIT}; self.unused = nn.Parameter(torch.rand(2))",
         also=["seed independence"]),
    edit("gradients", r"outputs have no gradient: is there a \.detach\(\)", "return y", "return y.detach()",
         also=NO_GRADIENT),
    edit("gradients", r"gradient of 'edge' is not finite", INIT, EDGE, "return y", "return y + self.edge.sqrt()"),
    edit("gradients", r"gradient of 'edge' is zero for 6 random inputs",
         INIT, EDGE, "return y", "return y + 0 * self.edge"),
    edit("finite differences", r"finite differences give .*backward pass",
         "return y", "return y + (y.detach() - y) / 2"),
    edit("copies", r"deep copy shares 'hidden.weight' with its original",
         "def forward", "def __deepcopy__(self, memo):\n        return self\n\n    def forward"),
    edit("copies", r"copy\.deepcopy, which makes target networks, changes 'hidden",
         "def forward", "def __deepcopy__(self, memo):\n        return Network(4, 3, 32)\n\n    def forward"),
    edit("population", r"slice 0 of the population differs from agent 0 alone", population=made("reversed_population")),
    edit("population", r"population maps \(5, 6, 4\) to \(5, 6, 2\)", population=made("short")),
    edit("population", r"same names, with a leading axis of seeds", population=made("wrapped")),
    edit("population", r"declares other quantum parameters than its agents",
         "def forward", QUANTUM, family="quantum", population=made("classical_population")),
    edit("seed independence", r"among themselves compute other values", also=["state"], population=made("coupled")),
    edit("seed independence", r"among themselves get another gradient of", population=made("steeper")),
    edit("seed independence", r"among themselves compute other values than among all 5 \(width = 5\): torch rounds "
         r".*silu.*: use relu.* tanh", "from torch import", f"from {HERE} import InVectors\nfrom torch import",
         FORWARD, FORWARD.replace("torch.tanh(self.hidden(x))", "InVectors.apply(torch.tanh(self.hidden(x)))")),
    edit("options per agent", r"gain = 10 computes something else beside one with another value than alone",
         "from torch import", "from qrlsuite.options import Tuned\nfrom torch import",
         WIDTH, WIDTH + "\n    gain: Annotated[float, Tuned(0.1, 10, per_agent=True)] = 1.0",
         "options.width)", "options)", "width: int)", "options)", "super()", "width = options.width; super()",
         INIT, f"{INIT}; self.options = options", "hidden(x)", "hidden(x * self.options.gain)"),
    edit("state", r"is not in state_dict\(\); register it", population=made("forgetful")),
    edit("state", r"is not restored by load_state_dict", population=made("deaf")),
    edit("bend=cos", r"gradient of 'edge' is zero", "import Annotated", "import Annotated, Literal",
         WIDTH, f"{WIDTH}\n    bend: Literal['tanh', 'cos', 'sin'] = 'tanh'",
         "options.width)", "options)", "width: int)", "options)", "super()", "width = options.width; super()",
         INIT, f"{INIT}; {EDGE.partition('; ')[2]}; self.bend = options.bend",
         "return y", "return y + self.edge.sum() * (self.bend != 'cos')"),
    edit("state", r"'steps' of shape \(\) has no leading axis", population=made("WithOneCounter")),
]  # fmt: skip


def spec(source: str = GOOD, **more: Any) -> ModelSpec:
    name = module(source)
    given = {"family": "classical", "options": f"{name}:Options", "build": f"{name}:build", **more}
    return ModelSpec(name="broken", summary="Breaks a rule", **given)


@pytest.mark.parametrize("edit", EDITS, ids=ids(EDITS))
def test_one_rule_is_broken(edit: Edit) -> None:
    assert_breaks(spec(edit.of(GOOD), **edit.spec), edit.rule, edit.message, edit.also)


def test_silu_is_refused_where_torch_rounds_it_by_place() -> None:
    """It does on processors with AVX2 or AVX-512, and there either values show it or a gradient."""
    x = torch.linspace(-3, 3, 150)
    by_place = any(
        not torch.equal(nn.functional.silu(x[:size]), nn.functional.silu(x)[:size]) for size in range(150)
    )
    silu = own_rules(spec(GOOD.replace("torch.tanh", "nn.functional.silu")))
    assert [finding.rule for finding in silu if not finding.ok] == ["seed independence"] * by_place


def test_every_rule_has_a_model_that_breaks_it() -> None:
    assert assert_all_good(spec()) == {edit.rule for edit in EDITS if "=" not in edit.rule}
