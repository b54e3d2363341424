"""A diagnosis in words: a name and a text per line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

SHOWN = 24
"""Names that a plugin registers and that are listed."""


def rows(facts: dict[str, dict[str, Any]]) -> Iterator[tuple[str, str]]:
    """Yield the facts of `Diagnosis.facts`, line by line: a name and a text."""
    lines = {
        "suite": _suite,
        "python": _python,
        "machine": _machine,
        "packages": _packages,
        "extras": _extras,
        "tried": _tried,
        "plugins": _plugins,
        "runs": _runs,
        "slurm": _slurm,
    }
    for name, write in lines.items():
        if "error" in facts[name]:
            yield name, facts[name]["error"]
        else:
            yield from write(facts[name])


def _suite(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    commit = f", commit {facts['commit']}" if facts["commit"] else ""
    yield "qrlsuite", f"{facts['version']}, {facts['location']}{commit}"


def _python(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    environment = "" if facts["virtual_environment"] else ", no virtual environment"
    yield "python", f"{facts['version']}, {facts['executable']}{environment}"


def _machine(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    usable = f"{facts['usable_cores']} of {facts['cores']} cores"
    quota = "" if facts["quota_cores"] is None else f", limited to {facts['quota_cores']:g}"
    yield "system", facts["system"]
    yield (
        "processor",
        f"{facts['processor']}, {usable}{quota}, {facts['memory_bytes'] / 1e9:.0f} GB of memory",
    )
    yield "variables", " ".join(f"{name}={value}" for name, value in facts["variables"].items()) or "none set"


def _packages(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "packages", ", ".join(f"{name} {version or 'MISSING'}" for name, version in facts.items())


def _extras(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for extra, about in facts.items():
        installed = [
            f"{name} {version}" for name, version in about["versions"].items() if name not in about["missing"]
        ]
        lacks = f"no {', '.join(about['missing'])}: {about['install']}" if about["missing"] else ""
        yield f"[{extra}]", "; ".join(filter(None, [", ".join(installed), lacks]))


def _tried(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    torch, simulator = facts["torch"], facts["simulator"]
    gpus = ", ".join(
        f"{device['name']} {device['bytes'] / 1e9:.0f} GB" for device in torch.get("devices", [])
    )
    built = (
        f"torch built for CUDA {torch['built_for_cuda']}"
        if torch.get("built_for_cuda")
        else "torch for the CPU"
    )
    driver = "an NVIDIA driver" if facts["nvidia_driver"] else "no NVIDIA driver"
    yield (
        "cuda",
        f"{'yes' if gpus else 'no'}: {gpus or 'no GPU'}, {built if torch else 'torch fails'}, {driver}",
    )
    if "cache" in simulator:
        layers = ", ".join(simulator["threading_layers"])
        yield "simulator", f"works, compiled in {', '.join(simulator['cache']) or 'memory'}"
        yield (
            "threads",
            (
                f"torch {torch.get('threads', '?')}, numba {simulator['numba_threads']} (threading layer "
                f"{simulator['threading_layer']} of {layers}); a worker of `qrlsuite run` takes one"
            ),
        )
    else:
        yield "simulator", "fails"


def _plugins(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for state in ("loaded", "incompatible", "failed"):
        for distribution, names in facts[state].items():
            if state != "loaded":
                text = f"{state.upper()}, see below"
            elif distribution.startswith("qrlsuite "):
                text = "the suite's own"
            else:
                more = f", and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
                text = f"{', '.join(names[:SHOWN])}{more}" if names else "nothing by name"
            yield "plugin", f"{distribution}: {text}"


def _runs(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    state = "there" if facts["exists"] else "not there yet"
    writable = "writable" if facts["writable"] else "NOT WRITABLE"
    held = f"{facts['entries']} entries, {facts['seeds']} seeds, {facts['free_bytes'] / 1e9:.1f} GB free"
    yield "runs", f"{facts['folder']} ({state}, {writable}), {held}"


def _slurm(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    job = f", in job {facts['job']}" if facts["job"] else ""
    yield "slurm", f"{facts.get('version', facts['sbatch'])}{job}" if facts["sbatch"] else f"no sbatch{job}"
