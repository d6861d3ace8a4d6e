"""Why a motion does not count: each reason from a motion that is wrong in this one way, without physics."""

from dataclasses import replace

import numpy as np
import pytest

from xew.episode import FAILURES
from xew.protocol import FRAME_RATE
from xew.sim_warp import objects
from xew.sim_warp.kinematics.expert import Commands
from xew.sim_warp.physics import Motion
from xew.sim_warp.plan import LEFT, RIGHT, Hold, Timeline, ToolPath
from xew.sim_warp.production import cells
from xew.sim_warp.production.cells import Cell, measured_tools
from xew.sim_warp.production.outcome import DEEPEST_IN_ARM, DEEPEST_IN_TABLE, moment
from xew.sim_warp.production.warm_up import stand_at_home
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import Scene, SceneObject, upright
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks.task import Moment, Task

FRAMES = 21
ROBOT = ROBOTS["piper"]
HOLD = Hold(LEFT, "cube", 6 / FRAME_RATE, 15 / FRAME_RATE)


def sample(rng: np.random.Generator, seed: int) -> Scene:
    cube = SceneObject("cube", objects.block((0.04,) * 3, (200, 0, 0)), upright((0.1, 0), TABLE_TOP), mass=0.05)
    plate = SceneObject("plate", objects.disc(0.1, 0.01, (0, 0, 200)), upright((-0.2, 0), TABLE_TOP))
    return Scene("lift", seed, (cube, plate))


def is_lifted(scene: Scene, now: Moment) -> bool:
    return bool(now.object_pose[0, 2] > TABLE_TOP + 0.05)


TASK = Task("lift", "lift the cube", sample, lambda scene: Timeline(), is_lifted)


@pytest.fixture
def cell(task_of_this_file: None) -> Cell:
    """The left hand lifts a cube, without a robot that moves: both tools stay home, the cube rises and is touched."""
    scene = sample(np.random.default_rng(0), 0)
    pose = np.tile(np.array([thing.pose for thing in scene.objects], np.float32), (FRAMES, 1, 1))
    pose[:, 0, 2] += np.linspace(0, 0.1, FRAMES).astype(np.float32)
    contact = np.zeros((FRAMES, 2, 2), bool)
    contact[6:16, LEFT, 0] = True
    action = stand_at_home(ROBOT, FRAMES)
    nothing = np.zeros((FRAMES, 2), np.float32)
    motion = Motion(action, np.zeros_like(action), pose, nothing, contact, nothing, 0.0, 0.0, False)
    path = ToolPath(np.zeros((FRAMES, 2, 7)), np.ones((FRAMES, 2)), ())
    return cells.with_motion(Cell("lift", scene, path, "piper", ROBOT, Commands(action, None)), motion)


@pytest.fixture(autouse=True)
def task_of_this_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """The cells' task is the one of this file, whatever its name."""
    monkeypatch.setattr(cells, "get_task", lambda name: TASK)


def with_motion(cell: Cell, **changes: object) -> Cell:
    return cells.with_motion(cell, replace(cell.known_motion, **changes))  # type: ignore[arg-type]


def test_a_motion_that_ends_in_success_has_no_failure(cell: Cell) -> None:
    assert cell.failure is None


def test_a_robot_that_cannot_follow_fails_in_its_plan(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Commands(cell.commands.action, "left arm cannot reach")
    monkeypatch.setattr(cells, "joint_commands", lambda robot, paths, device: [problem] * len(paths))
    ((stuck,),) = cells.simulate_cells(cells.plan_cells([cells.Job("lift", 0, ("piper",))]), "cpu")
    assert stuck.failure == ("plan", "left arm cannot reach") and stuck.motion is None


def test_a_cell_without_a_motion_has_none_to_give(cell: Cell) -> None:
    with pytest.raises(AssertionError, match="piper cannot follow the plan of lift/0"):
        _ = replace(cell, motion=None).known_motion


@pytest.mark.parametrize(
    ("changes", "failure"),
    [
        ({"overflow": True}, ("overflow", "a contact or constraint buffer was too small, or the state was not finite")),
        ({"table_overlap": 2 * DEEPEST_IN_TABLE}, ("plan", "an arm pressed 3.0 mm into the table")),
        ({"arm_overlap": 2 * DEEPEST_IN_ARM}, ("plan", "the arms pressed 0.4 mm into each other")),
    ],
)
def test_what_physics_reports_is_told(cell: Cell, changes: dict[str, object], failure: tuple[str, str]) -> None:
    assert with_motion(cell, **changes).failure == failure


def test_a_brush_of_the_table_passes(cell: Cell) -> None:
    assert with_motion(cell, table_overlap=0.9 * DEEPEST_IN_TABLE, arm_overlap=0.9 * DEEPEST_IN_ARM).failure is None


def test_what_is_solved_before_it_begins_does_not_count(cell: Cell) -> None:
    pose = cell.known_motion.object_pose.copy()
    pose[:, 0, 2] += np.float32(0.1)
    assert with_motion(cell, object_pose=pose).failure == ("plan", "the scene is solved before it begins")


def dropped(cell: Cell, *holds: Hold, contact: np.ndarray | None = None) -> Cell:
    """The same cell, in which the cube stays on the table."""
    still = np.repeat(cell.known_motion.object_pose[:1], FRAMES, 0)
    held = replace(cell, path=replace(cell.path, holds=holds))
    return with_motion(held, object_pose=still, contact=cell.known_motion.contact if contact is None else contact)


def test_what_was_never_touched_was_not_grasped(cell: Cell) -> None:
    none = np.zeros_like(cell.known_motion.contact)
    assert dropped(cell, HOLD, contact=none).failure == ("grasp", "the left hand never touched the cube from 0.4 to 0.9 s")
    other = replace(HOLD, arm=RIGHT)
    assert dropped(cell, other).failure == ("grasp", "the right hand never touched the cube from 0.4 to 0.9 s")


def test_what_is_touched_before_its_hold_alone_was_not_grasped(cell: Cell) -> None:
    early = np.zeros_like(cell.known_motion.contact)
    early[:6, LEFT, 0] = True
    assert (dropped(cell, HOLD, contact=early).failure or ("",))[0] == "grasp"


def test_what_was_lost_before_the_end_of_its_hold_slipped(cell: Cell) -> None:
    contact = cell.known_motion.contact.copy()
    contact[13:] = False
    assert dropped(cell, HOLD, contact=contact).failure == ("slip", "the left hand lost the cube at 0.7 s")
    contact[13] = True
    assert (dropped(cell, HOLD, contact=contact).failure or ("",))[0] == "timeout", "one touch in the last three frames will do"


def test_what_was_held_to_the_end_and_still_failed_ran_out_of_time(cell: Cell) -> None:
    assert dropped(cell, HOLD).failure == ("timeout", "the plan ended short of success")
    assert dropped(cell).failure == ("timeout", "the plan ended short of success")


def test_the_first_hold_that_failed_is_named(cell: Cell) -> None:
    second = Hold(RIGHT, "plate", 8 / FRAME_RATE, 10 / FRAME_RATE)
    assert (dropped(cell, HOLD, second).failure or ("", ""))[1] == "the right hand never touched the plate from 0.5 to 0.6 s"


def test_success_by_what_cannot_happen_is_refused(cell: Cell) -> None:
    sunk = cell.known_motion.penetration.copy()
    sunk[5:15, 0] = 0.008
    assert with_motion(cell, penetration=sunk).failure == (
        "physics",
        "the cube sank 8 mm into the table or an arm at 0.3 s",
    )


def test_every_reason_is_one_of_the_contract_s(cell: Cell) -> None:
    reasons = {"plan", "overflow", "grasp", "slip", "timeout", "physics"}
    assert reasons <= set(FAILURES)


def test_a_moment_is_one_frame_of_everything(cell: Cell) -> None:
    tools = measured_tools(ROBOT, cell.known_motion.joint_pos)
    action = cell.commands.action.copy()
    action[7, [7, 15]] = (0.25, 0.75)
    now = moment(action, cell.known_motion, tools, 7)
    assert now.gripper.tolist() == [0.25, 0.75]
    np.testing.assert_array_equal(now.object_pose, cell.known_motion.object_pose[7])
    np.testing.assert_array_equal(now.tool_pose, tools[7])
    assert now.contact[LEFT].tolist() == [True, False]


def test_measured_tools_of_a_robot_at_home_are_at_home(cell: Cell) -> None:
    np.testing.assert_array_equal(cell.tool_pose, np.repeat(cell.tool_pose[:1], FRAMES, 0))
    assert cell.tool_pose.shape == (FRAMES, 2, 7) and cell.tool_pose.dtype == np.float32
    assert cell.tool_pose[0, LEFT, 0] < 0 < cell.tool_pose[0, RIGHT, 0]
