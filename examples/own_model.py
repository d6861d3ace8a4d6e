"""Two models of your own: what it takes to enter a video model into the study.

    python -m xew.model.outside examples.own_model:PasteRender --data data --split test --out rollouts/paste_render
    python -m xew.metrics.evaluate rollouts/paste_render --data data --baselines --out scores.parquet

A model gets an `EpisodeInputs` (first frame, instruction, commanded joints and tool poses, camera, robot-only render) and
returns uint8 [frame_count h w 3]. Neither of these has learned anything; a world model should beat both.
"""

import cv2
import numpy as np

from xew.model.outside import EpisodeInputs


def freeze(inputs: EpisodeInputs) -> np.ndarray:
    """Nothing ever moves."""
    return np.repeat(inputs.first_frame[None], inputs.frame_count, axis=0)


class PasteRender:
    """Takes the robot out of the first frame and pastes the commanded render over what is left; objects stay where they are.

    A class, for a real model loads its weights in `__init__`.
    """

    def __init__(self) -> None:
        self.margin = np.ones((9, 9), np.uint8)
        """The robot's shadows and soft edges go with it."""

    def __call__(self, inputs: EpisodeInputs) -> np.ndarray:
        render = inputs.robot_render
        robot = (render != 255).any(axis=-1)
        hole = cv2.dilate(robot[0].astype(np.uint8), self.margin)
        empty = cv2.inpaint(inputs.first_frame, hole, 5, cv2.INPAINT_TELEA)
        video = np.where(robot[..., None], render, empty)
        video[0] = inputs.first_frame
        return video
