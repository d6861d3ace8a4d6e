"""Counts of what the tests of faults have tried, printed at the end: a test tells them by the property `tried CLASS`."""

from collections import Counter

import pytest

TRIED: Counter[str] = Counter()
TOLD = "tried "
"""Beginning of the names of properties that count; a test without any has tried one case of its file."""


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.when != "call" or "tests/faults/" not in report.nodeid or report.skipped:
        return
    told = {name.removeprefix(TOLD): int(str(value)) for name, value in report.user_properties if name.startswith(TOLD)}
    TRIED.update(told or {report.nodeid.partition("::")[0].rpartition("/")[2].removesuffix(".py"): 1})


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if TRIED:
        terminalreporter.section("faults tried")
        for kind, count in sorted(TRIED.items()):
            terminalreporter.write_line(f"{kind}: {count}")
        terminalreporter.write_line(f"all together: {TRIED.total()}")
