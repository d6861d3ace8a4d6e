"""The first sentence of a report: what it says of each verdict, and which baseline it names."""

import pytest

from xew.analysis.reports.answer import Contest, answer
from xew.protocol import COPY_FIRST_FRAME, PASTED_RENDER
from xew.statistics import BETTER, UNRESOLVED, WORSE


def contest(robot: str, verdict: str, baseline: str = PASTED_RENDER) -> Contest:
    return Contest(robot, baseline, verdict, {"best model": (0.1, 0.09, 0.11), "other": (0.2, 0.19, 0.21)})


@pytest.mark.parametrize(
    ("verdicts", "head"),
    [
        ((BETTER, BETTER), "Yes"),
        ((WORSE, WORSE), "No"),
        ((UNRESOLVED, UNRESOLVED), "Unresolved"),
        ((BETTER, WORSE), "In part"),
        ((BETTER, UNRESOLVED), "In part"),
        ((WORSE, UNRESOLVED), "No"),
    ],
)
def test_the_first_word(verdicts: tuple[str, ...], head: str) -> None:
    contests = [contest(robot, verdict) for robot, verdict in zip(("Franka (Panda)", "Piper"), verdicts, strict=True)]
    assert answer(contests, None).sentence.startswith(f"{head}: by LPIPS, the best model is ")


def test_an_unresolved_difference_is_not_called_equal_and_each_robot_keeps_its_baseline() -> None:
    contests = [contest("Franka (Panda)", UNRESOLVED), contest("Piper", BETTER, COPY_FIRST_FRAME)]
    assert answer(contests, None).sentence == (
        "In part: by LPIPS, the best model is better than the frozen first frame on Piper, "
        "and not resolved from the paste baseline on Franka (Panda)."
    )
