"""Checksums of a run's checkpoints: what is read is what was written, down to the bit.

Reads  <out>/checkpoints/STEP, complete
Writes <out>/sums/STEP.json: SHA-256 of each of its files

A checkpoint whose sums were not written yet, because the run was killed just then, or which an earlier version made, is read
without them.
"""

import json
from collections.abc import Collection
from pathlib import Path

from xew.config import ConfigError
from xew.files import file_digest, read_json, write_text


def note_sums(out: Path) -> None:
    """Write the sums of all complete checkpoints of a run that have none yet, and remove those of checkpoints that are gone."""
    steps = {folder.name: folder for folder in (out / "checkpoints").glob("*") if folder.name.isdecimal()}
    for name, folder in steps.items():
        path = _sums(out, int(name))
        if path.exists():
            continue
        try:
            sums = {file.relative_to(folder).as_posix(): file_digest(file) for file in _files(folder)}
            write_text(path, json.dumps(sums, indent=1, sort_keys=True) + "\n")
        except OSError:  # it is being replaced by a later one, or the disk is full: then it is read without sums
            continue
    for path in (out / "sums").glob("*.json"):
        if path.stem not in steps:
            path.unlink(missing_ok=True)


def find_damage(out: Path, step: int, items: Collection[str]) -> str:
    """What is wrong with the files of a checkpoint by its sums; '' where nothing is, or where there are no sums.

    Args:
        out: folder of the run.
        step: of the checkpoint.
        items: those of its parts that are read; other files directly in its folder count too.
    """
    folder, path = out / "checkpoints" / str(step), _sums(out, step)
    if not path.exists():
        return ""
    try:
        sums = read_json(path)
        if not isinstance(sums, dict) or not all(isinstance(digest, str) for digest in sums.values()):
            raise ValueError("expected digests by the names of files")
    except (OSError, ValueError) as error:
        return f"its sums {path} cannot be read: {error}"
    for name, digest in sums.items():
        if "/" in name and name.partition("/")[0] not in items:
            continue
        try:
            found = file_digest(folder / name)
        except OSError:
            return f"{name} is missing"
        if found != digest:
            return f"{name} has other bytes than were written"
    return ""


def damaged(out: Path, step: int, items: Collection[str], what: object) -> ConfigError:
    """The error for a damaged checkpoint, in one line: what is wrong with which, and the last one that is whole."""
    steps = sorted((int(path.name) for path in (out / "checkpoints").glob("*") if path.name.isdecimal()), reverse=True)
    whole = [other for other in steps if other != step and _sums(out, other).exists() and not find_damage(out, other, items)]
    offer = "no other is known to be whole: copy the run again, or train it anew with --overwrite"
    if whole:
        offer = f"step {whole[0]} is whole: move that folder away to go on from it, or read it by --checkpoint {whole[0]}"
    reason = " ".join(str(what).split())[:200] or type(what).__name__
    return ConfigError(f"{out / 'checkpoints' / str(step)}: the checkpoint of step {step} is damaged ({reason}); {offer}.")


def _sums(out: Path, step: int) -> Path:
    return out / "sums" / f"{step}.json"


def _files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file())
