"""The seeds that were asked for: a line of `requests.jsonl` in the entry's folder, before they are trained.

Verdicts name the seeds that were asked for and are not there. A request is withdrawn by a further line, with its
reason. Results from before this record, published entries and curves of other programs have the seeds that they have.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.results import genuine
from qrlsuite.results.claims import living, locked
from qrlsuite.results.records import RequestLine
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, append, drop_torn_line, json_line, read_records
from qrlsuite.results.text import counted

FILE = "requests.jsonl"


@dataclass(frozen=True)
class Requests:
    """The epochs to which seeds were asked for, and why requests were withdrawn, by seed."""

    asked: dict[int, int]
    withdrawn: dict[int, str]

    @classmethod
    def of(cls, lines: Iterable[RequestLine]) -> Requests:
        """Return what lines come to: a later line about a seed counts more than an earlier one."""
        found = cls({}, {})
        for line in lines:
            for seed in line.seeds:
                if line.withdrawn is None:
                    found.asked[seed] = max(found.asked.get(seed, 0), line.epochs)
                    found.withdrawn.pop(seed, None)
                else:
                    found.asked.pop(seed, None)
                    found.withdrawn[seed] = line.withdrawn
        return found


def lines(store: EntryStore) -> list[RequestLine]:
    """Return the lines of an entry's folder; none where there is no record."""
    genuine.require_no_link(_path(store))
    return read_records(_path(store), RequestLine)


def read(store: EntryStore) -> Requests:
    """Return the requests for an entry's seeds."""
    return Requests.of(lines(store))


def missing_text(store: EntryStore, missing: Sequence[int], total: int) -> str:
    """Write that seeds of so many are not there: `4 of 24 seeds are missing: 6, 7, 9, 18`, or are still training."""
    held = {seed for claim in living(store) for seed in claim.seeds}
    lost = [seed for seed in missing if seed not in held]
    told = ", ".join(map(str, lost)) if len(lost) <= 10 else format_seeds(lost)
    parts = {"still training": len(missing) - len(lost), f"missing: {told}": len(lost)}
    return "; ".join(
        f"{count} of {counted(total, 'seed')} {'is' if count == 1 else 'are'} {what}"
        for what, count in parts.items()
        if count
    )


def ask(store: EntryStore, seeds: Iterable[int], epochs: int, code: str) -> None:
    """Record a request, if it asks for more than was asked for; the first one covers the seeds that are there."""
    with locked(store):
        asked = read(store).asked
        wanted = {*seeds, *(() if asked else store.seeds())}
        wanted = {seed for seed in wanted if seed < TUNING_SEEDS}
        if any(asked.get(seed, 0) < epochs for seed in wanted):
            _add(store, [RequestLine(seeds=sorted(wanted), epochs=epochs, code=code, time=_now())])


def withdraw(store: EntryStore, seeds: Sequence[int], reason: str) -> None:
    """Record that seeds are no longer asked for."""
    with locked(store):
        _add(store, [RequestLine(seeds=sorted(seeds), withdrawn=reason, time=_now())])


def take_over(store: EntryStore, others: Sequence[RequestLine]) -> None:
    """Record requests of another folder, with its seeds."""
    with locked(store):
        here = [line.content for line in lines(store)]
        _add(store, [line for line in others if line.content not in here])


def _add(store: EntryStore, new: Sequence[RequestLine]) -> None:
    drop_torn_line(_path(store))
    content = [json_line(line.content or line.model_dump(exclude_defaults=True)) for line in new]
    if content:
        append(_path(store), b"".join(content))


def _path(store: EntryStore) -> Path:
    return store.path / FILE


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
