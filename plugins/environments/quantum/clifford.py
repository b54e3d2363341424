"""Clifford: write a Clifford operation of two to four qubits as a circuit of few gates that the coupling map allows."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.environment import EpisodeLanes, LaneEnv, require_lanes
from qrlsuite.errors import OptionError
from qrlsuite.plugins.environments.quantum import pictures
from qrlsuite.plugins.environments.quantum.lanes import Drawn, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Coupling = Literal["line", "ring", "all"]
Gate = tuple[str, tuple[int, ...]]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CliffordOptions:
    """Options of Clifford."""

    qubits: Annotated[int, Field(ge=2, le=4, description="number of qubits")] = 2
    coupling: Annotated[
        Coupling,
        Field(description="between which qubits CX is allowed, in both directions: line, ring or all pairs"),
    ] = "line"
    scramble: Annotated[
        int,
        Field(ge=1, le=1000, description="most random gates that a target is made of; how many is uniform"),
    ] = 20
    steps: Annotated[int, Field(ge=1, le=1000, description="most gates of an episode")] = 20


def gates(options: CliffordOptions) -> list[Gate]:
    """Return the gates in the order of the actions: H and S of every qubit, and CX of every allowed pair."""
    n = options.qubits
    pairs = [
        (a, b)
        for a in range(n)
        for b in range(n)
        if a != b
        and (
            options.coupling == "all"
            or abs(a - b) == 1
            or (options.coupling == "ring" and {a, b} == {0, n - 1})
        )
    ]
    alone: list[Gate] = [(name, (q,)) for q in range(n) for name in ("H", "S")]
    return alone + [("CX", pair) for pair in pairs]


def matrices(options: CliffordOptions) -> IntArray:
    """Return each gate's action on Pauli words: its symplectic matrix (gates, 2n, 2n), bits.

    A word is a row of bits (x_1 .. x_n, z_1 .. z_n): X^x Z^z, without its sign. A gate maps the row v to v M, modulo 2.
    Aaronson and Gottesman, "Improved simulation of stabilizer circuits" (2004), give these rules.
    """
    n = options.qubits
    found = []
    for name, at in gates(options):
        matrix = np.eye(2 * n, dtype=np.int64)
        if name == "H":  # swaps x and z
            matrix[:, [at[0], n + at[0]]] = matrix[:, [n + at[0], at[0]]]
        elif name == "S":  # z += x
            matrix[at[0], n + at[0]] = 1
        else:  # CX: x of the target += x of the control, z of the control += z of the target
            matrix[at[0], at[1]] = matrix[n + at[1], n + at[0]] = 1
        found.append(matrix)
    return np.stack(found)


class Clifford(Drawn):
    """Write a Clifford operation as a circuit, gate by gate.

    ## Description

    A Clifford operation maps Pauli words to Pauli words. Up to signs, it is a symplectic matrix of bits: row k is the
    image of X_k, row n + k the image of Z_k. Signs are corrected by Pauli gates, which are free here; a global phase
    does not appear. The target of an episode is a product of random gates: their number is uniform in 1 .. `scramble`,
    each is drawn uniformly; where the product is the identity, a last gate is drawn again.

    The agent sees the remaining operation: the gates so far, undone, and then the target. When it is the identity,
    the gates in their order are a circuit for the target. There are 720 such matrices of two qubits,
    1,451,520 of three and 47,377,612,800 of four. For two and three all shortest circuits are known by exhaustion (the
    policy `shortest circuit`), for four no optimum is. Every target has a circuit of `scramble` gates or fewer.

    qiskit-gym (github.com/AI4quantum/qiskit-gym) has the like; code, rewards and targets are ours.

    ## Action Space

    `Discrete(gates)`: H and S of qubit 0, of qubit 1, ..., then CX of the allowed pairs (control, target), ascending.

    ## Observation Space

    `Box(0, 1, (4 n^2,), float32)`: the bits of the remaining matrix, row by row.

    ## Rewards

    1 - 0.9 t / `steps` for the last gate, the t-th, else 0.

    ## Episode End

    The episode is *terminated* when the operation is written, and *truncated* after `steps` gates. `info["score"]` is 1
    where it was written, else 0.

    Arguments are the fields of `CliffordOptions`.
    """

    lanes: CliffordLanes

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(CliffordLanes, CliffordOptions, options, render_mode)

    def moment(self) -> IntArray:
        """Return the remaining operation, (2n, 2n) bits."""
        left: IntArray = self.lanes.left[0].copy()
        return left

    def figure(self) -> Figure:
        """Return a figure of the circuit so far and the remaining operation."""
        options = self.lanes.options
        circuit = [self.lanes.gates[int(action)] for action in self.done]
        return pictures.clifford(circuit, self.shown[-1], options.qubits, options.steps)


class CliffordLanes(EpisodeLanes):
    """Vector form of `Clifford`; see there for spaces and rewards.

    Attributes
    ----------
    left:
        The remaining operation, (L, 2n, 2n) int64, bits.
    """

    name = "clifford"
    cut = True

    def __init__(self, options: CliffordOptions, num_envs: int) -> None:
        self.gates, self.matrices = gates(options), matrices(options)
        side = 2 * options.qubits
        observation = Box(0.0, 1.0, (side * side,), np.float32)
        super().__init__(options, num_envs, observation, Discrete(len(self.gates)))
        self.left = np.tile(np.eye(side, dtype=np.int64), (num_envs, 1, 1))

    def solved(self) -> NDArray[np.bool_]:
        """Return where nothing remains, (L,)."""
        result: NDArray[np.bool_] = (self.left == np.eye(self.left.shape[1])).all((1, 2))
        return result

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"left": self.left}

    def _draw(self, stream: np.random.Generator, count: int) -> FloatArray:
        return stream.random((count, 2 + self.options.scramble))

    def _begin(self, lanes: NDArray[np.intp], drawn: FloatArray) -> None:
        length = 1 + (drawn[:, 0] * self.options.scramble).astype(np.int64)
        chosen = (drawn[:, 1:] * len(self.gates)).astype(np.int64)
        left = np.tile(np.eye(self.left.shape[1], dtype=np.int64), (len(lanes), 1, 1))
        for k in range(self.options.scramble):
            left = np.where((k < length)[:, None, None], self.matrices[chosen[:, k]] @ left % 2, left)
        same = (left == np.eye(left.shape[1])).all((1, 2))
        left[same] = self.matrices[chosen[same, -1]]
        self.left[lanes] = left

    def _act(self, actions: NDArray[Any], running: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
        self.left[running] = (self.matrices[actions] @ self.left % 2)[running]
        solved = self.solved()
        return np.where(solved, 1.0 - 0.9 * self.step_count / self.options.steps, 0.0), solved

    def _seen(self) -> NDArray[np.float32]:
        return self.left.reshape(self.num_envs, -1).astype(np.float32)

    def _scores(self) -> FloatArray:
        return self.solved().astype(np.float64)

    def _possible(self, state: Mapping[str, NDArray[Any]]) -> bool:
        left, n = state["left"], self.options.qubits
        form = np.block([[np.zeros((n, n)), np.eye(n)], [np.eye(n), np.zeros((n, n))]])
        return bool(np.isin(left, (0, 1)).all() and (left @ form @ left.swapaxes(1, 2) % 2 == form).all())


def codes(left: IntArray) -> IntArray:
    """Return bits (..., 2n, 2n), n <= 3, as one whole number each."""
    flat = left.reshape(*left.shape[:-2], -1)
    result: IntArray = flat @ (1 << np.arange(flat.shape[-1], dtype=np.int64))
    return result


@cache
def distances(options: CliffordOptions) -> tuple[IntArray, NDArray[np.int8]]:
    """Return all operations of two or three qubits, by ascending `codes`, and the lengths of their shortest circuits.

    Breadth-first search from the identity: 720 operations, or 1,451,520 in some 20 seconds.
    """
    side, steps = 2 * options.qubits, matrices(options)
    border = np.eye(side, dtype=np.int64)[None]
    known, far = codes(border), np.zeros(1, np.int8)
    distance = 0
    while len(border):
        distance += 1
        reached = np.concatenate([border @ step % 2 for step in steps]).astype(np.int8)
        names, first = np.unique(codes(reached.astype(np.int64)), return_index=True)
        new = ~_member(names, known)
        border = reached[first[new]].astype(np.int64)
        order = np.argsort(both := np.concatenate([known, names[new]]))
        known = both[order]
        far = np.concatenate([far, np.full(int(new.sum()), distance, np.int8)])[order]
    return known, far


def _member(names: IntArray, known: IntArray) -> NDArray[np.bool_]:
    at = np.minimum(np.searchsorted(known, names), len(known) - 1)
    result: NDArray[np.bool_] = known[at] == names
    return result


class ShortestCircuit:
    """The reference policy that plays a shortest circuit, known by exhaustion: an optimum for two and three qubits."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, CliffordLanes)
        if self.envs.options.qubits == 4:
            raise OptionError("environment 'clifford': shortest circuits of four qubits are not known")
        self._known, self._far = distances(
            CliffordOptions(qubits=self.envs.options.qubits, coupling=self.envs.options.coupling)
        )

    def lengths(self, left: IntArray) -> NDArray[np.int8]:
        """Return the gates of the shortest circuits of operations (..., 2n, 2n)."""
        result: NDArray[np.int8] = self._far[np.searchsorted(self._known, codes(left))]
        return result

    def __call__(self, observations: NDArray[np.float32]) -> IntArray:
        """Return actions (L,)."""
        after = self.envs.matrices @ self.envs.left[:, None] % 2
        best: IntArray = np.argmin(self.lengths(after), axis=1).astype(np.int64)
        return best


class GreedyCircuit:
    """The reference policy that takes the first gate after which fewest bits differ from the identity."""

    def __init__(self, envs: LaneEnv) -> None:
        self.envs = require_lanes(envs, CliffordLanes)

    def __call__(self, observations: NDArray[np.float32]) -> IntArray:
        """Return actions (L,)."""
        after = self.envs.matrices @ self.envs.left[:, None] % 2
        wrong = (after != np.eye(after.shape[-1])).sum((2, 3))
        best: IntArray = np.argmin(wrong, axis=1).astype(np.int64)
        return best
