"""The first screen of a report: the answer to its title in one sentence, one picture and one chart.

The best model on each held-out robot, by LPIPS, is compared with the paste baseline, or else with the frozen first frame.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from xew.analysis.reports import charts, pictures
from xew.analysis.reports.charts import SERIES, Chart, Panel
from xew.analysis.reports.run_tables import Interval, RobotTable, Row
from xew.analysis.reports.study_strips import Strip
from xew.analysis.scores import COPY, TRUTH
from xew.analysis.statistics.grades import StudyGrades, find_variant
from xew.analysis.tables.builder import interval_ends
from xew.analysis.tables.labels import ACTIONS, LADDER, ROBOT_TITLES
from xew.episode import read_pixels, read_record, read_states
from xew.model.conditions import make_command, pasted_render
from xew.protocol import BASELINES, HELD_OUT_ROBOTS, PASTED_RENDER
from xew.rollout import Rollout, read_as_graded
from xew.statistics import BETTER, UNRESOLVED, WORSE, combine, verdict

METRIC = "lpips"
BEST = "best model"
TITLES = {PASTED_RENDER: "paste baseline", COPY: "frozen first frame"}
"""Names of the baselines that a model is compared with, the preferred one first."""
PHRASES = {BETTER: "better than", WORSE: "worse than", UNRESOLVED: "not resolved from"}


@dataclass(frozen=True)
class Contest:
    """The best model on one held-out robot, compared with a baseline."""

    robot: str
    baseline: str
    verdict: str
    bars: Mapping[str, tuple[float, float, float]]
    """Mean and ends of the interval, by the label of the model or baseline; the model first."""


@dataclass(frozen=True)
class Answer:
    """Everything on the first screen."""

    sentence: str
    chart: Chart | None = None
    strip: Strip | None = None


def answer(contests: Sequence[Contest], strip: Strip | None) -> Answer:
    """The first screen from the contests of all held-out robots; `strip` shows truth, prediction and pasted render."""
    if not contests:
        return Answer("Open: no model was compared with a baseline on a held-out robot.", strip=strip)
    verdicts = {contest.verdict for contest in contests}
    alone = {BETTER: "Yes", UNRESOLVED: "Unresolved"}
    head = alone.get(next(iter(verdicts)), "No") if len(verdicts) == 1 else "In part" if BETTER in verdicts else "No"
    robots: dict[str, list[str]] = {}
    for word, contest in product(PHRASES, contests):
        if contest.verdict == word:
            robots.setdefault(f"{PHRASES[word]} the {TITLES[contest.baseline]}", []).append(contest.robot)
    parts = [f"{phrase} on {' and '.join(names)}" for phrase, names in robots.items()]
    return Answer(f"{head}: by LPIPS, the best model is {', and '.join(parts)}.", _chart(contests), strip)


def _chart(contests: Sequence[Contest]) -> Chart:
    data = pd.DataFrame(
        ((c.robot, label, *numbers) for c in contests for label, numbers in c.bars.items()),
        columns=["robot", "row", "value", "low", "high"],
    )
    longest = float(np.nanmax(data[["value", "high"]].to_numpy()))

    def draw(axes: Axes, robot: str) -> None:
        rows = data[data["robot"] == robot]
        numbers = rows[["value", "low", "high"]].to_numpy()
        charts.bars(axes, list(rows["row"]), [(SERIES[0], numbers, np.full(len(rows), np.nan))], "LPIPS ↓")
        axes.set_xlim(0, 1.05 * longest or 1)

    panels = [Panel(c.robot, partial(draw, robot=c.robot), 0.9 + 0.32 * len(c.bars)) for c in contests]
    caption = "LPIPS of the best model and of the baselines on robots never seen; lower is better. Lines: 95 % intervals."
    return Chart("answer", caption, panels, data)


def best_row(table: RobotTable) -> Row | None:
    """The model with the best LPIPS among those that were compared with a baseline; None where there is none."""
    models = [row for row in table.rows if row.verdicts and METRIC in row.scores]
    return min(models, key=lambda row: row.scores[METRIC].mean, default=None)


def run_contests(tables: Sequence[RobotTable]) -> Iterator[Contest]:
    """The contests of a run's held-out robots, as far as LPIPS was graded."""
    for table in tables:
        if best := best_row(table):
            shown = [best, *(row for row in table.rows if row.model in (*TITLES, TRUTH) and METRIC in row.scores)]
            bars = {BEST if row is best else row.title: _numbers(row.scores[METRIC]) for row in shown}
            verdicts = best.over_pasting or best.verdicts
            yield Contest(table.title, PASTED_RENDER if best.over_pasting else COPY, verdicts[METRIC], bars)


def _numbers(score: Interval) -> tuple[float, float, float]:
    return score.mean, score.low, score.high


def study_contests(grades: StudyGrades) -> Iterator[tuple[str, str, Contest]]:
    """The contests of a study's held-out robots: the robot's key, the best variant that never saw it, and the contest."""
    rows = [("fixed", "fixed"), ("shifts", "fixed"), *product(["actions"], ACTIONS), *product(["ladder"], LADDER)]
    for robot in HELD_OUT_ROBOTS if METRIC in grades.metrics else ():
        means = {row: mean for row in rows if (mean := grades.mean(*row, robot, METRIC))}
        best = min(means, key=lambda row: means[row].value, default=None)
        pairs = {name: pair for name in TITLES if best and (pair := grades.against(*best, name, robot, METRIC))}
        if best is None or not pairs:
            continue
        baseline, pair = next(iter(pairs.items()))
        difference, info = combine(np.subtract, *pair), grades.metrics[METRIC]
        word = verdict(difference.value, difference.interval(), grades.floor(robot, METRIC, best), info.higher_is_better)
        shown = {BEST: means[best]}
        shown |= {BASELINES[name]: mean for name in (*TITLES, TRUTH) if (mean := grades.variant_mean(name, (robot,), METRIC))}
        bars = {label: (mean.value, *interval_ends(mean, grades.level)) for label, mean in shown.items()}
        yield robot, find_variant(*best).name, Contest(ROBOT_TITLES[robot], baseline, word, bars)


def answer_strip(episodes: Mapping[str, tuple[Path, Rollout]], frame_zero: str) -> Strip | None:
    """Truth, prediction and pasted render of the episode and rollout of each robot's title; None without an episode."""
    frames = []
    for folder, rollout in episodes.values():
        truth = read_pixels(folder, "rgb")
        predicted = read_as_graded(rollout, truth, frame_zero != "absent")
        pasted = pasted_render(make_command(folder, read_record(folder), read_states(folder)))
        t = 3 * (len(predicted) - 1) // 4
        frames.append([truth[t], predicted[t], pasted[t]])
    if not frames:
        return None
    caption = "The episode with the median LPIPS, at three quarters of its length."
    columns = ["truth", "prediction", "paste baseline"]
    return Strip(pictures.encode_png(pictures.sheet(frames)), caption, columns, list(episodes))
