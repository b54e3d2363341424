"""Every hook of qrlsuite. A plugin implements the ones it needs; this file is the manual.

A plugin is a module (or object) listed as an entry point in the group `qrlsuite` of its distribution, which also
says which versions of the suite it works with:

    [project]
    dependencies = ["qrlsuite>=0.1,<0.2"]

    [project.entry-points.qrlsuite]
    my_ansatz = "my_package.plugin"

and marks its implementations with `qrlsuite.hookimpl`. Importing the module must do nothing but define them:
no torch, no PennyLane, no Qiskit. Specs carry references to code (`"package.module:Name"`) that are resolved
only when a command needs them. `qrlsuite check NAME` finds out whether what is registered keeps to the rules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import pluggy

from qrlsuite import specs

if TYPE_CHECKING:
    import typer

PROJECT = "qrlsuite"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def register(register: Callable[[specs.Spec], None]) -> None:
    """Register anything: the type of a spec says what it is.

    This one hook serves for all of the `register_KIND` hooks below, whose manuals say what each kind needs:

        from qrlsuite import hookimpl
        from qrlsuite.specs import AnsatzSpec, TaskSpec

        @hookimpl
        def register(register):
            register(AnsatzSpec("ring", "RY and a ring", "my_package.ring:Options", "my_package.ring:ring"))
            register(TaskSpec("short", "A short task", "my_package/short.toml"))
    """


@hookspec
def register_environments(register: Callable[[specs.EnvironmentSpec], None]) -> None:
    """Register environments: a task file then names one under `[environment]`.

    `options` is a pydantic dataclass whose fields are the keyword arguments of the `gymnasium.Env` at `entry_point`.
    Faster lanes (`vector`), reference policies and pictures are optional: see `qrlsuite.specs.EnvironmentSpec`:

        from qrlsuite import hookimpl
        from qrlsuite.specs import EnvironmentSpec

        @hookimpl
        def register_environments(register):
            register(
                EnvironmentSpec(
                    name="corridor",
                    summary="Walk to the end of a corridor",
                    options="my_package.corridor:Options",
                    gymnasium_id="my_package/Corridor-v1",
                    entry_point="my_package.corridor:Corridor",
                )
            )
    """


@hookspec
def register_models(register: Callable[[specs.ModelSpec], None]) -> None:
    """Register function approximators: they appear as `qrlsuite run --model NAME`.

    `build(obs_dim, out_dim, options, generator)` returns an ordinary `torch.nn.Module` for one agent,
    (B, obs_dim) -> (B, out_dim), and draws from `generator` alone: see `qrlsuite.specs.ModelSpec`:

        from qrlsuite import hookimpl
        from qrlsuite.specs import ModelSpec

        @hookimpl
        def register_models(register):
            register(
                ModelSpec(
                    name="waves",
                    summary="Random Fourier features and a linear layer",
                    family="classical",
                    options="my_package.waves:Options",
                    build="my_package.waves:build",
                )
            )
    """


@hookspec
def register_algorithms(register: Callable[[specs.AlgorithmSpec], None]) -> None:
    """Register learning algorithms: they appear as `qrlsuite run --algorithm NAME`.

    `factory(envs, build_model, options, streams, device)` returns an object with the methods of
    `qrlsuite.algorithm.Algorithm`, which trains one agent for every seed at once:

        from qrlsuite import hookimpl
        from qrlsuite.specs import AlgorithmSpec

        @hookimpl
        def register_algorithms(register):
            register(
                AlgorithmSpec(
                    name="sarsa",
                    summary="On-policy temporal differences",
                    options="my_package.sarsa:Options",
                    factory="my_package.sarsa:Sarsa",
                )
            )
    """


@hookspec
def register_tasks(register: Callable[[specs.TaskSpec], None]) -> None:
    """Register benchmark tasks: they appear as `qrlsuite run --task NAME`.

    `path` names the task's TOML file, and name and summary are those in the file:

        from pathlib import Path
        from qrlsuite import hookimpl
        from qrlsuite.specs import TaskSpec

        @hookimpl
        def register_tasks(register):
            path = Path(__file__).with_name("corridor.toml")
            register(TaskSpec(name="corridor", summary="A corridor of ten steps", path=str(path)))
    """


@hookspec
def register_studies(register: Callable[[specs.StudySpec], None]) -> None:
    """Register studies, a list of entries and their pictures: they appear as `qrlsuite study run NAME`.

    `path` names the study's TOML file:

        from pathlib import Path
        from qrlsuite import hookimpl
        from qrlsuite.specs import StudySpec

        @hookimpl
        def register_studies(register):
            path = Path(__file__).with_name("widths.toml")
            register(StudySpec(name="widths", summary="How wide a network must be", path=str(path)))
    """


@hookspec
def register_ansatzes(register: Callable[[specs.AnsatzSpec], None]) -> None:
    """Register circuit families: they appear as `--set ansatz=NAME` of every `vqc-*` model.

    `build(qubits, layers, options)` returns a `qrlsuite.circuit.Circuit`, a description that every backend runs:

        from qrlsuite import hookimpl
        from qrlsuite.specs import AnsatzSpec

        @hookimpl
        def register_ansatzes(register):
            register(
                AnsatzSpec(
                    name="ring",
                    summary="Re-uploaded RY, and a ring of RZZ",
                    options="my_package.ring:Options",
                    build="my_package.ring:build",
                )
            )
    """


@hookspec
def register_circuit_backends(register: Callable[[specs.CircuitBackendSpec], None]) -> None:
    """Register simulators or hardware that compute expectation values of a `qrlsuite.circuit.Circuit`.

    `factory(circuit, options)` returns a callable of inputs and parameters, differentiable by torch: see
    `qrlsuite.circuit.api.CircuitBackend`. They appear as `qrlsuite.circuit.expectations(..., backend=NAME)`:

        from qrlsuite import hookimpl
        from qrlsuite.specs import CircuitBackendSpec

        @hookimpl
        def register_circuit_backends(register):
            register(
                CircuitBackendSpec(
                    name="mps",
                    summary="Matrix product states",
                    options="my_package.mps:Options",
                    factory="my_package.mps:Backend",
                )
            )
    """


@hookspec
def register_rules(register: Callable[[specs.RuleSpec], None]) -> None:
    """Register rules that decide whether one entry needs significantly fewer samples than another.

    They appear as `qrlsuite leaderboard --rule NAME` and `compare --rule NAME`. A rule has
    a `name`, a `promise` (one sentence: which error probability it controls, and which it does not), and is
    called with two `qrlsuite.statistics.Evidence` objects, already at equal numbers of runs and one horizon. It
    returns an array (epsilons, deltas) of +1 where the first needs significantly fewer samples, -1 where it
    needs more and 0 elsewhere, with `rule(a, b) == -rule(b, a)`:

        class Half:
            name = "half"
            promise = "none: whoever needs less than half is declared the winner"

            def __call__(self, first, second):
                fewer, more = 2 * first.point < second.point, 2 * second.point < first.point
                return fewer.astype("int8") - more.astype("int8")

        @hookimpl
        def register_rules(register):
            register(RuleSpec(name="half", summary="...", factory="my_package:Half"))

    Equal numbers, the limit of 20 runs, outperformance and ranking hold for every rule.
    """


@hookspec
def register_engines(register: Callable[[specs.EngineSpec], None]) -> None:
    """Register places where groups of seeds run: they appear as `qrlsuite run --engine NAME`.

    `factory(options)` returns an object with the methods of `qrlsuite.engine.api.Engine`; it decides only where
    `python -m qrlsuite.engine.worker` runs, and all results are files:

        from qrlsuite import hookimpl
        from qrlsuite.specs import EngineSpec

        @hookimpl
        def register_engines(register):
            register(
                EngineSpec(
                    name="ssh",
                    summary="Processes on other machines that share a folder",
                    factory="my_package.ssh:Engine",
                    options="my_package.ssh:Options",
                )
            )
    """


@hookspec
def register_trackers(register: Callable[[specs.TrackerSpec], None]) -> None:
    """Register trackers that watch a run when they are asked for: `qrlsuite run --track NAME`.

    `factory(target)` returns an object with any of the methods `run_started`, `epoch_finished` and `run_finished`,
    as the hooks of these names; `target` is what the user wrote after `--track NAME=`, or None:

        from qrlsuite import hookimpl
        from qrlsuite.specs import TrackerSpec

        @hookimpl
        def register_trackers(register):
            register(
                TrackerSpec(
                    name="csv",
                    summary="A line per epoch in a CSV file",
                    factory="my_package.csv_tracker:Tracker",
                )
            )
    """


@hookspec
def register_commands(app: typer.Typer) -> None:
    """Add commands to the `qrlsuite` command line.

    `app` is a `typer.Typer`. A name that is taken already is refused:

        import typer
        from qrlsuite import hookimpl

        @hookimpl
        def register_commands(app):
            @app.command("hello")
            def hello(name: str = "you"):
                'Greet someone.'
                typer.echo(f"Hello, {name}.")
    """


@hookspec
def run_started(run: Mapping[str, Any]) -> None:
    """Observe a seed's run beginning or resuming, in the worker that trains it.

    `run` is a mapping: what the seed's `run.json` says (task, entry, label, algorithm, model, their options, seed,
    ...), `epochs`, the number of epochs that are finished, `history`, their records as `epoch_finished` is given them,
    and `folder`, the seed's folder. What a tracker prints goes to the worker's output, which nobody reads: write to a
    file.

    A run that was stopped resumes from its last checkpoint, so epochs after `run["epochs"]` may come a second time:
    they are equal to those of the first. A tracker that raises is reported once and left out; it never stops a run.

    This hook watches every run. A tracker that is only to watch when asked for is registered with
    `register_trackers`:

        from pathlib import Path
        from qrlsuite import hookimpl

        @hookimpl
        def run_started(run):
            with Path(run["folder"], "notes.txt").open("a") as file:
                print(f"{run['label']} begins after epoch {run['epochs']}", file=file)
    """


@hookspec
def epoch_finished(run: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Observe a finished epoch of one seed: `record` is its line of `epochs.jsonl` as a mapping.

    It has `epoch`, the validation `scores` (a list of numbers), and the algorithm's metrics (`loss`, ...),
    `train_return` and `train_score`: numbers, or None where there is no value. `run` is as in `run_started`,
    without `epochs` and `history`:

        from pathlib import Path
        from qrlsuite import hookimpl

        @hookimpl
        def epoch_finished(run, record):
            mean = sum(record["scores"]) / len(record["scores"])
            with Path(run["folder"], "notes.txt").open("a") as file:
                print(f"epoch {record['epoch']}: {mean:.3f}", file=file)
    """


@hookspec
def run_finished(run: Mapping[str, Any]) -> None:
    """Observe a seed's run reaching its last epoch; its results are complete on disk.

    `run` is as in `run_started`, without `history`:

        from pathlib import Path
        from qrlsuite import hookimpl

        @hookimpl
        def run_finished(run):
            with Path(run["folder"], "notes.txt").open("a") as file:
                print(f"seed {run['seed']} is done", file=file)
    """
