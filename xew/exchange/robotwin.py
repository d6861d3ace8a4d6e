"""Import RoboTwin 2.0 episodes from HDF5 files of the legacy layout or of version 1.0.

Reads  SRC: a file, or a folder with <task>/<robot>/data/episodeN.hdf5 at any depth
Writes <out>/<task>/<seed>/<robot>/, see xew/episode.py, and <out>/robots/<robot>/

RoboTwin's joint positions are drive targets and become `action`, the command in force at each frame. Measured joints, objects,
contacts and the robot's mask stay unknown (`Record.unknown`). End poses are measured and become tool poses. If the joints of
one of xew's robots reach the end poses, that robot is stored with the fitted bases, and the robot-only video and keypoints are
rendered with it, posed by the commands. Otherwise there are none. What neither the file nor its folders say is asked for by an
option.

Command: python -m xew.exchange.robotwin SRC --out data [--robot arx_x5 --task NAME]
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tqdm import tqdm

import xew
from xew.config import ConfigError, user_errors
from xew.dataset import VIEWS, is_stale
from xew.episode import (
    EpisodeError,
    Record,
    States,
    array_hash,
    data_folder,
    episode_folder,
    exact_rate,
    read_record,
    read_states,
    write_episode,
)
from xew.exchange.hdf5 import OtherCamera, ReadOptions, Recorded, read_robotwin, text_beside
from xew.exchange.pictures import Colors
from xew.files import hold_lock
from xew.names import check_name, path_below
from xew.protocol import ACTION_DIM, FRAME_RATE, OWN_MOTION, CameraSpec
from xew.sim_warp.cameras import TOOLS, commanded_camera, fixed_frames
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.geometry.camera import Camera, project
from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix
from xew.sim_warp.kinematics.expert import canonical_commands
from xew.sim_warp.kinematics.forward import tool_matrix
from xew.sim_warp.rendering.observe import keypoint_names, keypoint_positions
from xew.sim_warp.rendering.streams import command_renders
from xew.sim_warp.robots import RobotSpec, get_robot, is_path, keep_robot
from xew.sim_warp.robots.user.draft import find_description, read_draft
from xew.sim_warp.stage import TABLE_TOP

EMBODIMENTS = {
    "aloha-agilex": "aloha_agilex",
    "ARX-X5": "arx_x5",
    "ur5-wsg": "ur5_wsg",
    "franka-panda": "franka_panda",
    "piper": "piper",
}
"""RoboTwin's names of robots, and xew's."""
ROBOT_NAMES = "|".join(EMBODIMENTS).replace("-", "[-_]")
ROBOT_FOLDER = re.compile(rf"({ROBOT_NAMES})(_(demo_)?(clean|randomized)(_[0-9]+)?)?", re.IGNORECASE)
"""Name of the folder above data/ that names a robot, such as ARX-X5_clean_50 or arx_x5."""
EPISODE_NAME = re.compile(r"episode_?([0-9]+)\.hdf5")
TOOL_DISTANCE = {"aloha_agilex": 0.12, "arx_x5": 0.12, "ur5_wsg": 0.11, "franka_panda": 0.08, "piper": 0.12}
"""Distance from the link that carries the tool to RoboTwin's tool center point [m] (gripper_bias of its embodiments)."""
FIT_POSITION, FIT_ROTATION = 0.01, 0.05
"""Largest median distance [m] and angle [rad] between end poses and a robot's tool poses at which it is that robot."""
SAME_PLACE = 0.003
"""Largest distance between the bases of two episodes of one robot [m]."""
UNKNOWN = ("joint_pos", "joint_vel", "object_pose", "object_joint", "contact", "penetration", "keypoint_visible", "robot_mask")
SOURCE = "RoboTwin HDF5"


@dataclass(frozen=True)
class Args:
    """What to import."""

    source: Annotated[Path, tyro.conf.Positional]
    """Path of a RoboTwin episode (.hdf5), or of a folder with them at any depth."""
    out: Path = Path("data")
    robot: str | None = None
    """Registry key, module:NAME or path of a robot; default: by the folder above data/, such as ARX-X5_clean_50."""
    task: str | None = None
    """Name of the task; default: the folder above the robot's, as in <task>/<robot>/data/episode0.hdf5."""
    instruction: str | None = None
    """Instruction of all episodes, perhaps empty; default: the first that RoboTwin stored for each."""
    frame_rate: float | None = None
    """Frames per second; default: by the file's frequency, or RoboTwin's 16.67 in files without it."""
    colors: Colors = "marked"
    """marked: RoboTwin's pictures. ordinary: a viewer shows their true colors. swapped: a viewer shows red as blue."""


def find_episodes(source: Path) -> list[Path]:
    """All RoboTwin episodes at or below a path. Raises EpisodeError if there is none."""
    paths = [source] if source.is_file() else sorted(source.rglob("episode*.hdf5"))
    if not paths:
        others = sorted(path.name for path in source.rglob("*.h*5"))[:3]
        there = f"; there are {', '.join(others)}" if others else ""
        raise EpisodeError(f"no episode*.hdf5 at {source}{there}; pass a RoboTwin episode or a folder of them.")
    return paths


def import_episode(path: Path, args: Args) -> Record:
    """Read one file and write one episode; an existing episode is skipped if it holds the same.

    Raises:
        EpisodeError, ConfigError: the file or the robot cannot be used, or another recording has its task, seed and robot.
    """
    recorded = read_robotwin(path, ReadOptions(args.frame_rate, args.colors, args.instruction))
    name, robot = _robot(path, recorded, args)
    task, seed = check_name(args.task or _folders(path, "task")[0], f"task of {path}"), _seed(path)
    action = canonical_commands(recorded.arms, recorded.grippers).astype(np.float32)
    folder = episode_folder(args.out, task, seed, name)
    if (folder / "episode.json").is_file():
        record = _check_existing(path, folder, recorded, action)
        _write_views(folder, record, robot, recorded)
        return record
    for neighbor in folder.parent.glob("[!.]*/episode.json"):
        if not read_record(neighbor.parent).source:
            raise EpisodeError(
                f"{path}: {neighbor.parent} was simulated here; RoboTwin's seed {seed} is another scene. Import it as another "
                "--task or into another --out."
            )
    camera = Camera(recorded.intrinsics, recorded.extrinsics)
    states, names = _build_states(robot, action, recorded, camera)
    video = None if robot is None else command_renders([(robot, action)], camera)[0]
    record = Record(
        task=task,
        seed=seed,
        robot=name,
        success=True,  # RoboTwin stores successful episodes only
        instruction=recorded.instruction,
        frame_count=len(action),
        frame_rate=recorded.frame_rate,
        keypoint_names=names,
        versions={"xew": xew.__version__},
        source=f"{SOURCE} ({recorded.layout})",
        motion=OWN_MOTION,  # RoboTwin plans for each robot separately
        unknown=UNKNOWN if recorded.tool_pose is not None else (*UNKNOWN, "tool_pose"),
    )
    record = read_record(write_episode(args.out, record, states, recorded.rgb, video))
    _write_views(folder, record, robot, recorded)
    return record


def _write_views(folder: Path, record: Record, robot: RobotSpec | None, recorded: Recorded) -> None:
    """Write the views of the file's other cameras that are missing; without a robot only those of cameras that stand still."""
    states = read_states(folder, record)
    for name, seen in recorded.cameras.items():
        root = path_below(data_folder(folder), VIEWS, name)
        moves = f"{name.removeprefix('wrist_')}_tool" in TOOLS
        stored = episode_folder(root, record.task, record.seed, record.robot)
        if ((stored / "episode.json").is_file() and not is_stale(read_record(stored))) or (moves and not robot):
            continue
        spec = _locate_camera(name, seen, robot, states.action)
        camera = Camera(seen.intrinsics, seen.extrinsics if moves else seen.extrinsics[0])
        of_view, video = replace(states, intrinsics=camera.intrinsics, extrinsics=camera.extrinsics), None
        if robot is not None:
            keypoints, _ = project(camera, keypoint_positions(robot, states.action))
            of_view = replace(of_view, keypoints=keypoints.astype(np.float32))
            video = command_renders([(robot, states.action)], commanded_camera(spec, robot, of_view), TABLE_TOP)[0]
        write_episode(root, replace(record, camera=spec, table=TABLE_TOP), of_view, seen.rgb, video)


def _locate_camera(name: str, seen: OtherCamera, robot: RobotSpec | None, action: np.ndarray) -> CameraSpec:
    """A recorded camera as data: fixed to the tool as in the first frame, or to the world."""
    tool = f"{name.removeprefix('wrist_')}_tool"
    fixed_to = tool if tool in TOOLS and robot is not None else "world"
    spec = CameraSpec(name, fixed_to)
    frame = np.eye(4) if robot is None else fixed_frames(spec, robot, action[:1])[0]
    _, y, z, center = (np.linalg.inv(frame) @ np.linalg.inv(seen.extrinsics[0]))[:3].T
    fov = 2 * np.degrees(np.arctan(seen.rgb.shape[1] / 2 / seen.intrinsics[1, 1]))
    position, target, up = (tuple(vector.tolist()) for vector in (center, center + z, -y))
    return CameraSpec(name, fixed_to, position, target, up, float(fov), (seen.rgb.shape[2], seen.rgb.shape[1]))


def _check_existing(path: Path, folder: Path, recorded: Recorded, action: np.ndarray) -> Record:
    """The header of an episode that was imported before. Raises EpisodeError if it holds another recording or reading.

    RoboTwin counts the seeds of each configuration from 0: files of two configurations may have the same task, seed and robot.
    """
    record = read_record(folder)
    if not np.array_equal(read_states(folder).action, action):
        raise EpisodeError(
            f"{path}: {folder} holds another recording of that task, seed and robot; import this one as another --task or into "
            "another --out."
        )
    same = {
        "frame rate": record.frame_rate == recorded.frame_rate,
        "instruction": record.instruction == recorded.instruction,
        "picture": record.hashes["rgb"] == array_hash(recorded.rgb),
    }
    if others := [name for name, is_same in same.items() if not is_same]:
        raise EpisodeError(
            f"{path}: {folder} holds this recording with another {' and '.join(others)}; delete it, or choose another --out."
        )
    return record


def fit_bases(robot: RobotSpec, recorded: Recorded) -> RobotSpec | None:
    """The robot with the bases and tool frames at which the recorded joints reach the recorded end poses.

    Targets run ahead of measurements: the bases are the median over the episode.

    Returns:
        None if there are no end poses or they do not fit the robot.
    """
    if recorded.tool_pose is None or recorded.arms.shape[2] != robot.arm_joint_count:
        return None
    distance = TOOL_DISTANCE.get(robot.key)
    arms = []
    for side, arm in enumerate(robot.arms):
        if distance is not None:
            approach = matrix_from_pose(arm.tool_pose)[:3, 0]
            arm = replace(arm, tool_pose=(*(distance * approach).tolist(), *arm.tool_pose[3:]))
        unplaced = replace(arm, root_pose=(0, 0, 0, 0, 0, 0, 1))
        reached = tool_matrix(replace(robot, arms=(unplaced, unplaced)), 0, recorded.arms[:, side])
        measured = matrix_from_pose(recorded.tool_pose[:, side])
        bases = pose_from_matrix(measured @ np.linalg.inv(reached))
        base = _middle_pose(bases)
        off = pose_from_matrix(np.linalg.inv(matrix_from_pose(base)) @ matrix_from_pose(bases))
        angle = 2 * np.arccos(np.clip(off[:, 6], -1, 1))
        if np.median(np.linalg.norm(off[:, :3], axis=1)) > FIT_POSITION or np.median(angle) > FIT_ROTATION:
            return None
        x, y, z, qx, qy, qz, qw = base.tolist()
        arms.append(replace(arm, root_pose=(x, y, z, qx, qy, qz, qw), home=tuple(recorded.arms[0, side].tolist())))
    return replace(robot, arms=(arms[0], arms[1]), title=f"{robot.title} as placed in RoboTwin")


def _middle_pose(poses: np.ndarray) -> np.ndarray:
    """The pose [7] among poses [t 7] nearest to their median."""
    aligned = np.concatenate([poses[:, :3], poses[:, 3:] * np.where(poses[:, 3:] @ poses[0, 3:] < 0, -1, 1)[:, None]], 1)
    return poses[int(np.argmin(np.linalg.norm(aligned - np.median(aligned, axis=0), axis=1)))]


def _robot(path: Path, recorded: Recorded, args: Args) -> tuple[str, RobotSpec | None]:
    """The name under which the episode is stored, and the robot for rendering, if it is known."""
    named = args.robot or _embodiment(path)
    robot = get_robot(named, args.out)
    if is_path(named) and (tool := read_draft(find_description(Path(named))).arms[0].tool_pose):
        robot = replace(robot, arms=(replace(robot.arms[0], tool_pose=tool), replace(robot.arms[1], tool_pose=tool)))
    if (joints := recorded.arms.shape[2]) != robot.arm_joint_count:
        raise EpisodeError(
            f"{path} has arms of {joints} joints, {robot.title} has {robot.arm_joint_count}; pass another --robot."
        )
    key, placed = f"{robot.key}_robotwin", fit_bases(robot, recorded)
    if placed is None:
        return key, None
    placed = replace(placed, key=key)
    earlier = keep_robot(placed, args.out)
    bases = [np.array([arm.root_pose[:3] for arm in spec.arms]) for spec in (placed, earlier)]
    if (moved := np.abs(bases[0] - bases[1]).max()) > SAME_PLACE:
        raise EpisodeError(
            f"{path}: the base of {robot.title} is {1000 * moved:.0f} mm from its place in earlier episodes; import episodes "
            "with another base distance into another --out."
        )
    return key, earlier


def _embodiment(path: Path) -> str:
    """The key of the robot after which the folder above data/ is named."""
    _, folder = _folders(path, "robot")
    if match := ROBOT_FOLDER.fullmatch(folder):
        return next(ours for theirs, ours in EMBODIMENTS.items() if _plain(theirs) == _plain(match[1]))
    raise ConfigError(
        f"{path}: its folder {folder!r} names no robot; expected {', '.join(EMBODIMENTS)}, perhaps with an ending such as "
        "_clean_50; pass --robot."
    )


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")


def _folders(path: Path, needed: str) -> tuple[str, str]:
    """Task and folder of the robot in <task>/<robot>/data/episode0.hdf5, perhaps below a folder of the configuration."""
    parts = path.absolute().parts
    if len(parts) < 4 or parts[-2] != "data":
        raise ConfigError(f"{path} is not at <task>/<robot>/data/episodeN.hdf5, RoboTwin's layout; pass --{needed}.")
    return parts[-4], parts[-3]


def _seed(path: Path) -> int:
    """The scene's seed by RoboTwin's seed.txt, or the episode's number without that file."""
    match = EPISODE_NAME.fullmatch(path.name)
    if not match:
        raise EpisodeError(f"{path}: the file's name gives no seed; rename it to episodeN.hdf5 or episode_N.hdf5.")
    number, seeds = int(match[1]), text_beside(path, "seed.txt").split()
    if not seeds:
        return number
    if number < len(seeds) and re.fullmatch("[0-9]{1,19}", seeds[number]):
        return int(seeds[number])
    raise EpisodeError(
        f"{path.absolute().parents[1] / 'seed.txt'} has {len(seeds)} entries and no seed of {path.name}; correct it, or remove "
        "it to take the files' numbers as seeds."
    )


def _build_states(
    robot: RobotSpec | None, action: np.ndarray, recorded: Recorded, camera: Camera
) -> tuple[States, tuple[str, ...]]:
    """States and names of keypoints of commands [t 16], as far as they are known."""
    frames, height, width = recorded.rgb.shape[:3]
    names: tuple[str, ...] = ()
    keypoints = np.zeros((frames, 0, 2), np.float32)
    if robot is not None:
        names = keypoint_names(robot)
        keypoints = project(camera, keypoint_positions(robot, action))[0].astype(np.float32)
    nothing = np.full((frames, ACTION_DIM), np.nan, np.float32)
    no_pose = np.full((frames, 2, 7), np.nan)
    states = States(
        action=action,
        joint_pos=nothing,
        joint_vel=nothing,
        tool_pose=(no_pose if recorded.tool_pose is None else recorded.tool_pose).astype(np.float32),
        object_pose=np.zeros((frames, 0, 7), np.float32),
        object_joint=np.zeros((frames, 0), np.float32),
        contact=np.zeros((frames, 2, 0), bool),
        penetration=np.zeros((frames, 0), np.float32),
        keypoints=keypoints,
        keypoint_visible=np.zeros(keypoints.shape[:2], bool),
        robot_mask=np.zeros((frames, height, width), bool),
        intrinsics=recorded.intrinsics,
        extrinsics=recorded.extrinsics,
    )
    return states, names


def import_all(paths: Sequence[Path], args: Args) -> tuple[list[Record], list[str]]:
    """Import files one by one; the headers of the imported files, and an error message for each other file."""
    records: list[Record] = []
    problems: list[str] = []
    for path in tqdm(paths, desc="importing", unit="episode"):
        try:
            records.append(import_episode(path, args))
        except (EpisodeError, ConfigError) as error:
            problems.append(str(error))
    return records, problems


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    if args.robot:
        get_robot(args.robot, args.out)  # a mistake is reported once, not for every file
    if args.frame_rate is not None:
        exact_rate(args.frame_rate)
    with hold_lock(args.out):
        records, problems = import_all(find_episodes(args.source), args)
    rendered = sum("robot" in record.hashes for record in records)
    print(f"{len(records)} episodes under {args.out}, {rendered} with the robot's own kinematics")
    rates = sorted({1000 / record.frame_rate for record in records})
    if any(abs(1000 / FRAME_RATE - time) > 0.1 for time in rates):
        times = " and ".join(f"{time:.0f}" for time in rates)
        print(
            f"their frames are {times} ms apart, in simulated data {1000 / FRAME_RATE:.0f} ms: training refuses to mix them. "
            "If another rate is right, delete them and pass --frame-rate."
        )
    if problems:
        raise EpisodeError(f"{len(problems)} of {len(records) + len(problems)} files were not imported:", *problems)


if __name__ == "__main__":
    main()
