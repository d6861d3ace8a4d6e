"""Task: put a burger and a portion of fries on a tray, both grasped at once, set down one after the other.

Randomization: tray (fixed) in the middle at y in [-.15, -.10]; burger at x in [-.30, -.25], fries at x in [.20, .30], both at
    y in [-.15, -.07]; filling and size of the burger, color and size of the carton, color of the tray.
Success: burger within 80 mm of the middle of the tray's left half, fries of its right half, both on the tray (15 mm), both
    grippers open. (RoboTwin 2.0 does not test the height.)
After RoboTwin 2.0's place_burger_fries.
"""

import numpy as np

from xew.sim_warp import objects
from xew.sim_warp.assets import containers
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.meshes import Color, Mesh
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import LEFT, RIGHT, Timeline, tool
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import (
    STEEP_TILT,
    Moment,
    Task,
    aside_poses,
    pick,
    place,
    point_above,
    radial_turn,
    radial_yaw,
    share_carried,
)

TRAY = (0.30, 0.19)
"""Outer size of the tray [m]."""
TRAY_FLOOR = 0.006
SPOT = 0.073
"""Distance of the two places on the tray from its middle, in x [m]."""
LIFT = 0.08
SIDES = 12
"""Number of flat sides of the burger, on which pads lie."""
BURGER_GRASP, FRIES_GRASP = 0.023, 0.019
"""Heights of the tool above the bottom [m]."""
CARTON_BACK = -0.046
"""Place of the carton's bottom end along y [m]; the fries stick out toward +y."""
CARTON_LENGTH = 0.056


def tray(color: Color) -> Shape:
    """A low tray with a rim."""
    width, depth = TRAY
    floor = objects.block((width, depth, TRAY_FLOOR), color)
    edges = containers.walls(TRAY, 0.006, 0.009, objects.darken(color, 0.82), TRAY_FLOOR)
    paper = meshes.box((width * 0.86, depth * 0.8, 0.0006), (246, 243, 234)).transformed((0, 0, TRAY_FLOOR))
    return objects.merge(floor, *edges, Shape(paper))


def burger(rng: np.random.Generator) -> Shape:
    """Bun, lettuce, patty, cheese and, in some, tomato or a second patty; its widest layers have flat sides."""
    radius = rng.uniform(0.028, 0.031)
    bun: Color = ((206, 140, 66), (190, 118, 52), (222, 170, 96))[rng.integers(3)]
    filling = [
        [("lettuce", 0.004), ("patty", 0.011), ("cheese", 0.003)],
        [("lettuce", 0.004), ("patty", 0.010), ("cheese", 0.003), ("tomato", 0.005)],
        [("patty", 0.009), ("cheese", 0.003), ("patty", 0.009), ("lettuce", 0.004)],
    ][rng.integers(3)]
    layers = [_layer(radius * 0.96, 0.0, 0.011, bun)]
    height = 0.011
    for name, thickness in filling:
        layers.append(_filling(name, radius, height, thickness))
        height += thickness
    crown = [_ring(radius * share, height + rise) for share, rise in ((0.98, 0.0), (1.0, 0.005), (0.8, 0.014), (0.42, 0.019))]
    seeds = [
        meshes.box((0.0035, 0.002, 0.0016), (246, 226, 178)).transformed(_crown_point(radius, height, angle), (0, 0, angle))
        for angle in rng.uniform(0, np.pi / 3, 6) + np.arange(6) * np.pi / 3
    ]
    mesh = meshes.merge([*layers, meshes.hull(np.concatenate(crown), bun), *seeds])
    hull = np.concatenate([_ring(radius * 0.96, 0.0), _ring(radius, 0.010), *crown[1:]]).astype(np.float32)
    return Shape(mesh, (hull,))


def _ring(radius: float, z: float) -> np.ndarray:
    return containers.ring(radius, SIDES, z)


def _layer(radius: float, low: float, high: float, color: Color) -> Mesh:
    return meshes.hull(np.concatenate([_ring(radius, low), _ring(radius, high)]), color)


def _filling(name: str, radius: float, low: float, thickness: float) -> Mesh:
    if name == "cheese":  # a square slice whose corners hang out a little
        edge = radius * 1.44
        return meshes.box((edge, edge, thickness), (242, 186, 48)).transformed((0, 0, low + thickness / 2), (0, 0, 0.5))
    color = {"lettuce": (106, 172, 66), "patty": (92, 54, 34), "tomato": (206, 60, 44)}[name]
    return _layer(radius * (0.94 if name == "tomato" else 1.0), low, low + thickness, color)


def _crown_point(radius: float, height: float, angle: float) -> tuple[float, float, float]:
    at = 0.6 * radius
    return float(at * np.cos(angle)), float(at * np.sin(angle)), height + 0.0168


def fries(rng: np.random.Generator) -> Shape:
    """A carton of fries on its back, open toward +y."""
    width, height = rng.uniform([0.046, 0.031], [0.054, 0.035])
    color, stripe = [((200, 40, 36), (245, 200, 60)), ((235, 232, 226), (200, 40, 36)), ((50, 90, 180), (240, 240, 238))][
        rng.integers(3)
    ]
    front = CARTON_BACK + CARTON_LENGTH
    carton = meshes.box((width, CARTON_LENGTH, height), color).transformed((0, front - CARTON_LENGTH / 2, height / 2))
    label = meshes.cylinder(0.015, 0.0012, stripe, sections=20).transformed((0, front - 0.028, height))
    band = meshes.box((width + 0.0012, 0.007, height + 0.0012), stripe).transformed((0, front - 0.006, height / 2))
    half = width / 2 - 0.005
    corners = np.array(np.meshgrid([-half, half], [front - 0.004, 0.04], [0.004, height - 0.004])).reshape(3, -1).T
    rows, columns = np.linspace(0.008, height - 0.008, 3), np.linspace(-0.84, 0.84, 5) * half
    sticks = [_stick(rng, x, z, front) for z in rows for x in columns]
    return Shape(meshes.merge([carton, label, band, *sticks]), (carton.vertices, corners.astype(np.float32)))


def _stick(rng: np.random.Generator, x: float, z: float, front: float) -> Mesh:
    length, turn, shade = rng.uniform(0.022, 0.040), rng.uniform(-0.06, 0.06), rng.integers(0, 26)
    color = (250 - int(shade) // 2, 212 - int(shade), 96 - int(shade))
    return meshes.box((0.0065, length, 0.0065), color).transformed((x, front - 0.006 + length / 2, z), (0, 0, turn))


def sample(rng: np.random.Generator, seed: int) -> Scene:
    middle = rng.uniform(-0.15, -0.10)
    left = rng.uniform([-0.30, -0.15], [-0.25, -0.07])
    right = rng.uniform([0.20, -0.15], [0.30, -0.07])
    color = [(176, 70, 58), (96, 104, 112), (70, 116, 96), (160, 120, 80)][rng.integers(4)]
    return Scene(
        "place_burger_fries",
        seed,
        (
            SceneObject("burger", burger(rng), upright(left, TABLE_TOP, radial_yaw(LEFT, left)), mass=0.08),
            SceneObject("fries", fries(rng), upright(right, TABLE_TOP), mass=0.06),
            SceneObject("tray", tray(color), upright((0.0, middle), TABLE_TOP)),
        ),
    )


def spots(scene: Scene) -> dict[str, np.ndarray]:
    """Where burger and fries go on the tray's floor, [3] world."""
    middle = point_above(scene.object("tray"), TRAY_FLOOR)
    return {"burger": middle - [SPOT, 0, 0], "fries": middle + [SPOT, 0, 0]}


def plan(scene: Scene) -> Timeline:
    left, right = (np.array(scene.object(name).pose[:3]) for name in ("burger", "fries"))
    along = np.array([0, CARTON_BACK + CARTON_LENGTH / 2, FRIES_GRASP])
    grasps = {
        LEFT: tool(left + [0, 0, BURGER_GRASP], radial_yaw(LEFT, left), STEEP_TILT),
        RIGHT: tool(right + along, 0.0, STEEP_TILT),
    }
    goal = {name: spot + [0, 0, 0.002] for name, spot in spots(scene).items()}
    turn = radial_turn(LEFT, left, goal["burger"])
    timeline = Timeline()
    pick(timeline, grasps, lift=LIFT)
    put_burger = grasps[LEFT].carried(left, goal["burger"], turn)
    place(timeline, LEFT, "burger", put_burger, above=0.07, retreat=LIFT, release=0.95)
    put_fries = grasps[RIGHT].carried(right, goal["fries"])
    timeline.move(aside_poses([RIGHT]) | {RIGHT: put_fries.moved(z=0.07)})
    place(timeline, RIGHT, "fries", put_fries, above=0.03, retreat=LIFT, release=0.9)
    return timeline


def success(scene: Scene, now: Moment) -> bool:
    for name, spot in spots(scene).items():
        offset = now.object_pose[scene.index(name), :3] - spot
        if np.hypot(*offset[:2]) >= 0.08 or abs(offset[2]) >= 0.015:
            return False
    return now.both_open


def approach(scene: Scene, first: Moment, now: Moment) -> float:
    return share_carried(scene, first, now, spots(scene), (0.08, 0.08, 0.015))


TASK = Task(
    "place_burger_fries",
    "pick up the burger and the fries with both arms and put them on the tray",
    sample,
    plan,
    success,
    approach,
)
