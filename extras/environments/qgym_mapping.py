"""A task of qgym: say which physical qubit holds which qubit of a circuit.

    pip install qgym
    qrlsuite run "ppo mlp width=64" --plugin extras/environments/qgym_mapping.py --task qgym-mapping

The package (van der Linde et al. 2023, arXiv:2308.02536; written for version 0.3.1) draws its circuits from a generator
that `reset(seed=...)` does not reach, and changes observations that it has given. Here circuits follow the seed, and an
episode ends.
"""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import networkx
from qgym.envs import InitialMapping


class QgymMapping(gymnasium.Env[Any, Any]):
    """A random graph of `qubits` circuit qubits that interact is mapped to a line of physical qubits.

    Observations, actions and rewards are the package's. An action is a pair of a physical and a circuit qubit. It earns
    -100 if one of them is mapped already, else 5 for each mapped interaction on the line and -1 for each off it.
    """

    metadata = {"render_modes": []}

    def __init__(self, qubits: int = 4, steps: int = 20) -> None:
        self.theirs = InitialMapping(connection_graph=networkx.path_graph(qubits))
        self.qubits, self.steps = qubits, steps
        self.observation_space, self.action_space = self.theirs.observation_space, self.theirs.action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Draw a graph of interactions from the seed's stream."""
        super().reset(seed=seed)
        number = int(self.np_random.integers(2**31))
        graph = networkx.gnp_random_graph(self.qubits, 0.5, seed=number)
        seen, _ = self.theirs.reset(options={"interaction_graph": graph})
        self.count = 0
        return copy.deepcopy(seen), {}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Assign a qubit."""
        self.count += 1
        seen, reward, ended, _, _ = self.theirs.step(action)
        return copy.deepcopy(seen), float(reward), bool(ended), self.count >= self.steps, {}
