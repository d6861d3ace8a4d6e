"""What several benchmarks need: versions, whether a package is there, a data set that is checked, and labels on pictures."""

import platform
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import numpy as np

from xew.concurrency import usable_cores
from xew.dataset import find_accepted
from xew.episode import Record, verify_episode

SAMPLE = 200
"""Number of episodes that are read back and compared with their hashes."""


def is_installed(package: str) -> bool:
    try:
        return bool(version(package))
    except PackageNotFoundError:
        return False


def format_versions(packages: Sequence[str]) -> str:
    """Python and the packages that are installed, with their versions."""
    named = [f"{name} {version(name)}" for name in packages if is_installed(name)]
    return ", ".join([f"Python {platform.python_version()}", *named])


def check_episodes(data: Path, expected: int, videos: bool = True) -> list[Record]:
    """The headers of all accepted episodes.

    Raises AssertionError unless there are as many as expected, all of them successes, and those of a sample read back have the
    hashes of their headers.
    """
    accepted = find_accepted(data)
    assert len(accepted) == expected, f"{data} has {len(accepted)} episodes, expected {expected}"
    for _, record in accepted:
        assert record.success and record.videos == videos
        assert set(record.hashes) == {"states", "rgb", "robot"}
    sample = np.unique(np.linspace(0, len(accepted) - 1, SAMPLE).round().astype(int))
    with ThreadPoolExecutor(usable_cores()) as pool:
        list(pool.map(verify_episode, [accepted[index][0] for index in sample]))
    return [record for _, record in accepted]


def intersection_over_union(first: np.ndarray, second: np.ndarray) -> float:
    """Agreement of two masks [h w] bool."""
    return float((first & second).sum() / (first | second).sum())


def label_picture(image: np.ndarray, label: str) -> np.ndarray:
    """A picture [h w 3] at twice its size with a label [2h 2w 3]."""
    image = cv2.resize(np.ascontiguousarray(image), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    return cv2.putText(image, label, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (200, 0, 0), 1, cv2.LINE_AA)
