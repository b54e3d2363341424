"""Provenance: versions, machine, code revision. Recorded per seed, never part of an identity; summed up per entry."""

from __future__ import annotations

import functools
import os
import platform
import subprocess
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import qrlsuite
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry
from qrlsuite.results.records import DeviceRecord, Provenance

if TYPE_CHECKING:
    import torch

PACKAGES = ("qrlsuite", "torch", "numpy", "scipy", "gymnasium", "numba", "pennylane", "qiskit")

INSTRUCTIONS = {
    "NUMBA_CPU_NAME": "x86-64-v3",
    "NUMBA_CPU_FEATURES": "",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "COMPATIBLE",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
}
"""Variables that fix the instruction sets that bits depend on, with the values of the Containerfile.

Where all are set alike, the name of the processor does not count, see `qrlsuite.leaderboard.shelf.verify`.
"""


def collect(distributions: Sequence[str], device: torch.device | None = None) -> Provenance:
    """Return versions, device, processor, threads, git commit, and the variables that fixed instruction sets.

    Parameters
    ----------
    distributions:
        Further distributions whose versions matter: the distributions of the plugins in use.
    device:
        The device that trains the models; the processor by default.
    """
    versions = {name: version(name) for name in [*PACKAGES, *distributions]}
    return Provenance(
        versions={name: number for name, number in versions.items() if number is not None},
        python=platform.python_version(),
        system=f"{platform.system()} {platform.machine()}",
        processor=processor(),
        device=DeviceRecord(kind="cpu", name=processor()) if device is None else _device(device),
        cores=os.cpu_count(),
        threads=1,
        instructions={name: os.environ[name] for name in INSTRUCTIONS if name in os.environ},
        commit=_commit(),
    )


def of(entry: Entry, device: torch.device | None = None) -> Provenance:
    """Return `collect` of an entry's distributions, and the `numerics` of the suite's own parts, by role.

    A GPU's `circuit kernels` are among those of a quantum model once they have computed, if they are others than
    numba-cuda's.
    """
    counted = identity.numerics(entry)
    if device is not None and device.type != "cpu" and entry.model.family == "quantum":
        from qrlsuite.device import NUMERICS

        counted |= NUMERICS
    return collect(entry.distributions(), device).changed(numerics=counted)


def version(distribution: str) -> str | None:
    """Return the version of a distribution, None if it is not installed; for this suite, the running code's version.

    The version in an editable installation's metadata is as old as the installation.
    """
    if distribution == "qrlsuite":
        return qrlsuite.__version__
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def difference(here: Provenance, there: Provenance) -> str | None:
    """Name a difference on which bits may depend; None if they must be equal.

    The suite's version does not count: its parts compute equal bits while their `numerics` are equal (1 if not
    recorded). Earlier versions of the suite recorded neither versions of plugins nor the device: these versions are
    then not compared, and the device was the CPU.
    """
    devices = [
        "the CPU" if each.kind == "cpu" else f"{each.kind} ({each.name or 'unknown'})"
        for each in (here.device, there.device)
    ]
    if devices[0] != devices[1]:
        return f"trained on {devices[0]} here, on {devices[1]} there"
    for name, number in here.versions.items():
        compared = name != "qrlsuite" and (name in there.versions or name in PACKAGES)
        if there.versions.get(name) != number and compared:
            return f"{name} {number} here, {there.versions.get(name)} there"
    for role in here.numerics | there.numerics:
        if (counted := here.numerics.get(role, 1)) != (other := there.numerics.get(role, 1)):
            return f"numerics {counted} of the {role} here, {other} there"
    if there.system != here.system:
        return f"system {here.system} here, {there.system} there"
    if there.python != here.python:
        return f"python {here.python} here, {there.python} there"
    # older records have no `instructions`; nothing fixed them then
    fixed = here.instructions
    if fixed != there.instructions:
        return (
            f"instruction sets fixed here by {fixed or 'nothing'}, there by {there.instructions or 'nothing'}"
        )
    if fixed.keys() == INSTRUCTIONS.keys() or there.processor == here.processor:
        return None
    return f"processor {here.processor} here, {there.processor} there"


def versions(origins: Iterable[Provenance]) -> dict[str, tuple[str, ...]]:
    """Return every version that occurs, by distribution; Python's under "python"."""
    by_package: dict[str, set[str]] = {}
    for origin in origins:
        for name, version in {**origin.versions, "python": origin.python}.items():
            if version is not None:
                by_package.setdefault(name, set()).add(version)
    return {name: tuple(sorted(by_package[name])) for name in sorted(by_package)}


def distinct(texts: Iterable[str | None]) -> tuple[str, ...]:
    """Return every text that is known, sorted, each once."""
    return tuple(sorted({text for text in texts if text is not None}))


def gpus(origins: Iterable[Provenance]) -> set[str]:
    """Return the names of every device that occurs but the CPU; the kind of one without a name."""
    devices = (origin.device for origin in origins if origin.device.kind != "cpu")
    return {(device.name or device.kind)[:80] for device in devices}


def _device(device: torch.device) -> DeviceRecord:
    import torch

    if device.type != "cuda":
        return DeviceRecord(kind=device.type, name=processor())
    facts = {"name": torch.cuda.get_device_name(device), "numba-cuda": version("numba-cuda") or "none"}
    return DeviceRecord.model_validate({"kind": device.type, **facts})


def processor() -> str:
    """Return the processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    try:  # macOS has no /proc
        command = ["sysctl", "-n", "machdep.cpu.brand_string"]
        name = subprocess.run(command, capture_output=True, text=True, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        name = ""
    return name or platform.processor() or "unknown"


@functools.cache
def _commit() -> str | None:
    """Return the git commit of the suite's own working copy, as of the first call; None for an installed release."""
    return commit_of(Path(qrlsuite.__file__).resolve().parent)


def commit_of(package: Path) -> str | None:
    """Return the commit of the working copy whose top holds a package, with `-dirty` if a file was changed.

    None if there is no such working copy, or git fails. A repository that does not track the package, or has it further
    below (in a virtual environment, say), does not count.
    """
    if not (package.parent / ".git").exists():
        return None
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    own["GIT_OPTIONAL_LOCKS"] = "0"  # other commands of git in this folder go on

    def git(*words: str) -> str:
        command = ["git", "-C", str(package.parent), *words]
        return subprocess.run(
            command, env=own, capture_output=True, text=True, timeout=5, check=True
        ).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", f"{package.name}/__init__.py")
        return git("describe", "--always", "--dirty") or None
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
