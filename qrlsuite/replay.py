"""Replay: the last transitions of S seeds, and batches drawn from them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import torch
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
    """

    def __init__(self, seeds: int, capacity: int, device: torch.device, **columns: int) -> None:
        self.columns = columns
        self.rows = torch.zeros((seeds, capacity, sum(columns.values())), device=device)
        self._stored = 0
        self._count = None if self.rows.is_cpu else torch.zeros((), dtype=torch.int64, device=device)
        """`stored` on the device, where rounds read it."""
        self._borders = [0, *itertools.accumulate(columns.values())]
        blocks = list(zip(self._borders, columns.values()))
        self._starts, self._within, self._widths = np.array(
            [(first, column, width) for first, width in blocks for column in range(width)], np.uint64
        ).T.copy()

    @property
    def stored(self) -> int:
        """Rows ever stored, per seed."""
        return self._stored

    @stored.setter
    def stored(self, rows: int) -> None:
        self._stored = rows
        if self._count is not None:
            self._count.fill_(rows)

    @property
    def filled(self) -> int:
        """Rows that each seed holds now."""
        return min(self.stored, self.rows.shape[1])

    def add(self, **values: Tensor) -> None:
        """Store E rows of every seed, over the oldest ones: each quantity (S, E, numbers), or (S, E)."""
        capacity, new = self.rows.shape[1], len(values[next(iter(self.columns))][0])
        place = self.stored % capacity
        if place + new <= capacity and self.rows.is_cpu:
            held = self.rows.numpy()[:, place : place + new]
            for name, first, end in zip(self.columns, self._borders, self._borders[1:]):
                held[:, :, first:end] = values[name].detach().numpy().reshape(len(held), new, -1)
        else:
            parts = [values[name].to(torch.float32) for name in self.columns]
            both = torch.cat([part if part.dim() == 3 else part[..., None] for part in parts], dim=2)
            start: int | Tensor = self._stored if self._count is None else self._count
            self.rows[:, (start + torch.arange(new, device=self.rows.device)) % capacity] = both
        self._stored += new
        if self._count is not None:
            self._count += new

    def batch(self, draws: Tensor) -> dict[str, Tensor]:
        """Return rows of every seed, each quantity (S, B, numbers), contiguous.

        Parameters
        ----------
        draws:
            (S, B) float64, uniform in [0, 1): they choose stored rows, with replacement.
        """
        filled = self.filled if self._count is None else self._count.clamp(max=self.rows.shape[1])
        return self.at((draws * filled).to(torch.int64))

    def at(self, places: Tensor) -> dict[str, Tensor]:
        """Return the rows at `places` (S, B) of every seed, as `batch` does."""
        seeds, capacity, numbers = self.rows.shape
        if self.rows.is_cpu:
            return self._picked(places)
        offset = torch.arange(seeds, device=self.rows.device)[:, None] * capacity
        found = self.rows.view(-1, numbers)[(places + offset).reshape(-1)].view(seeds, -1, numbers)
        parts = torch.split(found, list(self.columns.values()), dim=2)
        return {name: part.contiguous() for name, part in zip(self.columns, parts)}

    def _picked(self, places: Tensor) -> dict[str, Tensor]:
        """Like `at`, by one compiled loop."""
        from qrlsuite.compiled.networks import pick

        seeds, batch = places.shape
        samples, parts = seeds * batch, {}
        out, first = np.empty(samples * self._borders[-1], np.float32), 0
        begin = self._starts * np.uint64(samples) + self._within
        rows = self.rows.view(-1).numpy()
        pick(rows, self.rows.shape[1], places.contiguous().numpy(), begin, self._widths, out)
        for (name, width), end in zip(self.columns.items(), self._borders[1:]):
            parts[name] = torch.from_numpy(out[first : samples * end].reshape(seeds, batch, width))
            first = samples * end
        return parts

    def state_dict(self) -> dict[str, Tensor]:
        """Return rows and counts, seed-first."""
        return {"rows": self.rows, "stored": torch.full((len(self.rows),), self.stored, dtype=torch.int64)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of `state_dict`."""
        self.rows.copy_(state["rows"])
        self.stored = int(state["stored"][0])
