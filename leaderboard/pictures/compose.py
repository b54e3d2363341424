"""Draws a picture by its name, from entries or from a task's environment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from qrlsuite import options, registry, specs
from qrlsuite.errors import OptionError, PluginError, UnknownNameError, nearest
from qrlsuite.experiment import task as task_files
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.shelf import collect
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.seeds import read_seeds
from qrlsuite.specs import PictureSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Composed:
    """A picture, and its subject.

    Attributes
    ----------
    entries:
        Empty for a picture of no entries.
    tasks:
        The tasks of the entries, or the tasks whose environment is shown.
    left_out:
        One line for each entry that was left out and why.
    """

    figure: Figure
    entries: tuple[EntryResults, ...] = ()
    tasks: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def compose(
    kind: str,
    written: Selection,
    entries: Sequence[str | EntryResults] = (),
    *,
    horizon: int | None = None,
    seeds: int | str | Iterable[int] | None = None,
    settings: Mapping[str, Any],
    environment: Mapping[str, Any],
) -> Composed:
    """Choose the entries of a picture, and draw it.

    Parameters
    ----------
    kind:
        A name of `summaries`.
    entries, horizon:
        As for `qrlsuite.leaderboard.shelf.collect.select`.
    seeds:
        Draw these alone, of every entry, see `EntryResults.with_seeds`; None means all.
    settings:
        The picture's settings by name.
    environment:
        For a picture of an environment: options that replace the task's.
    """
    spec = find(kind, written.tasks)
    results = {"--entry": entries, "--horizon": horizon, "--seeds": seeds}
    results |= {"--label": written.labels, "--published": written.published}
    if spec is not None and any(results.values()):
        name = next(name for name, value in results.items() if value)
        raise OptionError(f"picture '{kind}' shows no results: leave {name} out")
    if spec is not None:
        return _of_environment(kind, spec, written.tasks, settings, environment)
    if environment:
        raise OptionError(f"environment.{next(iter(environment))}: picture '{kind}' shows what was trained")
    data = pictures.KINDS[kind].data
    if data == "episodes":
        raise OptionError(f"picture '{kind}' is drawn by: qrlsuite evaluate ENTRY --out {kind}.png")
    if data == "deployed":
        raise OptionError(f"picture '{kind}' is drawn by: qrlsuite plot shots --study deploy")
    cuts = "horizon" in options.field_names(specs.resolve(pictures.KINDS[kind].options))
    own = {"horizon": horizon} if cuts and horizon is not None else {}
    selection = written.named()
    selected, left_out = collect.select(selection, entries, horizon)
    if seeds is not None:
        wanted = read_seeds(seeds)
        lacking = [entry for entry in selected if not entries and set(wanted) - set(entry.seeds)]
        left_out += [
            f"{entry.label}: {len(entry.seeds)} seeds, and not all that were asked for" for entry in lacking
        ]
        selected = [
            entry.with_seeds(wanted) for entry in selected if all(entry is not each for each in lacking)
        ]
    if not entries:
        selected.sort(key=lambda entry: (entry.model, sum(entry.parameters), entry.label))
        if cuts:
            selected, short = collect.equally_long(selected)
            left_out += short
        selected = [replace(entry, color=place) for place, entry in enumerate(selected)]
    held = sorted({entry.task for entry in selected})
    if not selected:
        raise UnknownNameError(
            f"{selection.runs} holds no results{selection.of_tasks} yet: qrlsuite run; --published draws "
            "the entries that come with the suite"
        )
    if len(held) > 1 and not selection.tasks and not entries:
        raise OptionError(
            f"{selection.runs} holds several tasks; choose with --task {' or --task '.join(held)}"
        )
    figure = pictures.draw(kind, selected, **{**own, **settings})
    return Composed(figure, tuple(selected), tuple(dict.fromkeys(e.task for e in selected)), tuple(left_out))


def describe(kind: str) -> dict[str, Any]:
    """Describe a picture and its settings, as plain values; one of environments for each of them."""
    lines = summaries()
    if kind not in lines:
        raise UnknownNameError(f"unknown picture '{kind}'{nearest(kind, lines)}")
    owners = {} if kind in pictures.KINDS else _environment_pictures()[kind]
    references = [each.options for each in owners.values()] or [pictures.KINDS[kind].options]
    change = {"set_with": f"qrlsuite plot {kind} NAME=VALUE"}
    tables = [{"options": options.describe(specs.resolve(each))} | change for each in references]
    content = {"kind": "picture", "name": kind, "summary": lines[kind]}
    if len(tables) == 1:
        return content | tables[0]
    return content | {f"tasks of {name}": table for name, table in zip(owners, tables)}


def summaries() -> dict[str, str]:
    """Return one line for every picture; pictures of environments name them."""
    lines = {name: picture.summary for name, picture in pictures.KINDS.items()}
    for name, owners in _environment_pictures().items():
        summary = next(iter(owners.values())).summary
        lines.setdefault(name, f"{summary} (tasks of {', '.join(owners)})")
    return lines


def _environment_pictures() -> dict[str, dict[str, PictureSpec]]:
    by_name: dict[str, dict[str, PictureSpec]] = {}
    for registered in registry.load().of(specs.EnvironmentSpec).values():
        for picture in registered.spec.pictures:
            by_name.setdefault(picture.name, {})[registered.spec.name] = picture
    return by_name


def find(kind: str, tasks: Sequence[str]) -> PictureSpec | None:
    """Return the environment's picture of that name, None for one of the suite's own kinds."""
    if kind in pictures.KINDS:
        return None
    owners = _environment_pictures().get(kind)
    if owners is None:
        raise UnknownNameError(f"unknown picture '{kind}'{nearest(kind, summaries())}")
    if not tasks:
        if len(owners) == 1:
            return next(iter(owners.values()))
        raise OptionError(f"several environments have a picture '{kind}': choose one with --task TASK")
    environment = task_files.load(tasks[0]).environment.name
    if environment not in owners:
        raise OptionError(
            f"picture '{kind}' shows tasks of {', '.join(owners)}; '{tasks[0]}' is a task of {environment}"
        )
    return owners[environment]


def _of_environment(
    kind: str, spec: PictureSpec, tasks: Sequence[str], own: Mapping[str, Any], world: Mapping[str, Any]
) -> Composed:
    """Draw a picture that an environment brings, of one or several tasks."""
    if not tasks:
        raise OptionError(f"picture '{kind}' shows the environment of a task: add --task TASK")
    loaded = [task_files.load(name).with_environment(dict(world)) for name in tasks]
    if len({task.environment.name for task in loaded}) > 1:
        raise OptionError(f"picture '{kind}': {' and '.join(tasks)} have different environments")
    chosen = options.build(specs.resolve(spec.options), dict(own), f"picture '{kind}'")
    from matplotlib.figure import Figure

    figure = specs.resolve(spec.draw)({task.name: task.environment_options for task in loaded}, chosen)
    if not isinstance(figure, Figure):
        raise PluginError(
            f"picture '{kind}' of environment '{loaded[0].environment.name}' returned {type(figure).__name__}, "
            "not a matplotlib.figure.Figure"
        )
    return Composed(figure, tasks=tuple(task.name for task in loaded))
