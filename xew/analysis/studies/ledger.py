"""What of a study is done: a record of each cell beside its product, and the digest that says whether both still hold.

<out>/state/<stage>/<variant>.json   key, status (begun, done, failed), outcome, seconds, host

A cell is done when its record says so, its key is that of the study as it is now (its inputs and what it was made from), and
its product still has the outcome that was noted. Anything else is made again, from where it was left if the key is the same.
"""

import hashlib
import json
import shutil
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from xew.analysis.studies.plan import Cell, key_of
from xew.config import ConfigError
from xew.dataset import find_accepted
from xew.episode import EpisodeError
from xew.files import checkpoint_time, file_digest, replacing


class Ledger:
    """The records of a study's cells."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self._outcomes: dict[str, str] = {}

    def outcome(self, name: str) -> str | None:
        """Of a cell that was found done, or was done just now; None of others."""
        return self._outcomes.get(name)

    def log(self, cell: Cell) -> Path:
        return self.out / "logs" / f"{cell.name}.log"

    def record(self, cell: Cell) -> Mapping[str, Any]:
        """What is noted of a cell; nothing if that was never begun or its record is damaged."""
        try:
            return json.loads(self._path(cell).read_text())
        except (OSError, ValueError):
            return {}

    def key(self, cell: Cell) -> str:
        """Of a cell whose needs are done as far as they will be."""
        return key_of(cell, [self.outcome(name) for name in cell.needs])

    def find_done(self, cell: Cell) -> bool:
        """Whether a cell needs no work; its needs must have been asked before it."""
        record = self.record(cell)
        if record.get("status") != "done" or record["key"] != self.key(cell):
            return False
        found = read_outcome(cell)
        if found is None or found != record["outcome"]:
            return False
        self._outcomes[cell.name] = found
        return True

    def begin(self, cell: Cell) -> bool:
        """Note that a cell is being made; returns whether it goes on from what an earlier try left.

        What was made from other inputs is removed where the command would take it for its own, and so is a run that was
        killed before its first checkpoint, perhaps in the middle of writing its config.
        """
        key = self.key(cell)
        goes_on = self.record(cell).get("key") == key
        if cell.stage in ("train", "adapt"):
            goes_on = goes_on and _of_run(cell.product) is not None
        if not goes_on and cell.stage in ("train", "adapt", "rollout"):
            shutil.rmtree(cell.product, ignore_errors=True)
        self._write(cell, {"key": key, "status": "begun"})
        return goes_on

    def finish(self, cell: Cell, exit_code: int, seconds: float) -> str:
        """Note how a cell ended; returns '' or what was wrong."""
        error = "" if exit_code == 0 else f"exit status {exit_code}"
        found = None
        if not error:
            try:
                found = read_outcome(cell)
                error = "" if found else f"it made no {cell.product}"
            except EpisodeError as wrong:
                error = str(wrong)
        status = {"status": "failed", "error": error} if error else {"status": "done", "outcome": found}
        self._write(cell, {"key": self.key(cell), **status, "seconds": round(seconds, 1), "host": socket.gethostname()})
        if found:
            self._outcomes[cell.name] = found
        return error

    def forget(self, cell: Cell) -> None:
        """Make a cell undone, from nothing; of grades, also what a command would go on from (`scores/<variant>.*`)."""
        self._path(cell).unlink(missing_ok=True)
        for path in cell.product.parent.glob(f"{cell.product.stem}.*") if cell.stage == "evaluate" else ():
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def _path(self, cell: Cell) -> Path:
        return self.out / "state" / f"{cell.name}.json"

    def _write(self, cell: Cell, record: Mapping[str, Any]) -> None:
        path = self._path(cell)
        try:
            with replacing(path) as temporary:
                temporary.write_text(json.dumps({**record, "at": time.strftime("%Y-%m-%d %H:%M:%S")}, indent=1) + "\n")
        except OSError as error:
            raise ConfigError(f"cannot write {path}: {error}. Free some space, or choose another --out.") from error


def read_outcome(cell: Cell) -> str | None:
    """A digest of what a cell has made, or None if it is not there. Quick: videos and weights are not read."""
    return _OUTCOMES[cell.stage](cell.product)


def _of_episodes(data: Path) -> str | None:
    if not data.is_dir():
        return None
    try:
        accepted = find_accepted(data)
    except EpisodeError:
        return None
    return _digest([[r.task, r.seed, r.robot, sorted(r.hashes.items())] for _, r in accepted])


def _of_run(run: Path) -> str | None:
    """Which training a run's latest checkpoint came from: its step and when that was begun."""
    steps = [path for path in (run / "checkpoints").glob("*") if path.name.isdecimal()]
    if not steps:
        return None
    latest = max(steps, key=lambda path: int(path.name))
    begun = checkpoint_time(run, int(latest.name))
    return None if begun is None else _digest([latest.name, begun])


def _of_rollouts(root: Path) -> str | None:
    """Headers, names and sizes: a video is lossless, and its header says what it was made from."""
    files = sorted(path for path in root.glob("*/*/*/*") if path.is_file() and not path.parent.name.startswith("."))
    if not files:
        return None
    return _digest([[str(f.relative_to(root)), f.stat().st_size, f.read_text() if f.suffix == ".json" else ""] for f in files])


def _of_file(path: Path) -> str | None:
    return file_digest(path)[:16] if path.is_file() else None


def _of_folder(path: Path) -> str | None:
    """Of the latent cache, whose files name themselves what they were made from; training says so if one is missing."""
    return "there" if path.is_dir() else None


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


_OUTCOMES: dict[str, Callable[[Path], str | None]] = {
    "generate": _of_episodes,
    "latents": _of_folder,
    "train": _of_run,
    "adapt": _of_run,
    "rollout": _of_rollouts,
    "evaluate": _of_file,
    "distances": _of_file,
    "analyse": _of_file,
}
