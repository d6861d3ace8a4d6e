"""Placement of robots: bases and homes with both tools at `plan.HOME`, by inverse kinematics.

Candidates are filtered in three steps: homes of both arms, the share of the work area within reach, and plans of tasks with
both arms. The search runs on the CPU with a fixed seed and is deterministic.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from xew.config import ConfigError
from xew.sim_warp.embodiment.spec import Arm, RobotSpec
from xew.sim_warp.kinematics.expert import joint_commands
from xew.sim_warp.plan import HOME
from xew.sim_warp.robots.user.draft import Near
from xew.sim_warp.robots.user.trials import Postures, Trials, trial_plans

DISTANCES = (0.6, 0.7, 0.8, 0.5, 0.4)
"""Distances between the bases of two equal arms [m], in order of preference; in RoboTwin 0.6 to 0.8 are typical."""
PLACE_DISTANCES, BASE_Y, BASE_Z = (0.6, 0.4, 0.7), (-0.45, -0.55, -0.65, -0.37), (0.75, 0.55)
ROOT_Z = (0.0, 0.25, 0.5, 0.75)
"""Default candidate places [m]: the values above for two equal arms, this height for one root of both arms."""
YAW_90 = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
"""Quaternion x y z w of a root that faces +y, for robots that face along their x."""
SEEDS, MANY_SEEDS = 20, 64
"""Numbers of start postures for the search of a home, for many places and for few."""
FEW, SEVERAL = 3, 8
"""Numbers of compared postures per arm, for many places and for few."""
FEW_PLACES = 8
"""Largest number of places that counts as few."""
BEST_PLACES, BEST_POSTURES = 4, 2
"""Numbers of places, and of postures per arm, for trials of plans."""
FINALISTS = 4
"""Largest number of places with homes for complete plans; the first that follows all plans is chosen."""


@dataclass(frozen=True)
class Placed:
    """A robot with a place and homes, and the results of its plans."""

    robot: RobotSpec
    problems: tuple[str | None, ...]
    """For each of `trials.trial_plans` the reason why the robot cannot follow it, None if it can."""

    @property
    def share(self) -> float:
        """Share of the plans that the robot follows."""
        return sum(problem is None for problem in self.problems) / len(self.problems)


def place(candidates: Sequence[RobotSpec], near: Near = (None, None)) -> Placed:
    """The candidate place of one robot that follows the most plans, with homes near preferred postures; of equals the first.

    Raises:
        ConfigError: no candidate brings both tools home without a collision with the table.
    """
    few = len(candidates) <= FEW_PLACES
    trials = Trials(candidates)
    homes = trials.find_homes(near, MANY_SEEDS if few else SEEDS, SEVERAL if few else FEW)
    complete = [number for number in range(len(candidates)) if len(set(homes.arm[homes.candidate == number])) == 2]
    if not complete:
        raise ConfigError(_no_home(candidates, Trials(candidates[:1]).find_miss(near, MANY_SEEDS)))
    homes = homes[np.isin(homes.candidate, complete)]
    finalists = _rank_by_plans(trials, _rank_by_reach(trials, homes))[:FINALISTS]
    best: Placed | None = None
    for robot in finalists:
        placed = check_plans(robot)
        if best is None or placed.share > best.share:
            best = placed
        if best.share == 1:
            break
    assert best is not None
    return best


def check_plans(robot: RobotSpec) -> Placed:
    """Follow a few tasks' plans with a complete robot."""
    return Placed(robot, tuple(commands.problem for commands in joint_commands(robot, list(trial_plans()))))


def place_at(robot: RobotSpec, candidates: Sequence[RobotSpec], near: Near) -> Placed:
    """As `place`, for a robot at a given place, or at it with several base distances; an error suggests another place."""
    try:
        return place(candidates, near)
    except ConfigError as error:
        try:
            other = place([*standard_places(robot)], near).robot
        except ConfigError:
            raise error from None
        roots = " and ".join(_format_position(np.array(arm.root_pose[:3])) for arm in other.arms)
        raise ConfigError(f"{error} From root_pose {roots} m, facing +y, both arms reach home.") from None


def standard_places(robot: RobotSpec) -> list[RobotSpec]:
    """The robot at all default candidate places."""
    if robot.one_urdf_holds_both_arms:
        return [move_to(robot, (0.0, y, z, *YAW_90)) for y, z in product(BASE_Y, ROOT_Z)]
    places = product(PLACE_DISTANCES, BASE_Y, BASE_Z)
    return [move_apart(move_to(robot, (0.0, y, z, *YAW_90)), gap) for gap, y, z in places]


def move_to(robot: RobotSpec, root_pose: tuple[float, ...]) -> RobotSpec:
    """The robot with both roots at a pose [7]."""
    x, y, z, qx, qy, qz, qw = root_pose
    left, right = (replace(arm, root_pose=(x, y, z, qx, qy, qz, qw)) for arm in robot.arms)
    return replace(robot, arms=(left, right))


def move_apart(robot: RobotSpec, gap: float) -> RobotSpec:
    """The robot with each base moved outward by half a gap [m]."""
    left, right = (
        replace(arm, root_pose=(arm.root_pose[0] + side * gap / 2, *arm.root_pose[1:]))
        for side, arm in zip((-1, 1), robot.arms, strict=True)
    )
    return replace(robot, arms=(left, right))


def with_turned_tools(candidates: Iterable[RobotSpec]) -> list[RobotSpec]:
    """The candidates, then the same with their tool frames turned by 180 degrees about the approach, an equivalent grasp."""
    half = Rotation.from_euler("x", np.pi)

    def turn(arm: Arm) -> Arm:
        rotation = (Rotation.from_quat(arm.tool_pose[3:]) * half).as_quat(canonical=True)
        return replace(arm, tool_pose=(*arm.tool_pose[:3], *rotation.tolist()))

    robots = list(candidates)
    return robots + [replace(robot, arms=(turn(robot.arms[0]), turn(robot.arms[1]))) for robot in robots]


def _rank_by_reach(trials: Trials, homes: Postures) -> Postures:
    """The best postures of the places with the largest reach of the worse arm."""
    shares = trials.reached_shares(homes)
    best = np.array(
        [
            [shares[(homes.candidate == number) & (homes.arm == arm)].max(initial=-1) for arm in (0, 1)]
            for number in range(len(trials.candidates))
        ]
    )
    order = np.lexsort((np.arange(len(best)), -best.sum(1), -best.min(1)))[:BEST_PLACES]
    rows: list[int] = []
    for number, arm in product(order, (0, 1)):
        mine = np.flatnonzero((homes.candidate == number) & (homes.arm == arm))
        rows += mine[np.argsort(-shares[mine], kind="stable")][:BEST_POSTURES].tolist()
    return homes[np.array(rows)]


def _rank_by_plans(trials: Trials, homes: Postures) -> list[RobotSpec]:
    """The places with pairs of homes, by decreasing number of plans that both arms follow, then by similarity of the arms.

    Seven-joint arms are pulled toward the mean of both homes.
    """
    follows = trials.follow_plans(homes)
    ranked: list[tuple[int, float, int, int]] = []
    for number in dict.fromkeys(homes.candidate.tolist()):
        left, right = (np.flatnonzero((homes.candidate == number) & (homes.arm == arm)) for arm in (0, 1))
        for a, b in product(left.tolist(), right.tolist()):
            apart = float(np.linalg.norm(homes.joint_pos[a] - homes.joint_pos[b]))
            ranked.append((-int((follows[a] & follows[b]).sum()), apart, a, b))
    return [
        _set_homes(trials.candidates[homes.candidate[a]], homes.joint_pos[a], homes.joint_pos[b])
        for _, _, a, b in sorted(ranked)
    ]


def _set_homes(robot: RobotSpec, left: np.ndarray, right: np.ndarray) -> RobotSpec:
    """The robot with homes [d] rad, rounded."""
    arms = [
        replace(arm, home=tuple(round(float(value), 4) for value in home))
        for arm, home in zip(robot.arms, (left, right), strict=True)
    ]
    return replace(robot, arms=(arms[0], arms[1]))


def _no_home(candidates: Sequence[RobotSpec], miss: str) -> str:
    goals = " and ".join(_format_position(at.position) for at in HOME)
    tried = f"from none of {len(candidates)} places" if len(candidates) > 1 else "from its place"
    return (
        f"{candidates[0].urdf}: the robot cannot bring its tools home, to {goals} m over the table, {tried}: {miss}. Move its "
        "base (root_pose), or check tool_pose and the limits."
    )


def _format_position(position: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in position)
