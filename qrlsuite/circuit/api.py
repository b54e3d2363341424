"""Circuits by name: `ansatz` builds one, `expectations` runs it on any registered backend.

    >>> from qrlsuite.circuit import ansatz, expectations
    >>> circuit = ansatz("cz", qubits=3, layers=2, gate="xyz")
    >>> zeros = {name: np.zeros(p.shape) for name, p in circuit.parameters.items()}
    >>> expectations(circuit, np.zeros((5, 3)), zeros).shape
    torch.Size([5, 3])

Registry, torch and simulators are imported when a function is called, not before.
"""

from __future__ import annotations

import copy
import functools
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import numpy as np

from qrlsuite.circuit.description import (
    FUNCTIONS,
    Circuit,
    Encoding,
    Product,
    apart,
    in_bases,
    without_products,
)
from qrlsuite.errors import OptionError, PluginError, QrlSuiteError, nearest

if TYPE_CHECKING:
    import torch
    from numpy.typing import ArrayLike

    from qrlsuite.specs import CircuitBackendSpec


Options = TypeVar("Options")


class CircuitBackend(Protocol):
    """The result of `factory(circuit, options)` of a `CircuitBackendSpec`.

    A backend evaluates one circuit for S seeds (agents with their own parameters) and B inputs each. Seeds
    must not influence each other: slice s of the result depends on slice s of the arguments alone, bitwise.
    It has no state that a call changes; deep copies of a model share it.

    Attributes
    ----------
    shots:
        Circuit repetitions per expectation value; None means exact.

    More attributes are read where a backend has them:

    draws (bool):
        Whether results are random, so that `seeds` are needed; by default where `shots` is finite.
    noisy (bool):
        Whether values differ from the exact ones by noise; `qrlsuite check` then compares roughly. By default false.
    gradient_circuits (int):
        Circuits that it executes per input for a gradient; by default the number of the parameter-shift rule. They
        count if `draws` is true; for an exact simulator the rule's number counts, so that entries can be compared.
    simulator (bool):
        False where circuits run on a device, whose executions may cost money; by default true.
    terms (callable):
        For a device: `terms(circuits)` returns its queue and the price of a number of circuits, in words. It executes
        nothing.
    repeats (int):
        Circuits that are executed in place of each, to mitigate errors; by default 1.
    states (callable):
        For a simulator: `states(inputs, parameters)` returns the final states (S, B, 2^n), up to a global phase,
        without shots and noise; qubit 0 is the highest bit of a basis state's index.
    compile_for (callable):
        For a simulator: `compile_for(like)` compiles all code for passes on tensors of the dtype and device of `like`.
        It is called before training, so that no epoch's time includes it.
    """

    shots: int | None

    def __call__(
        self,
        inputs: torch.Tensor,
        parameters: Mapping[str, torch.Tensor],
        seeds: Sequence[int] | None = None,
    ) -> torch.Tensor:
        """Return expectation values, differentiable in torch by inputs and parameters.

        Parameters
        ----------
        inputs:
            (S, B, circuit.inputs), float32 or float64, radians before scaling.
        parameters:
            Every declared parameter by name, (S, *shape), of the inputs' dtype.
        seeds:
            S non-negative integers below 2^63, used where results are random: the sampling of seed s, in the
            backward pass too, depends on `seeds[s]` alone. None draws fresh entropy.

        Returns
        -------
        Tensor
            (S, B, len(circuit.observables)), in [-1, 1], of the inputs' dtype.
        """
        ...


def ansatz(name: str, qubits: int, layers: int, **options: Any) -> Circuit:
    """Build a registered ansatz.

    Parameters
    ----------
    name:
        Name of the ansatz: `qrlsuite list ansatzes`.
    qubits, layers:
        Size of the circuit: 1 or more of each. The backend limits the number of qubits.
    options:
        Options of the ansatz, such as `gate="rot"`.

    Raises
    ------
    UnknownNameError
        If no ansatz has that name.
    OptionError
        For a number of qubits or layers, or an option, that the ansatz cannot have.
    PluginError
        If the ansatz fails otherwise, or returns no circuit.
    """
    from qrlsuite import options as option_values
    from qrlsuite import own, registry, specs

    if isinstance(qubits, bool) or not isinstance(qubits, int) or qubits < 1:
        raise OptionError(f"qubits = {qubits!r}: a circuit has 1 qubit or more")
    if isinstance(layers, bool) or not isinstance(layers, int) or layers < 1:
        raise OptionError(f"layers = {layers!r}: a circuit has 1 layer or more")
    spec = registry.get(specs.AnsatzSpec, name)
    chosen = option_values.build(specs.resolve(spec.options), options, f"ansatz '{name}'")
    try:
        circuit = specs.resolve(spec.build)(qubits, layers, chosen)
    except OptionError as error:
        raise own.placed(error) from None
    except QrlSuiteError:
        raise
    except Exception as error:
        raise PluginError(f"ansatz '{name}' cannot be built: {own.failure(error)}") from error
    if not isinstance(circuit, Circuit):
        raise PluginError(
            f"ansatz '{name}' returns {type(circuit).__name__}, and must return a Circuit of qrlsuite.circuit; "
            "a QNode stands in the file by itself, see docs/your-circuit.md"
        )
    return circuit


def options_on(of_model: type[Options], backend: str) -> type[Options]:
    """Return one class with the options of a circuit model and of the backend that computes its circuits.

    Parameters
    ----------
    of_model:
        The model's, a frozen pydantic dataclass.
    backend:
        Name of the backend; the class variable `backend` of the result.

    Raises
    ------
    UnknownNameError
        If no backend has that name.
    PluginError
        If both classes have something of one name.
    """
    from qrlsuite import registry, specs

    of_backend = specs.resolve(registry.get(specs.CircuitBackendSpec, backend).options)
    joined: type[Options] = _joined(cast(Any, of_model), of_backend, backend)
    return joined


@functools.cache
def _joined(of_model: Any, of_backend: Any, backend: str) -> Any:
    from pydantic import ConfigDict
    from pydantic.dataclasses import dataclass

    from qrlsuite.options import field_names

    names = {*field_names(of_model), *(name for name in vars(of_model) if not name.startswith("_"))}
    if shared := sorted(names & set(dir(of_backend)) | names & set(field_names(of_backend))):
        raise PluginError(
            f"circuit backend '{backend}': '{shared[0]}' of its options is one of the model's: give it another name"
        )

    def reduced(
        self: Any,
    ) -> tuple[Any, ...]:  # a process that unpickles it finds no class of this name in a module
        values = {name: getattr(self, name) for name in field_names(type(self))}
        return _with_values, (of_model, backend, values)

    content = {
        "__module__": of_model.__module__,
        "__doc__": of_model.__doc__,
        "backend": backend,
        "__reduce__": reduced,
    }
    made = type(f"{of_model.__name__}[{backend}]", (of_backend, of_model), content)
    return dataclass(frozen=True, config=ConfigDict(extra="forbid"))(made)


def _with_values(of_model: type[Options], backend: str, values: Mapping[str, Any]) -> Options:
    return options_on(of_model, backend)(**values)


def create_backend(name: str, circuit: Circuit, **options: Any) -> CircuitBackend:
    """Prepare a registered backend for a circuit.

    Raises
    ------
    UnknownNameError
        If no backend has that name.
    OptionError
        For an option that it cannot have, a circuit that it cannot run, or a missing optional package.
    """
    spec, chosen = _backend(name, circuit, options)
    return _make(spec, circuit, chosen)


class _Whole:
    """A backend made of the backends of a circuit's parts, to which functions and products of inputs are more inputs.

    Parts are measurement bases and, where the backend takes no more at once, qubits that nothing connects.
    """

    def __init__(
        self, parts: Sequence[CircuitBackend], places: Sequence[int], products: Sequence[Encoding | Product]
    ) -> None:
        self.parts = parts
        self.places = places
        self.products = products
        first = parts[0]
        self.shots = first.shots
        for name in ("draws", "noisy", "simulator", "repeats", "terms"):
            if hasattr(first, name):
                setattr(self, name, getattr(first, name))
        if hasattr(first, "gradient_circuits"):
            self.gradient_circuits = sum(cast(Any, part).gradient_circuits for part in parts)
        if hasattr(first, "compile_for"):
            self.compile_for = self._compile_for
        if hasattr(first, "states") and len(parts) == 1:  # others turn the state, or have a part of it
            self.states = self._states

    def _compile_for(self, like: torch.Tensor) -> None:
        for part in self.parts:
            cast(Any, part).compile_for(like)

    def _states(self, inputs: torch.Tensor, parameters: Mapping[str, torch.Tensor]) -> torch.Tensor:
        found: torch.Tensor = cast(Any, self.parts[0]).states(extended(inputs, self.products), parameters)
        return found

    def __call__(
        self,
        inputs: torch.Tensor,
        parameters: Mapping[str, torch.Tensor],
        seeds: Sequence[int] | None = None,
    ) -> torch.Tensor:
        """Return expectation values, see `CircuitBackend`."""
        x = extended(inputs, self.products)
        if len(self.parts) == 1:
            return self.parts[0](x, parameters, seeds)
        import torch

        values = [
            part(x, parameters, seeds if seeds is None else [_part_seed(seed, k) for seed in seeds])
            for k, part in enumerate(self.parts)
        ]
        return torch.cat(values, dim=-1)[..., list(self.places)]


def _part_seed(seed: int, part: int) -> int:
    """Return the seed of one part's samples, independent of other parts' seeds."""
    return int(np.random.SeedSequence((seed, part)).generate_state(1, np.uint64)[0] >> np.uint64(1))


def extended(inputs: torch.Tensor, further: Sequence[Encoding | Product]) -> torch.Tensor:
    """Return inputs (..., in) with functions and products of them behind, see `without_products`."""
    import torch

    if columns := [_encoded(each, inputs) for each in further if isinstance(each, Encoding)]:
        inputs = torch.cat([inputs, torch.stack(columns, dim=-1)], dim=-1)
    products = [each for each in further if not isinstance(each, Encoding)]
    if not products:
        return inputs
    first, second, times = zip(*products)
    factors = inputs
    if None in first or None in second:  # 1 stands behind the inputs
        factors = torch.cat([inputs, torch.ones_like(inputs[..., :1])], dim=-1)
    left, right = ([-1 if i is None else i for i in each] for each in (first, second))
    products_of_inputs = factors[..., left] * factors[..., right]
    if any(number != 1.0 for number in times):
        products_of_inputs = products_of_inputs * inputs.new_tensor(times)
    return torch.cat([inputs, products_of_inputs], dim=-1)


def _encoded(term: Encoding | int, inputs: torch.Tensor) -> torch.Tensor:
    """Return an input, or a function of inputs, (...)."""
    import torch

    if not isinstance(term, Encoding):
        return inputs[..., term]
    values = []
    for angle in term.of:
        terms = [_encoded(each, inputs) for each in (angle.input, angle.factor) if each is not None]
        value = functools.reduce(torch.mul, terms, torch.full_like(inputs[..., 0], angle.times))
        values.append(value + angle.constant if terms else torch.full_like(value, angle.constant))
    if term.function in FUNCTIONS:
        found: torch.Tensor = getattr(torch, term.function)(values[0])
        return found
    return functools.reduce(torch.add if term.function == "sum" else torch.mul, values)


def _make(spec: CircuitBackendSpec, circuit: Circuit, chosen: Any) -> CircuitBackend:
    from qrlsuite import specs

    factory = specs.resolve(spec.factory)
    plain, products = without_products(circuit)
    parts = in_bases(plain)
    most = spec.max_qubits
    if most is not None and circuit.qubits > most and not circuit.mean_field:
        parts = [
            (few, tuple(places[place] for place in some))
            for part, places in parts
            for few, some in apart(part)
        ]
    backends: list[CircuitBackend] = [factory(part, chosen) for part, _ in parts]
    if len(parts) == 1 and not products:
        return backends[0]
    order = [place for _, places in parts for place in places]
    return _Whole(backends, np.argsort(order).tolist(), products)


def _backend(name: str, circuit: Circuit, options: Mapping[str, Any]) -> tuple[CircuitBackendSpec, Any]:
    from qrlsuite import options as option_values
    from qrlsuite import registry, specs

    spec = registry.get(specs.CircuitBackendSpec, name)
    require_computable(circuit, name)
    return spec, option_values.build(specs.resolve(spec.options), options, f"circuit backend '{name}'")


def require_computable(circuit: Circuit, backend: str) -> None:
    """Refuse a circuit of a kind that a registered backend does not compute.

    Raises
    ------
    UnknownNameError
        If no backend has that name.
    OptionError
        For more qubits than the backend takes; for a mean-field approximation, or products of Paulis, where the backend
        has none; for both together.
    """
    from qrlsuite import registry, specs

    spec = registry.get(specs.CircuitBackendSpec, backend)
    if circuit.mean_field and not spec.mean_field:
        raise OptionError(
            f"backend '{backend}' runs circuits, and the mean-field approximation of a circuit is none; backend "
            "'native' computes it (model vqc-native)"
        )
    largest = 0 if circuit.mean_field else max(map(len, circuit.components()))
    if spec.max_qubits is not None and largest > spec.max_qubits:
        limits = {
            name: each.spec.max_qubits for name, each in registry.load().of(specs.CircuitBackendSpec).items()
        }
        more = [
            f"'{name}' takes {limit or 'any number'}"
            for name, limit in limits.items()
            if limit is None or limit >= largest
        ]
        raise OptionError(
            f"qubits = {circuit.qubits}: gates or observables connect {largest} of them, and backend '{backend}' "
            f"takes at most {spec.max_qubits}; {', '.join(more) or 'no backend that is installed takes so many'}"
        )
    if circuit.measures_products and not spec.products:
        raise OptionError(f"backend '{backend}' measures Paulis of single qubits, and not products of them")
    if circuit.measures_products and circuit.mean_field:
        raise OptionError(
            "a mean-field approximation has no correlations, and so no products of Paulis to measure"
        )


class _Prepared(threading.local):
    """The backends of the last circuits that `expectations` ran, the latest last; every thread has its own."""

    def __init__(self) -> None:
        self.backends: OrderedDict[Any, CircuitBackend] = OrderedDict()


_prepared = _Prepared()
PREPARED = 8
"""How many backends a thread keeps."""


def _prepare(name: str, circuit: Circuit, options: Mapping[str, Any]) -> CircuitBackend:
    """Return a backend for a circuit; an earlier one if backend, options and the circuit's content are equal."""
    spec, chosen = _backend(name, circuit, options)
    size = circuit.qubits, circuit.inputs, circuit.mean_field
    content = (*size, *circuit.parameters.values(), *circuit, circuit.observables)
    key = (spec, repr(chosen), content)
    kept = _prepared.backends
    if key in kept:
        kept.move_to_end(key)
        return kept[key]
    # A copy: a backend may read its circuit at every call, and the caller may append to it.
    backend = _make(spec, copy.deepcopy(circuit), chosen)
    kept[key] = backend
    if len(kept) > PREPARED:
        kept.popitem(last=False)
    return backend


def expectations(
    circuit: Circuit,
    inputs: ArrayLike | torch.Tensor,
    parameters: Mapping[str, ArrayLike | torch.Tensor],
    backend: str | None = None,
    dtype: torch.dtype | str | None = None,
    seed: int | None = None,
    **backend_options: Any,
) -> torch.Tensor:
    """Compute a circuit's expectation values for a batch of inputs.

    The last few circuits stay prepared, so that only the first call with a circuit compiles it.

    Parameters
    ----------
    circuit:
        The circuit to run.
    inputs:
        (B, circuit.inputs), finite.
    parameters:
        Every declared parameter by name, of its declared shape, finite. Tensors keep their gradient.
    backend:
        Name of a registered circuit backend; by default `native` where it is registered, else `pennylane`.
    dtype:
        float32 or float64; by default the dtype of `inputs` if it is one of these, else float64.
    seed:
        Seed of the sampling where the options ask for a finite number of shots; None draws fresh entropy.
    backend_options:
        Options of the backend, such as `device="lightning.qubit"` or `shots=1000`.

    Returns
    -------
    Tensor
        (B, len(circuit.observables)): the expectation values of its observables, in [-1, 1].

    Raises
    ------
    UnknownNameError
        If no backend has that name.
    OptionError
        For inputs or parameters that are missing, not finite or of a wrong shape; for wrong options.
    """
    from qrlsuite import registry, specs

    if backend is None:
        backend = "native" if "native" in registry.load().names(specs.CircuitBackendSpec) else "pennylane"
    exact = _dtype(inputs, dtype)
    x = _tensor(inputs, "inputs", exact)
    if x.dim() != 2 or x.shape[1] != circuit.inputs or x.shape[0] < 1:
        raise OptionError(
            f"inputs have shape {tuple(x.shape)}: this circuit needs (batch, {circuit.inputs}), one row per sample"
        )
    unknown = [name for name in parameters if name not in circuit.parameters]
    if unknown:
        raise OptionError(
            f"this circuit has no parameter '{unknown[0]}'{nearest(unknown[0], circuit.parameters)}"
        )
    state: dict[str, torch.Tensor] = {}
    for name, parameter in circuit.parameters.items():
        if name not in parameters:
            raise OptionError(f"parameter '{name}' of shape {parameter.shape} is missing")
        value = _tensor(parameters[name], f"parameter '{name}'", exact)
        if tuple(value.shape) != parameter.shape:
            raise OptionError(
                f"parameter '{name}' has shape {tuple(value.shape)}, declared is {parameter.shape}"
            )
        state[name] = value[None]
    run = _prepare(backend, circuit, backend_options)
    return run(x[None], state, None if seed is None else [seed])[0]


def _dtype(inputs: Any, dtype: torch.dtype | str | None) -> torch.dtype:
    import torch

    known = {"float32": torch.float32, "float64": torch.float64}
    if dtype is None:
        input_dtype = str(getattr(inputs, "dtype", "float64")).removeprefix("torch.")
        return known.get(input_dtype, torch.float64)
    name = str(dtype).removeprefix("torch.")
    if name not in known:
        raise OptionError(f"dtype = {name}: circuits are computed in float32 or float64")
    return known[name]


def _tensor(value: Any, name: str, dtype: torch.dtype) -> torch.Tensor:
    """Convert to a finite tensor of a precision, keeping the gradient of one that has it."""
    import torch

    try:
        tensor = (
            value if isinstance(value, torch.Tensor) else torch.as_tensor(np.asarray(value, dtype=np.float64))
        )
    except (TypeError, ValueError) as error:
        raise OptionError(f"{name} are not an array of numbers: {error}") from error
    tensor = tensor.to(dtype)
    if not bool(torch.isfinite(tensor.detach()).all()):
        raise OptionError(f"{name}: every number must be finite, found nan or infinity")
    return tensor
