"""The page's section on the metrics' power says what the scores say."""

from pathlib import Path

import pandas as pd
import pytest

from lab.power import power_section, write_power, write_section
from xew.config import ConfigError
from xew.metrics import METRICS
from xew.statistics import measure_power

ROBOTS = ("aloha_agilex", "piper")


def test_the_power_of_tasks_is_a_section_of_a_page(tmp_path: Path) -> None:
    """Of the frozen frame and the true video on two tasks, one of which tells them apart."""
    rows = pd.DataFrame(
        {"model": model, "condition": "", "task": task, "seed": 800000, "robot": robot, "metric": "pck_strict", "value": value}
        for task, scores in {"lift": (0.2, 0.9), "rest": (0.85, 0.9), "best": (0.5, 1.0), "both": (1.0, 1.0)}.items()
        for model, value in zip(("copy_first_frame", "ground_truth"), scores, strict=True)
        for robot in ROBOTS
    )
    text = power_section(measure_power(rows, METRICS), rows)
    assert "8 episodes of `aloha_agilex`, `piper`, seed 800000 of each task" in text
    assert "as the true video (pck_strict: both, rest). The least power is 1.5, of `rest` for `pck_strict`." in text
    assert "| `both` | none |" in text and "| `best` | over 10,000 |" in text
    assert "| `lift` | 8 |" in text and "| `lift` | 0.2 (0.9) |" in text and "| `rest` | 0.85 (0.9) |" in text
    write_power(tmp_path / "page.md", measure_power(rows, METRICS), rows)
    assert (tmp_path / "page.md").read_text().endswith(f"{text}\n")
    with pytest.raises(ConfigError, match="lacks the frozen first frame or the true video"):
        write_power(tmp_path / "page.md", measure_power(rows[rows["model"] == "ground_truth"], METRICS), rows)


def test_a_section_is_written_anew_and_all_else_stays(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    write_section(page, "## One", "first")
    assert page.read_text() == "## One\nfirst\n"
    write_section(page, "## Two", "second\n\n### Part\nof it")
    write_section(page, "## One", "other\n")
    assert page.read_text() == "## One\nother\n\n## Two\nsecond\n\n### Part\nof it\n"
    page.write_text(f"# Page\nhead\n{page.read_text()}\n# Next\n")
    write_section(page, "## Two", "last")
    assert page.read_text() == "# Page\nhead\n## One\nother\n\n## Two\nlast\n\n# Next\n"
