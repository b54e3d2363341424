"""Replay: the last transitions of S seeds, and batches drawn from them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class Replay:
    """A replay buffer: a ring of rows for each of S seeds, all filled alike.

    Parameters
    ----------
    seeds, capacity:
        S, and the rows that each seed holds at most.
    device:
        Where they are.
    columns:
        How many numbers of a row each quantity takes, by name: `observation=3, action=1, reward=1`.

    Attributes
    ----------
    rows:
        (S, capacity, numbers) float32; 0 where nothing was stored yet.
    count:
        `stored` on a device, where rounds read it; None on the CPU.
    stored:
        Rows ever stored, per seed.
    """

    def __init__(self, seeds: int, capacity: int, device: torch.device, **columns: int) -> None:
        self.columns = columns
        self.rows = torch.zeros((seeds, capacity, sum(columns.values())), device=device)
        self.stored = 0
        self.count = None if self.rows.is_cpu else torch.zeros((), dtype=torch.int64, device=device)
        self._borders = np.array([0, *itertools.accumulate(columns.values())])

    def resume(self, stored: int) -> None:
        """Go on after so many rows."""
        self.stored = stored
        if self.count is not None:
            self.count.fill_(stored)

    @property
    def filled(self) -> int:
        """Rows that each seed holds now."""
        return min(self.stored, self.rows.shape[1])

    def add(self, **values: Tensor | NDArray[Any]) -> None:
        """Store E rows of every seed, over the oldest ones: each quantity (S, E, numbers), or lanes (S E, ...)."""
        (seeds, capacity, _), widths = self.rows.shape, self.columns.values()
        given = [values[name] for name in self.columns]
        new = math.prod(given[0].shape) // seeds // int(self._borders[1])
        place = self.stored % capacity
        if place + new <= capacity and self.rows.is_cpu:
            held = self.rows.numpy()[:, place : place + new]
            for each, width, first in zip(given, widths, self._borders):
                part = each.numpy(force=True) if isinstance(each, Tensor) else each
                held[:, :, first : first + width] = part.reshape(seeds, new, width)
        else:
            both = torch.cat(
                [
                    torch.as_tensor(each).to(self.rows).reshape(seeds, new, width)
                    for each, width in zip(given, widths)
                ],
                2,
            )
            start: int | Tensor = self.stored if self.count is None else self.count
            self.rows[:, (start + torch.arange(new, device=self.rows.device)) % capacity] = both
        self.stored += new
        if self.count is not None:
            self.count += new

    def batch(self, draws: Tensor) -> dict[str, Tensor]:
        """Return rows of every seed, each quantity (S, B, numbers), contiguous.

        Parameters
        ----------
        draws:
            (S, B) float64, uniform in [0, 1): they choose stored rows, with replacement.
        """
        filled = self.filled if self.count is None else self.count.clamp(max=self.rows.shape[1])
        return self.at((draws * filled).to(torch.int64))

    def at(self, places: Tensor) -> dict[str, Tensor]:
        """Return the rows at `places` (S, B) of every seed, as `batch` does."""
        seeds, capacity, numbers = self.rows.shape
        if self.rows.is_cpu:
            found = self._picked(places.contiguous().numpy())
            return {name: torch.from_numpy(part) for name, part in found.items()}
        offset = torch.arange(seeds, device=self.rows.device)[:, None] * capacity
        rows = self.rows.view(-1, numbers)[(places + offset).reshape(-1)].view(seeds, -1, numbers)
        parts = torch.split(rows, list(self.columns.values()), dim=2)
        return {name: part.contiguous() for name, part in zip(self.columns, parts)}

    def arrays(self, draws: NDArray[np.float64]) -> dict[str, NDArray[np.float32]]:
        """Return what `batch` does, of a buffer on the CPU."""
        return self._picked((draws * self.filled).astype(np.int64))

    def _picked(self, places: NDArray[np.int64]) -> dict[str, NDArray[np.float32]]:
        """Return rows on the CPU, by one compiled loop."""
        from qrlsuite.compiled.networks import pick

        out, parts, end = np.empty(places.size * self.rows.shape[2], np.float32), {}, 0
        pick(self.rows.numpy(), places, self._borders, out)
        for name, width in self.columns.items():
            first, end = end, end + places.size * width
            parts[name] = out[first:end].reshape(*places.shape, width)
        return parts

    def state_dict(self) -> dict[str, Tensor]:
        """Return rows and counts, seed-first."""
        return {"rows": self.rows, "stored": torch.full((len(self.rows),), self.stored, dtype=torch.int64)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self.rows.copy_(state["rows"])
        self.resume(int(state["stored"][0]))
