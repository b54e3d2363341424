"""Built-in environments."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite.hookspecs import hookimpl
from qrlsuite.specs import EnvironmentSpec

_BEAM6G = "qrlsuite.plugins.environments.beam6g"


@hookimpl
def register_environments(register: Callable[[EnvironmentSpec], None]) -> None:
    """Register BeamManagement6G."""
    register(
        EnvironmentSpec(
            name="beam6g",
            summary="BeamManagement6G: choose the antenna that serves a moving user best",
            options=f"{_BEAM6G}.options:Options",
            gymnasium_id="qrlsuite/BeamManagement6G-v1",
            entry_point=f"{_BEAM6G}.env:BeamManagement6G",
            vector=f"{_BEAM6G}.vector:make_vector",
        )
    )
