"""ALOHA-AgileX (Cobot Magic): one mobile base, two working arms in front, two teaching arms behind.

Expert limits: real-stanford/arx5-sdk, configuration X5, the family of the front arms.
"""

from dataclasses import replace
from pathlib import Path

from xew.sim_warp.embodiment.spec import Arm, RobotSpec

LEFT = Arm(
    root_pose=(0, -0.62, 0, 0, 0, 0.7071067812, 0.7071067812),
    joints=("fl_joint1", "fl_joint2", "fl_joint3", "fl_joint4", "fl_joint5", "fl_joint6"),
    home=(-1.1287, 0.9535, 0.7022, -1.0705, -0.463, -1.0553),
    rest=(-0.864, 0.477, 0.351, -0.535, -0.232, -0.528),
    tool_link="fl_link6",
    tool_pose=(0.1406, 0, 0, 0, 0, 0, 1),
    fingers=("fl_joint7", "fl_joint8"),
    finger_closed=(0.0, 0.0),
    finger_open=(0.045, 0.045),
)
RIGHT = replace(
    LEFT,
    home=(1.1263, 0.9928, 0.7229, -1.0598, 0.4716, 1.0729),
    rest=(0.863, 0.496, 0.361, -0.53, 0.236, 0.536),
    joints=("fr_joint1", "fr_joint2", "fr_joint3", "fr_joint4", "fr_joint5", "fr_joint6"),
    tool_link="fr_link6",
    fingers=("fr_joint7", "fr_joint8"),
)

SPEC = RobotSpec(
    key="aloha_agilex",
    title="ALOHA-AgileX",
    label="ALOHA",
    urdf=Path(__file__).parent / "descriptions" / "aloha_agilex.urdf",
    arms=(LEFT, RIGHT),
    joint_lower=(-3.14, -0.05, -0.1, -1.6, -1.57, -2.0),
    joint_upper=(2.618, 3.5, 3.2, 1.55, 1.57, 2.0),
    joint_velocity=(5.0, 5.0, 5.5, 5.5, 5.0, 5.0),
    joint_acceleration=(3.0, 3.0, 3.0, 3.0, 3.0, 3.0),
)
