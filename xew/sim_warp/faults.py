"""Faults: commands that fail on purpose, made by changing an expert's plan before inverse kinematics; they know no robot.

A faulty episode has the scene of its base seed, and the fault `FAULTS[number - 1]` of its seed (`protocol.split_fault`). Which
hand has the fault, and in which direction, depends on the fault's name, the task and the seed, not on the severity.
Faults keep the plan's clock: the commands of a scene last equally long, except if another object is taken.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from xew.episode import EpisodeError
from xew.protocol import FAULT_SEVERITIES
from xew.sim_warp.plan import GRIP_TIME, LEFT, RIGHT, Segment, Timeline, Tool, minimum_jerk
from xew.sim_warp.scene import Scene, SceneObject, scene_rng
from xew.sim_warp.tasks.task import GRIPPER_CLOSED

Planner = Callable[[Scene], Timeline]
Change = Callable[[Planner, Scene, np.random.Generator, float], Timeline | None]
"""Function (planner, scene, random stream, severity) -> the faulty plan; None if the plan cannot have the fault."""


@dataclass(frozen=True)
class Fault:
    """One kind of fault at one severity."""

    name: str
    severity: float
    unit: str
    """Unit of the severity; empty for a fault without degrees."""
    change: Change

    def __str__(self) -> str:
        """The name in headers, such as grasp_offset:20."""
        return f"{self.name}:{self.severity:g}" if self.unit else self.name


@dataclass(frozen=True)
class _Grip:
    """A hand's closing, and the opening that ends it, if any."""

    arm: int
    close: int
    """Number of the gripper's knot at which it begins to close."""
    open: int | None
    """Number of the knot at which it begins to open."""
    lift: int
    """Number of the arm's first segment with the closed hand; 0 for a hand that closes at home."""
    retreat: int
    """Number of the arm's first segment after the opening, or of its segments if there is none."""


def _find_grips(plan: Timeline) -> list[_Grip]:
    return [grip for arm in (LEFT, RIGHT) for grip in _grips_of_arm(plan, arm)]


def _grips_of_arm(plan: Timeline, arm: int) -> Iterator[_Grip]:
    times, values = np.array(plan.grips[arm]).T
    ends = np.array([segment.end_time for segment in plan.segments[arm]])
    for close in np.flatnonzero((values[:-1] > GRIPPER_CLOSED) & (values[1:] <= GRIPPER_CLOSED)):
        later = np.flatnonzero(np.diff(values[close + 1 :]) > 0)
        opens = int(close + 1 + later[0]) if len(later) else None
        lift = int(np.searchsorted(ends, times[close], side="right"))
        retreat = len(ends) if opens is None else int(np.searchsorted(ends, times[opens], side="right"))
        yield _Grip(arm, int(close), opens, lift, retreat)


def _of_a_grip(change: Callable[[Timeline, _Grip, np.random.Generator, float], Timeline], released: bool = False) -> Change:
    """The fault of one drawn grip of a plan; with `released` of one that ends before the arm's last move."""

    def make(planner: Planner, scene: Scene, rng: np.random.Generator, severity: float) -> Timeline | None:
        plan = planner(scene)
        grips = [grip for grip in _find_grips(plan) if not released or grip.retreat < len(plan.segments[grip.arm])]
        return change(plan, grips[rng.integers(len(grips))], rng, severity) if grips else None

    return make


def _draw_direction(rng: np.random.Generator) -> np.ndarray:
    """[3] a horizontal unit vector."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _with_segments(plan: Timeline, arm: int, segments: list[Segment]) -> Timeline:
    """The plan with other segments of one arm."""
    both, at = list(plan.segments), list(plan.at)
    both[arm] = segments
    if segments:
        at[arm] = segments[-1].waypoints[-1]
    return replace(plan, segments=(both[LEFT], both[RIGHT]), at=at)


def _with_knots(plan: Timeline, arm: int, knots: list[tuple[float, float]]) -> Timeline:
    """The plan with other knots of one gripper."""
    both = list(plan.grips)
    both[arm] = knots
    return replace(plan, grips=(both[LEFT], both[RIGHT]))


def _move_stops(plan: Timeline, arm: int, first: int, last: int, change: Callable[[Tool], Tool]) -> Timeline:
    """The plan with the stops of an arm `first` to `last` changed, and all waypoints between; stop n is before segment n."""
    segments = []
    for number, segment in enumerate(plan.segments[arm]):
        start, *between, end = segment.waypoints
        start = change(start) if first <= number <= last else start
        end = change(end) if first <= number + 1 <= last else end
        between = [change(waypoint) if first <= number < last else waypoint for waypoint in between]
        segments.append(replace(segment, waypoints=(start, *between, end)))
    return _with_segments(plan, arm, segments)


def _offset_grasp(plan: Timeline, grip: _Grip, rng: np.random.Generator, severity: float) -> Timeline:
    """The hand goes down, closes and lifts next to the right place by `severity` [mm]."""
    offset = severity / 1000 * _draw_direction(rng)
    first, last = (grip.lift - 1, grip.lift + 1) if grip.lift else (1, len(plan.segments[grip.arm]))
    return _move_stops(plan, grip.arm, max(1, first), last, lambda tool: tool.moved(*offset))


def _miss_target(plan: Timeline, grip: _Grip, rng: np.random.Generator, severity: float) -> Timeline:
    """The hand sets the object down next to its place by `severity` [mm]."""
    offset = severity / 1000 * _draw_direction(rng)
    return _move_stops(plan, grip.arm, grip.retreat - 1, grip.retreat + 1, lambda tool: tool.moved(*offset))


def _close_late(plan: Timeline, grip: _Grip, rng: np.random.Generator, severity: float) -> Timeline:
    """The gripper begins to close `severity` [s] late, while the arm moves on."""
    knots = plan.grips[grip.arm]
    latest = plan.time if grip.open is None else knots[grip.open][0]
    closing = [(min(latest, time + severity), value) for time, value in knots[grip.close : grip.close + 2]]
    return _with_knots(plan, grip.arm, [*knots[: grip.close], *closing, *knots[grip.close + 2 :]])


def _stay_open(plan: Timeline, grip: _Grip, rng: np.random.Generator, severity: float) -> Timeline:
    """The gripper does not close."""
    knots = plan.grips[grip.arm]
    after = [] if grip.open is None else [(knots[grip.open][0], knots[grip.close][1]), *knots[grip.open + 1 :]]
    return _with_knots(plan, grip.arm, [*knots[: grip.close + 1], *after])


def _open_early(plan: Timeline, grip: _Grip, rng: np.random.Generator, severity: float) -> Timeline:
    """The gripper opens before its time, by `severity` % of the time for which it should hold."""
    knots = plan.grips[grip.arm]
    closed, held = knots[grip.close + 1]
    until, after = (plan.time, []) if grip.open is None else (knots[grip.open][0], knots[grip.open + 1 :])
    begin, width = until - severity / 100 * (until - closed), after[0][1] if after else 1.0
    opening = [(begin, held), (begin + GRIP_TIME, width)]
    return _with_knots(
        plan, grip.arm, [*knots[: grip.close + 2], *opening, *(knot for knot in after if knot[0] > begin + GRIP_TIME)]
    )


def _lift_low(planner: Planner, scene: Scene, rng: np.random.Generator, severity: float) -> Timeline | None:
    """All held objects are lifted `severity` % less high over the higher end of their way."""
    plan = planner(scene)
    grips = [grip for grip in _find_grips(plan) if grip.lift]
    for grip in grips:
        segments = plan.segments[grip.arm][grip.lift : grip.retreat]
        last = grip.retreat - 1 if grip.open is not None else grip.retreat
        ends = [segments[0].waypoints[0]] + ([segments[-1].waypoints[-1]] if grip.open is not None else [])
        floor = max(end.position[2] for end in ends)

        def lower(tool: Tool, floor: float = floor) -> Tool:
            return tool.moved(z=-severity / 100 * max(0.0, tool.position[2] - floor))

        plan = _move_stops(plan, grip.arm, grip.lift + 1, last, lower)
    return plan if grips else None


def _swap_objects(planner: Planner, scene: Scene, rng: np.random.Generator, severity: float) -> Timeline | None:
    """Two movable objects are taken for each other."""
    expert, movable = planner(scene), [thing for thing in scene.objects if not thing.is_fixed]
    pairs = [pair for pair in combinations(movable, 2) if (pair[0].grasp is None) == (pair[1].grasp is None)]
    if not pairs:
        return None
    first, second = pairs[rng.integers(len(pairs))]
    other = {first.name: replace(second, name=first.name), second.name: replace(first, name=second.name)}
    objects: tuple[SceneObject, ...] = tuple(other.get(thing.name, thing) for thing in scene.objects)
    plan = planner(replace(scene, objects=objects))
    plan.time = max(plan.time, expert.time)
    same = plan.time == expert.time and np.array_equal(plan.path().pose, expert.path().pose)
    return None if same else plan


def _stop(planner: Planner, scene: Scene, rng: np.random.Generator, severity: float) -> Timeline | None:
    """Both arms and grippers stop for good, `severity` % of the time before the last move would end."""
    plan = planner(scene)
    last = max((segment.end_time for segments in plan.segments for segment in segments[-1:]), default=plan.time)
    end = (1 - severity / 100) * last
    for arm in (LEFT, RIGHT):
        begun = [segment for segment in plan.segments[arm] if segment.start_time < end]
        plan = _with_segments(plan, arm, [_cut(segment, end) for segment in begun])
        times, values = np.array(plan.grips[arm]).T
        knots = [knot for knot in plan.grips[arm] if knot[0] < end]
        plan = _with_knots(plan, arm, [*knots, (end, float(np.interp(end, times, values)))])
    return plan


def _cut(segment: Segment, end: float) -> Segment:
    """The first part of a move, which comes to rest at `end` [s] if that is before its own end."""
    if segment.end_time <= end:
        return segment
    share = np.array((end - segment.start_time) / (segment.end_time - segment.start_time))
    poses = segment.sample(np.linspace(0, float(minimum_jerk(share)), len(segment.waypoints)))
    waypoints = (segment.waypoints[0], *(Tool(pose[:3], Rotation.from_quat(pose[3:])) for pose in poses[1:]))
    return replace(segment, end_time=end, waypoints=waypoints)


def _push(plan: Timeline, grip: _Grip, rng: np.random.Generator, severity: float) -> Timeline:
    """Before it retreats, the opened hand moves sideways by `severity` [mm] and pushes what it has set down."""
    side = rng.choice([-1.0, 1.0])
    segments = list(plan.segments[grip.arm])
    start, *others = segments[grip.retreat].waypoints
    across = start.rotation.apply([0.0, 1.0, 0.0]) * [1, 1, 0]
    pushed = start.moved(*(side * severity / 1000 * across / np.linalg.norm(across)))
    segments[grip.retreat] = replace(segments[grip.retreat], waypoints=(start, pushed, *others), is_curve=True)
    return _with_segments(plan, grip.arm, segments)


def _jitter(planner: Planner, scene: Scene, rng: np.random.Generator, severity: float) -> Timeline | None:
    """The arms and each gripper run up to `severity` % slower or faster from event to event, within the same whole time."""
    plan = planner(scene)
    ends = {time for arm in (LEFT, RIGHT) for segment in plan.segments[arm] for time in (segment.start_time, segment.end_time)}
    planned = np.array(sorted(ends | {time for knots in plan.grips for time, _ in knots} | {0.0, plan.time}))

    def draw_clock() -> Callable[[float], float]:
        rates = (1 + severity / 100) ** rng.uniform(-1, 1, len(planned) - 1)
        actual = np.concatenate([[0.0], np.cumsum(np.diff(planned) * rates)])
        return lambda time: float(np.interp(time, planned, actual * plan.time / actual[-1]))

    of_arms, *of_grippers = (draw_clock() for _ in range(3))
    for arm in (LEFT, RIGHT):
        segments = [replace(s, start_time=of_arms(s.start_time), end_time=of_arms(s.end_time)) for s in plan.segments[arm]]
        plan = _with_segments(plan, arm, segments)
        plan = _with_knots(plan, arm, [(of_grippers[arm](time), value) for time, value in plan.grips[arm]])
    return plan


KINDS: dict[str, tuple[str, Change]] = {
    "grasp_offset": ("mm", _of_a_grip(_offset_grasp)),
    "close_late": ("s", _of_a_grip(_close_late)),
    "stay_open": ("", _of_a_grip(_stay_open)),
    "open_early": ("%", _of_a_grip(_open_early)),
    "miss_target": ("mm", _of_a_grip(_miss_target, released=True)),
    "swap_objects": ("", _swap_objects),
    "low_lift": ("%", _lift_low),
    "stop": ("%", _stop),
    "push": ("mm", _of_a_grip(_push, released=True)),
    "jitter": ("%", _jitter),
}
"""Unit of the severity and change of the plan, by the keys of `protocol.FAULT_SEVERITIES`."""
FAULTS = tuple(Fault(name, severity, *KINDS[name]) for name, own in FAULT_SEVERITIES.items() for severity in own)
"""All faults. A seed names a fault by its place here, from 1 on."""


def get_fault(number: int) -> Fault | None:
    """The fault of a number in seeds; None for 0, the expert. Raises EpisodeError if there is none."""
    if number > len(FAULTS):
        raise EpisodeError(f"a seed names fault {number}, expected at most {len(FAULTS)}; use the version of xew that made it.")
    return FAULTS[number - 1] if number else None


def make_faulty(planner: Planner, scene: Scene, number: int) -> Timeline | None:
    """The plan with a fault, by its number; None if the plan cannot have it. Number 0 is the plan itself.

    Args:
        planner: function scene -> the expert's plan.
        scene: of the base seed.
        number: of the fault.
    """
    if (fault := get_fault(number)) is None:
        return planner(scene)
    plan = fault.change(planner, scene, scene_rng(f"{fault.name} of {scene.task}", scene.seed), fault.severity)
    return None if plan is None else replace(plan, holds=[])  # what a faulty hand holds, physics decides


def draw_faults(planner: Planner, scene: Scene) -> tuple[int, ...]:
    """Numbers of all faults that a scene's plan can have, in a drawn order: each kind before any kind comes again."""
    expert = planner(scene)  # planned once: faults change copies
    order = scene_rng(f"faults of {scene.task}", scene.seed).permutation(len(FAULTS)) + 1
    turn: Counter[str] = Counter()
    turns: dict[int, int] = {}
    for number in map(int, order):
        name = FAULTS[number - 1].name
        turns[number], turn[name] = turn[name], turn[name] + 1

    def plan(other: Scene) -> Timeline:
        return expert if other is scene else planner(other)

    return tuple(number for number in sorted(turns, key=turns.__getitem__) if make_faulty(plan, scene, number) is not None)
