"""Names of a run folder's files and checkpoints; without JAX, for `xew.analysis.study`. folder.py describes the files."""

from pathlib import Path

from xew.files import read_json

RUN_MARK = ".xew-run"
"""Name of the file that marks the folder of a run."""
RUN_FILES = (
    RUN_MARK,
    "config.yaml",
    "codec/*",
    "scales.json",
    "episodes.json",
    "checkpoints/*",
    "sums/*.json",
    "start.json",
    "metrics.jsonl",
    "events.out.tfevents.*",
    "autoencoder.*",
    "vae.*",
    "report.md",
    "pictures/*.png",
)
"""Patterns of the paths of a run's files."""


def is_run(folder: Path) -> bool:
    """Whether a folder has the mark of a run."""
    return (folder / RUN_MARK).is_file()


def list_steps(run: Path) -> list[int]:
    """Sorted steps of a run's checkpoints."""
    return sorted(int(path.name) for path in (run / "checkpoints").glob("*") if path.name.isdecimal())


def checkpoint_time(run: Path, step: int) -> int | None:
    """Start time of writing a checkpoint [ns], which identifies it, or None if there is no such checkpoint."""
    try:
        return read_json(run / "checkpoints" / str(step) / "_CHECKPOINT_METADATA")["init_timestamp_nsecs"]
    except (OSError, ValueError, KeyError):
        return None
