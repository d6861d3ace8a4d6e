"""Policy ranking: are policies ordered by success in predicted video as they are in the simulator?

Agreement is measured by Pearson's r, Spearman's rank correlation, and the mean maximum rank violation of SIMPLER (X. Li et al.,
"Evaluating real-world robot manipulation policies in simulation", 2024, arXiv 2405.05941). Intervals are over scenes.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import pandas as pd
from scipy.stats import rankdata

from xew.protocol import FAULT_STRIDE
from xew.statistics.bootstrap import Units, bootstrap_means
from xew.statistics.correlation import pearson
from xew.statistics.means import Mean, combine


def spearman(judged: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Spearman's rank correlation [...] over the last axis of success rates [... p]; NaN where one does not vary."""
    return pearson(rankdata(judged, axis=-1), rankdata(true, axis=-1))


def mean_max_rank_violation(judged: np.ndarray, true: np.ndarray) -> np.ndarray:
    """SIMPLER's MMRV of success rates [... p] of p policies, in [0, 1]; 0 is best.

    A pair whose order is wrong violates it by the difference of the two true rates. Each policy counts with its worst pair.
    By SIMPLER's formula, equal judged rates of policies that differ count for the lower policy alone.

    Args:
        judged: rates in predicted video. true: rates in the simulator.

    Returns:
        [...] float64.
    """
    judged, true = np.asarray(judged, float), np.asarray(true, float)
    wrong = _is_less(judged) != _is_less(true)
    return np.max(np.abs(true[..., :, None] - true[..., None, :]) * wrong, axis=-1).mean(axis=-1)


def _is_less(rate: np.ndarray) -> np.ndarray:
    """[... p p] whether the rate of policy i is less than that of policy j."""
    return rate[..., :, None] < rate[..., None, :]


RANKINGS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "pearson": pearson,
    "spearman": spearman,
    "mmrv": mean_max_rank_violation,
}
"""Functions of judged and true success rates [... p] by name."""
RANKED = ["robot", "model", "condition", "measure", "value", "low", "high", "policies", "scenes"]
BOUNDS = {"pearson": (-1.0, 1.0), "spearman": (-1.0, 1.0), "mmrv": (0.0, 1.0)}


def policy_ranking(rows: pd.DataFrame) -> dict[str, Mean]:
    """The agreement of judged with true success rates of policies, by the names of RANKINGS, with draws of scenes.

    Args:
        rows: one episode each: task, seed (of the scene, the same for all policies), policy, judged and true (1 is success).

    Raises:
        ValueError: there are fewer than two policies.
    """
    table = rows.pivot_table(index=["task", "seed"], columns="policy", values=["judged", "true"], sort=True)
    policies = len(table.columns) // 2
    if policies < 2:
        raise ValueError(f"there are {policies} policies to rank, expected at least 2: the column policy.")
    units = Units(rows)
    rates = [*bootstrap_means(table.to_numpy(), units.numbers(cast(pd.MultiIndex, table.index)), units.strata)]
    known = [rate for rate in rates if rate is not None]

    def compare(function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[..., np.ndarray]:
        return lambda *values: function(*np.split(np.stack(values, axis=-1), 2, axis=-1))

    return {name: combine(compare(function), *known).within(BOUNDS[name]) for name, function in RANKINGS.items()}


def rank_policies(rows: pd.DataFrame, groups: Mapping[str, Sequence[str]]) -> pd.DataFrame:
    """How models rank policies: the expert and its faults, each a policy with a success rate over scenes.

    Args:
        rows: of a score table, with the metrics outcome_accuracy and hallucinated_success (which failures alone have).
        groups: robots that are pooled, by the name of the group.

    Returns:
        robot model condition measure value low high policies scenes; empty where the table has no two policies.
    """
    key = ["model", "condition", "task", "seed", "robot"]
    graded = rows[rows["metric"] == "outcome_accuracy"].set_index(key)["value"]
    failed = graded.index.isin(pd.MultiIndex.from_frame(rows.loc[rows["metric"] == "hallucinated_success", key]))
    episodes = pd.DataFrame({"true": (~failed).astype(float), "judged": (failed ^ (graded == 1)).astype(float)}).reset_index()
    episodes = episodes.assign(policy=episodes["seed"] // FAULT_STRIDE, seed=episodes["seed"] % FAULT_STRIDE)
    table: list[tuple[Any, ...]] = []
    for group, robots in groups.items():
        for (model, condition), own in episodes[episodes["robot"].isin(robots)].groupby(["model", "condition"], sort=False):
            if own["policy"].nunique() > 1:
                counts = own["policy"].nunique(), len(own[["task", "seed"]].drop_duplicates())
                ranking = policy_ranking(own).items()
                table += [(group, model, condition, name, mean.value, *mean.interval(), *counts) for name, mean in ranking]
    return pd.DataFrame(table, columns=RANKED)
