"""Goals of tasks that put things into, onto or against others, by scenes set by hand: what counts and what does not."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xew.sim_warp.scene import Scene, scene_rng
from xew.sim_warp.stage import TABLE_TOP
from xew.sim_warp.tasks import TASKS
from xew.sim_warp.tasks.blocks_ranking_size import SIZES
from xew.sim_warp.tasks.place_bread_basket import FLOOR, SLOT, breads
from xew.sim_warp.tasks.place_burger_fries import spots
from xew.sim_warp.tasks.place_dual_shoes import TIP_LEFT, slots
from xew.sim_warp.tasks.place_phone_stand import LEAN, ledge
from xew.sim_warp.tasks.task import Moment

SEEDS = range(24)
WIDEST_GRASP = 0.065
Goals = dict[str, tuple[np.ndarray, Rotation]]
UPRIGHT = Rotation.identity()


def size_goals(scene: Scene) -> Goals:
    return {name: (np.array([*xy, TABLE_TOP]), UPRIGHT) for name, xy in scene.targets.items()}


def bread_goals(scene: Scene) -> Goals:
    middle, things = np.array(scene.object("basket").pose[:3]) + [0, 0, FLOOR], breads(scene)
    shifts = [0.0] if len(things) == 1 else [-SLOT, SLOT]
    return {thing.name: (middle + [shift, 0, 0], UPRIGHT) for thing, shift in zip(things, shifts, strict=True)}


def tray_goals(scene: Scene) -> Goals:
    return {name: (spot, UPRIGHT) for name, spot in spots(scene).items()}


def shoe_goals(scene: Scene) -> Goals:
    return {name: (place, Rotation.from_euler("z", TIP_LEFT)) for name, place in slots(scene).items()}


def phone_goals(scene: Scene, lean: float = LEAN) -> Goals:
    """The phone with its lower edge on the ledge, leaning by an angle."""
    turned = Rotation.from_quat(scene.object("stand").pose[3:]) * Rotation.from_euler("x", lean)
    edge = [0, scene.object("phone").shape.hulls[0][:, 1].min(), 0]
    return {"phone": (ledge(scene) - turned.apply(edge), turned)}


def seal_goals(scene: Scene) -> Goals:
    return {"seal": (np.array(scene.object("square").pose[:3]), UPRIGHT)}


GOALS: dict[str, Callable[[Scene], Goals]] = {
    "blocks_ranking_size": size_goals,
    "place_bread_basket": bread_goals,
    "place_burger_fries": tray_goals,
    "place_dual_shoes": shoe_goals,
    "place_phone_stand": phone_goals,
    "stamp_seal": seal_goals,
}


def sampled(task: str, seed: int) -> Scene:
    return TASKS[task].sample(scene_rng(task, seed), seed)


def moment_of(scene: Scene, goals: Goals, gripper: tuple[float, float] = (1.0, 1.0)) -> Moment:
    """Everything at its goal, the hands far off."""
    pose = np.array([thing.pose for thing in scene.objects])
    for name, (position, rotation) in goals.items():
        pose[scene.index(name)] = [*position, *rotation.as_quat()]
    count = len(scene.objects)
    tools = np.tile([0.0, -0.5, 1.2, 0, 0, 0, 1], (2, 1))
    return Moment(pose, np.zeros(count), tools, np.array(gripper), np.zeros((2, count), bool))


def succeeds(scene: Scene, goals: Goals, gripper: tuple[float, float] = (1.0, 1.0)) -> bool:
    return TASKS[scene.task].success(scene, moment_of(scene, goals, gripper))


def shifted(goals: Goals, name: str, by: tuple[float, float, float]) -> Goals:
    position, rotation = goals[name]
    return goals | {name: (position + by, rotation)}


@pytest.mark.parametrize("task", GOALS)
def test_things_at_their_goals_are_a_success_that_open_hands_complete(task: str) -> None:
    for seed in SEEDS:
        scene = sampled(task, seed)
        goals = GOALS[task](scene)
        assert succeeds(scene, goals)
        assert not succeeds(scene, goals, (1.0, 0.7)) and not succeeds(scene, goals, (0.0, 1.0))


@pytest.mark.parametrize(
    ("task", "near", "far"),
    [
        ("blocks_ranking_size", (0.01, 0.02, 0), (0, 0.05, 0)),
        ("place_bread_basket", (0.008, 0.05, 0), (0, 0.07, 0)),
        ("place_bread_basket", (0, 0, 0.01), (0, 0, 0.04)),
        ("place_burger_fries", (0.05, 0.05, 0.01), (0.06, 0.06, 0)),
        ("place_burger_fries", (0, 0, 0.01), (0, 0, 0.02)),
        ("place_dual_shoes", (0.04, -0.04, 0.01), (0, -0.06, 0)),
        ("place_dual_shoes", (0.04, 0.04, 0), (0.06, 0, 0)),
        ("place_dual_shoes", (0, 0, 0.01), (0, 0, 0.03)),
        ("place_phone_stand", (0.04, 0.03, 0.03), (0, 0.05, 0)),
        ("place_phone_stand", (0, 0, 0.03), (0, 0, 0.05)),
        ("stamp_seal", (0.008, 0.008, 0), (0.012, 0, 0)),
        ("stamp_seal", (0, 0, 0.004), (0, 0, 0.006)),
    ],
)
def test_near_misses_count_and_far_ones_do_not(
    task: str, near: tuple[float, float, float], far: tuple[float, float, float]
) -> None:
    scene = sampled(task, 3)
    goals = GOALS[task](scene)
    for name in goals:
        assert succeeds(scene, shifted(goals, name, near)), name
        assert not succeeds(scene, shifted(goals, name, far)), name


def test_blocks_in_another_order_are_no_success() -> None:
    scene = sampled("blocks_ranking_size", 0)
    goals = size_goals(scene)
    assert not succeeds(scene, goals | {"large_block": goals["small_block"], "small_block": goals["large_block"]})
    widths = [float(np.ptp(scene.object(f"{size}_block").shape.hulls[0][:, 0])) for size in SIZES]
    assert widths == sorted(widths, reverse=True) and np.diff(widths).max() < -0.003


@pytest.mark.parametrize(("turn", "counts"), [(0.2, True), (-0.2, True), (0.35, False), (np.pi, False)])
def test_tips_of_shoes_point_to_the_left(turn: float, counts: bool) -> None:
    scene = sampled("place_dual_shoes", 1)
    for name, (position, rotation) in shoe_goals(scene).items():
        turned = {name: (position, Rotation.from_euler("z", turn) * rotation)}
        assert succeeds(scene, shoe_goals(scene) | turned) is counts


def test_swapped_shoes_are_no_success() -> None:
    scene = sampled("place_dual_shoes", 1)
    goals = shoe_goals(scene)
    assert not succeeds(scene, {"left_shoe": goals["right_shoe"], "right_shoe": goals["left_shoe"]})


@pytest.mark.parametrize(("degrees", "counts"), [(0, False), (25, False), (35, True), (47, True), (60, False), (130, False)])
def test_a_phone_leans_on_its_stand(degrees: float, counts: bool) -> None:
    scene = sampled("place_phone_stand", 2)
    assert succeeds(scene, phone_goals(scene, np.radians(degrees))) is counts


def test_a_seal_that_lies_has_not_stamped() -> None:
    scene = sampled("stamp_seal", 0)
    position, _ = seal_goals(scene)["seal"]
    assert not succeeds(scene, {"seal": (position, Rotation.from_euler("x", np.radians(12)))})


def test_some_baskets_get_one_bread_and_some_two() -> None:
    counts = {len(breads(sampled("place_bread_basket", seed))) for seed in SEEDS}
    assert counts == {1, 2}
    for seed in SEEDS:
        scene = sampled("place_bread_basket", seed)
        assert ("and the" in scene.words["bread"]) == (len(breads(scene)) == 2)


@pytest.mark.parametrize("task", GOALS)
def test_what_is_taken_fits_a_hand_and_begins_at_rest_on_the_table(task: str) -> None:
    for seed in SEEDS:
        for thing in sampled(task, seed).objects:
            assert len(thing.shape.hulls) <= 10, thing.name
            if thing.is_fixed:
                continue
            points = np.concatenate(thing.shape.hulls)
            lowest = (Rotation.from_quat(thing.pose[3:]).apply(points)[:, 2] + thing.pose[2]).min()
            assert abs(lowest - TABLE_TOP) < 1e-6, thing.name
            assert np.ptp(points[:, :2], axis=0).min() <= WIDEST_GRASP, thing.name
            assert 0.03 <= thing.mass <= 0.3
