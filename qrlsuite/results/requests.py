"""The seeds that were asked for: lines of `requests.jsonl` in the entry's folder, appended before they are trained.

Verdicts name the seeds that were asked for and are not there. A request is withdrawn by a further line, with its
reason. Results from before this record, published entries and curves of other programs have the seeds that they have.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence

from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.results import genuine
from qrlsuite.results.claims import living, locked
from qrlsuite.results.records import RequestLine
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, append, drop_torn_line, json_line, read_records
from qrlsuite.results.text import counted

FILE = "requests.jsonl"


def read(store: EntryStore) -> tuple[dict[int, int], dict[int, str]]:
    """Return the epochs to which seeds are asked for, and why others no longer are, by seed."""
    asked, withdrawn = dict[int, int](), dict[int, str]()
    genuine.require_no_link(store.path / FILE)
    for line in read_records(store.path / FILE, RequestLine):
        for seed in line.seeds:
            most = asked.pop(seed, 0)
            if line.withdrawn:
                withdrawn[seed] = line.withdrawn
            else:
                asked[seed] = max(most, line.epochs)
                withdrawn.pop(seed, None)
    return asked, withdrawn


def add(store: EntryStore, seeds: Iterable[int], epochs: int = 0, **more: str) -> None:
    """Record that seeds are asked for to some epochs (`code`), or why they no longer are (`withdrawn`).

    The first request is for the seeds that are there, too.
    """
    with locked(store):
        asked, withdrawn = read(store)
        wanted = {*seeds, *(() if asked or not epochs else store.seeds())}
        wanted = {seed for seed in wanted if seed < TUNING_SEEDS}
        if any(
            asked.get(seed, 0) < epochs or withdrawn.get(seed) != more.get("withdrawn") for seed in wanted
        ):
            now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
            drop_torn_line(store.path / FILE)
            line = {"seeds": sorted(wanted), **({"epochs": epochs} if epochs else {}), **more, "time": now}
            append(store.path / FILE, json_line(line))


def take_over(store: EntryStore, asked: Mapping[int, int], withdrawn: Mapping[int, str]) -> None:
    """Record what `read` returned of another folder with seeds of the entry; no seed that is here is withdrawn."""
    here = store.seeds()
    for reason in dict.fromkeys(withdrawn.values()):
        add(store, [s for s, why in withdrawn.items() if why == reason and s not in here], withdrawn=reason)
    for epochs in dict.fromkeys(asked.values()):
        add(store, [seed for seed, most in asked.items() if most == epochs], epochs)


def missing_text(store: EntryStore, missing: Sequence[int], total: int) -> str:
    """Write that seeds of so many are not there: `4 of 24 seeds are missing: 6, 7, 9, 18`, or are still training."""
    held = {seed for claim in living(store) for seed in claim.seeds}
    lost = [seed for seed in missing if seed not in held]
    told = ", ".join(map(str, lost)) if len(lost) <= 10 else format_seeds(lost)
    parts = {"still training": len(missing) - len(lost), f"missing: {told}": len(lost)}
    return "; ".join(
        f"{count:,} of {counted(total, 'seed')} {'is' if count == 1 else 'are'} {what}"
        for what, count in parts.items()
        if count
    )
