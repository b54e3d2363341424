"""The CPU path: numba kernels behind a `torch.autograd.Function`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qrlsuite.circuit import Circuit
from qrlsuite.compiled.cache import announce
from qrlsuite.plugins.circuits.native.program import compile_circuit

KEEP_BYTES = 256 << 20
"""Final states and gates up to this size stay for the backward pass; larger ones are computed again."""

APART = 17
"""Rows between the two states of a backward pass. Without them equal rows lie a power of two apart, where a processor
takes a load from one for dependent on a store to the other, and both for the same place in its first-level cache."""

SPARE_BYTES = 64 << 20
"""Memory up to this size stays from one pass to the next, one array per circuit and precision."""

NUMPY = {torch.float32: np.float32, torch.float64: np.float64}


@dataclass
class _Workspace:
    """Buffers of one precision, reused from call to call."""

    scratch: Any
    record: np.ndarray[Any, Any]
    pair: np.ndarray[Any, Any]
    overlap: np.ndarray[Any, Any]
    sums: np.ndarray[Any, Any]
    slopes: np.ndarray[Any, Any]


class _Records:
    """Final states and gates of one forward pass, (chunks, rows, V), until its backward pass is over.

    The memory then serves the next pass, where it is not large: fresh pages cost more time than a small circuit.
    """

    def __init__(self, simulator: Simulator, dtype: torch.dtype, chunks: int) -> None:
        rows = simulator.workspace(dtype).record.shape[1:]
        self.spare = simulator.spare
        self.dtype = dtype
        room = self.spare.pop(dtype, None)
        if room is None or len(room) < chunks:
            room = simulator.vectors.aligned((chunks, *rows), NUMPY[dtype])
        self.array = room

    def __del__(self) -> None:
        if self.array.nbytes <= SPARE_BYTES:
            self.spare[self.dtype] = self.array


class Simulator:
    """Runs one circuit on the CPU; not to be shared between threads."""

    def __init__(self, circuit: Circuit) -> None:
        announce(Path(__file__).parent, "the circuit simulator")
        from qrlsuite.compiled import vectors
        from qrlsuite.plugins.circuits.native import kernels, mean_field

        self.vectors = vectors
        self.kernels: Any = mean_field if circuit.mean_field else kernels
        self.program = (mean_field.compile_circuit if circuit.mean_field else compile_circuit)(circuit)
        self.tables = self.kernels.tables(self.program)
        self.lanes = {dtype: vectors.lanes(kind) for dtype, kind in NUMPY.items()}
        self.spare: dict[torch.dtype, np.ndarray[Any, Any]] = {}
        self._workspaces: dict[torch.dtype, _Workspace] = {}

    def __call__(self, inputs: Tensor, flat: Tensor) -> Tensor:
        """Return expectation values (S, B, O) of inputs (S, B, I) and flat parameters (S, P)."""
        result: Tensor = _Expectations.apply(inputs, flat, self)  # type: ignore[no-untyped-call]
        return result

    def workspace(self, dtype: torch.dtype) -> _Workspace:
        """Return the buffers of a precision."""
        if dtype not in self._workspaces:
            lanes, kind, program = self.lanes[dtype], NUMPY[dtype], self.program
            rows = self.kernels.record_rows(program)
            self._workspaces[dtype] = _Workspace(
                scratch=self.kernels.scratch(program, lanes, kind),
                record=self.vectors.aligned((1, sum(rows), lanes), kind),
                pair=self.vectors.aligned((2, rows[0] + APART, lanes), kind),
                overlap=self.vectors.aligned((4, lanes), kind),
                sums=self.vectors.aligned((program.parameters, lanes), kind),
                slopes=self.vectors.aligned((program.inputs, lanes), kind),
            )
        return self._workspaces[dtype]

    def __deepcopy__(self, memo: dict[int, Any]) -> Simulator:
        return self


class _Expectations(torch.autograd.Function):
    """Expectation values with adjoint gradients."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, flat: Tensor, simulator: Simulator) -> Tensor:
        x, p = inputs.detach().contiguous(), flat.detach().contiguous()
        lanes, kind = simulator.lanes[x.dtype], NUMPY[x.dtype]
        work = simulator.workspace(x.dtype)
        chunks = x.shape[0] * -(-x.shape[1] // lanes)
        needed = any(ctx.needs_input_grad[:2])
        keep = needed and chunks * work.record.nbytes <= KEEP_BYTES
        kept = _Records(simulator, x.dtype, chunks) if keep else None
        records = work.record if kept is None else kept.array
        out = np.empty((*x.shape[:2], len(simulator.program.observables)), kind)
        simulator.kernels.forward(
            simulator.tables, x.numpy(), p.numpy(), records, int(keep), work.scratch, out
        )
        ctx.simulator, ctx.kept = simulator, kept
        ctx.save_for_backward(x, p)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, Tensor, None]:
        x, p = ctx.saved_tensors
        simulator: Simulator = ctx.simulator
        work = simulator.workspace(x.dtype)
        kept: _Records | None = ctx.kept
        grad_x, grad_p = np.empty(tuple(x.shape), NUMPY[x.dtype]), np.empty(tuple(p.shape), NUMPY[x.dtype])
        simulator.kernels.backward(
            simulator.tables,
            x.numpy(),
            p.numpy(),
            cotangents[0].to(x.dtype).contiguous().numpy(),
            work.record if kept is None else kept.array,
            int(kept is not None),
            work.pair,
            work.scratch,
            work.overlap,
            work.sums,
            work.slopes,
            grad_x,
            grad_p,
        )
        return torch.from_numpy(grad_x), torch.from_numpy(grad_p), None
