"""A headless Chromium for the report: the installed one, never a download."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.leaderboard.boards.board import Leaderboard
from qrlsuite.leaderboard.report import render

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A running browser; skips where there is none."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="needs playwright: pip install 'qrlsuite[dev]'"
    )
    path = next((found for name in NAMES if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"needs a browser on the path ({', '.join(NAMES)}): apt-get install chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium: Any, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Open a board's page from a file, without a network; complaints and requests fail the test at its end."""
    trouble: list[str] = []
    contexts = []

    def open_page(page: Leaderboard | str, width: int = 1400, **settings: Any) -> Any:
        path = tmp_path / f"report-{len(contexts)}.html"
        path.write_text(page if isinstance(page, str) else render(page), encoding="utf-8")
        context = chromium.new_context(viewport={"width": width, "height": 900}, offline=True, **settings)
        context.set_default_timeout(300_000)  # of a busy machine nothing is demanded
        contexts.append(context)
        tab = context.new_page()
        tab.on("console", lambda message: trouble.append(f"console: {message.text}"))
        tab.on("pageerror", lambda error: trouble.append(f"error: {error}"))
        tab.on("dialog", lambda dialog: (trouble.append(f"dialog: {dialog.message}"), dialog.dismiss()))
        tab.on("request", lambda request: _allowed(request.url, path) or trouble.append(request.url))
        tab.goto(path.as_uri())
        return tab

    yield open_page
    for context in contexts:
        context.close()
    assert trouble == []


def _allowed(url: str, path: Path) -> bool:
    return url.partition("#")[0] == path.as_uri() or url.startswith("data:")
