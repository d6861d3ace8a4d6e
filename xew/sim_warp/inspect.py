"""The command that looks into a data set: yields, hashes, contact sheets and strips.

Reads  <data>/<task>/<seed>/<robot>/
Writes a table to the terminal and, where asked, pictures: a sheet a task (start, middle and end of every robot) and a strip
       an episode (eight frames of the scene over eight of the robot alone); a grid of all tasks and robots; or a page
       on which the robots' videos run side by side, with overlays and predictions (`inspection/explorer.py`)

Command: python -m xew.sim_warp.inspect data [--verify] [--visibility] [--rerender 5] [--render] [--pictures sheets]
         [--grid grid.png] [--page explorer [--scenes open_laptop stack_bowls_two/0] [--rollouts rollouts/fixed]]
"""

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
from PIL import Image
from tqdm import tqdm

from xew.concurrency import usable_cores
from xew.config import admit, user_errors
from xew.dataset import explain_missing, read_dataset
from xew.episode import HEIGHT, WIDTH, EpisodeError, Record, encode_png, read_record, read_states, read_video, verify_episode
from xew.files import hold_lock, replacing, write_bytes, write_section
from xew.names import folder_name, path_below
from xew.sim_warp.devices.workers import Workers, find_devices, quiet_warp, worker_count
from xew.sim_warp.generate import yield_table
from xew.sim_warp.inspection.explorer import Page, choose_scenes, find_predictions, write_page
from xew.sim_warp.inspection.visibility import HEADING as VISIBILITY
from xew.sim_warp.inspection.visibility import visibility_section
from xew.sim_warp.production.rerender import add_videos, demand_plausible, render_again
from xew.sim_warp.production.surfaces import read_visibility
from xew.sim_warp.production.warm_up import compile_kernels
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.robots import ROBOTS

COMMAND = "python -m xew.sim_warp.inspect data --visibility --visibility-page docs/tasks.md"
"""Command that the page of the tasks names."""
EPISODES_PER_WORKER = 32
"""Number of episodes that are verified, or fewer rendered, in the time in which a process starts."""
STRIP_FRAMES = 8
SHEET_TIMES = (0.0, 0.5, 1.0)
"""Instants that a contact sheet shows, as shares of the episode."""
BLANK = np.full((HEIGHT // 2, WIDTH // 2, 3), 255, np.uint8)
GAP = 4
"""Width of the white between pictures [pixels]."""
AT_WORK = 0.6
"""Share of an episode after which the hands are at work."""
LABEL_WIDTH, LABEL_HEIGHT, TEXT_SCALE = 96, 24, 0.42
"""Size of the names in a grid or sheet [pixels], and the scale of their letters."""


@dataclass(frozen=True)
class Args:
    """What to look at."""

    data: Annotated[Path, tyro.conf.Positional]
    verify: bool = False
    """Read everything and compare with the recorded hashes, and the motions with what is plausible."""
    visibility: bool = False
    """Print in how many frames the camera sees enough points on the surfaces of each robot and of what moves. Points that
    `xew.metrics.evaluate` has kept beside the data are not rendered again."""
    visibility_page: Path | None = None
    """Markdown page whose section on this is written anew, such as docs/tasks.md; as with --visibility it is printed, too."""
    rerender: int = 0
    """Number of episodes to render again from their states and compare with the recorded hashes."""
    render: bool = False
    """Make the videos of episodes that were generated with --states-only, and store them."""
    pictures: Path | None = None
    """Folder for contact sheets and strips; none are drawn without it."""
    seeds: int = 2
    """Number of seeds of each task that are drawn."""
    grid: Path | None = None
    """PNG file for one picture of all tasks and robots at work: the first accepted seed of each task."""
    page: Path | None = None
    """Folder for an offline page that plays the robots' videos side by side; open its index.html."""
    scenes: tuple[str, ...] = ()
    """Scenes that the page shows, each TASK or TASK/SEED; all tasks without."""
    most: int = 6
    """Largest number of scenes on the page: the first seed of every task, then the second."""
    rollouts: tuple[Path, ...] = ()
    """Trees of predicted videos that the page shows beside the true ones; only scenes that have some are shown."""
    flow: bool = True
    """Render optical flow for the page, which takes some seconds an episode on a CPU."""
    trust: tuple[str, ...] = ()
    """Modules of your own tasks and robots, such as my_lab.tasks, that the data may name."""


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    admit(args.trust)
    cells, damaged = read_headers(args.data)
    print(yield_table([record for _, record in cells]))
    for folder, record in cells:
        if not record.success:
            print(f"{folder}: {record.failure}: {record.failure_detail}")
    pictured = [(folder, record) for folder, record in cells if record.hashes]
    if args.verify:
        damaged += verify([folder for folder, _ in pictured])
    if damaged:
        raise EpisodeError("\n".join([*damaged, f"{len(damaged)} damaged."]))
    visibility = args.visibility or args.visibility_page is not None
    if not pictured and (visibility or args.rerender or args.render or args.pictures or args.grid or args.page):
        raise EpisodeError(f"no seed under {args.data} is accepted, so there is nothing to render or draw.")
    if visibility:
        show_visibility([folder for folder, _ in pictured], args)
    if args.rerender:
        rerender([folder for folder, _ in pictured], args.rerender)
    if args.render:
        with hold_lock(args.data):
            render_videos([folder for folder, record in pictured if not record.videos])
    if args.pictures:
        with hold_lock(args.pictures):
            draw_pictures(pictured, args.pictures, args.seeds)
    if args.grid:
        with hold_lock(args.grid):
            draw_grid(pictured, args.grid)
    if args.page:
        make_page(pictured, args)


def show_visibility(folders: list[Path], args: Args) -> None:
    """Print how much of robots and of what moves is seen, and write it into the page that is named."""
    kept = args.data.absolute().with_name(f"{args.data.absolute().name}-surfaces")
    found = read_visibility(folders, kept if kept.is_dir() else None)
    if not found:
        raise EpisodeError(
            f"{args.data} has no episode whose shapes are known, so nothing can be counted: all are imported, or of tasks, "
            "scenes or robots that are not here."
        )
    text = visibility_section(found)
    print(text)
    if args.visibility_page:
        try:
            write_section(args.visibility_page, VISIBILITY, f"`{COMMAND}`. {text}")
        except OSError as error:
            raise EpisodeError(
                f"cannot write {args.visibility_page}: {error.strerror}. Choose another file with --visibility-page."
            ) from error


def make_page(cells: list[tuple[Path, Record]], args: Args) -> None:
    """Write the explorer's page of some scenes, and say where it is and what it leaves out."""
    assert args.page is not None
    if args.most < 1:
        raise EpisodeError(f"--most is {args.most}, expected at least 1 scene.")
    predictions = find_predictions(args.rollouts)
    scenes, left_out = choose_scenes(cells, args.scenes, args.most, predictions)
    write_page(Page(f"Episodes of {args.data.absolute().name}", scenes, left_out, predictions, args.flow), args.page)
    size = sum(file.stat().st_size for file in args.page.rglob("*") if file.is_file())
    told = f"; {left_out} left out (--scenes, --most)" if left_out else ""
    print(f"{args.page / 'index.html'}: {len(scenes)} scene{'s' * (len(scenes) != 1)}, {size / 1e6:.1f} MB{told}")


def read_headers(data: Path) -> tuple[list[tuple[Path, Record]], list[str]]:
    """All cells whose headers can be read, and what is wrong with the others. Raises EpisodeError if there is no cell."""
    damaged: list[str] = []
    cells = list(read_dataset(data, damaged).cells)
    if not cells and not damaged:
        raise explain_missing(data)
    return cells, damaged


def verify(folders: list[Path]) -> list[str]:
    """Compare all files with their hashes, and motions with what is plausible; returns what is wrong with which episode."""
    with Workers(min(usable_cores(), len(folders) // EPISODES_PER_WORKER)) as workers:
        found = workers.run(find_problem, folders) if len(folders) >= 2 * EPISODES_PER_WORKER else map(find_problem, folders)
        bar = tqdm(found, desc="verifying", unit="episode", total=len(folders))
        damaged = sorted(problem for problem in bar if problem)
    print(f"{len(folders) - len(damaged)} of {len(folders)} episodes agree with their hashes and are plausible")
    return damaged


def find_problem(folder: Path) -> str:
    """What is wrong with an episode; an empty text where nothing is."""
    try:
        if not verify_episode(folder).source:
            demand_plausible(folder)
    except EpisodeError as error:
        return str(error)
    return ""


def rerender(folders: list[Path], count: int) -> None:
    """Render some episodes again, spread over the data set."""
    renderer = Renderer()
    sample = [folders[index] for index in np.unique(np.linspace(0, len(folders) - 1, max(1, count)).astype(int))]
    for folder in tqdm(sample, desc="rendering again", unit="episode"):
        render_again(folder, renderer)
    print(f"{len(sample)} episodes rendered again from their states agree with their hashes")


def render_videos(folders: list[Path]) -> None:
    """Make and store the videos of episodes that have none."""
    devices = find_devices(None)
    several = len(folders) >= 2 * EPISODES_PER_WORKER
    with Workers(worker_count(devices), devices) as workers:
        if several:
            compile_kernels(workers, devices[0], 1, ("rendering",))
        made = workers.run(_render_video, folders) if several else map(_render_video, folders)
        for _ in tqdm(made, desc="rendering", unit="episode", total=len(folders)):
            pass
    print(f"videos of {len(folders)} episodes made from their states")


@cache
def _renderer() -> Renderer:
    """The renderer of this process on its own device, made once."""
    return Renderer()


def _render_video(folder: Path) -> None:
    """Make and store the videos of one episode, in a worker process or here."""
    add_videos(folder, _renderer())


def draw_pictures(cells: list[tuple[Path, Record]], out: Path, seeds: int) -> None:
    """Draw sheets and strips of the first seeds of each task, as PNG."""
    by_task = seeds_by_task(cells)
    _make_folder(out, "--pictures")
    for task, of_task in tqdm(by_task.items(), desc="drawing", unit="task"):
        for seed in sorted(of_task)[:seeds]:
            save_png(path_below(out, f"{folder_name(task)}_{seed}.png"), contact_sheet(of_task[seed]))
            for folder, record in of_task[seed]:
                save_png(path_below(out, f"{folder_name(task)}_{seed}_{folder_name(record.robot)}.png"), strip(folder))


def seeds_by_task(cells: list[tuple[Path, Record]]) -> dict[str, dict[int, list[tuple[Path, Record]]]]:
    """Cells in order, by task and seed."""
    by_task: dict[str, dict[int, list[tuple[Path, Record]]]] = defaultdict(lambda: defaultdict(list))
    for folder, record in cells:
        by_task[record.task][record.seed].append((folder, record))
    return by_task


def _make_folder(folder: Path, option: str) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EpisodeError(f"cannot write to {folder}: {error.strerror}. Choose another folder with {option}.") from error


def draw_grid(cells: list[tuple[Path, Record]], path: Path) -> None:
    """Write `grid` of the first seed of each task as a PNG; 25 tasks and five robots take 1.1 MB."""
    _make_folder(path.parent, "--grid")
    picture = grid([of_task[min(of_task)] for of_task in seeds_by_task(cells).values()])
    try:
        with replacing(path) as temporary:
            Image.fromarray(picture).save(temporary, format="PNG", optimize=True)
    except OSError as error:
        raise EpisodeError(f"cannot write {path}: {error.strerror}. Choose another file with --grid.") from error
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def grid(seeds: list[list[tuple[Path, Record]]]) -> np.ndarray:
    """One seed of every task, a column each under its name, and a robot a row, at half size: [h w 3] uint8.

    In a column all robots are shown at the same instant, see `busy_instants`. Columns stand in bands of equal length, one
    under the other, about as many as make the picture as wide as high.
    """
    present = {record.robot for cells in seeds for _, record in cells}
    robots = [robot for robot in ROBOTS if robot in present] + sorted(present - set(ROBOTS))
    columns = [_column(cells, robots) for cells in seeds]
    bands = math.ceil(len(columns) ** 0.5 / 2)
    length = -(-len(columns) // bands)
    names = np.concatenate([_label("", LABEL_WIDTH), *(_label(robot, LABEL_WIDTH, HEIGHT // 2 + GAP) for robot in robots)])
    blank = np.full_like(columns[0], 255)
    drawn = []
    for first in range(0, len(columns), length):
        band = columns[first : first + length]
        drawn.append(np.concatenate([names, *band, *[blank] * (length - len(band))], 1))
    return np.concatenate(drawn)


def _column(cells: list[tuple[Path, Record]], robots: list[str]) -> np.ndarray:
    """A task's name over one picture a robot: [h w 3] uint8."""
    folders = {record.robot: folder for folder, record in cells}
    instants = dict(zip(folders, busy_instants([read_states(folder).contact for folder in folders.values()]), strict=True))
    images = [
        _halve(read_video(folders[robot] / "rgb.mkv")[instants[robot]]) if robot in folders else BLANK for robot in robots
    ]
    name = cells[0][1].task.rsplit(":", 1)[-1]
    return np.concatenate([_label(name, WIDTH // 2 + GAP), tile([[image] for image in images])])


def busy_instants(contacts: list[np.ndarray]) -> list[int]:
    """For every robot the frame nearest to 60 % of the episodes at which all of them touch something, or that at 60 %.

    It is one frame for all, but for episodes of different lengths, as imported ones are: those share no clock.

    Args:
        contacts: [t 2 o] bool of every robot, whether its left, right fingers touch each object.
    """
    if len({len(contact) for contact in contacts}) > 1:
        return [instant for contact in contacts for instant in busy_instants([contact])]
    wanted = round(AT_WORK * (len(contacts[0]) - 1))
    touching = np.flatnonzero(np.logical_and.reduce([contact.any((1, 2)) for contact in contacts]))
    return [int(touching[np.abs(touching - wanted).argmin()]) if touching.size else wanted] * len(contacts)


def _label(text: str, width: int, height: int = LABEL_HEIGHT) -> np.ndarray:
    """Text on white [h w 3] uint8, smaller where it would not fit."""
    image = np.full((height, width, 3), 255, np.uint8)
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)
    scale = min(TEXT_SCALE, (width - 8) / max(1, wide))
    place = round((width - GAP - scale * wide) / 2), round((height - GAP + scale * high) / 2)
    return cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (40, 40, 40), 1, cv2.LINE_AA)


def _halve(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)


def contact_sheet(cells: list[tuple[Path, Record]]) -> np.ndarray:
    """A seed's robots one under the other by name, each at its start, middle and end, under the instruction: [h w 3] uint8."""
    rows = []
    for folder, _ in cells:
        video = read_video(folder / "rgb.mkv")
        rows.append([video[round(time * (len(video) - 1))] for time in SHEET_TIMES])
    names = np.concatenate([_label(record.robot, LABEL_WIDTH, HEIGHT + GAP) for _, record in cells])
    pictures = np.concatenate([names, tile(rows)], 1)
    record = cells[0][1]
    title = f"{record.task}, seed {record.seed}: {record.instruction}"
    return np.concatenate([_label(title, pictures.shape[1]), pictures])


def strip(folder: Path) -> np.ndarray:
    """Eight evenly spaced frames of an episode, with keypoints, over the robot alone: [h w 3] uint8."""
    rgb, states = read_video(folder / "rgb.mkv"), read_states(folder)
    is_known = "robot" in read_record(folder).hashes  # an imported episode may be without
    robot = read_video(folder / "robot.mkv") if is_known else np.full_like(rgb, 255)
    frames = np.linspace(0, len(rgb) - 1, STRIP_FRAMES).round().astype(int)
    marked = [_mark_robot(rgb[t], states.keypoints[t][states.keypoint_visible[t]], states.robot_mask[t]) for t in frames]
    return tile([marked, [robot[t] for t in frames]])


def _mark_robot(image: np.ndarray, keypoints: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image [h w 3] with the outline of the robot's mask [h w] and its visible keypoints [k 2] pixels."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    image = cv2.drawContours(image.copy(), outlines, -1, (255, 120, 0), 1)
    for x, y in keypoints:
        cv2.circle(image, (round(float(x)), round(float(y))), 2, (0, 160, 255), -1, cv2.LINE_AA)
    return image


def tile(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Rows of equal pictures [h w 3] uint8 as one, white between them."""
    padded = [[np.pad(image, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for image in row] for row in rows]
    return np.concatenate([np.concatenate(row, 1) for row in padded])


def save_png(path: Path, image: np.ndarray) -> None:
    """Write an image [h w 3] uint8 RGB. Raises EpisodeError where it cannot be written."""
    try:
        write_bytes(path, encode_png(image))
    except OSError as error:
        raise EpisodeError(f"cannot write {path}: {error.strerror}. Choose another folder with --pictures.") from error


if __name__ == "__main__":
    main()
