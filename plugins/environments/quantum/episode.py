"""The picture `episode` of the quantum tasks: an episode as a reference policy plays it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.figure import Figure
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qrlsuite.plugins.environments.quantum import channel, clifford, pictures, pulse, vqe

PLAYED: dict[type[Any], tuple[Any, dict[str, Any]]] = {
    pulse.PulseOptions: (pulse.Pulse, {"best": pulse.BestPulse, "greedy": pulse.GreedyPulse}),
    clifford.CliffordOptions: (
        clifford.Clifford,
        {"best": clifford.ShortestCircuit, "greedy": clifford.GreedyCircuit},
    ),
    vqe.VQEOptions: (vqe.VQE, {"best": vqe.BestCircuit, "greedy": vqe.GreedyGate}),
    channel.ChannelOptions: (channel.Channel, {"best": channel.Informative, "greedy": channel.InTurn}),
}


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class EpisodeOptions:
    """Settings of the picture."""

    policy: Annotated[
        Literal["best", "greedy"],
        Field(description="policy that plays: the best known one, or the greedy one (of channel: in turn)"),
    ] = "best"
    seed: Annotated[int, Field(ge=0, description="the same seed draws the same episode")] = 0


def episode(worlds: Mapping[str, Any], options: EpisodeOptions) -> Figure:
    """Draw the end of an episode of each task."""
    drawn = []
    for world in worlds.values():
        make, policies = PLAYED[type(world)]
        env = make(**dataclasses.asdict(world))
        seen, _ = env.reset(seed=options.seed)
        act, ended = policies[options.policy](env.lanes), False
        while not ended:
            seen, _, terminated, truncated, _ = env.step(act(seen[None])[0])
            ended = terminated or truncated
        drawn.append(env.figure())
    if len(drawn) == 1:
        return drawn[0]  # type: ignore[no-any-return]
    images = [pictures.pixels(each) for each in drawn]
    heights = [image.shape[0] for image in images]
    together = pictures.figure(max(image.shape[1] for image in images) / 100, sum(heights) / 100)
    for axes, image in zip(np.ravel(together.subplots(len(images), 1, height_ratios=heights)), images):
        axes.imshow(image)
        axes.set_axis_off()
    return together
