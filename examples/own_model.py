"""Two example models, which show how a video model of your own enters the study.

    python -m xew.model.outside examples.own_model:PasteRender --data data --split test --out rollouts/paste_render
    python -m xew.metrics.evaluate rollouts/paste_render --data data --baselines --out scores.parquet

A model gets an `EpisodeInputs` (first frame, instruction, commanded joints and tool poses, camera, robot-only render) and
returns uint8 [frame_count h w 3]. Neither of these has learned anything; a world model should beat both.
"""

import cv2
import numpy as np

from xew.model.outside import EpisodeInputs


def freeze(inputs: EpisodeInputs) -> np.ndarray:
    """Repeat the first frame: a video [t h w 3] uint8 in which nothing moves."""
    return np.repeat(inputs.first_frame[None], inputs.frame_count, axis=0)


class PasteRender:
    """A model that removes the robot from the first frame and pastes the commanded render over it; objects do not move.

    It is a class because a real model loads its weights in `__init__`.
    """

    def __init__(self) -> None:
        self.margin = np.ones((9, 9), np.uint8)
        """Neighborhood [9 9] uint8 by which the hole is widened, so that the robot's shadows and soft edges are removed too."""

    def __call__(self, inputs: EpisodeInputs) -> np.ndarray:
        """Predict a video [t h w 3] uint8 of an episode."""
        render = inputs.robot_render
        robot = (render != 255).any(axis=-1)
        hole = cv2.dilate(robot[0].astype(np.uint8), self.margin)
        empty = cv2.inpaint(inputs.first_frame, hole, 5, cv2.INPAINT_TELEA)
        video = np.where(robot[..., None], render, empty)
        video[0] = inputs.first_frame
        return video
