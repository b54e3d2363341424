"""`qrlsuite show`: print options, protocols, circuits and provenance."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite import circuit, registry, specs
from qrlsuite.circuit import drawing, export
from qrlsuite.circuit.description import canonical
from qrlsuite.circuit.resources import LARGEST_RANK, jacobian_rank
from qrlsuite.cli.arguments import JsonOption, PublishedOption, RunsOption
from qrlsuite.engine.terminal import printable_lines, table_console
from qrlsuite.errors import OptionError, UnknownNameError, nearest
from qrlsuite.experiment import identity
from qrlsuite.experiment.catalog import describe
from qrlsuite.leaderboard import pictures, rules
from qrlsuite.leaderboard.shelf import collect, published_studies
from qrlsuite.leaderboard.shelf import published as published_entries
from qrlsuite.options import parse_setting
from qrlsuite.results import codes, lookup
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, entries, write_atomically
from qrlsuite.results.survey import outline
from qrlsuite.studies.outcome import StudyOutcome


def show(
    name: Annotated[
        str,
        typer.Argument(
            help="A task, model, algorithm, environment, ansatz, study, or an entry: name, label or folder."
        ),
    ],
    second: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="With a kind first: `show ansatz iqp`.")
    ] = None,
    qubits: Annotated[
        int | None, typer.Option("--qubits", help="For an ansatz: the number of qubits to draw; default: 4.")
    ] = None,
    layers: Annotated[
        int | None, typer.Option("--layers", help="For an ansatz: the number of layers to draw; default: 2.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="For an ansatz: an option of its own."),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", help="For an ansatz: draw to this picture file.")
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="For an ansatz: print the circuit for others: qasm3, or a program with qiskit or pennylane.",
        ),
    ] = None,
    code: Annotated[
        bool,
        typer.Option(
            "--identity", help="Show the code identity, and what it is taken of: of an entry or a plugin."
        ),
    ] = False,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Show options with their defaults and meaning, a task's protocol, how far a study is, or how an entry was made.

    A study is given by name, or as its file or the folder of a published one. Of a study you see the seeds that are
    finished and what the missing ones will take; of a study with looks what is decided, and what open pairs need.

    Examples: qrlsuite show mlp; qrlsuite show task beam6g; qrlsuite show ansatz iqp --qubits 4;
    qrlsuite show ansatz iqp --format qasm3; qrlsuite show fig7 --published;
    qrlsuite show "cartpole/reinforce mlp" --published
    """
    kind, target = (None, name) if second is None else (specs.kind(name), second)
    if kind in (None, specs.StudySpec) and (target.endswith(".toml") or published_studies.folder_of(target)):
        kind = specs.StudySpec
    known = registry.load()
    among = list(specs.KINDS.values()) if kind is None else [kind]
    kinds = [k for k in among if target in known.of(k)]
    if target.startswith("gym:") and specs.TaskSpec in among:
        kinds = [specs.TaskSpec]
    if kind is specs.StudySpec or kinds == [specs.StudySpec]:
        _show_study(target, runs, published, json_output)
        return
    if not kinds and kind is None:
        folder = _entry_folder(runs, target, published)
        if folder is not None:
            content = _code_of_entry(EntryStore(folder)) if code else _outline(EntryStore(folder))
            typer.echo(json.dumps(content) if json_output else printable_lines(_text(content)))
            return
    if not kinds:
        names = [n for k in among for n in known.of(k)]
        names += published_studies.names()
        more = "; --published looks among the published entries, too" if kind is None else ""
        raise UnknownNameError(f"nothing called '{target}'{nearest(target, names)}{more}")
    if len(kinds) > 1:
        singulars = " or ".join(f"`show {k.kind} {target}`" for k in kinds)
        raise UnknownNameError(f"'{target}' is several things; write {singulars}")
    if code:
        size = (4 if qubits is None else qubits, 2 if layers is None else layers)
        content = _code_of_plugin(kinds[0], target, *size, settings or [])
        typer.echo(json.dumps(content) if json_output else printable_lines(_text(content)))
        return
    content = describe(kinds[0], target)
    if kinds[0] is specs.RuleSpec:
        content["promises"] = rules.load(target).promise
    if kinds[0] is not specs.AnsatzSpec and (
        settings or figure or format or qubits is not None or layers is not None
    ):
        raise OptionError(
            f"{specs.title(kinds[0], target)}: --qubits, --layers, --set, --figure and --format draw an "
            "ansatz; options "
            "are changed where they are used, as in `qrlsuite run --set NAME=VALUE`"
        )
    if kinds[0] is specs.AnsatzSpec:
        size = (4 if qubits is None else qubits, 2 if layers is None else layers)
        if format is not None:
            text = export.export(_circuit(target, *size, settings or []), format)
            typer.echo(json.dumps({"format": format, "text": text}) if json_output else text, nl=json_output)
            return
        content["drawing"] = _draw(target, *size, settings or [], figure, content)
    typer.echo(json.dumps(content) if json_output else printable_lines(_text(content)))


def _show_study(name: str, runs: Path, published: bool, json_output: bool) -> None:
    from qrlsuite import api  # what it needs is slow to import, and nothing else here needs it
    from qrlsuite.cli.commands.study import print_outcome

    found = api.read_study(name, runs=runs, published=published)
    if json_output:
        typer.echo(json.dumps(found.as_dict()))
    elif isinstance(found, StudyOutcome):
        print_outcome(found)
    else:
        table_console().print(found, soft_wrap=True)


def _entry_folder(runs: Path, name: str, published: bool) -> Path | None:
    """Find an entry's folder by path, or by what it is called in the results folder; None where nothing fits.

    Raises
    ------
    UnknownNameError
        If several fit, or none of the published ones does.
    """
    if (Path(name) / "entry.json").exists():
        return Path(name)
    if published:
        return collect.find(runs, name, published).folder
    if not runs.is_dir():
        return None
    stored = lookup.stored(entries(runs))
    try:
        return lookup.choose(stored, name, runs).store.path
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
    said = made.record["published"]
    return {
        **content,
        "seeds": len(made.seeds),
        "provenance": said["provenance"],
        "parameters": said["parameters"],
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
        code = codes.read(made.record, store.path / "entry.json")
        return {format_seeds(made.seeds): ["not recorded" if code is None else code.digest]}
    return {
        format_seeds(group.seeds): [digest or "not recorded" for digest in group.codes]
        for group in codes.of_seeds(store)
    }


def _code_of_plugin(
    kind: type[specs.Spec], name: str, qubits: int, layers: int, settings: list[str]
) -> dict[str, Any]:
    """Return what a registered thing adds to the identity of an entry: its circuit, files or `numerics`.

    Raises
    ------
    OptionError
        If it computes nothing of an entry.
    """
    if not issubclass(kind, specs.NumericSpec):
        raise OptionError(f"{specs.title(kind, name)} computes nothing of an entry, and has no code identity")
    drawn = _circuit(name, qubits, layers, settings) if kind is specs.AnsatzSpec else None
    text = {} if drawn is None else {"circuit text": canonical(drawn)}
    return {**text, **identity.of_registered(kind, name, drawn)}


def _circuit(name: str, qubits: int, layers: int, settings: list[str]) -> circuit.Circuit:
    chosen = {setting.name: setting.value for setting in map(parse_setting, settings)}
    return circuit.ansatz(name, qubits=qubits, layers=layers, **chosen)


def _draw(
    name: str, qubits: int, layers: int, settings: list[str], figure: Path | None, content: dict[str, Any]
) -> str:
    """Draw an ansatz as text (and to a file), and add its resources to the content."""
    format_ = pictures.format_of(figure, "--figure")
    drawn = _circuit(name, qubits, layers, settings)
    counted = dataclasses.asdict(drawing.resources(drawn))
    content["resources"] = {}
    for resource, count in counted.items():
        content["resources"][resource] = count
        if resource == "parameters":
            rank = jacobian_rank(drawn)
            text = f"not computed where gates connect more than {LARGEST_RANK} qubits"
            content["resources"]["jacobian_rank"] = text if rank is None else rank
    if figure is not None:
        write_atomically(figure, pictures.encode(drawing.draw_figure(drawn), format_))
        content["figure"] = str(figure)
    return str(drawing.draw_text(drawn))


def _text(content: dict[str, Any], indent: str = "") -> str:
    """Lay nested content out as indented lines; option tables with their descriptions."""
    lines = []
    for key, value in content.items():
        if key == "set_with":
            continue
        if key == "options" and isinstance(value, list):
            lines.append(
                f"{indent}options (change with {content['set_with']})" if value else f"{indent}options: none"
            )
            for row in value:
                lines.append(f"{indent}  {row['name']} = {_value(row['default'])}    {row['values']}")
                lines.append(f"{indent}      {row['description']}")
        elif isinstance(value, dict) and value:
            lines += [f"{indent}{key}", _text(value, indent + "  ")]
        elif isinstance(value, str) and "\n" in value:
            lines += [f"{indent}{key}", value]
        else:
            lines.append(f"{indent}{key}: {_value(value)}")
    return "\n".join(lines)


def _value(value: Any) -> str:

    return value if isinstance(value, str) else json.dumps(value)
