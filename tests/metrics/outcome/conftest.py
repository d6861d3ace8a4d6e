"""One scene of a block on a table with one robot, under three commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.calibration.perturbations import render_perturbation
from tests.sim_warp.small import TASK, produce
from xew.dataset import find_accepted
from xew.episode import States, read_pixels, read_states, write_episode
from xew.protocol import join_fault
from xew.sim_warp.production.cells import Job
from xew.sim_warp.rendering.render import Renderer

FAULTS = {3: 0.05, 7: -0.05}
"""Way of the block to the right [m] under each fault."""


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The expert's episode, and those in which the block moves to the right and to the left."""
    root = tmp_path_factory.mktemp("counterfactual")
    produce([Job(TASK, 1, ("piper",))], root, Renderer("cpu"))
    [(folder, record)] = find_accepted(root)
    for number, way in FAULTS.items():
        faulty = replace(record, seed=join_fault(number, 1), success=False, fault="push:40", progress=0.5, files={}, hashes={})
        moved = move_block(read_states(folder), way)
        write_episode(root, faulty, moved, render_perturbation(folder, moved).rgb, read_pixels(folder, "robot"))
    return root


def move_block(states: States, way: float) -> States:
    """The block slides to the right by a way [m]."""
    pose = states.object_pose.copy()
    pose[..., 0, 0] += np.linspace(0, way, len(pose))
    return replace(states, object_pose=pose)
