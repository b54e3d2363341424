"""Every hook of qrlsuite. A plugin implements the ones it needs; this file is the manual.

A plugin is a module (or object) listed as an entry point in the group `qrlsuite` of its distribution::

    [project.entry-points.qrlsuite]
    my_ansatz = "my_package.plugin"

and marks its implementations with `qrlsuite.hookimpl`. Importing the module must do nothing but define them:
no torch, no PennyLane, no Qiskit. Specs carry references to code (`"package.module:Name"`) that are resolved
only when a command needs them.
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
def register_environments(register: Callable[[specs.EnvironmentSpec], None]) -> None:
    """Register environments: `register(EnvironmentSpec(name=..., summary=..., options=..., gymnasium_id=...))`.

    A task file then names it under `[environment]`.
    """


@hookspec
def register_models(register: Callable[[specs.ModelSpec], None]) -> None:
    """Register function approximators: `register(ModelSpec(name=..., family="quantum", build=..., ...))`.

    They appear as `qrlsuite run --model NAME`.
    """


@hookspec
def register_algorithms(register: Callable[[specs.AlgorithmSpec], None]) -> None:
    """Register learning algorithms: they appear as `qrlsuite run --algorithm NAME`."""


@hookspec
def register_tasks(register: Callable[[specs.TaskSpec], None]) -> None:
    """Register benchmark tasks: `register(TaskSpec(name=..., summary=..., path=".../my-task.toml"))`."""


@hookspec
def register_studies(register: Callable[[specs.StudySpec], None]) -> None:
    """Register studies: `register(StudySpec(name=..., summary=..., path=".../my-study.toml"))`.

    They appear as `qrlsuite study run NAME`.
    """


@hookspec
def register_ansatzes(register: Callable[[specs.AnsatzSpec], None]) -> None:
    """Register circuit families: they appear as `--set ansatz=NAME` of every `vqc-*` model."""


@hookspec
def register_circuit_backends(register: Callable[[specs.CircuitBackendSpec], None]) -> None:
    """Register simulators or hardware that compute expectation values of a `qrlsuite.circuit.Circuit`."""


@hookspec
def register_significance_tests(register: Callable[[specs.SignificanceTestSpec], None]) -> None:
    """Register rules that decide whether one entry needs significantly fewer samples than another.

    They appear as `qrlsuite leaderboard --rule NAME`, `compare --rule NAME` and `calibrate --rule NAME`. A rule has
    a `name`, a `promise` (one sentence: which error probability it controls, and which it does not), and is
    called with two `qrlsuite.statistics.Evidence` objects, already at equal numbers of runs and one horizon. It
    returns an array (epsilons, deltas) of +1 where the first needs significantly fewer samples, -1 where it
    needs more and 0 elsewhere, with `rule(a, b) == -rule(b, a)`::

        class Half:
            name = "half"
            promise = "none: whoever needs less than half is declared the winner"

            def __call__(self, first, second):
                fewer, more = 2 * first.point < second.point, 2 * second.point < first.point
                return fewer.astype("int8") - more.astype("int8")

        @hookimpl
        def register_significance_tests(register):
            register(SignificanceTestSpec(name="half", summary="...", factory="my_package:Half"))

    Equal numbers, the limit of 20 runs, outperformance and ranking hold for every rule. A rule whose attribute
    `paired` is true is given entries with the same seeds in the same order.
    """


@hookspec
def register_engines(register: Callable[[specs.EngineSpec], None]) -> None:
    """Register places where groups of seeds run: they appear as `qrlsuite run --engine NAME`."""


@hookspec
def register_commands(app: typer.Typer) -> None:
    """Add commands to the `qrlsuite` command line: `@app.command() def hello(): ...`."""


@hookspec
def run_started(run: Mapping[str, Any]) -> None:
    """Observe a seed's run beginning or resuming.

    `run` is its `run.json` as a mapping (task, algorithm, model, options, seed, versions, ...).
    """


@hookspec
def epoch_finished(run: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Observe a finished epoch of one seed: `record` is its line of `epochs.jsonl` as a mapping."""


@hookspec
def run_finished(run: Mapping[str, Any]) -> None:
    """Observe a seed's run reaching its last epoch."""
