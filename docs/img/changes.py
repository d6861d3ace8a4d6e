"""Draws the picture of docs/cameras.md: one scene with every factor at its three levels, seen by the head camera.

`python docs/img/changes.py` writes changes.webp next to this file. It plans and simulates one robot's episode for each height.
"""

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from xew.protocol import FACTORS, STRENGTHS, Change
from xew.sim_warp.changes.looks import camera_of, stage_of
from xew.sim_warp.geometry.camera import spec_camera
from xew.sim_warp.production.cells import Cell, Job, plan_cells, simulate_cells
from xew.sim_warp.rendering.observe import observe
from xew.sim_warp.rendering.render import Renderer

PICTURE = Path(__file__).with_name("changes.webp")
TASK, SEED, ROBOT = "place_empty_cup", 0, "franka_panda"
SHARE = 0.5
"""Part of the episode at which the picture is taken."""
SCALE = 0.5


@cache
def moved(change: str) -> Cell:
    """The simulated episode of a scene with a change."""
    ((cell,),) = simulate_cells(plan_cells([Job(TASK, SEED, (ROBOT,), change=change)], device="cpu"), "cpu")
    return cell


def draw(change: Change, renderer: Renderer) -> np.ndarray:
    """The scene [h w 3] uint8 with a change."""
    recording = moved(str(change) if change.factor in ("clutter", "height") else "").recording
    frame = int(SHARE * len(recording.joint_pos))
    view = observe(renderer, [recording], spec_camera(camera_of(change)), stage_of(change))[0].rgb[frame]
    return cv2.resize(view, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA)


def main() -> None:
    renderer = Renderer("cpu")
    columns = [
        np.concatenate([draw(Change(factor, level), renderer) for level in range(1, STRENGTHS + 1)]) for factor in FACTORS
    ]
    cv2.imwrite(str(PICTURE), np.concatenate(columns, 1)[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 80])


if __name__ == "__main__":
    main()
