"""Readers of files that may come from anybody, by the name of the file in its folder; what tests of faults give them."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from xew.analysis.scores import read_scores
from xew.config import read_yaml
from xew.episode import read_record, read_states, read_video
from xew.exchange.hdf5 import read_robotwin, text_beside
from xew.files import file_digest
from xew.metrics.grading.bundle import read_bundle
from xew.model.runs.folder import load_run_config
from xew.rollout import read_rollout, read_rollout_video
from xew.sim_warp.embodiment.mesh_files import MeshError, read_mesh
from xew.sim_warp.embodiment.urdf import load_urdf
from xew.sim_warp.manifest import read_manifest
from xew.sim_warp.robots import load_robot


def _read_mesh(path: Path) -> Any:
    try:
        return read_mesh(path)
    except MeshError as error:
        raise OSError(str(error)) from error


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "header": ("episode.json", lambda path: read_record(path.parent)),
    "states": ("states.npz", lambda path: read_states(path.parent)),
    "video": ("rgb.mkv", read_video),
    "rollout header": ("t/0/r/rollout.json", lambda path: read_rollout(path.parent)),
    "rollout video": ("t/0/r/rgb.mkv", lambda path: read_rollout_video(read_rollout(path.parent))),
    "rollout picture": ("t/0/r/0.png", lambda path: read_rollout_video(read_rollout(path.parent))),
    "rollout array": ("t/0/r/v.npz", lambda path: read_rollout_video(read_rollout(path.parent))),
    "config": ("config.yaml", read_yaml),
    "run": ("config.yaml", lambda path: load_run_config(path.parent)),
    "scores": ("scores.parquet", read_scores),
    "bundle": ("bundle.json", read_bundle),
    "seeds": ("seeds.json", read_manifest),
    "robotwin": ("episode0.hdf5", read_robotwin),
    "text beside": ("seed.txt", lambda path: text_beside(path.parent / "data/e.hdf5", "seed.txt")),
    "digest": ("any", file_digest),
    "robot": ("robot.yaml", load_robot),
    "urdf": ("arm.urdf", load_urdf),
    "mesh": ("arm.stl", _read_mesh),
    "collada": ("arm.dae", _read_mesh),
    "gltf": ("arm.glb", _read_mesh),
}
"""Name of a reader to the name of its file and the function that is called with its path."""


@contextmanager
def at_most_seconds(seconds: int) -> Iterator[None]:
    """Raise TimeoutError in a block that hangs."""

    def stop(number: int, frame: Any) -> NoReturn:
        raise RuntimeError(f"it hung for {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
