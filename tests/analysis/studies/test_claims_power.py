"""How much data claims need: what more runs, scenes and bodies do, and the page that says it of our study."""

from pathlib import Path

import numpy as np
import pytest

from tests.analysis.synthetic_study import write_study
from xew.analysis.studies.power import BODIES, RUNS, Asked, format_power, power_of_r, power_of_two
from xew.analysis.study import main
from xew.config import ConfigError

ROOT = Path(__file__).parents[3]


def share(asked: Asked, more: float, runs: int) -> float:
    """Share of studies in which one number alone gets a verdict."""
    return float((asked.draw_p(np.random.default_rng(0), more, runs).min(axis=1) <= 0.05).mean())


def test_runs_help_where_runs_differ_and_scenes_where_scenes_do() -> None:
    between_runs = Asked(0.1, (0.0, np.inf), False, of_scenes=1e-5, of_runs=0.004, freedom=(30, 4))
    between_scenes = Asked(0.1, (0.0, np.inf), False, of_scenes=0.004, of_runs=1e-5, freedom=(30, 4))
    assert share(between_runs, 20, 3) < 0.5 < 0.9 < share(between_runs, 1, 8)
    assert share(between_scenes, 1, 8) < 0.5 < 0.9 < share(between_scenes, 20, 1)
    assert share(Asked(0.1, (0.0, np.inf), True, 0, 0, (30, 4)), 20, 8) == 0


def test_of_nothing_a_verdict_is_rare_and_an_equivalence_needs_little_noise() -> None:
    assert share(Asked(0.0, (0.0, np.inf), False, 0.004, 0.004, (30, 4)), 1, 3) <= 0.08
    calm, loud = (Asked(0.0, (-0.01, 0.01), False, variance, variance, (30, 4)) for variance in (1e-6, 1e-3))
    assert share(calm, 1, 5) > 0.9 and share(loud, 1, 5) < 0.1


def test_correlations_need_bodies() -> None:
    """By Fisher's z, of 64 bodies without any luck in their gaps: 0.98 at 2.5 % on either side."""
    assert power_of_r(0.5, 64, 1.0) == pytest.approx(0.98, abs=0.01)
    for power in (lambda n: power_of_r(0.5, n, 0.9), lambda n: power_of_two(0.6, 0.2, n, 0.9)):
        assert np.diff([power(count) for count in BODIES]).min() > 0
    assert power_of_r(0.5, 64, 0.5) < power_of_r(0.5, 64, 0.9)


UNRESOLVED_AT_FIRST = ["rays recover", "mask keeps outlines", "flow looks best", "views saturate", "render gains most"]
UNRESOLVED_AT_FIRST += ["only alignment closes the gap", "the frame flatters", "forgetting", "catastrophic forgetting"]
UNRESOLVED_AT_FIRST += ["pixel systems lead"]
"""Claims that scenes and runs can resolve and that the first rules did not."""


def test_the_page_has_what_the_command_prints() -> None:
    text = format_power(ROOT / "docs" / "results" / "six_tasks" / "scores.parquet")
    page = (ROOT / "docs" / "study.md").read_text()
    for scenes, lines in zip((36, 500), text.split(" scenes\n")[1:], strict=True):
        rows = {line[:36].strip(): line.split()[-5:] for line in lines.splitlines()}
        for runs in (3, 8):
            expected = sum(float(rows[name][RUNS.index(runs)]) for name in UNRESOLVED_AT_FIRST)
            assert f"| {runs} runs, {scenes} scenes | {expected:.1f} |" in page, expected
    for title, line in (("r = 0.5", "r = 0.5 with one"), ("r = 0.6 against 0.2", "r = 0.6 with one")):
        (found,) = (each.split()[-3:] for each in text.splitlines() if line in each)
        assert f"| {title}, over 32, 64 and 128 bodies | {', '.join(found)} |" in page
    expected = [line.split()[-5:] for line in text.splitlines() if "expected of 20 claims" in line]
    assert len(expected) == 2 and all(f"scenes | {' | '.join(numbers)} |" in page for numbers in expected)
    (found,) = (line.split()[-3:] for line in text.splitlines() if "r = 0.5" in line)
    assert f"{found[0]} over 32 bodies and {found[1]} over 64" in page


def test_a_dry_run_estimates_from_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("xew.analysis.study.check_configs", lambda paths: None)
    table = write_study(tmp_path / "scores.parquet")
    main(["configs/study_debug.yaml", "--dry-run", "--scores", str(table), "--out", str(tmp_path / "study")])
    said = capsys.readouterr().out
    assert "expected of" in said and "r = 0.5" in said and not (tmp_path / "study").exists()
    (tmp_path / "own").mkdir()
    table.write_bytes((ROOT / "docs" / "results" / "recipe" / "scores.parquet").read_bytes())
    table.rename(tmp_path / "own" / "scores.parquet")
    main(["configs/study_debug.yaml", "--dry-run", "--out", str(tmp_path / "own")])
    assert "is not of a study" in capsys.readouterr().out, "a study's own scores that tell nothing are no error"
    with pytest.raises(ConfigError, match="is not of a study"):
        format_power(ROOT / "docs" / "results" / "recipe" / "scores.parquet")
