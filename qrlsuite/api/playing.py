"""Trained agents: as a policy, or in an animated episode."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

from qrlsuite.errors import OptionError
from qrlsuite.leaderboard.shelf.collect import Selection

if TYPE_CHECKING:
    from qrlsuite.api.episode import Episode
    from qrlsuite.api.trained import TrainedAgent


def agent(
    entry: str,
    *,
    task: str | None = None,
    seed: int | None = None,
    published: bool = False,
    runs: str | PathLike[str] = "runs",
) -> TrainedAgent:
    """Return a trained agent of an entry, to act in a loop of your own.

    Parameters
    ----------
    entry:
        Its name, label, the beginning of one of them, or folder.
    task:
        The task that it plays, as for `evaluate`; None is the entry's own.
    seed:
        Seed of the agent; None takes the agent with the highest last validation score.
    published:
        Look among the published entries that come with the suite, too.
    runs:
        The results folder.

    Raises
    ------
    UnknownNameError
        If no entry, or several, have the name.
    OptionError
        If the agent cannot play the task.
    StoreError
        If the entry has no trained agent, or no agent of that seed.

    Examples
    --------
    >>> policy = agent("vqc-native qubits=6", task="beam6g", published=True)  # doctest: +SKIP
    >>> lanes = policy.environments(4)  # doctest: +SKIP
    >>> observations, infos = lanes.reset(seed=1)  # doctest: +SKIP
    >>> lanes.step(policy.act(observations))  # doctest: +SKIP
    """
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise OptionError(f"seed = {seed!r}: give a whole number, 0 or more")
    from qrlsuite.api import trained  # torch, which all other functions do without

    return trained.load(Selection.create(runs, task, published), entry, seed)


def play(
    entry: str,
    *,
    task: str | None = None,
    episode: int = 0,
    seed: int = 0,
    published: bool = False,
    runs: str | PathLike[str] = "runs",
) -> Episode:
    """Play an episode with an entry's best trained agent, and draw it.

    The best agent has the highest last validation score, and the episode is an episode of `evaluate`.

    Parameters
    ----------
    entry:
        Its name, label, the beginning of one of them, or folder.
    task:
        The task that is played, as for `evaluate`; None plays the entry's own.
    episode:
        Its number among the evaluation's, from 0.
    seed:
        Seed of the evaluation.
    published:
        Look among the published entries that come with the suite, too.
    runs:
        The results folder.

    Returns
    -------
    Episode
        Which a notebook shows; `save("episode.gif")` writes it.

    Raises
    ------
    UnknownNameError
        If no entry, or several, have the name.
    OptionError
        If the environment draws no frames, a number cannot be used, or the agents cannot play the task.
    StoreError
        If the entry has no trained agent.
    EnvironmentFailure
        If the environment fails, or its single form plays another episode than its lanes.

    Examples
    --------
    >>> play("vqc-native qubits=6", task="beam6g", published=True).save("episode.gif")  # doctest: +SKIP
    """
    for name, value in (("episode", episode), ("seed", seed)):
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise OptionError(f"{name} = {value!r}: give a whole number, 0 or more")
    from qrlsuite.api import episode as episodes  # torch, which all other functions do without

    return episodes.record(Selection.create(runs, task, published), entry, episode, seed)
