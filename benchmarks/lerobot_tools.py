"""LeRobot's own reader and `lerobot-edit-dataset` on a set that `xew.exchange.lerobot` has exported: every frame is compared.

It runs in an environment of LeRobot, which needs nothing of xew:

    python -m venv lerobot && lerobot/bin/pip install "lerobot[dataset]"
    lerobot/bin/python benchmarks/lerobot_tools.py EXPORT

Read are rows by pyarrow and pictures by PyAV, once as exported, once by LeRobotDataset, and once after LeRobot has deleted two
episodes and after it has split the set. Prints a line for each; exit status 1 where something differs.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as parquet

EDIT = Path(sys.executable).with_name("lerobot-edit-dataset")
CLOSE = 2.0
"""Largest difference of a color, 0 to 255, that two ways of decoding the same H.264 frame may make."""


@dataclass(frozen=True)
class Episode:
    """One episode as it was exported."""

    action: np.ndarray
    """[t 16] float32."""
    pictures: np.ndarray
    """[t h w 3] uint8, the head camera."""
    task: str


def read_export(root: Path) -> list[Episode]:
    """The episodes of an export, by pyarrow and PyAV."""
    rows = parquet.read_table(root / "data").to_pandas()
    found = []
    for number, row in enumerate(parquet.read_table(root / "meta/episodes").to_pylist()):
        key = "videos/observation.images.head"
        film = root / f"{key}/chunk-{row[f'{key}/chunk_index']:03d}/file-{row[f'{key}/file_index']:03d}.mp4"
        with av.open(str(film)) as container:
            pictures = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
        found.append(Episode(np.stack(rows[rows["episode_index"] == number]["action"]), pictures, row["tasks"][0]))
    return found


def compare(root: Path, expected: Sequence[Episode]) -> str:
    """Read every frame of a set by LeRobotDataset; a line about it. Raises AssertionError where a frame is another."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # the tool's own, in its own environment

    dataset = LeRobotDataset("xew/test", root=root, video_backend="pyav")
    assert dataset.num_episodes == len(expected) and len(dataset) == sum(len(e.action) for e in expected)
    rate = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))["fps"]
    index, worst = 0, 0.0
    for number, episode in enumerate(expected):
        for frame, action in enumerate(episode.action):
            item = dataset[index]
            assert (int(item["episode_index"]), int(item["frame_index"])) == (number, frame), (number, frame)
            assert (item["action"].numpy() == action).all() and item["task"] == episode.task, (number, frame)
            assert abs(float(item["timestamp"]) - frame / rate) < 1e-4, (number, frame)
            image = 255 * item["observation.images.head"].numpy().transpose(1, 2, 0)
            worst = max(worst, float(np.abs(image - episode.pictures[frame]).max()))
            index += 1
    assert worst <= CLOSE, f"colors differ by {worst:.1f}"
    return (
        f"{len(expected)} episodes, {index} frames, fps {rate:.4f}, actions equal, colors differ by {worst:.1f} of 255 at most"
    )


def edit(root: Path, out: Path, operation: str, *arguments: str) -> None:
    """Run `lerobot-edit-dataset` on a set; what it makes lies in `out`."""
    given = ["--repo_id", "xew/test", "--root", str(root), "--new_repo_id", "xew/new", "--new_root", str(out)]
    done = subprocess.run([str(EDIT), *given, "--operation.type", operation, *arguments], capture_output=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("export", type=Path, help="folder that xew.exchange.lerobot wrote, of at least four episodes")
    root = parser.parse_args().export
    episodes = read_export(root)
    print(f"read: {compare(root, episodes)}")
    with tempfile.TemporaryDirectory() as folder:
        deleted, parts = Path(folder) / "deleted", Path(folder) / "split"
        edit(root, deleted, "delete_episodes", "--operation.episode_indices", "[1, 2]")
        print(f"two deleted: {compare(deleted, [episodes[0], *episodes[3:]])}")
        edit(root, parts, "split", "--operation.splits", '{"first": 0.5, "second": 0.5}')
        half = len(episodes) // 2
        for name, expected in (("first", episodes[:half]), ("second", episodes[half : 2 * half])):
            print(f"split, {name} half: {compare(parts / name, expected)}")


if __name__ == "__main__":
    main()
