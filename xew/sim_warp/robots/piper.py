"""AgileX PiPER: two dark, light-weight table-top arms of six joints.

Limits that experts keep: agilexrobotics/piper_sdk, and for joint 3 the URDF.
"""

from pathlib import Path

from xew.sim_warp.robots.spec import Arm, RobotSpec

SPEC = RobotSpec(
    key="piper",
    title="AgileX PiPER",
    urdf=Path(__file__).parent / "descriptions" / "piper.urdf",
    arms=(
        Arm(
            root_pose=(-0.3, -0.45, 0.75, 0, 0, 0.7071067812, 0.7071067812),
            joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
            home=(0, 1.2, -1.2, 0, 0.6, 0),
            tool_link="link6",
            tool_pose=(0, 0, 0.125, -0.0, -0.7071067812, -0.0, 0.7071067812),
            fingers=("joint7", "joint8"),
            finger_closed=(0.0, 0.0),
            finger_open=(0.04, 0.04),
        ),
        Arm(
            root_pose=(0.3, -0.45, 0.75, 0, 0, 0.7071067812, 0.7071067812),
            joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
            home=(0, 1.2, -1.2, 0, 0.6, 0),
            tool_link="link6",
            tool_pose=(0, 0, 0.125, -0.0, -0.7071067812, -0.0, 0.7071067812),
            fingers=("joint7", "joint8"),
            finger_closed=(0.0, 0.0),
            finger_open=(0.04, 0.04),
        ),
    ),
    joint_lower=(-2.6179, 0.0, -2.697, -1.745, -1.22, -2.09439),
    joint_upper=(2.6179, 3.14, 0.0, 1.745, 1.22, 2.09439),
    joint_velocity=(3.0, 3.0, 3.0, 3.0, 3.0, 3.0),
)
