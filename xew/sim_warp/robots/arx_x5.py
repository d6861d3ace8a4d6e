"""ARX-X5: two black-and-white table-top arms of six joints.

Expert limits: real-stanford/arx5-sdk, configuration X5.
"""

from dataclasses import replace
from pathlib import Path

from xew.sim_warp.embodiment.spec import Arm, RobotSpec

LEFT = Arm(
    root_pose=(-0.22, -0.38, 0.84, 0, 0, 0.7071067812, 0.7071067812),
    joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
    home=(-0.7354, 0.559, 0.3734, -0.9806, -0.3421, -0.6646),
    rest=(-0.648, 0.447, 0.299, -0.784, -0.274, -0.532),
    tool_link="link6",
    tool_pose=(0.142, 0, 0, 0, 0, 0, 1),
    fingers=("joint7", "joint8"),
    finger_closed=(0.0, 0.0),
    finger_open=(0.044, 0.044),
)
RIGHT = replace(
    LEFT,
    root_pose=(0.22, -0.38, 0.84, 0, 0, 0.7071067812, 0.7071067812),
    home=(0.7489, 0.5609, 0.374, -0.9839, 0.3474, 0.6778),
    rest=(0.659, 0.449, 0.299, -0.787, 0.278, 0.542),
)

SPEC = RobotSpec(
    key="arx_x5",
    title="ARX-X5",
    label="ARX",
    urdf=Path(__file__).parent / "descriptions" / "arx_x5.urdf",
    arms=(LEFT, RIGHT),
    joint_lower=(-3.14, -0.05, -0.1, -1.6, -1.57, -2.0),
    joint_upper=(2.618, 3.5, 3.2, 1.55, 1.57, 2.0),
    joint_velocity=(5.0, 5.0, 5.5, 5.5, 5.0, 5.0),
)
