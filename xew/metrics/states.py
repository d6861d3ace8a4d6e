"""Metrics by parts: states that are made of parts of a video and merged, so that no split and no order changes a number.

    ssim = STATES["ssim"]
    state = ssim.init()
    for prediction, target in parts:
        state = ssim.update(state, prediction, target)
    ssim.compute(state)                    # what the whole video gives

A state is a tree of integers; sums of floats are exact, so `merge` is associative and commutative to the last bit. Any split
into batches, any number of hosts and any order give the same bits, as long as a frame's own value does not depend on the
batch that it is computed in. On a CPU it does not; on a GPU, convolutions of other batch sizes may round a frame's LPIPS
otherwise in its last digit. NaN in any part makes the whole NaN, as it does for the function of the whole video. All functions
are pure and work under jit; `lax.scan` can carry a state.
"""

import jax
import jax.numpy as jnp

from xew.metrics import METRICS
from xew.metrics.mergeable.sums import LIMBS, Mean, Mergeable, empty_mean, mean_of, mean_over, merge_means
from xew.metrics.metric import Metric

__all__ = ["LIMBS", "MEAN", "STATES", "Mean", "Mergeable", "derive_state", "empty_mean", "mean_of", "merge_means"]


def derive_state(metric: Metric) -> Mergeable:
    """The states of a metric: its own, else the mean of its parts, else the mean of its values by frame."""
    if metric.state is not None:
        return metric.state
    if metric.parts is not None:
        return mean_over(metric.parts)
    curve = metric.curve or jax.vmap(lambda *frame: metric.function(*(array[None] for array in frame)))
    return mean_over(lambda *inputs, **options: (curve(*inputs, **options), None))


STATES = {name: derive_state(metric) for name, metric in METRICS.items()}
"""States by the names of METRICS.

The parts are the frames of one video, with three remarks. `region_lpips` needs the box of the whole video:
`update(state, prediction, target, mask, box=union_box(all_masks))`. A path cannot be cut, so `ndtw` takes all frames at once,
and its state is the mean over keypoints of several such. States of several videos, merged, are means over all their frames or
points; for the mean over videos, each counting the same, give one number a video to MEAN.
"""

MEAN = mean_over(lambda values: (values, jnp.isfinite(values)))
"""States of the mean of numbers [n], such as a score for each video. NaN, the score without a valid point, is not counted."""
