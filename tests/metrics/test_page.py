"""docs/metrics.md: its code is run from top to bottom, what it prints is what it says, and its table names all metrics."""

import contextlib
import io
import re
from pathlib import Path

from xew.metrics import METRICS

PAGE = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text()
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SAID = re.compile(r"^print\(.*\)  # (.*)$|^# (.*)$", re.MULTILINE)


def test_examples_print_what_they_say() -> None:
    names: dict = {}
    blocks = BLOCK.findall(PAGE)
    assert len(blocks) > 10
    for block in blocks:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(block, "docs/metrics.md", "exec"), names)
        said = [first or second for first, second in SAID.findall(block)]
        assert printed.getvalue().splitlines() == said, block


def test_the_table_names_all_metrics() -> None:
    rows = [line.split("|")[1:3] for line in PAGE.splitlines() if line.startswith("| `")]
    named = {name: dimension.strip() for cell, dimension in rows for name in re.findall(r"`(\w+)`", cell)}
    assert named == {name: metric.dimension for name, metric in METRICS.items()}
