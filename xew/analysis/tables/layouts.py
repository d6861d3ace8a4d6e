"""A study's tables in the paper's layouts, with the paper's values; held-out robots are never averaged.

To add a table: a function of a `Builder`, and its name in `build_tables`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from xew.analysis.scores import TRUTH
from xew.analysis.statistics.grades import REFERENCE, SEEN, StudyGrades, find_variant, pooled
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.labels import (
    ACTIONS,
    GROUP_TITLES,
    HELD_OUT_TITLES,
    LADDER,
    REMEDIES,
    ROBOT_TITLES,
    SHORT_ROBOTS,
    SYSTEM_ACTIONS,
    SYSTEMS,
    TRUE,
)
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection, metric_columns, metric_title
from xew.protocol import FORGETTING_ROBOT, HELD_OUT_ROBOTS, PARTS, ROBOT_NAMES, SEEN_ROBOTS, SHOTS
from xew.statistics import strict_metrics


def build_tables(builder: Builder) -> list[Table]:
    """Every table of the paper that rests on scores, in its order; parts of which nothing was run are left out."""
    made = {
        "fixed": (gap_table,),
        "actions": (action_table, action_full),
        "ladder": (ladder_table, ladder_full),
        "few_shot": (few_shot_table, recovery_full),
        "forgetting": (forgetting_full,),
        "baselines": (baseline_table,),
        "loeo": (loeo_full,),
    }
    return [make(builder) for part, makers in made.items() if builder.has_results(part) for make in makers]


def _keep_measured(builder: Builder, names: Sequence[str]) -> tuple[str, ...]:
    """These metrics of the paper, as far as graded, each behind that of the suite strict which decides in its place."""
    strict = strict_metrics(builder.ours.metrics)
    both = (kept for name in names for kept in (strict.get(name, ""), name))
    return tuple(name for name in both if name in builder.ours.metrics)


def gap_table(builder: Builder) -> Table:
    """The reference model, flow only, on seen and unseen robots, with both baselines (ours)."""
    keys = {"fixed": "flow only"}
    return _full_table(builder, "gap", "The gap: robots seen and unseen", "fixed", "model", keys, "")


def action_table(builder: Builder) -> Table:
    """The paper's main table of action representations: both held-out robots under each representation."""
    metrics = _keep_measured(builder, ("psnr", "lpips", "mask_iou", "boundary_f1", "pck", "keypoint_error", "trajectory_error"))
    keys = [(key, robot) for key in ACTIONS for robot in HELD_OUT_ROBOTS]
    rows = [builder.row("actions", key, robot, metrics, (ACTIONS[key], SHORT_ROBOTS[robot]), "joints") for key, robot in keys]
    step = len(HELD_OUT_ROBOTS)
    for first in range(step):
        rows[first::step] = _mark_best(rows[first::step], builder, metrics)
    places = ((key, robot, f"{ACTIONS[key]}, {SHORT_ROBOTS[robot]}") for key, robot in keys)
    floors = (builder.truth((TRUE, SHORT_ROBOTS[r]), [((r,), metric) for metric in metrics]) for r in HELD_OUT_ROBOTS)
    section = TableSection("", (*rows, *(row for found in floors for row in found)), builder.note("actions", places))
    return Table(
        "actions",
        "Action representation, robots never seen",
        "Bold is best for each robot. Marks: compared with joint pose.",
        ("action representation", "target"),
        metric_columns(builder.ours.metrics, metrics),
        (section,),
    )


def action_full(builder: Builder) -> Table:
    """The appendix's complete table of action representations."""
    return _full_table(
        builder, "actions_full", "Action representation, all metrics", "actions", "representation", ACTIONS, "joints"
    )


def ladder_table(builder: Builder) -> Table:
    """The paper's main table of the conditioning ladder."""
    metrics = _keep_measured(builder, ("mask_iou", "region_lpips", "lpips"))
    return Table(
        "ladder",
        "Conditioning on the robot's appearance",
        "All rows use optical flow. Marks: compared with flow only.",
        ("conditioning",),
        tuple(Column(metric_title(builder.ours.metrics[name])) for name in metrics),
        tuple(
            _build_section(builder, ROBOT_TITLES[robot], "ladder", LADDER, robot, metrics, "none") for robot in HELD_OUT_ROBOTS
        ),
    )


def ladder_full(builder: Builder) -> Table:
    """The appendix's complete table of the conditioning ladder."""
    return _full_table(builder, "ladder_full", "Conditioning, all metrics", "ladder", "conditioning", LADDER, "none")


def few_shot_table(builder: Builder) -> Table:
    """The paper's main few-shot table: metrics down, demonstrations across."""
    metrics = _keep_measured(builder, ("mask_iou", "region_lpips", "lpips"))
    graded = any(builder.variant_cell(TRUTH, (robot,), metric).episodes for robot in HELD_OUT_ROBOTS for metric in metrics)

    def row(robot: str, metric: str) -> TableRow:
        cells = [builder.cell("few_shot", f"{robot}-{shots}", robot, metric, f"{robot}-0") for shots in (0, *SHOTS)]
        cells.append(builder.cell("few_shot", "robot_render", robot, metric))
        cells += [builder.variant_cell(TRUTH, (robot,), metric)] * graded
        return TableRow((SHORT_ROBOTS[robot], metric_title(builder.ours.metrics[metric])), tuple(cells))

    return Table(
        "few_shot",
        "Few-shot adaptation",
        "M demonstrations of each task; M = 0 is the model with nine views, before adaptation. Marks: compared with M = 0.",
        ("target", "metric"),
        (
            *(Column(f"M = {shots}", "Demonstrations a task") for shots in (0, *SHOTS)),
            Column("per-frame render"),
            *([Column(TRUE)] * graded),
        ),
        tuple(
            TableSection("", tuple(row(robot, metric) for metric in metrics), _few_shot_note(builder, robot))
            for robot in HELD_OUT_ROBOTS
        ),
    )


def recovery_full(builder: Builder) -> Table:
    """The appendix's complete table of few-shot recovery, and with it the remedies against forgetting."""
    metrics = builder.reported
    seen = builder.row("few_shot", REFERENCE, SEEN, metrics, (REFERENCE,))
    sections = [TableSection("Seen pool, before adaptation", (seen,), builder.note("few_shot", [(REFERENCE, SEEN, REFERENCE)]))]
    for robot in HELD_OUT_ROBOTS:
        keys = {f"{robot}-{shots}": f"M = {shots}" for shots in (0, *SHOTS)} | _list_remedies(builder, robot, "")
        sections.append(_build_section(builder, HELD_OUT_TITLES[robot], "few_shot", keys, robot, metrics, f"{robot}-0"))
    caption = "Marks: compared with M = 0."
    columns = metric_columns(builder.ours.metrics, metrics)
    return Table(
        "few_shot_full", "Few-shot recovery, all metrics", caption, ("demonstrations a task",), columns, tuple(sections)
    )


def _list_remedies(builder: Builder, robot: str, before: str) -> dict[str, str]:
    """Rows of the adaptations to a robot with a remedy, and their labels; none where the study has no such part."""
    if not builder.has_results("remedies"):
        return {}
    return {
        f"{robot}-{shots}-{remedy}": f"{before}M = {shots}, {title} (ours)"
        for remedy, title in REMEDIES.items()
        for shots in SHOTS
    }


def forgetting_full(builder: Builder) -> Table:
    """The appendix's complete table of forgetting, and with it the remedies, which the paper does not have."""
    metrics = builder.reported
    keys = {"none": "none (before)"}
    keys |= {f"{robot}-{shots}": f"{SHORT_ROBOTS[robot]}, M = {shots}" for robot in HELD_OUT_ROBOTS for shots in SHOTS}
    for robot in HELD_OUT_ROBOTS:
        keys |= _list_remedies(builder, robot, f"{SHORT_ROBOTS[robot]}, ")
    section = _build_section(builder, "", "forgetting", keys, FORGETTING_ROBOT, metrics, "none")
    plain = tuple(replace(row, cells=tuple(replace(cell, best=False) for cell in row.cells)) for row in section.rows)
    return Table(
        "forgetting_full",
        f"Forgetting on {ROBOT_TITLES[FORGETTING_ROBOT]}, all metrics",
        f"The same {ROBOT_TITLES[FORGETTING_ROBOT]} episodes after each adaptation. Marks: compared with before.",
        ("adapted to",),
        metric_columns(builder.ours.metrics, metrics),
        (replace(section, rows=plain),),
    )


def baseline_table(builder: Builder) -> Table:
    """The paper's table of world models: seen robots, Franka and Piper side by side for one metric of each dimension."""
    metrics = _keep_measured(builder, ("lpips", "mask_iou", "pck", "trajectory_error"))
    groups = (SEEN, *HELD_OUT_ROBOTS)
    systems = dict(zip(SYSTEMS, SYSTEM_ACTIONS, strict=True))

    def row(key: str, action: str, title: str) -> TableRow:
        cells = (builder.cell("baselines", key, robots, metric) for metric in metrics for robots in groups)
        return TableRow((title, action), tuple(cells))

    rows = [row(key, action, SYSTEMS[key]) for key, action in systems.items()]
    if builder.has_results("more_systems") and builder.paper:
        rows += [row(variant.system, "tool poses", f"{variant.system.upper()} (ours)") for variant in PARTS["more_systems"]]
    better_up = [builder.ours.metrics[metric].higher_is_better for metric in metrics for _ in groups]
    columns = tuple(
        Column(SHORT_ROBOTS.get(robots, "seen"), metric_title(builder.ours.metrics[metric]))
        for metric in metrics
        for robots in groups
    )
    truths = [(SEEN_ROBOTS if robots == SEEN else (robots,), metric) for metric in metrics for robots in groups]
    floor = builder.truth((TRUE, ""), truths)
    notes = {robots: builder.note("baselines", ((key, robots, SYSTEMS[key]) for key in systems)) for robots in groups}
    note = " ".join(f"{SHORT_ROBOTS.get(robots, 'Seen robots')}: {text}" for robots, text in notes.items() if text)
    section = TableSection("", (*_mark_best_cells(rows, better_up), *floor), note)
    return Table(
        "baselines",
        "Seen and unseen robots under other world models",
        "Bold is best.",
        ("model", "actions"),
        columns,
        (section,),
    )


def loeo_full(builder: Builder) -> Table:
    """The appendix's absolute scores of the five folds; each row is another model."""
    metrics = builder.reported
    rows = [builder.row("loeo", f"loeo_{robot}", robot, metrics, (ROBOT_TITLES[robot],)) for robot in ROBOT_NAMES]
    floors = [row for r in ROBOT_NAMES for row in builder.truth((ROBOT_TITLES[r],), [((r,), metric) for metric in metrics])]
    note = builder.note("loeo", ((f"loeo_{robot}", robot, ROBOT_TITLES[robot]) for robot in ROBOT_NAMES))
    return Table(
        "loeo_full",
        "Each robot held out in turn",
        "Each row is another model, trained on the other four robots; it does not compare with the fixed split.",
        ("held out",),
        metric_columns(builder.ours.metrics, metrics),
        (TableSection("", tuple(rows), note), *([TableSection("True video, graded", tuple(floors))] if floors else [])),
    )


def count_table(builder: Builder) -> Table:
    """The paper's numbers of scored episodes, and how many there are here."""
    printed = {"actions": (1500, 500, 500), "ladder": (1500, 500, 500), "loeo": (2000, 500, 500), "few_shot": (500, 500, 500)}
    titles = {"actions": "Action representation", "ladder": "Conditioning", "loeo": "One LOEO fold", "few_shot": "Few-shot"}
    rows = [
        TableRow((titles[part],), tuple(_count_cell(builder, part, i, number) for i, number in enumerate(numbers)))
        for part, numbers in printed.items()
    ]
    return Table(
        "counts",
        "Numbers of scored episodes",
        f"Episodes of one row of each table; few-shot: {ROBOT_TITLES[FORGETTING_ROBOT]} for forgetting, and the target.",
        ("experiment",),
        (Column("seen / reference"), *(Column(SHORT_ROBOTS[robot]) for robot in HELD_OUT_ROBOTS)),
        (TableSection("", tuple(rows)),),
    )


def _count_cell(builder: Builder, part: str, place: int, printed: int) -> TableCell:
    """Smallest and largest count over the variants of a part, in one of the columns seen, Franka, Piper."""
    if not isinstance(builder.ours, StudyGrades):
        return TableCell(published=str(printed), printed=printed)
    counts = set()
    for variant in PARTS[part]:
        seen = (FORGETTING_ROBOT,) if part == "few_shot" else variant.seen_robots
        robots = (seen, *((robot,) for robot in HELD_OUT_ROBOTS))[place]
        held_out = place == 0 or robots[0] in variant.held_out_robots
        if held_out and (mean := builder.ours.variant_mean(variant.name, robots, builder.any_metric)):
            counts.add(mean.count)
    text = " to ".join(map(str, dict.fromkeys((min(counts), max(counts))))) if counts else "–"
    return TableCell(
        text, published=str(printed), printed=printed, value=max(counts, default=np.nan), episodes=max(counts, default=0)
    )


def _full_table(builder: Builder, name: str, title: str, part: str, stub: str, keys: dict[str, str], base: str) -> Table:
    metrics = builder.reported
    sections = tuple(_build_section(builder, text, part, keys, robots, metrics, base) for robots, text in GROUP_TITLES.items())
    caption = f"Marks: compared with {keys[base].lower()}." if base else ""
    return Table(name, title, caption, (stub,), metric_columns(builder.ours.metrics, metrics), sections)


def _build_section(
    builder: Builder, title: str, part: str, keys: dict[str, str], robots: str, metrics: Sequence[str], base: str = ""
) -> TableSection:
    rows = [builder.row(part, key, robots, metrics, (label,), base) for key, label in keys.items()]
    below = builder.baselines(pooled(find_variant(part, next(iter(keys))), robots), metrics)
    note = builder.note(part, ((key, robots, label) for key, label in keys.items()))
    return TableSection(title, (*_mark_best(rows, builder, metrics), *below), note)


def _few_shot_note(builder: Builder, robot: str) -> str:
    keys = {f"{robot}-{shots}": f"M = {shots}" for shots in (0, *SHOTS)} | {"robot_render": "per-frame render"}
    note = builder.note("few_shot", ((key, robot, label) for key, label in keys.items()))
    return note and f"{SHORT_ROBOTS[robot]}. {note}"


def _mark_best(rows: Sequence[TableRow], builder: Builder, metrics: Sequence[str]) -> list[TableRow]:
    return _mark_best_cells(rows, [builder.ours.metrics[name].higher_is_better for name in metrics])


def _mark_best_cells(rows: Sequence[TableRow], higher_is_better: Sequence[bool]) -> list[TableRow]:
    """The same rows with the best cell of each column marked, where at least two rows have one."""
    values = np.array([[cell.value for cell in row.cells] for row in rows])
    signed = np.where(higher_is_better, values, -values)
    enough = (~np.isnan(values)).sum(axis=0) > 1
    top = np.nanmax(np.where(np.isnan(signed), -np.inf, signed), axis=0)
    return [
        replace(row, cells=tuple(replace(c, best=bool(enough[j] and signed[i, j] == top[j])) for j, c in enumerate(row.cells)))
        for i, row in enumerate(rows)
    ]
