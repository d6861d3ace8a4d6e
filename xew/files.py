"""Files, for all rooms: names and paths that files give, files written whole or not at all, and digests of their content.

Data sets, rollouts, runs and score tables come from anybody. A name that one of them holds becomes part of a path only through
`check_name` and `path_below`, and what is opened is a regular file (`demand_regular`).
"""

import errno
import fcntl
import fnmatch
import glob
import hashlib
import json
import os
import re
import socket
import stat
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any

NAME = re.compile(r"\w[\w.+-]*(?::[^\W\d]\w*)?")
"""Form of the name of a task or robot in a file: a key, or `module:NAME`. It is no path, neither hidden nor an option."""
MOST_LETTERS = 200
"""Largest length of a name [bytes]; file systems take 255 with an ending."""
SHOWN_LETTERS = 80
"""Largest number of letters of a wrong name that a message shows."""
ACTIVE_TAG = re.compile(
    r"<(?=[A-Za-z/!?])(?!(?!base|embed|form|iframe|link|math|meta|object|plaintext|script|style|svg|template|textarea|title|xmp)"
    r"[a-z]+>)"
)
"""Beginnings of HTML tags in Markdown, but for those without attributes that only format, as <frame> in a name."""
SETTLED_S = 2.0
"""Age from which the file of a process that does not exist here is taken for left [s]; on another machine it may exist."""
KINDS = {stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
"""Names of what a path may lead to that is neither a file nor a folder, by the type in its mode."""


RUN_MARK = ".xew-run"
"""Name of the file that marks the folder of a run; runs of earlier versions have none."""
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
"""Patterns of the paths of what trainings write into the folder of a run."""


class EpisodeError(Exception):
    """An episode, or another thing on disk that should hold one, is not as it should be; the message says what to do."""


def check_name(name: object, what: str) -> str:
    """The name of a task or robot, as a file gives it, where it is fit to be a folder's name.

    Args:
        name: as found.
        what: it names, for the message.

    Raises:
        EpisodeError: it is no text, too long, or has other characters than `NAME`; a path is refused so.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name) or len(name.encode()) > MOST_LETTERS:
        raise EpisodeError(
            f"the {what} is {_shorten(name)}, expected a key of letters, digits, _, -, + and dots, or module:NAME; correct it "
            "where it stands, or leave that file out."
        )
    return name


def check_label(text: object, what: str) -> str:
    """The name of a model or condition, as a file gives it, where it is fit to print; it may have spaces and slashes.

    Raises:
        EpisodeError: it is no printable text, or reads as a path to elsewhere.
    """
    if not isinstance(text, str) or not text.isprintable() or len(text) > MOST_LETTERS:
        raise EpisodeError(f"the {what} is {_shorten(text)}, expected printable text of at most {MOST_LETTERS} letters.")
    if text.startswith(("/", "~")) or "\\" in text or ".." in PurePosixPath(text).parts:
        raise EpisodeError(f"the {what} is {_shorten(text)}, which reads as a path to elsewhere; give it a plain name.")
    return text


def _shorten(name: object) -> str:
    text = repr(name)
    return text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}…"


def plain_markdown(text: str) -> str:
    """Text as part of Markdown, in which it opens no link, picture, cell of a table, or HTML tag that does anything."""
    return ACTIVE_TAG.sub(r"\\<", text.replace("|", r"\|")).replace("](", r"]\(")


def csv_text(frame: Any) -> str:
    """A table (pandas) as CSV without its index; texts that would begin a spreadsheet's formula get a quote in front."""
    texts = {column: frame[column].map(_plain_cell) for column in frame if frame[column].dtype.kind not in "biufcmM"}
    return frame.assign(**texts).rename(columns=_plain_cell).to_csv(index=False)


def _plain_cell(value: object) -> object:
    if not isinstance(value, str) or len(value) < 2 or value[0] not in "=+-@\t\r":
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def path_below(root: Path, *names: str) -> Path:
    """The path of names below a root, with links followed to see where it ends.

    Raises:
        EpisodeError: it ends elsewhere than below the root, or links lead in a circle.
    """
    path = Path(root, *names)
    try:
        end, top = path.resolve(), Path(root).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise EpisodeError(f"{path} leads nowhere ({error}); put the folder or file itself there.") from error
    if end == top or not end.is_relative_to(top):
        raise EpisodeError(f"{path} leads to {end}, which is not below {root}; put the folder or file itself there.")
    return path


def demand_regular(path: Path) -> Path:
    """The path itself, where it is that of a regular file. Others may block for ever or never end.

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
    _sweep(path)
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


def _sweep(path: Path) -> None:
    """Remove what processes that have ended have left of a file that they were writing."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*"):
        number = left.name.rpartition(".")[2]
        if number.isdecimal() and not _is_alive(int(number)) and time.time() - left.stat().st_mtime > SETTLED_S:
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


def is_run(folder: Path) -> bool:
    """Whether a training has made a folder, by its mark; in earlier versions by a config beside what trainings write."""
    if (folder / RUN_MARK).is_file():
        return True
    return (folder / "config.yaml").is_file() and any(
        (folder / name).exists() for name in ("codec", "checkpoints", "metrics.jsonl")
    )


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a folder or file that a command writes, until the block or the process ends.

    The lock is a file beside it, `.NAME.lock`, which says who holds it and goes with the lock. Where none can be made, because
    the file system has no locks or nothing may be written beside, there is none.

    Raises:
        EpisodeError: another process holds it; the message says which.
    """
    path = path.absolute()
    file = _lock(path, path.with_name(f".{path.name}.lock"))
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
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()} ({Path(sys.argv[0]).stem})\n")
            file.flush()
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


def checkpoint_time(run: Path, step: int) -> int | None:
    """When a run's checkpoint was begun [ns], which tells it from another of the same step; None if there is none."""
    try:
        return read_json(run / "checkpoints" / str(step) / "_CHECKPOINT_METADATA")["init_timestamp_nsecs"]
    except (OSError, ValueError, KeyError):
        return None


def cache_folder(name: str) -> Path:
    """The user's folder for what xew can make again, such as compiled programs; it need not be there yet."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "xew" / name
