"""Power: whether a task can tell a video that follows the truth from one in which nothing happens.

Where the frozen first frame scores nearly as well as the true video, as where hardly anything of a body is seen to move, a task
says nothing about a metric and leaves its mean, for all models and robots alike. This is so of metrics that need an estimator
and belong to the suite strict; means of the suite paper stay over all tasks, as the paper's are.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from xew.protocol import COPY_FIRST_FRAME, GROUND_TRUTH

LEAST_POWER = 2.0
"""Least power of a task for a metric: how many times as far from the best the frozen first frame is as the true video."""


def find_power(rows: pd.DataFrame, bests: Mapping[str, float]) -> pd.DataFrame:
    """The power of each task for each metric with a best value, over the episodes of all robots.

    Returns:
        task, metric, frozen and truth (mean scores), power (the frozen first frame's distance from the best over the true
            video's), kept (whether power reaches LEAST_POWER). No row where one was not graded.
    """
    baselines = rows[rows["model"].isin([COPY_FIRST_FRAME, GROUND_TRUTH]) & rows["metric"].isin(list(bests))]
    means = baselines.groupby(["task", "metric", "model"])["value"].mean().unstack()
    means = means.reindex(columns=[COPY_FIRST_FRAME, GROUND_TRUTH]).dropna().set_axis(["frozen", "truth"], axis=1).reset_index()
    best = means["metric"].map(dict(bests)).astype(float)
    frozen, truth = (np.abs(means[name].astype(float) - best) for name in ("frozen", "truth"))
    with np.errstate(divide="ignore", invalid="ignore"):
        return means.assign(power=frozen / truth, kept=frozen > LEAST_POWER * truth)


def find_powerless(power: pd.DataFrame) -> list[tuple[str, str]]:
    """Task and metric of all that leaves a mean, in order."""
    left = power.loc[~power["kept"].astype(bool), ["task", "metric"]]
    return [(str(task), str(metric)) for task, metric in left.itertuples(index=False, name=None)]


def drop_powerless(rows: pd.DataFrame, power: pd.DataFrame) -> pd.DataFrame:
    """The rows of a score table without those of tasks that have no power for their metric."""
    powerless = find_powerless(power)
    if not powerless:
        return rows
    return rows[~pd.MultiIndex.from_frame(rows[["task", "metric"]]).isin(powerless)]


def describe_power(power: pd.DataFrame, titles: Mapping[str, str]) -> str:
    """Sentence on the tasks that means leave out, with titles of metrics by name; '' if there is none."""
    tasks: dict[str, list[str]] = {}
    for task, metric in find_powerless(power):
        tasks.setdefault(titles.get(metric, metric), []).append(task)
    if not tasks:
        return ""
    left_out = "; ".join(f"{metric}: {', '.join(names)}" for metric, names in tasks.items())
    return (
        f"Means leave out tasks without power, where the frozen first frame is less than {LEAST_POWER:g} times as far from the "
        f"best score as the true video ({left_out})."
    )
