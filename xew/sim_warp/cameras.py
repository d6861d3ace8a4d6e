"""Named cameras as data, custom cameras from YAML files, and the pinhole camera of each for a robot's motion.

To add a camera, add a line to CAMERAS. A custom camera is a YAML file with the fields of `CameraSpec`.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from xew.config import ConfigError, load, suggestion
from xew.episode import States
from xew.names import EpisodeError, check_name
from xew.protocol import HEAD, HEAD_SPEC, LARGEST_SIDE, CameraSpec
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.geometry.camera import Camera, spec_camera
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.kinematics.forward import link_poses, tool_poses
from xew.sim_warp.rendering.bodies import SIDES, body_names, robot_bodies, robot_pose
from xew.sim_warp.rendering.streams import articulation_action, default_renderer, home_action

TOOLS = ("left_tool", "right_tool")
"""Names of the tools' frames, to which a camera can be fixed on every robot."""
WRIST = CameraSpec("wrist", "left_tool", (-0.04, 0.0, 0.08), (0.03, 0.0, 0.0), vertical_fov=75.0)
"""A camera over the hand; `fix_camera` raises it above larger hands."""
WRIST_CLEARANCE = 0.02
"""Least height of a wrist camera above the hand [m]."""
HAND_REACH, HAND_WIDTH = (-0.06, 0.06), 0.1
"""Part of the hand below a wrist camera: range of x, and width in y [m, tool frame]."""
CAMERAS: dict[str, CameraSpec] = {
    HEAD: HEAD_SPEC,
    "wrist_left": replace(WRIST, name="wrist_left"),
    "wrist_right": replace(WRIST, name="wrist_right", fixed_to="right_tool"),
    "front": CameraSpec("front", position=(0.0, 0.37, 1.35), target=(0.0, -0.3, 0.95), vertical_fov=65.0),
    "side": CameraSpec("side", position=(1.2, -0.1, 1.3), target=(0.0, -0.2, 0.9), vertical_fov=50.0),
}
"""Cameras by name."""
FACTOR = 8
"""Number that divides the sides of pictures, as the codecs' latents need it."""
SMALLEST_SIDE = 64


def get_camera(name: str, size: str | None = None) -> CameraSpec:
    """A camera of CAMERAS or of a YAML file, with another size if given.

    Args:
        name: key of CAMERAS, or path of a file that ends with .yaml or .yml.
        size: such as 640x480; None for the camera's own.

    Raises:
        ConfigError: there is no such camera, or its numbers or size cannot be used.
    """
    spec = load(CameraSpec, name) if name.endswith((".yaml", ".yml")) else CAMERAS.get(name)
    if spec is None:
        raise ConfigError(
            f"there is no camera {name!r};{suggestion(name, CAMERAS)} known: {', '.join(CAMERAS)}, or the path of a YAML file."
        )
    if spec.name in CAMERAS and spec != CAMERAS[spec.name]:
        raise ConfigError(f"{name}: the camera has the name {spec.name!r} of a built-in camera; give it its own name.")
    spec = spec if size is None else replace(spec, size=parse_size(size))
    try:
        check_name(spec.name, "name of a camera")
    except EpisodeError as error:
        raise ConfigError(str(error)) from error
    if problem := "its name has a +, as tiled views have" if spec.parts else spec.problem:
        raise ConfigError(f"{name}: {problem}.")
    parse_size("{}x{}".format(*spec.size))
    return spec


def get_views(names: Sequence[str], size: str | None = None) -> list[CameraSpec]:
    """The cameras with views besides `head`, which every episode has. Raises ConfigError as `get_camera`."""
    return [spec for spec in (get_camera(name, size) for name in names) if spec.view != HEAD]


def parse_size(text: str) -> tuple[int, int]:
    """Width and height [pixels] of a text such as 640x480. Raises ConfigError for a size that no picture has."""
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    width, height = (int(side) for side in match.groups()) if match else (0, 0)
    if width % FACTOR or height % FACTOR or not SMALLEST_SIDE <= min(width, height) <= max(width, height) <= LARGEST_SIDE:
        raise ConfigError(
            f"the size is {text!r}; expected WIDTHxHEIGHT such as 640x480, both multiples of {FACTOR} (codecs need that) from "
            f"{SMALLEST_SIDE} to {LARGEST_SIDE}."
        )
    return width, height


@cache
def fix_camera(spec: CameraSpec, robot: RobotSpec) -> CameraSpec:
    """The camera with the place that it has on a robot: a wrist camera stands above the hand.

    Raises:
        ConfigError: the robot does not have the link that the camera is fixed to.
    """
    fixed_frames(spec, robot, home_action(robot)[None])
    if replace(spec, size=WRIST.size) not in (CAMERAS["wrist_left"], CAMERAS["wrist_right"]):
        return spec
    x, y, least = spec.position
    return replace(spec, position=(x, y, max(least, round(_hand_top(robot, spec.fixed_to) + WRIST_CLEARANCE, 3))))


def _hand_top(robot: RobotSpec, tool: str) -> float:
    """Height of the part of the hand below a wrist camera at home [m], along z of the tool's frame."""
    home = home_action(robot)[None]
    to_tool = _invert(_tool_frames(robot, tool, home))[0]
    placed = zip(robot_bodies(robot), to_tool @ matrix_from_pose(robot_pose(robot, home)[0]), strict=True)
    points = np.concatenate([body.mesh.vertices @ pose[:3, :3].T + pose[:3, 3] for body, pose in placed])
    ahead = (points[:, 0] > HAND_REACH[0]) & (points[:, 0] < HAND_REACH[1])
    near = ahead & (np.abs(points[:, 1]) < HAND_WIDTH / 2) & (np.abs(points[:, 2]) < HAND_WIDTH)
    return float(points[near, 2].max(initial=0))


def place_camera(spec: CameraSpec, robot: RobotSpec, joint_pos: np.ndarray) -> Camera:
    """The camera for canonical joint positions [t 16], measured or commanded: with one pose if it stands still, else [t 4 4].

    Raises:
        ConfigError: the robot does not have the link that the camera is fixed to.
    """
    camera = spec_camera(spec)
    if not spec.moves:
        return camera
    frames = fixed_frames(spec, robot, np.asarray(joint_pos, float))
    return replace(camera, extrinsics=camera.extrinsics @ _invert(frames))


def commanded_camera(spec: CameraSpec, robot: RobotSpec, states: States) -> Camera:
    """An episode's camera while the robot follows its commands; one that stands still is as recorded."""
    height, width = states.robot_mask.shape[1:]
    camera = Camera(states.intrinsics, states.extrinsics, width, height)
    return replace(camera, extrinsics=place_camera(spec, robot, states.action).extrinsics) if spec.moves else camera


def fixed_frames(spec: CameraSpec, robot: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """Poses [t 4 4] in the world of what a camera is fixed to. Raises ConfigError as `place_camera`."""
    if not spec.moves:
        return np.tile(np.eye(4), (len(joint_pos), 1, 1))
    if spec.fixed_to in TOOLS:
        return _tool_frames(robot, spec.fixed_to, joint_pos)
    links = {_link_name(robot, copy, link): (copy, link) for copy, link in body_names(robot)}
    if spec.fixed_to not in links:
        raise ConfigError(
            f"the camera {spec.name} is fixed to {spec.fixed_to!r}, which {robot.key} does not have; its links are "
            f"{', '.join(links)}; world and {' and '.join(TOOLS)} are there on every robot."
        )
    copy, link = links[spec.fixed_to]
    return matrix_from_pose(link_poses(robot, joint_pos)[copy][link])


def _tool_frames(robot: RobotSpec, tool: str, joint_pos: np.ndarray) -> np.ndarray:
    return matrix_from_pose(tool_poses(robot, joint_pos)[:, TOOLS.index(tool)])


def _invert(frames: np.ndarray) -> np.ndarray:
    """The inverse of rigid transforms [t 4 4]."""
    inverse = np.tile(np.eye(4), (len(frames), 1, 1))
    inverse[:, :3, :3] = frames[:, :3, :3].swapaxes(1, 2)
    inverse[:, :3, 3] = -np.einsum("tij,tj->ti", inverse[:, :3, :3], frames[:, :3, 3])
    return inverse


def _link_name(robot: RobotSpec, copy: int, link: str) -> str:
    return link if robot.one_urdf_holds_both_arms else f"{SIDES[copy]}/{link}"


def demand_sight(specs: Sequence[CameraSpec], robots: Sequence[RobotSpec]) -> None:
    """Raise ConfigError for a camera that sees nothing of a robot, at home and while each of its joints moves."""
    for spec in specs:
        for robot in robots:
            fixed, motion = fix_camera(spec, robot), np.concatenate([home_action(robot)[None], articulation_action(robot)])
            worlds = robot_bodies(robot), robot_pose(robot, motion)
            frames = default_renderer().render(*worlds, place_camera(fixed, robot, motion))
            if not frames.robot_mask.any():
                raise ConfigError(
                    f"the camera {spec.name} at {fixed.position} in the frame of {spec.fixed_to} sees nothing of {robot.key}; "
                    f"turn it by its target, now {spec.target}, or move it. The robots stand round (0, -0.4, 0.8) and face +y."
                )
