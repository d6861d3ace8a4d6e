"""Registry of robots: five bimanual robots, each a URDF with a `RobotSpec`, and procedural bodies by number.

`body:17` names a procedural body, `body:0-63` a range (docs/bodies.md); keys are `body_17`. To add a robot, write a file with
`SPEC = RobotSpec(...)` here and add a line to `ROBOTS`. Outside the repository, use `module:SPEC`, or the path of a URDF or
RoboTwin embodiment (docs/add_a_robot.md).
"""

from pathlib import Path

from xew.config import ConfigError, demand_admitted, pick
from xew.names import EpisodeError, check_name
from xew.sim_warp.embodiment.spec import Arm, RobotSpec
from xew.sim_warp.embodiment.urdf import Urdf, load_urdf
from xew.sim_warp.embodiment.xml_files import UrdfError
from xew.sim_warp.robots import aloha_agilex, arx_x5, franka_panda, piper, ur5_wsg
from xew.sim_warp.robots.procedural.bodies import body_number, load_body
from xew.sim_warp.robots.user.own import FOLDERS, adopt_robots, is_path, keep_robot, kept_robot, load_robot

__all__ = [
    "ROBOTS",
    "Arm",
    "RobotSpec",
    "Urdf",
    "UrdfError",
    "adopt_robots",
    "get_robot",
    "is_path",
    "keep_robot",
    "load_robot",
    "load_urdf",
    "recorded_robot",
]

ROBOTS: dict[str, RobotSpec] = {
    "aloha_agilex": aloha_agilex.SPEC,
    "arx_x5": arx_x5.SPEC,
    "ur5_wsg": ur5_wsg.SPEC,
    "franka_panda": franka_panda.SPEC,
    "piper": piper.SPEC,
}


def get_robot(name: str | RobotSpec, data: Path | None = None) -> RobotSpec:
    """The robot of a registry key, `module:NAME` or path, of a data set, or a body by its number.

    Args:
        name: name of the robot, or the robot itself.
        data: data set whose robots are searched, before the folders of `XEW_ROBOTS`.

    Raises:
        ConfigError: there is no such robot, or it cannot be used.
    """
    if isinstance(name, RobotSpec):
        return name
    if (number := body_number(name)) is not None:
        return load_body(number)
    if name not in ROBOTS and is_path(name):
        return load_robot(name)
    try:
        return pick(ROBOTS, name, "robot")
    except ConfigError as error:
        if ":" not in name and (robot := kept_robot(name, data)):
            return robot
        if ":" in name:
            raise
        hint = f"A path needs a /. For robots of a data set, list <data>/robots in {FOLDERS}."
        raise ConfigError(f"{error} {hint}") from None


def recorded_robot(name: str, data: Path | None = None) -> RobotSpec:
    """The robot that an episode or another file names: never a path, and `module:NAME` only of an admitted module.

    Raises:
        UntrustedError: its module is not admitted.
        ConfigError: there is no such robot, or it cannot be used.
    """
    try:
        check_name(name, "robot")
    except EpisodeError as error:
        raise ConfigError(str(error)) from error
    demand_admitted(name, "the robot")
    if name not in ROBOTS and is_path(name):  # as arm.urdf, a file of the current folder
        raise ConfigError(f"the robot is {name!r}, a path; rename its folder and correct the files that name it.")
    return get_robot(name, data)
