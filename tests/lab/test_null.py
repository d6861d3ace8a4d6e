"""Claims asked of studies in which there is nothing to find: at most one in twenty is answered falsely, either way."""

from functools import cache

import pytest

from lab import null
from lab.null import Args, Null, Rates, format_rates, main, measure, nulls

EQUAL, SEVERAL, UNEQUAL, ONE = nulls(trainings=3, spread=0.02)


@cache
def rates(kind: Null, studies: int = 200) -> Rates:
    return measure(kind, studies, scenes=18, draws=399)


@pytest.mark.parametrize("kind", [EQUAL, SEVERAL, UNEQUAL], ids=["equal", "trainings", "robots"])
def test_equal_variants_are_rarely_told_apart(kind: Null) -> None:
    """Rates are means over claims; 3 % is two standard errors of one claim's own rate over 200 studies."""
    found = rates(kind)
    assert found.holds <= 0.05 and found.fails <= 0.05 and found.family_errors <= 0.05, format_rates(found)
    assert max(found.false_holds.values()) <= 0.05 + 0.03 and max(found.false_fails.values()) <= 0.05 + 0.03, format_rates(
        found
    )
    assert len(found.false_holds) >= 22 and len(found.false_fails) >= 19


def test_one_training_is_told_from_another() -> None:
    """What "of this training" warns of: its interval does not know what another training would give."""
    assert rates(ONE, 20).fails > 2 * rates(SEVERAL).fails + 0.05


def test_a_claim_that_is_true_of_equals_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    found = measure(Null("little noise"), 5, scenes=18, draws=99)
    assert "views saturate" not in found.false_holds and "views saturate" in found.false_fails
    assert "flow gains much" not in found.false_fails and found.false_holds["flow gains much"] == 0
    monkeypatch.setattr(null, "TRUE_OF_EQUALS", {})
    assert measure(Null("little noise"), 5, scenes=18, draws=99).false_fails["flow gains much"] == 1


def test_the_command_prints_a_line_for_each_kind(capsys: pytest.CaptureFixture) -> None:
    main(Args(studies=2, scenes=12, draws=99))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and all("false holds" in line and "of 2 studies" in line for line in lines)
