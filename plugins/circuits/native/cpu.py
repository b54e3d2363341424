"""The CPU path: numba kernels behind a `torch.autograd.Function`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qrlsuite.plugins.circuits.native.cache import announce
from qrlsuite.plugins.circuits.native.program import Program

KEEP_BYTES = 256 << 20
"""Final states up to this size are kept for the backward pass; larger ones are computed again."""

LANES = {torch.float32: 16, torch.float64: 8}
NUMPY = {torch.float32: np.float32, torch.float64: np.float64}


@dataclass
class _Workspace:
    """Buffers of one precision, reused from call to call."""

    scratch: Any
    pair: np.ndarray[Any, Any]
    overlap: np.ndarray[Any, Any]
    sums: np.ndarray[Any, Any]
    slopes: np.ndarray[Any, Any]
    state: np.ndarray[Any, Any]


class Simulator:
    """Runs one program on the CPU; not to be shared between threads."""

    def __init__(self, program: Program) -> None:
        announce()
        from qrlsuite.plugins.circuits.native import kernels

        self.program = program
        self.kernels = kernels
        self.tables = kernels.tables(program)
        self._workspaces: dict[torch.dtype, _Workspace] = {}

    def __call__(self, inputs: Tensor, flat: Tensor) -> Tensor:
        """Return expectation values (S, B, O) of inputs (S, B, I) and flat parameters (S, P)."""
        result: Tensor = _Expectations.apply(inputs, flat, self)  # type: ignore[no-untyped-call]
        return result

    def workspace(self, dtype: torch.dtype) -> _Workspace:
        """Return the buffers of a precision."""
        if dtype not in self._workspaces:
            lanes, kind = LANES[dtype], NUMPY[dtype]
            size = (1 << self.program.qubits, 2, lanes)
            self._workspaces[dtype] = _Workspace(
                scratch=self.kernels.scratch(self.program, lanes, kind),
                pair=np.empty((2, *size), kind),
                overlap=np.empty((4, lanes), kind),
                sums=np.empty((max(1, self.program.parameter_count), lanes), kind),
                slopes=np.empty((self.program.inputs, lanes), kind),
                state=np.empty((1, *size), kind),
            )
        return self._workspaces[dtype]

    def __deepcopy__(self, memo: dict[int, Any]) -> Simulator:
        return self


class _Expectations(torch.autograd.Function):
    """Expectation values with adjoint gradients."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, flat: Tensor, simulator: Simulator) -> Tensor:
        x, p = inputs.detach().contiguous(), flat.detach().contiguous()
        lanes, kind = LANES[x.dtype], NUMPY[x.dtype]
        work = simulator.workspace(x.dtype)
        chunks = x.shape[0] * -(-x.shape[1] // lanes)
        needed = any(ctx.needs_input_grad[:2])
        keep = needed and chunks * work.state.nbytes <= KEEP_BYTES
        states = np.empty((chunks, *work.state.shape[1:]), kind) if keep else work.state
        out = np.empty((*x.shape[:2], len(simulator.program.observables)), kind)
        simulator.kernels.forward(
            simulator.tables, x.numpy(), p.numpy(), states, int(keep), work.scratch, out
        )
        ctx.simulator, ctx.states = simulator, states if keep else None
        ctx.save_for_backward(x, p)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, Tensor, None]:
        x, p = ctx.saved_tensors
        simulator: Simulator = ctx.simulator
        work = simulator.workspace(x.dtype)
        kept = ctx.states is not None
        grad_x, grad_p = np.empty(tuple(x.shape), NUMPY[x.dtype]), np.empty(tuple(p.shape), NUMPY[x.dtype])
        simulator.kernels.backward(
            simulator.tables,
            x.numpy(),
            p.numpy(),
            cotangents[0].to(x.dtype).contiguous().numpy(),
            ctx.states if kept else work.state,
            int(kept),
            work.pair,
            work.scratch,
            work.overlap,
            work.sums,
            work.slopes,
            grad_x,
            grad_p,
        )
        return torch.from_numpy(grad_x), torch.from_numpy(grad_p), None
