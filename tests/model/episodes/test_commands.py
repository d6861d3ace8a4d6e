"""New commands: pictures of commands that continue others are those of all commands at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests import synthetic
from xew.dataset import find_accepted
from xew.episode import read_pixels, read_states
from xew.model.episodes.commands import NewCommand, Pictures, new_command
from xew.sim_warp.cameras import CAMERAS
from xew.sim_warp.geometry.camera import spec_camera
from xew.sim_warp.rendering.streams import home_action
from xew.sim_warp.robots import ROBOTS

LENGTHS = (1, 4, 4, 7)
"""Numbers of commands, of which one adds nothing."""


@pytest.mark.parametrize("view", ["head", "wrist_left"])
def test_pictures_are_filled_up(view: str, tmp_path: Path) -> None:
    synthetic.write_synthetic_data(tmp_path, seeds=(0,), robots=("piper",), frames=max(LENGTHS))
    synthetic.write_synthetic_view(tmp_path, CAMERAS["wrist_left"])
    folder, record = find_accepted(tmp_path if view == "head" else tmp_path / "views" / view)[0]
    camera, first = spec_camera(record.camera), read_pixels(folder, "rgb", most=1)
    states = replace(read_states(folder, record), intrinsics=camera.intrinsics, extrinsics=camera.extrinsics)
    action = home_action(ROBOTS["piper"]) + np.arange(max(LENGTHS))[:, None] * np.array([0.02] * 6 + [0, -0.1] + [0] * 8)
    known: dict[str, Pictures] = {}

    def command(length: int, pictures: dict[str, Pictures] | None = None) -> NewCommand:
        return new_command(folder, record, states, action[:length].astype(np.float32), first, pictures)

    for length in LENGTHS:
        continued = command(length, known)
        shown = continued.render, continued.streams, continued.shadows
    whole = command(max(LENGTHS))
    np.testing.assert_array_equal(shown[0], whole.render)
    np.testing.assert_array_equal(shown[1].mask, whole.streams.mask)
    np.testing.assert_array_equal(shown[1].optical_flow, whole.streams.optical_flow)
    np.testing.assert_array_equal(shown[2], whole.shadows)
    assert whole.streams.mask.any() and whole.streams.optical_flow[:-1].any(axis=(1, 2, 3)).all()
    assert {name: len(pictures[0]) for name, pictures in known.items()} == dict.fromkeys(("render", "streams", "shadows"), 7)
