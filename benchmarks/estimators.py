"""How long it takes to find robot and points in a video: OpenCV frame by frame on one core, and the same in Warp kernels.

    python -m benchmarks.estimators [--frames 100]                     # both on the CPU
    python -m benchmarks.estimators --device cuda --kernels            # Warp on the GPU, and which kernels take how long

The videos are those of benchmarks/metrics.py, an arm of five links before a wall, 320x240: late, blurred and grainy, as a model
errs; the first frame frozen; the frames shuffled; the truth softened. Each is found masks and 16 points along the links for,
which are seen in every frame. An episode's looks are learnt, and its true video's flow is found, once for all its videos.
Before a figure is told, masks and points of both are compared: mean IoU with the true mask within .005, mean distance of
points, at most 100 pixels and as much where lost, within 3 %. Then contenders take turns, and medians are told: by the clock,
and of the process's time. The first call, which compiles kernels, is told by itself.
"""

import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import cv2
import numpy as np
import tyro
import warp as wp

from benchmarks.common import format_versions
from benchmarks.metrics import Pair, make_pair
from lab.calibration.predictors import delay, shuffle, soften
from xew.metrics.backends import ReferenceMasker
from xew.metrics.estimators.batched.masks import BatchedMasker
from xew.metrics.estimators.batched.tracks import BatchedTracker
from xew.metrics.estimators.tracks import ReferenceTracker

IOU, DISTANCE, FAR = 0.005, 0.03, 100.0
"""Largest difference of the mean IoU, largest relative one of the mean distance, and the distance of a lost point [pixels]."""
SHOWN_KERNELS = 12


@dataclass(frozen=True)
class Args:
    device: Annotated[str, tyro.conf.arg(metavar="cpu|cuda")] = "cpu"
    frames: int = 100
    rounds: int = 3
    """Turns of each contender."""
    kernels: bool = False
    """Also tell which kernels take how long on the GPU."""


@dataclass(frozen=True)
class Contender:
    masker: Callable[..., np.ndarray]
    tracker: Callable[..., np.ndarray]

    def run(self, video: np.ndarray, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        return self.find_masks(video, pair), self.find_points(video, pair)

    def find_masks(self, video: np.ndarray, pair: Pair) -> np.ndarray:
        return self.masker(video, pair.target, pair.mask)

    def find_points(self, video: np.ndarray, pair: Pair) -> np.ndarray:
        return self.tracker(video, pair.target, pair.points, np.ones(pair.points.shape[:2], bool))


def make_videos(pair: Pair) -> dict[str, np.ndarray]:
    truth = pair.target
    return {
        "late, blurred, grainy": pair.prediction,
        "frozen": delay(truth, len(truth)),
        "shuffled": shuffle(truth),
        "truth, softened": soften(truth),
    }


def compare(name: str, pair: Pair, ours: tuple[np.ndarray, np.ndarray], theirs: tuple[np.ndarray, np.ndarray]) -> None:
    """Fail unless the scores agree."""
    iou, distance = [], []
    for masks, points in (ours, theirs):
        iou.append(np.mean((masks & pair.mask).sum((1, 2)) / np.maximum((masks | pair.mask).sum((1, 2)), 1)))
        apart = np.linalg.norm(points - pair.points, axis=-1)
        distance.append(np.mean(np.where(np.isfinite(apart), np.minimum(apart, FAR), FAR)))
    print(f"  {name}: IoU {iou[0]:.4f} and {iou[1]:.4f}, distance {distance[0]:.3f} and {distance[1]:.3f} px")
    assert abs(iou[0] - iou[1]) < IOU, f"{name}: the masks' IoU differs"
    assert abs(distance[0] - distance[1]) < DISTANCE * max(distance[1], 1), f"{name}: the points' distance differs"


def clock(run: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of the clock and of the process."""
    start = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - start[0], time.process_time() - start[1]


def measure(contenders: dict[str, Contender], videos: dict[str, np.ndarray], pair: Pair, rounds: int) -> None:
    """Print milliseconds a frame of each video, of masks and of points."""
    print("| video | by | masks [ms a frame] | of the process | points | of the process |\n|---|---|---|---|---|---|")
    for case, video in videos.items():
        times: dict[str, list[list[tuple[float, float]]]] = {name: [[], []] for name in contenders}
        for _ in range(rounds):
            for name, contender in contenders.items():
                # A copy is another video to estimators, which keep what they know of one.
                fresh = video.copy()
                times[name][0].append(clock(partial(contender.find_masks, fresh, pair)))
                times[name][1].append(clock(partial(contender.find_points, fresh, pair)))
        for name, (masks, points) in times.items():
            values = np.concatenate([np.median(masks, axis=0), np.median(points, axis=0)]) * 1e3 / len(video)
            print(f"| {case} | {name} | " + " | ".join(f"{value:.3f}" for value in values) + " |")


def tell_kernels(contender: Contender, video: np.ndarray, pair: Pair) -> None:
    """Print the kernels that take longest for one video."""
    wp.timing_begin(cuda_filter=wp.TIMING_ALL)
    contender.run(video.copy(), pair)
    totals: dict[str, list[float]] = {}
    for result in wp.timing_end():
        totals.setdefault(result.name, []).append(result.elapsed)
    print(f"kernels and copies of one video: {sum(map(sum, totals.values())):.1f} ms")
    print("| kernel | launches | ms |\n|---|---|---|")
    for name, elapsed in sorted(totals.items(), key=lambda item: -sum(item[1]))[:SHOWN_KERNELS]:
        print(f"| {name} | {len(elapsed)} | {sum(elapsed):.2f} |")


def main(args: Args) -> None:
    cv2.setNumThreads(1)
    wp.config.log_level = wp.LOG_ERROR
    device = wp.get_device("cuda:0" if args.device == "cuda" else "cpu")
    packages = format_versions(("warp-lang", "opencv-python-headless", "numpy"))
    print(f"{device.name if device.is_cuda else platform.processor()}; {packages}; {args.frames} frames of 320x240")
    pair = make_pair(args.frames)
    videos = make_videos(pair)

    ours = Contender(BatchedMasker(device.alias), BatchedTracker(device.alias))
    contenders = {"opencv": Contender(ReferenceMasker(), ReferenceTracker()), f"warp, {args.device}": ours}
    print(f"first video, with compiling and learning: {clock(lambda: ours.run(pair.prediction, pair))[0]:.1f} s")
    for name, video in videos.items():
        compare(name, pair, ours.run(video, pair), contenders["opencv"].run(video, pair))
    measure(contenders, videos, pair, args.rounds)
    if args.kernels and device.is_cuda:
        tell_kernels(ours, pair.prediction, pair)


if __name__ == "__main__":
    main(tyro.cli(Args))
