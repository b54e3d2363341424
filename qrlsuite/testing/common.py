"""Rules for everything that is registered: its name, its references, its options, and how it is imported."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from multiprocessing.reduction import ForkingPickler
from typing import Any

from qrlsuite import options as option_values
from qrlsuite import registry, specs
from qrlsuite.testing.findings import Checklist, Finding, require

HEAVY = ("torch", "pennylane", "qiskit", "numba", "gymnasium", "scipy", "matplotlib", "jax", "tensorflow")
"""Packages that take long to import, and so must wait until a command needs them."""

REFERENCES = ("options", "build", "factory", "population", "vector", "entry_point")

_FRESH = """
import importlib, json, sys
from multiprocessing.reduction import ForkingPickler
from qrlsuite import registry, specs
modules, references, heavy = json.loads(sys.argv[1])
result = {"heavy": [], "references": {}, "modules": {}}
found = []
for name in modules:
    try:
        plugin = importlib.import_module(name)
        for kind in registry.KINDS:
            hook = getattr(plugin, "register_" + kind, None)
            if hook is not None:
                hook(register=found.append)
    except Exception as error:
        result["modules"][name] = f"{type(error).__name__}: {error}"
result["heavy"] = [name for name in heavy if name in sys.modules]
for spec in found:
    ForkingPickler.dumps(spec)
for reference in references:
    try:
        specs.resolve(reference)
        result["references"][reference] = None
    except Exception as error:
        result["references"][reference] = f"{type(error).__name__}: {error}"
print(json.dumps(result))
"""


@dataclasses.dataclass(frozen=True)
class Subject:
    """What is checked: a spec, and where it comes from.

    Attributes
    ----------
    modules:
        The plugin modules of its distribution; empty for a spec that nothing registered.
    settings:
        Values of options with which it is checked.
    """

    kind: str
    spec: specs.Spec
    distribution: str | None
    modules: tuple[str, ...]
    settings: Mapping[str, Any]

    @property
    def title(self) -> str:
        """The thing in words: `model 'mlp'`."""
        return f"{registry.SINGULAR[self.kind].replace('_', ' ')} '{self.spec.name}'"

    def references(self) -> dict[str, str]:
        """Return the references of the spec by field."""
        found = {field: getattr(self.spec, field, None) for field in REFERENCES}
        return {field: reference for field, reference in found.items() if reference is not None}

    def options(self) -> Any:
        """Build the options object with the settings."""
        reference = self.references().get("options")
        return (
            None
            if reference is None
            else option_values.build(specs.resolve(reference), self.settings, self.title)
        )

    def missing(self) -> str:
        """Return what to type for packages that it needs and that are not installed; `""` where all are there."""
        extras: dict[str, str] = getattr(self.spec, "extras", {})
        return " and ".join(sorted({c for m, c in extras.items() if importlib.util.find_spec(m) is None}))


def subject(kind: str, given: str | specs.Spec, settings: Mapping[str, Any] | None = None) -> Subject:
    """Look up what is to be checked.

    Parameters
    ----------
    kind:
        A key of `registry.KINDS`.
    given:
        A registered name, or a spec, registered or not.
    settings:
        Values of options. Where there are options `qubits` and `layers` and they are not set, two qubits and one
        layer are taken: conformance shows at the smallest size, and simulators take long at others.

    Raises
    ------
    UnknownNameError, PluginError
        If nothing or more than one thing has that name.
    """
    known = registry.load()
    if isinstance(given, str):
        found = known.get(kind, given)
        spec, distribution = found.spec, found.distribution
    else:
        spec, distribution = given, None
        entry = known.entries[kind].get(spec.name)
        if entry is not None and entry.spec == spec:
            distribution = entry.distribution
    modules = () if distribution is None else plugin_modules(distribution)
    return Subject(kind, spec, distribution, modules, {**_small(spec), **(settings or {})})


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


@functools.cache
def fresh_process(modules: tuple[str, ...], references: tuple[str, ...]) -> dict[str, Any]:
    """Import plugin modules, call their hooks and resolve references in a new interpreter.

    Returns
    -------
    dict
        `modules`: errors by module; `heavy`: heavy packages that registering imported; `references`: error or
        None by reference; `crash`: the last line of stderr, where the interpreter itself failed.
    """
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _FRESH, json.dumps([modules, references, HEAVY])],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path},
    )
    empty: dict[str, Any] = {"modules": {}, "heavy": [], "references": {}}
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        return {**empty, "crash": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    return {**empty, **json.loads(lines[-1])}


def check_common(subject: Subject) -> tuple[list[Finding], bool]:
    """Check what every registered thing keeps to; returns the findings and whether the rest can be checked."""
    rules = Checklist()
    rules.run("name", "unique among what is installed", lambda: _name(subject))
    usable = rules.run("references", "every reference leads to code", lambda: _references(subject))
    rules.run("lazy imports", f"registering imports none of {', '.join(HEAVY)}", lambda: _lazy(subject))
    rules.run(
        "spawn",
        "a fresh process finds the code; specs and options can be sent there",
        lambda: _spawn(subject),
    )
    if usable and "options" in subject.references():
        rules.run("options documented", "every option has a description", lambda: _documented(subject))
        usable = rules.run(
            "options", "defaults are valid, strict, and survive being stored", lambda: _options(subject)
        )
    return rules.findings, usable


def _name(subject: Subject) -> None:
    known = registry.load()
    owners = known.duplicates.get((subject.kind, subject.spec.name), [])
    require(
        not owners,
        f"{subject.title} is registered by both {' and '.join(owners)}: give yours another name",
    )
    entry = known.entries[subject.kind].get(subject.spec.name)
    require(
        entry is None or entry.spec == subject.spec,
        f"{subject.title} is already registered by '{entry.distribution if entry else ''}': give yours another name",
    )


def _references(subject: Subject) -> None:
    for field, reference in subject.references().items():
        try:
            found = specs.resolve(reference)
        except Exception as error:
            require(
                False,
                f"{field} = {reference!r}: {error}; "
                + (subject.missing() or "is the name spelled as in the file, and the package installed?"),
            )
        require(
            callable(found), f"{field} = {reference!r} is {type(found).__name__}, and it must be callable"
        )
        if field == "options":
            require(
                isinstance(found, type) and dataclasses.is_dataclass(found),
                f"options = {reference!r} is not a dataclass: write a class under @pydantic.dataclasses.dataclass",
            )


def _all_references(subject: Subject) -> tuple[str, ...]:
    """Return the references of the subject's whole distribution, so that one process serves all of them."""
    found = set(subject.references().values())
    if subject.distribution is not None:
        for kind, entry in registry.load():
            if entry.distribution == subject.distribution:
                found |= set(Subject(kind, entry.spec, None, (), {}).references().values())
    return tuple(sorted(found))


def _lazy(subject: Subject) -> None:
    result = fresh_process(subject.modules, _all_references(subject))
    require(
        not result["heavy"],
        f"registering imports {', '.join(result['heavy'])}: move that import from the top of "
        f"{' or '.join(subject.modules)} into the file that the reference names, so that commands start at once",
    )


def _spawn(subject: Subject) -> None:
    result = fresh_process(subject.modules, _all_references(subject))
    require("crash" not in result, f"a fresh process fails: {result.get('crash')}")
    for module, error in result["modules"].items():
        require(False, f"plugin module '{module}' fails in a fresh process: {error}")
    for reference in subject.references().values():
        error = result["references"].get(reference)
        require(
            error is None,
            f"{reference!r} cannot be resolved in a fresh process, as workers are: {error}; code must lie in an "
            "importable file, not in __main__, a notebook or a module made at run time",
        )
    ForkingPickler.dumps(subject.spec)
    options = subject.references().get("options")
    if options is not None:
        cls = specs.resolve(options)
        try:
            made = option_values.build(cls, subject.settings, subject.title)
        except Exception:  # the rule `options` reports it
            return
        try:
            ForkingPickler.dumps(made)
        except Exception as error:
            require(
                False, f"options cannot be pickled: {error}; keep plain values in them, no functions or files"
            )


def _documented(subject: Subject) -> None:
    rows = option_values.describe(specs.resolve(subject.references()["options"]))
    silent = [row["name"] for row in rows if not str(row["description"]).strip()]
    require(
        not silent,
        f"no description: {', '.join(silent)}; write name: Annotated[int, Field(description='...')] = 3, "
        "which `qrlsuite show` prints",
    )


def _options(subject: Subject) -> None:
    cls = specs.resolve(subject.references()["options"])
    try:
        option_values.build(cls, {}, subject.title)
    except Exception as error:
        require(False, f"the defaults are not valid: {error}; every option needs a default that works")
    made = subject.options()
    try:
        plain = json.loads(json.dumps(option_values.plain(made), allow_nan=False))
    except ValueError as error:
        require(False, f"options cannot be stored as JSON: {error}; nan and infinity have no JSON form")
    again = option_values.build(cls, plain, subject.title)
    require(
        again == made,
        f"options stored and read again differ: {made} became {again}; is a value changed when it is read?",
    )
    for field in option_values.field_names(cls):
        try:
            setattr(made, field, getattr(made, field))
        except Exception:
            continue
        require(
            False,
            f"option '{field}' can be assigned to: write @dataclass(frozen=True), for options are identity",
        )
