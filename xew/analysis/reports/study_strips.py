"""Strips of a study: one scene and moment under several variants, robots down and conditions across."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from xew.analysis.reports import pictures
from xew.analysis.scores import VARIANT, Scores
from xew.analysis.statistics.grades import find_variant
from xew.analysis.tables.labels import ACTIONS, LADDER, ROBOT_TITLES, SHORT_ROBOTS, SYSTEMS
from xew.config import ConfigError
from xew.episode import episode_folder, read_pixels
from xew.protocol import HELD_OUT_ROBOTS, ROBOT_NAMES, SHOTS, VARIANTS
from xew.rollout import Rollout, find_rollouts, read_as_graded

RANKED_BY = "lpips"
"""Metric by which the median scene is found."""
Videos = dict[tuple[str, str, int, str], Rollout]


@dataclass(frozen=True)
class Strip:
    """A sheet of frames with its labels."""

    image: bytes
    caption: str
    columns: Sequence[str]
    rows: Sequence[str]

    @property
    def labeled_caption(self) -> str:
        """The caption with the labels, for pages that cannot set labels next to a picture."""
        return f"{self.caption} From the left: {', '.join(self.columns)}; from the top: {', '.join(self.rows)}."


def study_strips(scores: Scores, data: Path, videos: Videos) -> dict[str, Strip]:
    """A strip for each comparison of which at least two variants can be shown, of the scene with the median LPIPS."""
    adapted = {f"M = {shots}": {robot: f"{robot}-{shots}" for robot in HELD_OUT_ROBOTS} for shots in (0, *SHOTS)}
    others = dict(zip(ROBOT_NAMES, (*ROBOT_NAMES[1:], ROBOT_NAMES[0]), strict=True))
    wanted = {
        "actions": {label: dict.fromkeys(HELD_OUT_ROBOTS, row) for row, label in ACTIONS.items()},
        "ladder": {label: dict.fromkeys(HELD_OUT_ROBOTS, row) for row, label in LADDER.items()},
        "few_shot": adapted,
        "loeo": {
            "model that never saw the robot": {robot: f"loeo_{robot}" for robot in ROBOT_NAMES},
            "model that did": {robot: f"loeo_{other}" for robot, other in others.items()},
        },
        "baselines": {label: dict.fromkeys(HELD_OUT_ROBOTS, row) for row, label in SYSTEMS.items()},
    }
    strips = {part: _make_strip(part, columns, scores, data, videos) for part, columns in wanted.items()}
    return {part: strip for part, strip in strips.items() if strip is not None}


def median_episodes(
    variants: Mapping[str, str], rows: pd.DataFrame, data: Path, videos: Videos
) -> dict[str, tuple[Path, Rollout]]:
    """By the robot's title: folder and rollout of the episode with the median LPIPS, for a variant of each robot's key."""
    episodes = {}
    for robot, variant in variants.items():
        graded = rows[(rows["metric"] == RANKED_BY) & (rows[VARIANT] == variant) & (rows["robot"] == robot)]
        scenes = graded.sort_values(["value", "task", "seed"])[["task", "seed"]].itertuples(index=False, name=None)
        keys = [key for task, seed in scenes if (key := (variant, task, seed, robot)) in videos]
        if keys:
            _, task, seed, _ = key = keys[len(keys) // 2]
            episodes[ROBOT_TITLES[robot]] = episode_folder(data, task, seed, robot), videos[key]
    return episodes


def find_videos(folders: Sequence[Path]) -> Videos:
    """All rollouts of variants in trees that are named after them, or in folders of such trees.

    Raises:
        ConfigError: none of the folders holds a variant's rollouts.
    """
    trees = {tree.name: tree for folder in folders for tree in (folder, *_children(folder)) if tree.name in VARIANTS}
    if not trees:
        raise ConfigError(
            f"no folder {', '.join(map(str, folders))} is named after a variant or holds one that is, such as "
            f"{next(iter(VARIANTS))}; name the folder of the study's rollouts."
        )
    return {
        (name, rollout.task, rollout.seed, rollout.robot): rollout
        for name, tree in trees.items()
        for rollout in find_rollouts(tree)
    }


def _children(folder: Path) -> list[Path]:
    return sorted(child for child in folder.iterdir() if child.is_dir()) if folder.is_dir() else []


def _make_strip(
    part: str, columns: Mapping[str, Mapping[str, str]], scores: Scores, data: Path, videos: Videos
) -> Strip | None:
    """Observed frame and all variants of a part, for each of its robots; None where fewer than two can be shown."""
    names = {
        label: {robot: find_variant(part, row).name for robot, row in by_robot.items()} for label, by_robot in columns.items()
    }
    scene = _median_scene(names, scores.rows, videos)
    if scene is None:
        return None
    task, seed, robots = scene
    labels = [label for label, by_robot in names.items() if all((by_robot[r], task, seed, r) in videos for r in robots)]
    shown = []
    for robot in robots:
        truth = read_pixels(episode_folder(data, task, seed, robot), "rgb")
        predicted = [videos[names[label][robot], task, seed, robot] for label in labels]
        shown.append([truth, *(read_as_graded(rollout, truth, scores.frame_zero != "absent") for rollout in predicted)])
    moment = min(len(video) for row in shown for video in row) - 1
    caption = f"{task.replace('_', ' ')}, seed {seed}, frame {moment}: the scene with the median LPIPS."
    image = pictures.encode_png(pictures.sheet([[video[moment] for video in row] for row in shown]))
    return Strip(image, caption, ["observed", *labels], [SHORT_ROBOTS[robot] for robot in robots])


def _median_scene(
    names: Mapping[str, Mapping[str, str]], rows: pd.DataFrame, videos: Videos
) -> tuple[str, int, list[str]] | None:
    """Task, seed and robots: of the scenes that most variants show on most robots, the one in the middle by LPIPS."""
    shown = {name for by_robot in names.values() for name in by_robot.values()}
    robots = list(dict.fromkeys(robot for by_robot in names.values() for robot in by_robot))
    chosen = rows[(rows["metric"] == RANKED_BY) & rows[VARIANT].isin(shown) & rows["robot"].isin(robots)]
    keys = zip(chosen[VARIANT], chosen["task"], chosen["seed"], chosen["robot"], strict=True)
    chosen = chosen[np.array([key in videos for key in keys], bool)]
    if chosen[VARIANT].nunique() < 2:
        return None
    scenes = chosen.groupby(["task", "seed"])["value"].agg(["size", "mean"]).reset_index()
    full = scenes[scenes["size"] == scenes["size"].max()].sort_values(["mean", "task", "seed"])
    middle = full.iloc[len(full) // 2]
    there = chosen[(chosen["task"] == middle["task"]) & (chosen["seed"] == middle["seed"])]
    return str(middle["task"]), int(middle["seed"]), [robot for robot in robots if robot in set(there["robot"])]
