"""Stage 11 of 11: a study's tables in the paper's layouts. What is built here is plain text; `formats` and `page` write it.

Ours stands large, the paper's value beside it where it prints one. A row that was not run says so, a block that has fewer
episodes than the protocol asks for says how many, and robots that were held out are never averaged.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from xew.analysis.scores import COPY, TRUTH, MetricInfo
from xew.analysis.statistics.grades import (
    MIN_SCENES,
    REFERENCE,
    SEEN,
    Grades,
    Mean,
    PaperGrades,
    StudyGrades,
    better,
    find_variant,
    interval,
    pooled,
)
from xew.analysis.statistics.summary import METRIC_TITLES, ROBOT_TITLES
from xew.model.conditions import ACTIONS as REPRESENTATIONS
from xew.model.conditions import CONDITIONS
from xew.protocol import (
    FORGETTING_ROBOT,
    HELD_OUT_ROBOTS,
    PAPER_PARTS,
    PARTS,
    ROBOT_NAMES,
    SEEN_ROBOTS,
    SHOTS,
    expected_counts,
    reference,
)
from xew.sim_warp.robots import ROBOTS

PAPER_METRICS = (
    "psnr", "ssim", "lpips", "mask_iou", "boundary_f1", "region_lpips", "pck", "keypoint_error", "ndtw", "trajectory_error",
)  # fmt: skip
"""The paper's suite in its order."""
DIMENSION_TITLES = {
    "visual": "Visual quality",
    "morphology": "Robot morphology",
    "kinematics": "Robot kinematics",
    "objects": "Object dynamics",
}
SHORT_ROBOTS = {key: robot.label for key, robot in ROBOTS.items()}
SEEN_TITLE = "Seen pool: Aloha-AgileX, ARX-X5 and UR5"

ACTIONS = {variant.action: REPRESENTATIONS[variant.action].title for variant in PARTS["actions"]}
"""Title of each action representation by its key."""
LADDER = {variant.embodiment: CONDITIONS[variant.embodiment].label for variant in PARTS["ladder"]}
"""Label of each condition of the ladder by its key, from nothing to a render of every frame."""
SYSTEMS = {
    variant.system: "reference model" if variant.system == REFERENCE else REPRESENTATIONS[variant.action].title
    for variant in PARTS["baselines"]
}
"""Title of each world model by its key."""
SYSTEM_ACTIONS = tuple(REPRESENTATIONS[variant.action].label for variant in PARTS["baselines"])
"""What each of SYSTEMS is told of actions."""
STILL, TRUE = "frozen first frame", "true video, graded"
REMEDIES = {"replay": "with replay", "lora": "with LoRA"}

MARKS = (
    "▲ better, ▼ worse, ≈ not resolved: the interval of the paired difference holds 0, the difference is inside the noise "
    f"floor, or there are fewer than {MIN_SCENES} scenes"
)
"""What stands behind values; captions name the row that they are compared with."""


@dataclass(frozen=True)
class Cell:
    """One value of a table, as text and as numbers."""

    text: str = "–"
    """'–' where nothing was measured."""
    interval: str = ""
    published: str = ""
    """The paper's value as it is printed."""
    verdict: str = ""
    """Against the row that the caption names: better, worse or unresolved; '' where there is none."""
    agrees: bool | None = None
    """Does a recomputed value print like the paper's; None where this is not asked."""
    best: bool = False
    """Of the rows of a block that are models."""
    value: float = np.nan
    low: float = np.nan
    high: float = np.nan
    printed: float = np.nan
    episodes: int = 0


@dataclass(frozen=True)
class Column:
    title: str
    group: str = ""
    """Title over several columns."""


@dataclass(frozen=True)
class Row:
    labels: tuple[str, ...]
    """One for each stub of the table."""
    cells: tuple[Cell, ...]
    baseline: bool = False


@dataclass(frozen=True)
class Block:
    """Rows under one heading, such as those of one robot."""

    title: str
    rows: tuple[Row, ...]
    note: str = ""
    """What is missing."""


@dataclass(frozen=True)
class Table:
    """A table as any of the output formats shows it."""

    name: str
    """For file names and labels."""
    title: str
    caption: str
    stubs: tuple[str, ...]
    """Heads of the columns of labels."""
    columns: tuple[Column, ...]
    blocks: tuple[Block, ...]

    @property
    def complete(self) -> bool:
        return not any(block.note for block in self.blocks)


@dataclass(frozen=True)
class Builder:
    """Makes cells, rows and blocks of means.

    Attributes:
        ours: what is reported on.
        paper: the printed values beside; None leaves them out.
        planned: episodes that the study meant to grade, by variant and robot; the paper's where it does not say.
    """

    ours: Grades
    paper: PaperGrades | None
    planned: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @property
    def any_metric(self) -> str:
        """The first metric, for counts."""
        return next(iter(self.ours.metrics))

    def present(self, part: str) -> bool:
        """Was anything measured that only this part asks for? The models that comparisons start from do not count."""
        if not isinstance(self.ours, StudyGrades):
            return part in PAPER_PARTS
        adapted = [variant for variant in PARTS[part] if variant.target is not None]
        own = adapted or [variant for variant in PARTS[part] if variant != reference()] or PARTS[part]
        return any(self.ours.has(variant.name) for variant in own)

    def cell(self, part: str, row: str, robots: str, metric: str, base: str = "") -> Cell:
        """The mean at an address, against that of the row `base`."""
        info = self.ours.metrics.get(metric)
        mean = self.ours.mean(part, row, robots, metric) if info else None
        printed = self._printed(part, row, robots, metric)
        if info is None or mean is None:
            return printed
        ends = _ends(mean, self.ours.level)
        return replace(
            printed,
            text=number(mean.value, info),
            interval=interval_text(ends, info),
            verdict=verdict(self.ours, part, row, base, robots, metric) if base and base != row else "",
            value=mean.value,
            low=ends[0],
            high=ends[1],
            episodes=mean.count,
        )

    def row(self, part: str, row: str, robots: str, metrics: Sequence[str], labels: Sequence[str], base: str = "") -> Row:
        return Row(tuple(labels), tuple(self.cell(part, row, robots, metric, base) for metric in metrics))

    def baselines(self, robots: Sequence[str], metrics: Sequence[str]) -> list[Row]:
        """The frozen first frame and the true video, where they were graded."""
        still = [Row((STILL,), tuple(self.baseline(COPY, robots, metric) for metric in metrics), baseline=True)]
        return [*_graded(still), *self.truth((TRUE,), [(robots, metric) for metric in metrics])]

    def truth(self, labels: tuple[str, ...], places: Sequence[tuple[Sequence[str], str]]) -> list[Row]:
        """The true video, of robots and a metric for each column: what it lacks is the noise floor. Empty if not graded."""
        return _graded([Row(labels, tuple(self.baseline(TRUTH, *place) for place in places), baseline=True)])

    def note(self, part: str, rows: Iterable[tuple[str, str, str]]) -> str:
        """What a block lacks. Rows are key, robots and label."""
        if not isinstance(self.ours, StudyGrades):
            return ""
        found: dict[str, list[str]] = {}
        as_planned, as_paper = True, True
        for key, robots, label in rows:
            variant = find_variant(part, key)
            paper = sum(expected_counts(variant).get(robot, 0) for robot in pooled(variant, robots))
            planned = sum(self.planned.get(variant.name, {}).get(robot, 0) for robot in pooled(variant, robots)) or paper
            # A metric that is not defined for an episode lacks it; the episode is graded all the same.
            means = (self.ours.mean(part, key, robots, metric) for metric in self.ours.metrics)
            count = max((mean.count for mean in means if mean), default=0)
            as_planned, as_paper = as_planned and count == planned, as_paper and count == paper
            text = f"{count} of {paper if count == planned else planned} episodes" if count else "not run"
            found.setdefault(text, []).append(label)
        if as_paper:
            return ""
        word = "As planned, but smaller than the paper's protocol" if as_planned else "Incomplete"
        if len(found) == 1:
            return f"{word}: {next(iter(found))} in every row."
        parts = (f"{text[0].upper()}{text[1:]}: {'; '.join(names)}." for text, names in found.items())
        return f"{word}. {' '.join(parts)}"

    def baseline(self, model: str, robots: Sequence[str], metric: str) -> Cell:
        """Mean of COPY or TRUTH on some robots."""
        info = self.ours.metrics.get(metric)
        mean = self.ours.baseline(model, robots, metric) if isinstance(self.ours, StudyGrades) else None
        if info is None or mean is None:
            return Cell()
        if model == TRUTH and metric == "psnr":
            return Cell("exact", episodes=mean.count)
        ends = _ends(mean, self.ours.level)
        return Cell(
            number(mean.value, info),
            interval_text(ends, info),
            value=mean.value,
            low=ends[0],
            high=ends[1],
            episodes=mean.count,
        )

    def _printed(self, part: str, row: str, robots: str, metric: str) -> Cell:
        text = self.paper.print(part, row, robots, metric) if self.paper else ""
        return Cell(published=text, printed=float(text)) if text else Cell()


def _graded(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if any(cell.episodes for cell in row.cells)]


def verdict(grades: Grades, part: str, row: str, base: str, robots: str, metric: str) -> str:
    """Is a row better than another of its part, on the cells that all rows of the part have?"""
    after, before = (grades.mean(part, key, robots, metric, shared=True) for key in (row, base))
    if after is None or before is None:
        return ""
    if isinstance(grades, StudyGrades) and min(after.scenes, before.scenes) < MIN_SCENES:
        return "unresolved"
    low, high = interval(better(after, before, grades.metrics[metric]), grades.level)
    if not low <= 0 <= high and abs(after.value - before.value) > grades.floor(robots, metric):
        return "better" if low > 0 else "worse"
    return "unresolved"


def number(value: float, metric: MetricInfo) -> str:
    """Digits that mean something: 0.01 dB, 0.1 px, else 0.001."""
    return f"{value:.{ {'dB': 2, 'px': 1}.get(metric.unit, 3) }f}"


def metric_title(metric: MetricInfo) -> str:
    """Such as 'PSNR [dB] ↑': the arrow points to better."""
    unit = f" [{metric.unit}]" if metric.unit else ""
    return f"{METRIC_TITLES.get(metric.name, metric.name)}{unit} {'↑' if metric.higher_is_better else '↓'}"


def metric_columns(metrics: Mapping[str, MetricInfo], names: Sequence[str]) -> tuple[Column, ...]:
    """A column for each name, under its dimension."""
    infos = [metrics[name] for name in names]
    return tuple(Column(metric_title(info), DIMENSION_TITLES.get(info.dimension, info.dimension)) for info in infos)


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
    return [make(builder) for part, makers in made.items() if builder.present(part) for make in makers]


def _measured(builder: Builder, names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name in builder.ours.metrics)


def gap_table(builder: Builder) -> Table:
    """Not in the paper as such: the reference model, flow only, on robots seen and unseen, beside both baselines."""
    keys = {"fixed": "flow only"}
    return _full(builder, "gap", "The gap: robots seen and unseen", "fixed", "model", keys, "")


def action_table(builder: Builder) -> Table:
    """The paper's main table of action representations: both held-out robots under each representation."""
    metrics = _measured(builder, ("psnr", "lpips", "mask_iou", "boundary_f1", "pck", "keypoint_error", "trajectory_error"))
    keys = [(key, robot) for key in ACTIONS for robot in HELD_OUT_ROBOTS]
    rows = [builder.row("actions", key, robot, metrics, (ACTIONS[key], SHORT_ROBOTS[robot]), "joints") for key, robot in keys]
    for first, step in enumerate([len(HELD_OUT_ROBOTS)] * len(HELD_OUT_ROBOTS)):
        rows[first::step] = _mark_best(rows[first::step], builder, metrics)
    places = ((key, robot, f"{ACTIONS[key]}, {SHORT_ROBOTS[robot]}") for key, robot in keys)
    floors = (builder.truth((TRUE, SHORT_ROBOTS[r]), [((r,), metric) for metric in metrics]) for r in HELD_OUT_ROBOTS)
    block = Block("", (*rows, *(row for found in floors for row in found)), builder.note("actions", places))
    return Table(
        "actions",
        "Action representation, robots never seen",
        "Each robot by itself; bold is best for that robot. Marks: against joint pose.",
        ("action representation", "target"),
        metric_columns(builder.ours.metrics, metrics),
        (block,),
    )


def action_full(builder: Builder) -> Table:
    """The appendix's complete table of action representations."""
    return _full(builder, "actions_full", "Action representation, all metrics", "actions", "representation", ACTIONS, "joints")


def ladder_table(builder: Builder) -> Table:
    """The paper's main table of the conditioning ladder."""
    metrics = _measured(builder, ("mask_iou", "region_lpips", "lpips"))
    return Table(
        "ladder",
        "What the model is told of the robot's looks",
        "Optical flow throughout. Marks: against flow only.",
        ("conditioning",),
        tuple(Column(metric_title(builder.ours.metrics[name])) for name in metrics),
        tuple(_block(builder, ROBOT_TITLES[robot], "ladder", LADDER, robot, metrics, "none") for robot in HELD_OUT_ROBOTS),
    )


def ladder_full(builder: Builder) -> Table:
    """The appendix's complete table of the conditioning ladder."""
    return _full(builder, "ladder_full", "Conditioning, all metrics", "ladder", "conditioning", LADDER, "none")


def few_shot_table(builder: Builder) -> Table:
    """The paper's main few-shot table: metrics down, demonstrations across."""
    metrics = _measured(builder, ("mask_iou", "region_lpips", "lpips"))
    graded = any(builder.baseline(TRUTH, (robot,), metric).episodes for robot in HELD_OUT_ROBOTS for metric in metrics)

    def row(robot: str, metric: str) -> Row:
        cells = [builder.cell("few_shot", f"{robot}-{shots}", robot, metric, f"{robot}-0") for shots in (0, *SHOTS)]
        cells.append(builder.cell("few_shot", "robot_render", robot, metric))
        cells += [builder.baseline(TRUTH, (robot,), metric)] * graded
        return Row((SHORT_ROBOTS[robot], metric_title(builder.ours.metrics[metric])), tuple(cells))

    return Table(
        "few_shot",
        "Few-shot adaptation",
        "M demonstrations of each task; M = 0 is the model told nine views, before adaptation. Marks: against M = 0.",
        ("target", "metric"),
        (
            *(Column(f"M = {shots}", "Demonstrations a task") for shots in (0, *SHOTS)),
            Column("per-frame render"),
            *([Column(TRUE)] * graded),
        ),
        tuple(
            Block("", tuple(row(robot, metric) for metric in metrics), _few_shot_note(builder, robot))
            for robot in HELD_OUT_ROBOTS
        ),
    )


def recovery_full(builder: Builder) -> Table:
    """The appendix's complete table of few-shot recovery."""
    metrics = _measured(builder, PAPER_METRICS)
    seen = builder.row("few_shot", REFERENCE, SEEN, metrics, (REFERENCE,))
    blocks = [Block("Seen pool, before adaptation", (seen,), builder.note("few_shot", [(REFERENCE, SEEN, REFERENCE)]))]
    for robot in HELD_OUT_ROBOTS:
        keys = {f"{robot}-{shots}": f"M = {shots}" for shots in (0, *SHOTS)}
        title = f"Held-out {ROBOT_TITLES[robot]}"
        blocks.append(_block(builder, title, "few_shot", keys, robot, metrics, f"{robot}-0"))
    caption = "Marks: against M = 0."
    columns = metric_columns(builder.ours.metrics, metrics)
    return Table("few_shot_full", "Few-shot recovery, all metrics", caption, ("demonstrations a task",), columns, tuple(blocks))


def forgetting_full(builder: Builder) -> Table:
    """The appendix's complete table of forgetting, and with it the remedies, which the paper does not have."""
    metrics = _measured(builder, PAPER_METRICS)
    keys = {"none": "none (before)"}
    keys |= {f"{robot}-{shots}": f"{SHORT_ROBOTS[robot]}, M = {shots}" for robot in HELD_OUT_ROBOTS for shots in SHOTS}
    if builder.present("remedies") and builder.paper:
        keys |= {
            f"{robot}-{shots}-{remedy}": f"{SHORT_ROBOTS[robot]}, M = {shots}, {title} (ours)"
            for remedy, title in REMEDIES.items()
            for robot in HELD_OUT_ROBOTS
            for shots in SHOTS
        }
    block = _block(builder, "", "forgetting", keys, FORGETTING_ROBOT, metrics, "none")
    plain = tuple(replace(row, cells=tuple(replace(cell, best=False) for cell in row.cells)) for row in block.rows)
    return Table(
        "forgetting_full",
        f"Forgetting on {ROBOT_TITLES[FORGETTING_ROBOT]}, all metrics",
        f"The same {ROBOT_TITLES[FORGETTING_ROBOT]} episodes after each adaptation. Marks: against before.",
        ("adapted to",),
        metric_columns(builder.ours.metrics, metrics),
        (replace(block, rows=plain),),
    )


def baseline_table(builder: Builder) -> Table:
    """The paper's table of world models: seen robots, Franka and Piper side by side for one metric of each dimension."""
    metrics = _measured(builder, ("lpips", "mask_iou", "pck", "trajectory_error"))
    groups = (SEEN, *HELD_OUT_ROBOTS)
    systems = dict(zip(SYSTEMS, SYSTEM_ACTIONS, strict=True))

    def row(key: str, action: str, title: str) -> Row:
        cells = (builder.cell("baselines", key, robots, metric) for metric in metrics for robots in groups)
        return Row((title, action), tuple(cells))

    rows = [row(key, action, SYSTEMS[key]) for key, action in systems.items()]
    if builder.present("more_systems") and builder.paper:
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
    block = Block("", (*_best(rows, better_up), *floor), note)
    return Table(
        "baselines",
        "Seen and unseen robots under other world models",
        "Bold is best.",
        ("model", "told of actions"),
        columns,
        (block,),
    )


def loeo_full(builder: Builder) -> Table:
    """The appendix's absolute scores of the five folds; each row is another model."""
    metrics = _measured(builder, PAPER_METRICS)
    rows = [builder.row("loeo", f"loeo_{robot}", robot, metrics, (ROBOT_TITLES[robot],)) for robot in ROBOT_NAMES]
    floors = [row for r in ROBOT_NAMES for row in builder.truth((ROBOT_TITLES[r],), [((r,), metric) for metric in metrics])]
    note = builder.note("loeo", ((f"loeo_{robot}", robot, ROBOT_TITLES[robot]) for robot in ROBOT_NAMES))
    return Table(
        "loeo_full",
        "Each robot held out in turn",
        "Each row is a model of its own, trained on the other four robots; not to be compared with the fixed split.",
        ("held out",),
        metric_columns(builder.ours.metrics, metrics),
        (Block("", tuple(rows), note), *([Block("True video, graded", tuple(floors))] if floors else [])),
    )


def count_table(builder: Builder) -> Table:
    """The paper's numbers of scored episodes, and how many there are here."""
    printed = {"actions": (1500, 500, 500), "ladder": (1500, 500, 500), "loeo": (2000, 500, 500), "few_shot": (500, 500, 500)}
    titles = {"actions": "Action representation", "ladder": "Conditioning", "loeo": "One LOEO fold", "few_shot": "Few-shot"}
    rows = [
        Row((titles[part],), tuple(_count_cell(builder, part, i, number) for i, number in enumerate(numbers)))
        for part, numbers in printed.items()
    ]
    return Table(
        "counts",
        "Numbers of scored episodes",
        f"Of a row of each table; few-shot: {ROBOT_TITLES[FORGETTING_ROBOT]} for forgetting, and the target.",
        ("experiment",),
        (Column("seen / reference"), *(Column(SHORT_ROBOTS[robot]) for robot in HELD_OUT_ROBOTS)),
        (Block("", tuple(rows)),),
    )


def _count_cell(builder: Builder, part: str, place: int, printed: int) -> Cell:
    """Smallest and largest count over the variants of a part, in one of the columns seen, Franka, Piper."""
    if not isinstance(builder.ours, StudyGrades):
        return Cell(published=str(printed), printed=printed)
    counts = set()
    for variant in PARTS[part]:
        seen = (FORGETTING_ROBOT,) if part == "few_shot" else variant.seen_robots
        robots = (seen, *((robot,) for robot in HELD_OUT_ROBOTS))[place]
        held_out = place == 0 or robots[0] in variant.held_out_robots
        if held_out and (mean := builder.ours.variant_mean(variant.name, robots, builder.any_metric)):
            counts.add(mean.count)
    text = " to ".join(map(str, dict.fromkeys((min(counts), max(counts))))) if counts else "–"
    return Cell(
        text, published=str(printed), printed=printed, value=max(counts, default=np.nan), episodes=max(counts, default=0)
    )


def _full(builder: Builder, name: str, title: str, part: str, stub: str, keys: dict[str, str], base: str) -> Table:
    """Ten metrics; the seen pool and each held-out robot a block."""
    metrics = _measured(builder, PAPER_METRICS)
    groups = {SEEN: SEEN_TITLE, **{robot: f"Held-out {ROBOT_TITLES[robot]}" for robot in HELD_OUT_ROBOTS}}
    blocks = tuple(_block(builder, text, part, keys, robots, metrics, base) for robots, text in groups.items())
    caption = f"Marks: against {keys[base].lower()}." if base else ""
    return Table(name, title, caption, (stub,), metric_columns(builder.ours.metrics, metrics), blocks)


def _block(
    builder: Builder, title: str, part: str, keys: dict[str, str], robots: str, metrics: Sequence[str], base: str = ""
) -> Block:
    rows = [builder.row(part, key, robots, metrics, (label,), base) for key, label in keys.items()]
    below = builder.baselines(pooled(find_variant(part, next(iter(keys))), robots), metrics)
    note = builder.note(part, ((key, robots, label) for key, label in keys.items()))
    return Block(title, (*_mark_best(rows, builder, metrics), *below), note)


def _few_shot_note(builder: Builder, robot: str) -> str:
    keys = {f"{robot}-{shots}": f"M = {shots}" for shots in (0, *SHOTS)} | {"robot_render": "per-frame render"}
    note = builder.note("few_shot", ((key, robot, label) for key, label in keys.items()))
    return note and f"{SHORT_ROBOTS[robot]}. {note}"


def _mark_best(rows: Sequence[Row], builder: Builder, metrics: Sequence[str]) -> list[Row]:
    return _best(rows, [builder.ours.metrics[name].higher_is_better for name in metrics])


def _best(rows: Sequence[Row], higher_is_better: Sequence[bool]) -> list[Row]:
    """The same rows with the best cell of each column marked, where at least two rows have one."""
    values = np.array([[cell.value for cell in row.cells] for row in rows])
    signed = np.where(higher_is_better, values, -values)
    enough = (~np.isnan(values)).sum(axis=0) > 1
    top = np.nanmax(np.where(np.isnan(signed), -np.inf, signed), axis=0)
    return [
        replace(row, cells=tuple(replace(c, best=bool(enough[j] and signed[i, j] == top[j])) for j, c in enumerate(row.cells)))
        for i, row in enumerate(rows)
    ]


def _ends(mean: Mean, level: float) -> tuple[float, float]:
    """NaN where there are too few scenes for an interval, or where none is known (the paper)."""
    return interval(mean.values, level) if mean.scenes >= MIN_SCENES else (np.nan, np.nan)


def interval_text(ends: tuple[float, float], metric: MetricInfo) -> str:
    """Such as '0.12–0.15'; '' where there is no interval, or none at these digits."""
    low, high = ends
    if np.isnan(low):
        return ""
    first, last = number(low, metric), number(high, metric)
    return "" if first == last else f"{first}–{last}"
