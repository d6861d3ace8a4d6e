"""Descriptions of users' robots as `RobotDraft`s, most of which may be left open.

Reads  a URDF, a folder with a robot.yaml, or a RoboTwin embodiment folder (config.yml)
Writes RobotDraft; `xew.sim_warp.robots.user.own` fills in what is open

A robot.yaml holds the fields of RobotDraft and nothing else; lengths in meters, angles in radians, quaternions x y z w.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from xew.config import ConfigError, parse, read_yaml
from xew.sim_warp.geometry.poses import Pose

OWN, ROBOTWIN = "robot.yaml", "config.yml"
"""Names of the file that describes a robot in our own way, and in RoboTwin's."""
Near = tuple[np.ndarray | None, np.ndarray | None]
"""Postures [d] rad near which homes of the left and right arm are sought; None is near the joints' zero."""


@dataclass(frozen=True)
class ArmDraft:
    """One arm, see `xew.sim_warp.robots.Arm`; `xew.sim_warp.robots.user.infer` or `placement` fill in what is None."""

    root_pose: Pose | None = None
    joints: tuple[str, ...] | None = None
    home: tuple[float, ...] | None = None
    near: tuple[float, ...] | None = None
    """Posture to search the home from, if home is left open [rad]."""
    rest: tuple[float, ...] | None = None
    """Posture in which motion of its own begins [rad]; open: home."""
    tool_link: str | None = None
    tool_pose: Pose | None = None
    tool_at_tips: bool = False
    """True takes only the orientation of `tool_pose`; the origin is the place at the fingers where all our robots have it."""
    fingers: tuple[str, str] | None = None
    finger_closed: tuple[float, float] | None = None
    finger_open: tuple[float, float] | None = None


@dataclass(frozen=True)
class RobotDraft:
    """A bimanual robot, or one arm that is put up twice."""

    urdf: str
    """Path of the URDF, relative to the file that says so."""
    title: str | None = None
    arms: tuple[ArmDraft, ArmDraft] = (ArmDraft(), ArmDraft())
    """Left and right arm. What only the left says holds for the right too, but for `root_pose`, `home` and `rest`."""
    joint_lower: tuple[float, ...] | None = None
    """Limits that experts keep [rad]; open: the URDF's."""
    joint_upper: tuple[float, ...] | None = None
    joint_velocity: tuple[float, ...] | None = None
    """Speed limits that experts keep [rad/s]; open: the URDF's."""
    joint_acceleration: tuple[float, ...] | None = None
    """Acceleration limits that motion of its own keeps [rad/s²]; open: 15 of each joint."""
    distance: float | None = None
    """Distance between the bases of two equal arms [m], half to either side of `root_pose`; open: the first of
    `placement.DISTANCES` at which both arms reach home."""
    source: str | None = None
    """SHA-256 of the description that a robot in a data set comes from; leave it out."""


def find_description(path: Path) -> Path:
    """The file that describes the robot at `path`: itself, or of a folder robot.yaml, config.yml or its only URDF.

    Raises:
        ConfigError: there is none, or more than one.
    """
    if path.is_file():
        return path
    if not path.is_dir():
        raise ConfigError(f"there is no robot at {path}; expected a URDF or a folder with one.")
    for name in (OWN, ROBOTWIN):
        if (path / name).is_file():
            return path / name
    urdfs = sorted(path.glob("*.urdf"))
    if len(urdfs) == 1:
        return urdfs[0]
    content = f"{len(urdfs)} URDFs" if urdfs else "no URDF"
    raise ConfigError(f"{path} holds {content}, no {OWN} and no {ROBOTWIN}; name one URDF, or write a {OWN} that does.")


def read_draft(description: Path) -> RobotDraft:
    """What a URDF, a robot.yaml or a RoboTwin config.yml says. Raises ConfigError if it cannot be understood."""
    if description.suffix == ".urdf":
        return RobotDraft(description.name)
    if description.suffix == ".xacro":
        raise ConfigError(f"{description} is a xacro; python -m xew.sim_warp.robots.adopt {description.name} expands it.")
    if description.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{description} is no robot; expected a .urdf, a {OWN}, or a folder with a {OWN} or {ROBOTWIN}.")
    content = read_yaml(description)
    if isinstance(content, dict) and "urdf_path" in content:
        return robotwin_draft(content, str(description))
    return parse(RobotDraft, content, str(description))


# --- RoboTwin's config.yml.


def robotwin_draft(config: dict[str, Any], source: str) -> RobotDraft:
    """A RoboTwin 2.0 embodiment (its config.yml) as a draft.

    Taken: URDF, arm joints, gripper joints with their scale, the tool frame's link and orientation (ee joint, `delta_matrix`),
    base poses, and `homestate` as the posture near which our home is looked for. `gripper_bias` is where RoboTwin's planner
    has its tool center point, 5 to 29 mm behind ours: our plans count on fingertips that are 15 mm beyond it.
    `global_trans_matrix` undoes the orientation that SAPIEN gives joint frames and has no part in ours; drive gains, planner,
    cameras, `rotate_lim` and `grasp_perfect_direction` belong to RoboTwin's experts.

    Raises:
        ConfigError: a key is missing or not as it should be.
    """
    reader = _Reader(config, source)
    rotation = reader.rotation("delta_matrix")
    bias = float(reader.numbers("gripper_bias", ())[()])
    tool = (*(bias * rotation[:, 0]).tolist(), *Rotation.from_matrix(rotation).as_quat(canonical=True).tolist())
    if "global_trans_matrix" in config:
        reader.rotation("global_trans_matrix")
    is_dual = reader.value("dual_arm", bool)
    arms = tuple(_robotwin_arm(reader, side, tool) for side in (0, 1))
    return RobotDraft(reader.value("urdf_path", str), arms=(arms[0], arms[1]), distance=0.0 if is_dual else None)


def _robotwin_arm(reader: "_Reader", side: int, tool: Pose) -> ArmDraft:
    joints = reader.per_side("arm_joints_name", side)
    home = reader.per_side("homestate", side)
    pose = np.asarray(reader.per_side("robot_pose", side), float)
    gripper = reader.per_side("gripper_name", side)
    if pose.shape != (7,):
        raise reader.error("robot_pose", "lists of x y z and a quaternion w x y z")
    try:
        (mimic,) = gripper["mimic"]
        fingers = (str(gripper["base"]), str(mimic[0]))
        factor, offset = float(mimic[1]), float(mimic[2])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise reader.error("gripper_name", "a base joint and one mimic of [joint, factor, offset] an arm") from error
    closed, opened = reader.numbers("gripper_scale", (2,))
    return ArmDraft(
        root_pose=(*pose[:3].tolist(), *_unit_quaternion(pose[[4, 5, 6, 3]], reader)),
        joints=tuple(map(str, joints)),
        near=tuple(map(float, home)),
        tool_link=str(reader.per_side("ee_joints", side)),
        tool_pose=tool,
        tool_at_tips=True,
        fingers=fingers,
        finger_closed=(float(closed), float(closed * factor + offset)),
        finger_open=(float(opened), float(opened * factor + offset)),
    )


def _unit_quaternion(quaternion: np.ndarray, reader: "_Reader") -> tuple[float, float, float, float]:
    """The quaternion [4] at unit length, for RoboTwin writes .707 for the root of a half."""
    length = float(np.linalg.norm(quaternion))
    if not 0.9 < length < 1.1:
        raise reader.error("robot_pose", "unit quaternions w x y z")
    x, y, z, w = (quaternion / length).tolist()
    return x, y, z, w


@dataclass(frozen=True)
class _Reader:
    """Takes values out of a config and says what is wrong with it."""

    config: dict[str, Any]
    source: str

    def value(self, key: str, kind: type) -> Any:
        """The value of a key, which must be there and of a type."""
        if key not in self.config:
            raise ConfigError(f"{self.source}: missing key {key!r}; a RoboTwin embodiment has it.")
        if not isinstance(self.config[key], kind):
            raise self.error(key, f"a {kind.__name__}")
        return self.config[key]

    def per_side(self, key: str, side: int) -> Any:
        """The left (first) or right (last) entry of a list; with one entry both are the same."""
        entries = self.value(key, list)
        if not entries:
            raise self.error(key, "one entry an arm")
        return entries[-1 if side else 0]

    def numbers(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """Finite numbers [...] float64 of a shape."""
        try:
            array = np.asarray(self.value(key, object), float)
        except (TypeError, ValueError) as error:
            raise self.error(key, "numbers") from error
        if array.shape != shape or not np.isfinite(array).all():
            raise self.error(key, f"finite numbers of shape {shape}" if shape else "a finite number")
        return array

    def rotation(self, key: str) -> np.ndarray:
        """A rotation matrix [3 3]."""
        matrix = self.numbers(key, (3, 3))
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
            raise self.error(key, "a rotation matrix")
        return matrix

    def error(self, key: str, expected: str) -> ConfigError:
        return ConfigError(f"{self.source}: {key} is {self.config[key]!r}; expected {expected}.")
