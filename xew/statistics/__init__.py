"""The statistics of scores: bootstrap draws, intervals, tests, noise floors and verdicts.

`evaluate`, `report`, `study` and `distance` all ask here, so the same scores have the same intervals and verdicts in each.
The package stands on the ground: it imports NumPy, SciPy and pandas, and nothing of ours but `xew.protocol`.

    bootstrap.py   draws of scenes within tasks, and the mean of scores in every draw
    runs.py        draws of training runs, and the spread between runs that a single run carries
    means.py       means over scenes and runs, and numbers computed of them
    correlation.py Pearson's r, its p and its interval
    inference.py   intervals and p-values of what was drawn, Holm's correction for several tests
    verdicts.py    noise floors, and better, worse or unresolved
    suites.py      which of two suites' metrics decides, and where they part
    power.py       which tasks say nothing about a metric, and leave its mean
    ranking.py     are policies ranked in predicted video as in the simulator
    summary.py     means of a table by group of robots, and differences between its models
"""

from xew.statistics.bootstrap import Units, bootstrap_means, find_strata
from xew.statistics.correlation import (
    every_draw,
    exact_p,
    interval_of_difference,
    interval_of_r,
    partial_r,
    pearson,
    permutation_p,
)
from xew.statistics.inference import DRAWS, LEVEL, SIGNIFICANCE, Component, Drawn, holm
from xew.statistics.means import MIN_SCENES, Mean, Part, combine, fixed_mean, pool_runs
from xew.statistics.power import describe_power, find_power
from xew.statistics.ranking import mean_max_rank_violation, policy_outcomes, policy_ranking, rank_policies
from xew.statistics.runs import ASSUMED_SPREAD, RunSpread, find_spread
from xew.statistics.suites import describe_parting, find_parting, strict_metrics
from xew.statistics.summary import Summary, measure_power, summarize
from xew.statistics.verdicts import (
    BETTER,
    UNRESOLVED,
    WORSE,
    describe_floors,
    floor_sources,
    largest_floor,
    noise_floor,
    verdict,
)

__all__ = [
    "ASSUMED_SPREAD",
    "BETTER",
    "DRAWS",
    "LEVEL",
    "MIN_SCENES",
    "SIGNIFICANCE",
    "UNRESOLVED",
    "WORSE",
    "Component",
    "Drawn",
    "Mean",
    "Part",
    "RunSpread",
    "Summary",
    "Units",
    "bootstrap_means",
    "combine",
    "describe_floors",
    "describe_parting",
    "describe_power",
    "every_draw",
    "exact_p",
    "find_parting",
    "find_power",
    "find_spread",
    "find_strata",
    "fixed_mean",
    "floor_sources",
    "holm",
    "interval_of_difference",
    "interval_of_r",
    "largest_floor",
    "mean_max_rank_violation",
    "measure_power",
    "noise_floor",
    "partial_r",
    "pearson",
    "permutation_p",
    "policy_outcomes",
    "policy_ranking",
    "pool_runs",
    "rank_policies",
    "strict_metrics",
    "summarize",
    "verdict",
]
