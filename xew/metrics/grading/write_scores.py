"""Last step of `evaluate`: write tables, bundle and summary next to each other."""

from pathlib import Path

import pandas as pd

from xew.files import write_text
from xew.metrics.grading.bundle import write_bundle
from xew.metrics.grading.list_jobs import Listing
from xew.metrics.grading.scores import describe, path_beside, write_tables
from xew.metrics.grading.settings import GradingSettings
from xew.metrics.grading.summary import summarize_robots, to_markdown
from xew.names import csv_text
from xew.protocol import HELD_OUT_ROBOTS

WRITTEN = {
    "parquet": "scores",
    "curves.parquet": "the same by frame",
    "summary.md": "means and differences between models",
    "summary.csv": "means, intervals, noise",
    "pairs.csv": "differences between models",
    "power.csv": "tasks on which a metric distinguishes the frozen first frame from the truth",
    "bundle.json": "for others to check",
}
"""Files that are written, by the ending of the name, with what each holds."""
TABLES = {"summary": "means", "pairs": "pairs", "power": "power"}


def write_scores(settings: GradingSettings, listing: Listing) -> str:
    """Write all files of a score table and return what is printed."""
    out, cells = settings.args.out, [job.cell for job in listing.jobs]
    attributes = describe(settings.choices, settings.metrics)
    if settings.args.rollouts and listing.codecs:
        attributes |= {"codecs": {model: [codec.key] for model, codec in sorted(listing.codecs.items())}}
    attributes |= {"motion": listing.motion} | ({"change": listing.change} if listing.change else {})
    write_tables(out, attributes, cells, settings.store)
    rows = pd.read_parquet(out)
    write_bundle(path_beside(out, "bundle.json"), out, rows, cells)
    return _write_summary(out, rows, settings.args.resample)


def _write_summary(out: Path, rows: pd.DataFrame, resample: str) -> str:
    if rows.empty:
        return "no scores"
    summary = summarize_robots(rows, resample, HELD_OUT_ROBOTS)
    texts = {"summary.md": to_markdown(summary)}
    texts |= {f"{name}.csv": csv_text(getattr(summary, table)) for name, table in TABLES.items()}
    for ending, text in texts.items():
        write_text(path_beside(out, ending), text, within=out.parent)
    written = "\n".join(f"{path_beside(out, ending)}  {what}" for ending, what in WRITTEN.items())
    return f"{to_markdown(summary, with_pairs=False)}\n{written}"
