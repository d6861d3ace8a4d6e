"""What all predictions of one episode share while they are graded, and videos in blocks as the metrics of frames take them.

Frames go through the compiler in blocks of one size, so a few programs serve episodes of all lengths.
"""

from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from xew.metrics.estimators.appearance import REST, TrueAppearance
from xew.metrics.metric import ACCELERATOR_CHUNK, fill_up
from xew.metrics.perceptual import KEPT_FEATURES, SMALLEST_SIDE, SharedFeatures
from xew.metrics.truth import Truth

FRAME_BLOCK = 4
"""Number of frames graded at once on a CPU; on a GPU it is `ACCELERATOR_CHUNK`. A video's last block is filled up: a short one
costs little."""
WHOLE_BLOCK = 16
"""Number of frames that a video is filled up to a multiple of on a CPU for metrics that need all of it."""


class GradedFrames:
    """The graded frames of a video or of masks. A GPU gets them once for all metrics.

    Args:
        frames: [t h w 3] uint8 or [t h w] bool.
    """

    def __init__(self, frames: np.ndarray) -> None:
        self.frames = frames
        self._blocks: dict[bool, list[Any]] = {}

    def blocks(self, whole: bool) -> list[Any]:
        """`cut_blocks` of the frames, on the device."""
        if whole not in self._blocks:
            if is_on_cpu():
                self._blocks[whole] = cut_blocks(self.frames, whole)
            elif whole:
                self._blocks[whole] = [jnp.concatenate(self.blocks(whole=False))]
            else:
                self._blocks[whole] = [jax.device_put(block) for block in cut_blocks(self.frames)]
        return self._blocks[whole]


class EpisodeCache:
    """An episode and what all predictions of it share: the graded frames of its true video and masks, their LPIPS features,
    and its appearance.

    Args:
        truth: the episode.
        first: the first graded frame; those before it were given to the model.
    """

    def __init__(self, truth: Truth, first: int = 1) -> None:
        self.truth, self.first = truth, first
        self.target = GradedFrames(truth.rgb[first:])
        self.features = SharedFeatures(KEPT_FEATURES["cpu" if is_on_cpu() else "gpu"])

    @cached_property
    def region(self) -> GradedFrames | None:
        """For each frame, all pixels that show the robot at any time; None where no frame shows it."""
        mask = self.truth.mask[self.first :]
        covered = np.any(mask, axis=0)
        is_known = covered.any() and min(covered.shape) >= SMALLEST_SIDE
        return GradedFrames(np.broadcast_to(covered, mask.shape)) if is_known else None

    @cached_property
    def robot(self) -> GradedFrames | None:
        """The robot's masks, frame by frame; None where no frame shows the robot.

        A frame without the robot gets all pixels that show it at any time, so a robot that is still shown there is an error.
        """
        mask = self.truth.mask[self.first :]
        shown = mask.any(axis=(1, 2), keepdims=True)
        return None if self.region is None else GradedFrames(np.where(shown, mask, self.region.frames))

    @cached_property
    def bodies(self) -> GradedFrames:
        """The masks of the robot and of all objects, frame by frame."""
        return GradedFrames(self.truth.labels[self.first :] != REST)

    @cached_property
    def appearance(self) -> TrueAppearance:
        """The appearance that estimators compare predictions with."""
        return TrueAppearance(self.truth.rgb, self.truth.labels)


def is_on_cpu() -> bool:
    """Does JAX compute on a CPU?"""
    return jax.default_backend() == "cpu"


def cut_blocks(array: np.ndarray, whole: bool = False) -> list[np.ndarray]:
    """An array [t ...] in blocks [n ...] of one size, the last filled up with its last frame; in one block if `whole`."""
    if whole:
        return [fill_up(array, 0, WHOLE_BLOCK if is_on_cpu() else ACCELERATOR_CHUNK)]
    size = FRAME_BLOCK if is_on_cpu() else ACCELERATOR_CHUNK
    blocks = [array[start : start + size] for start in range(0, len(array), size)]
    return [*blocks[:-1], fill_up(blocks[-1], 0, size)]
