"""What a study will take: time, GPU-hours and disk of every stage, from measured rates, before anything starts.

Where cells of a stage are done in this study already, the rest of the stage is estimated by how long those took.
"""

import heapq
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xew.analysis.studies.config import Settings, Study, experiment_of
from xew.analysis.studies.ledger import Ledger
from xew.analysis.studies.machines import gpus_of
from xew.analysis.studies.plan import STAGES, Cell, in_order
from xew.protocol import Variant


@dataclass(frozen=True)
class Cost:
    """Of one cell."""

    amount: int
    unit: str
    seconds: float
    disk_mb: float = 0.0


def estimate(study: Study, cells: Mapping[str, Cell]) -> dict[str, Cost]:
    """The cost of every cell from the study's rates, as if nothing were done."""
    rates, costs = study.rates, {}
    episodes = study.task_count * (study.train_seeds + study.test_seeds) * len(study.robots)
    costs["generate"] = Cost(episodes, "episodes", rates.start_s + episodes * rates.episode_s, episodes * rates.episode_mb)
    encoded: set[tuple[str, ...]] = set()
    for variant in study.planned:
        experiment = experiment_of(study, variant)
        streams = _new_streams(variant, experiment, encoded) * study.trained(variant)
        steps, graded = steps_of(study, variant, experiment), sum(study.graded(variant).values())
        costs |= {
            f"latents/{variant.name}": Cost(
                streams, "streams", rates.start_s + streams * rates.encode_s, streams * rates.stream_mb
            ),
            f"{'adapt' if variant.target else 'train'}/{variant.name}": Cost(
                steps, "steps", rates.start_s + steps * rates.step_s, rates.run_mb
            ),
            f"rollout/{variant.name}": Cost(
                graded, "episodes", rates.start_s + graded * rates.rollout_s, graded * rates.rollout_mb
            ),
            f"evaluate/{variant.name}": Cost(graded, "episodes", rates.start_s + graded * rates.grade_s),
        }
    costs |= {"distances": Cost(1, "table", 2 * rates.start_s), "analyse": Cost(1, "report", 2 * rates.start_s)}
    return {name: costs[name] for name in cells}


def _new_streams(variant: Variant, experiment: Settings, encoded: set[tuple[str, ...]]) -> int:
    """How many streams of an episode no variant before has encoded with the same codec and episodes."""
    model, new = experiment["model"], 0
    for stream in ("rgb", model["action"], model["embodiment"]):
        key = (variant.split, variant.target or "", str(variant.shots), stream)
        new += stream != "none" and key not in encoded
        encoded.add(key)
    return new


def steps_of(study: Study, variant: Variant, experiment: Settings) -> int:
    """Optimizer steps of a training; `train.epochs` are passes over its samples, as many as its episodes have chunks."""
    train, clip = experiment["train"], experiment["clip"]
    if not train.get("epochs"):
        return int(train.get("steps", 0))
    chunks = -(-(study.rates.episode_frames - 1) // (clip["frames"] - 1))
    samples = study.trained(variant) * max(1, chunks - (train.get("chunks", 1) - 1))
    return max(1, round(float(train["epochs"]) * samples / train["batch"]))


def corrected(costs: Mapping[str, Cost], cells: Mapping[str, Cell], ledger: Ledger) -> dict[str, float]:
    """Seconds of each cell: those noted of what is done, and the estimate times how far off it was for the stage."""
    noted: dict[str, float] = {}
    for name, cell in cells.items():
        record: Mapping[str, Any] = ledger.record(cell) if ledger.outcome(name) else {}
        if "seconds" in record:
            noted[name] = record["seconds"]
    factors = {}
    for stage in STAGES:
        done = [name for name in noted if cells[name].stage == stage]
        if done:
            factors[stage] = sum(noted[name] for name in done) / sum(costs[name].seconds for name in done)
    return {name: noted.get(name, cost.seconds * factors.get(cells[name].stage, 1.0)) for name, cost in costs.items()}


def wall_seconds(cells: Mapping[str, Cell], seconds: Mapping[str, float], done: Collection[str], slots: int) -> float:
    """Time to the end on so many slots, each cell started as soon as it can be, the longest way first."""
    left = {name: {need for need in cell.needs if need not in done} for name, cell in cells.items() if name not in done}
    ways, free, now = longest_ways(cells, seconds), slots, 0.0
    running: list[tuple[float, str, int]] = []
    while left or running:
        for name in sorted((name for name, needs in left.items() if not needs), key=lambda name: -ways[name]):
            needed = min(max(1, cells[name].gpus), slots)
            if needed <= free:
                free -= needed
                del left[name]
                heapq.heappush(running, (now + seconds[name], name, needed))
        now, ended, needed = heapq.heappop(running)
        free += needed
        for needs in left.values():
            needs.discard(ended)
    return now


def longest_ways(cells: Mapping[str, Cell], seconds: Mapping[str, float]) -> dict[str, float]:
    """From the start of each cell to the end of the study, were there slots for all."""
    ways: dict[str, float] = {}
    for cell in reversed(in_order(cells)):
        after = [ways[name] for name, other in cells.items() if cell.name in other.needs]
        ways[cell.name] = seconds[cell.name] + max(after, default=0.0)
    return ways


def cost_table(
    study: Study, cells: Mapping[str, Cell], costs: Mapping[str, Cost], seconds: Mapping[str, float], ledger: Ledger, slots: int
) -> str:
    """What is left to do, a line per stage, and what it takes altogether."""
    on_gpus = bool(gpus_of(study) or study.machine.ray)
    lines = [f"{'stage':<10}{'cells':>7}{'done':>7}{'left to do':>22}{'hours':>9}{'GPU-hours' if on_gpus else '':>11}{'GB':>8}"]
    done = {name for name in cells if ledger.outcome(name)}
    totals = [0.0, 0.0, 0.0]
    for stage in STAGES:
        names = [name for name, cell in cells.items() if cell.stage == stage]
        left = [name for name in names if name not in done]
        hours = sum(seconds[name] for name in left) / 3600
        gpu_hours = sum(seconds[name] * cells[name].gpus for name in left) / 3600
        disk = sum(costs[name].disk_mb for name in left) / 1000
        totals = [total + value for total, value in zip(totals, (hours, gpu_hours, disk), strict=True)]
        if names:
            amount = f"{sum(costs[name].amount for name in left):,} {costs[names[0]].unit}"
            counts = f"{stage:<10}{len(names):>7}{len(names) - len(left):>7}{amount:>22}"
            lines.append(f"{counts}{hours:>9.2f}{f'{gpu_hours:.2f}' if on_gpus else '':>11}{disk:>8.1f}")
    wall = wall_seconds(cells, seconds, done, slots)
    total = f"{'all':<10}{len(cells):>7}{len(done):>7}{'':>22}{totals[0]:>9.2f}"
    lines.append(f"{total}{f'{totals[1]:.2f}' if on_gpus else '':>11}{totals[2]:>8.1f}")
    lines.append(f"about {duration(wall)} with {slots} at once, by the rates of: {study.rates.measured_on}")
    free = free_gb(study.out)
    if free < totals[2]:
        lines.append(f"WARNING: {totals[2]:.1f} GB are needed and {free:.1f} GB are free under {study.out}")
    return "\n".join(lines)


def free_gb(folder: Path) -> float:
    """Of the disk that a folder is, or will be, on."""
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free / 1e9


def duration(seconds: float) -> str:
    """Such as '3 h 20 min'."""
    minutes = round(seconds / 60)
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
