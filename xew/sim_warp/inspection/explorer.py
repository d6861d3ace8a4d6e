"""The explorer's page: chooses scenes, makes a film and a script of each, and writes the page that plays them.

Writes <out>/index.html, and for every scene scenes/<number>_<task>_<seed>.js (overlays) and .mp4 (all robots' videos; one
more for every model with rollouts). The page works without a server; it loads a scene's script when the scene is selected.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from tqdm import tqdm

import xew
from xew.dataset import Episode, demand_one_rate, view_episode
from xew.episode import EpisodeError, States, data_folder, read_pixels, read_states
from xew.files import hold_lock, read_text, write_text
from xew.protocol import HEAD
from xew.rollout import Rollout, find_rollouts, read_as_graded
from xew.sim_warp.inspection.films import Row, difference_video, tile_frames, tile_size, write_film
from xew.sim_warp.inspection.overlays import frame_psnr, overlay_data
from xew.sim_warp.inspection.pictures import describe, fit_picture
from xew.sim_warp.robots import ROBOTS, recorded_robot

__all__ = ["Page", "Predictions", "Scene", "choose_scenes", "find_predictions", "write_page"]

MOST_ROBOTS = 10
"""Largest number of robots of a scene; browsers do not play larger films."""
MARK = '<meta name="generator" content="xew explorer">'
"""Line that identifies an explorer's page; no other page is replaced."""
NO_FILE_NAME = re.compile(r"[^A-Za-z0-9_.-]")

TEMPLATES = Environment(
    loader=PackageLoader("xew.sim_warp.inspection"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)

Predictions = Mapping[str, Mapping[tuple[str, int, str], Rollout]]
"""Rollouts by model with condition, and by task, seed and robot."""


@dataclass(frozen=True)
class Scene:
    """The episodes of one task and seed."""

    task: str
    seed: int
    cells: tuple[Episode, ...]
    """Shown episodes, in the order of ROBOTS, then others."""
    left_out: int
    """Number of robots that are not shown."""


@dataclass(frozen=True)
class Page:
    """Content of a page."""

    title: str
    scenes: Sequence[Scene]
    left_out: int
    """Number of scenes of the data set that are not shown."""
    predictions: Predictions
    flow: bool = True
    """Whether optical flow is rendered from the commands."""
    given: bool = True
    """Whether rollouts hold the given frame 0; otherwise they begin with frame 1."""
    views: Sequence[str] = (HEAD,)
    """Views besides `head` whose videos are shown below the head camera's."""


def find_predictions(roots: Iterable[Path]) -> Predictions:
    """Rollouts of all trees. Raises EpisodeError if a model has two of one episode, RolloutError as `find_rollouts`."""
    predictions: dict[str, dict[tuple[str, int, str], Rollout]] = {}
    for rollout in (rollout for root in roots for rollout in find_rollouts(root)):
        of_model = predictions.setdefault(" · ".join(filter(None, (rollout.model, rollout.condition))), {})
        other = of_model.setdefault((rollout.task, rollout.seed, rollout.robot), rollout)
        if other is not rollout:
            raise EpisodeError(
                f"{other.folder} and {rollout.folder} are both of the model {rollout.model!r}, expected one rollout per "
                "episode; remove one of the trees from --rollouts."
            )
    return predictions


def choose_scenes(
    cells: Iterable[Episode], wanted: Sequence[str], most: int, predictions: Predictions
) -> tuple[list[Scene], int]:
    """Scenes to show, and the number of other scenes.

    Args:
        cells: episodes with videos.
        wanted: TASK or TASK/SEED; empty for all scenes.
        most: largest number of scenes, the first seed of every task before the second.
        predictions: if not empty, only scenes with a prediction are shown.

    Raises:
        EpisodeError: a name in `wanted` is in no episode, or there is no scene to show.
    """
    scenes: dict[tuple[str, int], list[Episode]] = {}
    for folder, record in cells:
        scenes.setdefault((record.task, record.seed), []).append((folder, record))
    known = {name for task, seed in scenes for name in (task, f"{task}/{seed}")}
    names = [_plain_seed(name) for name in wanted]
    if missing := [name for name in names if name not in known]:
        raise EpisodeError(
            f"no scene {', '.join(missing)} among those with videos, expected TASK or TASK/SEED, of the tasks "
            f"{', '.join(sorted({task for task, _ in scenes}))}; correct --scenes."
        )
    predicted = {key[:2] for of_model in predictions.values() for key in of_model}
    fit = [
        (task, seed)
        for task, seed in scenes
        if (not names or task in names or f"{task}/{seed}" in names) and (not predictions or (task, seed) in predicted)
    ]
    if not fit:
        raise EpisodeError("none of the scenes with videos has a rollout; pass the data set of --rollouts.")
    seeds: dict[str, list[int]] = {}
    for task, seed in sorted(fit):
        seeds.setdefault(task, []).append(seed)
    in_turn = sorted(fit, key=lambda key: (seeds[key[0]].index(key[1]), key[0]))
    chosen = sorted(in_turn[:most])
    return [_scene(*key, scenes[key]) for key in chosen], len(scenes) - len(chosen)


def _plain_seed(name: str) -> str:
    """TASK/SEED with the seed as a plain number: folders are named 0800000."""
    task, slash, seed = name.rpartition("/")
    return f"{task}/{int(seed)}" if slash and seed.isdecimal() else name


def _scene(task: str, seed: int, cells: Sequence[Episode]) -> Scene:
    order = {name: place for place, name in enumerate(ROBOTS)}
    ordered = sorted(cells, key=lambda cell: (order.get(cell[1].robot, len(order)), cell[1].robot))
    return Scene(task, seed, tuple(ordered[:MOST_ROBOTS]), max(0, len(ordered) - MOST_ROBOTS))


def write_page(page: Page, out: Path) -> None:
    """Write a page and its films into a folder, index.html last.

    Raises:
        EpisodeError: the folder has another page or cannot be written.
    """
    index = out / "index.html"
    try:
        if index.exists() and MARK not in read_text(index):
            raise EpisodeError(f"{index} is not a page of the explorer; choose another folder with --page.")
        with hold_lock(out):
            bar = tqdm(page.scenes, desc="filming", unit="scene", disable=None)
            entries = [_write_scene(number, scene, page, out) for number, scene in enumerate(bar)]
            template = TEMPLATES.get_template("explorer.html")
            version = f"xew {xew.__version__}"
            html = template.render(page=page, index={"scenes": entries}, mark=MARK, version=version)
            write_text(index, html, within=out)
    except (OSError, UnicodeDecodeError) as error:
        raise EpisodeError(f"cannot write the page to {out}: {error}. Choose another folder with --page.") from error


def _write_scene(number: int, scene: Scene, page: Page, out: Path) -> dict[str, Any]:
    """Write the script and the films of a scene; returns its entry in the page's index."""
    stem = f"scenes/{number:03d}_{NO_FILE_NAME.sub('-', scene.task)}_{scene.seed}"
    truths = [read_pixels(folder, "rgb") for folder, _ in scene.cells]
    states = [read_states(folder) for folder, _ in scene.cells]
    for (folder, _), truth, of_cell in zip(scene.cells, truths, states, strict=True):
        if len(truth) != of_cell.frame_count:
            raise EpisodeError(
                f"{folder} has {len(truth)} frames in rgb.mkv and {of_cell.frame_count} in states.npz, expected as many in "
                "both; delete it and run generate again."
            )
    rate = float(demand_one_rate(data_folder(scene.cells[0][0]), (record for _, record in scene.cells)))
    rows: dict[str, Row] = {"video": truths}
    if page.flow:
        rows["flow"] = [_flow(cell, of_cell) for cell, of_cell in zip(scene.cells, states, strict=True)]
    for view in (view for view in page.views if view != HEAD):
        rows[view] = [_fit(read_pixels(view_episode(folder, view), "rgb"), truths[0]) for folder, _ in scene.cells]
    content = {
        "frames": max(map(len, truths)),
        "rate": rate,
        "films": _write_films(stem, scene, page, rows, out),
        "robots": [
            {
                "title": ROBOTS[record.robot].title if record.robot in ROBOTS else record.robot,
                "size": [truth.shape[2], truth.shape[1]],
                "frames": len(truth),
                "things": record.object_names,
                **overlay_data(record, of_cell),
            }
            for (_, record), truth, of_cell in zip(scene.cells, truths, states, strict=True)
        ],
    }
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    write_text(out / f"{stem}.js", f"explorerScene({number}, {text});\n", within=out)
    return {
        "task": scene.task,
        "seed": scene.seed,
        "instruction": describe([record for _, record in scene.cells]),
        "script": f"{stem}.js",
        "left_out": scene.left_out,
    }


def _write_films(stem: str, scene: Scene, page: Page, rows: dict[str, Row], out: Path) -> list[dict[str, Any]]:
    """Write a film of a scene for every model with predictions, or one without; returns their entries for the page."""
    truths = [truth for truth in rows["video"] if truth is not None]
    films = []
    for place, (label, rollouts) in enumerate(_models(scene, page.predictions)):
        predicted = [
            None if rollout is None else read_as_graded(rollout, truth, page.given)
            for rollout, truth in zip(rollouts, truths, strict=True)
        ]
        pairs = list(zip(predicted, truths, strict=True))
        shown = dict(rows)
        if label:
            shown["prediction"] = predicted
            shown["difference"] = [None if video is None else difference_video(video, truth) for video, truth in pairs]
        tiles = list(shown.values())
        name = f"{stem}_{place}.mp4"
        frames = tile_frames(tiles, max(map(len, truths)))
        write_film(out / name, frames, scene.cells[0][1].frame_rate, within=out)
        height, width = tile_size(tiles)
        errors = [None if video is None else frame_psnr(video, truth) for video, truth in pairs]
        films.append({"label": label, "file": name, "rows": list(shown), "tile": [width, height], "psnr": errors})
    return films


def _fit(video: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A video [t h w 3] that fits into the size of another one."""
    return np.stack([fit_picture(frame, *other.shape[1:3]) for frame in video])


def _flow(cell: Episode, states: States) -> np.ndarray:
    """The commanded robot's optical flow as a color wheel on white: [t h w 3] uint8."""
    from xew.sim_warp.cameras import commanded_camera  # here: a page without flow needs no Warp
    from xew.sim_warp.rendering.streams import command_streams, flow_to_rgb

    folder, record = cell
    robot = recorded_robot(record.robot, data_folder(folder))
    camera = commanded_camera(record.camera, robot, states)
    return flow_to_rgb(command_streams(robot, states.action, camera, record.table).optical_flow)


def _models(scene: Scene, predictions: Predictions) -> list[tuple[str, list[Rollout | None]]]:
    """Models with predictions of a scene, each with a rollout or None per robot; one empty label if there are none."""
    models = []
    for label, rollouts in predictions.items():
        of_scene = [rollouts.get((scene.task, scene.seed, record.robot)) for _, record in scene.cells]
        if any(of_scene):
            models.append((label, of_scene))
    return models or [("", [None] * len(scene.cells))]
