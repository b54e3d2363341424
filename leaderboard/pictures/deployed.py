"""Scores of trained agents whose circuits run with shots, noise or on a device, against an option of the backend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from qrlsuite import options
from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.pictures import style
from qrlsuite.training.evaluation import Played


class Line(NamedTuple):
    """An entry's agents as trained, and on the backend at each of K values; () without a circuit."""

    trained: Played
    deployed: tuple[Played, ...]


@dataclass(frozen=True)
class DeployedOptions:
    """Settings of the picture."""

    axis: Annotated[str, Field(description="quantity on the horizontal axis")] = ""
    title: Annotated[str, Field(description="a line above the picture")] = ""
    note: Annotated[str, Field(description="a line below it")] = ""


def draw(lines: Sequence[Line], values: Sequence[str], **settings: Any) -> Figure:
    """Draw the mean score of an entry's agents against the values, with each agent's score as a dot.

    Agents that act as trained are a horizontal line: dashed for circuits, dotted for networks. On a task
    without a known maximum the picture shows returns.

    Parameters
    ----------
    lines:
        One or more entries, which played the same episodes.
    """
    chosen: DeployedOptions = options.build(DeployedOptions, settings, "picture 'deployed'")
    if not any(line.deployed for line in lines):
        raise OptionError("picture 'deployed' needs an entry with a circuit")
    scored = all(line.trained.scores is not None for line in lines)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(values), dtype=np.float64)
    circuits = sum(bool(line.deployed) for line in lines)
    drawn = 0
    for number, line in enumerate(lines):
        look = style.style(number)
        reference = float(_of_agents(line.trained, scored).mean())
        name = style.plain(line.trained.name)
        if not line.deployed:
            axes.axhline(reference, color=look.color, ls=":", lw=1.6, label=f"{name} ({reference:.3f})")
            continue
        axes.axhline(
            reference, color=look.color, ls="--", lw=1.2, label=f"{name}, as trained ({reference:.3f})"
        )
        shift = 0.12 * (drawn - (circuits - 1) / 2)
        drawn += 1
        of_agents = np.stack([_of_agents(each, scored) for each in line.deployed])  # (K, agents)
        axes.plot(
            places + shift, of_agents.mean(axis=1), marker=look.marker, color=look.color, lw=1.5, label=name
        )
        across = np.repeat(places + shift, of_agents.shape[1])
        axes.plot(across, of_agents.ravel(), ".", color=look.color, alpha=0.35, ms=5, mew=0)
    axes.set_xticks(places, list(values))
    axes.set_xlabel(style.plain(chosen.axis))
    axes.set_ylabel("mean score of an episode" if scored else "mean return of an episode")
    style.tidy(axes)
    axes.legend(frameon=False, fontsize=8)
    if chosen.title:
        figure.suptitle(style.plain(chosen.title, 200), x=0.01, ha="left", fontsize="medium")
    first = lines[0].trained
    agents = sorted({len(line.trained.seeds) for line in lines})
    style.footnotes(
        figure,
        f"lines: mean of the {' or '.join(map(str, agents))} best runs by last validation score; dots: each of them",
        f"{first.returns.shape[1]} fresh episodes each, the same for all",
        style.plain(chosen.note, 1000),
    )
    return figure


def _of_agents(played: Played, scored: bool) -> NDArray[np.float64]:
    """Return each agent's mean (P,): its score, or its return."""
    values = played.scores if scored and played.scores is not None else played.returns
    means: NDArray[np.float64] = values.mean(axis=1)
    return means
