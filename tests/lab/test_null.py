"""Claims asked of studies in which there is nothing to find: at most one in twenty is answered falsely, either way."""

from functools import cache
from pathlib import Path

import pytest

from lab import null
from lab.null import ANCHORS, HEAD, SPREADS, Args, Null, Rates, format_rates, main, measure, nulls

ROOT = Path(__file__).parents[2]
KINDS = {kind.title: kind for kind in nulls()}
STUDIES = 40


@cache
def rates(title: str) -> Rates:
    return measure(KINDS[title], STUDIES, scenes=18, draws=199)


@pytest.mark.parametrize(
    "title",
    [
        "robots of unequal difficulty",
        "runs differ by 2 %; three of three variants",
        "runs differ by 5 %; one of each variant",
        "runs differ by 5 %; three of three variants",
        "runs differ by 5 %; one, two and three in turn",
        "runs differ by 5 %, mostly by their seed; one, two and three in turn",
    ],
)
def test_equal_variants_are_rarely_told_apart(title: str) -> None:
    """Rates are means over claims; one claim's own rate may be three standard errors above."""
    found = rates(title)
    assert found.holds <= 0.05 and found.fails <= 0.05 and found.family_errors <= 0.05, format_rates(found)
    largest = max(*found.false_holds.values(), *found.false_fails.values())
    assert largest <= 0.05 + 3 * (0.05 * 0.95 / STUDIES) ** 0.5, format_rates(found)
    assert len(found.false_holds) >= 22 and len(found.false_fails) >= 19


def test_runs_are_given_in_turn_and_anchors_have_more() -> None:
    names = ["a", ANCHORS[0], "b", "c"]
    assert list(Null("", (1, 2), repeated=3).runs_of(names).values()) == [1, 3, 1, 2]
    assert len(KINDS) == 18 and {kind.spread for kind in KINDS.values()} == {0.0, *SPREADS}


def test_a_claim_that_is_true_of_equals_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    found = measure(Null("little noise"), 5, scenes=18, draws=99)
    assert "views saturate" not in found.false_holds and "views saturate" in found.false_fails
    assert "flow gains much" not in found.false_fails and found.false_holds["flow gains much"] == 0
    monkeypatch.setattr(null, "TRUE_OF_EQUALS", {})
    assert measure(Null("little noise"), 5, scenes=18, draws=99).false_fails["flow gains much"] == 1


def test_the_command_prints_the_table_of_the_page(capsys: pytest.CaptureFixture) -> None:
    main(Args(studies=1, scenes=12, draws=49))
    text = capsys.readouterr().out
    titles = [line.split(" | ")[0].strip("| ") for line in text.removeprefix(HEAD).splitlines()[1:]]
    page = (ROOT / "docs" / "report.md").read_text()
    table = page[page.index(HEAD) + len(HEAD) :].split("\n\n")[0]
    assert titles == list(KINDS) == [line.split(" | ")[0].strip("| ") for line in table.splitlines()[1:]]
    assert max(float(line.split(" | ")[3].partition(" %")[0]) for line in table.splitlines()[1:]) <= 5
