"""Files, for all rooms: regular files are read, files are written whole or not at all, locked, removed and digested."""

import contextlib
import errno
import fcntl
import fnmatch
import glob
import hashlib
import json
import os
import re
import shutil
import socket
import stat
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from xew.names import EpisodeError

POLL_S = 0.2
"""Time between two looks at a lock that another process holds [s]."""
SETTLED_S = 2.0
"""Age from which the file of a process that does not exist here is taken for left [s]; on another machine it may exist."""
KINDS = {stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
"""Names of what a path may lead to that is neither a file nor a folder, by the type in its mode."""


def demand_regular(path: Path) -> Path:
    """The path itself, where it is that of a regular file. Reading another kind may block forever or never end.

    Raises:
        OSError: it is a FIFO, a socket, a device or a folder; or there is nothing (FileNotFoundError).
    """
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder, expected a file", str(path))
    if not stat.S_ISREG(mode):
        found = KINDS.get(stat.S_IFMT(mode), "no file")
        raise OSError(errno.EINVAL, f"is {found}, expected a regular file", str(path))
    return Path(path)


def read_text(path: Path) -> str:
    """The text of a regular file. Raises OSError as `demand_regular`, UnicodeDecodeError if it is not UTF-8."""
    return demand_regular(path).read_text(encoding="utf-8")


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        OSError: there is none, or it is no regular file.
        ValueError: it is no JSON in UTF-8, or nested too deeply.
    """
    try:
        return json.loads(read_text(path))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a name beside `path` to write to, which becomes `path` when the block ends well.

    Who reads `path` finds the old file or the new one. What a failed block has left is removed, and so is what a process that
    was killed has left of this file; folders are made.

    Raises:
        OSError: it cannot be written there, or the disk is full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a file of UTF-8 whole or not at all. Raises OSError as `replacing`."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file whole or not at all. Raises OSError as `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def sweep(path: Path, prefix: str = ".", ending: str = "") -> None:
    """Remove what processes that have ended have left beside a file or folder that they were writing.

    A process of another machine does not exist here; of folders, which take longer than SETTLED_S, the lock of what is written
    keeps it away.

    Names of temporaries begin with `prefix`, then its own name, a dot and the number of the process; the regular expression
    `ending` says what follows.
    """
    form = re.compile(rf"{re.escape(prefix + path.name)}\.(\d+){ending}")
    for left in path.parent.glob(f"{prefix}{glob.escape(path.name)}.*"):
        number = form.fullmatch(left.name)
        if number is None or _is_alive(int(number[1])) or time.time() - left.lstat().st_mtime <= SETTLED_S:
            continue
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def remove_written(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """Remove files that were written here, and folders that become empty; whatever else lies there stays.

    Args:
        folder: of which it is known that xew made it.
        patterns: of the paths of its files, relative to the folder, as `fnmatch` reads them; `*` stands for levels, too.

    Returns:
        What has stayed. Links are removed themselves, never what they lead to.

    Raises:
        OSError: something cannot be removed.
    """
    left: list[Path] = []
    for path in sorted(folder.rglob("*"), reverse=True):  # what lies in a folder before the folder
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()):
                path.rmdir()
        elif any(fnmatch.fnmatch(path.relative_to(folder).as_posix(), pattern) for pattern in patterns):
            path.unlink()
        else:
            left.append(path)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    return left


@contextmanager
def hold_lock(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of a folder or file that a command writes, until the block or the process ends.

    The lock is a file beside it, `.NAME.lock`, which says who holds it and goes with the lock. Where none can be made, because
    the file system has no locks or nothing may be written beside, there is none.

    Args:
        path: what is written.
        wait: for another process that holds it, which is said once on stderr.

    Raises:
        EpisodeError: another process holds it and is not waited for; the message says which.
    """
    path = path.absolute()
    beside, told = path.with_name(f".{path.name}.lock"), False
    while True:
        try:
            file = _lock(path, beside)
            break
        except EpisodeError as error:
            if not wait:
                raise
            if not told:
                print(f"waiting: {str(error).partition(';')[0]}", file=sys.stderr, flush=True)
                told = True
            time.sleep(POLL_S)
    try:
        yield
    finally:
        if file is not None:
            Path(file.name).unlink(missing_ok=True)
            file.close()


def _lock(path: Path, beside: Path) -> IO[str] | None:
    """The locked file, open; None where there can be none. Raises EpisodeError as `hold_lock`."""
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = beside.open("a+", encoding="utf-8")
        except OSError:
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not beside.exists() or os.fstat(file.fileno()).st_ino != beside.stat().st_ino:
                file.close()
                continue  # it was removed by who held it, after it was opened here
        except BlockingIOError as error:
            file.seek(0)
            holder = " ".join(file.read().split()) or "another process"
            file.close()
            raise EpisodeError(
                f"{path} is being written by {holder}; wait for it, stop it, or choose another --out."
            ) from error
        except OSError:
            file.close()
            return None
        holder = f"process {os.getpid()} on {socket.gethostname()} ({Path(sys.argv[0]).stem})\n"
        with contextlib.suppress(OSError):  # it is locked on a full disk, too, and says less
            os.truncate(file.fileno(), 0)
            os.write(file.fileno(), holder.encode())
        return file


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal digits. Raises OSError if it cannot be read."""
    with demand_regular(path).open("rb") as file:
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


def cache_folder(name: str) -> Path:
    """The user's folder for what xew can make again, such as compiled programs; it need not be there yet."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "xew" / name
