"""The Typer application: every command, its own file."""

from __future__ import annotations

from typing import Annotated

import typer

from qrlsuite.cli.commands import (
    calibrate,
    check,
    compare,
    doctor,
    evaluate,
    export,
    import_,
    leaderboard,
    listing,
    new,
    plot,
    run,
    runs,
    show,
    status,
    study,
    tune,
)


def build() -> typer.Typer:
    """Return the application with every built-in and plugin command."""
    app = typer.Typer(
        name="qrlsuite",
        help=(
            "Does a quantum model really beat a classical one at reinforcement learning, or did five lucky seeds "
            "say so? Train many seeds, estimate sample complexity with confidence intervals, and rank by "
            "significant outperformance.\n\n"
            "Start with:  qrlsuite run --task beam6g --model mlp --quick"
        ),
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.command("run")(run.run)
    app.command("status")(status.status)
    app.command("runs")(runs.runs)
    app.add_typer(leaderboard.app, name="leaderboard")
    app.command("compare")(compare.compare)
    app.command("calibrate")(calibrate.calibrate)
    app.command("plot", cls=plot.Command)(plot.plot)
    app.command("evaluate")(evaluate.evaluate)
    app.command("tune")(tune.tune)
    app.command("export")(export.export)
    app.command("import")(import_.import_results)
    app.command("list")(listing.list_things)
    app.command("show")(show.show)
    app.command("check")(check.check)
    app.command("doctor")(doctor.doctor)
    app.add_typer(study.app, name="study")
    app.add_typer(new.app, name="new")

    @app.callback()
    def common(
        version: Annotated[
            bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_print_version)
        ] = False,
        strict: Annotated[
            bool,
            typer.Option(
                "--strict", help="Stop at a broken plugin instead of skipping it (or QRLSUITE_STRICT=1)."
            ),
        ] = False,
    ) -> None:
        pass  # `cli.main` sees to --strict, for plugins are loaded before options are read

    from qrlsuite import registry
    from qrlsuite.cli.extensions import add_commands

    add_commands(app, registry.load())
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        import qrlsuite

        typer.echo(f"qrlsuite {qrlsuite.__version__}")
        raise typer.Exit
