"""The loops of an NVIDIA GPU: one block of threads takes one lane, a sample of a seed, through the whole program.

Threads share the amplitude pairs of a step and wait for each other before the next. Every sum is taken in a fixed
order, by the lane or the seed alone: the same numbers at every run, and in any company.

Gradients are adjoint, as on the CPU (see `sweeps`). `backward` collects the slope of every angle lane by lane;
`collect` adds these up over the lanes of a seed for parameters, and over the angles of a lane for inputs.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numba
import numpy as np
from numba import cuda as _cuda

from qrlsuite.plugins.circuits.native.program import (
    AXIS_X,
    AXIS_Y,
    HADAMARD,
    NONE,
    ON_CONTROL,
    ON_TARGET,
    PERMUTE,
    PHASE,
    ROTATE,
)

cuda: Any = _cuda  # its attributes are made at run time

WARP = 32
"""Threads that a GPU runs in step; a block has this many or a multiple."""

TOGETHER = 4
"""So many sums over all threads are taken at a time: the overlaps of a block, or expectation values."""

HELD = 32
"""Amplitudes that a thread holds while a permutation moves them."""

MOST_THREADS = 512
"""The most threads of a block, for the largest circuits."""

REGISTERS = 65536 // MOST_THREADS
"""The registers of a GPU that a thread may take, so that the most threads have room."""


@cache
def kernels(kind: Any) -> dict[str, Any]:
    """Return the kernels of a precision, numpy's float32 or float64, by name."""
    zero, one, two, half, root = (kind(x) for x in (0.0, 1.0, 2.0, 0.5, math.sqrt(0.5)))
    rationed = {} if getattr(numba.config, "ENABLE_CUDASIM", 0) else {"max_registers": REGISTERS}
    number, held = numba.from_dtype(np.dtype(kind)), 2 * HELD

    @cuda.jit(device=True)
    def spread(k: int, bit: int) -> int:
        """Insert a zero at a bit position."""
        low = k & ((1 << bit) - 1)
        return ((k ^ low) << 1) | low

    @cuda.jit(device=True)
    def pair(k: int, control: int, target: int) -> int:
        """Return the k-th basis state whose target bit is 0 and whose control bit, if there is one, is 1."""
        if control < 0:
            return spread(k, target)
        return spread(spread(k, min(control, target)), max(control, target)) | (1 << control)

    @cuda.jit(device=True)
    def angle_of(
        angles: Any, constants: Any, index: int, inputs: Any, flat: Any, seed: int, sample: int
    ) -> Any:
        """Return constant + scale * input + weight of an angle."""
        value = constants[index]
        if angles[index, 0] >= 0:
            x = inputs[seed, sample, angles[index, 0]]
            value = value + (flat[seed, angles[index, 1]] * x if angles[index, 1] >= 0 else x)
        if angles[index, 2] >= 0:
            value = value + flat[seed, angles[index, 2]]
        return value

    @cuda.jit(device=True)
    def prepare(
        angles: Any,
        constants: Any,
        rotations: Any,
        factors: Any,
        blocks: Any,
        inputs: Any,
        flat: Any,
        seed: int,
        sample: int,
        room: Any,
    ) -> None:
        """Write (a, b) and the phase of every block to the first 6 G numbers of shared memory."""
        for g in range(cuda.threadIdx.x, blocks.shape[0] - 1, cuda.blockDim.x):
            ar, ai, br, bi, cr, ci = one, zero, zero, zero, one, zero
            for r in range(blocks[g], blocks[g + 1]):
                axis = rotations[r, 0]
                value = angle_of(angles, constants, rotations[r, 1], inputs, flat, seed, sample) * factors[r]
                if axis != PHASE:
                    value = value * half
                s, c = kind(math.sin(value)), kind(math.cos(value))
                if axis == AXIS_X:  # multiply from the left by [[c, -i s], [-i s, c]]
                    ar, ai, br, bi = c * ar + s * bi, c * ai - s * br, c * br + s * ai, c * bi - s * ar
                elif axis == AXIS_Y:  # [[c, -s], [s, c]]
                    ar, ai, br, bi = c * ar - s * br, c * ai - s * bi, s * ar + c * br, s * ai + c * bi
                elif axis == PHASE:
                    cr, ci = c * cr - s * ci, c * ci + s * cr
                else:  # diag(c - i s, c + i s)
                    ar, ai, br, bi = c * ar + s * ai, c * ai - s * ar, c * br - s * bi, c * bi + s * br
            room[6 * g] = ar
            room[6 * g + 1] = ai
            room[6 * g + 2] = br
            room[6 * g + 3] = bi
            room[6 * g + 4] = cr
            room[6 * g + 5] = ci

    @cuda.jit(device=True)
    def rotate(
        re: Any, im: Any, n: int, control: int, target: int, room: Any, g: int, phase: int, behind: int
    ) -> None:
        """Apply a block, and the Hadamards behind it."""
        ar, ai, br, bi = room[6 * g], room[6 * g + 1], room[6 * g + 2], room[6 * g + 3]
        cr, ci = room[6 * g + 4], room[6 * g + 5]
        step = 1 << target
        for k in range(cuda.threadIdx.x, 1 << (n - 1 if control < 0 else n - 2), cuda.blockDim.x):
            i = pair(k, control, target)
            j = i + step
            xr, xi, yr, yi = re[i], im[i], re[j], im[j]
            p0r = ar * xr - ai * xi - br * yr - bi * yi
            p0i = ar * xi + ai * xr - br * yi + bi * yr
            p1r = br * xr - bi * xi + ar * yr + ai * yi
            p1i = br * xi + bi * xr + ar * yi - ai * yr
            if phase:
                p0r, p0i = cr * p0r - ci * p0i, cr * p0i + ci * p0r
                p1r, p1i = cr * p1r - ci * p1i, cr * p1i + ci * p1r
            if behind:
                u, v = i - (1 << control), j - (1 << control)
                q0r, q0i, q1r, q1i = re[u], im[u], re[v], im[v]
                if behind & ON_TARGET:
                    p0r, p0i, p1r, p1i = p0r + p1r, p0i + p1i, p0r - p1r, p0i - p1i
                    q0r, q0i, q1r, q1i = q0r + q1r, q0i + q1i, q0r - q1r, q0i - q1i
                if behind & ON_CONTROL:
                    q0r, q0i, p0r, p0i = q0r + p0r, q0i + p0i, q0r - p0r, q0i - p0i
                    q1r, q1i, p1r, p1i = q1r + p1r, q1i + p1i, q1r - p1r, q1i - p1i
                re[u] = q0r
                im[u] = q0i
                re[v] = q1r
                im[v] = q1i
            re[i] = p0r
            im[i] = p0i
            re[j] = p1r
            im[j] = p1i

    @cuda.jit(device=True)
    def hadamard(re: Any, im: Any, n: int, bit: int) -> None:
        """Apply a Hadamard."""
        for k in range(cuda.threadIdx.x, 1 << (n - 1), cuda.blockDim.x):
            i = spread(k, bit)
            j = i + (1 << bit)
            xr, xi, yr, yi = re[i] * root, im[i] * root, re[j] * root, im[j] * root
            re[i] = xr + yr
            im[i] = xi + yi
            re[j] = xr - yr
            im[j] = xi - yi

    @cuda.jit(device=True)
    def permute(re: Any, im: Any, n: int, sources: Any, first: int, inverse: int) -> None:
        """Apply new[i] = old[source[i]], or undo it."""
        parts = cuda.local.array(held, number)
        me, threads = cuda.threadIdx.x, cuda.blockDim.x
        for at, i in enumerate(range(me, 1 << n, threads)):
            other = i if inverse else sources[first + i]
            parts[2 * at] = re[other]
            parts[2 * at + 1] = im[other]
        cuda.syncthreads()
        for at, i in enumerate(range(me, 1 << n, threads)):
            other = sources[first + i] if inverse else i
            re[other] = parts[2 * at]
            im[other] = parts[2 * at + 1]

    @cuda.jit(device=True)
    def fixed(
        steps: Any, m: int, n: int, re: Any, im: Any, sources: Any, negative: Any, inverse: int
    ) -> None:
        """Apply a step that no parameter changes, or undo it."""
        if steps[m, 0] == HADAMARD:
            for place in range(1, 4):
                if steps[m, place] != NONE:
                    if place > 1:
                        cuda.syncthreads()
                    hadamard(re, im, n, steps[m, place])
        elif steps[m, 0] == PERMUTE:
            permute(re, im, n, sources, steps[m, 1], inverse)
        else:
            for at in range(steps[m, 1] + cuda.threadIdx.x, steps[m, 2], cuda.blockDim.x):
                re[negative[at]] = -re[negative[at]]
                im[negative[at]] = -im[negative[at]]

    @cuda.jit(device=True)
    def add_up(partial: Any) -> None:
        """Add `TOGETHER` numbers over all threads, in a fixed order.

        Thread t wrote its v-th to partial[v T + t]; behind these are `TOGETHER` * `WARP` places, of which the first of
        each `WARP` receives a sum. The caller waits before it reads.
        """
        threads = cuda.blockDim.x
        behind = TOGETHER * threads
        cuda.syncthreads()
        for place in range(cuda.threadIdx.x, TOGETHER * WARP, threads):
            total = zero
            first = (place // WARP) * threads
            for t in range(place % WARP, threads, WARP):
                total += partial[first + t]
            partial[behind + place] = total
        cuda.syncthreads()
        if cuda.threadIdx.x < TOGETHER:
            total = zero
            for place in range(WARP):
                total += partial[behind + cuda.threadIdx.x * WARP + place]
            partial[behind + cuda.threadIdx.x * WARP] = total

    @cuda.jit(device=True)
    def odd(bits: int) -> int:
        """Return whether an odd number of bits is set."""
        bits ^= bits >> 16
        bits ^= bits >> 8
        bits ^= bits >> 4
        bits ^= bits >> 2
        bits ^= bits >> 1
        return bits & 1

    @cuda.jit(device=True)
    def run(
        components: Any,
        steps: Any,
        sources: Any,
        negative: Any,
        observables: Any,
        room: Any,
        partial: Any,
        state: Any,
        final: Any,
        keep: int,
        out: Any,
        seed: int,
        sample: int,
    ) -> None:
        """Bring every component into its final state, write it to `final` if kept, and measure."""
        me, threads, size = cuda.threadIdx.x, cuda.blockDim.x, state.shape[0] // 2
        for c in range(components.shape[0]):
            n, first, opening = components[c, 0], components[c, 1], components[c, 5]
            re, im = state[first : first + (1 << n)], state[size + first : size + first + (1 << n)]
            weight = one
            for q in range(n):
                if opening & (1 << q):
                    weight *= root
            for _ in range(components[c, 6]):
                weight *= root
            for i in range(me, 1 << n, threads):
                re[i] = zero if i & ~opening else weight
                im[i] = zero
            cuda.syncthreads()
            for m in range(components[c, 3], components[c, 4]):
                if steps[m, 0] == ROTATE:
                    rotate(re, im, n, steps[m, 1], steps[m, 2], room, steps[m, 3], steps[m, 4], steps[m, 5])
                else:
                    fixed(steps, m, n, re, im, sources, negative, 0)
                cuda.syncthreads()
        for i in range(me, size, threads):
            xr, xi = state[i], state[size + i]
            if keep:
                final[i] = xr
                final[size + i] = xi
            state[i] = xr * xr + xi * xi
        cuda.syncthreads()
        for begin in range(0, observables.shape[0], TOGETHER):
            for v in range(TOGETHER):
                total = zero
                if begin + v < observables.shape[0]:
                    first, n, mask = (
                        observables[begin + v, 0],
                        observables[begin + v, 1],
                        observables[begin + v, 2],
                    )
                    for i in range(me, 1 << n, threads):
                        x = state[first + i]
                        total += -x if odd(i & mask) else x
                partial[v * threads + me] = total
            add_up(partial)
            if me < TOGETHER and begin + me < observables.shape[0]:
                out[seed, sample, begin + me] = partial[TOGETHER * threads + me * WARP]
            cuda.syncthreads()

    @cuda.jit(device=True)
    def unrotate(
        pr: Any,
        pi: Any,
        lr: Any,
        li: Any,
        n: int,
        control: int,
        target: int,
        room: Any,
        g: int,
        phase: int,
        behind: int,
        weight: Any,
        partial: Any,
    ) -> None:
        """Undo a block and the Hadamards behind it on both states; each thread writes its overlaps to `partial`."""
        ar, ai, br, bi = (
            room[6 * g],
            -room[6 * g + 1],
            -room[6 * g + 2],
            -room[6 * g + 3],
        )  # U^-1: conj(a), -b
        cr, ci = room[6 * g + 4], -room[6 * g + 5]
        tx, ty, tz, t1 = zero, zero, zero, zero
        step = 1 << target
        for k in range(cuda.threadIdx.x, 1 << (n - 1 if control < 0 else n - 2), cuda.blockDim.x):
            i = pair(k, control, target)
            j = i + step
            p0r, p0i, p1r, p1i = pr[i], pi[i], pr[j], pi[j]
            l0r, l0i, l1r, l1i = lr[i], li[i], lr[j], li[j]
            if behind:
                u, v = i - (1 << control), j - (1 << control)
                q0r, q0i, q1r, q1i = pr[u], pi[u], pr[v], pi[v]
                m0r, m0i, m1r, m1i = lr[u], li[u], lr[v], li[v]
                if behind & ON_CONTROL:
                    q0r, q0i, p0r, p0i = q0r + p0r, q0i + p0i, q0r - p0r, q0i - p0i
                    q1r, q1i, p1r, p1i = q1r + p1r, q1i + p1i, q1r - p1r, q1i - p1i
                    m0r, m0i, l0r, l0i = m0r + l0r, m0i + l0i, m0r - l0r, m0i - l0i
                    m1r, m1i, l1r, l1i = m1r + l1r, m1i + l1i, m1r - l1r, m1i - l1i
                if behind & ON_TARGET:
                    q0r, q0i, q1r, q1i = q0r + q1r, q0i + q1i, q0r - q1r, q0i - q1i
                    p0r, p0i, p1r, p1i = p0r + p1r, p0i + p1i, p0r - p1r, p0i - p1i
                    m0r, m0i, m1r, m1i = m0r + m1r, m0i + m1i, m0r - m1r, m0i - m1i
                    l0r, l0i, l1r, l1i = l0r + l1r, l0i + l1i, l0r - l1r, l0i - l1i
                pr[u] = q0r
                pi[u] = q0i
                pr[v] = q1r
                pi[v] = q1i
                lr[u] = m0r
                li[u] = m0i
                lr[v] = m1r
                li[v] = m1i
            tx += l0r * p1i - l0i * p1r + l1r * p0i - l1i * p0r
            ty += l1r * p0r + l1i * p0i - l0r * p1r - l0i * p1i
            tz += l0r * p0i - l0i * p0r - l1r * p1i + l1i * p1r
            if phase:
                t1 += l0r * p0i - l0i * p0r + l1r * p1i - l1i * p1r
                p0r, p0i = cr * p0r - ci * p0i, cr * p0i + ci * p0r
                p1r, p1i = cr * p1r - ci * p1i, cr * p1i + ci * p1r
                l0r, l0i = cr * l0r - ci * l0i, cr * l0i + ci * l0r
                l1r, l1i = cr * l1r - ci * l1i, cr * l1i + ci * l1r
            pr[i] = ar * p0r - ai * p0i - br * p1r - bi * p1i
            pi[i] = ar * p0i + ai * p0r - br * p1i + bi * p1r
            pr[j] = br * p0r - bi * p0i + ar * p1r + ai * p1i
            pi[j] = br * p0i + bi * p0r + ar * p1i - ai * p1r
            lr[i] = ar * l0r - ai * l0i - br * l1r - bi * l1i
            li[i] = ar * l0i + ai * l0r - br * l1i + bi * l1r
            lr[j] = br * l0r - bi * l0i + ar * l1r + ai * l1i
            li[j] = br * l0i + bi * l0r + ar * l1i - ai * l1r
        me, threads = cuda.threadIdx.x, cuda.blockDim.x
        partial[me] = weight * tx
        partial[threads + me] = weight * ty
        partial[2 * threads + me] = weight * tz
        partial[3 * threads + me] = weight * t1

    @cuda.jit(device=True)
    def unrun(
        components: Any,
        steps: Any,
        sources: Any,
        negative: Any,
        room: Any,
        partial: Any,
        overlaps: Any,
        psi: Any,
        lam: Any,
    ) -> None:
        """Undo every step on both states, last step first; `overlaps` (4 G) receives the overlaps of every block."""
        size = psi.shape[0] // 2
        me, threads = cuda.threadIdx.x, cuda.blockDim.x
        for c in range(components.shape[0]):
            n, first = components[c, 0], components[c, 1]
            last = first + (1 << n)
            pr, pi = psi[first:last], psi[size + first : size + last]
            lr, li = lam[first:last], lam[size + first : size + last]
            weight = one  # half for every Hadamard undone without its factor
            for back in range(components[c, 4] - components[c, 3]):
                m = components[c, 4] - 1 - back
                if steps[m, 0] == ROTATE:
                    behind = steps[m, 5]
                    if behind & ON_TARGET:
                        weight *= half
                    if behind & ON_CONTROL:
                        weight *= half
                    g = steps[m, 3]
                    unrotate(
                        pr,
                        pi,
                        lr,
                        li,
                        n,
                        steps[m, 1],
                        steps[m, 2],
                        room,
                        g,
                        steps[m, 4],
                        behind,
                        weight,
                        partial,
                    )
                    add_up(partial)
                    if me < TOGETHER:
                        overlaps[TOGETHER * g + me] = partial[TOGETHER * threads + me * WARP]
                else:
                    fixed(steps, m, n, pr, pi, sources, negative, 1)
                    fixed(steps, m, n, lr, li, sources, negative, 1)
                    cuda.syncthreads()
        cuda.syncthreads()

    @cuda.jit(device=True)
    def weigh(
        observables: Any, cotangent: Any, seed: int, sample: int, final: Any, psi: Any, lam: Any
    ) -> None:
        """Copy the final state to psi and write lambda = (sum_o g_o Z_o) psi."""
        size = psi.shape[0] // 2
        for i in range(cuda.threadIdx.x, size, cuda.blockDim.x):
            factor = zero
            for o in range(observables.shape[0]):
                inside = i - observables[o, 0]
                if inside >= 0 and inside < (1 << observables[o, 1]):
                    g = cotangent[seed, sample, o]
                    factor += -g if odd(inside & observables[o, 2]) else g
            xr, xi = final[i], final[size + i]
            psi[i] = xr
            psi[size + i] = xi
            lam[i] = factor * xr
            lam[size + i] = factor * xi
        cuda.syncthreads()

    @cuda.jit(device=True)
    def chain(
        angles: Any,
        constants: Any,
        rotations: Any,
        factors: Any,
        blocks: Any,
        inputs: Any,
        flat: Any,
        seed: int,
        sample: int,
        overlaps: Any,
        slopes: Any,
    ) -> None:
        """Turn the overlaps of every block into the slopes of its angles, see `kernels.chain`."""
        for g in range(cuda.threadIdx.x, blocks.shape[0] - 1, cuda.blockDim.x):
            for r in range(blocks[g], blocks[g + 1]):
                slopes[rotations[r, 1]] = zero
            x, y, z, phase = overlaps[4 * g], overlaps[4 * g + 1], overlaps[4 * g + 2], overlaps[4 * g + 3]
            for back in range(blocks[g + 1] - blocks[g]):
                r = blocks[g + 1] - 1 - back
                axis, index = rotations[r, 0], rotations[r, 1]
                value = angle_of(angles, constants, index, inputs, flat, seed, sample) * factors[r]
                s, c = kind(math.sin(value)), kind(math.cos(value))
                if axis == AXIS_X:
                    slope = x
                    y, z = c * y + s * z, c * z - s * y
                elif axis == AXIS_Y:
                    slope = y
                    z, x = c * z + s * x, c * x - s * z
                elif axis == PHASE:
                    slope = -two * phase
                else:
                    slope = z
                    x, y = c * x + s * y, c * y - s * x
                slopes[index] += factors[r] * slope

    def forward(shared: bool) -> Any:
        @cuda.jit(**rationed)
        def kernel(
            components: Any,
            steps: Any,
            angles: Any,
            constants: Any,
            rotations: Any,
            factors: Any,
            blocks: Any,
            sources: Any,
            negative: Any,
            observables: Any,
            size: int,
            inputs: Any,
            flat: Any,
            work: Any,
            finals: Any,
            keep: int,
            out: Any,
        ) -> None:
            room = cuda.shared.array(0, number)
            gates = 6 * (blocks.shape[0] - 1)
            sums = gates + TOGETHER * (cuda.blockDim.x + WARP)
            partial = room[gates:sums]
            state = room[sums : sums + size] if shared else work[cuda.blockIdx.x]
            for lane in range(cuda.blockIdx.x, inputs.shape[0] * inputs.shape[1], cuda.gridDim.x):
                seed, sample = lane // inputs.shape[1], lane % inputs.shape[1]
                prepare(angles, constants, rotations, factors, blocks, inputs, flat, seed, sample, room)
                cuda.syncthreads()
                run(
                    components,
                    steps,
                    sources,
                    negative,
                    observables,
                    room,
                    partial,
                    state,
                    finals[lane if keep else 0],
                    keep,
                    out,
                    seed,
                    sample,
                )

        return kernel

    def backward(psi_shared: bool, lam_shared: bool) -> Any:
        @cuda.jit(**rationed)
        def kernel(
            components: Any,
            steps: Any,
            angles: Any,
            constants: Any,
            rotations: Any,
            factors: Any,
            blocks: Any,
            sources: Any,
            negative: Any,
            observables: Any,
            size: int,
            inputs: Any,
            flat: Any,
            work: Any,
            finals: Any,
            cotangent: Any,
            slopes: Any,
        ) -> None:
            room = cuda.shared.array(0, number)
            gates = 6 * (blocks.shape[0] - 1)
            sums = gates + TOGETHER * (cuda.blockDim.x + WARP)
            overlaps = sums + TOGETHER * (blocks.shape[0] - 1)
            partial = room[gates:sums]
            psi = room[overlaps : overlaps + size] if psi_shared else work[2 * cuda.blockIdx.x]
            lam = room[overlaps + size : overlaps + 2 * size] if lam_shared else work[2 * cuda.blockIdx.x + 1]
            for lane in range(cuda.blockIdx.x, inputs.shape[0] * inputs.shape[1], cuda.gridDim.x):
                seed, sample = lane // inputs.shape[1], lane % inputs.shape[1]
                prepare(angles, constants, rotations, factors, blocks, inputs, flat, seed, sample, room)
                weigh(observables, cotangent, seed, sample, finals[lane], psi, lam)
                unrun(components, steps, sources, negative, room, partial, room[sums:overlaps], psi, lam)
                chain(
                    angles,
                    constants,
                    rotations,
                    factors,
                    blocks,
                    inputs,
                    flat,
                    seed,
                    sample,
                    room[sums:overlaps],
                    slopes[lane],
                )
                cuda.syncthreads()

        return kernel

    @cuda.jit
    def collect(
        angles: Any,
        of_parameters: Any,
        first_of_parameter: Any,
        of_inputs: Any,
        first_of_input: Any,
        inputs: Any,
        flat: Any,
        slopes: Any,
        grad_inputs: Any,
        grad_flat: Any,
    ) -> None:
        """One thread per parameter of a seed, then per input of a sample."""
        samples, features, parameters = inputs.shape[1], inputs.shape[2], flat.shape[1]
        me = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
        of_flat = flat.shape[0] * parameters
        if me < of_flat:
            seed, p = me // parameters, me % parameters
            total = zero
            for at in range(first_of_parameter[p], first_of_parameter[p + 1]):
                index, scales = of_parameters[at, 0], of_parameters[at, 1]
                for b in range(samples):
                    slope = slopes[seed * samples + b, index]
                    total += slope * inputs[seed, b, angles[index, 0]] if scales else slope
            grad_flat[seed, p] = total
        elif me < of_flat + inputs.shape[0] * samples * features:
            lane, feature = (me - of_flat) // features, (me - of_flat) % features
            seed, b = lane // samples, lane % samples
            total = zero
            for at in range(first_of_input[feature], first_of_input[feature + 1]):
                index = of_inputs[at]
                slope = slopes[lane, index]
                total += slope * flat[seed, angles[index, 1]] if angles[index, 1] >= 0 else slope
            grad_inputs[seed, b, feature] = total

    return {
        "forward shared": forward(True),
        "forward": forward(False),
        "backward shared": backward(True, True),
        "backward half": backward(True, False),
        "backward": backward(False, False),
        "collect": collect,
    }
