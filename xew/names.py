"""Names, paths and texts that files give, for all rooms. Data sets, rollouts, runs and score tables may be anybody's.

A name that one of them holds becomes part of a path only through `check_name` and `path_below`, and a text goes into Markdown
and CSV through `plain_markdown` and `csv_text`.
"""

import re
from pathlib import Path, PurePosixPath
from typing import Any

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


class EpisodeError(Exception):
    """An episode, or another thing on disk that should hold one, is not as it should be; the message says what to do."""


def check_name(name: object, what: str) -> str:
    """The name of a task or robot, as a file gives it, where it is fit to be a folder's name.

    Raises:
        EpisodeError: it is no text, too long, or has other characters than `NAME`; a path is refused so.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name) or len(name.encode()) > MOST_LETTERS:
        raise EpisodeError(
            f"the {what} is {_shorten(name)}, expected a key of letters, digits, _, -, + and dots, or module:NAME; correct it "
            "where it stands, or leave that file out."
        )
    return name


def folder_name(name: str) -> str:
    """The name of a task or robot as a folder's: no colon, which Windows does not allow and scp takes for the end of a host."""
    return name.replace(":", "@")


def name_of_folder(folder: str) -> str:
    """The name of a task or robot by its folder's."""
    return folder.replace("@", ":")


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
