"""Studies as data: one TOML file names the entries of an experiment, its pictures, and a paper's results.

A study has no training of its own: `qrlsuite run` would train its entries in the same folders, so that several
studies share the seeds of an entry. A study with a table `[looks]` compares its entries with as
many seeds as it takes, on seeds of its own: see `qrlsuite.studies.looks`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import AwareDatetime, Field, PrivateAttr, model_validator

from qrlsuite import files, notation, options, own, registry, specs
from qrlsuite.errors import OptionError, QrlSuiteError, nearest
from qrlsuite.experiment.entry import Entry, option_sides, resolve
from qrlsuite.experiment.preset import EntryTuning
from qrlsuite.experiment.script import SCRIPT
from qrlsuite.experiment.task import Task
from qrlsuite.experiment.task import load as load_task
from qrlsuite.experiment.task import parse as parse_task
from qrlsuite.options import Setting, Table
from qrlsuite.results.store import EntryStore
from qrlsuite.results.text import counted
from qrlsuite.studies.sizes import nearest_size

Name = Annotated[str, Field(pattern=specs.WHOLE_NAME, max_length=64)]
LARGEST = 1000
"""Entries that a study may have."""


class MatchSection(Table):
    """A computed option: the value whose parameter count is nearest to the count of another group's entry."""

    option: Annotated[
        str, Field(min_length=1, description="an integer option of the model that sets its size")
    ]
    group: Annotated[str, Field(description="the group of entries whose parameter counts are matched")]


class EntriesSection(Table):
    """A group of entries: every combination of its tasks, models and grid."""

    name: Annotated[
        str | None,
        Field(
            pattern=r"^[\w(][\w ,.:=+/()-]*$",
            max_length=64,
            description="by which pictures, pairs and other groups refer to it",
        ),
    ] = None
    task: str | Annotated[list[str], Field(min_length=1)]
    model: Annotated[
        str | Annotated[list[str], Field(min_length=1)],
        Field(description="a model, or an entry: 'mlp width=64', 'ppo mlp preset=FILE.toml'"),
    ]
    algorithm: str | None = None
    preset: str | None = None
    options: Annotated[
        dict[str, Any], Field(description='options as in --set: qubits, "environment.degree", "algorithm.lr"')
    ] = {}
    grid: Annotated[
        dict[str, Annotated[list[Any], Field(min_length=1)]],
        Field(description="options that take each of several values"),
    ] = {}
    match: MatchSection | None = None
    hash: Annotated[
        str | None,
        Field(description="with looks: of the entry that the options make, which cannot be another"),
    ] = None
    tuning: Annotated[
        EntryTuning | None,
        Field(description="with looks: how the options were found, where a preset file gave them"),
    ] = None
    code: Annotated[
        str | None,
        Field(description="with looks: the code identity of an entry that a plugin's code computes"),
    ] = None


class Question(Table):
    """A question of a study with looks, and the pairs of entries whose verdicts answer it."""

    text: Annotated[str, Field(min_length=1, max_length=200)]
    pairs: Annotated[list[tuple[str, str]], Field(min_length=1)]


class ClaimSection(Table):
    """A claim about one entry and several others, which has an error of its own."""

    entry: str
    rivals: Annotated[list[str], Field(min_length=1)]
    at_most: Annotated[
        float | None, Field(gt=0, le=10, description="0.1: the best rival needs at most 10 percent more")
    ] = None
    tasks: Annotated[
        int, Field(ge=1, le=LARGEST, description="studies, each of another task, that are read together")
    ] = 1


class LooksSection(Table):
    """When entries are compared, at which error and on which seeds: fixed once the first seed is begun."""

    looks: Annotated[list[int], Field(min_length=1, description="seeds of each entry at each look")] = [
        20,
        40,
        60,
        80,
        100,
    ]
    alpha: Annotated[
        float, Field(description="probability of any false difference, over all pairs and looks")
    ] = 0.05
    spending: Annotated[str, Field(description="how alpha is spent over the looks")] = "pocock"
    margin: Annotated[float, Field(description="a smaller difference counts as none: 0.1 is 10 percent")] = (
        0.1
    )
    first_seed: Annotated[int, Field(ge=0, description="where the study's own block of seeds begins")] = (
        10_000
    )
    epochs: Annotated[
        int | None, Field(ge=1, description="of every seed: the horizon at which entries are compared")
    ] = None
    rule: Literal["steps", "times"] = "steps"
    epsilons: Annotated[
        list[float] | None,
        Field(min_length=1, description="thresholds 1 - epsilon on a score with maximum 1"),
    ] = None
    thresholds: Annotated[list[float] | None, Field(min_length=1, description="thresholds on the return")] = (
        None
    )
    reason: Annotated[str, Field(description="why the first look comes before 20 seeds")] = ""
    written: AwareDatetime | None = None
    questions: Annotated[
        list[Question], Field(description="which pairs are compared; every pair of entries without them")
    ] = []
    claims: Annotated[
        list[ClaimSection], Field(description="about an entry and several rivals, each at alpha on one side")
    ] = []

    @property
    def block(self) -> range:
        """The seeds that the study may train, of every entry."""
        return range(self.first_seed, self.first_seed + self.looks[-1])


class DeploymentSection(Table):
    """A circuit backend on which trained agents act, with several values of one of its options."""

    backend: Annotated[str, Field(min_length=1)]
    vary: Annotated[str, Field(min_length=1, description="the option that takes each of the values")]
    values: Annotated[list[bool | int | float | str], Field(min_length=1)]
    options: Annotated[dict[str, Any], Field(description="its other options")] = {}

    def chosen(self, value: Any) -> dict[str, Any]:
        """Return the backend's options with one of the values."""
        return {**self.options, self.vary: value}


class EvaluationSection(Table):
    """For a picture of episodes: how many of each entry's runs play how many episodes."""

    best: Annotated[int, Field(ge=1)] = 10
    episodes: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    deployed: Annotated[
        DeploymentSection | None, Field(description="for picture 'deployed': where the agents act")
    ] = None


class PictureSection(Table):
    """A picture of the study's entries."""

    name: Annotated[Name, Field(description="part of the file's name")] = "picture"
    kind: Annotated[str, Field(min_length=1, description="see `qrlsuite plot --help`")]
    entries: Annotated[list[str], Field(description="groups that it shows; all where none is named")] = []
    settings: Annotated[dict[str, Any], Field(description="settings of the picture")] = {}
    evaluation: EvaluationSection | None = None


class StudyFile(Table):
    """A study: its entries, what it asks and when to look, and its pictures."""

    _origin: str = PrivateAttr("")
    _folder: Path | None = PrivateAttr(None)
    _kept: Path | None = PrivateAttr(None)
    format_version: Literal[1]
    name: Name
    summary: Annotated[str, Field(min_length=1)]
    source: Annotated[str, Field(description="where it was published: section, figure")] = ""
    reports: Annotated[str, Field(description="the result reported there")] = ""
    core_hours: Annotated[float | None, Field(ge=0, description="its cost there, in core-hours")] = None
    looks: LooksSection | None = None
    entries: list[EntriesSection] = []
    pictures: list[PictureSection] = []

    @model_validator(mode="after")
    def _groups_exist(self) -> StudyFile:
        names = [group.name for group in self.entries if group.name is not None]
        problems = [
            f"two groups are named '{name}'" for name in sorted({n for n in names if names.count(n) > 1})
        ]
        if self.looks is None and not self.pictures:
            problems.append("missing key 'pictures': a study without looks draws at least one")
        for index, group in enumerate(self.entries):
            earlier = [before.name for before in self.entries[:index] if before.name is not None]
            if group.match is not None and group.match.group not in earlier:
                problems.append(
                    f"entries.{index}.match.group = '{group.match.group}' is no earlier group"
                    f"{nearest(group.match.group, earlier)}"
                )
        titles = [picture.name for picture in self.pictures]
        problems += [
            f"two pictures are named '{name}'" for name in sorted({t for t in titles if titles.count(t) > 1})
        ]
        for index, picture in enumerate(self.pictures):
            problems += [
                f"pictures.{index}.entries: no group '{word}'{nearest(word, names)}"
                for word in picture.entries
                if word not in names
            ]
        if problems:
            raise ValueError("; ".join(problems))
        return self

    @property
    def origin(self) -> str:
        """Where it came from, for messages."""
        return self._origin or self.name

    def of(self, origin: str) -> StudyFile:
        """Return the study with where it came from."""
        named = self.model_copy()
        named._origin = origin
        return named

    def started_in(self, folder: Path) -> StudyFile:
        """Return the study, named in this call, with the folder where it starts commands of scripts."""
        named = self.model_copy()
        named._folder = folder.absolute()
        return named

    def kept_in(self, folder: Path) -> StudyFile:
        """Return the study with the folder of its results, whose entries have its tasks, too."""
        kept = self.model_copy()
        kept._kept = folder
        return kept

    def _recorded(self, name: str, hash: str | None) -> Task | None:
        """Return the task of an entry whose task is a file, from the results; None without results.

        The results may be a stranger's, so no task file loads a plugin here.
        """
        if self._kept is None or not name.endswith(".toml"):
            return None
        for path in sorted(self._kept.glob("*/*/entry.json")):
            if hash is not None and path.parent.name.endswith(f"-{hash[:8]}"):
                return EntryStore(path.parent).entry().task
        return parse_task(files.read(Path(name), "task file"), name)

    def members(
        self, settings: Sequence[Setting] = (), models: Mapping[str, str] | None = None
    ) -> list[Member]:
        """Return the entries, group by group, none twice within a group.

        Parameters
        ----------
        settings:
            Options that replace the study's own, in every entry that has them.
        models:
            Models to be used in the place of others, by name.
        """
        models, task_of = models or {}, functools.cache(load_task)
        named: set[str] = set()
        by_group: dict[str | None, list[Member]] = {}
        every: list[Member] = []
        used: set[tuple[str | None, str]] = set()
        for index, group in enumerate(self.entries):
            members: dict[tuple[str, str], Member] = {}
            targets = [m.entry for m in by_group[group.match.group]] if group.match is not None else [None]
            try:
                for draft, target in itertools.product(_drafts(group), targets):
                    named.add(draft.written.model)
                    task: Task | str | None = self._recorded(draft.task, group.hash)
                    if task is None:  # a script may define a task that nothing else knows
                        task = draft.task if draft.written.algorithm == SCRIPT else task_of(draft.task)
                    member = _member(group, draft, task, settings, models, target, used)
                    member = replace(member, entry=replace(member.entry, folder=self._folder))
                    members.setdefault((member.entry.task.name, member.entry.name), member)
            except QrlSuiteError as error:
                place = f"entries.{index}" if group.name is None else f"group '{group.name}'"
                raise type(error)(f"{self.origin}, {place}: {error}") from None
            by_group[group.name] = list(members.values())
            every += members.values()
        for name in sorted(set(models) - named):
            raise OptionError(f"study '{self.name}' has no entry with model '{name}'{nearest(name, named)}")
        for setting in settings:
            if (setting.side, setting.name) not in used:
                raise OptionError(
                    f"{setting.written}: no entry of study '{self.name}' has an option of that name"
                )
        if len(every) > LARGEST:
            raise OptionError(f"study '{self.name}' has {len(every)} entries, more than {LARGEST}")
        return every


@dataclass(frozen=True)
class Member:
    """An entry of a study, its group, and the group's table reduced to this entry."""

    group: str
    entry: Entry
    table: EntriesSection


@dataclass(frozen=True)
class _Draft:
    """An entry in the making."""

    task: str
    written: notation.Written


def _listed(names: str | list[str]) -> list[str]:
    return [names] if isinstance(names, str) else names


def setting(key: str, word: str, value: Any) -> Setting:
    """Return the setting of `NAME = VALUE` or `"SIDE.NAME" = VALUE` in a file's table `key`."""
    side, dot, name = word.rpartition(".")
    return Setting(side if dot else None, name, value, f"{key}.")


def _drafts(group: EntriesSection) -> Iterator[_Draft]:
    fixed = [setting("options", word, value) for word, value in group.options.items()]
    for task, text in itertools.product(_listed(group.task), _listed(group.model)):
        written = notation.parse_entry(text)
        written = replace(written, settings=(*fixed, *written.settings))
        for values in itertools.product(*group.grid.values()):
            varied = [setting("grid", word, value) for word, value in zip(group.grid, values)]
            yield _Draft(task, written.given(group.algorithm, tuple(varied), group.preset))


def _member(
    group: EntriesSection,
    draft: _Draft,
    task: Task | str,
    settings: Sequence[Setting],
    models: Mapping[str, str],
    target: Entry | None,
    used: set[tuple[str | None, str]],
) -> Member:
    written = replace(draft.written, model=models.get(draft.written.model, draft.written.model))
    applicable = _applicable(written, task, settings) if settings and isinstance(task, Task) else []
    used |= {(s.side, s.name) for s in applicable}
    all_settings = [*written.settings, *applicable]

    def entry(*more: Setting) -> Entry:
        return resolve(task, replace(written, settings=(*all_settings, *more)))

    if target is not None and group.match is not None:
        option = group.match.option
        if not any(s.name == option and s.side in (None, "model") for s in applicable):
            size = nearest_size(lambda size: entry(Setting("model", option, size)), target)
            all_settings.append(Setting("model", option, size))
    options_ = {s.full_name: s.value for s in all_settings}
    alone: dict[str, Any] = {
        "task": draft.task,
        "model": written.model,
        "algorithm": written.algorithm,
        "preset": written.preset,
    }
    alone |= {"options": options_, "grid": {}, "match": None}
    return Member(group.name or "", entry(), group.model_copy(update=alone))


def _applicable(written: notation.Written, task: Task, settings: Sequence[Setting]) -> list[Setting]:
    """Return the settings for options that an entry has."""
    algorithm = registry.get(specs.AlgorithmSpec, written.algorithm or task.file.default_algorithm)
    model = registry.get(specs.ModelSpec, written.model)
    sides = option_sides(task, algorithm, model, [*written.settings, *settings])
    return [setting for setting in settings if _has(sides, setting)]


def _has(sides: Mapping[str, type[Any]], setting: Setting) -> bool:
    """Whether an entry with these options classes has the option that a setting is for."""
    if setting.side == "ansatz":  # a study may have models without one, too
        names = options.field_names(sides["ansatz"]) if "ansatz" in sides else []
        return setting.name in (*names, *getattr(sides["model"], "passes_on", ()))
    if setting.side is not None and setting.side not in sides:
        raise OptionError(f"{setting.written}: sides are {', '.join(sides)}")
    chosen = [sides[setting.side]] if setting.side is not None else list(sides.values())
    return any(setting.name in options.field_names(cls) for cls in chosen)


def parse(text: str, source: str, folder: Path | None = None) -> StudyFile:
    """Parse and validate a study; the entries are resolved by `StudyFile.members`.

    Parameters
    ----------
    folder:
        Folder of the file: the paths in its key `plugins` are relative to it.
    """
    content = files.parse(text, source)
    own.load_named(content.pop("plugins", []), folder, source)
    data = _with_table(content)
    return files.validate(data, StudyFile, source).of(source)


def _with_table(data: dict[str, Any]) -> dict[str, Any]:
    """Return a file's content, with a table `[looks]` of the keys that version 0.1 wrote beside the others."""
    if not isinstance(data.get("looks"), list):
        return data
    looks = {key: data[key] for key in LooksSection.model_fields if key in data}
    entries = [{"task": data.get("task"), **each} for each in data.get("entries", [])]
    rest = {key: value for key, value in data.items() if key not in (*looks, "task", "entries")}
    names = [str(each.get("name") or each.get("model")) for each in entries]
    first, *more = [str(each.get("text")) for each in looks.get("questions", [])] or [question_of(names)]
    summary = f"{first} And {counted(len(more), 'more question')}." if more else first
    return {**rest, "summary": summary, "looks": looks, "entries": entries}


def question_of(names: Sequence[str]) -> str:
    """Return the question about all pairs of some entries."""
    if 0 < len(names) <= 4:
        return f"Which needs fewer steps, {', '.join(names[:-1])} or {names[-1]}?"
    return f"Which of {len(names)} entries needs the fewest steps?" if names else "Which needs fewer steps?"


def dumps(file: StudyFile) -> str:
    """Return the text of a study file."""
    content = file.model_dump(exclude_defaults=True, exclude_none=True)
    if file.looks is not None:  # in full: what was fixed does not depend on a later version's defaults
        looks = file.looks.model_dump(exclude_none=True)
        content["looks"] = {key: value for key, value in looks.items() if value not in ("", [])}
    for written, group in zip(content.get("entries", []), file.entries):
        if group.tuning is not None:
            written["tuning"] = group.tuning.model_dump(exclude_none=True)
    return tomli_w.dumps(content)


def load(name: str) -> StudyFile:
    """Load a registered study by name, or a study file by path (anything that ends in `.toml`), with its plugins."""
    path = Path(name) if name.endswith(".toml") else Path(registry.get(specs.StudySpec, name).path)
    file = parse(files.read(path, "study file"), path.name, path.parent).started_in(path.parent)
    return file.kept_in(path.parent) if any(path.parent.glob("*/*/entry.json")) else file


def load_kept(path: Path) -> StudyFile:
    """Load the file of a study that lies with its results; these may be a stranger's, so it loads no plugin."""
    return parse(files.read(path, "study file"), path.name).kept_in(path.parent)
