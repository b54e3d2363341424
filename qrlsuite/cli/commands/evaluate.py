"""`qrlsuite evaluate`: play trained agents, beside reference policies such as the optimal and the random one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.api import evaluation
from qrlsuite.cli.arguments import JsonOption, PublishedOption, RunsOption, entries_here, names_of
from qrlsuite.engine.terminal import table_console
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results.store import write_atomically


def evaluate(
    entries: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ENTRY...",
            help="Entries of one task: names or labels, or beginnings of them, after [TASK/]; or folders. "
            "Without entries, only the reference policies of --task play.",
            autocompletion=entries_here,
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            help="The task to play. Names mean its own entries; TASK/ENTRY or a folder names an entry of another task.",
            autocompletion=names_of("tasks"),
        ),
    ] = None,
    best: Annotated[
        int, typer.Option("--best", min=1, help="Evaluate the runs with the best last validation score.")
    ] = 10,
    episodes: Annotated[
        int, typer.Option("--episodes", min=1, max=1_000_000, help="Complete episodes of each policy.")
    ] = 1000,
    seed: Annotated[
        int,
        typer.Option("--seed", min=0, help="Seed of the episodes, which are the same for all policies."),
    ] = 0,
    backend: Annotated[
        str | None,
        typer.Option(
            "--backend",
            metavar="NAME",
            help="Also let the agents act on another circuit backend, with its options: 'native shots=1000', 'qiskit "
            "estimator=aer', 'pennylane device=lightning.qubit', or a plugin's.",
        ),
    ] = None,
    perturb: Annotated[
        list[float] | None,
        typer.Option(
            "--perturb",
            metavar="P",
            help="Also multiply each trained number by 1 + P z, z standard normal: 0.1 is ten percent. Repeatable.",
        ),
    ] = None,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="Execute circuits on a real device, which may cost money."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Draw the histogram to a png, pdf or svg file."),
    ] = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Play fresh episodes with an entry's best trained agents, and with reference policies.

    --published adds the entries that come with the suite and have agents.

    The best agents are chosen by their last validation score; these episodes are new, and the same for every policy, so
    the choice does not raise the result. Agents act as in validation. It shows sums of rewards and, where the task
    knows a maximum, relative scores. The random policy always plays; an environment may have others (beam6g: the
    optimal one and the nearest antenna). A task file may state their scores ([ranking.policies]): boards and learning
    curves show them.

    With --task OTHER, TASK/ENTRY plays another task than it was trained on, if observations and actions are the same.

    With --backend the same agents act twice: as they were trained, and with shots, with noise or on a device. The cost
    is printed first. Finished episodes are kept, and not played again.

    Example: qrlsuite evaluate vqc-native --backend "qiskit estimator=aer shots=1000"

    Example: qrlsuite evaluate --task pulse --episodes 10000

    Example: qrlsuite evaluate "mlp width=64" vqc-native --best 10 --episodes 1000 --out histogram.png
    """
    format_ = pictures.format_of(out)
    evaluations = evaluation.evaluate(
        Selection.create(runs, task, published),
        entries or (),
        best=best,
        episodes=episodes,
        seed=seed,
        progress=not json_output,
        backend=backend,
        yes=yes,
        perturb=perturb or (),
    )
    if out is not None:
        write_atomically(out, pictures.encode(evaluations.figure(), format_))
    if json_output:
        typer.echo(json.dumps({**evaluations.as_dict(), "picture": None if out is None else str(out)}))
        return
    table_console().print(evaluations)
    if out is not None:
        typer.echo(f"wrote {out}")
