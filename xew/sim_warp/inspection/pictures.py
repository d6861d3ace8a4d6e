"""Pictures of a data set: contact sheets and strips of its first seeds, and a grid of all tasks and robots."""

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from tqdm import tqdm

from xew.dataset import view_episode
from xew.episode import HEIGHT, WIDTH, EpisodeError, Record, read_pixels, read_record, read_states
from xew.files import replacing, write_bytes
from xew.names import folder_name, path_below
from xew.protocol import HEAD
from xew.sim_warp.robots import ROBOTS

STRIP_FRAMES = 8
SHEET_TIMES = (0.0, 0.5, 1.0)
"""Instants of a contact sheet, as shares of the episode."""
BLANK = np.full((HEIGHT // 2, WIDTH // 2, 3), 255, np.uint8)
GAP = 4
"""Width of the white between pictures [pixels]."""
AT_WORK = 0.6
"""Share of an episode at which the hands are usually at work."""
LABEL_WIDTH, LABEL_HEIGHT, TEXT_SCALE = 96, 24, 0.42
"""Size of the labels in a grid or sheet [pixels], and the scale of their letters."""


def draw_pictures(cells: list[tuple[Path, Record]], out: Path, seeds: int, views: Sequence[str] = (HEAD,)) -> None:
    """Draw sheets, with these views side by side, and strips of the first seeds of each task, as PNG."""
    by_task = seeds_by_task(cells)
    _make_folder(out, "--pictures")
    for task, of_task in tqdm(by_task.items(), desc="drawing", unit="task"):
        for seed in sorted(of_task)[:seeds]:
            save_png(path_below(out, f"{folder_name(task)}_{seed}.png"), contact_sheet(of_task[seed], views))
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
    """Write `grid` of the first seed of each task as a PNG."""
    _make_folder(path.parent, "--grid")
    picture = grid([of_task[min(of_task)] for of_task in seeds_by_task(cells).values()])
    try:
        with replacing(path, within=path.parent) as temporary:
            Image.fromarray(picture).save(temporary, format="PNG", optimize=True)
    except OSError as error:
        raise EpisodeError(f"cannot write {path}: {error.strerror}. Choose another file with --grid.") from error
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def grid(seeds: list[list[tuple[Path, Record]]]) -> np.ndarray:
    """One seed per task as columns, robots as rows, at half size: [h w 3] uint8.

    A column shows all robots at the same instant, see `busy_instants`. Columns are arranged in bands of equal length for an
    about square picture.
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
    """A task's name over one picture per robot: [h w 3] uint8."""
    folders = {record.robot: folder for folder, record in cells}
    instants = dict(zip(folders, busy_instants([read_states(folder).contact for folder in folders.values()]), strict=True))
    images = [_small(folders[robot], instants[robot]) if robot in folders else BLANK for robot in robots]
    name = cells[0][1].task.rsplit(":", 1)[-1]
    return np.concatenate([_label(name, WIDTH // 2 + GAP), tile([[image] for image in images])])


def _small(folder: Path, instant: int) -> np.ndarray:
    """A frame of an episode at half the head camera's size."""
    return fit_picture(read_pixels(folder, "rgb")[instant], HEIGHT // 2, WIDTH // 2)


def busy_instants(contacts: list[np.ndarray]) -> list[int]:
    """For every robot, the frame nearest to 60 % of the episode at which all robots touch something, or the frame at 60 %.

    It is the same frame for all robots if their episodes have the same length; otherwise each robot has its own.

    Args:
        contacts: [t 2 o] bool of every robot, whether its left, right fingers touch each object.
    """
    if len({len(contact) for contact in contacts}) > 1:
        return [instant for contact in contacts for instant in busy_instants([contact])]
    wanted = round(AT_WORK * (len(contacts[0]) - 1))
    touching = np.flatnonzero(np.logical_and.reduce([contact.any((1, 2)) for contact in contacts]))
    return [int(touching[np.abs(touching - wanted).argmin()]) if touching.size else wanted] * len(contacts)


def _label(text: str, width: int, height: int = LABEL_HEIGHT) -> np.ndarray:
    """Text on white [h w 3] uint8, shrunk to fit."""
    image = np.full((height, width, 3), 255, np.uint8)
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)
    scale = min(TEXT_SCALE, (width - 8) / max(1, wide))
    place = round((width - GAP - scale * wide) / 2), round((height - GAP + scale * high) / 2)
    return cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (40, 40, 40), 1, cv2.LINE_AA)


def fit_picture(image: np.ndarray, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """An image [h w 3] brought to a size with its aspect ratio, and white at the right or below."""
    scale = min(height / image.shape[0], width / image.shape[1])
    inner = round(image.shape[1] * scale), round(image.shape[0] * scale)
    resized = cv2.resize(image, inner, interpolation=cv2.INTER_AREA)
    return np.pad(resized, ((0, height - inner[1]), (0, width - inner[0]), (0, 0)), constant_values=255)


def contact_sheet(cells: list[tuple[Path, Record]], views: Sequence[str] = (HEAD,)) -> np.ndarray:
    """The instruction over one row per robot: its start, middle and end in each view: [h w 3] uint8."""
    rows = []
    for folder, _ in cells:
        videos = [read_pixels(view_episode(folder, view), "rgb") for view in views]
        rows.append([fit_picture(video[round(time * (len(video) - 1))]) for video in videos for time in SHEET_TIMES])
    names = np.concatenate([_label(record.robot, LABEL_WIDTH, HEIGHT + GAP) for _, record in cells])
    pictures = np.concatenate([names, tile(rows)], 1)
    record = cells[0][1]
    title = f"{record.task}, seed {record.seed}: {describe([record for _, record in cells])}"
    return np.concatenate([_label(title, pictures.shape[1]), pictures])


def describe(records: Sequence[Record]) -> str:
    """The instruction of a scene, and of faulty commands the fault and the number of robots that succeed."""
    first, solved = records[0], sum(record.success for record in records)
    return f"{first.instruction} ({first.fault}: {solved} of {len(records)} succeed)" if first.fault else first.instruction


def strip(folder: Path) -> np.ndarray:
    """Eight evenly spaced frames of an episode, with keypoints, over the robot alone: [h w 3] uint8."""
    rgb, states = read_pixels(folder, "rgb"), read_states(folder)
    is_known = "robot" in read_record(folder).hashes  # imported episodes may have none
    robot = read_pixels(folder, "robot") if is_known else np.full_like(rgb, 255)
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
    """Rows of equal pictures [h w 3] uint8 as one picture with white gaps."""
    padded = [[np.pad(image, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for image in row] for row in rows]
    return np.concatenate([np.concatenate(row, 1) for row in padded])


def encode_png(image: np.ndarray) -> bytes:
    """The PNG file of an RGB image [h w 3] uint8."""
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def save_png(path: Path, image: np.ndarray) -> None:
    """Write an image [h w 3] uint8 RGB. Raises EpisodeError if it cannot be written."""
    try:
        write_bytes(path, encode_png(image), within=path.parent)
    except OSError as error:
        raise EpisodeError(f"cannot write {path}: {error.strerror}. Choose another folder with --pictures.") from error
