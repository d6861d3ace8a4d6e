"""File operations for all packages: read regular files, write files atomically, lock, remove and digest them.

Every file is written by `replacing`, `write_text`, `write_bytes` or `open_own`, or into a new folder of
`xew.episode.complete_folder`. They create files under random names and follow no link below the folder that the user named.
"""

import contextlib
import errno
import fcntl
import fnmatch
import glob
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import stat
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO, Any, Literal

from xew.names import EpisodeError, demand_utf8, shorten

POLL_S = 0.2
"""Interval at which a lock that another process holds is polled [s]."""
SETTLED_S = 2.0
"""Age above which a temporary file whose process does not run on this machine counts as abandoned [s]."""
UNIQUE = "(-[0-9a-f]+)?"
"""Pattern of the random end of a temporary name."""
KINDS = {stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
"""Names of the file types that are neither regular files nor folders, by their mode bits."""


def demand_regular(path: Path) -> Path:
    """Return the path if it leads to a regular file. Reading another kind may block forever.

    Raises:
        OSError: it is a FIFO, a socket, a device or a folder, or does not exist (FileNotFoundError).
    """
    mode = os.stat(path).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder, expected a file", str(path))
    if not stat.S_ISREG(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "no file")
        raise OSError(errno.EINVAL, f"is {kind}, expected a regular file", str(path))
    return Path(path)


def read_text(path: Path) -> str:
    """The text of a regular file. Raises OSError as `demand_regular`, UnicodeDecodeError if it is not UTF-8."""
    return demand_regular(path).read_text(encoding="utf-8")


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises OSError as `demand_regular`, ValueError if it is not valid JSON in UTF-8."""
    try:
        return parse_json(read_text(path))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


@dataclass(frozen=True)
class LoadedFile:
    """A file in memory, so what is digested is what is decoded, even if the file is replaced meanwhile."""

    path: Path
    content: bytes = field(repr=False)

    def __str__(self) -> str:
        return str(self.path)

    @cached_property
    def digest(self) -> str:
        """Hexadecimal SHA-256."""
        return hashlib.sha256(self.content).hexdigest()


def load_file(path: "Path | LoadedFile") -> LoadedFile:
    """Read a file, unless it is in memory. Raises OSError as `demand_regular`."""
    return path if isinstance(path, LoadedFile) else LoadedFile(Path(path), demand_regular(path).read_bytes())


def parse_json(text: str | bytes) -> Any:
    """The content of a JSON text. Raises ValueError if it is not JSON or has a key twice, RecursionError."""
    return json.loads(text, object_pairs_hook=_demand_unique)


def _demand_unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"it has the key {shorten(next(key for key in keys if keys.count(key) > 1))} twice")
    return content


def check_place(path: Path, *, within: Path) -> None:
    """Raise OSError unless a file can be written at a path that follows no link below a folder.

    Args:
        path: the file, which may not exist yet.
        within: folder that the user named, which may be a link itself.
    """
    folder = within
    for name in path.relative_to(within).parts[:-1]:
        folder = folder / name
        if folder.is_symlink():
            raise OSError(
                errno.ELOOP,
                f"is a link, and no link below {within} is followed to write: put the folder itself there",
                str(folder),
            )
    if path.exists():
        demand_regular(path)


def demand_no_links(folder: Path) -> None:
    """Raise OSError if a folder that is to be written holds a link, at any depth."""
    for parent, folders, files in os.walk(folder):
        for path in (Path(parent, name) for name in (*folders, *files)):
            if path.is_symlink():
                raise OSError(
                    errno.ELOOP,
                    f"is a link, and no link below {folder} is followed to write: put the file or folder itself there",
                    str(path),
                )


def open_own(path: Path, mode: Literal["x", "a", "a+"]) -> IO[str]:
    """Open a text file for writing; x creates it.

    Raises:
        OSError: the path is a link or no regular file, or with x exists.
    """
    return open(path, mode, encoding="utf-8", opener=_open_regular)


def _open_regular(path: str, flags: int) -> int:
    """Open a file without following a link or waiting for the reader of a FIFO, and return its descriptor."""
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        demand_regular(Path(path))
    return descriptor


@contextmanager
def replacing(path: Path, *, within: Path) -> Iterator[Path]:
    """Yield the name of a new, empty file next to `path`, which is renamed to `path` if the block succeeds.

    Readers of `path` see the old file or the new one. Parent folders are created. Temporary files of a failed block or of a
    killed process are removed. A link at `path` itself is replaced.

    Args:
        path: the file to write.
        within: folder that the user named, below which no link is followed.

    Raises:
        OSError: as `check_place`, the file cannot be written, or the disk is full.
    """
    check_place(path, within=within)
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep(path, ending=UNIQUE)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}")
    open_own(temporary, "x").close()
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str, *, within: Path) -> None:
    """Write a UTF-8 file atomically. Raises OSError as `replacing`."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"), within=within)  # of names that are not UTF-8


def write_bytes(path: Path, content: bytes, *, within: Path) -> None:
    """Write a file atomically. Raises OSError as `replacing`."""
    with replacing(path, within=within) as temporary:
        temporary.write_bytes(content)


def copy_file(source: Path, path: Path, *, within: Path) -> None:
    """Copy a regular file atomically, with its times. Raises OSError as `replacing`."""
    with replacing(path, within=within) as temporary:
        shutil.copy2(demand_regular(source), temporary)


def copy_tree(source: Path, folder: Path, *, within: Path) -> None:
    """Copy the files of a folder into another, without links and hidden files. Raises OSError as `replacing`."""
    for path in sorted(source.rglob("*")):
        name = path.relative_to(source)
        if path.is_file() and not path.is_symlink() and not any(part.startswith(".") for part in name.parts):
            copy_file(path, folder / name, within=within)


def sweep(path: Path, prefix: str = ".", ending: str = "") -> None:
    """Remove temporary files and folders that ended processes left next to a path that they were writing.

    Temporary names are `prefix`, the name of the path, a dot, the process number, and a match of the regular expression
    `ending`. A live process on another machine is protected by SETTLED_S, or by the lock of the path.
    """
    form = re.compile(rf"{re.escape(prefix + path.name)}\.(\d+){ending}")
    for candidate in path.parent.glob(f"{prefix}{glob.escape(path.name)}.*"):
        match = form.fullmatch(candidate.name)
        if match is None or _is_alive(int(match[1])) or time.time() - candidate.lstat().st_mtime <= SETTLED_S:
            continue
        if candidate.is_dir() and not candidate.is_symlink():
            shutil.rmtree(candidate, ignore_errors=True)
        else:
            candidate.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def remove_written(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """Remove the matching files of a folder, then empty folders, and return the files that stay.

    Links are removed themselves, never their targets.

    Args:
        folder: a folder that xew wrote.
        patterns: `fnmatch` patterns of paths relative to the folder; `*` also matches `/`.

    Raises:
        OSError: a file cannot be removed.
    """
    foreign: list[Path] = []
    for path in sorted(folder.rglob("*"), reverse=True):  # files before their folder
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()):
                path.rmdir()
        elif any(fnmatch.fnmatch(path.relative_to(folder).as_posix(), pattern) for pattern in patterns):
            path.unlink()
        else:
            foreign.append(path)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    return foreign


@contextmanager
def hold_lock(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a folder or file that a command writes, until the block or the process ends.

    The lock file `.NAME.lock` next to it names the holder and is removed with the lock. No lock is taken where the file system
    has none or the lock file cannot be written. An output that is neither a regular file nor a folder is refused here.

    Args:
        path: the folder or file to lock.
        wait: wait for another holder, announced once on stderr.

    Raises:
        EpisodeError: another process, named in the message, holds the lock and `wait` is false, the lock is a link, or the
            path is not UTF-8.
        OSError: the output is a device, a FIFO, a socket or the root of the file system.
    """
    path = path.absolute()
    demand_utf8(path)
    if not path.name:
        raise IsADirectoryError(errno.EISDIR, "is the root of the file system, expected a folder or file below it", str(path))
    if path.exists() and not path.is_dir():
        demand_regular(path)
    lock_file, announced = path.with_name(f".{path.name}.lock"), False
    while True:
        try:
            file = _lock(path, lock_file)
            break
        except EpisodeError as error:
            if not wait:
                raise
            if not announced:
                print(f"waiting: {str(error).partition(';')[0]}", file=sys.stderr, flush=True)
                announced = True
            time.sleep(POLL_S)
    try:
        yield
    finally:
        if file is not None:
            Path(file.name).unlink(missing_ok=True)
            file.close()


def _lock(path: Path, lock_file: Path) -> IO[str] | None:
    """The open locked file; None where locks are not possible. Raises EpisodeError as `hold_lock`."""
    while True:
        if lock_file.is_symlink() or (lock_file.exists() and not lock_file.is_file()):
            raise EpisodeError(f"{lock_file} is a link or no regular file, and so no lock of xew; remove it.")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = open_own(lock_file, "a+")
        except OSError:
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not lock_file.exists() or os.fstat(file.fileno()).st_ino != lock_file.stat().st_ino:
                file.close()
                continue  # its former holder removed it after it was opened here
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
        with contextlib.suppress(OSError):  # on a full disk the lock holds without the name of its holder
            os.truncate(file.fileno(), 0)
            os.write(file.fileno(), holder.encode())
        return file


def file_digest(path: Path) -> str:
    """Hexadecimal SHA-256 of a file. Raises OSError if it cannot be read."""
    with demand_regular(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_files(paths: Sequence[Path]) -> str:
    """SHA-256 of one file, or of the digests of several in order. Raises OSError if one cannot be read."""
    return join_digests([file_digest(path) for path in paths])


def join_digests(digests: Sequence[str]) -> str:
    """The digest of one file, or the SHA-256 of the digests of several."""
    return digests[0] if len(digests) == 1 else hashlib.sha256(b"".join(map(bytes.fromhex, digests))).hexdigest()


def digest_tree(path: Path) -> str:
    """SHA-256 of a file, or of the names and digests of a folder's files."""
    if not path.is_dir():
        return file_digest(path)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    lines = [f"{file_digest(file)} {file.relative_to(path).as_posix()}" for file in files]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def cache_folder(name: str) -> Path:
    """The user's cache folder of this name, for reproducible data such as compiled programs; it may not exist yet."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "xew" / name
