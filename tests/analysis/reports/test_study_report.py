"""The report of a study: the paper's tables with our numbers, in every format, and what is missing said where it is missing."""

import re
from dataclasses import replace
from itertools import permutations, product
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from markupsafe import escape

from tests.analysis.reports.browser import find_faults, needs_chromium
from tests.analysis.synthetic_study import TASKS, paper_axes, write_study
from tests.analysis.test_report import Page, refers_outside
from tests.synthetic import write_synthetic_data
from xew.analysis.paper import read_paper
from xew.analysis.report import Args, main
from xew.analysis.reports import charts, page
from xew.analysis.reports.study_strips import find_videos, study_strips
from xew.analysis.reports.study_text import trainings_note
from xew.analysis.scores import MetricInfo, read_scores
from xew.analysis.statistics.grades import PaperGrades, StudyGrades
from xew.analysis.tables import formats
from xew.analysis.tables.builder import Builder
from xew.analysis.tables.distances import (
    correlation_table,
    distance_tables,
    gap_correlation_tables,
    own_correlation_tables,
    printed_distances,
    read_distances,
)
from xew.analysis.tables.labels import PAPER_METRICS
from xew.analysis.tables.layouts import build_tables, ladder_table
from xew.analysis.tables.table import Table
from xew.episode import episode_folder, read_video
from xew.protocol import HELD_OUT_ROBOTS, ROBOT_NAMES, SEEN_ROBOTS, SHOTS, TEST_SEED_START, VARIANTS
from xew.rollout import write_rollout

SHOWN = ("fixed-joints-none", "fixed-optical_flow-none", "fixed-optical_flow-nine_views")
MISSING = "fixed-mask-none"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole study but for one variant, with data and rollouts of some, and its report."""
    root = tmp_path_factory.mktemp("study_report")
    write_study(root / "scores.parquet", [name for name in VARIANTS if name != MISSING])
    seeds = (TEST_SEED_START, TEST_SEED_START + 1)
    write_synthetic_data(root / "data", tasks=TASKS[:1], seeds=seeds, robots=HELD_OUT_ROBOTS, frames=9)
    for i, name in enumerate(SHOWN):
        for seed in seeds:
            for robot in HELD_OUT_ROBOTS:
                video = read_video(episode_folder(root / "data", TASKS[0], seed, robot) / "rgb.mkv")
                late = video[np.maximum(np.arange(9) - i, 0)]
                write_rollout(root / "rollouts" / name, TASKS[0], seed, robot, late, {"model": "reference"})
    main(Args(root / "scores.parquet", root / "data", (root / "rollouts",), root / "report"))
    return root


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two variants, one scene, and their report."""
    root = tmp_path_factory.mktemp("small_study")
    write_study(root / "scores.parquet", ["fixed-optical_flow-none", "fixed-joints-none"], TASKS[:1], seeds=1)
    main(Args(root / "scores.parquet", out=root / "report"))
    return root


@pytest.fixture(scope="module")
def rows(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(folder / "scores.parquet")


@pytest.fixture(scope="module")
def tables(folder: Path) -> dict[str, Table]:
    return {table.name: table for table in build_tables(builder(folder / "scores.parquet"))}


def builder_of(rows: pd.DataFrame) -> Builder:
    paper = read_paper()
    return Builder(StudyGrades(rows, paper.infos, paper_axes(paper)), PaperGrades(paper, paper.infos))


def builder(path: Path) -> Builder:
    scores, paper = read_scores(path), read_paper()
    return Builder(StudyGrades(scores.rows, scores.metrics, paper_axes(paper)), PaperGrades(paper, scores.metrics))


def mean(rows: pd.DataFrame, variant: str, robots: tuple[str, ...], metric: str) -> float:
    chosen = rows[(rows["variant"] == variant) & rows["robot"].isin(robots) & (rows["metric"] == metric)]
    return float(chosen["value"].mean())


def test_the_page_is_well_formed_and_needs_no_network(folder: Path) -> None:
    text = (folder / "report" / "index.html").read_text()
    found = Page(text)
    assert not found.open and not refers_outside(text)
    assert len(found.images) == 2 and found.charts >= 4 * 3 + 2 + 2 + 4
    assert {target for target in re.findall(r'href="#([^"]*)"', text) if not target.startswith(("m", "p", "C", "D"))} <= set(
        re.findall(r'id="([^"]*)"', text)
    )


@needs_chromium
def test_a_browser_shows_it_on_a_phone_and_a_desk_in_light_and_dark(folder: Path) -> None:
    text = (folder / "report" / "index.html").read_text()
    assert find_faults(folder / "report" / "index.html", images=2, charts=text.count("<svg")) == []


def test_the_finding_comes_first(folder: Path) -> None:
    text = (folder / "report" / "index.html").read_text()
    finding = re.search(r'<ul class="finding">(.*?)</ul>', text, re.DOTALL)
    assert finding and finding.start() < text.index('class="claim') < text.index("<table")
    assert "claims of the paper" in finding[1] and "Franka (Panda), LPIPS is" in finding[1] and "r = +0.8" in finding[1]


def test_tables_are_those_of_the_paper_with_our_means_and_its_values_beside(
    tables: dict[str, Table], rows: pd.DataFrame
) -> None:
    section = {b.title: b for b in tables["actions_full"].sections}
    for title, robots in (("Seen robots", SEEN_ROBOTS), ("Held-out Franka", ("franka_panda",)), ("Held-out Piper", ("piper",))):
        found = next(b for name, b in section.items() if name.startswith(title))
        flow = next(row for row in found.rows if row.labels == ("Optical flow",))
        for metric, cell in zip(PAPER_METRICS, flow.cells, strict=True):
            assert cell.value == pytest.approx(mean(rows, "fixed-optical_flow-none", robots, metric))
            assert cell.low < cell.value < cell.high and cell.text != "–"
    piper = next(b for name, b in section.items() if "Piper" in name)
    assert [cell.published for cell in piper.rows[0].cells][:3] == ["18.554", "0.837", "0.228"]
    # Five rows of conditions, four representations, six adaptations, four systems: as in the paper.
    models = {name: [row for b in t.sections for row in b.rows if not row.baseline] for name, t in tables.items()}
    counts = {name: len(found) for name, found in models.items()}
    assert counts["actions"] == 4 * 2 and counts["actions_full"] == 4 * 3 and counts["ladder"] == 5 * 2
    assert counts["ladder_full"] == 5 * 3 and counts["few_shot"] == 3 * 2
    assert counts["few_shot_full"] == 1 + 4 * 2 + 12 and counts["forgetting_full"] == 7 + 12  # twelve with remedies, ours
    assert counts["baselines"] == 4 + 1 and counts["loeo_full"] == 5
    columns = {"few_shot": 5}  # the sixth is ours
    printed = [c.published for name, found in models.items() for row in found[:4] for c in row.cells[: columns.get(name)]]
    assert all(printed)


def test_every_table_of_scores_has_its_noise_floor(tables: dict[str, Table], rows: pd.DataFrame) -> None:
    floors = {
        name: [row for b in t.sections for row in b.rows if row.baseline and "frozen" not in row.labels[0]]
        for name, t in tables.items()
    }
    counts = {name: len(found) for name, found in floors.items()}
    assert counts["actions"] == 2 and counts["actions_full"] == counts["ladder_full"] == counts["gap"] == 3
    assert counts["ladder"] == counts["few_shot_full"] == 2 and counts["loeo_full"] == 5
    assert counts["forgetting_full"] == counts["baselines"] == 1
    assert tables["few_shot"].columns[-1].title == "true video, graded"
    truth = rows[(rows["model"] == "ground_truth") & (rows["metric"] == "mask_iou") & (rows["robot"] == "piper")]
    assert floors["actions"][1].cells[2].value == pytest.approx(truth["value"].mean())
    assert tables["few_shot"].sections[1].rows[0].cells[-1].value == pytest.approx(truth["value"].mean())
    without = builder_of(rows[rows["model"] != "ground_truth"])
    assert not any("true video" in str(table) for table in build_tables(without))


def test_no_column_or_block_averages_the_held_out_robots(tables: dict[str, Table], rows: pd.DataFrame) -> None:
    names = [name for name, variant in VARIANTS.items() if set(HELD_OUT_ROBOTS) <= set(variant.graded_robots)]
    both = {mean(rows, name, HELD_OUT_ROBOTS, metric) for name in names for metric in PAPER_METRICS}
    values = {cell.value for t in tables.values() for b in t.sections for row in b.rows for cell in row.cells}
    assert not any(np.isclose(a, b, rtol=1e-9) for a in both for b in values if not np.isnan(a + b))


def test_best_and_marks_follow_the_paired_differences(tables: dict[str, Table]) -> None:
    ladder = tables["ladder"].sections[0]
    render, flow = ladder.rows[4], ladder.rows[0]
    assert [cell.best for cell in render.cells] == [True] * 3 and [cell.verdict for cell in render.cells] == ["better"] * 3
    assert all(not cell.verdict for cell in flow.cells)
    assert "unresolved" in {cell.verdict for row in ladder.rows[1:4] for cell in row.cells}
    forgetting = tables["forgetting_full"].sections[0].rows
    lpips = PAPER_METRICS.index("lpips")
    assert {row.cells[lpips].verdict for row in forgetting[1:7]} == {"worse"}


def with_robot_lpips(path: Path, variant: str, factor: float) -> tuple[pd.DataFrame, tuple[MetricInfo, ...]]:
    """A study's scores, and as a metric of the suite strict those of region LPIPS again, of one variant times a factor."""
    scores = read_scores(path)
    info = next(info for info in scores.metrics if info.name == "region_lpips")
    own = scores.rows[scores.rows["metric"] == "region_lpips"].assign(metric="robot_lpips")
    own["value"] *= np.where(own["variant"] == variant, factor, 1.0)
    info = replace(info, name="robot_lpips", title="Robot LPIPS", counterpart="region_lpips")
    return pd.concat([scores.rows, own]), (*scores.metrics, info)


def test_cells_say_where_the_suites_part_in_every_format(folder: Path) -> None:
    """On the robot itself the render harms, in the paper's region it helps: that is one cell, and nothing else parts."""
    rows, metrics = with_robot_lpips(folder / "scores.parquet", "fixed-optical_flow-robot_render", 4.0)
    made = Builder(StudyGrades(rows, metrics, paper_axes(read_paper())), PaperGrades(read_paper(), metrics))
    ladder = ladder_table(made)
    robot, region = (i for i, column in enumerate(ladder.columns) if column.title.startswith(("Robot LPIPS", "Region LPIPS")))
    for section in ladder.sections:
        strict, paper = section.rows[4].cells[robot], section.rows[4].cells[region]
        assert (strict.verdict, strict.parting) == ("worse", "") and (paper.verdict, paper.parting) == ("", "better")
        others = [cell for row in section.rows for cell in row.cells if cell is not paper]
        assert not any(cell.parting for cell in others) and sum(bool(cell.verdict) for cell in others) == 4 * 3
    assert formats.markdown(ladder).count("(▲)") == 2
    assert formats.latex(ladder).count(r"$^{(\blacktriangle)}$") == 2
    assert page.table(ladder).count("paper-better") == 2 and "td.paper-better .mean::after" in page.page("", [], [], "")
    frame = formats.table_frame(ladder).query("parting != ''")
    assert set(frame["parting"]) == {"better"} and set(frame["verdict"]) == {""} and len(frame) == 2


def test_what_is_missing_is_said_in_the_table_in_every_format(folder: Path, tables: dict[str, Table]) -> None:
    note = tables["actions_full"].sections[1].note
    assert note.startswith("Incomplete") and "Not run: Mask" in note and "12 of 500 episodes: Joint pose" in note
    mask = tables["actions_full"].sections[1].rows[2]
    assert [cell.text for cell in mask.cells] == ["–"] * 10 and mask.cells[0].published == "18.376"
    report = folder / "report"
    for name in ("index.html", "report.md", "tables/actions_full.tex", "tables/actions_full.csv"):
        assert "Not run: Mask" in (report / name).read_text(), name
    assert "Not run in this study" not in (report / "index.html").read_text()


def test_scores_that_other_models_have_are_named_cell_by_cell(tmp_path: Path) -> None:
    path = write_study(tmp_path / "scores.parquet", ["fixed-optical_flow-none", "fixed-joints-none"], TASKS[:1], seeds=2)
    rows = pd.read_parquet(path)
    lost = (rows["variant"] == "fixed-joints-none") & (rows["metric"] == "pck") & (rows["seed"] == TEST_SEED_START)
    kept = rows[~(lost & (rows["robot"] == "piper"))]
    kept.attrs = rows.attrs
    kept.to_parquet(path, index=False)
    main(Args(path, out=tmp_path / "report"))
    missing = pd.read_csv(tmp_path / "report" / "missing.csv")
    assert missing[["variant", "task", "seed", "robot", "metric"]].to_numpy().tolist() == [
        ["fixed-joints-none", TASKS[0], TEST_SEED_START, "piper", "pck"]
    ]
    for name in ("index.html", "report.md"):
        assert f"{TASKS[0]} {TEST_SEED_START} piper pck" in (tmp_path / "report" / name).read_text()


def test_a_study_of_its_own_size_is_not_called_incomplete(folder: Path) -> None:
    made = builder(folder / "scores.parquet")
    planned = {name: dict.fromkeys(variant.graded_robots, 12) for name, variant in VARIANTS.items()}
    made = Builder(made.ours, made.paper, planned)
    assert made.note("ladder", [("none", "piper", "flow only")]).startswith("As planned, but smaller than the paper's protocol")
    assert made.note("actions", [("mask", "piper", "Mask")]) == "Incomplete: not run in every row."


def test_parts_that_were_not_run_have_no_table_and_are_named(small: Path) -> None:
    text = (small / "report" / "index.html").read_text()
    assert "Not run in this study: ladder, loeo, few shot, forgetting, baselines." in text
    assert {path.stem for path in (small / "report" / "tables").glob("*.tex")} == {
        "gap", "actions", "actions_full", "counts", "distances", "features", "matrices", "findings",
    }  # fmt: skip
    # One scene: numbers, but no interval and no verdict.
    findings = pd.read_csv(small / "report" / "findings.csv")
    here = findings[findings["of"] == "here"]
    assert set(here["verdict"]) == {"unresolved", "not measured"}


def test_rollouts_without_a_comparison_are_no_error(folder: Path, tmp_path: Path) -> None:
    write_study(tmp_path / "scores.parquet", ["fixed-irasim", "fixed-ctrl_world"], TASKS[:1], seeds=1)
    main(Args(tmp_path / "scores.parquet", folder / "data", (folder / "rollouts",), tmp_path / "report"))
    text = (tmp_path / "report" / "index.html").read_text()
    assert not Page(text).images and "The scores answer none of the paper&#39;s 25 claims" in text
    assert "Not run in this study: fixed, actions, ladder, loeo, few shot, forgetting." in text


def test_markdown_latex_and_csv_hold_the_same_cells(tables: dict[str, Table]) -> None:
    for table in tables.values():
        width = len(table.stubs) + len(table.columns)
        lines = formats.markdown(table).splitlines()
        assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {width + 1}
        tex = formats.latex(table)
        assert_well_formed(tex, width)
        frame = formats.table_frame(table)
        assert len(frame) == sum(len(row.cells) for b in table.sections for row in b.rows)
        for text in frame["text"]:
            assert text in formats.markdown(table) and formats._escape(text) in tex and escape(text) in page.table(table)


def assert_well_formed(tex: str, width: int) -> None:
    """Braces and environments close, and every row has as many cells as there are columns."""
    bare = re.sub(r"\\[\\{}%&$#_]", "", re.sub(r"^%.*$", "", tex, flags=re.MULTILINE).replace(r"\\", "\n"))
    assert bare.count("{") == bare.count("}") and bare.count("$") % 2 == 0
    assert re.findall(r"\\begin\{(.*?)\}", tex) == list(reversed(re.findall(r"\\end\{(.*?)\}", tex)))
    for line in tex.splitlines():
        if line.endswith(r"\\"):
            spans = sum(int(count) - 1 for count in re.findall(r"\\multicolumn\{(\d+)\}", line))
            assert len(re.findall(r"(?<!\\)&", line)) + 1 + spans == width, line
    assert tex.isascii(), re.findall(r"[^\x00-\x7f]", tex)[:3]


def test_every_tex_file_of_the_report_is_ascii_and_well_formed(folder: Path) -> None:
    for path in (folder / "report" / "tables").glob("*.tex"):
        tex = path.read_text()
        assert tex.isascii(), (path.name, re.findall(r"[^\x00-\x7f]", tex)[:5])
        assert tex.count(r"\begin{") == tex.count(r"\end{") == (2 if path.stem == "findings" else 3)


def test_figures_lie_beside_their_numbers(folder: Path) -> None:
    figures = folder / "report" / "figures"
    pictures = {path.stem for path in figures.glob("*.png")}
    assert pictures == {path.stem for path in figures.glob("*.csv")} | {"strip_actions", "strip_ladder"}
    assert {path.stem for path in figures.glob("*.csv")} == {path.stem for path in figures.glob("*.pdf")}
    for path in figures.glob("*.png"):
        assert cv2.imread(str(path)).std() > 0
    shown = re.findall(r"\]\((figures/[^)]+)\)", (folder / "report" / "report.md").read_text())
    assert {Path(name).stem for name in shown} == pictures
    distance = pd.read_csv(figures / "distance.csv")
    assert list(distance["appearance"]) == [0.175, 0.063, 0.058, 0.107, 0.052]


def test_one_training_is_said_to_be_one_wherever_there_is_an_interval(folder: Path, rows: pd.DataFrame) -> None:
    report = folder / "report"
    for name in ("index.html", "report.md", "tables/actions_full.tex", "tables/gap.tex", "tables/findings.tex"):
        assert "training run" in (report / name).read_text(), name
    findings = pd.read_csv(report / "findings.csv")
    assert set(findings.loc[(findings["of"] == "here") & findings["value"].notna(), "trainings"]) == {1}
    assert {"verdict_in_family", "p_holds", "p_fails"} <= set(findings)
    paper = read_paper()
    flow = "fixed-optical_flow-none"
    more = [rows.assign(training=0), rows[rows["variant"] == flow].assign(training=1)]
    grades = StudyGrades(pd.concat(more), paper.infos, paper_axes(paper))
    assert trainings_note(grades).startswith(f"Intervals cover scenes and the training runs of {flow} (2).")
    assert trainings_note(grades).endswith("Differences are taken within the training seeds that both models have.")
    own = pd.concat(more).query("variant == @flow or variant == ''")
    assert trainings_note(StudyGrades(own, paper.infos, paper_axes(paper))) == (
        "Each model was trained 2 times; intervals cover training runs and scenes. "
        "Differences are taken within the training seeds that both models have."
    )


def test_gains_are_relative_to_the_row_that_is_named(folder: Path, rows: pd.DataFrame) -> None:
    gains = pd.read_csv(folder / "report" / "figures" / "gains_actions.csv")
    flow = gains[(gains["row"] == "Optical flow") & (gains["robot"] == "piper") & (gains["metric"] == "lpips")].iloc[0]
    after, before = (mean(rows, f"fixed-{name}-none", ("piper",), "lpips") for name in ("optical_flow", "joints"))
    assert flow["gain"] == pytest.approx(100 * (before - after) / before)
    assert flow["low"] < flow["gain"] < flow["high"] and flow["paper"] == pytest.approx(100 * (0.228 - 0.097) / 0.228)
    assert gains[gains["row"] == "Mask"]["gain"].isna().all()


def test_a_strip_has_robots_down_and_conditions_across(folder: Path) -> None:
    found = [str(image["alt"]) for image in Page((folder / "report" / "index.html").read_text()).images]
    assert "Franka, Piper by observed, Joint pose, Optical flow" in found
    written = (folder / "report" / "report.md").read_text()
    assert "From the left: observed, Joint pose, Optical flow; from the top: Franka, Piper." in written
    strip = cv2.imread(str(folder / "report" / "figures" / "strip_actions.png"))
    frames = strip[:240, 648:968], strip[244:, :320]
    truth = [read_video(episode_folder(folder / "data", TASKS[0], seed, "piper") / "rgb.mkv")[8] for seed in (10**6, 10**6 + 1)]
    assert any((cv2.cvtColor(frames[1], cv2.COLOR_BGR2RGB) == frame).all() for frame in truth)
    assert frames[0].std() > 0


def test_measured_distances_take_the_place_of_the_printed(folder: Path, tmp_path: Path) -> None:
    features = ("dof", "links", "reach", "volume", "kinematic", "appearance", "perceptual")
    singles = [(robot, feature, 1.0 + i, 0.1, np.nan) for i, robot in enumerate(ROBOT_NAMES) for feature in features]
    pairs = [("kinematic", "piper", "arx_x5", 0.5, 0.01, 0.034)]
    pd.DataFrame(singles, columns=["robot", "feature", "value", "spread", "published"]).to_csv(tmp_path / "robots.csv")
    pd.DataFrame(pairs, columns=["axis", "robot", "other", "value", "spread", "published"]).to_csv(tmp_path / "distances.csv")
    distances = read_distances(tmp_path)
    made = {table.name: table for table in distance_tables(distances)}
    assert "the paper's figures" not in made["distances"].caption and made["distances"].columns[-1].title.endswith("(ours)")
    assert [cell.text for row in made["distances"].sections[1].rows for cell in row.cells] == ["4.000"] * 3 + ["5.000"] * 3
    matrix = formats.table_frame(made["matrices"])
    assert matrix[matrix["value"] == 0.5]["paper"].tolist() == [0.034, 0.034]
    grades = builder(folder / "scores.parquet").ours
    correlated, [own] = correlation_table(grades, distances, read_paper()), own_correlation_tables(grades, distances)
    assert (len(correlated.columns), len(own.columns)) == (2 * 2 + 1, 3)
    assert all(cell.text != "–" for table in (correlated, own) for row in table.sections[0].rows for cell in row.cells)
    scores = [mean.value for r in ROBOT_NAMES if (mean := grades.mean("loeo", f"loeo_{r}", r, "lpips"))]
    lpips = next(row for row in own.sections[0].rows if row.labels == ("LPIPS",))
    assert lpips.cells[0].value == pytest.approx(np.corrcoef(distances.of("perceptual"), scores)[0, 1])
    assert own_correlation_tables(grades, printed_distances(read_paper())) == []


def test_the_gap_leaves_out_how_hard_a_robot_is(folder: Path, rows: pd.DataFrame) -> None:
    paper = read_paper()
    distances = printed_distances(paper)
    kinematic = distances.of("kinematic")
    # Whoever saw a robot has its own difficulty as a score, and whoever did not has more of it in proportion to its distance.
    made = rows.copy()
    for robot, difficulty, distance in zip(ROBOT_NAMES, (0.1, 0.4, 0.2, 0.5, 0.3), kinematic, strict=True):
        here = (made["robot"] == robot) & (made["metric"] == "lpips")
        made.loc[here, "value"] = difficulty
        made.loc[here & made["variant"].str.startswith(f"loeo_{robot}"), "value"] = difficulty * (1 + 2 * distance)
    [table] = gap_correlation_tables(StudyGrades(made, paper.infos, paper_axes(paper)), distances)
    lpips = next(row for row in table.sections[0].rows if row.labels[0].startswith("LPIPS"))
    assert [cell.value for cell in lpips.cells[:5]] == pytest.approx(2 * kinematic)
    assert lpips.cells[0].text == f"{200 * kinematic[0]:+.0f} %"
    r, p = lpips.cells[-3].value, lpips.cells[-1].value
    assert r == pytest.approx(1) and p == pytest.approx(np.mean(_all_r(kinematic) > 1 - 1e-9))
    assert gap_correlation_tables(PaperGrades(paper, paper.infos), distances) == []  # it prints no fold on robots that it saw


def test_words_beside_points_keep_apart_and_in_order() -> None:
    heights = np.array([45.0, 32.0, 25.7, 27.2, 24.8])
    spread = charts._spread(heights, 2.0)
    assert (np.argsort(spread) == np.argsort(heights)).all()
    assert np.diff(np.sort(spread)).min() > 1.99 and spread[:2].tolist() == [45.0, 32.0]


def _all_r(values: np.ndarray) -> np.ndarray:
    """|r| of five numbers with all their orders [120]."""
    return np.abs([np.corrcoef(values, order)[0, 1] for order in permutations(values)])


def test_a_strip_of_the_folds_has_each_robot_unseen_and_seen(folder: Path, tmp_path: Path) -> None:
    data, folds = tmp_path / "data", [f"loeo_{robot}-optical_flow-nine_views" for robot in ROBOT_NAMES]
    write_synthetic_data(data, tasks=TASKS[:1], seeds=(TEST_SEED_START,), robots=ROBOT_NAMES, frames=9)
    for level, fold in enumerate(folds):
        for robot in ROBOT_NAMES:
            video = np.full((9, 240, 320, 3), 40 * level, np.uint8)
            write_rollout(tmp_path / "rollouts" / fold, TASKS[0], TEST_SEED_START, robot, video, {"model": "reference"})
    strip = study_strips(read_scores(folder / "scores.parquet"), data, find_videos((tmp_path / "rollouts",)))["loeo"]
    assert strip.columns == ["observed", "model that never saw the robot", "model that did"] and len(strip.rows) == 5
    frames = cv2.imdecode(np.frombuffer(strip.image, np.uint8), cv2.IMREAD_COLOR)[::244, 324::324]
    assert frames[:, 0].mean(axis=-1).tolist() == [0, 40, 80, 120, 160]
    assert frames[:, 1].mean(axis=-1).tolist() == [40, 80, 120, 160, 0]


@needs_chromium
def test_all_distances_fit_a_desk(tmp_path: Path) -> None:
    write_study(tmp_path / "scores.parquet", [name for name in VARIANTS if "loeo" in name], TASKS[:1], seeds=2)
    features = ("dof", "links", "reach", "volume", "kinematic", "appearance", "arm_base", "arm_alone", "perceptual")
    singles = [(robot, feature, 0.1 + i * i, 0.1, 0.1) for i, robot in enumerate(ROBOT_NAMES) for feature in features]
    pd.DataFrame(singles, columns=["robot", "feature", "value", "spread", "published"]).to_csv(tmp_path / "robots.csv")
    pairs = [("kinematic", "piper", "arx_x5", 0.5, 0.01, 0.034)]
    pd.DataFrame(pairs, columns=["axis", "robot", "other", "value", "spread", "published"]).to_csv(tmp_path / "distances.csv")
    main(Args(tmp_path / "scores.parquet", out=tmp_path / "report", distances=tmp_path))
    text = (tmp_path / "report" / "index.html").read_text()
    assert "Correlation of our own distances" in text
    assert find_faults(tmp_path / "report" / "index.html", images=0, charts=text.count("<svg")) == []


def test_wrong_inputs_name_what_to_do(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scores = folder / "scores.parquet"
    (tmp_path / "robots.csv").write_text("robot,feature,value,spread,published\npiper,dof,6,0,6\n")
    (tmp_path / "distances.csv").write_text("axis,robot,other,value,spread,published\n")
    (tmp_path / "void").mkdir()
    for args, words in (
        (Args(scores, distances=tmp_path / "void"), "xew.analysis.distance"),
        (Args(scores, distances=tmp_path), "aloha_agilex"),
        (Args(scores, folder / "data", (folder / "data",)), "fixed-optical_flow-none"),
        (Args(scores, tmp_path / "void"), "xew.sim_warp.generate"),
    ):
        with pytest.raises(SystemExit):
            main(replace(args, out=tmp_path / "report"))
        assert words in capsys.readouterr().err
    assert not (tmp_path / "report").exists()


def test_the_same_scores_make_the_same_bytes(small: Path, tmp_path: Path) -> None:
    main(Args(small / "scores.parquet", out=tmp_path))
    for path in sorted((small / "report").rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / path.relative_to(small / "report")).read_bytes(), path.name


def test_remedies_stand_beside_plain_adaptation_on_the_target_and_on_ur5(tmp_path: Path) -> None:
    remedies = ("", "-replay", "-lora")
    adapted = [f"few_shot-{robot}-{shots}{remedy}" for robot in HELD_OUT_ROBOTS for shots in SHOTS for remedy in remedies]
    path = write_study(tmp_path / "scores.parquet", ["fixed-optical_flow-nine_views", *adapted], TASKS[:2])
    main(Args(path, out=tmp_path / "report"))
    drawn = pd.read_csv(tmp_path / "report" / "figures" / "remedies.csv").set_index(["target", "on", "remedy", "shots"])[
        "value"
    ]
    for robot, remedy, shots in product(HELD_OUT_ROBOTS, ("replay", "lora"), SHOTS):
        variant = f"few_shot-{robot}-{shots}-{remedy}"
        for on, place in (("target", robot), ("ur5_wsg", "ur5_wsg")):
            expected = mean(read_scores(path).rows, variant, (place,), "lpips")
            assert drawn[robot, on, remedy, shots] == pytest.approx(expected)
    said = (tmp_path / "report" / "report.md").read_text()
    assert len(re.findall("Adaptation with (?:replay|LoRA) to one demonstration of each task changes LPIPS by", said)) == 2 * 2
    for table, rows in (("few_shot_full", 3 * 2), ("forgetting_full", 3 * 4)):
        labels = pd.read_csv(tmp_path / "report" / "tables" / f"{table}.csv")["row"].unique()
        assert sum(label.endswith("(ours)") for label in labels) == rows, labels
