"""The report of an autoencoder: its ceilings for every robot and stream of pictures, and contact sheets.

Reads  a codec, episodes
Writes <out>/report.md, <out>/pictures/ROBOT-STREAM.png (ground truth above reconstruction), and rows for autoencoder.json

It measures held-out robots and a few training robots, on training seeds unless `report.test_seeds` is set.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, UInt8
from tqdm import tqdm

from lab.codec.pictures import ALIGNED, differs_from_corner, draw_descriptions, read_aligned
from lab.codec.settings import CodecExperiment
from lab.codec.unpaired import select_unpaired
from xew.dataset import Dataset, Episode
from xew.files import write_bytes, write_text
from xew.model.codecs.ceiling import LPIPS_EVERY, choose_evenly, reconstruct
from xew.model.codecs.contract import Codec
from xew.model.settings.settings import Clip
from xew.model.video.comparison import strip
from xew.model.video.frames import TEMPORAL_FACTOR
from xew.protocol import expand_robots
from xew.sim_warp.inspection.pictures import encode_png


@dataclass(frozen=True)
class Quality:
    """Reconstruction of one stream of one robot at the camera's size, mean over clips."""

    robot: str
    stream: str
    trained: bool
    """Whether it is a training robot."""
    psnr: float
    """Mean PSNR [dB]."""
    lpips: float
    """Mean LPIPS on every third frame."""
    region_psnr: float | None
    """Mean PSNR [dB] of the robot's pixels, or of the pixels that differ from the background; None if there are none."""
    clips: int


class Truth(NamedTuple):
    """A true clip."""

    video: UInt8[np.ndarray, "t 240 320 3"]
    region: Bool[np.ndarray, "t 240 320"]
    """Pixels of the robot."""


def choose_robots(experiment: CodecExperiment, dataset: Dataset) -> list[str]:
    """Robots of the report: the config's, by default all held-out ones, then a few training robots."""
    seeds, trained = experiment.report.seeds, experiment.train_robots
    robots = {record.robot for _, record in dataset.cells}
    present = sorted({record.robot for _, record in select_unpaired(dataset, robots, seeds)})
    measured = expand_robots(experiment.report.robots) or tuple(robot for robot in present if robot not in trained)
    few = choose_evenly([robot for robot in present if robot in trained], experiment.report.trained_robots)
    return [robot for robot in dict.fromkeys((*measured, *few)) if robot in present]


def measure_codec(experiment: CodecExperiment, codec: Codec, dataset: Dataset, pictures: Path | None = None) -> list[Quality]:
    """Ceilings of every robot and stream of an experiment.

    Args:
        experiment: of the codec.
        codec: to measure.
        dataset: the episodes.
        pictures: folder for contact sheets, by default none.
    """
    qualities = []
    seeds = experiment.report.seeds
    for robot in tqdm(choose_robots(experiment, dataset), desc="report", unit="robot"):
        episodes = choose_evenly(select_unpaired(dataset, (robot,), seeds), experiment.report.clips)
        truths = read_truths(episodes, list(experiment.streams), experiment.clip.frames)
        for stream, clips in truths.items():
            sheet = None if pictures is None else pictures / f"{robot}-{stream}.png"
            scores = [grade(codec, clip, experiment.clip, sheet if number == 0 else None) for number, clip in enumerate(clips)]
            psnr, lpips, region = np.array(scores).T
            region_psnr = None if np.isnan(region).all() else float(np.nanmean(region))
            trained = robot in experiment.train_robots
            qualities.append(Quality(robot, stream, trained, float(psnr.mean()), float(lpips.mean()), region_psnr, len(clips)))
    return qualities


def read_truths(episodes: Sequence[Episode], streams: Sequence[str], frames: int) -> dict[str, list[Truth]]:
    """The first frames of each stream of some episodes of one robot; streams that describe the robot once."""
    truths: dict[str, list[Truth]] = {name: [] for name in streams}
    aligned = [name for name in streams if name in ALIGNED]
    for folder, record in episodes:
        read = read_aligned(folder, record, aligned, list(range(min(frames, record.frame_count))))
        for name, (video, region) in read.items():
            assert region is not None
            truths[name].append(Truth(video, region))
    described = [name for name in streams if name not in ALIGNED]
    for name, video in draw_descriptions(described, episodes[0]).items():
        truths[name].append(Truth(video, differs_from_corner(video)))
    return truths


def grade(codec: Codec, truth: Truth, clip: Clip, sheet: Path | None = None) -> tuple[float, float, float]:
    """PSNR [dB], LPIPS and PSNR of the region [dB] of one clip after the codec; the last is NaN without a region."""
    from xew.metrics import lpips, psnr

    video = truth.video
    frames = len(video) + (1 - len(video)) % TEMPORAL_FACTOR
    decoded = reconstruct(codec, video, frames, clip.height, clip.width)
    if sheet is not None:
        write_sheet(sheet, video, decoded)
    pair = jnp.asarray(decoded), jnp.asarray(video)
    whole = float(np.mean(psnr(*pair)))
    perceptual = float(np.mean(lpips(*(video[::LPIPS_EVERY] for video in pair))))
    if not truth.region.any():
        return whole, perceptual, math.nan
    errors = np.square(decoded[truth.region].astype(np.float64) - video[truth.region]).mean()
    return whole, perceptual, 10 * math.log10(255**2 / max(errors, 1e-6))


def write_sheet(path: Path, truth: UInt8[np.ndarray, "t h w 3"], decoded: UInt8[np.ndarray, "t h w 3"]) -> None:
    """Write a few frames of two videos [t h w 3] as a picture, ground truth above reconstruction."""
    write_bytes(path, encode_png(strip(truth, decoded)), within=path.parent)


def write_report(qualities: Sequence[Quality], experiment: CodecExperiment) -> str:
    """Write the table as <out>/report.md, and return it."""
    seeds = "test" if experiment.report.test_seeds else "training"
    lines = [
        f"Ceilings at 320x240 on {seeds} seeds; robots marked * were trained on.",
        "",
        "| robot | stream | PSNR [dB] | LPIPS | PSNR of the robot's region [dB] | clips |",
        "|---|---|---|---|---|---|",
    ]
    for q in qualities:
        region = "" if q.region_psnr is None else f"{q.region_psnr:.2f}"
        mark = " *" if q.trained else ""
        lines.append(f"| {q.robot}{mark} | {q.stream} | {q.psnr:.2f} | {q.lpips:.4f} | {region} | {q.clips} |")
    text = "\n".join((*lines, "", *spread_lines(qualities))) + "\n"
    write_text(experiment.out / "report.md", text, within=experiment.out)
    return text


def spread_lines(qualities: Sequence[Quality]) -> list[str]:
    """The worst and best held-out robot of each stream, one line each."""
    lines = []
    for stream in dict.fromkeys(q.stream for q in qualities):
        new = [q for q in qualities if q.stream == stream and not q.trained]
        if new:
            psnr, lpips = [q.psnr for q in new], [q.lpips for q in new]
            lines.append(
                f"{stream}, robots not trained on: PSNR {min(psnr):.2f} to {max(psnr):.2f} dB,"
                f" LPIPS {min(lpips):.4f} to {max(lpips):.4f}"
            )
    return lines


def report_scalars(qualities: Sequence[Quality]) -> Mapping[str, float]:
    """The ceilings by name, for a log."""
    named = {f"ceiling/{q.robot}/{q.stream}": q for q in qualities}
    psnr = {f"{name}/psnr": q.psnr for name, q in named.items()}
    return psnr | {f"{name}/lpips": q.lpips for name, q in named.items()}


def report_rows(qualities: Sequence[Quality]) -> list[dict[str, object]]:
    """The ceilings as plain data."""
    return [asdict(quality) for quality in qualities]
