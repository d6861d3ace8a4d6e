"""Task: put a phone that lies on its back on a stand, where it leans against the rest.

Randomization: phone at |x| in [.05, .25], y in [-.20, -.05], yaw within 40 degrees; stand (fixed) on the same side at |x| at
    most .15, y in [.02, .12], at least .17 away, turned to the shoulder of that side's arm; size and color of the phone,
    form and color of the stand.
Success: the middle of the phone's lower edge within 45, 40 and 40 mm of its place on the stand's ledge, in x, y and z; the
    phone leans 30 to 50 degrees from lying flat; both grippers open.
After RoboTwin 2.0's place_phone_stand, which does not test the lean, and whose stand holds the phone 27 degrees from
    upright; ours holds it 40 degrees from lying flat, as far as the Piper's wrist turns a hand that takes it from the table.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from xew.sim_warp import objects
from xew.sim_warp.assets import household
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import Timeline, tool
from xew.sim_warp.scene import Scene, SceneObject, draw, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    Moment,
    Task,
    arm_for,
    grasp_of,
    object_axis,
    opening_for,
    pick,
    place,
    radial_yaw,
    share_of_way,
)

LEAN = np.radians(40)
"""Lean of the stand's rest from level [rad]."""
FOOT = np.array([0.0, -0.040, 0.030])
"""Point where the rest meets the ledge, in the stand's frame [m]; the rest rises from there away from the robot."""
GRASP_HEIGHT = 0.0165
"""Height of the tool above the phone's back [m]: a hand that points straight down clears the table with it."""
GAP = 0.0015
"""Distance between phone and stand when it is let go [m]."""
WIDTH = 0.052
"""Width of rest and ledge [m]."""
LEDGE = 0.022
"""Depth of the ledge [m]."""
WITHIN = (0.045, 0.04, 0.04)
"""Largest offset of the phone's lower edge from its place on the ledge [m]."""


def stand(style: str, color: Color) -> Shape:
    """A desk stand: a rest that leans back, a ledge with a lip, and a foot; its front is at -y."""
    dark = objects.darken(color, 0.7)
    rest = _rest_box((WIDTH, 0.100, 0.006), (0, 0.050, -0.003), color)
    ledge = _rest_box((WIDTH, 0.004, LEDGE + 0.010), (0, -0.002, LEDGE / 2 - 0.001), color)
    lip = _rest_box((WIDTH, 0.005, 0.003), (0, 0.0005, LEDGE + 0.0025), dark)
    if style == "easel":
        base = meshes.box((0.07, 0.105, 0.006), dark).transformed((0, 0.0, 0.003))
        behind = [(-0.01, 0.045, 0.004), (0.01, 0.045, 0.004), (-0.01, 0.033, 0.004), (0.01, 0.033, 0.004)]
        at = [tuple(_rest_point((x, y, -0.006))) for x in (-0.01, 0.01) for y in (0.055, 0.070)]
        strut = meshes.hull(np.array([*behind, *at]), dark)
    else:
        base = meshes.box((0.058, 0.105, 0.008), dark).transformed((0, 0.0, 0.004))
        corners = [(side * 0.017, y, 0.006) for side in (-1, 1) for y in (-0.030, 0.042)]
        at = [tuple(_rest_point((side * 0.017, y, -0.006))) for side in (-1, 1) for y in (0.006, 0.080)]
        strut = meshes.hull(np.array([*corners, *at]), color)
    pads = [_rest_box((0.010, 0.050, 0.0008), (side * 0.018, 0.055, 0.0), (40, 40, 42)) for side in (-1, 1)]
    pieces = [rest, ledge, lip, base, strut]
    return Shape(meshes.merge([*pieces, *pads]), tuple(piece.vertices for piece in pieces))


def _rest_point(point: tuple[float, float, float]) -> np.ndarray:
    """A point given along the rest (x, up the slope, out of it) from its foot, in the stand's frame [3]."""
    return FOOT + Rotation.from_euler("x", LEAN).apply(point)


def _rest_box(size: tuple[float, float, float], center: tuple[float, float, float], color: Color) -> Mesh:
    """A box that lies on the rest's slope."""
    return meshes.box(size, color).transformed(tuple(_rest_point(center)), (LEAN, 0, 0))


def sample(rng: np.random.Generator, seed: int) -> Scene:
    side = np.array([rng.choice([-1.0, 1.0]), 1.0])
    start = rng.uniform([0.05, -0.20], [0.25, -0.05]) * side
    place_ = draw(rng, [0.0, 0.02], [0.15, 0.12], lambda p: np.hypot(*(p * side - start)) >= 0.17) * side
    phone = household.phone(rng)
    colors = {name: household.COLORS[name] for name in ("black", "gray", "teal", "orange", "blue", "pink")} | {
        "white": (232, 232, 228)
    }
    color = str(rng.choice(sorted(colors)))
    shape = stand(str(rng.choice(["easel", "wedge"])), colors[color])
    turn = radial_yaw(arm_for(start[0]), place_)
    return Scene(
        "place_phone_stand",
        seed,
        (
            phone.place_at("phone", start, rng.uniform(-0.7, 0.7)),
            SceneObject("stand", shape, upright(place_, TABLE_TOP, turn)),
        ),
        words={"phone": phone.words, "color": color},
    )


def _lower_edge(thing: SceneObject) -> np.ndarray:
    """[3] middle of a phone's lower edge at its back, in its own frame."""
    return np.array([0.0, thing.shape.hulls[0][:, 1].min(), 0.0])


def _edge_place(scene: Scene, now: Moment) -> np.ndarray:
    """[3] the middle of the phone's lower edge, world."""
    pose = now.object_pose[scene.index("phone")]
    return pose[:3] + object_axis(pose, _lower_edge(scene.object("phone")))


def ledge(scene: Scene) -> np.ndarray:
    """[3] where that edge comes to rest, world."""
    thing = scene.object("stand")
    return np.array(thing.pose[:3]) + object_axis(thing.pose, FOOT)


def plan(scene: Scene) -> Timeline:
    thing, support = scene.object("phone"), scene.object("stand")
    arm = arm_for(thing.pose[0])
    start = np.array(thing.pose[:3])
    grasp = tool(start + [0, 0, GRASP_HEIGHT], thing.yaw)
    leaning = Rotation.from_quat(support.pose[3:]) * Rotation.from_euler("x", LEAN)
    middle = ledge(scene) + leaning.apply(np.array([0, GAP, GAP]) - _lower_edge(thing))
    goal = tool(middle + leaning.apply([0, 0, GRASP_HEIGHT]), support.yaw, LEAN)
    timeline = Timeline()
    pick(timeline, {arm: grasp}, lift=0.06)
    place(timeline, arm, "phone", goal, above=0.05, retreat=0.07, release=opening_for(grasp_of(thing).width))
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    pose = now.object_pose[scene.index("phone")]
    offset = np.abs(_edge_place(scene, now) - ledge(scene))
    lean = np.degrees(np.arccos(np.clip(object_axis(pose, [0, 0, 1])[2], -1, 1)))
    return bool((offset < WITHIN).all() and 30 < lean < 50 and now.both_open)


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    start, end = (_edge_place(scene, moment) for moment in (first, now))
    return share_of_way(start, end, ledge(scene), WITHIN)


TASK = Task("place_phone_stand", "put the {phone} on the {color} phone stand", sample, plan, success, approach)
