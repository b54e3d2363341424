"""`qrlsuite doctor` on this installation, and on ones in which something is broken, each in a process of its own."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.cli.commands import doctor
from qrlsuite.installation import packages
from qrlsuite.installation.diagnosis import Diagnosis
from tests.core.test_hooks import install, suite

ROOT = Path(__file__).parents[2]


def shadow(site: Path, *requires: str, python: str = ">=3.11") -> None:
    """Put metadata of the suite before the real one, with further requirements."""
    real = metadata.distribution("qrlsuite")
    info = site / f"qrlsuite-{real.version}.dist-info"
    info.mkdir()
    lines = [f"Requires-Dist: {line}" for line in requires]
    (info / "METADATA").write_text(
        "\n".join(
            [
                "Metadata-Version: 2.1",
                "Name: qrlsuite",
                f"Version: {real.version}",
                f"Requires-Python: {python}",
                "Provides-Extra: slurm",
                *lines,
            ]
        )
    )
    (info / "entry_points.txt").write_text(real.read_text("entry_points.txt") or "")


def test_this_installation(tmp_path: Path) -> None:
    for seed in range(3):
        (tmp_path / "runs" / "tiny" / "entry" / f"seed-{seed:04d}").mkdir(parents=True)
    (tmp_path / "runs" / "tiny" / "entry" / "entry.json").write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    done = suite(tmp_path, "doctor", "--runs", str(tmp_path / "runs"), "--json", OMP_NUM_THREADS="1")
    found = json.loads(done.stdout)
    assert (done.returncode, found["ok"], found["broken"]) == (0, True, []), found
    facts = found["facts"]
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert set(facts["packages"]) == {line.partition(">")[0] for line in declared}
    assert facts["packages"]["numpy"] == metadata.version("numpy")
    assert facts["extras"]["slurm"]["install"] == "pip install 'qrlsuite[slurm]'"
    assert facts["suite"]["location"] == str(Path(doctor.__file__).parents[2])
    assert facts["tried"]["torch"]["threads"] == 1
    assert Path(facts["tried"]["simulator"]["cache"][0]).is_dir()
    assert facts["machine"]["variables"]["OMP_NUM_THREADS"] == "1"
    assert "mlp" in facts["plugins"]["loaded"][f"qrlsuite {metadata.version('qrlsuite')}"]
    assert (facts["runs"]["entries"], facts["runs"]["seeds"], facts["runs"]["writable"]) == (1, 3, True)
    assert sorted(tmp_path.rglob("*")) == before, "it leaves nothing behind"


def test_what_is_broken_is_said_with_what_to_type(tmp_path: Path) -> None:
    shadow(
        tmp_path,
        "no-such-package>=1",
        "numpy<1",
        "torch",
        "packaging",
        "wanted>=2; extra == 'slurm'",
        python=">=3.99",
    )
    (tmp_path / "torch.py").write_text("raise ImportError('libtorch.so: \\x1b[31mno such file')")
    (tmp_path / "runs").write_text("a file")
    install(tmp_path, "acme_old", "raise RuntimeError('must not be imported')", "qrlsuite<0.1")
    install(tmp_path, "acme_import", "import no_such_package")
    (tmp_path / "sbatch").write_text("#!/bin/sh\necho slurm 99.1\n")
    (tmp_path / "sbatch").chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = suite(tmp_path, "doctor", "--runs", str(tmp_path / "runs"), HOME=str(tmp_path), PATH=path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    broken = [
        line.removeprefix("broken: ") for line in done.stdout.splitlines() if line.startswith("broken: ")
    ]
    for expected in (
        "is not supported: qrlsuite needs >=3.99",
        "no-such-package is not installed: pip install 'no-such-package>=1'",
        "is installed, and does not fit: pip install 'numpy<1'",
        r"import torch, torch, simulator: ImportError: libtorch.so: \x1b[31mno such file",
        "runs cannot be written and locked: Not a directory; use --runs DIR",
    ):
        assert sum(expected in line for line in broken) == 1, (expected, broken)
    assert "[slurm]       no wanted: pip install 'qrlsuite[slurm]'" in done.stdout
    assert "simulator     fails" in done.stdout
    assert "acme_old 1.0: INCOMPATIBLE, see below" in done.stdout
    assert "acme_import 1.0: FAILED, see below" in done.stdout
    notes = [line for line in done.stdout.splitlines() if line.startswith("note: ")]
    assert "note: SLURM is here, and --engine slurm needs pip install 'qrlsuite[slurm]'" in notes
    assert "slurm         slurm 99.1" in done.stdout
    assert sum("acme_" in line for line in notes) == 2, "a stranger's plugin is no reason to exit with 1"
    assert "everything that is needed works" not in done.stdout
    assert "~/runs (there, NOT WRITABLE)" in done.stdout, "home is not shown"


def test_a_library_that_ends_the_process_is_named(tmp_path: Path) -> None:
    shadow(tmp_path, "packaging", "gymnasium", "numba")
    (tmp_path / "gymnasium.py").write_text("import os, sys; sys.stderr.write('bad instruction'); os._exit(9)")
    done = suite(tmp_path, "doctor", "--json", "--runs", str(tmp_path / "runs"))
    found = json.loads(done.stdout)
    assert done.returncode == 1
    assert found["broken"] == ["import gymnasium: the process ended with code 9: bad instruction"]
    assert not found["facts"]["runs"]["exists"]
    assert not (tmp_path / "runs").exists()


def test_requirements_of_extras_are_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shadow(
        tmp_path, "plain", "gymnasium[box2d]; extra == 'games'", "never; python_version < '3'", "not valid!"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert [requirement.name for requirement in packages.requirements()] == ["plain"]
    [first, *rest] = [requirement.name for requirement in packages.requirements(extra="games")]
    assert first == "gymnasium"
    assert any("box2d" in name for name in rest), "what gymnasium[box2d] brings"


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str]) -> Callable[[dict[str, Any]], str]:
    """What is printed about a torch, with every other section failed."""

    def show(tried: dict[str, Any]) -> str:
        sections = ("suite", "python", "machine", "packages", "extras", "plugins", "runs", "slurm")
        facts: dict[str, Any] = {name: {"error": "not looked at"} for name in sections}
        doctor._print(Diagnosis({**facts, "tried": tried}))
        return capsys.readouterr().out

    return show


def test_gpus_are_listed(shown: Callable[[dict[str, Any]], str]) -> None:
    gpu = {"built_for_cuda": "12.8", "devices": [{"name": "A100", "bytes": 80e9}], "threads": 4}
    text = shown({"torch": gpu, "simulator": {"error": "no"}, "nvidia_driver": True})
    assert "cuda          yes: A100 80 GB, torch built for CUDA 12.8, an NVIDIA driver" in text
    none = {"built_for_cuda": None, "devices": [], "threads": 4}
    text = shown({"torch": none, "simulator": {"error": "no"}, "nvidia_driver": False})
    assert "cuda          no: no GPU, torch for the CPU, no NVIDIA driver" in text
