"""Specs, which plugins register. A spec has a name, a one-line summary and *references* to code.

A reference is a string `"package.module:Name"`. It is resolved only by the command that needs it, so that
registering imports neither torch nor PennyLane nor Qiskit, and `qrlsuite list` answers at once.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

from qrlsuite.errors import PluginError, UnknownNameError, nearest

NAME = re.compile(r"[a-z][a-z0-9]*(?:[-_.][a-z0-9]+)*")
WHOLE_NAME = f"^(?:{NAME.pattern})$"
"""The same for pydantic, whose patterns match anywhere in a text."""
"""Names are lower case, digits, and single hyphens, underscores or dots: safe in a path and on a command line."""


NO_MODEL = "none"
"""The model of algorithms that build no network."""


def resolve(reference: str) -> Any:
    """Import the target of a reference `"package.module:Name"`; `"package.module:Name[key]"` is `Name["key"]`.

    Raises
    ------
    PluginError
        If the reference is malformed, the module cannot be imported or the name is not in it.
    """
    module_name, separator, attribute = reference.removesuffix("]").partition(":")
    attribute, bracket, key = attribute.partition("[")
    if not separator or not module_name or not attribute:
        raise PluginError(f"reference {reference!r} should read 'package.module:Name'")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise PluginError(f"reference {reference!r} cannot be imported: {error}") from error
    try:
        found = getattr(module, attribute)
    except AttributeError:
        raise PluginError(f"reference {reference!r}: module '{module_name}' has no '{attribute}'") from None
    return found[key] if bracket else found


@dataclass(frozen=True, slots=True)
class Spec:
    """Attributes of every registered thing.

    Attributes
    ----------
    kind, kinds:
        Its kind in the singular and in the plural: `kinds` is in the name of the hook that registers it.
    name:
        Unique within its kind; lower case, matching `NAME`.
    summary:
        One line for `qrlsuite list`.
    """

    kind: ClassVar[str]
    kinds: ClassVar[str]

    name: str
    summary: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not NAME.fullmatch(self.name) or len(self.name) > 64:
            raise PluginError(
                f"name {self.name!r} is not usable: lower-case letters, digits and single '-', '_', '.' "
                "between them, beginning with a letter, 64 characters at most"
            )
        if not isinstance(self.summary, str) or not self.summary.strip() or "\n" in self.summary:
            raise PluginError(f"'{self.name}': the summary must be one line of text")

    @property
    def title(self) -> str:
        """The kind and the name in words: `circuit backend 'native'`."""
        return title(type(self), self.name)


@dataclass(frozen=True, slots=True)
class NumericSpec(Spec):
    """Attributes of things that make an entry's numbers.

    Attributes
    ----------
    numerics:
        Only for the suite's own things: raised when its bits change, so that earlier seeds are not continued with it. A
        plugin's code is compared itself, see `qrlsuite.experiment.identity`.
    """

    numerics: int = field(default=1, kw_only=True)


@dataclass(frozen=True, slots=True)
class PictureSpec(Spec):
    """A picture of an environment, drawn by `qrlsuite plot NAME --task TASK`.

    Attributes
    ----------
    draw:
        Reference to `draw(worlds, options) -> matplotlib.figure.Figure`: `worlds` maps the name of each chosen task to
        the options of its environment.
    options:
        Reference to a pydantic dataclass: the picture's own settings, all with defaults.
    """

    draw: str
    options: str


@dataclass(frozen=True, slots=True)
class EnvironmentSpec(NumericSpec):
    """An environment.

    Attributes
    ----------
    options:
        Reference to a pydantic dataclass; its fields are the keyword arguments of the environment.
    gymnasium_id:
        The id under which `gymnasium.make` finds the single environment.
    entry_point:
        Reference to the `gymnasium.Env` class, registered under `gymnasium_id` when it is first needed;
        None where Gymnasium knows the id already.
    vector:
        Reference to `factory(options, num_envs) -> qrlsuite.environment.LaneEnv`; None uses a generic one
        over `gymnasium.make`.
    device:
        Reference to `factory(lanes, device) -> qrlsuite.device.DeviceLanes`, which plays the lanes that `vector` made
        by torch operations on a device; None: steps are NumPy's.
    policies:
        Reference policies for `qrlsuite evaluate`, by name: each a reference to `factory(envs) -> policy`,
        called when all lanes of the `LaneEnv` have been reset, and `policy(observations) -> actions` maps
        observations (num_envs, ...) to actions (num_envs, ...). It may read `envs`, and so know more than
        agents do. Uniformly random actions need no policy.
    pictures:
        Pictures of it for `qrlsuite plot`.
    views:
        Options that change agents' observations alone, neither events nor rewards: a study with looks compares entries
        of tasks that differ in these options only.
    repeats:
        Whether all seeds meet the same episodes on purpose: one, or a fixed cycle of levels. Boards say so.
    made_for:
        The family of models that it was made for, such as `"quantum"`: means over tasks leave such a task out.
    """

    kind, kinds = "environment", "environments"

    options: str
    gymnasium_id: str
    entry_point: str | None = None
    vector: str | None = None
    device: str | None = None
    policies: dict[str, str] = field(default_factory=dict)
    pictures: tuple[PictureSpec, ...] = ()
    views: tuple[str, ...] = ()
    repeats: bool = False
    made_for: str = ""


@dataclass(frozen=True, slots=True)
class ModelSpec(NumericSpec):
    """A function approximator.

    Attributes
    ----------
    family:
        `"classical"` or `"quantum"`; selects family-dependent presets of a task.
    options:
        Reference to a pydantic dataclass. If it has a method `check()`, it is called on options that a user typed, and
        may refuse them (`OptionError`) before anything is trained.
    build:
        Reference to `build(obs_dim, out_dim, options, generator) -> torch.nn.Module`, an ordinary
        single-agent module (B, obs_dim) -> (B, out_dim), every random number drawn from `generator`
        (a `torch.Generator`). A parameter `space` gets the space of the observations before they were flattened, such
        as an image's, and a parameter `role` the purpose of the network, such as `"critic"`: see
        `qrlsuite.algorithm.BuildModel`.
    population:
        Reference to `population(modules, options) -> torch.nn.Module`: S built modules as one that maps
        (S, B, in) to (S, B, out), its parameters named as in one module with a leading axis S. None uses
        `qrlsuite.population.stack`.
    faster, speedup:
        Name of a model that computes the same function much faster, and by how much: `run` says so before it trains.
    quick:
        Seeds and epochs of `run --quick`: at most two minutes of two cores.
    backends:
        Whether it is a model for each circuit backend, of plugins too: registered as `NAME-BACKEND`, with the options
        `options["BACKEND"]`, which `qrlsuite.circuit.options_on` makes.
    numerics_on:
        `numerics` by backend, where the bits of its model on one changed alone.
    shared:
        Names of parameters that are equal in all seeds at first, such as fixed features. Boards say so.
    """

    kind, kinds = "model", "models"

    family: Literal["classical", "quantum"]
    options: str
    build: str
    population: str | None = None
    faster: str | None = None
    speedup: str = "much faster"
    quick: tuple[int, int] = (8, 10)
    backends: bool = False
    numerics_on: Mapping[str, int] = field(default_factory=dict)
    shared: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Spec.__post_init__(self)
        if not isinstance(self.shared, tuple | list) or not all(
            isinstance(name, str) for name in self.shared
        ):
            raise PluginError(
                f"model '{self.name}': shared = {self.shared!r} must name parameters, in a tuple of texts"
            )
        if self.family not in ("classical", "quantum"):
            raise PluginError(
                f"model '{self.name}': family {self.family!r} is neither 'classical' nor 'quantum'"
            )

    def on(self, backend: CircuitBackendSpec) -> ModelSpec:
        """Return the model of one circuit backend."""
        name = f"{self.name}-{backend.name}"
        return replace(
            self,
            name=name,
            summary=f"{self.summary}; backend: {backend.summary.partition(';')[0]}",
            options=f"{self.options}[{backend.name}]",
            faster=None if name == self.faster else self.faster,
            speedup=backend.speedup or self.speedup,
            quick=backend.quick or self.quick,
            numerics=self.numerics_on.get(backend.name, self.numerics),
            backends=False,
        )


@dataclass(frozen=True, slots=True)
class AlgorithmSpec(NumericSpec):
    """A learning algorithm: one file with an options dataclass and a class (see `qrlsuite.algorithm`).

    Attributes
    ----------
    options:
        Reference to a pydantic dataclass.
    factory:
        Reference to the class: see `qrlsuite.algorithm.Algorithm`.
    actions:
        The kinds of actions that it takes: some of `qrlsuite.actions.KINDS`.
    starting_values:
        Values of options that a task's preset leaves out, and of the quick look `--task gym:ID`.
    unusable:
        Reference to `unusable(options, epochs, rounds, environments) -> list[str]`: sentences about options that are of
        no use in a run of so many epochs. An epoch has `rounds` steps of each of a seed's `environments`. `options` are
        the values by name, and as `episode` the most steps of an episode, None where unknown. Boards call it, so its
        module imports no torch. None says nothing.
    """

    kind, kinds = "algorithm", "algorithms"

    options: str
    factory: str
    actions: tuple[str, ...] = field(default=("discrete",), kw_only=True)
    starting_values: Mapping[str, Any] = field(default_factory=dict, kw_only=True, hash=False)
    unusable: str | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        Spec.__post_init__(self)
        known = ("discrete", "multi-discrete", "multi-binary", "box")
        if not self.actions or not set(self.actions) <= set(known):
            raise PluginError(
                f"algorithm '{self.name}': actions = {self.actions!r} must name some of {', '.join(known)}, in a tuple"
            )

    def useless(
        self,
        options: Mapping[str, Any],
        environment_options: Mapping[str, Any],
        epochs: int,
        rounds: int,
        environments: int,
    ) -> list[str]:
        """Return the sentences of `unusable` on a run; of an episode's length, by the environment's own option."""
        if self.unusable is None:
            return []
        episode = environment_options.get("max_episode_steps") or environment_options.get("steps")
        return list(resolve(self.unusable)({**options, "episode": episode}, epochs, rounds, environments))


@dataclass(frozen=True, slots=True)
class TaskSpec(Spec):
    """A benchmark task: `path` names its TOML file."""

    kind, kinds = "task", "tasks"

    path: str


@dataclass(frozen=True, slots=True)
class StudySpec(Spec):
    """A study: entries and their pictures, for `qrlsuite study run NAME`.

    Attributes
    ----------
    path:
        Its TOML file (see `qrlsuite.studies.study`).
    """

    kind, kinds = "study", "studies"

    path: str


@dataclass(frozen=True, slots=True)
class AnsatzSpec(NumericSpec):
    """A circuit family: `build(qubits, layers, options) -> qrlsuite.circuit.Circuit`.

    Attributes
    ----------
    qubits:
        Of a circuit of one size: its number of qubits, which models take, with 1 layer, where neither is set.
    """

    kind, kinds = "ansatz", "ansatzes"

    options: str
    build: str
    qubits: int | None = None

    @property
    def size(self) -> dict[str, int]:
        """The size of a circuit of one size, as options of a model; empty for any other."""
        return {} if self.qubits is None else {"qubits": self.qubits, "layers": 1}


@dataclass(frozen=True, slots=True)
class CircuitBackendSpec(NumericSpec):
    """Something that computes expectation values of a circuit, differentiably, in torch.

    Attributes
    ----------
    options:
        Reference to a pydantic dataclass.
    factory:
        Reference to `factory(circuit, options) -> backend`, see `qrlsuite.circuit.api.CircuitBackend`.
    mean_field, products:
        Whether it computes `Circuit.mean_field` too, and measures products of Pauli Z (`Circuit.measured`); where not,
        such a circuit is refused before it gets there.
    max_qubits:
        How many qubits it computes together; None stands for any number. A circuit in which gates or observables
        connect more is refused, and one with more that are not connected is given to it in parts.
    speedup, quick:
        Of its models, see `ModelSpec`; None: as theirs.
    """

    kind, kinds = "circuit_backend", "circuit_backends"

    options: str
    factory: str
    mean_field: bool = False
    products: bool = False
    max_qubits: int | None = 20
    speedup: str | None = None
    quick: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        Spec.__post_init__(self)
        most = self.max_qubits
        if most is not None and (isinstance(most, bool) or not isinstance(most, int) or most < 1):
            raise PluginError(
                f"circuit backend '{self.name}': max_qubits = {most!r} must be a number of qubits, or None for any"
            )


@dataclass(frozen=True, slots=True)
class RuleSpec(Spec):
    """A rule that decides, per (epsilon, delta) cell, whether one entry needs significantly fewer samples.

    Attributes
    ----------
    factory:
        Reference to a class or function that, called without arguments, returns a rule: see
        `qrlsuite.statistics.SignificanceRule`.
    """

    kind, kinds = "rule", "rules"

    factory: str


@dataclass(frozen=True, slots=True)
class EngineSpec(Spec):
    """Where groups of seeds run.

    Attributes
    ----------
    factory:
        Reference to `factory(options) -> engine`, see `qrlsuite.engine.api.Engine`.
    options:
        Reference to the class of its options, None where it has none.
    extras:
        Packages that it needs: the pip command by the name of the module.
    submits:
        Whether `run` hands the groups to a queue and returns: there is then nothing to watch or to interrupt.
    remote:
        Whether groups run on other machines: this one's memory, devices and speed then say nothing about them.
    """

    kind, kinds = "engine", "engines"

    factory: str
    options: str | None = None
    extras: dict[str, str] = field(default_factory=dict)
    submits: bool = False
    remote: bool = False


@dataclass(frozen=True, slots=True)
class TrackerSpec(Spec):
    """A tracker that watches a run on request: `qrlsuite run --track NAME`, or `--track NAME=TARGET`.

    Attributes
    ----------
    factory:
        Reference to `factory(target) -> tracker`, called once in every worker. `target` is the text after the
        equals sign, or None. `qrlsuite.training.trackers` defines a tracker.
    extras:
        Packages that it needs: the pip command by the name of the module.
    always:
        Whether it watches every run, without a request.
    """

    kind, kinds = "tracker", "trackers"

    factory: str
    extras: dict[str, str] = field(default_factory=dict)
    always: bool = False


KINDS: dict[str, type[Spec]] = {
    spec.kinds: spec
    for spec in (
        EnvironmentSpec, ModelSpec, AlgorithmSpec, TaskSpec, AnsatzSpec, CircuitBackendSpec, RuleSpec, EngineSpec,
        StudySpec, TrackerSpec,
    )
}  # fmt: skip
"""Every kind by its plural: a spec that is listed here has a hook, a listing, a page and checks."""


def kind(word: str) -> type[Spec]:
    """Return the kind that a word names, in the singular or the plural: `model`, `circuit-backends`."""
    known = {name: spec for spec in KINDS.values() for name in (spec.kind, spec.kinds)}
    name = word.replace("-", "_")
    if name not in known:
        raise UnknownNameError(f"unknown kind '{word}'{nearest(word, known)}")
    return known[name]


def title(kind: type[Spec], name: str) -> str:
    """Return a thing's name in messages: `circuit backend 'native'`."""
    return f"{kind.kind.replace('_', ' ')} '{name}'"
