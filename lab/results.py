"""Makes what docs/results publishes again from the committed scores: tables, sentences and charts.

Reads  docs/results/<name>/scores.parquet and, where they are there, distances/, shifted/ and scores.curves.parquet
Writes <name>/tables/*.csv and *.png that are published already, and tables/sentences.txt

    python -m lab.results [six_tasks remedies]

Every chart carries its numbers, so a test can compare them with the scores; those by frame do not. These are left as they are
where the scores by frame are not there: they are in the commit that a page names.
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro
from PIL import Image, PngImagePlugin

from xew.analysis import report
from xew.config import ConfigError, user_errors
from xew.files import read_text, write_bytes, write_text

RESULTS = Path(__file__).parents[1] / "docs" / "results"
OTHER_MOTION = {"own_motion": "six_tasks"}
"""Folder with the same study in the other kind of motion."""
COLORS = 128
"""Number of colors of a published chart, which makes its file a third as large."""
BY_FRAME = "frames_"
"""How the names of charts by frame begin, whose numbers are more than their pixels."""
NUMBERS = "numbers"
"""Key of the text of a chart's file that has its numbers, as CSV."""


@dataclass(frozen=True)
class Args:
    """Make the tables, sentences and charts of docs/results again."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Folders below docs/results; default: all with scores."""


@user_errors
def main(args: Args) -> None:
    """Write what is published again."""
    for folder in find_folders(args.names):
        with TemporaryDirectory() as out:
            make_report(folder, Path(out))
            publish(folder, Path(out))


def find_folders(names: tuple[str, ...] = ()) -> list[Path]:
    """The folders of results by these names, or all. Raises ConfigError for a name without scores."""
    known = sorted(path.parent for path in RESULTS.glob("*/scores.parquet"))
    for name in names:
        if RESULTS / name not in known:
            raise ConfigError(f"{RESULTS / name} has no scores.parquet; there are {', '.join(path.name for path in known)}.")
    return [folder for folder in known if not names or folder.name in names]


def make_report(folder: Path, out: Path) -> None:
    """Write the report on the scores of one folder, by the command that its page names."""
    distances, other = folder / "distances", OTHER_MOTION.get(folder.name)
    report.main(
        report.Args(
            folder / "scores.parquet",
            distances=distances if distances.is_dir() else None,
            other_motion=RESULTS / other / "scores.parquet" if other else None,
            shifted=tuple(sorted((folder / "shifted").glob("*.parquet"))),
            out=out,
        )
    )


def published_charts(folder: Path, out: Path) -> Iterator[tuple[Path, Path]]:
    """The charts that a folder publishes, each with the one of the report in `out`, where that has it."""
    for path in sorted(folder.glob("*.png")):
        if (made := out / "figures" / path.name).exists():
            yield path, made


def read_sentences(out: Path) -> list[str]:
    """The sentences of a report."""
    return [line for line in read_text(out / "report.md").splitlines() if line.startswith("- ")]


def publish(folder: Path, out: Path) -> None:
    """Replace what a folder publishes by what the report in `out` has."""
    for table in (folder / "tables").glob("*.csv"):
        write_bytes(table, (out / "tables" / table.name).read_bytes(), within=folder)
    write_text(folder / "tables" / "sentences.txt", "\n".join(read_sentences(out)) + "\n", within=folder)
    for path, made in published_charts(folder, out):
        write_bytes(path, compress_chart(made), within=folder)


def compress_chart(path: Path) -> bytes:
    """A chart's PNG in few colors, with the numbers of the CSV file beside it as a text, except for charts by frame."""
    numbers, file = PngImagePlugin.PngInfo(), io.BytesIO()
    if not path.name.startswith(BY_FRAME):
        numbers.add_itxt(NUMBERS, read_text(path.with_suffix(".csv")), zip=True)
    image = Image.open(path).convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)
    image.save(file, "png", optimize=True, pnginfo=numbers)
    return file.getvalue()


if __name__ == "__main__":
    main(tyro.cli(Args, prog="python -m lab.results"))
