"""What `qrlsuite doctor` looks at: facts by section, and what is wrong with them."""

from __future__ import annotations

import fcntl
import functools
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from packaging.specifiers import SpecifierSet

import qrlsuite
from qrlsuite import registry
from qrlsuite.engine.local import usable_cores
from qrlsuite.installation import packages
from qrlsuite.registry import words
from qrlsuite.results.provenance import collect, processor
from qrlsuite.results.store import entries

VARIABLES = ("OMP_", "MKL_", "OPENBLAS_", "NUMBA_", "CUDA_", "QRLSUITE_", "XDG_CACHE_HOME", "PYTHONPATH")
"""Environment variables, by how they begin, that change how fast or from where things run."""

LOW_DISK_BYTES = 1_000_000_000
"""Free bytes below which the results folder is reported as nearly full; a seed takes a quarter of a megabyte."""

Facts = dict[str, Any]


@dataclass
class Diagnosis:
    """Facts by section, and problems.

    Attributes
    ----------
    broken:
        What must be mended before the suite can be used.
    remarks:
        What is left out, or may surprise; the rest works.
    """

    facts: dict[str, Facts] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


def diagnose(runs: Path, announce: Callable[[str], None] = lambda doing: None) -> Diagnosis:
    """Look at everything; a section that fails is itself a finding.

    Parameters
    ----------
    runs:
        The results folder.
    announce:
        Called with what is being done, before every step that takes a while.
    """
    diagnosis = Diagnosis()
    sections: dict[str, Callable[[Diagnosis], Facts]] = {
        "suite": _suite,
        "python": _python,
        "machine": _machine,
        "packages": _packages,
        "extras": _extras,
        "tried": functools.partial(_tried, announce),
        "plugins": _plugins,
        "runs": functools.partial(_runs, runs),
        "slurm": _slurm,
    }
    for name, inspect in sections.items():
        try:
            diagnosis.facts[name] = inspect(diagnosis)
        except Exception as error:
            diagnosis.facts[name] = {"error": words(error)}
            diagnosis.broken.append(f"{name}: {words(error)}")
    return diagnosis


def _suite(diagnosis: Diagnosis) -> Facts:

    location, stated = Path(qrlsuite.__file__).parent, packages.about()["version"]
    if not stated:
        diagnosis.broken.append(f"{location} is on the path, and not installed: pip install it")
    elif stated != qrlsuite.__version__:
        diagnosis.broken.append(
            f"{location} is qrlsuite {qrlsuite.__version__}, and what is installed is {stated}: install it again"
        )
    return {"version": qrlsuite.__version__, "location": str(location), "commit": collect([])["commit"]}


def _python(diagnosis: Diagnosis) -> Facts:

    needed = packages.about()["python"]
    if not SpecifierSet(needed).contains(platform.python_version(), prereleases=True):
        diagnosis.broken.append(
            f"Python {platform.python_version()} is not supported: qrlsuite needs {needed}"
        )
    return {
        "version": platform.python_version(),
        "executable": sys.executable,
        "virtual_environment": sys.prefix != sys.base_prefix,
    }


def _machine(diagnosis: Diagnosis) -> Facts:

    usable, quota = usable_cores(), _quota()
    if quota is not None and quota < usable:
        diagnosis.remarks.append(
            f"this container may use {quota:g} of {usable} cores: qrlsuite run --workers {max(1, int(quota))}"
        )
    return {
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": processor(),
        "cores": os.cpu_count(),
        "usable_cores": usable,
        "quota_cores": quota,
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "variables": {
            name: value for name, value in sorted(os.environ.items()) if name.startswith(VARIABLES)
        },
    }


def _quota() -> float | None:
    """Return how many cores a container may use at a time, None where that is not limited."""
    try:
        limit, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return None if limit == "max" else int(limit) / int(period)
    except (OSError, ValueError):
        return None


def _packages(diagnosis: Diagnosis) -> Facts:
    needed = list(packages.requirements())
    diagnosis.broken += filter(None, map(packages.lacking, needed))
    return {requirement.name: packages.version(requirement) for requirement in needed}


def _extras(diagnosis: Diagnosis) -> Facts:
    facts: Facts = {}
    for extra in packages.about()["extras"]:
        needed = list(packages.requirements(extra=extra))
        facts[extra] = {
            "versions": {requirement.name: packages.version(requirement) for requirement in needed},
            "missing": [requirement.name for requirement in needed if packages.lacking(requirement)],
            "install": f"pip install 'qrlsuite[{extra}]'",
        }
    return facts


def _tried(announce: Callable[[str], None], diagnosis: Diagnosis) -> Facts:
    answers, failed = packages.attempt(announce)
    diagnosis.broken += failed
    facts = {name: answers.get(name, {}) for name in ("torch", "simulator")}
    driver = Path("/proc/driver/nvidia/version").exists()
    if driver and not facts["torch"].get("devices"):
        diagnosis.remarks.append(
            "there is an NVIDIA driver, and this torch sees no GPU: --device cuda needs a CUDA build of torch"
        )
    temporary = Path(tempfile.gettempdir())
    for folder in map(Path, facts["simulator"].get("cache", [])):
        if temporary in folder.parents:
            diagnosis.remarks.append(
                f"the compiled simulator is kept in {temporary} only: set QRLSUITE_CACHE to a folder that stays"
            )
    return {**facts, "nvidia_driver": driver}


def _plugins(diagnosis: Diagnosis) -> Facts:

    known = registry.load()
    facts: Facts = {"loaded": {}, "failed": {}, "incompatible": {}, "problems": list(known.problems)}
    for plugin in known.plugins:
        fits = SpecifierSet(plugin.requires).contains(qrlsuite.__version__, prereleases=True)
        state = "loaded" if not plugin.problem else "failed" if fits else "incompatible"
        names = facts[state].setdefault(f"{plugin.distribution} {plugin.version}".strip(), [])
        names += (
            [plugin.problem] if plugin.problem else [n for some in plugin.registered.values() for n in some]
        )
        if plugin.problem and plugin.distribution == "qrlsuite":
            diagnosis.broken.append(plugin.problem)
    if not any(plugin.distribution == "qrlsuite" for plugin in known.plugins):
        diagnosis.broken.append("the suite's own models and tasks are not there: install it again, with pip")
    diagnosis.remarks += [
        problem for problem in known.problems if not problem.startswith(tuple(diagnosis.broken))
    ]
    return facts


def _runs(folder: Path, diagnosis: Diagnosis) -> Facts:

    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    facts: Facts = {"folder": str(folder), "exists": folder.exists(), "entries": 0, "seeds": 0}
    facts["free_bytes"] = shutil.disk_usage(existing).free
    try:
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(b"\0" * 4096)
            file.flush()
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        facts["writable"] = True
    except OSError as error:
        facts["writable"] = False
        diagnosis.broken.append(f"{existing} cannot be written and locked: {error.strerror}; use --runs DIR")
    if facts["free_bytes"] < LOW_DISK_BYTES:
        diagnosis.remarks.append(f"little space is left at {existing}: {facts['free_bytes'] / 1e6:.0f} MB")
    if folder.is_dir():
        stores = entries(folder)
        facts |= {"entries": len(stores), "seeds": sum(len(store.seeds()) for store in stores)}
    return facts


def _slurm(diagnosis: Diagnosis) -> Facts:
    sbatch = shutil.which("sbatch")
    facts: Facts = {"sbatch": sbatch, "job": os.environ.get("SLURM_JOB_ID")}
    if sbatch is not None:
        try:
            answer = subprocess.run(
                [sbatch, "--version"], capture_output=True, text=True, timeout=20, check=True
            )
            facts["version"] = answer.stdout.strip()
        except (OSError, subprocess.SubprocessError) as error:
            diagnosis.remarks.append(f"{sbatch} --version fails: {error}")
        missing = diagnosis.facts.get("extras", {}).get("slurm", {})
        if missing.get("missing"):
            diagnosis.remarks.append(f"SLURM is here, and --engine slurm needs {missing['install']}")
    return facts
