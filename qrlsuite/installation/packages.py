"""What the suite's own metadata says it needs, what is installed of it, and whether it works when it is used."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from importlib import metadata
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement

PATIENCE = 600
"""Seconds that importing everything and compiling the simulator may take."""


def about() -> dict[str, Any]:
    """Return the suite's metadata: version, the Python that it needs, its extras; empty where it is not installed."""
    try:
        package = metadata.metadata("qrlsuite")
    except metadata.PackageNotFoundError:
        return {"version": "", "python": "", "extras": []}
    return {
        "version": package["Version"],
        "python": package["Requires-Python"] or "",
        "extras": package.get_all("Provides-Extra") or [],
    }


def requirements(distribution: str = "qrlsuite", extra: str = "") -> Iterator[Requirement]:
    """Yield what a distribution requires, or what an extra of it adds to that, with the extras of those."""
    try:
        lines = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return
    for line in lines:
        try:
            requirement = Requirement(line)
        except InvalidRequirement:
            continue
        always = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        added = requirement.marker is not None and requirement.marker.evaluate({"extra": extra})
        if always if not extra else added and not always:
            yield requirement
            for nested in sorted(requirement.extras):
                yield from requirements(requirement.name, nested)


def version(requirement: Requirement) -> str | None:
    """Return the installed version of what is required, None where there is none."""
    try:
        return metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return None


def lacking(requirement: Requirement) -> str:
    """Say what is wrong with what is installed, and what to type; `""` where nothing is."""
    installed = version(requirement)
    if installed is not None and requirement.specifier.contains(installed, prereleases=True):
        return ""
    problem = "is not installed" if installed is None else f"{installed} is installed, and does not fit"
    return f"{requirement.name} {problem}: pip install '{requirement.name}{requirement.specifier}'"


def attempt(announce: Callable[[str], None]) -> tuple[dict[str, Any], list[str]]:
    """Import every required package and compute a circuit, in a process that may end as it likes.

    Returns
    -------
    tuple
        What `qrlsuite.installation.probe` found, by step; and what failed, one line for each cause.
    """
    names = [requirement.name.lower().replace("-", "_") for requirement in requirements()]
    modules = [name for name in names if importlib.util.find_spec(name) is not None]
    answers: dict[str, Any] = {}
    doing = "start Python"
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "qrlsuite.installation.probe", *modules],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        timer = threading.Timer(PATIENCE, process.kill)
        timer.start()
        try:
            for line in process.stdout or ():
                answer = json.loads(line)
                doing = answer.pop("doing", doing)
                announce(doing)
                answers |= answer
            process.wait()
        finally:  # Ctrl-C, or a line that is no answer
            timer.cancel()
            process.kill()
            process.communicate()
        errors.seek(0)
        last_line = (errors.read().strip().splitlines() or ["it said nothing"])[-1]
    causes: dict[str, list[str]] = {}
    for step, answer in answers.items():
        if isinstance(answer, dict) and "error" in answer:
            causes.setdefault(answer["error"], []).append(step)
    failed = [f"{', '.join(steps)}: {error}" for error, steps in causes.items()]
    if process.returncode:
        failed.append(f"{doing}: the process ended with code {process.returncode}: {last_line}")
    return answers, failed
