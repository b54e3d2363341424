"""The state of a study with looks, for a screen, a page, and as plain values."""

from __future__ import annotations

import copy
import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from qrlsuite.engine.sheet import Sheet
from qrlsuite.engine.terminal import Shown, command, printable
from qrlsuite.errors import OptionError, nearest
from qrlsuite.experiment import identity
from qrlsuite.experiment.entry import resolve
from qrlsuite.experiment.preset import TUNING_SEEDS
from qrlsuite.results import speed
from qrlsuite.results.seeds import format_seeds
from qrlsuite.results.text import (
    counted,
    hours_range,
    hours_text,
    interval_text,
    mean_text,
    p_text,
    percent,
    score_text,
)
from qrlsuite.statistics import LearningCurves
from qrlsuite.statistics.final import final_scores
from qrlsuite.statistics.grid import Grid
from qrlsuite.statistics.planning import runs_at_difference
from qrlsuite.statistics.sequential import Decided, Decision, PairDecision
from qrlsuite.statistics.times import MeanTime, mean_time

if TYPE_CHECKING:
    from qrlsuite.studies.looks import Study

Pair = TypeVar("Pair")
"""A pair's decision, or more facts on it."""

NEAR = 0.9
"""Share of the horizon that entries spend below thresholds, beyond which they can hardly be told apart."""

Hours = tuple[float, float]
"""Least and most core-hours to be expected; both the same where they were measured on the entry's own seeds."""


@dataclass(frozen=True, eq=False, repr=False)
class State(Shown):
    """The progress of a study with looks: its trained seeds, and its decided pairs.

    Attributes
    ----------
    begun_at, ended:
        When the first seed was begun, and when the study was ended before all was decided, by its log.
    taken:
        When each look was taken, by its number of seeds.
    seeds:
        Finished seeds of each entry, from the block's first on without a gap.
    curves:
        Their learning curves; entries without any are absent.
    hours:
        Core-hours of each entry, with its unfinished seeds.
    decision:
        Every pair with its verdict, p at each look, difference and interval.
    submitted:
        One line for each entry whose seeds were handed to a queue.
    lost:
        By entry, a sentence about seeds that were asked for and are not there.
    notes:
        On the entries: how their settings were found, and what trained them.
    """

    study: Study
    begun: bool
    begun_at: str | None
    ended: str | None
    taken: Mapping[int, str]
    seeds: Mapping[str, Sequence[int]]
    curves: Mapping[str, LearningCurves]
    hours: Mapping[str, float]
    decision: Decision
    submitted: tuple[str, ...] = ()
    lost: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def missing(self) -> dict[str, int]:
        """How many seeds each open entry lacks for the next look; none where it has them."""
        lacking = {name: count - len(self.seeds[name]) for name, count in self.decision.wanted.items()}
        return {name: count for name, count in lacking.items() if count > 0}

    @property
    def pairs(self) -> tuple[PairDecision, ...]:
        """The compared pairs; `verdict` is its words."""
        return self.decision.pairs

    @property
    def finished(self) -> bool:
        """Whether every pair is decided or its last look was taken."""
        return self.decision.finished

    @property
    def looked(self) -> dict[str, int]:
        """Seeds of each entry at its last look; 0 where no look has reached it."""
        seeds = dict.fromkeys(self.study.entries, 0)
        looked = [(name, pair.n_runs) for pair in self.pairs for name in (pair.first, pair.second)]
        looked += [(name, each.n_runs) for each in self.decision.claims for name in each.claim.names]
        for name, n_runs in looked:
            seeds[name] = max(seeds[name], n_runs)
        return seeds

    @property
    def claims(self) -> list[str]:
        """A sentence for each claim, with its state: established or not."""
        return [f"claim: {each.claim.sentence}: {each.verdict}" for each in self.decision.claims]

    def labeled(self, words: Sequence[str]) -> State:
        """Return the state with names of your own, `ENTRY=TEXT` each."""
        called = {name: name for name in self.study.entries}
        for word in words:
            name = max((each for each in called if word.startswith(f"{each}=")), key=len, default="")
            text = word[len(name) + 1 :].strip()
            if not name or not text or text in called.values():
                meant = nearest(word.rpartition("=")[0], called) * (not name)
                raise OptionError(
                    f"--label {printable(word)}: write ENTRY=TEXT, and another text for each entry{meant}"
                )
            called[name] = text

        def renamed(values: Mapping[str, Any]) -> dict[str, Any]:
            return {called[name]: value for name, value in values.items()}

        study = copy.copy(self.study)
        study.entries = renamed(study.entries)
        pairs = (replace(p, first=called[p.first], second=called[p.second]) for p in self.pairs)
        claims = tuple(
            replace(
                each, claim=replace(each.claim, entry=called[entry], rivals=tuple(called[n] for n in rivals))
            )
            for each in self.decision.claims
            for entry, *rivals in [each.claim.names]
        )
        wanted = renamed(self.decision.wanted)
        decision = replace(self.decision, pairs=tuple(pairs), wanted=wanted, claims=claims)
        facts: dict[str, Any] = {
            name: renamed(getattr(self, name)) for name in ("seeds", "curves", "hours", "lost")
        }
        return replace(self, study=study, decision=decision, **facts)

    def mean_times(self) -> dict[str, MeanTime]:
        """Return M of each entry, its mean steps below threshold, over the seeds of its last look.

        Entries that no look has reached are absent.
        """
        looked = self.looked
        return {
            name: mean_time(replace(curves, values=curves.values[: looked[name]]), self.study.grid)
            for name, curves in self.curves.items()
            if looked[name]
        }

    def cost(self, seeds: Mapping[str, int]) -> Hours | None:
        """Return the core-hours of seeds of several entries together; None where one is unknown.

        They are measured on an entry's own seeds, else estimated.
        """
        known = [self._hours(name, count) for name, count in seeds.items()]
        if None in known:
            return None
        low, high = (sum(each[end] for each in known if each is not None) for end in (0, 1))
        return low, high

    def _hours(self, name: str, seeds: int) -> Hours | None:
        if done := len(self.seeds[name]):
            hours = seeds * self.hours[name] / done
            return hours, hours
        own = speed.find(self.study.entries[name], None, self.study.folder, self.study.runs)
        if own is None:
            return None
        low, high = (math.copysign(end / 3600, seeds) for end in own.range(abs(seeds) * self.study.epochs))
        return low, high

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        study, decision = self.study, self.decision
        protocol = {name: entry.task.file.protocol.seeds for name, entry in study.entries.items()}
        used = {name: len(self.seeds[name]) for name in study.entries}
        closed = [name for name in study.entries if name not in decision.wanted]
        saved = {name: protocol[name] - used[name] for name in closed if used[name]}
        times = self.mean_times()
        looks = study.looks.model_dump(mode="json", exclude=None if study.looks.claims else {"claims"})
        claims = [
            {
                **asdict(each),
                "claim": each.claim.sentence,
                "verdict": each.verdict,
                "excluded": _number(each.excluded),
            }
            for each in decision.claims
        ]
        return {
            "name": study.name,
            "summary": study.file.summary,
            "hash": study.hash,
            "task": study.task,
            "looks": looks | {"levels": self.levels()},
            "begun": self.begun,
            "finished": decision.finished,
            "begun_at": self.begun_at,
            "ended": self.ended,
            "looks_taken": dict(self.taken),
            "pairs": [
                {"question": asked or None, **self._pair(pair)}
                for asked, pairs in by_question(study, decision.pairs)
                for pair in pairs
            ],
            "entries": [
                {
                    "name": name,
                    "entry": entry.name,
                    "seeds": used[name],
                    "core_hours": self.hours[name],
                    "mean_time": times[name].mean if name in times else None,
                    "mean_time_interval": list(times[name].interval) if name in times else None,
                    "wanted": decision.wanted.get(name),
                    "missing": self.missing.get(name, 0),
                }
                for name, entry in study.entries.items()
            ],
            "next_core_hours": self.cost(self.missing),
            "protocol_seeds": sum(protocol.values()),
            "seeds_saved": sum(saved.values()),
            "core_hours_saved": self.cost(saved),
            "core_hours_at_most": self.cost(dict.fromkeys(study.entries, study.design.looks[-1])),
            "submitted": list(self.submitted),
            **({"claims": claims} if claims else {}),
            **({"lost": dict(self.lost)} if self.lost else {}),
            **({"notes": list(self.notes)} if self.notes else {}),
        }

    def levels(self) -> list[dict[str, Any]]:
        """Return at which p a pair differs at each look while all are open, and is equal by each one-sided test."""
        design = self.study.design
        return [
            {
                "seeds": seeds,
                "differs": design.level(look, len(design.family)),
                "equal": design.equal_level(look),
            }
            for look, seeds in enumerate(design.looks)
        ]

    def _pair(self, pair: PairDecision) -> dict[str, Any]:
        decision = self.decision
        needs = None
        if pair.decided is None:
            look = len(pair.p)
            undecided = sum(not each.differs for each in decision.pairs)
            needs = {
                "seeds": self.study.design.looks[look],
                "level": self.study.design.level(look, undecided),
                "seeds_at_this_difference": runs_at_difference(decision, pair),
            }
        finite = _finite(pair)
        led = finite and self.study.design.rule == "times"
        return {
            "first": pair.first,
            "second": pair.second,
            "verdict": pair.verdict,
            "at_horizon": self.late(pair),
            "decided": None if pair.decided is None else str(pair.decided),
            "seeds": pair.n_runs,
            "p": list(pair.p),
            "levels": list(pair.levels),
            "difference": pair.difference if finite else None,
            "interval": list(pair.interval) if finite else None,
            "final_scores": self.finals(pair) or None,
            "leading_threshold": self.study.grid.thresholds[pair.leading] if led else None,
            "leading_difference": _number(pair.leading_difference) if finite else None,
            "leading_interval": [_number(end) for end in pair.leading_interval] if led else None,
            "needs": needs,
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Show the question; the design before the first seed, later the pairs; the cost."""
        study, facts = self.study, self.as_dict()
        yield Text(f"{study.name}: {study.file.summary}", style="bold")
        if not self.begun:
            yield from map(Text, self._design())
        for sheet in self.sheets():
            if sheet.title != study.file.summary:
                yield Text(sheet.title, style="bold")
            yield replace(sheet, title="")
        yield from map(Text, self.claims)
        if self.claims:
            yield Text(
                f"Each claim has an error of {study.looks.alpha:g} of its own, on one side, over all looks. A lead of "
                "10 percent: the best of its rivals needs 10 percent more."
            )
        if any(pair.p for pair in self.pairs):
            yield Text(
                "B against A: how many more steps B needs, on average over the thresholds (+52% = B is slower), with "
                f"a repeated confidence interval that holds at every look ({100 * (1 - study.looks.alpha):g} percent "
                "for all pairs together). Each threshold is tested separately: where this interval contains 0, the "
                "threshold that decided follows with its own. An early stop overstates the difference."
            )
            yield _entries_sheet(facts["entries"], study.grid.before)
            yield Text(
                f"steps {study.grid.before} threshold: of a run of the entry, mean over seeds and thresholds, at its "
                "last look"
            )
        if note := horizon_note(self):
            yield Text(note)
        if self.begun_at:
            yield Text(f"hash {study.hash}, first seed begun {self.begun_at}")
        for seeds, when in facts["looks_taken"].items():
            yield Text(f"look at {seeds} seeds taken {when}")
        told = reason_note(study), lost_note(self), TURNED.get(study.hash), *self.notes
        yield from map(Text, filter(None, told))
        yield from map(Text, self._cost(facts))

    def sheets(self) -> list[Sheet]:
        """Return a table of pairs for each question."""
        pairs = list(zip(self.pairs, self.as_dict()["pairs"]))
        questions = by_question(self.study, pairs)
        return [
            replace(
                _sheet(self, of),
                title=asked or self.study.file.summary,
                label=self.study.name + f"-{number}" * (len(questions) > 1),
            )
            for number, (asked, of) in enumerate(questions, 1)
        ]

    def late(self, pair: PairDecision) -> bool:
        """Tell whether a pair is not known to differ, and cannot be: both entries hardly leave the horizon."""
        differs = pair.decided in (Decided.FIRST, Decided.SECOND, Decided.TRADE_OFF)
        return not differs and {pair.first, pair.second} <= self._late

    @functools.cached_property
    def _late(self) -> set[str]:
        first = next(iter(self.study.entries.values()))
        horizon = self.study.epochs * first.task.file.protocol.interactions
        return {name for name, time in self.mean_times().items() if time.mean >= NEAR * horizon}

    def verdict(self, pair: PairDecision) -> str:
        """Return a pair's verdict, and whether there was no time for another one."""
        return f"{pair.verdict}, at the horizon" if self.late(pair) else pair.verdict

    def finals(self, pair: PairDecision) -> list[float]:
        """Return both final scores at a pair's last look; empty before. They have no p: looks stop by steps."""
        seen = [
            replace(self.curves[name], values=self.curves[name].values[: pair.n_runs])
            for name in (pair.first, pair.second)
            if pair.p
        ]
        return [float(final_scores(each).mean()) for each in seen]

    def _design(self) -> Iterator[str]:
        """Describe the design, which is fixed when the first seed is trained."""
        study, section = self.study, self.study.looks
        family = len(study.design.family)
        written = f"written {section.written:%Y-%m-%d %H:%M} UTC, " if section.written else ""
        yield f"{written}hash {study.hash}, not begun: it can be edited until its first seed begins"
        first = next(iter(study.entries.values()))
        yield f"task {study.task}, {study.epochs} epochs ({study.epochs * first.task.file.protocol.interactions} steps)"
        yield (
            f"seeds {format_seeds(section.block)}; any false difference with probability {section.alpha:g} "
            f"({counted(family, 'pair')}, {section.spending} spending); equal within {100 * section.margin:g} percent"
        )
        unusable = {name: entry.unusable(study.epochs) for name, entry in study.entries.items()}
        for line in dict.fromkeys(line for lines in unusable.values() for line in lines):
            yield f"note: {line}: {', '.join(name for name, lines in unusable.items() if line in lines)}"
        for level in self.levels():
            equal = (
                f"; equal at p <= {level['equal']:.4f} on both sides" if (level["equal"] or 0) >= 1e-4 else ""
            )
            yield (
                f"look at {level['seeds']} seeds: different at p <= {level['differs']:.4f}"
                + (" while all pairs are open" if family > 1 else "")
                + equal
            )

    def _cost(self, facts: Mapping[str, Any]) -> Iterator[str]:
        """Describe the seeds and hours used and saved, and the next look."""
        if not self.begun:
            most = facts["core_hours_at_most"]
            cost = f": {hours_range(*most)} core-hours" if most else ", of unknown cost"
            measuring = list(self._measuring())
            cost += ". To measure it, on seeds that no board counts:" if measuring else ""
            yield f"at most {len(self.study.entries) * self.study.design.looks[-1]} seeds{cost}"
            yield from measuring
            return
        if self.ended:
            yield f"ended {self.ended}: open pairs stay open"
        elif not self.finished:
            lacking = sum(each["missing"] for each in facts["entries"])
            yield f"next look: {counted(lacking, 'seed')} missing{_about(facts['next_core_hours'])}"
        used, spent = (sum(each[key] for each in facts["entries"]) for key in ("seeds", "core_hours"))
        saved, hours = facts["seeds_saved"], facts["core_hours_saved"]
        more = hours and (min(map(abs, hours)), max(map(abs, hours)))
        yield (
            f"used {counted(used, 'seed')}, {hours_text(spent)} core-hours; the protocol has "
            f"{facts['protocol_seeds']} seeds: {abs(saved)} {'saved' if saved >= 0 else 'more than that'} on "
            f"entries that are decided{_about(more) if saved else ''}"
        )

    def _measuring(self) -> Iterator[str]:
        """Return the commands that measure the entries of unknown cost, with as many seeds as the first look."""
        study = self.study
        seeds = f"{TUNING_SEEDS}:{TUNING_SEEDS + study.design.looks[0]}"
        for table, (name, entry) in zip(study.file.entries, study.entries.items()):
            if entry.script is None and self._hours(name, 1) is None:
                task = str(table.task)
                alike = resolve(task, entry.label).task.name == entry.task.name
                label = entry.label if alike else str(table.model)
                words = [label, "--task", task, *identity.plugin_words(entry)]
                yield f"  {command('run', *words, '--seeds', seeds, '--epochs', '3', runs=study.runs)}"


def by_question(study: Study, pairs: Sequence[Pair]) -> list[tuple[str, list[Pair]]]:
    """Return each question of a study with its pairs, in order; the text is empty if the study asks none."""
    texts = study.questions or [""] * len(pairs)
    return [
        (text, [pair for _, pair in group])
        for text, group in itertools.groupby(zip(texts, pairs), key=lambda each: each[0])
    ]


def reason_note(study: Study) -> str:
    """Return a warning with the reason given where a study looks below 20 seeds; else an empty text."""
    if study.design.looks[0] >= 20:
        return ""
    return (
        "NOTE: its first look comes before 20 seeds, when rare failures may not have occurred yet. Reason "
        f"given: {study.looks.reason}"
    )


TURNED = {
    "fff5ccb281a6155b": "10 qubits / sines 14 rests on the 10,000 permutations of its look at 20 seeds (p "
    ".0069 at level .0075). 10 million give .0083, above that level.",
    "fd4f9be21ac4ae3a": "circuit / sines was left open by the 10,000 permutations of its look at 40 seeds "
    "(p .0084 at level .0067). 10 million give .0060, below that level.",
}
"""By hash of a published study: a decision that more permutations turn. It stands, since their number was fixed."""


def horizon_note(outcome: State) -> str:
    """Explain a verdict at the horizon; empty without such a verdict."""
    if not any(map(outcome.late, outcome.pairs)):
        return ""
    return (
        f"at the horizon: both entries are {outcome.study.grid.before} the thresholds for {NEAR:.0%} or more of the "
        "steps. Such a verdict means little: neither had time to learn. A study with more epochs may decide"
    )


def lost_note(outcome: State) -> str:
    """Name the requested seeds that are missing, and a missing log; empty where nothing is missing."""
    notes = [f"incomplete: {told} ({name})" for name, told in outcome.lost.items()]
    if outcome.begun and outcome.begun_at is None:
        notes.append("its log is missing: nobody can see when it began, or who has seen its seeds before")
    return "; ".join(notes)


def versus(pair: PairDecision) -> str:
    """Return `A / B`."""
    return f"{pair.first} / {pair.second}"


def difference_text(pair: PairDecision, grid: Grid) -> tuple[str, str]:
    """Return a pair's difference and its interval as text; empty where there is none.

    Where a pair was found to differ and the interval of the mean contains 0, the threshold that decided follows with
    the difference there and its own interval.
    """
    if not _finite(pair):
        return "", ""
    low, high = pair.interval
    return percent(pair.difference), f"{percent(low)} to {percent(high)}" + _leading_text(pair, grid)


def _leading_text(pair: PairDecision, grid: Grid) -> str:
    if not pair.at_threshold:
        return ""
    ends = " to ".join(map(percent, pair.leading_interval))
    return f"; at {grid.thresholds[pair.leading]:g}: {percent(pair.leading_difference)}, {ends}"


def finals_text(outcome: State, pair: PairDecision) -> str:
    """Return `0.942 / 0.791`, the final scores of A and B; empty before a look."""
    return " / ".join(map(score_text, outcome.finals(pair)))


def needs_text(outcome: State, needs: Mapping[str, Any] | None) -> str:
    """Describe the `needs` of an open pair from `as_dict`."""
    if needs is None or outcome.ended:
        return ""
    requirement = f"p <= {needs['level']:.2g} at {needs['seeds']} seeds"
    about = needs["seeds_at_this_difference"]
    if about is None:
        return requirement
    last = outcome.study.design.looks[-1]
    seeds = f"about {about}" if about <= 10 * last else f"over {10 * last}"
    return f"{requirement}; {seeds} if the difference stays as it is now"


def _about(span: Hours | None) -> str:
    return "" if span is None or not span[1] else f", about {hours_range(*span)} core-hours"


def _finite(pair: PairDecision) -> bool:
    return bool(pair.p) and all(math.isfinite(end) for end in (pair.difference, *pair.interval))


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _sheet(outcome: State, pairs: Sequence[tuple[PairDecision, Mapping[str, Any]]]) -> Sheet:
    """Return the table of some pairs."""
    heads = ["pair: A / B", "verdict", "seeds", "B against A", "interval", "p", "final score", "needs"]
    rows = [
        [
            versus(pair),
            outcome.verdict(pair),
            str(pair.n_runs),
            *difference_text(pair, outcome.study.grid),
            p_text(pair.p[-1]) if pair.p else "",
            finals_text(outcome, pair),
            needs_text(outcome, facts["needs"]),
        ]
        for pair, facts in pairs
    ]
    filled = [
        place
        for place, head in enumerate(heads)
        if head not in ("final score", "needs") or any(row[place] for row in rows)
    ]
    heads, rows = [heads[place] for place in filled], [[row[place] for place in filled] for row in rows]
    return Sheet.of("", heads, rows, words=(heads[0], "verdict", "B against A", "interval", "needs"))


def _entries_sheet(entries: Sequence[Mapping[str, Any]], before: str) -> Sheet:
    """Return the table of the entries; `before` a threshold is its other side, `below` or `above`."""
    rows = []
    for facts in entries:
        time = ""
        if facts["mean_time"] is not None:
            time = interval_text(mean_text, facts["mean_time"], *facts["mean_time_interval"])
        rows.append((facts["name"], str(facts["seeds"]), time, hours_text(facts["core_hours"])))
    heads = ("entry", "seeds", f"steps {before} threshold (95%)", "core-hours")
    return Sheet.of("", heads, rows, words=("entry",))
