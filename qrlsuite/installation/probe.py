"""The process of `qrlsuite doctor` that imports libraries, for a broken one may end it: `probe MODULE...`.

Writes a line of JSON per step, `[name, null]` before it and `[name, answer]` after it. Imports stand inside the steps,
so that a library that ends the process is named.
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
    os.dup2(2, 1)  # what libraries print is no answer

    def step(name: str, call: Callable[[], object]) -> None:
        print(json.dumps([name, None]), file=out, flush=True)
        try:
            answer = {"text": str(call())}
        except (Exception, SystemExit) as error:
            answer = {"error": type(error).__name__}
            with contextlib.suppress(Exception):
                answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps([name, answer]), file=out, flush=True)

    for module in modules:
        step(f"import {module}", lambda module=module: importlib.import_module(module))  # type: ignore[misc]
    step("GPU", gpu)
    step("simulator", simulator)


def gpu() -> str:
    """Return torch's build and its GPUs."""
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    devices = map(torch.cuda.get_device_properties, range(count))
    names = [f"{device.name} {device.total_memory / 1e9:.0f} GB" for device in devices]
    driver = "an" if os.path.exists("/proc/driver/nvidia/version") else "no"
    built = f"torch for CUDA {torch.version.cuda}" if torch.version.cuda else "torch for the CPU"
    text = f"{', '.join(names) or 'none'}, {built}, {driver} NVIDIA driver"
    if not names:
        return text
    from qrlsuite.circuit import Circuit, create_backend

    circuit = Circuit(1)
    circuit.append("RX", 0, circuit.input(0))
    native: Any = create_backend("native", circuit)
    problem = native.gpu_trouble()
    return f"{text}, circuits " + (f"slow there: {problem}" if problem else "by kernels")


def simulator() -> str:
    """Compute <Z> after a rotation by 0 and by pi."""
    import numpy as np

    from qrlsuite.circuit import Circuit, expectations

    circuit = Circuit(1)
    circuit.append("RX", 0, circuit.input(0))
    values = expectations(circuit, np.array([[0.0], [np.pi]]), {}).tolist()
    if not np.allclose(values, [[1.0], [-1.0]], atol=1e-6):
        raise ValueError(f"<Z> after RX(0) and RX(pi) is {values}, and must be [[1], [-1]]")
    return "works"


if __name__ == "__main__":
    main(sys.argv[1:])
