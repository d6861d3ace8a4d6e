"""The robots room: five bimanual robots, each a URDF with our own geometry and one `RobotSpec`.

To add one, write a file with `SPEC = RobotSpec(...)` here and add its line to `ROBOTS`; outside the repository write it
anywhere importable and name it `module:SPEC` wherever a robot is asked for.
"""

import difflib
import importlib

from xew.sim_warp.robots import aloha_agilex, arx_x5, franka_panda, piper, ur5_wsg
from xew.sim_warp.robots.spec import Arm, RobotSpec
from xew.sim_warp.robots.urdf import Urdf, UrdfError, load_urdf

__all__ = ["ROBOTS", "Arm", "RobotSpec", "UnknownRobotError", "Urdf", "UrdfError", "get_robot", "load_urdf"]

ROBOTS: dict[str, RobotSpec] = {
    "aloha_agilex": aloha_agilex.SPEC,
    "arx_x5": arx_x5.SPEC,
    "ur5_wsg": ur5_wsg.SPEC,
    "franka_panda": franka_panda.SPEC,
    "piper": piper.SPEC,
}


class UnknownRobotError(Exception):
    """A robot was asked for by a name that means none; the message lists those that exist."""


def get_robot(name: str) -> RobotSpec:
    """The robot of a registry key, or of an import path `module:NAME`.

    Raises:
        UnknownRobotError: there is no such robot; says which there are, or what the import path lacks.
    """
    if name in ROBOTS:
        return ROBOTS[name]
    if ":" in name:
        return _imported(name)
    close = difflib.get_close_matches(name, ROBOTS, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    raise UnknownRobotError(
        f"there is no robot {name!r}; {hint}known are {', '.join(ROBOTS)}, or give an import path module:NAME."
    )


def _imported(name: str) -> RobotSpec:
    module, _, attribute = name.partition(":")
    try:
        spec = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise UnknownRobotError(f"robot {name!r} cannot be imported ({error}); expected module:NAME of a RobotSpec.") from error
    if not isinstance(spec, RobotSpec):
        raise UnknownRobotError(f"robot {name!r} is a {type(spec).__name__}; expected a RobotSpec.")
    return spec
