"""Commands that start at once: forks of a process that has imported everything.

A command of `start` or `qrlsuite` is a process of its own, with its own folder, environment, output, signals and
workers, as one typed into a shell. Only the seconds of imports are paid once, by a process that waits to be forked.
Tests of how a process starts (what it imports, from where, with which interpreter) use `subprocess`.

This file is also the program of that process, `python -P commands.py SOCKET`, for whatever interpreter.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import importlib.util
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typer.testing import Result

PRELOADED = (
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "pyarrow.compute",
    "qrlsuite.api",
    "qrlsuite.cli",
    "qrlsuite.engine.local",
    "qrlsuite.engine.probe",
    "qrlsuite.engine.worker",
    "qrlsuite.leaderboard",
    "qrlsuite.plugins.circuits.native.cpu",
    "qrlsuite.plugins.circuits.native.sweeps",
    "qrlsuite.training.group",
    "rich.progress",
    "rich.table",
    "scipy.interpolate",
    "torch",
)
WHERE_INSTALLED = {
    "distributed": ("distributed.cli.dask_scheduler", "distributed.cli.dask_worker"),
    "pandas": ("pandas", "pyarrow.pandas_compat"),  # which pyarrow imports before it makes its first array
}
for _package, _modules in WHERE_INSTALLED.items():
    if importlib.util.find_spec(_package) is not None:
        PRELOADED += _modules
PENNYLANE, QISKIT = "qrlsuite.plugins.circuits.pennylane", "qrlsuite.plugins.circuits.qiskit"
LOADED_FOR = {"vqc-pennylane": (PENNYLANE,), "check": (PENNYLANE, QISKIT), "pytest": (PENNYLANE, QISKIT)}
"""What is imported before the first command with this word, for it and all that follow."""
HANGS = 1200
"""Seconds after which a command is taken to hang: far more than any needs on a busy machine."""

# Tests kill processes, which loses no written byte; nothing cuts the power.
os.fsync = lambda descriptor: None


class Fork:
    """A process that calls `program`, with the methods of `subprocess.Popen` that the local engine uses."""

    def __init__(self, program: Callable[[], object]) -> None:
        self.returncode: int | None = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python 3.12 warns of threads, of which there are none
            # a signal that comes before the child has handlers of its own would be handled by its parent's, and lost
            held = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
            self.pid = os.fork()
        if self.pid == 0:
            code = 1
            try:
                for number, handler in (
                    (signal.SIGINT, signal.default_int_handler),
                    (signal.SIGTERM, signal.SIG_DFL),
                ):
                    signal.signal(number, handler)
                signal.pthread_sigmask(signal.SIG_SETMASK, held)
                code = int(program() or 0)  # type: ignore[call-overload]
            except SystemExit as end:
                if isinstance(end.code, str):
                    print(end.code, file=sys.stderr)
                code = end.code if isinstance(end.code, int) else int(end.code is not None)
            except BaseException:
                traceback.print_exc()
            finally:
                with contextlib.suppress(OSError, ValueError):  # closed by the command, or nobody reads
                    sys.stdout.flush()
                    sys.stderr.flush()
                os._exit(code)
        signal.pthread_sigmask(signal.SIG_SETMASK, held)

    def poll(self) -> int | None:
        """Return the exit code of a process that has ended."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def wait(self, timeout: float = HANGS) -> int:
        """Return the exit code when the process has ended, or raise `subprocess.TimeoutExpired`."""
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("fork", timeout)
            time.sleep(0.01)
        return code

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)


def _worker(
    filters: list[Any],
    command: list[str],
    *,
    env: Mapping[str, str],
    stdout: IO[bytes],
    preexec_fn: Callable[[], None],
    **rest: object,
) -> Fork:
    """Stand in for the `subprocess.Popen` of the local engine."""

    def program() -> int:
        from qrlsuite.engine import worker

        os.setsid()
        preexec_fn()
        os.dup2(stdout.fileno(), 1)
        os.dup2(stdout.fileno(), 2)
        os.environ.update(env)
        warnings.filters[:] = filters  # type: ignore[index]
        return worker.main(command[command.index("qrlsuite.engine.worker") + 1 :])

    return Fork(program)


def _resolving_here(
    fresh_process: Callable[..., dict[str, Any]], modules: tuple[str, ...], references: tuple[str, ...]
) -> dict[str, Any]:
    """Register plugins in a new interpreter, and resolve references in this one, which has imported torch already."""
    from qrlsuite.testing import fresh

    return {**fresh_process(modules, ()), "references": fresh.resolved(references)}


def _command(program: str, words: list[str], folder: str, env: dict[str, str]) -> int:
    """Be `python -W error -m qrlsuite WORDS`, a worker, `pytest WORDS`, `dask WORDS` or `python -m MODULE WORDS`."""
    from qrlsuite import cli, registry
    from qrlsuite.engine import local, probe, worker
    from qrlsuite.testing import common, fresh

    common.fresh_process = functools.partial(_resolving_here, fresh.fresh_process)  # type: ignore[assignment]
    registry.load.cache_clear()  # importing Gymnasium has loaded the plugins that were asked for then
    filters = list(warnings.filters)
    local.subprocess = SimpleNamespace(  # type: ignore[assignment]
        Popen=functools.partial(_worker, filters),
        DEVNULL=subprocess.DEVNULL,
        TimeoutExpired=subprocess.TimeoutExpired,
    )
    probe.subprocess = fresh.subprocess = FORKED  # type: ignore[assignment]
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(env)
    sys.path[:0] = [path for path in env.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.argv = ["qrlsuite", *words]
    if "dask" in sys.modules:
        importlib.import_module("dask.config").refresh()  # from this command's environment
    if program == "dask":
        importlib.import_module(f"distributed.cli.dask_{words[0]}").main(words[1:], standalone_mode=False)
        return 0
    if "." in program:
        worker.end_with = _end_with
        sys.modules.pop(program, None)
        runpy.run_module(program, run_name="__main__", alter_sys=True)
        return 0
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", "The ``noload`` loader strategy", DeprecationWarning)  # MLflow's tables
    if program == "worker":
        return worker.main(words)
    if program == "pytest":
        import pytest

        return pytest.main(words)
    cli.main()
    return 0


def _end_with(parent: int) -> bool:
    """Stand in for the worker's `end_with`: whoever started this process is not its parent."""

    def watch() -> None:
        with contextlib.suppress(ProcessLookupError):
            while True:
                os.kill(parent, 0)
                time.sleep(0.05)
        os._exit(130)

    threading.Thread(target=watch, daemon=True).start()
    return True


def _answer(request: Mapping[str, Any], out: int, err: int, reply: int, given: int) -> None:
    """Run one command to its end, in a process between it and the one that serves."""

    def program() -> int:
        os.close(reply)
        os.setsid()
        os.dup2(given, 0)
        os.dup2(out, 1)
        os.dup2(err, 2)
        return _command(**request)

    command = Fork(program)
    os.write(reply, f"{command.pid}\n".encode())
    with contextlib.suppress(BrokenPipeError):  # who asked has ended
        os.write(reply, f"{command.wait()}\n".encode())


def serve(control: int) -> None:
    """Fork a command for every request, until the other end of the socket is closed."""
    for name in PRELOADED:
        importlib.import_module(name)
    importlib.import_module("numba").njit(lambda: 0)()  # the first compiled function takes longest
    requests = socket.socket(fileno=control)
    from_commands, to_server = socket.socketpair()
    OWN_SERVER.append(to_server)
    running: list[Fork] = []
    while True:
        ready = select.select([requests, from_commands], [], [])[0]
        message, files, _, _ = socket.recv_fds(ready[0], 1, 5)
        running = [process for process in running if process.poll() is None]
        if not message:
            return
        request = json.loads(os.pread(files[0], os.fstat(files[0]).st_size, 0))
        for word in (request["program"], *request["words"]):
            for name in LOADED_FOR.get(word, ()):
                importlib.import_module(name)
        running.append(Fork(functools.partial(_answer, request, *files[1:])))
        for file in files:
            os.close(file)


OWN_SERVER: list[socket.socket] = []
"""Where a command asks the process that it was forked from for another fork."""


@functools.cache
def _server(python: str) -> socket.socket:
    if OWN_SERVER:
        return OWN_SERVER[0]
    ours, theirs = socket.socketpair()
    own = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    own["QRLSUITE_LOAD_PLUGINS"] = ""  # not what the test that comes first has set
    process = subprocess.Popen(
        [python, "-P", __file__, str(theirs.fileno())],
        env={**{k: v for k, v in os.environ.items() if k != "PYTHONPATH"}, **own},
        stdin=subprocess.DEVNULL,
        pass_fds=[theirs.fileno()],
        start_new_session=True,
    )
    theirs.close()

    def stop() -> None:
        ours.close()
        process.wait()

    atexit.register(stop)
    return ours


class Command:
    """A started command, with the methods of `subprocess.Popen` that tests use; its output waits in files."""

    def __init__(
        self,
        words: list[str],
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        python: str = sys.executable,
        program: str = "qrlsuite",
        output: IO[bytes] | None = None,
        given: IO[bytes] | None = None,
    ) -> None:
        self.returncode: int | None = None
        self._printed: tuple[str, ...] = ()
        self._out, self._err = (tempfile.TemporaryFile() for _ in range(2))  # noqa: SIM115 - until the end
        asked = {
            "program": program,
            "words": words,
            "folder": str(cwd or Path.cwd()),
            "env": dict(os.environ if env is None else env),
        }
        with tempfile.TemporaryFile() as request, Path(os.devnull).open("rb") as nothing:
            request.write(json.dumps(asked).encode())
            request.seek(0)
            self._reply, reply = os.pipe()
            out, err = output or self._out, output or self._err
            files = [request.fileno(), out.fileno(), err.fileno(), reply, (given or nothing).fileno()]
            socket.send_fds(_server(python), [b"."], files)
            os.close(reply)
        self.pid = int(self._line(HANGS))

    def _line(self, timeout: float) -> str:
        """Return the next line of the reply, or nothing where there is none in time."""
        if not select.select([self._reply], [], [], timeout)[0]:
            return ""
        line = b""
        while not line.endswith(b"\n"):
            part = os.read(self._reply, 1)
            assert part, "the process that starts commands has ended"
            line += part
        return line.decode()

    def poll(self) -> int | None:
        """Return the exit code of a command that has ended."""
        if self.returncode is None and (line := self._line(0)):
            self.returncode = int(line)
            os.close(self._reply)
            self._printed = tuple(_content(file) for file in (self._out, self._err))
        return self.returncode

    def wait(self, timeout: float = HANGS) -> int:
        """Return the exit code when the command has ended."""
        if self.returncode is None:
            assert select.select([self._reply], [], [], timeout)[0], "the command hangs"
        code = self.poll()
        assert code is not None
        return code

    def communicate(self, timeout: float = HANGS) -> tuple[str, str]:
        """Wait for the end; return what was printed, and the messages."""
        self.wait(timeout)
        return self._printed[0], self._printed[1]

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Fresh(Command):
    """Stand in for the `subprocess.Popen` of `python -m MODULE WORDS`: it has imported the suite, and run nothing."""

    def __init__(
        self, command: list[str], *, stdin: Any = None, stdout: Any, env: Any = None, **rest: object
    ):
        module, *words = command[command.index("-m") + 1 :]
        output = None if stdout == subprocess.PIPE else stdout
        super().__init__(words, env, program=module, output=output, given=stdin)


FORKED = SimpleNamespace(**{**vars(subprocess), "Popen": Fresh})
"""Stands in for the `subprocess` of a module whose processes must have run nothing."""


def _content(file: IO[bytes]) -> str:
    with file:
        file.seek(0)
        return file.read().decode()


def start(*words: str, env: Mapping[str, str] | None = None, cwd: Path | None = None) -> Command:
    """Start `qrlsuite WORDS` and go on."""
    return Command(list(words), env, cwd)


def start_worker(*words: str, env: Mapping[str, str] | None = None) -> Command:
    """Start `python -m qrlsuite.engine.worker WORDS` and go on."""
    return Command(list(words), env, program="worker")


def start_dask(*words: str, env: Mapping[str, str] | None = None, cwd: Path | None = None) -> Command:
    """Start `dask WORDS` (a scheduler or a worker) and go on."""
    return Command(list(words), env, cwd, program="dask")


def popen(command: list[str], *, env: Mapping[str, str], stdout: IO[bytes], **rest: object) -> Command:
    """Stand in for the `subprocess.Popen` of a local engine in this process."""
    words = command[command.index("qrlsuite.engine.worker") + 1 : command.index("--follow-parent")]
    return Command(words, env, program="worker", output=stdout)


def qrlsuite(
    *words: str, env: Mapping[str, str] | None = None, cwd: Path | None = None, python: str = sys.executable
) -> subprocess.CompletedProcess[str]:
    """Run `qrlsuite WORDS` to its end."""
    command = Command(list(words), env, cwd, python)
    out, err = command.communicate()
    assert command.returncode is not None
    return subprocess.CompletedProcess(["qrlsuite", *words], command.returncode, out, err)


def say(*words: str, typed: str | None = None, **environment: str) -> Result:
    """Run `qrlsuite WORDS` in this process; what it refuses is raised."""
    from typer.testing import CliRunner

    from qrlsuite.cli.app import build

    return CliRunner().invoke(build(), words, typed, environment, catch_exceptions=False)


def answer(*words: str) -> Any:
    """Return what `qrlsuite WORDS --json` prints, run in this process."""
    done = say(*words, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
