"""Stage 11 of 11: the paper's figures checked against each other. `report --paper` writes what is made here.

Its distance table is rebuilt from its scores and distances, the percentages of its text from its tables. Ours is the question
what would have come out if workspaces had been compared in the frame of the arm's base, as its text says that they were.
"""

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import pandas as pd

from xew.analysis import page, pictures
from xew.analysis.correlation import Correlation, loeo_correlation
from xew.analysis.distance import Frame, mean_distances, measure
from xew.analysis.page import Compared
from xew.analysis.paper import (
    AXES,
    Cell,
    Paper,
    PublishedChange,
    RecomputedChange,
    mean_distance_cells,
    rebuild,
    recompute_changes,
)
from xew.analysis.summary import METRIC_TITLES, ROBOT_TITLES
from xew.protocol import ROBOT_NAMES
from xew.sim_warp.robots import ROBOTS

TITLE = "The paper's figures, rebuilt from one another"
AXIS_TITLES = {"appearance": "Appearance distance", "kinematic": "Kinematic distance"}
SEEDS = range(20)
"""Draws of the clouds that kinematic distances of our own are means of."""
PRIMARY = "lpips"
"""The paper's primary outcome; it calls all others exploratory."""
FIGURE = "distance.png"

CORRELATION_TEXT = (
    "Pearson's r of each robot's distance to the other four with its score when it was held out, and its range when one "
    "robot is left out. Positive means: farther is worse. Ours is computed from the printed scores and distances; the "
    "printed value is below it. ✓ says that inputs which print like these exist for which the value prints like the "
    "paper's; ✗ says that none was found. DoF r is a diagnostic: one robot alone has seven joints."
)
CERTAINTY_TEXT = (
    "What five points can say. p is exact and two-sided, over all 120 pairings; the paper prints it for LPIPS only. Spearman's "
    "ρ and the 95 % bootstrap interval of r (all resamples of three or more different robots) are ours. The sign is stable "
    "where it survives leaving out any one robot."
)
FRAME_TEXT = (
    "The paper's text has workspaces in the arm's base frame. Its figures are those of each URDF's root frame with all links, "
    "as clouds of our own URDFs show: in it all ten distances come out, in the arm's frame none of Aloha's does. The root of "
    "Aloha lies on the floor, between its arms, so all of it is far from robots whose root is the arm's base. Right: the arm "
    "alone in the frame of its base, by our own clouds with the paper's scores. There Franka, the one robot of seven joints, "
    "is the farthest, so this goes with the joints' column; five robots cannot tell the two apart."
)
CHANGE_TEXT = (
    "What the text says, and what the tables give for it: from the printed scores, and in brackets from all scores that print "
    "the same. Shares of a gap are of the way from zero-shot to the seen robots."
)
ROBOT_TEXT = "Means of the rows of the printed matrices, the printed means below them; features as printed."

Table = tuple[str, str, page.ComparedTable]
"""Heading, text and table."""


def build(paper: Paper, footer: str) -> tuple[str, tuple[str, dict[str, bytes]], pd.DataFrame]:
    """The page, Markdown with its figures, and every recomputed figure as a tidy frame."""
    cells, means, changes = rebuild(paper), mean_distance_cells(paper), recompute_changes(paper)
    results = {(metric, axis): paper.correlation(metric, axis) for metric in paper.metrics for axis in AXES}
    frames = frame_distances()
    arm_alone = frame_results(paper, frames["arm_base"])
    sentences = finding(cells, results, changes, arm_alone)
    tables: list[Table] = [
        ("The correlation table", CORRELATION_TEXT, _correlation_table(paper, cells)),
        ("How certain it is", CERTAINTY_TEXT, _certainty_table(paper, cells, results)),
        ("Which frame workspaces are in", FRAME_TEXT, _frame_table(paper, frames)),
        ("Percentages of the text", CHANGE_TEXT, _change_table(changes)),
        ("The robots", ROBOT_TEXT, _robot_table(paper, means)),
        (
            "Scores that went in",
            "One model a column, trained on the other four robots. As printed; arrows point to better.",
            _score_table(paper),
        ),
    ]
    names = {axis: f"{title}{' [m]' if axis == 'kinematic' else ''}" for axis, title in AXIS_TITLES.items()}
    axes = {names[axis]: paper.axis(axis) for axis in AXES}
    axes["Kinematic distance, arm alone [m] (ours)"] = frames["arm_base"].mean(axis=0)
    robots = [ROBOT_TITLES[robot] for robot in paper.robots]
    figure = pictures.distance_scatter(axes, paper.scores(PRIMARY), METRIC_TITLES[PRIMARY], robots)
    image = pictures.figure_png(figure)
    caption = (
        "Thick: the line through all five robots. Thin: the lines without one robot, which show how far one point carries."
    )
    sections = [page.section(heading, page.paragraph(text), page.compared_table(table)) for heading, text, table in tables]
    sections.insert(1, page.section("In a picture", page.picture(pictures.data_uri(image), caption, f"{PRIMARY} by distance")))
    sections.append(page.section("Where the figures are from", page.definitions({"paper": paper.title, **paper.tables})))
    markdown = _markdown(sentences, tables, caption), {FIGURE: image}
    return page.page(TITLE, sentences, sections, footer), markdown, _frame([*cells, *means], changes, arm_alone)


@cache
def frame_distances() -> dict[Frame, np.ndarray]:
    """Mean kinematic distances of our five robots to the other four by frame, a row for each seed [s 5], metres."""
    robots = {name: ROBOTS[name] for name in ROBOT_NAMES}
    frames: tuple[Frame, ...] = ("root", "arm_base")
    return {frame: mean_distances(measure(robots, SEEDS, frame).kinematic) for frame in frames}


def frame_results(paper: Paper, distances: np.ndarray) -> dict[str, Correlation]:
    """Correlation of the paper's scores with mean distances [s 5], by metric."""
    axis = distances.mean(axis=0).tolist()
    return {
        name: loeo_correlation(axis, paper.scores(name).tolist(), metric.higher_is_better)
        for name, metric in paper.metrics.items()
    }


def finding(
    cells: Sequence[Cell],
    results: Mapping[tuple[str, str], Correlation],
    changes: Sequence[RecomputedChange],
    arm_alone: Mapping[str, Correlation],
) -> list[str]:
    """What came out, in sentences."""
    outside = [f"{_name(cell.metric, cell.axis)} {cell.quantity}" for cell in cells if not cell.agrees]
    furthest = max(abs(cell.ours - cell.published) for cell in cells)
    word = f"{len(cells) - len(outside)} of {len(cells)} printed figures come out within what rounding of the inputs allows"
    sentences = [f"{word} (largest difference {furthest:.3f}){': not ' + ', '.join(outside) if outside else ''}."]
    sentences += [_sentence(axis, results[PRIMARY, axis]) for axis in AXES]
    stable = {axis: [result.stable for (_, of), result in results.items() if of == axis] for axis in AXES}
    counts = " and ".join(f"{sum(stable[axis])} of {len(stable[axis])} metrics against {axis} distance" for axis in AXES)
    sentences.append(f"The sign is stable for {counts}.")
    key = min(results, key=lambda key: results[key].p_value)
    wrong = [f"{change.change.percent:g} % ({change.change.source})" for change in changes if not change.agrees]
    sentences.append(
        f"{len(changes) - len(wrong)} of {len(changes)} percentages of the text follow from the tables"
        f"{': not ' + ', '.join(wrong) if wrong else ''}."
    )
    turned = [METRIC_TITLES[name] for name, result in arm_alone.items() if result.r * results[name, "kinematic"].r < 0]
    words = "survives" if arm_alone[PRIMARY].stable else "does not survive"
    sentences.append(
        f"By workspaces of the arm alone, in its base frame (ours), {METRIC_TITLES[PRIMARY]} has "
        f"r = {signed(arm_alone[PRIMARY].r)} and its sign {words} leaving out any one robot "
        f"({signed(arm_alone[PRIMARY].low)} to {signed(arm_alone[PRIMARY].high)}); against the kinematic distance as printed, "
        f"r turns its sign for {', '.join(turned) or 'no metric'}."
    )
    sentences.append(
        f"The smallest p of all {len(results)} is {results[key].p_value:.3f} ({_name(*key)}), before any correction."
    )
    return sentences


def _sentence(axis: str, result: Correlation) -> str:
    word = "survives" if result.stable else "does not survive"
    return (
        f"{METRIC_TITLES[PRIMARY]} against {axis} distance: r = {signed(result.r)}, p = {result.p_value:.3f}; its sign "
        f"{word} leaving out any one robot ({signed(result.low)} to {signed(result.high)})."
    )


def _name(metric: str, axis: str) -> str:
    return f"{METRIC_TITLES[metric]} by {axis}"


def signed(value: float) -> str:
    return f"{value:+.3f}".replace("-", "−")


def _correlation_table(paper: Paper, cells: Sequence[Cell]) -> page.ComparedTable:
    """The paper's layout: r and leave-one-out range for each axis, then r with the number of joints."""
    found = {(cell.metric, cell.axis, cell.quantity): cell for cell in cells}

    def row(metric: str) -> list[Compared]:
        pairs = [(axis, quantities) for axis in AXES for quantities in (("r",), ("low", "high"))]
        return [_compared([found[metric, axis, q] for q in names]) for axis, names in [*pairs, ("dof", ("r",))]]

    groups = [*((AXIS_TITLES[axis], 2) for axis in AXES), ("Joints", 1)]
    heads = ["metric", *["Pearson r", "leave one out"] * len(AXES), "DoF r"]
    return page.ComparedTable(groups, heads, {METRIC_TITLES[metric]: row(metric) for metric in paper.metrics})


def _compared(cells: Sequence[Cell]) -> Compared:
    """One figure, or the two ends of a range."""
    ours = " to ".join(signed(cell.ours) for cell in cells)
    published = " to ".join(signed(cell.published) for cell in cells)
    return Compared(ours, published, all(cell.agrees for cell in cells))


def _certainty_table(paper: Paper, cells: Sequence[Cell], results: Mapping[tuple[str, str], Correlation]) -> page.ComparedTable:
    printed = {(cell.metric, cell.axis): cell for cell in cells if cell.quantity == "p_value"}

    def row(metric: str) -> list[Compared]:
        columns = []
        for axis in AXES:
            result, p = results[metric, axis], printed.get((metric, axis))
            columns += [
                Compared(f"{result.p_value:.3f}", f"{p.published:.3f}" if p else "", p.agrees if p else None),
                Compared(signed(result.spearman)),
                Compared(f"{signed(result.bootstrap_low)} to {signed(result.bootstrap_high)}"),
                Compared("stable" if result.stable else "unstable"),
            ]
        return columns

    groups = [(AXIS_TITLES[axis], 4) for axis in AXES]
    heads = ["metric", *["p", "Spearman ρ", "bootstrap of r", "sign"] * len(AXES)]
    return page.ComparedTable(groups, heads, {METRIC_TITLES[metric]: row(metric) for metric in paper.metrics})


def _frame_table(paper: Paper, frames: Mapping[Frame, np.ndarray]) -> page.ComparedTable:
    """The paper's kinematic correlation beside what our own clouds give for it, in its frame and in the arm's."""
    by_frame = {frame: frame_results(paper, distances) for frame, distances in frames.items()}

    def row(metric: str) -> list[Compared]:
        printed = paper.metrics[metric].kinematic
        cells = [Compared(signed(printed.r)), Compared(f"{signed(printed.low)} to {signed(printed.high)}")]
        for results in by_frame.values():
            result = results[metric]
            cells += [Compared(signed(result.r)), Compared(f"{signed(result.low)} to {signed(result.high)}")]
        result = by_frame["arm_base"][metric]
        return [*cells, Compared(f"{result.p_value:.3f}"), Compared("stable" if result.stable else "unstable")]

    groups = [("As printed", 2), ("Root frame, all links (ours)", 2), ("Arm alone, its base frame (ours)", 4)]
    heads = ["metric", *["Pearson r", "leave one out"] * 3, "p", "sign"]
    rows = {METRIC_TITLES[metric]: row(metric) for metric in paper.metrics}
    rows["Mean distance [m]"] = [Compared("")] * 8
    for robot, name in enumerate(paper.robots):
        cells = [f"{paper.robots[name].kinematic:.3f}", ""]
        for distances in frames.values():
            cells += [f"{distances[:, robot].mean():.3f}", f"± {distances[:, robot].std(ddof=1):.3f} a draw"]
        rows[ROBOT_TITLES[name]] = [Compared(text) for text in (*cells, "", "")]
    return page.ComparedTable(groups, heads, rows)


def _change_table(changes: Sequence[RecomputedChange]) -> page.ComparedTable:
    rows = {}
    for found in changes:
        word = {"rounded": "", "about": "about ", "less than": "less than "}[found.change.word]
        ours = f"{percent(found.ours)} ({percent(found.least)} to {percent(found.most)})"
        rows[_compared_places(found.change)] = [Compared(ours, f"{word}{percent(found.change.percent, 0)}", found.agrees)]
    return page.ComparedTable([], ["what is compared", "change"], rows)


def _compared_places(change: PublishedChange) -> str:
    """Such as 'LPIPS, Piper: joints to optical flow'."""
    (_, before, start), (_, after, end) = (place.split("/") for place in (change.before, change.after))
    subject, pair = (end, (before, after)) if start == end else (before, (start, end))
    gap = ", share of the gap closed" if change.toward else ""
    first, second = map(_place_title, pair)
    return f"{METRIC_TITLES[change.metric]}, {_place_title(subject)}: {first} to {second}{gap}"


def _place_title(name: str) -> str:
    robot, _, shots = name.rpartition("-")
    if robot:
        return f"{ROBOT_TITLES[robot]} M = {shots}"
    return ROBOT_TITLES.get(name, {"none": "without"}.get(name, name.replace("_", " ")))


def percent(value: float, digits: int = 1) -> str:
    return f"{value:+.{digits}f} %".replace("-", "−")


def _robot_table(paper: Paper, means: Sequence[Cell]) -> page.ComparedTable:
    found = {(cell.metric, cell.axis): cell for cell in means}
    rows = {
        ROBOT_TITLES[name]: [
            *(Compared(f"{(c := found[name, axis]).ours:.3f}", f"{c.published:.3f}", c.agrees) for axis in AXES),
            *(Compared(text) for text in (str(robot.dof), str(robot.links), f"{robot.reach:.3f}", f"{robot.volume:.3f}")),
        ]
        for name, robot in paper.robots.items()
    }
    heads = ["robot", "appearance", "kinematic [m]", "joints", "links", "reach [m]", "hull [m³]"]
    return page.ComparedTable([("Mean distance to the other four", 2), ("Features", 4)], heads, rows)


def _score_table(paper: Paper) -> page.ComparedTable:
    rows = {
        f"{METRIC_TITLES[name]} {'↑' if metric.higher_is_better else '↓'}": [
            Compared(f"{score:.3f}") for score in paper.scores(name)
        ]
        for name, metric in paper.metrics.items()
    }
    return page.ComparedTable([("Held out", len(paper.robots))], ["metric", *map(ROBOT_TITLES.__getitem__, paper.robots)], rows)


def _markdown(sentences: Sequence[str], tables: Sequence[Table], caption: str) -> str:
    lines = [f"# {TITLE}", "", *(f"- {sentence}" for sentence in sentences)]
    for heading, text, table in tables:
        lines += ["", f"## {heading}", "", text, "", page.compared_markdown(table)]
    return "\n".join([*lines, "", "## In a picture", "", caption, "", f"![LPIPS by distance](figures/{FIGURE})", ""])


def _frame(cells: Sequence[Cell], changes: Sequence[RecomputedChange], arm_alone: Mapping[str, Correlation]) -> pd.DataFrame:
    """Columns: row axis quantity published ours least most agrees; blank where the paper prints nothing."""
    names = ("published", "ours", "least", "most", "agrees")
    rows = [
        {"row": cell.metric, "axis": cell.axis, "quantity": cell.quantity} | {name: getattr(cell, name) for name in names}
        for cell in cells
    ]
    rows += [
        {"row": _compared_places(found.change), "axis": found.change.source, "quantity": "percent"}
        | {"published": found.change.percent, "ours": found.ours, "least": found.least, "most": found.most}
        | {"agrees": found.agrees}
        for found in changes
    ]
    rows += [
        {"row": metric, "axis": "arm_base", "quantity": quantity, "ours": getattr(result, quantity)}
        for metric, result in arm_alone.items()
        for quantity in ("r", "low", "high", "p_value")
    ]
    return pd.DataFrame(rows)
