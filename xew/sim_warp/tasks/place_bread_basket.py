"""Task: put one or two pieces of bread into a basket, each with the hand on its side.

Randomization: breads at |x| in [.15, .28], y in [-.20, .02], at least .20 from the basket's middle and .14 apart, turned up
    to 45 degrees from the direction in which their side's arm reaches; three times in four there are two. Basket (fixed) at
    (0, -.15): round or square, yaw within 14 degrees, color; kind, size and color of the breads.
Success: every bread within 60 mm of the basket's middle in x and y and inside it (its bottom below the rim), both grippers
    open.
After RoboTwin 2.0's place_bread_basket, whose free basket stands at y = -.2 with any yaw, and which lets breads fall on each
    other, within 50 mm of the middle.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.assets import containers, household
from xew.sim_warp.assets.household import Thing
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import LEFT, RIGHT, Timeline, Tool
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    HOVER,
    STEEP_TILT,
    Moment,
    Task,
    arm_for,
    aside_poses,
    grasp_across,
    grasp_of,
    graspable_yaw,
    hand_yaw,
    object_axis,
    opening_for,
    pick,
    place,
    point_above,
    share_carried,
)

BASKET = (0.0, -0.15)
HALF = (0.108, 0.082)
"""Half width of the square basket inside [m]."""
RADIUS = 0.112
"""Inner radius of the round one [m]."""
WALL, FLOOR, RIM = 0.007, 0.007, 0.036
"""Thickness of the walls and of the floor, height of the rim [m]: wide hands pass over it with a bread low in them."""
SLOT = 0.043
"""Distance from the middle at which each of two breads goes [m]."""
WITHIN = 0.06
"""Largest offset of a bread from the basket's middle in x and in y [m]."""
LIFT = 0.08
PALM = 0.028
"""Greatest height of a bread above the tool [m]: the shortest fingers reach 39 mm from palm to tool, less the lean."""
WIDEST_TURN = np.radians(45)
"""Largest turn of a hand that leans by `STEEP_TILT` from its radial yaw [rad]."""
WICKER: tuple[Color, ...] = ((196, 152, 92), (158, 108, 62), (214, 184, 132))


def basket(form: str, color: Color) -> Shape:
    """A low wicker basket, woven light and dark, with a cloth in it."""
    shade = objects.darken(color, 0.88)
    if form == "round":
        body = objects.vessel([(RADIUS + WALL, 0), (RADIUS + WALL, RIM)], WALL, color, shade)
        angle = np.arange(36) * 2 * np.pi / 36
        outside = [((RADIUS + WALL) * np.cos(a), (RADIUS + WALL) * np.sin(a), a + np.pi / 2) for a in angle]
        inside = [(RADIUS * np.cos(a), RADIUS * np.sin(a), a + np.pi / 2) for a in angle]
        seen = [body.mesh, _weave(outside, color), _weave(inside, color), *_cloth()]
        return Shape(meshes.merge(seen), body.hulls)
    x, y = HALF
    floor = objects.block((2 * x + WALL, 2 * y + WALL, FLOOR), shade)
    walls = containers.walls((2 * x + 2 * WALL, 2 * y + 2 * WALL), WALL, RIM, color)
    along, deep = (np.linspace(-half + 0.01, half - 0.01, count) for half, count in ((x, 12), (y, 9)))
    spots = [(u, s * w, 0.0) for s in (-1, 1) for w in (y, y + WALL) for u in along]
    spots += [(s * w, v, np.pi / 2) for s in (-1, 1) for w in (x, x + WALL) for v in deep]
    return objects.merge(floor, *walls, Shape(meshes.merge([_weave(spots, color), *_cloth()])))


def _weave(spots: Sequence[tuple[float, float, float]], color: Color) -> Mesh:
    """Alternating dark and light withies on a wall at (x, y, direction along the wall [rad]); decoration."""
    dark, light = objects.darken(color, 0.72), objects.darken(color, 0.94)
    withies = [
        meshes.box((0.0165, 0.0024, 0.008), dark if (number + row) % 2 else light).transformed((x, y, z), (0, 0, angle))
        for number, (x, y, angle) in enumerate(spots)
        for row, z in enumerate((0.009, 0.018, 0.027))
    ]
    return meshes.merge(withies)


def _cloth() -> list[Mesh]:
    """A checked cloth on the floor; decoration."""
    cloth = meshes.box((0.13, 0.11, 0.001), (244, 240, 230)).transformed((0, 0, FLOOR))
    stripes = [
        meshes.box((0.008, 0.11, 0.0016), (196, 74, 66)).transformed((x, 0, FLOOR)) for x in (-0.045, -0.015, 0.015, 0.045)
    ]
    return [
        cloth,
        *stripes,
        *(meshes.box((0.13, 0.008, 0.0014), (222, 140, 132)).transformed((0, y, FLOOR)) for y in (-0.03, 0, 0.03)),
    ]


def sample(rng: np.random.Generator, seed: int) -> Scene:
    count = 1 + int(rng.random() < 0.75)
    starts: list[np.ndarray] = []
    for _ in range(count):
        starts.append(draw(rng, [-0.28, -0.20], [0.28, 0.02], lambda p: _is_free(p, starts)))
    breads = [_bread(rng) for _ in starts]
    form, color = str(rng.choice(["round", "square"])), WICKER[rng.integers(len(WICKER))]
    things = [
        bread.place_at(name, at, graspable_yaw(rng, at, WIDEST_TURN))
        for name, bread, at in zip(("first_bread", "second_bread"), breads, sorted(starts, key=lambda p: p[1]), strict=False)
    ]
    fixed = SceneObject("basket", basket(form, color), upright(BASKET, TABLE_TOP, rng.uniform(-0.25, 0.25)))
    words = {"bread": " and the ".join(bread.words for bread in breads), "form": form}
    return Scene("place_bread_basket", seed, (*things, fixed), words=words)


def _bread(rng: np.random.Generator) -> Thing:
    """A bread with a grasp high enough for clearance between its top and the palm."""
    bread = household.bread(rng)
    return replace(bread, grasp_height=max(bread.grasp_height, bread.height - PALM))


def _is_free(point: np.ndarray, others: list[np.ndarray]) -> bool:
    clear = abs(point[0]) >= 0.15 and np.hypot(*(point - BASKET)) >= 0.2
    return bool(clear and all(np.hypot(*(point - other)) >= 0.14 for other in others))


def breads(scene: Scene) -> list[SceneObject]:
    """The breads, the nearer one first."""
    return [thing for thing in scene.objects if not thing.is_fixed]


def plan(scene: Scene) -> Timeline:
    """Breads on both sides are grasped together and put down left, then right; others one by one, the nearer first."""
    things, goals = breads(scene), _goals(scene)
    timeline = Timeline()
    if len({arm_for(thing.pose[0]) for thing in things}) == 1:
        for thing in things:
            arm = arm_for(thing.pose[0])
            pick(timeline, {arm: grasp_across(thing, STEEP_TILT)}, LIFT)
            _put_bread(timeline, arm, thing, goals[thing.name])
        return timeline
    left, right = sorted(things, key=lambda thing: thing.pose[0])
    pick(timeline, {LEFT: grasp_across(left, STEEP_TILT), RIGHT: grasp_across(right, STEEP_TILT)}, LIFT)
    _put_bread(timeline, LEFT, left, goals[left.name])
    timeline.move(aside_poses([RIGHT]) | {RIGHT: goals[right.name].moved(z=LIFT)})
    _put_bread(timeline, RIGHT, right, goals[right.name])
    return timeline


def _goals(scene: Scene) -> dict[str, Tool]:
    """Release poses of the hand: one bread in the middle, two side by side."""
    fixed, things = scene.object("basket"), _sort_left_to_right(breads(scene))
    sideways = object_axis(fixed.pose, [1.0, 0, 0])
    goals = {}
    for thing, shift in zip(things, [0.0] if len(things) == 1 else [-SLOT, SLOT], strict=True):
        goal = np.array(fixed.pose[:3]) + shift * sideways + [0, 0, FLOOR + HOVER]
        turn = fixed.yaw - hand_yaw(thing)
        goals[thing.name] = grasp_across(thing, STEEP_TILT).carried(thing.pose[:3], goal, turn)
    return goals


def _sort_left_to_right(things: list[SceneObject]) -> list[SceneObject]:
    """Breads in the basket from left to right. Of two on one side, the first one goes to the far place."""
    arms = {arm_for(thing.pose[0]) for thing in things}
    if len(arms) == 2:
        return sorted(things, key=lambda thing: thing.pose[0])
    return things if arms == {RIGHT} else things[::-1]


def _put_bread(timeline: Timeline, arm: int, thing: SceneObject, goal: Tool) -> None:
    place(timeline, arm, thing.name, goal, above=0.05, retreat=LIFT, release=opening_for(grasp_of(thing).width))


def success(scene: Scene, now: Moment) -> bool:
    for thing in breads(scene):
        offset = now.object_pose[scene.index(thing.name), :3] - scene.object("basket").pose[:3]
        if (np.abs(offset[:2]) >= WITHIN).any() or not 0.0 < offset[2] < RIM:
            return False
    return now.both_open


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    middle = point_above(scene.object("basket"), RIM / 2)
    goals = {bread.name: middle for bread in breads(scene)}
    return share_carried(scene, first, now, goals, (WITHIN, WITHIN, RIM / 2))


TASK = Task("place_bread_basket", "put the {bread} into the {form} basket", sample, plan, success, approach)
