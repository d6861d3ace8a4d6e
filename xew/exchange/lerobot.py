"""Export accepted episodes as a LeRobotDataset (codebase v3.0).

Reads  DATA: a data set
Writes DIR: meta/ (info, tasks, episodes, statistics), data/ (parquet, many episodes per file), videos/ (H.264 in mp4, one each)

    action, observation.state     the canonical 16 numbers, commanded and measured
    observation.tool_pose         14 numbers: left and right tool, x y z [m] and quaternion x y z w, world
    observation.images.head       the head camera; observation.images.robot with --robot-video: the robot alone by its commands
    observation.images.cam_…      with --views, one video a camera by RoboTwin's names (CAMERA_NAMES)
    next.done, next.success       true at the last frame; next.success only if the task is solved
The table of episodes has each episode's robot, task, seed and kind of motion (columns xew/…), in changed scenes xew/change, and
with --faults xew/fault.
A feature that an imported episode lacks is omitted for the whole set. `fps` is the episodes' frame rate, 50 / 3 in simulated
data; a set has one rate. Video is lossy; all other data are exact.

Command: python -m xew.exchange.lerobot DATA --out DIR [--views head wrist_left wrist_right --robots … --tasks …
    --split train --robot-video --faults]
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as parquet
import tyro
from tqdm import tqdm

from xew.config import user_errors
from xew.dataset import demand_one_rate, read_dataset, view_episode
from xew.episode import EpisodeError, Record, States, complete_folder, data_folder, read_pixels, read_states
from xew.files import hold_lock
from xew.protocol import HEAD, expand_robots

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
LARGEST_DATA, LARGEST_VIDEO = 100, 200
"""Sizes at which LeRobot's tools begin the next file [MB]; here a video file has one episode."""
CAMERA_NAMES = {"head": "cam_head", "wrist_left": "cam_left_wrist", "wrist_right": "cam_right_wrist", "front": "cam_third_view"}
"""RoboTwin 1.0's names of cameras; views of other cameras keep their names."""
ENCODER = {"crf": "16", "g": "2", "bf": "0", "preset": "veryfast"}
"""Options of x264; every second frame is a key frame, for fast access to single frames."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
AXES = [f"{side}_{axis}" for side in ("left", "right") for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]
JOINTS = [f"{side}_{name}" for side in ("left", "right") for name in (*(f"joint{number}" for number in range(1, 8)), "gripper")]
Videos = dict[str, tuple[str, str]]
"""View and name of a video, rgb or robot, by feature."""
Vectors = dict[str, tuple[str, list[str]]]
"""Array of `States` and names of its numbers, by feature."""
VECTORS: Vectors = {
    "action": ("action", JOINTS),
    "observation.state": ("joint_pos", JOINTS),
    "observation.tool_pose": ("tool_pose", AXES),
}
SCALARS = {"next.done": "bool", "next.success": "bool", "timestamp": "float32"} | dict.fromkeys(
    ("frame_index", "episode_index", "index", "task_index"), "int64"
)


@dataclass(frozen=True)
class Args:
    """What to export."""

    data: Annotated[Path, tyro.conf.Positional]
    out: Path
    """Folder of the LeRobotDataset; it must not exist."""
    robots: tuple[str, ...] = ()
    """Robots to export; default: all in the data."""
    tasks: tuple[str, ...] = ()
    """Tasks to export; default: all in the data."""
    split: Literal["train", "validation", "test", "final"] | None = None
    """Family of seeds; default: all. Export the training seeds to train on the set and grade on xew's test seeds."""
    faults: bool = False
    """Also export the episodes of faulty commands, most of which are no demonstrations of success."""
    views: tuple[str, ...] = ()
    """Views, each with a video of its own; default: the head camera as observation.images.head."""
    robot_video: bool = False
    """Also export the video of the robot alone, as observation.images.robot."""


@dataclass(frozen=True)
class Place:
    """Numbers of a file's chunk and of the file in it, as LeRobot counts them."""

    chunk: int = 0
    file: int = 0

    def path(self, root: Path, ending: str) -> Path:
        return root / f"chunk-{self.chunk:03d}" / f"file-{self.file:03d}.{ending}"

    def next_place(self) -> "Place":
        return Place(self.chunk, self.file + 1) if self.file + 1 < FILES_PER_CHUNK else Place(self.chunk + 1, 0)


def export(args: Args) -> tuple[int, list[str]]:
    """Write a LeRobotDataset; returns the number of episodes and the omitted features.

    Raises:
        EpisodeError: nothing is selected, the episodes have several frame rates, the folder exists or cannot be written, or
            another process writes it.
    """
    with hold_lock(args.out):
        if args.out.exists():
            raise EpisodeError(f"{args.out} exists; choose another --out or remove it.")
        chosen = _select_episodes(args)
        vectors, videos = _select_features(args, chosen)
        try:
            with complete_folder(args.out) as root:
                _write(root, chosen, vectors, videos)
        except OSError as error:
            raise EpisodeError(f"cannot write {args.out}: {error}. Free some space or choose another --out.") from error
    return len(chosen), [feature for feature in VECTORS if feature not in vectors]


def _select_features(args: Args, chosen: Sequence[tuple[Path, Record]]) -> tuple[Vectors, Videos]:
    """Vectors that all episodes have, and videos."""
    vectors = {
        feature: entry for feature, entry in VECTORS.items() if not any(entry[0] in record.unknown for _, record in chosen)
    }
    videos = {f"observation.images.{CAMERA_NAMES.get(view, view)}": (view, "rgb") for view in args.views}
    videos = videos or {"observation.images.head": (HEAD, "rgb")}
    if args.robot_video:
        if without := [folder for folder, record in chosen if "robot" not in record.hashes]:
            raise EpisodeError(f"{without[0]} has no video of the robot alone; omit --robot-video.")
        videos["observation.images.robot"] = (HEAD, "robot")
    return vectors, videos


def _select_episodes(args: Args) -> list[tuple[Path, Record]]:
    dataset, robots = read_dataset(args.data), expand_robots(args.robots)
    for flag, asked, known in (
        ("--robots", robots, {record.robot for _, record in dataset.accepted}),
        ("--tasks", args.tasks, {record.task for _, record in dataset.accepted}),
    ):
        if missing := sorted(set(asked) - known):
            raise EpisodeError(f"{flag} {', '.join(missing)}: not in {args.data}; it has {', '.join(sorted(known))}.")
    selected = dataset.select(robots=robots or None, tasks=args.tasks or None, split=args.split)
    chosen = [(folder, record) for folder, record in selected if args.faults or not record.fault]
    if left_out := len(selected) - len(chosen):
        print(f"omitted: {left_out} episodes of faulty commands, which --faults exports too")
    if not chosen:
        raise EpisodeError(f"{args.data} has no episode of these robots, tasks and seeds; relax the selection.")
    return chosen


def _write(root: Path, chosen: Sequence[tuple[Path, Record]], vectors: Vectors, videos: Videos) -> None:
    instructions = [record.instruction or record.task for _, record in chosen]
    tasks = {task: index for index, task in enumerate(dict.fromkeys(instructions))}
    rate = demand_one_rate(data_folder(chosen[0][0]), (record for _, record in chosen))
    episodes: list[dict[str, Any]] = []
    changed, faulty = (any(getattr(record, name) for _, record in chosen) for name in ("change", "fault"))
    totals = _Totals()
    with _Tables(root / "data") as table:
        video_files = {key: _VideoFiles(root / "videos" / key, rate) for key in videos}
        start = 0
        for number, (folder, record) in enumerate(tqdm(chosen, desc="exporting", unit="episode")):
            columns = _columns(read_states(folder, record), vectors, rate, number, start, tasks[instructions[number]])
            columns["next.success"] = columns["next.done"] & record.success
            place = table.add(columns)
            row: dict[str, Any] = {"episode_index": number, "tasks": [instructions[number]], "length": len(columns["index"])}
            row |= {"data/chunk_index": place.chunk, "data/file_index": place.file}
            row |= {"dataset_from_index": start, "dataset_to_index": start + row["length"]}
            statistics = {name: _statistics(values) for name, values in columns.items()}
            for key, (view, name) in videos.items():
                video = read_pixels(view_episode(folder, view), name)
                row |= video_files[key].add(video)
                counts = color_counts(video)
                statistics[key] = _color_statistics(counts, len(video))
                totals.colors[key] = totals.colors.get(key, 0) + counts
            totals.add(columns)
            row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            row |= {"xew/robot": record.robot, "xew/task": record.task, "xew/seed": record.seed, "xew/motion": record.motion}
            row |= {"xew/change": record.change} if changed else {}
            row |= {"xew/fault": record.fault} if faulty else {}
            row |= {f"stats/{name}/{stat}": value for name, stats in statistics.items() for stat, value in stats.items()}
            episodes.append(row)
            start += row["length"]
    robots = {record.robot for _, record in chosen}
    sizes = {key: files.size for key, files in video_files.items()}
    _write_meta(root, episodes, tasks, totals, _features(vectors, sizes, rate), rate, robots)


def _columns(states: States, vectors: Vectors, rate: Fraction, episode: int, start: int, task: int) -> dict[str, np.ndarray]:
    """The rows of one episode, by feature: [t n] or [t]."""
    frames = np.arange(states.frame_count)
    last = frames == states.frame_count - 1
    columns = {
        feature: np.asarray(getattr(states, name), np.float32).reshape(len(frames), -1)
        for feature, (name, _) in vectors.items()
    }
    return columns | {
        "next.done": last,
        "next.success": last,
        "timestamp": (frames / float(rate)).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(len(frames), episode),
        "index": start + frames,
        "task_index": np.full(len(frames), task),
    }


def _arrow(columns: dict[str, np.ndarray]) -> pa.Table:
    arrays = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1]) if values.ndim == 2 else values
        for name, values in columns.items()
    }
    return pa.table(arrays)


class _Tables:
    """Parquet files of rows; each is closed when it is full, and the last at the end of a `with` block."""

    def __init__(self, root: Path) -> None:
        self.root, self.place = root, Place()
        self.writer: parquet.ParquetWriter | None = None
        self.bytes = 0

    def __enter__(self) -> "_Tables":
        return self

    def __exit__(self, *error: object) -> None:
        if self.writer is not None:
            self.writer.close()

    def add(self, columns: dict[str, np.ndarray]) -> Place:
        """Append the rows of an episode, arrays [t n] or [t] by feature; returns their file."""
        rows = _arrow(columns)
        if self.writer is not None and self.bytes + rows.nbytes > LARGEST_DATA * 1e6:
            self.writer.close()
            self.writer, self.bytes, self.place = None, 0, self.place.next_place()
        if self.writer is None:
            path = self.place.path(self.root, "parquet")
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = parquet.ParquetWriter(path, rows.schema)
        self.writer.write_table(rows)
        self.bytes += rows.nbytes
        return self.place


class _VideoFiles:
    """H.264 files of one episode each: tools that split or filter the set copy files without encoding."""

    def __init__(self, root: Path, rate: Fraction) -> None:
        self.root, self.rate, self.next = root, rate, Place()
        self.size: tuple[int, int] = (0, 0)
        """Height and width of the frames [pixels], after the first video."""

    def add(self, video: np.ndarray) -> dict[str, Any]:
        """Write the video of an episode [t h w 3] uint8 RGB; returns the columns that locate it.

        Raises:
            EpisodeError: its frames have another size than those of the first video.
        """
        height, width = video.shape[1:3]
        self.size = self.size if any(self.size) else (height, width)
        if (height, width) != self.size:
            raise EpisodeError(
                f"an episode has frames of {width}x{height}, expected {self.size[1]}x{self.size[0]}; exclude it by --robots or "
                "--tasks."
            )
        place, self.next = self.next, self.next.next_place()
        path = place.path(self.root, "mp4")
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=self.rate, options=ENCODER)
            stream.height, stream.width, stream.pix_fmt = *video.shape[1:3], "yuv420p"
            for number, image in enumerate(video):
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
                frame.pts, frame.time_base = number, 1 / self.rate
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        key = f"videos/{self.root.name}"
        return {
            f"{key}/chunk_index": place.chunk,
            f"{key}/file_index": place.file,
            f"{key}/from_timestamp": 0.0,
            f"{key}/to_timestamp": float(len(video) / self.rate),
        }


@dataclass
class _Totals:
    """Totals for the statistics of the whole set."""

    columns: dict[str, list[np.ndarray]] = field(default_factory=dict)
    colors: dict[str, np.ndarray] = field(default_factory=dict)
    """Counts of each value in the videos [3 256]."""
    frames: int = 0

    def add(self, columns: dict[str, np.ndarray]) -> None:
        """Add the numbers of an episode, [t n] or [t] by feature."""
        for name, values in columns.items():
            self.columns.setdefault(name, []).append(values)
        self.frames += len(columns["index"])

    def statistics(self) -> dict[str, dict[str, Any]]:
        vectors = {name: _statistics(np.concatenate(values)) for name, values in self.columns.items()}
        return vectors | {key: _color_statistics(counts, self.frames) for key, counts in self.colors.items()}


def _statistics(values: np.ndarray) -> dict[str, list[Any]]:
    """Statistics over the frames of numbers [t n] or [t], as lists of n numbers."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    statistics = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    statistics |= {name: np.quantile(rows, share, axis=0) for name, share in QUANTILES.items()}
    return {name: numbers.tolist() for name, numbers in statistics.items()} | {"count": [len(rows)]}


def color_counts(video: np.ndarray) -> np.ndarray:
    """[3 256] counts of each value in red, green and blue of uint8 [t h w 3]."""
    return np.stack([np.bincount(video[..., channel].reshape(-1), minlength=256) for channel in range(3)])


def _color_statistics(counts: np.ndarray, frames: int) -> dict[str, list[Any]]:
    """Exact statistics of all pixels from their counts [3 256], as [3 1 1] lists of values 0 to 1."""
    value, total = np.arange(256) / 255, counts.sum(1)
    mean = counts @ value / total
    statistics = {
        "min": value[(counts > 0).argmax(1)],
        "max": value[255 - (counts[:, ::-1] > 0).argmax(1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ value**2 / total - mean**2, 0)),
    }
    below = counts.cumsum(1) / total[:, None]
    statistics |= {name: value[(below >= share).argmax(1)] for name, share in QUANTILES.items()}
    return {name: numbers.reshape(3, 1, 1).tolist() for name, numbers in statistics.items()} | {"count": [frames]}


def _features(vectors: Vectors, sizes: dict[str, tuple[int, int]], rate: Fraction) -> dict[str, dict[str, Any]]:
    features: dict[str, dict[str, Any]] = {
        name: {"dtype": "float32", "shape": [len(names)], "names": names} for name, (_, names) in vectors.items()
    }
    information = {
        "video.channels": 3,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": _number(rate),
        "has_audio": False,
    }
    names = ["height", "width", "channels"]
    for key, (height, width) in sizes.items():
        info = {"video.height": height, "video.width": width} | information
        features[key] = {"dtype": "video", "shape": [height, width, 3], "names": names, "info": info}
    return features | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in SCALARS.items()}


def _number(rate: Fraction) -> int | float:
    """A whole rate as an integer, which LeRobot's tools expect where they can."""
    return rate.numerator if rate.denominator == 1 else float(rate)


def _write_meta(
    root: Path,
    episodes: list[dict[str, Any]],
    tasks: dict[str, int],
    totals: _Totals,
    features: dict[str, dict[str, Any]],
    rate: Fraction,
    robots: set[str],
) -> None:
    information = {
        "codebase_version": VERSION,
        "robot_type": next(iter(robots)) if len(robots) == 1 else "several",
        "total_episodes": len(episodes),
        "total_frames": totals.frames,
        "total_tasks": len(tasks),
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": LARGEST_DATA,
        "video_files_size_in_mb": LARGEST_VIDEO,
        "fps": _number(rate),
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }
    table = Place().path(root / "meta" / "episodes", "parquet")
    table.parent.mkdir(parents=True)
    parquet.write_table(pa.Table.from_pylist(episodes), table)
    (root / "meta" / "info.json").write_text(json.dumps(information, indent=4), encoding="utf-8")
    (root / "meta" / "stats.json").write_text(json.dumps(totals.statistics(), indent=4), encoding="utf-8")
    index = pd.Index(list(tasks), name="task")
    pd.DataFrame({"task_index": list(tasks.values())}, index=index).to_parquet(root / "meta" / "tasks.parquet")


@user_errors
def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    count, left_out = export(args)
    print(f"{count} episodes in {args.out}")
    for feature in left_out:
        print(f"omitted: {feature}, which imported episodes lack")


if __name__ == "__main__":
    main()
