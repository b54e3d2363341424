"""Finds state that a model keeps outside of parameters, buffers and submodules.

A population (`qrlsuite.population`) stacks parameters and buffers, one slice per seed, and keeps everything else of
the first seed's module. So a tensor in a plain attribute that is drawn per seed would be seed 1's for all of them, and
one that a forward pass changes would be changed by all: a seed would then give another result than when trained alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from qrlsuite import own
from qrlsuite.errors import PluginError

BATCH = 2
_OF_TORCH = frozenset(vars(nn.Module()))
_REGISTER = "register it, self.register_buffer('name', tensor), or as nn.Parameter where it is trained"
_MODULES = "assign it to an attribute of its own, or keep several in nn.ModuleList or nn.ModuleDict"
_GENERATOR = "draw what is random in `build`, and register it as a parameter or buffer"

Held = dict[str, tuple[Any, str]]
"""By place (`blocks[0].weight`): a copy of the value, and the cure."""


def held(module: nn.Module) -> Held:
    """Return the tensors, arrays, random generators and floats that a module holds where torch does not look.

    Lists, tuples, sets and mappings are searched, and modules inside of them; other objects, such as a circuit
    backend, are not.
    """
    registered = {id(each) for each in module.modules()}
    return dict(_of_module(module, "", "", registered))


def _of_module(
    module: nn.Module, path: str, cure: str, seen: set[int]
) -> Iterator[tuple[str, tuple[Any, str]]]:
    """Go through the plain attributes of a module and of its submodules."""
    for name, part in module.named_modules(prefix=path):
        for attribute, value in vars(part).items():
            # a recurrent layer's second list of its own parameters, which torch keeps up to date
            torch_owned = attribute in _OF_TORCH or (
                isinstance(part, nn.RNNBase) and attribute == "_flat_weights"
            )
            if not torch_owned:
                yield from _inside(value, f"{name}.{attribute}".lstrip("."), cure, seen)


def _inside(value: Any, path: str, cure: str, seen: set[int]) -> Iterator[tuple[str, tuple[Any, str]]]:
    if isinstance(value, Tensor):
        yield path, (value.detach().cpu().clone(), cure or _REGISTER)
    elif isinstance(value, np.ndarray):
        yield path, (value.copy(), cure or _REGISTER.replace("tensor", "torch.as_tensor(array)"))
    elif isinstance(value, float | complex | np.floating):
        yield path, (value, cure or _REGISTER)
    elif isinstance(value, torch.Generator):
        yield path, (value.get_state(), _GENERATOR)
    elif isinstance(value, np.random.Generator | np.random.RandomState):
        yield (
            path,
            (
                repr(
                    value.bit_generator.state if isinstance(value, np.random.Generator) else value.get_state()
                ),
                _GENERATOR,
            ),
        )
    elif isinstance(value, nn.Module | Mapping | list | tuple | set | frozenset) and id(value) not in seen:
        seen.add(id(value))
        if isinstance(value, nn.Module):
            seen.update(id(each) for each in value.modules())
            for name, tensor in [*value.named_parameters(), *value.named_buffers()]:
                yield f"{path}.{name}", (tensor.detach().cpu().clone(), _MODULES)
            yield from _of_module(value, path, _MODULES, seen)
        elif isinstance(value, Mapping):
            for key, item in value.items():
                yield from _inside(item, f"{path}[{key!r}]", cure, seen)
        else:
            for index, item in enumerate(value):
                yield from _inside(item, f"{path}[{index}]", cure, seen)


def require_none(
    build: Callable[[int], nn.Module],
    inputs: int,
    model: str,
    stacked: bool = True,
    outputs: int | None = None,
) -> None:
    """Refuse a model that holds values which differ between two seeds, or which a forward pass changes.

    Parameters
    ----------
    build:
        Builds the module of the first seed (0) or of another seed (1), anew at every call.
    stacked:
        Whether `qrlsuite.population.stack` makes the population: `torch.vmap` hands buffers to a pass and drops their
        changes, so that a pass may change none.
    outputs:
        How many numbers a pass must return for each sample; None asks nothing of them.
    """
    probe = build(0)
    for name, part in probe.named_modules():
        if type(part).__name__ == "TorchLayer":
            raise PluginError(
                f"model '{model}': self.{name} is a TorchLayer of PennyLane, whose agents cannot be trained together: "
                f"write self.{name} = qrlsuite.layer(QNODE), the same circuit on a faster simulator"
            )
    before, other = held(probe), held(build(1))
    for path, (value, cure) in before.items():
        if path not in other or not _equal(value, other[path][0]):
            _refuse(model, path, "differs between seeds, and torch does not know it", cure)
    buffers = {name: buffer.clone() for name, buffer in probe.named_buffers()} if stacked else {}
    source = torch.Generator().manual_seed(0)
    try:
        with torch.no_grad(), torch.random.fork_rng(devices=()):
            result = probe(torch.rand(BATCH, inputs, generator=source))
    except (
        Exception
    ):  # its own error, which training will meet and report; inputs of the task may be of another kind
        return
    if outputs is not None:
        _require_outputs(result, (BATCH, inputs), (BATCH, outputs), probe, model)
    for path, (value, cure) in held(probe).items():
        known = before.get(path)
        if not isinstance(value, float | complex) and (known is None or not _equal(value, known[0])):
            _refuse(model, path, "is changed by a forward pass, and torch does not know it", cure)
    for name, buffer in probe.named_buffers():
        if name in buffers and not _equal(buffers[name].cpu(), buffer.cpu()):
            raise PluginError(
                f"model '{model}': the buffer self.{name} is changed by a forward pass: agents that are trained "
                "together would lose what the pass writes; a network is a function of its input alone, so keep no "
                "state between passes (batch normalization, a recurrent state, running means), or give the model a "
                "`population`"
            )


def _require_outputs(
    result: Any, given: tuple[int, int], wanted: tuple[int, int], module: nn.Module, model: str
) -> None:
    """Refuse outputs of a fresh network for inputs between 0 and 1 that no task can use."""
    if not isinstance(result, Tensor):
        what = type(result).__name__
    elif tuple(result.shape) != wanted:
        what = f"the shape {tuple(result.shape)}"
    elif not bool(torch.isfinite(result).all()):
        what = f"{result[~torch.isfinite(result)][0].item()} before any training"
    else:
        return
    where = own.place_of(type(module).forward)
    raise PluginError(
        f"model '{model}': for inputs of the shape {given} (samples, inputs), forward returns {what}, and must return "
        f"finite numbers of the shape {wanted} (samples, outputs)" + (f" ({where})" if where else "")
    )


def _equal(first: Any, second: Any) -> bool:
    if type(first) is not type(second):
        return False
    if isinstance(first, Tensor):
        first, second = first.numpy(), second.numpy()
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and np.array_equal(
            first, second, equal_nan=first.dtype.kind in "fc"
        )
    return bool(first == second) or first != first  # nan


def _refuse(model: str, path: str, problem: str, cure: str) -> None:
    raise PluginError(
        f"model '{model}': self.{path} {problem}: seeds that are trained together would share the first one's; {cure}"
    )
