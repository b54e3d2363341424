"""The built-in engines, registered as a plugin's are."""

from __future__ import annotations

from collections.abc import Callable

from qrlsuite import hookimpl
from qrlsuite.specs import EngineSpec


@hookimpl
def register_engines(register: Callable[[EngineSpec], None]) -> None:
    """Register `local`, `command`, `dask` and `slurm`."""
    register(
        EngineSpec(
            name="local",
            summary="Processes on this machine, one per core, restarted when they die",
            factory="qrlsuite.engine.local:LocalEngine",
        )
    )
    register(
        EngineSpec(
            name="command",
            summary="Workers started by a shell command (PBS, LSF, HTCondor, ssh, Kubernetes), in a shared folder",
            factory="qrlsuite.plugins.engines.command:CommandEngine",
            options="qrlsuite.plugins.engines.command:CommandOptions",
            remote=True,
        )
    )
    register(
        EngineSpec(
            name="dask",
            summary="Workers of a Dask cluster whose machines see the results folder",
            factory="qrlsuite.plugins.engines.dask:DaskEngine",
            options="qrlsuite.plugins.engines.dask:DaskOptions",
            extras={"distributed": "pip install distributed"},
            remote=True,
        )
    )
    register(
        EngineSpec(
            name="slurm",
            summary="A SLURM job array: submit and leave; requeued at the time limit, see `qrlsuite runs`",
            factory="qrlsuite.plugins.engines.slurm:SlurmEngine",
            options="qrlsuite.plugins.engines.slurm:SlurmOptions",
            extras={"submitit": "pip install submitit"},
            submits=True,
            remote=True,
        )
    )
