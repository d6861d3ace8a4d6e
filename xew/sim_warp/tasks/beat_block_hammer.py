"""Task: pick up a hammer and strike a block with its face.

Randomization: the block (fixed to the table) at |x| in [.05, .25], y in [-.05, .15], yaw within 29 degrees; its color.
    The hammer stands on its head at (0, -.06), its handle toward the robot.
Success: the center of the hammer's face within 20 mm of the block's top center in x and y, and on it (6 mm).
After RoboTwin 2.0's beat_block_hammer.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.geometry import meshes
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import Timeline, tool
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import GRASP_TILT, Moment, Task, arm_for, object_axis, pick, point_above, share_carried

HEAD_SIZE = (0.05, 0.05, 0.07)
HANDLE_HEIGHT = 0.045
"""Height of the handle's axis above the hammer's face [m]."""
HANDLE_LENGTH = 0.11
GRIP_AT = -0.075
"""Place of the grasp along y in the hammer's frame [m]."""
BLOCK = 0.05
WITHIN = (0.02, 0.02, 0.006)
"""Largest offset from the goal in x, y and z [m]."""


def hammer() -> Shape:
    """A mallet whose face is its frame's origin; the handle points along -y, light enough that it stands on its head."""
    head = objects.block(HEAD_SIZE, (95, 98, 105))
    face = objects.move(objects.block((0.036, 0.036, 0.004), (60, 62, 66)), (0, 0, HEAD_SIZE[2]))
    handle = meshes.box((0.02, HANDLE_LENGTH, 0.022), (165, 105, 55))
    handle = handle.transformed((0, -HEAD_SIZE[1] / 2 - HANDLE_LENGTH / 2, HANDLE_HEIGHT))
    return objects.merge(head, Shape(face.mesh), Shape(handle, (handle.vertices,)))


def sample(rng: np.random.Generator, seed: int) -> Scene:
    x, y = draw(rng, [-0.25, -0.05], [0.25, 0.15], lambda p: abs(p[0]) >= 0.05 and np.hypot(*(p - [0, -0.06])) > 0.1)
    yaw = rng.uniform(-0.5, 0.5)
    color = rng.choice(sorted(objects.PALETTE))
    return Scene(
        "beat_block_hammer",
        seed,
        (
            SceneObject("hammer", hammer(), upright((0, -0.06), TABLE_TOP), mass=0.15),
            SceneObject("block", objects.block((BLOCK,) * 3, objects.PALETTE[color]), upright((x, y), TABLE_TOP, yaw)),
        ),
        words={"color": str(color)},
    )


def plan(scene: Scene) -> Timeline:
    start, block = np.array(scene.object("hammer").pose[:3]), scene.object("block")
    arm = arm_for(block.pose[0])
    grasp = tool(start + [0, GRIP_AT, HANDLE_HEIGHT], 0.0, GRASP_TILT)
    strike = grasp.moved(*(np.array(block.pose[:3]) - start)).moved(z=BLOCK - 0.002)
    timeline = Timeline()
    pick(timeline, {arm: grasp}, lift=0.09)
    timeline.move({arm: strike.moved(z=0.06)})
    timeline.move({arm: strike})
    timeline.wait(0.24)
    timeline.hold(arm, "hammer")
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    hammer = now.object_pose[scene.index("hammer")]
    offset = np.abs(hammer[:3] - np.array(scene.object("block").pose[:3]) - [0, 0, BLOCK])
    return bool((offset < WITHIN).all() and object_axis(hammer, [0, 0, 1])[2] > 0.9)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_carried(scene, first, now, {"hammer": point_above(scene.object("block"), BLOCK)}, WITHIN)


TASK = Task("beat_block_hammer", "pick up the hammer and hit the {color} block", sample, plan, success, approach)
