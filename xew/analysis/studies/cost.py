"""The cost of a study, before anything starts: time, GPU-hours and disk for every kind of step.

`rates.json` has measured rates by the size of the network; `benchmarks/rates.py` writes an entry from a study. Steps that are
done correct the estimates of their kind.
"""

import heapq
import math
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xew.analysis.studies.config import KINDS, Settings, Study, build_experiment
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import TRAININGS, usable_gpus
from xew.analysis.studies.plan import Step, measured_bodies, sort_steps
from xew.config import merge_settings, parse, read_yaml
from xew.files import read_json
from xew.protocol import BASELINES, ROBOT_NAMES, Variant, training_counts

RATES = Path(__file__).with_name("rates.json")
RECIPE: Settings = {"clip": {"frames": 33}, "model": {"size": "small"}, "train": {"batch": 4, "steps": 7500}}
"""Defaults of xew.model's experiments, which the analysis does not import, as far as costs depend on them."""


@dataclass(frozen=True)
class Rates:
    """Measured times [s] and sizes [MB], by network size."""

    machine: str
    measured: str
    """Place and date of the measurement."""
    episode_s: float
    encode_s: float
    """Time to encode one stream of one episode."""
    step_s: float
    """Time of one optimizer step, on the GPUs that a training has."""
    rollout_s: float
    grade_s: float
    """Time to grade one video: a predicted episode, or a baseline's."""
    start_s: float
    """Time from the start of a command to its first real work, with compilation."""
    pair_s: float
    episode_mb: float
    stream_mb: float
    run_mb: float
    rollout_mb: float
    episode_frames: int


@dataclass(frozen=True)
class Cost:
    """The cost of one step."""

    amount: int
    unit: str
    seconds: float
    disk_mb: float = 0.0


def find_size(study: Study) -> str:
    """Key of the size of the study's network."""
    settings = merge_settings(merge_settings(RECIPE, read_yaml(study.experiment)), study.settings)
    return str(settings["model"]["size"])


def find_rates(study: Study) -> Rates:
    """The rates of the size of the study's network; those of the small one where its size was not measured."""
    measured, size = read_json(RATES), find_size(study)
    return parse(Rates, measured.get(size, measured["small"]), f"{RATES}, {size}")


def estimate(study: Study, steps: Mapping[str, Step]) -> dict[str, Cost]:
    """The cost of every step from the study's rates, as if nothing were done."""
    rates, costs = find_rates(study), {}
    tested = study.task_count * study.test_seeds * len(study.graded_robots)
    episodes = study.task_count * study.train_seeds * len(study.trained_robots) + tested
    costs["generate"] = Cost(episodes, "episodes", rates.start_s + episodes * rates.episode_s, episodes * rates.episode_mb)
    encoded: dict[tuple[str, str], int] = {}
    for variant in study.planned_runs:
        experiment = build_experiment(study, variant)
        streams = _count_new_streams(study, variant, experiment, encoded)
        updates, graded = count_optimizer_steps(study, variant, experiment), sum(study.graded_counts(variant).values())
        costs |= {
            f"latents/{variant.name}": Cost(
                streams, "streams", rates.start_s + streams * rates.encode_s, streams * rates.stream_mb
            ),
            f"{'adapt' if variant.target else 'train'}/{variant.name}": Cost(
                updates, "steps", rates.start_s + updates * rates.step_s, rates.run_mb
            ),
            f"rollout/{variant.name}": Cost(
                graded, "episodes", rates.start_s + graded * rates.rollout_s, graded * rates.rollout_mb
            ),
            f"evaluate/{variant.name}": Cost(graded, "videos", rates.start_s + graded * rates.grade_s),
        }
    for name, (run, _) in study.shifted_runs.items():
        count = study.task_count * study.test_seeds * len([robot for robot in run.seen_robots if robot in study.robot_keys])
        costs |= {
            f"generate/{name}": Cost(count, "episodes", rates.start_s + count * rates.episode_s, count * rates.episode_mb),
            f"rollout/{name}": Cost(count, "episodes", rates.start_s + count * rates.rollout_s, count * rates.rollout_mb),
            f"evaluate/{name}": Cost(count, "videos", rates.start_s + count * rates.grade_s),
        }
    videos = tested * len(BASELINES)
    costs["baselines"] = Cost(videos, "videos", rates.start_s + videos * rates.grade_s)
    pairs = math.comb(len(ROBOT_NAMES) + len(measured_bodies(study)), 2)
    costs["distances"] = Cost(pairs, "pairs", 2 * rates.start_s + pairs * rates.pair_s)
    costs["analyse"] = Cost(1, "report", 2 * rates.start_s)
    return {name: costs[name] for name in steps}


def _count_new_streams(study: Study, variant: Variant, experiment: Settings, encoded: dict[tuple[str, str], int]) -> int:
    """Number of streams of single episodes that no earlier variant has encoded."""
    model, new = experiment["model"], 0
    counts = training_counts(variant, study.task_count, study.train_seeds, study.robot_keys)
    for stream in (name for name in ("rgb", model["action"], model["embodiment"]) if name != "none"):
        for robot, count in counts.items():
            key = (robot, stream)
            new += max(0, count - encoded.get(key, 0))
            encoded[key] = max(count, encoded.get(key, 0))
    return new


def count_optimizer_steps(study: Study, variant: Variant, experiment: Settings) -> int:
    """Number of optimizer steps of a training run; `train.epochs` are passes over the chunks of its episodes."""
    experiment = merge_settings(RECIPE, experiment)
    train, clip = experiment["train"], experiment["clip"]
    if not train.get("epochs"):
        return int(train["steps"])
    chunks = -(-(find_rates(study).episode_frames - 1) // (clip["frames"] - 1))
    samples = study.training_count(variant) * max(1, chunks - (train.get("chunks", 1) - 1))
    return max(1, round(float(train["epochs"]) * samples / train["batch"]))


def correct_by_ledger(costs: Mapping[str, Cost], steps: Mapping[str, Step], ledger: Ledger) -> dict[str, float]:
    """Seconds of each step: recorded ones if it is done, else the estimate scaled by its error for that kind."""
    noted: dict[str, float] = {}
    for name, step in steps.items():
        record: Mapping[str, Any] = ledger.record(step) if ledger.outcome(name) else {}
        if "seconds" in record:
            noted[name] = record["seconds"]
    factors = {}
    for kind in KINDS:
        done = [name for name in noted if steps[name].kind == kind]
        if done:
            factors[kind] = sum(noted[name] for name in done) / sum(costs[name].seconds for name in done)
    return {name: noted.get(name, cost.seconds * factors.get(steps[name].kind, 1.0)) for name, cost in costs.items()}


def estimate_wall_seconds(
    steps: Mapping[str, Step], seconds: Mapping[str, float], done: Collection[str], slots: int, steps_per_gpu: int = 1
) -> float:
    """Time to the end if each step starts as soon as it can, the longest critical path first.

    Args:
        steps, seconds: the study's steps and the time of each.
        done: names of steps that need no time.
        slots: number of GPUs, or of steps at once without GPUs.
        steps_per_gpu: number of steps that share a slot, one of them a training run.
    """
    left = {name: {need for need in step.predecessors if need not in done} for name, step in steps.items() if name not in done}
    alone = steps_per_gpu == 1
    pools = {name: "training" if step.kind in TRAININGS or alone else "other" for name, step in steps.items()}
    free = {"training": slots, "other": slots * (steps_per_gpu - 1)}
    paths, now = critical_paths(steps, seconds), 0.0
    running: list[tuple[float, str, int]] = []
    while left or running:
        for name in sorted((name for name, needs in left.items() if not needs), key=lambda name: -paths[name]):
            needed = min(max(1, steps[name].gpus_of(slots)), slots)
            if needed <= free[pools[name]]:
                free[pools[name]] -= needed
                del left[name]
                heapq.heappush(running, (now + seconds[name], name, needed))
        now, ended, needed = heapq.heappop(running)
        free[pools[ended]] += needed
        for needs in left.values():
            needs.discard(ended)
    return now


def critical_paths(steps: Mapping[str, Step], seconds: Mapping[str, float], own: bool = False) -> dict[str, float]:
    """Seconds from the start of each step to the end of the study, with a slot for every step.

    `own` counts only steps of the same variant.
    """
    paths: dict[str, float] = {}
    for step in reversed(sort_steps(steps)):
        followers = [other for other in steps.values() if step.name in other.predecessors]
        after = [paths[other.name] for other in followers if not own or other.variant == step.variant]
        paths[step.name] = seconds[step.name] + max(after, default=0.0)
    return paths


def format_costs(
    study: Study, steps: Mapping[str, Step], costs: Mapping[str, Cost], seconds: Mapping[str, float], ledger: Ledger, slots: int
) -> str:
    """What is left to do, a line per kind of step, and what it takes altogether."""
    on_gpus = bool(usable_gpus(study) or study.machine.ray)
    lines = [f"{'step':<10}{'steps':>7}{'done':>7}{'left to do':>22}{'hours':>9}{'GPU-hours' if on_gpus else '':>11}{'GB':>8}"]
    done = {name for name in steps if ledger.outcome(name)}
    totals = [0.0, 0.0, 0.0]
    for kind in KINDS:
        names = [name for name, step in steps.items() if step.kind == kind]
        left = [name for name in names if name not in done]
        hours = sum(seconds[name] for name in left) / 3600
        gpu_hours = sum(seconds[name] * steps[name].gpus_of(slots) for name in left) / 3600
        disk = sum(costs[name].disk_mb for name in left) / 1000
        totals = [total + value for total, value in zip(totals, (hours, gpu_hours, disk), strict=True)]
        if names:
            amount = f"{sum(costs[name].amount for name in left):,} {costs[names[0]].unit}"
            counts = f"{kind:<10}{len(names):>7}{len(names) - len(left):>7}{amount:>22}"
            lines.append(f"{counts}{hours:>9.2f}{f'{gpu_hours:.2f}' if on_gpus else '':>11}{disk:>8.1f}")
    rates, shared = find_rates(study), study.machine.steps_per_gpu if on_gpus else 1
    wall = estimate_wall_seconds(steps, seconds, done, slots, shared)
    total = f"{'all':<10}{len(steps):>7}{len(done):>7}{'':>22}{totals[0]:>9.2f}"
    lines.append(f"{total}{f'{totals[1]:.2f}' if on_gpus else '':>11}{totals[2]:>8.1f}")
    places = f"{slots} GPUs and {shared} steps on each" if shared > 1 else f"{slots} at once"
    lines.append(f"about {format_duration(wall)} with {places}, by the rates of: {rates.machine} ({rates.measured})")
    free = free_gb(study.out)
    if free < totals[2]:
        lines.append(f"WARNING: {totals[2]:.1f} GB are needed and {free:.1f} GB are free under {study.out}")
    return "\n".join(lines)


def free_gb(folder: Path) -> float:
    """Free space of the disk that a folder is on, or will be on [GB]."""
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free / 1e9


def format_duration(seconds: float) -> str:
    """Text such as '3 h 20 min'."""
    minutes = round(seconds / 60)
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
