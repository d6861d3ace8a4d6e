"""Universal Robots UR5 with a Weiss WSG-50 gripper, one at either side.

Expert limits: the URDF's, inside the limits of the UR5 manual (ur_description). The gripper opens 90 of 105 mm, for clearance
from neighboring objects.
"""

from dataclasses import replace
from pathlib import Path

from xew.sim_warp.embodiment.spec import Arm, RobotSpec

LEFT = Arm(
    root_pose=(-0.35, -0.65, 0.75, 0, 0, 0, 1),
    joints=("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
    home=(-1.7942, -1.4173, -2.3647, -0.4176, 1.6818, -0.1943),
    rest=(-1.722, -1.454, -2.054, -1.205, 1.571, -0.152),
    tool_link="ee_link",
    tool_pose=(0.1385, 0, 0, 0, 0, 0, 1),
    fingers=("base_joint_gripper_left", "base_joint_gripper_right"),
    finger_closed=(-0.0027, 0.0027),
    finger_open=(-0.0477, 0.0477),
)
RIGHT = replace(
    LEFT,
    root_pose=(0.35, -0.65, 0.75, 0, 0, 0, 1),
    home=(-0.7122, -1.3756, -2.3561, -0.6199, 1.1827, 0.787),
    rest=(-0.9, -1.454, -2.054, -1.205, 1.571, 0.671),
)

SPEC = RobotSpec(
    key="ur5_wsg",
    title="UR5",
    label="UR5",
    urdf=Path(__file__).parent / "descriptions" / "ur5_wsg.urdf",
    arms=(LEFT, RIGHT),
    joint_lower=(-3.1415, -3.1415, -3.1415, -1.75, -3.1415, -3.1415),
    joint_upper=(3.1415, 0.0, 3.1415, 1.75, 3.1415, 3.1415),
    joint_velocity=(3.1415, 3.1415, 3.1415, 3.1415, 3.1415, 3.1415),
)
