"""The engine `command`: starts every worker by a shell command, for queues and machines that share the results folder.

The template says how a worker is started: by ssh, by a queue's submit command, in a container. The engine stays until
all groups have finished. Whether a worker is at work it reads from the results folder and not from its process, so the
command may end with the worker (`ssh`) or when the worker waits in a queue (`qsub`).

- A worker that ended early (a time limit, a node taken away) is started again, from its checkpoint.
- After Ctrl-C a file beside its claim asks each worker to save and end.
- What a queue still holds is not seen: such a worker, when it begins, finds its seeds claimed or done, or trains them.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import signal
import string
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from typing import Annotated, Any

import pydantic
from pydantic.dataclasses import dataclass

from qrlsuite.engine.api import (
    Claim,
    EngineOutcome,
    EntryStore,
    SeedGroup,
    Show,
    Work,
    WorkerJob,
    held,
    usable_cores,
    worker_command,
    worker_environment,
)
from qrlsuite.errors import nearest

log = logging.getLogger("qrlsuite")

PLACEHOLDERS = ("command", "quoted", "i", "group")

LOOK_SECONDS = 0.5
"""Seconds between two looks at the results folder."""

PATIENCE = 60.0
"""Seconds for which workers that were asked to stop are waited for."""


def _template(text: str) -> str:
    try:
        names = [name for _, name, _, _ in string.Formatter().parse(text) if name is not None]
    except ValueError as error:
        raise ValueError(f"{error}; double a brace that the shell must see: {{{{ and }}}}") from None
    for name in names:
        if name not in PLACEHOLDERS:
            raise ValueError(
                f"there is no {{{name}}}{nearest(name, PLACEHOLDERS)}; double a brace that the shell must see"
            )
    if not {"command", "quoted"} & set(names):
        raise ValueError(
            "no worker is started: write {command} where its command belongs, such as 'srun {command}', or {quoted} "
            "where a second shell reads it, such as 'ssh node{i} {quoted}'"
        )
    return text


@dataclass(frozen=True, config={"extra": "forbid"})
class CommandOptions:
    """Options of the engine `command`."""

    template: Annotated[
        str,
        pydantic.AfterValidator(_template),
        pydantic.Field(
            description="shell line that starts a worker: {command} is the worker's command, {quoted} the same as one "
            "word, {i} counts the workers from 1, {group} names the group of seeds"
        ),
    ] = "{command}"


def shell_line(template: str, command: Sequence[str], place: int, group: str) -> str:
    """Put the words of a worker's command into a template, quoted as the shell needs it."""
    text = shlex.join(command)
    return template.format(command=text, quoted=shlex.quote(text), i=place, group=group)


class CommandEngine:
    """Starts workers by a shell command and follows them in the results folder."""

    def __init__(self, options: CommandOptions) -> None:
        self.options = options

    def workers(self, requested: int | None) -> int:
        """Return the number asked for, else one per core of this machine."""
        return requested or usable_cores()

    def queued(self, store: EntryStore) -> set[int]:
        """Return no seeds: a queue's content is unknown here, and a late worker does no harm."""
        return set()

    def run(self, works: Sequence[Work], show: Show) -> EngineOutcome:
        """Train the groups until all have finished or failed."""
        jobs = [_CommandJob(work, group, works) for work in works for group in work.groups]
        waiting, running = deque(jobs), list[_CommandJob]()
        free = deque(range(1, works[0].workers + 1))
        outcome = EngineOutcome()
        for job in jobs:
            job.progress.clear(len(job.group.seeds))
        try:
            while waiting or running:
                while waiting and free:
                    job = waiting.popleft()
                    job.start(self.options.template, free.popleft())
                    running.append(job)
                time.sleep(LOOK_SECONDS)
                claims = held(job.work.store for job in running)
                for job in list(running):
                    if job.look(claims):
                        continue
                    running.remove(job)
                    free.append(job.place)
                    if job.command_ended(outcome):
                        waiting.append(job)
                show({job.name: job.progress.read() for job in jobs})
        except BaseException:
            _stop(running)
            raise
        return outcome


class _CommandJob(WorkerJob):
    """A group whose worker was started by a command."""

    def __init__(self, work: Work, group: SeedGroup, works: Sequence[Work]) -> None:
        super().__init__(work, group, works)
        self.place = 0
        self.begun = False
        self._before: dict[str, Any] = {}

    def start(self, template: str, place: int) -> None:
        """Run the template's command.

        Parameters
        ----------
        place:
            The number of the worker, from 1: the value of `{i}`.
        """
        self.place, self.begun, self._before = place, False, self.progress.read()
        words = ["env", *(f"{name}={value}" for name, value in sorted(worker_environment().items()))]
        line = shell_line(template, [*words, *worker_command(self.work, self.group)], place, self.group.id)
        self.output = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the command has ended
        self.process = subprocess.Popen(
            line,
            shell=True,
            stdin=subprocess.DEVNULL,
            stdout=self.output,
            stderr=self.output,
            start_new_session=True,  # Ctrl-C reaches the worker once, from here
        )

    def look(self, claims: Sequence[Claim]) -> bool:
        """Return whether the group is still being trained, or waits to be."""
        code = None if self.process is None else self.process.poll()
        claimed = self.claimed(claims)
        self.begun |= claimed
        if code is None:
            return True
        if code == 3 or self.finished():
            return False
        waits = code == 0 and not self.begun and self.progress.read() == self._before
        return claimed or waits

    def command_ended(self, outcome: EngineOutcome) -> bool:
        """Judge an ended command; return whether to start it again, else record its end in the outcome."""
        text, progress = self.take_output(), self.progress.read()
        code = 0 if self.process is None else self.process.returncode
        if self.finished():
            return False
        if code == 3:
            outcome.taken[self.name] = text.rpartition("qrlsuite: ")[2] or "its seeds are being trained"
            return False
        if progress.get("error"):
            outcome.failed[self.name] = str(progress["error"])
            return False
        why = f"exit code {code} of its command" if code else "it left the results folder unfinished"
        given_up = self.died(why, text)
        if given_up is None:
            return True
        outcome.failed[self.name] = given_up
        return False


def _stop(running: Sequence[_CommandJob]) -> None:
    """Ask every worker to save and end, and wait for it; end commands whose worker never began."""
    asked: dict[str, Claim] = {}
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        claims = {
            claim.token: claim
            for claim in held(job.work.store for job in running)
            if any(job.claimed([claim]) for job in running)
        }
        for token in claims.keys() - asked.keys():
            claims[token].request_stop()
        asked |= claims
        for job in running:
            job.begun |= job.claimed(asked.values())
            if not job.begun:
                _signal(job, signal.SIGTERM)
        if not claims and all(job.process is None or job.process.poll() is not None for job in running):
            break
        time.sleep(LOOK_SECONDS / 5)
    for job in running:
        _signal(job, signal.SIGKILL)
        job.take_output()
    left = sum(
        1 for job in running if not job.begun and job.process is not None and job.process.returncode == 0
    )
    if left:
        log.warning(
            f"{left} worker{'s' * (left > 1)} may still wait in a queue: cancel what you do not want there; one that "
            "begins later goes on with the training"
        )


def _signal(job: _CommandJob, number: signal.Signals) -> None:
    """Signal a command that has not ended, with all that it started."""
    if job.process is not None and job.process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(job.process.pid, number)
        if number == signal.SIGKILL:
            job.process.wait()
