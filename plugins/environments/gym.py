"""The environment `gym`: any environment that Gymnasium knows, by its id."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Any

from pydantic import ConfigDict, Field, field_validator
from pydantic.dataclasses import dataclass

from qrlsuite.environment import LaneEnv
from qrlsuite.errors import OptionError
from qrlsuite.gymlanes import GymLanes, specification
from qrlsuite.normalization import KIND, Kind
from qrlsuite.options import Since

_OWN = {
    "id": "the option id",
    "max_episode_steps": "the option max_episode_steps",
    "disable_env_checker": "nothing: it is always left out",
    "render_mode": "nothing: training does not render",
}
"""Arguments of `gymnasium.make` that are no free arguments here, and what to use instead."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class GymOptions:
    """Options of `gym`."""

    id: Annotated[
        str, Field(description="id for gymnasium.make: Acrobot-v1, or MODULE:ID of another package")
    ] = "CartPole-v1"
    arguments: Annotated[
        dict[str, Any], Field(description="further arguments of gymnasium.make, { map_name = '8x8' }")
    ] = field(default_factory=dict)
    max_episode_steps: Annotated[
        int | None, Field(ge=1, le=100_000, description="time limit; absent: the environment's own")
    ] = None
    normalization: Annotated[Kind, Field(description=KIND)] = "none"
    low: Annotated[
        tuple[float, ...] | None, Field(description="values mapped to -1 by bounds; absent: the box's own")
    ] = None
    high: Annotated[
        tuple[float, ...] | None, Field(description="values mapped to 1 by bounds; absent: the box's own")
    ] = None
    observe: Annotated[
        tuple[int, ...] | None,
        Field(description="places of an observation's values that are shown, [0, 2]; absent: all"),
        Since("0.2.0"),
    ] = None

    @field_validator("id")
    @classmethod
    def _id(cls, env_id: str) -> str:
        try:
            specification(env_id)
        except OptionError as error:
            raise ValueError(str(error)) from None
        return env_id

    @field_validator("arguments")
    @classmethod
    def _arguments(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        for name in arguments:
            if name in _OWN:
                raise ValueError(f"'{name}' cannot be given here; use {_OWN[name]}")
        return arguments


def make_vector(options: GymOptions, num_envs: int) -> LaneEnv:
    """Return `num_envs` lanes of the environment `options.id`."""
    arguments = dict(options.arguments)
    if options.max_episode_steps is not None:
        arguments["max_episode_steps"] = options.max_episode_steps
    return GymLanes(
        options.id, num_envs, arguments, options.normalization, options.low, options.high, options.observe
    )
