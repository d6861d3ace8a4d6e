"""What goes beyond the paper: the gap by number of bodies, error and gap against distance over bodies, kinds of motion."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.analysis.synthetic_study import TASKS, attributes, paper_axes, write_study
from xew.analysis.beyond import (
    Motions,
    body_errors,
    body_gaps,
    correlate_bodies,
    difficulty_table,
    errors_table,
    find_difficulty,
    find_gaps,
    find_unseen_errors,
    gaps_table,
    halves_table,
    motion_table,
    scaling_frame,
    scaling_table,
)
from xew.analysis.beyond.difficulty import LEAST_BODIES
from xew.analysis.beyond.scaling import ALONE, GROUPS, PASTED, WITH_ROBOTS
from xew.analysis.paper import read_paper
from xew.analysis.report import Args, main
from xew.analysis.scores import read_scores
from xew.analysis.statistics.grades import BODIES, PaperGrades, StudyGrades
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.distances import Distances, printed_distances, read_distances
from xew.config import ConfigError
from xew.protocol import (
    CROSSED_BODIES,
    DISTANCE_BODIES,
    HALVES,
    HELD_OUT_ROBOTS,
    PARTS,
    SEEN_ROBOTS,
    SPLITS,
    TEST_SEED_START,
    UNSEEN_BODIES,
)

SCENES = [(task, TEST_SEED_START + i) for task in ("place_empty_cup", "beat_block_hammer") for i in range(3)]
RUN = ("scaling_seen", "scaling_seen_bodies_4", "scaling_seen_bodies_16", "scaling_bodies_16")
ERRORS = {"scaling_seen": 0.3, "scaling_seen_bodies_4": 0.25, "scaling_seen_bodies_16": 0.2, "scaling_bodies_16": 0.28}
"""Mean LPIPS of each variant that was run, on robots that it has not seen."""
DISTANCES = dict(zip(DISTANCE_BODIES, np.linspace(0.02, 0.3, len(DISTANCE_BODIES)), strict=True))
"""Kinematic distance of each body to all robots of the training."""
LOOKS = dict(zip(DISTANCE_BODIES, np.random.default_rng(5).permutation(np.linspace(0.1, 0.9, 64)), strict=True))
"""Appearance distance of each body, which has nothing to do with the other."""


def write_scores(path: Path, rows: list[dict[str, object]]) -> Path:
    """Write a score table of LPIPS and PSNR, and curves of one frame."""
    table = pd.DataFrame(rows).assign(frames=9, exact_frames=0)
    table.attrs = attributes()
    table.attrs["metrics"] = {name: table.attrs["metrics"][name] for name in ("lpips", "psnr")}
    table.to_parquet(path, index=False)
    curves = table.assign(frame=1).drop(columns=["frames", "exact_frames"])
    curves.to_parquet(path.with_suffix(".curves.parquet"), index=False)
    return path


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A score table in which more bodies help, and error goes with kinematic distance."""
    path, rows, rng = tmp_path_factory.mktemp("bodies") / "scores.parquet", [], np.random.default_rng(6)
    hardness = rng.normal(0, 0.01, len(SCENES))

    def add(variant: str, model: str, robot: str, lpips: float, psnr: float) -> None:
        for (task, seed), harder in zip(SCENES, hardness, strict=True):
            names = {"variant": variant, "model": model, "condition": variant, "task": task, "seed": seed, "robot": robot}
            noise = rng.normal(0, 0.003)
            rows.append(names | {"metric": "lpips", "value": lpips + harder + noise})
            rows.append(names | {"metric": "psnr", "value": psnr - 10 * (harder + noise)})

    for split, error in ERRORS.items():
        for robot in (*HELD_OUT_ROBOTS, *UNSEEN_BODIES[:4]):
            add(f"{split}-optical_flow-robot_render", "reference", robot, error, 20.0)
    for robot in (*HELD_OUT_ROBOTS, *UNSEEN_BODIES[:4]):
        add("", "pasted_render", robot, 0.22, 18.0)
    for body in DISTANCE_BODIES:
        error = 0.2 + 0.5 * DISTANCES[body]
        add("scaling_seen-optical_flow-robot_render", "reference", body, error, 40 * (1 - error))
        add("", "copy_first_frame", body, 0.4 - 0.1 * LOOKS[body], 15.0)
    return write_scores(path, rows)


def distances_of(bodies: Mapping[str, float], looks: Mapping[str, float]) -> Distances:
    """The paper's distances, with those of bodies to the three robots of the training."""
    printed = printed_distances(read_paper())
    rows = [
        {"axis": axis, "robot": body, "other": robot, "value": value, "spread": 0.0, "published": np.nan}
        for axis, values in (("kinematic", bodies), ("appearance", looks))
        for body, value in values.items()
        for robot in SEEN_ROBOTS
    ]
    return Distances(pd.concat([printed.pairs, pd.DataFrame(rows)], ignore_index=True), printed.robots, measured=True)


def grades_of(scores: Path) -> StudyGrades:
    paper = read_paper()
    infos = [info for info in paper.infos if info.name in ("lpips", "psnr")]
    return StudyGrades(pd.read_parquet(scores), infos, paper_axes(paper))


def test_bodies_that_help_are_seen_to_help(scores: Path) -> None:
    builder = Builder(grades_of(scores), PaperGrades(read_paper(), []))
    frame = scaling_frame(builder, "lpips")
    assert set(frame["robots"]) == set(GROUPS)
    for robots in GROUPS:
        own = frame[(frame["robots"] == robots) & (frame["trained_on"] == WITH_ROBOTS)]
        assert own["bodies"].tolist() == [0, 4, 16] and own["value"].is_monotonic_decreasing
        assert (own["low"] < own["value"]).all() and (own["value"] < own["high"]).all()
        assert frame[(frame["robots"] == robots) & (frame["trained_on"] == ALONE)]["bodies"].tolist() == [16]
        (pasted,) = frame[(frame["robots"] == robots) & (frame["trained_on"] == PASTED)].itertuples()
        assert pasted.low < pasted.value < pasted.high and pasted.value == pytest.approx(0.22, abs=0.02)
    table = scaling_table(builder)
    first = {row.labels[0]: row.cells[-1] for row in table.sections[0].rows}
    assert first["three robots and bodies, K = 16"].verdict == "better" and not first["three robots and bodies, K = 0"].verdict
    assert first["three robots and bodies, K = 64"].text == "–", "it was not run"
    assert "Not run: three robots and bodies, K = 64" in table.sections[0].note
    assert all("of 0 episodes" not in section.note for section in table.sections), "bodies are of the protocol, too"
    assert table.sections[-1].rows[0].cells[0].episodes == 4 * len(SCENES), "four of 32 bodies were graded"


def test_a_baseline_of_fewer_episodes_says_so_and_is_in_no_chart(scores: Path, tmp_path: Path) -> None:
    rows, lost_seed = pd.read_parquet(scores), SCENES[-1][1]
    lost = (rows["model"] == "pasted_render") & (rows["robot"] == "piper") & (rows["seed"] == lost_seed)
    builder = Builder(grades_of(write_scores(tmp_path / "scores.parquet", rows[~lost])), PaperGrades(read_paper(), []))
    frame = scaling_frame(builder, "lpips")
    assert set(frame[frame["trained_on"] == PASTED]["robots"]) == set(GROUPS) - {"piper"}
    labels = {section.title: [row.labels[0] for row in section.rows] for section in scaling_table(builder).sections}
    kept = sum(seed != lost_seed for _, seed in SCENES)
    assert f"pasted render ({kept} of {len(SCENES)} episodes)" in labels[GROUPS["piper"]]
    assert "pasted render" in labels[GROUPS["franka_panda"]]


def test_error_that_goes_with_one_distance_is_found_there_alone(scores: Path) -> None:
    errors = body_errors(grades_of(scores), distances_of(DISTANCES, LOOKS), "lpips")
    assert list(errors.index) == sorted(DISTANCE_BODIES)
    assert errors["kinematic"].to_dict() == pytest.approx(DISTANCES)
    found = correlate_bodies(errors, higher_is_better=False)
    kinematic, looks = found["kinematic"], found["appearance"]
    assert kinematic.r > 0.95 and kinematic.low > 0.9 and kinematic.p_value < 0.001 and kinematic.bodies == 64
    more = correlate_bodies(errors.assign(arm_base=errors["appearance"]), higher_is_better=False)
    assert {axis: more[axis].p_value for axis in found} == {axis: found[axis].p_value for axis in found}, "ours cost nothing"
    assert more["arm_base"].p_value <= looks.p_value, "and are not corrected"
    assert abs(looks.r) < 0.35 and looks.low < 0 < looks.high and looks.p_value > 0.05
    assert looks.frozen < -0.95, "the frozen frame is made to be better on odd looks"
    up = correlate_bodies(body_errors(grades_of(scores), distances_of(DISTANCES, LOOKS), "psnr"), higher_is_better=True)
    assert up["kinematic"].r > 0.9, "positive is worse whatever the metric"


def test_what_the_frozen_frame_explains_is_taken_out() -> None:
    """Both errors are the same hardness with noise of their own, and distance goes with that hardness."""
    rng = np.random.default_rng(7)
    distance = rng.normal(size=400)
    hardness = distance + 0.3 * rng.normal(size=400)
    errors = pd.DataFrame({"value": hardness + 0.05 * rng.normal(size=400), "frozen": hardness, "kinematic": distance})
    result = correlate_bodies(errors, higher_is_better=False)["kinematic"]
    assert result.r > 0.9 and result.frozen > 0.9 and abs(result.partial) < 0.15
    expected = np.corrcoef(
        *(y - np.polyval(np.polyfit(hardness, y, 1), hardness) for y in errors[["kinematic", "value"]].to_numpy().T)
    )
    assert result.partial == pytest.approx(expected[0, 1], abs=1e-9), "the correlation of what regressions leave"
    unknown = correlate_bodies(errors.assign(frozen=np.nan), higher_is_better=False)["kinematic"]
    assert np.isnan(unknown.partial) and unknown.r == result.r


def test_a_few_bodies_are_not_correlated(scores: Path) -> None:
    few = {body: DISTANCES[body] for body in DISTANCE_BODIES[: LEAST_BODIES - 1]}
    distances = distances_of(few, {body: LOOKS[body] for body in few})
    assert correlate_bodies(body_errors(grades_of(scores), distances, "lpips"), higher_is_better=False) == {}
    grades = grades_of(scores)
    for known in (distances, printed_distances(read_paper())):  # five robots are no bodies
        assert difficulty_table(find_difficulty(grades, known), grades.metrics) is None


def test_the_report_shows_both(scores: Path, tmp_path: Path) -> None:
    measured = distances_of(DISTANCES, LOOKS)
    measured.pairs.to_csv(tmp_path / "distances.csv", index=False)
    measured.robots.to_csv(tmp_path / "robots.csv", index=False)
    assert read_distances(tmp_path).measured
    main(Args(scores, distances=tmp_path, out=tmp_path / "report"))
    text = (tmp_path / "report" / "report.md").read_text()
    assert "## More bodies in training" in text and "## Distance and difficulty over many bodies" in text
    assert "Adding 16 bodies to the three training robots changes LPIPS by −3" in text
    assert "## Claims" not in text and "No part of the paper was run" in text, "what was not asked is not listed claim by claim"
    assert "On 64 bodies that one model has never seen, its LPIPS correlates with kinematic distance at r = +1.000 (" in text
    for name in ("scaling", "bodies"):
        assert (tmp_path / "report" / "figures" / f"{name}.png").stat().st_size > 1000
    assert BODIES in set(pd.read_csv(tmp_path / "report" / "figures" / "scaling.csv")["robots"])


# --- Bodies that one model saw and another did not.

PRICES = dict(zip(CROSSED_BODIES, np.random.default_rng(8).permutation(np.linspace(0.1, 0.6, 128)), strict=True))
"""Share by which each body is rendered worse by a model that never saw it."""
HARDNESS = dict(zip(CROSSED_BODIES, np.random.default_rng(5).permutation(np.linspace(0.1, 0.9, 128)), strict=True))
"""How hard each body is by its looks, which both models feel."""


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A score table in which bodies are hard by their looks, the gap goes with kinematic distance, and one model is worse."""
    path, rows, rng = tmp_path_factory.mktemp("halves") / "scores.parquet", [], np.random.default_rng(9)
    for task, seed in SCENES:
        scene = rng.normal(1, 0.05)
        for body in CROSSED_BODIES:
            hard = scene * (0.2 + 0.3 * HARDNESS[body])
            scores = {"": ("copy_first_frame", 2 * hard)}
            for variant in PARTS["halves"]:
                unseen = body in SPLITS[variant.split].held_out_robots
                error = hard * (1 + PRICES[body] * unseen) * (1.05 if variant.split == "halves_odd" else 1)
                scores[variant.name] = ("reference", error + rng.normal(0, 0.001))
            for variant, (model, error) in scores.items():
                names = {"variant": variant, "model": model, "condition": variant, "task": task, "seed": seed, "robot": body}
                rows += [names | {"metric": "lpips", "value": error}, names | {"metric": "psnr", "value": 30 - 20 * error}]
    return write_scores(path, rows)


def distances_between_halves() -> Distances:
    """Kinematic distances that go with the price, and distances in looks that go with how hard bodies are."""
    printed = printed_distances(read_paper())
    even, odd = HALVES["halves_even"].train_robots, HALVES["halves_odd"].train_robots
    rows = [
        {"axis": axis, "robot": a, "other": b, "value": values[a] + values[b], "spread": 0.0, "published": np.nan}
        for axis, values in (("kinematic", PRICES), ("appearance", HARDNESS))
        for a in even
        for b in odd
    ]
    return Distances(pd.concat([printed.pairs, pd.DataFrame(rows)], ignore_index=True), printed.robots, measured=True)


def test_halves_share_out_the_bodies_and_are_graded_on_all() -> None:
    even, odd = PARTS["halves"]
    assert set(even.seen_robots) == set(odd.held_out_robots) and set(even.held_out_robots) == set(odd.seen_robots)
    assert set(even.graded_robots) == set(odd.graded_robots) == set(CROSSED_BODIES)
    assert len(even.seen_robots) == len(odd.seen_robots) == 64


def test_the_gap_of_a_body_is_what_never_having_seen_it_costs(halves: Path) -> None:
    grades = grades_of(halves)
    gaps = body_gaps(grades, distances_between_halves(), "lpips")
    assert set(gaps.index) == set(CROSSED_BODIES)
    levels = [np.mean([PRICES[body] for body in half.train_robots]) for half in HALVES.values()]
    expected = {
        body: 100 * (PRICES[body] - own + np.mean(levels))
        for half, own in zip(HALVES.values(), levels, strict=True)
        for body in half.train_robots
    }
    assert gaps["value"].to_dict() == pytest.approx(expected, abs=2.5), "that one model is worse on all bodies is taken out"
    found = correlate_bodies(gaps, higher_is_better=False)
    assert found["kinematic"].r > 0.9 and found["kinematic"].p_value < 0.001 and found["kinematic"].bodies == 128
    assert abs(found["appearance"].r) < 0.5 and found["appearance"].frozen > 0.9, "how hard a body is has canceled"
    assert (body_gaps(grades, distances_between_halves(), "psnr")["value"] > 0).all(), "positive is worse whatever the metric"


def test_the_error_of_an_unseen_body_goes_with_how_hard_it_is(halves: Path) -> None:
    grades = grades_of(halves)
    found = find_gaps(grades, distances_between_halves())
    errors, psnr = (find_unseen_errors(found)[name] for name in ("lpips", "psnr"))
    assert errors.correlations["appearance"].r > 0.6, "by the fixture, bodies are hard by their looks"
    assert errors.correlations["kinematic"].r < found["lpips"].correlations["kinematic"].r - 0.1
    assert psnr.correlations["appearance"].r > 0.6 and psnr.correlations["appearance"].frozen > 0.9, "positive is worse"
    assert errors.values["value"].mean() == pytest.approx(
        np.mean([grades.variant_mean(half.name, half.held_out_robots, "lpips").value for half in PARTS["halves"]])
    )


def test_scores_of_halves_are_those_of_the_model_that_saw_them_and_of_the_other(halves: Path) -> None:
    grades = grades_of(halves)
    table = halves_table(Builder(grades, PaperGrades(read_paper(), [])))
    for section, seen, unseen in zip(table.sections, PARTS["halves"], PARTS["halves"][::-1], strict=True):
        bodies = SPLITS[seen.split].train_robots
        assert [row.labels[0] for row in section.rows] == ["trained on them", "never saw them", "frozen first frame"]
        for row, model in zip(section.rows, (seen.name, unseen.name, "copy_first_frame"), strict=True):
            assert row.cells[-1].value == grades.variant_mean(model, bodies, "lpips").value
            assert row.cells[-1].episodes == 64 * len(SCENES)


def test_one_half_alone_gives_no_gap(halves: Path) -> None:
    rows = pd.read_parquet(halves)
    alone = rows[rows["variant"] != PARTS["halves"][1].name]
    infos = [info for info in read_paper().infos if info.name in ("lpips", "psnr")]
    grades = StudyGrades(alone, infos, paper_axes(read_paper()))
    found = find_gaps(grades, distances_between_halves())
    assert not len(found["lpips"].values) and gaps_table(found, grades.metrics) is None
    assert errors_table(find_unseen_errors(found), grades.metrics) is None


def test_the_report_shows_the_gap_of_bodies(halves: Path, tmp_path: Path) -> None:
    measured = distances_between_halves()
    measured.pairs.to_csv(tmp_path / "distances.csv", index=False)
    measured.robots.to_csv(tmp_path / "robots.csv", index=False)
    main(Args(halves, distances=tmp_path, out=tmp_path / "report"))
    text = (tmp_path / "report" / "report.md").read_text()
    assert "## Distance and the gap of unseen bodies" in text
    assert "The gap of 128 bodies against their distance" in text
    assert "Over 128 bodies, LPIPS is 35\u00a0% higher on average for a model that never saw the body than for one" in text
    assert "This gap correlates with kinematic distance at r = +0.9" in text and "p < 0.001) and with appearance" in text
    assert "LPIPS itself, of the model that never saw the body, correlates with kinematic distance at r = +0." in text
    assert "| never saw them | " in text
    assert ": the gap goes with kinematics, not looks." in text
    assert (tmp_path / "report" / "figures" / "halves.png").stat().st_size > 1000


# --- Shared and own motion.


@pytest.fixture(scope="module")
def both_motions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Score tables of shared motion, and of own motion in which joint poses fail and one scene is missing."""
    root, names = tmp_path_factory.mktemp("motions"), [variant.name for variant in PARTS["actions"]]
    shared = write_study(root / "shared.parquet", names, TASKS[:3])
    rows = pd.read_parquet(shared)
    worse = (rows["variant"] == "fixed-joints-none") & (rows["metric"] == "lpips")
    own = rows.assign(value=rows["value"].where(~worse, 2 * rows["value"]))
    own = own[(own["task"] != TASKS[0]) | (own["seed"] != TEST_SEED_START)]
    own.attrs = {**rows.attrs, "motion": "own"}
    own.to_parquet(root / "own.parquet", index=False)
    curves = pd.read_parquet(shared.with_suffix(".curves.parquet"))
    curves.to_parquet(root / "own.curves.parquet", index=False)
    return shared, root / "own.parquet"


def test_motions_are_compared_on_the_scenes_that_both_have(both_motions: tuple[Path, Path]) -> None:
    shared, own = map(read_scores, both_motions)
    table = motion_table(Motions(own, shared))
    assert [column.group for column in table.columns[:2]] == ["LPIPS ↓"] * 2
    assert [column.title for column in table.columns[:2]] == ["shared", "own"]
    for section in table.sections:
        joints, *others, frozen, pasted = section.rows
        assert joints.cells[1].value == pytest.approx(2 * joints.cells[0].value) and joints.cells[1].verdict == "worse"
        assert all(row.cells[1].verdict == "unresolved" and row.cells[1].value == row.cells[0].value for row in others)
        assert frozen.cells[1].value == frozen.cells[0].value and frozen.cells[1].verdict == "unresolved"
        assert (frozen.labels, pasted.labels) == (("frozen first frame",), ("pasted render",))
    scenes = len(shared.rows[["task", "seed"]].drop_duplicates())
    assert [section.rows[0].cells[0].episodes for section in table.sections] == [3 * (scenes - 1), scenes - 1, scenes - 1]


def test_two_tables_of_one_motion_are_not_compared(both_motions: tuple[Path, Path]) -> None:
    shared, own = map(read_scores, both_motions)
    with pytest.raises(ConfigError, match="of shared and of shared motion are compared; expected one table of each kind"):
        Motions(shared, shared)
    own.attributes["protocol"] = 99
    with pytest.raises(ConfigError, match="graded by protocols 1 and 99"):
        Motions(shared, own)


def test_one_model_on_many_bodies_is_no_comparison_of_trainings(scores: Path) -> None:
    rows = pd.read_parquet(scores)
    infos = [info for info in read_paper().infos if info.name in ("lpips", "psnr")]
    alone = rows[rows["variant"].isin(["", "scaling_seen-optical_flow-robot_render"])]
    parts = [
        Builder(StudyGrades(chosen, infos, paper_axes(read_paper())), None).has_results("scaling") for chosen in (rows, alone)
    ]
    assert parts == [True, False]


def test_the_report_sets_both_motions_side_by_side(both_motions: tuple[Path, Path], tmp_path: Path) -> None:
    main(Args(both_motions[0], other_motion=both_motions[1], out=tmp_path))
    text = (tmp_path / "report.md").read_text()
    assert "## Shared and own motion" in text and "one tool path" in text
    for robot in ("Franka (Panda)", "Piper"):
        assert f"- From shared to own motion, LPIPS on {robot} changes by +100\u00a0% (+" in text
        assert "with joint pose, +0\u00a0% (−" in text
    assert "Shared and own motion" in (tmp_path / "index.html").read_text()
    drawn = pd.read_csv(tmp_path / "figures" / "motion.csv").set_index(["robots", "action", "motion"])
    joints, others = drawn["value"].xs("joints", level="action"), drawn["value"].drop("joints", level="action")
    assert joints.xs("own", level="motion").to_numpy() == pytest.approx(2 * joints.xs("shared", level="motion").to_numpy())
    assert others.xs("own", level="motion").equals(others.xs("shared", level="motion")) and len(others) == 2 * 3 * 3
    assert ((drawn["low"] < drawn["value"]) & (drawn["value"] < drawn["high"])).all()
    assert (tmp_path / "figures" / "motion.png").stat().st_size > 1000
