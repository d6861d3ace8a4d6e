"""Files, for all rooms: written whole or not at all, digests of their content, and the user's folder for what is kept."""

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a name beside `path` to write to, which becomes `path` when the block ends well.

    Who reads `path` finds the old file or the new one. What a failed block has left is removed; folders are made.

    Raises:
        OSError: it cannot be written there, or the disk is full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal digits. Raises OSError if it cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_files(paths: Sequence[Path]) -> str:
    """SHA-256 of one file's content; of several, that of their digests in order. Raises OSError if one cannot be read."""
    digests = [file_digest(path) for path in paths]
    return digests[0] if len(digests) == 1 else hashlib.sha256(b"".join(map(bytes.fromhex, digests))).hexdigest()


def digest_tree(path: Path) -> str:
    """SHA-256 of a file's content; of a folder, that of its files' names and digests."""
    if not path.is_dir():
        return file_digest(path)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    lines = [f"{file_digest(file)} {file.relative_to(path).as_posix()}" for file in files]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def checkpoint_time(run: Path, step: int) -> int | None:
    """When a run's checkpoint was begun [ns], which tells it from another of the same step; None if there is none."""
    try:
        return json.loads((run / "checkpoints" / str(step) / "_CHECKPOINT_METADATA").read_text())["init_timestamp_nsecs"]
    except (OSError, ValueError, KeyError):
        return None


def cache_folder(name: str) -> Path:
    """The user's folder for what xew can make again, such as compiled programs; it need not be there yet."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "xew" / name
