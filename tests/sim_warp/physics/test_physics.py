"""Physics: the template holds every robot, the C engine repeats bit for bit, and MuJoCo Warp agrees with it."""

from dataclasses import fields, replace

import numpy as np
import pytest
import warp
from scipy.spatial.transform import Rotation

from tests.sim_warp.small import launched_modules
from xew.config import ConfigError
from xew.protocol import ARMS, FRAME_RATE
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.kinematics.expert import joint_commands
from xew.sim_warp.physics import gpu as physics_gpu
from xew.sim_warp.physics import simulate
from xew.sim_warp.physics.template import FREE_SLOTS
from xew.sim_warp.physics.worlds import (
    FIRST_OBJECT,
    LEFT_ARM_LINKS,
    LEFT_FINGERS,
    RIGHT_FINGERS,
    STEPS_PER_FRAME,
    TABLE,
    Motion,
    World,
    canonical_joints,
    control_targets,
    finger_strokes,
    shape_owners,
    template_joints,
)
from xew.sim_warp.plan import HOME, LEFT, RIGHT, Timeline
from xew.sim_warp.production.cells import Cell, Job, plan_cells, with_motion
from xew.sim_warp.production.outcome import DEEPEST_IN_TABLE
from xew.sim_warp.production.warm_up import stand_at_home
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import Scene, scene_rng
from xew.sim_warp.tasks import TASKS

FRAMES = 9


def scene_of(task: str, seed: int = 1) -> Scene:
    return TASKS[task].sample(scene_rng(task, seed), seed)


def start_of(task: str, robot: str, seed: int = 1) -> World:
    """The first half second of an episode."""
    cell = plan_cells([Job(task, seed, (robot,))])[0][0]
    return World(cell.robot, cell.scene, cell.commands.action[:FRAMES])


def same(one: Motion, other: Motion) -> bool:
    return all(np.array_equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(Motion))


@pytest.mark.parametrize("key", ROBOTS)
def test_canonical_joints_survive_the_template(key: str) -> None:
    robot = ROBOTS[key]
    action = np.random.default_rng(0).uniform(0, 1, (5, 16))
    for joints, _ in ARMS:
        action[:, joints.start + robot.arm_joint_count : joints.stop] = 0.0
    np.testing.assert_allclose(canonical_joints(robot, template_joints(robot, action)), action, atol=1e-6)


@pytest.mark.parametrize("key", ROBOTS)
def test_the_template_counts_fingers_in_meters_from_closed(key: str) -> None:
    robot = ROBOTS[key]
    action = np.zeros((2, 16))
    action[1, 7] = 1.0
    joints = template_joints(robot, action)
    assert joints.shape == (2, 18) and (joints[0] == 0).all() and (joints[1, 9:] == 0).all()
    np.testing.assert_allclose(joints[1, 7:9], finger_strokes(robot, LEFT))
    assert 0.03 < finger_strokes(robot, LEFT).max() < 0.1


def test_targets_are_linear_between_frames_with_their_slope_as_velocity() -> None:
    action = np.zeros((3, 16))
    action[:, 0] = (0.0, 0.3, 0.0)
    targets = control_targets(ROBOTS["franka_panda"], action)
    assert targets.shape == (2, STEPS_PER_FRAME, 36)
    np.testing.assert_allclose(targets[0, :, 0], 0.3 * (np.arange(15) + 1) / 15)
    np.testing.assert_allclose(targets[0, :, 1], 0.3 * FRAME_RATE)
    np.testing.assert_allclose(targets[1, -1, :2], [0.0, -0.3 * FRAME_RATE])


def test_owners_of_shapes_by_their_labels() -> None:
    labels = ["a/left_finger1", "right_finger2", "w/0/left_link3", "x/object1", "object0", "table"]
    expected = [LEFT_FINGERS, RIGHT_FINGERS, LEFT_ARM_LINKS, FIRST_OBJECT + 1, FIRST_OBJECT, TABLE]
    assert shape_owners(labels).tolist() == expected


def test_the_c_engine_repeats_bit_for_bit_whatever_is_simulated_between() -> None:
    world, other = start_of("stack_bowls_two", "franka_panda"), start_of("open_laptop", "piper")
    first, _, second = simulate([world, other, world], "cpu")
    assert same(first, second)
    assert first.joint_pos.shape == (FRAMES, 16) and first.object_pose.shape == (FRAMES, 2, 7)


@pytest.mark.parametrize("key", ROBOTS)
def test_arms_follow_their_commands(key: str) -> None:
    """Half a second of a two-armed reach: a joint is a few milliradians behind, a sixth arm's seventh stays at zero."""
    robot = ROBOTS[key]
    world = start_of("grab_roller", key)
    motion = simulate([world], "cpu")[0]
    assert np.ptp(world.action, axis=0).max() > 0.02
    assert np.abs(motion.joint_pos - world.action).max() < 0.01
    for joints, _ in ARMS:
        assert (motion.joint_pos[:, joints.start + robot.arm_joint_count : joints.stop] == 0).all()
    assert not motion.overflow and motion.arm_overlap == 0.0


def stand_still(robot: RobotSpec, scene: Scene, frames: int) -> Motion:
    return simulate([World(robot, scene, stand_at_home(robot, frames))], "cpu")[0]


@pytest.mark.parametrize("share", [0.15, 0.5, 0.7])
def test_a_lid_stays_where_it_is_left(share: float) -> None:
    scene = scene_of("open_laptop")
    laptop = scene.objects[0]
    assert laptop.hinge is not None
    start = laptop.hinge.lower + share * (laptop.hinge.upper - laptop.hinge.lower)
    left = replace(scene, objects=(replace(laptop, hinge=replace(laptop.hinge, start=start)),))
    angle = stand_still(ROBOTS["piper"], left, 34).object_joint[:, 0]
    assert angle[0] == pytest.approx(start) and np.abs(angle - start).max() < np.radians(1)


def test_a_scene_beyond_the_template_is_refused() -> None:
    scene = scene_of("blocks_ranking_rgb")
    crowded = replace(scene, objects=(*scene.objects, replace(scene.objects[0], name="fourth")))
    with pytest.raises(ConfigError, match=f"has 4 free and 0 hinged objects; the template holds {FREE_SLOTS} free ones"):
        stand_still(ROBOTS["piper"], crowded, 1)


def driven(robot: RobotSpec, timeline: Timeline) -> Cell:
    """A plan of ours, carried out over the roller's scene whatever inverse kinematics thinks of it."""
    scene, path = scene_of("grab_roller"), timeline.path()
    commands = replace(joint_commands(robot, [path])[0], problem=None)
    motion = simulate([World(robot, scene, commands.action)], "cpu")[0]
    return with_motion(Cell("grab_roller", scene, path, robot.key, robot, commands), motion)


def test_a_hand_driven_into_the_table_is_seen() -> None:
    timeline = Timeline()
    timeline.follow(LEFT, [HOME[LEFT].moved(z=-0.22)], seconds=1.2)
    cell = driven(ROBOTS["franka_panda"], timeline)
    assert cell.known_motion.table_overlap > DEEPEST_IN_TABLE
    reason, words = cell.failure or ("", "")
    assert reason == "plan" and "into the table" in words


def test_a_hand_driven_into_the_other_is_seen() -> None:
    timeline = Timeline()
    timeline.follow(LEFT, [HOME[RIGHT]], seconds=1.5)
    reason, words = driven(ROBOTS["franka_panda"], timeline).failure or ("", "")
    assert reason == "plan" and "into each other" in words


def test_numbers_that_are_not_finite_are_never_taken_for_a_motion() -> None:
    robot = ROBOTS["piper"]
    action = stand_at_home(robot, 3)
    action[1:, 0] = np.nan
    motion = simulate([World(robot, scene_of("grab_roller"), action)], "cpu")[0]
    assert motion.overflow


# --- MuJoCo Warp, on Warp's CPU device: one batch of two robots and tasks, for all that follows.


@pytest.fixture(scope="module")
def mixed() -> list[World]:
    return [start_of("place_empty_cup", "piper"), start_of("open_laptop", "franka_panda")]


@pytest.fixture(scope="module")
def batch(mixed: list[World], quick_kernels: None) -> list[Motion]:
    return physics_gpu.simulate_batch(mixed, "cpu")


def test_all_that_a_batch_launches_is_known_before_it_runs(
    mixed: list[World], batch: list[Motion], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a GPU's kernels can be compiled together: none is left that is compiled when it is launched."""
    short = physics_gpu.Batch([replace(world, action=world.action[:2]) for world in mixed], warp.get_device("cpu"))
    noted = short.list_kernels()
    with launched_modules(monkeypatch) as launched:
        motions = short.run()
    assert len(launched) > 50
    assert launched <= {module.name for module, _ in noted}
    np.testing.assert_array_equal(motions[0].joint_pos, batch[0].joint_pos[:2])


def turned(one: np.ndarray, other: np.ndarray) -> float:
    """Largest angle between two poses [... 7], rad."""
    rotations = [Rotation.from_quat(pose[..., 3:].reshape(-1, 4)) for pose in (one, other)]
    return float((rotations[0].inv() * rotations[1]).magnitude().max())


def test_mujoco_warp_agrees_with_the_c_engine(mixed: list[World], batch: list[Motion]) -> None:
    """Single against double precision over eight frames: arms to rounding; what stands on the table creeps a little."""
    for expected, motion in zip(simulate(mixed, "cpu"), batch, strict=True):
        np.testing.assert_allclose(motion.joint_pos, expected.joint_pos, atol=1e-5)
        np.testing.assert_allclose(motion.joint_vel, expected.joint_vel, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(motion.object_pose[..., :3], expected.object_pose[..., :3], atol=5e-4)
        assert turned(motion.object_pose, expected.object_pose) < np.radians(0.3)
        np.testing.assert_allclose(motion.object_joint, expected.object_joint, atol=1e-4)
        np.testing.assert_array_equal(motion.contact, expected.contact)
        assert (
            motion.arm_overlap == expected.arm_overlap == motion.table_overlap == expected.table_overlap == 0.0
            and not motion.overflow
        )


def test_a_world_alone_moves_as_in_a_batch_of_several_kinds(mixed: list[World], batch: list[Motion]) -> None:
    """Arms bit for bit; objects to the rounding of contacts, which the solver adds up in the order of the whole batch."""
    for world, motion in zip(mixed, batch, strict=True):
        alone = physics_gpu.simulate_batch([world], "cpu")[0]
        np.testing.assert_array_equal(alone.joint_pos, motion.joint_pos)
        np.testing.assert_allclose(alone.object_pose[..., :3], motion.object_pose[..., :3], atol=5e-4)
        assert turned(alone.object_pose, motion.object_pose) < np.radians(0.1)


def test_worlds_that_overflow_are_stepped_again_with_larger_buffers(
    mixed: list[World], batch: list[Motion], monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[tuple[int, int]] = []

    class Recorded(physics_gpu.Batch):
        def __init__(self, worlds: list[World], device: object, scale: int = 1) -> None:
            sizes.append((len(worlds), scale))
            super().__init__(worlds, device, scale)

    monkeypatch.setattr(physics_gpu, "Batch", Recorded)
    monkeypatch.setattr(physics_gpu, "CONTACTS_PER_WORLD", 1)
    short = [replace(world, action=world.action[:2]) for world in mixed]
    motions = physics_gpu.simulate_batch(short, "cpu")
    assert sizes == [(2, 1), (2, 2)], "the four contacts of the cup fit at the second attempt"
    for motion, expected in zip(motions, batch, strict=True):
        assert not motion.overflow
        np.testing.assert_array_equal(motion.object_pose, expected.object_pose[:2])
    monkeypatch.setattr(physics_gpu, "ATTEMPTS", 1)
    assert all(motion.overflow for motion in physics_gpu.simulate_batch(short, "cpu"))
