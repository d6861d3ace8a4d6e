"""Noise floors of metrics, and the verdict on a paired difference: better, worse or unresolved.

A metric that needs an estimator does not give even the true video its best score. By how much it misses its best there, on the
mean over the same robots' episodes, is the metric's noise floor, and a difference that is no larger is unresolved, whatever its
interval says. What a model shows has gone through its codec: where the true video was graded through that, as the baseline
CODEC_TRUTH, it takes the true video's place. Metrics that compare pixels directly have a floor of 0. An estimated metric whose
ground truth was not graded has no floor (NaN), and nothing is resolved by it.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

from xew.protocol import CODEC_TRUTH, GROUND_TRUTH

BETTER, WORSE, UNRESOLVED = "better", "worse", "unresolved"


def verdict(difference: float, ends: tuple[float, float], floor: float, higher_is_better: bool) -> str:
    """Whether the first of two models is better or worse than the second, by the mean of their paired differences.

    Unresolved is what the interval does not tell from 0, what lies within the noise floor, and what has no interval or floor.

    Args:
        difference: the mean.
        ends: of its interval; NaN where there is none (too few scenes).
        floor: noise floor of the metric; NaN where it is not known.
        higher_is_better: of the metric.
    """
    low, high = ends
    resolved = (low > 0 or high < 0) and abs(difference) > floor
    return UNRESOLVED if not resolved else BETTER if (difference > 0) == higher_is_better else WORSE


def noise_floor(truth: float | None, best: float | None, estimated: bool) -> float:
    """By how much a metric misses its best on the ground truth; NaN where that is not known.

    Args:
        truth: mean score of the true video; None where it was not graded.
        best: the metric's best value; None where it has none.
        estimated: whether the metric needs an estimator.
    """
    if not estimated:
        return 0.0
    if truth is None or best is None or not math.isfinite(best):
        return math.nan
    return abs(truth - best)


def floor_sources(model: str, codecs: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    """Baselines, as model and condition, of which the noise floor of a model or variant is.

    Args:
        model: its name.
        codecs: attribute `codecs` of a score table: by model or variant, the conditions of the truth through its codec.
    """
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
