"""Options of BeamManagement6G, the keyword arguments of `gymnasium.make` and the keys of a task file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import ConfigDict, Field, field_validator
from pydantic.dataclasses import dataclass

from qrlsuite.options import build
from qrlsuite.plugins.environments.beam6g.physics import FIELD, Antenna, Name
from qrlsuite.plugins.environments.beam6g.trajectory import Rejection

MAIN: tuple[Antenna, ...] = (
    ((1.5, 1.0), (1.0, 0.0)),
    ((1.5, 5.0), (-1.0, 0.0)),
    ((4.5, 3.0), (0.0, 1.0)),
)
"""The paper's standard instance, `a3-main`."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class BeamOptions:
    """Options of BeamManagement6G."""

    antennas: Annotated[
        tuple[Antenna, ...],
        Field(
            description="at least two antennas ((x, y), (d_x, d_y)): position in [0, 6] x [0, 6], in units "
            "of the model, and orientation, normalized to length 1"
        ),
    ] = MAIN
    degree: Annotated[
        int,
        Field(description="number of support points of a trajectory, 2 to 32: the higher, the more curved"),
    ] = 3
    steps: Annotated[int, Field(ge=1, le=100_000, description="actions per episode, the horizon")] = 200
    physics: Annotated[
        Name,
        Field(description="released: as in the paper's code, 1/R^4; text: as in the paper's text, 1/R^2"),
    ] = "released"
    rejection: Annotated[
        Rejection,
        Field(
            description="tolerant: keep every path within 1e-9 of the field; released: also reject paths by "
            "the rounding error at their first point, as the paper's code does (slow)"
        ),
    ] = "tolerant"
    stack: Annotated[
        int, Field(ge=1, le=1000, description="number of last observations that make one, the oldest first")
    ] = 1

    @field_validator("antennas")
    @classmethod
    def _antennas(cls, antennas: tuple[Antenna, ...]) -> tuple[Antenna, ...]:
        if len(antennas) < 2:
            raise ValueError(
                "at least 2 are needed: the action is the choice of an antenna, and "
                "the observation divides its index by their number minus one"
            )
        return tuple(checked(i, antenna) for i, antenna in enumerate(antennas))

    @field_validator("degree")
    @classmethod
    def _degree(cls, degree: int) -> int:
        if degree < 2:
            raise ValueError("at least 2 is needed: a path has a first and a last support point")
        if degree > 32:
            raise ValueError("at most 32 is allowed: there only 2 percent of random paths stay in the field")
        return degree


def checked(index: int, antenna: Antenna) -> Antenna:
    """Return an antenna with a unit orientation, or raise a ValueError that names the fault."""
    (x, y), (d_x, d_y) = antenna
    if not all(math.isfinite(value) for value in (x, y, d_x, d_y)):
        raise ValueError(f"antenna {index} has a value that is not a finite number: {antenna}")
    if not (0.0 <= x <= FIELD and 0.0 <= y <= FIELD):
        raise ValueError(f"antenna {index} stands at ({x:g}, {y:g}), outside the field [0, 6] x [0, 6]")
    length = math.hypot(d_x, d_y)
    if length < 1e-12:
        raise ValueError(f"antenna {index} has the orientation (0, 0), which is no direction")
    if abs(length - 1.0) > 1e-12:  # leave unit vectors their bits, so that stored options stay as they are
        d_x, d_y = d_x / length, d_y / length
    return ((x, y), (d_x, d_y))


def parse(values: Mapping[str, Any]) -> BeamOptions:
    """Return the options that `values` describe."""
    options: BeamOptions = build(BeamOptions, values, "environment 'beam6g'")
    return options
