"""Circuits in the registers of an NVIDIA GPU: tables and launches of the kernels in `registers.cu`.

NVRTC compiles them, once for each number of qubits and kind of GPU; the machine code is kept beside numba's. No GPU has
run them yet, so they compute only with `QRLSUITE_CAPTURE=1`, and what `RegisterSimulator.takes`.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qrlsuite.compiled.cache import folder
from qrlsuite.device import NUMERICS
from qrlsuite.plugins.circuits.native import gpu, program
from qrlsuite.plugins.circuits.native.program import NONE, Component, Program

SOURCE = Path(__file__).with_name("registers.cu")
GATE, SWAP, FIXED = 0, 1, 2
"""Kinds of steps, as in `registers.cu`; so are the next three numbers."""
BEFORE, AFTER = 1, 2
NEGATIVE = 1 << 16
THREADS = 128
"""Threads of a block where a state takes a warp or less, and of `collect`."""


class Bits(NamedTuple):
    """How many bits of an amplitude's index are of which kind, see `registers.cu`."""

    register: int
    lane: int
    warp: int
    cluster: int


def bits_of(qubits: int) -> Bits:
    """Return the bits for states of up to so many qubits; states of fewer than 6 leave some at 0."""
    qubits = min(max(qubits, 6), gpu.MOST_QUBITS)
    register, cluster = 3 if qubits < 8 else 4, int(qubits == gpu.MOST_QUBITS)
    lane = min(qubits - register, 5)
    return Bits(register, lane, qubits - register - lane - cluster, cluster)


Gate = tuple[int, int, int, int, int]
"""GATE, target, control, block, and the Hadamards around it; or another step of a program and where its states are."""


def _gates(compiled: Program, component: Component) -> list[Gate]:
    """Return the steps of a component. Its Hadamards wait for the next gate on their bit, to join the gate's matrix."""
    alone = len(compiled.blocks) - 1
    gates: list[Gate] = []
    waiting: set[int] = set()

    def settle(bits: set[int]) -> None:
        gates.extend((GATE, bit, NONE, alone, BEFORE) for bit in sorted(waiting & bits))
        waiting.difference_update(bits)

    for kind, a, b, c, _, behind in compiled.steps[component.first : component.last].tolist():
        if kind == program.ROTATE:
            settle({a})
            around = BEFORE * (b in waiting) + AFTER * bool(behind & program.ON_TARGET)
            gates.append((GATE, b, a, c, around))
            waiting.discard(b)
            waiting.update({a} if behind & program.ON_CONTROL else ())
        elif kind == program.HADAMARD:
            waiting ^= {a, b, c} - {NONE}
        else:
            settle(waiting.copy())
            gates.append((kind, a, b, NONE, NONE))
    settle(waiting.copy())
    return gates


def _placed(mask: int, place: dict[int, int]) -> int:
    """Return a mask of bits of a program as one of the bits where they are."""
    return sum(1 << to for bit, to in place.items() if mask >> bit & 1)


def _moves(compiled: Program, qubits: int, gate: Gate, place: dict[int, int]) -> list[NDArray[np.int64]]:
    """Return whence a permutation or signs move every amplitude, and back, where the bits are at these places."""
    states, (kind, first, last, *_) = np.arange(1 << len(place)), gate
    position = np.bitwise_or.reduce([(states >> bit & 1) << to for bit, to in place.items()])
    source, sign = states.copy(), np.zeros_like(states)
    if kind == program.PERMUTE:
        source[: 1 << qubits] = compiled.source(first, last, qubits)
    else:
        sign[compiled.negative[first:last]] = NEGATIVE
    there, back = np.empty_like(states), np.empty_like(states)
    there[position] = position[source] + sign
    back[position[source]] = position + sign
    return [there, back]


def tables(compiled: Program, bits: Bits) -> list[NDArray[Any]]:
    """Return the arrays of a program in the order of `Program` in `registers.cu`.

    Where a gate's target is swapped into the registers, the bit goes out whose next turn as a target is the latest.
    """
    steps: list[tuple[int, ...]] = []
    components, moves, places = [], [np.zeros(0, np.int64)], []
    blocks = np.column_stack([compiled.blocks[:-1], compiled.blocks[1:], 0 * compiled.blocks[1:]])
    for row in compiled.components.tolist():
        component, begin = Component(*row), len(steps)
        gates = _gates(compiled, component)
        targets = [bit if kind == GATE else NONE for kind, bit, *_ in gates]
        order = dict.fromkeys(bit for bit in [*targets, *range(sum(bits))] if bit != NONE)
        place = {bit: at for at, bit in enumerate(order)}
        opening = _placed(component.opening, place)
        for at, gate in enumerate(gates):
            kind, target, control, block, around = gate
            if kind != GATE:
                steps.append((FIXED, NONE, sum(map(len, moves)), NONE, NONE))
                moves += _moves(compiled, component.qubits, gate, place)
                continue
            if place[target] >= bits.register:
                after = targets[at:]
                inside = [bit for bit in place if place[bit] < bits.register]
                out = max(inside, key=lambda bit: after.index(bit) if bit in after else len(after))
                steps.append((SWAP, place[out], place[target] - bits.register, NONE, NONE))
                place[target], place[out] = place[out], place[target]
            steps.append((GATE, place[target], place.get(control, NONE), block, around in (BEFORE, AFTER)))
            blocks[block : block + 1, 2] = around  # of none, if it is a Hadamard alone
        components.append((begin, len(steps), opening))
        places.append(place)
    measured = [(c, _placed(mask, places[c])) for c, mask in gpu.observables(compiled)]
    uses: list[list[tuple[int, int]]] = [[] for _ in range(compiled.parameters + compiled.inputs)]
    for index, (which, scale, weight) in enumerate(compiled.angles.tolist()):
        users = (weight, scale, NONE if which < 0 else compiled.parameters + which)
        for user, scales in zip(users, (0, 1, 0)):
            if user >= 0:
                uses[user].append((index, scales))
    sizes = [len(each) for each in (components, blocks, compiled.angles, measured)]
    return [
        np.array([*sizes, compiled.inputs, compiled.parameters]),
        np.array(components),
        np.array(steps, np.int64),
        blocks,
        compiled.rotations,
        compiled.factors,
        compiled.angles,
        compiled.constants,
        np.array(measured),
        np.concatenate(moves),
        np.array([use for own in uses for use in own], np.int64),
        np.cumsum([0, *map(len, uses)]),
    ]


class RegisterSimulator(gpu.GPUSimulator):
    """Runs one circuit's program on a GPU with its states in registers; not to be shared between threads."""

    def __init__(self, compiled: Program) -> None:
        super().__init__(compiled)
        self.bits = bits_of(self.largest)
        self.threads = 32 << self.bits.warp if self.bits.warp else THREADS
        self.states = self.threads >> (self.bits.lane + self.bits.warp)  # of a block
        self.moves = bool((compiled.steps[:, 0] >= program.PERMUTE).any())

    def takes(self, like: Tensor) -> bool:
        """Return whether a tensor is in single precision, and its GPU has the memory, and clusters where needed."""
        if like.dtype != torch.float32 or self.largest > gpu.MOST_QUBITS:
            return False
        if self.bits.cluster and torch.cuda.get_device_capability(like.device) < (9, 0):
            return False
        return self._room(backward=True)[1] <= gpu.shared_limit(like.device.index or 0)

    def tables(self, like: Tensor) -> tuple[list[Any], list[Any]]:
        """Return the places of the program's arrays on a tensor's device, and these."""
        key = (like.device, like.dtype)
        if key not in self._tables:
            kept = [gpu.tensor(array, like) for array in tables(self.program, self.bits)]
            self._tables[key] = [torch.tensor([each.data_ptr() for each in kept], device=like.device)], kept
        return self._tables[key]

    def forward(self, x: Tensor, p: Tensor, keep: bool) -> tuple[Tensor, Tensor]:
        """Return expectation values, and the final states of every lane if kept."""
        NUMERICS["circuit kernels"] = 2  # numba-cuda's are 1
        lanes, components = x.shape[0] * x.shape[1] * keep, len(self.program.components)
        finals = x.new_empty((lanes, components, 2 << sum(self.bits)))
        out = x.new_empty((*x.shape[:2], len(self.program.observables)))
        self._launch("forward", x, p, finals, out)
        return out, finals

    def backward(self, x: Tensor, p: Tensor, finals: Tensor, cotangent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of inputs and parameters."""
        slopes = x.new_empty((x.shape[0] * x.shape[1], len(self.program.angles)))
        grad_x, grad_p = torch.empty_like(x), torch.empty_like(p)
        self._launch("backward", x, p, finals, cotangent, slopes)
        self._launch("collect", x, p, slopes, grad_x, grad_p)
        return grad_x, grad_p

    def _room(self, backward: bool) -> tuple[int, int]:
        """Return how much shared memory a state takes (units of 16 bytes) and a block takes (bytes)."""
        sums = (4 * self.blocks if backward else len(self.program.observables)) << self.bits.warp
        own = 2 * (self.blocks + 1) + -(-sums // 4)
        moved = 1 << self.bits.register  # amplitudes of a thread: all, or halves of one state or two
        if not self.moves:
            moved = (moved if backward else moved // 2) if self.bits.warp else 0
        return own, 16 * own * self.states + 8 * moved * self.threads

    def _launch(self, name: str, x: Tensor, p: Tensor, *tensors: Tensor) -> None:
        (places,), _ = self.tables(x)
        lanes = x.shape[0] * x.shape[1]
        arguments = [*(each.data_ptr() for each in (places, x, p)), x.shape[1], lanes]
        if name == "collect":
            shape = (-(-(x.numel() + p.numel()) // THREADS), 1, THREADS, 0)
        else:
            own, shared = self._room(name == "backward")
            shape = (-(-lanes // self.states), 1 << self.bits.cluster, self.threads, shared)
            arguments.append(own)
        if shape[0]:
            launch(self.bits, name, x.device, shape, *arguments, *(each.data_ptr() for each in tensors))


def launch(
    bits: Bits, name: str, device: torch.device, shape: tuple[int, int, int, int], *arguments: int
) -> None:
    """Launch clusters of blocks of threads with bytes of shared memory (`shape`), in torch's own order of work."""
    from cuda.core import LaunchConfig, Stream
    from cuda.core import launch as launch_kernel

    clusters, blocks, threads, shared = shape
    with torch.cuda.device(device):
        kernel = _kernel(bits, name, device, shared)
        cluster = blocks if blocks > 1 else None
        config = LaunchConfig(grid=clusters, cluster=cluster, block=threads, shmem_size=shared)
        stream = Stream.from_handle(torch.cuda.current_stream().cuda_stream)
        launch_kernel(stream, config, kernel, *arguments)


@cache
def _kernel(bits: Bits, name: str, device: torch.device, shared: int) -> Any:
    """Return a kernel whose blocks may have so much shared memory."""
    kernel = compiled_for(bits, "sm_{}{}".format(*torch.cuda.get_device_capability(device))).get_kernel(name)
    if shared > gpu.ALWAYS_SHARED:
        gpu.allow(kernel.handle, gpu.shared_limit(device.index or 0), device.index or 0)
    return kernel


def definitions(bits: Bits) -> list[str]:
    """Return what `registers.cu` is compiled with."""
    return [f"{kind.upper()}_BITS={count}" for kind, count in bits._asdict().items()]


@cache
def compiled_for(bits: Bits, architecture: str) -> Any:
    """Return the kernels as machine code (cubin) of an architecture such as `sm_90`; no GPU is needed.

    The cache's keys are hashes of the source, the options and the compiler's version; its files have no pickles.
    """
    from cuda.core import Program as Source
    from cuda.core import ProgramOptions
    from cuda.core.utils import FileStreamProgramCache

    options = ProgramOptions(arch=architecture, std="c++17", define_macro=definitions(bits))
    source = Source(SOURCE.read_text(encoding="utf-8"), "c++", options)
    with FileStreamProgramCache(folder(SOURCE.parent) / "cubin") as kept:
        return source.compile("cubin", cache=kept)
