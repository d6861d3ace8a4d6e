"""Pictures of the robots: `python -m xew.sim_warp.robots.sheet --out docs/img` draws each from nine sides, and all in one.

Look at them after every change of a shape: a robot that a person would not recognise is a defect.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro

from xew.sim_warp.camera import HEAD_CAMERA
from xew.sim_warp.render import Renderer
from xew.sim_warp.robots import ROBOTS, get_robot
from xew.sim_warp.robots.bodies import robot_bodies, robot_pose
from xew.sim_warp.streams import home_action, nine_views
from xew.sim_warp.workers import quiet_warp


def sheet(views: np.ndarray) -> np.ndarray:
    """Nine images [9 h w 3] as three rows of three, [3h 3w 3]."""
    return np.vstack([np.hstack(list(views[row : row + 3])) for row in (0, 3, 6)])


def overview(views: dict[str, np.ndarray], head: dict[str, np.ndarray]) -> np.ndarray:
    """One row a robot at half size: its name, what the head camera sees at home, and every other of the nine views."""
    rows = []
    for key, images in views.items():
        small = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (head[key], *images[::2])]
        row = np.ascontiguousarray(np.hstack(small))
        cv2.putText(row, get_robot(key).title, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (20, 20, 20), 1, cv2.LINE_AA)
        rows.append(row)
    return np.vstack(rows)


def head_view(key: str, renderer: Renderer) -> np.ndarray:
    """The robot at home over the empty table, as the head camera sees it, [h w 3] uint8."""
    robot = get_robot(key)
    return renderer.render(robot_bodies(robot), robot_pose(robot, home_action(robot)[None]), HEAD_CAMERA).rgb[0]


@dataclass(frozen=True)
class Args:
    """Draw nine-view sheets of robots as PNG."""

    out: Path = Path("docs/img")
    """Folder for robot_<key>.png and robots.png."""
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Registry keys or import paths module:NAME."""


def main() -> None:
    quiet_warp()
    args = tyro.cli(Args)
    args.out.mkdir(parents=True, exist_ok=True)
    renderer = Renderer()
    views = {key: nine_views(key) for key in args.robots}
    pictures = {f"robot_{get_robot(key).key}": sheet(images) for key, images in views.items()}
    pictures["robots"] = overview(views, {key: head_view(key, renderer) for key in args.robots})
    for name, picture in pictures.items():
        path = args.out / f"{name}.png"
        if not cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
            raise OSError(f"{path} cannot be written; choose another folder with --out.")
        print(path)


if __name__ == "__main__":
    main()
