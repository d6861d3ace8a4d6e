"""Every figure of the pages on results is computed again from the committed scores, to the last digit that is printed."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from xew.analysis.scores import read_scores
from xew.analysis.statistics.grades import StudyGrades, paired_means, relative_gain, unseen_gap
from xew.protocol import FORGETTING_ROBOT, HELD_OUT_ROBOTS, PASTED_RENDER, ROBOT_NAMES, SEEN_ROBOTS, UNSEEN_BODIES, reference
from xew.statistics import Mean, combine

RESULTS = Path(__file__).parents[2] / "docs" / "results"
FRANKA, PIPER = HELD_OUT_ROBOTS
GROUPS = {"seen": SEEN_ROBOTS, "franka": (FRANKA,), "piper": (PIPER,), "ur5": (FORGETTING_ROBOT,), "bodies": UNSEEN_BODIES[:16]}
GROUPS |= {"aloha": ROBOT_NAMES[:1], "arx": ROBOT_NAMES[1:2]}
BASELINE = {
    "frozen first frame": "copy_first_frame",
    "pasted render": PASTED_RENDER,
    "another robot's episode": "other_robot",
}


@cache
def grades_of(folder: str) -> StudyGrades:
    """The means of a folder's scores; those of a run have its model's name, or the configs' where it has two."""
    scores = read_scores(RESULTS / folder / "scores.parquet")
    rows = scores.rows
    if "variant" not in rows:
        own = ~rows["model"].isin([*BASELINE.values(), "codec_truth", "ground_truth"])
        rows = rows.assign(variant=(rows["model"] + " " + rows["condition"]).where(own, ""))
    return StudyGrades(rows, scores.metrics, {}, codecs=scores.codecs)


def mean(folder: str, variant: str, group: str, metric: str) -> float:
    found = grades_of(folder).variant_mean(variant, GROUPS[group], metric)
    assert found is not None, (folder, variant, group, metric)
    return found.value


def read_rows(folder: str) -> list[list[str]]:
    """The cells of all rows of all tables of a page."""
    lines = (RESULTS / folder / "README.md").read_text().splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]


def row_of(folder: str, label: str, number: int = 0) -> list[str]:
    return [cells[1:] for cells in read_rows(folder) if cells[0].replace("*", "") == label][number]


def demand(cell: str, values: list[float]) -> None:
    """A cell prints these numbers with as many decimals as each has there; what is in no number is free."""
    printed = re.findall(r"[−-]?\d+\.?\d*", cell)
    shown = [f"{value:.{len(text.partition('.')[2])}f}".replace("-", "−") for value, text in zip(values, printed, strict=True)]
    assert [text.replace("-", "−") for text in printed] == shown, cell


SIX = {
    "joint angles": "fixed-joints-none",
    "ray map": "fixed-ray_map-none",
    "mask": "fixed-mask-none",
    "optical flow": "fixed-optical_flow-none",
    "flow and per-frame render": "fixed-optical_flow-robot_render",
    **BASELINE,
}
STRICT = ("lpips", "mask_iou", "robot_lpips", "keypoint_error_strict", "trajectory_error_strict")


@pytest.mark.parametrize("label", SIX)
def test_scores_on_six_tasks(label: str) -> None:
    for cell, metric in zip(row_of("six_tasks", label), STRICT, strict=True):
        demand(cell, [mean("six_tasks", SIX[label], group, metric) for group in ("seen", "franka", "piper")])


def test_the_truth_through_the_codec() -> None:
    (name,) = grades_of("six_tasks").codec_truths
    for cell, metric in zip(row_of("six_tasks", "truth through the codec"), STRICT, strict=True):
        demand(cell, [mean("six_tasks", name, group, metric) for group in ("seen", "franka", "piper")])


@pytest.mark.parametrize(("label", "group"), [("seen robots", "seen"), ("Franka", "franka"), ("Piper", "piper")])
def test_other_systems(label: str, group: str) -> None:
    names = ("fixed-irasim", "fixed-ctrl_world", "fixed-enerverse_ac", "fixed-optical_flow-none")
    demand(" ".join(row_of("six_tasks", label)), [mean("six_tasks", name, group, "lpips") for name in names])


MAIN = {
    "LPIPS ↓": "lpips",
    "PSNR [dB] ↑": "psnr",
    "mask IoU ↑": "mask_iou",
    "object error, strict [px] ↓": "trajectory_error_strict",
    "keypoint error, strict [px] ↓": "keypoint_error_strict",
    "robot LPIPS ↓": "robot_lpips",
}
RECIPE = MAIN | {"gripper error [px] ↓": "gripper_error", "flicker [levels] ↓": "flicker"}


def recipe(metric: str, group: str, folder: str = "recipe") -> tuple[float, float]:
    """The mean of all runs of the recommended recipe, and the pasted render."""
    runs = [mean(folder, name, group, metric) for name in grades_of(folder).variants]
    return sum(runs) / len(runs), mean(folder, PASTED_RENDER, group, metric)


@pytest.mark.parametrize("label", RECIPE)
def test_the_recommended_recipe(label: str) -> None:
    for cell, group in zip(row_of("recipe", label), ("seen", "piper", "franka"), strict=True):
        demand(cell, list(recipe(RECIPE[label], group)))


@pytest.mark.parametrize("label", RECIPE)
def test_the_recommended_recipe_on_all_tasks(label: str) -> None:
    """The README has the same, where it names them."""
    metric, readme = RECIPE[label], (RESULTS.parents[1] / "README.md").read_text()
    for cell, group in zip(row_of("all_tasks", label), ("seen", "piper", "franka"), strict=True):
        demand(cell, list(recipe(metric, group, "all_tasks")))
        if metric == "lpips" or (metric, group) == ("robot_lpips", "franka"):
            assert cell.split(" ")[0] in readme, (cell, group)


def test_each_task_of_the_recommended_recipe() -> None:
    """Tasks are in the order of LPIPS on training robots."""
    rows = read_scores(RESULTS / "all_tasks" / "scores.parquet").rows
    own = rows[rows["model"].isin(["fixed", "fixed_1"])]
    shown = [cells for cells in read_rows("all_tasks") if cells[0].startswith("`")]
    for cells in shown:
        of_task = own[own["task"] == cells[0].strip("`")]
        for cell, metric in zip(cells[1:], ("lpips", "trajectory_error_strict"), strict=True):
            of_metric = of_task[of_task["metric"] == metric]
            groups = [of_metric[of_metric["robot"].isin(GROUPS[group])] for group in ("seen", "piper", "franka")]
            demand(cell, [group["value"].mean() for group in groups])
    assert len(shown) == own["task"].nunique() == 25
    first = [float(cells[1].split(" ")[0]) for cells in shown]
    assert first == sorted(first)


SCALING = {f"three robots, K = {count}": f"scaling_seen_bodies_{count}" for count in (4, 16, 64)}
SCALING |= {f"bodies alone, K = {count}": f"scaling_bodies_{count}" for count in (16, 64)} | {
    "three robots, K = 0": "scaling_seen"
}


@pytest.mark.parametrize("label", [*SCALING, "frozen first frame", "pasted render"])
def test_bodies(label: str) -> None:
    name = reference(SCALING[label], embodiment="robot_render").name if label in SCALING else BASELINE[label]
    demand(" ".join(row_of("bodies", label)), [mean("bodies", name, group, "lpips") for group in ("franka", "piper", "bodies")])


@pytest.mark.parametrize(("label", "split"), [("K = 0", "scaling_seen"), ("K = 64", "scaling_seen_bodies_64")])
def test_the_price_of_bodies(label: str, split: str) -> None:
    name = reference(split, embodiment="robot_render").name
    demand(" ".join(row_of("bodies", label)), [mean("bodies", name, group, "lpips") for group in ("aloha", "arx", "ur5")])


@pytest.mark.parametrize(("label", "ending"), [("all weights", ""), ("replay", "-replay"), ("LoRA", "-lora")])
def test_remedies(label: str, ending: str) -> None:
    """Four blocks: the new robot and UR5 after it, of Franka and of Piper."""
    start = "fixed-optical_flow-nine_views"
    for number, (target, group) in enumerate(((FRANKA, "franka"), (FRANKA, "ur5"), (PIPER, "piper"), (PIPER, "ur5"))):
        cells = row_of("remedies", label, number)
        scores = [mean("remedies", f"few_shot-{target}-{shots}{ending}", group, "lpips") for shots in (1, 2, 3)]
        demand(" ".join(cells), scores)
        if group == "ur5":
            before = mean("remedies", start, "ur5", "lpips")
            worse = [round(100 * (score / before - 1)) for score in scores]
            shown = row_of("remedies", label, 4)[target == PIPER]
            printed = [int(text.replace("−", "-")) for text in re.findall(r"−?\d+", shown)]
            assert printed == (worse if " to " not in shown else [min(worse), max(worse)]), shown


def interval(number: Mean, share: float = 100) -> str:
    """Text such as '27 [19, 36]'."""
    value, *ends = (f"{share * end:.0f}".replace("-", "−") for end in (number.value, *number.interval()))
    return f"{value} [{', '.join('0' if end == '−0' else end for end in ends)}]"


def gain(folder: str, part: str, row: str, base: str, robots: str, metric: str = "lpips") -> Mean:
    grades = grades_of(folder)
    pair = paired_means(grades, part, row, base, robots, metric)
    assert pair is not None
    return relative_gain(*pair, grades.metrics[metric])


def loss(*address: str) -> Mean:
    return combine(np.negative, gain("six_tasks", *address))


def test_the_gap_of_each_robot() -> None:
    gaps = [unseen_gap(grades_of("six_tasks"), robot, "lpips") for robot in ROBOT_NAMES]
    assert row_of("six_tasks", "LPIPS worse by [%]") == [interval(gap) for gap in gaps if gap]
    values = sorted(round(100 * gap.value) for gap in gaps if gap)
    text = f"{values[0]} to {values[-1]} %"
    assert all(text in page.read_text() for page in (RESULTS / "README.md", RESULTS / "six_tasks" / "README.md"))
    assert text in (RESULTS.parent / "reproduce_the_paper.md").read_text()


@pytest.mark.parametrize("robot", HELD_OUT_ROBOTS)
def test_sentences_on_six_tasks(robot: str) -> None:
    """On the page of the study, and where others repeat it."""
    page, index = ((RESULTS / name).read_text() for name in ("six_tasks/README.md", "README.md"))
    adapted = interval(gain("six_tasks", "few_shot", f"{robot}-1", f"{robot}-0", robot))
    assert f"{adapted} % on {'Franka' if robot == FRANKA else 'Piper'}" in page and adapted in index
    forgotten = loss("forgetting", f"{robot}-1", "none", FORGETTING_ROBOT)
    assert f"{interval(forgotten)} %" in page
    render = gain("six_tasks", "ladder", "robot_render", "none", robot).value
    assert f"{100 * render:.0f} %" in page and f"{100 * render:.0f} %" in index
    found = {row: gain("six_tasks", "actions", row, "joints", robot) for row in ("mask", "optical_flow")}
    assert all(27 <= round(100 * each.value) <= 44 for each in found.values())
    assert interval(found["mask"]) in index


def test_descriptions_of_the_robot_on_franka() -> None:
    rows = ("reference_image", "nine_views", "articulation_clip")
    worse = sorted(round(100 * loss("ladder", row, "none", FRANKA).value) for row in rows)
    for page in ("six_tasks/README.md", "README.md"):
        assert f"{worse[0]} to {worse[-1]} %" in (RESULTS / page).read_text()


def test_sentences_on_bodies() -> None:
    page, index = ((RESULTS / name).read_text() for name in ("bodies/README.md", "README.md"))
    gains = {
        count: interval(gain("bodies", "scaling", f"scaling_seen_bodies_{count}", "scaling_seen", "bodies"))
        for count in (4, 64)
    }
    assert all(f"{text} %" in each for text in gains.values() for each in (page, index))
    others = [
        gain("bodies", "scaling", f"scaling_seen_bodies_{count}", "scaling_seen", robot).value
        for count in (4, 16, 64)
        for robot in HELD_OUT_ROBOTS
    ]
    text = f"{100 * min(others):.0f} to {100 * max(others):.0f} %"
    assert text in page and text in index


def test_what_runs_differ_by_and_what_is_lost() -> None:
    page, scores = (RESULTS / "six_tasks" / "README.md").read_text(), grades_of("six_tasks")
    for name, group, text in (
        ("fixed-optical_flow-none", "franka", "{:.3f} on Franka and"),
        ("fixed-optical_flow-none", "piper", "{:.3f} on Piper."),
        ("fixed-optical_flow-robot_render", "franka", "by {:.3f} on Franka."),
    ):
        number = scores.variant_mean(name, GROUPS[group], "lpips")
        assert number is not None
        runs = [float(run[0]) for run in number.parts[0].runs.values()]
        assert text.format(max(runs) - min(runs)) in page
    found = mean("six_tasks", "fixed-optical_flow-none", "franka", "coverage_strict")
    error = mean("six_tasks", "fixed-optical_flow-none", "franka", "keypoint_error_strict")
    assert f"finds {found:.0%} of".replace("%", " %") in page
    assert f"{54.127 * (1 - found):.1f} of the {error:.1f} px" in page
    table, within = (
        100 * (1 - mean("six_tasks", SIX["optical flow"], "piper", "lpips") / mean("six_tasks", SIX["mask"], "piper", "lpips")),
        100 * gain("six_tasks", "actions", "optical_flow", "mask", PIPER).value,
    )
    assert f"reads {table:.1f} % from the table, and is {within:.1f} %".replace("-", "−") in page


def test_sentences_on_own_motion() -> None:
    """Those that the report writes, in the page's form; the report's are compared with the scores."""
    page = (RESULTS / "own_motion" / "README.md").read_text()
    sentences = (RESULTS / "own_motion" / "tables" / "sentences.txt").read_text().replace("\u00a0", " ")
    changes = re.findall(r"([+−]\d+) % \(([+−]\d+) % to ([+−]\d+) %\) with (ray map|mask|optical flow)", sentences)
    assert len(changes) == 6
    for value, low, high, _ in changes:
        assert f"{value} [{low}, {high}]".replace("+", "") in page


@pytest.mark.parametrize("axis", ["kinematic", "appearance"])
def test_correlations_over_bodies(axis: str) -> None:
    sentences = (RESULTS / "bodies" / "tables" / "sentences.txt").read_text().replace("−", "-")
    found = re.search(rf"{axis} distance at r = (\S+) \((\S+) to (\S+), p = (\S+)\)", sentences)
    assert found is not None
    r, low, high, p = map(float, found.groups())
    pages = [(RESULTS / name).read_text().replace("−", "-") for name in ("bodies/README.md", "README.md")]
    assert f"{r:.2f} [{low:.2f}, {high:.2f}] (p = {p:.2f})" in pages[0] and f"{r:.2f} [{low:.2f}, {high:.2f}]" in pages[1]
    assert all(f"above {high:.2f}" in page for page in pages)
