"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

TaskOption = Annotated[str | None, typer.Option("--task", help="Only this task.")]
RunsOption = Annotated[
    Path, typer.Option("--runs", metavar="DIR", help="The results folder.", envvar="QRLSUITE_RUNS")
]
RuleOption = Annotated[
    str,
    typer.Option(
        "--rule",
        metavar="NAME",
        help="What counts as significant: qrlsuite list significance-tests; qrlsuite show NAME.",
    ),
]
PublishedOption = Annotated[
    bool,
    typer.Option("--published", help="With the published entries that come with the suite."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
