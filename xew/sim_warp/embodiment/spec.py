"""`RobotSpec`: base poses, home, tool frame and limits of a robot, in addition to its URDF."""

from dataclasses import dataclass
from pathlib import Path

from xew.sim_warp.geometry.poses import Pose

USUAL_ACCELERATION = 15.0
"""Acceleration limit of joints without a known limit [rad/s²]; RoboTwin's planner uses it for four of its five robots."""


@dataclass(frozen=True)
class Arm:
    """One arm of a bimanual robot: its base, joints, tool frame and fingers."""

    root_pose: Pose
    """Pose of the URDF's root link in the world; equal for both arms if one URDF holds both."""
    joints: tuple[str, ...]
    """Six or seven revolute joints of the URDF, from the base outward."""
    home: tuple[float, ...]
    """Joint positions at rest [rad], as many as `joints`."""
    tool_link: str
    """Name of the link that carries the tool frame."""
    tool_pose: Pose
    """Tool frame in `tool_link`: x approach (out of the hand), y opening direction of the fingers, origin between the finger
    pads (the tool center point, TCP)."""
    fingers: tuple[str, str]
    """Names of the two prismatic joints of the gripper."""
    finger_closed: tuple[float, float]
    """Finger joint positions at gripper 0 [m]."""
    finger_open: tuple[float, float]
    """Finger joint positions at gripper 1 [m]."""
    rest: tuple[float, ...] = ()
    """Joint positions at which own motion begins [rad]; default: `home`."""


@dataclass(frozen=True)
class RobotSpec:
    """A bimanual robot: a URDF, used once with both arms in it or twice with one."""

    key: str
    """Name in commands, folders and score tables."""
    title: str
    """Name in headings of tables and pages."""
    urdf: Path
    arms: tuple[Arm, Arm]
    """Left arm (at -x) and right arm (at +x); the robot stands at -y and faces +y."""
    joint_lower: tuple[float, ...]
    """Lower position limits of an arm that experts keep [rad]: the real robot's, inside the URDF's."""
    joint_upper: tuple[float, ...]
    joint_velocity: tuple[float, ...]
    """Speed limits that experts keep [rad/s]."""
    joint_acceleration: tuple[float, ...] = ()
    """Acceleration limits of own motion [rad/s²]; default: `USUAL_ACCELERATION`."""
    label: str = ""
    """Short name in columns and legends; default: the title."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.title)
        usual = (USUAL_ACCELERATION,) * self.arm_joint_count
        object.__setattr__(self, "joint_acceleration", self.joint_acceleration or usual)

    @property
    def one_urdf_holds_both_arms(self) -> bool:
        """True for one URDF with two arms, False for two copies of a URDF with one arm."""
        return self.arms[0].joints != self.arms[1].joints

    @property
    def arm_joint_count(self) -> int:
        """Number of joints of each arm, six or seven."""
        return len(self.arms[0].joints)
