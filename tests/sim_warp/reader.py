"""Somebody who reads a data set while it is made; a module of its own, for its process need not import the simulator."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from xew.dataset import find_accepted
from xew.episode import EpisodeError, Record, read_states, read_video, verify_episode


@dataclass
class Reading:
    """What a reader saw."""

    wrong: list[str] = field(default_factory=list)
    """Whatever was not whole."""
    rounds: int = 0
    episodes: int = 0


def read_on(out: Path, stop: Any, result: Any) -> None:
    """Read all that is there, again and again, as an evaluation beside a running `generate` would; a process of its own."""
    seen = Reading()
    while not stop.is_set():
        seen.rounds += 1
        try:
            for folder, record in _accepted(out)[-4:]:
                if verify_episode(folder) != record or len(read_video(folder / "rgb.mkv")) != read_states(folder).frame_count:
                    seen.wrong.append(f"{folder} is not what its header says")
                seen.episodes += 1
        except Exception as error:  # whatever comes of something that is not whole
            seen.wrong.append(f"{type(error).__name__}: {error}")
        stop.wait(0.05)
    result.put(seen)


def _accepted(out: Path) -> list[tuple[Path, Record]]:
    try:
        return find_accepted(out)
    except EpisodeError as error:
        if str(error).startswith("no accepted episode"):
            return []
        raise
