"""How much of robots and of moving objects the camera sees, as Markdown.

It is a table of all tasks and robots, and one of what is below the aims.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from xew.sim_warp.production.surfaces import Seen, Visibility
from xew.sim_warp.robots import ROBOTS

NEEDED_OF_ROBOT, NEEDED_OF_THING = 8, 4
"""Numbers of visible points of a robot, and of an object that moves, that are aimed at."""
ROBOT_SHARE, THING_SHARE = 0.95, 0.90
"""Shares of frames, and of an object's moving frames, in which there should be so many."""
Found = Mapping[tuple[str, str], Sequence[Visibility]]
"""Visibility of each episode, by task and robot."""


@dataclass(frozen=True)
class _Share:
    """In how many frames enough points of something are seen."""

    name: str
    share: float
    """From 0 to 1; 1 where there are no such frames."""
    pixels: float
    """Median number of pixels that show it in the other frames; NaN where there are none."""


def visibility_section(found: Found) -> str:
    """Markdown: in how many frames enough points are seen, by task and robot, and what is below the aims, with its size there.

    Args:
        found: of at least one task and robot.
    """
    present = {robot for _, robot in found}
    robots = [robot for robot in ROBOTS if robot in present] + sorted(present - set(ROBOTS))
    tasks = sorted({task for task, _ in found})
    of_robot = {cell: _share("robot", [one.robot for one in several], NEEDED_OF_ROBOT) for cell, several in found.items()}
    of_thing = {cell: _least(several) for cell, several in found.items()}
    lines = [f"| task | {' | '.join(f'`{robot}`' for robot in robots)} | seen least |", "|---" * (len(robots) + 2) + "|"]
    for task in tasks:
        cells = [(task, robot) for robot in robots]
        text = (f"{100 * of_robot[c].share:.0f} / {100 * of_thing[c].share:.0f}" if c in found else "–" for c in cells)
        least = min((of_thing[cell] for cell in cells if cell in found), key=lambda share: share.share)
        lines.append(f"| `{task}` | {' | '.join(text)} | {least.name} |")
    return "\n".join([_introduction(found, of_robot, of_thing), "", *lines, *_below_lines(of_robot, of_thing)])


def _introduction(found: Found, of_robot: Mapping[tuple[str, str], _Share], of_thing: Mapping[tuple[str, str], _Share]) -> str:
    """What the table shows, and in how many cells the aims are met."""
    count = sum(map(len, found.values()))
    episodes = f"{count} episode{'s' * (count != 1)}"
    points = [np.concatenate([one.robot.points for one in several]).mean() for several in found.values()]
    met = [sum(share.share >= aim for share in of.values()) for of, aim in ((of_robot, ROBOT_SHARE), (of_thing, THING_SHARE))]
    return (
        f"Share of frames [%] with at least {NEEDED_OF_ROBOT} visible points of the robot / share of the moving frames of the "
        f"object that is seen least, with at least {NEEDED_OF_THING} visible points of it; {episodes}.\nThe aims "
        f"are {100 * ROBOT_SHARE:.0f} and {100 * THING_SHARE:.0f}. The first is met in {met[0]} of {len(found)} cells, with "
        f"{min(points):.0f} to {max(points):.0f} points in the mean, the second in {met[1]}."
    )


def _below_lines(of_robot: Mapping[tuple[str, str], _Share], of_thing: Mapping[tuple[str, str], _Share]) -> Iterator[str]:
    """A table of what is below the aims; nothing where all is above."""
    below = [(cell, share) for cell, share in of_robot.items() if share.share < ROBOT_SHARE]
    below += [(cell, share) for cell, share in of_thing.items() if share.share < THING_SHARE]
    if not below:
        return
    yield from ("", "Below the aims, and how many pixels show it in the frames that lack points (median):", "")
    yield from ("| task | robot | what is seen | share [%] | pixels |", "|---|---|---|---|---|")
    for (task, robot), share in sorted(below, key=lambda one: (one[0], one[1].name)):
        yield f"| `{task}` | `{robot}` | {share.name} | {100 * share.share:.0f} | {share.pixels:.0f} |"


def _share(name: str, several: Sequence[Seen], needed: int) -> _Share:
    """Share of one thing, over the frames of several episodes together."""
    points, pixels = (np.concatenate([getattr(seen, of) for seen in several]) for of in ("points", "pixels"))
    enough = points >= needed
    missed = float(np.median(pixels[~enough])) if not enough.all() else np.nan
    return _Share(name, float(enough.mean()) if len(enough) else 1.0, missed)


def _least(several: Sequence[Visibility]) -> _Share:
    """Share of the thing that is seen least, in the episode in which it is seen least."""
    shares = [_share(name.replace("_", " "), [seen], NEEDED_OF_THING) for one in several for name, seen in one.things.items()]
    return min(shares, key=lambda share: share.share, default=_Share("nothing moves", 1.0, np.nan))
