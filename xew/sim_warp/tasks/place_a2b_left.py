"""Task: put one everyday thing to the left of another.

Randomization: two different things A and B out of mouse, stapler, bell, toy car, magic cube, bread, phone, playing cards,
    wooden block, tea box, coffee box, soap, each a random variant. A at |x| in [.02, .22], y in [-.20, 0], its long side
    within 55 degrees of the direction from its arm's shoulder, either way round. B at y in [-.20, 0], any yaw, x in
    [.18, .23] if A is on the right, else in [-.10, .10]; the two at least .10 apart in y and 35 mm free of each other.
Success: A left of B, between .08 and .20 away, within 50 mm of it in y, both grippers open.
After RoboTwin 2.0's place_a2b_left, whose expert puts A 13 cm beside B; here up to 18 cm, where the two or the palm of a wide
    hand would touch otherwise.
"""

import numpy as np

from xew.sim_warp.assets import household
from xew.sim_warp.assets.household import Thing
from xew.sim_warp.plan import Timeline
from xew.sim_warp.scene import Scene, SceneObject, draw
from xew.sim_warp.tasks.task import Moment, Task, carry, easy_turn, grasp_of, graspable_yaw, share_of_way

KINDS = (
    "bell", "bread", "coffee_box", "mouse", "phone", "playing_cards", "rubik_cube", "soap", "stapler", "tea_box", "toy_car",
    "wooden_block",
)  # fmt: skip
LEFT_OF, RIGHT_OF = -1.0, 1.0
"""Sign of x from B to the place for A."""
BESIDE = 0.13
"""Target distance between A and B [m]."""
GAP = 0.035
"""Free space between them, for a finger [m]."""
OVER = 0.08
"""Height at which A is carried [m], above any B."""
PALM_HALF_WIDTH = 0.108
"""Half width of the widest palm, the Panda's, with a margin [m]; B must be lower or farther away."""
MARGIN = 0.02
"""Margin of the target distance to FARTHEST [m]."""
NEAREST, FARTHEST = 0.08, 0.2
"""Range of successful distances between A and B [m]."""


def sample_beside(rng: np.random.Generator, task: str, seed: int, side: float) -> Scene:
    """A scene of things A and B in which A is to be put on the `side` of B: `LEFT_OF` or `RIGHT_OF`."""
    kinds = rng.permutation(KINDS)
    first, second = (household.THINGS[str(kind)](rng) for kind in kinds[:2])
    half = rng.choice([-1.0, 1.0])
    mirror = np.array([half, 1, -side, 1])
    # A must fit between B and the end of the arm's reach.
    near, far = (0.18, 0.23) if half == -side else (-0.1, 0.1)
    low, high = [0.02, -0.2, near, -0.2], [0.22, 0.0, far, 0.0]
    positions = draw(rng, low, high, lambda p: _are_apart(p * mirror, first, second, side))
    first_xy, second_xy = np.split(positions * mirror, 2)
    return Scene(
        task,
        seed,
        (
            first.place_at("a", first_xy, graspable_yaw(rng, first_xy)),
            second.place_at("b", second_xy, rng.uniform(-np.pi, np.pi)),
        ),
        words={"a": first.words, "b": second.words},
    )


def _are_apart(positions: np.ndarray, first: Thing, second: Thing, side: float) -> bool:
    """Whether A and B, at [4] x y x y, are apart and A is not at its goal."""
    offset = positions[2:] - positions[:2]
    free = np.hypot(*offset) >= max(0.1, first.radius + second.radius + GAP) and abs(offset[1]) >= 0.1
    return bool(free and (np.hypot(*offset) > FARTHEST - 0.01 or side * offset[0] > 0))


def plan_beside(scene: Scene, side: float) -> Timeline:
    """Put A on the `side` of B, at any yaw."""
    first, second = scene.object("a"), scene.object("b")
    goal = np.array(second.pose[:3]) + [side * BESIDE, 0, 0]
    for _ in range(3):  # the distance depends on the turn, and the turn on the goal
        goal[0] = second.pose[0] + side * _distance(first, second, first.yaw + easy_turn(first, goal))
    timeline = Timeline()
    carry(timeline, first, goal, easy_turn(first, goal), lift=OVER, above=OVER)
    return timeline


def _distance(first: SceneObject, second: SceneObject, yaw: float) -> float:
    """Distance from B at which A, turned to `yaw` [rad], fingers and palm stay clear of B [m]."""
    distance = _half_extent(first, yaw) + _half_extent(second, second.yaw) + GAP
    if second.shape.mesh.vertices[:, 2].max() > grasp_of(first).height + household.PALM:
        distance = max(distance, PALM_HALF_WIDTH + _half_extent(second, second.yaw))
    return float(np.clip(distance, BESIDE, FARTHEST - MARGIN))


def _half_extent(thing: SceneObject, yaw: float) -> float:
    """Half extent along x of an object turned by `yaw` [rad], from its origin [m]."""
    points = np.concatenate(thing.shape.hulls)
    return float(np.abs(points[:, 0] * np.cos(yaw) - points[:, 1] * np.sin(yaw)).max())


def is_beside(scene: Scene, now: Moment, side: float) -> bool:
    """Whether A is on the `side` of B at a successful distance, with open grippers."""
    first, second = (now.object_pose[scene.index(name), :2] for name in ("a", "b"))
    offset = first - second
    there = side * offset[0] > 0 and abs(offset[1]) < 0.05 and NEAREST < np.hypot(*offset) < FARTHEST
    return bool(there and now.both_open)


def sample(rng: np.random.Generator, seed: int) -> Scene:
    return sample_beside(rng, "place_a2b_left", seed, LEFT_OF)


def plan(scene: Scene) -> Timeline:
    return plan_beside(scene, LEFT_OF)


def success(scene: Scene, now: Moment) -> bool:
    return is_beside(scene, now, LEFT_OF)


def share_beside(scene: Scene, first: Moment, now: Moment, side: float) -> float:
    """The share of A's way to the successful distances on the `side` of B."""
    start, end = (
        moment.object_pose[scene.index("a"), :2] - moment.object_pose[scene.index("b"), :2] for moment in (first, now)
    )
    return share_of_way(start, end, (side * (NEAREST + FARTHEST) / 2, 0.0), ((FARTHEST - NEAREST) / 2, 0.05))


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_beside(scene, first, now, LEFT_OF)


TASK = Task("place_a2b_left", "place the {a} to the left of the {b}", sample, plan, success, approach)
