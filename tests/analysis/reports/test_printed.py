"""The printed report: tables whole, folded blocks open, headings on the sheet of what they head."""

import base64
import io
from pathlib import Path

import pytest
from PIL import Image

from tests.analysis.reports.browser import needs_chromium
from tests.analysis.reports.printed import print_page
from xew.analysis.reports.page import details, labeled_picture, page, paragraph, section
from xew.analysis.reports.page import table as table_markup
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection

COLUMNS = 12
ROWS = 45
"""Number of rows; more than a sheet holds."""
SECTIONS = 7
"""Number of sections with a picture; in a row they would part heading and picture somewhere."""


def cell(row: int, column: int) -> TableCell:
    return TableCell(
        f"{row}.{column:02}7", interval=f"{row}.{column:02}1–{row}.{column:02}9", published="0.123", verdict="better"
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    columns = tuple(Column(f"Metric{i} [px] ↑", "Kinematics" if i < 8 else "Objects") for i in range(COLUMNS))
    rows = tuple(TableRow((f"row{i}", "with action"), tuple(cell(i, j) for j in range(COLUMNS))) for i in range(ROWS))
    wide = Table("wide", "All metrics", "By robot.", ("model", "variant"), columns, (TableSection("UR5", rows),))
    buffer = io.BytesIO()
    Image.new("RGB", (900, 330), "gray").save(buffer, "PNG")
    source = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
    parts = [section("Tables", table_markup(wide)), details("Definitions", paragraph("Folded words."))]
    for i in range(SECTIONS):
        picture = labeled_picture(source, f"caption{i}.", ("first", "last"), ("truth", "model"))
        before = [paragraph("Before it. " * (i * 20))] if i else []
        parts.append(section(f"Pictures{i}", *before, picture))
    path = tmp_path_factory.mktemp("printed") / "index.html"
    path.write_text(page("A report", ["It holds."], parts, "the end"))
    return path


@needs_chromium
@pytest.mark.parametrize("sheet", ["", "A4"])
def test_a_printed_report_is_whole(report: Path, sheet: str) -> None:
    """On the sheet that the page asks for, which is wide, and on an upright one."""
    sheets = print_page(report, sheet)
    text = "".join(sheets)
    heads = [f"Metric{i}[px]↑" for i in range(COLUMNS)]
    values = [f"{i}.{j:02}{digit}" for i in range(ROWS) for j in range(COLUMNS) for digit in (1, 7, 9)]
    assert [word for word in [*heads, *values, "Kinematics", "Objects", "Foldedwords.", "theend"] if word not in text] == []
    for i in range(SECTIONS):
        (of_heading,) = (number for number, words in enumerate(sheets) if f"Pictures{i}" in words)
        assert f"caption{i}." in sheets[of_heading] or "Beforeit." in sheets[of_heading].partition(f"Pictures{i}")[2]
        (of_caption,) = (number for number, words in enumerate(sheets) if f"caption{i}." in words)
        assert "truthmodel" in sheets[of_caption].partition(f"caption{i}.")[2], "the rows' names stand beside the picture"
