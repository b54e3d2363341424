"""`qrlsuite doctor` on this installation, and on one in which something is broken."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import qrlsuite
from tests.conftest import install, installed
from tests.core.test_hooks import suite


def shadow(site: Path, *requires: str) -> None:
    """Put metadata of the suite before the real one, with further requirements."""
    real = metadata.distribution("qrlsuite")
    info = site / f"qrlsuite-{real.version}.dist-info"
    info.mkdir()
    head = f"Metadata-Version: 2.1\nName: qrlsuite\nVersion: {real.version}\n"
    lines = ["Provides-Extra: slurm", *(f"Requires-Dist: {line}" for line in requires)]
    (info / "METADATA").write_text(head + "\n".join(lines))
    (info / "entry_points.txt").write_text(real.read_text("entry_points.txt") or "")


def test_this_installation(tmp_path: Path) -> None:
    for seed in range(3):
        (tmp_path / "runs" / "tiny" / "entry" / f"seed-{seed:04d}").mkdir(parents=True)
    (tmp_path / "runs" / "tiny" / "entry" / "entry.json").write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    done = suite(tmp_path, "doctor", "--runs", str(tmp_path / "runs"), "--json", OMP_NUM_THREADS="1")
    answer = json.loads(done.stdout)
    assert (done.returncode, answer["ok"], answer["broken"]) == (0, True, []), answer
    facts = answer["facts"]
    assert f"numpy {metadata.version('numpy')}" in facts["packages"]
    assert facts["qrlsuite"].startswith(f"{qrlsuite.__version__}, {Path(qrlsuite.__file__).parent}")
    assert "OMP_NUM_THREADS=1" in facts["variables"]
    assert "torch for" in facts["GPU"]
    assert facts["cache"].endswith(" compiled kernels")
    assert facts["engines"].startswith("command, ")
    assert facts["engines"].endswith(", slurm" if find_spec("submitit") else "slurm (pip install submitit)")
    assert "runs, 1 entries, 3 seeds" in facts["runs"]
    assert sorted(tmp_path.rglob("*")) == before, "it leaves nothing behind"


def test_what_is_broken_is_said_with_what_to_type(tmp_path: Path) -> None:
    shadow(
        tmp_path,
        "no-such-package>=1",
        "numpy<1",
        "torch",
        "packaging",
        "wanted>=2; extra == 'slurm'",
        "never; python_version < '3'",
    )
    (tmp_path / "torch.py").write_text("raise ImportError('libtorch.so: \\x1b[31mno such file')")
    (tmp_path / "runs").write_text("a file")
    install(tmp_path, "acme_old", "raise RuntimeError('must not be imported')", "qrlsuite<0.1")
    install(tmp_path, "acme_import", "import no_such_package")
    words = [
        sys.executable,
        "-m",
        "qrlsuite",
        "doctor",
        "--runs",
        str(tmp_path / "runs"),
    ]  # no fork: it imports torch
    environment = {**installed(tmp_path), "HOME": str(tmp_path)}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    broken = [
        line.removeprefix("broken: ") for line in done.stdout.splitlines() if line.startswith("broken: ")
    ]
    expected = (
        "no-such-package is not installed: pip install 'no-such-package>=1'",
        "is installed, but does not fit: pip install 'numpy<1'",
        r"GPU: ImportError: libtorch.so: \x1b[31mno such file",
        "runs cannot be written and locked: Not a directory; use --runs DIR",
    )
    for words in expected:
        assert sum(words in line for line in broken) == 1, (words, broken)
    assert len(broken) == len(expected), "what an extra lacks is no reason to exit with 1"
    assert "GPU        fails" in done.stdout
    assert "acme_old 1.0 (skipped)" in done.stdout
    assert "acme_import 1.0 (skipped)" in done.stdout
    notes = [line for line in done.stdout.splitlines() if line.startswith("note: ")]
    assert sum("acme_" in line for line in notes) == 2, "a stranger's plugin is no reason to exit with 1"
    assert "nothing is missing" not in done.stdout
    assert "runs       ~/runs, " in done.stdout, "home is not shown"
