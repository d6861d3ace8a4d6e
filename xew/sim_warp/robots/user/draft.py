"""Descriptions of users' robots as `RobotDraft`s, from a URDF, a robot.yaml or a RoboTwin embodiment (config.yml).

A robot.yaml has the fields of RobotDraft, in meters, radians and quaternions x y z w. `own` completes missing fields.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from xew.config import ConfigError, parse, read_yaml
from xew.sim_warp.geometry.poses import Pose

OWN, ROBOTWIN = "robot.yaml", "config.yml"
"""Names of xew's and RoboTwin's file that describes a robot."""
Near = tuple[np.ndarray | None, np.ndarray | None]
"""Postures [d] rad near which homes of the left and right arm are searched; None for zero."""


@dataclass(frozen=True)
class ArmDraft:
    """One arm, see `xew.sim_warp.robots.Arm`; `infer` or `placement` find missing fields."""

    root_pose: Pose | None = None
    joints: tuple[str, ...] | None = None
    home: tuple[float, ...] | None = None
    near: tuple[float, ...] | None = None
    """Start posture for the search of a missing home [rad]."""
    rest: tuple[float, ...] | None = None
    """Initial posture of own motion [rad]; default: home."""
    tool_link: str | None = None
    tool_pose: Pose | None = None
    tool_at_tips: bool = False
    """Whether to use only the orientation of `tool_pose`, with the origin at the fingers as for xew's robots."""
    fingers: tuple[str, str] | None = None
    finger_closed: tuple[float, float] | None = None
    finger_open: tuple[float, float] | None = None


@dataclass(frozen=True)
class RobotDraft:
    """A bimanual robot, or two copies of one arm."""

    urdf: str
    """Path of the URDF, relative to the description."""
    title: str | None = None
    arms: tuple[ArmDraft, ArmDraft] = (ArmDraft(), ArmDraft())
    """Left and right arm; a missing right arm is like the left, except for `home` and `rest`."""
    joint_lower: tuple[float, ...] | None = None
    """Expert limits [rad]; default: the URDF's."""
    joint_upper: tuple[float, ...] | None = None
    joint_velocity: tuple[float, ...] | None = None
    """Speed limits of experts [rad/s]; default: the URDF's."""
    joint_acceleration: tuple[float, ...] | None = None
    """Acceleration limits of own motion [rad/s²]; default: 15 for each joint."""
    distance: float | None = None
    """Distance between the bases of two equal arms [m], half to either side of `root_pose`; default: the first of
    `placement.DISTANCES` at which both arms reach home."""
    source: str | None = None
    """SHA-256 of the original description of a robot in a data set; do not set it."""


def find_description(path: Path) -> Path:
    """The file that describes the robot at `path`: the file, or a folder's robot.yaml, config.yml or only URDF.

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
    urdfs = sorted(file for file in path.iterdir() if file.suffix.lower() == ".urdf" and not file.name.startswith("."))
    if len(urdfs) == 1:
        return urdfs[0]
    content = f"{len(urdfs)} URDFs" if urdfs else "no URDF"
    raise ConfigError(f"{path} holds {content}, no {OWN} and no {ROBOTWIN}; name one URDF, or write a {OWN} that does.")


def read_draft(description: Path) -> RobotDraft:
    """Read a URDF, a robot.yaml or a RoboTwin config.yml. Raises ConfigError if it is invalid."""
    kind = description.suffix.lower()
    if kind == ".urdf":
        return RobotDraft(description.name)
    if kind == ".xacro":
        raise ConfigError(f"{description} is a xacro; python -m xew.sim_warp.robots.adopt {description.name} expands it.")
    if kind not in (".yaml", ".yml"):
        raise ConfigError(f"{description} is no robot; expected a .urdf, a {OWN}, or a folder with a {OWN} or {ROBOTWIN}.")
    content = read_yaml(description)
    if isinstance(content, dict) and "urdf_path" in content:
        return robotwin_draft(content, str(description))
    return parse(RobotDraft, content, str(description))


# --- RoboTwin's config.yml.


def robotwin_draft(config: dict[str, Any], source: str) -> RobotDraft:
    """A RoboTwin 2.0 embodiment (its config.yml) as a draft.

    Used: URDF, arm joints, gripper joints with their scale, the tool frame's link and orientation (ee joint, `delta_matrix`),
    base poses, and `homestate` as the start of the search for a home. RoboTwin's tool center point (`gripper_bias`) is 5 to
    29 mm behind xew's, which is 15 mm behind the fingertips. `global_trans_matrix` is for SAPIEN's joint frames; other keys are
    for RoboTwin's experts.

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
    """The quaternion [4] at unit length; RoboTwin rounds to three digits."""
    length = float(np.linalg.norm(quaternion))
    if not 0.9 < length < 1.1:
        raise reader.error("robot_pose", "unit quaternions w x y z")
    x, y, z, w = (quaternion / length).tolist()
    return x, y, z, w


@dataclass(frozen=True)
class _Reader:
    """Checked access to the values of a config."""

    config: dict[str, Any]
    source: str

    def value(self, key: str, kind: type) -> Any:
        """The value of a required key and type."""
        if key not in self.config:
            raise ConfigError(f"{self.source}: missing key {key!r}; expected the keys of a RoboTwin embodiment.")
        if not isinstance(self.config[key], kind):
            raise self.error(key, f"a {kind.__name__}")
        return self.config[key]

    def per_side(self, key: str, side: int) -> Any:
        """The left (first) or right (last) entry of a list of one or two."""
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
