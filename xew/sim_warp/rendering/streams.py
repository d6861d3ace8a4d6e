"""Images from a robot and its canonical commands [t 16] alone, without recorded states: a model may know them in advance.

To add one, write a pure function of (robot, action, camera) here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np

from xew.concurrency import PARSING
from xew.protocol import ARMS
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.geometry.camera import HEAD_CAMERA, Camera, look_at, project
from xew.sim_warp.geometry.meshes import Color
from xew.sim_warp.geometry.poses import matrix_from_pose
from xew.sim_warp.kinematics.forward import tool_pose
from xew.sim_warp.rendering.bodies import robot_bodies, robot_pose
from xew.sim_warp.rendering.render import FLOW_LIMIT, Body, Renderer, World
from xew.sim_warp.stage import TABLE_TOP, Light, Stage

VIEW_COUNT = 9
CLIP_FRAMES = 17
"""Numbers of views and of frames in the paper's specifications of a robot."""
VIEW_ELEVATION = 25.0
"""Height of the cameras of reference views over the horizon [deg]."""
FIT_MARGIN = 1.05
"""Margin round the robot in reference views, as a factor of the distance."""
SWEEP = 0.6
"""Angle by which the articulation clip moves a joint from home to either side, where its limits allow [rad]."""
STILL = 0.5
"""Length below which optical flow is drawn as zero [pixels]."""
AXIS_LENGTH = 0.1
"""Length of the tool's axes in the ray map [m]."""
MARKER_RADIUS, AXIS_WIDTH = 50 / 512, 8 / 512
"""Radius of the base marker and width of the axes' lines, as shares of the image's width."""
THREE_LAMPS = Stage(
    lights=(
        Light(1.5, (0.0, 1.0, -1.0), color=(1.0, 0.0, 0.0)),
        Light(1.5, (-0.866, -0.5, -1.0), color=(0.0, 1.0, 0.0)),
        Light(1.5, (0.866, -0.5, -1.0), color=(0.0, 0.0, 1.0)),
    ),
    ambient=0.1,
)
"""A red, a green and a blue lamp round the bare table, 45 degrees high: none of them is a lamp of the scenes."""
WHITE = np.uint32(0xFFFFFFFF)
"""A white pixel: red, green, blue and an unused byte."""
RAY_MAP_GROUND: Color = (128, 128, 128)
AXIS_COLORS: tuple[Color, ...] = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
GRIPPER_COLORS: tuple[tuple[Color, Color], ...] = (((229, 245, 224), (0, 68, 27)), ((254, 224, 210), (103, 0, 13)))
"""Base marker of the left and the right tool with the gripper closed and open: greens and reds, as in EnerVerse-AC."""


@dataclass(frozen=True)
class CommandStreams:
    """The robot alone, posed by its commands, on white."""

    render: np.ndarray
    """[t h w 3] uint8, sRGB."""
    mask: np.ndarray
    """[t h w] bool."""
    optical_flow: np.ndarray
    """[t h w 2] float32 motion from this frame to the next [pixels], see `Frames.optical_flow`."""


def default_renderer(frames_per_chunk: int | None = None) -> Renderer:
    """The process's shared renderer on Warp's default device.

    The first call silences Warp and creates the renderer, with so many frames in flight.
    """
    with PARSING:  # Warp's devices are not thread-safe at first use
        if not _shared:
            quiet_warp()
            _shared.append(Renderer(frames_per_chunk=frames_per_chunk))
        return _shared[0]


_shared: list[Renderer] = []


def command_streams(
    robot: RobotSpec, action: np.ndarray, camera: Camera = HEAD_CAMERA, table: float | None = None, colors: bool = True
) -> CommandStreams:
    """Render [t h w 3] uint8, mask [t h w] and exact optical flow [t h w 2] pixels of canonical commands [t 16].

    Args:
        table: height of the table that hides what lies behind it, as in the header of an episode (`Record.table`).
        colors: without them the render is empty, which halves the time on a CPU.

    Raises:
        ValueError: the action does not have 16 columns.
    """
    return command_streams_batch([(robot, action)], camera, table, colors=colors)[0]


def command_streams_batch(
    commands: Sequence[tuple[RobotSpec, np.ndarray]],
    camera: Camera = HEAD_CAMERA,
    table: float | None = None,
    renderer: Renderer | None = None,
    colors: bool = True,
) -> list[CommandStreams]:
    """`command_streams` of many (robot, action [t 16]) at once; each does not depend on the others."""
    renderer = renderer or default_renderer()
    batch = renderer.render_batch(_worlds(commands), camera, **_hidden_by(table), optical_flow=True, colors=colors)
    return [CommandStreams(frames.rgb, frames.robot_mask, frames.optical_flow) for frames in batch]


def command_renders(
    commands: Sequence[tuple[RobotSpec, np.ndarray]],
    camera: Camera = HEAD_CAMERA,
    table: float | None = None,
    renderer: Renderer | None = None,
) -> list[np.ndarray]:
    """Only the renders [t h w 3] uint8 of `command_streams_batch`, of which an episode keeps a video."""
    batch = (renderer or default_renderer()).render_batch(_worlds(commands), camera, **_hidden_by(table))
    return [frames.rgb for frames in batch]


def three_shadows(robot: RobotSpec, action: np.ndarray, camera: Camera = HEAD_CAMERA, raised: float = 0.0) -> np.ndarray:
    """The robot of canonical commands [t 16] on the bare table, with a shadow of each of `THREE_LAMPS`: [t h w 3] uint8.

    The three shadows of a part say where it is above the table, whatever lights the scene. The table's top is `raised` [m] over
    the standard one.
    """
    stage = replace(THREE_LAMPS, raised=raised)
    return default_renderer().render_batch(_worlds([(robot, action)]), camera, stage=stage)[0].rgb


def _hidden_by(table: float | None) -> dict[str, Any]:
    """Arguments of the renderer for bodies on white behind a table of this height [m], or without one."""
    return {"ground": table is not None, "stage": Stage(raised=0.0 if table is None else table - TABLE_TOP, only_hides=True)}


def _worlds(commands: Sequence[tuple[RobotSpec, np.ndarray]]) -> list[World]:
    return [World(robot_bodies(robot), robot_pose(robot, _check_action(action))) for robot, action in commands]


def flow_to_rgb(flow: np.ndarray, clip: float = FLOW_LIMIT) -> np.ndarray:
    """Optical flow as a video [t h w 3] uint8: direction is hue, length is saturation, rest is white.

    The color wheel is FlowWAM's. Frame 0 is white and frame k holds the motion from k - 1 to k.

    Args:
        flow: [t h w 2] float32 motion from each frame to the next [pixels].
        clip: length of full saturation [pixels]; the paper's 25, FlowWAM's WorldArena script has 20.
    """
    pixels = np.ascontiguousarray(flow[:-1], np.float32).view(np.uint64).ravel()
    moving = np.flatnonzero(pixels != 0)  # few pixels move, and most of the others are zero to the bit
    x, y = pixels[moving].view(np.float32).reshape(-1, 2).T.copy()
    far = x * x + y * y >= STILL * STILL
    moving, x, y = moving[far], x[far], y[far]
    hue = (np.arctan2(y, x) + np.pi) / (2 * np.pi) * 179
    saturation = np.minimum(np.sqrt(x * x + y * y) / clip, 1) * 255
    colors = np.full(flow.shape[:3], WHITE, np.uint32)
    colors[1:].reshape(-1)[moving] = color_wheel()[hue.astype(np.uint8), saturation.astype(np.uint8)]
    rows = colors.view(np.uint8).reshape(-1, flow.shape[2], 4)  # all frames below each other, for one call of OpenCV
    return cv2.cvtColor(rows, cv2.COLOR_RGBA2RGB).reshape(*flow.shape[:3], 3)


@cache
def color_wheel() -> np.ndarray:
    """RGB and 255 of each hue and saturation at full value, as OpenCV has them, in the bytes of uint32 [180 256]."""
    hue, saturation = np.mgrid[:180, :256].astype(np.uint8)
    colors = cv2.cvtColor(np.stack([hue, saturation, np.full_like(hue, 255)], -1), cv2.COLOR_HSV2RGB)
    return cv2.cvtColor(colors, cv2.COLOR_RGB2RGBA).view(np.uint32)[..., 0]


def ray_map(robot: RobotSpec, action: np.ndarray, camera: Camera = HEAD_CAMERA) -> np.ndarray:
    """The tool frames of canonical commands [t 16] drawn into the image: [t h w 3] uint8.

    On gray, each tool has a disc at its origin, whose color shows the gripper, and its x (approach), y (opening) and z axes in
    red, green and blue, 0.1 m long, in the proportions of EnerVerse-AC's trajectory maps. The nearer tool covers the other;
    tools behind the camera are omitted.
    """
    action = _check_action(action)
    canvas = np.full((len(action), camera.height, camera.width, 3), RAY_MAP_GROUND, np.uint8)
    tools = [_tool_points(robot, arm, action) for arm in range(len(ARMS))]
    projected = [project(camera, points) for points in tools]
    for frame in range(len(action)):
        for arm in sorted(range(len(ARMS)), key=lambda arm: -projected[arm][1][frame, 0]):
            pixels, depth = projected[arm]
            if (depth[frame] > 0.05).all():
                _draw_tool(canvas[frame], pixels[frame], arm, float(action[frame, ARMS[arm][1]]))
    return canvas


def _tool_points(robot: RobotSpec, arm: int, action: np.ndarray) -> np.ndarray:
    """[t 4 3] origin and ends of the axes of a tool, world frame [m]."""
    joints = action[:, ARMS[arm][0]][:, : len(robot.arms[arm].joints)]
    frame = matrix_from_pose(tool_pose(robot, arm, joints))
    ends = frame[:, :3, 3:] + AXIS_LENGTH * frame[:, :3, :3]
    return np.concatenate([frame[:, :3, 3:], ends], -1).transpose(0, 2, 1)


def _draw_tool(image: np.ndarray, pixels: np.ndarray, arm: int, gripper: float) -> None:
    """Base marker and axes from the four projected points [4 2] into an image [h w 3]."""
    closed, opened = (np.array(color) for color in GRIPPER_COLORS[arm])
    color = closed + np.clip(gripper, 0, 1) * (opened - closed)
    fixed_point = np.clip(np.round(pixels * 16), -(1 << 20), 1 << 20).astype(int)
    origin, *ends = (tuple(int(v) for v in point) for point in fixed_point)
    width = image.shape[1]
    cv2.circle(image, origin, round(width * MARKER_RADIUS) * 16, color.round().tolist(), -1, cv2.LINE_AA, 4)
    for end, axis_color in zip(ends, AXIS_COLORS, strict=True):
        cv2.line(image, origin, end, axis_color, round(width * AXIS_WIDTH), cv2.LINE_AA, 4)


def reference_image(robot: RobotSpec) -> np.ndarray:
    """The robot at home, seen from the front, [h w 3] uint8: the first of its nine views."""
    return nine_views(robot)[0]


def nine_views(robot: RobotSpec) -> np.ndarray:
    """The robot at home from nine azimuths 40 degrees apart, [9 h w 3] uint8, the first from the front."""
    bodies, pose = robot_bodies(robot), robot_pose(robot, home_action(robot)[None])
    cameras = fit_cameras(bodies, pose, [index * 360 / VIEW_COUNT for index in range(VIEW_COUNT)])
    return np.concatenate([default_renderer().render(bodies, pose, camera, ground=False).rgb for camera in cameras])


def articulation_clip(robot: RobotSpec) -> np.ndarray:
    """A clip [17 h w 3] uint8 of the robot, from the front, that sweeps every joint and both grippers."""
    bodies, pose = robot_bodies(robot), robot_pose(robot, articulation_action(robot))
    camera = fit_cameras(bodies, pose, [0.0])[0]
    return default_renderer().render(bodies, pose, camera, ground=False).rgb


def articulation_action(robot: RobotSpec) -> np.ndarray:
    """[17 16] float64 commands that move all joints to both sides of home within the experts' limits, and both grippers.

    They end at home. The outer three joints swing twice while the others swing once.
    """
    home = home_action(robot)
    swing = 2 * np.pi * np.arange(CLIP_FRAMES) / (CLIP_FRAMES - 1)
    action = np.tile(home, (CLIP_FRAMES, 1))
    lower, upper = np.array(robot.joint_lower), np.array(robot.joint_upper)
    for arm, gripper in ARMS:
        middle = home[arm][: len(lower)]
        rate = np.where(np.arange(len(lower)) < len(lower) - 3, 1, 2)
        moved = middle + SWEEP * np.sin(swing[:, None] * rate)
        action[:, arm.start : arm.start + len(lower)] = np.clip(moved, lower, upper)
        action[:, gripper] = (1 + np.cos(swing)) / 2
    return action


def home_action(robot: RobotSpec) -> np.ndarray:
    """[16] float64 canonical joint positions at home [rad], grippers open (1)."""
    action = np.zeros(16)
    for (joints, gripper), arm in zip(ARMS, robot.arms, strict=True):
        action[joints.start : joints.start + len(arm.home)] = arm.home
        action[gripper] = 1.0
    return action


def fit_cameras(bodies: Sequence[Body], pose: np.ndarray, azimuths: Sequence[float]) -> list[Camera]:
    """Cameras round the robot at the least equal distance at which poses [t b 7] fit into every image.

    Azimuth 0 [deg] is in front of the robot; it increases towards the robot's left hand.
    """
    placed = [
        np.einsum("tij,vj->tvi", frame[:, :3, :3], body.mesh.vertices) + frame[:, None, :3, 3]
        for body, frame in zip(bodies, matrix_from_pose(pose).swapaxes(0, 1), strict=True)
    ]
    points = np.concatenate([vertices.reshape(-1, 3) for vertices in placed])
    center = (points.min(0) + points.max(0)) / 2
    cameras = [look_at(center + _view_direction(azimuth), center) for azimuth in azimuths]
    distance = FIT_MARGIN * max(_fitting_distance(camera, points) for camera in cameras)
    return [look_at(center + distance * _view_direction(azimuth), center) for azimuth in azimuths]


def _view_direction(azimuth: float) -> np.ndarray:
    """[3] unit vector from the robot to a camera at an azimuth [deg]."""
    turn, rise = np.radians(azimuth), np.radians(VIEW_ELEVATION)
    return np.array([-np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), np.sin(rise)])


def _fitting_distance(camera: Camera, points: np.ndarray) -> float:
    """Least distance from a target 1 m ahead of the camera at which all points [p 3] are in the image [m]."""
    seen = points @ camera.extrinsics[:3, :3].T + camera.extrinsics[:3, 3]
    half_view = camera.intrinsics[:2, 2] / camera.intrinsics[[0, 1], [0, 1]]
    return float((np.abs(seen[:, :2]) / half_view - (seen[:, 2:] - 1)).max())


def _check_action(action: np.ndarray) -> np.ndarray:
    """The action as float64 [t 16]. Raises ValueError for another shape."""
    action = np.asarray(action, float)
    if action.ndim != 2 or action.shape[1] != 16:
        raise ValueError(f"action has shape {action.shape}, expected (frames, 16): the canonical layout of xew.protocol.")
    return action
