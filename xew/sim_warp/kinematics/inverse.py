"""Inverse kinematics: batched Levenberg-Marquardt of newton.ik, on the CPU or a GPU.

Every arm has seven joints (six-joint arms get a fixed last one): one set of kernels, and one graph of their launches, serves
all robots. Arms that differ only by their bases are solved together, mirrored arms separately.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from xew.concurrency import PARSING
from xew.sim_warp.devices.newton import newton, without_adjoints
from xew.sim_warp.devices.waiting import wait_for
from xew.sim_warp.embodiment.spec import Arm, RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix
from xew.sim_warp.kinematics.forward import tool_matrix

JOINT_COUNT = 7
POSITION_WEIGHT = 4.0
"""Weight of a position residual: 1 m counts as much as 4 rad."""
LIMIT_WEIGHT = 2.0
POSTURE_WEIGHT = 0.01
"""Weight that pulls a seven-joint arm toward the mean of its two homes, against drift of the elbow."""
POLISH_STEPS = 4
"""Number of last steps without that weight."""
ANCHOR_STRIDE = 8
"""Number of frames between poses of a path that are solved one after another; the frames between them are solved at once."""
LARGEST_BATCH = 1024
"""Largest number of poses per call on a CPU; batches are filled up to a power of two."""


@dataclass(frozen=True)
class Solution:
    """Joint positions for tool poses, with their errors."""

    joint_pos: np.ndarray
    """[... d] float64, rad, inside the robot's limits."""
    position_error: np.ndarray
    """[...] m, distance between the target and the reached tool frame."""
    rotation_error: np.ndarray
    """[...] rad, angle between them."""


class ArmSolver:
    """Inverse kinematics of one robot's arms.

    Args:
        robot: the robot.
        device: Warp's name of the device, None for its default.
        iterations: Levenberg-Marquardt steps per call.
        posture_weight: weight that pulls a seven-joint arm toward the mean of its homes; 0 if there are no homes yet.
    """

    def __init__(
        self, robot: RobotSpec, device: str | None = None, iterations: int = 24, posture_weight: float = POSTURE_WEIGHT
    ) -> None:
        self.robot = robot
        self.iterations = iterations
        self.posture_weight = posture_weight if robot.arm_joint_count == JOINT_COUNT else 0.0
        self.base = arm_bases(robot)
        self.device = wp.get_device(device)
        alike = _are_alike(robot)
        homes = [np.mean([arm.home for arm in robot.arms], 0)] if alike else [np.array(arm.home) for arm in robot.arms]
        self.models = [_pose_as_seven(robot, arm, home) for arm, home in zip(robot.arms, homes, strict=False)]
        self.lower, self.upper = np.array(robot.joint_lower), np.array(robot.joint_upper)

    def solve(self, arm: int | np.ndarray, tool_pose: np.ndarray, seed: np.ndarray) -> Solution:
        """Joint positions for tool poses, near a seed.

        Args:
            arm: 0 (left) or 1 (right), one for all or [n].
            tool_pose: [n 7], target poses of the tool frame in the world.
            seed: [n d], start of the search [rad].

        Returns:
            Solution of [n ...], for a pose out of reach the nearest solution with its errors.
        """
        arm = np.broadcast_to(arm, len(tool_pose))
        joint_pos = self._nearest(arm, self._in_base(arm, tool_pose), seed)
        return Solution(joint_pos, *_pose_errors(self._reached(arm, joint_pos), tool_pose))

    def solve_in_base(self, arm: np.ndarray, tool_pose: np.ndarray, seed: np.ndarray) -> Solution:
        """As `solve`, for poses [n 7] in the frame in which an arm's first joint turns."""
        side = arm if len(self.models) > 1 else np.zeros_like(arm)
        joint_pos = self._nearest(side, tool_pose, seed)
        reached = np.linalg.inv(self.base)[side] @ self._reached(side, joint_pos)
        return Solution(joint_pos, *_pose_errors(reached, tool_pose))

    def solve_path(
        self, arm: int | np.ndarray, tool_pose: np.ndarray, start: np.ndarray, lengths: np.ndarray | None = None
    ) -> Solution:
        """Solution [t n ...] along paths of the tool; the bits of a path do not depend on the others.

        Args:
            arm: 0 (left) or 1 (right), one for all or [n].
            tool_pose: [t n 7], target poses of the tool frame in the world.
            start: [n d], joint positions before the first pose [rad].
            lengths: [n] int, numbers of frames of the paths, after which their last pose is repeated; default: t.
        """
        frames, count = tool_pose.shape[:2]
        arm, columns = np.broadcast_to(arm, count), np.arange(count)
        last = np.full(count, frames - 1) if lengths is None else lengths - 1
        anchors = np.minimum(np.arange(0, frames + ANCHOR_STRIDE - 1, ANCHOR_STRIDE)[:, None], last)
        at_anchor = np.empty((len(anchors), *start.shape))
        for index, frame in enumerate(anchors):
            start = at_anchor[index] = self._nearest(arm, self._in_base(arm, tool_pose[frame, columns]), start)
        frame, column = np.nonzero(np.arange(frames)[:, None] <= last)
        poses, seed = tool_pose[frame, column], _interpolate(frame, column, anchors, at_anchor)
        joint_pos = self._nearest(arm[column], self._in_base(arm[column], poses), seed)
        solved = Solution(joint_pos, *_pose_errors(self._reached(arm[column], joint_pos), poses))
        row = np.zeros((frames, count), int)
        row[frame, column] = np.arange(len(frame))
        row = row[np.minimum(np.arange(frames)[:, None], last), columns]
        return Solution(solved.joint_pos[row], solved.position_error[row], solved.rotation_error[row])

    def _in_base(self, arm: np.ndarray, tool_pose: np.ndarray) -> np.ndarray:
        """Tool poses [n 7] seen from the bases of their arms [n]."""
        return pose_from_matrix(np.linalg.inv(self.base)[arm] @ matrix_from_pose(tool_pose))

    def _nearest(self, arm: np.ndarray, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """[n d] joint positions of arms [n] for poses [n 7] in their bases, found from seeds [n d]."""
        if len(self.models) == 1:
            return self._solve(0, target, seed)
        joint_pos = np.empty(seed.shape)
        for side in np.unique(arm).tolist():
            joint_pos[arm == side] = self._solve(side, target[arm == side], seed[arm == side])
        return joint_pos

    def _solve(self, number: int, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """As `_nearest`, for the arms of one model."""
        if len(target) > LARGEST_BATCH and not self.device.is_cuda:
            parts = [slice(first, first + LARGEST_BATCH) for first in range(0, len(target), LARGEST_BATCH)]
            return np.concatenate([self._solve(number, target[part], seed[part]) for part in parts])
        size = 1 << max(0, len(target) - 1).bit_length()
        problems = _problems(self.device.alias, seed.shape[1], size, self.iterations, self.posture_weight)
        problems.set_arm(self.models[number])
        return np.clip(problems.solve(target, seed), self.lower, self.upper)

    def _reached(self, arm: np.ndarray, joint_pos: np.ndarray) -> np.ndarray:
        """[n 4 4] world poses of the tool frames of arms [n] at joint positions [n d]."""
        reached = np.empty((len(arm), 4, 4))
        for side in np.unique(arm):
            reached[arm == side] = tool_matrix(self.robot, side, joint_pos[arm == side])
        return reached


def _pose_errors(reached: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [n] m and angles [n] rad between tool frames [n 4 4] and poses [n 7]."""
    position = np.linalg.norm(reached[:, :3, 3] - wanted[:, :3], axis=-1)
    rotation = (Rotation.from_matrix(reached[:, :3, :3]).inv() * Rotation.from_quat(wanted[:, 3:])).magnitude()
    return position, rotation


@lru_cache(maxsize=128)
def arm_solver(robot: RobotSpec, device: str | None = None) -> ArmSolver:
    """The process's solver of a robot on a device, created at first use."""
    return ArmSolver(robot, device)


def _interpolate(frame: np.ndarray, column: np.ndarray, anchors: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values [a n d] at anchor frames [a n], linearly between them at frames [m] of columns [m]: [m d]."""
    after = -(-frame // ANCHOR_STRIDE)
    before = np.maximum(after - 1, 0)
    first, second = anchors[before, column], anchors[after, column]
    share = (frame - first) / np.maximum(second - first, 1)
    start = values[before, column]
    return start + share[:, None] * (values[after, column] - start)


def _segments(robot: RobotSpec, arm: Arm) -> list[np.ndarray]:
    """Transforms [4 4] from the root to the first joint, between joints, and from the last joint to the tool."""
    segments, frame = [], np.eye(4)
    for joint in load_urdf(robot.urdf).chain(arm.tool_link):
        frame = frame @ joint.origin
        if joint.name in arm.joints:
            segments.append(frame)
            frame = np.eye(4)
    return [*segments, frame @ matrix_from_pose(arm.tool_pose)]


def arm_bases(robot: RobotSpec) -> np.ndarray:
    """[2 4 4] world poses of the frames in which the first joints of both arms turn."""
    return np.stack([matrix_from_pose(arm.root_pose) @ _segments(robot, arm)[0] for arm in robot.arms])


def _are_alike(robot: RobotSpec) -> bool:
    """Whether the arms differ only by their bases."""
    joints = load_urdf(robot.urdf).joints
    left, right = (_segments(robot, arm) for arm in robot.arms)
    axes, others = ([joints[name].axis for name in arm.joints] for arm in robot.arms)
    return np.allclose(left[1:], right[1:], atol=1e-6) and np.allclose(axes, others, atol=1e-6)


@dataclass(frozen=True)
class _SevenJoints:
    """An arm from its first joint on, with seven joints; added joints do not move."""

    parents: np.ndarray
    """[7 7] poses of the joints in their parent links, xyz [m] and quaternion xyzw."""
    axes: np.ndarray
    """[7 3] unit axes of the joints."""
    children: np.ndarray
    """[7 7] poses of the joints in their child links; the frame of the last real link is the tool frame."""
    lower: np.ndarray
    upper: np.ndarray
    """[7] limits [rad]."""
    home: np.ndarray
    """[7] posture of the posture weight [rad]."""


def _pose_as_seven(robot: RobotSpec, arm: Arm, home: np.ndarray) -> _SevenJoints:
    """An arm of a robot and its posture [d] rad as seven joints."""
    segments = _segments(robot, arm)
    count = len(arm.joints)
    parents = np.tile(pose_from_matrix(np.eye(4)), (JOINT_COUNT, 1))
    parents[1:count] = [pose_from_matrix(segment) for segment in segments[1:count]]
    children = np.tile(pose_from_matrix(np.eye(4)), (JOINT_COUNT, 1))
    children[count - 1] = pose_from_matrix(np.linalg.inv(segments[-1]))
    axes = np.tile([0.0, 0.0, 1.0], (JOINT_COUNT, 1))
    axes[:count] = [load_urdf(robot.urdf).joints[name].axis for name in arm.joints]
    limits = np.zeros((3, JOINT_COUNT))
    limits[:, :count] = robot.joint_lower, robot.joint_upper, home
    return _SevenJoints(parents, axes / np.linalg.norm(axes, axis=1, keepdims=True), children, *limits)


@lru_cache(maxsize=64)
def _problems(device: str, joints: int, size: int, iterations: int, posture_weight: float) -> "_Problems":
    """The process's problems for all arms with a number of joints."""
    return _Problems(device, joints, size, iterations, posture_weight)


class _Problems:
    """A fixed number of problems of one arm, with buffers and a captured graph that serves all arms."""

    def __init__(self, device: str, joints: int, size: int, iterations: int, posture_weight: float) -> None:
        self.model = _chain(device)
        self.device = self.model.device
        self.arm: _SevenJoints | None = None
        self.home = wp.zeros(JOINT_COUNT, dtype=wp.float32, device=device)
        self.positions = wp.zeros(size, dtype=wp.vec3, device=device)
        self.rotations = wp.zeros(size, dtype=wp.vec4, device=device)
        self.joint_pos = wp.zeros((size, JOINT_COUNT), dtype=wp.float32, device=device)
        self.iterations = iterations
        self.posture = newton.ik.IKObjectiveJointLimit(self.home, self.home)
        self.posture_weight = posture_weight
        model, link = self.model, joints - 1
        objectives = [
            newton.ik.IKObjectivePosition(link, wp.vec3(), self.positions, weight=POSITION_WEIGHT),
            newton.ik.IKObjectiveRotation(link, wp.quat_identity(), self.rotations),
            newton.ik.IKObjectiveJointLimit(model.joint_limit_lower, model.joint_limit_upper, weight=LIMIT_WEIGHT),
            self.posture,
        ]
        with without_adjoints():
            self.solver = newton.ik.IKSolver(
                model, size, objectives, jacobian_mode=newton.ik.IKJacobianType.ANALYTIC, lambda_initial=1e-3
            )
        self.has_run = False
        self.graph: wp.Graph | None = None

    def set_arm(self, arm: _SevenJoints) -> None:
        """Write an arm's parameters into the arrays of the problems."""
        if arm is self.arm:
            return
        model = self.model
        for array, values in (
            (model.joint_X_p, arm.parents),
            (model.joint_X_c, arm.children),
            (model.joint_axis, arm.axes),
            (model.joint_limit_lower, arm.lower),
            (model.joint_limit_upper, arm.upper),
            (self.home, arm.home),
        ):
            array.assign(values.astype(np.float32))
        self.arm = arm

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """Joint positions [n d] for tool poses [n 7] in the arm's base frame, n at most the size."""
        count, joints = seed.shape
        self.positions.assign(_pad(target[:, :3], self.positions.shape[0]))
        self.rotations.assign(_pad(target[:, 3:], self.positions.shape[0]))
        start = np.zeros((self.positions.shape[0], JOINT_COUNT), np.float32)
        start[:count, :joints] = seed
        self.joint_pos.assign(start)
        self._run()
        wait_for(self.device)
        return self.joint_pos.numpy()[:count, :joints].astype(float)

    def _run(self) -> None:
        """Run all steps; the first run loads the kernels, the second records a graph, later ones replay it."""
        if not self.has_run:
            self._step()
            self.has_run = True
            return
        if self.graph is None:
            with PARSING, wp.ScopedCapture(self.device) as capture:  # on a CPU it records the launches of all threads
                self._step()
            self.graph = capture.graph
        wp.capture_launch(self.graph)

    def _step(self) -> None:
        for weight, iterations in ((self.posture_weight, self.iterations - POLISH_STEPS), (0.0, POLISH_STEPS)):
            self.posture.weight = weight
            self.solver.step(self.joint_pos, self.joint_pos, iterations=iterations)


def _chain(device: str) -> "newton.Model":
    """A chain of seven joints at the origin."""
    builder = newton.ModelBuilder()
    handles = [
        builder.add_joint_revolute(
            parent=index - 1,
            child=builder.add_link(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel())),
            axis=wp.vec3(0.0, 0.0, 1.0),
            limit_lower=0.0,
            limit_upper=0.0,
        )
        for index in range(JOINT_COUNT)
    ]
    builder.add_articulation(handles)
    return builder.finalize(device=device)


def _pad(rows: np.ndarray, size: int) -> np.ndarray:
    """Rows [n ...] float32, the last one repeated up to `size` rows."""
    return np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), 0)]).astype(np.float32)
