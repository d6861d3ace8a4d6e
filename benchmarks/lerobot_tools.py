"""LeRobot's own reader, trainer and `lerobot-edit-dataset` on a set that `xew.exchange.lerobot` has exported.

It runs in an environment of LeRobot, which needs nothing of xew:

    python -m venv lerobot && lerobot/bin/pip install "lerobot[training]"
    lerobot/bin/python benchmarks/lerobot_tools.py EXPORT --data DATA --views head wrist_left wrist_right

Rows are read by pyarrow and pictures by PyAV as exported, then every frame of every camera by LeRobotDataset: of the export,
and of what remains after LeRobot has deleted two episodes and after it has split the set. With --data, the pictures are also
compared with xew's own files. `lerobot-train` then takes a few steps of a tiny ACT policy that sees all cameras. Prints a line
for each; exit status 1 where something differs.
"""

import argparse
import json
import math
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as parquet

SCRIPTS = Path(sys.executable).parent
CLOSE = 2.0
"""Largest difference of a color, 0 to 255, that two ways of decoding the same H.264 frame may make."""
LOSSY = 2.5
"""Largest mean difference of a frame's colors, 0 to 255, that H.264 may make."""
ROBOT = "observation.images.robot"
"""The robot alone, which is no view."""
STEPS = 4
TINY = {"dim_model": 64, "n_heads": 2, "dim_feedforward": 64, "n_encoder_layers": 1, "n_vae_encoder_layers": 1, "latent_dim": 8}
TINY |= {"chunk_size": 8, "n_action_steps": 8}
"""Sizes of the policy."""


@dataclass(frozen=True)
class Episode:
    """One episode as it was exported."""

    action: np.ndarray
    """[t 16] float32."""
    films: dict[str, Path]
    """Video by camera."""
    folder: str
    """Place of the episode in a data set of xew."""
    task: str


def read_film(path: Path) -> np.ndarray:
    """Pictures [t h w 3] uint8 of a video, by PyAV."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def read_info(root: Path) -> tuple[float, list[str]]:
    """Frame rate and cameras of a set."""
    info = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))
    return info["fps"], [name for name, feature in info["features"].items() if feature["dtype"] == "video"]


def read_export(root: Path) -> list[Episode]:
    """The episodes of an export, by pyarrow."""
    rows, cameras = parquet.read_table(root / "data").to_pandas(), read_info(root)[1]
    found = []
    for number, row in enumerate(parquet.read_table(root / "meta/episodes").to_pylist()):
        films = {
            camera: root / f"{key}/chunk-{row[f'{key}/chunk_index']:03d}/file-{row[f'{key}/file_index']:03d}.mp4"
            for camera in cameras
            for key in [f"videos/{camera}"]
        }
        folder = f"{row['xew/task']}/{row['xew/seed']:07d}/{row['xew/robot']}"
        found.append(Episode(np.stack(rows[rows["episode_index"] == number]["action"]), films, folder, row["tasks"][0]))
    return found


def compare(root: Path, expected: Sequence[Episode], decoder: str) -> str:
    """Read every frame of a set by LeRobotDataset; a line about it. Raises AssertionError where a frame is another."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # the tool's own, in its own environment

    dataset = LeRobotDataset("xew/test", root=root, video_backend=decoder)
    assert dataset.num_episodes == len(expected) and len(dataset) == sum(len(e.action) for e in expected)
    rate = read_info(root)[0]
    assert dataset.meta.camera_keys == list(expected[0].films) and dataset.meta.fps == rate
    index, worst = 0, 0.0
    for number, episode in enumerate(expected):
        films = {camera: read_film(path) for camera, path in episode.films.items()}
        for frame, action in enumerate(episode.action):
            item = dataset[index]
            assert (int(item["episode_index"]), int(item["frame_index"])) == (number, frame), (number, frame)
            assert (item["action"].numpy() == action).all() and item["task"] == episode.task, (number, frame)
            assert abs(float(item["timestamp"]) - frame / rate) < 1e-4, (number, frame)
            for camera, pictures in films.items():
                image = 255 * item[camera].numpy().transpose(1, 2, 0)
                worst = max(worst, float(np.abs(image - pictures[frame]).max()))
            index += 1
    assert worst <= CLOSE, f"colors differ by {worst:.1f}"
    return (
        f"{len(expected)} episodes, {index} frames of {len(films)} cameras, fps {rate:.4f}, actions equal, colors differ by "
        f"{worst:.1f} of 255 at most"
    )


def compare_originals(data: Path, view: str, camera: str, episodes: Sequence[Episode]) -> str:
    """Compare a camera's pictures with the files of a view of xew; a line about it. Raises AssertionError as `compare`."""
    root, worst = data if view == "head" else data / "views" / view, 0.0
    for episode in episodes:
        pictures, original = read_film(episode.films[camera]), read_film(root / episode.folder / "rgb.mkv")
        assert pictures.shape == original.shape, f"{pictures.shape}, expected {original.shape}"
        worst = max(worst, float(np.abs(pictures.astype(np.int16) - original).mean((1, 2, 3)).max()))
    assert worst <= LOSSY, f"{camera}: colors of a frame differ by {worst:.2f} on average"
    return f"{camera} is {view}: colors of a frame differ by {worst:.2f} of 255 on average at most"


def run_tool(name: str, *arguments: str) -> str:
    """Run a command of LeRobot; returns its log."""
    done = subprocess.run([str(SCRIPTS / name), *arguments], capture_output=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def edit(root: Path, out: Path, operation: str, *arguments: str) -> None:
    """Run `lerobot-edit-dataset` on a set; what it makes lies in `out`."""
    given = ["--repo_id", "xew/test", "--root", str(root), "--new_repo_id", "xew/new", "--new_root", str(out)]
    run_tool("lerobot-edit-dataset", *given, "--operation.type", operation, *arguments)


def train(root: Path, out: Path, decoder: str) -> str:
    """Train on all cameras with `lerobot-train`; a line about it. Raises AssertionError if a camera or a loss is missing."""
    policy = {"type": "act", "device": "cpu", "push_to_hub": "false", "pretrained_backbone_weights": "null"} | TINY
    dataset = {"repo_id": "xew/test", "root": root, "video_backend": decoder, "use_imagenet_stats": "false"}
    options = {"steps": STEPS, "batch_size": 2, "num_workers": 0, "log_freq": 1, "env_eval_freq": 0, "output_dir": out}
    options |= {f"policy.{name}": value for name, value in policy.items()}
    options |= {f"dataset.{name}": value for name, value in dataset.items()}
    log = run_tool("lerobot-train", *(f"--{name}={value}" for name, value in options.items()))
    losses = [float(loss) for loss in re.findall(r"\bloss:(\S+)", log)]
    assert len(losses) == STEPS and all(map(math.isfinite, losses)), losses
    inputs = json.loads((out / "checkpoints/last/pretrained_model/config.json").read_text(encoding="utf-8"))["input_features"]
    seen = [name for name, feature in inputs.items() if feature["type"] == "VISUAL"]
    assert seen == read_info(root)[1], seen
    return f"{STEPS} steps of ACT on {len(seen)} cameras, losses {losses}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("export", type=Path, help="folder that xew.exchange.lerobot wrote, of at least four episodes")
    parser.add_argument("--data", type=Path, help="the data set that was exported, to compare with its own files")
    parser.add_argument("--views", nargs="+", default=["head"], help="the export's --views, in its order")
    parser.add_argument("--decoder", choices=["pyav", "torchcodec"], default="pyav", help="how LeRobot decodes videos")
    args = parser.parse_args()
    root, episodes = args.export, read_export(args.export)
    print(f"read: {compare(root, episodes, args.decoder)}")
    if args.data:
        cameras = [camera for camera in read_info(root)[1] if camera != ROBOT]
        for view, camera in zip(args.views, cameras, strict=True):
            print(compare_originals(args.data, view, camera, episodes))
    with tempfile.TemporaryDirectory() as folder:
        print(f"train: {train(root, Path(folder) / 'train', args.decoder)}")
        deleted, parts = Path(folder) / "deleted", Path(folder) / "split"
        edit(root, deleted, "delete_episodes", "--operation.episode_indices", "[1, 2]")
        print(f"two deleted: {compare(deleted, [episodes[0], *episodes[3:]], args.decoder)}")
        edit(root, parts, "split", "--operation.splits", '{"first": 0.5, "second": 0.5}')
        half = len(episodes) // 2
        for name, expected in (("first", episodes[:half]), ("second", episodes[half : 2 * half])):
            print(f"split, {name} half: {compare(parts / name, expected, args.decoder)}")


if __name__ == "__main__":
    main()
