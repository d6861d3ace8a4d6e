"""Last step of `evaluate`: write tables, bundle and summary next to each other."""

from pathlib import Path

import pandas as pd

from xew.files import write_text
from xew.metrics.grading.bundle import write_bundle
from xew.metrics.grading.list_jobs import Listing
from xew.metrics.grading.scores import describe, path_beside, write_tables
from xew.metrics.grading.settings import GradingSettings
from xew.metrics.grading.summary import ranking_to_markdown, summarize_robots, to_markdown
from xew.names import csv_text
from xew.protocol import HELD_OUT_ROBOTS
from xew.statistics import rank_policies

WRITTEN = {
    "parquet": "scores",
    "curves.parquet": "the same by frame",
    "summary.md": "means and differences between models",
    "summary.csv": "means, intervals, noise",
    "pairs.csv": "differences between models",
    "power.csv": "tasks on which a metric distinguishes the frozen first frame from the truth",
    "outcome.csv": "whether policies are ranked as in the simulator, of data sets with faulty episodes",
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
    ranking = rank_policies(rows, {robot: [robot] for robot in summary.means["robot"].unique()})
    texts = {"summary.md": to_markdown(summary) + ranking_to_markdown(ranking)}
    texts |= {f"{name}.csv": csv_text(getattr(summary, table)) for name, table in TABLES.items()}
    texts |= {} if ranking.empty else {"outcome.csv": csv_text(ranking)}
    for ending, text in texts.items():
        write_text(path_beside(out, ending), text, within=out.parent)
    written = {ending: what for ending, what in WRITTEN.items() if ending != "outcome.csv" or not ranking.empty}
    lines = "\n".join(f"{path_beside(out, ending)}  {what}" for ending, what in written.items())
    return f"{to_markdown(summary, with_pairs=False)}{ranking_to_markdown(ranking)}\n{lines}"
