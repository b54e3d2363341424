"""Writes the task files `beam6g-a{2..5}-{0..4}.toml` of the random placements, beside this module:

python -m qrlsuite.tasks.placements
"""

from __future__ import annotations

from pathlib import Path

from qrlsuite.plugins.environments.beam6g.placements import COUNTS, PER_COUNT, SEED, placement

TEMPLATE = """\
# Random placement a{antennas}-{index}. The paper's own instances were never published: these numbers are ours, drawn
# by the paper's rule with seed ({seed}, {antennas}, {index}). Written by `python -m qrlsuite.tasks.placements`.
format_version = 1
name = "beam6g-a{antennas}-{index}"
summary = "Beam management with {antennas} antennas at random, placement {index} of 0 to {last} (ours)"
default_algorithm = "ddqn"
default_preset = "released"

[environment]
name = "beam6g"

[environment.options]
# Antennas as ((x, y), (orientation x, orientation y)).
antennas = [
{rows}
]
# Number of support points of the user's path.
degree = 3
# Steps of an episode.
steps = 200

[protocol]
# Independent runs of a complete entry.
seeds = 100
# Epochs of a complete run; PPO needs more.
epochs = 100
algorithm_epochs = {{ ppo = 500 }}
# Training environments per seed, and steps per epoch of all of them together: 10 episodes of 200 steps.
environments = 10
interactions = 2000
# Fresh greedy episodes after every epoch; V is the mean of their scores.
validation_episodes = 100

[score]
# The environment's own score: received over optimal sum.
source = "info"

[ranking]
# The paper's grid for random placements, the cell shown first, and the steps at which sample complexity is
# capped (100 epochs of DDQN, 500 of PPO).
epsilons = [0.30, 0.20, 0.10]
deltas = [0.5, 0.75]
reference = {{ epsilon = 0.20, delta = 0.75 }}
horizons = [200_000, 1_000_000]

# What the released code does (it made the published results).
[presets.released.ddqn.all]
gamma = 0.95
lr = 5e-4
quantum_lr = 1e-3
epsilon = 0.1
buffer = 2000
batch = 64
target_steps = 2000

# What the text says: half the buffer, target copied twice as often.
[presets.text.ddqn.all]
gamma = 0.95
lr = 5e-4
quantum_lr = 1e-3
epsilon = 0.1
buffer = 1000
batch = 64
target_steps = 1000
"""


def files() -> dict[str, str]:
    """Return the content of every task file by its name."""
    found = {}
    for antennas in COUNTS:
        for index in range(PER_COUNT):
            rows = "\n".join(
                f"    [[{x}, {y}], [{u}, {v}]]," for (x, y), (u, v) in placement(antennas, index)
            )
            found[f"beam6g-a{antennas}-{index}.toml"] = TEMPLATE.format(
                antennas=antennas, index=index, seed=SEED, last=PER_COUNT - 1, rows=rows
            )
    return found


if __name__ == "__main__":
    for name, content in files().items():
        (Path(__file__).parent / name).write_text(content, encoding="utf-8")
