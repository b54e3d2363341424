"""What the report says is what the statistics say, and what it packs can be read again."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shlex
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest

import qrlsuite
from qrlsuite import api
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard.boards.ranked import learning_curves
from qrlsuite.leaderboard.report import encode, entries, ladder, render, sections, winners
from qrlsuite.leaderboard.report.judge import judge
from qrlsuite.leaderboard.report.rows import sentence
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.options import parse_setting
from qrlsuite.results.records import ImportedRecord
from qrlsuite.statistics import Outcome, Verdict, compare
from tests.commands import say
from tests.conftest import Train
from tests.core.test_docs import parse
from tests.leaderboard import boards

ROOT = Path(__file__).parents[2]
NAMES = {
    Verdict.WIN: "+",
    Verdict.LOSS: "-",
    Verdict.TIE: ".",
    Verdict.BOTH_AT_CAP: "^",
    Verdict.UNDECIDED: "?",
}


def test_pairs_are_those_of_the_statistics() -> None:
    drawn = ("fast", 100, 100, 2), ("slow", 30, 100, 0.4), ("slower", 25, 120, 0.3), ("few", 8, 100, 1)
    members = [boards.entry(*each) for each in drawn]
    (section,) = boards.of(members).sections
    found = judge(section)
    grid = members[0].task_file.ranking.grid
    for pair in found.pairs:
        one, other = (learning_curves(section.rows[place].entry) for place in (pair.first, pair.second))
        wanted = compare(one, other, grid, horizon=200_000)
        assert pair.cells == "".join(NAMES[verdict] for row in wanted.verdicts for verdict in row)
        assert (pair.n_runs, pair.outcome(pair.first)) == (wanted.n_runs, wanted.outcome)
        np.testing.assert_array_equal(found.evidence[pair.first, pair.n_runs].point, wanted.points[0])
        np.testing.assert_array_equal(
            found.evidence[pair.second, pair.n_runs].interval(), wanted.intervals[1]
        )
    outcomes = {pair.outcome(0) for pair in found.pairs if pair.first == 0}
    assert outcomes == {Outcome.OUTPERFORMS, Outcome.UNDECIDED}
    assert any("^" in pair.cells for pair in found.pairs)


def test_a_page_agrees_with_its_board() -> None:
    board = boards.of([*boards.graded(6), boards.entry("few", 8)])
    (section,) = board.sections
    judged, wins = judge(section), {row.entry.label: row.outperforms for row in section.tiers}
    labels = [row.entry.label for row in section.rows]
    for place, label in enumerate(labels):
        pairs = {other: judged.pair(place, other) for other in range(len(labels)) if other != place}
        beaten = {
            labels[other] for other, pair in pairs.items() if pair.outcome(place) is Outcome.OUTPERFORMS
        }
        assert beaten == set(wins[label])


def test_arcs_that_a_chain_stands_for_are_left_out() -> None:
    chain = np.triu(np.ones((4, 4), dtype=bool), 1)
    drawn = ladder.draw(chain, [1, 2, 3, 4])
    assert [(arc.start, arc.end) for arc in drawn.arcs] == [(0, 1), (1, 2), (2, 3)]
    assert (drawn.implied, drawn.chains_without_win) == (3, 0)


def test_an_arc_reaches_the_further_the_more_rows_it_spans_and_stays_inside() -> None:
    beats = np.zeros((7, 7), dtype=bool)
    for start, end in ((0, 1), (1, 4), (0, 6)):
        beats[start, end] = True
    arcs = ladder.draw(beats, [1, 2, 2, 2, 3, 3, 3]).arcs
    rows = {arc.end - arc.start: float(re.match(r"M6 [\d.]+C([\d.]+) ", arc.line)[1]) for arc in arcs}  # type: ignore[index]
    reached = {span: 0.75 * bend for span, bend in rows.items()}  # of a cubic with these control points
    assert reached[1] < 0.5 * reached[6]
    assert reached[1] < reached[3] < reached[6] < ladder.WIDTH


def test_a_chain_without_a_direct_win_is_counted() -> None:
    beats = np.triu(np.ones((3, 3), dtype=bool), 1)
    beats[0, 2] = False
    drawn = ladder.draw(beats, [1, 2, 3])
    assert (len(drawn.arcs), drawn.implied, drawn.chains_without_win) == (2, 0, 1)


def test_a_circle_keeps_all_its_arcs() -> None:
    circle = np.array([[0, 1, 0, 1], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 0]], dtype=bool)
    drawn = ladder.draw(circle, [1, 1, 1, 2])
    assert [(arc.start, arc.end) for arc in drawn.arcs if arc.circle] == [(0, 1), (1, 2), (2, 0)]
    assert [(arc.start, arc.end) for arc in drawn.arcs if not arc.circle] == [(0, 3)]


@pytest.mark.parametrize("count", [1, 2, 7])
def test_packed_curves_read_back(count: int) -> None:
    values = np.linspace(-3.0, 5.0, count)
    text = encode.pack(values, -3.0, 5.0)
    octets = base64.b64decode(text + "AA" * (count % 2))
    bits = np.unpackbits(np.frombuffer(octets, np.uint8)).reshape(-1, 12)
    codes = bits @ (1 << np.arange(11, -1, -1))
    assert len(text) == 2 * count
    np.testing.assert_allclose(-3.0 + 8.0 * codes[:count] / 4094, values, atol=8 / 4094 / 2)


def test_what_is_not_a_number_is_packed_as_missing() -> None:
    assert encode.pack(np.array([np.nan, 0.0, np.inf]), 0.0, 1.0) == "//AA//"


def test_a_large_board_carries_a_selection_of_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(entries, "SINGLE_RUNS", 1000)
    views = entries.views(boards.graded(4))
    entries.paint(views[2:])
    entries.paint(views)
    assert [view.color for view in reversed(views)] == [1, 0, 3, 2], "reading a color gives none"
    data = entries.curves_data(views)
    assert [entry["kept"] for entry in data] == [2] * 4
    assert sum(len(entry["single"]) for entry in data) <= 2 * 1000


@pytest.mark.parametrize("name", boards.HOSTILE)
def test_nothing_ends_the_data_element(name: str) -> None:
    text = encode.script_json({"name": encode.clean(name)})
    assert not set("<>&\u2028\u2029") & set(text)
    assert json.loads(text)["name"] == encode.clean(name)
    text.encode("utf-8")


def test_names_are_cut_and_lose_what_no_escaping_helps_against() -> None:
    assert encode.clean("a\u202eb\x1b[31m\u200bc\n d") == "a\ufffdb\ufffd[31m\ufffdc d"
    assert len(encode.clean("x" * 10_000)) == encode.LONGEST


def test_equal_labels_are_told_apart() -> None:
    twins = [boards.entry("same", 20), boards.entry("same", 21)]
    named = [boards.changed(twin, name=f"same-{i}") for i, twin in enumerate(twins, 1)]
    assert [view.label for view in entries.views(named)] == ["same (same-1)", "same (same-2)"]


def test_a_task_has_one_row_in_who_wins_where_and_its_policies_are_named() -> None:
    whole = [
        boards.entry(name, epochs=500, speed=speed, task="cartpole") for name, speed in (("a", 1), ("b", 2))
    ]
    page = render(boards.of([*whole, *boards.graded(2)]))
    answers = page.partition('<table class="answers"')[2].partition("</table>")[0]
    assert re.findall(r"#board-(\d)", answers) == [
        "0",
        "2",
        "1",
    ]  # beam6g; cartpole at its whole and its short horizon
    assert ">100k steps</a>" in answers
    assert "final score of random 0.37, nearest antenna 0.976, optimal 1." in page
    assert '"policies":[["random",0.044]]' in page.replace(" ", "")


def test_the_page_names_no_other_place_but_the_paper() -> None:
    text = render(boards.of(boards.graded(2)))
    without_scripts = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert set(re.findall(r"""(?:src|href)=["']?(?!#|data:)([^"'> ]+)""", without_scripts)) == {
        "https://arxiv.org/abs/2501.15893"
    }
    assert "@import" not in without_scripts
    assert "url(" not in without_scripts


def test_a_page_of_curves_of_others_has_no_empty_columns_and_no_parameters() -> None:
    unknown = {"imported": ImportedRecord(), "parameters": {"classical": 0, "quantum": 0}, "seconds": 0.0}
    entries = [
        boards.changed(boards.entry(name, task=task, speed=speed), **unknown)
        for task in ("beam6g", "cartpole")
        for name, speed in (("a", 1), ("b", 2), ("c", 3))
    ]
    page = render(boards.of(entries))
    heads = set(re.findall(r'<th role="columnheader"[^>]*>([^<]*)', page))
    assert {"Best entry", "Vs. first", "Final score", "Seeds"} <= heads
    assert not heads & {"Best circuit", "Network nearest in size", "Core-hours", "Parameters", "Settings"}
    shown = page.partition("<main")[0] + page.partition('id="entries"')[2].partition("</main>")[0]
    assert not re.findall(r"0 parameters|0 core-hours|0 classical|Core-hours", shown)


def test_an_empty_board_is_still_a_page() -> None:
    assert "runs/x: damaged" in render(boards.of([], ["runs/x: damaged"]))


def test_the_command_writes_a_page(tmp_path: Path, train: Train) -> None:
    folder = train("runs", [0], epochs=1).parents[1]
    result = say("leaderboard", "--runs", str(folder), "--format", "html")
    assert result.stdout == f"wrote {folder / 'leaderboard.html'}\n"
    assert "<h1>Leaderboard</h1>" in (folder / "leaderboard.html").read_text()
    both = boards.refused("leaderboard", "--runs", folder, "--format", "csv", "--out", "page.html")
    assert both.endswith("--out page.html, which is html: give one of them")
    say("leaderboard", "--runs", str(folder), "--out", str(folder / "page.html"))
    assert "<h1>Leaderboard</h1>" in (folder / "page.html").read_text()


def test_boards_are_counted_and_a_circuit_is_set_against_the_network_of_its_size() -> None:
    """100 parameters are nearer to 110 than to 90, by ratio; the fast network and the slow one are on both boards."""

    def drawn(task: str, circuit: float) -> list[EntryResults]:
        made = [boards.entry(f"mlp width={n}", speed=v, task=task) for n, v in ((99, 3), (9, 2), (11, 1))]
        made = [
            boards.changed(each, parameters={"classical": n})
            for each, n in zip(made, (1000, 90, 110), strict=True)
        ]
        circuits = [
            boards.changed(
                boards.entry(f"vqc{n}", speed=v, task=task), parameters={"classical": 60, "quantum": 40}
            )
            for n, v in ((0, circuit), (1, 9), (2, 9))
        ]
        for each, at in zip(circuits, (None, "model_options", "ansatz_options")):
            control = {"entangled": "separable" if at == "model_options" else "mean-field"}
            if at is not None:
                each.identity["model_options"] = control if at == "model_options" else {at: control}
        return [*made, *circuits]

    board = boards.of([*drawn("beam6g", 1.6), *drawn("cartpole", 0.5)])
    shown = entries.views([row.entry for section in board.sections for row in section.rows])
    by_curves = {id(entry.curves): entry for entry in shown}
    found = [sections.view(section, 0, by_curves).winners for section in board.sections]
    assert [each.sized.name for each in found if each.sized is not None] == ["mlp width=11"] * 2
    assert winners.outcome(found) == [
        "The best network needs fewer steps than the best circuit on 2 of 2 boards.",
        "The best circuit needs fewer steps than the network nearest in size on 1 of 2 boards, more on 1.",
    ]
    assert winners.outcome(found[:1]) == []


@pytest.mark.parametrize("task", ["cartpole", "beam6g+7d1167f1"])
def test_every_published_entry_is_one_click_from_its_commands(task: str) -> None:
    board = api.board(task, published=True, runs="none")
    for view in entries.views([row.entry for row in board.sections[0].rows]):
        commands = {term: shlex.split(line) for term, line in view.commands}
        assert list(commands) == ["Train", "Check", "Curves"] + ["Play"] * bool(view.curves.agents)
        assert {parse(words[1:]) for words in commands.values()} == {""}
        _, _, label, _, name, *rest = commands["Train"]
        assert (
            resolve(name, label, settings=[parse_setting(text) for text in rest[1:-2:2]]).name
            == view.curves.name
        )
        assert (ROOT / commands["Check"][2] / "entry.json").is_file()


def test_a_board_is_cited_by_what_it_ranks() -> None:
    """The hash follows a score and no order, and JSON has it; names of files are no markup in a badge."""
    one, other = boards.entry("<b>fast</b>", speed=2), boards.entry("slow", speed=0.5)
    changed = boards.changed(other, curves=np.where(other.curves == other.curves.max(), 0.5, other.curves))
    board = boards.of([one, other])
    ((section,), (forged,)) = (boards.of(each).sections for each in ([one, other], [one, changed]))
    content = section.hash
    assert content == dataclasses.replace(section, rows=section.rows[::-1]).hash != forged.hash
    assert board.as_dict()["sections"][0]["hash"] == content
    page = render(board)
    assert f"version = {{{qrlsuite.__version__}}}" in page
    assert f"note = {{2 entries, content hash {content}}}" in page
    (saved,) = re.findall(r'download="beam6g.svg" href="data:image/svg\+xml,([^"]+)"', page)
    texts = [element.text for element in ElementTree.fromstring(unquote(saved)).iter()]
    assert "<b>fast</b>: rank 1 of 2 entries" in texts


def test_notes_begin_with_a_capital_but_for_options_and_have_no_marks_of_code() -> None:
    assert sentence("rank: `qrlsuite compare` decides") == "Rank: qrlsuite compare decides"
    assert sentence("target_steps=2000 copies nothing") == "target_steps=2000 copies nothing"
