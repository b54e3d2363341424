"""`qrlsuite play`: show an episode of a trained agent."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from qrlsuite.api import episode as episodes
from qrlsuite.cli.arguments import PublishedOption, RunsOption, entries_here, names_of
from qrlsuite.leaderboard.shelf.collect import Selection


def play(
    entry: Annotated[
        str,
        typer.Argument(
            metavar="ENTRY",
            help="Its name or label, or the beginning of one, after [TASK/]; or its folder.",
            autocompletion=entries_here,
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            help="The task to play. A name means its own entry; TASK/ENTRY or a folder names an entry of another task.",
            autocompletion=names_of("tasks"),
        ),
    ] = None,
    episode: Annotated[
        int, typer.Option("--episode", metavar="N", min=0, help="Which of the evaluation's episodes.")
    ] = 0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the episodes, as of evaluate.")] = 0,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="A gif; or an mp4, where ffmpeg is installed.")
    ] = Path("episode.gif"),
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
) -> None:
    """Show an episode of an entry's best trained agent, as an animation.

    The best agent has the highest last validation score, and `evaluate` plays the same episode. Every environment that
    draws frames (render_mode="rgb_array") can be shown; beam6g shows the field, the antennas, the beam and the path.

    Example: qrlsuite play "vqc-native qubits=6" --task beam6g --published --out circuit.gif
    """
    episodes.check_ending(out)
    shown = episodes.record(Selection.create(runs, task, published), entry, episode, seed)
    typer.echo(str(shown))
    shown.save(out)
    typer.echo(f"wrote {out} ({len(shown.frames)} frames, {out.stat().st_size / 1e6:.1f} MB)")
