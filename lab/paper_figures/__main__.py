"""The command: prints what of the paper's figures can be rebuilt, and writes all tables as a Markdown page."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from lab.paper_figures.recompute import (
    RecomputedChange,
    RecomputedFigure,
    rebuild,
    recompute_changes,
    recompute_mean_distances,
)
from lab.paper_figures.tables import (
    base_table,
    change_table,
    correlation_table,
    format_percent,
    frame_distances,
    frame_results,
    frame_table,
    robot_table,
)
from xew.analysis.correlation import Correlation
from xew.analysis.distances.workspaces import Frame
from xew.analysis.paper import PAPER_TITLES, Paper, read_paper
from xew.analysis.reports.paper import PRIMARY, describe_stability
from xew.analysis.tables import formats
from xew.analysis.tables.table import format_signed
from xew.config import user_errors
from xew.files import write_text

OWN_FRAMES: tuple[Frame, ...] = ("arm_base", "arm_alone")
"""Frames of workspaces whose distances the paper does not print."""


@dataclass(frozen=True)
class Args:
    """Rebuild the paper's printed figures from one another."""

    out: Path = Path("paper_figures.md")
    """Markdown page to write."""


def main(args: Args) -> None:
    """Print the sentences and write the page."""
    sentences, page = describe(read_paper())
    write_text(args.out, page, within=args.out.parent)
    print("\n".join([*sentences, str(args.out)]))


def describe(paper: Paper) -> tuple[list[str], str]:
    """The results in sentences, and all tables as a Markdown page."""
    figures, changes, frames = rebuild(paper), recompute_changes(paper), frame_distances()
    results = {metric: paper.correlation(metric, "kinematic") for metric in paper.metrics}
    by_frame = {frame: frame_results(paper, frames[frame]) for frame in OWN_FRAMES}
    sentences = [*rebuilt_sentences(figures, changes), *frame_sentences(results, by_frame)]
    tables = [
        correlation_table(paper, figures),
        frame_table(paper, frames),
        base_table(paper, frames),
        change_table(changes),
        robot_table(paper, recompute_mean_distances(paper)),
    ]
    lines = ["# The paper's figures, rebuilt from one another", "", *(f"- {sentence}" for sentence in sentences)]
    lines += [line for t in tables for line in ("", f"## {t.title}", "", t.caption, "", formats.markdown(t))]
    return sentences, "\n".join(lines) + "\n"


def rebuilt_sentences(figures: Sequence[RecomputedFigure], changes: Sequence[RecomputedChange]) -> Iterator[str]:
    """How many printed figures and percentages can be recomputed, and which cannot."""
    outside = [f"{PAPER_TITLES[one.metric]} by {one.axis} {one.quantity}" for one in figures if not one.agrees]
    furthest = max(abs(one.ours - one.published) for one in figures)
    word = f"{len(figures) - len(outside)} of {len(figures)} printed figures come out within what rounding of the inputs allows"
    yield f"{word} (largest difference {furthest:.3f}){': not ' + ', '.join(outside) if outside else ''}."
    wrong = [f"{format_percent(one.change.percent, 0)} ({one.change.source})" for one in changes if not one.agrees]
    follow = f"{len(changes) - len(wrong)} of {len(changes)} percentages of the text follow from the tables"
    yield f"{follow}{': not ' + ', '.join(wrong) if wrong else ''}."


def frame_sentences(results: Mapping[str, Correlation], by_frame: Mapping[Frame, Mapping[str, Correlation]]) -> Iterator[str]:
    """How the frame of workspaces changes the primary outcome and the others; `results` are by the printed distances."""
    starts: dict[Frame, str] = {
        "arm_base": "By kinematic distance as the text defines it, in the arm's base frame (our clouds, its scores)",
        "arm_alone": "By workspaces of the arm alone, in that frame (ours)",
    }
    for frame, start in starts.items():
        primary = by_frame[frame][PRIMARY]
        turned = [PAPER_TITLES[name] for name, one in by_frame[frame].items() if one.r * results[name].r < 0]
        yield (
            f"{start}, {PAPER_TITLES[PRIMARY]} has r = {format_signed(primary.r)}, p = {primary.p_value:.3f}; its sign "
            f"{describe_stability(primary)}. Against the printed figures r turns its sign for "
            f"{', '.join(turned) or 'no metric'}."
        )


if __name__ == "__main__":
    user_errors(lambda: main(tyro.cli(Args, prog="python -m lab.paper_figures")))()
