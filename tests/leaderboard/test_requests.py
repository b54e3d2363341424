"""A verdict names the seeds that were asked for and are not there, and is incomplete until they are."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from qrlsuite import api
from qrlsuite.engine.worker import train_group
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment.entry import resolve
from qrlsuite.leaderboard.shelf import collect, published
from qrlsuite.results import claims, requests
from qrlsuite.results.store import EntryStore
from qrlsuite.results.survey import look
from tests.commands import answer, say

pytestmark = pytest.mark.usefixtures("forked_workers")


@pytest.fixture(scope="module")
def _trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.conftest import TINY

    root = tmp_path_factory.mktemp("asked")
    (root / "tiny.toml").write_text(TINY)
    return root


@pytest.fixture
def runs(_trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two entries of 24 seeds, trained by the command."""
    monkeypatch.chdir(_trained)
    for width in (8, 16) if not (_trained / "runs").exists() else ():
        api.train("tiny.toml", f"mlp width={width}", seeds=24, workers=1, progress=False)
    shutil.copytree(_trained / "runs", tmp_path / "runs")
    return tmp_path / "runs"


def lose(runs: Path, width: int, *seeds: int) -> EntryStore:
    (folder,) = (Path(each.folder) for each in [api.load(f"mlp width={width}", runs=runs)])
    for seed in seeds:
        shutil.rmtree(folder / f"seed-{seed:04d}")
    return EntryStore(folder)


SAID = "4 of 24 seeds are missing: 6, 7, 9, 18"


def test_deleted_seeds_make_every_verdict_incomplete(runs: Path, tmp_path: Path) -> None:
    assert "incomplete" not in say("compare", "mlp width=8", "mlp width=16", "--runs", str(runs)).stdout
    lose(runs, 8, 6, 7, 9, 18)
    compared = say("compare", "mlp width=8", "mlp width=16", "--runs", str(runs)).stdout
    assert compared.startswith("incomplete: ")
    assert SAID in " ".join(compared.split())
    assert SAID in answer("compare", "mlp width=8", "mlp width=16", "--runs", str(runs))["notes"][0]
    for axis in ("steps", "executions", "core-hours", "score", "area"):
        board = say("leaderboard", "--by", axis, "--runs", str(runs)).stdout
        assert SAID in " ".join(board.split()), axis
        found = api.board(by=axis, runs=runs)
        assert SAID in str(found.as_dict()["sections"]), axis
        ranked = [row for row in found.flat() if row["rank"] is not None]
        assert "mlp width=8" not in str([row["label"] for row in ranked]), axis
    assert [place.tier for place in api.board(runs=runs, rule="paper").sections[0].tiers] == [None, None]
    page = tmp_path / "page.html"
    say("leaderboard", "--runs", str(runs), "--format", "html", "--out", str(page))
    assert SAID in page.read_text()
    with pytest.raises(QrlSuiteError, match=SAID):
        say("export", "mlp width=8", "--runs", str(runs), "--out", str(tmp_path / "out"))
    api.train("tiny.toml", "mlp width=8", seeds=24, runs=runs, workers=1, progress=False)
    assert not api.load("mlp width=8", runs=runs).missing


def test_the_best_seeds_trained_on_are_not_all_that_were_asked_for(runs: Path) -> None:
    best = [seed for seed in range(24) if seed not in (6, 7, 9, 18)]
    entry = api.train("tiny.toml", "mlp width=8", seeds=best, epochs=4, runs=runs, workers=1, progress=False)
    assert entry is not None
    assert (entry.epochs, len(entry.seeds), entry.missing_text) == (4, 20, SAID)
    assert "missing" not in str(api.board(runs=runs).as_dict()), "at the task's horizon, all are there"
    assert SAID in str(api.board(runs=runs, horizon=240).as_dict())


def test_a_withdrawn_request_is_named_with_its_reason(runs: Path, tmp_path: Path) -> None:
    store = lose(runs, 8, 6)
    rm = ("runs", "rm", "mlp width=8", "--runs", str(runs), "--yes", "--seeds")
    for text in ("6,7", "6,7 because=it", "6,7 reason=' '", "6,7 reason='a\nb'"):
        with pytest.raises(OptionError, match="reason"):
            say(*rm, text)
    with pytest.raises(OptionError, match="has no seeds 24:25"):
        say(*rm, "24:25 reason=x")
    with pytest.raises(OptionError, match="--seeds 6: write 6:7 for this seed, 0:6 for so many"):
        say(*rm, "6 reason=x")
    (lose(runs, 16, 6).path / requests.FILE).unlink()
    with pytest.raises(OptionError, match="has no seeds 6:7, missing or not"):
        say(*rm[:3], "mlp width=16", *rm[3:], "6:8 reason=x")
    assert requests.read(store)[0].keys() == {*range(24)}
    say(*rm, "6,7 reason='the disk failed'")
    entry = api.load("mlp width=8", runs=runs)
    assert (entry.missing, 7 in entry.seeds) == ((), False)
    note = "seeds that were asked for, and withdrawn: mlp width=8 (6:8: the disk failed)"
    compared = api.compare("mlp width=8", "mlp width=16", runs=runs)
    assert note in " ".join(compared.further).replace("ddqn ", "")
    assert not compared.sentence.startswith("incomplete")
    say("export", "mlp width=8", "--runs", str(runs), "--out", str(tmp_path / "out"))
    (folder,) = (tmp_path / "out" / "tiny").iterdir()
    assert published.read(folder).entry_results().withdrawn == {6: "the disk failed", 7: "the disk failed"}
    say("import", str(folder), "--runs", str(tmp_path / "other"))
    assert api.load("mlp width=8", runs=tmp_path / "other").withdrawn == entry.withdrawn
    whole = tmp_path / "whole"
    shutil.copytree(Path("runs"), whole)
    say("import", str(runs), "--runs", str(whole))
    assert not api.load("mlp width=8", runs=whole).withdrawn, "its seeds are there"
    api.train("tiny.toml", "mlp width=8", seeds=24, runs=runs, workers=1, progress=False)
    assert (api.load("mlp width=8", runs=runs).withdrawn, len(api.load("mlp width=8", runs=runs).seeds)) == (
        {},
        24,
    )


def test_seeds_at_work_are_still_training(runs: Path) -> None:
    store = lose(runs, 8, 6, 7, 9)
    claim = claims.acquire(store, [6, 7])
    said = "2 of 24 seeds are still training; 1 of 24 seeds is missing: 9"
    assert api.load("mlp width=8", runs=runs).missing_text == said
    assert look(store).seeds == {"finished": 21, "running": 2}
    claim.release()


def test_a_run_that_was_stopped_is_incomplete_until_it_is_continued(runs: Path) -> None:
    store = EntryStore.create(runs, resolve("tiny.toml", "mlp width=4"))
    requests.add(store, range(20), 3, code="code")
    train_group(store.path, range(20), 2)
    entry = api.load("mlp width=4", runs=runs)
    assert (entry.epochs, len(entry.seeds), len(entry.missing)) == (2, 20, 20)
    assert api.compare("mlp width=4", "mlp width=8", runs=runs).sentence.startswith(
        "incomplete: after 120 of 180"
    )
    (section,) = api.board(runs=runs, horizon=120).sections
    assert {row.entry.label: row.time.rank_text for row in section.rows}["ddqn mlp width=4"] == "-"
    train_group(store.path, range(20), 3)
    assert not api.load("mlp width=4", runs=runs).missing


def test_seeds_that_all_began_anew_by_another_code_have_moved(runs: Path) -> None:
    store = lose(runs, 8)
    anew = store.path.with_name(f"{store.name}@0123abcd")
    shutil.copytree(store.path, anew)
    lose(runs, 8, 6, 7)
    moved = f"trained anew, by another code ({anew.name})"
    found = collect.read(store)
    assert found is not None
    assert (found.missing, found.withdrawn) == ((), {6: moved, 7: moved})
    shutil.rmtree(anew / "seed-0003")
    found = collect.read(store)
    assert found is not None
    assert (found.missing, found.withdrawn) == ((6, 7), {})


def test_results_from_before_have_the_seeds_they_have_until_more_is_asked_for(runs: Path) -> None:
    store = lose(runs, 8, 6)
    (store.path / requests.FILE).unlink()
    assert not api.load("mlp width=8", runs=runs).missing
    api.train("tiny.toml", "mlp width=8", seeds=[0, 30], runs=runs, workers=1, progress=False)
    assert requests.read(store)[0].keys() == {*range(24), 30} - {6}


def test_parallel_requests_and_torn_lines_lose_nothing(runs: Path) -> None:
    store = lose(runs, 8)
    with (store.path / requests.FILE).open("ab") as file:
        file.write(b'{"seeds":[1')
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda seed: requests.add(store, [seed], 3), range(30, 50)))
    assert requests.read(store)[0].keys() == {*range(24), *range(30, 50)}
    assert set(requests.read(store)[0].values()) == {3}
    before = (store.path / requests.FILE).read_bytes()
    requests.add(store, range(24), 2)
    requests.add(store, [1_000_000], 2)
    assert (store.path / requests.FILE).read_bytes() == before, "nothing new was asked for"
