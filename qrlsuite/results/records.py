"""Records as types: who writes one builds it, who reads one gets it, and one that is damaged is refused here.

    entry.json     EntryRecord: the entry; of a published entry with `published`
    run.json       RunRecord: one seed's run
    epochs.jsonl   EpochLine: one epoch of a seed; epochs.parquet has the same in columns
    timings.jsonl  TimingLine: how long that epoch took
    requests.jsonl RequestLine: seeds that were asked for
    looks.jsonl    LookLine: an event of a study with looks
    evaluations/*.jsonl  RoundLine: the episodes of an evaluation that were played at once

A record has the known keys of its file as attributes. `content` is all of it, in the order of the file, with keys of
later versions: that is written again. A key that may be absent has a default, with which older records are read.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import pydantic
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    model_validator,
)
from pydantic.functional_validators import ModelWrapValidatorHandler

from qrlsuite import files, notation, options, registry, specs
from qrlsuite.errors import StoreError
from qrlsuite.experiment import script as scripts
from qrlsuite.experiment.entry import START_FORM, Entry, of_script
from qrlsuite.experiment.identity import CodeIdentity
from qrlsuite.experiment.preset import EntryTuning
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.experiment.task import Task, TaskFile, digest

FORMAT_VERSION = 1
MEASURED = "measured"
"""Before the name of a metric of the environment in an epoch's record: `measured.violations`."""


def _one_line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("not one line of text")
    return text


def _sorted_once(names: list[Any]) -> list[Any]:
    if names != sorted(set(names)):
        raise ValueError("not sorted, each once")
    return names


Line = Annotated[str, AfterValidator(_one_line)]
Reason = Annotated[Line, Field(min_length=1, max_length=300)]
Count = Annotated[int, Field(ge=0, lt=10**12)]
Positive = Annotated[int, Field(ge=1, lt=10**9)]
Name = Annotated[str, Field(pattern=specs.WHOLE_NAME)]
Word = Annotated[str, Field(pattern=r"^[A-Za-z_]\w{0,63}$")]
Number = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, lt=1e12)]


class Record(pydantic.BaseModel):
    """A JSON object of a file; messages name its kind (`what`) and the remedy for a damaged one (`cure`)."""

    model_config = pydantic.ConfigDict(frozen=True, populate_by_name=True, strict=True)
    what: ClassVar[str] = "a record"
    cure: ClassVar[str] = "restore the file"
    _content: dict[str, Any] = PrivateAttr(default_factory=dict)

    @model_validator(mode="wrap")
    @classmethod
    def _keep(cls, content: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        record = validate(content)
        if record is not content:
            record._content = {name: _plain(value) for name, value in content.items()}
        return record

    @classmethod
    def read(cls, content: Any, source: Path | str) -> Self:
        """Read the content of a file; what does not fit is refused with its key."""
        try:
            return cls.model_validate(content)
        except pydantic.ValidationError as error:
            problems = "; ".join(files.problems(error, cls))
        except RecursionError:
            problems = "too many nested tables"
        text = " ".join(problems.split())[:300]
        raise StoreError(f"{source} is not {cls.what}: {text}; {cls.cure}")

    @property
    def content(self) -> dict[str, Any]:
        """The whole object, as plain values in the order of the file; not to be changed."""
        return self._content

    def changed(self, **values: Any) -> Self:
        """Return the record with other values of some keys."""
        return type(self).model_validate({**self._content, **values})


def _plain(value: Any) -> Any:
    if isinstance(value, Record):
        return value.content
    return [_plain(each) for each in value] if isinstance(value, list) else value


class CodePart(Record):
    """One part of a code identity, see `qrlsuite.experiment.identity`."""

    model_config = pydantic.ConfigDict(extra="forbid")

    role: str
    name: str
    distribution: str | None = None
    numerics: int | None = None
    circuit: str | None = None
    sha256: str | None = None
    files: dict[str, str] = {}


class CodeRecord(Record):
    """The code that computes an entry's numbers."""

    digest: str
    parts: list[CodePart]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.identity.digest != self.digest:
            raise ValueError("its parts do not have its digest")
        return self

    @property
    def identity(self) -> CodeIdentity:
        """The code identity."""
        return CodeIdentity(tuple(part.content for part in self.parts))


class CodedRecord(Record):
    """A record that names the code of its seeds; None where that was not recorded."""

    code: CodeRecord | None = None

    @property
    def code_identity(self) -> CodeIdentity | None:
        """The identity of the code, where it was recorded."""
        return None if self.code is None else self.code.identity


class SameCodeRecord(Record):
    """A declaration that codes, named by their digests, do the same."""

    codes: list[str]
    reason: str = ""
    time: str = ""


class EntryIdentity(Record):
    """The content of an entry's hash: the task's definition, algorithm, model, their options, and `Entry.start`."""

    task: dict[str, Any]
    algorithm: str
    algorithm_options: dict[str, Any]
    model: str
    model_options: dict[str, Any]
    start: Annotated[str | None, Field(alias=notation.START, pattern=f"^(?:{START_FORM.pattern})$")] = None


class DeviceRecord(Record):
    """The device that models were trained on."""

    kind: str = "cpu"
    name: str | None = None


class Provenance(Record):
    """Versions and machine that trained a seed, see `qrlsuite.results.provenance`; never part of an identity.

    `instructions` are the variables that fixed instruction sets. `before` has the other records of a published seed's
    earlier epochs. Records of Dask workers that saw no results folder have a `host`.
    """

    versions: dict[str, str] = {}
    python: str | None = None
    system: str | None = None
    processor: str | None = None
    device: DeviceRecord = DeviceRecord()
    cores: int | None = None
    threads: int | None = None
    instructions: dict[str, str] = {}
    commit: str | None = None
    numerics: dict[str, int] = {}
    before: list[Provenance] = []
    host: str | None = None

    @property
    def without_host(self) -> Provenance:
        """The record without the name of a machine."""
        return type(self).model_validate(
            {name: part for name, part in self.content.items() if name != "host"}
        )

    @property
    def with_earlier(self) -> list[Provenance]:
        """The record of a published seed's last epochs, and records of earlier epochs that were made otherwise."""
        return [self, *self.before]


class ImportedRecord(Record):
    """From what curves of another program were made, and the scale of the first of them in the files' units."""

    grid: str = ""
    maximum: Number | None = None
    metric: str = ""
    largest: Number | None = None
    last_step: Count | None = None


def _told(imported: Any) -> Any:
    """Accept the records of 0.1, which only say that the entry was imported."""
    return {} if imported is True else imported


class ProbeRecord(Record):
    """The result of a probe of independent seeds (`qrlsuite.engine.probe`).

    `seed` was trained alone for some `epochs`, on a kind of `device`, by a `code` with this digest. `difference` names
    the first value that differed, `reason` why nothing was probed. `seconds` are by the clock, `cpu` of processor time.
    `declared` is what all seeds have in common by declaration of the plugins.
    """

    result: Literal["equal", "differs", "not probed"]
    seed: int | None = None
    device: str | None = None
    code: str | None = None
    epochs: int | None = None
    difference: str | None = None
    reason: str | None = None
    declared: list[Line] = []
    seconds: float | None = None
    cpu: float | None = None


class AgentsRecord(Record):
    """The agents of a published entry: whose they are, the SHA-256 of their file, and their provenance."""

    sha256: str
    seeds: Annotated[list[Count], Field(min_length=1), AfterValidator(_sorted_once)]
    provenance: list[Provenance] = []


class RequestLine(Record):
    """Seeds that were asked for, to so many epochs by a code; or, with a reason, that no longer are (`withdrawn`)."""

    what: ClassVar[str] = "a request for seeds"

    seeds: Annotated[list[Count], Field(min_length=1), AfterValidator(_sorted_once)]
    epochs: Count = 0
    code: str = ""
    withdrawn: Reason | None = None
    time: str = ""


def _counted(parameters: dict[str, int]) -> dict[str, int]:
    if missing := {"classical", "quantum"} - parameters.keys():
        raise ValueError(f"{' and '.join(sorted(missing))} missing")
    return parameters


def _independent(probe: ProbeRecord) -> ProbeRecord:
    if probe.result == "differs":
        raise ValueError("not the result of a probe that found seeds independent")
    return probe


class PublishedRecord(Record):
    """The facts of a published entry: numbers of `seeds` and `epochs`, `parameters` as `parameters_of` returns them.

    Each seed names one of the different provenances. `diverged` has by seed the first epoch after which its agent's
    numbers were not finite. `measured` are metrics of the environment. `withdrawn` says why seeds are not asked for.
    """

    seeds: Positive
    epochs: Positive
    parameters: Annotated[dict[str, Count], AfterValidator(_counted)]
    core_hours: float | None = None
    circuit_executions: Count | None = None
    provenance: Annotated[list[Provenance], Field(min_length=1)]
    diverged: dict[str, Positive] = {}
    probe: Annotated[ProbeRecord, AfterValidator(_independent)] | None = None
    agents: AgentsRecord | None = None
    measured: Annotated[list[Name], Field(max_length=100), AfterValidator(_sorted_once)] = []
    withdrawn: dict[Annotated[str, Field(pattern=r"^\d{1,12}$")], Reason] = {}


PLUGINS = "plugins"
"""The folder, in an entry's, of copies of plugins by path: each in a folder named by its content."""

_COPY = re.compile(rf"{PLUGINS}/[0-9a-f]{{16}}/[A-Za-z_][A-Za-z0-9_]*(\.py)?")


def _place_of_copy(place: str) -> str:
    if not _COPY.fullmatch(place):
        raise ValueError("no copy of a plugin")
    return place


class EntryRecord(CodedRecord):
    """An entry: enough to build it again anywhere.

    `task_file` is the task as of the first run. `same` are its author's declarations about its codes. `plugins` has the
    places of copied plugins by path, by the digest of their code.
    """

    what: ClassVar[str] = "an entry's record"

    name: Line
    hash: str
    label: Line
    preset: str | None = None
    tuning: EntryTuning | None = None
    plan: str | None = None
    imported: Annotated[ImportedRecord | None, BeforeValidator(_told)] = None
    task_name: Line
    task_hash: str
    task_file: TaskFile
    identity: EntryIdentity
    same: list[SameCodeRecord] = []
    plugins: dict[str, list[Annotated[str, AfterValidator(_place_of_copy)]]] = {}
    published: PublishedRecord | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Refuse hashes and a name that do not follow from the entry."""
        identity = self.identity
        if digest(identity.task) != self.task_hash:
            raise ValueError("the task's definition does not have its hash")
        if digest(identity.content) != self.hash:
            raise ValueError("the options do not have the entry's hash")
        expected = f"{identity.algorithm}-{identity.model}-{self.hash[:8]}"
        if self.name != expected:
            raise ValueError(f"it is named {self.name!r}, and should be {expected!r}")
        return self

    @classmethod
    def of(cls, entry: Entry) -> EntryRecord:
        """Return the record of an entry."""
        tuned = {} if entry.tuning is None else {"tuning": entry.tuning}
        made = {} if entry.script is None else {"imported": {"kind": entry.script.scores}}
        planned = {} if entry.study is None else {"plan": entry.study}
        file = entry.task.file.model_dump(mode="json", exclude={"tuning"})
        if entry.task.name in registry.load().of(specs.TaskSpec):
            file["ranking"].pop("policies", None)  # boards read the registered file; 0.1.1 knows no such key
        return cls.model_validate(
            {
                "name": entry.name,
                "hash": entry.hash,
                "label": entry.label,
                "preset": entry.preset,
                **tuned,
                **planned,
                **made,
                "task_name": entry.task.name,
                "task_hash": entry.task.hash,
                "task_file": file,
                "identity": entry.identity,
            }
        )

    @property
    def tuned(self) -> dict[str, Any] | None:
        """The record of tuning as plain values; seeds that entries are judged by are marked in it."""
        return None if self.tuning is None else self.tuning.model_dump(mode="json", exclude_unset=True)

    @property
    def maximum(self) -> float | None:
        """The best possible score, where curves of another program were divided by it."""
        return None if self.imported is None else self.imported.maximum

    @property
    def same_codes(self) -> list[list[str]]:
        """The digests that were declared to be the same, one list for each declaration."""
        return [declared.codes for declared in self.same]

    def entry(self, source: str) -> Entry:
        """Build the entry; `source` is where the record came from, for messages. A script's is never started."""
        task = Task(self.task_file, source)
        if self.identity.algorithm == SCRIPT:
            name = self.identity.model
            entry = of_script(task, name, scripts.build(name, self.identity.algorithm_options))
        else:
            entry = self._built(task, source)
        if entry.hash != self.hash:
            raise StoreError(
                f"{source} was made by a version of the suite or a plugin in which its options meant something else "
                f"(hash {self.hash}, now {entry.hash}): keep it for reading, and choose another folder with --runs"
            )
        return replace(entry, tuning=self.tuned, study=self.plan)

    def _built(self, task: Task, source: str) -> Entry:
        task.name = self.task_name
        algorithm = registry.get(specs.AlgorithmSpec, self.identity.algorithm)
        model = registry.get(specs.ModelSpec, self.identity.model)
        sides = (algorithm, self.identity.algorithm_options), (model, self.identity.model_options)
        algorithm_options, model_options = (
            options.build(specs.resolve(spec.options), dict(values), source) for spec, values in sides
        )
        return Entry(
            task=task,
            algorithm=algorithm,
            model=model,
            algorithm_options=algorithm_options,
            model_options=model_options,
            preset=self.preset,
            start=self.identity.start,
        )


class RunRecord(CodedRecord):
    """One seed's run: its entry, progress and provenance.

    `plan` is the hash of the study with looks that trains it. `epochs` counts all epochs of a finished run; of a
    running one, the epochs that it went on from. `diverged` is the first epoch after which numbers of the agent were
    not finite. `agent` is False if it was imported without its agent.
    """

    what: ClassVar[str] = "a run's record"
    cure: ClassVar[str] = "restore the file or delete the seed's folder"

    plan: str | None = None
    task: str
    task_hash: str
    entry: str
    label: str = ""
    algorithm: str = ""
    algorithm_options: dict[str, Any] = {}
    model: str = ""
    family: str = ""
    model_options: dict[str, Any] = {}
    parameters: dict[str, Count] = {}
    seed: Count
    interactions_per_epoch: int | None = None
    probe: ProbeRecord | None = None
    status: Literal["running", "finished"]
    epochs: Count
    diverged: Positive | None = None
    imported: dict[str, Any] = {}
    agent: bool = True
    provenance: list[Provenance] = []

    @property
    def finished(self) -> bool:
        """Whether it reached the epochs that were asked for."""
        return self.status == "finished"

    @property
    def begun(self) -> dict[str, Any]:
        """Facts that stay when the run goes on: the code that began it, and the result of a probe."""
        return {name: self.content[name] for name in ("code", "probe") if name in self.content}

    def told(self, folder: Path, **more: Any) -> dict[str, Any]:
        """Return the record for trackers: all but the version, and the seed's folder."""
        content = {name: value for name, value in self.content.items() if name != "format_version"}
        return {**content, "folder": str(folder), **more}


class EpochLine(Record):
    """One epoch of a seed. Further keys are metrics of training, and `measured.NAME` of the environment.

    `scores` belong to the validation's episodes, or `score` their mean if nothing more was imported. `executions` of
    circuits are counted by name. `diverged`: numbers of the agent were not finite after it. Tables have `measured`.
    """

    model_config = pydantic.ConfigDict(extra="allow")
    what: ClassVar[str] = "an epoch's record"
    cure: ClassVar[str] = "restore the file or delete the seed's folder"

    epoch: Positive
    scores: Annotated[list[Number], Field(min_length=1)] | None = None
    score: Number | None = None
    executions: dict[Word, Annotated[int, Field(ge=0, lt=2**63)] | None] | None = None
    diverged: bool | None = None
    measured: dict[Name, Number | None] = {}

    __pydantic_extra__: dict[str, Number | None]

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in self.model_extra or {}:
            outer, dot, inner = name.partition(".")
            if outer == MEASURED and dot and not specs.NAME.fullmatch(inner):
                raise ValueError(f"{name!r} is not the name of a metric")
        return self


class TimingLine(Record):
    """A seed's share of the time that an epoch of its group of `group` seeds took, and where and when.

    `train` and `validate` are seconds by the clock; `cpu` core-seconds of both, None if not recorded (on a GPU).
    """

    what: ClassVar[str] = "a record of times"

    epoch: Positive | None = None
    train: Seconds | None = None
    validate_: Annotated[Seconds | None, Field(alias="validate")] = None
    cpu: Seconds | None = None
    group: Positive = 1
    host: str = ""
    time: str = ""

    @property
    def spent(self) -> list[float]:
        """Parts of the seed's core-seconds; by the clock, which other work stretches, without `cpu`."""
        parts = (self.train, self.validate_) if self.cpu is None else (self.cpu,)
        return [part for part in parts if part is not None]


class DecidedPair(Record):
    """Two entries of a study at a look, with their p and the decision, if any; by rule `steps` with p's relabelings."""

    pair: list[str]
    p: Annotated[float | None, Field(ge=0, le=1)] = None
    decided: str | None = None
    relabelings: Count | None = None


class DecidedClaim(Record):
    """A claim of a study at a look: one-sided p of each rival with its relabelings, and whether it is established."""

    entry: str
    rivals: list[str]
    at_most: Number | None = None
    p: list[Annotated[float, Field(ge=0, le=1)]]
    relabelings: list[Count]
    established: bool


class LookLine(Record):
    """An event of the study whose hash is `plan`: it was begun or ended, or a look was taken at so many seeds.

    `seeds` is where the block of a study that was begun starts and stops; older lines leave it to the study's file. By
    rule `steps`, a look has the seed of its relabelings and a digest of the curves that it saw; older lines have none.
    """

    what: ClassVar[str] = "a line of a study's log"

    begun: str | None = None
    ended: str | None = None
    time: str | None = None
    plan: str | None = None
    seeds: Annotated[list[Count], Field(min_length=2, max_length=2)] | None = None
    look: Positive | None = None
    pairs: list[DecidedPair] = []
    claims: list[DecidedClaim] = []
    seed: Count | None = None
    curves: str | None = None


class RoundLine(Record):
    """The episodes that P agents played at once in an evaluation: returns and scores (P, lanes), and all steps."""

    what: ClassVar[str] = "a round of an evaluation"
    cure: ClassVar[str] = "delete the file, and its episodes are played again"

    round: Count
    lanes: Positive
    steps: Count
    returns: list[list[Number]]
    scores: list[list[Number | None]]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if {*map(len, self.returns), *map(len, self.scores)} != {self.lanes}:
            raise ValueError("not as many returns or scores as lanes")
        if len(self.returns) != len(self.scores):
            raise ValueError("not as many agents with returns as with scores")
        return self
