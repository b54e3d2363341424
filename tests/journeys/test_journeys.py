"""Journeys: what a user types from the first command to the last, with everything that is answered.

A file of this folder is one journey. Indented lines are a terminal's: after `$` stands what is typed (`>` continues
it), below it what is printed, messages (stderr) after `!`, and in brackets an exit code other than 0. All else is
prose. `qrlsuite` is a process of `tests.commands`; other lines are a shell's, in the journey's own folder, where a
task file `tiny.toml` lies. What differs from one machine or one day to the next is replaced (`CHANGING`).

    REWRITE=1 pytest tests/journeys

writes down what is printed now, and shows what that changes. Read every line of it before it is committed.
"""

from __future__ import annotations

import difflib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest

from tests.commands import Command, start
from tests.conftest import TINY, Hold, install_from_source, installed
from tests.engine.stress import children

HERE = Path(__file__).parent
NEEDS = {
    "dask": "distributed",
    "import-tensorboard": "tensorboard",
    "import-wandb": "wandb",
    "slurm": "submitit",
}
"""The package without which a journey is skipped."""
LONG = {"slurm"}
TIME = r"\b[\d.]+ ?(ms|s|min|h|days?|seconds?|minutes?|hours?)\b"
CHANGING = (
    (r"\b\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d)?(Z|\+00:00)?)?", "DATE"),
    (r"\bprocess \d+", "process N"),
    (r"\bhash [0-9a-f]{16}\b", "hash OF TODAY"),
    ("─{4,}", "────"),
    (r"\b\d[\d.,e-]* (to [\d.,e-]+ )?core-(hour|second|minute)s?", "N core-hours"),
    (r"core-hours \d[\d.e-]*( to [\d.e-]+)?", "core-hours N"),
    (r"\[files .*?\]", "[FILES]"),
    (r"\b(job|scancel) \d+", r"\1 N"),
    (r"first --seeds 0:\d+", "first --seeds 0:N"),
    (rf"{TIME}( to {TIME})?", "TIME"),
    (r"\bwith \d+ workers?\b", "with N workers"),
    (r"\b[\d.]+ (k|M|G|T)?B\b", "N B"),
    (r"\b\d{5,}(?=%)", "N"),
    (r"median score [\d.]+ after epoch 2000", "median score N after epoch 2000"),
)
"""What is replaced in what is printed, and by what: times, sizes, processes.

After 2000 epochs, the score depends on how the processor's vectors round.
"""
PROGRESS = re.compile(
    r"seeds \d+/\d+  epoch |(about )?[\d.]+ ?\w+ (or more )?left, by |qrlsuite: compiling |one round of |faster: fewer "
)
"""A line that is printed as often as there is time for, once on a machine, or on a slow one."""


class Journey:
    """A folder in which commands are typed one after the other."""

    def __init__(self, tmp_path: Path) -> None:
        self.folder = tmp_path / "here"
        self.folder.mkdir()
        (self.folder / "tiny.toml").write_text(TINY)
        self.environment = {**os.environ, "COLUMNS": "200", "TESTS": str(HERE.parent)}
        self.hold = Hold(tmp_path)
        self.words = {str(self.folder): "HERE", str(tmp_path): "TMP", socket.gethostname(): "HOST"}

    def type(self, line: str) -> list[str]:
        """Return what a line prints."""
        words = shlex.split(line, comments=True)
        if words[:2] == ["pip", "install"]:
            return self.install(*words[2:])
        if words[0] != "qrlsuite":
            done = subprocess.run(
                ["sh", "-c", line], cwd=self.folder, env=self.environment, capture_output=True, text=True
            )
            return self.printed(done.stdout, done.stderr, done.returncode)
        typed, _, stop = line.partition("  # ")
        typed, _, behind = typed.partition(" | ")
        command = self.start(shlex.split(typed.removesuffix(" 2>&1"))[1:], stop)
        out, err = command.communicate()
        if typed.endswith(" 2>&1"):
            out, err = err + out, ""
        if behind:
            done = subprocess.run(
                ["sh", "-c", behind], input=out, cwd=self.folder, capture_output=True, text=True
            )
            out, err = done.stdout, err + done.stderr
        assert command.returncode is not None
        return self.printed(out, err, command.returncode)

    def start(self, words: list[str], stop: str) -> Command:
        """Start a command; `SIGINT in epoch 2`: stop it there, by SIGKILL together with its workers."""
        if not stop:
            return start(*words, env=self.environment, cwd=self.folder)
        name, _, epoch = stop.partition(" in epoch ")
        held = {name: self.environment.get(name, "") for name in ("PYTHONPATH", "QRLSUITE_LOAD_PLUGINS")}
        for name_, value in (("PYTHONPATH", str(self.hold.site)), ("QRLSUITE_LOAD_PLUGINS", "holding")):
            held[name_] = f"{held[name_]}{':' if name_ == 'PYTHONPATH' else ','}{value}".lstrip(":,")
        held |= {"HOLD_IN_EPOCH": epoch, "QRLSUITE_CHECKPOINT_SECONDS": "0"}
        command = start(*words, env={**self.environment, **held}, cwd=self.folder)
        workers = int(words[words.index("--workers") + 1])
        self.hold.wait(command, workers=workers)
        processes = children(command.pid) if name == "SIGKILL" else []
        if processes:
            command.send_signal(signal.SIGSTOP)  # else it would begin a killed worker again
        for process in processes:
            os.kill(process, signal.SIGKILL)
        command.send_signal(signal.Signals[name])
        command.wait()
        while any(Path(f"/proc/{process}").exists() for process in processes):
            time.sleep(0.01)  # until whoever inherited them has noticed
        return command

    def install(self, *folders: str) -> list[str]:
        """Build packages and put them where commands find them, in the place of earlier versions."""
        site = self.folder.parent / "site"
        shutil.rmtree(site, ignore_errors=True)
        install_from_source(site, *(self.folder / folder for folder in folders))
        self.environment |= {k: v for k, v in installed(site).items() if v != os.environ.get(k)}
        return []

    def printed(self, out: str, err: str, code: int) -> list[str]:
        """Return what a command printed, without what changes."""
        lines = [f"! {line}" for line in err.splitlines() if line.strip() and not PROGRESS.match(line)]
        lines += without_hours([line for line in out.splitlines() if line.strip()])
        for index, line in enumerate(lines):
            for word, name in self.words.items():
                line = line.replace(word, name)
            for pattern, name in CHANGING:
                line = re.sub(pattern, name, line)
            lines[index] = line.rstrip()
        return lines + ([f"[{code}]"] if code else [])


def without_hours(lines: list[str]) -> list[str]:
    """Replace the numbers of a table's column `core-hours`, whose head is in two lines, the second above a rule."""
    edge, made = 0, list[str]()
    for line, below in zip(lines, [*lines[1:], ""]):
        if "──" in below:
            edge = line.find("hours") + len("hours") if "hours" in line else 0
        number = (
            re.search(r"(?<=  )[\d.]+(e-\d\d)?$", line[:edge]) if line[edge : edge + 1] in (" ", "") else None
        )
        made.append(f"{line[: number.start()]}{'N':>{len(number[0])}}{line[edge:]}" if number else line)
    return made


def traveled(text: str, journey: Journey) -> str:
    """Return a journey's file with what is printed now; what differs in line breaks and blanks alone is left."""
    lines, made = text.splitlines(), list[str]()
    while lines:
        made.append(lines.pop(0))
        if not made[-1].startswith("  $ "):
            continue
        typed, before = [made[-1][4:]], list[str]()
        while lines and lines[0].startswith("  >"):
            made.append(lines.pop(0))
            typed.append(made[-1][4:])
        while lines and lines[0].startswith("  ") and not lines[0].startswith("  $ "):
            before.append(lines.pop(0))
        now = [f"  {line}" for line in journey.type("\n".join(typed))]
        made += before if " ".join(before).split() == " ".join(now).split() else now
    return "\n".join(made) + "\n"


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(path.stem, marks=[pytest.mark.long] * (path.stem in LONG))
        for path in sorted(HERE.glob("*.txt"))
    ],
)
def test_journey(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    if name == "slurm" and shutil.which("sinfo") is None:
        pytest.skip("no SLURM here: sh tests/slurm/setup.sh")
    path = HERE / f"{name}.txt"
    before = path.read_text()
    after = traveled(before, Journey(tmp_path))
    changed = "\n".join(
        difflib.unified_diff(before.splitlines(), after.splitlines(), "stored", "now", n=2, lineterm="")
    )
    if os.environ.get("REWRITE"):
        path.write_text(after)
        with capsys.disabled():
            print(f"{path.name}\n{changed}" if changed else f"{path.name}: as before")
    elif changed:
        pytest.fail(
            f"{changed}\n\nREWRITE=1 pytest tests/journeys writes down what is printed now", pytrace=False
        )
