"""Data sets: the index of a folder of episodes, read once per process and refreshed when the folder has changed.

`read_dataset` lists the folder each time, but opens only headers that are new or have changed since the last read.
"""

import contextlib
import os
import shutil
import time
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path

from xew.episode import TEMPORARY, EpisodeError, Record, data_folder, exact_rate, read_record
from xew.files import check_place
from xew.names import check_name, folder_name
from xew.protocol import HEAD, MOTIONS, RANDOM_CHANGE, seed_split, split_fault

Episode = tuple[Path, Record]
"""Folder and header of one cell."""
Signature = tuple[int, int, int, int]
"""Inode, size, time of change and of status change [ns] of a header's file."""

VIEWS = "views"
"""Folder of the views besides `head` in a data set."""
UNSETTLED_NS = 100_000_000
"""Age [ns] below which a header is read again next time: two writes within one clock tick have equal time stamps."""

_READ: dict[Path, dict[Path, tuple[Signature, Record]]] = {}
"""Headers that this process has read, by the data set's absolute path and the episode's folder in it."""


@dataclass(frozen=True)
class Dataset:
    """The cells of a data set as they were when it was read."""

    root: Path
    cells: tuple[Episode, ...]
    """All cells with their headers, accepted or not, sorted by task, seed and robot."""

    @cached_property
    def accepted(self) -> tuple[Episode, ...]:
        """Episodes of seeds on which no robot was refused: the paired data set. Raises EpisodeError if there is none."""
        failed = {(record.task, record.seed) for _, record in self.cells if not record.is_recorded}
        accepted = tuple((folder, record) for folder, record in self.cells if (record.task, record.seed) not in failed)
        if not accepted:
            raise explain_missing(self.root, "accepted episode")
        return accepted

    @property
    def robots(self) -> list[str]:
        """Robots of accepted episodes, sorted."""
        return sorted({record.robot for _, record in self.accepted})

    def select(
        self,
        *,
        robots: Collection[str] | None = None,
        tasks: Collection[str] | None = None,
        split: str | None = None,
        motion: str | None = None,
        faults: bool = True,
    ) -> list[Episode]:
        """Accepted episodes of these robots, tasks and seed family; None selects all. The list may be empty.

        Args:
            motion: required kind of motion (`Split.motion`); None accepts any.
            faults: whether to select faulty episodes too.

        Raises:
            EpisodeError: the data set has no accepted episode, or a selected one has another kind of motion.
        """
        chosen = [
            (folder, record)
            for folder, record in self.accepted
            if (robots is None or record.robot in robots)
            and (tasks is None or record.task in tasks)
            and split in (None, seed_split(record.seed))
            and (faults or not record.fault)
        ]
        if motion is not None:
            demand_motion(self.root, (record for _, record in chosen), motion)
        return chosen


def read_dataset(data: Path, problems: list[str] | None = None) -> Dataset:
    """Read the index of a data set, or refresh what this process has of it.

    Args:
        data: root of the data set.
        problems: list to which one message is added for each damaged header, which is then left out.

    Raises:
        EpisodeError: a header is damaged and `problems` is None.
    """
    root = Path(data).absolute()
    before = _READ.get(root, {})
    headers: dict[Path, tuple[Signature, Record]] = {}
    cells: list[Episode] = []
    folders = (path.parent for path in Path(data).glob("*/*/*/episode.json"))
    for folder in sorted(folder for folder in folders if not folder.name.startswith(TEMPORARY)):
        name = folder.relative_to(data)
        try:
            signature, known = _sign(folder), before.get(name)
            record = known[1] if known is not None and known[0] == signature else read_record(folder)
        except FileNotFoundError:
            continue  # the cell is being replaced
        except EpisodeError as error:
            if isinstance(error.__cause__, FileNotFoundError):
                continue
            if problems is None:
                raise
            problems.append(str(error))
            continue
        cells.append((folder, record))
        if time.time_ns() - signature[3] > UNSETTLED_NS:
            headers[name] = signature, record
    _READ[root] = headers
    return Dataset(Path(data), tuple(cells))


def _sign(folder: Path) -> Signature:
    status = os.stat(folder / "episode.json")
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def find_records(data: Path) -> Iterator[Episode]:
    """All cells of a data set with their headers, accepted or not. Raises EpisodeError at a damaged header."""
    return iter(read_dataset(data).cells)


def find_accepted(data: Path) -> list[Episode]:
    """`Dataset.accepted` of a data set."""
    return list(read_dataset(data).accepted)


def name_number(record: Record) -> int:
    """Number of an episode by its task, seed and robot, for its random numbers."""
    return zlib.crc32(f"{record.task}/{record.seed}/{record.robot}".encode())


def holds_faults(data: Path) -> bool:
    """Whether a data set holds episodes of faulty commands, by the names of its folders."""
    return any(path.name.isdecimal() and split_fault(int(path.name))[0] for path in Path(data).glob("*/*"))


def demand_motion(data: Path, records: Iterable[Record], motion: str) -> None:
    """Raise EpisodeError if an episode has another kind of motion than `Split.motion`."""
    counts = count_motions(records)
    if set(counts) - {motion}:
        raise EpisodeError(
            f"{data} has {_list_motions(counts)}, and the split is of {motion} motion; choose a split of the other kind "
            "(--split fixed, fixed_own)."
        )


def demand_one_motion(data: Path, records: Iterable[Record]) -> str:
    """The kind of motion of a data set's episodes, one of `MOTIONS`. Raises EpisodeError if they have both."""
    counts = count_motions(records)
    if len(counts) > 1:
        raise EpisodeError(f"{data} has {_list_motions(counts)}, which cannot be compared; keep them in separate data sets.")
    return next(iter(counts), MOTIONS[0])


def demand_one_change(data: Path, records: Iterable[Record]) -> str:
    """The change of a data set's episodes: empty, one, or RANDOM_CHANGE. Raises EpisodeError if only some have a change."""
    counts = Counter(record.change for record in records)
    if len(counts) > 1 and "" in counts:
        changed = ", ".join(sorted(change for change in counts if change)[:3])
        raise EpisodeError(
            f"{data} has {counts['']} unchanged episodes and {counts.total() - counts['']} with a change ({changed}), which "
            "cannot be compared; keep them in separate data sets."
        )
    return RANDOM_CHANGE if len(counts) > 1 else next(iter(counts), "")


def demand_one_rate(data: Path, records: Iterable[Record]) -> Fraction:
    """The frame rate [Hz] of episodes, of which there is at least one. Raises EpisodeError if they have several."""
    counts = Counter(exact_rate(record.frame_rate) for record in records)
    if len(counts) > 1:
        rates = " and ".join(f"at {float(rate):.2f} ({count})" for rate, count in sorted(counts.items()))
        raise EpisodeError(
            f"{data} has episodes {rates} frames per second, which cannot be mixed; choose robots or tasks of one rate, or "
            "keep them in separate data sets."
        )
    return next(iter(counts))


def count_motions(records: Iterable[Record]) -> dict[str, int]:
    """Numbers of episodes by kind of motion, in the order of `MOTIONS`, without kinds that have none."""
    counts = Counter(record.motion for record in records)
    return {motion: counts[motion] for motion in MOTIONS if counts[motion]}


def _list_motions(counts: dict[str, int]) -> str:
    return "episodes " + " and ".join(f"of {motion} motion ({count})" for motion, count in counts.items())


def view_folder(data: Path, view: str) -> Path:
    """The root of a view's data set: of `head` the data set itself.

    Raises:
        EpisodeError: the data set has no such view.
    """
    if view == HEAD:
        return Path(data)
    folder = Path(data) / VIEWS / folder_name(check_name(view, "view"))
    if not folder.is_dir():
        known = ", ".join([HEAD, *list_views(data)])
        raise EpisodeError(
            f"{data} has no view {view!r}, but {known}; add it by `python -m xew.sim_warp.inspect {data} --render --cameras "
            "NAME [--size 640x480]`."
        )
    return folder


def view_episode(folder: Path, view: str) -> Path:
    """The folder of an episode, of any view, in a view of its data set. Raises EpisodeError if the view does not have it."""
    seen = view_folder(base_data(data_folder(folder)), view).joinpath(*folder.absolute().parts[-3:])
    if not seen.is_dir():
        raise EpisodeError(f"the view {view} has no episode {seen}; run `inspect DATA --render --cameras …` again to add it.")
    return seen


def is_stale(record: Record) -> bool:
    """Whether an episode is of a view that an earlier version rendered, without the table that hides the robot."""
    return record.camera.name != HEAD and record.table is None


def list_views(data: Path) -> list[str]:
    """Names of a data set's views besides `head`, sorted."""
    return sorted(folder.name for folder in Path(data, VIEWS).glob("[!.]*") if folder.is_dir())


def base_data(data: Path) -> Path:
    """The data set that a view's data set lies in; another data set is its own."""
    root = Path(data).absolute()
    is_view = root.parent.name == VIEWS and next(root.parents[1].glob("*/*/*/episode.json"), None) is not None
    return root.parents[1] if is_view else Path(data)


def folder_beside(data: Path, name: str) -> Path:
    """The folder for what is made of a data set, `<data>-NAME`; of a view, below that of the data set."""
    base, data = base_data(data), Path(data)
    folder = base.with_name(f"{base.name}-{name}")
    return folder if base == data else folder / VIEWS / data.name


def explain_missing(data: Path, what: str = "episode") -> EpisodeError:
    """The error for a folder without episodes; for a folder inside a data set it names the data set."""
    for levels, pattern in enumerate(("*/*/episode.json", "*/episode.json", "episode.json")):
        if next(Path(data).glob(pattern), None):
            root = Path(data).absolute().parents[levels]
            return EpisodeError(f"{data} lies inside a data set; pass the data set's root: {root}.")
    return EpisodeError(f"no {what} under {data}; make some: python -m xew.sim_warp.generate --out {data}")


def remove_left_overs(data: Path) -> None:
    """Remove incomplete episodes and robots of killed runs, except where links lead."""
    for folder in [*Path(data).glob(f"*/*/{TEMPORARY}*"), *Path(data).glob(f"*/{TEMPORARY}*")]:
        with contextlib.suppress(OSError):
            check_place(folder / "file", within=Path(data))
            shutil.rmtree(folder, ignore_errors=True)
