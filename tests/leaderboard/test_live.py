"""`qrlsuite view`: the page while runs go on, in a real browser; and what it refuses."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.report import live
from tests.commands import HANGS, Command, qrlsuite, start
from tests.conftest import Hold, Train, trainer

View = Callable[..., tuple[Command, str]]


@pytest.fixture
def view(tmp_path: Path) -> Iterator[View]:
    """Start `qrlsuite view`; returns the process and its address once it is printed."""
    started = []

    def begin(*words: str) -> tuple[Command, str]:
        path = tmp_path / f"view-{len(started)}.txt"
        with path.open("wb") as output:
            command = Command(["view", "--runs", str(tmp_path / "runs"), *words], output=output)
        started.append(command)
        while not (found := re.search(r"http://127\.0\.0\.1:\d+", path.read_text())):
            assert command.poll() is None, path.read_text()
            time.sleep(0.05)
        return command, found[0]

    yield begin
    for command in started:
        if command.poll() is None:
            command.kill()
            command.wait(HANGS)


def answer(address: str, path: str = "/", method: str = "GET", **headers: str) -> tuple[int, str]:
    """Send one request as it is written here, and return the code and the text of the answer."""
    connection = http.client.HTTPConnection(address.removeprefix("http://"), timeout=HANGS)
    connection.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    reply = connection.getresponse()
    return reply.status, reply.read().decode()


def contents(folder: Path) -> dict[Path, tuple[int, bytes]]:
    """Everything in a folder."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def test_a_browser_follows_a_run(
    chromium: Any, view: View, tiny_task: str, tmp_path: Path, hold: Hold
) -> None:
    trainer(tiny_task, tmp_path)("runs", [0, 1], epochs=8)
    _, address = view()
    tab = chromium.new_page(viewport={"width": 1000, "height": 700})
    tab.set_default_timeout(1000 * HANGS)
    trouble: list[str] = []
    tab.on("pageerror", lambda error: trouble.append(str(error)))
    tab.on("console", lambda message: trouble.append(message.text))
    tab.on("request", lambda request: request.url.startswith(address) or trouble.append(request.url))
    tab.goto(address)
    tab.get_by_text("Nothing is running.").wait_for()
    board = tab.locator("#board-0")
    board.get_by_role("checkbox", name="Pick mlp width=16").wait_for()

    words = ("run", "--task", tiny_task, "mlp width=8", "--seeds", "2", "--epochs", "8")
    run = start(*words, "--runs", str(tmp_path / "runs"), env=hold.environment)
    hold.wait(run)
    row = tab.locator("#running tbody tr", has_text="mlp width=8").first
    row.get_by_text("of 8").first.wait_for()  # it is held in its first epoch
    assert row.locator("progress").get_attribute("max") == "8"
    told = tab.evaluate("fetch('/progress').then((answer) => answer.json())")
    assert {(group["entry"].partition(" (")[0], group["seeds"]) for group in told["groups"]} <= {
        ("tiny, ddqn mlp width=8", seeds) for seeds in ("0:1", "1:2", "0:2")
    }

    hold.release()
    run.wait(HANGS)
    tab.get_by_text("Nothing is running.").wait_for()
    board.get_by_role("checkbox", name="Pick mlp width=8").wait_for()  # both at one horizon
    search = board.get_by_label("Search entries")
    board.get_by_role("button", name="Unpick all").click()
    for name in ("mlp width=16", "mlp width=8"):
        board.get_by_role("checkbox", name=f"Pick {name}").check()
    board.get_by_label("Single runs").check()
    search.fill("width=8")
    search.blur()
    chosen = board.locator(".legend li > span").all_inner_texts()
    assert chosen == ["mlp width=16", "mlp width=8"]
    name = tab.locator("#running").get_attribute("data-page")

    qrlsuite(*words[:3], "mlp width=4", *words[4:], "--runs", str(tmp_path / "runs"))
    hidden = board.get_by_role("checkbox", name="Pick mlp width=4", include_hidden=True)
    hidden.wait_for(state="attached")  # the search hides its row
    assert tab.locator("#running").get_attribute("data-page") != name
    assert board.locator(".legend li > span").all_inner_texts() == chosen, "what is picked stays"
    assert search.input_value() == "width=8"
    assert board.get_by_label("Single runs").is_checked()
    assert tab.locator("#board-0-table tbody tr:visible", has_text="width=4").count() == 0
    tab.close()
    assert trouble == []


def test_it_shows_what_a_study_trains(view: View, tiny_task: str, tmp_path: Path, hold: Hold) -> None:
    study, runs = str(tmp_path / "widths.toml"), ("--runs", str(tmp_path / "runs"))
    words = ("mlp width=4", "mlp width=2", "--task", tiny_task, "--epochs", "2", "--looks", "2 reason=test")
    assert qrlsuite("study", "new", study, *words, *runs).returncode == 0
    run = start("study", "run", study, "--workers", "1", *runs, env=hold.environment)
    hold.wait(run)
    _, address = view()
    [group] = json.loads(answer(address, "/progress")[1])["groups"]
    assert (group["entry"], group["seeds"]) == ("widths: tiny, ddqn mlp width=4 (2 running)", "10000:10002")
    [status] = json.loads(qrlsuite("runs", "--json", *runs).stdout)
    assert (status["study"], status["asked"], status["seeds"]) == ("widths", 2, {"running": 2})
    assert "widths: tiny  ddqn-mlp" in qrlsuite("runs", *runs).stdout
    hold.release()
    run.wait(HANGS)


def test_ctrl_c_ends_it_with_a_sentence_and_nothing_is_changed(
    view: View, train: Train, tmp_path: Path, chromium: Any
) -> None:
    train("runs", [0, 1])
    before = contents(tmp_path / "runs")
    command, address = view()
    assert answer(address)[0] == answer(address, "/progress")[0] == 200
    tab = chromium.new_page()
    tab.set_default_timeout(1000 * HANGS)
    tab.goto(address)
    tab.get_by_text("Nothing is running.").wait_for()
    os.kill(command.pid, signal.SIGINT)
    assert command.wait(HANGS) == 0
    assert (tmp_path / "view-0.txt").read_text().endswith("ended; nothing in the folder was changed\n")
    assert contents(tmp_path / "runs") == before
    tab.get_by_text("has ended: this page stays as it is").wait_for()
    tab.close()


def test_only_two_addresses_of_this_machine_are_answered(view: View, train: Train) -> None:
    folder = train("runs", [0])
    assert (folder / "entry.json").is_file()
    _, address = view()
    port = address.rpartition(":")[2]
    assert answer(address, Host=f"localhost:{port}")[0] == 200
    evil = "evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}"
    for host in (*evil, "127.0.0.1", "", "[::1]"):
        assert answer(address, Host=host) == (403, f"403: only {address} is served here\n")
        assert answer(address, "/progress", Host=host)[0] == 403
    inside = folder.relative_to(folder.parents[1])
    own = [
        f"/{inside}/entry.json",
        f"//{inside}/entry.json",
        f"/../{inside}/entry.json",
        f"{folder}/entry.json",
    ]
    elsewhere = ["/%2e%2e/%2e%2e/etc/passwd", "/../../../../etc/passwd"]
    for path in (*own, *elsewhere, "/page.js", "/progress/", "/?"):
        assert answer(address, path) == (404, f"404: there is nothing but {address}/\n"), path
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "HEAD"):
        assert answer(address, method=method)[0] == 501
    with socket.create_connection(("127.0.0.1", int(port))) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1:" + port.encode() + b"\r\nHost: evil.example\r\n\r\n")
        assert b" 403 " in raw.makefile("rb").readline(), "two names"
    own = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for other in own - {"127.0.0.1"}:
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((other, int(port)), timeout=HANGS)


def test_a_port_in_use_is_told_and_the_next_free_one_is_taken(
    view: View, train: Train, tmp_path: Path
) -> None:
    train("runs", [0])
    _, address = view()
    port = address.rpartition(":")[2]
    done = qrlsuite("view", "--runs", str(tmp_path / "runs"), "--port", port)
    assert done.returncode == 2
    said = f"qrlsuite: --port {port}: Address already in use; without --port the first free one from 8010 on is taken\n"
    assert (done.stdout, done.stderr) == ("", said)
    _, next_ = view()
    assert next_ != address
    assert answer(address)[0] == answer(next_)[0] == 200


def test_no_free_port_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setattr(live, "PORT", taken.getsockname()[1])
        monkeypatch.setattr(live, "TRIED", 1)
        with pytest.raises(OptionError, match=r"no port .* is free .*: name one with --port"):
            live.Server(None)


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    done = qrlsuite("view", "--runs", str(tmp_path / "none"))
    assert done.returncode == 2
    assert f"there is no results folder {tmp_path / 'none'}" in done.stderr
    unknown = qrlsuite("view", "--runs", str(tmp_path), "--task", "beam6h")
    assert unknown.returncode == 2
    assert "unknown task 'beam6h'; did you mean 'beam6g'?" in unknown.stderr


def test_damage_while_it_is_shown_is_told_and_goes_by(view: View, train: Train, tmp_path: Path) -> None:
    folder = train("runs", [0, 1])
    _, address = view()
    _, first = answer(address)
    record = (folder / "entry.json").read_bytes()
    (folder / "entry.json").write_bytes(b"{")
    train("runs", [0], epochs=3, settings=("width=8",))
    while (page := answer(address)[1]) == first:
        time.sleep(0.05)
    assert "entry.json" in page.partition('id="refused"')[2]
    assert "mlp width=8" in page
    (folder / "entry.json").write_bytes(record)
    train("runs", [2], epochs=3)
    while "mlp width=16" not in (page := answer(address)[1]):
        time.sleep(0.05)
    assert 'id="refused"' not in page


def test_published_entries_need_no_results_folder(view: View, tmp_path: Path) -> None:
    _, address = view("--published", "--task", "cartpole")
    assert not (tmp_path / "runs").exists()
    code, text = answer(address, "/progress")
    assert (code, json.loads(text)["groups"]) == (200, [])
