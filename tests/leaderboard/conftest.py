"""The report in the headless browser that is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.leaderboard.boards.board import Leaderboard
from qrlsuite.leaderboard.report import render


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
