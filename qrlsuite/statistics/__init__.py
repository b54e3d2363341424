"""Sample complexity, its confidence intervals, and tests for a difference between entries.

Arrays in, arrays out: learning curves are (N runs, T epochs), results are (E epsilons, D deltas). Nothing
here knows about tasks, stores or commands, and importing it costs no more than numpy.

- `estimator`: S_hat and its two marks. `bootstrap`: its percentile intervals.
- `significance`: rules that judge one pair, cell by cell. `compare`: one pair, in words.
- `times`: one number per run behind the surface. `permutation`: tests that relabel whole runs.
- `steps`: relabelings until no decision can turn, intervals that belong to p, and the limits of few runs.
- `board` and `ranking`: all pairs, and tiers. `times_board`: all pairs by their mean steps; `pair`: one of them.
- `sequential`: as many runs as it takes to decide, at one error for all looks.
- `simulation`: how often all this errs. `planning`: how many runs it takes.
- `across`: several tasks at once. `final`: entries by their scores at the end, or over all of training.
"""

from qrlsuite.statistics.across import (
    AcrossTasks,
    MeanRatio,
    across_tasks,
    horizon_shares,
    interquartile_mean,
    mean_ratio,
    probability_of_improvement,
    rliable_arrays,
)
from qrlsuite.statistics.board import Board, outperformance
from qrlsuite.statistics.bootstrap import (
    bootstrap_draws,
    bootstrap_interval,
)
from qrlsuite.statistics.compare import MIN_RUNS, Comparison, Outcome, Verdict, compare
from qrlsuite.statistics.curves import LearningCurves, common_horizon
from qrlsuite.statistics.estimator import (
    at_cap,
    sample_complexity,
    unsettled,
)
from qrlsuite.statistics.final import ScoreBoard, areas, compare_scores, deviations, final_scores, last_epochs
from qrlsuite.statistics.grid import Grid
from qrlsuite.statistics.pair import TimesPair, times_pair
from qrlsuite.statistics.permutation import MaxT, StepsRule, TimesRule
from qrlsuite.statistics.planning import Need, runs_needed, runs_to_detect
from qrlsuite.statistics.ranking import Ranked, Ranking, rank
from qrlsuite.statistics.sequential import (
    Decided,
    Decision,
    PairDecision,
    SequentialDesign,
    Spending,
    decide,
    nominal_levels,
)
from qrlsuite.statistics.significance import (
    Evidence,
    IntervalRule,
    Resampling,
    SignificanceRule,
)
from qrlsuite.statistics.simulation import (
    DecisionRates,
    SmoothedRuns,
    decision_rates,
    slower,
)
from qrlsuite.statistics.times import MeanTime, mean_time, times_below
from qrlsuite.statistics.times_board import Direction, TimesBoard, holm, rank_ranges, times_board

__all__ = [
    "MIN_RUNS",
    "AcrossTasks",
    "Board",
    "Comparison",
    "Decided",
    "Decision",
    "DecisionRates",
    "Direction",
    "Evidence",
    "Grid",
    "IntervalRule",
    "LearningCurves",
    "MaxT",
    "MeanRatio",
    "MeanTime",
    "Need",
    "Outcome",
    "PairDecision",
    "Ranked",
    "Ranking",
    "Resampling",
    "ScoreBoard",
    "SequentialDesign",
    "SignificanceRule",
    "SmoothedRuns",
    "Spending",
    "StepsRule",
    "TimesBoard",
    "TimesPair",
    "TimesRule",
    "Verdict",
    "across_tasks",
    "areas",
    "at_cap",
    "bootstrap_draws",
    "bootstrap_interval",
    "common_horizon",
    "compare",
    "compare_scores",
    "decide",
    "decision_rates",
    "deviations",
    "final_scores",
    "holm",
    "horizon_shares",
    "interquartile_mean",
    "last_epochs",
    "mean_ratio",
    "mean_time",
    "nominal_levels",
    "outperformance",
    "probability_of_improvement",
    "rank",
    "rank_ranges",
    "rliable_arrays",
    "runs_needed",
    "runs_to_detect",
    "sample_complexity",
    "slower",
    "times_below",
    "times_board",
    "times_pair",
    "unsettled",
]
