"""Checks of a remote worker's answer: nothing in it is believed before it is written.

A worker that is broken, out of date or somebody else's costs the group that it answers for, and no more: written
seeds can be read, ranked and continued like seeds that were trained here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pydantic

from qrlsuite import specs
from qrlsuite.errors import StoreError
from qrlsuite.experiment.task import TaskFile
from qrlsuite.files import validation_lines
from qrlsuite.results.checkpoint import Arrays
from qrlsuite.results.genuine import require_plain
from qrlsuite.results.records import MEASURED, EpochLine, Provenance, TimingLine
from qrlsuite.training.remote_task import POLICY

if TYPE_CHECKING:
    from qrlsuite.training.trainer import Trainer

Layout = tuple[tuple[int, ...], str]
"""Shape of one seed's part of an array, and type."""

_METRIC = re.compile(rf"[A-Za-z_]\w{{0,63}}|{MEASURED}\.{specs.NAME.pattern}", re.ASCII)
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Expected:
    """The shapes and sizes of an answer, computed by the entry's own code.

    Attributes
    ----------
    parameters:
        As `ModelBuilder.trained` counts them.
    state, policy:
        Names and layouts of the arrays of a checkpoint, and of a trained agent.
    seed_bytes:
        Size of both, of one seed.
    """

    parameters: Mapping[str, int]
    state: Mapping[str, Layout]
    policy: Mapping[str, Layout]
    seed_bytes: int


def expected_of(trainer: Trainer) -> Expected:
    """Return the expected content of answers for a trainer's entry; the trainer has begun with one seed."""
    state, policy = trainer.capture(), trainer.policy()
    size = sum(array.nbytes for arrays in (state, policy) for array in arrays.values())
    return Expected(trainer.models.trained(), _layouts(state), _layouts(policy), size)


def _layouts(arrays: Arrays) -> dict[str, Layout]:
    return {name: (array.shape[1:], str(array.dtype)) for name, array in arrays.items()}


@dataclass(frozen=True)
class Asked:
    """The task that an answer is waited for: its token, the seeds, the epoch it begins after, and the last one."""

    token: str
    seeds: Sequence[int]
    epoch: int
    epochs: int


def require_fit(
    header: Mapping[str, Any], arrays: Arrays, asked: Asked, task: TaskFile, expected: Expected
) -> None:
    """Refuse an answer that is not one to the task that is waited for."""
    try:
        problem = next(_problems(header, arrays, asked, task, expected), None)
    except pydantic.ValidationError as error:
        problem = f"{error.title}: {validation_lines(error)[0]}"
    if problem is not None:
        raise StoreError(f"an answer does not fit its task: {problem}")
    require_plain("an answer", dict(header))


def _problems(
    header: Mapping[str, Any], arrays: Arrays, asked: Asked, task: TaskFile, expected: Expected
) -> Iterator[str]:
    """Yield problems of an answer; problems after the first may be nonsense."""
    last: Any = header.get("epoch")
    lines: Any = header.get("lines")
    timings: Any = header.get("timings")
    error: Any = header.get("error")
    if (header.get("token"), header.get("seeds")) != (asked.token, list(asked.seeds)):
        yield "it answers another task"
    if type(last) is not int or not isinstance(lines, list) or not isinstance(timings, list):
        yield "it has no epochs"
    if not last <= asked.epochs or not len(lines) == len(timings) == last - asked.epoch:
        yield f"it ends at epoch {last} with {len(lines)} epochs after {asked.epoch}"
    if error is not None and not isinstance(error, str):
        yield "its error is no text"
    if error is None and not lines and asked.epoch < asked.epochs:
        yield "it has no new epoch and names no error"
    warnings = header.get("warnings")
    if not isinstance(warnings, list) or not all(isinstance(text, str) for text in warnings):
        yield "its warnings are no texts"
    for number, (of_seeds, timing) in enumerate(zip(lines, timings), start=asked.epoch + 1):
        yield from _line_problems(of_seeds, number, len(asked.seeds), task)
        times = TimingLine.model_validate(timing)
        if (times.epoch, times.group) != (number, len(asked.seeds)):
            yield f"the times of epoch {number} are not its own"
    if lines or error is None:
        if header.get("parameters") != expected.parameters:
            yield f"it counts other parameters than {json.dumps(expected.parameters)}"
        Provenance.model_validate(header.get("provenance"))
    yield from _array_problems(arrays, asked, bool(lines), last == asked.epochs and error is None, expected)


def _line_problems(of_seeds: object, number: int, seeds: int, task: TaskFile) -> Iterator[str]:
    """Check the lines of one epoch."""
    if not isinstance(of_seeds, list) or len(of_seeds) != seeds:
        yield f"the lines of epoch {number} are not one for each seed"
        return
    lines = [EpochLine.model_validate(line) for line in of_seeds]
    for line in lines:
        if line.epoch != number:
            yield f"the lines of epoch {number} are not one for each seed"
        yield from _score_problems(line.scores or [], number, task)
        if line.content.keys() - _OPTIONAL != lines[0].content.keys() - _OPTIONAL:
            yield f"the lines of epoch {number} hold different values"
        for name in line.model_extra or {}:
            if not _METRIC.fullmatch(name):
                yield f"a line of epoch {number} has {ascii(name)[:40]}"


_OPTIONAL = {"diverged", "executions"}


def _score_problems(scores: Sequence[float], number: int, task: TaskFile) -> Iterator[str]:
    """Check the scores of one validation."""
    episodes = task.protocol.validation_episodes
    if len(scores) != episodes:
        yield f"epoch {number} has not {episodes} scores for each seed"
    elif max(map(abs, scores)) > np.finfo(np.float32).max:
        yield f"a score of epoch {number} is no finite number"
    elif task.ranking.thresholds is None and not (
        min(scores) >= -_TOLERANCE and max(scores) <= 1 + _TOLERANCE
    ):
        yield f"epoch {number} has scores from {min(scores):g} to {max(scores):g}, outside [0, 1]"


def _array_problems(
    arrays: Arrays, asked: Asked, begun: bool, finished: bool, expected: Expected
) -> Iterator[str]:
    """Check the checkpoint, which may hold more than at the beginning, and the trained agents, which may not."""
    for name, array in arrays.items():
        if array.ndim == 0 or array.shape[0] != len(asked.seeds):
            yield f"array {ascii(name)[:60]} of shape {array.shape} is not seed-first"
    layouts = _layouts({name: array for name, array in arrays.items() if array.ndim})
    state = {name: layout for name, layout in layouts.items() if not name.startswith(POLICY)}
    policy = {name.removeprefix(POLICY): layouts[name] for name in layouts.keys() - state.keys()}
    if begun and (wrong := _differing(state, expected.state)):
        yield f"its checkpoint has another {ascii(wrong)[:60]} than the entry, or none"
    if finished and policy != expected.policy:
        wrong = _differing(policy, expected.policy) or _differing(expected.policy, policy)
        yield f"its trained agent has another {ascii(wrong)[:60]} than the entry, or none"
    if policy and not finished:
        yield "it has a trained agent before the last epoch"


def _differing(found: Mapping[str, Layout], wanted: Mapping[str, Layout]) -> str | None:
    """Return the first name of `wanted` that `found` has not, or has otherwise."""
    return next((name for name in wanted if found.get(name) != wanted[name]), None)


def require_alike(
    first: Mapping[str, Any], arrays: Arrays, second: Mapping[str, Any], others: Arrays
) -> None:
    """Refuse two workers' answers to one task that differ in a bit of the lines or the checkpoint.

    On another kind of processor the last bits differ rightly: such answers say nothing about each other.
    """
    made = [Provenance.model_validate(header.get("provenance") or {}) for header in (first, second)]
    if made[0].processor != made[1].processor or made[0].device != made[1].device:
        return
    alike = first["lines"] == second["lines"] and all(
        name in others and array.tobytes() == others[name].tobytes() for name, array in arrays.items()
    )
    if not alike:
        here, there = (ascii(origin.host)[1:-1] for origin in made)
        raise StoreError(
            f"two workers, on {here} and {there}, gave different answers to one task, and nothing of it was written: "
            "one of them computes wrongly; stop it, and repeat the command"
        )
