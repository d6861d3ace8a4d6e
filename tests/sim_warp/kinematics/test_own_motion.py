"""Motion of its own: a robot keeps its joints, limits and rest; lines that a task asks for and meetings of both arms stay."""

from dataclasses import replace

import numpy as np
import pytest

from lab.seeds.motions import Compared, robot_table, task_table, tools_at_phase
from xew.protocol import ARMS, FRAME_RATE, MOTIONS
from xew.sim_warp.embodiment.spec import USUAL_ACCELERATION, RobotSpec
from xew.sim_warp.kinematics.expert import POSITION_TOLERANCE, Commands, joint_commands
from xew.sim_warp.kinematics.forward import tool_poses
from xew.sim_warp.kinematics.own_motion import SPEED_SHARE, own_commands
from xew.sim_warp.physics import World, simulate
from xew.sim_warp.plan import LEFT, RIGHT, Timeline, ToolPath, tool
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import scene_rng
from xew.sim_warp.tasks import TASKS

KEYS = ("arx_x5", "franka_panda")
LIFT = 0.06
GRASPS = {arm: tool((x, -0.05, 0.86), tilt=np.radians(20)) for arm, x in ((LEFT, -0.15), (RIGHT, 0.15))}

Planned = tuple[ToolPath, Commands]


def timeline() -> Timeline:
    """Both hands to a grasp by a way that turns them; closed there, then lifted together without a turn."""
    made = Timeline()
    made.move(GRASPS)
    made.grip({LEFT: 0.0, RIGHT: 0.0})
    made.move({arm: grasp.moved(z=LIFT) for arm, grasp in GRASPS.items()})
    made.hold(LEFT, "bar")
    return made


def longer() -> Timeline:
    made = timeline()
    made.move({LEFT: GRASPS[LEFT]})
    return made


@pytest.fixture(scope="module")
def planned() -> dict[str, Planned]:
    return {key: own_commands(ROBOTS[key], [timeline()])[0] for key in KEYS}


def joints_of(robot: RobotSpec, rows: np.ndarray) -> np.ndarray:
    """[t 2 d] arm joints of canonical rows [t 16]."""
    return np.stack([rows[:, arm.start : arm.start + robot.arm_joint_count] for arm, _ in ARMS], 1).astype(float)


@pytest.mark.parametrize("key", KEYS)
def test_the_same_bits_alone_and_beside_a_longer_plan(key: str, planned: dict[str, Planned]) -> None:
    path, commands = own_commands(ROBOTS[key], [longer(), timeline()])[1]
    assert commands.action.tobytes() == planned[key][1].action.tobytes()
    assert path.clock == planned[key][0].clock and path.holds == planned[key][0].holds


@pytest.mark.parametrize("key", KEYS)
def test_it_begins_at_the_robots_rest_and_ends_where_the_plan_does(key: str, planned: dict[str, Planned]) -> None:
    robot, (path, commands) = ROBOTS[key], planned[key]
    assert commands.problem is None
    for arm in (LEFT, RIGHT):
        np.testing.assert_allclose(joints_of(robot, commands.action)[0, arm], robot.arms[arm].rest, atol=1e-6)
        end = GRASPS[arm].moved(z=LIFT).position
        np.testing.assert_allclose(path.pose[-1, arm, :3], end, atol=POSITION_TOLERANCE)


def test_robots_differ_in_path_and_time_and_from_shared_motion(planned: dict[str, Planned]) -> None:
    one, other = (planned[key][0] for key in KEYS)
    shared = timeline().path()
    assert len({one.frame_count, other.frame_count, shared.frame_count}) == 3
    phases = [tools_at_phase(timeline(), path, path.pose[..., :3]) for path in (one, other, shared)]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert np.linalg.norm(phases[first] - phases[second], axis=-1).max() > 0.03


@pytest.mark.parametrize("key", KEYS)
def test_recorded_states_keep_the_limits_of_the_joints(key: str, planned: dict[str, Planned]) -> None:
    """Commands keep a share of each limit; what physics makes of them keeps the limits."""
    robot, action = ROBOTS[key], planned[key][1].action
    speed, acceleration = np.array(robot.joint_velocity), np.array(robot.joint_acceleration)
    commanded = np.diff(joints_of(robot, action), axis=0) * FRAME_RATE
    assert (np.abs(commanded) <= SPEED_SHARE * speed + 1e-3).all()
    assert (np.abs(np.diff(commanded, axis=0)) * FRAME_RATE <= SPEED_SHARE * acceleration + 0.01).all()
    assert (np.abs(commanded) / speed).max() > 0.9 * SPEED_SHARE or (
        np.abs(np.diff(commanded, axis=0)) * FRAME_RATE / acceleration
    ).max() > 0.9 * SPEED_SHARE, "no slower than need be"
    scene = TASKS["grab_roller"].sample(scene_rng("grab_roller", 1), 1)
    recorded = joints_of(robot, simulate([World(robot, scene, action)], "cpu")[0].joint_vel)
    assert (np.abs(recorded) <= speed).all()
    assert (np.abs(np.diff(recorded, axis=0)) * FRAME_RATE <= acceleration).all()


@pytest.mark.parametrize("key", KEYS)
def test_a_lift_is_straight_and_both_hands_rise_together(key: str, planned: dict[str, Planned]) -> None:
    path = planned[key][0]
    closed = path.gripper.max(-1) == 0
    for arm in (LEFT, RIGHT):
        lifted = path.pose[closed, arm, :3] - GRASPS[arm].position
        assert np.abs(lifted[:, :2]).max() < POSITION_TOLERANCE
    heights = path.pose[closed, :, 2]
    assert np.ptp(heights[:, 0]) > 0.9 * LIFT
    np.testing.assert_allclose(heights[:, LEFT], heights[:, RIGHT], atol=POSITION_TOLERANCE)


@pytest.mark.parametrize("key", KEYS)
def test_hands_close_where_they_have_arrived_and_holds_come_with_them(key: str, planned: dict[str, Planned]) -> None:
    path = planned[key][0]
    closing = (path.gripper > 0).all(-1) & (path.gripper < 1).all(-1)
    assert closing.any()
    for arm in (LEFT, RIGHT):
        np.testing.assert_allclose(path.pose[closing, arm, :3] - GRASPS[arm].position, 0, atol=POSITION_TOLERANCE)
    (hold,) = path.holds
    last = np.flatnonzero(closing)[-1] / FRAME_RATE
    assert last < hold.start < last + 1 / FRAME_RATE
    assert 0 <= (path.frame_count - 1) / FRAME_RATE - hold.end < 1 / FRAME_RATE


def test_a_slow_robot_takes_longer_instead_of_failing(planned: dict[str, Planned]) -> None:
    slow = replace(ROBOTS["arx_x5"], joint_velocity=(0.2,) * 6)
    assert joint_commands(slow, [timeline().path()])[0].problem is not None
    path, commands = own_commands(slow, [timeline()])[0]
    assert commands.problem is None and path.frame_count > 2 * planned["arx_x5"][0].frame_count


def test_what_cannot_be_reached_is_told_in_words() -> None:
    made = Timeline()
    made.move({RIGHT: GRASPS[RIGHT].moved(y=1.5)})
    problem = own_commands(ROBOTS["arx_x5"], [made])[0][1].problem
    assert problem is not None and problem.startswith("right arm cannot reach: off by")


def test_robots_without_a_rest_of_their_own_begin_at_home() -> None:
    arx = ROBOTS["arx_x5"]
    bare = replace(arx, arms=tuple(replace(arm, rest=()) for arm in arx.arms))
    action = own_commands(bare, [timeline()])[0][1].action
    np.testing.assert_allclose(joints_of(bare, action)[0], [arm.home for arm in arx.arms], atol=1e-6)
    assert arx.joint_acceleration == (USUAL_ACCELERATION,) * 6


def test_the_tables_tell_distances_at_equal_phase(planned: dict[str, Planned]) -> None:
    """Shared motion is at distance 0 from itself whoever carries it out; a constant shift is read as what it is."""
    plan = timeline()
    shared = plan.path()
    tools = tools_at_phase(plan, shared, shared.pose[..., :3])
    np.testing.assert_allclose(tools[:-1], shared.pose[:-1, :, :3], atol=1e-12)  # the last frame is after the end of the plan
    moved = {"arx_x5": tools, "piper": tools + [0.003, 0.004, 0.0]}
    scenes = [
        Compared("lift_pot", motion, tools_by_robot, seconds)
        for motion, tools_by_robot, seconds in zip(
            MOTIONS,
            ({"arx_x5": tools, "piper": tools}, moved),
            ({"arx_x5": 2.0, "piper": 2.0}, {"arx_x5": 3.0, "piper": 5.0}),
            strict=True,
        )
    ]
    assert task_table(scenes).splitlines()[2] == "| `lift_pot` | 0.0, 0.0 | 5.0, 5.0 | 2.0 | 3.0, 5.0 |"
    assert robot_table(scenes).splitlines()[3] == "| `piper` | 5.0, 5.0 | 2.0 | 5.0 | 2.50 |"
    own = planned["arx_x5"]
    found = tool_poses(ROBOTS["arx_x5"], own[1].action.astype(float))
    np.testing.assert_allclose(found[..., :3], own[0].pose[..., :3], atol=1e-5)
