"""A study's score table without a study: numbers like the paper's, scattered over scenes, for every variant or some."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from xew.analysis.paper import AXES, Paper, read_paper
from xew.analysis.statistics.grades import SEEN, row_keys
from xew.analysis.tables.labels import PAPER_METRICS
from xew.metrics import METRICS
from xew.protocol import HELD_OUT_ROBOTS, PARTS, ROBOT_NAMES, TEST_SEED_START, VARIANTS, Variant

TASKS = ("place_empty_cup", "open_laptop", "stamp_seal", "lift_pot")
FRAMES = 9
OF_THE_PAPER = tuple(name for name, variant in VARIANTS.items() if set(variant.graded_robots) <= set(ROBOT_NAMES))
"""Names of the variants that are graded on the five robots alone."""
PERFECT = {"psnr": 100.0, "ssim": 1.0, "mask_iou": 0.97, "boundary_f1": 0.96, "pck": 0.95, "keypoint_error": 1.2, "ndtw": 0.01}
PERFECT |= {"trajectory_error": 0.9, "lpips": 0.0, "region_lpips": 0.0}
FROZEN = {"psnr": 19.0, "ssim": 0.85, "mask_iou": 0.4, "boundary_f1": 0.25, "pck": 0.2, "keypoint_error": 38.0, "ndtw": 0.24}
FROZEN |= {"trajectory_error": 18.0, "lpips": 0.2, "region_lpips": 0.3}


def write_study(
    path: Path, variants: Sequence[str] = OF_THE_PAPER, tasks: Sequence[str] = TASKS, seeds: int = 3, spread: float = 0.04
) -> Path:
    """Write a merged score table and its curves.

    Every scene is harder or easier by the same share for all; what is left scatters by `spread` of a mean.
    """
    rng = np.random.default_rng(0)
    paper, scenes = read_paper(), [(task, TEST_SEED_START + i) for task in tasks for i in range(seeds)]
    hardness = rng.normal(0, 0.15, len(scenes))
    models = [(name, "reference", name, robot, _means(paper, VARIANTS[name], robot)) for name in variants
              for robot in VARIANTS[name].graded_robots]  # fmt: skip
    models += [("", "copy_first_frame", "", robot, FROZEN) for robot in ROBOT_NAMES]
    models += [("", "ground_truth", "", robot, PERFECT) for robot in ROBOT_NAMES]
    parts = []
    for variant, model, condition, robot, means in models:
        base = np.array([means[metric] for metric in PAPER_METRICS])
        harder = np.array([-1 if METRICS[metric].higher_is_better else 1 for metric in PAPER_METRICS])
        scatter = hardness[:, None] * harder + rng.normal(0, spread, (len(scenes), len(PAPER_METRICS)))
        limit = np.array([min(METRICS[metric].range[1], 200) for metric in PAPER_METRICS])
        values = base if model == "ground_truth" else np.clip(base * (1 + scatter), 0, limit)
        table = pd.DataFrame(np.broadcast_to(values, (len(scenes), len(base))), columns=list(PAPER_METRICS))
        table[["task", "seed"]] = scenes
        table = table.melt(["task", "seed"], var_name="metric").assign(
            variant=variant, model=model, condition=condition, robot=robot
        )
        parts.append(table)
    rows = pd.concat(parts, ignore_index=True).assign(frames=FRAMES, exact_frames=0)
    curves = rows[rows["metric"].isin(["lpips", "psnr", "mask_iou"])].merge(
        pd.DataFrame({"frame": np.arange(1, FRAMES)}), how="cross"
    )
    curves["value"] *= 0.6 + 0.8 * (curves["frame"] - 1) / (FRAMES - 2)
    rows.attrs = attributes()
    rows.to_parquet(path, index=False)
    curves.drop(columns=["frames", "exact_frames"]).to_parquet(path.with_suffix(".curves.parquet"), index=False)
    return path


def attributes() -> dict[str, object]:
    """What `evaluate` says of its table."""
    metrics = {
        name: {
            "dimension": METRICS[name].dimension,
            "unit": METRICS[name].unit,
            "higher_is_better": METRICS[name].higher_is_better,
            "low": None if np.isinf(METRICS[name].range[0]) else METRICS[name].range[0],
            "high": None if np.isinf(METRICS[name].range[1]) else METRICS[name].range[1],
            "reference": METRICS[name].reference,
            "title": METRICS[name].title,
            "estimated": METRICS[name].estimated,
            "suites": [],
            "counterpart": "",
            "reported": True,
        }
        for name in PAPER_METRICS
    }
    return {"protocol": 1, "metrics": metrics, "versions": {"xew": "test"}}


def _means(paper: Paper, variant: Variant, robot: str) -> dict[str, float]:
    """The paper's means of a variant and robot where it prints them, else of one like it."""
    for group in (robot, *([] if robot in HELD_OUT_ROBOTS else [SEEN])):  # where the paper prints it
        for part, variants in PARTS.items():
            for row in row_keys(part, variant) if variant in variants else []:
                found = {metric: paper.score(part, row, group, metric) for metric in PAPER_METRICS}
                if None not in found.values():
                    return {metric: float(value) for metric, value in found.items() if value is not None}
    # A fold that saw a robot draws it as well as any other that it saw.
    group = robot if robot in variant.held_out_robots and robot in HELD_OUT_ROBOTS else SEEN
    like = {metric: paper.score("actions", "optical_flow", group, metric) for metric in PAPER_METRICS}
    if variant.remedy != "full":
        like = {metric: paper.score("forgetting", "none", "ur5_wsg", metric) for metric in PAPER_METRICS}
    printed = {metric: paper.score("baselines", variant.system, group, metric) for metric in PAPER_METRICS}
    return {metric: float(printed[metric] or like[metric] or 0) for metric in PAPER_METRICS}


def paper_axes(paper: Paper) -> dict[str, np.ndarray]:
    """The printed mean distances by axis, in the order of ROBOT_NAMES."""
    return {axis: np.array([getattr(paper.robots[robot], axis) for robot in ROBOT_NAMES]) for axis in AXES}
