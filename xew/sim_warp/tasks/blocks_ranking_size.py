"""Task: put three blocks in a row by size, the largest on the left, one hand at a time.

Randomization: three cubes of half edges 28 to 31, 23 to 26 and 18 to 21 mm in three colors at |x| in [.05, .28], y in
    [-.08, .05] (y at most 0 where |x| < .15), any yaw within 43 degrees, at least .12 apart and .10 from the places of the
    row; never in order already. The row's y and its three x vary too.
Success: large left of medium left of small, neighbors within 130 mm in x and 30 mm in y, both grippers open.
After RoboTwin 2.0's blocks_ranking_size, whose large block is 60 to 66 mm wide (the narrowest of our hands opens 80 mm) and
    whose medium block goes within 70 mm of the small one, where a wide hand has no room between them.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.blocks_ranking_rgb import approach, cube, draw_starts, is_free, move_block, success
from xew.sim_warp.tasks.task import Task, opening_for

SIZES = {"large": (0.028, 0.031), "medium": (0.023, 0.026), "small": (0.018, 0.021)}
"""Half edges [m], from the left end of the row to the right."""
ROW = ((-0.10, -0.09), (-0.005, 0.005), (0.09, 0.10))
"""Place of each size along x in the row [m]."""


def sample(rng: np.random.Generator, seed: int) -> Scene:
    halves = [rng.uniform(low, high) for low, high in SIZES.values()]
    row = rng.uniform(-0.2, -0.1)
    targets = [np.array([rng.uniform(low, high), row]) for low, high in ROW]
    starts = draw_starts(rng, lambda point, others: _is_free(point, others, targets))
    yaws = rng.uniform(-0.75, 0.75, 3)
    colors = [str(color) for color in rng.permutation(sorted(objects.PALETTE))]
    blocks = tuple(
        cube(f"{size}_block", half, color, 700, upright(start, TABLE_TOP, yaw))
        for size, half, color, start, yaw in zip(SIZES, halves, colors, starts, yaws, strict=False)
    )
    row_targets = {block.name: (float(x), float(y)) for block, (x, y) in zip(blocks, targets, strict=True)}
    return Scene("blocks_ranking_size", seed, blocks, words=dict(zip(SIZES, colors, strict=False)), targets=row_targets)


def _is_free(point: np.ndarray, others: list[np.ndarray], targets: list[np.ndarray]) -> bool:
    off_row = all(np.hypot(*(point - target)) >= 0.1 for target in targets)
    return off_row and is_free(point, others) and all(np.hypot(*(point - other)) >= 0.12 for other in others)


def plan(scene: Scene) -> Timeline:
    """Small, medium, large: a hand is always higher than the placed blocks."""
    timeline = Timeline()
    for block in reversed(scene.objects):
        width = float(np.ptp(block.shape.mesh.vertices[:, 0]))
        target = scene.targets[block.name]
        move_block(timeline, block, target, opening=opening_for(width, 0.020), release=opening_for(width))
    return timeline


TASK = Task(
    "blocks_ranking_size",
    "line up the {large}, the {medium} and the {small} block from the largest to the smallest, from left to right",
    sample,
    plan,
    success,
    approach,
)
