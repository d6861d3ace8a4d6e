"""The command that measures the judge of outcomes: judged against true progress in videos whose outcome is known.

Reads  a data set, of validation seeds and training robots; with faulty episodes both outcomes occur in true videos
Writes <out>/outcome.md (tables by task, robot and case) and outcome.parquet (a row for each episode, case and frame), every
       minute: run it again to go on where it stopped
       <data>-surfaces/, the points on surfaces, as `xew.metrics.evaluate` does

Cases: the true video, through a codec if one is named; a render in which no object moves, through H.264; and of faulty commands
a render in which objects move as under the expert's, as a model that has only seen success might show it.
The rules, written before any result:
* The judge has power on a task, and keeps it, if Pearson's r of judged and true progress is at least LEAST_R over INSTANTS
  frames of each video, all robots and the first two cases together. All other tasks are left out for all models
  (`judge.UNJUDGED`), those whose progress does not vary too.
* A video shows success from the progress on, of CANDIDATES, that gives most right verdicts over these frames of kept tasks; of
  equals, the middle one, or the lower of two.

    python -m lab.calibration.outcome --data data --codec configs/fixed.yaml --out calibration
"""

import functools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro
from tqdm import tqdm

from lab.calibration.calibrate import KEY, CommonArgs, Episode, Row, as_markdown, choose, write
from lab.calibration.perturbations import render_perturbation
from lab.calibration.predictors import hold_objects, through_h264
from xew.concurrency import map_in_processes, visible_gpus
from xew.config import ConfigError, user_errors
from xew.dataset import demand_one_motion, find_accepted
from xew.episode import EpisodeError, Record, States, data_folder, episode_folder, read_states
from xew.files import hold_lock
from xew.metrics.backends import Tracker, identity, open_masker, open_tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.evaluate import SECONDS_IN_LOGS
from xew.metrics.grade import Comparison
from xew.metrics.grading.codecs import ModelCodec, open_codecs
from xew.metrics.grading.open_graders import IMPORTED, choose_processes, prepare_process
from xew.metrics.grading.scores import surfaces_folder
from xew.metrics.outcome.judge import UNJUDGED
from xew.metrics.outcome.measures import SHOWN
from xew.metrics.outcome.variants import INSTANTS, instants
from xew.metrics.truth import Truth, read_truth
from xew.protocol import GRADING_PROTOCOL, HELD_OUT_ROBOTS, split_fault
from xew.statistics import pearson

LEAST_R = 0.9
"""Least r of judged and true progress of a task that the judge keeps."""
CANDIDATES = tuple(round(0.5 + 0.05 * step, 2) for step in range(11))
"""Progress from which on a video may show success."""
CASES = ("truth", "object at rest", "objects of the expert")
"""Videos of each episode; the last one of faulty episodes only."""
OF_RULES = CASES[:2]
"""The cases that the rules are about."""
SECONDS_BETWEEN_WRITES = 60.0


@dataclass(frozen=True)
class Args(CommonArgs):
    """Calibrate the judge of outcomes on a data set of `xew.sim_warp.generate`; without a codec videos go through H.264."""

    robots: tuple[str, ...] = ()
    """Only episodes of these robots; left out: all robots but Franka and Piper, by which nothing is chosen."""


@user_errors
def main(args: Args) -> None:
    """Judge, write, and print the tables."""
    prepare_process(args.trust)
    episodes = find_accepted(args.data)
    demand_one_motion(args.data, [record for _, record in episodes])
    with hold_lock(args.out):
        chosen, codec = choose(of_robots(episodes, args), args), _open_codec(args)
        made_by = {
            "protocol": GRADING_PROTOCOL,
            "tracks": identity(args.tracks, args.tracks_checkpoint),
            "codec": codec.digest if codec else "H.264",
            "cases": list(CASES),
        }
        rows = read_earlier(args.out / "outcome.parquet", made_by, chosen)
        done = {row["content"] for row in rows}
        todo = [episode for episode in chosen if content(episode[1]) not in done]
        print(f"{len(chosen) - len(todo)} of {len(chosen)} episodes are judged already", flush=True)
        written = time.monotonic()
        interval = 0.1 if sys.stderr.isatty() else SECONDS_IN_LOGS
        for own in tqdm(judge_all(args, todo), total=len(todo), desc="judge", unit="episode", mininterval=interval):
            rows += own
            if time.monotonic() - written > SECONDS_BETWEEN_WRITES:
                written = time.monotonic()
                write_rows(args.out, rows, made_by)
        print(write_rows(args.out, rows, made_by))


def write_rows(out: Path, rows: Sequence[Row], made_by: Row) -> str:
    """Write rows and their tables, and return these in Markdown."""
    table = pd.DataFrame(rows)
    table.attrs.update(made_by)
    text = report(table)
    write(out, text, {"outcome": table}, "outcome.md")
    return text


def of_robots(episodes: Sequence[Episode], args: Args) -> list[Episode]:
    """The episodes of the robots asked for. Raises ConfigError if there are none."""
    held = sorted({record.robot for _, record in episodes})
    robots = args.robots or [robot for robot in held if robot not in HELD_OUT_ROBOTS]
    if lacking := [robot for robot in robots if robot not in held] or ([] if robots else ["robot to choose by"]):
        raise ConfigError(f"{args.data} has no {lacking[0]}; it has {', '.join(held)}: --robots.")
    return [episode for episode in episodes if episode[1].robot in robots]


def content(record: Record) -> str:
    """What says which episode rows are of."""
    return record.hashes["rgb"]


def read_earlier(path: Path, made_by: Row, episodes: Sequence[Episode]) -> list[Row]:
    """Rows of these episodes that an earlier run has written by the same means."""
    table = pd.read_parquet(path) if path.exists() else pd.DataFrame()
    if table.attrs != made_by:
        return []
    known = table[table["content"].isin([content(record) for _, record in episodes])]
    return [dict(zip(map(str, known.columns), row, strict=True)) for row in known.itertuples(index=False)]


def judge_all(args: Args, episodes: Sequence[Episode]) -> Iterator[list[Row]]:
    """Rows of each episode, in order, from as many processes as suit the machine."""
    opener = functools.partial(_open_judge, args)
    processes = choose_processes(len(episodes), len(CASES) * len(episodes)) if episodes else 1
    if processes > 1:
        return map_in_processes(opener, episodes, processes, IMPORTED, visible_gpus())
    return map(opener(), episodes)


def _open_judge(args: Args) -> Callable[[Episode], list[Row]]:
    """The function of an episode to its rows."""
    prepare_process(args.trust)
    tracker, codec = open_tracker(args.tracks, args.tracks_checkpoint), _open_codec(args)
    surfaces = surfaces_folder(args.data, args.out / "outcome.parquet")
    return lambda episode: judge_episode(*episode, tracker, codec, surfaces)


def _open_codec(args: Args) -> ModelCodec | None:
    return next(iter(open_codecs([args.codec]).values())) if args.codec else None


def judge_episode(
    folder: Path, record: Record, tracker: Tracker, codec: ModelCodec | None, surfaces: Path | None = None
) -> list[Row]:
    """Rows of an episode: KEY, content frame true judged. Raises EpisodeError if its scene is not known."""
    truth = read_truth(folder, record.frame_count, ("outcome", "object_points"), surfaces, record)
    if truth.outcome is None:
        raise EpisodeError(f"{folder}: its scene is not known, so its outcome cannot be judged; leave it out: --seeds.")
    key: Row = {"task": record.task, "seed": record.seed, "robot": record.robot, "content": content(record)}
    video = through_h264(truth.rgb) if codec is None else codec.reconstruct(folder, truth.rgb)
    rows = [key | {"case": CASES[0]} | row for row in judge_video(video, truth, tracker)]
    for case, states in zip(CASES[1:], change_objects(folder, record, truth.outcome.states), strict=False):
        video = through_h264(render_perturbation(folder, states).rgb)
        wrong = [replace(truth.outcome, states=states).true_progress(frame) for frame in instants(len(video))]
        judged = judge_video(video, truth, tracker)
        rows += [key | {"case": case} | row | {"true": true} for row, true in zip(judged, wrong, strict=True)]
    return rows


def change_objects(folder: Path, record: Record, states: States) -> Iterator[States]:
    """States of an episode whose objects stay where they began; of a faulty one also those that move as the expert's do."""
    yield hold_objects(states)
    number, base = split_fault(record.seed)
    expert = episode_folder(data_folder(folder), record.task, base, record.robot)
    if number and expert.is_dir():
        other = read_states(expert)
        then = np.minimum(np.arange(states.frame_count), other.frame_count - 1)
        yield replace(states, **{name: getattr(other, name)[then] for name in ("object_pose", "object_joint", "contact")})


def judge_video(video: np.ndarray, truth: Truth, tracker: Tracker) -> Iterator[Row]:
    """frame true judged: progress in frames of a video [t h w 3] uint8, and of the truth."""
    outcome, frames = truth.outcome, instants(len(video))
    assert outcome is not None
    poses = Comparison(video, EpisodeCache(truth), open_masker("opencv"), tracker).judged_poses
    for frame in frames:
        yield {"frame": frame, "true": outcome.true_progress(frame), "judged": outcome.progress(poses[frame], frame)}


def report(rows: pd.DataFrame) -> str:
    """All tables in Markdown."""
    every, rows = rows, rows[rows["case"].isin(OF_RULES)]
    by_task = {str(task): _correlation_text(own) for task, own in rows.groupby("task")}
    names = kept_tasks(rows)
    kept, left_out = rows[rows["task"].isin(names)], [task for task in by_task if task not in names]
    odd = sorted(set(UNJUDGED) & set(names) | set(left_out) - set(UNJUDGED))
    videos = every[KEY].drop_duplicates()
    tables = {
        "By task": agreement_table(rows, ["task"]),
        "By robot, of kept tasks": agreement_table(kept, ["robot"]),
        "By case, of kept tasks": agreement_table(every[every["task"].isin(names)], ["case"]),
        "Pearson's r by task and robot": correlation_table(rows),
        "By task and robot": agreement_table(rows, ["task", "robot"]),
    }
    parts = [
        f"Judged and true progress in {INSTANTS} frames of each of {len(videos)} videos, of {rows['content'].nunique()} "
        f"episodes. Successes and failures are counted in the last frame of each video. All but the table by case is of "
        f"{' and '.join(OF_RULES)}.",
        f"Kept are {len(names)} of {len(by_task)} tasks, whose r is at least {LEAST_R}: {', '.join(names) or 'none'}.",
        f"Left out are: {', '.join(f'{task} (r {by_task[task]})' for task in left_out) or 'none'}.",
        f"The metrics' list of tasks that are left out (UNJUDGED) is wrong about: {', '.join(odd) or 'none'}.",
        f"Success is shown from {best_threshold(kept)} on (metrics use {SHOWN})." if names else "",
        *(part for title, table in tables.items() if len(table) for part in (f"### {title}", as_markdown(table))),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def kept_tasks(rows: pd.DataFrame) -> list[str]:
    """Tasks whose r of judged and true progress is at least LEAST_R; not those whose progress does not vary."""
    return [str(task) for task, own in rows.groupby("task") if correlation(own) >= LEAST_R]


def correlation(rows: pd.DataFrame) -> float:
    """Pearson's r of judged and true progress."""
    return float(pearson(rows["judged"].to_numpy(), rows["true"].to_numpy()))


def _correlation_text(rows: pd.DataFrame) -> str:
    r = correlation(rows)
    return "-" if np.isnan(r) else f"{r:.3f}"


def best_threshold(rows: pd.DataFrame) -> float:
    """The one of CANDIDATES that gives most right verdicts; of equals, the middle one, or the lower of two."""
    right = [((rows["judged"] >= shown) == (rows["true"] >= 1)).mean() for shown in CANDIDATES]
    best = np.flatnonzero(np.isclose(right, max(right)))
    return CANDIDATES[best[(len(best) - 1) // 2]]


def agreement_table(rows: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """r, mean absolute error of progress, and the confusion matrix of success in last frames, for each value of columns."""
    table: dict[str, dict[str, Any]] = {}
    for names, own in rows.groupby(list(by)):
        last = own.loc[own.groupby(KEY)["frame"].idxmax()]
        judged, true = last["judged"] >= SHOWN, last["true"] >= 1
        table[" ".join(map(str, names))] = {
            "r": _correlation_text(own),
            "progress error": f"{(own['judged'] - own['true']).abs().mean():.3f}",
            "success, judged so": str((true & judged).sum()),
            "success, judged failure": str((true & ~judged).sum()),
            "failure, judged success": str((~true & judged).sum()),
            "failure, judged so": str((~true & ~judged).sum()),
        }
    return pd.DataFrame.from_dict(table, orient="index")


def correlation_table(rows: pd.DataFrame) -> pd.DataFrame:
    """r of each task (rows) with each robot (columns)."""
    table = {key: _correlation_text(own) for key, own in rows.groupby(["task", "robot"])}
    return pd.Series(table).unstack().fillna("")


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m lab.calibration.outcome"))
