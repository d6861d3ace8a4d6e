"""Score tables that cannot be trusted are refused with every cell named; a study's tables become one."""

from itertools import product
from pathlib import Path

import pandas as pd
import pytest

from tests.analysis.synthetic_study import write_study
from xew.analysis.scores import (
    COPY,
    TRUTH,
    describe_scores,
    find_missing_scores,
    merge_scores,
    read_scores,
    write_scores,
)
from xew.config import ConfigError
from xew.protocol import VARIANTS

ADAPTED = ("fixed-optical_flow-nine_views", "few_shot-piper-1", "few_shot-franka_panda-1")
COMMON = {"title": "", "estimated": False, "suites": [], "counterpart": "", "reported": True, "reference": "x", "low": 0.0}
METRICS = {
    "lpips": {"dimension": "visual", "unit": "", "higher_is_better": False, "high": None, **COMMON},
    "pck": {"dimension": "kinematics", "unit": "", "higher_is_better": True, "high": 1.0, **COMMON},
}
ATTRIBUTES = {"protocol": 2, "metrics": METRICS, "versions": {"xew": "1.0"}, "estimators": {"masks": "default"}}


def test_several_trainings_of_a_variant_are_told_by_their_seed(tmp_path: Path) -> None:
    a, b = written(tmp_path / "a.parquet", graded()), written(tmp_path / "b.parquet", graded(baselines=False))
    merged = merge_scores([("flow", a), ("flow", b)], trainings=(3, 7))
    own = merged.rows[merged.rows["variant"] == "flow"]
    assert own.groupby("training").size().to_dict() == {3: 8, 7: 8}
    assert set(merged.rows.loc[merged.rows["variant"] == "", "training"]) == {0}
    write_scores(merged, tmp_path / "merged.parquet")
    assert read_scores(tmp_path / "merged.parquet").rows.equals(merged.rows) and merged.curves["training"].nunique() == 3
    lacking = merged.rows.drop(own[(own["training"] == 7) & (own["robot"] == "piper") & (own["metric"] == "pck")].index[:1])
    assert find_missing_scores(lacking)[["variant", "training", "robot", "metric"]].to_numpy().tolist() == [
        ["flow", 7, "piper", "pck"]
    ]
    assert describe_scores(find_missing_scores(lacking)) == "flow 7 flow open_laptop 1000000 piper pck"
    with pytest.raises(ConfigError, match="a cell occurs more than once"):
        merge_scores([("flow", a), ("flow", b)], trainings=(3, 3))
    assert "training" not in merge_scores([("flow", a)]).rows, "a table of one training each stays as it was"


def graded(model: str = "flow", robots: tuple[str, ...] = ("ur5_wsg", "piper"), baselines: bool = True) -> pd.DataFrame:
    """Two tasks with one seed each; every value differs."""
    models = [model, *((COPY, TRUTH) if baselines else ())]
    cells = product(models, ("open_laptop", "lift_pot"), robots, METRICS)
    rows = [
        {"model": m, "condition": "", "task": task, "seed": 1_000_000, "robot": robot, "metric": metric}
        | {"value": 0.01 * i, "frames": 9, "exact_frames": 0, "content": f"{m} {task} {robot}"}
        for i, (m, task, robot, metric) in enumerate(cells)
    ]
    return pd.DataFrame(rows)


def written(path: Path, rows: pd.DataFrame, **attributes: object) -> Path:
    rows, curves = (
        rows.copy(),
        rows.assign(frame=1)[["model", "condition", "task", "seed", "robot", "metric", "frame", "value"]],
    )
    for frame, file in ((rows, path), (curves, path.with_suffix(".curves.parquet"))):
        frame.attrs = ATTRIBUTES | attributes
        frame.to_parquet(file, index=False)
    return path


def alter(rows: pd.DataFrame, place: int, **values: object) -> pd.DataFrame:
    rows = rows.copy()
    for column, value in values.items():
        rows.loc[place, column] = value
    return rows


WRONG = {
    "the value is NaN, 1 rows: flow open_laptop 1000000 ur5_wsg pck": lambda r: alter(r, 1, value=float("nan")),
    "outside of the metric's range, 2 rows: flow open_laptop 1000000 ur5_wsg lpips; flow open_laptop 1000000 ur5_wsg pck": (
        lambda r: alter(alter(r, 0, value=-0.1), 1, value=1.1)
    ),
    "the robot is unknown, 1 rows: flow open_laptop 1000000 my_robot lpips": lambda r: alter(r, 0, robot="my_robot"),
    "more than once, 2 rows: flow open_laptop 1000000 ur5_wsg lpips": lambda r: pd.concat([r, r.iloc[:1]], ignore_index=True),
    "the metric is not described, 1 rows: flow open_laptop 1000000 ur5_wsg fid": lambda r: alter(r, 0, metric="fid"),
    "over different numbers of frames, 6 rows: flow open_laptop 1000000 ur5_wsg lpips": lambda r: alter(r, 0, frames=8),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_cell_is_named(message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read_scores(written(tmp_path / "s.parquet", WRONG[message](graded())))
    assert message in str(error.value) and "--overwrite" in str(error.value)


def test_curves_may_be_missing(tmp_path: Path) -> None:
    path = written(tmp_path / "s.parquet", graded())
    path.with_suffix(".curves.parquet").unlink()
    scores = read_scores(path)
    assert scores.curves.empty and len(scores.rows) == len(graded())
    merged = merge_scores([("flow", path)])
    write_scores(merged, tmp_path / "merged.parquet")
    assert read_scores(tmp_path / "merged.parquet").curves.empty


def test_nobody_is_told_to_delete_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder; name a score table") as error:
        read_scores(tmp_path)
    assert "delete it" not in str(error.value)


def test_all_that_is_wrong_is_named_at_once(tmp_path: Path) -> None:
    rows = alter(alter(graded(), 0, robot="my_robot"), 5, value=float("nan"))
    with pytest.raises(ConfigError) as error:
        read_scores(written(tmp_path / "s.parquet", rows))
    assert "unknown, 1 rows" in str(error.value) and "NaN, 1 rows: flow lift_pot" in str(error.value)


def test_robots_of_ones_own_are_told(tmp_path: Path) -> None:
    rows = graded(robots=("piper", "my_robot"))
    path = written(tmp_path / "s.parquet", rows)
    with pytest.raises(ConfigError, match="the robot is unknown, 12 rows"):
        read_scores(path)
    assert set(read_scores(path, own_robots=["my_robot"]).rows["robot"]) == {"piper", "my_robot"}
    assert len(read_scores(written(path, rows, robots=["my_robot"])).rows) == len(rows)


def test_robots_with_an_import_path_need_no_word(tmp_path: Path) -> None:
    rows = graded(robots=("piper", "my_lab.robots:SPEC"))
    assert set(read_scores(written(tmp_path / "s.parquet", rows)).rows["robot"]) == {"piper", "my_lab.robots:SPEC"}
    for name in ("my_lab/robots:SPEC", "../robots:SPEC", ":SPEC", "my_lab:", "1a:B"):
        with pytest.raises(ConfigError, match=r"the robot is (unknown|')"):
            read_scores(written(tmp_path / "s.parquet", graded(robots=("piper", name))))


def test_a_table_that_does_not_describe_a_metric_is_none_of_ours(tmp_path: Path) -> None:
    without_unit = {name: value for name, value in METRICS["lpips"].items() if name != "unit"}
    with pytest.raises(ConfigError, match="does not say the unit of lpips"):
        read_scores(written(tmp_path / "s.parquet", graded(), metrics={**METRICS, "lpips": without_unit}))


def test_missing_cells_are_found_against_the_others() -> None:
    rows = graded()
    assert find_missing_scores(rows).empty
    gone = rows.drop(index=[0, len(rows) - 1])
    found = find_missing_scores(gone)
    assert list(found.columns) == ["model", "condition", "task", "seed", "robot", "metric"]
    assert describe_scores(found) == "flow open_laptop 1000000 ur5_wsg lpips; ground_truth lift_pot 1000000 piper pck"
    # A robot that a model was never asked for is not missing; an episode that nobody graded cannot be known.
    assert find_missing_scores(rows[~((rows["model"] == "flow") & (rows["robot"] == "piper"))]).empty
    assert find_missing_scores(rows[rows["task"] == "lift_pot"]).empty


def test_long_lists_are_cut_and_counted() -> None:
    assert describe_scores(graded(), most=1) == "flow open_laptop 1000000 ur5_wsg lpips; and 23 more"


def test_merging_names_variants_and_keeps_baselines_once(tmp_path: Path) -> None:
    first, second = graded(), graded(robots=("ur5_wsg", "arx_x5"))
    tables = [("a", written(tmp_path / "a.parquet", first)), ("b", written(tmp_path / "b.parquet", second))]
    merged = merge_scores(tables)
    counts = merged.rows.groupby(["variant", "model"]).size().to_dict()
    # Baselines are on three robots, each in two tasks by two metrics.
    assert counts == {("a", "flow"): 8, ("b", "flow"): 8, ("", COPY): 12, ("", TRUTH): 12}
    assert len(merged.curves) == len(merged.rows) and merged.of_study and merged.rows.columns[0] == "variant"
    for variant, rows in (("a", first), ("b", second)):
        own = merged.rows[merged.rows["variant"] == variant].drop(columns="variant").reset_index(drop=True)
        pd.testing.assert_frame_equal(own, rows[rows["model"] == "flow"].reset_index(drop=True))
    write_scores(merged, tmp_path / "study" / "scores.parquet")
    again = read_scores(tmp_path / "study" / "scores.parquet")
    pd.testing.assert_frame_equal(again.rows, merged.rows)
    pd.testing.assert_frame_equal(again.curves, merged.curves)
    assert again.attributes == merged.attributes and again.protocol == 2
    assert sorted(path.name for path in (tmp_path / "study").iterdir()) == ["scores.curves.parquet", "scores.parquet"]


def test_a_study_that_was_graded_in_parts_is_the_whole_again(tmp_path: Path) -> None:
    """Also where each part has the baselines of its own robots."""
    whole = read_scores(write_study(tmp_path / "whole.parquet", ADAPTED, tasks=("lift_pot",), seeds=2))
    parts = []
    for name in ADAPTED:
        robots = VARIANTS[name].graded_robots
        path = tmp_path / f"{name}.parquet"
        for table, file in ((whole.rows, path), (whole.curves, path.with_suffix(".curves.parquet"))):
            of_part = (table["variant"] == name) | ((table["variant"] == "") & table["robot"].isin(robots))
            part = table[of_part].drop(columns="variant").reset_index(drop=True)
            part.attrs = dict(whole.attributes)
            part.to_parquet(file, index=False)
        parts.append((name, path))
    merged = merge_scores(parts)
    for ours, theirs in ((merged.rows, whole.rows), (merged.curves, whole.curves)):
        order = [column for column in theirs.columns if column != "value"]
        texts = {column: str for column in order if column not in ("seed", "frame", "frames", "exact_frames")}
        ours, theirs = (
            table.astype(texts).sort_values(order, ignore_index=True)[[*order, "value"]] for table in (ours, theirs)
        )
        pd.testing.assert_frame_equal(ours, theirs)
    assert merged.curves["robot"].dtype == "category", "a hundred million rows of text would not fit"


def test_missing_cells_of_a_study_are_by_variant(tmp_path: Path) -> None:
    rows = graded(baselines=False)
    tables = [("a", written(tmp_path / "a.parquet", rows)), ("b", written(tmp_path / "b.parquet", rows.drop(index=3)))]
    assert describe_scores(find_missing_scores(merge_scores(tables).rows)) == "b flow open_laptop 1000000 piper pck"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("protocol", 3),
        ("estimators", {"masks": "sam2"}),
        ("frame_zero", "absent"),
        ("motion", "own"),
        ("metrics", {"lpips": METRICS["lpips"]}),
    ],
)
def test_tables_that_do_not_compare_are_not_merged(key: str, value: object, tmp_path: Path) -> None:
    rows = graded()
    rows = rows[rows["metric"] == "lpips"]
    tables = [("a", written(tmp_path / "a.parquet", rows)), ("b", written(tmp_path / "b.parquet", rows, **{key: value}))]
    with pytest.raises(ConfigError, match=f"differ in {key}") as error:
        merge_scores(tables)
    assert all(str(path) in str(error.value) for _, path in tables) and str(value) in str(error.value)


def test_other_package_versions_are_all_named(tmp_path: Path) -> None:
    a, b = (written(tmp_path / f"{v}.parquet", graded(), versions={"xew": v}) for v in ("1.0", "1.1"))
    assert merge_scores([("a", a), ("b", b)]).versions == {"xew": "1.0, 1.1"}


def test_conflicts_between_tables_are_named(tmp_path: Path) -> None:
    rows = graded()
    a = written(tmp_path / "a.parquet", rows)
    with pytest.raises(ConfigError, match="more than once, 16 rows: a flow open_laptop"):
        merge_scores([("a", a), ("a", a)])
    other = written(tmp_path / "other.parquet", rows[rows["model"] == "flow"].assign(condition="other"))
    with pytest.raises(ConfigError, match="more than once, 16 rows: a flow open_laptop"):
        merge_scores([("a", a), ("a", other)])
    truth_of_other_data = rows.assign(content=rows["content"].str.replace("ground_truth lift_pot piper", "other"))
    with pytest.raises(ConfigError, match="more than once, 4 rows: ground_truth lift_pot 1000000 piper lpips"):
        merge_scores([("a", a), ("b", written(tmp_path / "b.parquet", truth_of_other_data))])
    with pytest.raises(ConfigError, match="over different numbers of frames"):
        merge_scores([("a", a), ("b", written(tmp_path / "b.parquet", rows.assign(frames=5, content="shorter")))])


def test_only_tables_of_one_variant_are_merged(tmp_path: Path) -> None:
    path = written(tmp_path / "a.parquet", graded())
    with pytest.raises(ConfigError, match="no score table to merge"):
        merge_scores([])
    with pytest.raises(ConfigError, match="no variant's name"):
        merge_scores([("", path)])
    write_scores(merge_scores([("a", path)]), tmp_path / "merged.parquet")
    with pytest.raises(ConfigError, match="is a merged table of 2 variants"):
        merge_scores([("a", tmp_path / "merged.parquet")])
