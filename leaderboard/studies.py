"""Studies: found by name, their entries read for boards, and their pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qrlsuite import options, registry, specs
from qrlsuite.engine.terminal import command
from qrlsuite.engine.work import Missing
from qrlsuite.errors import OptionError, UnknownNameError, nearest
from qrlsuite.experiment.entry import Entry
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.boards.times import rank_by_time
from qrlsuite.leaderboard.pictures.compose import Composed, compose
from qrlsuite.leaderboard.shelf import collect, published, published_studies
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.store import EntryStore
from qrlsuite.statistics import MIN_RUNS
from qrlsuite.studies.looks import FILE, Study, has_begun
from qrlsuite.studies.runner import Overview
from qrlsuite.studies.state import State
from qrlsuite.studies.study import EvaluationSection, Member, PictureSection, StudyFile, load
from qrlsuite.studies.together import together

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLAYED = ("episodes", "deployed")
"""Data of pictures for which trained agents play."""
OF_LOOKS = ("pairs", "entries")
"""Pictures of a study with looks, which its file need not name."""


def find(name: str) -> StudyFile:
    """Load a study: registered, one with looks that comes with the suite, a folder with a published one, or a file."""
    registered = registry.load().names(specs.StudySpec)
    if not name.endswith(".toml") and name not in registered:
        if (folder := published_studies.folder_of(name)) is None:
            files = [f"{name}.toml"] if Path(f"{name}.toml").exists() else []
            known = [*files, *registered, *published_studies.names()]
            raise UnknownNameError(f"unknown study '{name}'{nearest(name, files or known)}")
        return published_studies.load(folder).of(name)
    path = Path(name)
    if path.name == FILE and any(path.parent.glob("*/*/entry.json")):  # results, which may be a stranger's
        return published_studies.load(path.parent).of(name)
    study = load(name)
    check(study)
    return study


def read_outcome(name: str, runs: Path) -> State:
    """Return the outcome of a study with looks: of the results folder if it has begun there, else the published one."""
    found, folder = find(name), published_studies.folder_of(name)
    if folder is not None and (folder == Path(name) or not has_begun(runs, found.name)):
        return published_studies.noted(published_studies.read(folder))
    return published_studies.noted(Study(found, runs).read())


def check(study: StudyFile) -> None:
    """Check that a study's pictures exist and take its settings."""
    for place, picture in enumerate(study.pictures):
        location = f"{study.origin}: pictures.{place}"
        if picture.kind not in pictures.KINDS:
            raise UnknownNameError(
                f"{location}.kind: unknown picture '{picture.kind}'{nearest(picture.kind, pictures.KINDS)}"
            )
        kind = pictures.KINDS[picture.kind]
        options.build(specs.resolve(kind.options), picture.settings, f"{location}.settings")
        played = kind.data in PLAYED
        if (picture.evaluation is not None) != played:
            rule = "needs" if played else "takes no"
            raise OptionError(f"{location}.evaluation: picture '{picture.kind}' {rule} evaluation")
        deployed = picture.evaluation.deployed if picture.evaluation is not None else None
        if (deployed is not None) != (kind.data == "deployed"):
            rule = "needs" if kind.data == "deployed" else "takes no"
            raise OptionError(f"{location}.evaluation.deployed: picture '{picture.kind}' {rule} deployed")
        if deployed is not None:
            backend = specs.resolve(registry.get(specs.CircuitBackendSpec, deployed.backend).options)
            for value in deployed.values:
                options.build(backend, deployed.chosen(value), f"{location}.evaluation.deployed")


def read(selection: Selection, members: Sequence[Member]) -> dict[str, EntryResults]:
    """Return the learning curves of the entries that have any, by entry name; seeds kept for tuning are left out.

    Own and published seeds of an entry are united, see `collect.united`.
    """
    curves_by_name = {}
    for entry in {member.entry.name: member.entry for member in members}.values():
        if copies := _copies(selection.folders, entry):
            curves_by_name[entry.name] = selection.shown(collect.united(copies)[0])
    return curves_by_name


def _copies(folders: Iterable[Path], entry: Entry) -> list[EntryResults]:
    """Return the copies of an entry of one code, the first of `collect.by_code`."""
    found = [collect.read(store) for folder in folders for store in EntryStore.of_name(folder, entry)]
    return next(iter(collect.by_code(curves for curves in found if curves is not None)), [])


def published_seeds(works: Iterable[Missing]) -> dict[str, int]:
    """Return how many seeds of each entry come with the suite and reach its last epoch, by entry name."""
    counts = {}
    for work in works:
        copies = _copies(published.folders(), work.entry)
        reached = [long for copy in copies if (long := copy.reaching(work.epochs)) is not None]
        counts[work.entry.name] = max((len(copy.seeds) for copy in reached), default=0)
    return counts


def select(
    name: str, selection: Selection, horizon: int | None = None
) -> tuple[list[EntryResults], list[str]]:
    """Read a study's entries for a board of that study alone.

    Parameters
    ----------
    name:
        A study, or a study file's path.
    horizon:
        As for `collect.select`.

    Returns
    -------
    tuple
        The entries, and one line for each that was left out and why.
    """
    runs, published_too = selection.runs, selection.published
    entries = [member.entry for member in load(name).members()]
    keys = {(e.task.name, e.name) for e in entries if not selection.tasks or e.task.name in selection.tasks}
    if not keys:
        raise OptionError(f"study '{name}' has no entry{selection.of_tasks}")
    selected, left_out = collect.select(dataclasses.replace(selection, only=keys), horizon=horizon)
    if not selected:
        searched = f"{runs} and the published entries hold" if published_too else f"{runs} holds"
        more = "" if published_too else "; --published shows the entries that come with the suite"
        raise UnknownNameError(f"{searched} no entry of study '{name}' yet: qrlsuite study run {name}{more}")
    return selected, left_out


def decided_pairs(entries: Iterable[EntryResults]) -> tuple[int, int]:
    """Count the pairs of entries that rule `steps` decides, and all pairs that it tests: both of 20 seeds or more.

    Entries are compared within a task, at its shortest horizon; Holm's procedure goes over the task's pairs. Entries
    of a study with looks are left out: their number of seeds depends on results.
    """
    by_task: dict[str, list[EntryResults]] = {}
    for entry in entries:
        if entry.study is None and not entry.missing:
            by_task.setdefault(entry.task_hash, []).append(entry)
    counts = [(0, 0)]
    for group in by_task.values():
        ranking = ranking_of(group)
        horizon = min(ranking.horizons)
        long = [reached for e in group if (reached := e.reaching(horizon // e.steps_per_epoch))]
        if sum(len(entry.seeds) >= MIN_RUNS for entry in long) > 1:
            result = rank_by_time(long, ranking.grid, horizon)
            counts.append((result.n_decided, result.n_pairs))
    return sum(decided for decided, _ in counts), sum(pairs for _, pairs in counts)


def draw(
    kind: str,
    names: Sequence[str],
    selection: Selection,
    *,
    horizon: int | None = None,
    seeds: int | str | Iterable[int] | None = None,
    settings: Mapping[str, Any],
) -> Composed:
    """Draw a picture of a study: its entries, with the settings of its file; of studies with looks the pairs, too.

    Parameters
    ----------
    kind:
        The name of a picture in the study's file, or a kind of picture: `pairs` or `entries` with looks.
    names:
        A study, or for `pairs` several with looks, each of another task.
    selection, horizon, seeds, settings:
        As for `qrlsuite.leaderboard.pictures.compose.compose`. The results folder's agents play.
    """
    name, *more = names
    study = find(name)
    named = {section.name: section for section in study.pictures}
    if kind not in named and kind in OF_LOOKS and study.looks is not None:
        if settings or selection.tasks or seeds is not None or horizon is not None:
            raise OptionError(
                f"picture '{kind}' of a study shows its looks as they are: leave settings, --task, --seeds and "
                "--horizon out"
            )
        return _of_looks(kind, names, selection)
    if kind not in named and kind not in pictures.KINDS:
        known = [*named, *(OF_LOOKS if study.looks is not None else ()), *pictures.KINDS]
        raise UnknownNameError(f"study '{study.name}' has no picture '{kind}'{nearest(kind, known)}")
    if more:
        raise OptionError(f"picture '{kind}' shows one study: leave {', '.join(more)} out")
    section = named.get(kind) or PictureSection(kind=kind)
    members = [
        member
        for member in study.members()
        if (not section.entries or member.group in section.entries)
        and (not selection.tasks or member.entry.task.name in selection.tasks)
    ]
    if not members:
        raise OptionError(f"study '{name}' has no entry{selection.of_tasks}")
    data = pictures.KINDS[section.kind].data
    if data == "deployed" and section.evaluation is None:
        raise OptionError(f"picture '{kind}' needs a study whose file has an evaluation, such as `deploy`")
    if data == "deployed" and (
        seeds is not None or horizon is not None or selection.labels or selection.published
    ):
        raise OptionError(
            f"picture '{kind}' plays the best agents of all seeds here: leave --seeds, --horizon, --label and "
            "--published out"
        )
    if data == "episodes":
        raise OptionError(f"picture '{kind}' is drawn by: {drawn_by(name, section, members, selection.runs)}")
    folder = selection.runs if study.looks is None else read_outcome(name, selection.runs).study.folder
    among = Selection(folder, selection.published and data == "entries", labels=selection.labels)
    entries = list(read(among, members).values())
    if not entries:
        hint = "; --published draws the entries that come with the suite"
        hint *= not selection.published and data == "entries"
        raise UnknownNameError(f"study '{study.name}' has no seeds yet: qrlsuite study run {name}{hint}")
    entries, short = collect.equally_long(entries)
    own = {**section.settings, **settings}
    if data == "deployed":
        drawn = Composed(_deployed(section, entries, own), tuple(entries))
    else:
        drawn = compose(
            section.kind, selection.of(), entries, horizon=horizon, seeds=seeds, settings=own, environment={}
        )
    return dataclasses.replace(drawn, left_out=(*drawn.left_out, *short))


def next_steps(name: str, found: Overview, runs: Path) -> list[str]:
    """Return a line for each picture of a study: the command that draws it."""
    return [f"next: {drawn_by(name, picture, found.members, runs)}" for picture in found.study.pictures]


def drawn_by(name: str, section: PictureSection, members: Sequence[Member], runs: Path) -> str:
    """Return the command that draws a picture of a study."""
    if pictures.KINDS[section.kind].data != "episodes":
        return command("plot", section.name, "--study", name, runs=runs)
    shown = [m.entry for m in members if not section.entries or m.group in section.entries]
    labels, played = dict.fromkeys(entry.label for entry in shown), section.evaluation or EvaluationSection()
    numbers = ("--best", str(played.best), "--episodes", str(played.episodes))
    out = f"{section.name}.png"
    return command("evaluate", *labels, "--task", shown[0].task.name, *numbers, "--out", out, runs=runs)


def _of_looks(kind: str, names: Sequence[str], selection: Selection) -> Composed:
    """Draw the pairs or the entries of studies with looks."""
    from qrlsuite.leaderboard.pictures import outcome as drawing  # matplotlib

    outcomes = [read_outcome(name, selection.runs).labeled(selection.labels) for name in names]
    if len(outcomes) > 1 and kind != "pairs":
        raise OptionError(f"picture '{kind}' shows one study: leave {', '.join(names[1:])} out")
    if len(outcomes) > 1:
        return Composed(drawing.draw_together(together(outcomes)))
    return Composed(drawing.draw(outcomes[0]) if kind == "pairs" else drawing.draw_entries(outcomes[0]))


def _deployed(picture: PictureSection, entries: Sequence[EntryResults], own: Mapping[str, Any]) -> Figure:
    """Play the entries' best runs as trained, and runs with a circuit on the backend at every value.

    Episodes on the backend are stored in the entries' folders, and not played again.
    """
    assert picture.evaluation is not None  # `draw` and `check` saw to it, and to the next
    assert picture.evaluation.deployed is not None
    from qrlsuite.leaderboard.pictures import cells  # matplotlib, which is needed for drawing alone

    cells.one_task(entries, picture.kind)
    from qrlsuite.leaderboard.pictures import deployed as drawing  # matplotlib
    from qrlsuite.training import evaluation  # torch, which most pictures do without
    from qrlsuite.training.deployment import Deployment

    best, episodes, where = picture.evaluation.best, picture.evaluation.episodes, picture.evaluation.deployed
    lines = []
    for entry in entries:
        store = EntryStore(entry.folder)
        trained = evaluation.trained(store, best, episodes)
        elsewhere = []
        if getattr(store.entry().model_options, "backend", None) is not None:
            for value in where.values:
                deployment = Deployment(store, where.backend, where.chosen(value), best)
                if not deployment.simulator:
                    raise OptionError(
                        f"{deployment.name} is not a simulator: a picture executes nothing on hardware; use "
                        "`qrlsuite evaluate` with --yes"
                    )
                elsewhere.append(deployment.play(episodes, 0))
        lines.append(drawing.Line(trained, tuple(elsewhere)))
    from qrlsuite.leaderboard.pictures import style

    settings = {"title": style.heading(entries), "axis": where.vary, **own}
    return drawing.draw(
        lines, [f"{value:,}" if type(value) is int else f"{value}" for value in where.values], **settings
    )
