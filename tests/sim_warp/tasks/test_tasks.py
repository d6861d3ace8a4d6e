"""Every task of the registry: unsolved at first, solved in physics by its expert at last; and the page that tells of them."""

from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from xew.config import ConfigError
from xew.episode import FAILURES
from xew.sim_warp.plan import LEFT, RIGHT
from xew.sim_warp.production import cells
from xew.sim_warp.production.cells import Cell, Job, plan_cells, simulate_cells, with_motion
from xew.sim_warp.production.outcome import moment
from xew.sim_warp.robots import ROBOTS
from xew.sim_warp.scene import Scene, scene_rng
from xew.sim_warp.tasks import TASKS, get_task
from xew.sim_warp.tasks.task import Moment, Task, share_of_way

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "tasks.md"
SOLVERS = dict(zip(sorted(TASKS), cycle(ROBOTS), strict=False))
"""One robot a task, all five among them."""
SEED = 2


@pytest.fixture(scope="module")
def solved() -> dict[str, Cell]:
    """A whole episode of every task, in physics."""
    assert set(SOLVERS.values()) == set(ROBOTS)
    solved = simulate_cells(plan_cells([Job(task, SEED, (robot,)) for task, robot in SOLVERS.items()]), "cpu")
    return {seed[0].task_name: seed[0] for seed in solved}


def at(cell: Cell, frame: int) -> Moment:
    return moment(cell.commands.action, cell.known_motion, cell.tool_pose, frame)


@pytest.mark.parametrize("name", TASKS)
def test_an_expert_turns_failure_into_success(name: str, solved: dict[str, Cell]) -> None:
    cell = solved[name]
    assert cell.failure is None
    assert not cell.task.success(cell.scene, at(cell, 0))
    assert cell.task.success(cell.scene, at(cell, -1))


@pytest.mark.parametrize("name", TASKS)
def test_progress_goes_from_0_to_1_and_is_1_only_in_success(name: str, solved: dict[str, Cell]) -> None:
    cell = solved[name]
    first = at(cell, 0)
    course = [cell.task.progress(cell.scene, first, at(cell, frame)) for frame in range(cell.path.frame_count)]
    is_solved = [cell.task.success(cell.scene, at(cell, frame)) for frame in range(cell.path.frame_count)]
    assert course[0] == pytest.approx(0, abs=0.01) and course[-1] == 1
    assert [value == 1 for value in course] == is_solved
    assert min(course) >= 0 and any(0.2 < value < 0.8 for value in course)


@pytest.mark.parametrize(
    ("now", "share"), [((0, 0), 0.0), ((0.1, 0), 0.5), ((0.2, 0.01), 1.0), ((0.3, 0), 1.0), ((-0.5, 0), 0.0), ((0.5, 0), 0.0)]
)
def test_the_share_of_the_way_ends_at_the_tolerance(now: tuple[float, float], share: float) -> None:
    """From 0 to a goal at 0.25 with a tolerance of 0.05 the way is 0.2 long."""
    assert share_of_way((0.0, 0.0), now, (0.25, 0.0), (0.05, 0.02)) == pytest.approx(share)


def test_a_task_without_an_approach_has_progress_0_or_1(solved: dict[str, Cell]) -> None:
    cell = solved["lift_pot"]
    plain = Task("lift", "lift", cell.task.sample, cell.task.plan, cell.task.success)
    first, last = at(cell, 0), at(cell, -1)
    assert [plain.progress(cell.scene, first, moment) for moment in (first, at(cell, -30), last)] == [0, 0, 1]


@pytest.mark.parametrize("name", TASKS)
def test_hands_hold_what_the_plan_says_they_hold(name: str, solved: dict[str, Cell]) -> None:
    cell = solved[name]
    assert cell.path.holds
    for hold in cell.path.holds:
        end = int(hold.end * cell.path.frame_rate)
        touched = cell.known_motion.contact[end - 8 : end, hold.arm, cell.scene.index(hold.name)]
        assert touched.any(), f"the {('left', 'right')[hold.arm]} hand does not touch the {hold.name}"


@pytest.mark.parametrize("name", TASKS)
def test_an_expert_that_closes_no_hand_is_told_so(name: str, solved: dict[str, Cell]) -> None:
    """Success is not for free: with nothing moved it fails, and the reason is one of the contract's."""
    cell = solved[name]
    still = {
        field: np.repeat(getattr(cell.known_motion, field)[:1], cell.path.frame_count, 0)
        for field in ("object_pose", "object_joint")
    }
    idle = with_motion(cell, replace(cell.known_motion, **still, contact=np.zeros_like(cell.known_motion.contact)))
    reason, words = idle.failure or ("", "")
    assert reason == "grasp" and reason in FAILURES and "never touched" in words


def test_what_is_lost_on_the_way_is_a_slip(solved: dict[str, Cell]) -> None:
    cell = solved["place_empty_cup"]
    hold = cell.path.holds[0]
    contact = cell.known_motion.contact.copy()
    contact[int(hold.end * cell.path.frame_rate) - 12 :] = False
    pose = np.repeat(cell.known_motion.object_pose[:1], cell.path.frame_count, 0)
    lost = with_motion(cell, replace(cell.known_motion, contact=contact, object_pose=pose))
    word, told = lost.failure or ("", "")
    assert word == "slip" and told.startswith(f"the {('left', 'right')[hold.arm]} hand lost the cup at ")


def test_an_overflow_and_an_early_success_are_failures(solved: dict[str, Cell], monkeypatch: pytest.MonkeyPatch) -> None:
    cell = solved["grab_roller"]
    assert (with_motion(cell, replace(cell.known_motion, overflow=True)).failure or ("",))[0] == "overflow"
    monkeypatch.setattr(cells, "get_task", lambda name: replace(TASKS[name], success=lambda scene, now: True))
    early = with_motion(cell, cell.known_motion)
    assert early.failure == ("plan", "the scene is solved before it begins")
    monkeypatch.setattr(cells, "get_task", lambda name: replace(TASKS[name], success=lambda scene, now: False))
    late = with_motion(cell, cell.known_motion)
    assert (late.failure or ("",))[0] == "timeout"


@pytest.mark.parametrize("name", TASKS)
def test_no_scene_of_many_is_solved_as_it_stands(name: str) -> None:
    task = TASKS[name]
    for seed in range(100):
        scene = task.sample(scene_rng(name, seed), seed)
        assert not task.success(scene, beginning(scene)), f"seed {seed}"


def beginning(scene: Scene) -> Moment:
    """Open hands far from everything, objects where the scene puts them."""
    joint = np.array([thing.hinge.start if thing.hinge else 0.0 for thing in scene.objects])
    pose = np.array([thing.pose for thing in scene.objects])
    tools = np.tile([0.0, -0.5, 1.2, 0, 0, 0, 1], (2, 1))
    return Moment(pose, joint, tools, np.ones(2), np.zeros((2, len(scene.objects)), bool))


@pytest.mark.parametrize("name", TASKS)
def test_the_instruction_names_what_the_scene_shows(name: str) -> None:
    task = TASKS[name]
    said = {task.instruction.format(**task.sample(scene_rng(name, seed), seed).words) for seed in range(30)}
    assert all("{" not in text for text in said)
    assert ("{" in task.instruction) == (len(said) > 1)


def test_both_arms_get_work() -> None:
    for name in ("beat_block_hammer", "open_laptop", "place_empty_cup"):
        arms = {task_arm(name, seed) for seed in range(12)}
        assert arms == {LEFT, RIGHT}, name


def task_arm(name: str, seed: int) -> int:
    return TASKS[name].plan(TASKS[name].sample(scene_rng(name, seed), seed)).holds[0].arm


def test_success_wants_what_the_docstrings_say(solved: dict[str, Cell]) -> None:
    """Each condition alone undoes success."""
    undone = {
        "beat_block_hammer": [("object_pose", (0, 0), 0.021), ("object_pose", (0, 2), 0.012)],
        "blocks_ranking_rgb": [("object_pose", (2, 0), 0.14), ("object_pose", (1, 1), 0.06)],
        "grab_roller": [("object_pose", (0, 2), -0.2)],
        "move_stapler_pad": [("object_pose", (0, 0), 0.025), ("object_pose", (0, 1), 0.025), ("object_pose", (0, 2), 0.012)],
        "open_laptop": [("object_joint", (0,), -0.5)],
        "place_a2b_left": [("object_pose", (0, 0), 0.27), ("object_pose", (0, 1), 0.06), ("object_pose", (0, 0), -0.13)],
        "place_a2b_right": [("object_pose", (0, 0), -0.27), ("object_pose", (0, 1), 0.06), ("object_pose", (0, 0), 0.13)],
        "place_empty_cup": [("object_pose", (0, 1), 0.07), ("object_pose", (0, 2), 0.016)],
        "place_mouse_pad": [("object_pose", (0, 0), 0.02), ("object_pose", (0, 1), 0.017)],
        "place_object_scale": [("object_pose", (0, 1), 0.05), ("object_pose", (0, 2), -0.013)],
        "place_object_stand": [("object_pose", (0, 1), 0.04), ("object_pose", (0, 2), 0.015)],
        "press_stapler": [("object_joint", (0,), -0.06), ("tool_pose", (slice(None), 2), 0.05)],
        "stack_bowls_two": [("object_pose", (1, 0), 0.09), ("object_pose", (1, 2), 0.05), ("object_pose", (1, 2), -0.02)],
    }
    for name, changes in undone.items():
        cell = solved[name]
        last = at(cell, -1)
        for field, index, change in changes:
            values = getattr(last, field).copy()
            values[index] += change
            assert not cell.task.success(cell.scene, replace(last, **{field: values})), (name, field, index)
    let_go = ("blocks_ranking_rgb", "move_stapler_pad", "place_a2b_left", "place_a2b_right", "place_empty_cup")
    for name in (*let_go, "place_mouse_pad", "place_object_scale", "place_object_stand", "press_stapler", "stack_bowls_two"):
        last = at(solved[name], -1)
        assert not TASKS[name].success(solved[name].scene, replace(last, gripper=np.array([1.0, 0.7])))
    roller = at(solved["grab_roller"], -1)
    assert not TASKS["grab_roller"].success(solved["grab_roller"].scene, replace(roller, gripper=np.array([0.0, 0.5])))
    laptop = at(solved["open_laptop"], -1)
    away = laptop.tool_pose + np.float32([0, -0.3, 0.3, 0, 0, 0, 0])
    assert not TASKS["open_laptop"].success(solved["open_laptop"].scene, replace(laptop, tool_pose=away))


def test_unknown_tasks_are_told_with_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match="did you mean 'grab_roller'"):
        get_task("grab_rollers")
    with pytest.raises(ConfigError, match="expected module:NAME"):
        get_task("nowhere.to.be:FOUND")
    with pytest.raises(ConfigError, match="is a str; expected a Task"):
        get_task("tests.sim_warp.small:TASK")
