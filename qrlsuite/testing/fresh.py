"""Loads plugins in a new process, as a worker does, and reports which modules that imports."""

from __future__ import annotations

import functools
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from qrlsuite import hookspecs, own, registry, specs

HEAVY = (
    "torch", "pennylane", "qiskit", "cirq", "numba", "gymnasium", "scipy", "matplotlib", "pandas", "sklearn",
    "jax", "tensorflow",
)  # fmt: skip
"""Packages that take long to import, and so must wait until a command needs them."""

_MARK = "qrlsuite.testing.fresh "
"""Before the result, for imported modules may print."""


def environment() -> dict[str, str]:
    """Return this process's environment, and the folders that it imports from."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}


@functools.cache
def fresh_process(modules: tuple[str, ...], references: tuple[str, ...]) -> dict[str, Any]:
    """Import plugin modules, call their hooks and resolve references in a new interpreter.

    Returns
    -------
    dict
        `modules`: errors by module; `heavy`: heavy packages that registering imported; `references`: error or
        None by reference; `crash`: the last line of stderr, where the interpreter itself ended.
    """
    copies = [str(each.source.copy) for each in own.loaded()]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", __name__, json.dumps([copies, modules, references])],
        capture_output=True,
        text=True,
        check=False,
        env={
            **environment(),
            registry.LOAD_PLUGINS: "",
        },  # importing Gymnasium would load the plugins of others
    )
    for line in done.stdout.splitlines():
        if line.startswith(_MARK):
            answer: dict[str, Any] = json.loads(line.removeprefix(_MARK))
            return answer
    lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}, and no message"]
    return {"modules": {}, "heavy": [], "references": {}, "crash": lines[-1]}


def _look(modules: Sequence[str], references: Sequence[str]) -> dict[str, Any]:
    """Do the work of `fresh_process` in this process."""
    failed: dict[str, str] = {}
    for name in modules:
        try:
            plugin = importlib.import_module(name)
            for hook_name in hookspecs.REGISTER:
                hook = getattr(plugin, hook_name, None)
                if hook is not None and hasattr(hook, f"{hookspecs.PROJECT}_impl"):
                    hook(register=lambda spec: None)
        except (Exception, SystemExit) as error:
            failed[name] = registry.words(error)
    heavy = [name for name in HEAVY if name in sys.modules]
    return {"modules": failed, "heavy": heavy, "references": resolved(references)}


def resolved(references: Sequence[str]) -> dict[str, str | None]:
    """Resolve references in this process; returns by reference its error, or None."""
    errors: dict[str, str | None] = {}
    for reference in references:
        try:
            specs.resolve(reference)
            errors[reference] = None
        except (Exception, SystemExit) as error:
            errors[reference] = registry.words(error)
    return errors


if __name__ == "__main__":
    _paths, *_given = json.loads(sys.argv[1])
    for _path in _paths:
        own.load(_path)
    print(f"\n{_MARK}{json.dumps(_look(*_given))}")
