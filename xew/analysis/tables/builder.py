"""Cells, rows and notes of a study's tables, made from its means and the paper's printed values."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from xew import statistics
from xew.analysis.scores import TRUTH, MetricInfo
from xew.analysis.statistics.grades import Grades, PaperGrades, StudyGrades, find_variant, paired_means, pooled
from xew.analysis.tables.labels import PAPER_METRICS, TRUE
from xew.analysis.tables.table import TableCell, TableRow, format_interval, format_number
from xew.protocol import BASELINES, CODEC_TRUTH, PAPER_PARTS, PARTS, expected_counts, reference
from xew.statistics import Mean, combine, strict_metrics


@dataclass(frozen=True)
class Builder:
    """Makes the cells, rows and notes of a study's tables.

    Attributes:
        ours: means of the study.
        paper: means that the paper prints; None leaves them out.
        planned: numbers of episodes that the study meant to grade, by variant and robot; the paper's where it does not say.
    """

    ours: Grades
    paper: PaperGrades | None
    planned: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @property
    def any_metric(self) -> str:
        """The first metric, for counts."""
        return next(iter(self.ours.metrics))

    @property
    def reported(self) -> tuple[str, ...]:
        """Metrics of the full tables: the paper's suite, and other reported metrics."""
        return tuple(name for name, info in self.ours.metrics.items() if name in PAPER_METRICS or info.reported)

    @cached_property
    def _strict(self) -> dict[str, str]:
        return strict_metrics(self.ours.metrics)

    def has_results(self, part: str) -> bool:
        """Whether anything was measured that only this part asks for; models that comparisons start from do not count."""
        if not isinstance(self.ours, StudyGrades):
            return part in PAPER_PARTS
        adapted = [variant for variant in PARTS[part] if variant.target is not None]
        starts = (reference(), *PARTS["bodies"])
        own = adapted or [variant for variant in PARTS[part] if variant not in starts] or PARTS[part]
        return any(self.ours.has(variant.name) for variant in own)

    def cell(self, part: str, row: str, robots: str, metric: str, base: str = "") -> TableCell:
        """The mean at an address, with the paper's value and the verdict on its difference from the row `base`."""
        info = self.ours.metrics.get(metric)
        mean = self.ours.mean(part, row, robots, metric) if info else None
        printed = self._printed_cell(part, row, robots, metric)
        if info is None or mean is None:
            return printed
        verdict, parting = self._marks(part, row, base, robots, metric)
        own = mean_cell(mean, info, self.ours.level)
        return replace(own, verdict=verdict, parting=parting, published=printed.published, printed=printed.printed)

    def _marks(self, part: str, row: str, base: str, robots: str, metric: str) -> tuple[str, str]:
        """Verdict on the difference from the row `base`, and `TableCell.parting`; of a pair only the strict metric has a
        verdict.
        """
        if not base or base == row:
            return "", ""
        own = paired_verdict(self.ours, part, row, base, robots, metric)
        strict = self._strict.get(metric)
        if strict is None:
            return own, ""
        decides = paired_verdict(self.ours, part, row, base, robots, strict)
        return "", own if own and decides and own != decides else ""

    def row(self, part: str, row: str, robots: str, metrics: Sequence[str], labels: Sequence[str], base: str = "") -> TableRow:
        """One cell for each metric."""
        return TableRow(tuple(labels), tuple(self.cell(part, row, robots, metric, base) for metric in metrics))

    def baselines(self, robots: Sequence[str], metrics: Sequence[str]) -> list[TableRow]:
        """Rows of the baselines, the true video last, where they were graded; of fewer episodes than a model's, they say so."""
        most, rows = self._most_episodes(robots), []
        for name, title in BASELINES.items():
            if name not in (CODEC_TRUTH, TRUTH):
                graded = self.ours.count_episodes(name, robots) if isinstance(self.ours, StudyGrades) else most
                label = f"{title} ({graded} of {most} episodes)" if graded < most else title
                rows.append(
                    TableRow((label,), tuple(self.variant_cell(name, tuple(robots), m) for m in metrics), baseline=True)
                )
        return [*_keep_graded(rows), *self.truth((TRUE,), [(robots, metric) for metric in metrics])]

    def _most_episodes(self, robots: Sequence[str]) -> int:
        """Number of episodes of some robots on which the model was graded that was graded on most."""
        if not isinstance(self.ours, StudyGrades):
            return 0
        return max((self.ours.count_episodes(variant, robots) for variant in self.ours.variants), default=0)

    def truth(self, labels: tuple[str, ...], places: Sequence[tuple[Sequence[str], str]]) -> list[TableRow]:
        """Rows of the true video and of the truth through codecs, for the robots and metric of each column; empty if not
        graded.
        """
        rows = {TRUTH: labels}
        for name in self.ours.codec_truths if isinstance(self.ours, StudyGrades) else ():
            title = f"{BASELINES[CODEC_TRUTH]} ({name.partition(' ')[2]})"
            shown = tuple(title if label == TRUE else label for label in labels)
            rows[name] = shown if title in shown else (f"{labels[0]}, {title}", *labels[1:])
        cells = {name: tuple(self.variant_cell(name, tuple(robots), metric) for robots, metric in places) for name in rows}
        return _keep_graded([TableRow(shown, cells[name], baseline=True) for name, shown in rows.items()])

    def note(self, part: str, rows: Iterable[tuple[str, str, str]]) -> str:
        """Note on what a section lacks, or ''; its rows are given as key, robots and label."""
        if not isinstance(self.ours, StudyGrades):
            return ""
        found: dict[str, list[str]] = {}
        as_planned, as_paper = True, True
        for key, robots, label in rows:
            variant = find_variant(part, key)
            protocol = expected_counts(variant, robots=variant.graded_robots)
            paper = sum(protocol.get(robot, 0) for robot in pooled(variant, robots))
            planned = sum(self.planned.get(variant.name, {}).get(robot, 0) for robot in pooled(variant, robots)) or paper
            # A metric that is not defined for an episode lacks it; the episode is graded all the same.
            means = (self.ours.mean(part, key, robots, metric) for metric in self.ours.metrics)
            count = max((mean.count for mean in means if mean), default=0)
            as_planned, as_paper = as_planned and count == planned, as_paper and count == paper
            text = f"{count} of {paper if count == planned else planned} episodes" if count else "not run"
            found.setdefault(text, []).append(label)
        if as_paper:
            return ""
        word = "As planned, but smaller than the paper's protocol" if as_planned else "Incomplete"
        if len(found) == 1:
            return f"{word}: {next(iter(found))} in every row."
        parts = (f"{text[0].upper()}{text[1:]}: {'; '.join(names)}." for text, names in found.items())
        return f"{word}. {' '.join(parts)}"

    def variant_cell(self, model: str, robots: tuple[str, ...], metric: str) -> TableCell:
        """The mean of a variant, or of a baseline, on some robots, pooled; without the paper's value."""
        info = self.ours.metrics.get(metric)
        mean = self.ours.variant_mean(model, robots, metric) if isinstance(self.ours, StudyGrades) else None
        if info is None or mean is None:
            return TableCell()
        if model == TRUTH and metric == "psnr":
            return TableCell("exact", episodes=mean.count)
        return mean_cell(mean, info, self.ours.level)

    def _printed_cell(self, part: str, row: str, robots: str, metric: str) -> TableCell:
        text = self.paper.print(part, row, robots, metric) if self.paper else ""
        return TableCell(published=text, printed=float(text)) if text else TableCell()


def _keep_graded(rows: Sequence[TableRow]) -> list[TableRow]:
    return [row for row in rows if any(cell.episodes for cell in row.cells)]


def paired_verdict(grades: Grades, part: str, row: str, base: str, robots: str, metric: str) -> str:
    """Verdict on the paired difference of a row from another of its part, on the cells that all rows of the part have."""
    pair = paired_means(grades, part, row, base, robots, metric)
    if pair is None:
        return ""
    difference = combine(np.subtract, *pair)
    floor, info = grades.floor(robots, metric, (part, row), (part, base)), grades.metrics[metric]
    return statistics.verdict(difference.value, difference.interval(grades.level), floor, info.higher_is_better)


def mean_cell(mean: Mean, metric: MetricInfo, level: float) -> TableCell:
    """A mean and its interval at this level."""
    ends = interval_ends(mean, level)
    text, between = format_number(mean.value, metric), format_interval(ends, metric)
    return TableCell(text, between, value=mean.value, low=ends[0], high=ends[1], episodes=mean.count)


def interval_ends(mean: Mean, level: float) -> tuple[float, float]:
    """Ends of a mean's interval; NaN where there are too few scenes, or where none is known (the paper)."""
    return mean.interval(level) if mean.scenes is not None else (np.nan, np.nan)
