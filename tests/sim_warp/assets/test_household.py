"""Everyday objects: recognisably many, of a size that hands can hold; and a stapler whose spring answers."""

from dataclasses import replace

import numpy as np
import pytest

from xew.sim_warp.assets.household import LOWEST_GRASP, MATS, THINGS, Thing, mat_color, stapler_parts
from xew.sim_warp.physics import World, simulate
from xew.sim_warp.physics import gpu as physics_gpu
from xew.sim_warp.production.warm_up import stand_at_home
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import Scene, SceneObject, scene_hash, scene_rng
from xew.sim_warp.tasks import TASKS
from xew.sim_warp.tasks.task import arm_for, radial_yaw

VARIANTS = 40
WIDEST = 0.065
"""m, between the fingers of the narrowest gripper with room to spare."""


def variants(kind: str) -> list[Thing]:
    return [THINGS[kind](np.random.default_rng(seed)) for seed in range(VARIANTS)]


def slice_width(thing: Thing) -> float:
    """Of what collides, along x, at the height of the grasp and over a pad's width about the origin [m]."""
    points = np.concatenate(thing.shape.hulls)
    return float(np.ptp(points[:, 0]))


@pytest.mark.parametrize("kind", THINGS)
def test_a_hand_can_hold_every_variant(kind: str) -> None:
    for thing in variants(kind):
        assert thing.width <= WIDEST and thing.width == pytest.approx(slice_width(thing), abs=0.003)
        assert LOWEST_GRASP - 0.002 <= thing.grasp_height < thing.height + 0.010
        assert 0.03 <= thing.mass <= 0.3 and np.ptp(np.concatenate(thing.shape.hulls)[:, 1]) <= 0.16
        assert 1 <= len(thing.shape.hulls) <= 3
        assert min(float(hull[:, 2].min()) for hull in thing.shape.hulls) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("kind", THINGS)
def test_variants_differ_in_size_and_looks(kind: str) -> None:
    things = variants(kind)
    assert len({round(thing.width, 5) for thing in things}) == VARIANTS
    assert len({thing.shape.mesh.colors.tobytes() for thing in things}) >= 3


@pytest.mark.parametrize("kind", THINGS)
def test_what_is_seen_is_what_collides(kind: str) -> None:
    """Decorations stand out by a few millimeters at most."""
    for thing in variants(kind)[:10]:
        solid = np.concatenate(thing.shape.hulls)
        seen = thing.shape.mesh.vertices
        assert np.abs(seen.min(0) - solid.min(0)).max() < 0.004 and np.abs(seen.max(0) - solid.max(0)).max() < 0.004


def test_a_mat_has_another_color_than_what_lies_on_it() -> None:
    colors = {mat_color(np.random.default_rng(seed), "red stapler") for seed in range(60)}
    assert colors == set(MATS) - {"red"}


# --- The stapler's spring.


def scene() -> Scene:
    return TASKS["press_stapler"].sample(scene_rng("press_stapler", 1), 1)


def pressed(by: float) -> Scene:
    """The stapler with its arm pressed by a share of its way when the world begins, and nothing on it."""
    whole = scene()
    thing = whole.objects[0]
    assert thing.hinge is not None
    return replace(whole, objects=(replace(thing, hinge=replace(thing.hinge, start=by * thing.hinge.upper)),))


def test_an_open_stapler_stays_open_and_a_pressed_one_springs_back() -> None:
    robot = ROBOTS["piper"]
    worlds = [World(robot, pressed(share), stand_at_home(robot, 30)) for share in (0.0, 0.9)]
    still, released = (motion.object_joint[:, 0] for motion in simulate(worlds, "cpu"))
    assert np.abs(still).max() < np.radians(0.1)
    assert released[0] == pytest.approx(0.9 * stapler_opening()) and abs(released[-1]) < np.radians(0.3)


def stapler_opening() -> float:
    hinge = scene().objects[0].hinge
    assert hinge is not None
    return hinge.upper


def test_a_stapler_without_its_spring_falls_shut() -> None:
    """What holds the arm open is the spring, not friction."""
    robot, whole = ROBOTS["piper"], scene()
    thing = whole.objects[0]
    assert thing.hinge is not None
    slack = replace(whole, objects=(replace(thing, hinge=replace(thing.hinge, stiffness=0.0)),))
    angle = simulate([World(robot, slack, stand_at_home(robot, 30))], "cpu")[0].object_joint[:, 0]
    assert angle[-1] > 0.8 * thing.hinge.upper
    assert scene_hash(slack) != scene_hash(whole)


def test_the_spring_acts_alike_in_mujoco_warp_and_only_in_its_own_world(quick_kernels: None) -> None:
    robot, laptop = ROBOTS["piper"], TASKS["open_laptop"].sample(scene_rng("open_laptop", 1), 1)
    worlds = [World(robot, laptop, stand_at_home(robot, 8)), World(robot, pressed(0.9), stand_at_home(robot, 8))]
    expected, found = simulate(worlds, "cpu"), physics_gpu.simulate_batch(worlds, "cpu")
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other.object_joint, one.object_joint, atol=2e-4)
    assert found[1].object_joint[-1, 0] < 0.5 * stapler_opening()
    assert np.ptp(found[0].object_joint[:, 0]) < np.radians(0.1)


def test_every_part_of_a_stapler_varies() -> None:
    parts = [stapler_parts(np.random.default_rng(seed)) for seed in range(20)]
    assert all(0.08 < part.opening < 0.16 for part in parts)
    assert len({part.words for part in parts}) > 3


# --- The tasks with household things keep the ranges that their docstrings promise.


def drawn(task: str) -> list[Scene]:
    return [TASKS[task].sample(scene_rng(task, seed), seed) for seed in range(200)]


def places(scenes: list[Scene], name: str) -> np.ndarray:
    """[n 2] x y of an object, m."""
    return np.array([found.object(name).pose[:2] for found in scenes])


def within(values: np.ndarray, low: float, high: float) -> bool:
    """All keep the range, and they fill most of it."""
    return bool(values.min() >= low and values.max() <= high and np.ptp(values) > 0.85 * (high - low))


def offsets(scenes: list[Scene], name: str) -> np.ndarray:
    """[n] between an object's long side and the direction from its arm's shoulder, modulo half a turn, rad."""
    found = []
    for one in scenes:
        thing = one.object(name)
        off = thing.yaw - radial_yaw(arm_for(thing.pose[0]), thing.pose)
        found.append(off - np.pi * np.round(off / np.pi))
    return np.array(found)


def free_of_each_other(scenes: list[Scene], one: str, other: str) -> bool:
    """Is there a straight line between the footprints of two objects in every scene?"""
    return all(_gap(scene.object(one), scene.object(other)) > 0 for scene in scenes)


def _gap(one: SceneObject, other: SceneObject) -> float:
    """Widest strip between two footprints over all directions [m]; negative where they overlap."""
    directions = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    axes = np.stack([np.cos(directions), np.sin(directions)])
    return float(((_outline(other) @ axes).min(0) - (_outline(one) @ axes).max(0)).max())


def _outline(thing: SceneObject) -> np.ndarray:
    points = np.concatenate(thing.shape.hulls)[:, :2]
    c, s = np.cos(thing.yaw), np.sin(thing.yaw)
    return points @ np.array([[c, s], [-s, c]]) + np.array(thing.pose[:2])


def test_ranges_of_place_mouse_pad() -> None:
    scenes = drawn("place_mouse_pad")
    mouse, mat = places(scenes, "mouse"), places(scenes, "mat")
    for at in (mouse, mat):
        assert within(np.abs(at[:, 0]), 0.05, 0.25) and within(at[:, 1], -0.20, 0.0)
    assert (mouse[:, 0] * mat[:, 0] > 0).all() and np.linalg.norm(mouse - mat, axis=-1).min() >= 0.13
    assert within(offsets(scenes, "mouse"), -np.radians(55), np.radians(55))
    assert {scene.words["color"] for scene in scenes} == set(MATS) and free_of_each_other(scenes, "mouse", "mat")


def test_ranges_of_move_stapler_pad() -> None:
    scenes = drawn("move_stapler_pad")
    stapler, mat = places(scenes, "stapler"), places(scenes, "mat")
    assert within(np.abs(stapler[:, 0]), 0.05, 0.25) and within(stapler[:, 1], -0.20, -0.03)
    assert within(np.abs(mat[:, 0]), 0.05, 0.16) and within(mat[:, 1], -0.20, -0.10)
    assert (stapler[:, 0] * mat[:, 0] > 0).all() and np.linalg.norm(stapler - mat, axis=-1).min() >= 0.12
    assert within(offsets(scenes, "stapler"), -np.radians(50), np.radians(50))


@pytest.mark.parametrize(("task", "side"), [("place_a2b_left", -1), ("place_a2b_right", 1)])
def test_ranges_of_one_thing_beside_another(task: str, side: int) -> None:
    scenes = drawn(task)
    first, second = places(scenes, "a"), places(scenes, "b")
    assert within(np.abs(first[:, 0]), 0.02, 0.22) and within(first[:, 1], -0.20, 0.0) and within(second[:, 1], -0.20, 0.0)
    inner = first[:, 0] * side < 0  # A begins where it has to pass the middle or B
    assert within(second[inner, 0] * -side, 0.18, 0.23) and within(np.abs(second[~inner, 0]), 0.0, 0.10)
    assert np.abs(first - second)[:, 1].min() >= 0.1 and free_of_each_other(scenes, "a", "b")
    assert within(offsets(scenes, "a"), -np.radians(55), np.radians(55))
    assert len({scene.words["a"] for scene in scenes} | {scene.words["b"] for scene in scenes}) > 40


def test_ranges_of_place_object_scale() -> None:
    scenes = drawn("place_object_scale")
    thing, scale = places(scenes, "thing"), places(scenes, "scale")
    assert within(np.abs(thing[:, 0]), 0.04, 0.25) and within(thing[:, 1], -0.20, 0.0)
    assert within(np.abs(scale[:, 0]), 0.04, 0.25) and within(scale[:, 1], -0.18, 0.02)
    assert (thing[:, 0] * scale[:, 0] > 0).all() and free_of_each_other(scenes, "thing", "scale")
    assert within(np.array([scene.object("scale").yaw for scene in scenes]), -np.radians(40), np.radians(40))


def test_ranges_of_place_object_stand() -> None:
    scenes = drawn("place_object_stand")
    thing, stand = places(scenes, "thing"), places(scenes, "stand")
    assert within(np.abs(thing[:, 0]), 0.20, 0.28) and within(thing[:, 1], -0.05, 0.05)
    assert within(np.abs(stand[:, 0]), 0.0, 0.05) and within(stand[:, 1], -0.15, -0.10)
    assert within(offsets(scenes, "thing"), -np.radians(45), np.radians(45)) and free_of_each_other(scenes, "thing", "stand")
    assert not scenes[0].object("stand").is_fixed


def test_ranges_of_press_stapler() -> None:
    scenes = drawn("press_stapler")
    x, y = places(scenes, "stapler").T
    assert within(x, -0.20, 0.20) and within(y, -0.10, 0.05)
    assert within(np.array([scene.object("stapler").yaw for scene in scenes]), -np.pi, np.pi)
