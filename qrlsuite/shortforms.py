"""Short forms of registration for plugins by path: a function or class alone, its options taken from the signature.

    form                     signature                                          registered as
    a function               (qubits, layers, ...) -> Circuit                   ansatz
    a QNode, or a function beside `weight_shapes`   (inputs, weights, ...)      ansatz
    a torch.nn.Module        __init__(self, inputs, outputs, ...)               model
    a gymnasium.Env          __init__(self, ...)                                environment
    an algorithm's class     __init__(self, envs, build_model, streams, device, ...)   algorithm

Every further parameter is an option, with its annotation and its default. One parameter `options`, annotated with a
dataclass, may replace further parameters, as in a package. The name is the function's or class's in lower case with
hyphens, the summary the first line of its docstring.

A model's class attribute `family = "quantum"` says that it is one; otherwise it is one where its `__init__` or module
says `qrlsuite.layer`. Class attributes `shared` of a model and `repeats` of an environment mean the same as in the
spec. An environment's `lanes` is a `qrlsuite.environment.LaneEnv`, called with its options and the number of lanes.
Without it, episodes end after 1000 steps.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
import typing
from collections.abc import Callable, Iterable, Mapping
from types import ModuleType
from typing import Annotated, Any, Literal

import pydantic

from qrlsuite import specs
from qrlsuite.errors import OptionError, PluginError

EPISODE_STEPS = 1000
"""At which episodes of an environment end."""

_ALGORITHM = ("start", "train_epoch", "act", "state_dict", "load_state_dict", "policy_state")
"""The methods that identify an algorithm."""

HANDED = ("envs", "build_model", "streams", "device")
"""Arguments of an algorithm's class, beside options."""


ASKED = ("generator", "space", "role")
"""Arguments of a model's class, if it has such parameters, see `qrlsuite.specs.ModelSpec`."""


PRIVATE = "_qrlsuite_"
"""How the names of the targets of references begin."""


SHAPES = "weight_shapes"
"""The name of the table of shapes beside a quantum function, as for PennyLane's TorchLayer."""


def kebab(name: str) -> str:
    """Return the name under which a function or class is registered: `RingNet` becomes `ring-net`."""
    words = re.sub(r"([a-z0-9])([A-Z])|([A-Z])(?=[A-Z][a-z])", lambda m: f"{m[1] or m[3]}-{m[2] or ''}", name)
    return re.sub(r"[-_]+", "-", words).strip("-").lower()


def kind_of(thing: Any) -> type[specs.Spec] | None:
    """Return the kind that a function or class is a short form of, None where it is of none."""
    if inspect.isfunction(thing) or is_qnode(thing):
        return specs.AnsatzSpec if is_quantum_function(thing) or _builds_circuits(thing) else None
    if not isinstance(thing, type):
        return None
    gymnasium, torch = sys.modules.get("gymnasium"), sys.modules.get("torch")
    if gymnasium is not None and issubclass(thing, gymnasium.Env):
        return specs.EnvironmentSpec
    if torch is not None and issubclass(thing, torch.nn.Module):
        return specs.ModelSpec
    if all(callable(getattr(thing, name, None)) for name in _ALGORITHM):
        return specs.AlgorithmSpec
    return None


def is_qnode(thing: Any) -> bool:
    """Return whether this is a QNode of PennyLane, whose import it does not need."""
    pennylane = sys.modules.get("pennylane")
    return pennylane is not None and isinstance(thing, pennylane.QNode)


def is_quantum_function(thing: Any) -> bool:
    """Return whether this is a QNode, or a function of `inputs` and of weights whose shapes are beside it."""
    if is_qnode(thing) or not inspect.isfunction(thing):
        return is_qnode(thing)
    needs = {each.name for each in _parameters(thing) if each.default is each.empty}
    return "pennylane" in sys.modules and {"inputs"} < needs <= {"inputs", *thing.__globals__.get(SHAPES, ())}


def source_of(function: Any) -> Any:
    """Return the Python function of a QNode, or the function itself."""
    return function.func if is_qnode(function) else function


def shapes_of(function: Any) -> Mapping[str, Any]:
    """Return the table `weight_shapes` beside a quantum function.

    Raises
    ------
    PluginError
        If a parameter without default is not in it.
    """
    source = source_of(function)
    shapes = source.__globals__.get(SHAPES, {})
    others = [each for each in _parameters(source) if each.name != inputs_of(function)]
    for each in others:
        if each.default is each.empty and each.name not in shapes:
            raise PluginError(
                f"'{source.__name__}': the shape of '{each.name}' is not known; write at the top level of its file "
                f'{SHAPES} = {{"{each.name}": lambda qubits, layers: (layers, qubits, 3)}}, or the shape in numbers'
            )
    return {each.name: shapes[each.name] for each in others if each.name in shapes}


def inputs_of(function: Any) -> str:
    """Return the name of a quantum function's parameter for inputs: `inputs`, as for TorchLayer, or the first one."""
    names = [each.name for each in _parameters(source_of(function))]
    return "inputs" if "inputs" in names or not names else names[0]


def has_one_size(function: Any) -> bool:
    """Return whether the shapes of all weights are numbers, and so qubits and layers are given by the function."""
    return not any(callable(shape) for shape in shapes_of(function).values())


def lacking(things: Iterable[Any]) -> str:
    """Name the methods that the first class lacks that trains or acts like an algorithm; empty without such a class."""
    for thing in things:
        if not isinstance(thing, type) or kind_of(thing) is not None:
            continue
        has = [name for name in _ALGORITHM if callable(getattr(thing, name, None))]
        if {"train_epoch", "act"} & set(has):
            lacks = [name for name in _ALGORITHM if name not in has]
            return (
                f"class {thing.__name__} has {' and '.join(has)}, and lacks {', '.join(lacks)}: an algorithm needs all "
                f"{len(_ALGORITHM)} methods"
            )
    return ""


def _builds_circuits(function: Callable[..., Any]) -> bool:
    """Return whether a function is annotated to return a circuit; or, without such a word, takes qubits and layers."""
    returned = function.__annotations__.get("return", inspect.Parameter.empty)
    if returned is not inspect.Parameter.empty:
        word = returned if isinstance(returned, str) else getattr(returned, "__name__", "")
        return word.rpartition(".")[2] == "Circuit"
    return list(inspect.signature(function).parameters)[:2] == ["qubits", "layers"]


def public(module: ModuleType) -> list[Any]:
    """Return the public functions and classes that are defined in a module; of a QNode's function the QNode."""
    things = [
        thing
        for name, thing in vars(module).items()
        if not name.startswith("_")
        and getattr(thing, "__module__", "").partition(".")[0] == module.__name__
        and (getattr(thing, "__name__", None) == name or is_qnode(thing))
    ]
    inner = [source_of(thing) for thing in things if is_qnode(thing)]
    return [thing for thing in things if thing not in inner]


def recognized(module: ModuleType) -> list[Any]:
    """Return the functions and classes in a module that are short forms: public ones that are defined there.

    A `torch.nn.Module` whose `__init__` does not fit a model is a part of a model, and is left out.
    """
    found = [(thing, kind_of(thing)) for thing in public(module)]
    return [
        thing
        for thing, kind in found
        if kind is not None and not (kind is specs.ModelSpec and _is_part(thing))
    ]


def notes(module: ModuleType) -> list[str]:
    """Describe how networks in a module that call a QNode are trained faster."""
    found = []
    for cls in public(module):
        if kind_of(cls) is not specs.ModelSpec:
            continue
        codes = (getattr(each, "__code__", None) for each in vars(cls).values())
        names = {name for code in codes if code is not None for name in code.co_names}
        qnodes = sorted(name for name in names if is_qnode(getattr(module, name, None)))
        if qnodes and not {"layer", "TorchLayer"} & names:  # `run` refuses a TorchLayer, in the same words
            found.append(
                f"note: {cls.__name__} calls the QNode {qnodes[0]}, one sample or agent after the other: "
                f"self.circuit = qrlsuite.layer({qnodes[0]}) is the same circuit for all agents at once"
            )
    return found


def _is_part(cls: type[Any]) -> bool:
    try:
        _signature(cls, ("inputs", "outputs"), optional=ASKED)
    except PluginError:
        return True
    return False


def line_of(thing: Any) -> int | None:
    """Return the line where a function or class begins, None where it is not known."""
    code = getattr(source_of(thing), "__code__", None)
    if code is not None:
        return int(code.co_firstlineno)
    try:
        return inspect.getsourcelines(thing)[1]
    except (OSError, TypeError):
        return None


def spec_of(thing: Any, module: ModuleType, origin: str) -> specs.Spec:
    """Return the spec of a short form; the targets of its references are put into the module.

    Parameters
    ----------
    origin:
        The plugin's name, for the summary of a thing without a docstring.

    Raises
    ------
    PluginError
        If it is no short form, or a parameter cannot be an option; the message has the remedy.
    """
    kind = kind_of(thing)
    if kind is None:
        raise PluginError(f"{_title(thing)} cannot be registered: {lacking([thing]) or f'write {FORMS}'}")
    name = kebab(thing.__name__)
    if not specs.NAME.fullmatch(name):
        raise PluginError(
            f"{_title(thing)} needs a name with letters, of which 'ring-net' is made for RingNet"
        )
    makers: dict[type[specs.Spec], Callable[[Any, str, str, _Holder], specs.Spec]] = {
        specs.AnsatzSpec: _ansatz,
        specs.ModelSpec: _model,
        specs.EnvironmentSpec: _environment,
        specs.AlgorithmSpec: _algorithm,
    }
    # not the docstring of a base class
    own = vars(thing).get("__doc__") if isinstance(thing, type) else getattr(thing, "__doc__", None)
    summary = (own or "").strip().partition("\n")[0].strip()
    return makers[kind](
        thing, name, summary or f"{thing.__name__} of {origin}", _Holder(module, thing.__name__)
    )


FORMS = (
    "a function (qubits, layers) that returns a Circuit, a QNode, a function (inputs, weights) beside weight_shapes, a "
    "torch.nn.Module, gymnasium.Env or algorithm class"
)


def _title(thing: Any) -> str:
    return f"'{getattr(thing, '__name__', None) or repr(thing)[:60]}'"


def put_targets(module: str, *things: Any) -> None:
    """Put the options and builders of short forms into a module, for specs that refer to them."""
    for thing in things:
        spec_of(thing, sys.modules[module], module)


class _Holder:
    """Puts the targets of references into a module."""

    def __init__(self, module: ModuleType, name: str) -> None:
        self.module, self.name = module, name

    def put(self, word: str, value: Any) -> str:
        attribute = f"{PRIVATE}{self.name}_{word}"
        known = str(value.__name__)
        if isinstance(value, type) and getattr(self.module, known, None) is value:
            return f"{self.module.__name__}:{known}"  # an options class that is written out
        value.__module__, value.__qualname__ = self.module.__name__, attribute
        value.__name__ = attribute
        setattr(self.module, attribute, value)
        return f"{self.module.__name__}:{attribute}"


def _ansatz(function: Callable[..., Any], name: str, summary: str, holder: _Holder) -> specs.Spec:
    qubits = None
    if is_quantum_function(function):
        try:
            options, call = _signature(
                source_of(function), (), (inputs_of(function), *shapes_of(function)), more=_ENTANGLED
            )

            def build(qubits: int | None, layers: int, chosen: Any) -> Any:
                own = functools.partial(call, options=chosen)
                trace = specs.resolve("qrlsuite.circuit.tracing:trace")
                mean_field = getattr(chosen, "entangled", True) == "mean-field"
                return trace(function, qubits, layers, own, mean_field)

            if has_one_size(function):
                qubits = build(None, 1, options()).qubits
        except OptionError as error:
            raise PluginError(str(error)) from error
    else:
        options, call = _signature(function, ("qubits", "layers"))

        def build(qubits: int | None, layers: int, chosen: Any) -> Any:
            return call(qubits, layers, options=chosen)

    return specs.AnsatzSpec(
        name, summary, holder.put("options", options), holder.put("build", build), qubits=qubits
    )


_ENTANGLED = (
    (
        "entangled",
        Annotated[
            Literal[True, "mean-field"],
            pydantic.Field(description="mean-field: without correlations of qubits"),
        ],
        True,
    ),
)


def _model(cls: type[Any], name: str, summary: str, holder: _Holder) -> specs.Spec:
    options, call = _signature(cls, ("inputs", "outputs"), optional=ASKED)

    def build(obs_dim: int, out_dim: int, chosen: Any, generator: Any, **more: Any) -> Any:
        return call(obs_dim, out_dim, options=chosen, generator=generator, **more)

    given = inspect.signature(build)
    asked = [each for each in inspect.signature(cls).parameters if each in ASKED[1:]]
    build.__signature__ = given.replace(  # type: ignore[attr-defined]
        parameters=[
            *list(given.parameters.values())[:-1],
            *(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in asked),
        ]
    )

    if not hasattr(cls, "quantum_parameters") and _uses_circuits(cls):
        cls.quantum_parameters = circuit_parameters
    family: Any = getattr(cls, "family", None) or ("quantum" if _uses_circuits(cls) else "classical")
    return specs.ModelSpec(
        name,
        summary,
        family=family,
        options=holder.put("options", options),
        build=holder.put("build", build),
        shared=getattr(cls, "shared", ()),
    )


def circuit_parameters(module: Any) -> set[str]:
    """Return the names of a module's parameters that belong to `qrlsuite.layer`: its `quantum_parameters`."""
    return {
        f"{place}.{name}" if place else name
        for place, part in module.named_modules()
        if type(part).__module__.startswith("qrlsuite.circuit")
        for name, _ in part.named_parameters()
    }


def _uses_circuits(cls: type[Any]) -> bool:
    """Return whether a model's `__init__` names `qrlsuite.layer`, or another of the suite's functions of circuits."""
    init = vars(cls).get("__init__")
    names, scope = getattr(getattr(init, "__code__", None), "co_names", ()), getattr(init, "__globals__", {})
    return any(
        name == "layer" or getattr(scope.get(name), "__module__", "").startswith("qrlsuite.circuit")
        for name in names
    )


def _environment(cls: type[Any], name: str, summary: str, holder: _Holder) -> specs.Spec:
    options, _ = _signature(cls, ())
    lanes = getattr(cls, "lanes", None)

    def vector(options: Any, num_envs: int) -> Any:
        return cls.lanes(options, num_envs)

    def make(**arguments: Any) -> Any:
        from gymnasium.wrappers import TimeLimit

        return TimeLimit(cls(**arguments), EPISODE_STEPS)

    return specs.EnvironmentSpec(
        name,
        summary,
        options=holder.put("options", options),
        gymnasium_id=f"{holder.module.__name__}/{cls.__name__}-v0",
        entry_point=holder.put("make", make),
        vector=None if lanes is None else holder.put("vector", vector),
        repeats=getattr(cls, "repeats", False),
    )


def _algorithm(cls: type[Any], name: str, summary: str, holder: _Holder) -> specs.Spec:
    options, call = _signature(cls, (), named=HANDED)

    def factory(envs: Any, build_model: Any, chosen: Any, streams: Any, device: Any) -> Any:
        return call(options=chosen, envs=envs, build_model=build_model, streams=streams, device=device)

    return specs.AlgorithmSpec(
        name,
        summary,
        options=holder.put("options", options),
        factory=holder.put("factory", factory),
        actions=tuple(getattr(cls, "actions", ("discrete",))),
    )


def _signature(
    thing: Callable[..., Any],
    first: tuple[str, ...],
    named: tuple[str, ...] = (),
    optional: tuple[str, ...] = (),
    more: tuple[tuple[str, Any, Any], ...] = (),
) -> tuple[type[Any], Callable[..., Any]]:
    """Return the options class of a signature, and a function that calls with an object of it as `options`.

    Parameters
    ----------
    first:
        Arguments by position; the parameters may have other names.
    named, optional:
        Arguments by name: always, and if there is such a parameter.
    more:
        Further options (name, annotation, default), where neither a parameter nor a dataclass of options is in their
        place.
    """
    parameters = _parameters(thing)
    written = f"{thing.__name__}({', '.join([*first, *named, '...'])})"
    if len(parameters) < len(first) or any(p.kind is p.KEYWORD_ONLY for p in parameters[: len(first)]):
        raise PluginError(f"{_title(thing)} takes {len(parameters)} arguments, and is called as {written}")
    rest = [each for each in parameters[len(first) :] if each.name not in (*named, *optional)]
    missing = [name for name in named if name not in {each.name for each in parameters}]
    if missing:
        raise PluginError(f"{_title(thing)} has no parameter '{missing[0]}', and is called as {written}")
    hints = _hints(thing)
    positional = [each.name for each in rest if each.kind is each.POSITIONAL_ONLY]
    if positional:
        raise PluginError(f"{_title(thing)}: '{positional[0]}' cannot be given by name: leave the / out")
    takes = {each.name for each in parameters}
    if [each.name for each in rest] == ["options"] and dataclasses.is_dataclass(hints.get("options")):
        return hints["options"], _calling(thing, takes, lambda chosen: {"options": chosen})
    fields = [_field(thing, each, hints) for each in rest]
    fields += [each for each in more if each[0] not in takes]
    body: dict[str, Any] = {name: default for name, _, default in fields}
    body |= {
        "__annotations__": {name: annotation for name, annotation, _ in fields},
        "__doc__": f"Options of {thing.__name__}.",
    }
    made = pydantic.dataclasses.dataclass(
        type("Options", (), body), frozen=True, config=pydantic.ConfigDict(extra="forbid")
    )
    names = [each.name for each in rest]
    return made, _calling(thing, takes, lambda chosen: {name: getattr(chosen, name) for name in names})


def _parameters(thing: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the parameters that have a name of their own."""
    every = inspect.signature(thing).parameters.values()
    return [each for each in every if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]


def _calling(thing: Callable[..., Any], takes: set[str], unfold: Callable[[Any], Mapping[str, Any]]) -> Any:
    def call(*given: Any, options: Any, **named: Any) -> Any:
        return thing(
            *given, **{name: value for name, value in named.items() if name in takes}, **unfold(options)
        )

    return call


def _hints(thing: Any) -> Mapping[str, Any]:
    function: Any = getattr(thing, "__init__") if isinstance(thing, type) else thing  # noqa: B009
    try:
        return typing.get_type_hints(function, include_extras=True)
    except Exception as error:  # a name that is not there, say
        raise PluginError(
            f"{_title(thing)}: its annotations cannot be read: {type(error).__name__}: {error}"
        ) from None


def _field(
    thing: Callable[..., Any], parameter: inspect.Parameter, hints: Mapping[str, Any]
) -> tuple[str, Any, Any]:
    name, default = parameter.name, parameter.default
    if default is parameter.empty:
        kind = parameter.annotation if isinstance(parameter.annotation, str) else "int"
        raise PluginError(
            f"{_title(thing)}: parameter '{name}' needs a default, for example {name}: {kind} = 1"
        )
    annotation = hints.get(name)
    if annotation is None:
        if not isinstance(default, bool | int | float | str):
            raise PluginError(
                f"{_title(thing)}: parameter '{name}' needs a type, for example {name}: int = 1"
            )
        annotation = type(default)
    described = any(getattr(each, "description", None) for each in getattr(annotation, "__metadata__", ()))
    if not described:
        annotation = Annotated[annotation, pydantic.Field(description=f"argument of {thing.__name__}")]
    factory = functools.partial(type(default), default) if isinstance(default, list | dict | set) else None
    given = (
        dataclasses.field(default=default) if factory is None else dataclasses.field(default_factory=factory)
    )
    return name, annotation, given
