"""Task: stack two bowls in the middle, the nearer one first, each hand serving its own side.

Randomization: two equal bowls at |x| in [.09, .30], y in [-.15, .15] (y at most 0 where |x| < .15), at least .15 apart and
    .15 from the place of the stack; size and colors.
Success: centers within 40 mm in x and y, the lower bowl on the table (below .76), the upper inside it (between 10 and
    45 mm higher), both grippers open. (RoboTwin 2.0 tests only upper bounds of the heights.)
After RoboTwin 2.0's stack_bowls_two.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, draw
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task, carry_by_rim, share_carried, share_of_way, vessel_pose

STACK = (0.0, -0.1)
WALL = 0.004
NESTING = 0.022
"""Height of the upper bowl above the lower when they are nested [m]."""
RIM_DEPTH = 0.006


def sample(rng: np.random.Generator, seed: int) -> Scene:
    radius = rng.uniform(0.054, 0.062)
    first = draw(rng, [-0.30, -0.15], [0.30, 0.15], lambda p: _is_free(p, []))
    second = draw(rng, [-0.30, -0.15], [0.30, 0.15], lambda p: _is_free(p, [first]))
    nearer, farther = sorted((first, second), key=lambda p: p[1])
    colors = rng.permutation(sorted(objects.PALETTE))
    outline = [(radius - 0.026, 0), (radius - 0.006, 0.02), (radius, 0.05)]
    bowls = tuple(
        SceneObject(
            name,
            objects.vessel(outline, WALL, objects.PALETTE[color], (238, 236, 230)),
            vessel_pose(at),
            mass=0.12,
        )
        for name, at, color in (("lower_bowl", nearer, colors[0]), ("upper_bowl", farther, colors[1]))
    )
    return Scene("stack_bowls_two", seed, bowls, words={"lower": colors[0], "upper": colors[1]})


def _is_free(point: np.ndarray, others: list[np.ndarray]) -> bool:
    x, y = point
    if abs(x) < 0.09 or (abs(x) < 0.15 and y > 0) or np.hypot(x - STACK[0], y - STACK[1]) < 0.15:
        return False
    return all(np.hypot(*(point - other)) >= 0.15 for other in others)


def plan(scene: Scene) -> Timeline:
    timeline = Timeline()
    for bowl, height in zip(scene.objects, (0.0, NESTING), strict=True):
        goal = np.array([*STACK, TABLE_TOP + height + 0.003])
        carry_by_rim(timeline, bowl, goal, WALL, RIM_DEPTH, lift=0.10, above=0.08, retreat=0.09)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    lower, upper = (now.object_pose[scene.index(name), :3] for name in ("lower_bowl", "upper_bowl"))
    apart = np.abs(upper - lower)
    nested = 0.01 < upper[2] - lower[2] < 0.045
    return bool((apart[:2] < 0.04).all() and lower[2] < 0.76 and nested and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    """The mean share of the lower bowl's way to the stack, and of the upper bowl's way into the lower one."""
    middle = (*STACK, TABLE_TOP)
    to_stack = share_carried(scene, first, now, {"lower_bowl": middle}, (0.04, 0.04, 0.01))
    start, end = (moment.object_pose[1, :3] - moment.object_pose[0, :3] for moment in (first, now))
    return (to_stack + share_of_way(start, end, (0.0, 0.0, NESTING), (0.04, 0.04, 0.012))) / 2


TASK = Task("stack_bowls_two", "stack the {upper} bowl on the {lower} bowl", sample, plan, success, approach)
