"""A task of qiskit-gym: undo a random Clifford with few gates.

    pip install qiskit-gym
    qrlsuite run "mlp width=64" --plugin extras/environments/qiskit_clifford.py --task qiskit-clifford

The package (https://github.com/AI4quantum/qiskit-gym, written for version 0.4.2) draws its Cliffords from a generator
that `reset(seed=...)` does not reach. Here they follow the seed.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from qiskit import QuantumCircuit
from qiskit_gym.envs import CliffordGym


class QiskitClifford(gymnasium.Env[Any, Any]):
    """A Clifford of `gates` random gates (H, S, and CX along a line) becomes the identity within `steps` gates.

    An observation is the tableau without phases (2 qubits, 2 qubits), of 0 and 1, as the package shows it. The reward
    is 1 at the identity, where an episode ends, and 0 before.
    """

    metadata = {"render_modes": []}

    def __init__(self, qubits: int = 3, gates: int = 4, steps: int = 16) -> None:
        line = [(q, q + 1) for q in range(qubits - 1)]
        names = ("H", "S", "CX")
        self.theirs = CliffordGym.from_coupling_map(
            line, names, max_depth=2 * steps, add_inverts=False, add_perms=False
        )
        self.qubits, self.gates, self.steps = qubits, gates, steps
        self.observation_space, self.action_space = self.theirs.observation_space, self.theirs.action_space

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[NDArray[np.int8], dict[str, Any]]:
        """Draw a target from the seed's stream."""
        super().reset(seed=seed)
        target = QuantumCircuit(self.qubits)
        known = self.theirs.config["gateset"]
        for number in self.np_random.integers(len(known), size=self.gates):
            name, wires = known[number]
            getattr(target, name.lower())(*wires)
        seen, _ = self.theirs.reset()
        self.theirs.set_state(self.theirs.get_state(target))
        seen[:] = 0
        seen.flat[self.theirs.observe()] = 1
        self.seen, self.count = seen, 0
        return seen, {}

    def step(self, action: int) -> tuple[NDArray[np.int8], float, bool, bool, dict[str, Any]]:
        """Append a gate."""
        self.count += 1
        solved = self.theirs.is_final()  # a target may be the identity
        if not solved:
            self.seen, _, solved, _, _ = self.theirs.step(action)
        return self.seen.copy(), float(solved), solved, self.count >= self.steps, {}
