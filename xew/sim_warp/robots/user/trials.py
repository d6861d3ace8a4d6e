"""Trials of candidate places for a robot: homes, the share of the work area within reach, and plans of tasks.

Candidates differ only by their bases and tool frames. They share the calls of the solver, which take 15 ms and 0.1 ms per pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from xew.protocol import FRAME_RATE
from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import load_urdf, outermost_points
from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix
from xew.sim_warp.kinematics.forward import link_matrices
from xew.sim_warp.kinematics.inverse import ArmSolver, arm_bases
from xew.sim_warp.kinematics.reachability import GRASP_TILT, radial_yaw
from xew.sim_warp.plan import ASIDE, HOME, Tool, ToolPath, tool
from xew.sim_warp.robots.user.draft import Near
from xew.sim_warp.scene import scene_rng
from xew.sim_warp.stage import TABLE_SIZE, TABLE_TOP
from xew.sim_warp.tasks import TASKS

PLAN_TASKS = (
    "place_empty_cup",
    "lift_pot",
    "beat_block_hammer",
    "grab_roller",
    "move_can_pot",
    "place_phone_stand",
    "open_laptop",
    "place_a2b_left",
)
"""Tasks of the trial plans: with one hand and with two, lifting, striking, turning, placing."""
PLAN_SEEDS = 2
"""Number of seeds of each task, from 0."""
ITERATIONS = 16
"""Number of solver steps per call."""
POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-3, 0.01
"""Largest error of a home [m], [rad]."""
REACH_POSITION, REACH_ROTATION = 3e-3, 0.03
"""Largest error of a reached pose [m], [rad], as for the expert."""
LIMIT_MARGIN = 0.15
"""Least distance of a home from the joint limits, unless there is no other home [rad]."""
CLEARANCE = 0.02
"""Least height of all moving links above the table, with the arms at home [m]."""
HULL_POINTS = 64
"""Largest number of points per link for collisions with the table."""
GRASP_OFFSETS, GRASP_X, GRASP_Y, GRASP_Z = (-45, 0, 45), (-0.3, -0.1, 0.1), (-0.2, 0.12), 0.8
"""Trial grasps: yaw offsets from the radial yaw [deg] and positions of the left hand [m]."""
PATH_STEPS = 4
"""Number of poses along the straight path from home to a grasp."""
STRIDE = 8
"""Number of frames between the tried poses of a plan."""
SPEED_SHARE = 0.8
"""Largest share of a joint's speed limit over a stride of a plan, as a margin for peaks within it."""


@dataclass(frozen=True)
class Postures:
    """Arms of candidates at rest, one per row."""

    candidate: np.ndarray
    """[e] int, number of the candidate."""
    arm: np.ndarray
    """[e] int, 0 (left) or 1 (right)."""
    joint_pos: np.ndarray
    """[e d] rad."""

    def __getitem__(self, rows: np.ndarray) -> "Postures":
        return Postures(self.candidate[rows], self.arm[rows], self.joint_pos[rows])


class Trials:
    """Inverse kinematics of one robot at many places."""

    def __init__(self, candidates: Sequence[RobotSpec]) -> None:
        self.candidates = candidates
        first = candidates[0]
        self.solver = ArmSolver(first, "cpu", ITERATIONS, posture_weight=0.0)
        self._to_base = np.linalg.inv([arm_bases(robot) for robot in candidates])
        tools = np.array([[matrix_from_pose(arm.tool_pose) for arm in robot.arms] for robot in candidates])
        self._to_first_tool = np.linalg.inv(tools) @ tools[0]
        self._hulls = _link_points(first)
        self.speed = np.array(first.joint_velocity)

    def solve(self, rows: Postures, pose: np.ndarray, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joint positions [e k d] with position [e k] m and rotation errors [e k] rad for tool poses [e k 7], world, near
        seeds [e k d]."""
        count, each = pose.shape[:2]
        where = (rows.candidate, rows.arm)
        frames = self._to_base[where][:, None] @ matrix_from_pose(pose) @ self._to_first_tool[where][:, None]
        targets = pose_from_matrix(frames.reshape(-1, 4, 4))
        solution = self.solver.solve_in_base(rows.arm.repeat(each), targets, seed.reshape(count * each, -1))
        shape = (count, each)
        errors = solution.position_error.reshape(shape), solution.rotation_error.reshape(shape)
        return solution.joint_pos.reshape(*shape, -1), *errors

    def find_homes(self, near: Near, seeds: int, most: int) -> Postures:
        """At most `most` homes per arm and candidate, from `seeds` start postures, the nearest to `near` first."""
        rows, position, rotation = self._search_homes(near, seeds)
        rows = rows[_are_home(position, rotation)]
        return self._choose(rows[self._is_clear(rows)], near, most)

    def find_miss(self, near: Near, seeds: int) -> str:
        """The reason why the candidates have no home; arguments as of `find_homes`."""
        rows, position, rotation = self._search_homes(near, seeds)
        for arm in (0, 1):
            mine = rows.arm == arm
            if not _are_home(position[mine], rotation[mine]).any():
                nearest = int(np.argmin(np.where(mine, position + 0.25 * rotation, np.inf)))
                off = f"{1000 * position[nearest]:.0f} mm and {np.degrees(rotation[nearest]):.0f} deg off"
                return f"the nearest of the {('left', 'right')[arm]} arm is {off}"
        return "a link would stand in the table or on the other arm's side"

    def _search_homes(self, near: Near, seeds: int) -> tuple[Postures, np.ndarray, np.ndarray]:
        """Postures from all starts of both arms of all candidates, with the errors [e] m and rad of the home poses."""
        starts = [_start_postures(self.candidates[0], wanted, seeds) for wanted in near]
        pairs = np.array(list(product(range(len(self.candidates)), (0, 1))))
        rows = Postures(pairs[:, 0], pairs[:, 1], np.zeros((len(pairs), starts[0].shape[1])))
        pose = np.stack([HOME[arm].pose for arm in rows.arm])[:, None].repeat(seeds, 1)
        joint_pos, position, rotation = self.solve(rows, pose, np.stack([starts[arm] for arm in rows.arm]))
        every = Postures(rows.candidate.repeat(seeds), rows.arm.repeat(seeds), joint_pos.reshape(-1, joint_pos.shape[-1]))
        return every, position.ravel(), rotation.ravel()

    def _choose(self, rows: Postures, near: Near, most: int) -> Postures:
        """The postures of each arm that differ by more than 0.1 rad, with a margin to the limits if there are any."""
        lower, upper = self.solver.lower, self.solver.upper
        wanted = [np.zeros(len(lower)) if posture is None else posture for posture in near]
        far = np.linalg.norm(rows.joint_pos - np.array(wanted)[rows.arm], axis=1)
        tight = np.minimum(rows.joint_pos - lower, upper - rows.joint_pos).min(1) <= LIMIT_MARGIN
        chosen: dict[tuple[int, int], list[int]] = {}
        for row in np.lexsort((far, tight)):
            mine = chosen.setdefault((int(rows.candidate[row]), int(rows.arm[row])), [])
            differs = all(np.abs(rows.joint_pos[row] - rows.joint_pos[other]).max() > 0.1 for other in mine)
            if len(mine) < most and differs and not (tight[row] and mine and not tight[mine[0]]):
                mine.append(int(row))
        return rows[np.array([row for mine in chosen.values() for row in mine], int)]

    def _is_clear(self, rows: Postures) -> np.ndarray:
        """[e] bool, whether all links from an arm's second joint on are above the table or off it, and on their side."""
        clear = np.ones(len(rows.arm), bool)
        urdf = load_urdf(self.candidates[0].urdf)
        roots = np.array([[matrix_from_pose(arm.root_pose) for arm in robot.arms] for robot in self.candidates])
        for side in (0, 1):
            mine = rows.arm == side
            joint_pos = np.zeros((int(mine.sum()), len(urdf.joint_names)))
            columns = [urdf.joint_names.index(name) for name in self.candidates[0].arms[side].joints]
            joint_pos[:, columns] = rows.joint_pos[mine]
            frames, root = link_matrices(urdf, joint_pos), roots[rows.candidate[mine], side]
            stays = np.ones(len(joint_pos), bool)
            for name, points in self._hulls[side].items():
                pose = root @ frames[name]
                position = points @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3]
                over = (np.abs(position[..., :2]) < np.array(TABLE_SIZE[:2]) / 2).all(-1)
                wrong = (position[..., 2] < TABLE_TOP + CLEARANCE) | (position[..., 0] * (2 * side - 1) < 0)
                stays &= ~(over & wrong).any(1)
            clear[mine] = stays
        return clear

    def reached_shares(self, rows: Postures) -> np.ndarray:
        """[e] share of the grasps that an arm reaches from home on a straight path, divided by four if it cannot move aside."""
        path = np.stack([_grasp_paths(arm) for arm in (0, 1)])
        joint_pos = rows.joint_pos[:, None].repeat(path.shape[2], 1)
        for step in range(PATH_STEPS):
            joint_pos, position, rotation = self.solve(rows, path[rows.arm, step], joint_pos)
        reached = (position < REACH_POSITION) & (rotation < REACH_ROTATION)
        return reached[:, 1:].mean(1) * np.where(reached[:, 0], 1.0, 0.25)

    def follow_plans(self, rows: Postures) -> np.ndarray:
        """[e p] bool, whether the arm follows each of `trial_plans` at every `STRIDE`th frame, within its speed limits."""
        pose = _plan_poses()
        joint_pos = rows.joint_pos[:, None].repeat(pose.shape[2], 1)
        good = np.ones(joint_pos.shape[:2], bool)
        for frame in range(pose.shape[1]):
            before = joint_pos
            joint_pos, position, rotation = self.solve(rows, pose[rows.arm, frame], joint_pos)
            fast = np.abs(joint_pos - before) * FRAME_RATE / STRIDE > SPEED_SHARE * self.speed
            good &= (position < REACH_POSITION) & (rotation < REACH_ROTATION) & ~(fast.any(-1) & (frame > 0))
        return good


@cache
def trial_plans() -> tuple[ToolPath, ...]:
    """Tool paths of a few tasks and seeds, the same for every robot."""
    plans = []
    for name, seed in product(PLAN_TASKS, range(PLAN_SEEDS)):
        task = TASKS[name]
        plans.append(task.plan(task.sample(scene_rng(name, seed), seed)).path())
    return tuple(plans)


@cache
def _plan_poses() -> np.ndarray:
    """[2 t p 7] tool poses of both arms at every `STRIDE`th frame of the plans, extended at their last pose."""
    longest = -(-max(path.frame_count for path in trial_plans()) // STRIDE) + 1
    at = [np.minimum(STRIDE * np.arange(longest), path.frame_count - 1) for path in trial_plans()]
    return np.stack([path.pose[frames] for path, frames in zip(trial_plans(), at, strict=True)], 2).transpose(1, 0, 2, 3)


@cache
def _grasp_paths(arm: int) -> np.ndarray:
    """[s g 7] straight paths of one tool from home: aside, and to grasps over the work area."""
    mirror = 1 - 2 * arm
    goals = [ASIDE[arm]]
    for offset, x, y in product(GRASP_OFFSETS, GRASP_X, GRASP_Y):
        position = np.array([x, y, GRASP_Z])
        yaw = mirror * np.radians(radial_yaw(position) + offset)
        goals.append(tool(position * [mirror, 1, 1], yaw, np.radians(GRASP_TILT)))
    shares = np.linspace(1 / PATH_STEPS, 1, PATH_STEPS)
    return np.stack([_straight(HOME[arm], goal, shares) for goal in goals], 1)


def _straight(start: Tool, end: Tool, shares: np.ndarray) -> np.ndarray:
    """[s 7] poses between two, at shares of the way."""
    turn = Slerp([0, 1], Rotation.concatenate([start.rotation, end.rotation]))
    return np.concatenate([start.position + shares[:, None] * (end.position - start.position), turn(shares).as_quat()], 1)


def _are_home(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """[e] bool for errors [e] m and rad."""
    return (position < POSITION_TOLERANCE) & (rotation < ROTATION_TOLERANCE)


def _link_points(robot: RobotSpec) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """For each arm, outermost points [k 3] m of the links from its second joint on."""
    urdf = load_urdf(robot.urdf)
    left, right = (
        {
            link.name: outermost_points(link.visual.vertices, HULL_POINTS)
            for link in urdf.moved_links(arm.joints[1])
            if link.visual is not None
        }
        for arm in robot.arms
    )
    return left, right


def _start_postures(robot: RobotSpec, near: np.ndarray | None, count: int) -> np.ndarray:
    """[count d] start postures: the preferred one, the middle of the limits, zero, and random ones within half a turn."""
    lower, upper = np.array(robot.joint_lower), np.array(robot.joint_upper)
    low, high = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    spread = np.random.default_rng(0).uniform(low, high, (count, len(lower)))
    first = [(low + high) / 2, np.clip(np.zeros(len(lower)), lower, upper)]
    if near is not None:
        first.insert(0, np.clip(near, lower, upper))
    spread[: len(first)] = first
    return spread
