"""Inspect a data set: yields, hashes, contact sheets, strips and an offline page.

Reads  <data>/<task>/<seed>/<robot>/
Writes a table to the terminal and, with options, pictures: a sheet per seed (start, middle and end of every robot) and a strip
       per episode (eight frames of the scene over eight of the robot alone); a grid of all tasks and robots; or a page
       with the robots' synchronized videos, overlays and predictions (`inspection/explorer.py`)

Command: python -m xew.sim_warp.inspect data [--verify] [--visibility] [--rerender 5] [--pictures sheets]
         [--render [--cameras head wrist_left --size 640x480] [--change light:2 --out NEW]]
         [--grid grid.png] [--page explorer [--scenes open_laptop stack_bowls_two/0] [--rollouts rollouts/fixed]]
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from xew.config import admit, user_errors
from xew.dataset import base_data, explain_missing, folder_beside, list_views, read_dataset, view_folder
from xew.episode import EpisodeError, Record, read_record
from xew.files import hold_lock
from xew.names import plain_line
from xew.protocol import HEAD, seed_split
from xew.sim_warp.cameras import get_views
from xew.sim_warp.devices.workers import quiet_warp
from xew.sim_warp.inspection.checks import render_changes, render_videos, render_views, rerender, tile_views, verify
from xew.sim_warp.inspection.explorer import Page, choose_scenes, find_predictions, write_page
from xew.sim_warp.inspection.pictures import draw_grid, draw_pictures
from xew.sim_warp.inspection.visibility import visibility_section
from xew.sim_warp.production.summary import yield_table
from xew.sim_warp.production.surfaces import read_visibility


@dataclass(frozen=True)
class Args:
    """What to inspect."""

    data: Annotated[Path, tyro.conf.Positional]
    verify: bool = False
    """Compare all files with the recorded hashes, and check motions for plausibility."""
    visibility: bool = False
    """Print in how many frames the camera sees enough surface points of each robot and each moving object. Points that
    `xew.metrics.evaluate` has stored for the data set are not rendered again."""
    faults: bool = False
    """With --visibility: also count the episodes of faulty commands, most of which are no demonstrations of success."""
    rerender: int = 0
    """Number of episodes to render again from their states and compare with the recorded hashes."""
    render: bool = False
    """Make and store the videos of episodes that were generated with --states-only, and the views of --cameras."""
    change: str = ""
    """With --render and --out: write the data set with this change, such as light:2, from its states without physics."""
    out: Path | None = None
    """Folder of the changed data set."""
    split: str | None = None
    """Family of seeds of the changed data set: train, validation, test or final; default: all."""
    cameras: tuple[str, ...] = ()
    """Cameras whose views --render adds: head, wrist_left, wrist_right, front, side, or YAML files (docs/cameras.md)."""
    size: str | None = None
    """Size of these views, such as 640x480; default: the camera's."""
    tile: tuple[str, ...] = ()
    """Views that --render tiles into one picture, from top to bottom, as the view head+wrist_left."""
    views: tuple[str, ...] = (HEAD,)
    """Views on --pictures and --page, side by side. A view is a data set too: inspect DATA/views/wrist_left."""
    pictures: Path | None = None
    """Folder for contact sheets and strips."""
    seeds: int = 2
    """Number of seeds per task for --pictures."""
    grid: Path | None = None
    """PNG file for one picture of all tasks and robots: the first accepted seed of each task."""
    page: Path | None = None
    """Folder for an offline page that plays the robots' videos side by side; open its index.html."""
    scenes: tuple[str, ...] = ()
    """Scenes on the page, each TASK or TASK/SEED; default: all tasks."""
    most: int = 6
    """Largest number of scenes on the page: the first seed of every task, then the second."""
    rollouts: tuple[Path, ...] = ()
    """Trees of predicted videos for the page, which then shows only scenes with predictions."""
    flow: bool = True
    """Render optical flow for the page; takes some seconds per episode on a CPU."""
    trust: tuple[str, ...] = ()
    """Modules of custom tasks and robots, such as my_lab.tasks, that the data may name."""


@user_errors
def main() -> None:
    quiet_warp()
    args = tyro.cli(Args, description=__doc__)
    admit(args.trust)
    check_change_options(args)
    cells, damaged = read_headers(args.data)
    print(yield_table([record for _, record in cells]))
    for folder, record in cells:
        if not record.is_kept:
            print(plain_line(f"{folder}: {record.failure}: {record.failure_detail}"))
    pictured = [(folder, record) for folder, record in cells if record.hashes]
    stored = [folder for folder, _ in pictured] + list_stored_views(args.data, damaged)
    if args.verify:
        damaged += verify(stored)
    if damaged:
        raise EpisodeError(f"{len(damaged)} damaged:", *damaged)  # the number first: of a long list the end is cut off
    if not pictured and (args.visibility or args.rerender or args.render or args.pictures or args.grid or args.page):
        raise EpisodeError(f"no seed under {args.data} is accepted; expected at least one to render or draw.")
    if args.visibility:
        show_visibility(pictured, args)
    if args.rerender:
        rerender([folder for folder in stored if not read_record(folder).camera.parts], args.rerender)
    if args.render or args.cameras or args.tile:
        render(pictured, args)
    if args.pictures:
        with hold_lock(args.pictures):
            draw_pictures(pictured, args.pictures, args.seeds, args.views)
    if args.grid:
        with hold_lock(args.grid):
            draw_grid(pictured, args.grid)
    if args.page:
        make_page(pictured, args)


def check_change_options(args: Args) -> None:
    """Raise EpisodeError if only some of --render, --change and --out are given."""
    if (args.change or args.out) and not (args.render and args.change and args.out):
        raise EpisodeError("--change needs --render and --out, such as --render --change light:2 --out data_light_2.")


def list_stored_views(data: Path, damaged: list[str]) -> list[Path]:
    """Episodes of all views besides `head`; messages of unreadable ones are added to `damaged`."""
    roots = [view_folder(data, view) for view in list_views(data)]
    return [folder for root in roots for folder, _ in read_dataset(root, damaged).cells]


def render(cells: list[tuple[Path, Record]], args: Args) -> None:
    """Make missing videos and the views of --cameras; with --change of another data set, which is made first."""
    if not args.render:
        raise EpisodeError(f"{' '.join(args.cameras or args.tile)}: views are made by --render; add it.")
    if (base := base_data(args.data)) != args.data:
        raise EpisodeError(f"{args.data} is a view; add views to its data set: {base}.")
    if len(args.tile) == 1:
        raise EpisodeError(f"--tile {args.tile[0]} is one view, expected at least two.")
    views = get_views(args.cameras, args.size)
    with hold_lock(args.out or args.data):
        if args.out:
            asked = [folder for folder, record in cells if args.split in (None, seed_split(record.seed))]
            if not asked:
                raise EpisodeError(f"{args.data} has no accepted episode of the family {args.split}; choose another --split.")
            render_changes(asked, args.change, args.out)
            cells = list(read_dataset(args.out).accepted)
        render_videos([folder for folder, record in cells if not record.videos])
        render_views(cells, views)
        if args.tile:
            tile_views(cells, args.tile)


def show_visibility(cells: list[tuple[Path, Record]], args: Args) -> None:
    """Print the visibility of robots and moving objects; in faulty episodes only with --faults."""
    folders = [folder for folder, record in cells if args.faults or not record.fault]
    store = folder_beside(args.data.absolute(), "surfaces")
    visibility = read_visibility(folders, store if store.is_dir() else None)
    if not visibility:
        raise EpisodeError(
            f"{args.data} has no episode with known shapes: all are imported, faulty (see --faults), or of tasks, scenes or "
            "robots that this xew does not have."
        )
    if left_out := len(cells) - len(folders):
        print(f"omitted: {left_out} episodes of faulty commands, which --faults counts too")
    print(visibility_section(visibility))


def make_page(cells: list[tuple[Path, Record]], args: Args) -> None:
    """Write the explorer's page of some scenes, and print its path."""
    assert args.page is not None
    if args.most < 1:
        raise EpisodeError(f"--most is {args.most}, expected at least 1 scene.")
    predictions = find_predictions(args.rollouts)
    scenes, left_out = choose_scenes(cells, args.scenes, args.most, predictions)
    title = f"Episodes of {args.data.absolute().name}"
    write_page(Page(title, scenes, left_out, predictions, args.flow, views=args.views), args.page)
    size = sum(file.stat().st_size for file in args.page.rglob("*") if file.is_file())
    omitted = f"; {left_out} omitted (--scenes, --most)" if left_out else ""
    print(f"{args.page / 'index.html'}: {len(scenes)} scene{'s' * (len(scenes) != 1)}, {size / 1e6:.1f} MB{omitted}")


def read_headers(data: Path) -> tuple[list[tuple[Path, Record]], list[str]]:
    """All cells with readable headers, and an error message for each other. Raises EpisodeError if there is no cell."""
    damaged: list[str] = []
    cells = list(read_dataset(data, damaged).cells)
    if not cells and not damaged:
        raise explain_missing(data)
    return cells, damaged


if __name__ == "__main__":
    main()
