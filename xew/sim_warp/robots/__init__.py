"""The robots room: five bimanual robots, each a URDF with our own geometry and one `RobotSpec`.

To add one, write a file with `SPEC = RobotSpec(...)` here and add its line to `ROBOTS`; outside the repository write it
anywhere importable and name it `module:SPEC` wherever a robot is asked for.
"""

from xew.config import pick
from xew.sim_warp.robots import aloha_agilex, arx_x5, franka_panda, piper, ur5_wsg
from xew.sim_warp.robots.spec import Arm, RobotSpec
from xew.sim_warp.robots.urdf import Urdf, UrdfError, load_urdf

__all__ = ["ROBOTS", "Arm", "RobotSpec", "Urdf", "UrdfError", "get_robot", "load_urdf"]

ROBOTS: dict[str, RobotSpec] = {
    "aloha_agilex": aloha_agilex.SPEC,
    "arx_x5": arx_x5.SPEC,
    "ur5_wsg": ur5_wsg.SPEC,
    "franka_panda": franka_panda.SPEC,
    "piper": piper.SPEC,
}


def get_robot(name: str) -> RobotSpec:
    """The robot of a registry key, or of an import path `module:NAME`. Raises ConfigError if there is none."""
    return pick(ROBOTS, name, "robot")
