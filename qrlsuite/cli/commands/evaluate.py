"""`qrlsuite evaluate`: what trained policies earn, against the optimal, the random and other known policies."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from qrlsuite.cli.arguments import AmongOption, JsonOption, RunsOption
from qrlsuite.cli.terminal import table_console
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard import collect, pictures
from qrlsuite.leaderboard.pictures import histogram
from qrlsuite.results import lookup
from qrlsuite.results.store import EntryStore, write_atomically
from qrlsuite.training import evaluation
from qrlsuite.training.evaluation import Played


def evaluate(
    entries: Annotated[
        list[str],
        typer.Argument(
            metavar="ENTRY...",
            help="Entries of one task: name or label, [TASK/] before it, the beginning, or folder.",
        ),
    ],
    task: AmongOption = None,
    best: Annotated[
        int, typer.Option("--best", min=1, help="Evaluate the runs with the best last validation score.")
    ] = 10,
    episodes: Annotated[
        int, typer.Option("--episodes", min=1, max=1_000_000, help="Complete episodes of each policy.")
    ] = 1000,
    seed: Annotated[
        int,
        typer.Option("--seed", min=0, help="Another one gives other episodes, the same for all policies."),
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Draw the histogram to a png, pdf or svg file."),
    ] = None,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Play fresh episodes with an entry's best trained agents, and with reference policies.

    The best agents are chosen by their last validation score; the episodes here are others, the same for every
    policy, so the choice does not raise the result. Agents act as in validation. Shown are sums of rewards and,
    where the task knows a maximum, relative scores. The random policy is always there; an environment may offer
    others (beam6g: the optimal one and the nearest antenna).

    Example: qrlsuite evaluate "mlp width=64" vqc-native --best 10 --episodes 1000 --out histogram.png
    """
    format_ = _format(out)
    lookup.check_tasks(runs, task)
    tasks = [task] if task else []
    folders = dict.fromkeys(collect.find(runs, name, tasks=tasks).folder.resolve() for name in entries)
    stores = [EntryStore(folder) for folder in folders]
    _one_task(stores)
    with _progress(json_output) as report:
        played = [evaluation.trained(store, best, episodes, seed, report=report) for store in stores]
        labels = [each.name for each in played]
        played = [
            each
            if labels.count(each.name) == 1
            else replace(each, name=f"{each.name} {store.path.name[-8:]}")
            for each, store in zip(played, stores)
        ]
        entry = stores[0].entry()
        played += evaluation.references(entry, episodes, seed, report)
    if out is not None:
        _draw(out, format_, played, entry.task.name)
    if json_output:
        content = {
            "task": entry.task.name,
            "task_hash": entry.task.hash,
            "evaluation_seed": seed,
            "episodes": episodes,
            "selection": "last validation score",
            "policies": [each.summary() for each in played],
            "picture": None if out is None else str(out),
        }
        typer.echo(json.dumps(content))
        return
    _table(played, entry.task.name, episodes)
    if out is not None:
        typer.echo(f"wrote {out}")


def _format(out: Path | None) -> str:

    format_ = "" if out is None else out.suffix.removeprefix(".").lower()
    if out is not None and format_ not in ("png", "pdf", "svg"):
        raise OptionError(f"--out {out}: the file's ending must be .png, .pdf or .svg")
    return format_


def _one_task(stores: Sequence[EntryStore]) -> None:

    tasks = {store.record()["task_hash"]: store.record()["task_name"] for store in stores}
    if len(tasks) > 1:
        raise OptionError(
            f"the entries belong to different tasks ({', '.join(sorted(tasks.values()))}), whose episodes and sums "
            "cannot be compared: evaluate them one by one"
        )


def _progress(quiet: bool) -> AbstractContextManager[Callable[[str, int, int], None]]:
    """Return a context that gives a report function showing one bar per policy."""

    @contextmanager
    def shown() -> Iterator[Callable[[str, int, int], None]]:
        console = Console(stderr=True, quiet=quiet, highlight=False)
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("episodes"),
            TimeRemainingColumn(),
        )
        bars: dict[str, Any] = {}
        with Progress(
            *columns, console=console, transient=True, disable=quiet or not console.is_terminal
        ) as live:

            def report(name: str, done: int, total: int) -> None:
                if name not in bars:
                    bars[name] = live.add_task(name, total=total)
                live.update(bars[name], completed=done)

            yield report

    return shown()


def _row(played: Played, what: str) -> list[str]:
    content = played.summary()[what]
    if content is None:
        return []
    digits = 3 if what == "score" else 2
    return [f"{content[name]:.{digits}f}" for name in ("mean", "p50", "p5", "p95")]


WIDE = 100
"""Columns of a terminal in which the whole table can be read."""


def _table(played: Sequence[Played], task: str, episodes: int) -> None:

    relative = any(each.scores is not None for each in played)
    console, notes = table_console(), _notes(played)
    if console.width < WIDE:
        notes.append(f"a terminal of {WIDE} columns shows medians and percentiles too")
    table = Table(
        title=Text(f"{task}: {episodes} fresh episodes of each policy, the same for all"),
        title_justify="left",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        caption=Text("\n".join(notes)),
        caption_justify="left",
        pad_edge=False,
    )
    names = ["policy", "agents", "return: mean", "median", "5%", "95%"]
    names += ["score: mean", "median", "5%", "95%"] * relative
    shown = [i for i, name in enumerate(names) if console.width >= WIDE or i < 2 or name.endswith("mean")]
    for name in (names[i] for i in shown):
        table.add_column(
            Text(name),
            justify="left" if name == "policy" else "right",
            overflow="fold",
            no_wrap=name != "policy",
        )
    for each in played:
        row = [each.name, str(len(each.seeds) or "-"), *_row(each, "return"), *_row(each, "score") * relative]
        row += [""] * (len(names) - len(row))
        table.add_row(*(Text(row[i]) for i in shown))
    console.print(table)


def _notes(played: Sequence[Played]) -> list[str]:
    """Say how the agents were chosen, and what the choice promised against what came."""
    notes = ["return: sum of rewards; score: relative, as the task defines it; percentiles over all episodes"]
    for each in played:
        if not each.seeds:
            continue
        among = f"the {len(each.seeds)} of {each.runs} runs with the best last validation score"
        promised = f"(mean {np.mean(each.validation):.3f}"
        came = "" if each.scores is None else f"; on these fresh episodes {each.scores.mean():.3f}"
        notes.append(f"{each.name}: {among} {promised}{came})")
    return notes


def _draw(out: Path, format_: str, played: Sequence[Played], task: str) -> None:

    note = ""
    if any(each.seeds for each in played):
        note = "agents: the best runs by last validation score; episodes: fresh, the same for all policies"
    values = {each.name: each.returns if each.seeds else each.returns[0] for each in played}
    figure = histogram.draw(values, quantity="sum of rewards over an episode", title=task, note=note)
    write_atomically(out, pictures.encode(figure, format_))
