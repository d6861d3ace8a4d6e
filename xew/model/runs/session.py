"""The open files of a run in training: its checkpoints and its log."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from xew.model.runs.checkpoint import write_checkpoints
from xew.model.runs.log import RunLog


@dataclass(frozen=True)
class Session:
    """The open files of a run."""

    out: Path
    """Folder of the run."""
    checkpoints: Any
    log: RunLog | None
    """Log of the first process; None in others."""

    @property
    def step(self) -> int:
        """Step of the latest checkpoint, or 0."""
        return self.checkpoints.latest_step() or 0


@contextlib.contextmanager
def open_session(out: Path, keep: int, recommended: Any = None) -> Iterator[Session]:
    """Open the log and the checkpoints of a run, of which the last `keep` are kept; all is written when the block ends.

    HParams leave out the settings of the config `recommended`.
    """
    with write_checkpoints(out, keep) as checkpoints:
        log = RunLog(out, checkpoints.latest_step() or 0, recommended) if jax.process_index() == 0 else None
        try:
            yield Session(out, checkpoints, log)
        finally:
            if log is not None:
                log.close()
