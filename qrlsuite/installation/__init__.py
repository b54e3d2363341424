"""Tests the installation for `qrlsuite doctor`: packages, plugins, the simulator, a GPU, the results folder."""

from __future__ import annotations

import fcntl
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import SpecifierSet

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

PROBE_SECONDS = 600
"""Time limit for importing all packages and compiling the simulator."""


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


def diagnose(runs: Path, announce: Callable[[str], None] = lambda step: None) -> Diagnosis:
    """Test everything; a test that raises is reported as broken.

    Parameters
    ----------
    runs:
        The results folder.
    announce:
        Called with the name of each step that takes a while, before it.
    """
    diagnosis = Diagnosis()
    tests: dict[str, Callable[[], None]] = {
        "python": lambda: _python(diagnosis),
        "packages": lambda: _packages(diagnosis),
        "probe": lambda: _probe(diagnosis, announce),
        "plugins": lambda: _plugins(diagnosis),
        "runs": lambda: _runs(runs, diagnosis),
    }
    for name, test in tests.items():
        try:
            test()
        except Exception as error:
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
    try:
        installed = metadata.metadata("qrlsuite")
    except metadata.PackageNotFoundError:
        diagnosis.broken.append(f"{location} is on the path but not installed: pip install it")
        return
    if installed["Version"] != qrlsuite.__version__:
        diagnosis.broken.append(
            f"{location} is qrlsuite {qrlsuite.__version__}, installed is {installed['Version']}: install it again"
        )
    needed = installed["Requires-Python"] or ""
    if not SpecifierSet(needed).contains(platform.python_version(), prereleases=True):
        diagnosis.broken.append(
            f"Python {platform.python_version()} is not supported: qrlsuite needs {needed}"
        )


def requirements() -> Iterator[tuple[Requirement, bool]]:
    """Yield the requirements of the suite on this Python, and whether each belongs to an extra."""
    try:
        lines = metadata.requires("qrlsuite") or []
    except metadata.PackageNotFoundError:
        return
    for line in lines:
        try:
            requirement = Requirement(line)
        except InvalidRequirement:
            continue
        extra = "extra ==" in str(requirement.marker)
        if extra or requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield requirement, extra


def _packages(diagnosis: Diagnosis) -> None:
    versions = {}
    for requirement, extra in requirements():
        name = requirement.name
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            problem = "is not installed"
        else:
            if requirement.specifier.contains(versions[name], prereleases=True):
                continue
            problem = f"{versions[name]} is installed, and does not fit"
        if not extra:
            diagnosis.broken.append(f"{name} {problem}: pip install '{name}{requirement.specifier}'")
    diagnosis.facts["packages"] = ", ".join(f"{name} {version}" for name, version in versions.items())


def _probe(diagnosis: Diagnosis, announce: Callable[[str], None]) -> None:
    """Import every required package and compute a circuit in another process, which a broken library may end."""
    names = [requirement.name.lower().replace("-", "_") for requirement, extra in requirements() if not extra]
    modules = [name for name in names if importlib.util.find_spec(name) is not None]
    answers: dict[str, Any] = {}
    step = "start Python"
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "qrlsuite.installation.probe", *modules],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        timer = threading.Timer(PROBE_SECONDS, process.kill)
        timer.start()
        try:
            for line in process.stdout or ():
                step, answer = json.loads(line)
                announce(step)
                answers[step] = answer
            process.wait()
        finally:  # after Ctrl-C, or a line that is no answer
            timer.cancel()
            process.kill()
            process.communicate()
        errors.seek(0)
        last_line = (errors.read().strip().splitlines() or ["no message"])[-1]
    failed: dict[str, list[str]] = {}
    for name, answer in answers.items():
        if answer is not None and "error" in answer:
            failed.setdefault(answer["error"], []).append(name)
    diagnosis.broken += [f"{', '.join(steps)}: {error}" for error, steps in failed.items()]
    if process.returncode:
        diagnosis.broken.append(f"{step}: the process ended with code {process.returncode}: {last_line}")
    for name in ("GPU", "simulator"):
        diagnosis.facts[name] = (answers.get(name) or {}).get("text", "fails")


def _plugins(diagnosis: Diagnosis) -> None:
    known = registry.load()
    own = [plugin for plugin in known.plugins if plugin.distribution == "qrlsuite"]
    if not own:
        diagnosis.broken.append("the suite's own models and tasks are not there: install it again, with pip")
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
    """Return an engine's name, with what to type where a package that it needs is not installed."""
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
