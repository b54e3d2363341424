"""What an index gets: a wheel of the size that README states, and a page whose links lead somewhere."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from email.parser import BytesParser
from pathlib import Path

import pytest

from tests.conftest import HANGS

ROOT = Path(__file__).parents[2]
SUITE = (
    "pyproject.toml",
    "setup.py",
    "CITATION.cff",
    "README.md",
    "LICENSE",
    "qrlsuite",
    "plugins",
    "tasks",
    "leaderboard",
)
ADDRESS = "https://example.org/qrlsuite"


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources of a wheel, because a build leaves files beside them."""
    folder = tmp_path_factory.mktemp("suite")
    for name in SUITE:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    return folder


def setuptools(hook: str, sources: Path, to: Path) -> None:
    """Call the backend as pip does."""
    code = f"import sys; from setuptools import build_meta; build_meta.{hook}(sys.argv[1])"
    words = [sys.executable, "-c", code, str(to)]
    done = subprocess.run(words, cwd=sources, capture_output=True, text=True, check=False, timeout=HANGS)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_wheel_has_its_kernels_and_the_size_that_readme_states(sources: Path, tmp_path: Path) -> None:
    setuptools("build_wheel", sources, tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    assert "qrlsuite/plugins/circuits/native/registers.cu" in zipfile.ZipFile(wheel).namelist()
    stated = re.search(r"wheel\s+has\s+(\d+)\s+MB", (ROOT / "README.md").read_text())
    assert stated
    assert os.path.getsize(wheel) / 1e6 == pytest.approx(int(stated[1]), rel=0.1)


@pytest.mark.parametrize("address", [None, ADDRESS])
def test_what_an_index_shows_leads_somewhere_or_is_plain_text(
    address: str | None, sources: Path, tmp_path: Path
) -> None:
    renderer = pytest.importorskip("readme_renderer.markdown", reason="pip install '.[dev]'")
    citation = re.sub(r"^repository-code:.*\n", "", (ROOT / "CITATION.cff").read_text(), flags=re.MULTILINE)
    (sources / "CITATION.cff").write_text(citation + (f'repository-code: "{address}/"\n' if address else ""))
    setuptools("prepare_metadata_for_build_wheel", sources, tmp_path)
    made = BytesParser().parsebytes(next(tmp_path.glob("*/METADATA")).read_bytes())
    assert made.get_all("Project-URL") == ([f"Repository, {address}"] if address else None)
    page = renderer.render(made.get_payload())
    links = re.findall(r'(?:href|src)="([^"]*)"', page)
    assert links
    own = [link for link in links if not link.startswith(("https://arxiv.org", "#"))]
    assert bool(own) == bool(address)
    for link in own:
        path = re.fullmatch(rf"{ADDRESS}/(?:blob|raw)/v{made['Version']}/([^#]+)(#.*)?", link)
        assert path, link
        assert (ROOT / path[1]).exists(), link
