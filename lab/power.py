"""Writes the section on the metrics' power on each task into docs/reference/tasks.md.

Reads  a score table with the baselines, such as of `xew.metrics.evaluate --data data --baselines-of validation`
Writes one section of a Markdown page; the rest of the page stays

    python -m lab.power scores.parquet --page docs/reference/tasks.md
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro

from xew.config import ConfigError, user_errors
from xew.files import read_text, write_text
from xew.metrics import METRICS
from xew.statistics import describe_power, measure_power
from xew.statistics.power import LEAST_POWER

HEADING = "## What the metrics can tell"
"""Heading of the section on the page of the tasks."""
MOST_SHOWN = 10_000
"""Power from which on no number is written; it is infinite where the true video has a metric's best score."""


COMMAND = "python -m lab.power scores.parquet --page docs/reference/tasks.md"
"""Command that the page names."""


@dataclass(frozen=True)
class Args:
    """Write what the metrics can tell on each task into a page."""

    scores: Annotated[Path, tyro.conf.Positional]
    """Score table with the baselines of some episodes."""
    page: Path = Path("docs/reference/tasks.md")
    """Markdown page whose section is written again."""


@user_errors
def main(args: Args) -> None:
    """Write the section."""
    rows = pd.read_parquet(args.scores)
    write_power(args.page, measure_power(rows, METRICS), rows)


def write_power(page: Path, power: pd.DataFrame, rows: pd.DataFrame) -> None:
    """Write the section on the metrics' power into a page. Raises ConfigError where the power is not known."""
    if power.empty:
        raise ConfigError("the table lacks the frozen first frame or the true video in a metric of the suite strict.")
    write_section(page, HEADING, f"`{COMMAND}`.\n{power_section(power, rows)}")


def power_section(power: pd.DataFrame, rows: pd.DataFrame) -> str:
    """Markdown: the power of each task for each metric, and what the frozen first frame and the true video score.

    Args:
        power: as of `xew.statistics.find_power`, of at least one task.
        rows: score table that it was found in; columns task seed robot.
    """
    least = power.sort_values("power").iloc[0]
    seeds = ", ".join(map(str, sorted(rows["seed"].unique())))
    robots = ", ".join(f"`{robot}`" for robot in sorted(rows["robot"].unique()))
    episodes = len(rows[["task", "seed", "robot"]].drop_duplicates())
    introduction = (
        "Power is the distance of the frozen first frame from a metric's best score, divided by the distance of the true "
        f"video, which `evaluate` shows softened to its estimators. It is of {episodes} episodes of {robots}, "
        f"seed {seeds} of each task.\n"
        f"A task leaves a metric's mean where that is not above {LEAST_POWER:g}. "
        f"{describe_power(power, {}) or 'None of these does.'} The least power is {_times(least['power'])}, of "
        f"`{least['task']}` for `{least['metric']}`."
    )
    scores = power.assign(
        text=[f"{frozen:.3g} ({truth:.3g})" for frozen, truth in zip(power["frozen"], power["truth"], strict=True)]
    )
    parts = [introduction, _table(power.assign(text=power["power"].map(_times)))]
    parts += ["The scores behind it, of the frozen first frame, and in parentheses of the true video:", _table(scores)]
    return "\n\n".join(parts)


def _times(power: float) -> str:
    """A power with two digits; 'none' where it is not defined: the frozen frame and the true video have the best score."""
    if np.isnan(power):
        return "none"
    return f"{float(f'{power:.2g}'):.4g}" if power < MOST_SHOWN else f"over {MOST_SHOWN:,}"


def _table(power: pd.DataFrame) -> str:
    """Tasks down, metrics across, the column `text` in the cells."""
    table = power.pivot(index="task", columns="metric", values="text")
    names = [name for name in METRICS if name in table.columns]
    lines = [["task", *(f"`{name}`" for name in names)], ["---"] * (len(names) + 1)]
    lines += [[f"`{task}`", *table.loc[task, names].fillna("–")] for task in table.index]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def write_section(path: Path, heading: str, text: str) -> None:
    """Write one section of a Markdown page again, without changing the rest; a missing page is created.

    Args:
        path: of the page.
        heading: of the section, such as '## Results', which ends before the next heading of its level or above. Where there
            is no such section, it comes to the page's end.
        text: what stands below the heading.

    Raises:
        OSError: the page cannot be read or written, or the disk is full.
    """
    page = read_text(path) if path.exists() else ""
    section, most = f"{heading}\n{text.strip()}\n\n", len(heading) - len(heading.lstrip("#"))
    old = re.search(rf"^{re.escape(heading)}\n.*?(?=^#{{1,{most}}} |\Z)", page, re.MULTILINE | re.DOTALL)
    start, end = old.span() if old else (len(page), len(page))
    before = f"{page[:start].rstrip()}\n\n" if page[:start].strip() else ""
    write_text(path, f"{before}{section}{page[end:]}".rstrip() + "\n", within=path.parent)


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m lab.power"))
