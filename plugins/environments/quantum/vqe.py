"""VQE: grow a circuit, gate by gate, whose state has a low energy: the hydrogen molecule or a chain of Ising spins."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from qrlsuite.environment import EpisodeLanes, LaneEnv, require_lanes
from qrlsuite.plugins.environments.quantum import pictures
from qrlsuite.plugins.environments.quantum.compiled import optimize
from qrlsuite.plugins.environments.quantum.lanes import Drawn, FloatArray, pauli

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IntArray = NDArray[np.int64]
SWEEPS = 3
"""Passes over all angles after every gate."""
KEPT = 1024
"""Energies of each length that `BestCircuit` goes on from, with one circuit each."""
H2 = {
    0.40: (1.1182, 0.4754, -0.9145, 0.6438, 0.0825, 0.0825),
    0.55: (0.5979, 0.4125, -0.6612, 0.6129, 0.0858, 0.0858),
    0.65: (0.3819, 0.3760, -0.5358, 0.5921, 0.0883, 0.0883),
    0.75: (0.2252, 0.3435, -0.4347, 0.5716, 0.0910, 0.0910),
    0.90: (0.0609, 0.3018, -0.3168, 0.5421, 0.0954, 0.0954),
    1.05: (-0.0493, 0.2669, -0.2282, 0.5146, 0.1002, 0.1002),
    1.25: (-0.1452, 0.2286, -0.1413, 0.4812, 0.1067, 0.1067),
    1.50: (-0.2165, 0.1908, -0.0666, 0.4451, 0.1149, 0.1149),
    1.80: (-0.2632, 0.1565, -0.0088, 0.4094, 0.1241, 0.1241),
    2.10: (-0.2879, 0.1316, 0.0272, 0.3811, 0.1323, 0.1323),
    2.50: (-0.3051, 0.1098, 0.0549, 0.3521, 0.1412, 0.1412),
    2.85: (-0.3135, 0.0984, 0.0679, 0.3329, 0.1475, 0.1475),
}
"""Hydrogen in the basis STO-3G: the distance of its atoms, Angstrom, and the coefficients of II, ZI, IZ, ZZ, XX, YY,
Hartree, with the repulsion of the nuclei."""
FIELDS: FloatArray = np.linspace(0.5, 1.5, 11)
"""Transverse fields of the Ising chain, in units of its coupling."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class VQEOptions:
    """Options of VQE."""

    model: Annotated[
        Literal["h2", "ising"],
        Field(
            description="h2: the hydrogen molecule, two qubits; ising: a chain of spins in a transverse field"
        ),
    ] = "h2"
    qubits: Annotated[int, Field(ge=2, le=5, description="number of qubits; h2 has 2")] = 2
    steps: Annotated[int, Field(ge=1, le=40, description="gates of an episode")] = 6

    @model_validator(mode="after")
    def _two(self) -> VQEOptions:
        if self.model == "h2" and self.qubits != 2:
            raise ValueError(f'qubits = {self.qubits}: the model "h2" has 2')
        return self


@cache
def hamiltonians(options: VQEOptions) -> tuple[FloatArray, FloatArray]:
    """Return the problems that episodes draw from: distances or fields (K,), and Hamiltonians (K, d, d), real."""
    n = options.qubits
    if options.model == "h2":
        terms = np.stack([pauli(word).real for word in ("II", "ZI", "IZ", "ZZ", "XX", "YY")])
        return np.array(list(H2)), np.einsum("kt,tij->kij", np.array(list(H2.values())), terms)
    bonds = np.sum([pauli("I" * q + "ZZ" + "I" * (n - 2 - q)).real for q in range(n - 1)], axis=0)
    flips = np.sum([pauli("I" * q + "X" + "I" * (n - 1 - q)).real for q in range(n)], axis=0)
    chains: FloatArray = -bonds - FIELDS[:, None, None] * flips
    return FIELDS, chains


def coupled(qubits: int) -> IntArray:
    """Return the pairs (control, target) of CX in the order of the actions: neighbors, both directions."""
    pairs = [(a, b) for a in range(qubits) for b in range(qubits) if abs(a - b) == 1]
    return np.array(pairs, np.int64)


@cache
def energies(options: VQEOptions) -> tuple[FloatArray, FloatArray]:
    """Return the lowest energies (K,) of circuits without CX, and the exact ones, by dense diagonalization."""
    _, matrices = hamiltonians(options)
    n, starts = options.qubits, 32
    which = np.repeat(np.arange(len(matrices)), starts)
    gates = np.tile(np.arange(n), (len(which), 1))
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, gates.shape)
    reached = np.zeros(len(which))
    optimize(matrices, which, gates, angles, np.full(len(which), n), coupled(n), n, 200, reached)
    exact = np.linalg.eigvalsh(matrices)[:, 0].astype(np.float64)
    return reached.reshape(-1, starts).min(1), exact


class VQE(Drawn):
    """Grow a circuit whose state has a low energy, gate by gate.

    ## Description

    Each episode has a Hamiltonian, drawn from 11 or 12 with equal probabilities. Its circuit begins with |0..0>. An
    action appends a gate; then every angle is set to where the energy is lowest, given the others, in three passes from
    the first gate on. That is exact: the energy is a sine of each angle (Ostaszewski et al., "Structure optimization
    for parameterized quantum circuits", arXiv 1905.09692). The agent has to find which gates.

    | model   | Hamiltonian                                                                  | energies in       |
    |---------|------------------------------------------------------------------------------|-------------------|
    | `h2`    | g0 + g1 Z0 + g2 Z1 + g3 Z0 Z1 + g4 X0 X1 + g5 Y0 Y1, by the atoms' distance  | Hartree           |
    | `ising` | - sum Z_i Z_i+1 - g sum X_i, an open chain, g = 0.5, 0.6, ..., 1.5           | the coupling      |

    The coefficients of `h2`, the molecule in the minimal basis STO-3G at 12 distances of 0.40 to 2.85 Angstrom, are
    from O'Malley et al., "Scalable quantum simulation of molecular energies" (arXiv 1512.06860), by the samples of
    Microsoft's Quantum Development Kit.

    With E the energy at the end, E_0 the ground state's (dense diagonalization) and E_1 the lowest of circuits
    without CX, the score is (E_1 - E) / (E_1 - E_0), and 0 where that is negative: the part of the correlation energy.

    ## Action Space

    `Discrete(gates)`: RY of qubit 0, 1, ..., then CX of neighbors (control, target), ascending.

    ## Observation Space

    `Box(0, 1, (steps * gates + 2,), float32)`: for each gate of the circuit a 1 at its number, then the distance or
    field (0: the lowest, 1: the highest), and the score so far. That is all there is to know.

    ## Rewards

    By how much the score rises.

    ## Episode End

    After `steps` gates the episode is *terminated*. `info["score"]` is the score, in [0, 1], and
    `info["metrics"]["energy-error"]` is E - E_0.

    Arguments are the fields of `VQEOptions`.
    """

    lanes: VQELanes

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(VQELanes, VQEOptions, options, render_mode)

    def moment(self) -> float:
        """Return the energy above the ground state's."""
        return float(self.lanes.above()[0])

    def figure(self) -> Figure:
        """Return the circuit so far, and the energy after each gate."""
        lanes = self.lanes
        names = [lanes.word(int(gate)) for gate in self.done]
        angles = lanes.angles[0, : len(names)].tolist()
        what = "R = {:.2f} Angstrom" if lanes.options.model == "h2" else "g = {:.1f}"
        title = what.format(lanes.values[lanes.which[0]])
        return pictures.vqe(names, angles, self.shown, lanes.options, title, float(lanes.gap[lanes.which[0]]))


class VQELanes(EpisodeLanes):
    """Vector form of `VQE`; see there for spaces and rewards.

    Attributes
    ----------
    which, gates, angles, energy:
        The number of the Hamiltonian (L,), the gates' numbers (L, steps), -1 where there is none yet, their angles,
        radians, and the energy (L,).
    """

    name = "vqe"

    def __init__(self, options: VQEOptions, num_envs: int) -> None:
        self.values, self.matrices = hamiltonians(options)
        self.pairs = coupled(options.qubits)
        product, self.exact = energies(options)
        self.gap: FloatArray = product - self.exact
        """Correlation energies (K,)."""
        count = options.qubits + len(self.pairs)
        observation = Box(0.0, 1.0, (options.steps * count + 2,), np.float32)
        super().__init__(options, num_envs, observation, Discrete(count))
        self.which = np.zeros(num_envs, np.int64)
        self.gates = np.full((num_envs, options.steps), -1, np.int64)
        self.angles = np.zeros((num_envs, options.steps))
        self.energy = np.zeros(num_envs)

    def word(self, gate: int) -> tuple[str, tuple[int, ...]]:
        """Return a gate's name and qubits."""
        n = self.options.qubits
        return ("RY", (gate,)) if gate < n else ("CX", tuple(self.pairs[gate - n].tolist()))

    def grown(
        self, which: IntArray, gates: IntArray, angles: FloatArray, counts: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the best angles (N, steps) and energies (N,) of circuits, from the angles that they have."""
        angles, reached = angles.copy(), np.zeros(len(which))
        optimize(
            self.matrices, which, gates, angles, counts, self.pairs, self.options.qubits, SWEEPS, reached
        )
        return angles, reached

    def above(self) -> FloatArray:
        """Return the energies above the ground states' energies, (L,)."""
        result: FloatArray = self.energy - self.exact[self.which]
        return result

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"which": self.which, "gates": self.gates, "angles": self.angles, "energy": self.energy}

    def _draw(self, stream: np.random.Generator, count: int) -> FloatArray:
        return stream.random(count)

    def _begin(self, lanes: NDArray[np.intp], drawn: FloatArray) -> None:
        self.which[lanes] = (drawn * len(self.values)).astype(np.int64)
        self.gates[lanes], self.angles[lanes] = -1, 0.0
        self.energy[lanes] = self.matrices[self.which[lanes], 0, 0]

    def _act(self, actions: NDArray[Any], running: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
        before = self._scores()
        lanes = np.flatnonzero(running)
        self.gates[lanes, self.step_count[lanes] - 1] = actions[lanes]
        self.angles[lanes], self.energy[lanes] = self.grown(
            self.which[lanes], self.gates[lanes], self.angles[lanes], self.step_count[lanes]
        )
        return self._scores() - before, np.zeros_like(running)

    def _seen(self) -> NDArray[np.float32]:
        count = self.options.qubits + len(self.pairs)
        circuit = (self.gates[:, :, None] == np.arange(count)).reshape(self.num_envs, -1)
        low, high = self.values[[0, -1]]
        place = (self.values[self.which] - low) / (high - low)
        return np.column_stack([circuit, place, self._scores()]).astype(np.float32)

    def _scores(self) -> FloatArray:
        result: FloatArray = np.clip(1.0 - self.above() / self.gap[self.which], 0.0, 1.0)
        return result

    def _metrics(self) -> dict[str, FloatArray]:
        return {"energy-error": self.above()}

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        count = self.options.qubits + len(self.pairs)
        return bool(
            np.isin(state["which"], range(len(self.values))).all()
            and np.isin(state["gates"], range(-1, count)).all()
            and np.isfinite(state["angles"]).all()
            and np.isfinite(state["energy"]).all()
        )


def _longer(
    envs: VQELanes, which: IntArray, gates: IntArray, angles: FloatArray, counts: IntArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return circuits (N * gates, steps) with each gate appended, their angles and energies (N * gates,)."""
    choices = int(envs.single_action_space.n)  # type: ignore[attr-defined]
    which, gates = which.repeat(choices), gates.repeat(choices, 0)
    angles, counts = angles.repeat(choices, 0), counts.repeat(choices)
    gates[np.arange(len(gates)), counts] = np.tile(np.arange(choices), len(gates) // choices)
    return gates, *envs.grown(which, gates, angles, counts + 1)


class GreedyGate:
    """The reference policy that appends the gate after which the energy is lowest, the first of several."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, VQELanes)

    def __call__(self, observations: NDArray[np.float32]) -> IntArray:
        """Return actions (L,)."""
        envs = self.envs
        counts = np.minimum(envs.step_count, envs.options.steps - 1)  # an ended lane's action means nothing
        _, _, reached = _longer(envs, envs.which, envs.gates, envs.angles, counts)
        best: IntArray = np.argmin(reached.reshape(envs.num_envs, -1).round(9), axis=1).astype(np.int64)
        return best


class BestCircuit:
    """The reference policy that plays the best circuit that a beam search finds for each Hamiltonian.

    The search goes on from the 1024 lowest energies of each length, with one circuit each: circuits of one energy
    mostly prepare the same state or its mirror image, and would crowd out the others. It reaches the ground states of
    `vqe-ising` and `vqe-h2`, which are optima. Otherwise it is the best known.
    """

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, VQELanes)
        self._plan = _searched(self.envs.options)

    def __call__(self, observations: NDArray[np.float32]) -> IntArray:
        """Return actions (L,)."""
        steps = np.minimum(self.envs.step_count, self.envs.options.steps - 1)
        result: IntArray = self._plan[self.envs.which, steps]
        return result


@cache
def _searched(options: VQEOptions) -> IntArray:
    """Return the best known circuits, (K, steps)."""
    envs = VQELanes(options, 1)
    plan = []
    for k in range(len(envs.values)):
        gates = np.full((1, options.steps), -1, np.int64)
        angles, reached = np.zeros((1, options.steps)), np.zeros(1)
        for step in range(options.steps):
            _, order = np.unique(reached.round(9), return_index=True)
            order = order[:KEPT]
            size = len(order)
            gates, angles, reached = _longer(
                envs, np.full(size, k), gates[order], angles[order], np.full(size, step)
            )
        plan.append(gates[int(np.argmin(reached))])
    return np.stack(plan)
