"""Tables of distances between robots and of their correlation with scores, in the paper's layouts.

Without the files of `python -m xew.analysis.distance` they use the paper's printed distances and say so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from xew.analysis.correlation import Correlation, dof_correlation, loeo_correlation
from xew.analysis.paper import AXES, PAPER_TITLES, Paper
from xew.analysis.statistics.grades import Grades, unseen_gap
from xew.analysis.tables.labels import PAPER_METRICS, ROBOT_TITLES, SHORT_ROBOTS
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection, format_signed, metric_title
from xew.config import ConfigError
from xew.protocol import HELD_OUT_ROBOTS, ROBOT_NAMES
from xew.statistics import Mean, strict_metrics

AXIS_TITLES = {
    "kinematic": "Kinematic distance [m]",
    "appearance": "Appearance distance",
    "arm_base": "From the arm's base [m] (ours)",
    "arm_alone": "Arm alone, from there [m] (ours)",
    "perceptual": "LPIPS of the renders (ours)",
    "motion": "Motion distance [px] (ours)",
}
FEATURE_TITLES = {"dof": "Joints", "links": "Links", "reach": "Reach [m]", "volume": "Volume [m³]"}
COMMAND = "python -m xew.analysis.distance --out {folder}"


@dataclass(frozen=True)
class Distances:
    """Distances between robots, and the features of each robot."""

    pairs: pd.DataFrame
    """Table with the columns axis robot other value spread published."""
    robots: pd.DataFrame
    """Table with the columns robot feature value spread published; mean distances stand under their axis."""
    measured: bool
    """Whether we measured them; else they are the paper's figures."""

    @property
    def axes(self) -> list[str]:
        """Kinds of distance that are known."""
        return [axis for axis in AXIS_TITLES if axis in set(self.robots["feature"])]

    def of(self, feature: str, column: str = "value") -> np.ndarray:
        """A feature of all robots, or its spread (`column`): [5] float64 in the order of ROBOT_NAMES."""
        found = self.robots[self.robots["feature"] == feature].set_index("robot")[column]
        return found.reindex(list(ROBOT_NAMES)).to_numpy(np.float64)


def read_distances(folder: Path) -> Distances:
    """Read the files of python -m xew.analysis.distance. Raises ConfigError if a file, column, robot or axis is missing."""
    frames = []
    for name, columns in (("distances", ["axis", "robot", "other"]), ("robots", ["robot", "feature"])):
        path = folder / f"{name}.csv"
        try:
            frames.append(pd.read_csv(path))
        except (OSError, ValueError) as error:
            raise ConfigError(f"cannot read {path} ({error}); make it: {COMMAND.format(folder=folder)}") from error
        missing = [column for column in (*columns, "value", "spread", "published") if column not in frames[-1]]
        if missing:
            raise ConfigError(f"{path} has no column {', '.join(missing)}; make it again: {COMMAND.format(folder=folder)}")
    found = Distances(frames[0], frames[1], measured=True)
    for feature in (*AXES, *FEATURE_TITLES):
        lacking = [robot for robot, value in zip(ROBOT_NAMES, found.of(feature), strict=True) if np.isnan(value)]
        if lacking:
            raise ConfigError(
                f"{folder / 'robots.csv'} has no {feature} of {', '.join(lacking)}; make it again with all five robots: "
                f"{COMMAND.format(folder=folder)}"
            )
    return found


def printed_distances(paper: Paper) -> Distances:
    """The paper's printed distances."""
    features = (*FEATURE_TITLES, *AXES)
    robots = [(robot, name, getattr(paper.robots[robot], name)) for name in features for robot in ROBOT_NAMES]
    names = list(paper.robots)
    pairs = [
        (axis, names[a], names[b], paper.distances[axis][a][b]) for axis in AXES for a in range(5) for b in range(a + 1, 5)
    ]
    blank = {"spread": 0.0, "published": np.nan}
    return Distances(
        pd.DataFrame(pairs, columns=["axis", "robot", "other", "value"]).assign(**blank),
        pd.DataFrame(robots, columns=["robot", "feature", "value"]).assign(**blank),
        measured=False,
    )


def correlate(grades: Grades, distances: Distances) -> dict[tuple[str, str], Correlation]:
    """Correlations by metric and axis; metrics that some fold lacks are left out."""
    found = {}
    for name in PAPER_METRICS:
        scores = _loeo_scores(grades, name)
        if scores is not None:
            for axis in distances.axes:
                better_up = grades.metrics[name].higher_is_better
                found[name, axis] = loeo_correlation(distances.of(axis).tolist(), scores, better_up)
    return found


def distance_tables(distances: Distances) -> list[Table]:
    """Tables of mean distances, of features and of all matrices."""
    origin = "" if distances.measured else " These are the paper's figures: none of our own were given (--distances)."
    drawn = (distances.robots["spread"] > 0).any()
    spread = " ±: deviation of one draw of configurations; of looks, the jackknife over views." if drawn else ""
    return [
        _robot_table(
            distances,
            "distances",
            "Distance of each robot to the other four",
            f"{spread}{origin}".strip(),
            {axis: AXIS_TITLES[axis] for axis in distances.axes},
        ),
        _robot_table(
            distances,
            "features",
            "Kinematic features",
            f"Reach and volume of the hull are of all links over all configurations.{origin}",
            FEATURE_TITLES,
        ),
        _matrix_table(distances, origin),
    ]


def correlation_table(grades: Grades, distances: Distances, paper: Paper) -> Table:
    """The paper's table: r and leave-one-out range for each of its axes, then r with the number of joints."""
    results = correlate(grades, distances)

    def row(metric: str) -> TableRow:
        cells = []
        for axis in AXES:
            result, printed = results.get((metric, axis)), getattr(paper.metrics[metric], axis)
            cells += [
                _signed_cell([result.r] if result else [], [printed.r]),
                _signed_cell([result.low, result.high] if result else [], [printed.low, printed.high]),
            ]
        scores = _loeo_scores(grades, metric)
        dof = [dof_correlation(distances.of("dof").tolist(), scores, grades.metrics[metric].higher_is_better)] if scores else []
        cells.append(_signed_cell(dof, [paper.metrics[metric].dof_r]))
        return TableRow((PAPER_TITLES[metric],), tuple(cells))

    columns = [Column(title, AXIS_TITLES[axis]) for axis in AXES for title in ("Pearson r", "leave one out")]
    shown = [metric for metric in PAPER_METRICS if metric in grades.metrics]
    return Table(
        "correlations",
        "Correlation of distance with scores",
        "r of each robot's mean distance with its score when it was held out, and its range when one robot is left out. "
        f"Positive: farther is worse. LPIPS is the paper's primary outcome; all others are exploratory."
        f"{_note_printed_distances(distances)}",
        ("metric",),
        (*columns, Column("DoF r")),
        (TableSection("", tuple(row(metric) for metric in shown), _note_missing_folds(grades, shown)),),
    )


def own_correlation_tables(grades: Grades, distances: Distances) -> list[Table]:
    """The same table for distances that the paper does not have; none where none were measured."""
    results = correlate(grades, distances)
    own = [axis for axis in distances.axes if axis not in AXES]
    shown = [metric for metric in PAPER_METRICS if metric in grades.metrics]

    def row(metric: str) -> TableRow:
        cells: list[TableCell] = []
        for axis in own:
            cells += _correlation_cells(results.get((metric, axis)))
        return TableRow((PAPER_TITLES[metric],), tuple(cells))

    table = Table(
        "correlations_own",
        "Correlation of our own distances with scores",
        "r, its range when one robot is left out, and the exact two-sided p over all 120 pairings. Positive: farther is worse.",
        ("metric",),
        tuple(Column(title, AXIS_TITLES[axis]) for axis in own for title in ("Pearson r", "leave one out", "p")),
        (TableSection("", tuple(row(metric) for metric in shown), _note_missing_folds(grades, shown)),),
    )
    return [table] if own else []


def unseen_gaps(grades: Grades, metric: str) -> list[Mean] | None:
    """`unseen_gap` of each robot in the order of ROBOT_NAMES; None where a fold was not graded, or r is not defined."""
    gaps = [unseen_gap(grades, robot, metric) for robot in ROBOT_NAMES]
    known = [gap for gap in gaps if gap is not None]
    return known if _vary([gap.value for gap in known]) else None


def gap_correlation_tables(grades: Grades, distances: Distances) -> list[Table]:
    """The gap of each robot in the metrics that decide, and its correlation with distance; none without all five folds."""
    deciding = dict.fromkeys(strict_metrics(grades.metrics).get(name, name) for name in PAPER_METRICS if name in grades.metrics)
    found = {metric: gaps for metric in deciding if (gaps := unseen_gaps(grades, metric)) is not None}

    def row(metric: str, gaps: Sequence[Mean]) -> TableRow:
        cells = [_percent_cell(gap, grades.level) for gap in gaps]
        for axis in AXES:
            cells += _correlation_cells(loeo_correlation(distances.of(axis).tolist(), [gap.value for gap in gaps]))
        return TableRow((metric_title(grades.metrics[metric]),), tuple(cells))

    heads = ("Pearson r", "leave one out", "p")
    table = Table(
        "gap_correlations",
        "The gap of each robot, and its correlation with distance",
        "Gap: loss of the fold that never saw a robot against the mean of the four folds that did, on the same episodes. r of "
        "distance with the gap, its range when one robot is left out, and the exact two-sided p over all 120 pairings. Ours, "
        "and exploratory: the claims are about scores."
        f"{_note_printed_distances(distances)}",
        ("metric",),
        (
            *(Column(SHORT_ROBOTS[robot], "Gap") for robot in ROBOT_NAMES),
            *(Column(title, AXIS_TITLES[axis]) for axis in AXES for title in heads),
        ),
        (TableSection("", tuple(row(metric, gaps) for metric, gaps in found.items())),),
    )
    return [table] if found else []


def certainty_table(grades: Grades, distances: Distances, paper: Paper) -> Table:
    """Table of what five points can say: exact p, Spearman, bootstrap over robots, stability of the sign."""
    results = correlate(grades, distances)

    def row(metric: str) -> TableRow:
        cells: list[TableCell] = []
        for axis in AXES:
            result, printed = results.get((metric, axis)), getattr(paper.metrics[metric], axis).p_value
            p = TableCell(published=f"{printed:.3f}" if printed else "", printed=printed or np.nan)
            if result is None:
                cells += [p, TableCell(), TableCell(), TableCell()]
                continue
            spread = f"{format_signed(result.bootstrap_low)} to {format_signed(result.bootstrap_high)}"
            cells += [
                TableCell(f"{result.p_value:.3f}", published=p.published, printed=p.printed, value=result.p_value),
                TableCell(format_signed(result.spearman), value=result.spearman),
                TableCell(spread, value=result.r, low=result.bootstrap_low, high=result.bootstrap_high),
                TableCell("stable" if result.stable else "unstable", value=float(result.stable)),
            ]
        return TableRow((PAPER_TITLES[metric],), tuple(cells))

    shown = [metric for metric in PAPER_METRICS if metric in grades.metrics]
    heads = ("exact p", "Spearman ρ", "bootstrap of r", "sign")
    return Table(
        "certainty",
        "Certainty of these correlations",
        "p is two-sided over all 120 pairings; ρ and the 95 % bootstrap over robots are ours; the sign is stable where it "
        f"survives leaving out any one robot.{_note_printed_distances(distances)}",
        ("metric",),
        tuple(Column(head, AXIS_TITLES[axis]) for axis in AXES for head in heads),
        (TableSection("", tuple(row(metric) for metric in shown), _note_missing_folds(grades, shown)),),
    )


def _loeo_scores(grades: Grades, metric: str) -> list[float] | None:
    means = [grades.mean("loeo", f"loeo_{robot}", robot, metric) if metric in grades.metrics else None for robot in ROBOT_NAMES]
    values = [mean.value for mean in means if mean is not None]
    return values if _vary(values) else None


def _vary(values: Sequence[float]) -> bool:
    """Whether there is a number for each robot, and they vary whichever robot is left out."""
    return len(values) == len(ROBOT_NAMES) and all(np.ptp(np.delete(values, i)) > 0 for i in range(len(values)))


def _note_missing_folds(grades: Grades, metrics: Sequence[str]) -> str:
    missing = [
        ROBOT_TITLES[robot]
        for robot in ROBOT_NAMES
        if not any(grades.mean("loeo", f"loeo_{robot}", robot, metric) for metric in metrics)
    ]
    return f"Incomplete: all five folds are needed, not run: {', '.join(missing)}." if missing else ""


def _note_printed_distances(distances: Distances) -> str:
    return "" if distances.measured else " Distances are the paper's printed ones."


def _signed_cell(ours: Sequence[float], printed: Sequence[float]) -> TableCell:
    """A cell of one figure, or of the two ends of a range."""
    return TableCell(
        " to ".join(map(format_signed, ours)) or "–",
        published=" to ".join(map(format_signed, printed)),
        value=ours[0] if len(ours) == 1 else np.nan,
        low=ours[0] if len(ours) == 2 else np.nan,
        high=ours[-1] if len(ours) == 2 else np.nan,
        printed=printed[0] if len(printed) == 1 else np.nan,
    )


def _correlation_cells(result: Correlation | None) -> list[TableCell]:
    """Cells of r, its leave-one-out range and p."""
    if result is None:
        return [TableCell()] * 3
    p = TableCell(f"{result.p_value:.3f}", value=result.p_value)
    return [_signed_cell([result.r], []), _signed_cell([result.low, result.high], []), p]


def _percent_cell(mean: Mean, level: float) -> TableCell:
    low, high = mean.interval(level)
    text, *ends = (f"{100 * number:+.0f}".replace("-", "−") for number in (mean.value, low, high))
    return TableCell(f"{text} %", "" if np.isnan(low) else " to ".join(ends), value=mean.value, low=low, high=high)


def _robot_table(distances: Distances, name: str, title: str, caption: str, features: Mapping[str, str]) -> Table:
    records = {(row["robot"], row["feature"]): row for row in distances.robots.to_dict("records")}

    def row(robot: str) -> TableRow:
        cells = (_distance_cell(records.get((robot, feature)), feature) for feature in features)
        return TableRow((ROBOT_TITLES[robot],), tuple(cells))

    seen = tuple(row(robot) for robot in ROBOT_NAMES if robot not in HELD_OUT_ROBOTS)
    held_out = tuple(row(robot) for robot in HELD_OUT_ROBOTS)
    columns = tuple(Column(head) for head in features.values())
    return Table(name, title, caption, ("robot",), columns, (TableSection("Seen", seen), TableSection("Held out", held_out)))


def _matrix_table(distances: Distances, origin: str) -> Table:
    def section(axis: str) -> TableSection:
        chosen = distances.pairs[distances.pairs["axis"] == axis]
        records = {frozenset((row["robot"], row["other"])): row for row in chosen.to_dict("records")}
        rows = tuple(
            TableRow(
                (SHORT_ROBOTS[a],),
                tuple(
                    TableCell("0", value=0.0) if a == b else _distance_cell(records.get(frozenset((a, b)))) for b in ROBOT_NAMES
                ),
            )
            for a in ROBOT_NAMES
        )
        return TableSection(AXIS_TITLES[axis], rows)

    axes = [axis for axis in AXIS_TITLES if axis in set(distances.pairs["axis"])]
    return Table(
        "matrices",
        "Distance of every two robots",
        f"Symmetric.{origin}",
        ("",),
        tuple(Column(SHORT_ROBOTS[robot]) for robot in ROBOT_NAMES),
        tuple(section(axis) for axis in axes),
    )


def _distance_cell(record: Mapping[object, float] | None, feature: str = "") -> TableCell:
    if record is None:
        return TableCell()
    digits = 0 if feature in ("dof", "links") else 3
    value, spread, printed = (float(record[name]) for name in ("value", "spread", "published"))
    return TableCell(
        f"{value:.{digits}f}",
        f"± {spread:.{digits}f}" if spread > 0 else "",
        "" if np.isnan(printed) else f"{printed:.{digits}f}",
        value=value,
        low=value - spread if spread > 0 else np.nan,
        high=value + spread if spread > 0 else np.nan,
        printed=printed,
    )
