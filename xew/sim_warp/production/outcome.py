"""The outcome of a motion: success, or one of `episode.FAILURES` with a sentence.

A motion of faulty commands has a success and a progress, and a failure only if it was refused.
"""

from dataclasses import replace

import numpy as np

from xew.protocol import ARMS
from xew.sim_warp.changes.clutter import find_struck
from xew.sim_warp.changes.scenes import is_solved, measure_progress
from xew.sim_warp.physics import Motion
from xew.sim_warp.physics.plausibility import find_implausible
from xew.sim_warp.plan import ToolPath
from xew.sim_warp.rendering.observe import Recording
from xew.sim_warp.scene import Scene
from xew.sim_warp.tasks import Moment, Task

DEEPEST_IN_TABLE = 0.0015
"""Largest penetration of an arm and the table [m]; a finger may brush the table."""
DEEPEST_IN_ARM = 0.0002
"""Largest penetration of the arms [m]; colliding hands reach 0.4 mm."""
LAST_FRAMES = 3
"""Number of last frames of a hold, in one of which the hand must touch its object."""


def find_failure(
    task: Task, scene: Scene, path: ToolPath, action: np.ndarray, motion: Motion, tools: np.ndarray
) -> tuple[str, str] | None:
    """The first failure of a motion: one of `episode.FAILURES` and a sentence; None for success.

    Args:
        action: [t 16] canonical commands [rad; grippers 0 to 1].
        tools: [t 2 7] measured tool poses, xyz [m] and quaternion xyzw, world.
    """
    if collision := _find_collision(motion):
        return collision
    first, last = (moment(action, motion, tools, frame) for frame in (0, -1))
    if is_solved(task, scene, first):
        return "plan", "the scene is solved before it begins"
    if not is_solved(task, scene, last):
        return _find_lost_hold(scene, path, motion)
    return _find_implausible(scene, path, motion, tools)


def find_refusal(scene: Scene, path: ToolPath, motion: Motion, tools: np.ndarray) -> tuple[str, str] | None:
    """The reason why a motion of faulty commands is no episode, as `find_failure`; missing the goal is none.

    `tools` [t 2 7] are measured tool poses, xyz [m] and quaternion xyzw, world.
    """
    return _find_collision(motion) or _find_implausible(scene, path, motion, tools)


def measure_outcome(task: Task, scene: Scene, action: np.ndarray, motion: Motion, tools: np.ndarray) -> tuple[bool, float]:
    """Success and progress at the end of a motion; arguments as of `find_failure`: commands [t 16], tool poses [t 2 7]."""
    first, last = (moment(action, motion, tools, frame) for frame in (0, -1))
    return is_solved(task, scene, last), measure_progress(task, scene, first, last)


def _find_collision(motion: Motion) -> tuple[str, str] | None:
    """The failure of a simulation that broke down, or of arms that pressed into the table or each other."""
    if motion.overflow:
        return "overflow", "a contact or constraint buffer was too small, or the state was not finite"
    if motion.table_overlap > DEEPEST_IN_TABLE:
        return "plan", f"an arm pressed {1000 * motion.table_overlap:.1f} mm into the table"
    if motion.arm_overlap > DEEPEST_IN_ARM:
        return "plan", f"the arms pressed {1000 * motion.arm_overlap:.1f} mm into each other"
    return None


def _find_implausible(scene: Scene, path: ToolPath, motion: Motion, tools: np.ndarray) -> tuple[str, str] | None:
    problem = find_implausible(
        scene, path.holds, motion.object_pose, motion.penetration, motion.contact, tools, path.frame_rate
    )
    return ("physics", problem) if problem else None


def find_obstruction(scene: Scene, recording: Recording) -> tuple[str, str] | None:
    """The failure of a motion that comes too near to the scene's clutter, which is not simulated."""
    if not scene.clutter:
        return None
    moving = len(recording.things) - len(scene.clutter)
    assert recording.thing_pose is not None
    problem = find_struck(
        scene.clutter, replace(recording, things=recording.things[:moving], thing_pose=recording.thing_pose[:, :moving])
    )
    return ("plan", problem) if problem else None


def moment(action: np.ndarray, motion: Motion, tools: np.ndarray, frame: int) -> Moment:
    """One frame for a success test, from commands [t 16] and measured tool poses [t 2 7], world."""
    gripper = action[frame, [column for _, column in ARMS]]
    return Moment(motion.object_pose[frame], motion.object_joint[frame], tools[frame], gripper, motion.contact[frame])


def _find_lost_hold(scene: Scene, path: ToolPath, motion: Motion) -> tuple[str, str]:
    """The first hold that was not reached or was lost."""
    for hold in path.holds:
        frames = slice(int(hold.start * path.frame_rate), int(hold.end * path.frame_rate) + 1)
        touched = motion.contact[frames, hold.arm, scene.index(hold.name)]
        side = ("left", "right")[hold.arm]
        if not touched.any():
            return "grasp", f"the {side} hand never touched the {hold.name} from {hold.start:.1f} to {hold.end:.1f} s"
        if not touched[-LAST_FRAMES:].any():
            last = frames.start + int(np.flatnonzero(touched)[-1])
            return "slip", f"the {side} hand lost the {hold.name} at {last / path.frame_rate:.1f} s"
    return "timeout", "the plan ended short of success"
