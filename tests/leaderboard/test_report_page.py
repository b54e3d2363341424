"""The report in a real browser: searched, picked from, offline, readable everywhere, and deaf to hostile names."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from qrlsuite.leaderboard.boards.compared import compare_entries
from qrlsuite.leaderboard.report import render
from qrlsuite.results.records import ImportedRecord
from tests.leaderboard import boards

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def page() -> str:
    """A board of four entries on one task, one of another task and a folder left out."""
    entries = [*boards.graded(4), boards.entry("few", 8), boards.entry("pole", 20, 20, task="cartpole")]
    return render(boards.of(entries, ["runs/beam6g/torn: epochs.parquet is truncated"]))


def column(tab: Any, key: str, table: str = "#board-0-table") -> list[str]:
    """The values of a column from top to bottom."""
    script = """([table, key]) => {
      const at = [...document.querySelectorAll(`${table} thead th`)].findIndex((cell) => cell.dataset.key === key);
      return [...document.querySelectorAll(`${table} tbody tr`)].map((row) => row.cells[at].dataset.value);
    }"""
    values: list[str] = tab.evaluate(script, [table, key])
    return values


def test_the_table_sorts_by_click(opened: Open, page: str) -> None:
    tab = opened(page)
    means = [float(value) for value in column(tab, "mean_time")[:-1]]
    assert means == sorted(means)
    assert column(tab, "mean_time")[-1] == "", "fewer than 20 seeds"
    header = tab.locator("#board-0-table th[data-key=sample_complexity]")
    header.get_by_role("button").click()
    up = [int(value) for value in column(tab, "sample_complexity")]
    assert up == sorted(up)
    assert header.get_attribute("aria-sort") == "ascending"
    assert tab.locator("#board-0-table [aria-sort]").count() == 1
    header.get_by_role("button").click()
    assert [int(value) for value in column(tab, "sample_complexity")] == up[::-1]
    assert header.get_attribute("aria-sort") == "descending"
    for reverse in (False, True):
        tab.locator("#board-0-table th[data-key=ranks] button").click()
        ranks = column(tab, "ranks")
        assert ranks == [*sorted(ranks[:-1], reverse=reverse), ""], "an unranked entry stays last"


def test_the_keyboard_skips_to_the_content_and_sorts(opened: Open, page: str) -> None:
    tab = opened(page)
    tab.keyboard.press("Tab")
    assert tab.evaluate("document.activeElement.className") == "skip"
    tab.keyboard.press("Enter")
    assert tab.evaluate("document.activeElement.id") == "content"
    for _ in range(60):
        tab.keyboard.press("Tab")
        if tab.evaluate("document.activeElement.closest('th')?.dataset.key") == "parameters":
            break
    outline = tab.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    tab.keyboard.press("Enter")
    values = [int(value) for value in column(tab, "parameters")]
    assert values == sorted(values)
    assert outline == "solid"


def test_the_page_begins_with_the_boards_verdict(opened: Open) -> None:
    """The best classical and the best quantum entry of a board, as `compare` says it, with the board's p."""
    speeds = {
        "mlp width=16": (2, 0),
        "mlp width=8": (1.5, 0),
        "vqc qubits=4": (1, 9),
        "vqc qubits=3": (0.7, 9),
    }
    entries = [boards.entry(label, speed=speed, quantum=q) for label, (speed, q) in speeds.items()]
    tab = opened(boards.of([*entries, boards.entry("pole", task="cartpole")]), 390)
    alone = compare_entries(entries[0], entries[2]).sentence
    assert alone.startswith("mlp width=16 needs ")
    words = "classical mlp width=16 needs", "than quantum vqc qubits=4"
    wanted = re.sub("mlp width=16 needs(.*)than vqc qubits=4", rf"{words[0]}\1{words[1]}", alone)
    answer = tab.locator(".answers .said span").first
    said = answer.inner_text().replace("\u00a0", " ")
    assert said.partition(" (")[0] == wanted.partition(" (")[0]
    assert re.search(
        r", 20 seeds each, adjusted p [=<] \.\d+\); final score 0\.\d+ against 0\.\d+, adjusted p ", said
    )
    assert answer.bounding_box()["y"] < 300, "on a phone, without scrolling"


def test_a_board_of_three_begins_with_every_pair(opened: Open) -> None:
    tab = opened(boards.of([boards.entry(f"at {speed}", speed=speed) for speed in (3, 1.5, 0.5)]), 390)
    verdicts = tab.locator("#board-0 .verdict")
    said = [text.partition(" (")[0] for text in verdicts.all_inner_texts()]
    assert [re.sub(r"\d+%", "n%", line) for line in said] == [
        "at 3 needs n% fewer steps than at 1.5",
        "at 3 needs n% fewer steps than at 0.5",
        "at 1.5 needs n% fewer steps than at 0.5",
    ]
    assert [tab.locator("body").inner_text().count(line) for line in said] == [1, 1, 1]
    assert verdicts.first.bounding_box()["y"] < 500, "on a phone, without scrolling"


def test_what_another_program_trained_is_neither_classical_nor_quantum(opened: Open) -> None:
    entries = [boards.entry(f"at {speed}", speed=speed, quantum=9 * (speed == 1)) for speed in (3, 2, 1, 0.5)]
    tab = opened(boards.of([boards.changed(entries[0], imported=ImportedRecord()), *entries[1:]]))
    assert "external" in tab.locator("#board-0-table tbody tr").first.inner_text()
    assert tab.locator("#board-0 .verdict").first.inner_text().startswith("at 2 needs ")
    assert "Curves of other programs" in tab.locator("#board-0-notes").inner_text()


def picked(tab: Any) -> list[str]:
    """The entries whose curves are drawn, by the legend."""
    names: list[str] = tab.locator("#board-0 .legend li > span").all_inner_texts()
    return names


def test_rows_are_picked_by_a_click_and_compared(opened: Open, page: str) -> None:
    assert len(page.encode()) < 500_000
    tab = opened(page)
    tab.locator("#board-0").get_by_label("Single runs").check()
    runs = tab.locator("#board-0 path.runs")
    assert [path.get_attribute("d").count("M") for path in runs.all()] == [20, 20]
    assert picked(tab) == ["model-0 width=1", "model-1 width=2"]
    row = tab.locator("#board-0-table tbody tr", has_text="model-3 width=8")
    row.locator("td").last.click()
    assert picked(tab) == ["model-0 width=1", "model-1 width=2", "model-3 width=8"]
    assert tab.locator("#board-0 .verdicts .verdict").count() == 3, "all pairs of three"
    assert not tab.get_by_text("Options of the algorithm").first.is_visible()
    tab.locator("#board-0-table").get_by_role("link", name="model-0 width=1").click()
    tab.get_by_text("Options of the algorithm").first.wait_for(state="visible")
    assert tab.locator("#board-0 path.median").count() == 3
    tab.locator("#board-0-table tbody tr", has_text="model-1 width=2").locator("td").last.click()
    verdict = tab.locator("#board-0 .verdicts .verdict")
    assert verdict.count() == 1
    assert verdict.inner_text().startswith("model-0 width=1 needs ")
    assert " fewer steps than model-3 width=8 (" in verdict.inner_text()
    tab.get_by_role("button", name="Unpick model-3 width=8").click()
    assert picked(tab) == ["model-0 width=1"]
    assert verdict.count() == 0
    tab.locator("#board-0").get_by_role("button", name="Unpick all").click()
    assert tab.locator("#board-0 path.median").count() == 0


def test_rows_are_picked_by_keyboard_and_the_cursor_moves(opened: Open, page: str) -> None:
    tab = opened(page)
    box = tab.get_by_role("checkbox", name="Pick few")
    box.focus()
    tab.keyboard.press("Space")
    assert "few" in picked(tab)
    tab.keyboard.press("Space")
    assert "few" not in picked(tab)
    plot = tab.locator("#board-0 .plot")
    assert "model-0 width=1, model-1 width=2" in plot.get_attribute("aria-label")
    at_end = tab.locator("#board-0 .legend output").all_inner_texts()
    plot.focus()
    for _ in range(45):
        tab.keyboard.press("ArrowLeft")
    early = tab.locator("#board-0 .legend output").all_inner_texts()
    assert [float(value) for value in early] < [float(value) for value in at_end]
    assert "steps" in tab.locator("#board-0 .picked .at").inner_text()


def test_the_search_filters_rows(opened: Open, page: str) -> None:
    tab = opened(page)
    tab.locator("#board-0").get_by_label("Search entries").fill("Width=2 QUANTUM")
    rows = tab.locator("#board-0-table tbody tr:visible")
    assert rows.count() == 1
    assert "model-1 width=2" in rows.first.inner_text()
    assert tab.locator("#board-0 .tools output").first.inner_text() == "1 of 5"
    tab.locator("#board-0").get_by_label("Search entries").fill("quantum nowhere")
    assert rows.count() == 0
    tab.locator("#board-0").get_by_label("Search entries").fill("classical")
    tab.locator("#board-0").get_by_role("button", name="Pick shown").click()
    assert set(picked(tab)) == {f"model-{i} width={2**i}" for i in range(4)} | {"few"}
    tab.locator("#board-0").get_by_label("Search entries").fill("")
    assert rows.count() == 5


def test_curves_are_those_of_the_entries(opened: Open) -> None:
    """A curve that is 0.5 up to half of its epochs and 1 afterwards has its step in the middle of the picture."""
    entry = boards.entry("step")
    entry.curves[:, :50], entry.curves[:, 50:] = 0.5, 1.0
    tab = opened(boards.of([entry, boards.entry("other", speed=2)]))
    plot = tab.locator("#board-0 .plot")
    tab.locator("#board-0").get_by_role("button", name="Unpick other").click()
    box = plot.bounding_box()
    values = tab.locator("#board-0 .legend output")
    seen = []
    for share in (0.3, 0.7):
        tab.mouse.move(box["x"] + share * box["width"], box["y"] + 50)
        seen.append(values.inner_text())
    assert seen == ["0.500", "1.000"]
    path = tab.locator("#board-0 path.median").get_attribute("d")
    points = [tuple(map(float, point.split())) for point in path[1:].split("L")]
    assert len(points) == 100
    assert points[49][1] > points[50][1], "a higher score is further up"
    assert len({y for _, y in points}) == 2


def test_the_picture_is_saved_with_names_and_colors(opened: Open, page: str) -> None:
    tab = opened(page)
    with tab.expect_download() as download:
        tab.locator("#board-0").get_by_role("button", name="Save as SVG").click()
    text = Path(download.value.path()).read_text()
    root = ElementTree.fromstring(text)
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert ">model-0 width=1</text>" in text
    assert "var(" not in text


def test_a_pair_is_chosen_from_the_matrix(opened: Open, page: str) -> None:
    tab = opened(page)
    tab.locator("#board-0 details.more summary").first.click()
    panel = tab.locator("#board-0-pair")
    assert "model-0 width=1 against model-1 width=2" in panel.inner_text()
    cell = tab.locator("#board-0 .matrix tbody tr").nth(3).locator("td").nth(0)
    cell.click()
    assert picked(tab) == ["model-3 width=8", "model-0 width=1"]
    assert "model-3 width=8 against model-0 width=1: is outperformed" in panel.inner_text()
    assert panel.locator("tbody td").count() == 49
    assert panel.locator("td.loss").count() > 0
    assert "model-3 width=8 against model-0 width=1: is outperformed" in cell.get_attribute("title")
    tab.locator("#board-0 .matrix tbody tr").nth(0).locator("td").nth(3).click()
    assert "model-0 width=1 against model-3 width=8: outperforms" in panel.inner_text()
    assert panel.locator("td.win").count() > 0
    tab.get_by_role("checkbox", name="Pick few").check()
    assert panel.inner_text() == "Pick two entries to see their cells."


def test_hostile_names_stay_text(opened: Open) -> None:
    entries = [boards.entry(name, speed=2 - i / 10) for i, name in enumerate(boards.HOSTILE)]
    tab = opened(boards.of(entries, [f"{name}: damaged" for name in boards.HOSTILE]))
    data = (
        "JSON.parse(document.getElementById('report-data').textContent).entries.map((entry) => entry.label)"
    )
    seen = tab.evaluate(data)
    harmless = {0x202E: "\ufffd", 0: "\ufffd", 0xD800: "\ufffd"}
    assert sorted(seen) == sorted(name.translate(harmless) for name in boards.HOSTILE)
    tab.locator("#board-0").get_by_role("button", name="Pick shown").click()
    for details in tab.locator("#board-0 details.more").all():
        details.locator("summary").first.click()
    places = ("#board-0-table tbody", "#refused", "#entries", "#board-0 .ladder", "#board-0 .legend", ".bars")
    for place in places:
        text = tab.locator(place).inner_text()
        assert [name for name in seen if name not in text] == []
    text = str(tab.locator("[data-sentences]").text_content())
    assert [name for name in seen if name not in text] == []
    for one in range(len(seen) - 1):
        tab.locator("#board-0 .matrix tbody tr").nth(one).locator("td").nth(one + 1).click()
        said = tab.locator("#board-0 .verdicts").inner_text() + tab.locator("#board-0-pair").inner_text()
        assert sum(name in said for name in seen) == 2
    assert tab.locator("main img, main script, body > img").count() == 0
    assert tab.title() == "Leaderboard"


def test_without_javascript_everything_is_there_and_printed(opened: Open, page: str) -> None:
    tab = opened(page, java_script_enabled=False)
    parts = {"-table tbody tr": 5, " .ladder .arc": 4, " .tiers tbody tr": 5, " .surface": 5}
    assert {part: tab.locator(f"#board-0{part}").count() for part in parts} == parts
    assert tab.locator("#board-0 .matrix tbody td").count() == 25
    assert "model-0" in tab.locator("#board-0-table tbody").inner_text()
    assert "model-0 width=1 needs " in tab.locator("#board-0 .verdict").inner_text()
    assert not tab.locator("#theme").is_visible()
    assert not tab.locator(".facts").first.is_visible()
    tab.emulate_media(media="print")
    assert tab.locator(".facts").first.is_visible()


def test_dark_mode_follows_the_system_and_the_button(opened: Open, page: str) -> None:
    tab = opened(page, color_scheme="dark")
    ground = "getComputedStyle(document.documentElement).backgroundColor"
    curve = tab.locator("#board-0 path.median").first
    dark, pale = tab.evaluate(ground), curve.get_attribute("stroke")
    assert dark != "rgb(255, 255, 255)"
    tab.get_by_role("button", name="Light mode").click()
    assert tab.evaluate(ground) == "rgb(255, 255, 255)"
    assert curve.get_attribute("stroke") != pale
    tab.get_by_role("button", name="Dark mode").click()
    assert (tab.evaluate(ground), curve.get_attribute("stroke")) == (dark, pale)


def test_no_page_scrolls_sideways(opened: Open) -> None:
    entries = [boards.entry("w" * 150), *(boards.entry(f"entry {i}", speed=1 + i / 2) for i in range(13))]
    tab = opened(boards.of(entries, ["x" * 400]))
    tab.get_by_role("button", name="Pick shown").click()
    tab.evaluate("document.querySelectorAll('details').forEach((details) => { details.open = true; })")
    fits = """document.documentElement.scrollWidth === innerWidth &&
      [...document.querySelectorAll('.plot')].every((plot) =>
      plot.querySelector('svg').getAttribute('width') === String(plot.clientWidth))"""
    overflow = {}
    for width in (1400, 1000, 800, 390, 320):
        tab.set_viewport_size({"width": width, "height": 900})
        for _ in range(1200):  # figures are drawn again shortly after the last change of size
            if tab.evaluate(fits):
                break
            tab.wait_for_timeout(50)
        overflow[width] = tab.evaluate("document.documentElement.scrollWidth") - width
    assert overflow == dict.fromkeys(overflow, 0)


def test_curves_drawn_at_first_have_the_first_colors_and_leave_room_on_a_phone(opened: Open) -> None:
    """Of nine entries the first, the third and the ninth are drawn, whose places are those of two colors."""
    speeds = [3 - i / 4 for i in range(9)]
    quantum = [0, 0, 9, 0, 0, 0, 0, 0, 0]
    members = [
        boards.entry(f"entry {i}", speed=s, quantum=q) for i, (s, q) in enumerate(zip(speeds, quantum))
    ]
    sized = boards.changed(members[8], parameters={"classical": 396, "quantum": 0})
    tab = opened(boards.of([*members[:8], sized]), 390)
    assert picked(tab) == ["entry 0", "entry 2", "entry 8"]
    tones = [line.get_attribute("class") for line in tab.locator("#board-0 .legend line").all()]
    assert tones == ["c0 dash0", "c1 dash0", "c2 dash0"]
    tab.locator("#board-0-table tbody tr").last.scroll_into_view_if_needed()
    tops = [tab.locator(f"#board-0 .picked .{name}").bounding_box()["y"] for name in ("plot", "verdicts")]
    assert tops[0] == 0, "the curves stay in sight"
    assert tops[1] < -1000, "the words do not"


def test_a_narrow_page_shows_cards_and_sorts_them(opened: Open, page: str) -> None:
    tab = opened(page, 390)
    assert not tab.locator("#board-0-table thead").is_visible()
    tab.locator("#board-0 .only-narrow select").select_option("final_score")
    scores = [float(value) for value in column(tab, "final_score")]
    assert scores == sorted(scores, reverse=True)
    labels = tab.evaluate(
        "[...document.querySelectorAll('#board-0-table tbody tr:first-child td:not(.rank, .with-bar)')]"
        ".map(cell => getComputedStyle(cell, '::before').content)"
    )
    assert '"Settings"' in labels
    assert "none" not in labels  # a number on a card is named


def test_print_shows_everything_in_light_colors(opened: Open, page: str) -> None:
    tab = opened(page, color_scheme="dark")
    tab.emulate_media(media="print")
    tab.locator("details:not([open])").first.wait_for(state="detached")  # the page is told shortly after
    assert tab.locator(".facts").first.is_visible()
    assert tab.locator("#board-0 .numbers").last.is_visible()
    assert not tab.locator("#theme").is_visible()
    plot = tab.locator("#board-0 .plot svg")
    for _ in range(1200):  # figures are drawn again
        if plot.bounding_box()["width"] <= 700:
            break
        tab.wait_for_timeout(50)
    assert plot.bounding_box()["width"] <= 700
    assert plot.locator("path.median").first.get_attribute("stroke") == "rgb(0, 114, 178)", "the light blue"
    tab.emulate_media(media="screen")
    tab.locator("details.more[open]").first.wait_for(state="detached")


def test_the_policy_forbids_foreign_scripts(opened: Open, page: str) -> None:
    foreign = page.replace("<main", "<script>document.title = 'foreign'</script><main", 1)
    tab = opened(page)
    blocked: list[str] = []
    tab.context.new_page()
    other = tab.context.pages[-1]
    other.on("console", lambda message: blocked.append(message.text))
    other.set_content(foreign)
    assert other.title() == "Leaderboard"
    assert any("Content Security Policy" in text for text in blocked)


def test_an_entry_has_one_color_in_every_picture_and_bands_are_those_of_a_few(opened: Open) -> None:
    long = [boards.entry(f"slow {i}", epochs=500, speed=0.4 - i / 20) for i in range(5)]
    short = [boards.entry(f"fast {i}", speed=3 - i / 2) for i in range(4)]
    tab = opened(boards.of([*short, *long]))
    assert tab.locator(".board").count() == 2
    looks: dict[str, set[str]] = {}
    for number in (0, 1):
        assert tab.locator(f"#board-{number} path.band").count() == 2
        tab.locator(f"#board-{number}").get_by_role("button", name="Pick shown").click()
        shown = tab.locator(f"#board-{number} path.median").count()
        assert tab.locator(f"#board-{number} path.band").count() == (shown if shown <= 5 else 0)
        for place in (".ranks tbody tr", ".legend li", ".bars tbody tr"):
            for row in tab.locator(f"#board-{number} {place}").all():
                look = str(row.locator(".swatch line").get_attribute("class"))
                name = next(word for word in re.findall(r"(?:slow|fast) \d", row.text_content()))
                looks.setdefault(name, set()).add(look)
        drawn = tab.locator(f"#board-{number} path.median")
        for item, curve in zip(tab.locator(f"#board-{number} .legend li").all(), drawn.all(), strict=True):
            tone = item.locator("line").evaluate("(line) => getComputedStyle(line).stroke")
            assert curve.get_attribute("stroke") == tone
    assert len(looks) == 9
    assert {name: look for name, look in looks.items() if len(look) > 1} == {}


def test_the_legend_names_the_ansatz(opened: Open) -> None:
    options = {"model_options": {"qubits": 4, "ansatz": "iqp"}}
    entry = boards.changed(boards.entry("ddqn vqc-native qubits=4", quantum=96), identity=options)
    tab = opened(boards.of([entry, boards.entry("ddqn mlp width=16")]))
    assert sorted(picked(tab)) == ["mlp width=16", "vqc-native qubits=4 ansatz=iqp"]
    hostile = boards.changed(entry, identity={"model_options": {"ansatz": boards.HOSTILE[0]}})
    assert boards.HOSTILE[0] not in render(boards.of([hostile]))


@pytest.mark.parametrize("external", [False, True])
def test_two_entries_of_few_seeds_have_a_verdict_and_an_axis(opened: Open, external: bool) -> None:
    few = [boards.entry(label, 10, speed=speed) for label, speed in (("one", 3), ("other", 1))]
    tab = opened(
        boards.of([boards.changed(entry, imported=ImportedRecord() if external else None) for entry in few])
    )
    (said,) = tab.locator("#board-0 .verdicts .verdict").all_inner_texts()
    assert said.startswith("one needs 65% fewer steps than other (")
    axis = tab.locator("#board-0 .plot svg").first.text_content()
    assert "score" in axis
    assert ("validation score" in axis) is not external
