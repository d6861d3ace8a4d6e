"""Tables of the report that are too wide for its page."""

import re

import pytest

from xew.analysis.reports import page
from xew.analysis.tables.table import Column, Table, TableCell, TableRow, TableSection


def make_table(groups: dict[str, int]) -> Table:
    """A table of two rows with so many columns under each title; each value is the number of its row and column."""
    columns = tuple(Column(f"m{number}", title) for title, count in groups.items() for number in range(count))
    rows = tuple(
        TableRow((f"model {row}",), tuple(TableCell(f"{row}.{place:02d}") for place in range(len(columns)))) for row in (1, 2)
    )
    return Table("t", "Title", "Caption", ("model",), columns, (TableSection("Panda", rows, "2 of 3 episodes"),))


@pytest.mark.parametrize(
    ("groups", "widths", "titles"),
    [
        (
            {"visual": 3, "morphology": 4, "kinematics": 9, "objects": 4},
            [7, 9, 4],
            [["visual", "morphology"], ["kinematics"], ["objects"]],
        ),
        ({"visual": 3, "morphology": 4}, [7], [["visual", "morphology"]]),
        ({"all": page.MOST_COLUMNS + 2}, [page.MOST_COLUMNS + 2], [["all"]]),
        ({"": page.MOST_COLUMNS + 2}, [page.MOST_COLUMNS + 2], [[]]),
        ({"a": page.MOST_COLUMNS, "b": 1}, [page.MOST_COLUMNS, 1], [["a"], ["b"]]),
    ],
)
def test_a_wide_table_goes_on_below_with_whole_groups(
    groups: dict[str, int], widths: list[int], titles: list[list[str]]
) -> None:
    """Every value stands once and in its order, beside the label of its row; title and caption stand once."""
    markup = page.table(make_table(groups))
    parts = re.findall("<table>.*?</table>", markup, re.DOTALL)
    assert [re.findall(r'<th colspan="\d+">(\w+)</th>', part) for part in parts] == titles
    assert all(part.count("model 1") == part.count("model 2") == part.count("2 of 3 episodes") == 1 for part in parts)
    values = [re.findall(r'class="mean">([\d.]+)<', part) for part in parts]
    assert [len(part) // 2 for part in values] == widths
    for row in ("1", "2"):
        found = [value for part in values for value in part if value.startswith(row)]
        assert found == [f"{row}.{place:02d}" for place in range(sum(groups.values()))]
    assert markup.count("<h3>Title</h3>") == markup.count("Caption") == 1
