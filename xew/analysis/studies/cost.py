"""The cost of a study, before anything starts: time, GPU-hours and disk for every kind of step.

Rates are measured on this machine, or documented (`rates.py`). Steps that are done correct the estimates of their kind.
"""

import heapq
import math
import shutil
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xew.analysis.studies.config import KINDS, RECIPE, Settings, Study, build_experiment
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import usable_gpus
from xew.analysis.studies.plan import Step, count_gpus, count_sharing, generate_name, measured_bodies, sort_steps
from xew.analysis.studies.rates import Rate, Source, find_rates
from xew.config import merge_settings, pick, read_yaml
from xew.model.conditions import ACTIONS, CONDITIONS, list_conditions
from xew.protocol import BASELINES, ROBOT_NAMES, Variant, training_counts

OWN_TOKENS = ("action", "embodiment")
"""Streams of the network that have as many tokens as the video; other conditions are channels or few tokens."""
PAIRS = 0.2
"""Part of a sample's FLOPs that grows with pairs of tokens, not with tokens, where only the video has tokens: 0.28 of `small`,
0.09 of `wan5b`."""


@dataclass(frozen=True)
class Cost:
    """The cost of one step."""

    amount: int
    unit: str
    rate: Rate
    items: float
    """Number of items that the rate counts: of a training run the samples of all batches, as if of the study's experiment."""
    disk_mb: float = 0.0

    def seconds(self, gpus: int = 1) -> float:
        """Time on a number of GPUs, or without any."""
        return self.rate.seconds(self.items, gpus)


def read_model(study: Study) -> Settings:
    """The model of the study's experiment, whose size its rates are of."""
    model: Settings = merge_settings(merge_settings(RECIPE, read_yaml(study.experiment)), study.settings)["model"]
    return model


def study_rates(study: Study) -> Source:
    """The rates that a study is estimated by. Raises ConfigError for a file of rates that cannot be read."""
    return find_rates(str(read_model(study)["size"]), study.machine.rates)


def estimate(study: Study, steps: Mapping[str, Step]) -> dict[str, Cost]:
    """The cost of every step from the study's rates, as if nothing were done."""
    rates, costs, measured = study_rates(study), dict[str, Cost](), work_of_sample(read_model(study))

    def add(name: str, amount: int, unit: str, items: float | None = None, stored: int | None = None) -> None:
        """Note the cost of a step; `stored` is the number of products on disk, by default one an item."""
        items = amount if items is None else items
        rate = rates.kinds[name.partition("/")[0].replace("adapt", "train")]
        costs[name] = Cost(amount, unit, rate, items, (items if stored is None else stored) * rate.item_mb)

    tested = study.task_count * study.test_seeds * len(study.graded_robots)
    add("generate", study.task_count * study.train_seeds * len(study.trained_robots) + tested, "episodes")
    encoded: dict[tuple[str, ...], int] = {}
    for variant in study.planned_runs:
        experiment = build_experiment(study, variant)
        updates, graded = count_optimizer_steps(study, variant, experiment), sum(study.graded_counts(variant).values())
        complete = merge_settings(RECIPE, experiment)
        samples = updates * complete["train"]["batch"] * work_of_sample(complete["model"]) / measured
        add(f"latents/{variant.name}", _count_new_streams(study, variant, experiment, encoded), "streams")
        add(f"{'adapt' if variant.target else 'train'}/{variant.name}", updates, "steps", samples, stored=1)
        add(f"rollout/{variant.name}", graded, "episodes")
        add(f"evaluate/{variant.name}", graded, "videos")
    shown = study.task_count * len(study.shifted_robots)
    for change, counts in study.planned_changes.items():
        add(generate_name(study, change), shown * sum(counts.values()), "episodes")
    for name in study.shifted_runs:
        add(f"rollout/{name}", shown * study.test_seeds, "episodes")
        add(f"evaluate/{name}", shown * study.test_seeds, "videos")
    add("baselines", tested * len(BASELINES), "videos")
    add("distances", math.comb(len(ROBOT_NAMES) + len(measured_bodies(study)), 2), "pairs")
    add("analyse", 1, "report")
    return {name: costs[name] for name in steps}


def work_of_sample(model: Settings) -> float:
    """FLOPs of a training sample relative to one whose conditions have no tokens of their own."""
    action, embodiment = pick(ACTIONS, model["action"], "action", (tuple,)), pick(CONDITIONS, model["embodiment"], "embodiment")
    conditions = (*list_conditions(action), *list_conditions(embodiment))
    own = sum(condition.stream in OWN_TOKENS for condition in conditions)
    pairs = (1 + own) ** 2 if model["visibility"] == "joint" else 1 + own + own**2
    return (1 - PAIRS) * (1 + own) + PAIRS * pairs


def _count_new_streams(study: Study, variant: Variant, experiment: Settings, encoded: dict[tuple[str, ...], int]) -> int:
    """Number of streams of single episodes that no earlier variant has encoded."""
    model, new = experiment["model"], 0
    counts = training_counts(variant, study.task_count, study.train_seeds, study.robot_keys)
    for stream in (name for name in ("rgb", model["action"], model["embodiment"]) if name != "none"):
        for robot, count in counts.items():
            key = (variant.change, robot, stream)
            new += max(0, count - encoded.get(key, 0))
            encoded[key] = max(count, encoded.get(key, 0))
    return new


def count_optimizer_steps(study: Study, variant: Variant, experiment: Settings) -> int:
    """Number of optimizer steps of a training run; `train.epochs` are passes over the chunks of its episodes."""
    experiment = merge_settings(RECIPE, experiment)
    train, clip = experiment["train"], experiment["clip"]
    if not train.get("epochs"):
        return int(train["steps"])
    chunks = -(-(study_rates(study).episode_frames - 1) // (clip["frames"] - 1))
    samples = study.training_count(variant) * max(1, chunks - (train.get("chunks", 1) - 1))
    return max(1, round(float(train["epochs"]) * samples / train["batch"]))


def correct_by_ledger(costs: Mapping[str, Cost], steps: Mapping[str, Step], ledger: Ledger, slots: int = 1) -> dict[str, float]:
    """Seconds of each step: recorded ones if it is done, else the estimate scaled by its error for that kind.

    `slots` is the number of GPUs, of which each step has as many as it is planned with.
    """
    noted: dict[str, float] = {}
    expected: dict[str, float] = {}
    for name, step in steps.items():
        record: Mapping[str, Any] = ledger.record(step) if ledger.outcome(name) else {}
        if "seconds" in record:
            noted[name] = record["seconds"]
            expected[name] = costs[name].seconds(record.get("gpus", step.gpus_of(slots)))
    factors = {}
    for kind in KINDS:
        done = [name for name in noted if steps[name].kind == kind]
        if total := sum(expected[name] for name in done):
            factors[kind] = sum(noted[name] for name in done) / total
    planned = {name: cost.seconds(steps[name].gpus_of(slots)) for name, cost in costs.items()}
    return {name: noted.get(name, seconds * factors.get(steps[name].kind, 1.0)) for name, seconds in planned.items()}


def estimate_wall_seconds(
    steps: Mapping[str, Step],
    seconds: Mapping[str, float],
    done: Collection[str],
    slots: int,
    steps_per_gpu: int = 1,
    speedup: Callable[[str, int], float] = lambda name, gpus: 1.0,
) -> float:
    """Time to the end if each step starts as soon as it can, the longest critical path first.

    Args:
        steps, seconds: the study's steps and the time of each, on as many GPUs as it is planned with.
        done: names of steps that need no time.
        slots: number of GPUs, or of steps at once without GPUs.
        steps_per_gpu: number of steps that share a slot, one of them a training run.
        speedup: factor by which a step is faster on a number of GPUs than as planned.
    """
    left, ended, paths, now = {name for name in steps if name not in done}, set(done), critical_paths(steps, seconds), 0.0
    alone = steps_per_gpu == 1
    pools = {name: "training" if step.is_training or alone else "other" for name, step in steps.items()}
    free = {"training": slots, "other": slots * (steps_per_gpu - 1)}
    running: list[tuple[float, str, int]] = []
    while left or running:
        ready = sorted((name for name in left if ended.issuperset(steps[name].predecessors)), key=lambda name: -paths[name])
        for place, name in enumerate(ready):
            pool = pools[name]
            among = count_sharing(steps[name], steps, left, ready[place:], ended)
            needed = count_gpus(steps[name], slots, free[pool], among)
            if needed <= free[pool]:
                free[pool] -= needed
                left.discard(name)
                heapq.heappush(running, (now + seconds[name] / speedup(name, needed), name, needed))
        now, last, needed = heapq.heappop(running)
        free[pools[last]] += needed
        ended.add(last)
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

    def speedup(name: str, gpus: int) -> float:
        return costs[name].seconds(steps[name].gpus_of(slots)) / costs[name].seconds(gpus) if on_gpus else 1.0

    shared = study.machine.steps_per_gpu if on_gpus else 1
    wall = estimate_wall_seconds(steps, seconds, done, slots, shared, speedup)
    total = f"{'all':<10}{len(steps):>7}{len(done):>7}{'':>22}{totals[0]:>9.2f}"
    lines.append(f"{total}{f'{totals[1]:.2f}' if on_gpus else '':>11}{totals[2]:>8.1f}")
    gpus = f"{slots} GPU{'s' if slots > 1 else ''}"
    places = f"{gpus} and {shared} steps on each" if shared > 1 else gpus if on_gpus else f"{slots} at once"
    own = "the steps that are done and " if done else ""
    lines.append(f"about {format_duration(wall)} with {places}, by {own}{study_rates(study).text}")
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
