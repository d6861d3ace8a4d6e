"""Figures that sentences of the pages quote, outside their tables, are computed again from the committed scores.

Each line names the pages, the sentence with a place for each number, and the function that computes them.
"""

import re
from collections.abc import Callable, Iterable
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

from tests.analysis.test_results_pages import (
    FRANKA,
    GROUPS,
    PIPER,
    RESULTS,
    demand,
    gain,
    grades_of,
    interval,
    loss,
    mean,
    recipe,
    row_of,
)
from xew.analysis.beyond.difficulty import body_errors, correlate_bodies
from xew.analysis.paper import read_paper
from xew.analysis.scores import read_scores
from xew.analysis.statistics.grades import PaperGrades, paired_means, relative_gain, unseen_gap
from xew.analysis.statistics.suites import StrictGrades
from xew.analysis.tables.claims import CLAIMS
from xew.analysis.tables.comparisons import Reader
from xew.analysis.tables.distances import read_distances
from xew.analysis.tables.findings import FAILS, HOLDS, UNMEASURED, ask
from xew.protocol import (
    CODEC_TRUTH,
    COPY_FIRST_FRAME,
    DISTANCE_BODIES,
    FORGETTING_ROBOT,
    GROUND_TRUTH,
    HELD_OUT_ROBOTS,
    PASTED_RENDER,
    ROBOT_NAMES,
    reference,
)

DOCS = RESULTS.parent
PAPER_CLAIMS = [claim for claim in CLAIMS if claim.where != "ours"]
Numbers = Iterable[float | str]


def read_page(name: str) -> str:
    """A page by its name below docs, or README; all minus signs are alike."""
    paths = {"README": DOCS.parent / "README.md", "results": RESULTS / "README.md"}
    folder = RESULTS / name / "README.md"
    return paths.get(name, folder if folder.exists() else DOCS / f"{name}.md").read_text().replace("−", "-")


def half_widths(numbers: Iterable) -> Numbers:
    """The smallest and the largest distance of interval ends from their number [%]."""
    apart = [100 * abs(end - number.value) for number in numbers for end in number.interval()]
    return min(apart), max(apart)


def gaps() -> Iterable:
    return [unseen_gap(grades_of("six_tasks"), robot, "lpips") for robot in ROBOT_NAMES]


@cache
def paper_grades() -> PaperGrades:
    return PaperGrades(read_paper(), grades_of("six_tasks").metrics.values())


def paper_gain(part: str, row: str, base: str, robot: str) -> float:
    pair = paired_means(paper_grades(), part, row, base, robot, "lpips")
    assert pair is not None
    return 100 * relative_gain(*pair, paper_grades().metrics["lpips"]).value


def paper_first_shots() -> Numbers:
    return [paper_gain("few_shot", f"{robot}-1", f"{robot}-0", robot) for robot in HELD_OUT_ROBOTS]


def paper_renders() -> Numbers:
    return [paper_gain("ladder", "robot_render", "none", robot) for robot in HELD_OUT_ROBOTS]


def forgotten() -> Numbers:
    return [100 * loss("forgetting", f"{FRANKA}-1", "none", FORGETTING_ROBOT).value]


def printed_forgetting() -> float:
    """What the paper's text says of UR5 after one demonstration of Franka [%]."""
    place = f"forgetting/{FRANKA}-1/{FORGETTING_ROBOT}"
    return next(change.percent for change in read_paper().changes if change.after == place and change.metric == "lpips")


def percent(*numbers: float) -> Numbers:
    return [100 * number for number in numbers]


def render_gains() -> Numbers:
    return percent(*(gain("six_tasks", "ladder", "robot_render", "none", robot).value for robot in HELD_OUT_ROBOTS))


def cell(folder: str, table: str, row: str, column: str) -> float:
    rows = pd.read_csv(RESULTS / folder / "tables" / f"{table}.csv")
    return float(rows[(rows["row"] == row) & (rows["column"] == column)]["value"].item())


def correlation(axis: str, table: str = "correlations", row: str = "LPIPS") -> float:
    return cell("six_tasks", table, row, f"{axis}: Pearson r")


def exact_p(axis: str) -> float:
    return cell("six_tasks", "certainty", "LPIPS", f"{axis}: exact p")


APPEARANCE, KINEMATIC = "Appearance distance", "Kinematic distance [m]"


def closed_shares(folder: str) -> list:
    """The share of the gap from joints to flow that a ray map closes, on Franka and Piper."""
    (claim,) = (claim for claim in CLAIMS if claim.name == "rays recover")
    return [one.number for one in claim.comparisons(Reader(StrictGrades(grades_of(folder))))]


def closed_in_own_motion() -> Numbers:
    return percent(*(share.value for share in closed_shares("own_motion")))


@cache
def errors(folder: str) -> pd.DataFrame:
    return body_errors(grades_of(folder), read_distances(RESULTS / folder / "distances"), "lpips")


def at_debug_size(axis: str, name: str) -> Numbers:
    """The attribute `name` of the correlation of LPIPS with distance on an axis."""
    return [getattr(correlate_bodies(errors("bodies_debug"), higher_is_better=False)[axis], name)]


def better_than_frozen() -> Numbers:
    return percent((errors("bodies_debug")["value"] < errors("bodies_debug")["frozen"]).mean())


def of_frozen(folder: str) -> Numbers:
    return [errors(folder)["value"].corr(errors(folder)["frozen"])]


def halves_of_scenes() -> Numbers:
    """r between LPIPS of the bodies over every other scene and over the rest."""
    rows = read_scores(RESULTS / "bodies" / "scores.parquet").rows
    model = reference("scaling_seen", embodiment="robot_render").name
    rows = rows[(rows["variant"] == model) & (rows["metric"] == "lpips") & rows["robot"].isin(DISTANCE_BODIES)]
    scenes = rows.groupby(["task", "seed"]).ngroup()
    by_half = rows.assign(half=scenes % 2).groupby(["robot", "half"])["value"].mean().unstack()
    return [by_half[0].corr(by_half[1])]


def without_the_hardest() -> Numbers:
    rest = errors("bodies").drop(index="body_157")
    return [rest["value"].corr(rest["kinematic"])]


def pairs_of_metric_and_distance() -> Numbers:
    rows = pd.read_csv(RESULTS / "bodies" / "tables" / "bodies.csv")
    found = rows[rows["column"].str.endswith(": r")]["value"].abs()
    return len(found), found.max()


def changes_with_bodies() -> list:
    return [
        gain("bodies", "scaling", f"scaling_seen_bodies_{count}", "scaling_seen", robot)
        for count in (4, 16, 64)
        for robot in HELD_OUT_ROBOTS
    ]


def run_means(variant: str, group: str) -> dict[int, float]:
    found = grades_of("six_tasks").variant_mean(variant, GROUPS[group], "lpips")
    assert found is not None
    return {seed: float(values[0]) for seed, values in found.parts[0].runs.items() if seed is not None}


def spreads_of_runs() -> Numbers:
    """Standard deviations of runs of flow only, nine views and the render, on three groups of robots [%]."""
    names = [reference(embodiment=name).name for name in ("none", "nine_views", "robot_render")]
    runs = [list(run_means(name, group).values()) for name in names for group in ("seen", "franka", "piper")]
    shares = [100 * np.std(each, ddof=1) / np.mean(each) for each in runs]
    return min(shares), max(shares)


def range_of_runs() -> Numbers:
    runs = list(run_means(reference().name, "piper").values())
    return [100 * (max(runs) / min(runs) - 1)]


def forgetting_by_start() -> Numbers:
    """Loss on UR5 after one demonstration of Franka, from the starts of seeds 0 and 3 [%]."""
    before = run_means(reference(embodiment="nine_views").name, "ur5")
    after = run_means(f"few_shot-{FRANKA}-1", "ur5")
    return [100 * (after[seed] / before[seed] - 1) for seed in (0, 3)]


def replay_gains(metric: str, on: str) -> list:
    grades = grades_of("remedies")
    found = []
    for target in HELD_OUT_ROBOTS:
        robots = (target if on == "target" else FORGETTING_ROBOT,)
        for shots in (1, 2, 3):
            names = (f"few_shot-{target}-{shots}-replay", f"few_shot-{target}-{shots}")
            replayed, plain = (grades.variant_mean(name, robots, metric) for name in names)
            assert replayed is not None and plain is not None
            found.append(relative_gain(replayed, plain, grades.metrics[metric]))
    return found


def replay_range() -> Numbers:
    values = [100 * each.value for each in replay_gains("lpips", "ur5")]
    return min(values), max(values)


def least_ends() -> Numbers:
    """The lowest end after Franka and after Piper, rounded down [%]."""
    lows = [100 * each.interval()[0] for each in replay_gains("lpips", "ur5")]
    return np.floor(min(lows[:3])), np.floor(min(lows[3:]))


def outline_after_one_shot() -> Numbers:
    names = (reference(embodiment="nine_views").name, f"few_shot-{FRANKA}-1")
    return [mean("remedies", name, "franka", "mask_iou") for name in names]


def better_by() -> Numbers:
    """How much lower the recipe's LPIPS is than that of the pasted render [%]."""
    for group in ("seen", "piper", "franka"):
        own, pasted = recipe("lpips", group)
        yield 100 * (1 - own / pasted)


def flicker_of_the_codec() -> Numbers:
    (name,) = grades_of("recipe").codec_truths
    values = [mean("recipe", name, group, "flicker") for group in ("seen", "piper", "franka")]
    return min(values), max(values)


def differences_of_runs(folder: str) -> list[float]:
    """Between both runs of the recommended recipe in the columns of a page, in LPIPS [%]."""
    runs = grades_of(folder).variants
    pairs = [[mean(folder, name, group, "lpips") for name in runs] for group in ("seen", "piper", "franka")]
    return [100 * (max(pair) / min(pair) - 1) for pair in pairs]


def of_all_tasks() -> Numbers:
    """LPIPS of the recommended recipe on all tasks."""
    return [recipe("lpips", group, "all_tasks")[0] for group in ("seen", "piper", "franka")]


def six_distances(axis: str) -> pd.DataFrame:
    rows = pd.read_csv(RESULTS / "six_tasks" / "distances" / "distances.csv")
    return rows[rows["axis"] == axis].dropna(subset="published")


def robot_features(feature: str) -> pd.DataFrame:
    rows = pd.read_csv(RESULTS / "six_tasks" / "distances" / "robots.csv")
    return rows[rows["feature"] == feature].set_index("robot")


def from_the_published(in_deviations: bool) -> Numbers:
    rows = six_distances("kinematic")
    apart = (rows["value"] - rows["published"]).abs()
    return [(apart / rows["spread"] if in_deviations else apart).max()]


def own_floors() -> Numbers:
    others = robot_features("floor")["value"].drop("aloha_agilex")
    return robot_features("floor").loc["aloha_agilex", "value"], others.min(), others.max()


def rank_correlation() -> Numbers:
    rows = six_distances("appearance")
    return [float(spearmanr(rows["value"], rows["published"]).statistic)]


def printed_row() -> Numbers:
    found = read_paper().metrics["lpips"].kinematic
    return found.r, found.low, found.high, found.p_value or np.nan


def recomputed_row() -> Numbers:
    found = read_paper().correlation("lpips", "appearance")
    return found.r, found.p_value


def harder_pictures() -> Numbers:
    own, shared = (mean(folder, COPY_FIRST_FRAME, "franka", "lpips") for folder in ("own_motion", "six_tasks"))
    return [100 * (own / shared - 1)]


def paper_shares() -> Numbers:
    """The share that the paper's ray map closes [%]."""
    for robot in HELD_OUT_ROBOTS:
        joints, rays, flow = (
            read_paper().score("actions", row, robot, "lpips") for row in ("joints", "ray_map", "optical_flow")
        )
        assert joints and rays and flow
        yield 100 * (rays - joints) / (flow - joints)


SENTENCES: list[tuple[str, str, Callable[[], Numbers]]] = [
    ("README", "{:.3f} on Franka, pasting {:.3f}", lambda: recipe("robot_lpips", "franka", "all_tasks")),
    ("results", "LPIPS {:.3f} on training robots, {:.3f} on Piper, {:.3f} on Franka (pasting", of_all_tasks),
    ("results", "intervals reach {:.0f} to {:.0f} points either way", lambda: half_widths(gaps())),
    ("results", "on training robots ({:.3f} against {:.3f})", lambda: recipe("lpips", "seen")),
    ("results", "Piper ({:.3f} against {:.3f})", lambda: recipe("lpips", "piper")),
    ("results", "Franka ({:.3f} against {:.3f})", lambda: recipe("lpips", "franka")),
    ("results", "robot LPIPS ({:.3f} against {:.3f} on Piper", lambda: recipe("robot_lpips", "piper")),
    ("results", ", {:.3f} against {:.3f} on Franka)", lambda: recipe("robot_lpips", "franka")),
    ("results", "(paper: {:.0f} and {:.0f} %)", paper_first_shots),
    ("results", "becomes {:.0f} % worse after Franka", forgotten),
    ("results", "repeat at r = {:.2f}", halves_of_scenes),
    ("six_tasks", "The paper reports {:.0f} and {:.0f} %", paper_first_shots),
    ("six_tasks", "(r = {:.2f}) or", lambda: [correlation(APPEARANCE)]),
    ("six_tasks", "kinematic distance (r = {:.2f})", lambda: [correlation(KINEMATIC)]),
    ("six_tasks", "at r = {:.3f}", lambda: [correlation(KINEMATIC, "gap_correlations", "LPIPS ↓")]),
    (
        "six_tasks",
        "(exact p = {:.3f})",
        lambda: [cell("six_tasks", "gap_correlations", "LPIPS ↓", f"{KINEMATIC}: p")],
    ),
    ("six_tasks", "scores {:.0f} on Franka", lambda: [mean("six_tasks", GROUND_TRUTH, "franka", "ndtw")]),
    ("reproduce_the_paper", "on Franka and {:.0f} % on Piper (paper 41", lambda: list(render_gains())[1:]),
    ("reproduce_the_paper", "LPIPS by {:.0f} % on Franka", lambda: list(render_gains())[:1]),
    ("reproduce_the_paper", "Piper (paper {:.0f} and {:.0f} %); a", paper_renders),
    ("reproduce_the_paper", "Piper (paper {:.0f} and {:.0f} %) |", paper_first_shots),
    ("reproduce_the_paper", "demonstration of each task (paper {:.0f} %)", lambda: [printed_forgetting()]),
    ("reproduce_the_paper", "r = {:.2f} (p = {:.2f}), kinematic", lambda: [correlation(APPEARANCE), exact_p(APPEARANCE)]),
    ("reproduce_the_paper", "kinematic r = {:.2f} (p = {:.2f})", lambda: [correlation(KINEMATIC), exact_p(KINEMATIC)]),
    ("reproduce_the_paper", "within {:.3f} m of the paper", lambda: from_the_published(in_deviations=False)),
    ("own_motion", "closes {} % and {} %", lambda: map(interval, closed_shares("six_tasks"))),
    ("own_motion", "the points are {:.0f} and {:.0f} %", closed_in_own_motion),
    ("own_motion", "from {:.0f} to {:.0f} %.", lambda: percent(*closed_shares("own_motion")[0].interval())),
    ("own_motion", "the frozen frame is {:.0f} % worse there", harder_pictures),
    ("own_motion", "close {:.0f} and {:.0f} % of the gap", paper_shares),
    ("bodies", "of kinematic distance is {:.2f}", without_the_hardest),
    ("bodies", "r = {:.2f} with appearance distance over five folds", lambda: [read_paper().metrics["lpips"].appearance.r]),
    ("bodies", "(p = {:.3f})", lambda: [read_paper().metrics["lpips"].appearance.p_value or np.nan]),
    ("bodies", "correlates at {:.2f} with the other half", halves_of_scenes),
    ("bodies", "with the network's at r = {:.2f}", lambda: of_frozen("bodies")),
    ("bodies", "with intervals of {:.0f} to {:.0f} points either way", lambda: half_widths(changes_with_bodies())),
    ("bodies", "was {:.0f} to {:.0f} %, depending on the model", spreads_of_runs),
    ("bodies", "strongest of {} pairs of metric and distance is r = {:.2f}", pairs_of_metric_and_distance),
    ("bodies_debug", "r of LPIPS is {:.2f} with kinematic distance", lambda: at_debug_size("kinematic", "r")),
    ("bodies_debug", "and {:.2f} with appearance distance", lambda: at_debug_size("appearance", "r")),
    ("bodies_debug", "above {:.2f} with kinematic", lambda: at_debug_size("kinematic", "high")),
    ("bodies_debug", "above {:.2f} with appearance", lambda: at_debug_size("appearance", "high")),
    ("bodies_debug", "with the network's at r = {:.2f}", lambda: of_frozen("bodies_debug")),
    ("bodies_debug", "on {:.0f} % of the bodies", better_than_frozen),
    ("remedies", "falls from {:.3f} to {:.3f}", outline_after_one_shot),
    ("remedies", "lower by {:.0f} to {:.0f} %", replay_range),
    ("remedies", "less than {:.0f} %; after Piper they reach down to {:.0f} %", least_ends),
    ("remedies", "UR5 {:.0f} % instead of {:.0f} %", forgetting_by_start),
    (
        "recipe",
        "LPIPS is {:.0f} % lower than with pasting on training robots, {:.0f} % on Piper and {:.0f} % on Franka",
        better_by,
    ),
    ("recipe", "whose own flicker is {:.2f} to {:.2f} levels", flicker_of_the_codec),
    ("recipe", "differ by at most {:.0f} % in LPIPS", lambda: [max(differences_of_runs("recipe"))]),
    ("all_tasks", "LPIPS is {:.3f} on training robots, {:.3f} on Piper and {:.3f} on Franka", of_all_tasks),
    (
        "all_tasks",
        "differ in LPIPS by {:.1f} % on training robots, {:.1f} % on Piper and {:.1f} % on Franka",
        lambda: differences_of_runs("all_tasks"),
    ),
    ("scope", "can differ by {:.0f} % in LPIPS", range_of_runs),
    ("distances", "within {:.1f} standard deviations", lambda: from_the_published(in_deviations=True)),
    ("distances", "{:.3f} m apart for ALOHA and {:.3f} to {:.3f} m", own_floors),
    ("distances", "rank correlation {:.2f}", rank_correlation),
    ("distances", "| as printed (root frame) | {:.3f} | {:.3f} to {:.3f} | {:.3f} |", printed_row),
    ("distances", "| appearance, for comparison | {:.3f} | | {:.3f} |", recomputed_row),
]


@pytest.mark.parametrize(("page", "sentence", "numbers"), SENTENCES, ids=[f"{page}: {text}" for page, text, _ in SENTENCES])
def test_a_sentence_quotes_what_the_scores_give(page: str, sentence: str, numbers: Callable[[], Numbers]) -> None:
    expected = sentence.format(*numbers()).replace("−", "-")
    assert expected in read_page(page), expected


DEBUG_ROWS = {"the network": "", "frozen first frame": COPY_FIRST_FRAME, "pasted render": PASTED_RENDER}
DEBUG_ROWS |= {"truth through the codec": CODEC_TRUTH}


def named(folder: str, name: str) -> str:
    grades = grades_of(folder)
    return grades.codec_truths[0] if name == CODEC_TRUTH else name or grades.variants[0]


@pytest.mark.parametrize("label", DEBUG_ROWS)
def test_bodies_at_debug_size(label: str) -> None:
    name, grades = named("bodies_debug", DEBUG_ROWS[label]), grades_of("bodies_debug")
    means = [grades.variant_mean(name, robots, "lpips") for robots in (*((key,) for key in ROBOT_NAMES), DISTANCE_BODIES)]
    demand(" ".join(row_of("bodies_debug", label)), [found.value for found in means if found])


def test_pasting_wins_on_every_body_at_debug_size() -> None:
    grades, pasted = grades_of("bodies_debug"), errors("bodies_debug")["value"].copy()
    for body in pasted.index:
        found = grades.variant_mean(PASTED_RENDER, (body,), "lpips")
        assert found is not None
        pasted[body] = found.value
    assert (errors("bodies_debug")["value"] > pasted).all()


def test_the_truth_through_the_codec_on_bodies() -> None:
    groups = ("franka", "piper", "bodies")
    values = [mean("bodies", named("bodies", CODEC_TRUTH), group, "lpips") for group in groups]
    demand(" ".join(row_of("bodies", "truth through the codec")), values)


@pytest.mark.parametrize(
    ("folder", "says"),
    [
        ("own_motion", "Of 25 claims 7 can be tested here, and all are unresolved"),
        ("remedies", "Of the paper's claims 5 can be tested here: none holds, 1 fails, 4 are unresolved"),
    ],
)
def test_claims_that_a_part_of_the_study_can_answer(folder: str, says: str) -> None:
    answers = [finding.in_family for finding in ask(StrictGrades(grades_of(folder)), PAPER_CLAIMS)]
    tested = len(answers) - answers.count(UNMEASURED)
    assert f" {tested} can be tested here" in says and says in read_page(folder)
    assert (answers.count(HOLDS), answers.count(FAILS)) == (0, int("1 fails" in says))


def test_replay_costs_nothing_on_the_new_robot() -> None:
    """LPIPS is as good or better in all six cases; robot LPIPS and strict keypoint error are level or within 3 %."""
    assert min(each.value for each in replay_gains("lpips", "target")) >= 0
    others = [each.value for metric in ("robot_lpips", "keypoint_error_strict") for each in replay_gains(metric, "target")]
    assert "level or within 3 %" in read_page("remedies") and round(100 * max(map(abs, others))) == 3


def test_joint_angles_in_own_motion() -> None:
    sentences = (RESULTS / "own_motion" / "tables" / "sentences.txt").read_text()
    lost = sorted(int(change) for change in re.findall(r"by \+(\d+)\u00a0% .{,30} with joint pose", sentences))
    assert "lose {} to {} % on unseen robots".format(*lost) in read_page("own_motion")


def test_the_test_on_gaps_is_one_of_twenty_and_the_spread_has_four_degrees_of_freedom() -> None:
    rows = pd.read_csv(RESULTS / "six_tasks" / "tables" / "gap_correlations.csv")
    assert rows["column"].str.endswith(": p").sum() == 20 and "one of 20" in read_page("six_tasks")
    number = grades_of("six_tasks").variant_mean(reference(action="mask").name, (PIPER,), "lpips")
    assert number is not None and number.parts[0].spread is not None and number.parts[0].spread.own_freedom == 4


def test_distances_of_the_five_robots() -> None:
    """The table has mean, deviation and the paper's value; features agree as the page says."""
    rows = six_distances("kinematic").set_index(["robot", "other"])
    lines = [line.strip("|").split("|") for line in read_page("distances").splitlines() if " ± 0.0" in line]
    shown = [cell.strip() for line in lines for cell in line[1:] if cell.strip()]
    order = [(ROBOT_NAMES[j], ROBOT_NAMES[i]) for i in range(1, 5) for j in range(i)]
    printed = rows.loc[order, ["value", "spread", "published"]].to_numpy()
    assert shown == ["{:.3f} ± {:.3f} ({:.3f})".format(*cells) for cells in printed]
    within = {
        feature: (rows["value"] - rows["published"]).abs() <= 2 * rows["spread"]
        for feature in ("reach", "volume")
        for rows in (robot_features(feature),)
    }
    assert within["reach"].all() and list(within["volume"][~within["volume"]].index) == ["aloha_agilex", "ur5_wsg"]


def test_numbers_of_training_runs() -> None:
    """Flow only and the per-frame render have three runs, nine views four, each adaptation two, every other model one."""
    grades = grades_of("six_tasks")
    names = {word: reference(embodiment=word).name for word in ("none", "robot_render", "nine_views")}
    expected = {names["none"]: 3, names["robot_render"]: 3, names["nine_views"]: 4}
    for variant in grades.variants:
        assert grades.trainings(variant) == expected.get(variant, 2 if variant.startswith("few_shot") else 1), variant
    assert "have three runs, nine views four, each adaptation two, every other model one" in read_page("six_tasks")
