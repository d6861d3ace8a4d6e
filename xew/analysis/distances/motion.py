"""Motion distance: how differently robots move in the picture while their tools follow the same paths."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from xew.analysis.distances.matrices import symmetric_matrix
from xew.protocol import SHARED_MOTION
from xew.sim_warp.robots import RobotSpec

if TYPE_CHECKING:
    from xew.sim_warp.plan import Timeline

SCENES = {
    "place_empty_cup": 800_005,
    "beat_block_hammer": 800_003,
    "stack_bowls_two": 800_000,
    "grab_roller": 800_000,
    "open_laptop": 800_001,
    "move_pillbottle_pad": 800_000,
}
"""Tasks whose expert moves, each with the first validation seed that the five robots and all 168 bodies can follow."""
EVERY = 5
"""Number of frames from one compared frame to the next."""
CELL = 8
"""Side of the squares over which flow is averaged [pixels], so many robots fit in memory."""


def motion_matrices(robots: Sequence[RobotSpec]) -> dict[str, np.ndarray]:
    """Endpoint errors [n n] of the commanded optical flow of n robots [pixels], by task whose path all of them can follow."""
    plans = make_plans()
    by_robot = [command_flows(robot, plans) for robot in robots]
    followed = [task for task in SCENES if all(task in flows for flows in by_robot)]
    return {task: endpoint_errors([flows[task] for flows in by_robot]) for task in followed}


def endpoint_errors(flows: Sequence[np.ndarray]) -> np.ndarray:
    """Mean distance [n n] of every two of n flows [t h w 2] [pixels]."""
    return symmetric_matrix(len(flows), lambda a, b: float(np.linalg.norm(flows[a] - flows[b], axis=-1).mean()))


def make_plans() -> dict[str, "Timeline"]:
    """The expert's plan of each of SCENES."""
    from xew.sim_warp.changes.scenes import make_plan, make_scene  # load Warp, which few parts of the analysis need
    from xew.sim_warp.tasks import get_task

    return {name: make_plan(get_task(name), make_scene(get_task(name), name, seed)) for name, seed in SCENES.items()}


def command_flows(robot: RobotSpec, plans: Mapping[str, "Timeline"]) -> dict[str, np.ndarray]:
    """Optical flow [t h w 2] float32 of a robot's commands in squares of CELL pixels [pixels], by task that it can follow."""
    from xew.sim_warp.production.cells import plan_motion
    from xew.sim_warp.rendering.streams import command_streams_batch

    planned = zip(plans, plan_motion(robot, list(plans.values()), SHARED_MOTION, "cpu"), strict=True)
    actions = {name: commands.action[::EVERY] for name, (_, commands) in planned if commands.problem is None}
    streams = command_streams_batch([(robot, action) for action in actions.values()], colors=False)
    return {name: _average(of_task.optical_flow[:-1]) for name, of_task in zip(actions, streams, strict=True)}


def _average(flow: np.ndarray) -> np.ndarray:
    """Mean flow of each square: [t h/CELL w/CELL 2] of [t h w 2]."""
    frames, height, width, _ = flow.shape
    return flow.reshape(frames, height // CELL, CELL, width // CELL, CELL, 2).mean(axis=(2, 4))
