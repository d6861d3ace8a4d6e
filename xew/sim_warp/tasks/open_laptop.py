"""Task: open a laptop by its lid with one hand.

Randomisation: centre at |x| at most .05, y in [-.08, .03]; its front turned up to 45 degrees to the left or right (the arm
    on that side works); size of the lid, colour. The lid begins at 20 % of its range, the base is fixed.
Success: lid open beyond 40 % of its range, the tool within 10 cm of the lid's free edge.
After RoboTwin 2.0's open_laptop, whose front turns up to 60 degrees.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp import objects
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import LEFT, RIGHT, Timeline, Tool, tool
from xew.sim_warp.scene import Hinge, Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import PRE_GRASP, Moment, Task

BASE_HEIGHT = 0.016
LID_THICKNESS = 0.009
RANGE = 2.3
"""rad, of the hinge."""
START, GOAL, DONE = 0.2, 0.52, 0.4
"""Shares of the range at which the lid begins, to which the expert opens it, and from which it counts as open."""
GRASP_FROM_EDGE = 0.012
OPENING = 0.45


def laptop(width: float, depth: float, color: objects.Color) -> tuple[Shape, Hinge]:
    """The fixed base and the lid; the front is at -y, the hinge along the edge at +y."""
    deck = objects.moved(objects.block((width * 0.8, depth * 0.4, 0.001), (45, 45, 48)), (0, depth * 0.12, BASE_HEIGHT))
    base = objects.merge(objects.block((width, depth, BASE_HEIGHT), color), Shape(deck.mesh))
    screen = objects.moved(objects.block((width * 0.92, depth * 0.86, 0.001), (25, 35, 60)), (0, 0, BASE_HEIGHT + 0.001))
    panel = objects.moved(objects.block((width, depth - 0.008, LID_THICKNESS), color), (0, -0.004, BASE_HEIGHT + 0.002))
    hinge = Hinge(
        lid=objects.merge(panel, Shape(screen.mesh)),
        mass=0.12,
        anchor=(0.0, depth / 2 - 0.004, BASE_HEIGHT + 0.002 + LID_THICKNESS / 2),
        axis=(-1.0, 0.0, 0.0),
        lower=0.0,
        upper=RANGE,
        start=START * RANGE,
        friction=0.15,
        damping=0.05,
    )
    return base, hinge


def sample(rng: np.random.Generator, seed: int) -> Scene:
    x, y = rng.uniform([-0.05, -0.08], [0.05, 0.03])
    yaw = rng.choice([-1, 1]) * rng.uniform(0.05, np.radians(45))
    width, depth = rng.uniform([0.19, 0.14], [0.21, 0.16])
    color = [(150, 152, 158), (70, 72, 80), (190, 170, 150)][rng.integers(3)]
    base, hinge = laptop(width, depth, color)
    return Scene("open_laptop", seed, (SceneObject("laptop", base, upright(x, y, TABLE_TOP, yaw), hinge=hinge),))


def lid_grasp(scene: Scene, fraction: float) -> Tool:
    """The grasp of the lid's free edge, fingers on both of its faces, when it is open by a fraction of its range."""
    thing = scene.object("laptop")
    hinge, yaw = thing.hinge, _yaw(thing)
    angle = hinge.lower + fraction * (hinge.upper - hinge.lower)
    reach = -hinge.lid.hulls[0][:, 1].min() + hinge.anchor[1] - GRASP_FROM_EDGE
    local = np.array(hinge.anchor) + reach * np.array([0, -np.cos(angle), np.sin(angle)])
    position = np.array(thing.pose[:3]) + Rotation.from_euler("z", yaw).apply(local)
    return tool(position, yaw, tilt=np.pi / 2 - angle, roll=np.pi / 2)


def plan(scene: Scene) -> Timeline:
    arm = RIGHT if _yaw(scene.object("laptop")) > 0 else LEFT
    grasp = lid_grasp(scene, START)
    timeline = Timeline()
    timeline.grip({arm: OPENING}, seconds=0.3)
    timeline.move({arm: grasp.backed(PRE_GRASP)})
    timeline.move({arm: grasp})
    timeline.grip({arm: 0.0})
    timeline.follow(arm, [lid_grasp(scene, fraction) for fraction in np.linspace(START, GOAL, 12)[1:]], seconds=1.8)
    timeline.wait(0.2)
    timeline.hold(arm, "laptop", timeline.grips[arm][-1][0])
    return timeline


def _yaw(thing: SceneObject) -> float:
    return float(2 * np.arctan2(thing.pose[5], thing.pose[6]))


def success(scene: Scene, now: Moment) -> bool:
    index = scene.index("laptop")
    fraction = scene.objects[index].hinge.fraction(now.object_joint[index])
    edge = lid_grasp(scene, fraction).position
    near = np.linalg.norm(now.tool_pose[:, :3] - edge, axis=-1).min() < 0.1
    return bool(fraction > DONE and near)


TASK = Task("open_laptop", "open the laptop with one arm", sample, plan, success)
