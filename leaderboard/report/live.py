"""The page of a results folder, served while runs go on: read-only, and to browsers on this machine alone.

A request names one of two addresses, `/` and `/progress`; no part of it becomes a file's name. The board is computed in
the background whenever results have changed, and the page loads itself anew when there is a newer one.
"""

from __future__ import annotations

import hashlib
import json
import os
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from qrlsuite.engine.status import EntryStatus
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.leaderboard.report.encode import clean
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import duration

HOST = "127.0.0.1"
PORT = 8010
TRIED = 20
"""Ports that are tried, from `PORT` on, where the user names none."""
LOOKS = 2.0
"""Seconds from one look at the results folder to the next."""
PLACE = 'data-page=""'
"""The place of a page's name, which the page compares with the newest name."""
REST = 4.0
"""After a look that took long the next one waits for so many times as long: runs need the processor."""


class Live:
    """The newest page and the progress of a results folder.

    Parameters
    ----------
    render:
        Returns the page, as `render(..., live=True)` does.
    survey:
        Returns the state of every entry of the folder.
    """

    def __init__(self, render: Callable[[], str], survey: Callable[[], Sequence[EntryStatus]]) -> None:
        self._render, self._survey = render, survey
        self._ended = threading.Event()
        self._seen = self._look()
        self._compute()

    def watch(self) -> None:
        """Look at the folder until `end`, and compute the page anew when its results have changed."""
        rest = LOOKS
        while not self._ended.wait(rest):
            began = time.monotonic()
            try:
                seen = self._look()
                if seen != self._seen:
                    self._compute()
                    self._seen = seen
            except (
                QrlSuiteError,
                OSError,
            ) as error:  # a file is damaged, or went away just now: the last page stays
                self._problem = str(error)
            rest = max(LOOKS, REST * (time.monotonic() - began))

    def end(self) -> None:
        """Make `watch` return."""
        self._ended.set()

    def _compute(self) -> None:
        text = self._render()
        name = hashlib.sha256(text.encode()).hexdigest()[:16]  # so that an equal page is no newer one
        self.page = text.replace(PLACE, PLACE.replace('""', f'"{name}"'), 1).encode()
        self.name = name

    def progress(self) -> bytes:
        """Return the name of the newest page and the groups that have not finished, as JSON."""
        return json.dumps(
            {"page": self.name, "problem": clean(self._problem, 600), "groups": self._groups}
        ).encode()

    def _look(self) -> list[object]:
        """Look at the folder; returns facts that change whenever the board may have changed."""
        statuses = self._survey()
        self._problem = "; ".join(status.queue_problem for status in statuses if status.queue_problem)
        self._groups = [group for status in statuses for group in _groups(status)]
        entries = (status.entry for status in statuses)
        return [(entry.folder, dict(entry.seeds), entry.epochs, entry.size) for entry in entries]


def _groups(status: EntryStatus) -> list[dict[str, Any]]:
    """Return the groups of an entry for the page: numbers and harmless text."""
    shown = []
    for group, plain in zip(status.groups, status.as_dict()["groups"], strict=True):
        epoch, epochs, score, left = (
            value if isinstance(value, int | float) else None
            for value in (plain["epoch"], plain["epochs"], plain["median_score"], plain["seconds_left"])
        )
        running = group.state == "running"
        shown.append(
            {
                "entry": clean(f"{status.task}, {status.entry.label} ({status.seeds})"),
                "seeds": format_seeds(group.seeds),
                "state": clean((plain["phase"] or "running") if running else group.state),
                "epoch": epoch,
                "epochs": epochs,
                "score": None if score is None else f"{score:.3f}",
                "left": f"{duration(left)} left" if running and left is not None else "",
                "error": clean(plain["error"] or "", 300),
            }
        )
    return shown


class Server(ThreadingHTTPServer):
    """Listens on 127.0.0.1 alone, and answers with the pages that `serve` sets.

    Parameters
    ----------
    port:
        None takes the first free one from 8010 on.
    """

    daemon_threads = True
    allow_reuse_address = os.name == "posix"  # elsewhere it lets two programs share a port
    live: Live

    def __init__(self, port: int | None) -> None:
        tried = range(PORT, PORT + TRIED) if port is None else (port,)
        for each in tried:
            try:
                super().__init__((HOST, each), Handler)
            except OSError as error:
                why = error.strerror or str(error)
                continue
            self.address = f"http://{HOST}:{self.server_port}"
            self.hosts = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}
            return
        if port is None:
            raise OptionError(
                f"no port from {PORT} to {PORT + TRIED - 1} is free ({why}): name one with --port"
            )
        raise OptionError(f"--port {port}: {why}; without --port the first free one from {PORT} on is taken")

    def server_bind(self) -> None:
        """Bind without asking a name server for this machine's name."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that hang up."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class Handler(BaseHTTPRequestHandler):
    """Answers `/` with the page and `/progress` with JSON; everything else, and other hosts' names, with an error."""

    server: Server
    timeout = 30
    server_version, sys_version = "qrlsuite", ""
    error_message_format, error_content_type = "%(code)d: %(message)s\n", "text/plain; charset=utf-8"

    def do_GET(self) -> None:
        """Answer."""
        if self.headers.get_all("Host", []) not in [[host] for host in self.server.hosts]:
            # a page of a stranger whose name was made to lead here (DNS rebinding) sends its own
            self.send_error(HTTPStatus.FORBIDDEN, f"only {self.server.address} is served here")
        elif self.path == "/":
            self._send(self.server.live.page, "text/html")
        elif self.path == "/progress":
            self._send(self.server.live.progress(), "application/json")
        else:
            self.send_error(HTTPStatus.NOT_FOUND, f"there is nothing but {self.server.address}/")

    def _send(self, content: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def end_headers(self) -> None:
        """Forbid browsers to keep the answer, to guess its type, and to show it inside another page."""
        for name, value in (
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("Content-Security-Policy", "frame-ancestors 'none'"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
        ):
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing for each request."""


def serve(server: Server, live: Live) -> None:
    """Serve until Ctrl-C."""
    server.live = live
    watching = threading.Thread(target=live.watch, daemon=True)
    watching.start()
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        live.end()
        server.server_close()
