"""The cost of a study: time, GPU-hours and disk for every kind of step, from measured rates, before anything starts.

Where steps of a kind are done in this study already, the others of that kind are estimated by how long those took.
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
from xew.protocol import BASELINES, ROBOT_NAMES, Variant, training_counts


@dataclass(frozen=True)
class Cost:
    """The cost of one step."""

    amount: int
    """Amount of work, in `unit`."""
    unit: str
    seconds: float
    disk_mb: float = 0.0


def estimate(study: Study, steps: Mapping[str, Step]) -> dict[str, Cost]:
    """The cost of every step from the study's rates, as if nothing were done."""
    rates, costs = study.rates, {}
    tested = study.task_count * study.test_seeds * len(study.graded_robots)
    episodes = study.task_count * study.train_seeds * len(study.trained_robots) + tested
    costs["generate"] = Cost(episodes, "episodes", rates.start_s + episodes * rates.episode_s, episodes * rates.episode_mb)
    encoded: dict[tuple[str, ...], int] = {}
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
    videos = tested * len(BASELINES)
    costs["baselines"] = Cost(videos, "videos", rates.start_s + videos * rates.grade_s)
    pairs = math.comb(len(ROBOT_NAMES) + len(measured_bodies(study)), 2)
    costs["distances"] = Cost(pairs, "pairs", 2 * rates.start_s + pairs * rates.pair_s)
    costs["analyse"] = Cost(1, "report", 2 * rates.start_s)
    return {name: costs[name] for name in steps}


def _count_new_streams(study: Study, variant: Variant, experiment: Settings, encoded: dict[tuple[str, ...], int]) -> int:
    """Number of streams of single episodes that no earlier variant has encoded."""
    model, new = experiment["model"], 0
    counts = training_counts(variant, study.task_count, study.train_seeds, study.robot_keys)
    for stream in (name for name in ("rgb", model["action"], model["embodiment"]) if name != "none"):
        for robot, count in counts.items():
            new += max(0, count - encoded.get((robot, stream), 0))
            encoded[robot, stream] = max(count, encoded.get((robot, stream), 0))
    return new


def count_optimizer_steps(study: Study, variant: Variant, experiment: Settings) -> int:
    """Number of optimizer steps of a training.

    `train.epochs` are passes over its samples, of which an episode gives as many as it has chunks.
    """
    train, clip = experiment["train"], experiment["clip"]
    if not train.get("epochs"):
        return int(train.get("steps", 0))
    chunks = -(-(study.rates.episode_frames - 1) // (clip["frames"] - 1))
    samples = study.training_count(variant) * max(1, chunks - (train.get("chunks", 1) - 1))
    return max(1, round(float(train["epochs"]) * samples / train["batch"]))


def correct_by_ledger(costs: Mapping[str, Cost], steps: Mapping[str, Step], ledger: Ledger) -> dict[str, float]:
    """Seconds of each step: as the ledger has them of what is done, else the estimate scaled by its error for that kind."""
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
    steps: Mapping[str, Step], seconds: Mapping[str, float], done: Collection[str], slots: int, beside: int = 0
) -> float:
    """Time to the end, with each step started as soon as it can be, the longest critical path first.

    Args:
        steps: of the study.
        seconds: that each takes.
        done: names of steps that need no time.
        slots: number of GPUs, or of steps at once where there is none.
        beside: number of other steps that share a GPU with its training; 0 where every step has a slot for itself. Trainings
            that share a GPU count as one after another, since each then takes as much longer.
    """
    left = {name: {need for need in step.predecessors if need not in done} for name, step in steps.items() if name not in done}
    pools = {name: "training" if step.kind in TRAININGS or not beside else "beside" for name, step in steps.items()}
    free = {"training": slots, "beside": slots * beside}
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
    """Seconds from the start of each step to the end of the study if there were a slot for every step.

    With `own` to the end of the step's own variant: without the steps of others, and of a step that serves all, alone.
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
    beside = study.machine.beside if on_gpus else 0
    wall = estimate_wall_seconds(steps, seconds, done, slots, beside)
    total = f"{'all':<10}{len(steps):>7}{len(done):>7}{'':>22}{totals[0]:>9.2f}"
    lines.append(f"{total}{f'{totals[1]:.2f}' if on_gpus else '':>11}{totals[2]:>8.1f}")
    shared = f"{slots} GPUs and {beside} steps beside a training" if beside else f"{slots} at once"
    lines.append(f"about {format_duration(wall)} with {shared}, by the rates of: {study.rates.measured_on}")
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
