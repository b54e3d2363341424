"""Environments of other packages keep every rule: `pip install qgym qiskit-gym`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "extras" / "environments"


@pytest.mark.parametrize(("package", "name"), [("qiskit_gym", "qiskit-clifford"), ("qgym", "qgym-mapping")])
def test_they_keep_every_rule(package: str, name: str) -> None:
    pytest.importorskip(package)
    words = ["check", name, "--plugin", str(FOLDER / f"{name.replace('-', '_')}.py")]
    done = subprocess.run(
        [sys.executable, "-m", "qrlsuite", *words], capture_output=True, text=True, check=False
    )
    assert "all 15 rules hold" in done.stdout, done.stdout + done.stderr
