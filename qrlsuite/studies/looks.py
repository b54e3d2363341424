"""Studies with looks: which of several entries needs fewer steps, with as many seeds as it takes.

The table `[looks]` of a study file fixes, before the first seed is trained, which pairs are compared, at which numbers
of seeds the results are looked at, and at which error (`qrlsuite.statistics.sequential`). The seeds are the study's
own, in a folder of its own:

    <runs>/decisions/<name>/plan.toml           the study as it was when its first seed began
                            looks.jsonl         times of the first seed and of each look, and the look's results
                            <task>/<entry>/...  as in any results folder; each seed's record has the study's hash

Verdicts follow from the study and the curves. The log has the time of each look, and reveals curves that were changed
after it. By rule `steps` it has p, too, which 10,000 relabelings check at every later reading. Leaderboards do not read
this folder: if the number of seeds depends on results, the p-value of a fixed number of seeds does not hold.
"""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
from numpy.typing import NDArray

from qrlsuite import files, notation, options
from qrlsuite.errors import OptionError, QrlSuiteError, StoreError
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.experiment.preset import TUNING_SEEDS, EntryTuning
from qrlsuite.experiment.task import digest
from qrlsuite.results import requests
from qrlsuite.results.records import DecidedClaim, DecidedPair, LookLine
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.store import EntryStore, append, json_line, read_records, write_atomically
from qrlsuite.statistics import Grid, LearningCurves, SequentialDesign, decide
from qrlsuite.statistics.sequential import Claim, Decision
from qrlsuite.studies.state import State
from qrlsuite.studies.study import (
    EntriesSection,
    LooksSection,
    Member,
    StudyFile,
    dumps,
    load_kept,
    question_of,
    setting,
)
from qrlsuite.tuning.search import FOLDER as TUNING

Curves = Mapping[int, NDArray[np.float64]]
"""Learning curves of finished seeds by seed, of shape (T,) or longer."""
FOLDER = "decisions"
"""Below the results folder: studies with looks have a folder each, so that leaderboards do not rank their seeds."""
FILE, LOG = "plan.toml", "looks.jsonl"
LONG = 40
"""Characters of a name beyond which a new study leaves out the common part of its names."""


class Study:
    """A study with looks and its results folder.

    Attributes
    ----------
    file:
        The study with every entry by itself, and all that is fixed written out.
    looks:
        Its table.
    hash:
        Sixteen hexadecimal digits over all that decides.
    entries:
        The entries by the name that verdicts use, in the study's order.
    design:
        The tests, and the looks at which they are made.
    questions:
        For each pair the question that it answers; empty where the study asks none.
    folder:
        Where its results are, or will be.
    """

    def __init__(self, file: StudyFile, runs: Path) -> None:
        if file.looks is None:
            raise OptionError(f"study '{file.name}' has no looks: add a table [looks] to {file.origin}")
        self.source, self.runs = file.origin, runs
        self.folder = runs / FOLDER / file.name
        self.file, members = _fixed(file)
        if self.begun and (self.folder / FILE).is_file():
            self.file = _as_begun(self.file, load_kept(self.folder / FILE))
        self.looks = self.file.looks or LooksSection()
        self.hash = digest(_content(self.file))
        self.epochs = self.looks.epochs or 0
        tables = self.file.entries
        names = tuple(table.name or name for table, name in zip(tables, _names([m.entry for m in members])))
        own = [
            replace(m.entry, study=self.hash, tuning=table.tuning.plain() if table.tuning else m.entry.tuning)
            for m, table in zip(members, tables)
        ]
        self.entries: dict[str, Entry] = dict(zip(names, own))
        self.questions = [asked.text for asked in self.looks.questions for _ in asked.pairs]
        try:
            self.design = self._design(names)
            if self.looks.epsilons is not None:  # no rule here needs delta
                self.grid = Grid.relative(self.looks.epsilons, [0.5])
            else:
                goal = members[0].entry.task.file.ranking.goal
                self.grid = Grid.absolute(self.looks.thresholds or [], [0.5], goal)
        except OptionError as error:
            raise OptionError(f"{self.source}: {error}") from None
        self._check_block()

    def _design(self, names: tuple[str, ...]) -> SequentialDesign:
        looks = self.looks
        return SequentialDesign(
            names,
            tuple(looks.looks),
            looks.alpha,
            looks.spending,  # type: ignore[arg-type]  # checked there
            looks.margin,
            pairs=tuple(pair for asked in looks.questions for pair in asked.pairs) or None,
            reason=looks.reason,
            rule=looks.rule,
            claims=tuple(
                Claim(each.entry, tuple(each.rivals), each.at_most, each.tasks) for each in looks.claims
            ),
        )

    @property
    def name(self) -> str:
        """The study's name."""
        return self.file.name

    @property
    def task(self) -> str:
        """The name of the task on which all entries are compared."""
        return next(iter(self.entries.values())).task.name

    @property
    def made_for(self) -> str:
        """The family of models that the environment was made for, if it was made for one."""
        return next(iter(self.entries.values())).task.environment.made_for

    def _check_block(self) -> None:
        """Refuse seeds that belong to others."""
        block = self.looks.block
        protocol = max(entry.task.file.protocol.seeds for entry in self.entries.values())
        if block.start < protocol:
            raise OptionError(
                f"{self.source}: first_seed = {block.start}: seeds 0:{protocol} are the protocol's, and "
                f"somebody may have seen them; begin at {protocol} or later"
            )
        if block.stop > TUNING_SEEDS:
            raise OptionError(
                f"{self.source}: first_seed = {block.start}: seeds from {TUNING_SEEDS} up are for tuning; "
                "the block has to end below"
            )

    @property
    def begun(self) -> bool:
        """Whether a seed was begun: from then on the study is fixed."""
        return has_begun(self.runs, self.name)

    def check(self) -> bool:
        """Refuse a study that changed after it began, or whose seeds were trained before; return whether it began."""
        if not self.begun:
            self._require_code_of_new_entries()
            for line in self.seen_before():
                raise OptionError(
                    f"{self.source}: {line}: a study with looks needs seeds that nobody has seen; with first_seed = "
                    f"{self._next_block()} it has others"
                )
            return False
        before, after = _content(load_kept(self.folder / FILE)), _content(self.file)
        if digest(before) != self.hash:
            changes = [
                f"{key} (was {_short(before.get(key))}, is {_short(after.get(key))})"
                for key in {**before, **after}
                if before.get(key) != after.get(key)
            ]
            raise OptionError(
                f"{self.source}: {', '.join(changes)} changed after the study began. End this study and write "
                f"a new one with other seeds (the study as it began: {self.folder / FILE})"
            )
        return True

    def seen_before(self) -> Iterator[str]:
        """Yield a line for each entry with seeds of the block elsewhere, and for each other study that began with them.

        A log that does not say with which seeds a study of these entries began may mean these.
        """
        own, studies = self.looks.block, sorted((self.runs / FOLDER).glob("*"))
        for folder in (self.runs, self.runs / TUNING, *(path for path in studies if path != self.folder)):
            for name, entry in self.entries.items():
                path = folder / entry.task.name / entry.name
                if seeds := [seed for seed in EntryStore(path).seeds() if seed in own]:
                    yield f"seeds {format_seeds(seeds)} of '{name}' were trained already ({path})"
        for log in (path / LOG for path in studies if (path / LOG).is_file()):
            file, lines = log.with_name(FILE), read_records(log, LookLine)
            blocks = {line.plan: range(*line.seeds) for line in lines if line.seeds}
            kept = load_kept(file) if file.is_file() else self.file.model_copy(update={"entries": []})
            if kept.looks is not None:
                blocks.setdefault(digest(_content(kept)), kept.looks.block)
            shared = {table.hash for table in self.file.entries} & {table.hash for table in kept.entries}
            for plan in dict.fromkeys(line.plan for line in lines if line.plan not in (None, self.hash)):
                block = blocks.get(plan, own)
                common = range(max(block.start, own.start), min(block.stop, own.stop))
                if common and (shared or log.parent == self.folder):
                    yield (
                        f"study {plan} has seen these seeds ({log}), and their results may have shaped this study"
                    )

    def _next_block(self) -> int:
        return self.looks.first_seed + max(1000, len(self.looks.block))

    def begin(self) -> None:
        """Store the study in its present form, before its first seed."""
        begun = self.check()
        if begun:
            self._require_code_of_new_entries()
        log = self._log()
        if (when := next((line.ended for line in log if line.ended), None)) is not None:
            raise OptionError(
                f"{self.source}: the study was ended on {when}; a new one needs a name of its own"
            )
        if not begun:
            write_atomically(self.folder / FILE, dumps(self.file).encode())
            if self._begun_at(log) is None:
                block = [self.looks.block.start, self.looks.block.stop]
                append(self.folder / LOG, json_line({"begun": _now(), "plan": self.hash, "seeds": block}))

    def _require_code_of_new_entries(self) -> None:
        """Refuse an entry without seeds if its code is not the code in the study's hash."""
        for table, (name, entry) in zip(self.file.entries, self.entries.items()):
            store = EntryStore.find(self.folder, entry)
            if not store.seeds() and _has_other_code(table, entry):
                raise OptionError(
                    f"{self.source}: the code of '{name}' has changed since the study was written, and the study's "
                    "hash covers it: restore that code, or write another study with `qrlsuite study new`"
                )

    def end(self) -> None:
        """Close the study for good, with its open pairs open."""
        state = self.read()
        if not state.begun:
            raise OptionError(f"{self.source}: the study has not begun, so there is nothing to end")
        if state.ended is not None:
            raise OptionError(f"{self.source}: the study was ended on {state.ended} already")
        if state.decision.finished:
            raise OptionError(f"{self.source}: everything is decided, so there is nothing to end")
        append(self.folder / LOG, json_line({"ended": _now()}))

    def read(self) -> State:
        """Read the folder once, and decide by it; writes nothing."""
        begun, trained, hours = self.check(), dict[str, Curves](), dict[str, float]()
        for name, entry in self.entries.items():
            store, curves = EntryStore.find(self.folder, entry), dict[int, NDArray[np.float64]]()
            trained[name], hours[name] = curves, 0.0
            for seed in store.seeds():
                folder, record = store.seed(seed), store.seed(seed).record()
                if record is not None:
                    self.require_own(name, seed, record.plan)
                if record is not None and record.finished and record.epochs >= self.epochs:
                    run = folder.read()
                    curves[seed] = run.curve
                    hours[name] += run.seconds / 3600
                else:
                    hours[name] += folder.seconds() / 3600
        state, lost = self.state(trained, hours, begun), dict[str, str]()
        end = self.looks.first_seed + max(state.taken, default=0)
        for name, entry in self.entries.items():
            store = EntryStore.find(self.folder, entry)
            asked = [seed for seed in requests.read(store)[0] if seed < end]
            if missing := [seed for seed in asked if seed not in trained[name]]:
                lost[name] = requests.missing_text(store, missing, len(asked))
        return replace(state, lost=lost)

    def require_own(self, name: str, seed: int, study: str | None) -> None:
        """Refuse a seed of the block that another study, or none, has trained."""
        if seed in self.looks.block and study != self.hash:
            path = EntryStore.find(self.folder, self.entries[name]).seed(seed).path
            raise StoreError(
                f"{path}: seed {seed} of '{name}' was not trained by study {self.hash}; delete that folder, and the "
                "study trains it"
            )

    def state(self, trained: Mapping[str, Curves], hours: Mapping[str, float], begun: bool) -> State:
        """Decide by the curves of finished seeds, and compare with the log of looks."""
        log = [line for line in self._log() if line.plan in (None, self.hash)]
        seeds, curves = dict[str, range](), dict[str, LearningCurves]()
        for name, done in trained.items():
            gap = next((seed for seed in self.looks.block if seed not in done), self.looks.block.stop)
            seeds[name] = range(self.looks.block.start, gap)
            if seeds[name]:
                values = np.stack([done[seed][: self.epochs] for seed in seeds[name]])
                steps = self.entries[name].task.file.protocol.interactions
                curves[name] = LearningCurves(values, steps, name)
        seen = [line for line in log if line.curves is not None and line.curves == _seen(line, curves)]
        known: dict[tuple[int, tuple[str, ...]], tuple[float, int]] = {
            (line.look or 0, tuple(pair.pair)): (pair.p, pair.relabelings)
            for line in seen
            for pair in line.pairs
            if pair.p is not None and pair.relabelings
        }
        known |= {
            (line.look or 0, (claim.entry, rival, str(claim.at_most))): (p, count)
            for line in seen
            for claim in line.claims
            for rival, p, count in zip(claim.rivals, claim.p, claim.relabelings)
        }
        decision = decide(self.design, curves, self.grid, known)
        self._compare(_lines(self.design, decision, curves), log)
        return State(
            self,
            begun,
            begun_at=self._begun_at(log),
            ended=next((line.ended for line in log if line.ended), None),
            taken=dict(sorted({line.look: line.time or "" for line in reversed(log) if line.look}.items())),
            seeds=seeds,
            curves=curves,
            hours=hours,
            decision=decision,
        )

    def _compare(self, lines: Sequence[LookLine], log: Sequence[LookLine]) -> None:
        """Refuse curves that a look did not see, or by which it finds something else than the log says."""
        for line in lines:
            for before in (before for before in log if before.look == line.look):
                turned = [
                    f"; it found '{then.decided}' for {' and '.join(now.pair)}, now it is '{now.decided}'"
                    for now, then in zip(line.pairs, before.pairs)
                    if now.decided != then.decided
                ]
                turned += [
                    f"; a claim about {now.entry} was{' not' * now.established} established"
                    for now, then in zip(line.claims, before.claims)
                    if now.established != then.established
                ]
                if turned or before.curves not in (None, line.curves):
                    raise StoreError(
                        f"{self.folder / LOG}: the look at {line.look} seeds saw other curves than are there now"
                        f"{''.join(turned)}: results were changed since; restore them"
                    )

    def _log(self) -> list[LookLine]:
        return read_records(self.folder / LOG, LookLine)

    def _begun_at(self, log: Sequence[LookLine]) -> str | None:
        return next((line.begun for line in log if line.begun and line.plan == self.hash), None)

    def look(self) -> State:
        """Take every look for which the seeds are there, and note when."""
        state = self.read()
        taken = dict(state.taken)
        for line in _lines(self.design, state.decision, state.curves):
            if line.look is not None and line.look not in state.taken:
                taken[line.look] = _now()
                content = {"time": taken[line.look], "plan": self.hash, **line.content}
                append(self.folder / LOG, json_line(content))
        return replace(state, taken=taken)


def folders(runs: Path) -> list[Path]:
    """Return the folders of the studies that have begun in a results folder."""
    return [path.parent for path in sorted((runs / FOLDER).glob(f"*/{FILE}"))]


def in_folder(runs: Path, tasks: Sequence[str] = ()) -> tuple[list[State], list[str]]:
    """Return the outcomes of the studies that have begun in a results folder, and a line for each unreadable study.

    Parameters
    ----------
    tasks:
        Only studies of these tasks; all where empty.
    """
    outcomes, refused = [], []
    for path in folders(runs):
        try:
            study = Study(load_kept(path / FILE), runs)
            if study.begun and (not tasks or study.task in tasks):
                outcomes.append(study.read())
        except QrlSuiteError as error:
            refused.append(str(error))
    return outcomes, refused


def has_begun(runs: Path, name: str) -> bool:
    """Return whether a results folder has a seed of the study with a name."""
    return any((runs / FOLDER / name).glob("*/*/seed-*"))


def new(
    name: str,
    task: str,
    entries: Sequence[str],
    runs: Path,
    *,
    first_seed: int | None = None,
    folder: Path = Path(),
    **looks: Any,
) -> Study:
    """Return a new study with looks, dated now; writes nothing.

    Parameters
    ----------
    entries:
        Each as `[ALGORITHM] MODEL NAME=VALUE ...`, with a name before it where one is wanted, `wide, tuned: mlp
        preset=FILE.toml`. A setting `preset=FILE.toml` gives the values of a preset file, with the record of how they
        were found.
    first_seed:
        None for the first block from 10,000 without a trained seed below `runs`.
    folder:
        Where commands of scripts are started: the folder of the study's file.
    looks:
        Further fields of `LooksSection`; None takes the default.
    """
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    looks |= {"written": now, "first_seed": first_seed}
    try:
        file = StudyFile(
            format_version=1,
            name=name,
            summary=question_of([]),
            looks=LooksSection(**{key: value for key, value in looks.items() if value is not None}),
            entries=[
                EntriesSection(task=task, model=text, name=name or None)
                for name, text in map(_named, entries)
            ],
        ).started_in(folder)
    except pydantic.ValidationError as error:
        raise OptionError("; ".join(files.problems(error, StudyFile))) from None
    study = Study(file.of("the study"), runs)
    while first_seed is None and any(study.seen_before()):
        moved = study.looks.model_copy(update={"first_seed": study._next_block()})
        study = Study(study.file.model_copy(update={"looks": moved}).of("the study"), runs)
    names, shared = list(study.entries), list[str]()
    if not any(table.name for table in study.file.entries):  # names that were written stay as they are
        names, shared = _brief(names)
    if shared:
        tables = [table.model_copy(update={"name": name}) for table, name in zip(study.file.entries, names)]
        study = Study(study.file.model_copy(update={"entries": tables}).of("the study"), runs)
    summary = question_of(names) + (f" All have {' '.join(shared)}." if shared else "")
    study.file = study.file.model_copy(update={"summary": summary})
    return study


def _named(text: str) -> tuple[str, str]:
    """Return the name that is written before an entry, `wide: mlp width=64`, or an empty one; and the entry.

    >>> _named("wide, tuned: mlp preset=wide.toml"), _named("mlp width=64")
    (('wide, tuned', 'mlp preset=wide.toml'), ('', 'mlp width=64'))
    """
    name, colon, entry = text.partition(": ")
    return (name.strip(), entry.strip()) if colon else ("", text)


def _brief(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return names without the options that all have, where one is too long for a table's line; and these options."""
    words = [notation.split(name) for name in names]
    shared = [
        word
        for word in words[0]
        if "=" in word and all(word in each for each in words) and max(map(len, names)) > LONG
    ]
    brief = [" ".join(word for word in each if word not in shared) for each in words]
    return (brief, shared) if len(set(brief)) == len(brief) else (list(names), [])


def _fixed(file: StudyFile) -> tuple[StudyFile, list[Member]]:
    """Return a study with every entry by itself, its hash, and all that is compared written out; and its entries."""
    members, source = file.members(), file.origin
    if len(members) < 2:
        labels = [member.table.name or member.entry.label for member in members]
        raise OptionError(f"{source}: entries = {labels}: a study with looks needs two or more entries")
    for index, (table, entry) in enumerate((member.table, member.entry) for member in members):
        if table.hash not in (None, entry.hash):
            raise OptionError(
                f"{source}: entries.{index}.hash is '{table.hash}', these options make '{entry.hash}' here: "
                "the options have changed; write a new study with `qrlsuite study new`"
            )
        for before, other in enumerate(members[:index]):
            if other.entry.hash == entry.hash:
                raise OptionError(
                    f"{source}: entries.{before} and entries.{index} are the same, '{entry.label}': leave one out"
                )
    looks = file.looks or LooksSection()
    entries = [member.entry for member in members]
    if len({entry.task.world for entry in entries}) > 1:
        tasks = sorted({entry.task.name for entry in entries})
        raise OptionError(f"{source}: entries of {' and '.join(tasks)}: a study with looks has one task")
    fixed: dict[str, Any] = {"epochs": looks.epochs or _common_epochs(source, entries)}
    if looks.epsilons is None and looks.thresholds is None:
        ranking = entries[0].task.file.ranking
        fixed |= {"epsilons": ranking.epsilons, "thresholds": ranking.thresholds}
    alone = Counter(member.group for member in members)
    tables = [_fixed_table(member, named=alone[member.group] == 1) for member in members]
    return file.model_copy(update={"looks": looks.model_copy(update=fixed), "entries": tables}), members


def _common_epochs(source: str, entries: Sequence[Entry]) -> int:
    lengths = {entry.label: entry.epochs for entry in entries}
    if len(set(lengths.values())) > 1:
        steps = entries[0].task.file.protocol.interactions
        ends = ", ".join(f"'{label}' at {count * steps} steps" for label, count in lengths.items())
        raise OptionError(
            f"{source}: the entries end at different horizons: {ends}; give epochs (--epochs) for all of them"
        )
    return next(iter(lengths.values()))


def _fixed_table(member: Member, named: bool) -> EntriesSection:
    """Return an entry's table with the values and the record of its preset file, so that the file can change later."""
    table, entry = member.table, member.entry
    if table.hash is not None:
        return table
    preset, values, tuning = table.preset, table.options, entry.tuning
    if preset is not None and preset.endswith(".toml"):
        settings = [setting("options", word, value) for word, value in values.items()]
        usual = resolve(str(table.task), str(table.model), entry.algorithm.name, settings)
        preset, values = None, {**values, **_difference(entry, usual)}
    return table.model_copy(
        update={
            "name": table.name if named else None,
            "algorithm": entry.algorithm.name,
            "preset": preset,
            "options": values,
            "hash": entry.hash,
            "tuning": None if tuning is None or preset is not None else EntryTuning(**tuning),
            "code": code_of(entry),
        }
    )


def code_of(entry: Entry) -> str | None:
    """Return the digest of an entry's code where a plugin's is among it; None where all is the suite's."""
    return identity.of(entry).digest if entry.third_party() else None


def _has_other_code(table: EntriesSection, entry: Entry) -> bool:
    """Return whether an entry's code has changed; a script that was found in a folder has none here."""
    found = entry.script is not None and entry.folder is None
    return not found and table.code not in (None, code_of(entry))


def _as_begun(file: StudyFile, kept: StudyFile) -> StudyFile:
    """Return a study that has begun, with its entries' code of then, without which training is refused.

    A file that names no rule has the rule that was the default then.
    """
    if file.looks is not None and kept.looks is not None and "rule" not in file.looks.model_fields_set:
        file = file.model_copy(update={"looks": file.looks.model_copy(update={"rule": kept.looks.rule})})
    codes = {table.hash: table.code for table in kept.entries}
    tables = [
        table.model_copy(update={"code": codes[table.hash]}) if table.hash in codes else table
        for table in file.entries
    ]
    return file.model_copy(update={"entries": tables})


def _difference(entry: Entry, other: Entry) -> dict[str, Any]:
    """Return the options in which an entry differs from another of the same model and algorithm, by full name."""
    sides = {
        "algorithm": (entry.algorithm_options, other.algorithm_options),
        "model": (entry.model_options, other.model_options),
    }
    return {
        f"{side}.{name}": value
        for side, (own, others) in sides.items()
        for name, value in options.plain(own).items()
        if value != options.plain(others)[name]
    }


def _content(file: StudyFile) -> dict[str, Any]:
    """Return all that decides, in the layout of version 0.1, whose studies keep their hash."""
    looks = (file.looks or LooksSection()).model_dump(mode="json")
    task = next((table.task for table in file.entries), None)
    for key in ("questions", "claims"):
        if not looks[key]:
            del looks[key]
    keys = {"model", "algorithm", "preset", "options", "hash", "name", "tuning", "code"}
    entries = [table.model_dump(mode="json", include=keys) for table in file.entries]
    for entry in entries:
        for key in ("name", "tuning", "code"):
            if entry[key] is None:
                del entry[key]
    return {"format_version": 1, "name": file.name, "task": task, **looks, "entries": entries}


def _lines(
    design: SequentialDesign, decision: Decision, curves: Mapping[str, LearningCurves]
) -> list[LookLine]:
    """Return the results of each look: for every open pair and claim, its p and how it was closed."""
    lines = []
    for index, look in enumerate(design.looks):
        pairs = [
            DecidedPair(
                pair=[pair.first, pair.second],
                p=pair.p[index],
                decided=None if pair.decided is None or index < len(pair.p) - 1 else str(pair.decided),
                **({"relabelings": pair.relabelings[index]} if pair.relabelings else {}),
            )
            for pair in decision.pairs
            if index < len(pair.p)
        ]
        claims = [
            DecidedClaim(
                entry=each.claim.entry,
                rivals=list(each.claim.rivals),
                at_most=each.claim.at_most,
                p=list(each.p[index]),
                relabelings=list(each.relabelings[index]),
                established=each.established is not None and each.established <= look,
            )
            for each in decision.claims
            if index < len(each.p)
        ]
        if pairs or claims:
            line = LookLine(look=look, pairs=pairs)
            if claims:
                line = line.changed(claims=[claim.content for claim in claims])
            seen = {"seed": design.seed, "curves": _seen(line, curves)} if design.rule == "steps" else {}
            lines.append(line.changed(**seen))
    return lines


def _seen(line: LookLine, curves: Mapping[str, LearningCurves]) -> str:
    """Return the digest of the curves that a look sees; missing curves are left out."""
    names = {name for pair in line.pairs for name in pair.pair}
    names |= {name for claim in line.claims for name in (claim.entry, *claim.rivals)}
    return digest({name: curves[name].values[: line.look].tolist() for name in names & {*curves}})


def _names(entries: Sequence[Entry]) -> list[str]:
    """Return the names of entries in verdicts: label without algorithm, label or name, the shortest unique one."""
    short = [entry.label.partition(" ")[2] for entry in entries]
    labels = [entry.label for entry in entries]
    result = []
    for index, entry in enumerate(entries):
        chosen = (names[index] for names in (short, labels) if Counter(names)[names[index]] == 1)
        result.append(next(chosen, entry.name))
    return result


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
