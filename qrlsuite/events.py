"""Run events for trackers: a tracker that fails is reported once and never stops a run."""

from __future__ import annotations

import logging
from typing import Any

import pluggy

log = logging.getLogger("qrlsuite")


class EventSink:
    """Sends `run_started`, `epoch_finished` and `run_finished` to every plugin that listens."""

    def __init__(self, manager: pluggy.PluginManager) -> None:
        self.manager = manager
        self._failed: set[str] = set()

    def send(self, event: str, **content: Any) -> None:
        """Call a run event's hook in each plugin on its own."""
        for implementation in getattr(self.manager.hook, event).get_hookimpls():
            name = str(implementation.plugin_name)
            if name in self._failed:
                continue
            try:
                implementation.function(*[content[argument] for argument in implementation.argnames])
            except Exception as error:
                self._failed.add(name)
                log.warning(
                    "tracker '%s' failed in %s and is left out: %s: %s",
                    name,
                    event,
                    type(error).__name__,
                    error,
                )
