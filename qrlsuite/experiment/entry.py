"""An entry: one algorithm with one model on one task, every option resolved; the unit that is ranked.

Its hash covers the task definition, the algorithm, the model and all their options: not seeds, epochs, device,
engine, workers or versions. More epochs extend an entry, more seeds widen it. An option that a later version added
(`qrlsuite.options.Since`) is covered where it does not have its default.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from qrlsuite import notation, options, registry, specs
from qrlsuite.errors import OptionError
from qrlsuite.experiment import preset as presets
from qrlsuite.experiment import script as scripts
from qrlsuite.experiment.script import SCRIPT, Script
from qrlsuite.experiment.task import EXTERNAL, Nothing, Task, digest, load
from qrlsuite.notation import Written
from qrlsuite.options import Setting

START_FORM = re.compile(r"[a-z0-9][a-z0-9+._-]*/[a-z0-9][a-z0-9+._@-]*:[1-9][0-9]{0,8}")
"""Where training begins, see `Entry.start`."""


@dataclass(frozen=True)
class Entry:
    """A resolved entry.

    Attributes
    ----------
    preset:
        The preset that supplied defaults; not part of the identity, its values are.
    tuning:
        How the settings were found, where their preset says so; not part of the identity either.
    study:
        Hash of the study with looks that trains it, where one does; not part of the identity either.
    start:
        `TASK/ENTRY:EPOCHS` if training begins with the agents of another entry after so many epochs, seed k with that
        entry's seed k; part of the identity.
    folder:
        Where a script's command is started; set if it was typed in this call or stands in the study file that this call
        names. Without it, the command is never started.
    """

    task: Task
    algorithm: specs.AlgorithmSpec
    model: specs.ModelSpec
    algorithm_options: Any
    model_options: Any
    preset: str | None
    tuning: dict[str, Any] | None = field(default=None, compare=False)
    study: str | None = field(default=None, compare=False)
    start: str | None = None
    folder: Path | None = field(default=None, compare=False)

    @property
    def script(self) -> Script | None:
        """The script that trains it, where one does."""
        return self.algorithm_options if isinstance(self.algorithm_options, Script) else None

    @property
    def epochs(self) -> int:
        """The epochs of a complete run."""
        if self.script is not None:
            return (self.script.steps or 0) // self.task.file.protocol.interactions
        return self.task.epochs(self.algorithm.name)

    def for_epochs(self, epochs: int) -> Entry:
        """Return a script's entry with other steps: schedules depend on them, so it is another entry."""
        steps = epochs * self.task.file.protocol.interactions
        return replace(self, algorithm_options=replace(self.algorithm_options, steps=steps))

    @property
    def identity(self) -> dict[str, Any]:
        """Everything the hash covers, as plain values."""
        return {
            "task": self.task.definition,
            "algorithm": self.algorithm.name,
            "algorithm_options": options.identity(self.algorithm_options),
            "model": self.model.name,
            "model_options": options.identity(self.model_options),
            **({} if self.start is None else {notation.START: self.start}),
        }

    @cached_property
    def hash(self) -> str:
        """Sixteen hexadecimal digits that identify the entry."""
        return digest(self.identity)

    @property
    def population_key(self) -> str:
        """Equal for entries that differ in options per agent only: one population can train their agents.

        See `per_agent` of `qrlsuite.options.Tuned`.
        """
        common = self.identity
        for side, own in (
            ("algorithm_options", self.algorithm_options),
            ("model_options", self.model_options),
        ):
            free = options.per_agent(type(own))
            common[side] = {name: value for name, value in common[side].items() if name not in free}
        return digest(common)

    @property
    def name(self) -> str:
        """The folder's name: algorithm, model, and the first eight digits of the hash."""
        return f"{self.algorithm.name}-{self.model.name}-{self.hash[:8]}"

    @cached_property
    def label(self) -> str:
        """The entry in its notation: the model with its first option and every option that is not the default.

        `resolve` makes the entry of it again, on the same task. Only an option that was added later
        (`qrlsuite.options.Since`) is not written where it has its default, whatever the task's preset says now.
        """
        if self.script is not None:
            usual_steps = self.epochs == self.task.epochs(SCRIPT)
            return f"{SCRIPT} {self.model.name}" + ("" if usual_steps else f" steps={self.script.steps}")
        own = {"model": self.model_options, "algorithm": self.algorithm_options}
        usual = {
            "model": options.plain(specs.resolve(self.model.options)()),
            "algorithm": self._usual_algorithm_options(),
        }
        words = [self.algorithm.name, self.model.name]
        for side, other in (("model", "algorithm"), ("algorithm", "model")):
            taken = {notation.PRESET, notation.START} | {
                name
                for each in (own[other], self.task.environment_options)
                for name in options.field_names(type(each))
            }
            for index, (name, value) in enumerate(options.identity(own[side]).items()):
                if value == usual[side].get(name) and not (side == "model" and index == 0):
                    continue
                if name == "ansatz_options" and value and not usual[side].get(name):
                    other_names = {*taken, *options.field_names(type(own[side]))}
                    for key, item in value.items():
                        full = f"ansatz.{key}" if key in other_names else key
                        words.append(notation.write_setting(full, item))
                else:
                    full = f"{side}.{name}" if name in taken else name
                    words.append(notation.write_setting(full, value))
        if self.start is not None:
            words.append(notation.write_setting(notation.START, self.start))
        return " ".join(words)

    def _usual_algorithm_options(self) -> options.Values:
        """Return the algorithm's options as the task's default preset has them, later ones at their defaults."""
        _, values = self.task.preset(None, self.algorithm.name, self.model.family)
        cls = specs.resolve(self.algorithm.options)
        covered = {k: v for k, v in values.items() if k not in options.later(cls)}
        return options.plain(options.build(cls, covered, "preset"))

    def registered(self) -> dict[str, registry.Registered[specs.NumericSpec]]:
        """Return the parts that make the entry's numbers, by role: environment, algorithm and model.

        Where the model has them, its `ansatz` and its circuit `backend`, too.
        """
        if self.script is not None:
            return {}
        known = registry.load()
        named: dict[str, tuple[type[specs.NumericSpec], Any]] = {
            "environment": (specs.EnvironmentSpec, self.task.environment.name),
            "algorithm": (specs.AlgorithmSpec, self.algorithm.name),
            "model": (specs.ModelSpec, self.model.name),
            "ansatz": (specs.AnsatzSpec, getattr(self.model_options, "ansatz", None)),
            "backend": (specs.CircuitBackendSpec, getattr(self.model_options, "backend", None)),
        }
        return {
            role: known.of(kind)[name]
            for role, (kind, name) in named.items()
            if isinstance(name, str) and name in known.of(kind)
        }

    def unusable(self, epochs: int) -> list[str]:
        """Name settings of the algorithm that are of no use in a run of so many epochs, by its own account."""
        protocol, task = self.task.file.protocol, options.plain(self.task.environment_options)
        own = options.plain(self.algorithm_options)
        return self.algorithm.useless(own, task, epochs, protocol.rounds, protocol.environments)

    def distributions(self) -> list[str]:
        """Return the distributions whose code makes the entry's numbers, each once."""
        return list(dict.fromkeys(each.distribution for each in self.registered().values()))

    def third_party(self) -> list[str]:
        """Return the distributions other than this suite, or the script."""
        if self.script is not None:
            return [self.model.name]
        return [name for name in self.distributions() if name != "qrlsuite"]


def resolve(
    task: str | Task,
    entry: str | Written,
    algorithm: str | None = None,
    settings: Sequence[Setting] = (),
    preset: str | None = None,
) -> Entry:
    """Build an entry from its notation.

    Parameters
    ----------
    task:
        Its name or file, or a result of `qrlsuite.experiment.task.load`.
    entry:
        As `qrlsuite.notation.parse_entry` reads it: a model's name alone, or an entry's label.
    algorithm, settings, preset:
        Choices beside the text. A preset is one of the task's, or a file's path (anything that ends in `.toml`).
        A file's values override the task's default preset; settings override both.
    """
    written = entry if isinstance(entry, Written) else notation.parse_entry(entry)
    written = written.given(algorithm, tuple(settings), preset)
    if written.algorithm == EXTERNAL:
        raise OptionError(
            f"'{EXTERNAL} {written.model}' has curves that another program made: they can be compared, not trained"
        )
    if written.start is not None and not START_FORM.fullmatch(written.start):
        raise OptionError(
            f"{notation.START}={written.start}: write TASK/ENTRY:EPOCHS, or run it with --from ENTRY"
        )
    if written.algorithm == SCRIPT:
        if written.preset is not None or written.start is not None:
            raise OptionError(f"script '{written.model}' has no preset, and no agents to begin with")
        values = {each.full_name.removeprefix("algorithm."): each.value for each in written.settings}
        return of_script(task, written.model, scripts.build(written.model, values))
    task = task if isinstance(task, Task) else load(task)
    model = registry.get(specs.ModelSpec, written.model)
    file = _preset_file(written)
    spec = registry.get(
        specs.AlgorithmSpec, written.algorithm or (file.algorithm if file else task.file.default_algorithm)
    )
    sides = option_sides(task, spec, model, written.settings, file.model_options if file else None)
    task.check_presets(spec.name, sides["algorithm"])
    source = _task_preset(task, None if file else written.preset, spec, model)
    if file is not None:
        source = _file_preset(file, written.preset or "", sides, source)
    values = options.assign(written.settings, sides)
    _hand_to_ansatz(values, sides, source.model)
    model_options = options.build(
        sides["model"],
        {**_size(sides, {**source.model, **values["model"]}), **source.model, **values["model"]},
        f"model '{model.name}'",
    )
    if hasattr(model_options, "check"):
        model_options.check()
    return Entry(
        task=task.with_environment(values["environment"]),
        algorithm=spec,
        model=model,
        algorithm_options=options.build(
            sides["algorithm"], {**source.algorithm, **values["algorithm"]}, f"algorithm '{spec.name}'"
        ),
        model_options=model_options,
        preset=source.name,
        tuning=source.record(values),
        start=written.start,
    )


def _size(sides: Mapping[str, type[Any]], values: Mapping[str, Any]) -> dict[str, int]:
    """Return the size of a model's ansatz, if that is a circuit of one size."""
    if "ansatz" not in sides:
        return {}
    chosen = {**options.plain(sides["model"]()), **values}["ansatz"]
    registered = registry.load().of(specs.AnsatzSpec)
    return registered[chosen].spec.size if chosen in registered else {}


def of_script(task: str | Task, name: str, script: Script) -> Entry:
    """Build the entry of a script; without a `folder`, its command is never started."""
    algorithm, model = scripts.parts(name)
    its_task, script = scripts.place(task, script)
    return Entry(its_task, algorithm, model, script, Nothing(), None)


@dataclass(frozen=True)
class _Preset:
    """Values that come before the defaults, and how they were found.

    Attributes
    ----------
    tuned:
        By side the values that the record speaks of.
    """

    name: str | None
    algorithm: Mapping[str, Any]
    model: Mapping[str, Any]
    tuning: presets.TuningRecord | None
    tuned: Mapping[str, Mapping[str, Any]]

    def record(self, values: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
        """Return the record of tuning for an entry with these own values."""
        if self.tuning is None or self.name is None:
            return None
        return presets.record_of(self.tuning, self.name, self.tuned, values)


def _preset_file(written: Written) -> presets.PresetFile | None:
    """Read the preset file that an entry names, if it names one."""
    if written.preset is None or not written.preset.endswith(".toml"):
        return None
    file = presets.load(Path(written.preset))
    presets.require(file, written.preset, written.algorithm or file.algorithm, written.model)
    return file


def _task_preset(
    task: Task, name: str | None, algorithm: specs.AlgorithmSpec, model: specs.ModelSpec
) -> _Preset:
    chosen, values = task.preset(name, algorithm.name, model.family)
    tuning = task.tuning(chosen, algorithm.name, model.family)
    return _Preset(chosen, values, {}, tuning, {"algorithm": values})


def _file_preset(
    file: presets.PresetFile, path: str, sides: Mapping[str, type[Any]], usual: _Preset
) -> _Preset:
    tuned = {"algorithm": file.algorithm_options, "model": file.model_options}
    for side, values in tuned.items():
        options.build(sides[side], values, f"preset file {path}: {side} '{getattr(file, side)}'")
    algorithm = {**usual.algorithm, **file.algorithm_options}
    return _Preset(Path(path).name, algorithm, file.model_options, file.tuning, tuned)


def option_sides(
    task: Task,
    algorithm: specs.AlgorithmSpec,
    model: specs.ModelSpec,
    settings: Sequence[Setting] = (),
    defaults: Mapping[str, Any] | None = None,
) -> dict[str, type[Any]]:
    """Return the options classes among which `--set` finds a name, by side.

    These are `environment`, `model` and `algorithm`; and `ansatz` for a model whose options are `ansatz`, the name of
    one, and `ansatz_options`, a table of that ansatz's own options. An option that such a model has itself and
    hands to its ansatz (class variable `passes_on`) is found at the model only.

    Parameters
    ----------
    settings:
        The settings; `ansatz=NAME` among them chooses the ansatz.
    defaults:
        The model's options where nothing was set, by name; absent ones have the class's defaults.
    """
    own = specs.resolve(model.options)
    sides = {
        "environment": specs.resolve(task.environment.options),
        "model": own,
        "algorithm": specs.resolve(algorithm.options),
    }
    if not {"ansatz", "ansatz_options"} <= set(options.field_names(own)):
        return sides
    chosen = {**options.plain(own()), **(defaults or {})}["ansatz"]
    for setting in settings:
        if setting.name == "ansatz" and setting.side in (None, "model"):
            chosen = setting.value
    if isinstance(chosen, str):  # what is none is refused where the model's options are built
        theirs = specs.resolve(registry.get(specs.AnsatzSpec, chosen).options)
        left = [name for name in options.field_names(theirs) if name not in getattr(own, "passes_on", ())]
        sides["ansatz"] = make_dataclass(theirs.__name__, left)
        _require_not_of_another_ansatz(settings, sides, chosen)
    return sides


def _require_not_of_another_ansatz(
    settings: Sequence[Setting], sides: Mapping[str, type[Any]], chosen: str
) -> None:
    """Refuse an option that only another ansatz has: the list of known names would not say so."""
    option_names = {name for side in sides.values() for name in options.field_names(side)}
    for setting in settings:
        if setting.side is not None or setting.name in option_names:
            continue
        others = [
            f"'{name}'"
            for name in registry.load().names(specs.AnsatzSpec)
            if setting.name
            in options.field_names(specs.resolve(registry.get(specs.AnsatzSpec, name).options))
        ]
        if others:
            raise OptionError(
                f"{setting.written}: no option of that name: ansatz '{chosen}' has none, {', '.join(others)} "
                f"{'has' if len(others) == 1 else 'have'} it" + _control_of_own(setting, chosen)
            )


def _control_of_own(setting: Setting, ansatz: str) -> str:
    """Say how a circuit of a plugin gets controls, where one was asked for."""
    own = registry.load().get(specs.AnsatzSpec, ansatz).distribution != "qrlsuite"
    return "; give its function a parameter `entangled`: docs/controls.md, Controls of your own circuit" * (
        own and setting.name == "entangled"
    )


def _hand_to_ansatz(
    values: dict[str, options.Values], sides: Mapping[str, type[Any]], defaults: Mapping[str, Any]
) -> None:
    """Move options that were set for an ansatz to the model: into its table `ansatz_options`, or to its own option."""
    ansatz_options = values.pop("ansatz", {})
    for name in [name for name in ansatz_options if name in getattr(sides["model"], "passes_on", ())]:
        values["model"][name] = ansatz_options.pop(name)
    table = values["model"].get("ansatz_options", defaults.get("ansatz_options", {}))
    if ansatz_options and isinstance(
        table, Mapping
    ):  # what is no table is refused where the model's options are built
        values["model"]["ansatz_options"] = {**table, **ansatz_options}
