"""`report --paper`: one offline page with the paper's figures beside ours, and the same as Markdown and CSV."""

import re
from pathlib import Path

import cv2
import pandas as pd
import pytest

from tests.analysis.test_report import Page
from xew.analysis.paper import read_paper
from xew.analysis.report import Args, main
from xew.analysis.tables.table import format_signed


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("paper")
    main(Args(paper=True, out=out))
    return out


def test_the_page_is_well_formed_and_opens_offline(written: Path) -> None:
    text = (written / "index.html").read_text()
    page = Page(text)
    assert not page.open and not page.images and text.count("<svg") == 2
    assert not re.search(r"(src|href)\s*=\s*[\"'](?!data:|#)", text) and "url(http" not in text and "<script" not in text
    assert cv2.imread(str(written / "figures" / "distance.png")).std() > 0


def test_the_finding_comes_first(written: Path) -> None:
    text = (written / "index.html").read_text()
    assert text.index("p = 0.075; its sign survives") < text.index("<table")
    assert "p = 0.392; its sign does not survive" in text


def test_correlations_stand_next_to_the_printed_ones(written: Path) -> None:
    page, markdown = (written / "index.html").read_text(), (written / "report.md").read_text()
    for metric in read_paper().metrics.values():
        for of in (metric.appearance, metric.kinematic):
            low, high = format_signed(of.low), format_signed(of.high)
            assert f"{low} to {high}" in page and f"(paper {low} to {high})" in markdown


def test_all_tables_of_the_paper_are_there_as_printed(written: Path) -> None:
    page = (written / "index.html").read_text()
    for part in read_paper().parts.values():
        for row in part.rows.values():
            for scores in row.values():
                for metric, value in scores.items():
                    digits = 1 if metric == "trajectory_error" and "tab:baseline" in part.source else 3
                    assert f">{value:.{digits}f}<" in page, (part.source, metric, value)
    names = {path.stem for path in (written / "tables").glob("*.csv")}
    assert {
        "actions_full",
        "ladder_full",
        "few_shot_full",
        "forgetting_full",
        "baselines",
        "loeo_full",
        "correlations",
    } <= names
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


@pytest.mark.parametrize("args", [Args(), Args(Path("scores.parquet"), paper=True), Args(paper=True, data=Path("data"))])
def test_it_is_scores_or_paper(args: Args, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(args)
    assert exit_.value.code == 2 and "--paper" in capsys.readouterr().err
