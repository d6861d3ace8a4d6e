"""Bodies by their number: `body:17` is a candidate of the catalog with its base poses and homes.

catalog.json lists the candidates that follow the trial plans and succeed in physics. All other properties are functions of the
number. URDFs and meshes are written once to the user's cache folder, under a digest of the code.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import scipy
import trimesh

from xew.config import ConfigError, parse
from xew.episode import complete_folder
from xew.files import read_json
from xew.protocol import BODY_NAME, body_key
from xew.sim_warp.embodiment import mesh_claims, mesh_files, named_files, prepared, urdf, xml_files
from xew.sim_warp.embodiment.spec import Arm, RobotSpec
from xew.sim_warp.embodiment.urdf import prepare
from xew.sim_warp.geometry import meshes
from xew.sim_warp.geometry.poses import Pose
from xew.sim_warp.robots.procedural import colors, design, shapes, solids, urdf_files
from xew.sim_warp.robots.procedural.design import SPEED, BodyDesign, design_body
from xew.sim_warp.robots.procedural.shapes import tool_offset
from xew.sim_warp.robots.procedural.urdf_files import URDF, body_files

CATALOG = Path(__file__).parent / "catalog.json"
AT_ORIGIN: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Entry:
    """Catalog entry of a body; left arm first."""

    candidate: int
    """Number of the design."""
    root_pose: tuple[Pose, Pose]
    home: tuple[tuple[float, ...], tuple[float, ...]]
    """Joint positions at rest [rad]."""


@dataclass(frozen=True)
class Catalog:
    """The usable bodies, by number."""

    bodies: tuple[Entry, ...]


def body_number(name: str) -> int | None:
    """The number of a body by its name, body:17 or body_17; None for other names."""
    match = BODY_NAME.fullmatch(name)
    return int(match[1]) if match else None


@cache
def load_body(number: int) -> RobotSpec:
    """A procedural body of the catalog, from 0.

    Raises:
        ConfigError: there is no body of that number, or the user's cache folder cannot be written.
    """
    entries = read_catalog()
    if number >= len(entries):
        raise ConfigError(f"there is no body:{number}; expected body:0 to body:{len(entries) - 1}.")
    return placed_body(entries[number], body_key(number), f"Body {number}")


@cache
def read_catalog(path: Path = CATALOG) -> tuple[Entry, ...]:
    """The entries of a catalog, by number. Raises ConfigError if it is invalid."""
    return parse(Catalog, read_json(path), str(path)).bodies


def placed_body(entry: Entry, key: str, title: str) -> RobotSpec:
    """The robot of an entry."""
    robot = unplaced_body(design_body(entry.candidate), key, title)
    left, right = (
        replace(arm, root_pose=root, home=home) for arm, root, home in zip(robot.arms, entry.root_pose, entry.home, strict=True)
    )
    return replace(robot, arms=(left, right))


def unplaced_body(body: BodyDesign, key: str, title: str) -> RobotSpec:
    """The robot of a design at the world's origin, with all joints at 0; writes missing files."""
    x, y, z = body.flange
    count, stroke = len(body.joints), body.hand.stroke
    arm = Arm(
        root_pose=AT_ORIGIN,
        joints=tuple(f"joint{index + 1}" for index in range(count)),
        home=(0.0,) * count,
        tool_link=f"link{count}",
        tool_pose=(round(x + tool_offset(body.hand), 6), y, z, 0.0, 0.0, 0.0, 1.0),
        fingers=("left_finger_joint", "right_finger_joint"),
        finger_closed=(0.0, 0.0),
        finger_open=(stroke, stroke),
    )
    return RobotSpec(
        key=key,
        title=title,
        label=title,
        urdf=keep_files(body),
        arms=(arm, arm),
        joint_lower=tuple(joint.lower for joint in body.joints),
        joint_upper=tuple(joint.upper for joint in body.joints),
        joint_velocity=SPEED[:count],
    )


def keep_files(body: BodyDesign) -> Path:
    """The URDF of a design in the user's cache folder, written with its meshes if missing.

    Raises:
        ConfigError: the folder cannot be written.
    """
    folder = prepared.bodies_folder() / content_version() / f"candidate_{body.number}"
    path = folder / URDF
    if path.is_file():
        return path
    try:
        with complete_folder(folder) as temporary:
            for name, content in body_files(body).items():
                (temporary / name).parent.mkdir(exist_ok=True)
                (temporary / name).write_bytes(content)
            prepare(temporary / URDF)
    except OSError as error:
        if path.is_file():  # another process was faster
            return path
        raise ConfigError(f"cannot write {folder}: {error.strerror}. Set XDG_CACHE_HOME to another folder.") from error
    return path


@cache
def content_version() -> str:
    """Digest of the code and the versions of the libraries that make and read a body's files."""
    digest = hashlib.sha256(f"{np.__version__} {scipy.__version__} {trimesh.__version__}".encode())
    readers = (mesh_claims, mesh_files, meshes, named_files, prepared, urdf, xml_files)
    for module in (design, colors, shapes, urdf_files, solids, *readers):
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()[:12]
