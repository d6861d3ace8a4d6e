"""Plans know no robot; commands follow them within limits, or say in words why they cannot."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xew.protocol import ARMS, FRAME_RATE
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.kinematics.expert import POSITION_TOLERANCE, ROTATION_TOLERANCE, Commands, joint_commands
from xew.sim_warp.kinematics.forward import tool_pose
from xew.sim_warp.plan import GRIP_TIME, HOME, LEFT, RIGHT, TOOL_SPEED, TURN_SPEED, Timeline, ToolPath, minimum_jerk, tool
from xew.sim_warp.production.cells import Job, measured_tools, plan_cells
from xew.sim_warp.production.warm_up import stand_at_home
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import scene_rng
from xew.sim_warp.tasks import TASKS

SIDES = (LEFT, RIGHT)


def path_of(task: str, seed: int) -> ToolPath:
    return TASKS[task].plan(TASKS[task].sample(scene_rng(task, seed), seed)).path()


def difference(pose: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [m] and angles [rad] between poses [... 7]."""
    turned = Rotation.from_quat(pose[..., 3:].reshape(-1, 4)).inv() * Rotation.from_quat(other[..., 3:].reshape(-1, 4))
    return np.linalg.norm(pose[..., :3] - other[..., :3], axis=-1), turned.magnitude()


@pytest.mark.parametrize("task", TASKS)
def test_a_path_starts_at_home_with_open_hands(task: str) -> None:
    for seed in range(5):
        path = path_of(task, seed)
        assert (path.gripper[0] == 1).all()
        for arm in SIDES:
            np.testing.assert_allclose(path.pose[0, arm], [*HOME[arm].position, *HOME[arm].rotation.as_quat()], atol=1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_tools_keep_their_speed(task: str) -> None:
    """A minimum-jerk move peaks at 1.875 times its mean speed; `follow` sets its own pace, no faster."""
    for seed in range(5):
        pose = path_of(task, seed).pose
        speed, turning = (np.asarray(d).reshape(len(pose) - 1, 2) * FRAME_RATE for d in difference(pose[:-1], pose[1:]))
        fastest_turn = 0.9 if task.startswith("shake") else 0.6  # a shake is meant to be brisk; joints keep their limits
        assert speed.max() < 1.9 * max(TOOL_SPEED, 0.2) and turning.max() < 1.9 * max(TURN_SPEED, fastest_turn)
        assert speed[0].max() < 0.1 and speed[-1].max() < 0.1


def test_both_tools_of_a_move_start_and_arrive_together() -> None:
    timeline = Timeline()
    timeline.move({LEFT: HOME[LEFT].moved(z=0.01), RIGHT: HOME[RIGHT].moved(x=0.16)})
    path = timeline.path()
    ways = np.linalg.norm(path.pose[..., :3] - path.pose[:1, :, :3], axis=-1)
    np.testing.assert_allclose(ways[:, LEFT] / 0.01, ways[:, RIGHT] / 0.16, atol=1e-9)
    assert path.frame_count == int(np.ceil(FRAME_RATE * 0.16 / TOOL_SPEED)) + 1


def test_grippers_move_while_tools_stand_and_holds_remember_when() -> None:
    timeline = Timeline()
    timeline.grip({LEFT: 0.0})
    timeline.wait(0.3)
    timeline.hold(LEFT, "thing")
    path = timeline.path()
    np.testing.assert_allclose(path.gripper[[0, 4, 8], LEFT], [1, 0.5, 0], atol=1e-9)
    assert (path.gripper[:, RIGHT] == 1).all() and (path.pose == path.pose[:1]).all()
    (hold,) = path.holds
    assert (hold.arm, hold.name, hold.start, hold.end) == (LEFT, "thing", GRIP_TIME, GRIP_TIME + 0.3)


def test_a_followed_curve_meets_its_waypoints_and_stops_nowhere_between() -> None:
    corner, end = HOME[LEFT].moved(z=0.03), HOME[LEFT].moved(z=0.03, y=0.03)
    timeline = Timeline()
    timeline.follow(LEFT, [corner, end], seconds=1.2)
    path = timeline.path()
    np.testing.assert_allclose(path.pose[10, LEFT, :3], corner.position, atol=1e-9)
    np.testing.assert_allclose(path.pose[-1, LEFT, :3], end.position, atol=1e-9)
    assert np.linalg.norm(np.diff(path.pose[:, LEFT, :3], axis=0), axis=-1)[8:12].min() > 0.003


def test_minimum_jerk_starts_and_ends_at_rest() -> None:
    share = np.linspace(-0.5, 1.5, 401)
    progress = minimum_jerk(share)
    assert (np.diff(progress) >= 0).all() and progress[0] == 0 and progress[-1] == 1
    assert np.diff(progress).max() / np.diff(share)[0] == pytest.approx(1.875, rel=1e-3)


def test_the_tool_frame_is_what_it_is_said_to_be() -> None:
    x, y, _ = tool((0, 0, 0)).rotation.as_matrix().T
    np.testing.assert_allclose([x, np.abs(y)], [[0, 0, -1], [1, 0, 0]], atol=1e-12)
    leaning = tool((0, 0, 0), tilt=0.3).rotation.apply([1, 0, 0])
    np.testing.assert_allclose(leaning, [0, np.sin(0.3), -np.cos(0.3)], atol=1e-12)


def test_what_is_held_turns_with_the_hand() -> None:
    grasp = tool((0.25, 0.1, 0.8), yaw=0.2, tilt=0.4)
    carried = grasp.carried(np.array([0.2, 0.1, 0.74]), np.array([-0.1, 0.0, 0.74]), turn=np.pi / 2)
    np.testing.assert_allclose(carried.position, [-0.1, 0.05, 0.8], atol=1e-12)
    assert (grasp.rotation.inv() * carried.rotation).magnitude() == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("key", ROBOTS)
def test_home_is_where_plans_begin(key: str) -> None:
    home = measured_tools(ROBOTS[key], stand_at_home(ROBOTS[key], 1))[0]
    for arm in SIDES:
        distance, angle = difference(home[arm], np.concatenate([HOME[arm].position, HOME[arm].rotation.as_quat()]))
        assert distance < 0.001 and angle[0] < 0.005


@pytest.fixture(scope="module")
def commanded() -> dict[str, list[tuple[RobotSpec, ToolPath, Commands]]]:
    """One seed of two tasks, one of two arms together and one of long reach, on all robots."""
    cells = plan_cells([Job("grab_roller", 3, tuple(ROBOTS)), Job("blocks_ranking_rgb", 3, tuple(ROBOTS))])
    return {
        key: [(cell.robot, cell.path, cell.commands) for seed in cells for cell in seed if cell.robot_name == key]
        for key in ROBOTS
    }


@pytest.mark.parametrize("key", ROBOTS)
def test_commands_follow_the_path_within_limits(key: str, commanded: dict) -> None:
    for robot, path, commands in commanded[key]:
        assert commands.problem is None
        assert commands.action.shape == (path.frame_count, 16) and commands.action.dtype == np.float32
        count = robot.arm_joint_count
        for arm, (joints, gripper) in enumerate(ARMS):
            joint_pos = commands.action[:, joints].astype(float)
            assert (joint_pos[:, :count] >= np.array(robot.joint_lower) - 1e-6).all()
            assert (joint_pos[:, :count] <= np.array(robot.joint_upper) + 1e-6).all()
            assert (joint_pos[:, count:] == 0).all()
            assert (np.abs(np.diff(joint_pos[:, :count], axis=0)) * FRAME_RATE <= np.array(robot.joint_velocity) + 1e-4).all()
            distance, angle = difference(tool_pose(robot, arm, joint_pos[:, :count]), path.pose[:, arm])
            assert distance.max() < POSITION_TOLERANCE + 1e-4 and angle.max() < ROTATION_TOLERANCE + 1e-3
            np.testing.assert_array_equal(commands.action[:, gripper], path.gripper[:, arm].astype(np.float32))


def test_all_robots_share_the_clock(commanded: dict) -> None:
    lengths = {key: [len(commands.action) for _, _, commands in cells] for key, cells in commanded.items()}
    assert len(set(map(tuple, lengths.values()))) == 1


def test_commands_do_not_depend_on_what_is_solved_beside_them(commanded: dict) -> None:
    alone = plan_cells([Job("grab_roller", 3, ("ur5_wsg",))])[0][0]
    among = commanded["ur5_wsg"][0][2]
    assert alone.commands.action.tobytes() == among.action.tobytes()


def test_out_of_reach_is_told_in_words() -> None:
    timeline = Timeline()
    timeline.follow(RIGHT, [HOME[RIGHT].moved(y=1.5)], seconds=1.0)
    commands = joint_commands(ROBOTS["piper"], [timeline.path()])[0]
    assert commands.problem is not None and commands.problem.startswith("right arm cannot reach: off by")


def test_too_fast_is_told_in_words() -> None:
    timeline = Timeline()
    timeline.follow(LEFT, [HOME[LEFT].moved(x=-0.03)], seconds=0.3)
    quick = joint_commands(ROBOTS["arx_x5"], [timeline.path()])[0]
    slow = joint_commands(replace(ROBOTS["arx_x5"], joint_velocity=(0.1,) * 6), [timeline.path()])[0]
    assert quick.problem is None
    assert slow.problem is not None and "its limit is 0.1" in slow.problem and slow.problem.startswith("left joint")
