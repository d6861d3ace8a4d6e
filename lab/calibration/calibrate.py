"""The command that measures the estimators' error: what metrics say of videos whose truth is known (docs/calibration.md).

Reads  a data set; for the second table its episodes are rendered again, with robot and objects moved wrongly
Writes <out>/calibration.md (both tables), references.parquet and wrong.parquet (a row for each episode, case and metric),
       frames.parquet (the second by frame); or, with --predictors, predictors.md and predictors.parquet

References: every metric on the true video itself, on what a codec leaves of it, and on videos that are wrong altogether.
Wrong motions: where the true mask and the true points of the video are known, so that what a metric makes of the estimators'
masks and points compares with what it makes of the true ones.
Predictors: videos made on purpose, from the true one to a gray one, and whether every metric puts them in order
(docs/metrics.md).

    python -m lab.calibration --data data --codec runs/fixed --out calibration
    python -m lab.calibration --data data --predictors --out calibration
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import spearmanr
from tqdm import tqdm

from lab.calibration.matrix import grade_predictors, matrix, to_markdown
from lab.calibration.perturbations import Perturbation, render_perturbations
from lab.calibration.predictors import APPEARANCES, PREDICTORS, Material, predict
from xew.config import ConfigError, admit, suggestion, user_errors
from xew.dataset import demand_one_motion, find_accepted
from xew.episode import EpisodeError, Record, read_pixels
from xew.files import hold_lock, replacing, write_text
from xew.metrics import METRICS
from xew.metrics.backends import Masker, Tracker, open_masker, open_tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.grade import Comparison, Grades, grade, input_kind
from xew.metrics.grading.codecs import ModelCodec, open_codecs
from xew.metrics.grading.settings import WITHOUT_OUTCOME
from xew.metrics.truth import NEEDS, Truth, read_truth
from xew.protocol import seed_split, split_fault

LATE = 8
"""Number of frames by which the true video is shifted, half a second."""
KEY = ["task", "seed", "robot", "case"]
ESTIMATED = tuple(name for name in METRICS if input_kind(name) in ("mask", "keypoints", "objects"))
"""Names of the metrics that see a prediction through an estimator."""
BY_MOTION = ("mask_iou", "boundary_f1", "keypoint_error")
"""Names of the metrics of the table by motion, frame by frame."""
MOTION_STEPS = (0, 0.5, 2, 5, 10, 20, 40, 80, np.inf)
"""Edges of the classes of motion: mean distance [pixels] by which the keypoints of a perturbation are off in a frame."""
RESOLVED = {"px": 0.5, "": 0.005}
"""Least difference of two true scores, by unit, at which their order counts."""
Row = dict[str, Any]
Episode = tuple[Path, Record]


@dataclass(frozen=True)
class CommonArgs:
    """Options of both commands that calibrate."""

    data: Path = Path("data")
    """A data set; with fewer than two robots and two seeds of a task the videos of others are left out."""
    out: Path = Path("calibration")
    """Folder of the tables."""
    codec: Path | None = None
    """A run or a config of `xew.model.train`, through whose codec the true videos go."""
    seeds: tuple[int, ...] = ()
    """Only episodes of these seeds; all others serve as another seed's. Left out: those of validation seeds, or where there are
    none of training seeds; never of test seeds, since estimators are chosen and tuned by what comes out."""
    episodes: int = 0
    """At most so many, of as many robots and tasks as there are; 0: all."""
    tracks: str = "default"
    """Estimator of keypoints and objects: a name of xew.metrics.backends.TRACKERS, or module:NAME."""
    tracks_checkpoint: Path | None = None
    """Its weights, where it has some."""
    trust: tuple[str, ...] = ()
    """Custom modules, such as my_lab.tasks, that the run and the data may name."""


@dataclass(frozen=True)
class Args(CommonArgs):
    """Calibrate the metrics on a data set of `xew.sim_warp.generate`."""

    masks: str = "default"
    """Estimator of robot masks: a name of xew.metrics.backends.MASKERS, or module:NAME."""
    masks_checkpoint: Path | None = None
    """Its weights, where it has some."""
    predictors: bool = False
    """Grade predictors made on purpose, instead of both tables."""
    metrics: tuple[str, ...] = WITHOUT_OUTCOME
    """Names of the metrics of the predictors' table."""
    cases: tuple[str, ...] = tuple(PREDICTORS)
    """Names of the predictors that are graded."""


@dataclass(frozen=True)
class Estimators:
    """The estimators that look into the videos."""

    masker: Masker
    tracker: Tracker

    def grade(self, video: np.ndarray, truth: Truth, names: Sequence[str]) -> Grades:
        """Scores of a video [t h w 3] uint8, of the shape of the true video, by the metrics of these names."""
        return grade(Comparison(video, EpisodeCache(truth), self.masker, self.tracker), names)


@user_errors
def main(args: Args) -> None:
    """Grade, write, and print both tables."""
    admit(args.trust)
    if unknown := [name for name in args.cases if name not in PREDICTORS]:
        near = suggestion(unknown[0], PREDICTORS)
        raise ConfigError(f"unknown predictor {unknown[0]!r};{near} known: {', '.join(PREDICTORS)}: --cases.")
    estimators = Estimators(open_masker(args.masks, args.masks_checkpoint), open_tracker(args.tracks, args.tracks_checkpoint))
    codec = None if args.codec is None else next(iter(open_codecs((args.codec,)).values()))
    episodes = find_accepted(args.data)
    demand_one_motion(args.data, (record for _, record in episodes))
    with hold_lock(args.out):
        if args.predictors:
            print(grade_matrix(episodes, args, estimators))
        else:
            print(grade_references(episodes, args, estimators, codec))


def grade_references(
    episodes: Sequence[Episode],
    args: Args,
    estimators: Estimators,
    codec: ModelCodec | None,
) -> str:
    """Grade references and wrong motions on the chosen episodes, write rows and both tables, and return these in Markdown."""
    tables = {name: pd.DataFrame() for name in ("references", "wrong", "frames")}
    text = ""
    for episode in tqdm(choose(episodes, args), desc="calibrate", unit="episode", disable=None):
        for name, table in calibrate(episode, episodes, estimators, codec).items():
            tables[name] = pd.concat([tables[name], table], ignore_index=True)
        text = report(**tables)
        write(args.out, text, tables)  # each time, so a stopped run has written something
    return text


def grade_matrix(episodes: Sequence[Episode], args: Args, estimators: Estimators) -> str:
    """Grade the predictors on the chosen episodes, write rows and table, and return the table in Markdown."""
    rows: list[Row] = []
    text = ""
    for folder, record in tqdm(choose(episodes, args), desc="predictors", unit="episode", disable=None):
        other = find_another(episodes, record, "robot")
        rows += grade_predictors(folder, record, other, estimators.masker, estimators.tracker, args.metrics, args.cases)
        table = pd.DataFrame(rows)
        text = to_markdown(matrix(table)) + "\n"
        write(args.out, text, {"predictors": table}, "predictors.md")
    return text


def calibrate(
    episode: Episode,
    episodes: Sequence[Episode],
    estimators: Estimators,
    codec: ModelCodec | None = None,
) -> dict[str, pd.DataFrame]:
    """The rows of one of the episodes: references (KEY metric value), wrong (KEY metric estimate truth), frames (by frame)."""
    folder, record = episode
    truth = read_truth(folder, record.frame_count, NEEDS)
    key: Row = {"task": record.task, "seed": record.seed, "robot": record.robot}
    references: list[Row] = []
    wrong: list[Row] = []
    frames: list[pd.DataFrame] = []
    for case, video in reference_videos(episodes, episode, truth, codec):
        values = estimators.grade(video, truth, _graded()).values
        references += [key | {"case": case, "metric": name, "value": value} for name, value in values.items()]
    for case, wrong_motion in render_perturbations(folder):
        grades, true = estimators.grade(wrong_motion.rgb, truth, ESTIMATED), true_grades(wrong_motion, truth)
        pairs = {name: {"estimate": grades.values[name], "truth": true.values[name]} for name in ESTIMATED}
        wrong += [key | {"case": case, "metric": name} | pair for name, pair in pairs.items()]
        frames.append(_by_frame(grades, true).assign(**key, case=case))
    rows = {"references": pd.DataFrame(references), "wrong": pd.DataFrame(wrong)}
    return rows | {"frames": pd.concat(frames, ignore_index=True)}


def choose(episodes: Sequence[Episode], args: CommonArgs) -> list[Episode]:
    """Those to calibrate on. Raises ConfigError if the data does not hold a seed asked for, or test seeds alone and none is."""
    if not args.seeds:
        families = ([e for e in episodes if seed_split(e[1].seed) == family] for family in ("validation", "train"))
        if not (chosen := next(filter(None, families), [])):
            raise ConfigError(
                f"{args.data} holds test seeds alone, by which nothing is tuned; make others: python -m xew.sim_warp.generate "
                f"--out {args.data} --validation-seeds 4, or name seeds: --seeds."
            )
        return _take_turns(chosen)[: args.episodes or None]
    held = sorted({record.seed for _, record in episodes})
    if unknown := [seed for seed in args.seeds if seed not in held]:
        raise ConfigError(f"{args.data} holds no seed {unknown[0]}; it has {', '.join(map(str, held[:20]))}: --seeds.")
    chosen = [episode for episode in episodes if episode[1].seed in args.seeds]
    return _take_turns(chosen)[: args.episodes or None]


def _take_turns(episodes: Sequence[Episode]) -> list[Episode]:
    """Episodes of tasks in alternation, each task with another robot first and each robot with another seed.

    The first few are of many tasks and robots. Of a task and robot, the commands of a scene follow one another.
    """
    robots, tasks = (list(dict.fromkeys(getattr(record, name) for _, record in episodes)) for name in ("robot", "task"))
    queues: dict[tuple[int, int], list[Episode]] = defaultdict(list)
    for episode in sorted(episodes, key=lambda episode: split_fault(episode[1].seed)[::-1]):
        queues[tasks.index(episode[1].task), robots.index(episode[1].robot)].append(episode)
    places = [(turn, (robot - task) % len(robots), task) for (task, robot), own in queues.items() for turn in range(len(own))]
    in_turn = [own[(turn + robot) % len(own)] for (_, robot), own in queues.items() for turn in range(len(own))]
    return [in_turn[number] for number in sorted(range(len(places)), key=places.__getitem__)]


def reference_videos(
    episodes: Sequence[Episode], episode: Episode, truth: Truth, codec: ModelCodec | None
) -> Iterator[tuple[str, np.ndarray]]:
    """Videos to grade as predictions of an episode, by the name of the case, each uint8 [t h w 3]."""
    folder, record = episode
    frames = np.arange(len(truth.rgb))
    yield "truth itself", truth.rgb
    if codec is not None:
        yield "truth through the codec", codec.reconstruct(folder, truth.rgb)
    yield "frozen first frame", truth.rgb[np.zeros_like(frames)]
    yield f"truth {LATE} frames late", truth.rgb[np.maximum(frames - LATE, 0)]
    material = Material(truth.rgb, robot=truth.labels == 0, objects=truth.labels > 0)
    for case in APPEARANCES:
        video = predict(case, material)
        if video is not None:
            yield case, video
    for differs in ("robot", "seed"):
        other = find_another(episodes, record, differs)
        if other is not None:
            video = read_pixels(other, "rgb")
            yield f"another {differs}", video[np.minimum(frames, len(video) - 1)]


def find_another(episodes: Sequence[Episode], record: Record, differs: str) -> Path | None:
    """The next episode that differs in robot or seed alone, the first after the last; None where there is none."""
    same = ("task", "seed") if differs == "robot" else ("task", "robot")
    folders = {
        getattr(other, differs): folder
        for folder, other in episodes
        if all(getattr(other, name) == getattr(record, name) for name in same)
    }
    own, others = getattr(record, differs), sorted(folders)
    following = others[(others.index(own) + 1) % len(others)]
    return None if following == own else folders[following]


def true_grades(wrong_motion: Perturbation, truth: Truth) -> Grades:
    """What the metrics of ESTIMATED say of a wrong video's true mask and true points."""
    values: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {}
    points = {
        "keypoints": (wrong_motion.keypoints, truth.keypoint_visible),
        "objects": (wrong_motion.objects, truth.object_visible),
    }
    for name in ESTIMATED:
        places, visible = points.get(input_kind(name), (wrong_motion.keypoints, truth.keypoint_visible))
        known = Estimators(lambda *_: wrong_motion.mask, lambda *_, p=places, v=visible: p[:, v.any(axis=0)])
        grades = known.grade(wrong_motion.rgb, truth, (name,))
        values |= grades.values
        curves |= grades.curves
    return Grades(values, curves, 0)


def _by_frame(grades: Grades, true: Grades) -> pd.DataFrame:
    """frame metric estimate truth motion: a row for each graded frame and metric of BY_MOTION."""
    tables = []
    for name in BY_MOTION:
        if name in grades.curves and name in true.curves:
            columns = {"estimate": grades.curves[name], "truth": true.curves[name], "motion": true.curves["keypoint_error"]}
            tables.append(pd.DataFrame({"frame": np.arange(1, len(true.curves[name]) + 1), "metric": name} | columns))
    return pd.concat(tables, ignore_index=True)


def report(references: pd.DataFrame, wrong: pd.DataFrame, frames: pd.DataFrame) -> str:
    """All tables in Markdown."""
    episodes = len(wrong[["task", "seed", "robot"]].drop_duplicates())
    parts = [
        f"Means over {episodes} episodes: {', '.join(sorted(wrong['task'].unique()))}; robots "
        f"{', '.join(sorted(wrong['robot'].unique()))}.",
        "### References",
        as_markdown(reference_table(references)),
        "### Wrong appearance: error of found points [px] (share that was found), of the robot; of objects; mask IoU",
        as_markdown(appearance_table(references)),
        "### Wrong motions: estimate (truth)",
        as_markdown(wrong_table(wrong, frames)),
        "### Wrong motions, frame by frame: mean difference of the estimate from the truth (mean of its absolute value)",
        as_markdown(motion_table(frames)),
        "### Order",
        as_markdown(order_table(wrong)),
    ]
    return "\n\n".join(parts) + "\n"


def reference_table(references: pd.DataFrame) -> pd.DataFrame:
    """Mean of each metric (rows) on each reference (columns); both in their own order."""
    table = references.groupby(["metric", "case"])["value"].mean().unstack()
    return table.loc[list(_graded()), list(references["case"].unique())].map("{:.3f}".format)


def _graded() -> tuple[str, ...]:
    """Names of metrics of references; those of outcomes have a calibration of their own (outcome.py)."""
    return tuple(name for name in METRICS if name in WITHOUT_OUTCOME)


def appearance_table(rows: pd.DataFrame) -> pd.DataFrame:
    """What the estimators make of each robot (columns) in the true motion and each wrong appearance (rows).

    Args:
        rows: task, seed, robot, case, metric and value, of references or of predictors.
    """
    cases = [case for case in ("truth itself", "truth", *APPEARANCES) if case in set(rows["case"])]
    means = rows.groupby(["case", "robot", "metric"])["value"].mean().unstack()
    cell = (
        "{keypoint_error_found:.2f} ({coverage_strict:.2f}); {trajectory_error_found:.2f} ({object_coverage_strict:.2f}); "
        "{mask_iou:.3f}"
    )
    robots = sorted(set(rows["robot"]))
    cells = {case: [cell.format(**means.loc[(case, robot)]) for robot in robots] for case in cases}
    return pd.DataFrame.from_dict(cells, orient="index", columns=robots)


def wrong_table(wrong: pd.DataFrame, frames: pd.DataFrame) -> pd.DataFrame:
    """Estimate and truth of each metric (columns) for each motion (rows), and by how many pixels keypoints are off."""
    means = wrong.groupby(["case", "metric"])[["estimate", "truth"]].mean()
    motion = frames.drop_duplicates([*KEY, "frame"]).groupby("case")["motion"].mean()
    rows = {}
    for case in wrong["case"].unique():
        cells = {name: "{estimate:.3f} ({truth:.3f})".format(**means.loc[(case, name)]) for name in ESTIMATED}
        rows[case] = {"motion [px]": f"{motion[case]:.1f}"} | cells
    return pd.DataFrame.from_dict(rows, orient="index")


def motion_table(frames: pd.DataFrame) -> pd.DataFrame:
    """How far estimates are from the truth in frames whose keypoints are off by so much."""
    steps = pd.cut(frames["motion"], MOTION_STEPS, right=False)
    rows = {}
    for step, part in frames.groupby(steps, observed=True):
        errors = {name: (own["estimate"] - own["truth"]).dropna() for name, own in part.groupby("metric")}
        cells = {name: f"{errors[name].mean():+.3f} ({errors[name].abs().mean():.3f})" for name in BY_MOTION if name in errors}
        rows[f"{step.left:g} to {step.right:g} px"] = {"frames": str(len(part.drop_duplicates([*KEY, "frame"])))} | cells
    return pd.DataFrame.from_dict(rows, orient="index")


def order_table(wrong: pd.DataFrame) -> pd.DataFrame:
    """Whether estimates put wrong motions in the order that the truth puts them in."""
    rows = {}
    for name in ESTIMATED:
        own = wrong[wrong["metric"] == name].dropna(subset=["estimate", "truth"])
        if len(own) < 3 or own["truth"].nunique() < 2:
            continue
        apart = RESOLVED[METRICS[name].unit]
        pairs = [in_order for _, episode in own.groupby(["task", "seed", "robot"]) for in_order in _keeps_order(episode, apart)]
        means = list(_keeps_order(own.groupby("case")[["estimate", "truth"]].mean(), apart))
        rows[name] = {
            "Spearman, all videos": f"{spearmanr(own['estimate'], own['truth']).statistic:.3f}",
            "pairs of an episode's videos in order": f"{sum(pairs)} of {len(pairs)}",
            "pairs of mean scores in order": f"{sum(means)} of {len(means)}",
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def _keeps_order(table: pd.DataFrame, apart: float) -> Iterator[bool]:
    """For each two rows whose truths lie so far apart: does the estimate put them in the same order?"""
    for (_, a), (_, b) in combinations(table[["estimate", "truth"]].iterrows(), 2):
        if abs(a["truth"] - b["truth"]) >= apart:
            yield bool((a["truth"] - b["truth"]) * (a["estimate"] - b["estimate"]) > 0)


def as_markdown(table: pd.DataFrame) -> str:
    """A table of texts, its index first."""
    lines = [["", *map(str, table.columns)], ["---"] * (1 + len(table.columns))]
    lines += [[str(name), *map(str, row)] for name, row in zip(table.index, table.to_numpy(), strict=True)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def write(out: Path, text: str, tables: dict[str, pd.DataFrame], name: str = "calibration.md") -> None:
    """Write a text of this name and tables. Raises EpisodeError if the folder cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_text(out / name, text, within=out)
        for key, table in tables.items():
            with replacing(out / f"{key}.parquet", within=out) as temporary:
                table.to_parquet(temporary, index=False)
    except OSError as error:
        raise EpisodeError(f"cannot write the tables to {out}: {error}; choose another --out.") from error
