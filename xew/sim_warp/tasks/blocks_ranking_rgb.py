"""Task: put a red, a green and a blue block in a row, from left to right, one hand at a time.

Randomization: three cubes of one size (half edge 15 to 25 mm) at |x| in [.05, .28], y in [-.08, .05] (y at most 0 where
    |x| < .15), any yaw within 43 degrees, at least .10 apart; never in order already. The row's y and its three x
    vary too.
Success: red left of green left of blue, neighbors within 130 mm in x and 30 mm in y, both grippers open.
After RoboTwin 2.0's blocks_ranking_rgb.
"""

from collections.abc import Callable

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.geometry.poses import Pose
from xew.sim_warp.plan import Timeline, tool
from xew.sim_warp.scene import Point, Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import STEEP_TILT, Moment, Task, arm_for, pick, place, share_carried, symmetric_yaw

COLORS = ("red", "green", "blue")
GRASP_BELOW_TOP = 0.014
"""Depth of the tool below the top of a block [m]; a wide hand passes over the neighboring blocks."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    half = rng.uniform(0.015, 0.025)
    targets = [rng.uniform(low, high) for low, high in ((-0.09, -0.08), (-0.01, 0.01), (0.08, 0.09))]
    row = rng.uniform(-0.2, -0.1)
    starts = draw_starts(rng, is_free)
    yaws = rng.uniform(-0.75, 0.75, 3)
    blocks = tuple(
        cube(f"{color}_block", half, color, 400, upright(start, TABLE_TOP, yaw))
        for color, start, yaw in zip(COLORS, starts, yaws, strict=True)
    )
    row_targets = {block.name: (float(x), float(row)) for block, x in zip(blocks, targets, strict=True)}
    return Scene("blocks_ranking_rgb", seed, blocks, targets=row_targets)


def cube(name: str, half: float, color: str, density: float, pose: Pose) -> SceneObject:
    """A block of half an edge `half` [m], a color's name and a density [kg/m^3]."""
    return SceneObject(
        name, objects.block((2 * half,) * 3, objects.PALETTE[color]), pose, mass=float(density * (2 * half) ** 3)
    )


def draw_starts(
    rng: np.random.Generator, accept: Callable[[np.ndarray, list[np.ndarray]], bool], count: int = 3
) -> list[np.ndarray]:
    """Initial points [2] of blocks that are not in order; `accept` gets each with the points before it."""
    starts: list[np.ndarray] = []
    while not starts or are_in_order(np.array(starts)):
        starts = []
        for _ in range(count):
            starts.append(draw(rng, [-0.28, -0.08], [0.28, 0.05], lambda p: accept(p, starts)))  # noqa: B023
    return starts


def is_free(point: np.ndarray, others: list[np.ndarray]) -> bool:
    """Whether `point` [2] is clear of the row's middle and of the `others` [2]."""
    x, y = point
    if abs(x) < 0.05 or (abs(x) < 0.15 and y > 0) or np.hypot(x, y + 0.1) < 0.1:
        return False
    return all(np.hypot(*(point - other)) >= 0.1 for other in others)


def are_in_order(positions: np.ndarray) -> bool:
    """Whether blocks at [3 2] are in a row in their order, each a little to the right of the one before."""
    step = np.diff(positions, axis=0)
    return bool((step[:, 0] > 0).all() and (step[:, 0] < 0.13).all() and (np.abs(step[:, 1]) < 0.03).all())


def plan(scene: Scene) -> Timeline:
    timeline = Timeline()
    for block in scene.objects:
        move_block(timeline, block, scene.targets[block.name])
    return timeline


def move_block(timeline: Timeline, block: SceneObject, target: Point, *, opening: float = 0.8, release: float = 0.7) -> None:
    """Put a block down squarely at `target` [2]; `opening` and `release` are gripper values before and after the grasp."""
    arm = arm_for(block.pose[0])
    height = TABLE_TOP + float(block.shape.mesh.vertices[:, 2].max()) - GRASP_BELOW_TOP
    grasp = tool((*block.pose[:2], height), symmetric_yaw(arm, block.pose, block.yaw, np.pi / 2), STEEP_TILT)
    goal = tool((*target, height + 0.002), symmetric_yaw(arm, target, 0.0, np.pi / 2), STEEP_TILT)
    pick(timeline, {arm: grasp}, lift=0.08, opening=opening)
    place(timeline, arm, block.name, goal, above=0.07, retreat=0.09, release=release)


def success(scene: Scene, now: Moment) -> bool:
    """Whether the scene's objects, the blocks from left to right, are in order."""
    return are_in_order(now.object_pose[:, :2]) and now.both_open


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    """The mean share of the blocks' ways to their targets."""
    goals = {name: (*target, TABLE_TOP) for name, target in scene.targets.items()}
    return share_carried(scene, first, now, goals, (0.02, 0.02, 0.01))


TASK = Task(
    "blocks_ranking_rgb",
    "put the red, the green and the blue block in a row from left to right",
    sample,
    plan,
    success,
    approach,
)
