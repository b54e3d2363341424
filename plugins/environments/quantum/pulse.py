"""Pulse: bring one or two qubits into a state by fields that are switched or set, step by step."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.environment import EpisodeLanes, LaneEnv, require_lanes
from qrlsuite.errors import OptionError
from qrlsuite.plugins.environments.quantum import pictures
from qrlsuite.plugins.environments.quantum.lanes import (
    ComplexArray,
    Drawn,
    FloatArray,
    pauli,
    words,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXHAUSTED = 4096
"""Most pulses of half an episode that `BestPulse` goes through, for all pulses of an episode."""
STARTS = 100
"""Random pulses that `BestPulse` begins with where fields are continuous."""
ENOUGH = 0.9999
"""Fidelity at which it looks no further; 1 is the bound."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PulseOptions:
    """Options of Pulse."""

    qubits: Annotated[
        int, Field(ge=1, le=2, description="number of qubits, each with a field of its own")
    ] = 1
    control: Annotated[
        Literal["bang-bang", "continuous"],
        Field(description="bang-bang: a field is off or full; continuous: any strength between"),
    ] = "bang-bang"
    steps: Annotated[int, Field(ge=1, le=1000, description="pieces of constant fields")] = 20
    duration: Annotated[
        float, Field(gt=0, le=1000, description="time of an episode, in units of hbar / h")
    ] = 6.283185307179586
    strength: Annotated[float, Field(gt=0, le=100, description="full field J, in units of h")] = 4.0
    coupling: Annotated[float, Field(ge=0, le=100, description="coupling c of two qubits, in units of h")] = (
        1.0
    )
    start: Annotated[
        Literal["zero", "random"],
        Field(description="zero: all qubits in |0>; random: a pure state, uniform over all of them"),
    ] = "random"
    dephasing: Annotated[
        float,
        Field(
            ge=0,
            le=10,
            description="rate at which a qubit's coherence decays, in units of h / hbar; 0: not at all",
        ),
    ] = 0.0
    miscalibration: Annotated[
        float,
        Field(
            ge=0,
            le=1,
            description="standard deviation of the relative error of the field, which is drawn for each episode",
        ),
    ] = 0.0


def physics(options: PulseOptions) -> tuple[ComplexArray, ComplexArray, ComplexArray, FloatArray]:
    """Return drift (d, d), controls (qubits, d, d), target (d,), and the factor of dephasing in half a step (d, d)."""
    one = options.qubits == 1
    drift = pauli("X") / 2 if one else (pauli("XI") + pauli("IX") + options.coupling * pauli("ZZ")) / 2
    controls = np.stack([options.strength * pauli(w) / 2 for w in (["Z"] if one else ["ZI", "IZ"])])
    target = np.array([0, 1] if one else [1, 0, 0, 1], np.complex128)
    index = np.arange(2**options.qubits)
    apart = np.array([[bin(a ^ b).count("1") for a in index] for b in index])
    kept = np.exp(-options.dephasing * options.duration / options.steps / 2 * apart)
    return drift, controls, target / np.linalg.norm(target), kept


class Pulse(Drawn):
    """Bring one or two qubits into a target state by switched or continuous fields.

    ## Description

    A qubit feels a constant field h along x and a controlled field J u along z, 0 <= u <= 1, as a singlet-triplet qubit
    does. With hbar = h = 1 and the Pauli matrices X and Z,

        H(u)      = (J u Z + X) / 2                                     (one qubit)
        H(u1, u2) = (J u1 Z1 + J u2 Z2 + X1 + X2 + c Z1 Z2) / 2         (two qubits)

    The first, J = 4, T = 2 pi, 20 steps and the target |1> are from Zhang et al., "When does reinforcement learning
    stand out in quantum control?" (arXiv 1902.02157), in the code at github.com/93xiaoming/RL_state_preparation. Two
    qubits, their target (|00> + |11>) / sqrt(2) and random starts are ours.

    With `dephasing` g, the coherence of each qubit decays by exp(-g t): half of a step's decay comes before its
    rotation, half after (the symmetric splitting of the Lindblad equation). With `miscalibration`, J is J (1 + e)
    throughout an episode, e normal.

    ## Action Space

    | control      | qubits | actions                                                        |
    |--------------|--------|----------------------------------------------------------------|
    | `bang-bang`  | 1      | `Discrete(2)`: u                                               |
    | `bang-bang`  | 2      | `Discrete(4)`: (u1, u2) = (0, 0), (0, 1), (1, 0), (1, 1)       |
    | `continuous` | n      | `Box(-1, 1, (n,), float32)`: u = (1 + a) / 2                   |

    ## Observation Space

    `Box(-1, 1, (4^qubits,), float32)`: the expectation values of the Pauli words X, Y, Z (of two qubits IX, IY, ...,
    ZZ), which hold no global phase, then the part of the steps that is over.

    ## Rewards

    By how much the fidelity F = <target| rho |target> rises in a step.

    ## Episode End

    After `steps` steps the episode is *terminated*, and `info["score"]` is F, in [0, 1].

    Arguments are the fields of `PulseOptions`.
    """

    lanes: PulseLanes

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(PulseLanes, PulseOptions, options, render_mode)

    def moment(self) -> ComplexArray:
        """Return the density matrix (d, d)."""
        rho: ComplexArray = self.lanes.rho[0].copy()
        return rho

    def figure(self) -> Figure:
        """Return the paths of the Bloch vectors, the fields and the fidelity."""
        lanes, shown = self.lanes, np.stack(self.shown)
        fields = [lanes.fields(np.asarray(action)[None])[0] for action in self.done]
        between = [shown[:1]]
        for rho, after, field in zip(shown, shown[1:], fields):
            parts = np.linspace(0.1, 0.9, 9)
            turned = lanes.rotations(np.tile(field, (9, 1)), lanes.error.repeat(9), parts)
            between += [turned @ rho @ turned.conj().swapaxes(1, 2), after[None]]
        return pictures.pulse(
            lanes.bloch(shown),
            lanes.bloch(np.concatenate(between)),
            lanes.fidelity(shown),
            fields,
            lanes.options,
        )


class PulseLanes(EpisodeLanes):
    """Vector form of `Pulse`; see there for spaces and rewards."""

    name = "pulse"

    def __init__(self, options: PulseOptions, num_envs: int) -> None:
        n = options.qubits
        discrete = options.control == "bang-bang"
        action = Discrete(2**n) if discrete else Box(-1.0, 1.0, (n,), np.float32)
        super().__init__(options, num_envs, Box(-1.0, 1.0, (4**n,), np.float32), action)
        self.drift, self.controls, self.target, self.kept = physics(options)
        self.words = words(n)
        self.levels = np.array(list(product([0.0, 1.0], repeat=n)))
        """(2^qubits, qubits): the fields of each discrete action."""
        self._transposed = np.stack([pauli(word).T for word in self.words])
        self._rho = np.zeros((num_envs, 2**n, 2**n, 2))
        """Density matrices, real and imaginary parts."""
        self.error = np.zeros(num_envs)
        """The fields' relative errors in this episode."""

    @property
    def rho(self) -> ComplexArray:
        """The density matrices (L, d, d), a view."""
        return self._rho.view(np.complex128)[..., 0]

    def fields(self, actions: NDArray[Any]) -> FloatArray:
        """Return the fields u (L, qubits) in 0 .. 1 of actions."""
        if self.options.control == "bang-bang":
            switched: FloatArray = self.levels[actions]
            return switched
        result: FloatArray = (1.0 + actions.astype(np.float64)) / 2.0
        return result

    def rotations(
        self, fields: FloatArray, error: FloatArray, part: float | FloatArray = 1.0
    ) -> ComplexArray:
        """Return the unitary matrices (L, d, d) of a step, or of a part of it (L,).

        Parameters
        ----------
        fields, error:
            Fields u (L, qubits) and their relative errors (L,).
        """
        total = np.broadcast_to(self.drift, (len(fields), *self.drift.shape)).copy()
        for q, control in enumerate(self.controls):
            total += (fields[:, q] * (1.0 + error))[:, None, None] * control
        energies, vectors = np.linalg.eigh(total)
        times = part * np.full(len(fields), self.options.duration / self.options.steps)
        phases = np.exp(-1j * energies * times[:, None])
        result: ComplexArray = (vectors * phases[:, None, :]) @ vectors.conj().swapaxes(1, 2)
        return result

    def evolved(self, rho: ComplexArray, rotations: ComplexArray) -> ComplexArray:
        """Return density matrices (..., d, d) a step later."""
        result: ComplexArray = rotations @ (rho * self.kept) @ rotations.conj().swapaxes(-1, -2) * self.kept
        return result

    def fidelity(self, rho: ComplexArray | None = None) -> FloatArray:
        """Return <target| rho |target> of density matrices (L, d, d), by default of the lanes' own."""
        projector = np.outer(self.target, self.target.conj()).T
        values = ((self.rho if rho is None else rho) * projector).real
        result: FloatArray = np.clip(values.reshape(len(values), -1).sum(1), 0.0, 1.0)
        return result

    def expectations(self, rho: ComplexArray | None = None) -> FloatArray:
        """Return the expectation values (L, 4^qubits - 1) of the Pauli words, by default of the lanes' own."""
        rho = self.rho if rho is None else rho
        shown = np.stack(
            [(rho * word).real.reshape(len(rho), -1).sum(1) for word in self._transposed], axis=1
        )
        result: FloatArray = np.clip(shown, -1.0, 1.0)
        return result

    def bloch(self, rho: ComplexArray) -> FloatArray:
        """Return the qubits' Bloch vectors (L, qubits, 3) of density matrices (L, d, d)."""
        n = self.options.qubits
        alone = ["I" * q + letter + "I" * (n - 1 - q) for q in range(n) for letter in "XYZ"]
        places = [self.words.index(word) for word in alone]
        return self.expectations(rho)[:, places].reshape(-1, n, 3)

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"rho": self._rho, "error": self.error}

    def _draw(self, stream: np.random.Generator, count: int) -> FloatArray:
        return stream.standard_normal((count, 1 + 2 * len(self.target)))

    def _begin(self, lanes: NDArray[np.intp], drawn: FloatArray) -> None:
        self.error[lanes] = self.options.miscalibration * drawn[:, 0]
        d = len(self.target)
        state = drawn[:, 1 : 1 + d] + 1j * drawn[:, 1 + d :]
        if self.options.start == "zero":
            state = np.broadcast_to(np.eye(d)[0], state.shape).astype(np.complex128)
        state = state / np.sqrt((state * state.conj()).real.sum(1))[:, None]
        self.rho[lanes] = state[:, :, None] * state.conj()[:, None, :]

    def _act(self, actions: NDArray[Any], running: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
        before = self.fidelity()
        after = self.evolved(self.rho, self.rotations(self.fields(actions), self.error))
        self.rho[running] = after[running]
        return self.fidelity() - before, np.zeros_like(running)

    def _seen(self) -> NDArray[np.float32]:
        over = self.step_count / self.options.steps
        return np.column_stack([self.expectations(), over]).astype(np.float32)

    def _scores(self) -> FloatArray:
        return self.fidelity()

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        rho = np.ascontiguousarray(state["rho"], np.float64).view(np.complex128)[..., 0]
        return bool(np.allclose(np.trace(rho, axis1=1, axis2=2), 1) and np.isfinite(state["error"]).all())


class GreedyPulse:
    """The reference policy that takes the strength (of 2 or 11 a field) with the highest fidelity after the step."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, PulseLanes)
        discrete = self.envs.options.control == "bang-bang"
        grid = [0.0, 1.0] if discrete else np.linspace(0.0, 1.0, 11).tolist()
        self._tried = np.array(list(product(grid, repeat=self.envs.options.qubits)))

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return actions (L,) or (L, qubits)."""
        envs = self.envs
        found = []
        for fields in self._tried:
            rotations = envs.rotations(np.tile(fields, (envs.num_envs, 1)), envs.error)
            found.append(envs.fidelity(envs.evolved(envs.rho, rotations)))
        best: NDArray[np.intp] = np.argmax(found, axis=0)
        if envs.options.control == "bang-bang":
            return best.astype(np.int64)
        return (2.0 * self._tried[best] - 1.0).astype(np.float32)


class BestPulse:
    """The reference policy that knows the best pulse from where the episode begins, and the field's error.

    Switched fields: the best of all pulses, an optimum; the pulses of both halves of an episode are matched, from the
    start and back from the target. Continuous fields: the best that gradient ascent (GRAPE; exact gradients) finds from
    100 random pulses, or from fewer where it has a fidelity of 0.9999.
    """

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, PulseLanes)
        options = self.envs.options
        half = (options.steps + 1) // 2
        if options.control == "bang-bang" and 2 ** (options.qubits * half) > EXHAUSTED:
            raise OptionError(
                f"environment 'pulse': 2^{options.qubits * options.steps} pulses are too many to know the best; set "
                f'steps = {24 // options.qubits} or fewer, or control = "continuous"'
            )
        space = self.envs.action_space
        self._plan = np.zeros((options.steps, *(space.shape or ())), space.dtype)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return actions (L,) or (L, qubits)."""
        steps, options = self.envs.step_count, self.envs.options
        for lane in np.flatnonzero(steps == 0).tolist():
            discrete = options.control == "bang-bang"
            self._plan[:, lane] = self._exhausted(lane) if discrete else 2.0 * grape(self.envs, lane) - 1.0
        result: NDArray[Any] = self._plan[np.minimum(steps, options.steps - 1), np.arange(len(steps))]
        return result

    def _exhausted(self, lane: int) -> NDArray[np.int64]:
        """Return the best actions (steps,) of a lane."""
        envs = self.envs
        count, (first, second) = len(envs.levels), divmod(envs.options.steps, 2)
        rotations = envs.rotations(envs.levels, np.full(count, envs.error[lane]))
        forward = envs.rho[lane][None]
        for _ in range(first + second):
            forward = envs.evolved(forward[:, None], rotations).reshape(-1, *envs.drift.shape)
        backward = np.outer(envs.target, envs.target.conj())[None]
        for _ in range(first):  # the same channel in the Heisenberg picture, so later actions vary fastest
            backward = envs.evolved(backward[None], rotations.conj().swapaxes(1, 2)[:, None])
            backward = backward.reshape(-1, *envs.drift.shape)
        flat = forward.reshape(len(forward), -1), backward.conj().reshape(len(backward), -1)
        values = flat[0].real @ flat[1].real.T - flat[0].imag @ flat[1].imag.T
        a, b = np.unravel_index(int(np.argmax(values)), values.shape)
        digits = [int(a) // count**k % count for k in reversed(range(first + second))]
        return np.array(digits + [int(b) // count**k % count for k in reversed(range(first))])


def grape(envs: PulseLanes, lane: int, starts: int = STARTS) -> FloatArray:
    """Return the best fields (steps, qubits) that gradient ascent finds for a lane, from where it is.

    Gradients are exact, and L-BFGS-B of scipy makes the steps.

    Parameters
    ----------
    starts:
        Random pulses to begin with, one after another, until the fidelity is 0.9999.
    """
    from scipy.optimize import minimize

    options, generator = envs.options, np.random.default_rng(0)
    shape = options.steps, options.qubits
    best, lowest = np.zeros(shape), 1.0

    def climb(x: FloatArray) -> Any:
        return _infidelity(envs, lane, x.reshape(shape))

    for _ in range(starts):
        first = generator.random(options.steps * options.qubits)
        found = minimize(climb, first, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(first))
        if found.fun < lowest:
            best, lowest = found.x.reshape(shape), found.fun
        if lowest < 1.0 - ENOUGH:
            break
    return best


def _infidelity(envs: PulseLanes, lane: int, fields: FloatArray) -> tuple[float, FloatArray]:
    """Return 1 - F after a pulse (steps, qubits), and its exact gradient, flat.

    With U = V exp(-i E t) V^dagger, the derivative of U by a field with the matrix C is V (Phi * V^dagger C V)
    V^dagger, where Phi_ab is the divided difference of exp(-i E t) at E_a and E_b.
    """
    scale, time = 1.0 + envs.error[lane], envs.options.duration / envs.options.steps
    total = envs.drift + np.einsum("kq,qij->kij", scale * fields, envs.controls)
    energies, vectors = np.linalg.eigh(total)
    back = vectors.conj().swapaxes(1, 2)
    rotations = (vectors * np.exp(-1j * energies * time)[:, None, :]) @ back
    states = [envs.rho[lane]]
    for rotation in rotations:
        states.append(envs.evolved(states[-1], rotation))
    observed = [np.outer(envs.target, envs.target.conj())]
    for rotation in rotations[::-1]:  # the target in the Heisenberg picture
        observed.append(envs.evolved(observed[-1], rotation.conj().T))
    sums, differences = (
        energies[:, :, None] + energies[:, None, :],
        energies[:, :, None] - energies[:, None, :],
    )
    divided = -1j * time * np.exp(-0.5j * time * sums) * np.sinc(time * differences / (2 * np.pi))
    before, after = np.stack(states[:-1]) * envs.kept, np.stack(observed[-2::-1]) * envs.kept
    inner = back @ before @ rotations.conj().swapaxes(1, 2) @ after @ vectors
    turned = back[:, None] @ (scale * envs.controls) @ vectors[:, None]
    slopes = 2.0 * np.einsum("kba,kab,kqab->kq", inner, divided, turned).real
    return 1.0 - float(envs.fidelity(states[-1][None])[0]), -slopes.reshape(-1)
