"""The report of a score table: one page that opens without a network.

Reads  scores.parquet and its curves; the data set and the rollouts for pictures
Writes <out>/index.html (self-contained), report.md with figures/, tables/ (LaTeX, CSV) and summary.csv; of a study findings.csv
       With --explorer also <out>/explorer, a page that plays videos

A table with the column `variant` is a study's (xew.analysis.study writes it) and becomes the report of `reports/study.py`.

    python -m xew.analysis.report demo/scores.parquet --data demo/data --rollouts demo/rollouts --out demo/report

With --paper it reads nothing: the paper's own figures come with the package, and its distance table is rebuilt from them.

    python -m xew.analysis.report --paper --out paper_report
"""

import platform
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from markupsafe import Markup
from tqdm import tqdm

import xew
from xew.analysis.paper import read_paper
from xew.analysis.reports import page, pictures
from xew.analysis.reports import paper as paper_report
from xew.analysis.reports import study as report_study
from xew.analysis.reports.answer import answer, answer_strip, best_row, run_contests
from xew.analysis.reports.charts import Chart, chart_files
from xew.analysis.reports.run_tables import RobotTable, Row, finding, flat_summary, robot_table
from xew.analysis.reports.study_charts import ranking_chart, run_chart
from xew.analysis.reports.study_strips import Strip
from xew.analysis.reports.study_text import curves_note, missing_note
from xew.analysis.scores import TRUTH, MetricInfo, Scores, find_missing_scores, read_scores
from xew.analysis.tables import formats
from xew.analysis.tables.labels import robot_title
from xew.analysis.tables.table import (
    Column,
    Table,
    TableCell,
    TableRow,
    TableSection,
    format_interval,
    format_number,
    metric_columns,
    parting_note,
)
from xew.config import ConfigError, user_errors
from xew.dataset import demand_one_change, demand_one_motion, find_records
from xew.episode import Record, episode_folder, read_pixels
from xew.files import hold_lock, write_bytes, write_text
from xew.names import csv_text, plain_markdown
from xew.protocol import BASELINES, HELD_OUT_ROBOTS, ROBOT_NAMES, seed_split, split_fault
from xew.rollout import Rollout, find_rollouts, read_as_graded
from xew.statistics import MIN_SCENES, find_parting, rank_policies, strict_metrics

TITLE = "Can the model render a robot that it has never seen?"
RANKING = "Policies ranked in predicted video"
STRIP_METRIC = "lpips"
"""Metric that ranks episodes, so strips show the best, the median and the worst."""
FRAME_ZERO = {
    "given": "frame 0 is given to the model and never scored",
    "absent": "frame 0, which the model was given and its videos leave out, is never scored",
    "predicted": "frame 0 is predicted too, and scored as all others",
}
CURVE_METRICS = ("lpips", "psnr", "mask_iou")
FILES = ("index.html", "report.md", "*.csv", "figures/*", "tables/*")
"""Patterns of the paths of what is written into the folder of a report."""
NO_FILE_NAME = re.compile(r"[<>\"/\\|?*()\[\]`']+")
"""Letters of the names of models that stand in no name of a figure's file."""
Rollouts = Mapping[tuple[str, str, str, int, str], Rollout]
"""Rollouts by model, condition, task, seed and robot."""
MIDDLE = ("median", "the only episode")
"""Names of the middle one of ranked episodes."""
EXPLORER = "explorer/index.html"
"""Path of the explorer's page below the report's folder."""


@dataclass(frozen=True)
class Args:
    """Turn a score table into one HTML page, with Markdown and CSV next to it."""

    scores: Annotated[Path | None, tyro.conf.Positional] = None
    """Score table that python -m xew.metrics.evaluate made; needed unless --paper is given."""
    data: Path | None = None
    """Data set, for pictures and for the number of episodes that a complete table has."""
    rollouts: tuple[Path, ...] = ()
    """Graded rollouts, for pictures."""
    out: Path = Path("report")
    """Folder to write."""
    held_out: tuple[str, ...] = HELD_OUT_ROBOTS
    """Robots that the models have not seen; each has its own table, and so has every custom robot."""
    distances: Path | None = None
    """Folder that python -m xew.analysis.distance wrote, for a study; without it the paper's distances are used."""
    other_motion: Path | None = None
    """Score table of the same study in the other kind of motion, to compare action representations."""
    shifted: tuple[Path, ...] = ()
    """Score tables of the models of the part `shifts` on changed scenes, one for each change and model."""
    explorer: bool = False
    """Write <out>/explorer too, a page that plays the scenes of the strips, for the report of one run."""
    paper: bool = False
    """Instead of scores: rebuild the paper's distance table from the paper's own scores and distances."""


@dataclass(frozen=True)
class Picture:
    """A figure of the page."""

    name: str
    image: bytes
    html: Markup


@user_errors
def main(args: Args) -> None:
    """Read the scores, make the report and write it."""
    with hold_lock(args.out):
        if args.paper:
            _report_paper(args)
        elif args.scores:
            scores = read_scores(args.scores, _own_robots(args.data))
            _check_data(args, scores)
            (_report_study if scores.of_study else _report_scores)(args, scores)
        else:
            raise ConfigError("no score table was named: give the one that xew.metrics.evaluate wrote, or --paper.")
    print(f"report: {args.out / 'index.html'}")


def _check_data(args: Args, scores: Scores) -> None:
    records = [record for _, record in find_records(args.data)] if args.data else []
    motion = demand_one_motion(args.data, records) if args.data and records else scores.motion
    change = demand_one_change(args.data, records) if args.data and records else scores.change
    if (motion, change) != (scores.motion, scores.change):
        raise ConfigError(
            f"{args.data} has episodes of {motion} motion with {change or 'no'} change, {args.scores} has scores of "
            f"{scores.motion} motion with {scores.change or 'no'} change; name the data that was graded."
        )


def _own_robots(data: Path | None) -> list[str]:
    """Keys of the robots of a data set; those that read as paths are left out, since tables and pictures are named by them."""
    robots = {record.robot for _, record in find_records(data)} if data else set()
    return sorted(robot for robot in robots if not set(robot) & {"/", "\\"} and robot not in ("", ".", ".."))


def _report_paper(args: Args) -> None:
    if args.scores or args.data or args.rollouts or args.distances or args.explorer or args.other_motion:
        raise ConfigError(
            "--paper reports on the paper's own figures; leave out scores, --data, --rollouts, --distances, --other-motion and "
            "--explorer."
        )
    report = paper_report.build(read_paper(), _format_footer({}))
    _write_report(args.out, report.html, (report.markdown, report.files), report.summary)


def _report_study(args: Args, scores: Scores) -> None:
    if args.explorer:
        raise ConfigError("--explorer is for one run; for a study: python -m xew.sim_warp.inspect DATA --page OUT.")
    if args.held_out != HELD_OUT_ROBOTS:
        raise ConfigError(
            f"--held-out is for one run; {args.scores} is a study's table, whose variants say whom they have seen."
        )
    if args.data and not any(find_records(args.data)):
        raise ConfigError(f"{args.data} holds no episode; make some: python -m xew.sim_warp.generate --out {args.data}")
    other = read_scores(args.other_motion, _own_robots(args.data)) if args.other_motion else None
    shifted = [read_scores(path, _own_robots(args.data)) for path in args.shifted]
    others = report_study.Others(other, shifted)
    report = report_study.build(scores, args.data, args.rollouts, args.distances, _format_footer(scores.versions), others)
    _write_report(args.out, report.html, (report.markdown, report.files), report.summary)


def _report_scores(args: Args, scores: Scores) -> None:
    if args.distances or args.other_motion or args.shifted:
        raise ConfigError(
            f"--distances, --other-motion and --shifted are for the report of a study, and {args.scores} is the table of one "
            "run; leave them out."
        )
    own = [robot for robot in dict.fromkeys(scores.rows["robot"]) if robot not in ROBOT_NAMES]
    for robot in args.held_out:
        if robot not in (*ROBOT_NAMES, *own):
            raise ConfigError(f"--held-out names {robot!r}; known: {', '.join((*ROBOT_NAMES, *own))}.")
    # Robots of one's own are none that a split trains on.
    args = replace(args, held_out=tuple(dict.fromkeys((*args.held_out, *own))))
    records = [record for _, record in find_records(args.data)] if args.data else []
    if args.data and not records:
        raise ConfigError(f"{args.data} holds no episode; make some: python -m xew.sim_warp.generate --out {args.data}")
    held_out, seen = _make_tables(scores, records, args.held_out)
    missing = find_missing_scores(scores.rows)
    notes = [*missing_note(missing), *curves_note(scores)]
    rollouts = {(r.model, r.condition, r.task, r.seed, r.robot): r for root in args.rollouts for r in find_rollouts(root)}
    strips = _make_strips(scores, args, rollouts) if args.data and args.rollouts else []
    first = answer(list(run_contests(held_out)), _make_answer_strip(scores, args, held_out, rollouts))
    if args.explorer:
        _write_explorer(scores, args)
    curves = _curve_chart(scores, args.held_out)
    ranking, policies = ranking_tables(scores.rows, held_out + seen), _policies_chart(scores.rows, held_out + seen)
    sections = [
        *map(page.note, notes),
        _held_out_section(held_out, scores.metrics),
        _strip_section(strips, args),
        page.section("How the error grows with time", page.chart(curves)) if curves.panels else None,
        _seen_section(seen, scores.metrics),
        _ranking_section(ranking, policies),
        _method_section(scores, args),
    ]
    sentences = finding(held_out, seen, scores.metrics)
    html = page.page(TITLE, sentences, [part for part in sections if part], _format_footer(scores.versions), first)
    notes += _caution_notes(held_out)
    drawn = chart_files(curves) | (chart_files(first.chart) if first.chart else {})
    drawn |= chart_files(policies) if ranking else {}
    text, files = _write_markdown([first.sentence, *sentences], notes, held_out, seen, scores, strips, drawn, ranking)
    if len(missing):
        files["missing.csv"] = csv_text(missing).encode()
    _write_report(args.out, html, (text, files), flat_summary(held_out + seen, scores.metrics))


def _make_tables(
    scores: Scores, records: Sequence[Record], held_out: Sequence[str]
) -> tuple[list[RobotTable], list[RobotTable]]:
    """A table for each held-out robot, never averaged over them; one for the seen robots pooled, as in the paper."""
    present, families = set(scores.rows["robot"]), {_family(seed) for seed in scores.rows["seed"].unique()}

    def build(title: str, robots: Sequence[str]) -> RobotTable:
        return robot_table(scores, title, robots, _count_expected(records, robots, families) if records else None)

    apart = [build(robot_title(robot), [robot]) for robot in held_out if robot in present]
    rest = [robot for robot in ROBOT_NAMES if robot in present and robot not in held_out]
    pooled = [build("Pooled: " + ", ".join(map(robot_title, rest)), rest)] if rest else []
    return apart, pooled


def _count_expected(records: Sequence[Record], robots: Sequence[str], families: Collection[tuple[str, bool]]) -> int:
    """Episodes of these robots and families of seeds, in seeds that all robots have mastered: what a complete table has."""
    failed = {(record.task, record.seed) for record in records if not record.is_kept}
    graded = [record for record in records if record.robot in robots and _family(record.seed) in families]
    return sum((record.task, record.seed) not in failed for record in graded)


def _family(seed: int) -> tuple[str, bool]:
    """The family of a seed, and whether it has a fault: rollouts may leave these out."""
    return seed_split(seed), split_fault(seed)[0] > 0


def _held_out_section(tables: Sequence[RobotTable], metrics: Sequence[MetricInfo]) -> Markup:
    if not tables:
        return page.section("Robots never seen in training", page.note("No held-out robot has been graded yet."))
    return page.section(
        "Robots never seen in training",
        page.paragraph(
            "Means over episodes with 95 % bootstrap intervals; scenes (task and seed) are resampled. Compared with the frozen "
            "first frame, paired by episode: ▲ better, ▼ worse, ≈ not resolved. Strict metrics decide; the paper's metric has "
            "a mark in parentheses where its verdict differs. The true video's scores show the estimators' error, and smaller "
            "differences are not resolved."
        ),
        *map(page.note, _caution_notes(tables)),
        *(page.table(run_table(table, metrics)) for table in tables),
    )


def _caution_notes(tables: Sequence[RobotTable]) -> list[str]:
    few = min((table.count for table in tables), default=np.inf)
    if few < MIN_SCENES or any(row.is_few for table in tables for row in table.rows):
        return [f"Fewer than {MIN_SCENES} scenes: no intervals, and nothing is resolved."]
    return ["Fewer than ten episodes a robot: intervals and verdicts are rough."] if few < 10 else []


def _seen_section(tables: Sequence[RobotTable], metrics: Sequence[MetricInfo]) -> Markup | None:
    if not tables:
        return None
    text = "The same model on its training robots, at test seeds."
    return page.section("Robots seen in training", page.paragraph(text), *(page.table(run_table(t, metrics)) for t in tables))


def ranking_tables(rows: pd.DataFrame, tables: Sequence[RobotTable]) -> list[Table]:
    """A table of policy ranking with a section for each table of robots; none where no scene has several commands."""
    ranking = rank_policies(rows, {table.title: table.robots for table in tables})
    if ranking.empty:
        return []
    sections = []
    for group, own in ranking.groupby("robot", sort=False):
        models = own.groupby(["model", "condition"], sort=False)
        shown = tuple(_ranking_row(str(model), str(condition), of_model) for (model, condition), of_model in models)
        sections.append(TableSection(str(group), shown))
    caption = (
        f"Success rates of {ranking['policies'].max()} graded policies in predicted video against those in the simulator, "
        "with 95 % intervals over scenes. Policy 0 is the expert, and policy k carries out the k-th mildest faulty commands of "
        "every scene. r is not defined where all videos show success, or none does."
    )
    columns = tuple(map(Column, ("Pearson's r", "Spearman", "MMRV")))
    return [Table("policy_ranking", "Agreement of success rates", caption, ("model",), columns, tuple(sections))]


def _ranking_row(model: str, condition: str, measures: pd.DataFrame) -> TableRow:
    cells = (
        TableCell(
            "not defined" if np.isnan(value) else f"{value:.3f}",
            "" if np.isnan(low) else f"{low:.3f}–{high:.3f}",
            value=value,
            low=low,
            high=high,
            episodes=scenes,
        )
        for value, low, high, scenes in measures[["value", "low", "high", "scenes"]].itertuples(index=False)
    )
    return TableRow((" · ".join(filter(None, (BASELINES.get(model, model), condition))),), tuple(cells), model in BASELINES)


def _policies_chart(rows: pd.DataFrame, tables: Sequence[RobotTable]) -> Chart:
    return ranking_chart(rows, {table.title: table.robots for table in tables})


def _ranking_section(tables: Sequence[Table], policies: Chart) -> Markup | None:
    shown = [*map(page.table, tables), *([page.chart(policies)] if policies.panels else [])]
    return page.section(RANKING, *shown) if tables else None


def run_table(table: RobotTable, metrics: Sequence[MetricInfo]) -> Table:
    """One robot's scores as a table: metrics by dimension across, models down."""
    shown = [metric for metric in metrics if any(metric.name in row.scores for row in table.rows)]
    found = " to ".join(map(str, sorted({min(table.counts, default=0), max(table.counts, default=0)})))
    of = f"{found} episodes" if table.expected is None else f"{found} of {table.expected} episodes"
    named = {metric.name: metric for metric in metrics}
    rows = tuple(_run_row(row, shown, named) for row in table.rows)
    sections = (TableSection("", rows, "" if table.complete else f"Incomplete: {of} are scored."),)
    return Table(
        "_".join(table.robots),
        table.title,
        " ".join(filter(None, (f"{of[0].upper()}{of[1:]}.", parting_note(sections), table.notes))),
        ("model",),
        metric_columns({metric.name: metric for metric in shown}, [metric.name for metric in shown]),
        sections,
    )


def _run_row(row: Row, shown: Sequence[MetricInfo], metrics: Mapping[str, MetricInfo]) -> TableRow:
    """A model's means with their marks; a metric with a strict counterpart has a mark only where their verdicts differ."""
    strict, parting = strict_metrics(metrics), {paper for _, paper in find_parting(row.verdicts, metrics)}
    cells = []
    for metric in shown:
        word = row.verdicts.get(metric.name, "")
        own, differing = ("" if metric.name in strict else word), (word if metric.name in parting else "")
        cells.append(_run_cell(row, metric, own, differing))
    return TableRow((row.title,), tuple(cells), row.model in BASELINES)


def _run_cell(row: Row, metric: MetricInfo, verdict: str, parting: str) -> TableCell:
    score = row.scores.get(metric.name)
    if score is None:
        return TableCell()
    if row.model == TRUTH and metric.name == "psnr":
        return TableCell("exact", episodes=score.count)  # all frames are equal to the truth
    return TableCell(
        format_number(score.mean, metric),
        format_interval((score.low, score.high), metric),
        verdict=verdict,
        parting=parting,
        value=score.mean,
        low=score.low,
        high=score.high,
        episodes=score.count,
    )


def _strip_section(strips: Sequence[Picture], args: Args) -> Markup:
    if not strips:
        missing = "name the data and the rollouts (--data, --rollouts)"
        if args.data and args.rollouts:
            missing = f"no held-out robot has a score of {STRIP_METRIC}, by which episodes are chosen; grade it too (--metrics)"
        return page.section("Best, median and worst episodes", page.note(f"No pictures: {missing}."))
    text = (
        "Episodes of each held-out robot, ranked by LPIPS. The difference is the largest of the three "
        f"channels: white for none, black for {pictures.DIFFERENCE_FULL} of 255 levels or more."
    )
    played = [page.link("All robots' videos of these scenes side by side, as they run", EXPLORER)] if args.explorer else []
    return page.section("Best, median and worst episodes", page.paragraph(text), *played, *(strip.html for strip in strips))


def _method_section(scores: Scores, args: Args) -> Markup:
    definitions = {metric.title: metric.reference for metric in scores.metrics}
    notes = (
        f"Every metric is a mean over the predicted frames; {FRAME_ZERO[scores.frame_zero]}. Masks in predicted video are "
        "estimated with the help of the true episode, by the same estimator for every row."
    )
    made = {"scores": str(args.scores), "data": str(args.data or "not given")}
    made["rollouts"] = ", ".join(map(str, args.rollouts)) or "not given"
    made |= scores.measured_by
    return page.section("How it was measured", page.paragraph(notes), page.definitions(definitions), page.definitions(made))


def _choose_episodes(scores: Scores, held_out: Sequence[str]) -> list[tuple[str, pd.Series]]:
    rows = scores.rows[(scores.rows["metric"] == STRIP_METRIC) & scores.rows["robot"].isin(held_out)]
    rows = rows[~rows["model"].isin(BASELINES)]
    return [pair for _, group in rows.groupby(["robot", "model", "condition"]) for pair in _rank_episodes(group)]


def _write_explorer(scores: Scores, args: Args) -> None:
    """Write the explorer of the scenes that strips are of, without optical flow, which would have to be rendered."""
    from xew.sim_warp.inspection.explorer import Page, choose_scenes, find_predictions, write_page

    if not args.data or not args.rollouts:
        raise ConfigError("--explorer plays videos; name them by --data and --rollouts.")
    names = sorted({f"{row['task']}/{int(row['seed'])}" for _, row in _choose_episodes(scores, args.held_out)})
    if names:
        predictions = find_predictions(args.rollouts)
        cells = [(folder, record) for folder, record in find_records(args.data) if record.hashes]
        scenes, left_out = choose_scenes(cells, names, len(names), predictions)
        given = scores.frame_zero != "absent"
        write_page(Page(TITLE, scenes, left_out, predictions, flow=False, given=given), (args.out / EXPLORER).parent)


def _make_answer_strip(scores: Scores, args: Args, tables: Sequence[RobotTable], rollouts: Rollouts) -> Strip | None:
    episodes: dict[str, tuple[Path, Rollout]] = {}
    for word, row in _choose_episodes(scores, args.held_out) if args.data else ():
        title = robot_title(row["robot"])
        best = next((best_row(table) for table in tables if table.title == title), None)
        key = _rollout_key(row)
        if args.data and best and word in MIDDLE and key[:2] == (best.model, best.condition) and key in rollouts:
            episodes[title] = episode_folder(args.data, *key[2:]), rollouts[key]
    return answer_strip(episodes, scores.frame_zero)


def _make_strips(scores: Scores, args: Args, rollouts: Rollouts) -> list[Picture]:
    assert args.data is not None
    shown = tqdm(_choose_episodes(scores, args.held_out), desc="strips", unit="strip", disable=None)
    return [_make_strip(row, word, rollouts, args.data, scores.frame_zero) for word, row in shown]


def _rank_episodes(group: pd.DataFrame) -> list[tuple[str, pd.Series]]:
    """Best, median and worst row by the ranking metric (lower is better); fewer where there are fewer."""
    if len(group) == 1:
        return [(MIDDLE[1], group.iloc[0])]
    ordered = group.sort_values(["value", "task", "seed"])
    words = {0: "best", len(ordered) // 2: MIDDLE[0], len(ordered) - 1: "worst"}
    return [(word, ordered.iloc[rank]) for rank, word in sorted(words.items())]


def _rollout_key(row: pd.Series) -> tuple[str, str, str, int, str]:
    return row["model"], row["condition"], row["task"], int(row["seed"]), row["robot"]


def _make_strip(row: pd.Series, word: str, rollouts: Rollouts, data: Path, frame_zero: str) -> Picture:
    key = _rollout_key(row)
    if key not in rollouts:
        raise ConfigError(f"the rollout {' '.join(map(str, key))} is graded but not under --rollouts; name its tree too.")
    observed = read_pixels(episode_folder(data, *key[2:]), "rgb")
    predicted = read_as_graded(rollouts[key], observed, frame_zero != "absent")
    times = pictures.strip_times(int(row["frames"]))
    image = pictures.encode_png(pictures.strip(observed, predicted, times))
    title = f"{robot_title(row['robot'])}, {row['task']}"
    caption = f", seed {row['seed']} · {' · '.join(filter(None, key[:2]))} · {word}, LPIPS {row['value']:.3f}"
    columns = [f"frame {t}" for t in times]
    html = page.labeled_picture(pictures.data_uri(image), caption, columns, ["observed", "predicted", "difference"], title)
    return Picture(NO_FILE_NAME.sub("-", "_".join((*map(str, key[:5]), word))) + ".png", image, html)


def _curve_chart(scores: Scores, held_out: Sequence[str]) -> Chart:
    metrics = [metric for metric in scores.metrics if metric.name in CURVE_METRICS] or list(scores.metrics[:3])
    robots = [robot for robot in held_out if robot in set(scores.rows["robot"])] or sorted(set(scores.rows["robot"]))
    return run_chart(scores.curves, metrics, robots)


def _format_footer(graded_with: Mapping[str, str]) -> str:
    packages = ("numpy", "scipy", "pandas", "opencv-python-headless")
    versions = {"xew": xew.__version__} | {name: metadata.version(name) for name in packages} | dict(graded_with)
    text = " · ".join(f"{name} {version}" for name, version in versions.items())
    return f"{text} · Python {platform.python_version()}"


def _write_markdown(
    sentences: Sequence[str],
    notes: Sequence[str],
    held_out: Sequence[RobotTable],
    seen: Sequence[RobotTable],
    scores: Scores,
    figures: Sequence[Picture],
    charts: Mapping[str, bytes],
    ranking: Sequence[Table],
) -> tuple[str, dict[str, bytes]]:
    bullets = [f"- {plain_markdown(sentence)}" for sentence in sentences]
    lines = [f"# {TITLE}", "", *bullets, *(f"\n> {plain_markdown(note)}" for note in notes)]
    made: list[Table] = []
    groups = {"Robots never seen in training": held_out, "Robots seen in training": seen}
    sections = {heading: [run_table(table, scores.metrics) for table in tables] for heading, tables in groups.items()}
    for heading, shown in (sections | ({RANKING: [*ranking]} if ranking else {})).items():
        lines += ["", f"## {heading}"]
        lines += [line for t in shown for line in ("", f"### {t.title}", "", t.caption, "", formats.markdown(t))]
        made += shown
    files = {figure.name: figure.image for figure in figures} | dict(charts)
    lines += ["", "## Figures", "", *(f"![{name}](figures/{name})" for name in files if name.endswith(".png"))]
    written = {f"tables/{table.name}.tex": formats.latex(table).encode() for table in made}
    written |= {f"tables/{table.name}.csv": csv_text(formats.table_frame(table)).encode() for table in made}
    return "\n".join(lines) + "\n", written | {f"figures/{name}": content for name, content in files.items()}


def _write_report(out: Path, html: str, markdown: tuple[str, Mapping[str, bytes]], summary: pd.DataFrame) -> None:
    """Write all files, the page last, so it refers to existing files."""
    text, files = markdown
    try:
        for name, content in files.items():
            write_bytes(out / name, content, within=out)
        write_text(out / "report.md", text, within=out)
        write_text(out / "summary.csv", csv_text(summary), within=out)
        write_text(out / "index.html", html, within=out)
    except OSError as error:
        raise ConfigError(f"cannot write the report to {out}: {error}. Choose another --out.") from error


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m xew.analysis.report"))
