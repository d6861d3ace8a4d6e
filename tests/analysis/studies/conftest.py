"""A study of the smallest config, for tests whose steps cost nothing."""

from pathlib import Path

import pytest

from tests.analysis.studies.chains import ROOT
from xew.analysis.studies import ledger as study_ledger
from xew.analysis.studies import merge, processes, rates
from xew.analysis.studies.config import Study, load_study


@pytest.fixture(autouse=True)
def documented_rates(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Estimates by documented rates, whatever was measured on this machine."""
    monkeypatch.setattr(rates, "rates_path", lambda: tmp_path / "no_rates.json")


@pytest.fixture
def cheap_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps make one file each, whatever stage they claim to be, and need no model; what real ones find imported is at work in
    test_study_debug.py."""
    monkeypatch.chdir(ROOT)
    for module in (study_ledger, merge):
        monkeypatch.setattr(module, "digest_product", lambda kind, product: study_ledger._digest_file(product))
    monkeypatch.setattr(processes, "PRELOADED", ())


@pytest.fixture
def study(tmp_path: Path, cheap_steps: None) -> Study:
    return load_study(ROOT / "configs" / "study_debug.yaml", ["--out", str(tmp_path)])
