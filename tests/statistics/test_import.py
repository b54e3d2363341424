"""The statistics stand alone, and are light."""

from __future__ import annotations

import subprocess
import sys


def test_importing_needs_neither_scipy_nor_anything_heavier() -> None:
    code = (
        "import sys, qrlsuite.statistics;"
        "print(sorted({name.split('.')[0] for name in sys.modules} "
        "& {'scipy', 'torch', 'numba', 'pandas', 'pydantic', 'pennylane', 'matplotlib'}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
