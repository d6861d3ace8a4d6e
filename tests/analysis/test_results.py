"""What docs/results publishes is what its scores give, by the command that its pages name.

`tables/sentences.txt` holds the lines of report.md that begin with "- ".
"""

import io
import re
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from lab.results import BY_FRAME, NUMBERS, RESULTS, find_folders, make_report, published_charts, read_sentences

FOLDERS = find_folders()


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_published_tables_and_sentences_are_those_of_the_scores(folder: Path, tmp_path: Path) -> None:
    """And its charts; `python -m lab.results` makes all again."""
    make_report(folder, tmp_path)
    published = sorted((folder / "tables").glob("*.csv"))
    assert published, f"{folder} publishes no table"
    for path in published:
        pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "tables" / path.name), pd.read_csv(path), rtol=1e-6)
    charts = dict(published_charts(folder, tmp_path))
    assert [path.name for path in folder.glob("*.png") if path not in charts and not path.name.startswith(BY_FRAME)] == []
    for path, drawn in charts.items():
        numbers = pd.read_csv(io.StringIO(Image.open(path).text[NUMBERS]))
        pd.testing.assert_frame_equal(pd.read_csv(drawn.with_suffix(".csv")), numbers, rtol=1e-6)
    sentences = read_sentences(tmp_path)
    assert sentences and sentences == (folder / "tables" / "sentences.txt").read_text().splitlines()
    if folder.name == "shifts":
        answer = "Yes: by LPIPS, the best model is better than the paste baseline on Franka (Panda) and Piper."
        assert answer in (tmp_path / "report.md").read_text()
    if folder.name == "six_tasks":
        check_claims((tmp_path / "report.md").read_text().replace("\u00a0", " "), (folder / "README.md").read_text())
    if folder.name == "own_motion":
        check_motions((tmp_path / "report.md").read_text().replace("\u00a0", " "), (folder / "README.md").read_text())


def read_table(text: str, head: str) -> list[list[str]]:
    """The cells of the table whose first row begins so, without its heads."""
    lines = text[text.index(f"| {head}") :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def check_claims(report: str, page: str) -> None:
    """Verdicts, and every number with its interval, are those of the report's table; pages count the verdicts right."""
    asked = [cells for cells in read_table(report, "claim | test") if "(ours)" not in cells[0]]
    shown = read_table(page, "claim of the paper")
    for (_, _, verdict, alone, _, numbers, *_), (label, among_all, by_itself, text) in zip(asked, shown, strict=True):
        assert (verdict.partition(" ")[0].strip("*"), alone) == (among_all.strip("*"), by_itself), label
        pieces = re.sub(r" \([^)]*\)(?=;|$)", "", numbers).split("; ")
        quoted = re.sub(r"^\d+ numbers, from ", "", text).replace(" to ", "; ") if " numbers, from " in text else text
        assert set(quoted.split("; ")) <= set(pieces), label
    counts = [[cells[i].strip("*") for cells in shown] for i in (1, 2)]
    all_claims, alone = ([words.count(word) for word in ("holds", "fails", "unresolved")] for words in counts)
    said = "{} holds, {} fail and {} are unresolved".format(*all_claims)
    assert said in page and said in (RESULTS.parent / "reproduce_the_paper.md").read_text()
    assert said.replace(" fail and", " fail,") in (RESULTS / "README.md").read_text()
    assert "{} hold, {} fail and {} are unresolved".format(*alone) in page
    assert f"25 claims {all_claims[2]} stay unresolved" in (RESULTS.parents[1] / "README.md").read_text()


def check_motions(report: str, page: str) -> None:
    """The table of both motions is the report's, apart from labels."""
    section = report[report.index("### Action representation in shared and in own motion") :]
    ours, shown = (read_table(text, "action representation") for text in (section, page))
    assert [cells[1:] for cells in ours] == [cells[1:] for cells in shown]


def test_there_are_results() -> None:
    names = ["all_tasks", "bodies", "bodies_debug", "outcome", "own_motion", "recipe", "remedies", "shifts", "six_tasks"]
    assert [folder.name for folder in FOLDERS] == names
