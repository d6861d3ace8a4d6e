"""`report --paper`: one offline page with the paper's figures beside ours, and the same as Markdown and CSV."""

import dataclasses
import re
from pathlib import Path

import cv2
import pandas as pd
import pytest

from tests.analysis.test_report import Page
from xew.analysis.paper import read_paper
from xew.analysis.report import Args, main
from xew.analysis.reports import paper as paper_report
from xew.analysis.tables.distances import format_signed
from xew.analysis.tables.paper import frame_distances, frame_results


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("paper")
    main(Args(paper=True, out=out))
    return out


def test_the_page_is_well_formed_and_opens_offline(written: Path) -> None:
    text = (written / "index.html").read_text()
    page = Page(text)
    assert not page.open and not page.images and text.count("<svg") == 4
    assert not re.search(r"(src|href)\s*=\s*[\"'](?!data:|#)", text) and "url(http" not in text and "<script" not in text
    assert cv2.imread(str(written / "figures" / "distance.png")).std() > 0


def test_the_finding_comes_first(written: Path) -> None:
    text = (written / "index.html").read_text()
    assert text.index("72 of 72 printed figures come out") < text.index("<table")
    assert "p = 0.075; its sign survives" in text and "p = 0.392; its sign does not survive" in text


def test_every_printed_figure_stands_beside_ours(written: Path) -> None:
    page, markdown = (written / "index.html").read_text(), (written / "report.md").read_text()
    for metric in read_paper().metrics.values():
        for of in (metric.appearance, metric.kinematic):
            low, high = format_signed(of.low), format_signed(of.high)
            assert f">{low} to {high}<" in page and f"(paper {low} to {high}) ✓" in markdown
            assert f">{format_signed(of.r)}<" in page
    # Ten rows of five cells, two p, five robots with two means, 28 percentages.
    assert page.count('class="agrees"') == markdown.count(") ✓ ") == 10 * 5 + 2 + 5 * 2 + 28
    assert 'class="differs"' not in page


def test_all_tables_of_the_paper_are_there_as_printed(written: Path) -> None:
    page = (written / "index.html").read_text()
    for part in read_paper().parts.values():
        for row in part.rows.values():
            for scores in row.values():
                for metric, value in scores.items():
                    digits = 1 if metric == "trajectory_error" and "tab:baseline" in part.source else 3
                    assert f">{value:.{digits}f}<" in page, (part.source, metric, value)
    names = {path.stem for path in (written / "tables").iterdir()}
    assert {"actions_full", "ladder_full", "few_shot_full", "forgetting_full", "baselines", "loeo_full", "changes"} <= names
    for name in names:
        text = (written / "tables" / f"{name}.tex").read_text()
        assert text.isascii() and text.count(r"\begin{") == text.count(r"\end{") > 1
        assert len(pd.read_csv(written / "tables" / f"{name}.csv"))


def test_the_papers_claims_are_asked_of_its_own_figures(written: Path) -> None:
    found = pd.read_csv(written / "findings.csv").drop_duplicates("claim")
    papers = found[found["where"] != "ours"]
    assert len(papers) > 20 and not (papers["verdict"] == "fails").any()
    text = (written / "index.html").read_text()
    assert f"of the paper&#39;s {len(papers)} claims: hold {(papers['verdict'] == 'holds').sum()}, fail 0," in text


def test_the_summary_has_a_row_for_each_figure(written: Path) -> None:
    summary = pd.read_csv(written / "summary.csv")
    printed, own = summary[summary["published"].notna()], summary[summary["published"].isna()]
    assert len(printed) == 72 + 10 + 28 and printed["agrees"].all()
    assert len(own) == 2 * 10 * 4 and set(own["axis"]) == {"arm_base", "arm_alone"} and own["agrees"].isna().all()
    row = summary[(summary["row"] == "lpips") & (summary["axis"] == "kinematic") & (summary["quantity"] == "p_value")]
    assert row["published"].item() == 0.392 and row["ours"].item() == pytest.approx(47 / 120)


def test_the_frame_of_workspaces_is_named_and_what_it_changes(written: Path) -> None:
    """In the root's frame our clouds give the paper's r; in the arm's they give others."""
    summary = pd.read_csv(written / "summary.csv").set_index(["row", "axis", "quantity"])["ours"]
    root = frame_results(read_paper(), frame_distances()["root"])
    for metric, result in root.items():
        assert result.r == pytest.approx(summary[metric, "kinematic", "r"], abs=0.05)
    # As the text defines it, the kinematic distance goes with LPIPS as the appearance distance does.
    assert summary["lpips", "kinematic", "low"] < 0 < 0.7 < summary["lpips", "arm_base", "low"]
    assert summary["lpips", "arm_base", "r"] == pytest.approx(summary["lpips", "appearance", "r"], abs=0.05)
    assert summary["keypoint_error", "kinematic", "r"] < 0 < summary["keypoint_error", "arm_alone", "low"]
    text = (written / "index.html").read_text()
    assert "as the text defines it, in the arm&#39;s base frame (our clouds, its scores), LPIPS has r = +0.8" in text
    assert "By workspaces of the arm alone, in that frame (ours), LPIPS has r = +0.5" in text


def test_what_does_not_come_out_is_named() -> None:
    paper = read_paper()
    lpips = paper.metrics["lpips"]
    wrong = dataclasses.replace(lpips, appearance=dataclasses.replace(lpips.appearance, r=0.712))
    changes = [dataclasses.replace(paper.changes[0], percent=-39), *paper.changes[1:]]
    report = paper_report.build(dataclasses.replace(paper, metrics={**paper.metrics, "lpips": wrong}, changes=changes), "")
    assert "71 of 72 printed figures" in report.html and "not LPIPS by appearance r." in report.html
    assert "27 of 28 percentages of the text follow from the tables: not −39 % (sec:exp-actrep)." in report.html
    assert report.html.count('class="differs"') == 2 and (report.summary["agrees"] == False).sum() == 2  # noqa: E712
    assert "(paper +0.712) ✗" in report.markdown and "(paper −39 %) ✗" in report.markdown


@pytest.mark.parametrize("args", [Args(), Args(Path("scores.parquet"), paper=True), Args(paper=True, data=Path("data"))])
def test_it_is_scores_or_paper(args: Args, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(args)
    assert exit_.value.code == 2 and "--paper" in capsys.readouterr().err
