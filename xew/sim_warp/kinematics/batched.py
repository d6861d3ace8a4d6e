"""Forward kinematics of many configurations on a device: arrays in, arrays out, nothing copied to the host.

Reads  a URDF, or several robots of the registry, once; then joint positions or canonical commands as device arrays
Writes the poses of all links as a device array

Rows are configurations. Rows of different robots may stand in one batch. Poses are x y z [m] and quaternion x y z w
with w >= 0; the same rows give the same bits in any batch on the same device.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from xew.protocol import ACTION_DIM, ARMS
from xew.sim_warp.embodiment.spec import Arm, RobotSpec
from xew.sim_warp.embodiment.urdf import Joint, Urdf, load_urdf
from xew.sim_warp.geometry.poses import Pose, pose_from_matrix
from xew.sim_warp.kinematics.kernels import FIXED, SLIDING, TURNING, kinematics_kernels

BLOCK = 64
"""Number of threads of a block: with 65,536 configurations every multiprocessor of a large GPU has some."""
AT_ORIGIN: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Source:
    """Where the position of a joint comes from: gain * row[column] + bias."""

    column: int
    gain: float = 1.0
    bias: float = 0.0


@dataclass(frozen=True)
class Node:
    """A link in the order in which a thread walks."""

    copy: int
    """Number of the copy of the URDF: 0, or 1 for the right arm of a robot that uses it twice."""
    link: str
    above: int
    """Number of the parent's node, -1 for the world."""
    origin: Pose
    joint: Joint | None = None
    source: Source | None = None
    """Source of the position; None where the joint does not move."""


class BatchedKinematics:
    """Forward kinematics of one URDF (`of_urdf`) or of robots by canonical rows (`of_robots`) on one device.

    Args:
        forests: the links of each robot, parents before children.
        columns: numbers in a row of joint positions.
        device: Warp's name of a device, None for Warp's default.
        dtype: wp.float32 or wp.float64.
    """

    def __init__(
        self, forests: Sequence[Sequence[Node]], columns: int, device: str | None = None, dtype: type = wp.float32
    ) -> None:
        self.links = tuple(tuple((node.copy, node.link) for node in forest) for forest in forests)
        """For every robot its links as (copy of the URDF, name), in the order of the poses."""
        self._most_links = max(len(links) for links in self.links)
        self.columns = columns
        self.device = wp.get_device(device)
        self.dtype = dtype
        self._kernels = kinematics_kernels(dtype)
        self._forest = _pack(forests, self._kernels, dtype, self.device)
        self._no_robot = wp.empty(0, dtype=int, device=self.device)
        self._arrays: tuple[wp.array | None, wp.array | None, wp.array | None] = (None, None, None)
        self._launch: wp.Launch | None = None

    @classmethod
    def of_urdf(cls, urdf: Urdf, device: str | None = None, dtype: type = wp.float32) -> "BatchedKinematics":
        """Rows are positions of the moving joints [rad or m] in the order of `Urdf.joint_names`; the frame is the root's."""
        sources = {name: Source(column) for column, name in enumerate(urdf.joint_names)}
        return cls([list(_nodes(urdf, sources))], len(urdf.joint_names), device, dtype)

    @classmethod
    def of_robots(cls, robots: Sequence[RobotSpec], device: str | None = None, dtype: type = wp.float32) -> "BatchedKinematics":
        """Rows are canonical (`xew.protocol`): joints [rad], grippers [0 closed, 1 open]; the frame is the world's."""
        return cls([_robot_nodes(robot) for robot in robots], ACTION_DIM, device, dtype)

    def poses(self, rows: wp.array, robot: wp.array | None = None, out: wp.array | None = None) -> wp.array:
        """Poses of all links.

        Args:
            rows: [n j] of this dtype on this device.
            robot: [n] int, which of the robots each row is of; may be left out where there is one.
            out: what an earlier call with as many rows returned, to be written again. A call with the same three arrays
                as the one before, their numbers changed in place, costs the host least.

        Returns:
            [n l 7] of this dtype; the order of the l links is that of `links`. What comes after the last link of a robot with
            fewer links than another is not written. The array is a view: numbers of neighboring rows lie side by side.

        Raises:
            ValueError: an array does not fit.
        """
        if self._launch is not None and self._are_those_before(rows, robot, out):
            self._launch.launch()
            return out
        self._check(rows, robot, out)
        if out is None:
            out = wp.empty((self._most_links, 7, len(rows)), dtype=self.dtype, device=self.device).transpose((2, 0, 1))
        if len(rows) == 0:
            return out
        self._arrays = (rows, robot, out)
        self._launch = wp.launch(
            self._kernels.forward_kinematics,
            len(rows),
            inputs=[self._forest, self._no_robot if robot is None else robot, rows],
            outputs=[out.transpose((1, 2, 0))],
            device=self.device,
            block_dim=BLOCK,
            record_cmd=True,
        )
        self._launch.launch()
        return out

    def _are_those_before(self, rows: wp.array, robot: wp.array | None, out: wp.array | None) -> bool:
        """Are these the arrays of the call before? To repeat its launch costs the host a fraction of a new one."""
        return all(mine is given for mine, given in zip(self._arrays, (rows, robot, out), strict=True))

    def _check(self, rows: wp.array, robot: wp.array | None, out: wp.array | None) -> None:
        if rows.ndim != 2 or rows.shape[1] != self.columns:
            raise ValueError(f"joint positions have shape {rows.shape}, expected (configurations, {self.columns}).")
        if robot is None and len(self.links) > 1:
            raise ValueError(f"there are {len(self.links)} robots; say with `robot` which of them each row is of.")
        if robot is not None and robot.shape != (len(rows),):
            raise ValueError(f"robot has shape {robot.shape}, expected ({len(rows)},): one number for each row.")
        if out is not None and out.shape != (len(rows), self._most_links, 7):
            raise ValueError(
                f"out has shape {out.shape}, expected ({len(rows)}, {self._most_links}, 7): give what a call returned."
            )


def _robot_nodes(robot: RobotSpec) -> list[Node]:
    """All links of a robot in the world, one copy of its URDF after the other."""
    urdf = load_urdf(robot.urdf)
    if robot.one_urdf_holds_both_arms:
        sources = _arm_sources(robot.arms[0], 0) | _arm_sources(robot.arms[1], 1)
        return list(_nodes(urdf, sources, robot.arms[0].root_pose))
    nodes: list[Node] = []
    for copy, arm in enumerate(robot.arms):
        nodes += _nodes(urdf, _arm_sources(arm, copy), arm.root_pose, copy, len(nodes))
    return nodes


def _arm_sources(arm: Arm, side: int) -> dict[str, Source]:
    """Where an arm's joints and fingers stand in a canonical row; joints that are of neither are not moved."""
    columns, gripper = ARMS[side]
    sources = {name: Source(columns.start + index) for index, name in enumerate(arm.joints)}
    ends = zip(arm.fingers, arm.finger_closed, arm.finger_open, strict=True)
    return sources | {name: Source(gripper, opened - closed, closed) for name, closed, opened in ends}


def _nodes(urdf: Urdf, sources: dict[str, Source], root: Pose = AT_ORIGIN, copy: int = 0, first: int = 0) -> Iterator[Node]:
    """The links of a URDF depth first, so that most links follow the one that carries them; numbers count from `first`."""
    below: dict[str, list[Joint]] = {}
    for joint in urdf.joints.values():
        below.setdefault(joint.parent, []).append(joint)
    yield Node(copy, urdf.root, -1, root)
    number = first
    waiting = [(joint, number) for joint in reversed(below.get(urdf.root, []))]
    while waiting:
        joint, above = waiting.pop()
        number += 1
        yield Node(copy, joint.child, above, _pose(joint.origin), joint, sources.get(joint.name))
        waiting += [(child, number) for child in reversed(below.get(joint.child, []))]


def _pose(matrix: np.ndarray) -> Pose:
    x, y, z, qx, qy, qz, qw = (float(value) for value in pose_from_matrix(matrix))
    return (x, y, z, qx, qy, qz, qw)


def _pack(forests: Sequence[Sequence[Node]], kernels: object, dtype: type, device: wp.Device) -> object:
    """Device arrays of the links of all robots, see `kinematics_kernels`."""
    nodes = [node for forest in forests for node in forest]
    counts = np.array([len(forest) for forest in forests])
    still = Source(0, 0.0)
    packed = kernels.Forest()  # type: ignore[attr-defined]

    def to_device(values: Sequence[object] | np.ndarray, kind: type) -> wp.array:
        """Numbers [l ...] as an array of a type of Warp."""
        return wp.array(np.array(values), dtype=kind, device=device)

    packed.links = to_device(np.stack([np.cumsum(counts) - counts, counts], -1), wp.vec2i)
    packed.above = to_device([node.above for node in nodes], int)
    packed.kind = to_device([_kind(node) for node in nodes], int)
    packed.origin = to_device([node.origin for node in nodes], kernels.frame)  # type: ignore[attr-defined]
    axes = [node.joint.axis if node.joint else np.zeros(3) for node in nodes]
    packed.axis = to_device(axes, kernels.vector)  # type: ignore[attr-defined]
    packed.column = to_device([(node.source or still).column for node in nodes], int)
    packed.gain = to_device([(node.source or still).gain for node in nodes], dtype)
    packed.bias = to_device([(node.source or still).bias for node in nodes], dtype)
    return packed


def _kind(node: Node) -> int:
    if node.joint is None or node.source is None or node.joint.kind == "fixed":
        return FIXED
    return SLIDING if node.joint.kind == "prismatic" else TURNING
