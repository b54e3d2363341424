"""`qrlsuite check`: test plugins against the suite's rules."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from qrlsuite import registry, specs, testing
from qrlsuite.cli.arguments import JsonOption, split_settings
from qrlsuite.engine.terminal import printable
from qrlsuite.experiment.task import load as load_task
from qrlsuite.testing import Finding, selection
from qrlsuite.testing.findings import watching
from qrlsuite.testing.selection import CheckTarget


def check(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME|KIND:NAME|DISTRIBUTION",
            help="A registered name, a whole distribution, or a task's file.",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="OPTION=VALUE", help="Check a single plugin with these values of its options."
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            help="Take the options of this task, or task file, for an environment, and its environment for others.",
        ),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Test plugins against the suite's rules; a broken rule is shown with its likely cause.

    Exit codes: 0 every rule holds, 1 a rule is broken, 2 nothing has that name.

    Examples: qrlsuite check my-model; qrlsuite check ansatz:ring depth=2; qrlsuite check my-distribution
    """
    if name is None:
        if task:
            raise typer.BadParameter("--task needs a name: qrlsuite check KIND:NAME --task TASK")
        _teach(json_output)
        return
    items = selection.select(name)
    more: dict[str, Any] = {}
    kinds = [item.kind for item in items]
    if task and kinds not in ([specs.EnvironmentSpec], [specs.AlgorithmSpec], [specs.ModelSpec]):
        raise typer.BadParameter(
            "--task is for one environment, algorithm or model: qrlsuite check KIND:NAME --task TASK"
        )
    chosen = {}
    if task and kinds == [specs.EnvironmentSpec]:
        chosen = _options_in(task, items[0])
    elif task:
        load_task(task)
        more["task"] = task
    more_names, given = split_settings(settings)
    if more_names:
        raise typer.BadParameter(f"{more_names[0]}: give one name, and its options as OPTION=VALUE")
    chosen |= given
    if chosen and len(items) > 1:
        raise typer.BadParameter("options need a single name: qrlsuite check KIND:NAME OPTION=VALUE")
    if json_output:
        results = [(item, _findings(item, chosen, more)) for item in items]
        rows = [(item, asdict(finding)) for item, findings in results for finding in findings]
        typer.echo(json.dumps([{"kind": item.kind.kind, "name": item.name, **row} for item, row in rows]))
    else:
        results = _show(items, chosen, more)
    if not all(finding.ok for _, findings in results for finding in findings):
        raise typer.Exit(1)


def _options_in(task: str, item: CheckTarget) -> dict[str, Any]:
    section = load_task(task).file.environment
    if section.name != item.name:
        raise typer.BadParameter(f"--task {task}: its environment is '{section.name}', not '{item.name}'")
    return dict(section.options)


def _findings(item: CheckTarget, settings: dict[str, Any], more: dict[str, Any]) -> list[Finding]:
    try:
        return testing.check(item.kind.kind, item.name, settings, **more)
    except (Exception, SystemExit) as error:  # code that fails outside of any rule: the rest is still checked
        return [Finding("check", False, registry.words(error))]


def _show(
    items: list[CheckTarget], settings: dict[str, Any], more: dict[str, Any]
) -> list[tuple[CheckTarget, list[Finding]]]:
    """Check things one after another: print each rule as it holds or breaks, and the current one in a terminal."""
    console = Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
    results = []
    with console.status("") as status:

        def follow(seen: str | Finding) -> None:
            if isinstance(seen, Finding):
                printed.append(seen)
                _print(console, seen)
            else:
                status.update(Text(printable(f"{item.title}: {seen}")))

        for item in items:
            printed = list[Finding]()
            loaded = "" if item.kind.kind in testing.KINDS else " (only loading and registering are checked)"
            console.print(printable(f"{item.title}{loaded}"), style="bold")
            with watching(follow):
                findings = _findings(item, settings, more)
            results.append((item, findings))
            for finding in findings:
                if not any(finding is each for each in printed):
                    _print(console, finding)
    broken = sum(not finding.ok for _, findings in results for finding in findings)
    total = sum(len(findings) for _, findings in results)
    if broken:
        console.print(
            f"{broken} of {total} rules broken; some are tried only after these hold", style="bold red"
        )
        if "task" not in more and any(
            item.kind in (specs.AlgorithmSpec, specs.ModelSpec) and not finding.ok
            for item, findings in results
            for finding in findings
        ):
            console.print("it was tried on a toy: --task NAME tries it on a task's environment", style="dim")
    else:
        console.print(f"all {total} rules hold", style="bold green")
    return results


def _print(console: Any, finding: Finding) -> None:
    mark, style = ("\u2713", "green") if finding.ok else ("\u2717", "red")
    console.print(f"  {mark} ", style=style, end="")
    console.print(printable(f"{finding.rule}: {finding.message}"), style="dim" if finding.ok else "")


def _teach(json_output: bool) -> None:
    """Print the names that can be checked here."""
    registered = registry.load()
    others = sorted({plugin.distribution for plugin in registered.plugins} - {"qrlsuite"})
    if json_output:
        typer.echo(json.dumps({"distributions": others}))
        return
    typer.echo("qrlsuite check NAME            something registered: qrlsuite check mlp")
    typer.echo("qrlsuite check KIND:NAME       where several kinds have the name: qrlsuite check model:mlp")
    typer.echo("qrlsuite check DISTRIBUTION    everything that a package registers")
    typer.echo("qrlsuite check FILE.toml        a task of your own")
    typer.echo("\nIn a package's own tests: from qrlsuite.testing import assert_conforms")
    if others:
        typer.echo(f"\nOther installed plugins: {', '.join(printable(name) for name in others)}")
    else:
        typer.echo("\nNo other plugin is installed. Begin one: qrlsuite new plugin --help")
