"""How many runs it takes to tell two entries apart: by rule `steps`, all at once or with looks.

Entries are drawn from smoothed models of pilot runs, or of a similar published entry (`SmoothedRuns`), and judged like
real ones. The result holds for entries like the pilot, within the simulation's error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from qrlsuite.errors import OptionError
from qrlsuite.statistics.compare import MIN_RUNS
from qrlsuite.statistics.grid import Grid, IntArray, whole
from qrlsuite.statistics.sequential import Claim, Decided, Decision, PairDecision, SequentialDesign, Spending
from qrlsuite.statistics.simulation import SmoothedRuns, draw_steps, judge_steps, play, slower
from qrlsuite.statistics.times import check_probability

LADDER = (20, 25, 30, 40, 50, 60, 80, 100, 130, 160, 200, 250, 320, 400)
"""Numbers of runs that are tried, up to the most allowed."""
_INFLATION = (1.0, 1.1, 1.2, 1.35, 1.5, 1.75, 2.0)  # of runs that looks cost, at most, beyond all at once


@dataclass(frozen=True, slots=True)
class Need:
    """Runs that find a difference with a power.

    Attributes
    ----------
    power:
        The power asked for.
    fixed:
        Runs of each entry if all are made before they are compared; None if more than allowed.
    looks:
        Looks of a study of the same power; empty if more than allowed.
    mean_runs:
        Runs of each entry that the design needs on average; NaN without a design.
    """

    power: float
    fixed: int | None
    looks: tuple[int, ...]
    mean_runs: float


def runs_needed(
    first: SmoothedRuns,
    second: SmoothedRuns,
    grid: Grid,
    powers: Sequence[float] = (0.8, 0.9),
    alpha: float = 0.05,
    most: int = LADDER[-1],
    spending: Spending = Spending.POCOCK,
    n_pairs: int = 400,
    seed: int = 0,
) -> tuple[Need, ...]:
    """Return, for each power, how many runs it takes to find that the first needs fewer steps than the second.

    Parameters
    ----------
    first, second:
        Models from which entries are drawn; the first should be the better one.
    grid:
        Its E thresholds count; its deltas do not.
    powers:
        In (0, 1).
    alpha:
        Error of the test and of the design.
    most:
        Runs of an entry that are allowed at most, 20 or more.
    spending:
        Spending function of the design.
    n_pairs:
        Simulated pairs: the power at each number of runs has a standard error of sqrt(power (1 - power) / n_pairs).
    seed:
        Seed of the simulation.

    Raises
    ------
    OptionError
        If an argument is out of its range or the models end at different horizons.
    """
    if first.entry.horizon != second.entry.horizon:
        raise OptionError(
            f"'{first.entry.name}' ends at {first.entry.horizon} steps, '{second.entry.name}' at "
            f"{second.entry.horizon}: cut them to one horizon"
        )
    for power in powers:
        check_probability(power, "power")
    largest, count = whole(most, "most", at_least=MIN_RUNS), whole(n_pairs, "n_pairs", at_least=1)
    generator = np.random.default_rng(whole(seed, "seed", at_least=0))
    drawn = [draw_steps(model, largest, count, grid, generator) for model in (first, second)]
    fixed = _fixed(drawn, powers, alpha, largest)
    return tuple(_with_plan(drawn, power, runs, alpha, spending) for power, runs in zip(powers, fixed))


def runs_to_detect(pilot: SmoothedRuns, grid: Grid, slower_by: float, **options: object) -> tuple[Need, ...]:
    """Return how many runs it takes to detect that an entry like the pilot is slower by a fraction (.1: 10 percent).

    Options and errors as of `runs_needed`.
    """
    other = SmoothedRuns(slower(pilot.entry, 1 + slower_by), pilot.jitter, pilot.bounds)
    return runs_needed(pilot, other, grid, **options)  # type: ignore[arg-type]  # checked there


def runs_at_difference(decision: Decision, pair: PairDecision, power: float = 0.8) -> int | None:
    """Return about how many runs would find an open pair's present difference with a power, if it is real.

    By the normal approximation of the log ratio of mean steps, at the level of the pair's next look: a rule of thumb,
    for the present difference is an estimate itself. None before the pair's first look, or where its difference is 0
    or has no standard error.

    Raises
    ------
    OptionError
        If the power is not between 0 and 1.
    """
    check_probability(power, "power")
    design, normal = decision.design, NormalDist()
    if not pair.p or not math.isfinite(pair.interval[1]) or pair.difference == 0:
        return None
    look = len(pair.p) - 1
    ratio = math.log1p(pair.difference)
    width = math.log1p(pair.interval[1]) - ratio
    error = width / -normal.inv_cdf(design.level(look, len(design.family)) / 2)
    undecided = sum(not each.differs for each in decision.pairs)
    level = design.level(min(look + 1, len(design.looks) - 1), undecided)
    factor = (normal.inv_cdf(power) - normal.inv_cdf(level / 2)) * error / ratio
    return math.ceil(pair.n_runs * factor**2)


def chances(
    design: SequentialDesign, spread: float, lead: float, n_studies: int = 4000, seed: int = 0
) -> tuple[float, ...]:
    """Return how often an entry that needs fewer steps than all others has been told apart from them, by each look.

    Log mean steps are drawn as normal numbers, as they nearly are for many runs: the relabeling test of rule `steps`
    and the tests of equality are then tests of a normal mean.

    Parameters
    ----------
    design:
        Its first entry leads; the pairs with it count.
    spread:
        Standard deviation of one run's steps over their mean, the same of each entry.
    lead:
        0.1: the first needs 10 percent fewer than each other; between 0 and 1.
    n_studies, seed:
        Simulated studies, and the seed of their draws.

    Raises
    ------
    OptionError
        If the lead is not between 0 and 1.
    """
    check_probability(lead, "lead")
    generator, normal = np.random.default_rng(seed), NormalDist()
    names, family = design.entries, design.family
    sums = np.zeros((n_studies, len(names)))
    first, second = ([names.index(pair[side]) for pair in family] for side in (0, 1))
    counted_pairs = [names[0] in pair for pair in family]
    open_, differs = (np.full((n_studies, len(family)), state) for state in (True, False))
    told, before = [], 0
    for look, n_runs in enumerate(design.looks):
        sums += generator.normal(scale=spread * math.sqrt(n_runs - before), size=sums.shape)
        before, logs = n_runs, sums / n_runs
        logs[:, 0] += math.log1p(-lead)
        ratio, error = np.abs(logs[:, second] - logs[:, first]), spread * math.sqrt(2 / n_runs)
        reach = [-normal.inv_cdf(design.level(look, 1 + left) / 2) for left in range(len(family))]
        for _ in family:
            left = np.maximum(0, (~differs).sum(axis=1) - 1)
            rejected = open_ & (ratio >= error * np.take(reach, left)[:, None])
            differs, open_ = differs | rejected, open_ & ~rejected
        if (level := design.equal_level(look)) is not None:
            open_ &= ratio - error * normal.inv_cdf(level) >= math.log1p(design.margin)
        told.append(float(differs[:, counted_pairs].all(axis=1).mean()))
    return tuple(told)


def claim_chances(
    design: SequentialDesign, claim: Claim, spread: float, lead: float, n_studies: int = 4000, seed: int = 0
) -> tuple[float, ...]:
    """Return how often a claim is established by each look; arguments and approximation as of `chances`.

    The claim's entry needs a fraction `lead` fewer steps than each rival: 0 or more, below 1.
    """
    if not 0 <= lead < 1:
        raise OptionError(f"lead = {lead!r} is outside [0, 1)")
    generator, normal = np.random.default_rng(seed), NormalDist()
    sums = np.zeros((n_studies, len(claim.names)))
    established, shares, before = np.zeros(n_studies, dtype=bool), list[float](), 0
    for look, n_runs in enumerate(design.looks):
        sums += generator.normal(scale=spread * math.sqrt(n_runs - before), size=sums.shape)
        before, logs = n_runs, sums / n_runs
        ratio = logs[:, 1:] - logs[:, :1] - math.log1p(-lead)
        beyond = ratio if claim.at_most is None else math.log1p(claim.at_most) - ratio
        reach = -normal.inv_cdf(design.claim_level(look, claim.shares)) * spread * math.sqrt(2 / n_runs)
        every = np.all if claim.at_most is None else np.any
        established |= every(beyond >= reach, axis=1)
        shares.append(float(established.mean()))
    return tuple(shares)


def _fixed(drawn: Sequence[IntArray], powers: Sequence[float], alpha: float, most: int) -> list[int | None]:
    """Return, for each power, the runs that reach it, interpolated between two rungs of the ladder."""
    tried, reached_powers = [0], [0.0]
    for n_runs in sorted({*(rung for rung in LADDER if rung < most), most}):
        rates = judge_steps(drawn[0][:, :n_runs], drawn[1][:, :n_runs], alpha)
        tried.append(n_runs)
        reached_powers.append(max(rates.first, reached_powers[-1]))
        if reached_powers[-1] >= max(powers):
            break
    needed: list[int | None] = []
    for power in powers:
        if reached_powers[-1] < power:
            needed.append(None)
            continue
        rung = int(np.argmax(np.array(reached_powers) >= power))
        low, high = reached_powers[rung - 1], reached_powers[rung]
        between = tried[rung - 1] + (tried[rung] - tried[rung - 1]) * (power - low) / (high - low)
        needed.append(max(MIN_RUNS, math.ceil(between)))
    return needed


def even_looks(most: int, count: int = 5) -> tuple[int, ...]:
    """Return up to `count` looks in equal steps to `most` runs, the first at 20 or more.

    >>> even_looks(100)
    (20, 40, 60, 80, 100)
    >>> even_looks(30)
    (20, 30)
    """
    even = {math.ceil(most * (index + 1) / count) for index in range(count)}
    return tuple(sorted({max(MIN_RUNS, look) for look in even if look > MIN_RUNS} | {MIN_RUNS, most}))


def _with_plan(
    drawn: Sequence[IntArray], power: float, fixed: int | None, alpha: float, spending: Spending
) -> Need:
    """Return a need with the smallest design of its power, at most twice as long as all at once."""
    for factor in _INFLATION if fixed is not None else ():
        assert fixed is not None
        most = math.ceil(factor * fixed)
        if most > drawn[0].shape[1]:
            break
        design = SequentialDesign(("first", "second"), even_looks(most), alpha, spending, rule="steps")
        rates = play(design, [each[:, :most] for each in drawn])
        if rates.verdicts[0][Decided.FIRST] >= power:
            return Need(power, fixed, design.looks, rates.mean_runs[0])
    return Need(power, fixed, (), math.nan)
