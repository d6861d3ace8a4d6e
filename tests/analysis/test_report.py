"""The page holds what a reader needs, opens offline, and says what is missing."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

from tests.analysis.conftest import FRAMES, SEEDS, TASKS, Study
from tests.analysis.reports.browser import find_faults, needs_chromium
from xew.analysis.report import (
    Args,
    Picture,
    _count_expected,
    _family,
    _strip_section,
    _write_explorer,
    main,
    ranking_tables,
    run_table,
)
from xew.analysis.reports import charts
from xew.analysis.reports.run_tables import Interval, RobotTable, Row
from xew.analysis.reports.study_charts import ranking_chart, run_chart
from xew.analysis.scores import MetricInfo, read_scores
from xew.analysis.tables import formats
from xew.config import ConfigError
from xew.episode import Record, write_video
from xew.metrics import evaluate
from xew.protocol import COPY_FIRST_FRAME, join_fault
from xew.rollout import find_rollouts, read_rollout_video

VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Tags, and whether they close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.charts = 0
        self.headings: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            self.images.append(dict(attributes))
        self.charts += tag == "svg"
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("h1", "h2", "h3"):
            self.headings.append(data)


def refers_outside(text: str) -> list[str]:
    """What a page would have to fetch: nothing but itself (#...) and data are in it."""
    return re.findall(r"(?:src|href)\s*=\s*[\"'](?!data:|#)[^\"']*|url\((?!#)[^)]*|<script[^>]*|@import[^;]*", text)


@pytest.fixture(scope="module")
def report(study: Study, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report")
    main(Args(study.scores, study.data, (study.rollouts,), out))
    return out


def test_the_page_is_well_formed_and_needs_no_network(report: Path) -> None:
    text = (report / "index.html").read_text()
    page = Page(text)
    assert not page.open and not refers_outside(text)
    for image in page.images:
        kind, _, encoded = str(image["src"]).partition(",")
        assert kind == "data:image/png;base64"
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None and picture.std() > 0
        assert image["alt"]
    # The first screen; three strips for each of two held-out robots; the curves of three metrics and two robots.
    assert len(page.images) == 1 + 3 * 2 and page.charts == 2 + 3 * 2


@needs_chromium
def test_a_browser_shows_it_on_a_phone_and_a_desk_in_light_and_dark(report: Path) -> None:
    assert find_faults(report / "index.html", images=1 + 3 * 2, charts=2 + 3 * 2) == []


def test_curves_go_from_frame_to_frame_though_the_first_episode_begins_late() -> None:
    frames = [(1_000_000, 3), (1_000_000, 4), (1_000_001, 1), (1_000_001, 2), (1_000_001, 3), (1_000_001, 4)]
    curves = pd.DataFrame(frames, columns=["seed", "frame"]).assign(
        model="m", condition="", task="lift_pot", robot="piper", metric="lpips", value=0.5
    )
    axes = Figure().subplots()
    metrics = [MetricInfo(name, "visual", "", False, 0, None, "") for name in ("psnr", "lpips")]
    (panel,) = run_chart(curves, metrics, ["piper"]).panels  # PSNR has no curve, and no empty panel
    panel.draw(axes)
    assert list(axes.lines[0].get_xdata()) == [1, 2, 3, 4]


def test_each_held_out_robot_has_its_own_table_and_the_seen_are_pooled(report: Path) -> None:
    headings = Page((report / "index.html").read_text()).headings
    assert headings[0].startswith("Can the model")
    assert [h for h in headings if h in ("Franka (Panda)", "Piper")] == ["Franka (Panda)", "Piper"]
    assert "Pooled: ALOHA-AgileX" in headings
    assert not any("Franka" in h and "Piper" in h for h in headings)


def test_the_finding_comes_first_and_names_both_robots(report: Path) -> None:
    text = (report / "index.html").read_text()
    finding = re.search(r'<ul class="finding">(.*?)</ul>', text, re.DOTALL)
    assert finding and finding.start() < text.index("<table")
    for robot in ("Franka (Panda)", "Piper"):
        assert f"{robot} (6 episodes): late · by one &lt;frame&gt; is better than the frozen first frame on" in finding[1]
    assert "of the frozen first frame&#39;s (" in finding[1] and "on seen robots)" in finding[1]


def test_the_numbers_are_those_of_the_scores(report: Path, study: Study) -> None:
    summary = pd.read_csv(report / "summary.csv")
    rows = pd.read_parquet(study.scores)
    text = (report / "index.html").read_text()
    for robot in ("franka_panda", "piper"):
        mean = rows[(rows["robot"] == robot) & (rows["metric"] == "lpips") & (rows["model"] == "late")]["value"].mean()
        line = summary[(summary["robots"] == robot) & (summary["metric"] == "lpips") & (summary["model"] == "late")]
        assert line["mean"].item() == pytest.approx(mean, rel=1e-9)
        assert line["low"].item() <= mean <= line["high"].item()
        assert line["episodes"].item() == line["expected"].item() == 6
        assert f">{mean:.3f}<" in text
        table = pd.read_csv(report / "tables" / f"{robot}.csv")
        cell = table[table["row"].str.startswith("late") & table["column"].str.contains("LPIPS")]
        assert cell["value"].item() == pytest.approx(mean, rel=1e-9) and cell["episodes"].item() == 6
    assert "6 of 6 episodes" in text and "Incomplete" not in text


def test_a_cell_of_the_paper_has_a_mark_only_where_its_verdict_is_another() -> None:
    """The suite strict decides, and has the mark in any case."""
    names = {"pck": "", "pck_strict": "pck", "ndtw": "", "ndtw_strict": "ndtw", "psnr": ""}
    metrics = [MetricInfo(name, "kinematics", "", True, 0, 1, "", name, counterpart=paper) for name, paper in names.items()]
    verdicts = {"pck": "better", "pck_strict": "worse", "ndtw": "better", "ndtw_strict": "better", "psnr": "worse"}
    row = Row("mine", "", {name: Interval(0.5, 0.4, 0.6, 6) for name in names}, verdicts)
    shown = run_table(RobotTable("Piper", ("piper",), (row,), None), metrics)
    marks = dict(zip(names, ((cell.verdict, cell.parting) for cell in shown.sections[0].rows[0].cells), strict=True))
    assert marks == {
        "pck": ("", "better"), "pck_strict": ("worse", ""), "ndtw": ("", ""), "ndtw_strict": ("better", ""),
        "psnr": ("worse", ""),
    }  # fmt: skip
    assert "In parentheses: the verdict by the paper's definition" in shown.caption
    agreeing = replace(row, verdicts=dict.fromkeys(names, "better"))
    assert "In parentheses" not in run_table(RobotTable("Piper", ("piper",), (agreeing,), None), metrics).caption


def test_markdown_and_figures_stand_beside_the_page(report: Path) -> None:
    text = (report / "report.md").read_text()
    assert "### Franka (Panda)" in text and "| late · by one <frame> |" in text
    figures = re.findall(r"\]\((figures/[^)]+)\)", text)
    assert len(figures) == 8
    for figure in figures:
        assert cv2.imread(str(report / figure)) is not None


def test_a_strip_shows_the_first_and_the_last_frame(report: Path) -> None:
    page = Page((report / "index.html").read_text())
    assert f"frame {FRAMES - 1}" in str(page.images[1]["alt"]) and "frame 0" in str(page.images[1]["alt"])


def test_the_explorer_plays_the_scenes_of_the_strips(study: Study, report: Path, tmp_path: Path) -> None:
    args = Args(study.scores, study.data, (study.rollouts,), tmp_path, explorer=True)
    _write_explorer(read_scores(study.scores), args)
    text = (tmp_path / "explorer" / "index.html").read_text()
    assert Page(text).headings
    shown = {"_".join(path.stem.split("_")[1:]) for path in (tmp_path / "explorer" / "scenes").glob("*.js")}
    strips = [path.stem for path in (report / "figures").glob("late*")]
    scenes = [f"{task}_{seed}" for task in TASKS for seed in SEEDS]
    assert shown and shown == {scene for scene in scenes if any(f"_{scene}_" in name for name in strips)}
    strip = Picture("a.png", b"", Markup("<p></p>"))
    assert 'href="explorer/index.html"' in _strip_section([strip], args)
    assert "explorer" not in _strip_section([strip], replace(args, explorer=False))
    with pytest.raises(ConfigError, match="name them by --data and --rollouts"):
        _write_explorer(read_scores(study.scores), replace(args, rollouts=()))


def test_a_report_shows_rollouts_of_another_size_that_begin_with_frame_1(study: Study, tmp_path: Path) -> None:
    for rollout in find_rollouts(study.rollouts):
        if (rollout.robot, rollout.task) == ("piper", "open_laptop"):
            small = np.stack([frame[::2, ::2] for frame in read_rollout_video(rollout)[1:]])
            folder = tmp_path / "rollouts" / rollout.task / str(rollout.seed) / rollout.robot
            folder.mkdir(parents=True)
            write_video(folder / "rgb.mkv", small)
    args = ((tmp_path / "rollouts",), study.data, tmp_path / "scores.parquet", ("psnr", "lpips"))
    evaluate.main(evaluate.Args(*args, allow=("resize",), frame_zero="absent"))
    main(Args(tmp_path / "scores.parquet", study.data, (tmp_path / "rollouts",), tmp_path / "report"))
    strips = list((tmp_path / "report" / "figures").glob("rollouts__open_laptop_*.png"))
    assert len(strips) == 3
    text = (tmp_path / "report" / "index.html").read_text()
    assert "its videos leave out" in text and "<dt>changed to fit</dt><dd>resize</dd>" in text
    observed, predicted, _ = np.split(cv2.imread(str(strips[0]))[:, :320].astype(int), [244, 488])
    assert np.array_equal(observed[:240], predicted[:240])  # frame 0 was given


def edit(study: Study, out: Path, change: object) -> Path:
    """A copy of the scores with some change."""
    rows, curves = pd.read_parquet(study.scores), pd.read_parquet(study.scores.with_suffix(".curves.parquet"))
    changed = change(rows)
    changed.attrs = rows.attrs
    changed.to_parquet(out / "scores.parquet", index=False)
    curves.to_parquet(out / "scores.curves.parquet", index=False)
    return out / "scores.parquet"


def test_kinds_of_motion_are_never_reported_together(study: Study, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for motion, data, word in (
        ("mixed", None, "motion: mixed not in"),
        ("own", study.data, "has episodes of shared motion"),
    ):
        path = edit(study, tmp_path, lambda rows: rows)
        rows = pd.read_parquet(path)
        rows.attrs["motion"] = motion
        rows.to_parquet(path, index=False)
        with pytest.raises(SystemExit):
            main(Args(path, data, out=tmp_path / "report"))
        assert word in capsys.readouterr().err and not (tmp_path / "report").exists()
    assert read_scores(study.scores).motion == "shared"


def test_an_incomplete_table_says_so(study: Study, tmp_path: Path) -> None:
    piper = lambda rows: rows[~((rows["robot"] == "piper") & (rows["seed"] == 1_000_001))]  # noqa: E731
    main(Args(edit(study, tmp_path, piper), study.data, (study.rollouts,), tmp_path / "report"))
    text = (tmp_path / "report" / "index.html").read_text()
    assert text.count("Incomplete: 4 of 6 episodes are scored.") == 1
    assert "Piper (4 episodes): late · by one &lt;frame&gt; cannot be compared" in text and "Fewer than 6 scenes" in text
    for name in ("report.md", "tables/piper.tex"):
        assert "Incomplete: 4 of 6 episodes are scored." in (tmp_path / "report" / name).read_text()
    assert "> Fewer than 6 scenes" in (tmp_path / "report" / "report.md").read_text()


def test_without_data_there_are_numbers_and_a_word_on_the_missing_pictures(study: Study, tmp_path: Path) -> None:
    main(Args(study.scores, out=tmp_path))
    text = (tmp_path / "index.html").read_text()
    assert "No pictures" in text and "Franka (Panda)" in text and not Page(text).images and Page(text).charts


SPOILERS = {
    "more than once": lambda rows: pd.concat([rows, rows.iloc[:1]]),
    "NaN": lambda rows: rows.assign(value=rows["value"].where(rows.index > 0)),
    "unknown": lambda rows: rows.assign(robot=rows["robot"].replace("piper", "pipper")),
    "holds no row": lambda rows: rows.iloc[:0],
    "no score table": lambda rows: rows.drop(columns="metric"),
}


@pytest.mark.parametrize("word", SPOILERS)
def test_scores_that_cannot_be_trusted_are_named(
    word: str, study: Study, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(Args(edit(study, tmp_path, SPOILERS[word]), out=tmp_path / "report"))
    message = capsys.readouterr().err
    assert exit_.value.code == 2 and word in message and "xew.metrics.evaluate" in message
    assert not (tmp_path / "report").exists()


def test_a_robot_of_ones_own_has_its_own_table(study: Study, tmp_path: Path) -> None:
    def rename(rows: pd.DataFrame) -> pd.DataFrame:
        rows.attrs["robots"] = ["my_arm"]
        return rows.assign(robot=rows["robot"].replace("piper", "my_arm"))

    main(Args(edit(study, tmp_path, rename), out=tmp_path / "report"))
    headings = Page((tmp_path / "report" / "index.html").read_text()).headings
    assert [h for h in headings if h in ("Franka (Panda)", "Piper", "my_arm")] == ["Franka (Panda)", "my_arm"]
    assert (tmp_path / "report" / "tables" / "my_arm.tex").exists()


def test_missing_inputs_name_the_command_that_makes_them(study: Study, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "void").mkdir()
    for args, command in (
        (Args(tmp_path / "none.parquet"), "xew.metrics.evaluate"),
        (Args(study.scores, tmp_path / "void"), "xew.sim_warp.generate"),
        (Args(study.scores, study.data, (tmp_path / "void",)), "xew.model.rollout"),
        (Args(study.scores, held_out=("panda",)), "franka_panda"),
        (Args(study.scores, distances=tmp_path), "--other-motion and --shifted are for the report of a study"),
        (Args(study.scores, other_motion=study.scores), "--other-motion and --shifted are for the report of a study"),
        (Args(study.scores, shifted=(study.scores,)), "--other-motion and --shifted are for the report of a study"),
        (Args(distances=tmp_path, paper=True), "leave out scores"),
    ):
        with pytest.raises(SystemExit):
            main(args)
        assert command in capsys.readouterr().err


def test_reading_gives_the_metrics_with_unit_and_direction(study: Study) -> None:
    scores = read_scores(study.scores)
    assert [(m.name, m.unit, m.higher_is_better) for m in scores.metrics] == [
        ("psnr", "dB", True),
        ("lpips", "", False),
        ("mask_iou", "", True),
    ]
    assert scores.models == [("late", "by one <frame>")]


def test_a_gain_over_zero_is_named_and_leaves_the_axis_as_it_is() -> None:
    axes = Figure().subplots()
    values = np.array([[40.0, 30.0, 50.0], [np.inf, np.nan, np.nan], [np.nan] * 3])
    charts.bars(axes, ["render", "over nothing", "missing"], [("C0", values, np.full(3, np.nan))], "better by [%]")
    assert [text.get_text().strip() for text in axes.texts] == ["over zero", "not run"]
    assert 50 < axes.get_xlim()[1] < 60


def test_a_gain_over_almost_nothing_is_written_on_a_bar_that_ends() -> None:
    axes = Figure().subplots()
    values = np.array([[40.0, 30.0, 5000.0], [80600.0, 20000.0, 73000.0]])
    charts.bars(axes, ["render", "over almost nothing"], [("C0", values, np.full(2, np.nan))], "better by [%]")
    assert [text.get_text() for text in axes.texts] == ["80,600"]
    assert charts.LONGEST_BAR < axes.get_xlim()[1] < 1.1 * charts.LONGEST_BAR


@pytest.mark.parametrize(("graded", "expected"), [((0, 1), 2), ((10_000_000,), 1), ((0, 20_000_000), 3), ((1_000_000,), 0)])
def test_faulty_episodes_are_expected_where_any_was_graded(graded: tuple[int, ...], expected: int) -> None:
    records = [Record("t", seed, "piper", True) for seed in (0, 1)]
    records += [Record("t", 10_000_000, "piper", False, fault="push:40")]
    records += [Record("t", 20_000_000, "piper", False, failure="physics", fault="push:60")]
    assert _count_expected(records, ["piper"], {_family(seed) for seed in graded}) == expected


def test_policies_are_ranked_in_a_table_of_their_own() -> None:
    rows = []
    for fault, seed in ((fault, seed) for fault in (0, 1) for seed in range(3)):
        key = {"model": "mine", "condition": "flow", "task": "t", "seed": join_fault(fault, seed), "robot": "piper"}
        rows += [key | {"metric": "outcome_accuracy", "value": 1.0}]
        rows += [key | {"metric": "hallucinated_success", "value": 0.0}] if fault else []
    table = RobotTable("Piper", ("piper",), (), None)
    [ranking] = ranking_tables(pd.DataFrame(rows), [table])
    assert [section.title for section in ranking.sections] == ["Piper"] and "2 graded policies" in ranking.caption
    assert "| mine · flow | 1.000 | 1.000 | 0.000 |" in formats.markdown(ranking)
    assert ranking_tables(pd.DataFrame(rows[:3]), [table]) == [], "the expert alone"


def test_policies_are_points_of_true_and_judged_rates() -> None:
    rows = []
    tasks = {"place_mouse_pad": ("place an object", 1.0), "lift_pot": ("both hands at one object", 0.0)}
    tasks |= {"mine": ("other tasks", 0.5)}
    for task, (fault, seed, robot) in product(tasks, product((0, 3), range(2), ("piper", "arx_x5"))):
        key = {"model": "mine", "condition": "flow", "task": task, "seed": join_fault(fault, seed), "robot": robot}
        shown = not fault or seed < 2 * tasks[task][1]
        rows += [key | {"metric": "outcome_accuracy", "value": float(shown != bool(fault))}]
        rows += [key | {"metric": "hallucinated_success", "value": float(shown)}] if fault else []
    rows += [row | {"model": COPY_FIRST_FRAME, "value": 0.0} for row in rows]
    chart = ranking_chart(pd.DataFrame(rows), {"Pooled: ARX": ("arx_x5",), "Piper": ("piper",)})
    assert [panel.title for panel in chart.panels] == ["Pooled: ARX", "Piper"]
    assert [series.label for series in chart.legend] == [group for group, _ in tasks.values()]
    judged = chart.data[chart.data["policy"] == 1].set_index(["robots", "tasks"])[["true", "judged", "episodes"]]
    assert {key: tuple(row) for key, row in zip(judged.index, judged.to_numpy(), strict=True)} == {
        (robots, group): (0, rate, 2) for robots in ("Pooled: ARX", "Piper") for group, rate in tasks.values()
    }
    axes = Figure().subplots()
    chart.panels[0].draw(axes)
    assert [len(points.get_offsets()) for points in axes.collections] == [2, 2, 2]
