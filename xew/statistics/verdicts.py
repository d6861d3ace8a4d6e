"""Noise floors of metrics, and the verdict on a paired difference: better, worse or unresolved.

An estimated metric does not give even the true video its best score. This difference, on the mean over the same robots'
episodes, is the metric's noise floor; smaller differences are unresolved. Truth graded through a model's codec (CODEC_TRUTH)
replaces the true video. Metrics that compare pixels have a floor of 0; without a graded truth it is NaN and nothing is
resolved.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

from xew.protocol import CODEC_TRUTH, GROUND_TRUTH

BETTER, WORSE, UNRESOLVED = "better", "worse", "unresolved"


def verdict(difference: float, ends: tuple[float, float], floor: float, higher_is_better: bool) -> str:
    """Verdict on the first of two models, by the mean of their paired differences and the ends of its interval.

    It is unresolved if the interval contains 0, the difference is within the noise floor, or interval or floor is NaN.
    """
    low, high = ends
    resolved = (low > 0 or high < 0) and abs(difference) > floor
    return UNRESOLVED if not resolved else BETTER if (difference > 0) == higher_is_better else WORSE


def noise_floor(truth: float | None, best: float | None, estimated: bool) -> float:
    """Difference between a metric's best and its score of the true video; 0 if it is not estimated, NaN if unknown."""
    if not estimated:
        return 0.0
    if truth is None or best is None or not math.isfinite(best):
        return math.nan
    return abs(truth - best)


def floor_sources(model: str, codecs: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    """Baselines, as model and condition, that set the noise floor of a model; `codecs` is the score table's attribute."""
    return [(CODEC_TRUTH, key) for key in codecs.get(model, ())] or [(GROUND_TRUTH, "")]


def largest_floor(floors: Iterable[float]) -> float:
    """The largest of several floors, which counts where two models are compared; NaN where one is not known."""
    known = list(floors)
    return math.nan if any(map(math.isnan, known)) else max(known, default=0.0)


def describe_floors(models: Sequence[str], codecs: Mapping[str, Sequence[str]]) -> str:
    """Sentence that says what the noise floors of some models are of: the note of a table."""
    by_key: dict[tuple[str, ...], list[str]] = {}
    for model in models:
        by_key.setdefault(tuple(codecs.get(model, ())), []).append(model)
    without = by_key.pop((), [])
    blurred = "the true video after a blur, because the truth was not graded through a codec"
    if not by_key:
        return f"Noise floors come from {blurred}." if without else ""
    if not without and len(by_key) == 1:
        return f"Noise floors come from the truth through the models' {' and '.join(next(iter(by_key)))}."
    parts = [f"the truth through {' and '.join(key)} (for {', '.join(names)})" for key, names in by_key.items()]
    parts += [f"{blurred} (for {', '.join(without)})"] if without else []
    return f"Noise floors come from {'; '.join(parts)}."
