"""Rules of every registered thing: name, references, options, imports."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import json
from collections.abc import Callable, Mapping
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, TypeVar

from qrlsuite import options as option_values
from qrlsuite import registry, specs
from qrlsuite.errors import OptionError
from qrlsuite.experiment.task import load as load_task
from qrlsuite.testing.findings import Checklist, Finding, require
from qrlsuite.testing.fresh import HEAVY, fresh_process

REFERENCES = ("options", "build", "factory", "population", "vector", "entry_point", "unusable")


@dataclasses.dataclass(frozen=True)
class Subject:
    """The thing to be checked: a spec, its distribution and its settings.

    Attributes
    ----------
    modules:
        The plugin modules of its distribution; empty for a spec that nothing registered.
    settings:
        Values of options with which it is checked.
    """

    spec: specs.Spec
    distribution: str | None
    modules: tuple[str, ...]
    settings: Mapping[str, Any]

    def references(self) -> dict[str, str]:
        """Return the references of the spec by field; references inside a field are called `FIELD.NAME`."""
        references = {field: getattr(self.spec, field, None) for field in REFERENCES}
        if isinstance(self.spec, specs.EnvironmentSpec):
            references |= {f"policies.{name}": reference for name, reference in self.spec.policies.items()}
            for picture in self.spec.pictures:
                for part in ("draw", "options"):
                    references[f"pictures.{picture.name}.{part}"] = getattr(picture, part)
        return {field: reference for field, reference in references.items() if reference is not None}

    def options(self) -> Any:
        """Build the options object with the settings."""
        reference = self.references().get("options")
        return (
            None
            if reference is None
            else option_values.build(specs.resolve(reference), self.settings, self.spec.title)
        )

    def per_agent(self) -> dict[str, tuple[Any, Any]]:
        """Return, for every option in which agents of one population may differ, options with two values of it."""
        cls = type(self.options())
        pairs = {}
        for name in sorted(option_values.per_agent(cls)):
            mark = option_values.tuned(cls)[name]
            low, high = (
                option_values.build(cls, {**self.settings, name: value}, self.spec.title)
                for value in (mark.low, mark.high)
            )
            pairs[name] = low, high
        return pairs

    def choices(self) -> dict[str, Subject]:
        """Return, for every other value of the options that list their values, the subject with it, by `NAME=VALUE`."""
        options = self.options()
        return {
            f"{name}={option_values.typed(value)}": dataclasses.replace(
                self, settings={**self.settings, name: value}
            )
            for name, values in option_values.listed_values(type(options)).items()
            if name not in self.settings
            for value in values
            if value != getattr(options, name)
        }

    def counting(self, number: int) -> dict[str, Any]:
        """Return, for every option with a whole number that is not among the settings, options where it is another."""
        cls, counting = type(self.options()), {}
        for name, value in option_values.plain(self.options()).items():
            if type(value) is int and value != number and name not in self.settings:
                with contextlib.suppress(OptionError):  # out of its bounds
                    counting[name] = option_values.build(
                        cls, {**self.settings, name: number}, self.spec.title
                    )
        return counting

    def missing(self) -> str:
        """Return the commands that install missing packages; `""` if none is missing."""
        extras: dict[str, str] = getattr(self.spec, "extras", {})
        return " and ".join(sorted({c for m, c in extras.items() if importlib.util.find_spec(m) is None}))


def subject(
    kind: type[specs.Spec], name_or_spec: str | specs.Spec, settings: Mapping[str, Any] | None = None
) -> Subject:
    """Look up the thing to check.

    Parameters
    ----------
    name_or_spec:
        A registered name, or a spec, registered or not; or for a task its file (`*.toml`).
    settings:
        Values of options. Where there are options `qubits` and `layers` and they are not set, two qubits and one
        layer are taken: conformance shows at the smallest size, and simulators take long at others.
    """
    known = registry.load()
    if kind is specs.TaskSpec and isinstance(name_or_spec, str) and name_or_spec.endswith(".toml"):
        file = load_task(name_or_spec).file
        name_or_spec = specs.TaskSpec(file.name, file.summary, str(Path(name_or_spec).resolve()))
    if isinstance(name_or_spec, str):
        registered = known.get(kind, name_or_spec)
        spec, distribution = registered.spec, registered.distribution
    else:
        spec, distribution = name_or_spec, None
        entry = known.of(kind).get(spec.name)
        if entry is not None and entry.spec == spec:
            distribution = entry.distribution
    modules = () if distribution is None else plugin_modules(distribution)
    made = Subject(spec, distribution, modules, {**_small(spec), **(settings or {})})
    if settings and kind is not specs.AnsatzSpec and "options" not in made.references():
        raise OptionError(f"{spec.title} has no options: leave {', '.join(settings)} out")
    return made


def _small(spec: specs.Spec) -> dict[str, int]:
    if not isinstance(spec, specs.ModelSpec):
        return {}
    try:
        names = option_values.field_names(specs.resolve(spec.options))
    except Exception:  # the rule `references` reports it
        return {}
    return {name: size for name, size in (("qubits", 2), ("layers", 1)) if name in names}


def plugin_modules(distribution: str) -> tuple[str, ...]:
    """Return the names of a distribution's plugin modules."""
    named = registry.load().manager.list_name_plugin()
    prefix = f"{distribution}:"
    return tuple(sorted(name.removeprefix(prefix) for name, _ in named if name.startswith(prefix)))


def check_common(subject: Subject) -> tuple[list[Finding], bool]:
    """Check the rules of every registered thing; returns the findings, and whether further rules can be checked."""
    rules = Checklist()
    rules.run("name", "unique among what is installed", lambda: _name(subject))
    usable = rules.run("references", "every reference leads to code", lambda: _references(subject))
    if subject.modules:
        rules.run("lazy imports", f"registering imports none of {', '.join(HEAVY)}", lambda: _lazy(subject))
    rules.run(
        "spawn",
        "a fresh process finds the code; specs and options can be sent there",
        lambda: _spawn(subject),
    )
    if usable and "options" in subject.references():
        rules.run("options documented", "every option has a description", lambda: _documented(subject))
        usable = rules.run(
            "options", "defaults are valid, frozen, and survive being stored", lambda: _options(subject)
        )
    return rules.findings, usable


Case = TypeVar("Case")


def check_cases(rules: Checklist, cases: Mapping[str, Case], check: Callable[[Case], object]) -> None:
    """Run a short check on each case, by its name; it holds, or the case is refused in words.

    Nothing is tried where a rule is broken: the cases would break it, too.
    """

    def once(case: Case) -> str | None:
        try:
            check(case)
        except OptionError as error:
            return f"refused: {error}"
        return None

    for name, case in cases.items() if all(each.ok for each in rules.findings) else ():
        rules.run(name, "tried by itself", functools.partial(once, case))


def _name(subject: Subject) -> None:
    registered = registry.load()
    key = type(subject.spec), subject.spec.name
    owners = [f"{each.distribution} ({each.place})" for each in registered.duplicates.get(key, [])]
    require(
        not owners,
        f"{subject.spec.title} is registered by both {' and '.join(owners)}: give yours another name",
    )
    entry = registered.of(key[0]).get(key[1])
    if entry is not None:
        require(
            entry.spec == subject.spec,
            f"{subject.spec.title} is already registered by '{entry.distribution}': give yours another name",
        )


def _references(subject: Subject) -> None:
    for field, reference in subject.references().items():
        try:
            target = specs.resolve(reference)
        except Exception as error:
            require(
                False,
                f"{field} = {reference!r}: {error}; "
                + (subject.missing() or "is the name spelled as in the file, and the package installed?"),
            )
        require(
            callable(target), f"{field} = {reference!r} is {type(target).__name__}, and it must be callable"
        )
        if _is_options(field):
            require(
                isinstance(target, type) and dataclasses.is_dataclass(target),
                f"{field} = {reference!r} is not a dataclass: write a class under @pydantic.dataclasses.dataclass",
            )


def _is_options(field: str) -> bool:
    return field.rpartition(".")[2] == "options"


def _all_references(subject: Subject) -> tuple[str, ...]:
    """Return the references of the subject's whole distribution, so that one process serves all of them."""
    references = set(subject.references().values())
    if subject.distribution is not None:
        for entry in registry.load():
            if entry.distribution == subject.distribution:
                references |= set(Subject(entry.spec, None, (), {}).references().values())
    return tuple(sorted(references))


def _lazy(subject: Subject) -> None:
    result = fresh_process(subject.modules, _all_references(subject))
    require(
        not result["heavy"],
        f"registering imports {', '.join(result['heavy'])}: move that import from the top of "
        f"{' or '.join(subject.modules)} into the file that the reference names, so that commands start at once",
    )


def _spawn(subject: Subject) -> None:
    result = fresh_process(subject.modules, _all_references(subject))
    require(
        "crash" not in result,
        f"a fresh process, as workers are, ends when it imports the plugin: {result.get('crash')}",
    )
    for module, error in result["modules"].items():
        require(False, f"plugin module '{module}' fails in a fresh process: {error}")
    for reference in subject.references().values():
        error = result["references"].get(reference)
        require(
            error is None,
            f"{reference!r} cannot be resolved in a fresh process, as workers are: {error}; code must lie in an "
            "importable file, not in __main__, a notebook or a module made at run time",
        )
    try:
        ForkingPickler.dumps(subject.spec)
    except Exception as error:
        require(
            False, f"the spec cannot be pickled: {error}; specs hold text, references instead of functions"
        )
    options = subject.references().get("options")
    if options is not None:
        cls = specs.resolve(options)
        try:
            built = option_values.build(cls, subject.settings, subject.spec.title)
        except Exception:  # the rule `options` reports it
            return
        try:
            ForkingPickler.dumps(built)
        except Exception as error:
            require(
                False,
                f"options cannot be pickled: {error}; keep plain values in them, no functions or files, and the class "
                "at the top of its file",
            )


def _documented(subject: Subject) -> None:
    for field, reference in subject.references().items():
        if not _is_options(field):
            continue
        rows = option_values.describe(specs.resolve(reference))
        silent = [row["name"] for row in rows if not str(row["description"]).strip()]
        require(
            not silent,
            f"{reference.partition(':')[2]} has no description of {', '.join(silent)}; write name: Annotated[int, "
            "Field(description='...')] = 3, which `qrlsuite show` prints",
        )


def _options(subject: Subject) -> None:
    cls = specs.resolve(subject.references()["options"])
    try:
        defaults = option_values.build(cls, {}, subject.spec.title)
    except Exception as error:
        require(False, f"the defaults are not valid: {error}; every option needs a default that works")
    for options in (defaults, subject.options()):
        _stored(subject, cls, options)
    for name in option_values.field_names(cls):
        try:
            setattr(defaults, name, getattr(defaults, name))
        except Exception:
            continue
        require(
            False,
            f"option '{name}' can be assigned to: write @dataclass(frozen=True), for options are identity",
        )


def _stored(subject: Subject, cls: type[Any], options: Any) -> None:
    """Require that options can be stored, and read again unchanged."""
    for name in option_values.field_names(cls):
        require(
            not _has_set(getattr(options, name)),
            f"option '{name}' holds a set, whose order is another one in every process, and so would be the name under "
            "which results are kept: use a tuple",
        )
    try:
        plain = json.loads(json.dumps(option_values.plain(options), allow_nan=False))
    except ValueError as error:
        require(
            False,
            f"options cannot be stored as JSON: {error}; keep plain values in them, for nan, infinity and objects "
            "have no JSON form",
        )
    try:
        again = option_values.build(cls, plain, subject.spec.title)
    except Exception as error:
        require(
            False,
            f"options stored cannot be read again: {error}; defaults are not validated: is one outside its own bounds, "
            "or of another type?",
        )
    require(
        again == options,
        f"options stored and read again differ: {options} became {again}; is a value changed when it is read?",
    )


def _has_set(value: Any) -> bool:
    """Tell whether there is a set inside a value, at any depth."""
    if dataclasses.is_dataclass(value):
        value = [getattr(value, each.name) for each in dataclasses.fields(value)]
    if isinstance(value, Mapping):
        value = list(value.values())
    return isinstance(value, set | frozenset) or (
        isinstance(value, list | tuple) and any(_has_set(each) for each in value)
    )
