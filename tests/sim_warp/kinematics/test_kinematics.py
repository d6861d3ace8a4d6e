"""Forward kinematics against chains computed here from the reference table; inverse kinematics and reach."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from xew.sim_warp.kinematics.batched import BatchedKinematics
from xew.sim_warp.kinematics.forward import (
    finger_positions,
    forward_kinematics,
    joint_positions,
    link_matrices,
    link_poses,
    tool_pose,
)
from xew.sim_warp.kinematics.inverse import ArmSolver, arm_solver
from xew.sim_warp.kinematics.reachability import work_reach
from xew.sim_warp.plan import tool
from xew.sim_warp.robots import ROBOTS, RobotSpec, load_urdf

CHAINS = json.loads((Path(__file__).parents[1] / "data" / "chains.json").read_text())["robots"]
robots = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)


def rpy_matrix(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Written out here so that the test shares no rotation code with what it tests."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def axis_matrix(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def reference_poses(key: str, position: dict[str, float]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rotation [3 3] and origin [3] of every link, by walking up the reference table."""
    by_child = {row[3]: row for row in CHAINS[key]["joints"]}

    def pose(link: str) -> tuple[np.ndarray, np.ndarray]:
        if link not in by_child:
            return np.eye(3), np.zeros(3)
        name, kind, parent, _, *numbers = by_child[link]
        rotation, origin = pose(parent)
        origin = origin + rotation @ np.array(numbers[:3])
        rotation = rotation @ rpy_matrix(*numbers[3:6])
        axis = np.array(numbers[6:9])
        if kind == "prismatic":
            origin = origin + rotation @ axis * position[name]
        elif kind != "fixed":
            rotation = rotation @ axis_matrix(axis, position[name])
        return rotation, origin

    return {link: pose(link) for link in [CHAINS[key]["root"], *by_child]}


@robots
def test_every_link_is_where_the_reference_chain_puts_it(robot: RobotSpec) -> None:
    urdf = load_urdf(robot.urdf)
    rng = np.random.default_rng(1)
    joint_pos = np.vstack([np.zeros(len(urdf.joint_names)), rng.uniform(-3, 3, (5, len(urdf.joint_names)))])
    found = forward_kinematics(robot, joint_pos)
    assert list(found) == list(urdf.links)
    for index, row in enumerate(joint_pos):
        expected = reference_poses(robot.key, dict(zip(urdf.joint_names, row, strict=True)))
        assert set(expected) == set(found)
        for link, (rotation, origin) in expected.items():
            pose = found[link][index]
            assert np.linalg.norm(pose[:3] - origin) < 1e-4, link
            off = Rotation.from_matrix(rotation.T @ Rotation.from_quat(pose[3:]).as_matrix()).magnitude()
            assert off < 1e-4, link


def test_forward_kinematics_takes_what_load_urdf_returns() -> None:
    robot = ROBOTS["piper"]
    urdf = load_urdf(robot.urdf)
    joint_pos = np.full((1, len(urdf.joint_names)), 0.3)
    for link, pose in forward_kinematics(urdf, joint_pos).items():
        assert np.array_equal(pose, forward_kinematics(robot, joint_pos)[link])


def test_a_wrong_number_of_joints_is_named() -> None:
    with pytest.raises(ValueError, match=r"piper needs \[n 8\], one column for each of joint1"):
        forward_kinematics(ROBOTS["piper"], np.zeros((1, 6)))


@robots
@pytest.mark.parametrize(("dtype", "tolerance"), [(wp.float32, 1e-5), (wp.float64, 1e-12)], ids=("float", "double"))
def test_the_kernel_agrees_with_numpy(robot: RobotSpec, dtype: type, tolerance: float) -> None:
    urdf = load_urdf(robot.urdf)
    joint_pos = np.random.default_rng(5).uniform(-3, 3, (70, len(urdf.joint_names)))
    batched = BatchedKinematics(urdf, "cpu", dtype)
    found = batched.poses(wp.array(joint_pos, dtype=dtype, device="cpu")).numpy()
    assert found.shape == (70, len(urdf.links), 7)
    assert set(batched.links) == set(urdf.links)
    assert (found[..., 6] >= 0).all()
    expected = link_matrices(urdf, joint_pos)
    for number, link in enumerate(batched.links):
        assert np.abs(found[:, number, :3] - expected[link][:, :3, 3]).max() < tolerance, link
        turned = Rotation.from_quat(found[:, number, 3:]).as_matrix()
        assert np.abs(turned - expected[link][:, :3, :3]).max() < tolerance, link


def test_arrays_that_do_not_fit_are_named() -> None:
    batched = BatchedKinematics(load_urdf(ROBOTS["piper"].urdf), "cpu")
    with pytest.raises(ValueError, match=r"shape \(4, 14\), expected \(configurations, 8\)"):
        batched.poses(wp.zeros((4, 14), device="cpu"))
    with pytest.raises(ValueError, match=rf"out has shape \(4, 12, 7\), expected \(4, {len(batched.links)}, 7\)"):
        batched.poses(wp.zeros((4, 8), device="cpu"), wp.empty((4, 12, 7), device="cpu"))


def test_rows_changed_in_place_are_posed_again() -> None:
    """A call with the arrays of the one before repeats its launch; other arrays do not."""
    batched = BatchedKinematics(load_urdf(ROBOTS["piper"].urdf), "cpu")
    rng = np.random.default_rng(7)
    first, second = (rng.uniform(0, 1, (9, 8)).astype(np.float32) for _ in range(2))
    rows = wp.array(first, device="cpu")
    out = batched.poses(rows)
    before = out.numpy().copy()
    rows.assign(second)
    assert batched.poses(rows, out) is out
    after = out.numpy().copy()
    assert not np.array_equal(before, after)
    other = batched.poses(wp.array(first, device="cpu"), out)
    assert other is out and np.array_equal(out.numpy(), before)
    assert np.array_equal(batched.poses(rows).numpy(), after) and np.array_equal(out.numpy(), before)
    assert batched.poses(wp.empty((0, 8), device="cpu")).shape == (0, len(batched.links), 7)


@robots
def test_canonical_rows_pose_both_arms(robot: RobotSpec) -> None:
    rng = np.random.default_rng(2)
    action = rng.uniform(0, 1, (3, 16))
    copies = joint_positions(robot, action)
    assert len(copies) == (1 if robot.one_urdf_holds_both_arms else 2)
    names = load_urdf(robot.urdf).joint_names
    for side, (start, arm) in enumerate(zip((0, 8), robot.arms, strict=True)):
        joint_pos = copies[min(side, len(copies) - 1)]
        count = robot.arm_joint_count
        assert np.array_equal(joint_pos[:, [names.index(j) for j in arm.joints]], action[:, start : start + count])
        fingers = joint_pos[:, [names.index(j) for j in arm.fingers]]
        assert np.allclose(fingers, finger_positions(arm, action[:, start + 7]))
        poses = link_poses(robot, action)[min(side, len(copies) - 1)]
        tool_link = Rotation.from_quat(poses[arm.tool_link][:, 3:])
        expected = poses[arm.tool_link][:, :3] + tool_link.apply(arm.tool_pose[:3])
        assert np.allclose(tool_pose(robot, side, action[:, start : start + count])[:, :3], expected, atol=1e-9)


@robots
def test_inverse_undoes_forward(robot: RobotSpec) -> None:
    rng = np.random.default_rng(3)
    lower, upper = np.array(robot.joint_lower), np.array(robot.joint_upper)
    middle, reach = (lower + upper) / 2, 0.35 * np.minimum(upper - lower, np.pi)
    joint_pos = middle + rng.uniform(-1, 1, (16, len(lower))) * reach
    arm = np.arange(16) % 2
    wanted = np.stack([tool_pose(robot, side, row[None])[0] for side, row in zip(arm, joint_pos, strict=True)])
    seed = np.clip(joint_pos + rng.normal(0, 0.05, joint_pos.shape), lower, upper)
    solution = arm_solver(robot).solve(arm, wanted, seed)
    found, position_error = solution.joint_pos, solution.position_error
    assert position_error.max() < 2e-4
    assert solution.rotation_error.max() < 1e-3
    assert (found >= lower).all() and (found <= upper).all()
    again = np.stack([tool_pose(robot, side, row[None])[0] for side, row in zip(arm, found, strict=True)])
    assert np.linalg.norm(again[:, :3] - wanted[:, :3], axis=-1) == pytest.approx(position_error, abs=1e-9)


def test_arms_that_differ_beyond_their_bases_are_solved_each() -> None:
    left, right = ROBOTS["piper"].arms
    longer = replace(right, tool_pose=(*np.add(right.tool_pose[:3], 0.05).tolist(), *right.tool_pose[3:]))
    robot = replace(ROBOTS["piper"], arms=(left, longer))
    seed, arm = np.array([left.home, right.home, left.home]), np.array([0, 1, 0])
    wanted = np.stack([tool_pose(robot, side, row[None] + 0.05)[0] for side, row in zip(arm, seed, strict=True)])
    solution = ArmSolver(robot).solve(arm, wanted, seed)
    assert solution.position_error.max() < 2e-4 and solution.rotation_error.max() < 1e-3
    path = ArmSolver(robot).solve_path([0, 1], wanted[None, :2], seed[:2])
    assert path.position_error.max() < 2e-4


def test_robots_that_share_buffers_are_not_mixed_up() -> None:
    solvers = [ArmSolver(ROBOTS[name]) for name in ("piper", "ur5_wsg", "aloha_agilex")]
    seeds = [np.array([arm.home for arm in solver.robot.arms]) for solver in solvers]
    paths = [
        np.stack([tool_pose(solver.robot, side, row[None] + 0.05)[0] for side, row in enumerate(seed)])[None].repeat(9, 0)
        for solver, seed in zip(solvers, seeds, strict=True)
    ]
    first = [solver.solve_path([0, 1], *given).joint_pos for solver, *given in zip(solvers, paths, seeds, strict=True)]
    again = [solver.solve_path([0, 1], *given).joint_pos for solver, *given in zip(solvers, paths, seeds, strict=True)]
    assert all(np.array_equal(one, two) for one, two in zip(first, again, strict=True))
    assert np.abs(first[0] - first[2]).max() > 0.1


def test_out_of_reach_is_reported() -> None:
    robot = ROBOTS["piper"]
    far = np.array([[5.0, 5.0, 5.0, 0, 0, 0, 1]])
    solution = arm_solver(robot).solve(0, far, np.array([robot.arms[0].home]))
    assert solution.position_error[0] > 1


@robots
def test_paths_are_followed_smoothly(robot: RobotSpec) -> None:
    """Both arms down to the table, across it and up again: close to the tool's path, no jump of a joint."""
    frames = 41
    share = np.linspace(0, 1, frames)
    path = np.empty((frames, 2, 7))
    for arm, mirror in enumerate((1, -1)):
        corners = np.array([[-0.17, -0.24, 0.88], [-0.20, -0.05, 0.78], [-0.02, 0.0, 0.78], [-0.10, -0.1, 0.88]]) * [
            mirror,
            1,
            1,
        ]
        path[:, arm, :3] = np.stack([np.interp(share, np.linspace(0, 1, 4), corners[:, axis]) for axis in range(3)], -1)
        path[:, arm, 3:] = tool((0, 0, 0), tilt=math.radians(30)).rotation.as_quat()
    start = np.array([arm.home for arm in robot.arms])
    solution = ArmSolver(robot).solve_path([0, 1], path, start)
    assert solution.joint_pos.shape == (frames, 2, robot.arm_joint_count)
    assert solution.position_error.max() < 1e-3
    assert solution.rotation_error.max() < 5e-3
    assert np.abs(solution.joint_pos[0] - start).max() < 0.02
    assert np.abs(np.diff(solution.joint_pos, axis=0)).max() < 0.25


@pytest.mark.parametrize("lengths", [(1, 9), (10, 8), (17, 4)])
def test_a_path_has_the_same_bits_with_longer_and_shorter_ones(lengths: tuple[int, int]) -> None:
    robot = ROBOTS["ur5_wsg"]
    start = np.array([robot.arms[0].home, robot.arms[1].home])
    turned = start + np.linspace(0, 0.3, max(lengths))[:, None, None]
    poses = np.stack([tool_pose(robot, arm, turned[:, arm]) for arm in (0, 1)], 1)
    solver = ArmSolver(robot)
    together = solver.solve_path([0, 1], poses, start, np.array(lengths))
    for arm, length in enumerate(lengths):
        alone = solver.solve_path(arm, poses[:length, arm : arm + 1], start[arm : arm + 1])
        assert np.array_equal(together.joint_pos[:length, arm], alone.joint_pos[:, 0])
        assert np.array_equal(
            together.joint_pos[length - 1 :, arm], alone.joint_pos[-1:].repeat(max(lengths) - length + 1, 0)[:, 0]
        )


def test_a_batch_of_one_is_a_row_of_a_larger_batch() -> None:
    robot = ROBOTS["franka_panda"]
    rng = np.random.default_rng(4)
    seed = np.array(robot.arms[0].home) + rng.normal(0, 0.1, (7, 7))
    wanted = tool_pose(robot, 0, seed + rng.normal(0, 0.05, (7, 7)))
    solver = ArmSolver(robot)
    together = solver.solve(0, wanted, seed).joint_pos
    alone = solver.solve(0, wanted[3:4], seed[3:4]).joint_pos
    assert np.array_equal(alone[0], together[3])


@robots
@pytest.mark.parametrize("arm", (0, 1))
def test_both_arms_reach_the_work_area(robot: RobotSpec, arm: int) -> None:
    """Grasps at a tilt of 30 degrees, hand turned up to 45 degrees, from home inside the real limits to 2 mm."""
    found = work_reach(robot, arm)
    assert found.mean() > 0.95
    straight = found[len(found) // 2]
    assert straight[:-1].mean() > 0.98, "hand pointing away from the shoulder, all but the column past the middle"
