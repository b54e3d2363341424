"""An entry with its learning curves, for boards, pictures and comparisons."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from qrlsuite import registry, specs
from qrlsuite.engine.terminal import Shown
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.experiment.task import Task, TaskFile
from qrlsuite.experiment.task import load as load_task
from qrlsuite.results import codes, probes, provenance, requests
from qrlsuite.results.records import EntryRecord, Provenance, RunRecord
from qrlsuite.results.seeds import parse_seeds, read_seeds
from qrlsuite.results.store import EntryStore, SeedRun, parameters_of
from qrlsuite.results.text import counted, hours_text

BESIDE = "-published"
"""The mark of a published entry that stands beside own runs of it."""


class DifferentCurvesError(StoreError):
    """Two folders have different curves of the same seed."""


@dataclass(frozen=True, repr=False, eq=False)
class EntryResults(Shown):
    """The seeds of an entry: from a results folder, published, or of another program. It shows itself as a short table.

    Results of the same entry add: `mine + published` has the seeds of both.

    Attributes
    ----------
    task_file:
        The task as it is judged: as it is registered now, where its definition is the same.
    records:
        By seed, left-out ones too.
    epochs:
        T of `curves`.
    most:
        Epochs beyond which curves were cut; None where they were not.
    folder:
        Folder of its files; for a sum, the folder of the results with more seeds.
    mark:
        Text behind its name where another code has the name alone.
    refused:
        One line for each seed that does not count, since a file is damaged or the folder is not that seed's.
    asked:
        The epochs to which seeds were asked for, by seed (of N published ones 0 to N - 1); empty without a record.
    withdrawn:
        Why seeds that were asked for no longer are, by seed.
    own_label:
        The reader's name for it, which is shown as it is; empty if there is none.
    color:
        Number of its color and pattern in pictures, so that it keeps them where others are left out; None counts.
    """

    record: EntryRecord
    task_file: TaskFile
    records: Mapping[int, SeedRun]
    epochs: int
    folder: Path
    most: int | None = None
    mark: str = ""
    refused: tuple[str, ...] = ()
    asked: Mapping[int, int] = field(default_factory=dict)
    withdrawn: Mapping[int, str] = field(default_factory=dict)
    own_label: str = ""
    color: int | None = None

    @classmethod
    def of(
        cls, record: EntryRecord, folder: Path, seeds: Mapping[int, SeedRun], **facts: Any
    ) -> EntryResults:
        """Return the results of an entry, cut to the epochs that half of the finished seeds or more have."""
        return cls(record, current(record), seeds, _common_length(seeds.values()), folder, **facts)

    def __add__(self, other: EntryResults) -> EntryResults:
        """Return the union of the seeds, the longer curve of each; a `DifferentCurvesError` where they differ."""
        same = (self.task_hash, self.record.hash) == (other.task_hash, other.record.hash)
        if not (same and self.has_code_of(other)):
            raise OptionError(
                f"'{self.label}' and '{other.label}' are not the same entry: their seeds do not add"
            )
        for seed in sorted(self.records.keys() & other.records.keys()):
            here, there = self.records[seed], other.records[seed]
            if not here.agrees(there):
                first, second = sorted((str(here.folder), str(there.folder)))
                raise DifferentCurvesError(f"seed {seed} has one curve in {first} and another in {second}")
        seeds = {**self.records, **other.records}
        seeds |= {
            seed: self.records[seed] + other.records[seed] for seed in self.records.keys() & other.records
        }
        most = min((each.most for each in (self, other) if each.most is not None), default=None)
        length = _common_length(seeds.values())
        return replace(
            max(self, other, key=lambda results: (len(results.records), str(results.folder))),
            records=dict(sorted(seeds.items())),
            epochs=length if most is None else min(length, most),
            most=most,
            refused=tuple(sorted({*self.refused, *other.refused})),
            asked={**self.asked, **other.asked},
            withdrawn={s: why for s, why in {**self.withdrawn, **other.withdrawn}.items() if s not in seeds},
        )

    def has_code_of(self, other: EntryResults) -> bool:
        """Return whether the seeds of both were trained by the same code, or by codes that `--same` links."""
        here, there = (codes.linked(each.record, each.codes) for each in (self, other))
        return self.codes == other.codes or bool(set(here) & set(there))

    @property
    def name(self) -> str:
        """Algorithm, model and hash, with the mark."""
        return f"{self.record.name}{self.mark}"

    @property
    def label(self) -> str:
        """The reader's name for it, or algorithm, model and the options that are not defaults, with the mark."""
        return self.own_label or self.trained_as

    @property
    def short(self) -> str:
        """The label without the algorithm, where others share it."""
        return self.own_label or self.trained_as.removeprefix(f"{self.algorithm} ")

    @property
    def trained_as(self) -> str:
        """Algorithm, model and the options that are not defaults, with the mark."""
        mark = "(published)" if self.mark == BESIDE else self.mark
        return f"{self.record.label} {mark}".rstrip()

    @property
    def task(self) -> str:
        """The task's name."""
        return self.record.task_name

    @property
    def task_hash(self) -> str:
        """Hash of the task's definition."""
        return self.record.task_hash

    @property
    def algorithm(self) -> str:
        """The algorithm's name."""
        return self.record.identity.algorithm

    @property
    def model(self) -> str:
        """The model's name."""
        return self.record.identity.model

    @property
    def identity(self) -> Mapping[str, Any]:
        """The content of the entry's hash: task, algorithm, model and their resolved options."""
        return self.record.identity.content

    @property
    def options(self) -> dict[str, Mapping[str, Any]]:
        """The resolved options under "algorithm", "model" and "environment"."""
        identity = self.record.identity
        return {
            "algorithm": identity.algorithm_options,
            "model": identity.model_options,
            "environment": self.task_file.environment.options,
        }

    @property
    def preset(self) -> str | None:
        """The preset that supplied defaults."""
        return self.record.preset

    @property
    def tuning(self) -> Mapping[str, Any] | None:
        """How the settings were found, where their preset says so, see `qrlsuite.experiment.preset.EntryTuning`."""
        return self.record.tuned

    @property
    def study(self) -> str | None:
        """Hash of the study with looks that trained it; None for a number of seeds that was fixed in advance."""
        return self.record.plan

    @property
    def external(self) -> bool:
        """Whether another program made the curves: nobody here trained them, or can check them."""
        return bool(self.record.imported)

    @property
    def made(self) -> str:
        """The origin of external curves, in words."""
        return "by a script, not repeatable here" if self.algorithm == SCRIPT else "by another program"

    @property
    def ended_early(self) -> str:
        """How many imported runs end before the others, and what they were taken for; empty for none."""
        said = [run.imported.get("early") for run in self._run_records]
        taken = [(said.count(word), word) for word in ("solved", "failed") if word in said]
        return ", ".join(
            f"{counted(count, 'seed')} that ended early taken as {word}" for count, word in taken
        )

    @property
    def first_thresholds(self) -> tuple[float, ...] | None:
        """The thresholds in force when its first seed was trained; None where the record does not say."""
        return self.record.task_file.ranking.grid.thresholds

    @cached_property
    def seeds(self) -> tuple[int, ...]:
        """The N seeds with T epochs or more."""
        return tuple(seed for seed, run in self.records.items() if run.epochs >= self.epochs)

    @property
    def left_out(self) -> tuple[int, ...]:
        """Seeds whose runs have fewer than T epochs yet."""
        return tuple(seed for seed in self.records if seed not in self.seeds)

    @cached_property
    def missing(self) -> tuple[int, ...]:
        """The seeds that were asked for and have fewer than T epochs.

        Where T is less than the task's shortest horizon, they need as many epochs as they were asked for.
        """
        short = self.epochs * self.steps_per_epoch < min(self.task_file.ranking.horizons)
        there = {seed: run.epochs for seed, run in self.records.items()}
        return tuple(
            seed
            for seed, epochs in sorted(self.asked.items())
            if there.get(seed, 0) < (max(self.epochs, epochs) if short else self.epochs)
        )

    @property
    def missing_text(self) -> str:
        """`4 of 24 seeds are missing: 6, 7, 9, 18`, or that some are still training."""
        return requests.missing_text(EntryStore(self.folder), self.missing, len({*self.asked, *self.seeds}))

    @cached_property
    def curves(self) -> NDArray[np.float64]:
        """(N, T) float64: mean validation score per seed and epoch."""
        return np.stack([self.records[seed].curve[: self.epochs] for seed in self.seeds])

    @cached_property
    def _run_records(self) -> list[RunRecord]:
        return [run.record for run in self.records.values() if run.record is not None]

    @cached_property
    def counts(self) -> Mapping[str, int]:
        """The numbers of an agent, see `qrlsuite.results.store.parameters_of`."""
        return parameters_of(self._run_records)

    @property
    def parameters(self) -> tuple[int, int]:
        """Trainable numbers of one agent: classical, and of circuits."""
        return int(self.counts.get("classical", 0)), int(self.counts.get("quantum", 0))

    @property
    def networks(self) -> int | None:
        """Number of trained networks, over which `parameters` are summed.

        None in records of older versions, which counted the first alone, see `first_network_alone`.
        """
        return self.counts.get("networks")

    @property
    def fixed(self) -> int:
        """Numbers of one agent that stay as drawn."""
        return int(self.counts.get("fixed", 0))

    @property
    def source(self) -> Literal["runs", "published", "runs and published"]:
        """Whether the curves were read from a results folder, from a published entry, or from both."""
        origins = {run.published for run in self.records.values()}
        return "runs and published" if len(origins) > 1 else "published" if True in origins else "runs"

    @property
    def folders(self) -> list[Path]:
        """Where its seeds were read."""
        return list(dict.fromkeys(run.folder for run in self.records.values()))

    @property
    def agents(self) -> tuple[int, ...]:
        """The seeds whose trained agents are published with it; none of an entry from a results folder."""
        runs = (run for run in self.records.values() if run.published)
        return tuple(run.seed for run in runs if run.record is not None and run.record.agent)

    @property
    def hours(self) -> float:
        """Core-hours spent on all seeds, left-out ones too."""
        return float(np.sum([run.hours for run in self.records.values()]))

    @property
    def executions(self) -> int:
        """Circuit executions of these seeds in all."""
        return sum(run.executions for run in self.records.values())

    @property
    def clocked(self) -> bool | None:
        """Whether any of the hours are by the clock and not processor time; None where a record does not say."""
        clocked = {run.clocked for run in self.records.values()}
        return None if None in clocked else True in clocked

    @cached_property
    def _made_with(self) -> list[Provenance]:
        made = (made for record in self._run_records for made in record.provenance)
        return list({id(each): each for each in made}.values())

    @cached_property
    def versions(self) -> Mapping[str, tuple[str, ...]]:
        """Every version that occurs among the seeds, by distribution; Python's under "python"."""
        return provenance.versions(self._made_with)

    @property
    def commits(self) -> tuple[str, ...]:
        """Every code revision that occurs among the seeds."""
        return provenance.distinct(origin.commit for origin in self._made_with)

    @property
    def processors(self) -> tuple[str, ...]:
        """Every processor that occurs among the seeds."""
        return provenance.distinct(origin.processor for origin in self._made_with)

    @property
    def devices(self) -> tuple[str, ...]:
        """Every kind of device that occurs among the seeds."""
        return provenance.distinct(origin.device.kind for origin in self._made_with)

    @property
    def unprobed(self) -> bool:
        """Whether code of others has part in it and no probe has shown that its seeds are independent."""
        probed = {probe.result for probe in probes.of_records(self._run_records)}
        return probes.EQUAL not in probed and any(map(probes.third_party, self._made_with))

    @property
    def declared(self) -> list[str]:
        """The things that its seeds share by declaration of the plugins."""
        return sorted({line for probe in probes.of_records(self._run_records) for line in probe.declared})

    @cached_property
    def codes(self) -> tuple[str, ...]:
        """Digests of the code of its seeds; none where all is the suite's with its first bits, or unknown."""
        return codes.distinct(self._codes)

    @cached_property
    def environments(self) -> frozenset[str]:
        """Digests of every code of the environment among its seeds; none where it is the suite's."""
        return codes.environments(self._codes)

    @cached_property
    def _codes(self) -> list[CodeIdentity | None]:
        code = {id(record.code): record.code_identity for record in self._run_records}
        return list(code.values())

    @property
    def plugins(self) -> Mapping[str, frozenset[str]]:
        """Marks of the contents of plugins by path that trained its seeds, by file name."""
        return codes.contents(self.record, self.codes)

    def labeled(self, label: str) -> EntryResults:
        """Return the entry with a label of your own, for pictures and tables."""
        return replace(self, own_label=label)

    def reaching(self, epochs: int) -> EntryResults | None:
        """Return the entry with the seeds that have reached some epochs, itself where all have; None for none."""
        lengths = set(self._lengths)
        if lengths == {self.epochs}:
            return self if self.epochs >= epochs else None
        return replace(self, epochs=epochs, most=epochs) if max(lengths) >= epochs else None

    def cut(self, epochs: int) -> EntryResults | None:
        """Return the first epochs of the seeds that have reached them; None for none."""
        return replace(self, epochs=epochs, most=epochs) if self.longest >= epochs else None

    @property
    def _lengths(self) -> list[int]:
        return [
            run.epochs if self.most is None else min(run.epochs, self.most) for run in self.records.values()
        ]

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
        return replace(
            self, records={seed: self.records[seed] for seed in wanted}, most=self.epochs, asked={}
        )

    @property
    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """Metrics of the environment along the curves by name, (N, T) each; NaN where it measured none."""
        return self._along([self.records[seed].measured for seed in self.seeds])

    @property
    def training(self) -> dict[str, NDArray[np.float64]]:
        """Metrics of training along the curves by name, (N, T) each, of entries in a results folder."""
        runs = [self.records[seed].training for seed in self.seeds]
        return self._along([{name: np.asarray(own[name], np.float64) for name in own} for own in runs])

    def _along(self, runs: Sequence[Mapping[str, NDArray[np.float64]]]) -> dict[str, NDArray[np.float64]]:
        nothing = np.full(self.epochs, np.nan)
        names = sorted({name for own in runs for name in own})
        return {name: np.stack([own.get(name, nothing)[: self.epochs] for own in runs]) for name in names}

    @property
    def changed_thresholds(self) -> bool:
        """Whether the thresholds have changed since its first seed was trained."""
        first = self.first_thresholds
        return first is not None and sorted(first) != sorted(self.task_file.ranking.grid.thresholds)

    @property
    def diverged(self) -> tuple[int, ...]:
        """The seeds with agents whose numbers were not finite within the curves' epochs."""
        first = {seed: self.records[seed].diverged for seed in self.seeds}
        return tuple(seed for seed, epoch in first.items() if epoch and epoch <= self.epochs)

    @property
    def facts(self) -> dict[str, str]:
        """The first facts about an entry, in words."""
        n_runs, epochs = self.curves.shape
        return {
            "task": self.task,
            "entry": f"{self.label} ({self.name})",
            **({"made": self.made} if self.external else {}),
            "parameters": self.parameters_text(" quantum"),
            "seeds": f"{n_runs}"
            + (f", {len(self.left_out)} unfinished left out" if self.left_out else "")
            + (f"; incomplete: {self.missing_text}" if self.missing else "")
            + (f", {len(self.diverged)} diverged" if self.diverged else ""),
            **({"left out": "; ".join(self.refused)} if self.refused else {}),
            "epochs": f"{epochs} of {self.steps_per_epoch} environment steps",
            f"last {self.task_file.score.called}": f"median {np.median(self.curves[:, -1]):.3f} over seeds",
            "core-hours": hours_text(self.hours) if self.hours or not self.external else "-",
            "read from": ", ".join(map(str, self.folders)),
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
        return (f"{classical:,} + {quantum:,}{unit}" if quantum else f"{classical:,}") + self.fixed_text

    @property
    def fixed_text(self) -> str:
        """A note on numbers that stay as drawn: ` (240 fixed)`; empty if there are none."""
        return f" ({self.fixed:,} fixed)" if self.fixed else ""

    @property
    def legend(self) -> str:
        """The label, with the ansatz where the model has one and the label leaves the default out."""
        ansatz = self.identity.get("model_options", {}).get("ansatz")
        if self.own_label or ansatz is None or " ansatz=" in self.label:
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
        return max(self._lengths)

    @property
    def mixed_versions(self) -> tuple[str, ...]:
        """The distributions whose versions differ between the runs."""
        return tuple(name for name, used in self.versions.items() if len(used) > 1)

    @property
    def first_network_alone(self) -> bool:
        """Whether `parameters` leave out every network but the first, or may do so: an older version counted them.

        DDQN trains one network; REINFORCE trains one, or two with a baseline network.
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

    @cached_property
    def unusable(self) -> list[str]:
        """Settings of the algorithm that are of no use in the longest run as it was trained, however it is cut here."""
        registered = registry.load().of(specs.AlgorithmSpec)
        if self.algorithm not in registered or not any(run.finished for run in self.records.values()):
            return []
        protocol, trained = self.task_file.protocol, max(run.epochs for run in self.records.values())
        task = self.record.identity.task.get("environment_options", {})
        try:
            return registered[self.algorithm].spec.useless(
                self.options["algorithm"], task, trained, protocol.rounds, protocol.environments
            )
        except KeyError:
            return []  # an older record, without the option

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
        f"the code of environment '{first.task_file.environment.name}' was edited between '{first.label}' "
        f"and '{second.label}': their scores cannot be compared; train the entry with the earlier code again"
    )


def registered_task(name: str) -> Task | None:
    """Return a registered task, read once for all its entries; None where there is none, or it cannot be built."""
    return _registered(registry.load(), name)


@functools.lru_cache(maxsize=256)
def _registered(registered: registry.Registry, name: str) -> Task | None:
    if name not in registered.of(specs.TaskSpec):
        return None
    try:
        return load_task(name)
    except QrlSuiteError:
        return None  # its environment is not installed


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _common_length(seeds: Collection[SeedRun]) -> int:
    """Return the epochs that half of the finished seeds or more have; before any finished, the fewest of any seed."""
    lengths = sorted((run.epochs for run in seeds if run.finished), reverse=True)
    return lengths[(len(lengths) - 1) // 2] if lengths else min(run.epochs for run in seeds)


def require_scores(scores: NDArray[np.float64], task_file: TaskFile, folder: Path) -> None:
    """Refuse scores that a task cannot give."""
    if not np.isfinite(scores).all():
        raise StoreError(f"{folder}: scores must be finite")
    outside = (scores < -_TOLERANCE) | (scores > 1 + _TOLERANCE)
    if task_file.ranking.thresholds is None and outside.any():
        raise StoreError(f"{folder}: a score is {scores[outside][0]:g}, outside [0, 1]")


_TOLERANCE = 1e-6  # a mean of scores in [0, 1] may leave it by rounding


def _tuned_text(tuning: Mapping[str, Any]) -> str:
    """Return the known parts of the tuning budget: `tuned (24 trials, 32 seeds, regret 5%)`."""
    known = [counted(int(tuning["trials"]), "trial")] if tuning.get("trials") is not None else []
    if isinstance(tuning.get("seeds"), str):
        with contextlib.suppress(OptionError):  # text of another suite, which a record may hold
            known.append(counted(len(parse_seeds(tuning["seeds"])), "seed"))
    if tuning.get("regret") is not None:
        known.append(f"regret {tuning['regret']['expected']:.0%}")
    if tuning.get("last") is not None:
        known.append(f"{tuning['last']['expected']:.0%} among the last {len(tuning['last']['values'])}")
    changed = [name.partition(".")[2] for name in tuning.get("changed") or ()]
    text = f"tuned ({', '.join(known)})" if known else "tuned"
    return f"{text} but {', '.join(changed)}" if changed else text
