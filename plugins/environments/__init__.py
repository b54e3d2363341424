"""Built-in environments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import EnvironmentSpec, PictureSpec

_HERE = "qrlsuite.plugins.environments"
_BEAM6G = f"{_HERE}.beam6g"
_QUANTUM = f"{_HERE}.quantum"

_EPISODE = PictureSpec(
    name="episode",
    summary="an episode of a quantum task, as its best known policy plays it",
    draw=f"{_QUANTUM}.episode:episode",
    options=f"{_QUANTUM}.episode:EpisodeOptions",
)


@hookimpl
def register_environments(register: Callable[[EnvironmentSpec], None]) -> None:
    """Register the built-in environments, and whatever else Gymnasium knows."""
    register(
        EnvironmentSpec(
            name="beam6g",
            summary="BeamManagement6G: choose the antenna that serves a moving user best",
            options=f"{_BEAM6G}.options:BeamOptions",
            gymnasium_id="qrlsuite/BeamManagement6G-v1",
            entry_point=f"{_BEAM6G}.env:BeamManagement6G",
            vector=f"{_BEAM6G}.vector:make_vector",
            device=f"{_BEAM6G}.device:BeamOnDevice",
            policies={
                "optimal": f"{_BEAM6G}.policies:Optimal",
                "nearest antenna": f"{_BEAM6G}.policies:NearestAntenna",
            },
            views=("stack",),
            pictures=(
                PictureSpec(
                    name="trajectories",
                    summary="random paths of the user, by degree",
                    draw=f"{_BEAM6G}.pictures:trajectories",
                    options=f"{_BEAM6G}.pictures:TrajectoryOptions",
                ),
                PictureSpec(
                    name="field",
                    summary="the best antenna of every place, and its intensity",
                    draw=f"{_BEAM6G}.pictures:field",
                    options=f"{_BEAM6G}.pictures:FieldOptions",
                ),
            ),
        )
    )
    register(
        EnvironmentSpec(
            name="beam-angle",
            summary="BeamAngle: steer one antenna's beam after a moving user, by its angle",
            options=f"{_BEAM6G}.angle:AngleOptions",
            gymnasium_id="qrlsuite/BeamAngle-v1",
            entry_point=f"{_BEAM6G}.angle:BeamAngle",
            vector=f"{_BEAM6G}.angle:AngleLanes",
            policies={
                "optimal": f"{_BEAM6G}.angle:BestAngle",
                "same angle": f"{_BEAM6G}.angle:SameAngle",
            },
            views=("stack",),
        )
    )
    register(
        _in_lanes(
            f"{_HERE}.room:Room",
            "Room: find the goal in a walled room, seen as an image",
            {"shortest way": "ShortestWay"},
            views=("view", "sight"),
        )
    )
    register(
        _in_lanes(
            f"{_HERE}.cartpole:CartPole",
            "CartPole-v1: balance a pole on a cart; 500 steps at most",
            device=f"{_HERE}.ondevice:CartPoleOnDevice",
        )
    )
    register(
        _in_lanes(
            f"{_HERE}.pong:Pong",
            "Pong: play against an opponent that follows the ball",
            {"steep returns": "SteepReturns", "follows the ball": "Follower"},
        )
    )
    register(
        EnvironmentSpec(
            name="planted",
            summary="Planted: classify points as a hidden circuit of 2 qubits does",
            options=f"{_HERE}.planted:PlantedOptions",
            gymnasium_id="qrlsuite/Planted-v1",
            entry_point=f"{_HERE}.planted:Planted",
            made_for="quantum",
        )
    )
    register(
        _in_lanes(
            f"{_QUANTUM}.pulse:Pulse",
            "Pulse: bring one or two qubits into a state by fields",
            {"best pulse": "BestPulse", "greedy": "GreedyPulse"},
            pictures=(_EPISODE,),
        )
    )
    register(
        _in_lanes(
            f"{_QUANTUM}.clifford:Clifford",
            "Clifford: write a Clifford operation as a circuit of few gates",
            {"shortest circuit": "ShortestCircuit", "greedy": "GreedyCircuit"},
            device=f"{_HERE}.ondevice:CliffordOnDevice",
            pictures=(_EPISODE,),
        )
    )
    register(
        _in_lanes(
            f"{_QUANTUM}.vqe:VQE",
            "VQE: grow a circuit whose state has a low energy",
            {"best circuit": "BestCircuit", "greedy": "GreedyGate"},
            pictures=(_EPISODE,),
        )
    )
    register(
        _in_lanes(
            f"{_QUANTUM}.channel:Channel",
            "Channel: find out by experiments which error a qubit suffers",
            {"most informative": "Informative", "in turn": "InTurn"},
            device=f"{_HERE}.ondevice:ChannelOnDevice",
            pictures=(_EPISODE,),
        )
    )
    register(
        EnvironmentSpec(
            name="gym",
            summary="any environment of Gymnasium, by its id",
            options=f"{_HERE}.gym:GymOptions",
            gymnasium_id="CartPole-v1",
            vector=f"{_HERE}.gym:make_vector",
        )
    )


def _in_lanes(
    entry_point: str, summary: str, policies: Mapping[str, str] | None = None, **more: Any
) -> EnvironmentSpec:
    """Return the spec of an environment `MODULE:NAME` with `NAMEOptions` and `NAMELanes` in its module."""
    module, name = entry_point.split(":")
    return EnvironmentSpec(
        name=name.lower(),
        summary=summary,
        options=f"{entry_point}Options",
        gymnasium_id=f"qrlsuite/{name}-v1",
        entry_point=entry_point,
        vector=f"{entry_point}Lanes",
        policies={called: f"{module}:{policy}" for called, policy in (policies or {}).items()},
        **more,
    )
