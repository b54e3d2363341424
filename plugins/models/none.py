"""No network: the model of algorithms that build none, such as tables; entries are written `ALGORITHM none`."""

from __future__ import annotations

from typing import Any, NoReturn

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from qrlsuite.errors import OptionError


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NoneOptions:
    """There are none."""


def build(obs_dim: int, out_dim: int, options: NoneOptions, generator: Any) -> NoReturn:
    """Refuse to build a network."""
    raise OptionError(
        "model 'none' is for algorithms that build no network, and this one does: choose a model"
    )
