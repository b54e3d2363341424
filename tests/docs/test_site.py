"""The documentation is built with warnings as errors, needs no network, and holds the API that others use."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from qrlsuite import statistics, testing
from qrlsuite.specs import Spec
from tests.conftest import HANGS
from tests.docs.test_plugins import HOOKS

ROOT = Path(__file__).parents[2]
load_config = pytest.importorskip("mkdocs.config", reason="needs the extra 'docs'").load_config
pytest.importorskip("mkdocstrings_handlers.python", reason="needs the extra 'docs'")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built pages."""
    folder = tmp_path_factory.mktemp("site")
    package = folder / "package" / "qrlsuite"  # as in a wheel: the mapped folders inside
    package.mkdir(parents=True)
    for source in (ROOT / "qrlsuite").iterdir():
        (package / source.name).symlink_to(source)
    for name in ("plugins", "tasks", "leaderboard"):
        (package / name).symlink_to(ROOT / name)
    env = {**os.environ, "QRLSUITE_DOCS_PACKAGE": str(package.parent), "NO_MKDOCS_2_WARNING": "1"}
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder / "html")]
    # not --quiet: it hides warnings from --strict too
    done = subprocess.run(
        words, cwd=ROOT, env=env, capture_output=True, text=True, check=False, timeout=HANGS
    )
    assert done.returncode == 0, done.stderr
    return folder / "html"


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 15
    assert not list(site.rglob("*.py")), "programs that make pages and pictures are no pages"
    for page in pages:
        loaded = re.findall(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=[\"']?([^\"' >]+)", page.read_text())
        loaded += re.findall(r"<link\b(?![^>]*canonical)[^>]*\bhref=[\"']?([^\"' >]+)", page.read_text())
        assert not [address for address in loaded if re.match(r"(?:https?:)?//", address)], page


@pytest.mark.parametrize("address", [None, "https://example.org/qrlsuite"])
def test_pages_link_to_the_projects_address(address: str | None, tmp_path: Path) -> None:
    config = load_config(str(ROOT / "mkdocs.yml"))
    config.docs_dir = str(tmp_path / "docs")
    (tmp_path / "CITATION.cff").write_text(f"repository-code: {address}" if address else "title: qrlsuite")
    config.plugins.on_config(config)
    assert config.repo_url == address


def test_the_plugins_files_are_on_their_page(site: Path) -> None:
    text = unescape(re.sub(r"<[^>]+>", "", (site / "plugins.html").read_text()))
    code = (ROOT / "tests" / "third_party" / "acme-qrl" / "src" / "acme_qrl" / "ansatz.py").read_text()
    assert code.strip() in text
    assert "--8<--" not in text


def test_tutorials_are_pages_with_their_output(site: Path) -> None:
    notebooks = list((ROOT / "docs" / "tutorials").glob("*.ipynb"))
    assert len(notebooks) == 4
    for notebook in notebooks:
        text = (site / "tutorials" / f"{notebook.stem}.html").read_text()
        assert '<div class="output">' in text
        assert 'src="data:image/png;base64,' in text
        assert f'href="{notebook.name}"' in text, "to download"
        assert (site / "tutorials" / notebook.name).read_bytes() == notebook.read_bytes()
    assert 'href="tutorials/start.html"' in (site / "start.html").read_text(), "links lead to pages"


def test_every_page_of_results_is_in_the_navigation(site: Path) -> None:
    text = (site / "results" / "index.html").read_text()
    listed = re.findall(r'<a href="([\w.-]+)" class="md-nav__link">', text)
    pages = {page.name for page in (site / "results").glob("*.html")} - {"index.html"}
    assert len(pages) > 30
    assert sorted(listed) == sorted(pages)


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("hooks", [*HOOKS, "qrlsuite.training.trackers"]),
        ("specs", [f"qrlsuite.specs.{cls.__name__}" for cls in Spec.__subclasses__()]),
        ("testing", [f"qrlsuite.testing.{name}" for name in testing.__all__]),
        ("statistics", [f"qrlsuite.statistics.{name}" for name in statistics.__all__]),
        ("circuit", ["qrlsuite.circuit.description.Circuit", "qrlsuite.circuit.api.expectations"]),
        (
            "core",
            ["qrlsuite.algorithm.Algorithm", "qrlsuite.environment.LaneEnv", "qrlsuite.population.stack"],
        ),
        ("algorithms", ["qrlsuite.plugins.algorithms.ddqn.DDQN"]),
        ("models", ["qrlsuite.plugins.models.mlp.MLPOptions"]),
        ("environments", ["qrlsuite.plugins.environments.beam6g.env.BeamManagement6G"]),
    ],
)
def test_what_others_use_is_in_the_reference(site: Path, page: str, names: list[str]) -> None:
    text = (site / "api" / f"{page}.html").read_text()
    missing = [name for name in names if f'id="{name}"' not in text]
    assert not missing


def test_the_statements_are_filtered_by_words_and_verdict(site: Path, chromium: Any) -> None:
    tab = chromium.new_page()
    errors: list[str] = []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.goto((site / "statements.html").as_uri())
    bar = tab.locator("#statements")
    rows, count = tab.locator("tbody tr:visible"), bar.locator("output")
    total = rows.count()
    assert total > 100
    assert count.inner_text() == f"{total} of {total}"
    bar.get_by_label("Search statements").fill("WIDTH  antennas")
    texts = [text.lower() for text in rows.all_inner_texts()]
    assert 0 < len(texts) < total
    assert all("width" in text and "antennas" in text for text in texts)
    assert count.inner_text() == f"{len(texts)} of {total}"
    bar.get_by_label("Search statements").fill("")
    bar.get_by_label("Verdict").select_option("does not hold")
    assert 0 < rows.count() < total
    kinds = "(rows) => rows.map((row) => row.querySelector('[data-kind]').dataset.kind)"
    assert set(rows.evaluate_all(kinds)) == {"does not hold"}
    bar.get_by_label("Search statements").fill("no such words anywhere")
    assert (rows.count(), count.inner_text()) == (0, f"0 of {total}")
    bar.get_by_label("Search statements").fill("")
    bar.get_by_label("Verdict").select_option("")
    assert rows.count() == total
    tab.close()
    assert errors == []
