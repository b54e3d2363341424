"""Descriptions for `qrlsuite show` of everything that has a name, as plain values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qrlsuite import circuit, registry, specs
from qrlsuite.circuit import drawing, export, lightcone, resources
from qrlsuite.circuit.description import canonical
from qrlsuite.circuit.resources import LARGEST_RANK, jacobian_rank
from qrlsuite.errors import OptionError, UnknownNameError, nearest
from qrlsuite.experiment import catalog, identity
from qrlsuite.experiment.task import is_quick, is_task_file
from qrlsuite.leaderboard import pictures, rules
from qrlsuite.leaderboard.pictures import compose
from qrlsuite.leaderboard.shelf import collect, published_studies
from qrlsuite.leaderboard.shelf import published as published_entries
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.results import codes, lookup
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, entries, write_atomically
from qrlsuite.results.survey import outline

if TYPE_CHECKING:
    from qrlsuite.studies.runner import Overview
    from qrlsuite.studies.state import State
    from qrlsuite.studies.together import StudiesTogether

PICTURE = "picture"
"""The one kind that nothing registers."""


def describe(
    name: str,
    kind: str | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    code: bool = False,
    out: Path | None = None,
    format: str | None = None,
    runs: str | PathLike[str] = "runs",
    published: bool = False,
) -> dict[str, Any] | Overview | State | StudiesTogether:
    """Describe a registered thing, a picture, an entry or a study.

    Parameters
    ----------
    name:
        Name of the thing; for an entry also its label or folder, for a study its file or folder.
    kind:
        `model`, `ansatz`, ...; None looks among all.
    settings:
        For an ansatz: its options, `qubits` and `layers`.
    code:
        Describe the code identity, and its parts.
    out, format:
        For an ansatz: a file for its drawing; the language of a program (`qasm3`, `qiskit`, `pennylane`). For a task,
        the format may be `toml`: its file, to be saved and changed.
    runs, published:
        As for `load`.

    Returns
    -------
    dict or Overview or State or StudiesTogether
        For a study the result of `read_study`.
    """
    if sum(map(bool, (code, out, format))) > 1:
        raise OptionError("give one of --identity, --out and --format")
    folder = Path(runs)
    among = [] if kind == PICTURE else [specs.kind(kind)] if kind else list(specs.KINDS.values())
    if specs.StudySpec in among and is_study(name):
        among = [specs.StudySpec]
    registered = registry.load()
    found = [each for each in among if name in registered.of(each)]
    unregistered = name.startswith("gym:") or name.endswith(".toml")
    if (among == [specs.TaskSpec] and is_quick(name)) or (unregistered and specs.TaskSpec in among):
        found = [specs.TaskSpec]
    if specs.StudySpec in (*found[:1], *among[:1]) and len(found) < 2:
        from qrlsuite.api.studies import read_study  # slow to import, and nothing else needs it

        if settings or format or code:
            raise OptionError(
                f"study '{name}' takes no NAME=VALUE, --format or --identity here; --json prints it for scripts"
            )
        return read_study(name, runs=folder, published=published)
    if kind in (None, PICTURE) and not found and name in compose.summaries():
        _refuse(f"picture '{name}'", settings, out, format)
        if code:
            raise OptionError(f"picture '{name}' computes nothing for an entry, so it has no code identity")
        return compose.describe(name)
    if not found and kind is None and (store := _stored(Selection(folder, published), name)):
        _refuse(f"entry '{name}'", settings, out, format)
        return _code_of_entry(store) if code else _outline(store)
    if not found:
        names = [each for spec in among for each in registered.of(spec)] or list(compose.summaries())
        names += published_studies.names() if specs.StudySpec in among else []
        more = " (--published looks among the published entries, too)" if kind is None else ""
        raise UnknownNameError(f"nothing called '{name}'{nearest(name, names)}{more}")
    if len(found) > 1:
        singulars = " or ".join(f"`show {each.kind} {name}`" for each in found)
        raise UnknownNameError(f"'{name}' is several things; write {singulars}")
    if found == [specs.TaskSpec] and format == "toml" and not (settings or out):
        return {"format": format, "text": catalog.task_file(name)}
    if found == [specs.AnsatzSpec]:
        return _ansatz(name, settings or {}, code, out, format)
    _refuse(specs.title(found[0], name), settings, out, format)
    if code:
        return _code_of_plugin(found[0], name)
    content = catalog.describe(found[0], name)
    return content | ({"promises": rules.load(name).promise} if found[0] is specs.RuleSpec else {})


def _refuse(title: str, *of_ansatz: object) -> None:
    """Raise where something else than an ansatz was asked for what only an ansatz has."""
    if any(of_ansatz):
        raise OptionError(
            f"{title}: NAME=VALUE, --out and --format draw an ansatz; options are changed where they are used, as in "
            "`qrlsuite run --set NAME=VALUE`"
        )


def is_study(name: str) -> bool:
    """Return whether a name can only be a study's: a study file, or a published study or its folder."""
    if name.endswith(".toml"):
        return not is_task_file(Path(name))
    return published_studies.folder_of(name) is not None


def _ansatz(
    name: str, settings: Mapping[str, Any], code: bool, out: Path | None, format: str | None
) -> dict[str, Any]:
    """Describe an ansatz with its drawing and resources; as a program, or its code, where these are asked for."""
    picture_format = pictures.format_of(out, "--out")
    if "name" in settings:
        raise OptionError(f"ansatz '{name}': name: no option of that name")
    sizes = {"qubits": 4, "layers": 2, **registry.get(specs.AnsatzSpec, name).size, **settings}
    drawn = circuit.ansatz(name, **sizes)
    if code:
        return {"circuit text": canonical(drawn), **identity.of_registered(specs.AnsatzSpec, name, drawn)}
    if format is not None:
        return {"format": format, "text": export.export(drawn, format)}
    content = catalog.describe(specs.AnsatzSpec, name) | {"resources": {}}
    for resource, count in dataclasses.asdict(resources.resources(drawn)).items():
        content["resources"][resource] = count
        if resource == "parameters":
            rank = jacobian_rank(drawn)
            text = f"not computed where gates connect more than {LARGEST_RANK} qubits"
            content["resources"]["jacobian_rank"] = text if rank is None else rank
    content["light_cone"] = lightcone.described(
        drawn, lambda layers: circuit.ansatz(name, **{**sizes, "layers": layers})
    )
    if out is not None:
        write_atomically(out, pictures.encode(drawing.draw_figure(drawn), picture_format))
        content["figure"] = str(out)
    return content | {"drawing": str(drawing.draw_text(drawn))}


def _code_of_plugin(kind: type[specs.Spec], name: str) -> dict[str, Any]:
    """Return a registered thing's part of an entry's identity: its files or `numerics`."""
    if not issubclass(kind, specs.NumericSpec):
        raise OptionError(
            f"{specs.title(kind, name)} computes nothing for an entry, so it has no code identity"
        )
    return dict(identity.of_registered(kind, name, None))


def _stored(selection: Selection, name: str) -> EntryStore | None:
    """Find an entry by its folder, or by its name in the results folder; None if nothing fits."""
    if (Path(name) / "entry.json").exists():
        return EntryStore(Path(name))
    if selection.published:
        return EntryStore(collect.find(selection, name).folder)
    runs = selection.runs
    if not runs.is_dir():
        return None
    stored = lookup.stored(entries(runs))
    try:
        return lookup.choose(stored, name, runs).store
    except UnknownNameError:
        if any(lookup.mentions(entry, name) for entry in stored):
            raise
        return None


def _outline(store: EntryStore) -> dict[str, Any]:
    """Return an entry's options and how it was made; a published one has no folders of seeds, but says it itself."""
    content = outline(store)
    if not published_entries.is_published(store.path):
        return content
    made = published_entries.read(store.path)
    return content | {
        "seeds": len(made.seeds),
        "provenance": [origin.content for origin in made.published.provenance],
        "parameters": made.published.parameters,
    }


def _code_of_entry(store: EntryStore) -> dict[str, Any]:
    """Return the steps from an entry's code to its identity, and with which identities its seeds were trained."""
    entry = store.entry()
    now, drawn = identity.of(entry), identity.circuit_of(entry)
    return {
        "label": entry.label,
        **({} if drawn is None else {"circuit": canonical(drawn)}),
        "parts": {f"{part['role']} {part['name']}": dict(part) for part in now.parts},
        "text": now.text,
        "digest": now.digest,
        "seeds": _codes_of_seeds(store),
    }


def _codes_of_seeds(store: EntryStore) -> dict[str, list[str]]:
    """Return the digests of the code of an entry's seeds, or of its record where it is published."""
    if published_entries.is_published(store.path):
        made = published_entries.read(store.path)
        code = made.record.code_identity
        return {format_seeds(made.seeds): ["not recorded" if code is None else code.digest]}
    held = codes.of(store)
    if held is None:
        return {}
    return {format_seeds(store.seeds()): [digest or "not recorded" for digest in held.digests]}
