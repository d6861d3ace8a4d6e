"""What docs/results publishes is what its scores give, by the command that its pages name.

`tables/sentences.txt` holds the lines of report.md that begin with "- ".
"""

from pathlib import Path

import pandas as pd
import pytest

from xew.analysis.report import Args, main

RESULTS = Path(__file__).parents[2] / "docs" / "results"
OTHER_MOTION = {"own_motion": RESULTS / "six_tasks" / "scores.parquet"}
"""Score tables of the same study in the other kind of motion, by the folder whose page sets both side by side."""
FOLDERS = sorted(path.parent for path in RESULTS.glob("*/scores.parquet"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_published_tables_and_sentences_are_those_of_the_scores(folder: Path, tmp_path: Path) -> None:
    distances = folder / "distances"
    other = OTHER_MOTION.get(folder.name)
    main(Args(folder / "scores.parquet", distances=distances if distances.is_dir() else None, other_motion=other, out=tmp_path))
    published = sorted((folder / "tables").glob("*.csv"))
    assert published, f"{folder} publishes no table"
    for path in published:
        pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "tables" / path.name), pd.read_csv(path), rtol=1e-6)
    sentences = [line for line in (tmp_path / "report.md").read_text().splitlines() if line.startswith("- ")]
    assert sentences and sentences == (folder / "tables" / "sentences.txt").read_text().splitlines()


def test_there_are_results() -> None:
    names = ["bodies", "bodies_debug", "own_motion", "remedies", "six_tasks", "small_fine", "small_size"]
    assert [folder.name for folder in FOLDERS] == names
