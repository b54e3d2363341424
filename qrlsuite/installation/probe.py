"""What `qrlsuite doctor` tries in a process of its own, for a broken library may end the process: `probe MODULE...`.

Writes a JSON object per line: `{"doing": ...}` before every step, then what it found. Keeps to the standard library
until a step imports something: imports stand inside the steps, so that what breaks is named.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import sys
from collections.abc import Callable
from typing import Any


def main(modules: list[str]) -> None:
    """Import modules one after another, look for a GPU, and compute a circuit."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever libraries print is no answer

    def step(doing: str, name: str, call: Callable[[], Any]) -> None:
        print(json.dumps({"doing": doing}), file=out, flush=True)
        try:
            answer = call()
        except (Exception, SystemExit) as error:
            with contextlib.suppress(Exception):
                print(json.dumps({name: {"error": f"{type(error).__name__}: {error}"}}), file=out, flush=True)
        else:
            print(json.dumps({name: answer}), file=out, flush=True)

    for module in modules:
        step(f"import {module}", f"import {module}", lambda module=module: _import(module))  # type: ignore[misc]
    step("look for a GPU", "torch", torch)
    step("compute a circuit", "simulator", simulator)


def _import(module: str) -> str:
    return str(getattr(importlib.import_module(module), "__file__", ""))


def torch() -> dict[str, Any]:
    """Return what torch sees of GPUs, and its threads."""
    import torch

    devices = []
    for number in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
        device = torch.cuda.get_device_properties(number)
        devices.append({"name": device.name, "bytes": device.total_memory})
    return {
        "version": torch.__version__,
        "built_for_cuda": torch.version.cuda,
        "devices": devices,
        "threads": torch.get_num_threads(),
    }


def simulator() -> dict[str, Any]:
    """Compute <Z> after a rotation by 0 and by pi, and return where compiled kernels are kept, by which numba."""
    import numpy as np

    from qrlsuite.circuit import Circuit, expectations

    circuit = Circuit(1)
    circuit.append("RX", 0, circuit.input(0))
    values = expectations(circuit, np.array([[0.0], [np.pi]]), {}).tolist()
    if not np.allclose(values, [[1.0], [-1.0]], atol=1e-6):
        raise ValueError(f"<Z> after RX(0) and RX(pi) is {values}, and must be [[1], [-1]]")
    return {"cache": sorted(_caches()), **_numba()}


def _numba() -> dict[str, Any]:
    import numba

    config: Any = numba.config  # its attributes are made at run time
    layers = []
    for name, module in (("tbb", "tbbpool"), ("omp", "omppool"), ("workqueue", "workqueue")):
        with contextlib.suppress(ImportError):
            importlib.import_module(f"numba.np.ufunc.{module}")
            layers.append(name)
    return {
        "numba_threads": config.NUMBA_NUM_THREADS,
        "threading_layer": config.THREADING_LAYER,
        "threading_layers": layers,
    }


def _caches() -> set[str]:
    """Return the folders in which the suite's compiled functions are kept."""
    from numba.core.dispatcher import Dispatcher

    folders = set()
    for name, module in list(sys.modules.items()):
        if name.startswith("qrlsuite."):
            compiled = [value for value in vars(module).values() if isinstance(value, Dispatcher)]
            folders |= {str(value.stats.cache_path) for value in compiled if value.stats.cache_path}
    return folders


if __name__ == "__main__":
    main(sys.argv[1:])
