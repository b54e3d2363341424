"""Names the plugins an entry needs that are not installed here; the entry is ranked from its stored curves."""

from __future__ import annotations

from qrlsuite import registry, specs
from qrlsuite.leaderboard.shelf.curves import EntryResults


def absent(entry: EntryResults) -> list[str]:
    """Name the parts that an entry needs for further training and nothing registers: `model 'fourier'`."""
    if entry.external:
        return []
    registered = registry.load()
    used: list[tuple[type[specs.Spec], str]] = [
        (specs.EnvironmentSpec, entry.task_file.environment.name),
        (specs.AlgorithmSpec, entry.algorithm),
        (specs.ModelSpec, entry.model),
    ]
    # an option named like a kind (`ansatz`) names a registered thing
    options = entry.identity.get("model_options", {})
    if isinstance(options, dict):
        used += [(s, options[s.kind]) for s in specs.KINDS.values() if isinstance(options.get(s.kind), str)]
    return [specs.title(kind, name) for kind, name in used if name not in registered.of(kind)]
