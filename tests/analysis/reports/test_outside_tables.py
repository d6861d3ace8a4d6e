"""The report of scores that hold metrics, robots, tasks and variants that no registry of ours knows: each under its key."""

from pathlib import Path

import pandas as pd
import pytest

from tests.analysis.synthetic_study import attributes, write_study
from xew.analysis.report import Args, main
from xew.analysis.scores import VARIANT

METRIC = {
    "grip_sharpness": {
        "dimension": "hands", "unit": "N", "higher_is_better": True, "low": 0.0, "high": None, "reference": "ours",
        "title": "Grip sharpness", "reported": True, "estimated": False,
    }
}  # fmt: skip
BARE = {
    "wobble": {
        "dimension": "visual", "unit": "", "higher_is_better": False, "low": 0.0, "high": 1.0, "reference": "ours",
        "estimated": False,
    }
}  # fmt: skip
"""As tables describe a metric that say no title."""
ROBOT, TASK, VARIANT_NAME = "my_lab_robot", "my_tasks:FOLD", "fixed-my_action-none"


def add_strangers(path: Path, model: str, metrics: dict[str, dict[str, object]], only: bool = False) -> Path:
    """Add a robot, a task, a variant (or model) and metrics to a score table and its curves; or leave nothing else."""
    table, curves = pd.read_parquet(path), pd.read_parquet(path.with_suffix(".curves.parquet"))
    known = table.attrs
    episodes = table.drop_duplicates(["task", "seed"])[["task", "seed"]]
    episodes = pd.concat([episodes, pd.DataFrame({"task": TASK, "seed": episodes["seed"].unique()})])
    rows = []
    for name in ([] if only else ["lpips", "psnr"]) + list(metrics):
        for robot in (ROBOT, "piper"):
            made = episodes.assign(metric=name, robot=robot, model=model, condition="my_action", frames=9, exact_frames=0)
            rows.append(made.assign(value=0.25, **({VARIANT: VARIANT_NAME} if VARIANT in table else {})))
    added = pd.concat(rows)[[column for column in table.columns if column in rows[0]]]
    table = added if only else pd.concat([table, added])
    table.attrs = {**known, "robots": [ROBOT], "metrics": metrics if only else {**known["metrics"], **metrics}}
    table.to_parquet(path, index=False)
    curves = curves[:0] if only else curves
    curves.to_parquet(path.with_suffix(".curves.parquet"), index=False)
    return path


@pytest.mark.parametrize("only", [False, True], ids=["beside ours", "alone"])
def test_a_study_shows_what_the_protocol_does_not_hold(tmp_path: Path, only: bool) -> None:
    path = write_study(tmp_path / "scores.parquet", ["fixed-optical_flow-none", "fixed-joints-none"])
    add_strangers(path, "mine", {**METRIC, **BARE}, only)
    main(Args(scores=path, out=tmp_path / "report"))
    html, text = ((tmp_path / "report" / name).read_text() for name in ("index.html", "report.md"))
    for word in ("Grip sharpness [N]", ROBOT, VARIANT_NAME, "Outside the protocol", "hands"):
        assert word in html and word in text, word
    made = pd.read_csv(tmp_path / "report" / "tables" / "outside.csv")
    assert set(made["block"]) == {ROBOT, "Piper"} and set(made["row"]) >= {VARIANT_NAME}
    assert made.set_index(["block", "row", "column"]).loc[(ROBOT, VARIANT_NAME, "hands: Grip sharpness [N] ↑"), "value"] == 0.25


@pytest.mark.parametrize("only", [False, True], ids=["beside ours", "alone"])
def test_a_run_shows_what_no_registry_knows(tmp_path: Path, only: bool) -> None:
    path = write_study(tmp_path / "scores.parquet", ["fixed-optical_flow-none"])
    for file in (path, path.with_suffix(".curves.parquet")):
        run = pd.read_parquet(file).drop(columns=VARIANT)
        run.attrs = attributes()
        run.to_parquet(file, index=False)
    add_strangers(path, "mine", {**METRIC, **BARE}, only)
    main(Args(scores=path, out=tmp_path / "report"))
    html = (tmp_path / "report" / "index.html").read_text()
    for word in ("Grip sharpness [N]", "wobble", ROBOT, "mine · my_action"):
        assert word in html, word
    found = pd.read_csv(tmp_path / "report" / "summary.csv")
    assert {"grip_sharpness", "wobble"} <= set(found.loc[found["robots"] == ROBOT, "metric"])
