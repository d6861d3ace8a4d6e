"""Policy ranking: are policies ordered by success in predicted video as they are in the simulator?

The commands of a scene, sorted by how bad their faults are, make as many graded policies: policy 0 is the expert, and policy k
carries out the k-th mildest faulty commands of every scene. Each has every scene, and shares no episode with another.

Agreement is measured by Pearson's r, Spearman's rank correlation, and the mean maximum rank violation of SIMPLER (X. Li et al.,
"Evaluating real-world robot manipulation policies in simulation", 2024, arXiv 2405.05941). Intervals are over
scenes; a policy that no scene of a draw has tried is left out of that draw.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import pandas as pd
from scipy.stats import rankdata

from xew.protocol import BASELINES, FAULT_GRADES, FAULT_STRIDE
from xew.statistics.bootstrap import Units, bootstrap_means
from xew.statistics.means import Mean, fixed_mean


def pearson(judged: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Pearson's r [...] over the last axis of success rates [... p]; NaN where one does not vary.

    Here and below, a policy whose rates are NaN is left out.
    """
    x, y = (rates - np.nanmean(rates, axis=-1, keepdims=True) for rates in (judged, true))
    with np.errstate(invalid="ignore"):
        return np.nansum(x * y, axis=-1) / np.sqrt(np.nansum(x**2, axis=-1) * np.nansum(y**2, axis=-1))


def spearman(judged: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Spearman's rank correlation [...] over the last axis of success rates [... p]; NaN where one does not vary."""
    return pearson(*(rankdata(rates, axis=-1, nan_policy="omit") for rates in (judged, true)))


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
    violation = np.where(wrong, np.abs(true[..., :, None] - true[..., None, :]), 0).max(axis=-1)
    return np.nanmean(np.where(np.isnan(true), np.nan, violation), axis=-1)


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
NEAR_ONE = 0.999
"""Largest correlation of draws on Fisher's scale, unless the estimate is larger: its mirror image has no end at 1."""
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
    judged, true = np.split(np.stack([rate.values for rate in known], axis=-1), 2, axis=-1)
    scenes, freedom = max(rate.scenes or 0 for rate in known), max(rate.freedom for rate in known)
    values = {name: function(judged, true) for name, function in RANKINGS.items()}
    return {name: fixed_mean(own, len(rows), scenes, freedom).within(BOUNDS[name]) for name, own in values.items()}


def ranking_interval(name: str, mean: Mean) -> tuple[float, float]:
    """Ends of the interval of a measure of RANKINGS over scenes: of its draws and of their mirror image about it.

    Rates of few scenes vary by chance, which lowers r and raises MMRV, and draws vary once more: they lie to one side. In a
    simulation of 22 or 66 scenes and 8 policies such an interval holds the true value in 66 to 98 % of cases, and that of the
    draws alone in 52 to 97 %. Correlations are mirrored on Fisher's scale.
    """
    low, high = mean.interval()
    value, *ends = np.array([mean.value, low, high])
    if BOUNDS[name][0] < 0:
        limit = np.clip(abs(value), NEAR_ONE, np.nextafter(1, 0))
        value, *ends = np.arctanh(np.clip([value, *ends], -limit, limit))
    mirrored = 2 * value - np.array(ends)
    mirrored = np.clip(np.tanh(mirrored) if BOUNDS[name][0] < 0 else mirrored, *BOUNDS[name])
    return min(low, float(mirrored[1])), max(high, float(mirrored[0]))


def policy_outcomes(rows: pd.DataFrame) -> pd.DataFrame:
    """Outcomes of the graded videos: model condition task seed robot policy true judged (1 is success), a row each.

    A policy is the place of a command among all that the table has of its scene, from mild to bad; the seed is the scene's.

    Args:
        rows: of a score table, with the metrics outcome_accuracy and hallucinated_success (which failures alone have).
    """
    key = ["model", "condition", "task", "seed", "robot"]
    graded = rows[rows["metric"] == "outcome_accuracy"].set_index(key)["value"]
    failed = graded.index.isin(pd.MultiIndex.from_frame(rows.loc[rows["metric"] == "hallucinated_success", key]))
    episodes = pd.DataFrame({"true": (~failed).astype(float), "judged": (failed ^ (graded == 1)).astype(float)}).reset_index()
    episodes = episodes.assign(fault=episodes["seed"] // FAULT_STRIDE, seed=episodes["seed"] % FAULT_STRIDE)
    commands = episodes[["task", "seed", "fault"]].drop_duplicates()
    commands = commands.assign(grade=np.array(FAULT_GRADES)[commands["fault"]]).sort_values(["grade", "fault"])
    commands = commands.assign(policy=commands.groupby(["task", "seed"]).cumcount()).drop(columns="grade")
    return episodes.merge(commands).drop(columns="fault")


def rank_policies(rows: pd.DataFrame, groups: Mapping[str, Sequence[str]]) -> pd.DataFrame:
    """How models rank graded policies by their success rates over scenes.

    Args:
        rows: as of `policy_outcomes`.
        groups: robots that are pooled, by the name of the group.

    Returns:
        robot model condition measure value low high policies scenes, baselines last; empty where the table has no two policies.
    """
    episodes = policy_outcomes(rows)
    table: list[tuple[Any, ...]] = []
    place = {model: number for number, model in enumerate(BASELINES, 1)}
    for group, robots in groups.items():
        models = episodes[episodes["robot"].isin(robots)].groupby(["model", "condition"], sort=False)
        for (model, condition), own in sorted(models, key=lambda pair: place.get(str(pair[0][0]), 0)):
            if own["policy"].nunique() > 1:
                counts = own["policy"].nunique(), len(own[["task", "seed"]].drop_duplicates())
                ranking = policy_ranking(own).items()
                table += [
                    (group, model, condition, name, mean.value, *ranking_interval(name, mean), *counts)
                    for name, mean in ranking
                ]
    return pd.DataFrame(table, columns=RANKED)
