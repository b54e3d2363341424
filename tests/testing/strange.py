"""Options that break a rule, apart from their test: a fresh process imports them, so this file is light."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import field
from typing import Annotated, Any

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass


def build(*given: Any) -> None:
    raise AssertionError("no rule that all kinds share builds anything")


NUMBER = 3


@dataclass(frozen=True)
class Good:
    width: Annotated[int, Field(ge=1, description="neurons of a layer")] = 8
    names: Annotated[tuple[str, ...], Field(description="of the layers")] = ("in", "out")


class NoDataclass:
    width = 8


@dataclass(frozen=True)
class Silent:
    width: Annotated[int, Field(description="neurons of a layer")] = 8
    depth: int = 2


@dataclass(frozen=True)
class Required:
    width: Annotated[int, Field(description="neurons of a layer")]


@dataclass(frozen=True)
class OutOfBounds:
    width: Annotated[int, Field(ge=1, description="neurons of a layer")] = 0


@dataclass(frozen=True)
class Undefined:
    rate: Annotated[float, Field(description="learning rate")] = float("nan")


@dataclass(frozen=True)
class Doubling:
    width: Annotated[int, AfterValidator(lambda width: 2 * width), Field(description="pairs")] = 8


@dataclass(frozen=True)
class Unordered:
    names: Annotated[tuple[Any, ...], Field(description="of the layers")] = (frozenset({"in", "out"}),)


@dataclass
class Assigned:
    width: Annotated[int, Field(description="neurons of a layer")] = 8


class Spline:
    """An object that is no plain value."""


@plain_dataclass(frozen=True)
class Objects:
    curve: Annotated[Any, Field(description="of the path")] = field(default_factory=Spline)


def _local() -> type:
    @dataclass(frozen=True)
    class Options:
        width: Annotated[int, Field(description="neurons of a layer")] = 8

    return Options


Local = _local()
