"""Decision plans: which of several entries needs fewer steps, with as many seeds as it takes.

A plan is a TOML file that fixes, before the first seed is trained, who is compared, at which numbers of seeds the
results are looked at, and at which error (`qrlsuite.statistics.sequential`). Its results lie in a folder of their own:

    <runs>/decisions/<name>/plan.toml           the plan as it was when its first seed began
                            looks.jsonl         when the first seed was begun and each look taken, and what it found
                            <task>/<entry>/...  as in any results folder; each seed's record has the plan's hash

What is decided follows from the plan and the curves alone. The log is not read to decide anything: it says when each
look was taken, and reveals curves that were changed after it. Leaderboards do not read this folder: seeds whose number
depends on what they showed have no p-value of a fixed number of seeds.
"""

from __future__ import annotations

import datetime
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
import tomli_w
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

from qrlsuite import notation, options, specs
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError, TaskError
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.preset import TUNING_SEEDS, EntryTuning
from qrlsuite.experiment.task import digest
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, append, json_line, read_lines, write_atomically
from qrlsuite.statistics import DecisionPlan, Grid, LearningCurves, decide
from qrlsuite.statistics.sequential import Decision
from qrlsuite.studies.study import setting
from qrlsuite.tuning.search import FOLDER as TUNING

FOLDER = "decisions"
"""Plans' results lie in folders of their own below the results folder, so that leaderboards do not rank them."""

FIRST_SEED = 10_000
"""Where blocks of seeds begin unless told otherwise: no protocol asks for as many."""


class _PlanTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PlannedEntry(_PlanTable):
    """An entry of a plan; the keys mean what they mean in a study's entries."""

    model: Annotated[str, Field(min_length=1)]
    algorithm: Annotated[str, Field(min_length=1)]
    preset: str | None = None
    options: Annotated[
        dict[str, Any], Field(description='options as in --set: qubits, "environment.degree", "algorithm.lr"')
    ] = {}
    hash: Annotated[str, Field(description="of the entry that these options make: it cannot become another")]
    name: Annotated[
        str | None,
        Field(pattern=r"^[\w(][\w ,.:=+/()-]*$", max_length=60, description="what verdicts call it"),
    ] = None
    tuning: Annotated[
        EntryTuning | None, Field(description="how its options were found, where a preset file gave them")
    ] = None


class Question(_PlanTable):
    """What a plan asks, and the pairs of entries whose verdicts answer it."""

    text: Annotated[str, Field(min_length=1, max_length=200)]
    pairs: Annotated[list[tuple[str, str]], Field(min_length=1)]


class PlanFile(_PlanTable):
    """A whole plan file."""

    format_version: Literal[1]
    name: Annotated[str, Field(pattern=specs.WHOLE_NAME, max_length=64, description="of the results' folder")]
    written: AwareDatetime
    task: Annotated[str, Field(min_length=1)]
    epochs: Annotated[
        int, Field(ge=1, description="of every seed: the horizon at which entries are compared")
    ]
    rule: Literal["times", "times-skewed"]
    epsilons: Annotated[
        list[float] | None,
        Field(min_length=1, description="thresholds 1 - epsilon on a score with maximum 1"),
    ] = None
    thresholds: Annotated[list[float] | None, Field(min_length=1, description="thresholds on the return")] = (
        None
    )
    alpha: float
    spending: str
    looks: Annotated[list[int], Field(min_length=1, description="seeds of each entry at each look")]
    margin: Annotated[float, Field(description="a smaller difference counts as none: 0.1 is 10 percent")]
    first_seed: Annotated[int, Field(ge=0, description="where the plan's own block of seeds begins")]
    reason: Annotated[str, Field(description="why the first look comes before 20 seeds")] = ""
    questions: Annotated[
        list[Question], Field(description="which pairs are compared; every pair of entries without them")
    ] = []
    entries: list[PlannedEntry]

    @pydantic.model_validator(mode="after")
    def _one_grid(self) -> PlanFile:
        if (self.epsilons is None) == (self.thresholds is None):
            raise ValueError("give either epsilons (score with maximum 1) or thresholds (no known maximum)")
        return self

    @property
    def hash(self) -> str:
        """Sixteen hexadecimal digits over everything that the file says."""
        content = self.model_dump(mode="json")
        if not self.questions:  # no key of version 0.1.0, whose plans keep their hash
            del content["questions"]
        for entry in content["entries"]:
            for key in ("name", "tuning"):
                if entry[key] is None:
                    del entry[key]
        return digest(content)

    @property
    def block(self) -> range:
        """The seeds that the plan may train, of every entry."""
        return range(self.first_seed, self.first_seed + self.looks[-1])


def parse(text: str, source: str) -> PlanFile:
    """Parse a plan file; entries and numbers are checked by `StudyWithLooks`.

    Raises
    ------
    TaskError
        Listing every problem with its path in the file.
    """
    try:
        return PlanFile.model_validate(options.read_toml(text))
    except tomllib.TOMLDecodeError as error:
        raise TaskError(f"{source}: not valid TOML: {error}") from None
    except pydantic.ValidationError as error:
        raise TaskError(f"{source}: " + "; ".join(options.file_problems(error, PlanFile))) from None


def load(path: Path) -> PlanFile:
    """Read a plan file.

    Raises
    ------
    TaskError
        If it cannot be read or is malformed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TaskError(f"plan {path} cannot be read: {error}") from None
    return parse(text, path.name)


def dumps(file: PlanFile) -> str:
    """Return a plan file's text."""
    content = file.model_dump(exclude_none=True)
    for key in ("reason", "questions"):
        if not content[key]:
            del content[key]
    head = "# Fixed when its first seed is trained: see `qrlsuite decide --help`.\n"
    return head + tomli_w.dumps(content)


def write(
    name: str,
    task: str,
    names: Sequence[str],
    runs: Path,
    *,
    algorithm: str | None = None,
    preset: str | None = None,
    epochs: int | None = None,
    looks: Sequence[int] = (20, 40, 60, 80, 100),
    alpha: float = 0.05,
    spending: str = "pocock",
    margin: float = 0.10,
    first_seed: int | None = None,
    reason: str = "",
) -> StudyWithLooks:
    """Return a new plan, dated now; writes nothing.

    Parameters
    ----------
    names:
        For each entry its model and settings, or its label: `mlp width=64`, `ddqn mlp width=64`. A setting
        `preset=FILE.toml` gives those of a preset file, with the record of how they were found.
    epochs:
        Of every seed; None for the task's protocol.
    first_seed:
        None for the first block from 10,000 of which no seed was trained below `runs`.

    Raises
    ------
    QrlSuiteError
        If there are fewer than two entries, they would end at different horizons, or a name, an option or a number
        cannot be used.
    """
    drafts = [_read_entry(text, algorithm, preset) for text in names]
    entries = [draft.resolve(task) for draft in drafts]
    if len(entries) < 2:
        raise OptionError(f"{len(entries)} of two or more entries: write each as 'MODEL NAME=VALUE ...'")
    lengths = {entry.label: epochs or entry.task.epochs(entry.algorithm.name) for entry in entries}
    if len(set(lengths.values())) > 1:
        steps = entries[0].task.file.protocol.interactions
        ends = ", ".join(f"'{label}' at {count * steps} steps" for label, count in lengths.items())
        raise OptionError(f"the entries end at different horizons: {ends}; give --epochs for all of them")
    ranking = entries[0].task.file.ranking
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    try:
        file = PlanFile(
            format_version=1,
            name=name,
            written=now,
            task=task,
            epochs=next(iter(lengths.values())),
            rule="times",
            epsilons=ranking.epsilons,
            thresholds=ranking.thresholds,
            alpha=alpha,
            spending=spending,
            looks=list(looks),
            margin=margin,
            first_seed=FIRST_SEED if first_seed is None else first_seed,
            reason=reason,
            entries=[draft.planned(task, entry) for draft, entry in zip(drafts, entries)],
        )
    except pydantic.ValidationError as error:
        raise OptionError("; ".join(options.file_problems(error, PlanFile))) from None
    study = StudyWithLooks(file, "the plan", runs)
    while first_seed is None and study.trained_before():
        moved = file.model_copy(update={"first_seed": _next_block(study.file)})
        study = StudyWithLooks(moved, "the plan", runs)
    return study


@dataclass(frozen=True)
class _WrittenEntry:
    """An entry of a new plan as it was written."""

    algorithm: str | None
    model: str
    preset: str | None
    options: dict[str, Any]

    def resolve(self, task: str, preset: bool = True) -> Entry:
        """Build the entry, or the one that these options make without the preset."""
        settings = [setting("", word, value) for word, value in self.options.items()]
        return resolve(task, self.model, self.algorithm, settings, self.preset if preset else None)

    def planned(self, task: str, entry: Entry) -> PlannedEntry:
        """Return what the plan says of the entry: a preset file's values and record, so that it can change later."""
        named, values = self.preset, self.options
        if named is not None and named.endswith(".toml"):
            usual = replace(self, algorithm=entry.algorithm.name).resolve(task, preset=False)
            named, values = None, {**values, **_difference(entry, usual)}
        return PlannedEntry(
            model=entry.model.name,
            algorithm=entry.algorithm.name,
            preset=named,
            options=values,
            hash=entry.hash,
            tuning=None if entry.tuning is None or named is not None else EntryTuning(**entry.tuning),
        )


def _difference(entry: Entry, other: Entry) -> dict[str, Any]:
    """Return the options in which an entry differs from another of the same model and algorithm, by full name."""
    sides = {
        "algorithm": (entry.algorithm_options, other.algorithm_options),
        "model": (entry.model_options, other.model_options),
    }
    return {
        f"{side}.{name}": value
        for side, (own, others) in sides.items()
        for name, value in options.plain(own).items()
        if value != options.plain(others)[name]
    }


def _read_entry(text: str, algorithm: str | None, preset: str | None) -> _WrittenEntry:
    """Read an entry's notation; what the text leaves open is as given beside it."""
    written = notation.parse_entry(text)
    values = {each.full_name: each.value for each in written.settings}
    return _WrittenEntry(
        written.algorithm or algorithm, written.model, written.preset or preset or None, values
    )


def _next_block(file: PlanFile) -> int:
    return file.first_seed + max(1000, len(file.block))


class StudyWithLooks:
    """A decision plan with its results folder.

    Parameters
    ----------
    file:
        The plan.
    source:
        Where it came from, for messages.
    runs:
        The results folder.

    Attributes
    ----------
    entries:
        The entries by the name that verdicts use, in the plan's order.
    plan:
        What is tested when.
    questions:
        For each of the plan's pairs the question that it answers; empty where the plan asks none.
    folder:
        Where its results are, or will be.

    Raises
    ------
    QrlSuiteError
        If a name, an option or a number of the plan cannot be used, or an entry is no longer the one that was planned.
    """

    def __init__(self, file: PlanFile, source: str, runs: Path) -> None:
        self.file, self.source, self.runs = file, source, runs
        self.folder = runs / FOLDER / file.name
        planned: list[Entry] = []
        for index, each in enumerate(file.entries):
            settings = [setting("options", word, value) for word, value in each.options.items()]
            try:
                entry = resolve(file.task, each.model, each.algorithm, settings, each.preset)
            except QrlSuiteError as error:
                raise type(error)(f"{source}: entries.{index}: {error}") from None
            if entry.hash != each.hash:
                raise OptionError(
                    f"{source}: entries.{index}.hash is '{each.hash}', these options make '{entry.hash}' here: it is "
                    "another entry than was planned; write a new plan with `qrlsuite decide new`"
                )
            for before, other in enumerate(planned):
                if other.hash == entry.hash:
                    raise OptionError(
                        f"{source}: entries.{before} and entries.{index} are the same, '{entry.label}': leave one out"
                    )
            tuning = entry.tuning if each.tuning is None else each.tuning.plain()
            planned.append(replace(entry, plan=file.hash, tuning=tuning))
        names = tuple(each.name or name for each, name in zip(file.entries, _names(planned)))
        self.entries = dict(zip(names, planned))
        self.questions = [asked.text for asked in file.questions for _ in asked.pairs]
        pairs = tuple(pair for asked in file.questions for pair in asked.pairs)
        grid = Grid.relative if file.epsilons is not None else Grid.absolute
        try:
            self.plan = DecisionPlan(
                names,
                tuple(file.looks),
                file.alpha,
                file.spending,  # type: ignore[arg-type]  # checked there
                file.margin,
                pairs=pairs or None,
                reason=file.reason,
                rule=file.rule,
            )
            self.grid = grid(file.epsilons or file.thresholds or [], [0.5])  # rule `times` needs no delta
        except OptionError as error:
            raise OptionError(f"{source}: {error}") from None
        self._check_block()

    def _check_block(self) -> None:
        """Refuse seeds that belong to others."""
        block = self.file.block
        protocol = max(entry.task.file.protocol.seeds for entry in self.entries.values())
        if block.start < protocol:
            raise OptionError(
                f"{self.source}: first_seed = {block.start}: seeds 0:{protocol} are the protocol's, which may have "
                f"been looked at; begin at {protocol} or later"
            )
        if block.stop > TUNING_SEEDS:
            raise OptionError(
                f"{self.source}: first_seed = {block.start}: seeds from {TUNING_SEEDS} up are those of tuning; the "
                f"block has to end below"
            )

    @property
    def begun(self) -> bool:
        """Whether a seed of the plan was begun: from then on it is fixed."""
        return any(self.folder.glob("*/*/seed-*"))

    def check(self) -> None:
        """Refuse a plan that was changed after it began, and seeds that were trained outside of it.

        Raises
        ------
        OptionError
            If the plan was changed, or seeds of its block were trained before it began.
        StoreError
            If its folder holds seeds that the plan did not train.
        """
        if not self.begun:
            for name, seeds, path in self.trained_before():
                raise OptionError(
                    f"{self.source}: seeds {format_seeds(seeds)} of '{name}' were trained already ({path}): a plan "
                    f"needs seeds that nobody has seen; with first_seed = {_next_block(self.file)} it has others"
                )
            return
        kept = load(self.folder / "plan.toml")
        if kept.hash != self.file.hash:
            before, after = kept.model_dump(mode="json"), self.file.model_dump(mode="json")
            keys = [key for key in before if before[key] != after[key]]
            changes = [f"{key} (was {_short(before[key])}, is {_short(after[key])})" for key in keys]
            raise OptionError(
                f"{self.source}: {', '.join(changes)} changed after the plan began. End this plan and write "
                f"a new one with other seeds (the plan as it began: {self.folder / 'plan.toml'})"
            )
        for name, entry in self.entries.items():
            for seed, record in self._records(entry):
                if record.get("plan") != self.file.hash:
                    raise StoreError(
                        f"{EntryStore.find(self.folder, entry).seed(seed).path}: seed {seed} of '{name}' was not "
                        f"trained by plan {self.file.hash}; delete that folder, and the plan trains it"
                    )

    def trained_before(self) -> list[tuple[str, list[int], Path]]:
        """Return seeds of the block that were trained elsewhere below the results folder: entry, seeds, folder."""
        others = [self.runs, self.runs / TUNING]
        plans = self.runs / FOLDER
        if plans.is_dir():
            others += sorted(path for path in plans.iterdir() if path.is_dir() and path != self.folder)
        trained = []
        for name, entry in self.entries.items():
            for other in others:
                path = other / entry.task.name / entry.name
                if path.is_dir():
                    seeds = [seed for seed in EntryStore(path).seeds() if seed in self.file.block]
                    trained += [(name, seeds, path)] if seeds else []
        return trained

    def begin(self) -> None:
        """Keep the plan as it is now, before its first seed.

        Raises
        ------
        QrlSuiteError
            As `check`; or if the plan was ended, or the folder cannot be written.
        """
        self.check()
        if (when := self.ended) is not None:
            raise OptionError(
                f"{self.source}: the plan was ended on {when}; a new one needs a name of its own"
            )
        if not self.begun:
            write_atomically(self.folder / "plan.toml", dumps(self.file).encode())
            if self.begun_at is None:
                append(self._log, json_line({"begun": _now(), "plan": self.file.hash}))

    def end(self) -> None:
        """Close the plan for good, with its open pairs open.

        Raises
        ------
        QrlSuiteError
            As `check`; or if it has not begun, was ended before, or has nothing open.
        """
        self.check()
        if not self.begun:
            raise OptionError(f"{self.source}: the plan has not begun, so there is nothing to end")
        if (when := self.ended) is not None:
            raise OptionError(f"{self.source}: the plan was ended on {when} already")
        if self.decision().finished:
            raise OptionError(f"{self.source}: every pair is closed, so there is nothing to end")
        append(self._log, json_line({"ended": _now()}))

    @property
    def _log(self) -> Path:
        return self.folder / "looks.jsonl"

    @property
    def begun_at(self) -> str | None:
        """When its first seed was begun, by the log; None if it was not, or by a version that did not note it."""
        lines = (line for line in read_lines(self._log) if "begun" in line)
        return next((str(line["begun"]) for line in lines if line["plan"] == self.file.hash), None)

    @property
    def ended(self) -> str | None:
        """When the plan was ended before all was decided; None if it was not."""
        return next((str(line["ended"]) for line in read_lines(self._log) if "ended" in line), None)

    @property
    def taken(self) -> dict[int, str]:
        """When each look was taken, by its number of seeds."""
        times: dict[int, str] = {}
        for line in read_lines(self._log):
            if "look" in line:
                times.setdefault(line["look"], str(line["time"]))
        return times

    def _records(self, entry: Entry) -> Iterator[tuple[int, Mapping[str, Any]]]:
        store = EntryStore.find(self.folder, entry)
        for seed in store.seeds() if store.path.is_dir() else []:
            record = store.seed(seed).record() if seed in self.file.block else None
            if record is not None:
                yield seed, record

    def seeds(self, name: str) -> list[int]:
        """Return the seeds of an entry that have finished, from the block's first on without a gap."""
        entry = self.entries[name]
        block = self.file.block
        done = EntryStore.find(self.folder, entry).finished(block, self.file.epochs)
        gap = next((seed for seed in block if seed not in done), block.stop)
        return list(range(block.start, gap))

    def hours(self, name: str) -> float:
        """Return the core-hours that an entry's seeds have taken so far, unfinished ones too."""
        store = EntryStore.find(self.folder, self.entries[name])
        if not store.path.is_dir():
            return 0.0
        return sum(store.seed(seed).seconds() for seed in store.seeds()) / 3600

    def curves(self) -> dict[str, LearningCurves]:
        """Return the learning curves of the finished seeds; entries without any are absent."""
        curves = {}
        for name, entry in self.entries.items():
            store = EntryStore.find(self.folder, entry)
            values = [store.seed(seed).read().curve[: self.file.epochs] for seed in self.seeds(name)]
            if values:
                steps = entry.task.file.protocol.interactions
                curves[name] = LearningCurves(np.stack(values), steps, name)
        return curves

    def decision(self) -> Decision:
        """Return what is decided by the plan and the curves so far; writes nothing.

        Raises
        ------
        QrlSuiteError
            As `check`; or if a look finds something else than it did when it was taken.
        """
        self.check()
        result = decide(self.plan, self.curves(), self.grid)
        for line in _lines(self.plan, result):
            for before in read_lines(self._log):
                if before.get("look") != line["look"]:
                    continue
                for now, then in zip(line["pairs"], before.get("pairs", [])):
                    if now["decided"] != then.get("decided"):
                        raise StoreError(
                            f"{self._log}: the look at {line['look']} seeds found '{then.get('decided')}' for "
                            f"{' and '.join(now['pair'])}, and the curves there now give '{now['decided']}': results "
                            "were changed since; restore them"
                        )
        return result

    def look(self) -> Decision:
        """Take every look for which the seeds are there, and note when; returns what is decided.

        Raises
        ------
        QrlSuiteError
            As `decision`, or if the log cannot be written.
        """
        result = self.decision()
        taken = self.taken
        for line in _lines(self.plan, result):
            if line["look"] not in taken:
                append(self._log, json_line({"time": _now(), "plan": self.file.hash, **line}))
        return result

    def wanted(self, decision: Decision) -> dict[str, list[int]]:
        """Return the seeds that each open entry needs for the next look, those that are there included."""
        first = self.file.first_seed
        return {name: list(range(first, first + count)) for name, count in decision.wanted.items()}

    def missing(self, decision: Decision) -> dict[str, int]:
        """Return how many seeds each open entry lacks for the next look; none where it has them."""
        return {
            name: count - have
            for name, count in decision.wanted.items()
            if (have := len(self.seeds(name))) < count
        }


def _lines(plan: DecisionPlan, decision: Decision) -> list[dict[str, Any]]:
    """Return what each look found: for every pair that was open, its p and how it was closed."""
    lines = []
    for index, look in enumerate(plan.looks):
        pairs = [
            {
                "pair": [pair.first, pair.second],
                "p": pair.p[index],
                "decided": None if pair.decided is None or index < len(pair.p) - 1 else str(pair.decided),
            }
            for pair in decision.pairs
            if index < len(pair.p)
        ]
        if pairs:
            lines.append({"look": look, "pairs": pairs})
    return lines


def _names(entries: Sequence[Entry]) -> list[str]:
    """Return what verdicts call the entries: the shortest of label without algorithm, label and name that is unique."""
    short = [entry.label.partition(" ")[2] for entry in entries]
    labels = [entry.label for entry in entries]
    result = []
    for index, entry in enumerate(entries):
        chosen = (names[index] for names in (short, labels) if Counter(names)[names[index]] == 1)
        result.append(next(chosen, entry.name))
    return result


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
