"""The protocol as data: counts of the paper's tables, roles, names, and that the model knows every word of it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from xew.model.conditions import ACTIONS, CONDITIONS
from xew.protocol import (
    DISTANCE_BODIES,
    FIXED,
    FORGETTING_ROBOT,
    HALVES,
    HELD_OUT_ROBOTS,
    LOEO,
    MOTIONS,
    PAPER_PARTS,
    PARTS,
    ROBOT_NAMES,
    SCALING,
    SEED_STARTS,
    SEEN_ROBOTS,
    SHOTS,
    SPLITS,
    TASK_COUNT,
    TASK_GROUPS,
    TEST_SEED_START,
    TRAINING_BODIES,
    UNSEEN_BODIES,
    VALIDATION,
    VALIDATION_BODIES,
    VALIDATION_SEED_START,
    VARIANTS,
    Variant,
    expected_counts,
    join_fault,
    reference,
    seed_split,
    split_fault,
    split_key,
    training_counts,
    validation_split,
)
from xew.sim_warp.robots.procedural.bodies import read_catalog
from xew.sim_warp.tasks import TASKS


def count(variant: Variant, robots: tuple[str, ...]) -> int:
    """Scored episodes of some robots at the paper's size."""
    return sum(number for robot, number in expected_counts(variant).items() if robot in robots)


def test_the_suite_has_25_tasks() -> None:
    assert len(TASKS) == TASK_COUNT == 25


def test_each_task_is_of_one_group_as_on_its_page() -> None:
    page = (Path(__file__).parents[1] / "docs" / "tasks.md").read_text("utf-8").splitlines()
    rows = {f"| {group} | {', '.join(f'`{task}`' for task in tasks)} |" for group, tasks in TASK_GROUPS.items()}
    assert rows <= set(page)
    assert sorted(task for tasks in TASK_GROUPS.values() for task in tasks) == sorted(TASKS)


@pytest.mark.parametrize("part", ["fixed", "actions", "ladder", "baselines"])
def test_fixed_split_scores_1500_seen_and_500_of_each_held_out_robot(part: str) -> None:
    for variant in PARTS[part]:
        assert (variant.seen_robots, variant.held_out_robots) == (SEEN_ROBOTS, HELD_OUT_ROBOTS)
        assert count(variant, variant.seen_robots) == 1500
        assert [count(variant, (robot,)) for robot in variant.held_out_robots] == [500, 500]
        assert sum(training_counts(variant).values()) == 3750


def test_each_loeo_fold_scores_2000_seen_and_500_held_out_records() -> None:
    assert [variant.held_out_robots for variant in PARTS["loeo"]] == [(robot,) for robot in ROBOT_NAMES]
    for variant in PARTS["loeo"]:
        assert set(SPLITS[variant.split].train_robots) | set(variant.held_out_robots) == set(ROBOT_NAMES)
        assert count(variant, variant.seen_robots) == 2000
        assert count(variant, variant.held_out_robots) == 500
        assert sum(training_counts(variant).values()) == 5000


def test_few_shot_adapts_with_25_50_75_episodes_and_forgets_on_the_same_500() -> None:
    for target in HELD_OUT_ROBOTS:
        rows = [variant for variant in PARTS["few_shot"] if variant.target == target]
        assert [sum(training_counts(variant).values()) for variant in rows] == [25, 50, 75]
        assert [variant.shots for variant in rows] == list(SHOTS)
        for variant in rows:
            assert variant in PARTS["forgetting"]
            assert expected_counts(variant) == {FORGETTING_ROBOT: 500, target: 500}
            assert variant.start == reference(embodiment="nine_views") == PARTS["few_shot"][0]


def test_the_rows_of_the_papers_tables() -> None:
    assert [variant.action for variant in PARTS["actions"]] == ["joints", "ray_map", "mask", "optical_flow"]
    ladder = ["none", "reference_image", "nine_views", "articulation_clip", "robot_render"]
    assert [variant.embodiment for variant in PARTS["ladder"]] == ladder
    assert [variant.system for variant in PARTS["baselines"]] == ["irasim", "ctrl_world", "enerverse_ac", "reference"]
    assert set(PAPER_PARTS) < set(PARTS)
    assert len({variant.name for part in PAPER_PARTS for variant in PARTS[part]}) == 22


def test_names_are_unique_and_fit_for_folders() -> None:
    variants = {variant for part in PARTS.values() for variant in part}
    assert len(VARIANTS) == len(variants)
    assert all(re.fullmatch(r"[a-z0-9_]+(-[a-z0-9_]+)*", name) for name in VARIANTS)


def test_the_model_knows_every_action_conditioning_and_split() -> None:
    for variant in VARIANTS.values():
        assert variant.action in ACTIONS and variant.embodiment in CONDITIONS and variant.split in SPLITS
        assert variant.start is None or variant.start in VARIANTS.values()
    loeo = {f"loeo_{robot}" for robot in LOEO}
    shared = {"fixed", "validation", *loeo, *SCALING, *HALVES}
    assert set(SPLITS) == {key + ending for key in shared for ending in ("", "_own")}


def test_the_key_of_a_split_says_the_motion_of_its_episodes() -> None:
    assert [SPLITS[key].motion for key in ("fixed", "loeo_piper_own")] == ["shared", "own"]
    for motion in MOTIONS:
        split = SPLITS[split_key("fixed", motion)]
        assert replace(split, motion="shared") == FIXED
        assert validation_split(split).motion == motion


def test_splits_with_bodies_count_what_they_should() -> None:
    """K = 4, 16, 64 bodies, with the three robots and without; Panda, PiPER and 32 bodies to be tested on."""
    trained = {key: len(split.train_robots) for key, split in SCALING.items()}
    assert sorted(trained.values()) == [3, 4, 7, 16, 19, 64, 67]
    for key, split in SCALING.items():
        tested = 34 + 64 * (key == "scaling_seen")  # with the wide family, for error against distance
        assert len(split.held_out_robots) == tested and set(HELD_OUT_ROBOTS) < set(split.held_out_robots)
    assert SCALING["scaling_seen"].held_out_robots[34:] == DISTANCE_BODIES


def test_validation_is_of_the_training_side_and_of_robots_that_train() -> None:
    for family, start in SEED_STARTS.items():
        assert seed_split(start) == seed_split(start + 99_999) == family
    assert 0 < VALIDATION_SEED_START < TEST_SEED_START
    for split in SPLITS.values():
        validation = validation_split(split)
        assert validation.train_robots == split.train_robots and validation.held_out_robots == VALIDATION_BODIES
    assert validation_split(FIXED) == VALIDATION


def test_no_body_has_two_roles() -> None:
    roles = (TRAINING_BODIES, UNSEEN_BODIES, VALIDATION_BODIES, DISTANCE_BODIES)
    assert sum(map(len, roles)) == len(set().union(*roles)) == len(read_catalog())
    for split in SPLITS.values():
        assert set(split.train_robots).isdisjoint(split.held_out_robots)
    smaller = SPLITS["scaling_bodies_4"].train_robots
    assert SPLITS["scaling_bodies_16"].train_robots[:4] == smaller, "more bodies are those before and others"


def test_a_smaller_study_counts_what_it_has() -> None:
    robots = ("ur5_wsg", "piper")
    assert expected_counts(reference(), tasks=2, test_seeds=3, robots=robots) == {"ur5_wsg": 6, "piper": 6}
    assert training_counts(reference(), tasks=2, train_seeds=4, robots=robots) == {"ur5_wsg": 8}
    assert training_counts(VARIANTS["few_shot-franka_panda-2"], robots=robots) == {}


@pytest.mark.parametrize("base", [0, 799_999, *SEED_STARTS.values(), 2_000_007])
@pytest.mark.parametrize("fault", [0, 1, 27])
def test_a_faulty_seed_is_of_the_family_of_its_scene(fault: int, base: int) -> None:
    seed = join_fault(fault, base)
    assert split_fault(seed) == (fault, base) and (seed == base) == (fault == 0)
    assert seed_split(seed) == seed_split(base)
