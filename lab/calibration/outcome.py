"""The command that measures the judge of outcomes: judged against true progress in videos whose outcome is known.

Reads  a data set, of validation seeds and training robots
Writes <out>/outcome.md (tables by task and robot) and outcome.parquet (a row for each episode, case and frame)

Cases: the true video, through a codec if one is named; and a render in which no object moves, through H.264.
The rules, written before any result: the judge keeps a task if Pearson's r of judged and true progress is at least LEAST_R over
INSTANTS frames of each video. A video shows success from the progress on, of CANDIDATES, that gives most right verdicts over
these frames of kept tasks; of equals, the middle one, or the lower of two.

    python -m lab.calibration.outcome --data data --codec configs/fixed.yaml --out calibration
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro
from tqdm import tqdm

from lab.calibration.calibrate import CommonArgs, Row, as_markdown, choose, write
from lab.calibration.perturbations import render_perturbation
from lab.calibration.predictors import hold_objects, through_h264
from xew.config import admit, user_errors
from xew.dataset import demand_one_motion, find_accepted
from xew.episode import EpisodeError, Record
from xew.files import hold_lock
from xew.metrics.backends import Tracker, open_masker, open_tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.grade import Comparison
from xew.metrics.grading.codecs import ModelCodec, open_codecs
from xew.metrics.outcome.measures import SHOWN
from xew.metrics.truth import Truth, read_truth
from xew.statistics import pearson

INSTANTS = 8
"""Number of frames of each video, equally far apart, the last one among them."""
LEAST_R = 0.9
"""Least r of judged and true progress of a task that the judge keeps."""
CANDIDATES = tuple(round(0.5 + 0.05 * step, 2) for step in range(11))
"""Progress from which on a video may show success."""


@dataclass(frozen=True)
class Args(CommonArgs):
    """Calibrate the judge of outcomes on a data set of `xew.sim_warp.generate`; without a codec videos go through H.264."""


@user_errors
def main(args: Args) -> None:
    """Judge, write, and print the tables."""
    admit(args.trust)
    tracker = open_tracker(args.tracks, args.tracks_checkpoint)
    codec = next(iter(open_codecs([args.codec]).values())) if args.codec else None
    episodes = find_accepted(args.data)
    demand_one_motion(args.data, [record for _, record in episodes])
    with hold_lock(args.out):
        chosen = tqdm(choose(episodes, args), unit="episode")
        rows = [row for episode in chosen for row in judge_episode(*episode, tracker, codec)]
        table = pd.DataFrame(rows)
        text = report(table)
        write(args.out, text, {"outcome": table}, "outcome.md")
    print(text)


def judge_episode(folder: Path, record: Record, tracker: Tracker, codec: ModelCodec | None) -> list[Row]:
    """Rows of an episode: task seed robot case frame true judged. Raises EpisodeError if its scene is not known."""
    truth = read_truth(folder, record.frame_count, ("outcome", "object_points"), record=record)
    if truth.outcome is None:
        raise EpisodeError(f"{folder}: its scene is not known, so its outcome cannot be judged; leave it out: --seeds.")
    key: Row = {"task": record.task, "seed": record.seed, "robot": record.robot}
    video = through_h264(truth.rgb) if codec is None else codec.reconstruct(folder, truth.rgb)
    rows = [key | {"case": "truth"} | row for row in judge_video(video, truth, tracker)]
    still = hold_objects(truth.outcome.states)
    video = through_h264(render_perturbation(folder, still).rgb)
    wrong = [replace(truth.outcome, states=still).true_progress(frame) for frame in instants(len(video))]
    judged = judge_video(video, truth, tracker)
    return rows + [key | {"case": "object at rest"} | row | {"true": true} for row, true in zip(judged, wrong, strict=True)]


def instants(frames: int) -> list[int]:
    """Numbers of INSTANTS frames of a video of so many."""
    return [round(share * (frames - 1)) for share in np.arange(1, INSTANTS + 1) / INSTANTS]


def judge_video(video: np.ndarray, truth: Truth, tracker: Tracker) -> Iterator[Row]:
    """frame true judged: progress in frames of a video [t h w 3] uint8, and of the truth."""
    outcome, frames = truth.outcome, instants(len(video))
    assert outcome is not None
    poses = Comparison(video, EpisodeCache(truth), open_masker("opencv"), tracker).judged_poses
    for frame in frames:
        yield {"frame": frame, "true": outcome.true_progress(frame), "judged": outcome.progress(poses[frame], frame)}


def report(rows: pd.DataFrame) -> str:
    """All tables in Markdown."""
    kept = kept_tasks(rows)
    parts = [
        f"Judged and true progress in {INSTANTS} frames of each of {len(rows) // INSTANTS} videos. Kept are {len(kept)} of "
        f"{rows['task'].nunique()} tasks, whose r is at least {LEAST_R}: {', '.join(kept)}.",
        f"Success is shown from {best_threshold(rows[rows['task'].isin(kept)])} on (metrics use {SHOWN}).",
        "### By task",
        as_markdown(agreement_table(rows, "task")),
        "### By robot, of kept tasks",
        as_markdown(agreement_table(rows[rows["task"].isin(kept)], "robot")),
        "### By case, of kept tasks",
        as_markdown(agreement_table(rows[rows["task"].isin(kept)], "case")),
    ]
    return "\n\n".join(parts) + "\n"


def kept_tasks(rows: pd.DataFrame) -> list[str]:
    """Tasks whose r of judged and true progress is at least LEAST_R; not those whose progress does not vary."""
    return [str(task) for task, own in rows.groupby("task") if correlation(own) >= LEAST_R]


def correlation(rows: pd.DataFrame) -> float:
    """Pearson's r of judged and true progress."""
    return float(pearson(rows["judged"].to_numpy(), rows["true"].to_numpy()))


def best_threshold(rows: pd.DataFrame) -> float:
    """The one of CANDIDATES that gives most right verdicts; of equals, the middle one, or the lower of two."""
    right = [((rows["judged"] >= shown) == (rows["true"] >= 1)).mean() for shown in CANDIDATES]
    best = np.flatnonzero(np.isclose(right, max(right)))
    return CANDIDATES[best[(len(best) - 1) // 2]]


def agreement_table(rows: pd.DataFrame, by: str) -> pd.DataFrame:
    """r, mean absolute error of progress, and the confusion matrix of success, for each value of a column."""
    table: dict[str, dict[str, Any]] = {}
    for name, own in rows.groupby(by, sort=False):
        judged, true = own["judged"] >= SHOWN, own["true"] >= 1
        table[str(name)] = {
            "r": f"{correlation(own):.3f}",
            "progress error": f"{(own['judged'] - own['true']).abs().mean():.3f}",
            "success, judged so": str((true & judged).sum()),
            "success, judged failure": str((true & ~judged).sum()),
            "failure, judged success": str((~true & judged).sum()),
            "failure, judged so": str((~true & ~judged).sum()),
        }
    return pd.DataFrame.from_dict(table, orient="index")


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m lab.calibration.outcome"))
