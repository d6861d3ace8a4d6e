"""What a run folder holds: names of its files and checkpoints, and the file that marks it as a run.

It loads without JAX, for `xew.analysis.study`. folder.py says what each file holds, and reads them.
"""

from pathlib import Path

from xew.files import read_json

RUN_MARK = ".xew-run"
"""Name of the file that marks the folder of a run."""
RUN_FILES = (
    RUN_MARK,
    "config.yaml",
    "codec/*",
    "scales.json",
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
"""Patterns of the paths of what training runs write into their folders."""


def is_run(folder: Path) -> bool:
    """Whether a training run has made a folder, by its mark."""
    return (folder / RUN_MARK).is_file()


def list_steps(run: Path) -> list[int]:
    """Steps of the checkpoints of a run, in order."""
    return sorted(int(path.name) for path in (run / "checkpoints").glob("*") if path.name.isdecimal())


def checkpoint_time(run: Path, step: int) -> int | None:
    """Time at which a checkpoint was begun [ns]; another of the same step has another. None if there is no such checkpoint."""
    try:
        return read_json(run / "checkpoints" / str(step) / "_CHECKPOINT_METADATA")["init_timestamp_nsecs"]
    except (OSError, ValueError, KeyError):
        return None
