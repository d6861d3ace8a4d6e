"""Scores of robots that no model has seen, by the number of bodies that it was trained on."""

import math

import pandas as pd

from xew.analysis.statistics.grades import BODIES, find_variant, pooled
from xew.analysis.tables.builder import Builder, interval_ends
from xew.analysis.tables.labels import HELD_OUT_TITLES
from xew.analysis.tables.table import Table, TableSection, metric_columns
from xew.protocol import BASELINES, BODY_SCALES, PASTED_RENDER

PART = "scaling"
BASE = "scaling_seen"
"""Row that all others are compared with: the three robots alone."""
WITH_ROBOTS, ALONE = "three robots and bodies", "bodies alone"
PASTED = BASELINES[PASTED_RENDER]
"""Name of the no-learning baseline."""
ROWS = {
    BASE: (WITH_ROBOTS, 0),
    **{f"scaling_seen_bodies_{count}": (WITH_ROBOTS, count) for count in BODY_SCALES},
    **{f"scaling_bodies_{count}": (ALONE, count) for count in BODY_SCALES},
}
"""Rows of the part, with what a model was trained on and the number of bodies (K)."""
GROUPS = {**HELD_OUT_TITLES, BODIES: "Bodies that no model has seen"}


def scaling_table(builder: Builder) -> Table:
    """All metrics of each held-out robot and of the unseen bodies, by what the model was trained on."""
    metrics = builder.reported

    def section(robots: str, title: str) -> TableSection:
        rows = [builder.row(PART, key, robots, metrics, (f"{kind}, K = {count}",), BASE) for key, (kind, count) in ROWS.items()]
        below = builder.baselines(pooled(find_variant(PART, BASE), robots), metrics)
        note = builder.note(PART, ((key, robots, f"{kind}, K = {count}") for key, (kind, count) in ROWS.items()))
        return TableSection(title, (*rows, *below), note)

    return Table(
        "scaling",
        "Bodies in training, robots never seen",
        "K is the number of procedural bodies that a model was trained on; all models have the same number of steps. Marks: "
        "compared with the three robots alone.",
        ("trained on",),
        metric_columns(builder.ours.metrics, metrics),
        tuple(section(robots, title) for robots, title in GROUPS.items()),
    )


def scaling_frame(builder: Builder, metric: str) -> pd.DataFrame:
    """Means of a metric over the episodes that all models have; rows that were not graded on them are left out.

    Columns: robots (key of GROUPS), trained_on (WITH_ROBOTS, ALONE or PASTED), bodies (K; NaN of PASTED), value, low, high.
    """
    rows: list[tuple[str, str, float, float, float, float]] = []
    for robots in GROUPS:
        most = 0
        for key, (kind, count) in ROWS.items():
            mean = builder.ours.mean(PART, key, robots, metric, shared=True)
            if mean is not None:
                rows.append((robots, kind, count, mean.value, *interval_ends(mean, builder.ours.level)))
                most = max(most, mean.count)
        pasted = builder.variant_cell(PASTED_RENDER, pooled(find_variant(PART, BASE), robots), metric)
        if pasted.episodes >= most:
            rows.append((robots, PASTED, math.nan, pasted.value, pasted.low, pasted.high))
    return pd.DataFrame(rows, columns=["robots", "trained_on", "bodies", "value", "low", "high"])
