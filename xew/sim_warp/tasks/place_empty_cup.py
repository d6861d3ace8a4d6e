"""Task: put an empty cup on a coaster, with one hand by the rim.

Randomization: cup at |x| in [.15, .30], y in [-.20, .05]; coaster near the middle on the same side, at least .12 away;
    size and color of the cup, color of the coaster.
Success: cup within 35 mm of the coaster's center and standing on it (15 mm), both grippers open.
After RoboTwin 2.0's place_empty_cup.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task, carry_by_rim, point_above, share_carried, vessel_pose

COASTER_HEIGHT = 0.008
WALL = 0.005
RIM_DEPTH = 0.008


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = rng.choice([-1.0, 1.0])
    cup = rng.uniform([0.15, -0.20], [0.30, 0.05]) * [side, 1]
    coaster = draw(rng, [-0.05, -0.20], [0.10, 0.05], lambda p: np.hypot(*(p * [side, 1] - cup)) >= 0.12) * [side, 1]
    height, radius = rng.uniform([0.078, 0.038], [0.092, 0.043])
    colors = rng.permutation(sorted(objects.PALETTE))
    shape = objects.vessel([(radius - 0.008, 0), (radius, height)], WALL, objects.PALETTE[colors[0]], (235, 232, 225))
    return Scene(
        "place_empty_cup",
        seed,
        (
            SceneObject("cup", shape, vessel_pose(cup), mass=0.12),
            SceneObject(
                "coaster", objects.disc(0.055, COASTER_HEIGHT, objects.PALETTE[colors[1]]), upright(coaster, TABLE_TOP)
            ),
        ),
        words={"color": colors[0]},
    )


def plan(scene: Scene) -> Timeline:
    goal = point_above(scene.object("coaster"), COASTER_HEIGHT + 0.002)
    timeline = Timeline()
    carry_by_rim(timeline, scene.object("cup"), goal, WALL, RIM_DEPTH)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    goal = point_above(scene.object("coaster"), COASTER_HEIGHT)
    offset = now.object_pose[scene.index("cup"), :3] - goal
    return bool(np.hypot(*offset[:2]) < 0.035 and abs(offset[2]) < 0.015 and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    goal = point_above(scene.object("coaster"), COASTER_HEIGHT)
    return share_carried(scene, first, now, {"cup": goal}, (0.025, 0.025, 0.015))


TASK = Task("place_empty_cup", "place the empty {color} cup on the coaster", sample, plan, success, approach)
