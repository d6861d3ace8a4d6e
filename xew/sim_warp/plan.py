"""Plans of experts: waypoints of both tool frames on a common clock, independent of the robot.

The tool frame: x is the approach direction (out of the hand), y the axis along which the fingers open.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from xew.protocol import FRAME_RATE

LEFT, RIGHT = 0, 1
Point = Sequence[float] | np.ndarray
"""Coordinates x y z [m]."""
TOOL_SPEED = 0.16
"""Mean speed of a tool between two waypoints [m/s]; a minimum-jerk move peaks at 1.875 times its mean."""
TURN_SPEED = 0.45
"""Mean turning speed of a tool [rad/s]; a move takes the sum of its translation and rotation times."""
SHORTEST_MOVE = 0.42
"""Least time of a move [s]."""
GRIP_TIME = 0.48
"""Time for a gripper to close or open [s]: 8 frames."""


@dataclass(frozen=True)
class Tool:
    """A pose of a tool frame, world."""

    position: np.ndarray
    """[3] m, world frame."""
    rotation: Rotation

    @property
    def pose(self) -> np.ndarray:
        """[7] position x y z [m] and quaternion x y z w."""
        return np.concatenate([self.position, self.rotation.as_quat()])

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Tool":
        """The tool shifted along world axes [m]."""
        return Tool(self.position + np.array([x, y, z]), self.rotation)

    def backed(self, distance: float) -> "Tool":
        """The tool moved back along the approach direction by a distance [m]."""
        return Tool(self.position - distance * self.rotation.apply([1, 0, 0]), self.rotation)

    def carried(self, start: Point, goal: Point, turn: float = 0.0) -> "Tool":
        """The hand after the held object has moved from `start` to `goal` [3] m and turned about the world's z [rad]."""
        turned = Rotation.from_euler("z", turn)
        return Tool(np.asarray(goal) + turned.apply(self.position - np.asarray(start)), turned * self.rotation)


def tool(position: Point, yaw: float = 0.0, tilt: float = 0.0, roll: float = 0.0) -> Tool:
    """A tool frame that points down at `position`.

    Args:
        position: [3] m, world.
        yaw: turn of the hand about the world's z [rad]; at 0 the fingers open along x.
        tilt: angle of the approach direction from straight down, at yaw 0 toward +y, away from the robot [rad].
        roll: turn about the approach direction [rad]; at 0 the fingers open horizontally.
    """
    down = Rotation.from_matrix(np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]))
    turned = Rotation.from_euler("z", yaw) * Rotation.from_euler("x", tilt) * down * Rotation.from_euler("x", roll)
    return Tool(np.asarray(position, float), turned)


HOME = (tool((-0.17, -0.24, 0.88), tilt=np.radians(30)), tool((0.17, -0.24, 0.88), tilt=np.radians(30)))
"""Initial poses of both tools, at every robot's home posture."""
ASIDE = (tool((-0.28, -0.24, 0.93), tilt=np.radians(30)), tool((0.28, -0.24, 0.93), tilt=np.radians(30)))
"""Poses of an idle tool while the other arm works: wide hands would collide over the middle of the table."""
TURNED = 1e-6
"""Least angle of a turned tool [rad]."""
ASIDE_TIME = 0.96
"""Time of a move from home to aside [s], within the speed limit of Piper's wrist."""


@dataclass(frozen=True)
class Hold:
    """A time span in which an arm should touch an object."""

    arm: int
    name: str
    start: float
    """Begin [s]."""
    end: float


@dataclass(frozen=True)
class Segment:
    """A move of one arm along waypoints that are evenly spaced in progress."""

    start_time: float
    """Begin [s]."""
    end_time: float
    waypoints: tuple[Tool, ...]
    is_curve: bool = False
    """Whether every robot's tool must follow the line through the waypoints."""

    @property
    def is_straight(self) -> bool:
        """Whether the task needs the tool on this line: a curve, or a move without a turn."""
        turn = (self.waypoints[0].rotation.inv() * self.waypoints[-1].rotation).magnitude()
        return self.is_curve or bool(turn < TURNED)

    def sample(self, progress: np.ndarray) -> np.ndarray:
        """[t 7] poses of the tool at progress [t] from 0 to 1: x y z [m] and quaternion x y z w, world."""
        knots = np.linspace(0, 1, len(self.waypoints))
        positions = np.stack([waypoint.position for waypoint in self.waypoints])
        position = np.stack([np.interp(progress, knots, positions[:, axis]) for axis in range(3)], -1)
        turns = Slerp(knots, Rotation.concatenate([waypoint.rotation for waypoint in self.waypoints]))
        return np.concatenate([position, turns(progress).as_quat()], -1)


@dataclass(frozen=True)
class ToolPath:
    """Both tools at every stored frame."""

    pose: np.ndarray
    """[t 2 7] float64, x y z [m] and quaternion x y z w, world."""
    gripper: np.ndarray
    """[t 2] float64, 0 closed, 1 open."""
    holds: tuple[Hold, ...]
    frame_rate: float = FRAME_RATE
    """Stored frames a second [Hz]."""
    clock: tuple[tuple[float, float], ...] = ()
    """Pairs of an instant of the plan and the same instant of this path [s], ascending."""

    @property
    def frame_count(self) -> int:
        """Number of stored frames t."""
        return len(self.gripper)


@dataclass
class Timeline:
    """Moves, grips and waits of a task in order; at time 0 both arms are home with open grippers."""

    time: float = 0.0
    """Time now [s]."""
    at: list[Tool] = field(default_factory=lambda: list(HOME))
    """Pose of each tool now."""
    segments: tuple[list[Segment], list[Segment]] = field(default_factory=lambda: ([], []))
    grips: tuple[list[tuple[float, float]], list[tuple[float, float]]] = field(
        default_factory=lambda: ([(0.0, 1.0)], [(0.0, 1.0)])
    )
    """Knots (time [s], value 0 to 1) of each gripper; values between are linear."""
    holds: list[Hold] = field(default_factory=list)

    def move(self, goals: dict[int, Tool], at_least: float = 0.0) -> None:
        """Move one or both tools straight, starting and arriving together, in at least `at_least` [s]."""
        end = self.time + max(at_least, *(_duration(self.at[arm], goal) for arm, goal in goals.items()))
        for arm, goal in goals.items():
            self.segments[arm].append(Segment(self.time, end, (self.at[arm], goal)))
            self.at[arm] = goal
        self.time = end

    def follow(self, arm: int, goals: list[Tool], seconds: float) -> None:
        """Move one tool through waypoints without stopping, for example along the arc of a lid's edge."""
        self.segments[arm].append(Segment(self.time, self.time + seconds, (self.at[arm], *goals), is_curve=True))
        self.at[arm] = goals[-1]
        self.time += seconds

    def grip(self, values: dict[int, float], seconds: float = GRIP_TIME) -> None:
        """Bring grippers to values in [0 closed, 1 open] while the tools stand still."""
        for arm, value in values.items():
            knots = self.grips[arm]
            knots += [(self.time, knots[-1][1]), (self.time + seconds, value)]
        self.time += seconds

    def wait(self, seconds: float) -> None:
        """Let time pass while the tools stand still."""
        self.time += seconds

    def hold(self, arm: int, name: str) -> None:
        """Record that `arm` should touch the object `name` from its last grip until now."""
        self.holds.append(Hold(arm, name, self.grips[arm][-1][0], self.time))

    def path(self) -> ToolPath:
        """Both tools at each stored frame, 60 ms apart, from time 0 until the last move has ended."""
        times = frame_times(self.time)
        poses = [_sample(HOME[arm], self.segments[arm], times) for arm in (LEFT, RIGHT)]
        grippers = [np.interp(times, *np.array(self.grips[arm]).T) for arm in (LEFT, RIGHT)]
        return ToolPath(
            np.stack(poses, 1), np.stack(grippers, 1), tuple(self.holds), clock=((0.0, 0.0), (self.time, self.time))
        )

    @property
    def steps(self) -> list[dict[int, Segment]]:
        """The moves in order, each as the segments of the moving arms, which begin and end together."""
        by_start: dict[float, dict[int, Segment]] = {}
        for arm in (LEFT, RIGHT):
            for segment in self.segments[arm]:
                by_start.setdefault(segment.start_time, {})[arm] = segment
        return [by_start[start] for start in sorted(by_start)]


def frame_times(seconds: float) -> np.ndarray:
    """[t] instants of the stored frames of a path of this length [s]."""
    return np.arange(int(np.ceil(seconds * FRAME_RATE)) + 1) / FRAME_RATE


def _duration(start: Tool, end: Tool) -> float:
    """Time of a move [s]."""
    distance = np.linalg.norm(end.position - start.position)
    angle = (start.rotation.inv() * end.rotation).magnitude()
    return max(SHORTEST_MOVE, float(distance / TOOL_SPEED + angle / TURN_SPEED))


def minimum_jerk(share: np.ndarray) -> np.ndarray:
    """Progress [t] from 0 to 1 of a minimum-jerk move, at shares of its time [t] from 0 to 1."""
    share = np.clip(share, 0, 1)
    return np.clip(share**3 * (10 - 15 * share + 6 * share**2), 0, 1)


def _sample(home: Tool, segments: list[Segment], times: np.ndarray) -> np.ndarray:
    """[t 7] pose of one tool; it stands still between segments."""
    pose = np.tile(home.pose, (len(times), 1))
    for segment in segments:
        now = times >= segment.start_time
        progress = minimum_jerk((times[now] - segment.start_time) / (segment.end_time - segment.start_time))
        pose[now] = segment.sample(progress)
    return pose
