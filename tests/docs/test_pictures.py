"""No picture without a command, none of entries that have changed since, and none that no page shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from qrlsuite.leaderboard.shelf.published import AGENTS, encode_record
from tests.core.test_docs import parse
from tests.docs import load

ROOT = Path(__file__).parents[2]


pictures = load("pictures")
PUBLISHED = {name: of for name, of in pictures.PICTURES.items() if not isinstance(of, pictures.Unpublished)}


def test_every_picture_has_a_command_and_a_page() -> None:
    assert {path.name for path in pictures.IMAGES.iterdir()} == set(pictures.PICTURES)
    shown = [
        re.findall(r"\((?:docs/|../)?images/([\w.-]+)\)", page.read_text())
        for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))
    ]
    assert {name for names in shown for name in names} == set(pictures.PICTURES)
    assert (pictures.IMAGES / "episode.gif").stat().st_size < 1_000_000


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_picture_shows_the_entries_as_they_are_published_now(name: str) -> None:
    assert pictures.mark_of(pictures.IMAGES / name) == pictures.made_from(PUBLISHED[name]), (
        f"docs/images/{name} was made from other entries or by another command: run `make pictures`"
    )


def test_pictures_show_what_is_published_by_commands_of_the_suite() -> None:
    for picture in PUBLISHED.values():
        assert all(list((ROOT / "leaderboard").glob(f"{pattern}/[!.]*")) for pattern in picture.entries), (
            picture
        )
    for picture in pictures.PICTURES.values():
        words = shlex.split(picture.command)
        if isinstance(picture, pictures.Unpublished) and picture.program == "python":
            assert (ROOT / words[0]).is_file()
        else:
            assert parse(words) == ""


def test_a_mark_follows_the_entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = tmp_path / "leaderboard" / "entries" / "task" / "entry"
    entry.mkdir(parents=True)
    (entry / "seeds.parquet").write_bytes(b"old")
    monkeypatch.setattr(pictures, "ROOT", tmp_path)
    picture = pictures.Plot("plot curves", ("entries/task/*",))
    before = pictures.made_from(picture)
    assert pictures.made_from(picture) == before
    record = {"name": "entry", "published": {"seeds": 1}}
    (entry / "entry.json").write_bytes(encode_record(record))
    before = pictures.made_from(picture)
    named = {**record, "published": {"seeds": 1, "agents": {"seeds": [0]}}}
    (entry / "entry.json").write_bytes(encode_record(named))
    (entry / AGENTS).write_bytes(b"agents, which no picture shows")
    assert pictures.made_from(picture) == before
    (entry / "entry.json").write_bytes(encode_record({**record, "published": {"seeds": 2}}))
    assert pictures.made_from(picture) != before
    before = pictures.made_from(picture)
    (entry / "seeds.parquet").write_bytes(b"new")
    assert pictures.made_from(picture) != before
