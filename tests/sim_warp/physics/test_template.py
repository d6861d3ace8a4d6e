"""What bodies weigh, by formulas of textbooks, and what the template makes of a scene and a robot."""

from dataclasses import replace

import numpy as np
import pytest

from xew.config import ConfigError
from xew.sim_warp import objects
from xew.sim_warp.devices.newton import newton
from xew.sim_warp.physics.template import (
    ARM_JOINTS,
    FREE_SLOTS,
    HINGE_ARMATURE,
    PAD_FRICTION,
    ROBOT_GROUP,
    add_world,
    arm_groups,
    new_builder,
    solid,
)
from xew.sim_warp.robots import ROBOTS, load_urdf
from xew.sim_warp.scene import Hinge, Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP

COLOR = (200, 0, 0)


def corners(size: tuple[float, float, float], center: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """[8 3] corners of a box."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return signs * np.array(size) / 2 + center


def box_inertia(mass: float, size: tuple[float, float, float]) -> np.ndarray:
    """[3 3] of a box about its center."""
    x, y, z = np.square(size)
    return mass / 12 * np.diag([y + z, x + z, x + y])


def test_a_box_has_the_inertia_of_a_box() -> None:
    size = (0.2, 0.1, 0.05)
    mass, center, inertia = solid(0.3, [corners(size, (0.5, 0, -0.1))])
    assert mass == 0.3
    np.testing.assert_allclose(center, (0.5, 0, -0.1), atol=1e-6)
    np.testing.assert_allclose(inertia, box_inertia(0.3, size), atol=1e-8)


def test_two_halves_weigh_what_the_whole_weighs() -> None:
    halves = [corners((0.1, 0.1, 0.05), (x, 0, 0)) for x in (-0.05, 0.05)]
    _, center, inertia = solid(0.3, halves)
    np.testing.assert_allclose(center, 0, atol=1e-6)
    np.testing.assert_allclose(inertia, box_inertia(0.3, (0.2, 0.1, 0.05)), atol=1e-8)


def test_pieces_weigh_by_their_volume() -> None:
    """A cube of 10 cm and one of 20 cm, 1 to 8, at x = 0 and 0.9: the center is at 0.8."""
    _, center, inertia = solid(0.9, [corners((0.1,) * 3), corners((0.2,) * 3, (0.9, 0, 0))])
    np.testing.assert_allclose(center, (0.8, 0, 0), atol=1e-6)
    expected = box_inertia(0.1, (0.1,) * 3)[1, 1] + 0.1 * 0.8**2 + box_inertia(0.8, (0.2,) * 3)[1, 1] + 0.8 * 0.1**2
    assert inertia[1, 1] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("key", ROBOTS)
def test_groups_of_an_arm_hold_all_its_links_and_masses(key: str) -> None:
    robot = ROBOTS[key]
    urdf = load_urdf(robot.urdf)
    for arm in robot.arms:
        links, fingers = arm_groups(robot.urdf, arm)
        assert [group.joint.name for group in links] == list(arm.joints)
        assert [group.joint.name for group in fingers] == list(arm.fingers)
        for group in (*links, *fingers):
            assert group.mass > 0 and np.linalg.eigvalsh(group.inertia).min() > 0, group.joint.name
            np.testing.assert_allclose(group.inertia, group.inertia.T, atol=1e-12)
            child = urdf.links[group.joint.child]
            assert child.inertial is None or group.mass >= child.inertial.mass - 1e-9


def built(robot: str, *things: SceneObject) -> newton.ModelBuilder:
    builder = new_builder()
    add_world(builder, ROBOTS[robot], Scene("test", 0, things))
    return builder


def cube(name: str, mass: float = 0.05) -> SceneObject:
    return SceneObject(name, objects.block((0.04,) * 3, COLOR), upright((0.1, 0), TABLE_TOP), mass=mass)


def lid(name: str, mass: float = 0.0) -> SceneObject:
    shape = objects.block((0.1, 0.1, 0.01), COLOR)
    hinge = Hinge(shape, 0.1, (0, 0.05, 0.01), (1, 0, 0), 0.0, 2.0, start=0.4, friction=0.01, damping=0.01)
    return SceneObject(name, shape, upright((-0.1, 0), TABLE_TOP), mass=mass, hinge=hinge)


@pytest.mark.parametrize("key", ROBOTS)
def test_every_robot_and_scene_has_the_same_bodies_and_joints(key: str) -> None:
    """That is what lets MuJoCo Warp step them in one batch."""
    reference = built("franka_panda", cube("one"), lid("box"))
    for builder in (built(key), built(key, cube("one"), cube("two"), cube("three")), built(key, lid("box"))):
        assert builder.body_count == reference.body_count == 2 * (ARM_JOINTS + 2) + FREE_SLOTS + 1
        assert builder.joint_count == reference.joint_count
        assert builder.joint_type == reference.joint_type
        assert [label.rsplit("/", 1)[-1] for label in builder.body_label] == [
            label.rsplit("/", 1)[-1] for label in reference.body_label
        ]


def labels_of(builder: newton.ModelBuilder) -> list[str]:
    return [label.rsplit("/", 1)[-1] for label in builder.shape_label]


def test_shapes_of_things_carry_their_number_and_the_table_its_name() -> None:
    labels = labels_of(built("piper", lid("box"), cube("one")))
    assert labels.count("table") == 1
    assert labels.count("object0") == 2, "a box and its lid"
    assert labels.count("object1") == 1
    assert {label.split("_")[0] for label in labels} == {"left", "right", "table", "object0", "object1"}


def test_pads_grip_and_arms_meet_each_other_but_not_themselves() -> None:
    builder = built("franka_panda", cube("one"))
    labels = labels_of(builder)
    for index, label in enumerate(labels):
        side = label.split("_")[0]
        if side in ROBOT_GROUP:
            assert builder.shape_collision_group[index] == ROBOT_GROUP[side]
        else:
            assert builder.shape_collision_group[index] == 1
    friction = {round(builder.shape_material_mu[i], 3) for i, label in enumerate(labels) if "finger" in label}
    assert PAD_FRICTION in friction
    assert all(builder.shape_material_mu[i] < PAD_FRICTION for i, label in enumerate(labels) if "link" in label)


def test_a_lid_gets_inertia_that_the_solver_sees() -> None:
    builder = built("piper", lid("box"))
    index = next(i for i, label in enumerate(builder.joint_label) if label.endswith("lid_hinge"))
    start = builder.joint_qd_start[index]
    assert builder.joint_armature[start] == pytest.approx(HINGE_ARMATURE)
    assert builder.joint_limit_lower[start] == 0.0 and builder.joint_limit_upper[start] == 2.0


@pytest.mark.parametrize(
    ("things", "counts"),
    [
        ([cube(f"c{index}") for index in range(FREE_SLOTS + 1)], "4 free and 0 hinged"),
        ([lid("a"), lid("b")], "0 free and 2 hinged"),
        ([lid("a", mass=0.2)], "1 free and 1 hinged"),
    ],
)
def test_what_the_template_does_not_hold_is_told(things: list[SceneObject], counts: str) -> None:
    with pytest.raises(ConfigError, match=f"the scene of test has {counts} objects; the template holds"):
        built("piper", *things)


def test_a_thing_weighs_what_its_scene_says() -> None:
    heavy = built("piper", replace(cube("one"), mass=0.25))
    index = next(i for i, label in enumerate(heavy.body_label) if label.endswith("free0"))
    assert heavy.body_mass[index] == pytest.approx(0.25)
