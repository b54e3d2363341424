"""What a run was made with: versions, machine, code revision. Recorded per seed, never part of an identity."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = ("qrlsuite", "torch", "numpy", "scipy", "gymnasium", "numba", "pennylane", "qiskit")


def collect(distributions: list[str]) -> dict[str, Any]:
    """Return versions, processor, threads and git commit.

    Parameters
    ----------
    distributions:
        Further distributions whose versions matter: those of the plugins in use.
    """
    versions = {}
    for name in dict.fromkeys([*PACKAGES, *distributions]):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "versions": versions,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": 1,
        "commit": _commit(),
    }


def processor() -> str:
    """Return the processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _commit() -> str | None:
    """Return the git commit of the suite's own working copy, None for an installed release."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        result = subprocess.run(
            ["git", "describe", "--always", "--dirty"],
            cwd=root,
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip() or None
