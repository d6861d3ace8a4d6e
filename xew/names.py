"""Names, paths and texts from files of unknown origin: data sets, rollouts, runs and score tables.

A name from such a file becomes part of a path only through `check_name` and `path_below`. A text enters Markdown or CSV only
through `plain_markdown` or `csv_text`, and a message only through a `UserError`.
"""

import re
import reprlib
from pathlib import Path, PurePosixPath
from typing import Any

NAME = re.compile(r"\w[\w.+-]*(?::[^\W\d]\w*)?")
"""Form of the name of a task or robot in a file: a key or `module:NAME`, never a path, a hidden file or an option."""
MOST_LETTERS = 200
"""Largest length of a name [bytes]; file systems take 255 with an ending."""
SHOWN_LETTERS = 80
"""Largest number of letters of an invalid name or value in a message."""
LONGEST_LINE = 2000
"""Largest number of letters of a line of a message."""
MOST_LINES = 100
"""Largest number of lines of a message."""
LINE_ENDS = re.compile(r"\s*[\r\n]+\s*")
ACTIVE_TAG = re.compile(
    r"<(?=[A-Za-z/!?])(?!(?!base|embed|form|iframe|link|math|meta|object|plaintext|script|style|svg|template|textarea|title|xmp)"
    r"[a-z]+>)"
)
"""Beginnings of HTML tags in Markdown, except formatting tags without attributes."""


class UserError(Exception):
    """A mistake of the user or in a file, with the remedy.

    Each argument is a line of the message, see `plain_line`.
    """

    def __str__(self) -> str:
        lines = [plain_line(str(line)) for line in self.args[:MOST_LINES]]
        more = len(self.args) - MOST_LINES
        return "\n".join(lines + ([f"and {more} more"] if more > 0 else []))


class EpisodeError(UserError):
    """An episode or a file that belongs to one is missing or invalid; the message says what to do."""


def check_name(name: object, what: str) -> str:
    """The name of a task or robot from a file, checked for use as a folder name.

    Raises:
        EpisodeError: it is no text, too long, or does not match `NAME`, for example a path.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name) or len(name.encode()) > MOST_LETTERS:
        raise EpisodeError(
            f"the {what} is {shorten(name)}, expected a key of letters, digits, _, -, + and dots, or module:NAME; correct it "
            "in its file, or remove the file."
        )
    return name


def folder_name(name: str) -> str:
    """The folder name of a task or robot: without colons, which Windows and scp do not accept."""
    return name.replace(":", "@")


def name_of_folder(folder: str) -> str:
    """The name of the task or robot of a folder name."""
    return folder.replace("@", ":")


def check_label(text: object, what: str) -> str:
    """The name of a model or condition from a file, checked for printing; it may have spaces and slashes.

    Raises:
        EpisodeError: it is not printable text, or is a path that leads out of its folder.
    """
    if not isinstance(text, str) or not text.isprintable() or len(text) > MOST_LETTERS:
        raise EpisodeError(f"the {what} is {shorten(text)}, expected printable text of at most {MOST_LETTERS} letters.")
    if text.startswith(("/", "~")) or "\\" in text or ".." in PurePosixPath(text).parts:
        raise EpisodeError(f"the {what} is {shorten(text)}, a path that leads out of its folder; give it a plain name.")
    return text


def path_below(root: Path, *names: str) -> Path:
    """The path of names below a root; links are resolved to check its target.

    Raises:
        EpisodeError: the target is not below the root, or links form a circle.
    """
    path = Path(root, *names)
    try:
        end, top = path.resolve(), Path(root).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise EpisodeError(f"{path} cannot be resolved ({error}); replace the link with the folder or file.") from error
    if end == top or not end.is_relative_to(top):
        raise EpisodeError(f"{path} leads to {end}, which is not below {root}; replace the link with the folder or file.")
    return path


def demand_utf8(path: Path) -> None:
    """Raise EpisodeError if a path is not UTF-8, for Arrow, Orbax and TensorBoard open no others."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise EpisodeError(f"the path {path} is not UTF-8; rename the folder or file.") from error


def shorten(value: object) -> str:
    """The beginning of the `repr` of a value of any size."""
    text = _SHORT.repr(value)
    return text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}…"


_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 10 * SHOWN_LETTERS, 10 * SHOWN_LETTERS


def plain_line(text: str) -> str:
    """Text as one line of at most LONGEST_LINE letters; control characters and surrogates become escapes such as \\x1b."""
    text = LINE_ENDS.sub(" ", text)
    if len(text) > LONGEST_LINE:
        text = f"{text[: LONGEST_LINE - 500]} … {text[-400:]}"  # the remedy stands at the end
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def plain_markdown(text: str) -> str:
    """Text escaped for Markdown: it opens no link, picture, table cell or active HTML tag."""
    return ACTIVE_TAG.sub(r"\\<", text.replace("|", r"\|")).replace("](", r"]\(")


def csv_text(frame: Any) -> str:
    """A pandas table as CSV without its index; texts that a spreadsheet would read as formulas get a leading quote."""
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
