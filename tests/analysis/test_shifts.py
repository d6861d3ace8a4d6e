"""A new robot against changed scenes: common scenes, costs, marks, and what is no comparison."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.analysis.test_beyond import write_scores
from xew.analysis.beyond import Shifts, shifts_frame, shifts_table
from xew.analysis.beyond.shifts import MODELS
from xew.analysis.report import Args, main
from xew.analysis.scores import Scores, read_scores
from xew.config import ConfigError
from xew.protocol import HELD_OUT_ROBOTS, SEEN_ROBOTS, TEST_SEED_START

SCENES = [(task, TEST_SEED_START + i) for task in ("place_empty_cup", "beat_block_hammer") for i in range(8)]
COSTS = {"light:1": 0.0, "light:3": 0.05, "height:2": 0.02}
"""What each change adds to the LPIPS of the first model."""
MODEL, REMEDY = MODELS
SHARES = {MODEL: 1.0, REMEDY: 0.5}
"""The share of these costs that each model pays: training under changes halves them."""
NEW = dict(zip(HELD_OUT_ROBOTS, (0.1, 0.03), strict=True))
"""What each unseen robot adds."""


def rows(errors: Mapping[str, float], scenes: list[tuple[str, int]], **cell: str) -> list[dict[str, object]]:
    """Rows of one model on some robots, with their mean LPIPS and a spread over scenes that all share."""
    spread = 0.02 * np.random.default_rng(3).standard_normal(len(SCENES))
    return [
        {"model": "m", "condition": "c", **cell, "task": task, "seed": seed, "robot": robot, "metric": metric, "value": value}
        for robot, error in errors.items()
        for (task, seed) in scenes
        for metric, value in (("lpips", 0.2 + error + spread[SCENES.index((task, seed))]), ("psnr", 20.0))
    ]


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """A study's table, and one of each change and model; of the lower table the first scene is missing."""
    root = tmp_path_factory.mktemp("shifts")
    own = [row for model in MODELS for row in rows(dict.fromkeys(SEEN_ROBOTS, 0.0) | NEW, SCENES, variant=model)]
    unchanged, paths = write_scores(root / "scores.parquet", own), []
    for (change, cost), (model, share) in product(COSTS.items(), SHARES.items()):
        scenes = SCENES[1:] if change.startswith("height") else SCENES
        graded = rows(dict.fromkeys(SEEN_ROBOTS, share * cost), scenes, model=model)
        path = write_scores(root / f"{model}@{change.replace(':', '_')}.parquet", graded)
        frame = pd.read_parquet(path)
        frame.attrs |= {"change": change}
        frame.to_parquet(path, index=False)
        paths.append(path)
    return unchanged, paths


@pytest.fixture(scope="module")
def read(tables: tuple[Path, list[Path]]) -> tuple[Scores, list[Scores]]:
    return read_scores(tables[0]), [read_scores(path) for path in tables[1]]


def test_costs_are_paired_over_the_scenes_that_all_have(read: tuple[Scores, list[Scores]]) -> None:
    shifts = Shifts(*read)
    assert shifts.scenes == len(SCENES) - 1 and shifts.changes == ["light:1", "light:3", "height:2"]
    found = shifts_frame(shifts, "lpips").set_index(["trained_with", "case"])
    for (model, share), (case, cost) in product(SHARES.items(), (NEW | COSTS).items()):
        row = found.loc[MODELS[model], case]
        assert row["value"] == pytest.approx(cost if case in NEW else share * cost, abs=1e-6)
        assert row["high"] - row["low"] < 1e-5, "the spread over scenes cancels"
    mean = shifts.mean(REMEDY, "", "lpips")
    assert mean is not None and mean.count == 3 * shifts.scenes


def test_changes_are_compared_with_every_unseen_robot(read: tuple[Scores, list[Scores]]) -> None:
    """Of the costs 0, 0.05 and 0.02, the second lies between the robots' 0.03 and 0.1."""
    shifts = Shifts(*read)
    assert shifts.compare_changes(MODEL, "lpips") == {"more": [], "less": ["light:1", "height:2"], "unresolved": ["light:3"]}
    assert shifts.compare_changes(REMEDY, "lpips")["less"] == ["light:1", "light:3", "height:2"], "half of these costs"
    dear = [replace(table, rows=table.rows.assign(value=table.rows["value"] + 0.5)) for table in read[1]]
    assert Shifts(read[0], dear).compare_changes(MODEL, "lpips")["more"] == ["light:1", "light:3", "height:2"]


def test_a_model_without_its_own_scores_is_left_out(read: tuple[Scores, list[Scores]]) -> None:
    scores, shifted = read
    for left in (MODEL, REMEDY):
        alone = Shifts(replace(scores, rows=scores.rows[scores.rows["variant"] == left]), shifted)
        assert alone.models == [left] and len(shifts_frame(alone, "lpips")) == len(NEW | COSTS)
    assert not Shifts(replace(scores, rows=scores.rows.assign(variant="another")), shifted).models


def test_the_table_marks_what_costs_something(read: tuple[Scores, list[Scores]]) -> None:
    table = shifts_table(Shifts(*read))
    rows = {row.labels: row.cells[0] for section in table.sections for row in section.rows}
    for changes in ("no changes", "random changes"):
        own = {new: cell.verdict for (new, trained), cell in rows.items() if trained == changes}
        assert list(own.values()) == ["", "worse", "worse", "unresolved", "worse", "worse"]
        assert list(own)[3:] == ["light, level 1", "light, level 3", "height, level 2"]


def test_tables_that_do_not_compare_are_refused(read: tuple[Scores, list[Scores]]) -> None:
    scores, shifted = read
    unchanged = replace(shifted[0], attributes={**shifted[0].attributes, "change": ""})
    for wrong in ([*shifted, shifted[0]], [*shifted[1:], unchanged]):
        with pytest.raises(ConfigError, match="expected one without a change, and one of each change and model"):
            Shifts(scores, wrong)
    with pytest.raises(ConfigError, match=f"are of another; expected {MODEL} or {REMEDY}"):
        Shifts(scores, [replace(shifted[0], rows=shifted[0].rows.assign(model="another"))])
    other = replace(shifted[0], attributes={**shifted[0].attributes, "protocol": 99})
    with pytest.raises(ConfigError, match="differ in protocol from the unchanged"):
        Shifts(scores, [other])


def test_the_report_has_one_table_and_one_chart(tables: tuple[Path, list[Path]], tmp_path: Path) -> None:
    main(Args(tables[0], shifted=tuple(tables[1]), out=tmp_path))
    text = (tmp_path / "report.md").read_text()
    assert "## A new robot or a new lamp" in text and "Franka (Panda), never seen" in text
    assert "- Trained with no changes, a new robot adds 0.100 on Franka and 0.030 on Piper to LPIPS." in text
    assert (tmp_path / "figures" / "shifts.png").stat().st_size > 1000
