"""What `evaluate` writes when all is graded: tables, bundle and summary, beside each other.

It needs pandas and SciPy, which take as long to import as half of all else, and which nothing needs before.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from xew.config import ConfigError
from xew.episode import EpisodeError
from xew.files import write_section
from xew.metrics.grading.bundle import write_bundle
from xew.metrics.grading.power import HEADING, power_section
from xew.metrics.grading.scores import Cell, CellStore, path_beside, write_diagnostics, write_tables, write_whole
from xew.metrics.grading.summary import summarize_robots, to_markdown
from xew.names import csv_text
from xew.protocol import HELD_OUT_ROBOTS

POWER_COMMAND = "python -m xew.metrics.evaluate --data data --baselines-of validation --power-page docs/tasks.md"
"""Command that the page of the tasks names."""
WRITTEN = {
    "parquet": "scores",
    "curves.parquet": "the same by frame",
    "summary.md": "means and differences between models",
    "summary.csv": "means, intervals, noise",
    "pairs.csv": "differences between models",
    "power.csv": "which tasks tell the frozen first frame from the truth",
    "bundle.json": "for others to check",
}
"""Files that are written beside each other, by the ending of the name, with what each holds."""


def write_outcome(
    out: Path,
    attributes: dict[str, Any],
    diagnostics: Sequence[str],
    cells: Sequence[Cell],
    store: CellStore,
    resample: str,
    power_page: Path | None,
) -> str:
    """Write all files of a score table and return what is printed.

    Args:
        out: the table; all else lies beside it.
        attributes: of the table, as of `describe`.
        diagnostics: names of the diagnostics to write.
        cells: what was graded, in the store.
        resample: unit that the summary's intervals resample.
        power_page: page whose section on what the metrics can tell is written anew.

    Raises:
        ConfigError: the disk does not take a file, or the power for the page is not known.
    """
    write_tables(out, attributes, cells, store)
    if diagnostics:
        write_diagnostics(path_beside(out, "diagnostics.parquet"), attributes, diagnostics, cells, store)
    rows = pd.read_parquet(out)
    write_bundle(path_beside(out, "bundle.json"), out, rows, cells)
    return _write_summary(out, rows, resample, power_page)


def _write_summary(out: Path, rows: pd.DataFrame, resample: str, power_page: Path | None) -> str:
    """Write the summary's files and return what is printed."""
    if rows.empty:
        return "no scores"
    summary = summarize_robots(rows, resample, HELD_OUT_ROBOTS)
    write_whole(path_beside(out, "summary.md"), to_markdown(summary).encode())
    write_whole(path_beside(out, "summary.csv"), csv_text(summary.means).encode())
    write_whole(path_beside(out, "pairs.csv"), csv_text(summary.pairs).encode())
    write_whole(path_beside(out, "power.csv"), csv_text(summary.power).encode())
    if power_page:
        write_power(power_page, summary.power, rows)
    written = "\n".join(f"{path_beside(out, ending)}  {what}" for ending, what in WRITTEN.items())
    return f"{to_markdown(summary, with_pairs=False)}\n{written}"


def write_power(page: Path, power: pd.DataFrame, rows: pd.DataFrame) -> None:
    """Write what the metrics can tell on each task into a page. Raises ConfigError where the power is not known."""
    if power.empty:
        raise ConfigError("--power-page needs the frozen first frame and the true video in a metric of the suite strict.")
    try:
        write_section(page, HEADING, f"`{POWER_COMMAND}`.\n{power_section(power, rows)}")
    except OSError as error:
        raise EpisodeError(f"cannot write {page}: {error.strerror}. Choose another file with --power-page.") from error
