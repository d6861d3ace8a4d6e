"""AgileX Piper: two dark, light-weight table-top arms of six joints.

Expert limits: agilexrobotics/piper_sdk, and for joint 3 the URDF.
The bases lean back by 10 degrees because of the short wrist range.
"""

from dataclasses import replace
from pathlib import Path

from xew.sim_warp.embodiment.spec import Arm, RobotSpec

LEFT = Arm(
    root_pose=(-0.18, -0.37, 0.75, 0.06162841672, -0.06162841672, 0.7044160264, 0.7044160264),
    joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
    home=(-0.1479, 0.8278, -0.4817, 0.0612, 0.9673, -0.1739),
    rest=(-0.201, 0.538, -0.313, 0.04, 0.629, -0.113),
    tool_link="link6",
    tool_pose=(0, 0, 0.125, 0, -0.7071067812, 0, 0.7071067812),
    fingers=("joint7", "joint8"),
    finger_closed=(0.0, 0.0),
    finger_open=(0.04, 0.04),
)
RIGHT = replace(
    LEFT,
    root_pose=(0.18, -0.37, 0.75, 0.06162841672, -0.06162841672, 0.7044160264, 0.7044160264),
    home=(0.1113, 0.8279, -0.4823, -0.0462, 0.9659, 0.1309),
    rest=(0.177, 0.538, -0.313, -0.03, 0.628, 0.085),
)

SPEC = RobotSpec(
    key="piper",
    title="Piper",
    urdf=Path(__file__).parent / "descriptions" / "piper.urdf",
    arms=(LEFT, RIGHT),
    joint_lower=(-2.6179, 0.0, -2.697, -1.745, -1.22, -2.09439),
    joint_upper=(2.6179, 3.14, 0.0, 1.745, 1.22, 2.09439),
    joint_velocity=(3.0, 3.0, 3.0, 3.0, 3.0, 3.0),
)
