"""Tables of the recomputed figures; ✓ behind a value says that it agrees with the printed one, ✗ that it does not."""

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from lab.paper_figures.recompute import RecomputedChange, RecomputedFigure, mean_distances
from xew.analysis.correlation import Correlation, loeo_correlation
from xew.analysis.distances.workspaces import Frame, chamfer_floor, measure
from xew.analysis.paper import AXES, PAPER_TITLES, Paper, PublishedChange
from xew.analysis.tables.labels import ACTIONS, LADDER, ROBOT_TITLES, SYSTEMS
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection, format_signed
from xew.protocol import ROBOT_NAMES
from xew.sim_warp.robots import ROBOTS

AXIS_TITLES = {"appearance": "Appearance distance", "kinematic": "Kinematic distance"}
AGREES = {True: "✓", False: "✗"}
"""Marks of whether a recomputed value agrees with the printed one."""
SEEDS = range(20)
"""Seeds of the draws that our own kinematic distances are means of."""
SECTIONS = {
    "sec:exp-actrep": "Action representation",
    "sec:exp-cond": "Robot descriptions",
    "sec:exp-fewshot": "Few-shot adaptation",
    "sec:exp-baseline": "World models",
}
"""Titles of the paper's sections that print percentages."""

CORRELATION_TEXT = (
    "Pearson's r of each robot's distance to the other four with its score when it was held out, and its range when one "
    "robot is left out. Positive means: farther is worse. Ours is computed from the printed scores and distances; the "
    "printed value is below it. ✓ says that inputs which print like these exist for which the value prints like the "
    "paper's; ✗ says that none was found. DoF r is a diagnostic: one robot alone has seven joints."
)
FRAME_TEXT = (
    "The paper's text has the origins of every link in the arm's base frame. Its figures are those of each URDF's root frame, "
    "as clouds of our own URDFs show: in it all ten distances come out, in the arm's frame three of Aloha's four do not. "
    "Aloha's root lies on the floor, the others' is the arm's base. Here its scores meet our own clouds: in its frame; as its "
    "text says; and of the arm alone, so that no body counts. The arm alone goes with the joints' column, for Franka, the one "
    "robot of seven joints, is then the farthest; five robots cannot tell the two apart."
)
FRAME_TITLES: dict[Frame, str] = {
    "root": "Root frame (ours)",
    "arm_base": "Arm's base frame, as the text says (ours)",
    "arm_alone": "Arm alone, in that frame (ours)",
}
CHANGE_TEXT = (
    "What the text says (small), and what the tables give for it: from the printed scores, and below from all scores that "
    "print the same. Shares of a gap are of the way from zero-shot to the seen robots."
)
ROBOT_TEXT = "Means of the rows of the printed matrices, the printed means below them; features as printed."


@cache
def frame_distances() -> dict[Frame, np.ndarray]:
    """Mean kinematic distances of our five robots to the other four, by frame: [s 5] float64, a row for each seed [m]."""
    robots = {name: ROBOTS[name] for name in ROBOT_NAMES}
    return {frame: mean_distances(measure(robots, SEEDS, frame).kinematic) for frame in FRAME_TITLES}


@cache
def _mean_floor() -> np.ndarray:
    return chamfer_floor({name: ROBOTS[name] for name in ROBOT_NAMES}, SEEDS[:5]).mean(axis=0)


def frame_results(paper: Paper, distances: np.ndarray) -> dict[str, Correlation]:
    """Correlation by metric of the paper's scores with mean distances [s 5]."""
    axis = distances.mean(axis=0).tolist()
    return {
        name: loeo_correlation(axis, paper.scores(name).tolist(), metric.higher_is_better)
        for name, metric in paper.metrics.items()
    }


def correlation_table(paper: Paper, cells: Sequence[RecomputedFigure]) -> Table:
    """The paper's correlation table: r and leave-one-out range for each axis, then r with the number of joints."""
    found = {(cell.metric, cell.axis, cell.quantity): cell for cell in cells}
    layout = [(axis, names) for axis in AXES for names in (("r",), ("low", "high"))] + [("dof", ("r",))]
    rows = [
        TableRow(
            (PAPER_TITLES[metric],), tuple(_compared_cell([found[metric, axis, q] for q in names]) for axis, names in layout)
        )
        for metric in paper.metrics
    ]
    columns = [Column(title, AXIS_TITLES[axis]) for axis in AXES for title in ("Pearson r", "leave one out")]
    return _table(
        "correlations", "The correlation table", CORRELATION_TEXT, "metric", [*columns, Column("DoF r", "Joints")], rows
    )


def _compared_cell(cells: Sequence[RecomputedFigure]) -> TableCell:
    """A cell of one figure, or of the two ends of a range."""
    ours = " to ".join(format_signed(cell.ours) for cell in cells)
    published = " to ".join(format_signed(cell.published) for cell in cells)
    value, printed = (cells[0].ours, cells[0].published) if len(cells) == 1 else (np.nan, np.nan)
    agrees = all(cell.agrees for cell in cells)
    return TableCell(f"{ours} {AGREES[agrees]}", published=published, value=value, printed=printed)


def frame_table(paper: Paper, frames: Mapping[Frame, np.ndarray]) -> Table:
    """Table of the paper's kinematic correlation beside those that our own clouds give; `frames` has mean distances [s 5]."""
    by_frame = {frame: frame_results(paper, distances) for frame, distances in frames.items()}

    def row(metric: str) -> TableRow:
        printed = paper.metrics[metric].kinematic
        cells = [_signed_cell(printed.r), _range_cell(printed.low, printed.high)]
        for frame, results in by_frame.items():
            result = results[metric]
            p = TableCell(f"{result.p_value:.3f}", value=result.p_value)
            cells += [_signed_cell(result.r), *((_range_cell(result.low, result.high), p) if frame != "root" else ())]
        return TableRow((PAPER_TITLES[metric],), tuple(cells))

    columns = [Column(head, "As printed") for head in ("r", "leave one out")]
    columns += [
        Column(head, FRAME_TITLES[frame])
        for frame in frames
        for head in (("r",) if frame == "root" else ("r", "leave one out", "p"))
    ]
    rows = [row(metric) for metric in paper.metrics]
    return _table("frames", "Kinematic distance with the paper's scores", FRAME_TEXT, "metric", columns, rows)


def base_table(paper: Paper, frames: Mapping[Frame, np.ndarray]) -> Table:
    """Table of the mean distances [s 5] that `frame_table` rests on."""
    rows, floor = [], _mean_floor()
    for i, name in enumerate(paper.robots):
        cells = [TableCell(f"{paper.robots[name].kinematic:.3f}", value=paper.robots[name].kinematic)]
        for distances in frames.values():
            mean, spread = float(distances[:, i].mean()), float(distances[:, i].std(ddof=1))
            cells.append(TableCell(f"{mean:.3f}", f"± {spread:.3f}", value=mean, low=mean - spread, high=mean + spread))
        cells.append(TableCell(f"{floor[i]:.3f}", value=float(floor[i])))
        rows.append(TableRow((ROBOT_TITLES[name],), tuple(cells)))
    caption = (
        f"Meters. ± is the standard deviation of one draw of configurations, over {len(SEEDS)} draws. Right: how far a robot "
        "is from itself by another draw in the root frame, which is what 4,000 points make of no distance at all."
    )
    columns = [Column(head) for head in ("As printed", *FRAME_TITLES.values(), "The same robot twice (ours)")]
    return _table("frame_distances", "Mean kinematic distance to the other four", caption, "robot", columns, rows)


def change_table(changes: Sequence[RecomputedChange]) -> Table:
    sections = []
    for source, title in SECTIONS.items():
        found = [one for one in changes if one.change.source == source]
        rows = (TableRow((describe_change(one.change),), (_change_cell(one),)) for one in found)
        sections.append(TableSection(title, tuple(rows)))
    caption, columns = CHANGE_TEXT, (Column("change"),)
    return Table("changes", "What the tables give for them", caption, ("what is compared",), columns, tuple(sections))


def _change_cell(found: RecomputedChange) -> TableCell:
    printed = format_percent(found.change.percent, 0)
    if found.change.word != "rounded":
        printed = f"{found.change.word} {printed.lstrip('+−') if found.change.word == 'less than' else printed}"
    return TableCell(
        f"{format_percent(found.ours)} {AGREES[found.agrees]}",
        f"{format_percent(found.least)} to {format_percent(found.most)}",
        printed,
        value=found.ours,
        low=found.least,
        high=found.most,
        printed=found.change.percent,
    )


def describe_change(change: PublishedChange) -> str:
    """Text such as 'LPIPS, Piper: joint pose to optical flow'."""
    (part, before, start), (_, after, end) = (place.split("/") for place in (change.before, change.after))
    if start == end:
        subject, first, second = ROBOT_TITLES[end], _row_title(part, before, end), _row_title(part, after, end)
    else:
        subject, first, second = SYSTEMS[after], *(ROBOT_TITLES.get(robot, "seen robots") for robot in (start, end))
    gap = ", share of the gap to seen robots" if change.toward else ""
    return f"{PAPER_TITLES[change.metric]}, {subject}: {first} to {second}{gap}"


def _row_title(part: str, key: str, robot: str) -> str:
    target, _, shots = key.rpartition("-")
    if target:
        return f"M = {shots}" if target == robot else f"{ROBOT_TITLES[target]}, M = {shots}"
    return {"actions": ACTIONS, "ladder": LADDER, "forgetting": {"none": "no adaptation"}}[part][key].lower()


def format_percent(value: float, digits: int = 1) -> str:
    return f"{value:+z.{digits}f} %".replace("-", "−")


def robot_table(paper: Paper, means: Sequence[RecomputedFigure]) -> Table:
    found = {(cell.metric, cell.axis): cell for cell in means}

    def row(name: str) -> TableRow:
        robot = paper.robots[name]
        cells = [_mean_cell(found[name, axis]) for axis in AXES]
        cells += [TableCell(str(count), value=count) for count in (robot.dof, robot.links)]
        cells += [TableCell(f"{size:.3f}", value=size) for size in (robot.reach, robot.volume)]
        return TableRow((ROBOT_TITLES[name],), tuple(cells))

    columns = [Column(head, "Mean distance to the other four") for head in ("appearance", "kinematic [m]")]
    columns += [Column(head, "Features") for head in ("joints", "links", "reach [m]", "hull [m³]")]
    return _table("robots", "Distances and features", ROBOT_TEXT, "robot", columns, [row(name) for name in paper.robots])


def _mean_cell(cell: RecomputedFigure) -> TableCell:
    printed = f"{cell.published:.3f}"
    text = f"{cell.ours:.3f} {AGREES[cell.agrees]}"
    return TableCell(text, published=printed, value=cell.ours, printed=cell.published)


def _signed_cell(value: float) -> TableCell:
    return TableCell(format_signed(value), value=value)


def _range_cell(low: float, high: float) -> TableCell:
    return TableCell(f"{format_signed(low)} to {format_signed(high)}", low=low, high=high)


def _table(name: str, title: str, caption: str, stub: str, columns: Sequence[Column], rows: Sequence[TableRow]) -> Table:
    return Table(name, title, caption, (stub,), tuple(columns), (TableSection("", tuple(rows)),))
