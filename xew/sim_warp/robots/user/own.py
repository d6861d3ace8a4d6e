"""Users' robots: from a path to a `RobotSpec`, and their copies in data sets.

A copy is <data>/robots/<key>/ with a complete robot.yaml, the URDF and all files that it names. Episodes name their robot by
its key; it is searched in their data set, then in the folders of `XEW_ROBOTS`.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import yaml

from xew.config import ConfigError
from xew.dataset import base_data
from xew.episode import complete_folder
from xew.files import cache_folder, read_json, write_text
from xew.names import EpisodeError, check_name, path_below
from xew.protocol import BODY_NAME, ROBOT_NAMES, expand_robots
from xew.sim_warp.embodiment.named_files import find_file
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import Urdf, load_urdf
from xew.sim_warp.embodiment.xml_files import file_entries, read_xml
from xew.sim_warp.robots.user.draft import OWN, ArmDraft, Near, RobotDraft, find_description, read_draft
from xew.sim_warp.robots.user.infer import check_own_motion, complete_arms, complete_limits, fill_right_arm

FOLDERS = "XEW_ROBOTS"
"""Name of the environment variable that lists folders of robots, separated as in PATH."""
KEPT = "robots"
"""Name of the folder of a data set that holds its robots."""
FILES = "files"
"""Subfolder with copies of all files that the URDF names."""
DESCRIPTIONS = Path(__file__).resolve().parents[1] / "descriptions"
"""Folder of the package's own URDFs and meshes."""
SEARCH_CODE = ("robots/user", "kinematics", "tasks", "assets", "embodiment", "geometry")
"""Packages of sim_warp whose code, with the files at its root, determines a robot's place; changes invalidate cached places."""


def is_path(name: str) -> bool:
    """Whether the name of a robot is a path, not a key or module:NAME."""
    return os.sep in name or name in (".", "..") or name.lower().endswith((".urdf", ".xacro", ".yaml", ".yml"))


def load_robot(path: Path | str) -> RobotSpec:
    """The robot at a path: a .urdf, a robot.yaml, a RoboTwin config.yml, or a folder with one of them.

    Missing entries are inferred from the URDF and by inverse kinematics.

    Raises:
        ConfigError: there is no robot, it cannot be read, or it does not meet the requirements of all robots.
    """
    description = find_description(Path(path)).resolve()
    return _load(description, description.stat().st_mtime_ns)


@lru_cache(maxsize=16)
def _load(description: Path, modified: int) -> RobotSpec:
    draft = read_draft(description)
    return complete_draft(draft, load_urdf(description.parent / draft.urdf), robot_key(description), str(description))


def robot_key(description: Path) -> str:
    """The key of a robot: the name of its URDF file or folder; `_own` distinguishes it from xew's robots and bodies."""
    name = description.stem if description.suffix.lower() == ".urdf" else description.parent.name
    key = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_-")
    if not key:
        raise ConfigError(f"{description}: the name {name!r} is no valid key; expected a folder name with letters or digits.")
    taken = key in ROBOT_NAMES or BODY_NAME.fullmatch(key)
    return f"{key}_own" if taken else key


# --- Completion of drafts.


def complete_draft(draft: RobotDraft, urdf: Urdf, key: str, source: str) -> RobotSpec:
    """A RobotSpec of a draft and its URDF; `source` names the draft in errors."""
    arms = complete_arms(draft, urdf, source)
    counts = [len(arm.joints) for arm in arms]
    if counts[0] != counts[1] or counts[0] not in (6, 7):
        raise ConfigError(
            f"{source}: the arms have {counts[0]} and {counts[1]} joints; expected equal arms of six or seven, for full poses "
            "of the hand."
        )
    lower, upper, speed = complete_limits(draft, urdf, arms, source)
    check_own_motion(draft, arms, lower, upper, source)
    robot = RobotSpec(
        key=key,
        title=draft.title or urdf.name or key,
        urdf=urdf.path,
        arms=arms,
        joint_lower=tuple(lower.tolist()),
        joint_upper=tuple(upper.tolist()),
        joint_velocity=tuple(speed.tolist()),
        joint_acceleration=draft.joint_acceleration or (),
    )
    return _settle(draft, robot, source)


def _settle(draft: RobotDraft, robot: RobotSpec, source: str) -> RobotSpec:
    """The robot with bases and homes; missing ones are searched."""
    left, right = fill_right_arm(draft.arms)
    if left.root_pose is not None and left.home is not None and right.home is not None:
        return robot
    near = (_posture(left, robot, source), _posture(right, robot, source))
    path = cache_folder("places") / f"{_place_digest(draft, robot)}.json"
    if (known := _read_place(path, robot)) is not None:
        return known
    placed = _find_place(draft, robot, near)
    _keep_place(placed, path)
    return placed


def _find_place(draft: RobotDraft, robot: RobotSpec, near: Near) -> RobotSpec:
    """The robot with bases and homes, searched for near postures [d] rad."""
    from xew.sim_warp.robots.user import placement

    left = draft.arms[0]
    turn = list if left.tool_pose else placement.with_turned_tools
    if left.root_pose is None:
        return placement.place(turn(placement.standard_places(robot)), near).robot
    if not robot.one_urdf_holds_both_arms and robot.arms[0].root_pose[0] == robot.arms[1].root_pose[0]:
        gaps = placement.DISTANCES if draft.distance is None else (draft.distance,)
        return placement.place_at(robot, turn(placement.move_apart(robot, gap) for gap in gaps), near).robot
    return placement.place_at(robot, turn([robot]), near).robot


def _place_digest(draft: RobotDraft, robot: RobotSpec) -> str:
    """SHA-256 over all inputs of a place: the draft, the files of the URDF, and the code of the search."""
    digest = hashlib.sha256(repr((draft, replace(robot, urdf=Path()))).encode())
    package = Path(__file__).parents[2]
    code = {*package.glob("*.py"), *(file for folder in SEARCH_CODE for file in (package / folder).rglob("*.py"))}
    for file in [*load_urdf(robot.urdf).files, *sorted(code)]:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _read_place(path: Path, robot: RobotSpec) -> RobotSpec | None:
    """The robot with its cached bases, homes and tool frames, or None."""
    try:
        left, right = (
            replace(arm, root_pose=tuple(place["root_pose"]), home=tuple(place["home"]), tool_pose=tuple(place["tool_pose"]))
            for arm, place in zip(robot.arms, read_json(path), strict=True)
        )
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return replace(robot, arms=(left, right))


def _keep_place(robot: RobotSpec, path: Path) -> None:
    """Cache bases, homes and tool frames, if the cache folder can be written."""
    arms = [{name: getattr(arm, name) for name in ("root_pose", "home", "tool_pose")} for arm in robot.arms]
    with contextlib.suppress(OSError):
        write_text(path, json.dumps(arms), within=path.parent)


def _posture(arm: ArmDraft, robot: RobotSpec, source: str) -> np.ndarray | None:
    """Start posture [d] rad for the search of a home, if given. Raises ConfigError if it does not fit the arm."""
    near = arm.home or arm.near
    if near is not None and len(near) != robot.arm_joint_count:
        raise ConfigError(f"{source}: a home has {len(near)} joints; expected {robot.arm_joint_count}, as many as the arm.")
    return None if near is None else np.array(near)


# --- Copies in data sets.


def adopt_robots(names: Sequence[str], data: Path) -> tuple[str, ...]:
    """Keys of robots; robots at paths are copied to `<data>/robots/<key>`, and `body:0-7` becomes eight keys.

    Raises:
        ConfigError: a robot cannot be used, or the data set holds another of that key.
    """
    return tuple(_adopt(Path(name), data) if is_path(name) else name for name in expand_robots(names))


def kept_robot(key: str, data: Path | None = None) -> RobotSpec | None:
    """The robot of a key in a data set or the one that it is a view of, or else in a folder of `XEW_ROBOTS`, or None."""
    roots = () if data is None else (Path(data), base_data(data))
    if description := next((path for root in roots if (path := root / KEPT / key / OWN).is_file()), None):
        try:
            check_name(key, "robot")
            _demand_own_files(description, description.stat().st_mtime_ns)
        except EpisodeError as error:
            raise ConfigError(str(error)) from error
        return load_robot(description.parent)
    for folder in [Path(folder) for folder in os.environ.get(FOLDERS, "").split(os.pathsep) if folder]:
        if (folder / key / OWN).is_file():
            return load_robot(folder / key)
    return None


@lru_cache(maxsize=256)
def _demand_own_files(description: Path, modified: int) -> None:
    """Raise EpisodeError if a data set's robot refers to files outside its folder."""
    folder = description.parent
    path_below(folder.parent, folder.name)
    urdf = path_below(folder, read_draft(path_below(folder, description.name)).urdf)
    for _, entry in file_entries(read_xml(urdf)):  # before any of them is opened
        if found := find_file(entry.get("filename", ""), urdf.parent):
            _demand_below(folder, found[0])
    for file in load_urdf(urdf).files:  # materials and textures of meshes
        _demand_below(folder, file)


def _demand_below(folder: Path, file: Path) -> None:
    if not file.resolve().is_relative_to(folder.resolve()):
        raise EpisodeError(f"the robot {folder} reads {file}, which is not below its folder; copy the data set again.")


def _adopt(path: Path, data: Path) -> str:
    description = find_description(path).resolve()
    key, digest = robot_key(description), _digest(description)
    copy = data / KEPT / key / OWN
    if copy.is_file():
        if read_draft(copy).source != digest:
            raise ConfigError(
                f"{copy.parent} holds another robot of that name, or an earlier version of {path}; rename the folder or file, "
                "or choose another --out."
            )
        return key
    print(f"robot {key}: completing {description.name}; the result is written to {copy}")
    for note in load_urdf(description.parent / read_draft(description).urdf).notes:
        print(f"note: {note}")
    keep_robot(load_robot(path), data, digest)
    return key


def _digest(description: Path) -> str:
    """SHA-256 over the description and all files of its URDF."""
    urdf = load_urdf(description.parent / read_draft(description).urdf)
    digest = hashlib.sha256(description.read_bytes())
    for file in urdf.files:
        digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def keep_robot(robot: RobotSpec, data: Path, digest: str = "") -> RobotSpec:
    """Copy a robot, with the SHA-256 of its description, into a data set unless it has the key; returns the copy."""
    folder = path_below(data, KEPT, robot.key)
    if not (folder / OWN).is_file():
        write_robot(robot, folder, _robot_yaml(robot, digest))
    return load_robot(folder)


def write_robot(robot: RobotSpec, folder: Path, description: str) -> None:
    """Write a robot's folder: `description` as robot.yaml, the URDF as <key>.urdf, and all files that it names in files/.

    Raises:
        EpisodeError: the folder holds other files.
    """
    urdf, name = load_urdf(robot.urdf), urdf_name(robot)
    copies = _copy_names(urdf.files[1:])
    root = read_xml(urdf.path)
    tree = ElementTree.ElementTree(root)
    for _, entry in file_entries(root):
        entry.set("filename", copies[urdf.meshes[entry.get("filename", "")].resolve()].as_posix())
    ElementTree.indent(tree)
    with complete_folder(folder, held=(name, FILES, OWN)) as temporary:
        for file, copy in copies.items():
            (temporary / copy).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, temporary / copy)
        tree.write(temporary / name, encoding="utf-8", xml_declaration=True)
        (temporary / OWN).write_text(description, encoding="utf-8")


def urdf_name(robot: RobotSpec) -> str:
    """Name of the URDF in a robot's folder."""
    return f"{robot.key}.urdf"


def _copy_names(files: Sequence[Path]) -> dict[Path, Path]:
    """Path of each file's copy in a robot's folder, with unchanged relative paths."""
    own = [file.resolve() for file in files if not file.resolve().is_relative_to(DESCRIPTIONS)]
    top = Path(os.path.commonpath([file.parent for file in own])) if own else Path("/")
    copies = {file: Path(FILES) / file.relative_to(top) for file in own}
    packaged = [file.resolve() for file in files if file.resolve() not in copies]
    return copies | {file: Path(FILES) / "xew" / file.relative_to(DESCRIPTIONS) for file in packaged}


def _robot_yaml(robot: RobotSpec, digest: str) -> str:
    """A complete robot.yaml."""
    limits = {
        name: list(getattr(robot, name)) for name in ("joint_lower", "joint_upper", "joint_velocity", "joint_acceleration")
    }
    arms = [
        {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(arm).items()} for arm in robot.arms
    ]
    content = {"urdf": urdf_name(robot), "title": robot.title, "arms": arms, **limits, "source": digest}
    return str(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
