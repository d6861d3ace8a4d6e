"""Stage 11 of 11: the paper's distance table rebuilt, its printed figures beside. `report --paper` writes what is made here."""

from collections.abc import Mapping, Sequence

import pandas as pd

from xew.analysis import page, pictures
from xew.analysis.correlation import Correlation
from xew.analysis.page import Compared
from xew.analysis.paper import AXES, Cell, Paper, mean_distance_cells, rebuild
from xew.analysis.summary import METRIC_TITLES, ROBOT_TITLES

TITLE = "The paper's distance table, rebuilt from its own scores"
AXIS_TITLES = {"appearance": "Appearance distance", "kinematic": "Kinematic distance"}
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
ROBOT_TEXT = "Means of the rows of the printed matrices, the printed means below them; features as printed."

Table = tuple[str, str, page.ComparedTable]
"""Heading, text and table."""


def build(paper: Paper, footer: str) -> tuple[str, tuple[str, dict[str, bytes]], pd.DataFrame]:
    """The page, Markdown with its figures, and every recomputed figure as a tidy frame."""
    cells, means = rebuild(paper), mean_distance_cells(paper)
    results = {(metric, axis): paper.correlation(metric, axis) for metric in paper.metrics for axis in AXES}
    sentences = finding(cells, results)
    tables: list[Table] = [
        ("The correlation table", CORRELATION_TEXT, _correlation_table(paper, cells)),
        ("How certain it is", CERTAINTY_TEXT, _certainty_table(paper, cells, results)),
        ("The robots", ROBOT_TEXT, _robot_table(paper, means)),
        (
            "Scores that went in",
            "One model a column, trained on the other four robots. As printed; arrows point to better.",
            _score_table(paper),
        ),
    ]
    names = {axis: f"{title}{' [m]' if axis == 'kinematic' else ''}" for axis, title in AXIS_TITLES.items()}
    axes = {names[axis]: paper.axis(axis) for axis in AXES}
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
    return page.page(TITLE, sentences, sections, footer), markdown, _frame([*cells, *means])


def finding(cells: Sequence[Cell], results: Mapping[tuple[str, str], Correlation]) -> list[str]:
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


def _frame(cells: Sequence[Cell]) -> pd.DataFrame:
    """Columns: row axis quantity published ours least most agrees."""
    columns = {"metric": "row", "axis": "axis", "quantity": "quantity", "published": "published", "ours": "ours"}
    columns |= {"least": "least", "most": "most", "agrees": "agrees"}
    return pd.DataFrame({title: getattr(cell, name) for name, title in columns.items()} for cell in cells)
