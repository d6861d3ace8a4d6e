"""Faults of commands: what they change in a plan, what they leave, and what physics and the command make of them."""

import json
import shutil
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from tests.sim_warp.small import TASK, InlineWorkers, work_inline
from xew.dataset import find_accepted, read_dataset
from xew.episode import EpisodeError, Record, read_pixels, read_record
from xew.protocol import FRAME_RATE, TEST_SEED_START, join_fault, seed_split, split_fault
from xew.sim_warp.changes.scenes import make_plan, make_scene, measure_progress
from xew.sim_warp.devices.workers import Workers
from xew.sim_warp.faults import FAULTS, draw_faults, get_fault, make_faulty
from xew.sim_warp.generate import Args, generate
from xew.sim_warp.inspection.checks import find_problem
from xew.sim_warp.inspection.pictures import describe
from xew.sim_warp.plan import HOME, Timeline, ToolPath
from xew.sim_warp.production import cells, seeds
from xew.sim_warp.production.cells import Job, plan_cells, simulate_cells
from xew.sim_warp.production.seeds import Family, family_key
from xew.sim_warp.production.summary import fault_table, sort_faults, yield_table
from xew.sim_warp.scene import Scene, scene_hash, scene_rng
from xew.sim_warp.tasks import TASKS
from xew.sim_warp.tasks.place_empty_cup import COASTER_HEIGHT
from xew.sim_warp.tasks.task import Moment

NUMBERS = {str(fault): number for number, fault in enumerate(FAULTS, 1)}
SEED = 2
SWAPPED = {"blocks_ranking_rgb", "blocks_ranking_size", "place_a2b_left", "place_a2b_right", "stack_bowls_two"}


def scene_of(task: str, seed: int = SEED) -> Scene:
    return TASKS[task].sample(scene_rng(task, seed), seed)


def faulty(task: str, fault: str) -> Timeline:
    plan = make_faulty(TASKS[task].plan, scene_of(task), NUMBERS[fault])
    assert plan is not None
    return plan


def differs(path: ToolPath, other: ToolPath) -> bool:
    same = path.frame_count == other.frame_count
    return not (same and np.array_equal(path.pose, other.pose) and np.array_equal(path.gripper, other.gripper))


@pytest.mark.parametrize("task", TASKS)
def test_every_fault_changes_the_commands_and_keeps_their_clock(task: str) -> None:
    scene = scene_of(task)
    expert = TASKS[task].plan(scene).path()
    for number in draw_faults(TASKS[task].plan, scene):
        fault, plan = FAULTS[number - 1], make_faulty(TASKS[task].plan, scene, number)
        assert plan is not None
        path = plan.path()
        assert differs(path, expert), str(fault)
        assert fault.name == "swap_objects" or path.frame_count == expert.frame_count
        assert not path.holds and 0 <= path.gripper.min() <= path.gripper.max() <= 1
        assert np.allclose(path.pose[0], [home.pose for home in HOME]), "both tools start at home"
        assert np.linalg.norm(np.diff(path.pose[..., :3], axis=0), axis=-1).max() < 0.06, f"{fault}: no jump [m a frame]"
    assert not differs(TASKS[task].plan(scene).path(), expert)


@pytest.mark.parametrize("task", TASKS)
def test_faults_are_drawn_by_scene_and_each_kind_before_any_comes_again(task: str) -> None:
    drawn = draw_faults(TASKS[task].plan, scene_of(task))
    names = [FAULTS[number - 1].name for number in drawn]
    kinds = len(set(names))
    assert len(set(drawn)) == len(drawn) >= 18 and len(set(names[:kinds])) == kinds >= 6
    assert drawn == draw_faults(TASKS[task].plan, scene_of(task)) != draw_faults(TASKS[task].plan, scene_of(task, 3))
    assert ("swap_objects" in names) == (task in SWAPPED or task in ("place_burger_fries", "place_dual_shoes"))


DRAWN = {
    "beat_block_hammer": 3451010659,
    "blocks_ranking_rgb": 4000787397,
    "grab_roller": 2690467557,
    "lift_pot": 3142999783,
    "open_laptop": 567603014,
    "place_a2b_left": 3637080540,
    "place_dual_shoes": 818452122,
    "place_empty_cup": 1223637626,
    "press_stapler": 1466489311,
    "shake_bottle": 1532142456,
    "stack_bowls_two": 713324013,
}
"""Checksums of the faults drawn for seed 2: data sets of earlier versions are completed with the same ones."""


@pytest.mark.parametrize(("task", "checksum"), DRAWN.items())
def test_the_drawn_faults_are_those_of_earlier_versions(task: str, checksum: int) -> None:
    assert zlib.crc32(bytes(draw_faults(TASKS[task].plan, scene_of(task)))) == checksum


def test_faults_are_drawn_in_workers_and_stay_in_the_order_of_families(monkeypatch: pytest.MonkeyPatch) -> None:
    class Backwards(InlineWorkers):
        def run(self, function: Any, jobs: Sequence[Any]) -> Iterator[Any]:
            yield from super().run(function, jobs[::-1])

    monkeypatch.setattr(seeds.Family, "accepted_seeds", (2, 3))
    asked = [Family(task, TEST_SEED_START, 2, ("piper",)) for task in ("stack_bowls_two", "place_empty_cup")]
    families = seeds.plan_faults(asked, 8, cast(Workers, Backwards(1)))
    expected = [(family.task, seed) for family in asked for seed in (2, 3)]
    assert [(family.task, family.first_seed) for family in families] == expected
    assert [family.faults for family in families] == [draw_faults(TASKS[t].plan, scene_of(t, s)) for t, s in expected]
    assert {family.wanted for family in families} == {7}


def test_records_find_their_families_by_key() -> None:
    tests, faulty = Family("t", TEST_SEED_START, 2, ("a",)), seeds.FaultFamily("t", TEST_SEED_START + 1, 2, ("a",))
    record = Record("t", TEST_SEED_START + 1, "a", True)
    assert family_key(record) == tests.key
    assert family_key(replace(record, seed=join_fault(3, record.seed))) == faulty.key != tests.key
    assert family_key(replace(record, seed=1)) not in (tests.key, faulty.key)


def at(path: ToolPath, seconds: float) -> int:
    return round(seconds * FRAME_RATE)


CUP = TASKS["place_empty_cup"].plan(scene_of("place_empty_cup"))
ARM = CUP.holds[0].arm
CLOSE, CLOSED, OPEN, OPENED = (time for time, _ in CUP.grips[ARM][3:7])


def tool_offset(fault: str, seconds: float) -> np.ndarray:
    """Offset of the faulty tool from the expert's at an instant [mm]."""
    paths = (plan.path().pose[at(plan.path(), seconds), ARM, :3] for plan in (faulty("place_empty_cup", fault), CUP))
    return 1000 * np.subtract(*paths)


@pytest.mark.parametrize("severity", [5, 10, 20, 40])
def test_a_grasp_offset_is_one_at_the_grasp_alone(severity: int) -> None:
    offset = tool_offset(f"grasp_offset:{severity}", CLOSE)
    assert np.linalg.norm(offset) == pytest.approx(severity) and offset[2] == pytest.approx(0)
    assert np.allclose(offset / severity, tool_offset("grasp_offset:5", CLOSED) / 5), "the direction is the same"
    assert np.allclose(tool_offset(f"grasp_offset:{severity}", OPEN), 0, atol=1e-6)


def test_a_missed_target_is_one_at_the_release_alone() -> None:
    assert np.linalg.norm(tool_offset("miss_target:40", OPEN)) == pytest.approx(40)
    assert np.allclose(tool_offset("miss_target:40", CLOSE), 0, atol=1e-6)


@pytest.mark.parametrize(
    ("fault", "seconds", "gripper"),
    [
        ("close_late:0.6", CLOSED, 0.5),
        ("close_late:0.6", CLOSED + 0.6, 0.0),
        ("stay_open", (CLOSED + OPEN) / 2, 0.5),
        ("stay_open", CUP.time, 1.0),
        ("open_early:30", OPEN - 0.3 * (OPEN - CLOSED) - 0.06, 0.0),
        ("open_early:30", OPEN - 0.3 * (OPEN - CLOSED) + 0.54, 0.4),
        ("open_early:30", CUP.time, 1.0),
    ],
)
def test_faults_of_the_gripper(fault: str, seconds: float, gripper: float) -> None:
    path = faulty("place_empty_cup", fault).path()
    assert path.gripper[at(path, seconds), ARM] == pytest.approx(gripper, abs=0.06)
    assert np.array_equal(path.pose, CUP.path().pose)


@pytest.mark.parametrize("severity", [5, 10, 30, 60])
def test_a_stop_is_for_good(severity: int) -> None:
    path, last = faulty("place_empty_cup", f"stop:{severity}").path(), CUP.segments[ARM][-1].end_time
    rest = at(path, (1 - severity / 100) * last) + 1
    assert (path.pose[rest:] == path.pose[-1]).all() and (path.gripper[rest:] == path.gripper[-1]).all()
    assert np.allclose(path.pose[: rest // 2], CUP.path().pose[: rest // 2]), "until then the expert moves"


@pytest.mark.parametrize("severity", [50, 80, 95])
def test_a_low_lift_is_lower_by_its_share(severity: int) -> None:
    heights = [plan.path().pose[:, ARM, 2] for plan in (CUP, faulty("place_empty_cup", f"low_lift:{severity}"))]
    held = slice(at(CUP.path(), CLOSED), at(CUP.path(), OPEN))
    floor = max(heights[0][held.start - 2], heights[0][held.stop + 2])  # where the hand stands to close and to open
    expert, low = (height[held].max() - floor for height in heights)
    assert low == pytest.approx((1 - severity / 100) * expert, abs=2e-4)


def test_a_push_goes_sideways_after_the_release() -> None:
    paths = [plan.path().pose[:, ARM, :3] for plan in (CUP, faulty("place_empty_cup", "push:60"))]
    away = np.linalg.norm(paths[1] - paths[0], axis=-1)
    assert away[: at(CUP.path(), OPENED)].max() == 0 and 0.04 < away.max() <= 0.07
    assert np.allclose(paths[1][-1], paths[0][-1])


def test_another_object_is_taken_first() -> None:
    """The hand that closes first is over B instead of A."""
    scene, path = scene_of("place_a2b_left"), faulty("place_a2b_left", "swap_objects").path()
    first = np.argmax((path.gripper < 0.1).any(1))
    arm = np.argmin(path.gripper[first])
    assert np.allclose(path.pose[first, arm, :2], scene.object("b").pose[:2], atol=1e-3)


def test_numbers_name_faults_and_0_the_expert() -> None:
    assert get_fault(0) is None and str(get_fault(NUMBERS["grasp_offset:20"])) == "grasp_offset:20"
    assert len(NUMBERS) == len(FAULTS) and list(NUMBERS)[:3] == [f"grasp_offset:{size}" for size in (5, 10, 20)]
    assert sorted(["stop:30", "push:60", "stop:5", "stay_open"], key=sort_faults)[1:] == ["stay_open", "stop:5", "stop:30"]
    with pytest.raises(EpisodeError, match=f"names fault {len(FAULTS) + 1}, expected at most {len(FAULTS)}"):
        get_fault(len(FAULTS) + 1)
    with pytest.raises(EpisodeError, match="the plan of grab_roller, seed 2, cannot have the fault push:40"):
        make_plan(TASKS["grab_roller"], scene_of("grab_roller"), NUMBERS["push:40"])


@pytest.mark.parametrize("change", ["", "height:3", "clutter:1"])
def test_the_scene_of_a_faulty_seed_is_the_experts(change: str) -> None:
    task = TASKS["place_empty_cup"]
    scenes = [make_scene(task, "place_empty_cup", join_fault(number, 7), change) for number in (0, 1, len(FAULTS))]
    assert len({scene_hash(scene) for scene in scenes}) == 1 and {scene.seed for scene in scenes} == {7}


@pytest.mark.parametrize("fault", ["grasp_offset:20", "low_lift:80"])
def test_a_fault_is_the_same_over_a_raised_table(fault: str) -> None:
    task, number = TASKS["place_empty_cup"], NUMBERS[fault]
    flat, raised = (
        make_plan(task, make_scene(task, "place_empty_cup", SEED, change), number).path().pose for change in ("", "height:6")
    )
    assert np.allclose((raised - flat)[at(CUP.path(), CLOSE), ARM, :3], [0, 0, 0.03])


@pytest.mark.parametrize(("share", "progress"), [(0.0, 0.0), (0.5, 0.545), (1.0, 1.0)])
def test_progress_is_the_same_over_a_raised_table(share: float, progress: float) -> None:
    task = TASKS["place_empty_cup"]
    for change in ("", "height:6"):
        scene = make_scene(task, "place_empty_cup", SEED, change)
        pose = np.array([thing.pose for thing in scene.objects])
        hands = np.ones(2), np.zeros((2, 2), bool)
        first = Moment(pose, np.zeros(2), np.zeros((2, 7)), *hands)
        way = np.append(pose[1, :3] + [0, 0, COASTER_HEIGHT] - pose[0, :3], np.zeros(4))
        now = replace(first, object_pose=pose + share * np.outer([1, 0], way))
        assert measure_progress(task, scene, first, now) == pytest.approx(progress, abs=0.001)


def test_physics_decides_what_comes_of_a_fault() -> None:
    faults = {"grasp_offset:5": True, "stay_open": False, "stop:30": False}
    jobs = [Job("place_empty_cup", join_fault(NUMBERS[fault], SEED), ("ur5_wsg",)) for fault in faults]
    simulated = [cell for (cell,) in simulate_cells(plan_cells(jobs), "cpu")]
    assert [cell.seed for cell in simulated] == [job.seed for job in jobs] and not any(cell.failure for cell in simulated)
    outcomes = [cell.outcome for cell in simulated if cell.outcome]
    assert [success for success, _ in outcomes] == list(faults.values())
    assert outcomes[0][1] == 1 and outcomes[1][1] < 0.1 and outcomes[2][1] < 0.9


# --- The command.

VARIANTS = 3
ROBOTS = ("franka_panda", "piper")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes with three commands each: the expert's, and then two faulty ones."""
    out = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        draw_two(patch)
        generate(arguments(out, faults=0))
        assert not any(record.fault for _, record in read_dataset(out).cells)
        generate(arguments(out))
    return out


def draw_two(patch: pytest.MonkeyPatch) -> None:
    """Let the command draw a fault with which the small task fails, and one with which it succeeds."""
    work_inline(patch)
    patch.setattr(seeds, "draw_faults", lambda planner, scene: (NUMBERS["stay_open"], NUMBERS["jitter:10"]))


def arguments(out: Path, **changes: Any) -> Args:
    asked = Args((TASK,), ROBOTS, 1, 1, out=out, device="cpu", faults=VARIANTS)
    return replace(asked, **changes)


def test_each_accepted_scene_has_its_commands(made: Path) -> None:
    data = read_dataset(made)
    scenes = Counter((record.robot, split_fault(record.seed)[1]) for _, record in data.accepted)
    assert scenes == {(robot, seed): VARIANTS for robot in ROBOTS for seed in (0, TEST_SEED_START)}
    assert all(bool(record.fault) == (record.seed >= 10_000_000) == (record.progress is not None) for _, record in data.cells)
    outcomes = {(record.fault, record.success) for _, record in data.accepted}
    assert outcomes == {("", True), ("stay_open", False), ("jitter:10", True)}
    assert all(record.success == (record.progress == 1) for _, record in data.accepted if record.fault)
    tested = data.select(split="test")
    assert len(tested) == len(ROBOTS) * VARIANTS and {seed_split(record.seed) for _, record in tested} == {"test"}


def test_all_commands_of_a_scene_begin_with_the_same_frame(made: Path) -> None:
    first = {
        (record.robot, split_fault(record.seed)[1], read_pixels(folder, "rgb", 1).tobytes(), record.scene_hash)
        for folder, record in read_dataset(made).accepted
    }
    assert len(first) == len(ROBOTS) * 2


def test_faulty_episodes_can_be_verified_and_headers_of_experts_name_no_fault(made: Path) -> None:
    for folder, record in read_dataset(made).accepted:
        assert find_problem(folder) == ""
        header = json.loads((folder / "episode.json").read_text())
        assert ("fault" in header, "progress" in header) == (bool(record.fault),) * 2


def test_what_is_missing_of_the_faults_is_made_again(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = Path(shutil.copytree(made, tmp_path / "data"))
    folder, record = next((folder, record) for folder, record in read_dataset(out).accepted if record.fault)
    shutil.rmtree(folder)
    draw_two(monkeypatch)
    families = generate(arguments(out))
    assert read_record(folder) == record
    assert [family.accepted for family in families] == [1, 1, VARIANTS - 1, VARIANTS - 1]
    assert sorted(path.name for path in out.rglob("episode.json")) == sorted(path.name for path in made.rglob("episode.json"))


def test_a_fault_that_one_robot_cannot_do_is_refused_for_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells, "find_refusal", lambda scene, path, motion, tools: ("physics", "it sank") if motion else None)
    monkeypatch.setattr(seeds, "draw_faults", lambda planner, scene: (3, 1, 2))
    work_inline(monkeypatch)
    families = generate(arguments(tmp_path, test_seeds=0, faults=2, states_only=True))
    faulty_records = [record for _, record in read_dataset(tmp_path).cells if record.fault]
    assert families[-1].accepted == 0 and len(faulty_records) == len(ROBOTS) * 3, "all faults have been tried"
    assert not any(record.is_kept or record.success or record.hashes for record in faulty_records)
    assert "physics" in fault_table(faulty_records) and {record.seed for _, record in find_accepted(tmp_path)} == {0}


def test_the_summary_counts_outcomes_by_fault() -> None:
    def outcome(seed: int, robot: str, fault: str, progress: float | None) -> Record:
        failure = "plan" if progress is None else None
        return Record("task", seed, robot, progress == 1, failure=failure, fault=fault, progress=progress, hashes={"rgb": "0"})

    records = [outcome(10_000_000, robot, "stop:10", progress) for robot, progress in (("a", 1.0), ("b", 0.5))]
    records += [outcome(10_000_001, robot, "stop:10", progress) for robot, progress in (("a", 1.0), ("b", None))]
    assert fault_table(records).splitlines()[1].split() == ["stop:10", "2", "1", "2", "50%", "0.75", "plan", "1"]
    assert fault_table(records).splitlines()[-1] == "commands by scene: 2 in 1"
    assert "tried" not in yield_table(records) and yield_table(records).splitlines()[0] == "motion: shared 4"
    assert describe(records[:2]) == " (stop:10: 1 of 2 succeed)"
