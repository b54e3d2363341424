"""An entry with its learning curves, for boards, pictures and comparisons."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from qrlsuite import registry, specs
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment.task import Task, TaskFile
from qrlsuite.experiment.task import load as load_task
from qrlsuite.results import codes, probes, provenance
from qrlsuite.results.records import EntryRecord
from qrlsuite.results.seeds import parse_seeds, read_seeds
from qrlsuite.results.store import MEASURED
from qrlsuite.results.text import counted


@dataclass(frozen=True, repr=False)
class EntryResults(Shown):
    """An entry with the learning curves of its complete runs. It shows itself as a short table.

    Attributes
    ----------
    parameters:
        Trainable numbers of one agent: classical, quantum.
    fixed:
        Numbers of one agent that stay as drawn.
    networks:
        Number of trained networks, over which `parameters` are summed. None in records of older versions, which counted
        the first network alone, see `first_network_alone`.
    curves:
        (N, T) float64: mean validation score per run and epoch. Half of the finished runs or more have T epochs.
    seeds:
        The N seeds.
    left_out:
        Seeds whose runs have fewer than T epochs yet.
    runs:
        Every run's whole curve by seed, shorter or longer than T; empty if all have T epochs.
    hours:
        Core-hours spent on all runs, with the left-out ones.
    clocked:
        Whether some of these hours are by the clock and not processor time; None if not recorded.
    codes:
        Digests of the code identities of its seeds; empty if all code is the suite's first version, or unknown.
    environments:
        Digests of every code of the environment among its seeds; empty if the environment is the suite's.
    plugins:
        Contents of plugins by path that trained its seeds, by file name.
    identity:
        Content of the entry's hash: task, algorithm, model and their resolved options.
    options:
        The resolved options under "algorithm", "model" and "environment".
    preset:
        The preset that supplied defaults.
    versions:
        Every version that occurs among the seeds, by distribution; Python's under "python".
    commits, processors, devices:
        Every code revision, processor and kind of device that occurs among the seeds.
    executions:
        Circuit executions of all these runs.
    tuning:
        How the settings were found, if their preset says so, see `qrlsuite.experiment.preset.EntryTuning`.
    plan:
        Hash of the study with looks that trained it; None if the number of seeds was fixed in advance.
    source:
        Whether the curves were read from a results folder or from a published entry.
    external:
        Whether another program made the curves: nobody here trained them, or can check them.
    agents:
        The seeds whose trained agents are published with it; empty for an entry from a results folder.
    color:
        Number of its color and pattern in pictures, which stays if others are left out; None takes the next number.
    unprobed:
        Whether it has code of others and no probe has shown that its seeds are independent.
    chosen_seeds:
        Why no board ranks it, if it is published and its seeds may have been chosen; empty otherwise.
    first_thresholds:
        The thresholds in force when its first seed was trained; None if not recorded.
    records:
        Number of its color and pattern in pictures, kept where others are left out; None takes the next number.
        first epoch after which its agent's numbers were not finite.
    refused:
        One line for each seed that does not count, since a file is damaged or the folder is not that seed's.
    measured:
        Metrics of the environment by seed and name, see `qrlsuite.results.store.SeedRun.measured`.
    """

    name: str
    label: str
    task: str
    task_hash: str
    task_file: TaskFile
    algorithm: str
    model: str
    parameters: tuple[int, int]
    curves: NDArray[np.float64]
    seeds: tuple[int, ...]
    left_out: tuple[int, ...]
    hours: float
    folder: Path
    identity: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    preset: str | None = None
    versions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    commits: tuple[str, ...] = ()
    processors: tuple[str, ...] = ()
    devices: tuple[str, ...] = ()
    executions: int = 0
    tuning: Mapping[str, Any] | None = None
    plan: str | None = None
    source: Literal["runs", "published"] = "runs"
    external: bool = False
    runs: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    agents: tuple[int, ...] = ()
    color: int | None = None
    records: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    networks: int | None = None
    fixed: int = 0
    clocked: bool | None = None
    codes: tuple[str, ...] = ()
    environments: frozenset[str] = frozenset()
    plugins: Mapping[str, frozenset[str]] = field(default_factory=dict)
    refused: tuple[str, ...] = ()
    unprobed: bool = False
    chosen_seeds: str = ""
    first_thresholds: tuple[float, ...] | None = None
    measured: Mapping[int, Mapping[str, NDArray[np.float64]]] = field(default_factory=dict)

    @classmethod
    def of_record(
        cls,
        record: EntryRecord,
        folder: Path,
        curves: Mapping[int, NDArray[np.float64]],
        records: Mapping[int, Mapping[str, Any]],
        parameters: Mapping[str, int],
        made_with: Sequence[Mapping[str, Any]],
        probed: Collection[str],
        **facts: Any,
    ) -> EntryResults:
        """Return the results of an entry, from runs or published.

        Parameters
        ----------
        curves:
            Each seed's curve (T,); lengths may differ.
        parameters:
            The result of `qrlsuite.results.store.parameters_of`.
        made_with:
            Provenance of the seeds, see `qrlsuite.results.provenance.collect`.
        probed:
            The results of probes of its seeds.
        records, facts:
            Further attributes, unchanged.
        """
        identity, now = record.identity, current(record)
        length = _common_length(records.values())
        kept = [seed for seed, curve in curves.items() if len(curve) >= length]
        return cls(
            name=record.name,
            label=record.label,
            task=record.task_name,
            task_hash=record.task_hash,
            task_file=now,
            algorithm=identity.algorithm,
            model=identity.model,
            parameters=(int(parameters.get("classical", 0)), int(parameters.get("quantum", 0))),
            networks=parameters.get("networks"),
            fixed=int(parameters.get("fixed", 0)),
            curves=np.stack([curves[seed][:length] for seed in kept]),
            seeds=tuple(kept),
            left_out=tuple(seed for seed in curves if seed not in kept),
            runs=curves if any(len(curve) != length for curve in curves.values()) else {},
            hours=float(np.sum([spent["hours"] for spent in records.values()])),
            executions=sum(spent["executions"] for spent in records.values()),
            records=records,
            folder=folder,
            identity=identity.content,
            options={
                "algorithm": identity.algorithm_options,
                "model": identity.model_options,
                "environment": now.environment.options,
            },
            preset=record.preset,
            tuning=record.tuned,
            plan=record.plan,
            versions=provenance.versions(made_with),
            commits=provenance.texts(made_with, "commit"),
            processors=provenance.texts(made_with, "processor"),
            devices=provenance.devices(made_with),
            unprobed=any(map(probes.third_party, made_with)) and probes.EQUAL not in probed,
            first_thresholds=record.task_file.ranking.grid.thresholds,
            external=record.imported is not None,
            plugins=codes.contents(record, facts.get("codes", ())),
            **facts,
        )

    def marked(self, mark: str) -> EntryResults:
        """Return the entry with the mark of its code behind its name and its label."""
        if not mark or "@" in self.name:
            return self
        return replace(self, name=f"{self.name}{mark}", label=f"{self.label} {mark}")

    def reaching(self, epochs: int) -> EntryResults | None:
        """Return the entry with every run that has reached a number of epochs, itself where all have; None for none."""
        if not self.runs:
            return self if self.curves.shape[1] >= epochs else None
        kept = {seed: curve[:epochs] for seed, curve in self.runs.items() if len(curve) >= epochs}
        if not kept:
            return None
        out = tuple(sorted(set(self.runs) - set(kept)))
        return replace(self, curves=np.stack(list(kept.values())), seeds=tuple(kept), left_out=out, runs={})

    @property
    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """Metrics of the environment along the curves by name, (N, T) each; NaN where it measured none."""
        held = [self.measured.get(seed, {}) for seed in self.seeds]
        length, nothing = self.curves.shape[1], np.full(self.curves.shape[1], np.nan)
        names = sorted({name for own in held for name in own})
        return {name: np.stack([own.get(name, nothing)[:length] for own in held]) for name in names}

    def cut(self, epochs: int) -> EntryResults | None:
        """Return the first epochs of every run that has reached them; None if no run has."""
        reached = self.reaching(epochs)
        return None if reached is None else replace(reached, curves=reached.curves[:, :epochs], runs={})

    def with_seeds(self, seeds: int | str | Iterable[int]) -> EntryResults:
        """Return the entry with these seeds only, to see the results of fewer seeds.

        Parameters
        ----------
        seeds:
            A number (20: seeds 0 to 19), the seeds themselves, or text ('0:20').
        """
        wanted = read_seeds(seeds)
        missing = sorted(set(wanted) - set(self.seeds))
        if missing:
            raise OptionError(f"'{self.label}' has no complete run of seed {missing[0]}")
        places = [self.seeds.index(seed) for seed in wanted]
        records = {seed: self.records[seed] for seed in wanted if seed in self.records}
        return replace(
            self,
            curves=self.curves[places],
            seeds=tuple(wanted),
            left_out=(),
            runs={},
            records=records,
            hours=sum(float(record["hours"]) for record in records.values()),
            executions=sum(int(record["executions"]) for record in records.values()),
        )

    @property
    def changed_thresholds(self) -> bool:
        """Whether the thresholds have changed since its first seed was trained."""
        first = self.first_thresholds
        return first is not None and sorted(first) != sorted(self.task_file.ranking.grid.thresholds)

    @property
    def diverged(self) -> tuple[int, ...]:
        """The seeds with agents whose numbers were not finite within the curves' epochs."""
        first = {seed: self.records.get(seed, {}).get("diverged") for seed in self.seeds}
        return tuple(seed for seed, epoch in first.items() if epoch and epoch <= self.curves.shape[1])

    def to_table(self) -> pyarrow.Table:
        """Return the curves as an Arrow table of N x T rows, seed by seed: `to_pandas()`, or `polars.from_arrow`.

        Its columns are `task`, `entry` (the label), `seed`, `epoch` (from 1), `steps` (environment steps at the end
        of the epoch), `score` (mean validation score after it), and `measured.NAME` for each metric of the environment.
        """
        n_runs, epochs = self.curves.shape
        epoch = np.tile(np.arange(1, epochs + 1), n_runs)
        return pyarrow.table(
            {
                "task": pyarrow.repeat(self.task, n_runs * epochs),
                "entry": pyarrow.repeat(self.label, n_runs * epochs),
                "seed": np.repeat(np.array(self.seeds, dtype=np.int64), epochs),
                "epoch": epoch,
                "steps": epoch * self.steps_per_epoch,
                "score": self.curves.ravel(),
                **{f"{MEASURED}.{name}": values.ravel() for name, values in self.metrics.items()},
            }
        )

    @property
    def facts(self) -> dict[str, str]:
        """The first facts about an entry, in words."""
        n_runs, epochs = self.curves.shape
        return {
            "task": self.task,
            "entry": f"{self.label} ({self.name})",
            **({"made": "by another program"} if self.external else {}),
            "parameters": self.parameters_text(" quantum"),
            "seeds": f"{n_runs}"
            + (f", {len(self.left_out)} unfinished left out" if self.left_out else "")
            + (f", {len(self.diverged)} diverged" if self.diverged else ""),
            **({"left out": "; ".join(self.refused)} if self.refused else {}),
            "epochs": f"{epochs} of {self.steps_per_epoch} environment steps",
            f"last {self.task_file.score.called}": f"median {np.median(self.curves[:, -1]):.3f} over seeds",
            "core-hours": f"{self.hours:.2f}" if self.hours or not self.external else "-",
            "read from": str(self.folder),
        }

    def __rich__(self) -> Table:
        table = Table(show_header=False, box=None, pad_edge=False)
        for name, text in self.facts.items():
            table.add_row(Text(name), Text(text))
        return table

    def parameters_text(self, unit: str = "") -> str:
        """Write the numbers of parameters, classical and quantum: `73 + 240`; `-` if unknown.

        Parameters
        ----------
        unit:
            Text behind the quantum number.
        """
        classical, quantum = self.parameters
        if self.external and not classical + quantum:
            return "-"
        return (f"{classical} + {quantum}{unit}" if quantum else f"{classical}") + self.fixed_text

    @property
    def fixed_text(self) -> str:
        """A note on numbers that stay as drawn: ` (240 fixed)`; empty if there are none."""
        return f" ({self.fixed} fixed)" if self.fixed else ""

    @property
    def legend(self) -> str:
        """The label, with the ansatz where the model has one and the label leaves the default out."""
        ansatz = self.identity.get("model_options", {}).get("ansatz")
        if ansatz is None or " ansatz=" in self.label:
            return self.label
        return f"{self.label} ansatz={ansatz}"

    @property
    def control(self) -> bool:
        """Whether it is a circuit whose qubits are not entangled: a classical control, see docs/controls.md."""
        options = self.identity.get("model_options", {})
        kept = {**options, **_mapping(options.get("ansatz_options"))}
        return kept.get("entangled") in ("separable", "mean-field")

    @property
    def longest(self) -> int:
        """The epochs of the longest run."""
        return max((len(curve) for curve in self.runs.values()), default=int(self.curves.shape[1]))

    @property
    def mixed_versions(self) -> tuple[str, ...]:
        """The distributions whose versions differ between the runs."""
        return tuple(name for name, used in self.versions.items() if len(used) > 1)

    @property
    def first_network_alone(self) -> bool:
        """Whether `parameters` leave out every network but the first, or may do so: an older version counted them.

        DDQN trains one network, and so does REINFORCE unless its baseline is one.
        """
        algorithm_options = self.identity.get("algorithm_options", {})
        one = {"ddqn": True, "reinforce": algorithm_options.get("baseline") != "value"}.get(
            self.algorithm, False
        )
        return self.networks is None and not one and not self.external

    @property
    def has_circuit(self) -> bool:
        """Whether its model is, in part, a quantum circuit."""
        return self.executions > 0 or self.parameters[1] > 0

    @property
    def settings(self) -> str:
        """Source of its settings: the preset and its options changed by `--set`, or `tuned` and the budget."""
        if self.tuning is not None:
            return _tuned_text(self.tuning)
        if self.external:
            return "-"
        presets = self.task_file.presets
        name = self.preset or "default"
        if self.algorithm not in presets.get(name, {self.algorithm: {}}):
            return (
                "default"  # a record of an older version, in which a preset without the algorithm was named
            )
        family = "quantum" if self.parameters[1] else "classical"
        tables: Mapping[Any, Any] = presets.get(name, {}).get(self.algorithm, {})
        own = self.identity.get("algorithm_options", {})
        usual = {**tables.get("all", {}), **tables.get(family, {})}
        changed = [option for option, value in usual.items() if own.get(option, value) != value]
        return f"{name} but {', '.join(changed)}" if changed else name

    @property
    def on_protocol_seeds(self) -> bool:
        """Whether its settings are known to have been chosen on the seeds that judge it."""
        return bool(self.tuning and self.tuning.get("on_protocol_seeds"))

    @property
    def steps_per_epoch(self) -> int:
        """Environment steps per epoch of one run."""
        return self.task_file.protocol.interactions


def current(record: EntryRecord) -> TaskFile:
    """Return the task's registered file if the entry has that definition, else the entry's own file.

    Ranking is no part of a definition: with the entries' own files, the first entry of a board would choose its cells.
    """
    registered = registered_task(record.task_name)
    same = registered is not None and registered.hash == record.task_hash
    return registered.file if registered is not None and same else record.task_file


def edited_between(first: EntryResults, second: EntryResults) -> str:
    """Return the error text if two entries of a task saw environments of different code; empty if not."""
    if not first.environments or not second.environments or first.environments & second.environments:
        return ""
    return (
        f"the code of environment '{first.task_file.environment.name}' was edited between '{first.label}' and "
        f"'{second.label}': their scores cannot be compared; train the one of the earlier code again with --fresh"
    )


def registered_task(name: str) -> Task | None:
    """Return a registered task, read once for all its entries; None where there is none, or it cannot be built."""
    return _registered(registry.load(), name)


@functools.lru_cache(maxsize=256)
def _registered(known: registry.Registry, name: str) -> Task | None:
    if name not in known.of(specs.TaskSpec):
        return None
    try:
        return load_task(name)
    except QrlSuiteError:
        return None  # its environment is not installed


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _common_length(records: Collection[Mapping[str, Any]]) -> int:
    """Return the epochs that half of the finished runs or more have; before any finished, the fewest of any run."""
    lengths = sorted((int(run["epochs"]) for run in records if run["finished"]), reverse=True)
    return lengths[(len(lengths) - 1) // 2] if lengths else min(int(run["epochs"]) for run in records)


def require_scores(scores: NDArray[np.float64], task_file: TaskFile, folder: Path) -> None:
    """Refuse scores that a task cannot give."""
    if not np.isfinite(scores).all():
        raise StoreError(f"{folder}: scores must be finite")
    outside = (scores < -_TOLERANCE) | (scores > 1 + _TOLERANCE)
    if task_file.ranking.thresholds is None and outside.any():
        raise StoreError(f"{folder}: a score is {scores[outside][0]:g}, outside [0, 1]")


_TOLERANCE = 1e-6  # a mean of scores in [0, 1] may leave it by rounding


def _tuned_text(tuning: Mapping[str, Any]) -> str:
    """Return the budget of tuning as far as it is known: `tuned (24 trials, 32 seeds, regret 5%)`."""
    known = [counted(int(tuning["trials"]), "trial")] if tuning.get("trials") is not None else []
    if isinstance(tuning.get("seeds"), str):
        with contextlib.suppress(OptionError):  # text of another suite, which a record may hold
            known.append(counted(len(parse_seeds(tuning["seeds"])), "seed"))
    if tuning.get("regret") is not None:
        known.append(f"regret {tuning['regret']['expected']:.0%}")
    changed = [name.partition(".")[2] for name in tuning.get("changed") or ()]
    text = f"tuned ({', '.join(known)})" if known else "tuned"
    return f"{text} but {', '.join(changed)}" if changed else text
