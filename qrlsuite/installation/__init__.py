"""Collects the facts for `qrlsuite doctor`: versions, devices, plugins, the compile cache, the results folder."""

from __future__ import annotations

import fcntl
import importlib.util
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

import qrlsuite
from qrlsuite import registry
from qrlsuite.engine.local import usable_cores
from qrlsuite.results.provenance import collect, processor
from qrlsuite.results.store import entries
from qrlsuite.specs import EngineSpec

VARIABLES = ("OMP_", "MKL_", "OPENBLAS_", "NUMBA_", "CUDA_", "QRLSUITE_", "XDG_CACHE_HOME", "PYTHONPATH")
"""Prefixes of environment variables that change how fast or from where things run."""

LOW_DISK_BYTES = 1_000_000_000
"""Free bytes below which the results folder is reported as nearly full; a seed takes a quarter of a megabyte."""


@dataclass
class Diagnosis:
    """Facts, one line each by name, and problems.

    Attributes
    ----------
    broken:
        What must be repaired before the suite can be used.
    remarks:
        Skipped plugins, and what may surprise; the rest works.
    """

    facts: dict[str, str] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


def diagnose(runs: Path) -> Diagnosis:
    """Collect everything about this installation and a results folder; what raises is reported as broken."""
    diagnosis = Diagnosis()
    parts: dict[str, Callable[[], None]] = {
        "python": lambda: _python(diagnosis),
        "packages": lambda: _packages(diagnosis),
        "GPU": lambda: _gpu(diagnosis),
        "cache": lambda: _cache(diagnosis),
        "plugins": lambda: _plugins(diagnosis),
        "runs": lambda: _runs(runs, diagnosis),
    }
    for name, collect_part in parts.items():
        try:
            collect_part()
        except Exception as error:
            diagnosis.facts.setdefault(name, "fails")
            diagnosis.broken.append(f"{name}: {registry.words(error)}")
    return diagnosis


def _python(diagnosis: Diagnosis) -> None:
    cores, memory = usable_cores(), os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    commit = collect([]).commit
    variables = [
        f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(VARIABLES)
    ]
    location = Path(qrlsuite.__file__).parent
    diagnosis.facts |= {
        "qrlsuite": f"{qrlsuite.__version__}, {location}{f', commit {commit}' if commit else ''}",
        "python": f"{platform.python_version()}, {sys.executable}",
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": f"{processor()}, {cores} of {os.cpu_count()} cores, {memory / 1e9:.0f} GB of memory",
        "variables": " ".join(variables) or "none set",
        "sbatch": shutil.which("sbatch") or "none",
    }


def _packages(diagnosis: Diagnosis) -> None:
    """Compare versions with the suite's requirements; what only an extra needs is never broken."""
    if (installed := metadata.version("qrlsuite")) != qrlsuite.__version__:
        diagnosis.broken.append(
            f"qrlsuite {qrlsuite.__version__} runs, and {installed} is installed: install it again"
        )
    versions = {}
    for line in metadata.requires("qrlsuite") or []:
        requirement = Requirement(line)
        extra = "extra ==" in str(requirement.marker)
        if not extra and requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        name = requirement.name
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            problem = "is not installed"
        else:
            if requirement.specifier.contains(versions[name], prereleases=True):
                continue
            problem = f"{versions[name]} is installed, but does not fit"
        if not extra:
            diagnosis.broken.append(f"{name} {problem}: pip install '{name}{requirement.specifier}'")
    diagnosis.facts["packages"] = ", ".join(f"{name} {version}" for name, version in versions.items())


def _gpu(diagnosis: Diagnosis) -> None:
    """Name torch's build and its GPUs, and say whether circuits run there by kernels."""
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    devices = map(torch.cuda.get_device_properties, range(count))
    names = [f"{device.name} {device.total_memory / 1e9:.0f} GB" for device in devices]
    driver = "an" if os.path.exists("/proc/driver/nvidia/version") else "no"
    built = f"torch for CUDA {torch.version.cuda}" if torch.version.cuda else "torch for the CPU"
    text = f"{', '.join(names) or 'none'}, {built}, {driver} NVIDIA driver"
    if names:
        from qrlsuite.circuit import Circuit, create_backend

        circuit = Circuit(1)
        circuit.append("RX", 0, circuit.input(0))
        native: Any = create_backend("native", circuit)
        problem = native.gpu_trouble()
        text += ", circuits " + (f"slow there: {problem}" if problem else "by kernels")
    diagnosis.facts["GPU"] = text


def _cache(diagnosis: Diagnosis) -> None:
    from qrlsuite.compiled import cache

    folder = cache.folder(Path(cache.__file__).parent).parent
    diagnosis.facts["cache"] = f"{folder}, {len([*folder.rglob('*.nbc')])} compiled kernels"


def _plugins(diagnosis: Diagnosis) -> None:
    known = registry.load()
    own = [plugin for plugin in known.plugins if plugin.distribution == "qrlsuite"]
    if not own:
        diagnosis.broken.append("the suite's own models and tasks are missing: install it again, with pip")
    diagnosis.broken += [plugin.problem for plugin in own if plugin.problem]
    diagnosis.remarks += [line for line in known.problems if not line.startswith(tuple(diagnosis.broken))]
    others = {
        f"{plugin.distribution} {plugin.version}{' (skipped)' if plugin.problem else ''}": None
        for plugin in known.plugins
        if plugin.distribution != "qrlsuite"
    }
    diagnosis.facts["plugins"] = ", ".join(others) or "the suite's own"
    diagnosis.facts["engines"] = ", ".join(
        _engine(registered.spec) for _, registered in sorted(known.of(EngineSpec).items())
    )


def _engine(spec: EngineSpec) -> str:
    """Return an engine's name, with the command to type where a package that it needs is not installed."""
    missing = [command for module, command in spec.extras.items() if importlib.util.find_spec(module) is None]
    return f"{spec.name} ({', '.join(missing)})" if missing else spec.name


def _runs(folder: Path, diagnosis: Diagnosis) -> None:
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    stores = entries(folder) if folder.is_dir() else []
    seeds = sum(len(store.seeds()) for store in stores)
    diagnosis.facts["runs"] = f"{folder}, {len(stores)} entries, {seeds} seeds, {free / 1e9:.1f} GB free"
    try:
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(b"\0" * 4096)
            file.flush()
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        diagnosis.broken.append(f"{existing} cannot be written and locked: {error.strerror}; use --runs DIR")
    if free < LOW_DISK_BYTES:
        diagnosis.remarks.append(f"little space is left at {existing}: {free / 1e6:.0f} MB")
