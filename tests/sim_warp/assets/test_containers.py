"""Bottles, cans and pots: graspable in every variant; and the goals of their tasks, by scenes set by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xew.sim_warp.assets import containers
from xew.sim_warp.geometry.camera import HEAD_CAMERA, project
from xew.sim_warp.objects import Shape
from xew.sim_warp.plan import RIGHT
from xew.sim_warp.scene import Scene, SceneObject, scene_rng
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks import TASKS
from xew.sim_warp.tasks.lift_pot import OPENING, handles
from xew.sim_warp.tasks.move_can_pot import BESIDE
from xew.sim_warp.tasks.place_container_plate import WALL
from xew.sim_warp.tasks.task import Moment, arm_for, side_sign

VARIANTS = 40
WIDEST = 0.065
"""m, between the fingers of the narrowest gripper with room to spare."""
PAD_THICKNESS, WIDE_HAND = 0.008, 0.09
"""Of every robot's fingers, and the widest opening of a hand [m]."""
SEEDS = range(24)


def variants(kind: str) -> list[tuple[Shape, str]]:
    return [getattr(containers, kind)(np.random.default_rng(seed)) for seed in range(VARIANTS)]


def sampled(task: str, seed: int) -> Scene:
    return TASKS[task].sample(scene_rng(task, seed), seed)


# --- Shapes.


@pytest.mark.parametrize("kind", ["can", "pill_bottle", "bottle"])
def test_variants_differ_and_are_seen_where_they_collide(kind: str) -> None:
    shapes = [shape for shape, _ in variants(kind)]
    assert len({round(containers.height(shape), 6) for shape in shapes}) == VARIANTS
    assert len({name for _, name in variants(kind)}) >= 4
    for shape in shapes:
        solid, seen = np.concatenate(shape.hulls), shape.mesh.vertices
        assert np.abs(seen.min(0) - solid.min(0)).max() < 0.002 and np.abs(seen.max(0) - solid.max(0)).max() < 0.002


@pytest.mark.parametrize("kind", ["can", "pill_bottle"])
def test_hands_meet_flats_of_what_stands_at_every_turn_of_its_symmetry(kind: str) -> None:
    for shape, _ in variants(kind):
        thing = containers.place_standing("thing", shape, (0.1, 0.0), 0.3, mass=0.1)
        assert thing.grasp is not None and thing.grasp.width <= WIDEST
        hull = thing.shape.hulls[0]
        for turn in (0, 1, 5):
            across = Rotation.from_euler("z", turn * thing.grasp.symmetry).apply([1, 0, 0])
            reach = hull @ across
            assert np.ptp(reach) == pytest.approx(thing.grasp.width, abs=1e-5)
            assert (reach > reach.max() - 1e-5).sum() == 4, "two upright edges: a flat"
        assert 0 < thing.grasp.height < hull[:, 2].max() - 0.01


def test_a_bottle_lies_on_a_flat_under_its_point_of_balance() -> None:
    for shape, _ in variants("bottle"):
        thing = containers.place_lying("bottle", shape, (0.1, -0.1), 0.2, mass=0.1)
        points = np.concatenate(thing.shape.hulls)
        ground = points[points[:, 2] < 1e-5]
        assert points[:, 2].min() == pytest.approx(0, abs=1e-6) and len(ground) >= 4
        np.testing.assert_allclose(containers.center_of_mass(thing.shape)[:2], 0, atol=1e-4)
        assert (ground[:, :2].min(0) < -0.008).all() and (ground[:, :2].max(0) > 0.008).all()
        assert thing.grasp is not None and thing.grasp.width <= WIDEST
        slab = thing.shape.hulls[0]
        assert np.ptp(slab[:, 0]) == pytest.approx(thing.grasp.width, abs=1e-5)
        assert slab[:, 1].min() < -0.02 and slab[:, 1].max() > 0.02, "pads are 22 mm wide"
        assert points[:, 1].max() > 0.07, "the neck is at +y"


def test_a_finger_fits_between_a_pot_and_its_handles() -> None:
    for scene in (sampled("lift_pot", seed) for seed in SEEDS):
        pot = scene.object("pot")
        left, right = containers.handles(pot.shape)
        np.testing.assert_allclose(left, right * [-1, 1, 1], atol=1e-6)
        room = right[0] - np.hypot(*pot.shape.hulls[0][:, :2].T).max()
        assert room > OPENING * WIDE_HAND / 2 + PAD_THICKNESS + 0.005
        assert len(pot.shape.hulls) <= 10


# --- Goals. Poses are set by hand; the hands are far off unless said.


def moment_of(scene: Scene, name: str, pose: np.ndarray, gripper: tuple[float, float] = (1.0, 1.0)) -> Moment:
    poses = np.array([thing.pose for thing in scene.objects])
    poses[scene.index(name)] = pose
    tools = np.tile([0.0, -0.5, 1.2, 0, 0, 0, 1], (2, 1))
    count = len(scene.objects)
    return Moment(poses, np.zeros(count), tools, np.array(gripper), np.zeros((2, count), bool))


def goal(scene: Scene) -> tuple[str, np.ndarray]:
    """The name of what is carried and where it belongs [3]."""
    if scene.task == "move_can_pot":
        side = side_sign(arm_for(scene.object("can").pose[0]))
        return "can", np.array(scene.object("pot").pose[:3]) + [side * BESIDE, 0, 0]
    if scene.task == "move_pillbottle_pad":
        return "bottle", np.array(scene.object("pad").pose[:3]) + [0, 0, 0.001]
    return "container", np.array(scene.object("plate").pose[:3]) + [0, 0, WALL]


def succeeds(
    scene: Scene, offset: tuple[float, float, float], tilt: float = 0.0, gripper: tuple[float, float] = (1, 1)
) -> bool:
    name, place = goal(scene)
    turned = Rotation.from_euler("x", tilt).as_quat()
    return TASKS[scene.task].success(scene, moment_of(scene, name, np.concatenate([place + offset, turned]), gripper))


@pytest.mark.parametrize(
    ("task", "near", "far"),
    [
        ("move_can_pot", (0.015, 0.03, 0), (0.025, 0, 0)),
        ("move_can_pot", (-0.02, -0.03, 0), (0, 0.04, 0)),
        ("move_can_pot", (0, 0, 0.004), (0, 0, 0.01)),
        ("move_pillbottle_pad", (0.025, -0.025, 0), (0.035, 0, 0)),
        ("move_pillbottle_pad", (0, 0, 0.004), (0, 0, 0.006)),
        ("place_container_plate", (0.045, 0.045, 0), (0, 0.055, 0)),
        ("place_container_plate", (0, 0, 0.008), (0, 0, 0.012)),
    ],
)
def test_near_misses_count_and_far_ones_do_not(
    task: str, near: tuple[float, float, float], far: tuple[float, float, float]
) -> None:
    for seed in SEEDS:
        scene = sampled(task, seed)
        side = np.sign(scene.objects[0].pose[0])
        near_, far_ = ((side * x, y, z) for x, y, z in (near, far))
        assert succeeds(scene, (0, 0, 0)) and succeeds(scene, near_) and not succeeds(scene, far_)
        assert not succeeds(scene, (0, 0, 0), gripper=(1.0, 0.7)) and not succeeds(scene, (0, 0, 0), gripper=(0.0, 1.0))


@pytest.mark.parametrize("task", ["move_can_pot", "move_pillbottle_pad"])
def test_what_has_fallen_over_does_not_count(task: str) -> None:
    scene = sampled(task, 0)
    assert succeeds(scene, (0, 0, 0), tilt=np.radians(10)) and not succeeds(scene, (0, 0, 0), tilt=np.radians(20))


def test_a_can_on_the_other_side_of_the_pot_does_not_count() -> None:
    scene = sampled("move_can_pot", 0)
    side = np.sign(scene.object("can").pose[0])
    assert not succeeds(scene, (-2 * side * BESIDE, 0, 0))


def test_plates_are_clear_of_what_will_stand_on_them() -> None:
    for seed in SEEDS:
        scene = sampled("place_container_plate", seed)
        container, plate = scene.objects
        reach = sum(float(np.hypot(*np.concatenate(thing.shape.hulls)[:, :2].T).max()) for thing in scene.objects)
        assert np.hypot(*np.subtract(container.pose[:2], plate.pose[:2])) > reach


def test_a_pot_counts_high_level_and_by_its_handles() -> None:
    scene = sampled("lift_pot", 3)
    start = np.array(scene.object("pot").pose)

    def lifted(height: float, tilt: float = 0.0, apart: float = 0.0) -> bool:
        turned = Rotation.from_euler("y", tilt) * Rotation.from_quat(start[3:])
        now = moment_of(scene, "pot", np.concatenate([start[:2], [height], turned.as_quat()]), (0.0, 0.0))
        tools = now.tool_pose.copy()
        tools[:, :3] = handles(scene, now.object_pose[0])
        tools[RIGHT, 1] += apart
        return TASKS["lift_pot"].success(scene, replace(now, tool_pose=tools))

    assert lifted(0.88) and lifted(0.88, apart=0.025) and lifted(0.88, tilt=np.radians(30))
    assert not lifted(0.81) and not lifted(0.88, apart=0.035) and not lifted(0.88, tilt=np.radians(40))


@pytest.mark.parametrize("task", ["shake_bottle", "shake_bottle_horizontally"])
def test_bottles_are_shaken_where_the_camera_sees_them(task: str) -> None:
    """As if held fast: the bottle stays in the picture, upright in one task and level in the other."""
    for seed in SEEDS:
        scene = sampled(task, seed)
        (bottle,), path = scene.objects, TASKS[task].plan(scene).path()
        held = carried(bottle, path.pose[:, arm_for(bottle.pose[0])], int(np.ceil(path.holds[0].start * path.frame_rate)))
        assert pixels_inside(held[:, 0]).all() and pixels_inside(held[-1]).mean() > 0.9
        neck = held[-1, 1] - held[-1, 0]
        rise = np.degrees(np.arcsin(neck[2] / np.linalg.norm(neck)))
        assert rise == pytest.approx(70 if task == "shake_bottle" else 0, abs=1)
        assert TASKS[task].success(scene, moment_of(scene, "bottle", np.array([*held[-1, 0], 0, 0, 0, 1])))
        assert not TASKS[task].success(scene, moment_of(scene, "bottle", np.array([0, 0, TABLE_TOP + 0.05, 0, 0, 0, 1])))


def carried(thing: SceneObject, tools: np.ndarray, since: int) -> np.ndarray:
    """[t k 3] origin, a point farther along y, and hull points of a thing that follows a tool [t 7] from a frame on."""
    points = np.concatenate([[[0, 0, 0], [0, 0.05, 0]], *thing.shape.hulls])
    world = Rotation.from_quat(thing.pose[3:]).apply(points) + thing.pose[:3]
    hand = Rotation.from_quat(tools[since:, 3:])
    local = hand[0].inv().apply(world - tools[since, :3])
    return np.stack([turn.apply(local) + tool[:3] for turn, tool in zip(hand, tools[since:], strict=True)])


def pixels_inside(points: np.ndarray) -> np.ndarray:
    """[...] whether the head camera's picture holds points [... 3]."""
    pixel, _ = project(HEAD_CAMERA, points)
    return np.all((pixel >= 0) & (pixel <= [HEAD_CAMERA.width - 1, HEAD_CAMERA.height - 1]), axis=-1)
