"""BeamManagement6G; importing this package makes `qrlsuite/BeamManagement6G-v1` known to Gymnasium."""

from __future__ import annotations

from qrlsuite.plugins.environments.beam6g.env import ID, BeamManagement6G, register
from qrlsuite.plugins.environments.beam6g.options import BeamOptions
from qrlsuite.plugins.environments.beam6g.vector import BeamLanes, make_vector

__all__ = ["ID", "BeamLanes", "BeamManagement6G", "BeamOptions", "make_vector", "register"]

register()
