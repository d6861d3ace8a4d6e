"""The ledger of a study: a record of each step, and digests that show whether record and product still match.

    <out>/state/<kind>/<variant>.json   key, status (begun, done, failed), outcome, seconds, host

A step is done if its record says so, its key matches the study's inputs, and its product has the recorded outcome. A removed
product counts as done if no step that is left needs it. Other steps run again, and resume if their key is the same.
"""

import hashlib
import json
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from xew.analysis.studies.plan import Step, sort_steps, step_key
from xew.config import ConfigError, parse
from xew.dataset import find_accepted
from xew.episode import EpisodeError
from xew.files import check_place, copy_file, file_digest, read_json, remove_written, write_text
from xew.model.runs.layout import RUN_FILES, checkpoint_time, is_run, list_steps

ROLLOUT_FILES = ("*/*/*/rgb.mkv", "*/*/*/rollout.json")
"""Patterns of the paths of what `xew.model.rollout` writes into its tree."""
GRADES = ("parquet", "*.parquet", "summary.md", "summary.csv", "pairs.csv", "bundle.json", "cells/*.json", "baselines/*.json")
"""Patterns of the endings of what `xew.metrics.evaluate` writes next to a score table."""


@dataclass(frozen=True)
class _Record:
    """What is noted of a step."""

    key: str
    status: Literal["begun", "done", "failed"]
    at: str
    outcome: str | None = None
    error: str | None = None
    seconds: float | None = None
    gpus: int | None = None
    host: str | None = None


class Ledger:
    """The records of a study's steps."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self._outcomes: dict[str, str] = {}
        self._removed: set[str] = set()
        self._needed: set[str] = set()

    def outcome(self, name: str) -> str | None:
        """Digest of the product of a step that was found done or was done just now; None for others."""
        return self._outcomes.get(name)

    def log(self, step: Step) -> Path:
        """The file that a step's output goes to."""
        return self.out / "logs" / f"{step.name}.log"

    def record(self, step: Step) -> Mapping[str, Any]:
        """What is noted of a step; empty if it was never begun or its record is damaged."""
        try:
            found = asdict(parse(_Record, read_json(self._path(step)), ""))
        except (OSError, ValueError, ConfigError):
            return {}
        return {name: value for name, value in found.items() if value is not None}

    def key(self, step: Step) -> str:
        """Key of a step whose needs are done as far as they will be."""
        return step_key(step, [self.outcome(name) for name in step.needs])

    def find_all_done(self, steps: Mapping[str, Step]) -> None:
        """Look at every step, and find out whose removed products are needed by a step that is left to do."""
        order = sort_steps(steps)
        self._needed.clear()
        for step in order:
            if all(self.outcome(name) for name in step.needs):
                self.find_done(step)
        for step in reversed(order):
            if not self.outcome(step.name):
                self._needed.update(self._removed.intersection(step.needs))
                for name in self._needed:
                    self._outcomes.pop(name, None)

    def find_done(self, step: Step) -> bool:
        """Whether a step needs no work; the steps that it needs must have been looked at before."""
        noted = self.noted_outcome(step, self._outcomes)
        if noted is None:
            return False
        found = digest_product(step.kind, step.product)
        if found is None:
            self._removed.add(step.name)
        if found != noted and (found is not None or step.name in self._needed):
            return False
        self._outcomes[step.name] = noted
        return True

    def noted_outcome(self, step: Step, outcomes: Mapping[str, str]) -> str | None:
        """The outcome that is noted of a step made from these outcomes of other steps; None if it was not made from them."""
        record = self.record(step)
        key = step_key(step, [outcomes.get(name) for name in step.needs])
        return record["outcome"] if record.get("status") == "done" and record["key"] == key else None

    def take_record(self, step: Step, other: "Ledger") -> None:
        """Note what another ledger has noted of a step, with its log."""
        self._write(step, {name: value for name, value in other.record(step).items() if name != "at"})
        if other.log(step).is_file():
            copy_file(other.log(step), self.log(step), within=self.out)

    def begin(self, step: Step) -> bool:
        """Note that a step starts; returns whether it resumes an earlier attempt.

        Products of other inputs are removed if the command would resume them, and so are runs killed before their first
        checkpoint.
        """
        self._check_places(step)
        key = self.key(step)
        goes_on = self.record(step).get("key") == key
        if step.kind in ("train", "adapt"):
            goes_on = goes_on and _digest_run(step.product) is not None
        if not goes_on and step.kind in ("train", "adapt", "rollout"):
            _remove_product(step, begun=bool(self.record(step)))
        self._write(step, {"key": key, "status": "begun"})
        return goes_on

    def finish(self, step: Step, exit_code: int, seconds: float, gpus: int | None = None) -> str:
        """Note how a step ended, after how long and on how many GPUs; returns what was wrong, or ''."""
        error = "" if exit_code == 0 else f"exit status {exit_code}"
        found = None
        if not error:
            try:
                found = digest_product(step.kind, step.product)
                error = "" if found else f"it made no {step.product}"
            except EpisodeError as wrong:
                error = str(wrong)
        status = {"status": "failed", "error": error} if error else {"status": "done", "outcome": found}
        used = {} if gpus is None else {"gpus": gpus}
        self._write(step, {"key": self.key(step), **status, "seconds": round(seconds, 1), **used, "host": socket.gethostname()})
        if found:
            self._outcomes[step.name] = found
        return error

    def forget(self, step: Step) -> None:
        """Make a step run again; of grades, also remove what the command would resume (`scores/<variant>.*`)."""
        self._check_places(step)
        self._path(step).unlink(missing_ok=True)
        if step.kind in ("baselines", "evaluate"):
            remove_written(step.product.parent, [f"{step.product.stem}.{ending}" for ending in GRADES])

    def _check_places(self, step: Step) -> None:
        """Raise OSError if links lead the record, the log or the product of a step out of the study's folder."""
        for path in (self._path(step), self.log(step), step.product / "file"):
            if path.is_relative_to(self.out):
                check_place(path, within=self.out)

    def _path(self, step: Step) -> Path:
        return self.out / "state" / f"{step.name}.json"

    def _write(self, step: Step, record: Mapping[str, Any]) -> None:
        path = self._path(step)
        try:
            content = {**record, "at": time.strftime("%Y-%m-%d %H:%M:%S")}
            write_text(path, json.dumps(content, indent=1) + "\n", within=self.out)
        except OSError as error:
            raise ConfigError(f"cannot write {path}: {error}. Free some space, or choose another --out.") from error


def _remove_product(step: Step, begun: bool) -> None:
    """Remove the run or the rollouts of a step, and nothing next to them.

    Raises ConfigError if the folder of a run that this study never began holds something else, or a file cannot be removed.
    """
    run = step.kind in ("train", "adapt")
    if run and not begun and step.product.is_dir() and any(step.product.iterdir()) and not is_run(step.product):
        raise ConfigError(f"{step.product} is the place of a run and holds something else; move it away.")
    try:
        remove_written(step.product, RUN_FILES if run else ROLLOUT_FILES)
    except OSError as error:
        raise ConfigError(f"cannot replace {step.product}: {error}; remove it, or choose another --out.") from error


def digest_product(kind: str, product: Path) -> str | None:
    """A digest of what a step of a kind has made, or None if it is not there. Quick: videos and weights are not read."""
    return _DIGESTS[kind](product)


def _digest_episodes(data: Path) -> str | None:
    if not data.is_dir():
        return None
    try:
        accepted = find_accepted(data)
    except EpisodeError:
        return None
    return _digest([[r.task, r.seed, r.robot, sorted(r.hashes.items())] for _, r in accepted])


def _digest_run(run: Path) -> str | None:
    """Digest of a run's latest checkpoint: its step and the time when it was begun."""
    steps = list_steps(run)
    if not steps:
        return None
    begun = checkpoint_time(run, steps[-1])
    return None if begun is None else _digest([str(steps[-1]), begun])


def _digest_rollouts(root: Path) -> str | None:
    """Digest of headers, names and sizes: a video is lossless, and its header says what it was made from."""
    files = sorted(path for path in root.glob("*/*/*/*") if path.is_file() and not path.parent.name.startswith("."))
    if not files:
        return None
    texts = [f.read_text(encoding="utf-8", errors="replace") if f.suffix == ".json" else "" for f in files]
    return _digest([[str(f.relative_to(root)), f.stat().st_size, text] for f, text in zip(files, texts, strict=True)])


def _digest_file(path: Path) -> str | None:
    return file_digest(path)[:16] if path.is_file() else None


def _digest_folder(path: Path) -> str | None:
    """A constant for the latent cache, whose files carry what they were made from in their names."""
    return "there" if path.is_dir() else None


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


_DIGESTS: dict[str, Callable[[Path], str | None]] = {
    "generate": _digest_episodes,
    "latents": _digest_folder,
    "baselines": _digest_file,
    "train": _digest_run,
    "adapt": _digest_run,
    "rollout": _digest_rollouts,
    "evaluate": _digest_file,
    "distances": _digest_file,
    "analyse": _digest_file,
}
