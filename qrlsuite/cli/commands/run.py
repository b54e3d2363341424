"""`qrlsuite run`: train the missing seeds of an entry."""

from __future__ import annotations

import contextlib
import functools
import json
from pathlib import Path
from typing import Annotated

import typer

from qrlsuite import options, registry, specs
from qrlsuite.api.arguments import where_of
from qrlsuite.api.training import resolve_entry, train_entry
from qrlsuite.cli.arguments import (
    JsonOption,
    RunsOption,
    TrainedTaskOption,
    entries_here,
    names_of,
    split_settings,
)
from qrlsuite.cli.training import (
    BudgetOption,
    DeviceOption,
    EngineOption,
    SameOption,
    TrackOption,
    WorkersOption,
)
from qrlsuite.engine.missing import summarize
from qrlsuite.engine.terminal import command
from qrlsuite.errors import OptionError, QrlSuiteError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.experiment.task import load
from qrlsuite.notation import Written, joined, parse_entry, split, write_setting

QUICK_QUBITS = 4


def run(
    task: TrainedTaskOption,
    entry: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ENTRY]",
            help="[ALGORITHM] MODEL [NAME=VALUE ...] [preset=FILE], as boards print it: mlp width=16, or ppo mlp. "
            "With --model, options alone.",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            help="A function approximator (see `qrlsuite list models`).",
            autocompletion=names_of("models"),
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="An option, for example --set qubits=6, --set algorithm.gamma=.9, --set environment.degree=4.",
        ),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option("--seeds", help="100, or 0:20, or 0,3,10:12; default: the task's protocol.")
    ] = None,
    epochs: Annotated[
        int | None, typer.Option("--epochs", min=1, help="Default: the task's protocol.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help=f"A small budget: 8 seeds, 10 epochs, {QUICK_QUBITS} qubits; less where training is slow.",
        ),
    ] = False,
    start: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="ENTRY",
            help="Begin with the trained agents of this entry, seed k with seed k's agent; [TASK/]ENTRY, or a folder.",
            autocompletion=entries_here,
        ),
    ] = None,
    budget: BudgetOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
    device: DeviceOption = "cpu",
    same: SameOption = None,
    track: TrackOption = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Start even if training will take more than a day.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Train the missing seeds of an entry (a model and an algorithm on a task).

    Stop with Ctrl-C at any time; the same command continues where it stopped. More --seeds or --epochs add to
    earlier results; repeating a finished command does nothing.

    A script of your own is an entry, too: a process for each seed, started without a shell. curve=PATTERN says where it
    writes its learning curve; default: where CleanRL does.

    Examples: qrlsuite run mlp width=16 --task beam6g --seeds 20; qrlsuite run --task beam6g --model vqc-pennylane
    --set qubits=6; qrlsuite run script ppo-mine command="python ppo.py --seed {seed} --total-timesteps {steps}"
    curve="logs/{seed}.csv" metric=episodic_return --task cartpole --seeds 20
    """
    where = where_of(engine, workers, device, same)
    written = _written(entry or [], model, settings or [], quick)
    chosen = resolve_entry(task, written, runs=runs)
    quick_seeds, quick_epochs = chosen.model.quick if quick else (None, None)
    work, submitted = train_entry(
        chosen,
        where,
        seeds or quick_seeds,
        epochs or quick_epochs,
        budget,
        track or (),
        runs,
        progress=not json_output,
        confirmed=yes,
        start=start,
    )
    if json_output:
        typer.echo(json.dumps({"submitted": submitted} if submitted else summarize(work)))
    elif submitted is not None:
        typer.echo(submitted)
    elif work.todo and work.entry.model.family == "quantum" and work.entry.start is None:
        given = {"--seeds": seeds, "--epochs": epochs}
        words = [word for name, value in given.items() if value is not None for word in (name, str(value))]
        with contextlib.suppress(QrlSuiteError):  # a preset or an algorithm that is for circuits alone
            typer.echo(
                _of_its_size(work.entry, task, written, [*words, *["--quick"] * quick], runs), err=True
            )


def _of_its_size(circuit: Entry, task: str, written: Written, words: list[str], runs: Path) -> str:
    """Return a line that says how to train the network to which a circuit is compared."""
    from qrlsuite.population import count_parameters, remembers  # torch is slow to import
    from qrlsuite.studies.sizes import nearest_size, parameters
    from qrlsuite.training.trainer import first_network

    learning, world = (
        [s for s in written.settings if s.side in (None, side) and s.name in options.field_names(type(own))]
        for side, own in (
            ("algorithm", circuit.algorithm_options),
            ("environment", circuit.task.environment_options),
        )
    )
    kept = tuple(s for s in (*learning, *world) if s.name != "quantum_lr")
    first, loaded = first_network(circuit), load(task)
    model = "gru" if remembers(first) else "mlp"

    @functools.cache
    def network(width: int) -> Entry:
        width_of = options.Setting("model", "width", width)
        return resolve(loaded, Written(model, written.algorithm, (*kept, width_of), written.preset))

    found = network(nearest_size(network, circuit))
    counts = f"{parameters(found)} parameters, the circuit has {sum(count_parameters(first))}"
    entry = [*split(found.label), *(write_setting(f"environment.{s.name}", s.value) for s in world)]
    return f"a network of its size ({counts}): {command('run', *entry, '--task', task, *words, runs=runs)}"


def _written(words: list[str], model: str | None, settings: list[str], quick: bool) -> Written:
    """Read the entry from arguments or --model, and add the settings of --set and --quick."""
    if model is not None and not split_settings(words)[0]:
        words, model = [model, *words], None
    if not words or model is not None:
        problem = f"'{' '.join(words)}' and --model {model}: give one of them" if words else "name a model"
        raise OptionError(f"{problem}, for example: qrlsuite run mlp width=16 --task beam6g")
    written = parse_entry(joined(words)).given(settings=tuple(map(options.parse_setting, settings)))
    if not quick or any(setting.name == "qubits" for setting in written.settings):
        return written
    ansatzes = registry.load().of(specs.AnsatzSpec)
    if written.algorithm == SCRIPT or any(
        each.name == "ansatz" and each.value in ansatzes and ansatzes[str(each.value)].spec.size
        for each in written.settings
    ):
        return written
    names = options.field_names(specs.resolve(registry.get(specs.ModelSpec, written.model).options))
    fewer = (options.Setting("model", "qubits", QUICK_QUBITS),) if "qubits" in names else ()
    return written.given(settings=fewer)
