"""Names the plugins an entry needs that are not installed here; the entry is ranked from its stored curves."""

from __future__ import annotations

from qrlsuite import registry
from qrlsuite.leaderboard.shelf.curves import EntryResults


def absent(entry: EntryResults) -> list[str]:
    """Return what would be needed to train an entry further and nothing registers, in words: `model 'fourier'`."""
    known = registry.load().entries
    used = [
        ("environments", entry.task_file.environment.name),
        ("algorithms", entry.algorithm),
        ("models", entry.model),
    ]
    # an option named like a kind (`ansatz`) names a registered thing
    options = entry.identity.get("model_options", {})
    used += [
        (kind, options[word])
        for kind, word in registry.SINGULAR.items()
        if isinstance(options, dict) and isinstance(options.get(word), str)
    ]
    return [f"{registry.SINGULAR[kind]} {name!r}" for kind, name in used if name not in known[kind]]
