"""Masks of allowed actions, if an environment has them (`infos["action_mask"]`, see `qrlsuite.environment`).

An algorithm keeps the mask of an observation behind it, in one tensor (S, B, obs + choices): so it is stored, drawn
from a buffer and saved with the observation. Without masks nothing is appended or computed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from qrlsuite import population as populations
from qrlsuite.seeding import Streams

FORBIDDEN = -1e30
"""The output of a choice that is forbidden: below any other, and yet no infinity, whose products are NaN."""

NOTHING: Mapping[str, Any] = {}
"""Infos of lanes without masks."""


def behind(observations: Tensor, infos: Mapping[str, Any], arrived: bool = False) -> Tensor:
    """Return observations (S, B, obs) with the lanes' masks behind them (S, B, obs + choices), if there are masks.

    Parameters
    ----------
    infos:
        The lanes' infos on the observations, lane by lane or by seed.
    arrived:
        Whether the observations are where steps arrived, before any reset (`qrlsuite.environment.arrived`).
    """
    if "action_mask" not in infos:
        return observations
    mask = np.asarray(infos["action_mask"], np.bool_)
    if arrived and "final_obs" in infos:
        final = infos["final_info"].get("action_mask", np.ones_like(mask))
        mask = np.where(np.asarray(infos["_final_obs"], np.bool_)[:, None], final, mask)
    flags = torch.from_numpy(mask.astype(np.float32)).to(observations.device)
    return torch.cat([observations, flags.view(*observations.shape[:2], -1)], 2)


def observed(seen: Tensor, inputs: int) -> Tensor:
    """Return the observations (S, B, inputs) in a result of `behind`."""
    return seen if seen.shape[-1] == inputs else seen[..., :inputs].contiguous()


def masked(outputs: Tensor, seen: Tensor, inputs: int) -> Tensor:
    """Return outputs (S, B, choices) whose forbidden choices are least; `seen` has the mask behind `inputs` values.

    The argmax never is a forbidden choice, not even with noise, and a softmax gives them 0.
    """
    if seen.shape[-1] == inputs:
        return outputs
    return torch.where(seen[..., inputs:] > 0, outputs.clamp(min=FORBIDDEN / 2), FORBIDDEN)


def best(population: nn.Module, seen: Tensor, inputs: int) -> Tensor:
    """Return the index of the largest output (S, B) that `seen` allows, the first of equal ones."""
    if seen.shape[-1] == inputs:
        return populations.best(population, seen)
    with torch.no_grad():
        return masked(population(observed(seen, inputs)), seen, inputs).argmax(2)


def drawn(
    actions: Tensor, seen: Tensor, inputs: int, streams: Sequence[Streams], epoch: int, step: int
) -> Tensor:
    """Return uniform actions (S, B) unchanged, or uniform ones among the allowed actions if some are forbidden."""
    if seen.shape[-1] == inputs:
        return actions
    free = seen[..., inputs:] > 0
    numbers = [each.numpy(f"among the free {step}", epoch).random(actions.shape[1]) for each in streams]
    rank = (torch.from_numpy(np.stack(numbers)).to(seen.device) * free.sum(-1)).floor()
    return (free.cumsum(-1) <= rank[..., None]).sum(-1)
