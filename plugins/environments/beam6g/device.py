"""BeamManagement6G on a device: whole episodes as tables there, so that a step is one look-up."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qrlsuite.device import DeviceLanes
from qrlsuite.plugins.environments.beam6g.physics import BEAMS


class BeamOnDevice(DeviceLanes):
    """`BeamLanes` by torch operations, with their tables; all lanes are at the same step of their episodes."""

    def draw(self, steps: int) -> dict[str, Any]:
        """Return the tables and first observations of this episode and of those that begin within so many steps."""
        lanes, whole = self.lanes, self.lanes.options.steps
        ahead, now = copy.deepcopy(lanes), lanes.state_dict()
        last = int(now["step"][0]) + steps
        tables, starts = [lanes.tabulate()], [now["observations"]]
        for number in range(1, last // whole + 1 if lanes.autoreset else 1):
            ahead.restart()
            starts.append(ahead.state_dict()["observations"])
            if number * whole < last:
                tables.append(copy.deepcopy(ahead.tabulate()))
        antennas = len(lanes.options.antennas)
        return {
            "intensity": np.concatenate([each.intensity for each in tables]),
            "beam": np.concatenate([each.beam for each in tables]),
            "starts": np.stack(starts),
            "antenna": np.arange(antennas) / (antennas - 1),
            "lane": np.arange(lanes.num_envs),
            "episode": np.zeros(lanes.num_envs, np.int64),
            "step": now["step"],
            "observations": now["observations"],
        }

    def act(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look up what the antennas `actions` (L,) give the users at their next positions."""
        state, lane, k = self.state, self.state["lane"], self.state["step"] + 1
        _, antennas, places = state["intensity"].shape
        place = ((state["episode"] * len(lane) + lane) * antennas + actions) * places + k
        rewards = state["intensity"].view(-1)[place]
        beam = state["beam"].view(-1)[place].double() / (
            BEAMS - 1
        )  # a power of two, so exact on every device
        newest = torch.stack([state["antenna"][actions], rewards, beam], 1).float()
        arrived = torch.cat([state["observations"][:, 3:], newest], 1)
        ended = k == places - 1
        following = (state["episode"] + ended).clamp(max=len(state["starts"]) - 1)
        state["observations"].copy_(torch.where(ended[:, None], state["starts"][following, lane], arrived))
        state["step"].copy_(torch.where(ended, 0, k))
        state["episode"].copy_(following.clamp(max=len(state["intensity"]) // len(lane) - 1))
        return arrived, rewards, ended
