"""Sequential designs: several looks at growing numbers of runs, with one error probability for all looks.

Someone who looks at the data again and again and stops at the first p below .05 errs in far more than 5 percent of
cases. Here alpha is spent over the looks by a function that is fixed in advance (Lan and DeMets 1983, Biometrika 70),
and over the pairs by a group-sequential Holm procedure (Maurer and Bretz 2013, Statistics in Biopharmaceutical Research
5; Ye, Li, Liu and Yao 2013, Statistics in Medicine 32): every pair that is not yet decided is tested at the levels that
belong to alpha / number of such pairs, and after a rejection again with one less. The family is all pairs that were
planned. A pair that is closed as equal is not rejected: it keeps its share of alpha.

The test is the test of rule `steps` or `times` (`MaxT`); labels are exchanged within the block of seeds that each look
added. By `steps`, relabelings of a look go on until no decision can turn.
A pair is equal within the margin if two one-sided tests on the log ratio of the mean steps say so (Schuirmann
1987), with O'Brien-Fleming spending of their own: alpha per side, for each pair by itself.

A claim about an entry and several rivals has an error alpha of its own, on one side. That the entry beats all of them
is an intersection-union test: every rival at the full level, all at the same look (Berger 1982, Technometrics 24). That
the best of them needs at most so much more is a union: each at alpha / number of rivals. An entry goes on while a pair
or a claim needs it; that it beats all is given up where a pair says that a rival needs fewer steps.

`decide` is a function of the design and the runs so far, so that an interrupted study goes on where it was. A p that
took many relabelings at a look may be handed over, to be checked by 10,000 and not computed again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from fractions import Fraction
from itertools import combinations

import numpy as np

from qrlsuite.errors import OptionError
from qrlsuite.statistics.compare import MIN_RUNS
from qrlsuite.statistics.curves import LearningCurves
from qrlsuite.statistics.grid import FloatArray, Grid, IntArray, whole
from qrlsuite.statistics.permutation import CHUNK, Blocks, MaxT, relabelings_for, with_half_epoch
from qrlsuite.statistics.steps import RISK, relabel
from qrlsuite.statistics.times import check_probability, student_quantile, times_below
from qrlsuite.statistics.times_board import log_ratios

RULES = ("times", "steps")
"""Rules that may judge the pairs of a design."""
MOST_RELABELINGS = 200_000
"""At levels below 1e-4 a difference needs p = 1 / 200,001 or so; at levels below that there is none."""
Known = Mapping[tuple[int, tuple[str, ...]], tuple[float, int]]
"""By runs at a look and names of a pair: p of an earlier reading, and its relabelings."""
_POINTS = 1001  # of the numerical integration
_TAIL = 9.0  # standard deviations beyond which a density is nothing


class Spending(StrEnum):
    """How alpha is spent over the looks (Lan and DeMets 1983): t is the share of all planned runs."""

    POCOCK = "pocock"
    OBRIEN_FLEMING = "obrien-fleming"

    def spent(self, t: Sequence[float], alpha: float) -> FloatArray:
        """Return, shape (K,), the error that one side has spent at shares t in (0, 1] of the runs: alpha at t = 1."""
        from scipy.special import ndtr, ndtri

        share = np.asarray(t, dtype=np.float64)
        if self is Spending.POCOCK:
            result: FloatArray = alpha * np.log1p((math.e - 1) * share)
        else:
            result = 2 * ndtr(ndtri(alpha / 2) / np.sqrt(share))
        return result


def nominal_levels(
    looks: tuple[int, ...], alpha: float, spending: Spending, sides: int = 2
) -> tuple[float, ...]:
    """Return the level at which a p is significant at each look, so that all looks together err at alpha.

    By numerical integration over the looks of the density of the statistic among studies that go on (Armitage,
    McPherson and Rowe 1969; Jennison and Turnbull 2000, chapter 19).

    Parameters
    ----------
    looks:
        Numbers of runs, rising.
    alpha:
        The error spent when all runs are done.
    spending:
        The function.
    sides:
        2 for two-sided p, 1 for one-sided.

    Examples
    --------
    >>> [round(level, 4) for level in nominal_levels((20, 40, 60, 80, 100), 0.05, Spending.POCOCK)]
    [0.0148, 0.0152, 0.0159, 0.0165, 0.017]
    """
    return tuple(_level(looks, look, alpha, spending, sides) for look in range(len(looks)))


def _level(looks: tuple[int, ...], look: int, alpha: float, spending: Spending, sides: int) -> float:
    """Return the level of one look; later looks are not computed."""
    from scipy.special import ndtr

    bounds = [
        _bound(looks, each, alpha, spending, sides) for each in range(look + 1)
    ]  # each rests on those before
    return float(sides * ndtr(-bounds[-1]))


@functools.lru_cache(maxsize=1024)
def _bound(looks: tuple[int, ...], look: int, alpha: float, spending: Spending, sides: int) -> float:
    """Return the bound on |Z| (on Z where sides is 1) beyond which a look stops the study."""
    from scipy.optimize import brentq

    share, step = _share_and_step(looks, look)
    spent = spending.spent([_share_and_step(looks, each)[0] for each in range(len(looks))], alpha / sides)
    increment = float((sides * np.diff(spent, prepend=0.0))[look])
    points, density = _going_on(looks, look, alpha, spending, sides)
    stopped = functools.partial(_stopped, points, density, math.sqrt(share), step, sides, increment)
    return float(brentq(stopped, 0.0 if sides == 2 else -_TAIL, 40.0, xtol=1e-10))


@functools.lru_cache(maxsize=64)
def _going_on(
    looks: tuple[int, ...], look: int, alpha: float, spending: Spending, sides: int
) -> tuple[FloatArray, FloatArray]:
    """Return points (P,) and weighted density there of B_k = Z_k sqrt(t_k) among studies that go on to a look.

    B has independent increments.
    """
    if look == 0:
        return np.zeros(1), np.ones(1)
    points, density = _going_on(looks, look - 1, alpha, spending, sides)
    share, step = _share_and_step(looks, look - 1)
    scale, bound = math.sqrt(share), _bound(looks, look - 1, alpha, spending, sides)
    lower = -bound if sides == 2 else -_TAIL
    fresh, weights = _simpson(max(lower, -_TAIL) * scale, min(bound, _TAIL) * scale)
    kernel = np.exp(-(((fresh[:, None] - points) / step) ** 2) / 2) / (step * math.sqrt(2 * math.pi))
    return fresh, weights * (kernel @ density)


def _share_and_step(looks: tuple[int, ...], look: int) -> tuple[float, float]:
    """Return a look's share of all planned runs, and the standard deviation of its increment of B."""
    shares = [0.0, *(np.array(looks) / looks[-1]).tolist()]
    return shares[look + 1], math.sqrt(shares[look + 1] - shares[look])


def _stopped(
    points: FloatArray,
    density: FloatArray,
    scale: float,
    step: float,
    sides: int,
    increment: float,
    bound: float,
) -> float:
    """Return the probability that a study stops at this look at a bound on |Z|, minus the error it may spend."""
    from scipy.special import ndtr

    beyond = ndtr((points - bound * scale) / step)
    if sides == 2:
        beyond = beyond + ndtr((-points - bound * scale) / step)
    return float((density * beyond).sum()) - increment


def _simpson(low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Return points and weights of Simpson's rule."""
    points = np.linspace(low, high, _POINTS)
    weights = np.full(_POINTS, 2.0)
    weights[1::2] = 4
    weights[[0, -1]] = 1
    return points, weights * (points[1] - points[0]) / 3


@dataclass(frozen=True, slots=True)
class Claim:
    """A study's claim about an entry and its rivals, at an error of its own.

    Attributes
    ----------
    entry, rivals:
        Names of entries.
    at_most:
        None: the entry needs fewer steps than each rival. 0.1: the best rival needs at most 10 percent more than it.
    tasks:
        Studies, each of another task, that are read together for it: it is tested until it holds at alpha / tasks.
    """

    entry: str
    rivals: tuple[str, ...]
    at_most: float | None = None
    tasks: int = 1

    @property
    def sentence(self) -> str:
        """The claim in words."""
        rivals, several = ", ".join(self.rivals), len(self.rivals) > 1
        if self.at_most is None:
            return f"{self.entry} needs fewer steps than {'each of ' * several}{rivals}"
        percent = f"{100 * self.at_most:g} percent"
        return f"{'the best of ' * several}{rivals} needs at most {percent} more steps than {self.entry}"

    @property
    def names(self) -> tuple[str, ...]:
        """Every entry that it needs."""
        return (self.entry, *self.rivals)

    @property
    def shares(self) -> int:
        """How many tests share its alpha, if a single one is enough."""
        return 1 if self.at_most is None else len(self.rivals)


@dataclass(frozen=True, slots=True)
class SequentialDesign:
    """The facts that a study fixes before its first run: pairs, claims, looks, and error.

    Attributes
    ----------
    entries:
        Names of two or more entries.
    looks:
        Runs of each entry at each look, rising. Below 20 only with a `reason`: rare failures that have not
        occurred yet would decide.
    alpha:
        Probability of any false difference, over all pairs and looks, for entries of equal laws.
    spending:
        How alpha is spent over the looks.
    margin:
        Ratios of mean steps within 1 / (1 + margin) and 1 + margin are equal enough.
    equal_from:
        Runs from which a pair may be found equal.
    pairs:
        The pairs of names that are compared; None means all.
    seed:
        Seed of the relabelings.
    reason:
        Why the first look comes before 20 runs.
    rule:
        `steps`; or `times`, as studies of earlier versions have it.
    claims:
        Each has an error alpha of its own, on one side; by rule `steps`.

    Raises
    ------
    OptionError
        If something is out of its range, a name is repeated or unknown, or looks do not rise.
    """

    entries: tuple[str, ...]
    looks: tuple[int, ...] = (20, 40, 60, 80, 100)
    alpha: float = 0.05
    spending: Spending = Spending.POCOCK
    margin: float = 0.10
    equal_from: int = 40
    pairs: tuple[tuple[str, str], ...] | None = None
    seed: int = 0
    reason: str = ""
    rule: str = "times"
    claims: tuple[Claim, ...] = ()

    def __post_init__(self) -> None:
        if len(self.entries) < 2:
            raise OptionError(f"entries = {list(self.entries)}: a study needs two or more")
        for index, name in enumerate(self.entries):
            if name in self.entries[:index]:
                raise OptionError(f"entries: the name '{name}' is repeated")
        for look in self.looks:
            whole(look, "looks", at_least=2)
        if not self.looks or any(after <= before for before, after in zip(self.looks, self.looks[1:])):
            raise OptionError(f"looks = {list(self.looks)}: each must be at more runs than the one before")
        if self.looks[0] < MIN_RUNS and not self.reason.strip():
            raise OptionError(
                f"looks = {list(self.looks)}: the first is below {MIN_RUNS} runs, where rare failures that have not "
                "occurred yet would decide; begin later, or give a reason"
            )
        check_probability(self.alpha, "alpha")
        if self.rule not in RULES:
            raise OptionError(f"rule = '{self.rule}': expected {' or '.join(RULES)}")
        if self.spending not in tuple(Spending):
            known = " or ".join(f"'{each}'" for each in Spending)
            raise OptionError(f"spending = '{self.spending}': expected {known}")
        object.__setattr__(self, "spending", Spending(self.spending))
        if not 0 < self.margin < math.inf:
            raise OptionError(f"margin = {self.margin!r} is not a positive number")
        for first, second in self.pairs or ():
            for name in (first, second):
                if name not in self.entries:
                    raise OptionError(f"pairs: '{name}' is not one of the entries {list(self.entries)}")
            if first == second:
                raise OptionError(f"pairs: '{first}' is compared with itself")
        if len({frozenset(pair) for pair in self.family}) != len(self.family) or not self.family:
            raise OptionError("pairs: a pair is repeated, or there is none")
        if self.claims and self.rule != "steps":
            raise OptionError(f"claims are tested by rule 'steps', and the study has rule '{self.rule}'")
        for claim in self.claims:
            for name in claim.names:
                if name not in self.entries:
                    raise OptionError(f"claims: '{name}' is not one of the entries {list(self.entries)}")
            if len({*claim.names}) < len(claim.names):
                raise OptionError(f"claims: {list(claim.names)}: a name is repeated")

    @property
    def family(self) -> tuple[tuple[str, str], ...]:
        """The pairs that are compared."""
        return self.pairs if self.pairs is not None else tuple(combinations(self.entries, 2))

    @property
    def blocks(self) -> Blocks:
        """Runs that each look adds, of the first and the second entry."""
        added = np.diff(self.looks, prepend=0).tolist()
        return tuple((each, each) for each in added)

    def level(self, look: int, undecided: int) -> float:
        """Return the level of a p at look 0, 1, ... while so many pairs are not decided."""
        return _level(self.looks, look, self.alpha / undecided, self.spending, 2)

    def equal_level(self, look: int) -> float | None:
        """Return the level of each one-sided test of equality at a look; None before `equal_from`."""
        allowed = tuple(each for each in self.looks if each >= self.equal_from)
        if self.looks[look] not in allowed:
            return None
        return _level(allowed, allowed.index(self.looks[look]), self.alpha, Spending.OBRIEN_FLEMING, 1)

    def claim_level(self, look: int, shares: int) -> float:
        """Return the level of a one-sided p at look 0, 1, ... that has alpha / `shares`."""
        return _level(self.looks, look, self.alpha / shares, self.spending, 1)


class Decided(StrEnum):
    """How a pair was closed."""

    FIRST = "first needs fewer"
    SECOND = "second needs fewer"
    TRADE_OFF = "trade-off"
    EQUAL = "equal"
    NOT_TOLD_APART = "not told apart"


@dataclass(frozen=True, slots=True)
class PairDecision:
    """One pair after its last look.

    Attributes
    ----------
    first, second:
        The entries.
    decided:
        None while the pair is open.
    n_runs:
        Runs of each at its last look, 0 before the first.
    p, levels:
        p and the level it was compared with last, at each look so far.
    difference:
        The second's mean steps over the first's, minus 1, at the last look. After an early stop it is biased
        away from 0.
    interval:
        Repeated confidence interval of the difference (Jennison and Turnbull 1989). All pairs at all looks together are
        covered with probability about 1 - alpha, whatever made the study stop.
    within_margin:
        Whether the difference is significantly smaller than the margin, either way.
    margin:
        As in the design.
    leading:
        Number of the threshold with the largest |t| at the last look, which gave the pair its p; 0 by rule `steps`.
    leading_difference, leading_interval:
        As `difference`, at this threshold alone; the interval is at the level that p was compared with last. By rule
        `steps` there is none: NaN.
    relabelings:
        Relabelings behind each p by rule `steps`.
    """

    first: str
    second: str
    decided: Decided | None = None
    n_runs: int = 0
    p: tuple[float, ...] = ()
    levels: tuple[float, ...] = ()
    difference: float = math.nan
    interval: tuple[float, float] = (-1.0, math.inf)
    within_margin: bool = False
    margin: float = 0.10
    leading: int = 0
    leading_difference: float = math.nan
    leading_interval: tuple[float, float] = (-1.0, math.inf)
    relabelings: tuple[int, ...] = ()

    @property
    def differs(self) -> bool:
        """Whether the pair was found to differ."""
        return self.decided in (Decided.FIRST, Decided.SECOND, Decided.TRADE_OFF)

    @property
    def at_threshold(self) -> bool:
        """Whether a threshold decided, by rule `times`, while the interval of the mean holds 0."""
        low, high = self.interval
        one_sided = self.decided in (Decided.FIRST, Decided.SECOND)
        return one_sided and low <= 0 <= high and math.isfinite(self.leading_difference)

    @property
    def shown(self) -> tuple[float, float, float]:
        """Difference and interval that decided: of the mean, or of the threshold where `at_threshold`."""
        if self.at_threshold:
            return self.leading_difference, *self.leading_interval
        return self.difference, *self.interval

    @property
    def verdict(self) -> str:
        """The decision in words; `open` while there is none."""
        under = f"{100 * self.margin:g} percent"
        match self.decided:
            case None:
                return "open"
            case Decided.FIRST | Decided.SECOND:
                name = self.first if self.decided is Decided.FIRST else self.second
                return f"{name} needs fewer" + (f", by under {under}" if self.within_margin else "")
            case Decided.TRADE_OFF:
                return "trade-off"
            case Decided.EQUAL:
                return f"equal within {under}"
            case Decided.NOT_TOLD_APART:
                largest = max(abs(end) for end in self.interval)
                bound = f": no difference above {100 * largest:.0f} percent" if math.isfinite(largest) else ""
                return f"not told apart by {self.n_runs} seeds{bound}"


@dataclass(frozen=True, slots=True)
class ClaimDecision:
    """One claim after its last look.

    Attributes
    ----------
    p, relabelings:
        Of each rival at each look so far: its one-sided p, and the relabelings behind it.
    n_runs:
        Runs of each entry at its last look, 0 before the first.
    established:
        Runs at the first look at which it held at alpha; None while there is none.
    closed:
        Whether it needs no more runs.
    excluded:
        The smallest lead over all rivals that is excluded at its last look, on one side at alpha: 0.1 where the best
        rival needs at most 10 percent more.
    """

    claim: Claim
    p: tuple[tuple[float, ...], ...] = ()
    relabelings: tuple[tuple[int, ...], ...] = ()
    n_runs: int = 0
    established: int | None = None
    closed: bool = False
    excluded: float = math.inf

    def held(self, design: SequentialDesign, tasks: int = 1) -> int | None:
        """Return the runs at the first look at which it holds at alpha / `tasks`; None where it does not."""
        every = all if self.claim.at_most is None else any
        for look, p in enumerate(self.p):
            level = design.claim_level(look, tasks * self.claim.shares)
            if every(each <= level for each in p):
                return design.looks[look]
        return None

    @property
    def verdict(self) -> str:
        """The state of the claim, in words."""
        if not self.n_runs:
            return "open"
        if self.established is not None:
            found = f"established at {self.established} seeds"
        else:
            found = f"{'not established' if self.closed else 'open'} after {self.n_runs} seeds"
        if not math.isfinite(self.excluded):
            return f"{found}; no lead is excluded"
        return f"{found}; leads above {100 * max(0, self.excluded):.0f} percent are excluded"


@dataclass(frozen=True, slots=True)
class Decision:
    """All pairs and claims of a design after the looks for which there are runs.

    Attributes
    ----------
    design:
        The design.
    pairs:
        The pairs of the design, in order.
    wanted:
        For each entry with an open pair or claim: the runs that the next look needs. Empty when all is decided.
    claims:
        The claims of the design, in order.
    """

    design: SequentialDesign
    pairs: tuple[PairDecision, ...]
    wanted: Mapping[str, int]
    claims: tuple[ClaimDecision, ...] = ()

    @property
    def finished(self) -> bool:
        """Whether every pair and claim is closed."""
        return not self.wanted


def decide(
    design: SequentialDesign, runs: Mapping[str, LearningCurves], grid: Grid, known: Known | None = None
) -> Decision:
    """Return a design's decision from the runs so far.

    Parameters
    ----------
    design:
        The design.
    runs:
        For each entry of the design its runs so far, in the order of their seeds; entries without any may be
        absent. A look takes place once every entry with an open pair or claim has the runs for it. Runs beyond a look
        count for later ones only; runs that an entry got after all of its pairs were closed do not count.
    grid:
        Its E thresholds count; its deltas do not.
    known:
        By rule `steps`: p of an earlier reading of the same runs.

    Raises
    ------
    OptionError
        If a name is not in the design, or entries end at different horizons.
    """
    for name in runs:
        if name not in design.entries:
            raise OptionError(f"'{name}' is not one of the design's entries {list(design.entries)}")
    ends = {name: entry.horizon for name, entry in runs.items()}
    if len(set(ends.values())) > 1:
        raise OptionError(f"the entries end at different horizons: {ends}; cut them to one")
    epoch = max((each.steps_per_epoch for each in runs.values()), default=1)
    times = {
        name: judged_numbers(design, times_below(each.values, grid, each.steps_per_epoch), epoch)
        for name, each in runs.items()
    }
    pairs, claims = begin(design), [ClaimDecision(claim) for claim in design.claims]
    for look, n_runs in enumerate(design.looks):
        wanted = wanted_at(pairs, n_runs)
        wanted |= {name: n_runs for each in claims if not each.closed for name in each.claim.names}
        if any(name not in times or len(times[name]) < n_runs for name in wanted):
            return Decision(design, tuple(pairs), wanted, tuple(claims))
        [pairs] = next_look(design, look, [pairs], [times], known or {})
        claims = [
            each if each.closed else next_claim(design, look, each, times, known or {}) for each in claims
        ]
        claims = [replace(each, closed=each.closed or _lost(each.claim, pairs)) for each in claims]
    return Decision(design, tuple(pairs), {}, tuple(claims))


def _lost(claim: Claim, pairs: Sequence[PairDecision]) -> bool:
    """Whether a rival was found to need fewer steps than an entry that is claimed to beat it."""
    found = [(p.first, p.second) for p in pairs if p.decided is Decided.FIRST]
    found += [(p.second, p.first) for p in pairs if p.decided is Decided.SECOND]
    return claim.at_most is None and any((rival, claim.entry) in found for rival in claim.rivals)


def judged_numbers(design: SequentialDesign, times: IntArray, epoch: int) -> IntArray:
    """Return what a design's rule judges, given steps below threshold (..., N, E): the same, or one number per run."""
    return times if design.rule == "times" else with_half_epoch(times, epoch).sum(axis=-1, keepdims=True)


def begin(design: SequentialDesign) -> list[PairDecision]:
    """Return a design's pairs before the first look: all open."""
    return [PairDecision(first, second, margin=design.margin) for first, second in design.family]


def wanted_at(pairs: Sequence[PairDecision], n_runs: int) -> dict[str, int]:
    """Return `n_runs` for each entry with an open pair."""
    return {name: n_runs for pair in pairs if pair.decided is None for name in (pair.first, pair.second)}


def next_look(
    design: SequentialDesign,
    look: int,
    studies: Sequence[Sequence[PairDecision]],
    times: Sequence[Mapping[str, IntArray]],
    known: Known | None = None,
) -> list[list[PairDecision]]:
    """Return the pairs of several studies of one design after look 0, 1, ...; closed pairs are unchanged.

    Parameters
    ----------
    design, look:
        The design, and which of its looks.
    studies:
        For each study the pairs as the look before left them.
    times:
        For each study the `judged_numbers` of its entries, (N, E) with N at least the look's runs.
    known:
        As for `decide`. Relabelings of rule `steps` go on until no decision can turn; in simulations, without `known`,
        they do not.
    """
    n_runs = design.looks[look]
    todo = [
        (study, index)
        for study, pairs in enumerate(studies)
        for index, pair in enumerate(pairs)
        if pair.decided is None
    ]
    if not todo:
        return [list(pairs) for pairs in studies]
    data = []
    for study, index in todo:
        pair = studies[study][index]
        data.append((times[study][pair.first][:n_runs], times[study][pair.second][:n_runs]))
    test = MaxT(data, design.blocks[: look + 1], design.seed, ratio=design.rule == "steps")
    if test.ratio and known is not None:
        test.extend(CHUNK)
        for row, (study, index) in enumerate(todo):
            pair = studies[study][index]
            test.resume(row, *known.get((n_runs, (pair.first, pair.second)), (1.0, 0)))
        levels = {design.level(look, 1 + others) for others in range(len(design.family))}
        count = len(test.t)
        relabel(
            test, lambda: np.any([test.turns(np.full(count, each), RISK / count) for each in levels], axis=0)
        )
    else:
        test.extend(min(relabelings_for(design.level(look, len(design.family))), MOST_RELABELINGS))
    p, p_each = test.p, test.p_each
    result = [list(pairs) for pairs in studies]
    rows: dict[int, dict[int, int]] = {}  # of each study: the row of the test for each open pair
    for row, (study, index) in enumerate(todo):
        result[study][index] = _looked(design, look, studies[study][index], data[row], float(p[row]))
        rows.setdefault(study, {})[index] = row
    for study, of_study in rows.items():
        _reject(design, look, result[study], of_study, test.t, p_each)
        for index, row in of_study.items():
            if not test.ratio:
                result[study][index] = _led(result[study][index], data[row], test.t[row])
            elif known is not None:
                result[study][index] = _relabeled(result[study][index], data[row], test, row)
        _close(design, look, result[study])
    return result


def next_claim(
    design: SequentialDesign,
    look: int,
    before: ClaimDecision,
    times: Mapping[str, IntArray],
    known: Known | None = None,
) -> ClaimDecision:
    """Return an open claim after look 0, 1, ...; arguments as for `next_look`, of one study.

    As many runs of both make the law of t symmetric among relabelings: p of one side is half of p of both sides. For
    "at most 10 percent more" the entry's numbers are multiplied by 1.1. Keys of `known` end with `at_most`.
    """
    claim, n_runs = before.claim, design.looks[look]
    factor = Fraction(1 + (claim.at_most or 0)).limit_denominator(1000)
    own = times[claim.entry][:n_runs] * factor.numerator
    sides = [(own, times[rival][:n_runs] * factor.denominator) for rival in claim.rivals]
    data = sides if claim.at_most is None else [(rival, entry) for entry, rival in sides]
    test = MaxT(data, design.blocks[: look + 1], design.seed, ratio=True)
    test.extend(CHUNK)
    if known is not None:
        for row, rival in enumerate(claim.rivals):
            p, count = known.get((n_runs, (claim.entry, rival, str(claim.at_most))), (1.0, 0))
            test.resume(row, 2 * min(p, 1 - p), count)
        one_sided = [design.claim_level(look, tasks * claim.shares) for tasks in range(1, 1 + claim.tasks)]
        levels = [np.full(len(data), min(2 * level, 0.999)) for level in one_sided]
        relabel(test, lambda: np.any([test.turns(each, RISK / len(data)) for each in levels], axis=0))
    p_one = np.where(test.t[:, 0] > 0, test.p / 2, 1 - test.p / 2)
    now = replace(
        before,
        n_runs=n_runs,
        p=(*before.p, tuple(p_one.tolist())),
        relabelings=(*before.relabelings, tuple(test.n_relabelings.tolist())),
    )
    reaches = (
        test.critical(2 * design.claim_level(look, len(data)))
        if known is not None
        else [math.inf] * len(data)
    )
    ends = []
    for side, reach in zip(sides, reaches):
        ratio, error, _ = _log_ratio(side)
        ends.append(ratio + math.log(factor) + (reach * error if error else 0.0))
    held = now.held(design)
    excluded = math.expm1(min(ends))
    if claim.at_most is not None:  # which its p has decided
        excluded = (max if held is None else min)(excluded, claim.at_most)
    closed = n_runs == design.looks[-1] or now.held(design, claim.tasks) is not None
    return replace(now, established=held, closed=closed, excluded=excluded)


def holm_claims(decided: Sequence[tuple[SequentialDesign, ClaimDecision]], tasks: int) -> list[bool]:
    """Return which of the claims of several studies hold, each of its own task: Holm's procedure over `tasks`."""
    holds = [False] * len(decided)
    while True:
        left = max(1, tasks - sum(holds))
        now = [claim.held(design, left) is not None for design, claim in decided]
        if now == holds:
            return holds
        holds = now


def _looked(
    design: SequentialDesign,
    look: int,
    pair: PairDecision,
    data: tuple[IntArray, IntArray],
    p: float,
) -> PairDecision:
    """Return a pair with its p, difference, interval and test of equality at a look."""
    level = design.level(look, len(design.family))
    difference, interval = _repeated(data, level)
    equal_level = design.equal_level(look)
    within = False
    if math.isfinite(difference) and equal_level is not None:
        ratio, error, freedom = _log_ratio(data)
        reach = error * float(student_quantile(1 - equal_level, freedom))
        within = abs(ratio) + reach < math.log1p(design.margin)
    return replace(
        pair,
        n_runs=design.looks[look],
        p=(*pair.p, p),
        difference=difference,
        interval=interval,
        within_margin=within,
    )


def _led(pair: PairDecision, data: tuple[IntArray, IntArray], t: FloatArray) -> PairDecision:
    """Return a pair with the threshold that gave it its p, and the difference at that threshold."""
    leading = int(np.abs(t).argmax())
    first, second = (each[:, [leading]] for each in data)
    difference, interval = _repeated((first, second), pair.levels[-1])
    return replace(pair, leading=leading, leading_difference=difference, leading_interval=interval)


def _relabeled(pair: PairDecision, data: tuple[IntArray, IntArray], test: MaxT, row: int) -> PairDecision:
    """Return a pair with the interval that relabelings give at the level that its p was compared with."""
    ratio, error, _ = _log_ratio(data)
    reach = float(test.critical(pair.levels[-1])[row]) * error if error else 0.0
    reach = min(reach, abs(ratio) * (1 - 1e-9)) if pair.differs else max(reach, abs(ratio))
    interval = (math.expm1(ratio - reach), math.expm1(ratio + reach))
    return replace(pair, interval=interval, relabelings=(*pair.relabelings, int(test.n_relabelings[row])))


def _log_ratio(data: Sequence[IntArray]) -> tuple[float, float, float]:
    """Return log(mean of the second / mean of the first), its standard error and degrees of freedom."""
    ratio, error, freedom = (float(matrix[1, 0]) for matrix in log_ratios(data))
    return ratio, error, freedom


def _repeated(data: Sequence[IntArray], level: float) -> tuple[float, tuple[float, float]]:
    """Return the second's mean over the first's, minus 1, and its interval at level 1 - `level`."""
    ratio, error, freedom = _log_ratio(data)
    if not math.isfinite(ratio):
        return math.expm1(ratio), (-1.0, math.inf)
    reach = error * float(student_quantile(1 - level / 2, freedom))
    return math.expm1(ratio), (math.expm1(ratio - reach), math.expm1(ratio + reach))


def _reject(
    design: SequentialDesign,
    look: int,
    pairs: list[PairDecision],
    rows: Mapping[int, int],
    t: FloatArray,
    p_each: FloatArray,
) -> None:
    """Group-sequential Holm: decide open pairs at the level for the remaining ones, until none follows."""
    strictest = design.level(look, len(pairs))
    while True:
        undecided = sum(not pair.differs for pair in pairs)
        level = design.level(look, max(1, undecided))
        rejected = [index for index in rows if pairs[index].decided is None and pairs[index].p[-1] <= level]
        if not rejected:
            break
        for index in rejected:
            row = rows[index]
            signs = np.where(p_each[row] <= strictest, np.sign(t[row]), 0).astype(np.int64)
            sign = direction(t[row], signs)
            decided = {1: Decided.FIRST, -1: Decided.SECOND, 0: Decided.TRADE_OFF}[sign]
            pairs[index] = replace(pairs[index], decided=decided)
    for index in rows:
        pairs[index] = replace(pairs[index], levels=(*pairs[index].levels, level))


def direction(t: FloatArray, signs: IntArray) -> int:
    """Return 1 or -1, the sign of the largest |t| of (E,), or 0 if significant signs of (E,) are of both kinds."""
    if (signs > 0).any() and (signs < 0).any():
        return 0
    return int(np.sign(t[np.abs(t).argmax()]))


def _close(design: SequentialDesign, look: int, pairs: list[PairDecision]) -> None:
    """Close open pairs that are equal, and at the last look all."""
    for index, pair in enumerate(pairs):
        if pair.decided is None and pair.within_margin:
            pairs[index] = replace(pair, decided=Decided.EQUAL)
        elif pair.decided is None and look == len(design.looks) - 1:
            pairs[index] = replace(pair, decided=Decided.NOT_TOLD_APART)
