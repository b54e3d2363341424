"""A circuit as an ordinary PyTorch layer, for training loops that are not the suite's.

>>> import torch
>>> from qrlsuite import layer
>>> model = torch.nn.Sequential(torch.nn.Linear(4, 6), layer("cz", qubits=6, layers=2), torch.nn.Linear(6, 2))
>>> model(torch.zeros(32, 4)).shape
torch.Size([32, 2])
"""

from __future__ import annotations

import copy
import functools
import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from qrlsuite import shortforms
from qrlsuite.circuit import tracing
from qrlsuite.circuit.api import CircuitBackend, ansatz, create_backend
from qrlsuite.circuit.description import Circuit
from qrlsuite.errors import OptionError

DTYPES = (torch.float32, torch.float64)


def layer(
    circuit: str | Circuit | Callable[..., Any],
    qubits: int | None = None,
    layers: int = 1,
    *,
    backend: str = "native",
    backend_options: Mapping[str, Any] | None = None,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    **options: Any,
) -> CircuitLayer:
    """Return a circuit as a PyTorch layer: (..., inputs) to (..., expectation values).

    Parameters
    ----------
    circuit:
        Name of an ansatz (`qrlsuite list ansatzes`), a circuit of your own, or a QNode of PennyLane or its function
        `(inputs, weights...)`, see `qrlsuite.circuit.tracing`.
    qubits, layers:
        Size of the circuit, if a name is given; of a QNode's, if its shapes depend on them.
    backend:
        Backend that computes it (`qrlsuite list circuit_backends`); `native` is the fast simulator.
    backend_options:
        Options of the backend, such as `{"shots": 1000}`.
    generator:
        Source of the initial parameters; by default PyTorch's, as for any layer. Shots always draw from PyTorch's.
    dtype:
        float32 or float64; by default PyTorch's default type.
    options:
        Options of the ansatz, such as `gate="xyz"`.

    Raises
    ------
    UnknownNameError
        If no ansatz or backend has that name.
    OptionError
        For a size or an option that circuit or backend cannot have.
    """
    if isinstance(circuit, str):
        if qubits is None:
            raise OptionError(f"say how many qubits: layer('{circuit}', qubits=6)")
        circuit = ansatz(circuit, qubits, layers, **options)
    elif not isinstance(circuit, Circuit):
        source = shortforms.source_of(circuit)
        if not inspect.isfunction(source):
            raise OptionError(
                f"layer({circuit!r}): give the name of an ansatz, a Circuit, or a QNode or its function"
            )
        circuit = tracing.trace(circuit, qubits, layers, functools.partial(source, **options))
    elif qubits is not None or layers != 1 or options:
        raise OptionError(
            "a circuit of your own has its size and options already: leave out qubits, layers and others"
        )
    return CircuitLayer(
        circuit, backend, backend_options or {}, generator, dtype or torch.get_default_dtype()
    )


class _OfAgents(torch.autograd.Function):
    """A layer within `torch.vmap`: the backend computes all agents in one pass, each as if it were alone."""

    @staticmethod
    def forward(layer: CircuitLayer, inputs: Tensor, *parameters: Tensor) -> Tensor:
        raise RuntimeError("of the transforms of torch.func, the layer has only vmap, over agents")

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Keep nothing: `vmap` is differentiated by the backend's own function."""

    @staticmethod
    def vmap(
        info: Any, axes: tuple[int | None, ...], layer: CircuitLayer, *tensors: Tensor
    ) -> tuple[Tensor, int]:
        if layer.draws:
            raise RuntimeError("vmap: samples are drawn for each agent in its turn")
        inputs, *parameters = (
            each.expand(info.batch_size, *each.shape) if axis is None else each.movedim(axis, 0)
            for axis, each in zip(axes[1:], tensors)
        )
        return layer._prepared()(inputs, dict(zip(layer.circuit, parameters)), None), 0


class CircuitLayer(nn.Module):
    """A circuit's expectation values as a layer, made by `layer`.

    It can be copied, saved, moved and trained as any other layer. Inputs are angles in radians, before the scaling that
    the circuit has. Every parameter of the circuit is a parameter of the layer, under its own name in `circuit`.

    Attributes
    ----------
    in_features, out_features:
        Numbers of inputs and of expectation values.
    """

    def __init__(
        self,
        circuit: Circuit,
        backend: str,
        backend_options: Mapping[str, Any],
        generator: torch.Generator | None,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        if dtype not in DTYPES:
            raise OptionError(f"dtype = {dtype}: circuits are computed in float32 or float64")
        self.description = copy.deepcopy(circuit)
        self.backend_name = backend
        self.backend_options = dict(backend_options)
        self._backend: CircuitBackend | None = create_backend(
            backend, self.description, **self.backend_options
        )
        self.in_features, self.out_features = circuit.inputs, len(circuit.observables)
        self.circuit = nn.ParameterDict(
            {
                name: nn.Parameter(
                    parameter.low
                    + (parameter.high - parameter.low)
                    * torch.rand(parameter.shape, generator=generator, dtype=dtype)
                )
                for name, parameter in circuit.parameters.items()
            }
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """Map (..., in_features) to (..., out_features), each in [-1, 1], in the type of the inputs.

        Raises
        ------
        OptionError
            If the last axis is not `in_features`, or a number is not finite.
        """
        if inputs.dim() < 1 or inputs.shape[-1] != self.in_features:
            raise OptionError(
                f"inputs have shape {tuple(inputs.shape)}: the last axis must be {self.in_features}, "
                "the circuit's number of inputs"
            )
        shape = (*inputs.shape[:-1], self.out_features)
        if math.prod(shape) == 0:
            return inputs.new_zeros(shape)
        first = next(iter(self.circuit.values()), None)
        dtype = first.dtype if first is not None else inputs.dtype
        flat = inputs.reshape(1, -1, self.in_features).to(dtype)
        if torch._C._are_functorch_transforms_active():
            values: Tensor = _OfAgents.apply(self, flat[0], *self.circuit.values())  # type: ignore[no-untyped-call]
        else:
            parameters = {name: value[None] for name, value in self.circuit.items()}
            values = self._prepared()(flat, parameters, self._sampling_seed())[0]
        return values.reshape(shape).to(inputs.dtype)

    def extra_repr(self) -> str:
        """Describe the circuit in the layer's printed form."""
        return (
            f"qubits={self.description.qubits}, in_features={self.in_features}, out_features={self.out_features}, "
            f"backend='{self.backend_name}'"
        )

    def _prepared(self) -> CircuitBackend:
        if self._backend is None:  # in a copy
            self._backend = create_backend(self.backend_name, self.description, **self.backend_options)
        return self._backend

    @property
    def draws(self) -> bool:
        """Whether values or gradients are random: of shots, of noise, or guessed."""
        backend = self._prepared()
        return bool(getattr(backend, "draws", backend.shots is not None))

    def _sampling_seed(self) -> list[int] | None:
        """Return the seed of this pass's samples, None where values are exact."""
        return [int(torch.randint(2**63 - 1, ()))] if self.draws else None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy, which prepares its own backend at its first call."""
        return {**self.__dict__, "_backend": None}
