"""The report in a real browser: offline, sortable, readable everywhere, and deaf to hostile names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.leaderboard.boards import board
from qrlsuite.leaderboard.report import render
from qrlsuite.leaderboard.shelf import collect
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


def test_a_board_of_published_size_loads_offline_and_is_small(opened: Open) -> None:
    text = render(boards.of(boards.graded(8, seeds=100)))
    assert len(text.encode()) < 1_500_000
    tab = opened(text)
    assert tab.locator(".plot .main-svg").count() >= 2
    assert tab.locator("#board-0-table tbody tr").count() == 8


def test_the_table_sorts_by_click(opened: Open, page: str) -> None:
    tab = opened(page)
    means = [float(value) for value in column(tab, "mean")[:-1]]
    assert means == sorted(means)
    assert column(tab, "mean")[-1] == "", "fewer than 20 seeds"
    header = tab.locator("#board-0-table th[data-key=steps]")
    header.get_by_role("button").click()
    up = [int(value) for value in column(tab, "steps")]
    assert up == sorted(up)
    assert header.get_attribute("aria-sort") == "ascending"
    assert tab.locator("#board-0-table [aria-sort]").count() == 1
    header.get_by_role("button").click()
    assert [int(value) for value in column(tab, "steps")] == up[::-1]
    assert header.get_attribute("aria-sort") == "descending"


def test_an_unranked_entry_stays_last_whichever_way_ranks_are_sorted(opened: Open, page: str) -> None:
    tab = opened(page)
    for reverse in (False, True):
        tab.locator("#board-0-table th[data-key=rank] button").click()
        assert column(tab, "rank") == [*sorted(column(tab, "rank")[:-1], reverse=reverse), ""]


def test_the_table_sorts_by_keyboard(opened: Open, page: str) -> None:
    tab = opened(page)
    for _ in range(60):
        tab.keyboard.press("Tab")
        if tab.evaluate("document.activeElement.closest('th')?.dataset.key") == "parameters":
            break
    outline = tab.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    tab.keyboard.press("Enter")
    values = [int(value) for value in column(tab, "parameters")]
    assert values == sorted(values)
    assert outline == "solid"


def test_the_first_stop_of_the_keyboard_skips_to_the_content(opened: Open, page: str) -> None:
    tab = opened(page)
    tab.keyboard.press("Tab")
    assert tab.evaluate("document.activeElement.className") == "skip"
    tab.keyboard.press("Enter")
    assert tab.evaluate("document.activeElement.id") == "content"


def test_a_pair_is_chosen_from_the_matrix_and_from_the_lists(opened: Open, page: str) -> None:
    tab = opened(page)
    panel = tab.locator("#board-0-pair")
    tab.get_by_role("button", name="model-3 width=8 against model-0 width=1").click()
    assert "Is outperformed" in panel.inner_text()
    assert panel.locator("tbody td").count() == 49
    assert panel.locator("td.loss").count() > 0
    panel.get_by_label("First entry").select_option(label="1  model-0 width=1")
    panel.get_by_label("Second entry").select_option(label="4  model-3 width=8")
    assert "Outperforms" in panel.inner_text()
    assert panel.locator("td.win").count() > 0


def test_hostile_names_stay_text(opened: Open) -> None:
    entries = [boards.entry(name, speed=2 - i / 10) for i, name in enumerate(boards.HOSTILE)]
    tab = opened(boards.of(entries, [f"{name}: damaged" for name in boards.HOSTILE]))
    data = (
        "JSON.parse(document.getElementById('report-data').textContent).entries.map((entry) => entry.label)"
    )
    seen = tab.evaluate(data)
    harmless = {0x202E: "\ufffd", 0: "\ufffd", 0xD800: "\ufffd"}
    assert sorted(seen) == sorted(name.translate(harmless) for name in boards.HOSTILE)
    curves, bars = (tab.locator(f"#board-0-{kind}") for kind in ("curves", "bars"))
    for place in ("#board-0-table tbody", "#refused", "#entries", "#board-0 .ladder", "#board-0 .legend"):
        text = tab.locator(place).inner_text()
        assert [name for name in seen if name not in text] == []
    text = tab.locator("#board-0-pair select").first.text_content()
    assert [name for name in seen if name not in text] == []

    curves.hover()  # plotly reads labels as markup
    text = shown(tab, curves)
    assert [name for name in seen if name[:40] not in text] == []
    told = ""
    bars.scroll_into_view_if_needed()
    for trace in bars.locator(".subplot.xy .barlayer .trace").all():
        tab.mouse.move(0, 0)  # the last label has to go, or it would be read again
        bars.locator(".hoverlayer text").first.wait_for(state="detached")
        trace.locator(".point").first.hover(force=True)
        told += shown(tab, bars)
    assert [name for name in seen if name[:40] not in told] == []
    assert tab.locator(".hoverlayer a, .hoverlayer [style*='bold']").count() == 0
    assert tab.locator("main img, main script, body > img").count() == 0
    assert tab.title() == "Sample complexity leaderboard"


def shown(tab: Any, plot: Any) -> str:
    """What plotly shows at the pointer, once it does."""
    label = plot.locator(".hoverlayer text").first
    label.wait_for(state="attached")
    return str(plot.locator(".hoverlayer").text_content())


def test_dark_mode_follows_the_system_and_the_button(opened: Open, page: str) -> None:
    tab = opened(page, color_scheme="dark")
    ground = "getComputedStyle(document.documentElement).backgroundColor"
    plot = "document.querySelector('#board-0-curves .main-svg').style.background"
    dark = tab.evaluate(ground)
    assert dark == tab.evaluate(plot) != "rgb(255, 255, 255)"
    tab.get_by_role("button", name="Light mode").click()
    assert tab.evaluate(ground) == tab.evaluate(plot) == "rgb(255, 255, 255)"
    tab.get_by_role("button", name="Dark mode").click()
    assert tab.evaluate(ground) == tab.evaluate(plot) == dark


def test_no_page_scrolls_sideways(opened: Open) -> None:
    entries = [boards.entry("w" * 150), *(boards.entry(f"entry {i}", speed=1 + i / 2) for i in range(13))]
    tab = opened(boards.of(entries, ["x" * 400]))
    tab.evaluate("document.querySelectorAll('details').forEach((details) => { details.open = true; })")
    fits = """document.documentElement.scrollWidth === innerWidth &&
      [...document.querySelectorAll('.plot')].every((plot) =>
      plot.querySelector('.main-svg').getAttribute('width') === String(plot.clientWidth))"""
    overflow = {}
    for width in (1400, 1000, 800, 390, 320):
        tab.set_viewport_size({"width": width, "height": 900})
        for _ in range(1200):  # figures are drawn again shortly after the last change of size
            if tab.evaluate(fits):
                break
            tab.wait_for_timeout(50)
        overflow[width] = tab.evaluate("document.documentElement.scrollWidth") - width
    assert overflow == dict.fromkeys(overflow, 0)


def test_a_narrow_page_shows_cards_and_sorts_them(opened: Open, page: str) -> None:
    tab = opened(page, 390)
    assert not tab.locator("#board-0-table thead").is_visible()
    tab.locator("#board-0 .only-narrow select").select_option("score")
    scores = [float(value) for value in column(tab, "score")]
    assert scores == sorted(scores, reverse=True)
    labels = tab.evaluate(
        "[...document.querySelectorAll('#board-0-table tbody tr:first-child td:not(.rank, .steps)')]"
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
    plot = tab.locator("#board-0-curves .main-svg").first
    for _ in range(1200):  # figures are drawn again
        if "rgb(255, 255, 255)" in plot.get_attribute("style") and plot.bounding_box()["width"] <= 700:
            break
        tab.wait_for_timeout(50)
    assert "rgb(255, 255, 255)" in plot.get_attribute("style")
    assert plot.bounding_box()["width"] <= 700
    tab.emulate_media(media="screen")
    tab.locator("details[open]").first.wait_for(state="detached")


def test_print_without_javascript_opens_everything(opened: Open, page: str) -> None:
    tab = opened(page, java_script_enabled=False)
    assert not tab.locator(".facts").first.is_visible()
    tab.emulate_media(media="print")
    assert tab.locator(".facts").first.is_visible()


def test_without_javascript_tables_and_tiers_are_there(opened: Open, page: str) -> None:
    tab = opened(page, java_script_enabled=False)
    assert tab.locator("#board-0-table tbody tr").count() == 5
    assert "model-0" in tab.locator("#board-0-table tbody").inner_text()
    assert tab.locator("#board-0 .ladder .arc").count() == 4
    assert tab.locator("#board-0 .tiers tbody tr").count() == 5
    assert tab.locator("#board-0 .surface").count() == 5
    assert tab.locator("#board-0 .matrix tbody td").count() == 25
    assert not tab.locator("#theme").is_visible()


def test_single_runs_and_entries_are_switched(opened: Open, page: str) -> None:
    tab = opened(page)
    lines = tab.locator("#board-0-curves .scatterlayer .trace")
    before = lines.count()
    tab.locator("#board-0").get_by_label("Single runs").check()
    assert lines.count() == before + 5
    tab.locator("#board-0 .legend").get_by_label("model-0 width=1").uncheck()
    assert lines.count() == before + 5 - 3
    assert tab.locator("#board-0-bars .barlayer .trace").count() == 2 * 4


def test_a_link_opens_the_details_of_its_entry(opened: Open, page: str) -> None:
    tab = opened(page)
    assert not tab.get_by_text("Options of the algorithm").first.is_visible()
    tab.locator("#board-0-table").get_by_role("link", name="model-0 width=1").click()
    tab.get_by_text("Options of the algorithm").first.wait_for(state="visible")


def test_the_policy_forbids_foreign_scripts(opened: Open, page: str) -> None:
    foreign = page.replace("<main", "<script>document.title = 'foreign'</script><main", 1)
    tab = opened(page)
    blocked: list[str] = []
    tab.context.new_page()
    other = tab.context.pages[-1]
    other.on("console", lambda message: blocked.append(message.text))
    other.set_content(foreign)
    assert other.title() == "Sample complexity leaderboard"
    assert any("Content Security Policy" in text for text in blocked)


def test_a_real_entry(opened: Open, train: Callable[..., Path]) -> None:
    folder = train("runs", [0, 1], epochs=3)
    train("runs", [0, 1], epochs=2, settings=("width=8",))
    found, refused = collect.collect(folder.parents[1])
    tab = opened(board.build(found, refused))
    assert "mlp width=8" in tab.locator("main").inner_text()
    assert tab.locator(".board").count() == 2


def test_every_bar_is_filled_however_many_entries_there_are(opened: Open) -> None:
    tab = opened(boards.of(boards.graded(16)))
    for box in tab.locator("#board-0 .legend input[data-place]").all():
        box.check()
    patterns = tab.locator("#board-0-bars pattern")
    assert patterns.count() > 0
    grounds = (
        "[...document.querySelectorAll('#board-0-bars pattern')].map((each) => each.querySelector('rect'))"
    )
    fills = tab.evaluate(f"{grounds}.map((rect) => rect?.getAttribute('fill'))")
    colors = tab.evaluate("document.querySelector('#board-0-bars').data.map((trace) => trace.marker.color)")
    assert {fill or "none" for fill in fills} <= set(colors), (
        "from the eighth entry on, patterns had no ground"
    )


def test_an_entry_has_one_color_in_every_picture(opened: Open) -> None:
    long = [boards.entry(f"slow {i}", epochs=500, speed=0.4 - i / 20) for i in range(5)]
    short = [boards.entry(f"fast {i}", speed=3 - i / 2) for i in range(4)]
    tab = opened(boards.of([*short, *long]))
    assert tab.locator(".board").count() == 2
    looks: dict[str, set[str]] = {}
    for number in (0, 1):
        for box in tab.locator(f"#board-{number} .legend input[data-place]").all():
            box.check()
        for row in tab.locator(f"#board-{number} .ranks tbody tr").all():
            look = str(row.locator(".swatch line").get_attribute("class"))
            looks.setdefault(row.locator("a").first.inner_text(), set()).add(look)
        for kind, color in (("curves", "trace.line.color"), ("bars", "trace.marker.color")):
            script = (
                f"document.querySelector('#board-{number}-{kind}').data.map((trace) => [trace.name, {color}])"
            )
            for name, tone in tab.evaluate(script):
                if name:
                    looks.setdefault(f"{name} in pictures", set()).add(tone)
    assert len(looks) == 2 * 9
    assert {name: look for name, look in looks.items() if len(look) > 1} == {}


def test_bands_are_those_of_a_few(opened: Open) -> None:
    tab = opened(boards.of(boards.graded(6)))
    bands = "document.querySelector('#board-0-curves').data.filter((trace) => trace.fill === 'toself').length"
    assert tab.evaluate(bands) == 0
    tab.locator("#board-0 .legend label").nth(2).hover()
    assert tab.evaluate(bands) == 1
    tab.mouse.move(0, 0)
    assert tab.evaluate(bands) == 0
    tab.locator("#board-0 .legend input").first.uncheck()
    tab.mouse.move(0, 0)
    assert tab.evaluate(bands) == 5


def test_the_legend_names_the_ansatz(opened: Open) -> None:
    options = {"model_options": {"qubits": 4, "ansatz": "iqp"}}
    entry = dataclasses.replace(boards.entry("ddqn vqc-native qubits=4", quantum=96), identity=options)
    tab = opened(boards.of([entry, boards.entry("ddqn mlp width=16")]))
    legend = tab.locator("#board-0 .legend").inner_text().splitlines()
    assert {"ddqn vqc-native qubits=4 ansatz=iqp", "ddqn mlp width=16"} <= {line.strip() for line in legend}
    hostile = dataclasses.replace(entry, identity={"model_options": {"ansatz": boards.HOSTILE[0]}})
    assert boards.HOSTILE[0] not in render(boards.of([hostile]))
