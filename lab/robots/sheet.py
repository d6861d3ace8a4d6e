"""Pictures of the robots: each from nine sides and all in one, and their reference renders as files.

    python -m lab.robots.sheet --out docs/img
    python -m lab.robots.sheet --robots piper --references references
    python -m lab.robots.sheet --robots body:0-63 --grid docs/img/bodies.png

Reference renders do not depend on a task: for every robot <references>/<key>/ holds front.png (the canonical front view),
view_000.png to view_320.png (nine azimuths in degrees), clip.mkv (17 frames that sweep every joint, lossless) with clip.png
(the same side by side), and ray_map.png (the head camera's ray map of the clip's commands, every fourth frame).
Look at the sheets after every change of a shape: a robot that a person would not recognize is a defect.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro

from xew.config import user_errors
from xew.episode import write_video
from xew.files import hold_lock, replacing, write_bytes
from xew.protocol import expand_robots
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.geometry.camera import HEAD_CAMERA
from xew.sim_warp.inspection.pictures import encode_png
from xew.sim_warp.rendering.bodies import robot_bodies, robot_pose
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import (
    VIEW_COUNT,
    articulation_action,
    articulation_clip,
    default_renderer,
    fit_cameras,
    home_action,
    nine_views,
    ray_map,
    reference_image,
)
from xew.sim_warp.robots import ROBOTS, RobotSpec, get_robot
from xew.sim_warp.robots.adopt import view_sheet

GRID_COLUMNS, GRID_WIDTH, GRID_HEIGHT = 8, 240, 180
"""Numbers of robots in a row of a grid, and of pixels of each."""
GRID_AZIMUTH = 25.0
"""Azimuth from which a grid shows its robots [deg]: nearly from the front, a little towards the robot's left hand."""


def overview(robots: Sequence[RobotSpec], views: Sequence[np.ndarray], head: Sequence[np.ndarray]) -> np.ndarray:
    """All robots in one picture [h w 3] uint8, a row each at half size: the title, what the head camera sees at home, and every
    other of the nine views.

    Args:
        robots: which.
        views: [9 h w 3] uint8, nine views of each.
        head: [h w 3] uint8, the head camera's view of each.
    """
    rows = []
    for robot, images, seen in zip(robots, views, head, strict=True):
        small = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (seen, *images[::2])]
        row = np.ascontiguousarray(np.hstack(small))
        cv2.putText(row, robot.title, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (20, 20, 20), 1, cv2.LINE_AA)
        rows.append(row)
    return np.vstack(rows)


def grid(robots: Sequence[RobotSpec]) -> np.ndarray:
    """Robots at home side by side with their titles, eight in a row, [h w 3] uint8."""
    tiles = []
    for robot in robots:
        image = cv2.resize(side_view(robot, GRID_AZIMUTH), (GRID_WIDTH, GRID_HEIGHT), interpolation=cv2.INTER_AREA)
        cv2.putText(image, robot.title, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (20, 20, 20), 1, cv2.LINE_AA)
        tiles.append(image)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % GRID_COLUMNS)
    return np.vstack([np.hstack(tiles[row : row + GRID_COLUMNS]) for row in range(0, len(tiles), GRID_COLUMNS)])


def side_view(robot: RobotSpec, azimuth: float) -> np.ndarray:
    """The robot at home from one azimuth [deg], as in `nine_views` but as near as this view allows: [h w 3] uint8."""
    bodies, pose = robot_bodies(robot), robot_pose(robot, home_action(robot)[None])
    return default_renderer().render(bodies, pose, fit_cameras(bodies, pose, [azimuth])[0], ground=False).rgb[0]


def head_view(robot: RobotSpec, renderer: Renderer) -> np.ndarray:
    """The robot at home over the empty table, as the head camera sees it, [h w 3] uint8."""
    return renderer.render(robot_bodies(robot), robot_pose(robot, home_action(robot)[None]), HEAD_CAMERA).rgb[0]


def write_references(robot: RobotSpec, folder: Path) -> Path:
    """Write the reference renders of a robot into <folder>/<key>/, see the head of this file; returns that folder."""
    own = folder / robot.key
    own.mkdir(parents=True, exist_ok=True)
    save(own / "front.png", reference_image(robot))
    for index, image in enumerate(nine_views(robot)):
        save(own / f"view_{index * 360 // VIEW_COUNT:03d}.png", image)
    clip = articulation_clip(robot)
    with replacing(own / "clip.mkv", within=own) as temporary:
        write_video(temporary, clip)
    save(own / "clip.png", np.hstack([*clip]))
    save(own / "ray_map.png", np.hstack([*ray_map(robot, articulation_action(robot)[::4])]))
    return own


def save(path: Path, image: np.ndarray) -> None:
    """Write a PNG of [h w 3] uint8."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, encode_png(image), within=path.parent)


def write_sheets(robots: Sequence[RobotSpec], folder: Path) -> list[Path]:
    """Draw robot_<key>.png of every robot and robots.png of all; the files."""
    renderer = Renderer()
    views = [nine_views(robot) for robot in robots]
    pictures = {f"robot_{robot.key}": view_sheet(images) for robot, images in zip(robots, views, strict=True)}
    pictures["robots"] = overview(robots, views, [head_view(robot, renderer) for robot in robots])
    for name, picture in pictures.items():
        save(folder / f"{name}.png", picture)
    return [folder / f"{name}.png" for name in pictures]


@dataclass(frozen=True)
class Args:
    """Draw nine-view sheets of robots as PNG, or write their reference renders."""

    out: Path = Path("docs/img")
    """Folder for robot_<key>.png and robots.png."""
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Registry keys, bodies (body:17, body:0-63), import paths module:NAME or paths."""
    references: Path | None = None
    """Folder for reference renders, a folder a robot; then no sheets are drawn."""
    grid: Path | None = None
    """PNG file for one view of each robot, eight in a row; then no sheets are drawn."""


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    robots = [get_robot(name) for name in expand_robots(args.robots)]
    with hold_lock(args.grid or args.references or args.out):
        if args.grid is not None:
            save(args.grid, grid(robots))
            print(args.grid)
            return
        if args.references is None:
            print(*write_sheets(robots, args.out), sep="\n")
            return
        for robot in robots:
            print(write_references(robot, args.references))


if __name__ == "__main__":
    main()
