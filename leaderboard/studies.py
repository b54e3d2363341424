"""Draws the pictures of a study from its entries in a results folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qrlsuite import options, registry, specs
from qrlsuite.errors import OptionError, QrlSuiteError, UnknownNameError, nearest
from qrlsuite.experiment.entry import Entry
from qrlsuite.leaderboard import pictures
from qrlsuite.leaderboard.boards.ranked import ranking_of
from qrlsuite.leaderboard.boards.times import rank_by_time
from qrlsuite.leaderboard.shelf import collect, published, published_studies
from qrlsuite.leaderboard.shelf.collect import Selection
from qrlsuite.leaderboard.shelf.curves import EntryResults
from qrlsuite.results.store import EntryStore, write_atomically
from qrlsuite.results.text import counted
from qrlsuite.statistics import MIN_RUNS
from qrlsuite.studies.looks import StudyWithLooks, has_begun
from qrlsuite.studies.outcome import StudyOutcome
from qrlsuite.studies.runner import PendingEntry
from qrlsuite.studies.study import Member, PictureSection, Study, load
from qrlsuite.studies.together import StudiesTogether

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Report = Callable[[str, int, int], None]
NOTHING = "nothing is trained yet"
PLAYED = ("episodes", "deployed")
"""Data of pictures for which trained agents play."""


@dataclass(frozen=True)
class Drawn:
    """A picture of a study, or why there is none.

    Attributes
    ----------
    seeds:
        Seeds that each point rests on: (task, label, number) in the study's order, 0 where nothing is there yet.
    short:
        Entries that have begun but end before the others do, (task, label, epochs): they would cut the picture
        to their length, and are left out.
    figure:
        None where the finished seeds do not suffice for the picture.
    problem:
        Then the reason.
    path:
        The picture's file, where it was written to one.
    """

    name: str
    kind: str
    seeds: tuple[tuple[str, str, int], ...]
    short: tuple[tuple[str, str, int], ...] = ()
    figure: Figure | None = None
    problem: str = ""
    path: Path | None = None

    def lines(self) -> list[str]:
        """Say where it was written and on how many seeds each point rests; nothing where nothing is trained yet."""
        if self.path is None:
            return [] if self.problem == NOTHING else [f"no picture '{self.name}': {self.problem}"]
        several = len({task for task, _, _ in self.seeds}) > 1
        epochs = {(task, label): count for task, label, count in self.short}
        labels: dict[str, list[str]] = {}
        for task, label, count in sorted(self.seeds, key=lambda point: -point[2]):
            begun = epochs.get((task, label))
            state = f"left out, at epoch {begun}" if begun else "nothing yet"
            state = counted(count, "seed") if count else state
            labels.setdefault(state, []).append(f"{task} {label}" if several else label)
        return [f"wrote {self.path}", *(f"  {state}: {', '.join(names)}" for state, names in labels.items())]

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "picture": self.name,
            "kind": self.kind,
            "file": None if self.path is None else str(self.path),
            "problem": self.problem or None,
            "seeds": [{"task": task, "label": label, "seeds": count} for task, label, count in self.seeds],
            "short": [{"task": task, "label": label, "epochs": count} for task, label, count in self.short],
        }


def find(name: str) -> Study:
    """Load a study: registered, one with looks that comes with the suite, a folder with a published one, or a file."""
    registered = registry.load().names(specs.StudySpec)
    if not name.endswith(".toml") and name not in registered:
        if (folder := published_studies.folder_of(name)) is None:
            files = [f"{name}.toml"] if Path(f"{name}.toml").exists() else []
            known = [*files, *registered, *published_studies.names()]
            raise UnknownNameError(f"unknown study '{name}'{nearest(name, files or known)}")
        return dataclasses.replace(published_studies.load(folder), source=name)
    study = load(name)
    check(study)
    return study


def read_outcome(name: str, runs: Path) -> StudyOutcome:
    """Return the outcome of a study with looks: of the results folder if it has begun there, else the published one."""
    found, folder = find(name), published_studies.folder_of(name)
    if folder is not None and (folder == Path(name) or not has_begun(runs, found.name)):
        return published_studies.read(folder)
    study = StudyWithLooks(found, runs)
    return StudyOutcome(study, study.read())


def check(study: Study) -> None:
    """Check that a study's pictures exist and take its settings."""
    for place, picture in enumerate(study.file.pictures):
        location = f"{study.source}: pictures.{place}"
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
            curves_by_name[entry.name] = collect.united(copies)[0]
    return curves_by_name


def _copies(folders: Iterable[Path], entry: Entry) -> list[EntryResults]:
    """Return the copies of an entry that have the code of the first copy."""
    stores = [EntryStore.find(folder, entry) for folder in folders]
    found = [collect.read(store) for store in stores if (store.path / "entry.json").exists()]
    return next(iter(collect.by_code(curves for curves in found if curves is not None)), [])


def published_seeds(items: Iterable[PendingEntry]) -> dict[str, int]:
    """Return how many seeds of each entry come with the suite and reach its last epoch, by entry name."""
    counts = {}
    for item in items:
        copies = _copies(published.folders(), item.missing.entry)
        reached = [long for copy in copies if (long := copy.reaching(item.missing.epochs)) is not None]
        counts[item.missing.entry.name] = max((len(copy.seeds) for copy in reached), default=0)
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
        more = "" if published_too else "; --published shows those that come with the suite"
        raise UnknownNameError(f"{searched} no entry of study '{name}' yet: qrlsuite study run {name}{more}")
    return selected, left_out


def decided_pairs(entries: Iterable[EntryResults]) -> tuple[int, int]:
    """Count the pairs of entries that rule `times` decides, and all pairs that it tests: both of 20 seeds or more.

    Entries are compared within a task, at its shortest horizon; Holm's procedure goes over the task's pairs. Entries
    of a study with looks are left out: their number of seeds depends on results.
    """
    by_task: dict[str, list[EntryResults]] = {}
    for entry in entries:
        if entry.plan is None:
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
    study: Study,
    members: Sequence[Member],
    selection: Selection,
    report: Report | None = None,
    seeds: str | None = None,
) -> list[Drawn]:
    """Draw every picture of a study from the seeds finished so far.

    Parameters
    ----------
    selection:
        Pictures that play episodes show entries of the results folder alone.
    seeds:
        Draw these alone, of every entry (`20`, `0:20`), so that all have equal numbers; None means all. Pictures that
        play episodes choose among all seeds, and are not drawn.
    report:
        Told of the progress of episodes that a picture needs: policy, played, total.
    """
    check(study)
    own = read(Selection(selection.runs), members)  # those who can play: agents are not published
    curves_by_name = read(selection, members) if selection.published else own
    if seeds is not None:
        curves_by_name = {name: entry.with_seeds(seeds) for name, entry in curves_by_name.items()}
    drawn = []
    for picture in study.file.pictures:
        shown = [m for m in members if not picture.entries or m.group in picture.entries]
        unique = {member.entry.name: member for member in shown}
        kind = pictures.KINDS[picture.kind]
        known = own if kind.data in PLAYED else curves_by_name
        present = [known[name] for name in unique if name in known]
        longest = max((_steps(entry) for entry in present), default=0)
        entries = [entry for entry in present if _steps(entry) == longest]
        counts = {entry.name: len(entry.seeds) for entry in entries}
        head = Drawn(
            picture.name,
            picture.kind,
            tuple((m.entry.task.name, m.entry.label, counts.get(name, 0)) for name, m in unique.items()),
            tuple((e.task, e.label, e.curves.shape[1]) for e in present if _steps(e) < longest),
        )
        if not entries:
            drawn.append(dataclasses.replace(head, problem=NOTHING))
        elif seeds is not None and kind.data in PLAYED:
            drawn.append(
                dataclasses.replace(head, problem="it plays the best agents of all seeds: leave --seeds out")
            )
        else:
            drawn.append(_attempt(picture, entries, head, report))
    return drawn


def draw_outcome(outcome: StudyOutcome) -> list[Drawn]:
    """Draw the pairs and the entries of a study with looks, and the pictures that its file names."""
    from qrlsuite.leaderboard.pictures import outcome as drawing

    study = Study(outcome.study.file, outcome.study.source)
    own = draw(study, study.members(), Selection(outcome.study.folder)) if study.file.pictures else []
    figures = {"pairs": drawing.draw(outcome), "entries": drawing.draw_entries(outcome)}
    return [*(Drawn(name, name, (), figure=figure) for name, figure in figures.items()), *own]


def draw_together(together: StudiesTogether) -> list[Drawn]:
    """Draw the pairs that several studies with looks compare, task by task."""
    from qrlsuite.leaderboard.pictures import outcome as drawing

    return [Drawn("tasks", "tasks", (), figure=drawing.draw_together(together))]


def write(name: str, pictures_: Iterable[Drawn], runs: Path, format_: str) -> list[Drawn]:
    """Write the pictures of a study that could be drawn into the results folder.

    Parameters
    ----------
    format_:
        `png`, `pdf` or `svg`.
    """
    written = []
    for drawn in pictures_:
        if drawn.figure is not None:
            path = runs / f"study-{name}-{drawn.name}.{format_}"
            write_atomically(path, pictures.encode(drawn.figure, format_))
            drawn = dataclasses.replace(drawn, path=path)
        written.append(drawn)
    return written


def _steps(entry: EntryResults) -> int:
    return int(entry.curves.shape[1]) * entry.steps_per_epoch


def _attempt(
    picture: PictureSection, entries: Sequence[EntryResults], head: Drawn, report: Report | None
) -> Drawn:
    """Draw one picture; the finished seeds may not suffice for it."""
    try:
        if pictures.KINDS[picture.kind].data == "episodes":
            figure = _episodes(picture, entries, report)
        elif pictures.KINDS[picture.kind].data == "deployed":
            figure = _deployed(picture, entries, report)
        else:
            figure = pictures.draw(picture.kind, entries, **picture.settings)
    except QrlSuiteError as error:
        return dataclasses.replace(head, problem=str(error))
    return dataclasses.replace(head, figure=figure)


def _episodes(picture: PictureSection, entries: Sequence[EntryResults], report: Report | None) -> Figure:
    """Play the episodes that a picture shows: the entries' best runs, then the reference policies."""
    assert picture.evaluation is not None  # `check` saw to it
    from qrlsuite.leaderboard.pictures import cells  # matplotlib, which is needed for drawing alone

    cells.one_task(entries, picture.kind)
    from qrlsuite.training import evaluation  # torch, which most pictures do without

    best, episodes = picture.evaluation.best, picture.evaluation.episodes
    stores = [EntryStore(entry.folder) for entry in entries]
    more: Mapping[str, Any] = {} if report is None else {"report": report}
    played = [evaluation.trained(store, best, episodes, **more) for store in stores]
    played += evaluation.references(stores[0].entry(), episodes, **more)
    values = {each.name: each.returns if each.seeds else each.returns[0] for each in played}
    chosen = min(len(each.seeds) for each in played if each.seeds)
    settings = {
        "quantity": "sum of rewards over an episode",
        "title": entries[0].task,
        "note": f"agents: the {chosen} best runs by last validation score; episodes: fresh, the same for all policies",
        **picture.settings,
    }
    histogram: Callable[..., Figure] = specs.resolve(f"{pictures.KINDS[picture.kind].module}:draw")
    return histogram(values, **settings)


def _deployed(picture: PictureSection, entries: Sequence[EntryResults], report: Report | None) -> Figure:
    """Play the entries' best runs as trained, and runs with a circuit on the backend at every value.

    Episodes on the backend are stored in the entries' folders, and not played again.
    """
    assert picture.evaluation is not None  # `check` saw to it, and to the next
    assert picture.evaluation.deployed is not None
    from qrlsuite.leaderboard.pictures import cells  # matplotlib, which is needed for drawing alone

    cells.one_task(entries, picture.kind)
    from qrlsuite.leaderboard.pictures import deployed as drawing  # matplotlib
    from qrlsuite.training import evaluation  # torch, which most pictures do without
    from qrlsuite.training.deployment import Deployment

    best, episodes, where = picture.evaluation.best, picture.evaluation.episodes, picture.evaluation.deployed
    more: Mapping[str, Any] = {} if report is None else {"report": report}
    lines = []
    for entry in entries:
        store = EntryStore(entry.folder)
        trained = evaluation.trained(store, best, episodes, **more)
        elsewhere = []
        if getattr(store.entry().model_options, "backend", None) is not None:
            for value in where.values:
                deployment = Deployment(store, where.backend, where.chosen(value), best)
                if not deployment.simulator:
                    raise OptionError(
                        f"{deployment.name} is no simulator: a study executes nothing on hardware; use `qrlsuite "
                        "evaluate` with --yes"
                    )
                elsewhere.append(deployment.play(episodes, 0, **more))
        lines.append(drawing.Line(trained, tuple(elsewhere)))
    from qrlsuite.leaderboard.pictures import style

    settings = {"title": style.heading(entries), "axis": where.vary, **picture.settings}
    return drawing.draw(
        lines, [f"{value:,}" if type(value) is int else f"{value}" for value in where.values], **settings
    )
