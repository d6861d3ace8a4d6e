"""Task: open a laptop with one hand, a finger under the edge of its lid.

Randomization: center at |x| at most .05, y in [-.08, .03]; its front turned up to 45 degrees to the left or right (the arm
    on that side works); size of the lid, color. The lid begins at 20 % of its range, the base is fixed.
Success: lid open beyond 40 % of its range, the tool within 10 cm of the lid's free edge.
After RoboTwin 2.0's open_laptop, whose front turns up to 60 degrees and whose expert grasps the lid.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import LEFT, RIGHT, Timeline, Tool, tool
from xew.sim_warp.scene import Hinge, Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import GRASP_TILT, Moment, Task, aside_poses, hinge_of, lid_point, radial_yaw, share_turned

BASE_HEIGHT = 0.016
LID_THICKNESS = 0.009
RANGE = 3.1
"""Range of the hinge [rad], the largest of RoboTwin's laptops: 20 % of it is wide enough for a hand."""
START, GOAL, DONE = 0.2, 0.47, 0.4
"""Shares of the range: initial, the expert's goal, and open."""
FINGER_HALF_WIDTH = 0.011
"""Half width of every robot's pads along the tool's z [m]."""
PRESS = 0.004
"""Distance of the commanded tool beyond contact [m], against the hinge's friction."""
RUN_UP = 0.06
"""Distance before the lid at which the finger comes down [m]."""
WIDEST_TURN = np.radians(30)
"""Largest turn of the hand from its radial yaw toward the laptop's own [rad]."""


def laptop(width: float, depth: float, color: objects.Color) -> tuple[Shape, Hinge]:
    """The fixed base and the lid; the front is at -y, the hinge along the edge at +y."""
    deck = objects.move(objects.block((width * 0.8, depth * 0.4, 0.001), (45, 45, 48)), (0, depth * 0.12, BASE_HEIGHT))
    base = objects.merge(objects.block((width, depth, BASE_HEIGHT), color), Shape(deck.mesh))
    screen = objects.move(objects.block((width * 0.92, depth * 0.86, 0.001), (25, 35, 60)), (0, 0, BASE_HEIGHT + 0.001))
    panel = objects.move(objects.block((width, depth - 0.008, LID_THICKNESS), color), (0, -0.004, BASE_HEIGHT + 0.002))
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
    return Scene("open_laptop", seed, (SceneObject("laptop", base, upright((x, y), TABLE_TOP, yaw), hinge=hinge),))


def lid_edge(scene: Scene, fraction: float) -> np.ndarray:
    """[3] world position of the middle of the lid's free edge, inner side, at a fraction of the hinge's range."""
    laptop = scene.object("laptop")
    hinge = hinge_of(laptop)
    reach = hinge.anchor[1] - hinge.lid.hulls[0][:, 1].min()
    return lid_point(laptop, [0, -reach, -LID_THICKNESS / 2], fraction)


def _pushing_pose(scene: Scene, arm: int, fraction: float, short_by: float) -> Tool:
    """The closed hand with its far side at the lid's edge, moved back toward the laptop's front by `short_by` [m]."""
    edge, yaw = lid_edge(scene, fraction), scene.object("laptop").yaw
    radial = radial_yaw(arm, edge)
    hand = tool(edge, radial + np.clip(yaw - radial, -WIDEST_TURN, WIDEST_TURN), GRASP_TILT)
    ahead = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return Tool(edge - FINGER_HALF_WIDTH * hand.rotation.apply([0, 0, 1]) - short_by * ahead, hand.rotation)


def plan(scene: Scene) -> Timeline:
    arm = RIGHT if scene.object("laptop").yaw > 0 else LEFT
    timeline = Timeline()
    timeline.grip({arm: 0.0})
    before = _pushing_pose(scene, arm, START, RUN_UP)
    timeline.move(aside_poses([arm]) | {arm: before.moved(z=0.05)})
    timeline.move({arm: before})
    timeline.move({arm: _pushing_pose(scene, arm, START, 0.0)})
    timeline.follow(
        arm, [_pushing_pose(scene, arm, fraction, -PRESS) for fraction in np.linspace(START, GOAL, 16)[1:]], seconds=2.4
    )
    timeline.wait(0.2)
    timeline.hold(arm, "laptop")
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    fraction = hinge_of(scene.object("laptop")).fraction(now.object_joint[scene.index("laptop")])
    near = np.linalg.norm(now.tool_pose[:, :3] - lid_edge(scene, fraction), axis=-1).min() < 0.1
    return bool(fraction > DONE and near)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_turned(scene, first, now, "laptop", DONE)


TASK = Task("open_laptop", "open the laptop with one arm", sample, plan, success, approach)
