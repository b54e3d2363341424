"""`qrlsuite diagnose`: diagnostics of a circuit, or of trained agents, with tables and a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.api import diagnosis
from qrlsuite.cli.arguments import (
    JsonOption,
    PublishedOption,
    RunsOption,
    names_of,
    refuse_typed,
    split_settings,
)
from qrlsuite.engine.terminal import table_console
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard import pictures
from qrlsuite.results.store import write_atomically


def diagnose(
    context: typer.Context,
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="ENTRY... | ansatz NAME",
            help="Entries of one task; or `ansatz`, its name, and its options as OPTION=VALUE, with sizes: qubits=6, "
            "qubits=4:12 (both included), 2:16:2 or 4,8 (default: 2:8); layers likewise (default: 4), or n, as many as "
            "qubits, 2n, twice as many.",
        ),
    ],
    draws: Annotated[
        int,
        typer.Option(
            "--draws", min=2, help="For an ansatz: draws of random parameters for the variance of gradients."
        ),
    ] = 100,
    task: Annotated[
        str | None,
        typer.Option("--task", help="The task that agents play.", autocompletion=names_of("tasks")),
    ] = None,
    best: Annotated[
        int, typer.Option("--best", min=1, help="Agents: the runs with the best last score.")
    ] = 10,
    episodes: Annotated[
        int, typer.Option("--episodes", min=1, max=1000, help="Episodes of each agent.")
    ] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of draws and episodes.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Draw to a png, pdf or svg file.")
    ] = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Analyze a circuit, or trained agents: gradients, Fisher information, frequencies, entanglement.

    Of an ansatz, a row for each size: variance of the gradient with a local and a global readout and how it changes
    with each further qubit; rank of the Fisher information, effective dimension, mean frequency along the inputs,
    expressibility, entanglement, dimension of the dynamical Lie algebra. layers=n is the law by which depth grows.

    For entries, the best trained agents beside the same agents before training, at the states that they visit: rank,
    gauge directions, effective dimension, mean frequency, and the entanglement of circuits.

    Example: qrlsuite diagnose ansatz iqp qubits=4:12 --out iqp.png

    Example: qrlsuite diagnose "vqc-native qubits=6" --task beam6g --published
    """
    format_ = pictures.format_of(out)
    quiet = not json_output
    found: diagnosis.CircuitDiagnosis | diagnosis.AgentsDiagnosis
    if words[0] == "ansatz":
        refuse_typed(context, "for an ansatz", "task", "best", "episodes", "published")
        names, settings = split_settings(words[1:])
        sizes = [str(settings.pop(name, usual)) for name, usual in (("qubits", "2:8"), ("layers", "4"))]
        if len(names) != 1:
            raise OptionError("give the name of one ansatz, as in `qrlsuite diagnose ansatz iqp`")
        found = diagnosis.diagnose_ansatz(
            names[0], *sizes, draws=draws, seed=seed, options=settings, progress=quiet
        )
    else:
        refuse_typed(context, "for entries", "draws")
        found = diagnosis.diagnose(
            *words,
            task=task,
            best=best,
            episodes=episodes,
            seed=seed,
            published=published,
            runs=runs,
            progress=quiet,
        )
    if out is not None:
        write_atomically(out, pictures.encode(found.figure(), format_))
    if json_output:
        typer.echo(json.dumps({**found.as_dict(), "picture": None if out is None else str(out)}))
        return
    table_console().print(found)
    if out is not None:
        typer.echo(f"wrote {out}")
