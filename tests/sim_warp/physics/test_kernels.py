"""The kernels round MuJoCo Warp's step against the same in NumPy, on Warp's CPU device."""

import numpy as np
import pytest
import warp as wp

from xew.protocol import FRAME_RATE
from xew.sim_warp.physics.kernels import advance_frame, record_contacts, record_joints, set_targets
from xew.sim_warp.physics.worlds import (
    FIRST_OBJECT,
    LEFT_ARM_LINKS,
    LEFT_FINGERS,
    RIGHT_ARM_LINKS,
    RIGHT_FINGERS,
    ROBOT_DOFS,
    STEPS_PER_FRAME,
    TABLE,
    control_targets,
    template_joints,
)
from xew.sim_warp.robots import ROBOTS

OWNERS = np.array([TABLE, LEFT_FINGERS, RIGHT_FINGERS, LEFT_ARM_LINKS, RIGHT_ARM_LINKS, FIRST_OBJECT, FIRST_OBJECT + 1])
"""What the collision shapes 0 to 6 of every world belong to."""
TABLE_SHAPE, LEFT_PAD, RIGHT_PAD, LEFT_LINK, RIGHT_LINK, FIRST, SECOND = range(7)
FRAME = 1


def device_array(values: object, dtype: type = wp.float32) -> wp.array:
    return wp.array(np.asarray(values), dtype=dtype, device="cpu")


def launch(kernel: wp.Kernel, dim: object, inputs: list, outputs: list) -> None:
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device="cpu")


def test_targets_are_those_of_the_c_engine() -> None:
    robots = [ROBOTS["piper"], ROBOTS["franka_panda"]]
    actions = np.random.default_rng(0).uniform(0, 1, (2, 3, 16))
    joints = np.stack([template_joints(robot, action) for robot, action in zip(robots, actions, strict=True)])
    expected = np.stack([control_targets(robot, action) for robot, action in zip(robots, actions, strict=True)])
    for frame in range(2):
        for step in (0, 7, STEPS_PER_FRAME - 1):
            ctrl = wp.zeros((2, 2 * ROBOT_DOFS), dtype=wp.float32, device="cpu")
            share = (step + 1) / STEPS_PER_FRAME
            inputs = [device_array(joints), device_array([frame], wp.int32), share, FRAME_RATE]
            launch(set_targets, (2, ROBOT_DOFS), inputs, [ctrl])
            np.testing.assert_allclose(ctrl.numpy(), expected[:, frame, step], rtol=1e-5, atol=1e-5)


def test_joints_are_recorded_at_their_frame_alone() -> None:
    qpos, qvel = np.arange(8.0).reshape(2, 4), np.arange(6.0).reshape(2, 3)
    qpos_out, qvel_out = (wp.zeros((2, 3, width), dtype=wp.float32, device="cpu") for width in (4, 3))
    launch(
        record_joints, (2, 4), [device_array(qpos), device_array(qvel), device_array([FRAME], wp.int32)], [qpos_out, qvel_out]
    )
    np.testing.assert_array_equal(qpos_out.numpy()[:, FRAME], qpos)
    np.testing.assert_array_equal(qvel_out.numpy()[:, FRAME], qvel)
    assert (qpos_out.numpy()[:, [0, 2]] == 0).all() and (qvel_out.numpy()[:, [0, 2]] == 0).all()


def test_frames_are_counted_one_by_one() -> None:
    frame = device_array([4], wp.int32)
    for expected in (5, 6):
        launch(advance_frame, 1, [frame], [frame])
        assert frame.numpy().tolist() == [expected]


class Record:
    """What `record_contacts` writes of contacts (world, shape, shape, distance in mm)."""

    def __init__(self, *contacts: tuple[int, int, int, float], counted: int | None = None) -> None:
        world, first, second, distance = (list(column) for column in zip(*contacts, strict=True))
        self.contact = wp.zeros((2, 2, 2), dtype=wp.int32, device="cpu")
        self.penetration = wp.zeros((2, 2, 2), dtype=wp.float32, device="cpu")
        self.overlap = wp.zeros((2, 2), dtype=wp.float32, device="cpu")
        count = len(contacts) if counted is None else counted
        inputs = [
            device_array([count], wp.int32),
            device_array(np.column_stack([first, second]), wp.vec2i),
            device_array(world, wp.int32),
            device_array(np.array(distance) / 1000),
            device_array(np.tile(OWNERS, (2, 1)), wp.int32),
            device_array([FRAME], wp.int32),
        ]
        launch(record_contacts, len(contacts), inputs, [self.contact, self.penetration, self.overlap])

    def touched(self, world: int = 0) -> list[list[bool]]:
        """[2 o] which fingers touch which objects."""
        bits = self.contact.numpy()[world, FRAME]
        return [[bool(row >> index & 1) for index in range(2)] for row in bits]

    def depth(self, world: int = 0) -> list[float]:
        """[o] mm."""
        return (1000 * self.penetration.numpy()[world, FRAME].astype(float)).round(3).tolist()

    def pressed(self, world: int = 0) -> list[float]:
        """[2] mm, of an arm and the table, of the arms."""
        return (1000 * self.overlap.numpy()[world].astype(float)).round(3).tolist()


@pytest.mark.parametrize("swapped", [False, True])
def test_a_finger_on_a_thing_is_a_contact_whichever_comes_first(swapped: bool) -> None:
    pair = (SECOND, LEFT_PAD) if swapped else (LEFT_PAD, SECOND)
    record = Record((0, *pair, -0.5))
    assert record.touched() == [[False, True], [False, False]]
    assert record.depth() == [0, 0.5] and record.pressed() == [0, 0]


def test_two_hands_on_one_thing_both_count() -> None:
    record = Record((0, LEFT_PAD, FIRST, -0.2), (0, RIGHT_PAD, FIRST, -0.3), (0, RIGHT_PAD, SECOND, -0.1))
    assert record.touched() == [[True, False], [True, True]]
    assert record.depth() == [0.3, 0.1], "the deepest of all contacts"


def test_a_link_is_no_finger() -> None:
    record = Record((0, LEFT_LINK, FIRST, -0.4))
    assert record.touched() == [[False, False], [False, False]] and record.depth() == [0.4, 0]


def test_things_that_only_come_near_do_not_touch() -> None:
    record = Record((0, LEFT_PAD, FIRST, 0.1), (0, TABLE_SHAPE, LEFT_PAD, 0.0))
    assert record.touched() == [[False, False], [False, False]]
    assert record.depth() == [0, 0] and record.pressed() == [0, 0]


def test_a_thing_on_the_table_and_on_another_is_in_both() -> None:
    record = Record((0, TABLE_SHAPE, FIRST, -0.7), (0, FIRST, SECOND, -0.2))
    assert record.depth() == [0.7, 0.2] and record.pressed() == [0, 0]


@pytest.mark.parametrize("part", [LEFT_PAD, RIGHT_PAD, LEFT_LINK, RIGHT_LINK])
def test_any_part_of_an_arm_can_press_into_the_table(part: int) -> None:
    assert Record((0, part, TABLE_SHAPE, -1.5)).pressed() == [1.5, 0]


@pytest.mark.parametrize("pair", [(LEFT_PAD, RIGHT_PAD), (LEFT_LINK, RIGHT_PAD), (RIGHT_LINK, LEFT_LINK)])
def test_any_parts_of_both_arms_can_press_into_each_other(pair: tuple[int, int]) -> None:
    assert Record((0, *pair, -0.9)).pressed() == [0, 0.9]


def test_parts_of_one_arm_do_not_count_against_it() -> None:
    assert Record((0, LEFT_PAD, LEFT_LINK, -0.9)).pressed() == [0, 0]


def test_worlds_and_frames_do_not_mix() -> None:
    record = Record((1, LEFT_PAD, FIRST, -0.2), (0, LEFT_PAD, TABLE_SHAPE, -0.3))
    assert record.touched(0) == [[False, False], [False, False]] and record.touched(1) == [[True, False], [False, False]]
    assert record.pressed(0) == [0.3, 0] and record.pressed(1) == [0, 0]
    assert (record.contact.numpy()[:, 0] == 0).all() and (record.penetration.numpy()[:, 0] == 0).all()


def test_what_lies_behind_the_last_contact_is_not_read() -> None:
    """The buffer keeps contacts of earlier steps behind those of this one."""
    record = Record((0, LEFT_PAD, FIRST, -0.2), (0, RIGHT_PAD, SECOND, -0.3), counted=1)
    assert record.touched() == [[True, False], [False, False]] and record.depth() == [0.2, 0]
