"""Built-in environments."""

from __future__ import annotations

from collections.abc import Callable

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
        EnvironmentSpec(
            name="room",
            summary="Room: find the goal in a walled room, seen as an image",
            options=f"{_HERE}.room:RoomOptions",
            gymnasium_id="qrlsuite/Room-v1",
            entry_point=f"{_HERE}.room:Room",
            vector=f"{_HERE}.room:RoomLanes",
            policies={"shortest way": f"{_HERE}.room:ShortestWay"},
            views=("view", "sight"),
        )
    )
    register(
        EnvironmentSpec(
            name="cartpole",
            summary="CartPole-v1: balance a pole on a cart; 500 steps at most",
            options=f"{_HERE}.cartpole:CartPoleOptions",
            gymnasium_id="qrlsuite/CartPole-v1",
            entry_point=f"{_HERE}.cartpole:CartPole",
            vector=f"{_HERE}.cartpole:CartPoleLanes",
        )
    )
    register(
        EnvironmentSpec(
            name="pong",
            summary="Pong: play against an opponent that follows the ball",
            options=f"{_HERE}.pong:PongOptions",
            gymnasium_id="qrlsuite/Pong-v1",
            entry_point=f"{_HERE}.pong:Pong",
            vector=f"{_HERE}.pong:PongLanes",
            policies={
                "steep returns": f"{_HERE}.pong:SteepReturns",
                "follows the ball": f"{_HERE}.pong:Follower",
            },
        )
    )
    register(
        EnvironmentSpec(
            name="planted",
            summary="Planted: classify points as a hidden circuit of 2 qubits does",
            options=f"{_HERE}.planted:PlantedOptions",
            gymnasium_id="qrlsuite/Planted-v1",
            entry_point=f"{_HERE}.planted:Planted",
        )
    )
    register(
        EnvironmentSpec(
            name="pulse",
            summary="Pulse: bring one or two qubits into a state by fields",
            options=f"{_QUANTUM}.pulse:PulseOptions",
            gymnasium_id="qrlsuite/Pulse-v1",
            entry_point=f"{_QUANTUM}.pulse:Pulse",
            vector=f"{_QUANTUM}.pulse:PulseLanes",
            pictures=(_EPISODE,),
            policies={"best pulse": f"{_QUANTUM}.pulse:BestPulse", "greedy": f"{_QUANTUM}.pulse:GreedyPulse"},
        )
    )
    register(
        EnvironmentSpec(
            name="clifford",
            summary="Clifford: write a Clifford operation as a circuit of few gates",
            options=f"{_QUANTUM}.clifford:CliffordOptions",
            gymnasium_id="qrlsuite/Clifford-v1",
            entry_point=f"{_QUANTUM}.clifford:Clifford",
            vector=f"{_QUANTUM}.clifford:CliffordLanes",
            pictures=(_EPISODE,),
            policies={
                "shortest circuit": f"{_QUANTUM}.clifford:ShortestCircuit",
                "greedy": f"{_QUANTUM}.clifford:GreedyCircuit",
            },
        )
    )
    register(
        EnvironmentSpec(
            name="vqe",
            summary="VQE: grow a circuit whose state has a low energy",
            options=f"{_QUANTUM}.vqe:VQEOptions",
            gymnasium_id="qrlsuite/VQE-v1",
            entry_point=f"{_QUANTUM}.vqe:VQE",
            vector=f"{_QUANTUM}.vqe:VQELanes",
            pictures=(_EPISODE,),
            policies={"best circuit": f"{_QUANTUM}.vqe:BestCircuit", "greedy": f"{_QUANTUM}.vqe:GreedyGate"},
        )
    )
    register(
        EnvironmentSpec(
            name="channel",
            summary="Channel: find out by experiments which error a qubit suffers",
            options=f"{_QUANTUM}.channel:ChannelOptions",
            gymnasium_id="qrlsuite/Channel-v1",
            entry_point=f"{_QUANTUM}.channel:Channel",
            vector=f"{_QUANTUM}.channel:ChannelLanes",
            pictures=(_EPISODE,),
            policies={
                "most informative": f"{_QUANTUM}.channel:Informative",
                "in turn": f"{_QUANTUM}.channel:InTurn",
            },
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
