"""The GPU path: numba-cuda kernels behind a `torch.autograd.Function`.

States lie in the shared memory of a block where they fit, else in the GPU's memory, which its cache serves.
"""

from __future__ import annotations

import importlib
import math
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numba import cuda as _cuda
from torch import Tensor

from qrlsuite.circuit import Circuit
from qrlsuite.plugins.circuits.native.gpu_kernels import MOST_THREADS, TOGETHER, WARP, kernels
from qrlsuite.plugins.circuits.native.program import PERMUTE, Program, compile_circuit

if TYPE_CHECKING:
    from numpy.typing import NDArray

cuda: Any = _cuda  # its attributes are made at run time

MOST_QUBITS = 14
"""Gates may connect so many qubits; larger circuits are left to plain torch operations."""

BLOCKS = 1056
"""Blocks that share the GPU's memory where states do not fit into shared memory; each takes lane after lane."""

ALWAYS_SHARED = 48 << 10
"""Bytes of shared memory that every GPU grants a block without being asked."""

_ALLOWED: dict[tuple[Any, int], int] = {}
"""Bytes that a kernel may have in shared memory of a GPU, where it was allowed more than these."""

KINDS = {torch.float32: np.float32, torch.float64: np.float64}


def _threads(qubits: int) -> int:
    """Return how many threads share a state: the fastest number tried on an H100 at 6, 10, 12 and 14 qubits."""
    return MOST_THREADS if qubits > 12 else max(WARP, 1 << max(qubits - 4, 0))


class GPUSimulator:
    """Runs one circuit's program on a GPU; not to be shared between threads.

    Parameters
    ----------
    program:
        The program to run.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        self.largest = int(program.components[:, 0].max())
        self.threads = _threads(self.largest)
        self.size = 2 * program.amplitudes
        self.blocks = len(program.blocks) - 1
        self._tables: dict[Any, tuple[list[Any], list[Any]]] = {}

    def __call__(self, inputs: Tensor, flat: Tensor) -> Tensor:
        """Return expectation values (S, B, O) of inputs (S, B, I) and flat parameters (S, P), differentiably."""
        result: Tensor = _GPUExpectations.apply(inputs, flat, self)  # type: ignore[no-untyped-call]
        return result

    def takes(self, like: Tensor) -> bool:
        """Return whether the circuit is not too large for a GPU's blocks at a tensor's precision."""
        needed = self.bytes_of(like, 0, backward=True)
        return self.largest <= MOST_QUBITS and needed <= shared_limit(like.device.index or 0)

    def tables(self, like: Tensor) -> tuple[list[Any], list[Any]]:
        """Return the program's arrays on a tensor's device: for both passes, and for `collect`."""
        key = (like.device, like.dtype)
        if key not in self._tables:
            run, gather = _run_tables(self.program), _collect_tables(self.program)
            self._tables[key] = tuple(  # type: ignore[assignment]
                [_view(tensor(array, like)) for array in arrays] for arrays in (run, gather)
            )
        return self._tables[key]

    def bytes_of(self, like: Tensor, states: int, backward: bool) -> int:
        """Return the shared memory of a block with that many states in it."""
        numbers = 6 * self.blocks + TOGETHER * (self.threads + WARP) + states * self.size
        return (numbers + TOGETHER * self.blocks * backward) * like.element_size()

    def forward(self, x: Tensor, p: Tensor, keep: bool) -> tuple[Tensor, Tensor]:
        """Return expectation values, and the final state of every lane; of one lane alone without `keep`."""
        lanes = x.shape[0] * x.shape[1]
        tables, _ = self.tables(x)
        finals = x.new_empty((lanes if keep else 1, self.size))
        shared = self.bytes_of(x, 1, backward=False)
        fits = shared <= shared_limit(x.device.index or 0)
        blocks = lanes if fits else min(lanes, BLOCKS)
        work = x.new_empty((1, 1) if fits else (blocks, self.size))
        out = x.new_empty((*x.shape[:2], len(self.program.observables)))
        _launch(
            "forward shared" if fits else "forward",
            x,
            blocks,
            self.threads,
            shared if fits else self.bytes_of(x, 0, backward=False),
            *tables,
            self.size,
            _view(x),
            _view(p),
            _view(work),
            _view(finals),
            int(keep),
            _view(out),
        )
        return out, finals

    def backward(self, x: Tensor, p: Tensor, finals: Tensor, cotangent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of inputs and parameters."""
        lanes = x.shape[0] * x.shape[1]
        tables, gather = self.tables(x)
        limit = shared_limit(x.device.index or 0)
        states = max((s for s in (1, 2) if self.bytes_of(x, s, backward=True) <= limit), default=0)
        blocks = lanes if states == 2 else min(lanes, BLOCKS)
        work = x.new_empty((1, 1) if states == 2 else (2 * blocks, self.size))
        slopes = x.new_empty((lanes, max(len(self.program.angles), 1)))
        _launch(
            ("backward", "backward half", "backward shared")[states],
            x,
            blocks,
            self.threads,
            self.bytes_of(x, states, backward=True),
            *tables,
            self.size,
            _view(x),
            _view(p),
            _view(work),
            _view(finals),
            _view(cotangent),
            _view(slopes),
        )
        grad_x, grad_p = torch.zeros_like(x), torch.zeros_like(p)
        count = x.numel() + p.numel()
        if count:
            _launch(
                "collect",
                x,
                -(-count // 128),
                128,
                0,
                *gather,
                _view(x),
                _view(p),
                _view(slopes),
                _view(grad_x),
                _view(grad_p),
            )
        return grad_x, grad_p


def tensor(array: NDArray[Any], like: Tensor) -> Tensor:
    """Return an array on a tensor's device: indices in 32 bits, numbers in its precision. None is empty."""
    if array.size == 0:
        array = np.zeros((1, *array.shape[1:]), array.dtype)
    kind = torch.int32 if array.dtype.kind == "i" else like.dtype
    return torch.from_numpy(array).to(like.device, kind).contiguous()


def observables(program: Program) -> list[tuple[int, int]]:
    """Return the component of every observable, and its bits there as a mask."""
    found: list[tuple[int, int]] = []
    for index in program.observables.tolist():
        if index < program.qubits:
            owner = max(row for row in range(len(program.components)) if program.components[row, 2] <= index)
            found.append((owner, 1 << (index - int(program.components[owner, 2]))))
        else:
            found.append(tuple(program.products[index - program.qubits].tolist()))
    return found


def _run_tables(program: Program) -> list[NDArray[Any]]:
    """Return the arrays that both passes read; steps that permute point into `sources`."""
    steps = program.steps.copy()
    sources: list[NDArray[Any]] = []
    for component in program.components.tolist():
        for m in range(component[3], component[4]):
            if steps[m, 0] == PERMUTE:
                source = program.source(int(steps[m, 1]), int(steps[m, 2]), component[0])
                steps[m, 1] = sum(len(source) for source in sources)
                sources.append(source)
    measured = [
        (program.components[c, 1], program.components[c, 0], mask) for c, mask in observables(program)
    ]
    return [
        program.components,
        steps,
        program.angles,
        program.constants,
        program.rotations,
        program.factors,
        program.blocks,
        np.concatenate([*sources, np.zeros(0, np.int64)]),
        program.negative,
        np.array(measured, np.int64).reshape(-1, 3),
    ]


def _collect_tables(program: Program) -> list[NDArray[Any]]:
    """Return the angles, and lists of angles by parameter and by input, with the begin of each list."""
    by_parameter: list[list[tuple[int, int]]] = [[] for _ in range(program.parameters)]
    by_input: list[list[int]] = [[] for _ in range(program.inputs)]
    for index, (which, scale, weight) in enumerate(program.angles.tolist()):
        if which >= 0:
            by_input[which].append(index)
            if scale >= 0:
                by_parameter[scale].append((index, 1))
        if weight >= 0:
            by_parameter[weight].append((index, 0))
    starts = [np.cumsum([0, *map(len, lists)], dtype=np.int64) for lists in (by_parameter, by_input)]
    return [
        program.angles,
        np.array([entry for entries in by_parameter for entry in entries], np.int64).reshape(-1, 2),
        starts[0],
        np.array([entry for entries in by_input for entry in entries], np.int64),
        starts[1],
    ]


def _view(tensor: Tensor) -> Any:
    """Return a tensor's memory for a kernel; the CPU's memory if numba simulates a GPU."""
    return cuda.as_cuda_array(tensor, sync=False) if tensor.is_cuda else tensor.numpy()


@torch.enable_grad()  # the first circuit may be one of an agent that only acts
def computes_right(device: str = "cuda", make: type[GPUSimulator] = GPUSimulator) -> bool:
    """Compute <Z> = cos(x + w) and its slopes on torch's current GPU; return whether they are right."""
    circuit = Circuit(1)
    circuit.append("RX", 0, circuit.input(0) + circuit.parameter("w", (1,))[0])
    x, w = (torch.full(shape, 0.25, device=device, requires_grad=True) for shape in ((1, 1, 1), (1, 1)))
    value = make(compile_circuit(circuit))(x, w)
    slopes = torch.autograd.grad(value.sum(), [x, w])
    found = [float(number) for number in (value, *slopes)]
    return np.allclose(found, [math.cos(0.5), -math.sin(0.5), -math.sin(0.5)], atol=1e-6)


@cache
def shared_limit(device: int) -> int:
    """Return how many bytes of shared memory a block of this GPU may have."""
    if not torch.cuda.is_available():
        return ALWAYS_SHARED
    properties = torch.cuda.get_device_properties(device)
    return int(getattr(properties, "shared_memory_per_block_optin", ALWAYS_SHARED))


def _launch(name: str, like: Tensor, blocks: int, threads: int, shared: int, *arguments: Any) -> None:
    """Launch a kernel in torch's own order of work."""
    kernel = kernels(KINDS[like.dtype])[name]
    if not like.is_cuda:
        kernel[blocks, threads, 0, shared](*arguments)
        return
    with torch.cuda.device(like.device), cuda.gpus[like.device.index or 0]:
        if shared > ALWAYS_SHARED:
            _allow(kernel, shared, like, arguments)
        handle = torch.cuda.current_stream().cuda_stream
        stream = cuda.external_stream(handle) if handle else 0
        kernel[blocks, threads, stream, shared](*arguments)


def _allow(kernel: Any, shared: int, like: Tensor, arguments: Any) -> None:
    """Allow a kernel more shared memory than every GPU grants."""
    device = like.device.index or 0
    if _ALLOWED.get((kernel, device), 0) >= shared:
        return
    compiled = kernel.compile(tuple(kernel.typeof_pyval(argument) for argument in arguments))
    allow(compiled._codelibrary.get_cufunc().handle, shared, device)
    _ALLOWED[kernel, device] = shared


def allow(handle: Any, shared: int, device: int) -> None:
    """Let the driver give a kernel's blocks so many bytes of shared memory."""
    driver: Any = importlib.import_module("cuda.bindings.driver")
    (status,) = driver.cuKernelSetAttribute(
        driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES,
        shared,
        handle,
        driver.CUdevice(device),
    )
    if status != driver.CUresult.CUDA_SUCCESS:
        raise RuntimeError(f"the GPU refuses a block {shared} bytes of shared memory: {status}")


class _GPUExpectations(torch.autograd.Function):
    """Expectation values with adjoint gradients."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, flat: Tensor, simulator: GPUSimulator) -> Tensor:
        x, p = inputs.detach().contiguous(), flat.detach().contiguous()
        keep = any(ctx.needs_input_grad[:2])
        out, finals = simulator.forward(x, p, keep)
        ctx.simulator = simulator
        ctx.save_for_backward(x, p, *([finals] if keep else []))
        return out

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, Tensor, None]:
        x, p, finals = ctx.saved_tensors
        return (*ctx.simulator.backward(x, p, finals, cotangents[0].to(x.dtype).contiguous()), None)
