"""Files, for all rooms: there whole or not at all; and where between runs is kept what can be made again."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to, which becomes `path` when the block ends well.

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


def cache_folder(name: str) -> Path:
    """The user's folder for what xew can make again, such as compiled programs; it need not be there yet."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "xew" / name
