"""Complete a robot's description once: a URDF or xacro becomes a folder that every other command takes.

    python -m xew.sim_warp.robots.adopt lab/my_arm.urdf
    python -m xew.sim_warp.robots.adopt lab/arm.urdf.xacro --package arm_description=lab/arm_description --argument name=arm
    python -m xew.sim_warp.robots.adopt lab/ur5e.urdf --hand ur5_wsg

Writes <out>/<key>/ with the URDF, all files that it names and a robot.yaml that marks each entry as given or found, and
<out>/<key>.png, nine views. Prints a summary of the robot and warnings.

Only this command expands xacro, finds meshes of packages in other folders, converts linked fingers to sliding ones, mounts one
of xew's hands on a bare arm, and gives mirrored arms the same limits.
"""

import re
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import tyro
from tqdm import tqdm

from xew.config import ConfigError, user_errors
from xew.files import hold_lock, write_bytes
from xew.names import plain_line
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.embodiment.urdf import Urdf, load_urdf
from xew.sim_warp.inspection.pictures import encode_png
from xew.sim_warp.kinematics.reachability import work_reach
from xew.sim_warp.rendering.streams import nine_views
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.robots.user.draft import OWN, RobotDraft, find_description, read_draft
from xew.sim_warp.robots.user.hands import graft_hand, slide_fingers
from xew.sim_warp.robots.user.infer import complete_arms
from xew.sim_warp.robots.user.own import complete_draft, load_robot, robot_key, urdf_name, write_robot
from xew.sim_warp.robots.user.placement import check_plans
from xew.sim_warp.robots.user.plain import read_description, unfold_mirrored
from xew.sim_warp.robots.user.summary import commented_yaml, robot_lines, warning_lines

Value = TypeVar("Value")
STAGES = ("files", "hands", "place", "plans", "reach", "pictures")


@dataclass(frozen=True)
class Args:
    """Complete a robot's description once, as a folder for every other command."""

    robot: Annotated[Path, tyro.conf.Positional]
    """A .urdf, .xacro, or a folder with a robot.yaml, a RoboTwin config.yml or one URDF."""
    out: Path = Path("robots")
    """Parent of the robot's folder."""
    package: tuple[str, ...] = ()
    """NAME=DIR, folders of the packages in package:// names or a xacro."""
    argument: tuple[str, ...] = ()
    """NAME=VALUE, arguments of a xacro."""
    hand: str | None = None
    """Robot of xew whose hand replaces all moving links beyond the arm's last joint: ur5_wsg, franka_panda."""
    last_joint: str | None = None
    """Name of the arm's last joint, for --hand; default: the joint before the first branch."""


def adopt(args: Args) -> Path:
    """Complete a robot's description; returns the written folder.

    Raises:
        ConfigError: the description cannot be read, or the robot does not meet the requirements of all robots.
        EpisodeError: the folder holds other files, or another process writes it.
    """
    source = find_description(args.robot).resolve()
    is_xacro = source.suffix.lower() == ".xacro"
    draft = RobotDraft(source.name) if is_xacro else read_draft(source)
    key = robot_key(source.with_name(source.name.split(".")[0] + ".urdf") if is_xacro else source)
    folder, described = args.out / key, source.parent / draft.urdf
    notes: list[str] = []
    with (
        hold_lock(folder),
        tqdm(total=len(STAGES), desc=STAGES[0], unit="stage") as bar,
        tempfile.TemporaryDirectory() as work,
        _naming(described, work),
    ):
        following = iter(STAGES[1:])

        def end_stage() -> None:
            bar.update()
            bar.set_description(next(following, STAGES[-1]))

        tree = read_description(described, _pairs(args.package, Path), _pairs(args.argument, str), notes)
        end_stage()
        urdf, changes = _normalize(tree, draft, args, Path(work) / described.name, str(source))
        end_stage()
        robot = complete_draft(draft, urdf, key, str(source))
        notes += [*changes, *warning_lines(robot)]
        end_stage()
        problems = check_plans(robot).problems
        end_stage()
        reach = [float(work_reach(robot, arm).mean()) for arm in (0, 1)]
        end_stage()
        write_robot(robot, folder, commented_yaml(robot, draft, urdf_name(robot)))
        write_bytes(args.out / f"{key}.png", encode_png(view_sheet(nine_views(load_robot(folder)))), within=args.out)
        end_stage()
    for line in [*robot_lines(robot, problems, reach), *(f"note: {note}" for note in dict.fromkeys(notes))]:
        print(plain_line(line))
    return folder


@contextmanager
def _naming(described: Path, work: str) -> Iterator[None]:
    """Name the user's file in errors on its changed copies in the folder `work`."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(re.sub(rf"{re.escape(work)}/\d+/", f"{described.parent}/", str(error))) from error


def view_sheet(views: np.ndarray) -> np.ndarray:
    """Nine images [9 h w 3] as three rows of three, [3h 3w 3]."""
    return np.vstack([np.hstack(list(views[row : row + 3])) for row in (0, 3, 6)])


def _pairs(given: Sequence[str], kind: Callable[[str], Value]) -> dict[str, Value]:
    """Values by name, of texts NAME=VALUE."""
    if wrong := [text for text in given if "=" not in text]:
        raise ConfigError(f"{wrong[0]!r} is not of the form NAME=VALUE; correct the option.")
    return {name: kind(value) for name, _, value in (text.partition("=") for text in given)}


def _normalize(tree: ElementTree.Element, draft: RobotDraft, args: Args, copy: Path, source: str) -> tuple[Urdf, list[str]]:
    """The robot's URDF with two sliding fingers per hand and equal limits of both arms, and notes on the changes."""
    urdf, notes = _load(tree, copy), []
    if args.hand is not None:
        if args.hand not in ROBOTS:
            raise ConfigError(f"--hand {args.hand}: there is no such robot; expected one of {', '.join(ROBOTS)}.")
        joints = draft.arms[0].joints
        notes = [graft_hand(tree, urdf, ROBOTS[args.hand], args.last_joint or (joints[-1] if joints else None))]
    elif not draft.arms[0].fingers:
        notes = slide_fingers(tree, urdf)
    urdf = _load(tree, copy) if notes else urdf
    left, right = complete_arms(draft, urdf, source)
    if left.joints != right.joints and len(left.joints) == len(right.joints):
        turned = unfold_mirrored(tree, list(zip(left.joints, right.joints, strict=True)), urdf)
        if turned:
            notes.append(f"the axes of {', '.join(turned)} are reversed, because their limits mirror the left arm's")
            urdf = _load(tree, copy)
    return urdf, notes


def _load(tree: ElementTree.Element, copy: Path) -> Urdf:
    """The tree as a URDF, read from a file of this name in a new folder: `load_urdf` caches by file."""
    folder = copy.parent / str(len(list(copy.parent.iterdir())))
    folder.mkdir()
    ElementTree.ElementTree(tree).write(folder / copy.name, encoding="utf-8", xml_declaration=True)
    return load_urdf(folder / copy.name)


@user_errors
def main() -> None:
    quiet_warp()
    folder = adopt(tyro.cli(Args, description=__doc__))
    print(f"{folder}: pass this path to the other commands; {folder / OWN} says how each entry was found and how to change it")


if __name__ == "__main__":
    main()
