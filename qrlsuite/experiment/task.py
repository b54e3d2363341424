"""Benchmark tasks: one TOML file each, validated whole, every error at once with its path in the file."""

from __future__ import annotations

import copy
import hashlib
import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
import pydantic.dataclasses
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

import qrlsuite
from qrlsuite import files, options, own, registry, specs
from qrlsuite.errors import FileError, OptionError, UnknownNameError, nearest
from qrlsuite.experiment.preset import TuningRecord
from qrlsuite.statistics.compare import MIN_RUNS
from qrlsuite.statistics.grid import Goal, Grid

FORMAT_VERSION = 1

EXTERNAL = "external"
"""Name of the environment of tasks that the suite does not know, and of the algorithm of imported curves."""

_EPSILONS, _REFERENCE = [0.1, 0.2, 0.3, 0.4], 0.2
_DELTAS, _DELTA = [0.5, 0.75], 0.5


@pydantic.dataclasses.dataclass(frozen=True)
class Nothing:
    """No options."""


_EXTERNAL = specs.EnvironmentSpec(
    EXTERNAL, "An environment of another program", "qrlsuite.experiment.task:Nothing", ""
)


def _levels(value: Any) -> Any:
    several = value.split(",") if isinstance(value, str) else value
    return None if value is None else np.atleast_1d(several).tolist() or None


@pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config={"extra": "forbid"})
class Scale:
    """The good scores of another program, and the distance between the points of its curves.

    Attributes
    ----------
    metric:
        The column or scalar that is the score.
    maximum:
        The best possible score: scores become fractions of it.
    thresholds:
        Scores that count as reached, sorted; by default .6, .7, .8 and .9 of the maximum.
    every:
        Environment steps of an epoch.
    goal:
        `below` where less is better.
    """

    metric: str | None = None
    maximum: Annotated[FiniteFloat | None, Field(gt=0)] = None
    thresholds: Annotated[
        Annotated[list[FiniteFloat], AfterValidator(sorted)] | None, BeforeValidator(_levels)
    ] = None
    every: Annotated[int | None, Field(ge=1)] = None
    goal: Goal | None = None

    @model_validator(mode="after")
    def _fits(self) -> Scale:
        if self.goal == "below" and self.maximum is not None:
            raise ValueError("goal=below: give thresholds=A,B,... in place of maximum, the best high score")
        levels = self.thresholds or []
        if len(set(levels)) < len(levels):
            raise ValueError("thresholds: give each once")
        if self.maximum is not None and levels and not 0 < levels[0] <= levels[-1] <= self.maximum:
            raise ValueError(f"thresholds: give scores above 0, up to maximum={self.maximum:g}")
        return self


class EnvironmentSection(options.Table):
    """Which environment, with which options."""

    name: Annotated[str, Field(description="a registered environment")]
    options: Annotated[dict[str, Any], Field(description="its options; absent ones take their defaults")] = {}


class ProtocolSection(options.Table):
    """How much each seed interacts, and how it is validated."""

    seeds: Annotated[int, Field(ge=1, description="independent runs of a complete entry")] = 100
    epochs: Annotated[int, Field(ge=1, description="epochs of a complete run")] = 100
    algorithm_epochs: Annotated[
        dict[str, Annotated[int, Field(ge=1)]], Field(description="epochs where an algorithm needs others")
    ] = {}
    environments: Annotated[int, Field(ge=1, description="training environments per seed")] = 10
    interactions: Annotated[
        int, Field(ge=1, description="environment steps per epoch, all environments together")
    ]
    validation_episodes: Annotated[
        int, Field(ge=1, description="fresh validation episodes after every epoch")
    ] = 100

    @model_validator(mode="after")
    def _whole_rounds(self) -> ProtocolSection:
        if self.interactions % self.environments:
            raise ValueError(
                f"interactions = {self.interactions} is not a multiple of environments = {self.environments}"
            )
        return self

    @property
    def rounds(self) -> int:
        """Steps of every training environment per epoch."""
        return self.interactions // self.environments


class ScoreSection(options.Table):
    """The ranked number of an episode: a score in [0, 1], its return, or a metric of the environment."""

    source: Annotated[
        Literal["info", "return"],
        Field(
            description="info: the environment's info['score']; return: the episode's return over max_return"
        ),
    ] = "info"
    max_return: Annotated[
        float | None,
        Field(
            gt=0,
            allow_inf_nan=False,
            description="best possible return, above 0, for source = 'return'; without it, rank on thresholds",
        ),
    ] = None
    metric: Annotated[
        str | None,
        Field(
            pattern=specs.WHOLE_NAME,
            max_length=64,
            description="metric in the environment's info['metrics'] to rank in place of a score, on thresholds",
        ),
    ] = None
    goal: Annotated[
        Goal,
        Field(description="above: a metric should reach the threshold or more; below: the threshold or less"),
    ] = "above"

    @model_serializer(mode="wrap")
    def _without_absent_metric(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out the fields of metrics if there is none, so that tasks keep the hashes of earlier versions."""
        written: dict[str, Any] = write(self)
        if self.metric is None:
            written = {name: value for name, value in written.items() if name not in ("metric", "goal")}
        return written

    @model_validator(mode="after")
    def _of_one_source(self) -> ScoreSection:
        if self.metric is None and self.goal == "below":
            raise ValueError("goal = 'below' is for a metric: scores and returns should be high")
        if self.metric is not None and (self.source == "return" or self.max_return is not None):
            raise ValueError(
                f"metric = '{self.metric}' comes from the environment's info: source = \"info\", without max_return"
            )
        return self

    @property
    def sign(self) -> int:
        """1 where more is better, -1 where less is."""
        return 1 if self.goal == "above" else -1

    @property
    def before(self) -> str:
        """The side of a threshold where a run has not reached it: `below`, or `above` where less is better."""
        return "below" if self.goal == "above" else "above"

    @property
    def called(self) -> str:
        """Its name in sentences: `score`, or the metric's name."""
        return self.metric or "score"

    @property
    def of_optimum(self) -> bool:
        """Whether it is the environment's own score, a share of the best possible."""
        return self.source == "info" and self.metric is None


class Cell(options.Table):
    """One cell of a ranking grid: a threshold, relative (`epsilon`) or absolute, and a probability."""

    epsilon: Annotated[float | None, Field(ge=0, lt=1)] = None
    threshold: float | None = None
    delta: Annotated[float, Field(gt=0, le=1)]


class RankingSection(options.Table):
    """On which cells entries are compared."""

    epsilons: Annotated[
        list[Annotated[float, Field(ge=0, lt=1)]] | None,
        Field(min_length=1, description="thresholds 1 - epsilon on a score with maximum 1"),
    ] = None
    thresholds: Annotated[
        list[float] | None,
        Field(min_length=1, description="thresholds on the return, where no maximum is known"),
    ] = None
    deltas: Annotated[list[Annotated[float, Field(gt=0, le=1)]], Field(min_length=1)]
    reference: Annotated[Cell, Field(description="the cell a leaderboard shows first")]
    horizons: Annotated[
        list[Annotated[int, Field(ge=1)]],
        Field(
            min_length=1,
            description="environment steps at which S_hat is capped: one section of a board each",
        ),
    ]
    rule: Annotated[
        str | None, Field(description="rule by which its boards compare; the paper's where absent")
    ] = None
    costs: Annotated[
        list[Annotated[str, Field(pattern=specs.WHOLE_NAME, max_length=64)]],
        Field(description="metrics in info['metrics'] to show beside the score, less is better: violations"),
    ] = []
    policies: Annotated[
        dict[
            Annotated[str, Field(pattern=r"^\w[\w .,()/-]*$", max_length=40)],
            Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e9, le=1e9)],
        ],
        Field(
            max_length=8, description="final scores of policies to compare with: random, the best one known"
        ),
    ] = {}
    _score: ScoreSection = PrivateAttr(ScoreSection())

    @model_serializer(mode="wrap")
    def _without_absent(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out an absent rule, costs and policies if there are none: earlier versions can read the files."""
        late = ("rule", "costs", "policies")
        return {name: value for name, value in write(self).items() if name not in late or value}

    @model_validator(mode="after")
    def _consistent(self) -> RankingSection:
        if (self.epsilons is None) == (self.thresholds is None):
            raise ValueError("give either epsilons (score with maximum 1) or thresholds (no known maximum)")
        relative = self.epsilons is not None
        if (self.reference.epsilon is not None) != relative or (
            self.reference.threshold is not None
        ) == relative:
            kind = "epsilon" if relative else "threshold"
            raise ValueError(f"the reference cell needs {kind} and delta, as the grid has {kind}s")
        for name, score in self.policies.items():
            if relative and not 0 <= score <= 1:
                raise ValueError(f"policies.{name} = {score:g}: scores of this task are shares, from 0 to 1")
        for horizon in self.horizons:
            if self.horizons.count(horizon) > 1:
                raise ValueError(f"horizons: {horizon} is there twice")
        try:
            _ = self.grid, self.reference_grid
        except OptionError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def grid(self) -> Grid:
        """The cells on which entries are compared."""
        return self._grid(self.epsilons, self.thresholds, self.deltas)

    @property
    def reference_grid(self) -> Grid:
        """The reference cell alone."""
        epsilon, threshold = self.reference.epsilon, self.reference.threshold
        return self._grid([epsilon], [threshold], [self.reference.delta])

    def _grid(self, epsilons: Any, thresholds: Any, deltas: list[float]) -> Grid:
        if self.epsilons is not None:
            return Grid.relative(epsilons, deltas)
        return Grid.absolute(thresholds, deltas, self.goal)

    @property
    def goal(self) -> Goal:
        """The side of the thresholds that is the goal."""
        return self._score.goal

    @property
    def before(self) -> str:
        """The other side, `below` or `above`: boards count the steps on it."""
        return self._score.before

    @property
    def level_name(self) -> str:
        """Kind of thresholds: `epsilon`, `return`, or the metric's name."""
        return "epsilon" if self.epsilons is not None else self._score.metric or "return"

    @property
    def cell(self) -> str:
        """The reference cell in words: `epsilon 0.15, delta 0.75`."""
        return f"{self.reference_level}, delta {self.reference.delta:g}"

    @property
    def reference_level(self) -> str:
        """The reference cell's threshold in words: `return 200`."""
        return f"{self.level_name} {self.reference_grid.levels[0]:g}"


Family = Literal["all", "classical", "quantum"]


class TaskFile(options.Table):
    """A whole task file."""

    format_version: Literal[1]
    name: Annotated[str, Field(pattern=specs.WHOLE_NAME, max_length=64)]
    summary: Annotated[str, Field(min_length=1)]
    description: str = ""
    environment: EnvironmentSection
    protocol: ProtocolSection
    score: ScoreSection = ScoreSection()
    ranking: RankingSection
    default_algorithm: str = "ddqn"
    default_preset: Annotated[
        str | None, Field(description="the preset where none is chosen; left out: `default`, if there is one")
    ] = None
    presets: Annotated[
        dict[str, dict[str, dict[Family, dict[str, Any]]]],
        Field(
            description="[presets.NAME.ALGORITHM.FAMILY]: algorithm options, FAMILY all, classical or quantum"
        ),
    ] = {}
    tuning: Annotated[
        dict[str, dict[str, dict[Family, TuningRecord]]],
        Field(
            description="[tuning.NAME.ALGORITHM.FAMILY]: how the settings of that preset were found; entries keep it"
        ),
    ] = {}

    @model_validator(mode="after")
    def _goal_of_ranking(self) -> TaskFile:
        self.ranking._score = self.score
        if self.score.metric is not None and self.ranking.epsilons is not None:
            raise ValueError(
                f"score.metric = '{self.score.metric}' has no known maximum: ranking.thresholds and a reference with a "
                "threshold in place of epsilons"
            )
        for name in self.ranking.costs:
            if self.ranking.costs.count(name) > 1 or name == self.score.metric:
                raise ValueError(f"ranking.costs: '{name}' is shown twice")
        return self

    @model_validator(mode="after")
    def _preset_exists(self) -> TaskFile:
        for name, by_algorithm in self.tuning.items():
            if name not in self.presets:
                raise ValueError(f"tuning: no preset '{name}'{nearest(name, self.presets)}")
            for algorithm in by_algorithm:
                if algorithm not in self.presets[name]:
                    known = nearest(algorithm, self.presets[name])
                    raise ValueError(f"tuning.{name}: the preset says nothing of '{algorithm}'{known}")
        if self.default_preset is None and "default" in self.presets:
            object.__setattr__(self, "default_preset", "default")
        if self.default_preset is not None and self.default_preset not in self.presets:
            raise ValueError(
                f"default_preset '{self.default_preset}'{nearest(self.default_preset, self.presets)}"
            )
        return self


class Task:
    """A validated task with its environment's options resolved.

    Attributes
    ----------
    definition:
        Everything that a run's numbers depend on, as plain values (except `options.Since`).
    hash:
        The first 16 hexadecimal digits of SHA-256 over the definition; the key of all random streams.
    """

    def __init__(self, file: TaskFile, source: str) -> None:
        self.file = file
        self.source = source
        self.name = file.name
        try:
            name = file.environment.name
            self.environment = _EXTERNAL if name == EXTERNAL else registry.get(specs.EnvironmentSpec, name)
        except UnknownNameError as error:
            raise UnknownNameError(f"{source}: environment.name: {error}") from None
        cls = specs.resolve(self.environment.options)
        location = f"{source}: environment.options"
        self.environment_options = options.build(cls, file.environment.options, location)
        self.definition: dict[str, Any] = {
            "environment": file.environment.name,
            "environment_options": options.identity(self.environment_options),
            "environments": file.protocol.environments,
            "interactions": file.protocol.interactions,
            "validation_episodes": file.protocol.validation_episodes,
            "score": file.score.model_dump(mode="json"),
        }
        self.hash = digest(self.definition)
        if file.ranking.rule is not None:
            try:
                registry.load().get(specs.RuleSpec, file.ranking.rule)
            except UnknownNameError as error:
                raise FileError(f"{source}: ranking.rule: {error}") from None
        epoch = file.protocol.interactions
        for horizon in file.ranking.horizons:
            if horizon % epoch:
                raise FileError(
                    f"{source}: ranking.horizons: {horizon} steps are not a whole number of epochs of {epoch} steps "
                    "(protocol.interactions)"
                )
        if (
            file.score.source == "return"
            and file.score.max_return is None
            and file.ranking.thresholds is None
        ):
            raise FileError(
                f"{source}: without score.max_return, ranking.thresholds are needed instead of epsilons"
            )

    @property
    def world(self) -> str:
        """The hash without options of observations: entries of tasks with one world can be compared."""
        seen = dict.fromkeys(self.environment.views)
        world = {**self.definition, "environment_options": {**self.definition["environment_options"], **seen}}
        return digest(world)

    def epochs(self, algorithm: str) -> int:
        """Return the epochs of a complete run of an algorithm."""
        return self.file.protocol.algorithm_epochs.get(algorithm, self.file.protocol.epochs)

    def with_scores(self, kind: str) -> Task:
        """Return the task of scores of another kind, such as `training`, which its own are not compared with."""
        changed = copy.copy(self)
        changed.name, changed.definition = f"{self.name}+{kind}", {**self.definition, "scores": kind}
        changed.hash = digest(changed.definition)
        return changed

    def with_environment(self, values: dict[str, Any]) -> Task:
        """Return the task with other environment options, under a name that says so."""
        if not values:
            return self
        merged = {**self.file.environment.options, **values}
        location = f"environment '{self.environment.name}'"  # not the file: its own options are in order
        options.build(specs.resolve(self.environment.options), merged, location)
        section = self.file.environment.model_copy(update={"options": merged})
        file = self.file.model_copy(update={"environment": section})
        changed = Task(file, self.source)
        if changed.hash != self.hash:
            changed.name = f"{self.name}+{changed.hash[:8]}"
            ranking = file.ranking.model_copy(update={"policies": {}})  # they have other scores in it
            changed.file = file.model_copy(update={"ranking": ranking})
        return changed

    def preset(self, name: str | None, algorithm: str, family: str) -> tuple[str | None, dict[str, Any]]:
        """Return the chosen preset's name and its values for an algorithm and a model family.

        Options that a preset leaves out have the algorithm's `starting_values`. If the default preset has no values for
        them, there is no preset: the algorithm's defaults are not a task's `tuned` settings.
        """
        chosen = name or self.file.default_preset
        if chosen is None:
            return None, {}
        if chosen not in self.file.presets:
            raise FileError(
                f"task '{self.name}' has no preset '{chosen}'{nearest(chosen, self.file.presets)}"
            )
        tables: dict[Any, dict[str, Any]] = dict(self.file.presets[chosen].get(algorithm, {}))
        if tables.keys() & {"all", family}:
            return chosen, {
                **starting_values(algorithm),
                **tables.get("all", {}),
                **tables.get(family, {}),
            }
        if name is None:
            return None, {}
        of = f" with {family} models" if tables else ""
        raise FileError(
            f"task '{self.name}': preset '{chosen}' says nothing about algorithm '{algorithm}'{of}, only about "
            f"{', '.join(self.file.presets[chosen])}: leave it out, or set options one by one"
        )

    def tuning(self, preset: str | None, algorithm: str, family: str) -> TuningRecord | None:
        """Return how a preset's settings for an algorithm and a model family were found; None where it is not said."""
        tables: dict[Any, TuningRecord] = dict(self.file.tuning.get(preset or "", {}).get(algorithm, {}))
        return tables.get(family, tables.get("all"))

    def check_presets(self, algorithm: str, cls: type[Any]) -> None:
        """Check every preset of an algorithm against its options class."""
        problems = []
        for preset, by_algorithm in self.file.presets.items():
            for family in by_algorithm.get(algorithm, {}):
                of = (
                    "classical" if family == "all" else family
                )  # tables of `all` come before those of a family
                try:
                    options.build(cls, self.preset(preset, algorithm, of)[1], f"presets.{preset}.{algorithm}")
                except OptionError as error:
                    problems.append(str(error))
        if problems:
            raise FileError(f"{self.source}: " + "; ".join(dict.fromkeys(problems)))


def starting_values(algorithm: str) -> Mapping[str, Any]:
    """Return an algorithm's values for options that a task's preset leaves out; by default none."""
    registered = registry.load().of(specs.AlgorithmSpec)
    return registered[algorithm].spec.starting_values if algorithm in registered else {}


def digest(content: Any) -> str:
    """Return 16 hexadecimal digits of SHA-256 over content in canonical JSON."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def external(name: str, scale: Scale, every: int, epochs: int, horizon: int | None = None) -> TaskFile:
    """Return the file of a task whose environment only other programs know.

    Parameters
    ----------
    every, epochs:
        Environment steps of an epoch, and epochs of a run.
    horizon:
        Epochs at which entries are compared; None is all.
    """
    maximum, thresholds = scale.maximum, scale.thresholds or []
    if maximum is None and not thresholds:
        raise OptionError(
            f"{name!a} is a new task: say what a good score is with maximum=BEST (the best possible), "
            "thresholds=A,B,... (scores that count as reached; with goal=below less is better), or --task TASK of the "
            "suite"
        )
    score: dict[str, Any] = {"source": "return", "max_return": maximum}
    if scale.goal == "below":
        plain = re.sub(r"[^a-z0-9]+", "-", (scale.metric or "score").lower()).strip("-")[:64].rstrip("-")
        score = {"metric": plain if specs.NAME.fullmatch(plain) else "score", "goal": "below"}
    hardest = 0 if scale.goal == "below" else -1
    ranking: dict[str, Any] = {
        "thresholds": [*thresholds],
        "reference": {"threshold": (thresholds or [0])[hardest]},
    }
    if maximum is not None:
        epsilons = [round(1 - level / maximum, 12) for level in reversed(thresholds)] or _EPSILONS
        ranking = {"epsilons": epsilons, "reference": {"epsilon": epsilons[0] if thresholds else _REFERENCE}}
    content = {
        "format_version": 1,
        "name": name,
        "summary": "Learning curves that other programs made",
        "environment": {"name": EXTERNAL},
        "protocol": {
            "seeds": MIN_RUNS,
            "epochs": epochs,
            "environments": 1,
            "interactions": every,
            "validation_episodes": 1,
        },
        "score": score,
        "ranking": {
            **ranking,
            "reference": {**ranking["reference"], "delta": _DELTA},
            "deltas": _DELTAS,
            "horizons": [(horizon or epochs) * every],
        },
    }
    try:
        return TaskFile.model_validate(content)
    except pydantic.ValidationError as error:
        raise OptionError(
            f"--task {ascii(name)[1:-1]}: {'; '.join(files.problems(error, TaskFile))}"
        ) from None


def parse(text: str, source: str, folder: Path | None = None) -> Task:
    """Parse and validate a task.

    Parameters
    ----------
    text:
        TOML.
    source:
        Where it came from, for messages.
    folder:
        Folder of the file: the paths in its key `plugins` are relative to it.
    """
    data = _whole(text, source, folder=folder)
    try:
        file = TaskFile.model_validate(data)
    except pydantic.ValidationError as error:
        problems = [*files.problems(error, TaskFile), *_environment_problems(data.get("environment"))]
        raise FileError(f"{source}: " + "; ".join(problems)) from None
    return Task(file, source)


def _whole(text: str, source: str, below: tuple[str, ...] = (), folder: Path | None = None) -> dict[str, Any]:
    """Return a file's content merged with the task that it extends, and load the plugins that it names.

    Where it has `extends = TASK`, the content is that task's, with this file's values in place of its own. Tables are
    merged key by key. Every other value, a list too, replaces the one of the extended task; thresholds replace its
    epsilons. Scores of its policies go where the environment or the score is another.

    Parameters
    ----------
    below:
        The tasks whose files lead here by `extends`.
    """
    data = files.parse(text, source)
    own.load_named(data.pop("plugins", []), folder, source)
    if "extends" not in data:
        return data
    name = data.pop("extends")
    if not isinstance(name, str):
        raise FileError(f'{source}: extends = {name!r}: name a task, as in extends = "beam6g"')
    if name in below:
        raise FileError(f"{source}: a task extends itself: {' -> '.join([*below, name])}")
    try:
        path = Path(registry.get(specs.TaskSpec, name).path)
    except UnknownNameError as error:
        raise FileError(f"{source}: extends: {error}") from None
    base = _whole(files.read(path, "task file"), path.name, (*below, name), path.parent)
    ranking, changed = base.get("ranking"), data.get("ranking")
    if isinstance(ranking, dict) and not data.keys().isdisjoint({"environment", "score"}):
        ranking.pop("policies", None)
    if isinstance(ranking, dict) and isinstance(changed, dict) and "thresholds" in changed:
        for table in (ranking, ranking.get("reference")):  # they take the place of tolerances
            if isinstance(table, dict):
                table.pop("epsilons", None), table.pop("epsilon", None)
    return _merged(base, data)


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return the nested tables of `base` with the values of `changes`."""
    tables = {
        key: _merged(base[key], value)
        for key, value in changes.items()
        if isinstance(value, dict) and isinstance(base.get(key), dict)
    }
    return {**base, **changes, **tables}


def _environment_problems(section: Any) -> list[str]:
    try:
        parsed = EnvironmentSection.model_validate(section)
    except pydantic.ValidationError:
        return []  # named already
    try:
        cls = specs.resolve(registry.get(specs.EnvironmentSpec, parsed.name).options)
    except UnknownNameError as error:
        return [f"environment.name: {error}"]
    try:
        options.build(cls, parsed.options, "environment.options")
    except OptionError as error:
        return [str(error)]
    return []


def is_quick(name: str) -> bool:
    """Whether a name stands for a task that no file has: `gym:ID`, or an environment's (`gym` itself lacks an ID)."""
    registered = registry.load()
    names = registered.of(specs.EnvironmentSpec).keys() - registered.of(specs.TaskSpec).keys()
    return name.startswith("gym:") or name in names - {"gym"}


def is_known(name: str) -> bool:
    """Whether `load` finds a task by a name."""
    return name.endswith(".toml") or is_quick(name) or name in registry.load().of(specs.TaskSpec)


def load(name: str) -> Task:
    """Load a registered task by name, a task file by path (anything that ends in `.toml`), or `gym:ID`.

    `gym:Acrobot-v1` is a task with settings for a quick look at an environment that Gymnasium knows. So is the name of
    a registered environment, where no task has that name.
    """
    if is_quick(name):
        from qrlsuite.gymlanes import quick_task

        if name.startswith("gym:"):
            return Task(TaskFile.model_validate(quick_task(name.removeprefix("gym:"))), name)
        qrlsuite.register_environments()
        gymnasium_id = registry.get(specs.EnvironmentSpec, name).gymnasium_id
        return Task(TaskFile.model_validate(quick_task(gymnasium_id, name)), name)
    path = Path(name) if name.endswith(".toml") else _registered(name)
    return parse(files.read(path, "task file"), path.name, path.parent)


def _registered(name: str) -> Path:
    """Return a registered task's file; the error names the file in the current folder that has the task."""
    try:
        return Path(registry.get(specs.TaskSpec, name).path)
    except UnknownNameError as error:
        raise UnknownNameError(
            in_a_file(name) or f"{error} (a task file needs its path: FILE.toml)"
        ) from None


def in_a_file(name: str) -> str:
    """Say which file of the current folder has a task that is not registered; nothing where none has."""
    for path in sorted(Path().glob("*.toml")):
        content = _task_in(path)
        if content is not None and name in (content.get("name"), path.stem):
            return f"task '{name}' is not registered, but in a file: write --task {path}"
    return ""


def is_task_file(path: Path) -> bool:
    """Whether a file can be read and has the environment of a task."""
    return _task_in(path) is not None


def _task_in(path: Path) -> dict[str, Any] | None:
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if "environment" in content else None
