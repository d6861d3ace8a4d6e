"""Stage 2a: an expert's plan: waypoints of both tool frames on a common clock. It knows no robot.

Reads  a Scene (through a task's `plan` function)
Writes `Timeline`, and by `Timeline.path` both tools' poses and grippers at every stored frame

The tool frame: x is the approach direction (out of the hand), y the axis along which the fingers open.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from xew.protocol import FRAME_RATE

LEFT, RIGHT = 0, 1
TOOL_SPEED = 0.20
"""Mean speed of a tool between two waypoints [m/s]; a minimum-jerk move peaks at 1.875 times its mean."""
TURN_SPEED = 0.6
"""Mean turning speed of a tool [rad/s]."""
SHORTEST_MOVE = 0.36
"""s."""
GRIP_TIME = 0.48
"""Time for a gripper to close or open [s]: 8 frames."""
HOME_TIME = 1.8
"""Time from or to a robot's rest posture [s]; how far that is depends on the robot, so the clock must not."""


@dataclass(frozen=True)
class Tool:
    """A pose of a tool frame, world."""

    position: np.ndarray
    """[3] m."""
    rotation: Rotation

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Tool":
        """Shifted along world axes [m]."""
        return Tool(self.position + np.array([x, y, z]), self.rotation)

    def backed(self, distance: float) -> "Tool":
        """Drawn back against the approach direction [m]."""
        return Tool(self.position - distance * self.rotation.apply([1, 0, 0]), self.rotation)


def tool(position: np.ndarray | tuple[float, float, float], yaw: float = 0.0, tilt: float = 0.0, roll: float = 0.0) -> Tool:
    """A tool frame that points down at `position`.

    Args:
        position: [3] m, world.
        yaw: turn of the whole hand about the world's z [rad]; at 0 the fingers open along x.
        tilt: how far the approach direction leans from straight down, at yaw 0 towards +y, away from the robot [rad].
        roll: turn about the approach direction [rad]; at 0 the fingers open horizontally.
    """
    down = Rotation.from_matrix(np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]))
    turned = Rotation.from_euler("z", yaw) * Rotation.from_euler("x", tilt) * down * Rotation.from_euler("x", roll)
    return Tool(np.asarray(position, float), turned)


@dataclass(frozen=True)
class Hold:
    """A stretch of time in which an arm should be touching an object."""

    arm: int
    name: str
    start: float
    """s."""
    end: float


@dataclass(frozen=True)
class _Segment:
    """One arm along waypoints, evenly spaced in progress; None stands for the robot's rest posture."""

    start_time: float
    end_time: float
    waypoints: tuple[Tool | None, ...]


@dataclass(frozen=True)
class ToolPath:
    """Both tools at every stored frame."""

    position: np.ndarray
    """[t 2 3] float64, m, world; the nearest stated waypoint on the way from or to
    home, NaN while nothing is stated."""
    quaternion: np.ndarray
    """[t 2 4] float64, x y z w; NaN likewise."""
    home_share: np.ndarray
    """[t 2] float64, 1 at the rest posture, 0 on the tool path, between them on the way (minimum jerk)."""
    gripper: np.ndarray
    """[t 2] float64, 0 closed, 1 open."""
    holds: tuple[Hold, ...]

    @property
    def frame_count(self) -> int:
        return len(self.gripper)


@dataclass
class Timeline:
    """Written by a task, from time 0 at which both arms are home with open grippers."""

    time: float = 0.0
    """s, now."""
    at: list[Tool | None] = field(default_factory=lambda: [None, None])
    """Where each tool is now; None is home."""
    segments: tuple[list[_Segment], list[_Segment]] = field(default_factory=lambda: ([], []))
    grips: tuple[list[tuple[float, float]], list[tuple[float, float]]] = field(
        default_factory=lambda: ([(0.0, 1.0)], [(0.0, 1.0)])
    )
    """(time, value) knots of each gripper, linear between."""
    holds: list[Hold] = field(default_factory=list)

    def move(self, goals: dict[int, Tool | None], seconds: float | None = None) -> None:
        """Move one or both tools, starting and arriving together; a goal of None is the robot's rest posture."""
        seconds = seconds or max(_duration(self.at[arm], goal) for arm, goal in goals.items())
        end = self.time + seconds
        for arm, goal in goals.items():
            self.segments[arm].append(_Segment(self.time, end, (self.at[arm], goal)))
            self.at[arm] = goal
        self.time = end

    def follow(self, arm: int, goals: list[Tool], seconds: float) -> None:
        """Move one tool through waypoints without stopping: a curve, such as the arc of a lid's edge."""
        self.segments[arm].append(_Segment(self.time, self.time + seconds, (self.at[arm], *goals)))
        self.at[arm] = goals[-1]
        self.time += seconds

    def grip(self, values: dict[int, float], seconds: float = GRIP_TIME) -> None:
        """Bring grippers to values in [0 closed, 1 open] while the tools stand still."""
        for arm, value in values.items():
            knots = self.grips[arm]
            knots += [(self.time, knots[-1][1]), (self.time + seconds, value)]
        self.time += seconds

    def wait(self, seconds: float) -> None:
        self.time += seconds

    def hold(self, arm: int, name: str, since: float) -> None:
        """Say that `arm` should have touched the object `name` from time `since` until now."""
        self.holds.append(Hold(arm, name, since, self.time))

    def path(self) -> ToolPath:
        """Both tools at each stored frame, 60 ms apart, from time 0 until the last move has ended."""
        times = np.arange(int(np.ceil(self.time * FRAME_RATE)) + 1) / FRAME_RATE
        sampled = [_sample(self.segments[arm], times) for arm in (LEFT, RIGHT)]
        grippers = [np.interp(times, *np.array(self.grips[arm]).T) for arm in (LEFT, RIGHT)]
        position, quaternion, home_share = (np.stack(parts, 1) for parts in zip(*sampled, strict=True))
        return ToolPath(position, quaternion, home_share, np.stack(grippers, 1), tuple(self.holds))


def _duration(start: Tool | None, end: Tool | None) -> float:
    if start is None or end is None:
        return HOME_TIME
    distance = np.linalg.norm(end.position - start.position)
    angle = (start.rotation.inv() * end.rotation).magnitude()
    return max(SHORTEST_MOVE, float(distance / TOOL_SPEED + angle / TURN_SPEED))


def minimum_jerk(share: np.ndarray) -> np.ndarray:
    """Progress in [0, 1] that starts and ends at rest without jerk, for a share of the time in [0, 1]."""
    share = np.clip(share, 0, 1)
    return np.clip(share**3 * (10 - 15 * share + 6 * share**2), 0, 1)


def _sample(segments: list[_Segment], times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position [t 3], quaternion [t 4] and home share [t] of one tool; it stands still between segments."""
    position, quaternion = np.full((len(times), 3), np.nan), np.full((len(times), 4), np.nan)
    home_share = np.ones(len(times))
    for segment in segments:
        now = times >= segment.start_time
        progress = minimum_jerk((times[now] - segment.start_time) / (segment.end_time - segment.start_time))
        position[now], quaternion[now], home_share[now] = _sample_segment(segment, progress)
    return position, quaternion, home_share


def _sample_segment(segment: _Segment, progress: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    start, end = segment.waypoints[0], segment.waypoints[-1]
    if start is not None and end is not None:
        return *_along(segment.waypoints, progress), np.zeros(len(progress))
    # The tool's own pose on the way is the robot's business: only the end of the tool path is stated.
    known = start if end is None else end
    home_share = progress if end is None else 1 - progress
    if known is None:
        return np.full((len(progress), 3), np.nan), np.full((len(progress), 4), np.nan), np.ones(len(progress))
    return *_along((known, known), progress), home_share


def _along(waypoints: tuple[Tool, ...], progress: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    knots = np.linspace(0, 1, len(waypoints))
    positions = np.stack([waypoint.position for waypoint in waypoints])
    position = np.stack([np.interp(progress, knots, positions[:, axis]) for axis in range(3)], -1)
    turns = Slerp(knots, Rotation.concatenate([waypoint.rotation for waypoint in waypoints]))
    return position, turns(progress).as_quat()
