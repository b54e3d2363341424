"""`qrlsuite show`: print options, protocols, circuits and provenance."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from qrlsuite.api.showing import describe, is_study
from qrlsuite.cli.arguments import JsonOption, LabelOption, PublishedOption, RunsOption, split_settings
from qrlsuite.engine.sheet import text_of
from qrlsuite.engine.terminal import printable_lines, table_console
from qrlsuite.results.store import write_atomically


def show(
    name: Annotated[
        str,
        typer.Argument(
            help="A task, model, algorithm, environment, ansatz, picture, study, or an entry: name, label or folder."
        ),
    ],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME|OPTION=VALUE",
            help="After a kind, the name: `show ansatz iqp`. After a study, further studies of other "
            "tasks. After an ansatz, its options, and qubits=4 layers=2.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="For an ansatz: draw to this png, pdf or svg file. For a study: write the table to this "
            "tex or md file.",
        ),
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="For an ansatz: print the circuit as qasm3, or as a program with qiskit or pennylane. For "
            "a task: toml prints its file.",
        ),
    ] = None,
    code: Annotated[
        bool,
        typer.Option("--identity", help="Show the code identity of an entry or a plugin, and its parts."),
    ] = False,
    label: LabelOption = None,
    published: PublishedOption = False,
    runs: RunsOption = Path("runs"),
    json_output: JsonOption = False,
) -> None:
    """Show options with their defaults and meaning, a task's protocol, how far a study is, or how an entry was made.

    A study is given by name, or as its file or the folder of a published one. For a study you see the finished seeds
    and the cost of the missing ones; for a study with looks the verdicts, and the needs of open pairs; for several,
    each of another task, the pairs that all studies compare, on average over the tasks.

    Examples: qrlsuite show mlp; qrlsuite show task beam6g; qrlsuite show ansatz iqp qubits=4;
    qrlsuite show ansatz iqp --format qasm3; qrlsuite show picture bars; qrlsuite show fig7 --published;
    qrlsuite show "cartpole/reinforce mlp" --published; qrlsuite show quantum-or-not-degree5 quantum-or-not-a3-0
    """
    names, settings = split_settings(words)
    studies = names if name == "study" else [name, *names] if is_study(name) else []
    if len(studies) > 1 and not (settings or code or format):
        from qrlsuite.api.studies import read_study  # slow to import, and nothing else needs it

        found: Any = read_study(*studies, runs=runs)
    elif len(names) > 1 or len(studies) > 1:
        raise typer.BadParameter(
            f"{' '.join([name, *names])}: give one name, after a kind or alone; or several studies, without "
            "options, --format and --identity"
        )
    else:
        kind, target = (name, names[0]) if names else (None, name)
        found = describe(
            target, kind, settings=settings, code=code, out=out, format=format, runs=runs, published=published
        )
    if label:
        from qrlsuite.studies.state import State  # slow to import, and nothing else needs it

        if not isinstance(found, State):
            raise typer.BadParameter(
                "--label: only entries of a study with looks take names of your own here"
            )
        found = found.labeled(label)
    if not isinstance(found, dict) and out is not None:
        write_atomically(out, text_of(found.sheets(), out).encode())
    if json_output:
        typer.echo(json.dumps(found if isinstance(found, dict) else found.as_dict()))
    elif not isinstance(found, dict) and out is not None:
        typer.echo(f"wrote {out}")
    elif not isinstance(found, dict):
        table_console().print(found, soft_wrap=True)
        if studies and not getattr(found, "begun", True):
            from qrlsuite.api.needs import power_lines, study_power  # slow to import

            typer.echo("\n".join(power_lines(study_power(found.study))))
    elif format is not None and "text" in found:
        typer.echo(found["text"], nl=False)
    else:
        typer.echo(printable_lines(_text(found)))


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
