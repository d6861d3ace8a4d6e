"""Franka Emika Panda with the Franka hand, one at either side.

Expert limits: frankaemika/franka_description robots/fer/joint_limits.yaml.
"""

from dataclasses import replace
from pathlib import Path

from xew.sim_warp.embodiment.spec import Arm, RobotSpec

LEFT = Arm(
    root_pose=(-0.28, -0.68, 0.53, 0, 0, 0.7071067812, 0.7071067812),
    joints=("panda_joint1", "panda_joint2", "panda_joint3", "panda_joint4", "panda_joint5", "panda_joint6", "panda_joint7"),
    home=(-0.0136, -0.518, -0.2595, -2.714, 0.0195, 2.7176, 0.4963),
    rest=(-0.094, -0.491, -0.172, -2.547, -0.047, 2.231, 0.559),
    tool_link="panda_hand",
    tool_pose=(0, 0, 0.0979, 0.7071067812, 0, 0.7071067812, 0),
    fingers=("panda_finger_joint1", "panda_finger_joint2"),
    finger_closed=(0.0, 0.0),
    finger_open=(0.04, 0.04),
)
RIGHT = replace(
    LEFT,
    root_pose=(0.28, -0.68, 0.53, 0, 0, 0.7071067812, 0.7071067812),
    home=(0.0135, -0.518, 0.2597, -2.7141, -0.0193, 2.7176, 1.0744),
    rest=(0.094, -0.491, 0.172, -2.547, 0.047, 2.231, 1.012),
)

SPEC = RobotSpec(
    key="franka_panda",
    title="Franka (Panda)",
    label="Franka",
    urdf=Path(__file__).parent / "descriptions" / "franka_panda.urdf",
    arms=(LEFT, RIGHT),
    joint_lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    joint_upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    joint_velocity=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
)
