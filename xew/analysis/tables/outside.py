"""The table of what was graded outside the protocol: variants and robots that no table of the paper has a row for."""

import pandas as pd

from xew.analysis.scores import VARIANT
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.labels import robot_title
from xew.analysis.tables.table import Table, TableRow, TableSection, metric_columns
from xew.protocol import VARIANTS


def outside_tables(builder: Builder, rows: pd.DataFrame) -> list[Table]:
    """One table of the scores outside the protocol, a section for each robot; none if there are no such scores."""
    pairs = rows[[VARIANT, "robot"]].drop_duplicates().itertuples(index=False, name=None)
    by_robot: dict[str, list[str]] = {}
    for variant, robot in pairs:
        if variant and (variant not in VARIANTS or robot not in VARIANTS[variant].graded_robots):
            by_robot.setdefault(robot, []).append(variant)
    metrics = builder.reported
    sections = tuple(
        TableSection(
            robot_title(robot),
            (
                *(
                    TableRow((variant,), tuple(builder.variant_cell(variant, (robot,), metric) for metric in metrics))
                    for variant in variants
                ),
                *builder.baselines((robot,), metrics),
            ),
        )
        for robot, variants in by_robot.items()
    )
    table = Table(
        "outside",
        "Outside the protocol",
        "Means of scores outside the paper's protocol.",
        ("variant",),
        metric_columns(builder.ours.metrics, metrics),
        sections,
    )
    return [table] if sections and metrics else []
