"""Measures of outcomes: accuracy and progress error of single videos, and retrieval among the command variants of a scene.

Progress is a number in [0, 1] that a task defines from states (`xew.sim_warp.tasks.Task.progress`); it is 1 exactly where the
task is solved.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from xew.metrics.metric import AnyArray, ByFrame, Scalar, check_arrays, check_first

Progress: TypeAlias = Float[AnyArray, " t"]
"""Progress in [0, 1] at each moment; NaN where a judge says nothing."""
Distances: TypeAlias = Float[AnyArray, "k k"]
"""Distance of each prediction (row) from each truth (column) of a counterfactual set."""

SHOWN = 0.8
"""Judged progress from which on a video shows success, chosen on validation scenes by the rule of docs/metrics.md."""


def check_progress(prediction: Any, target: Any) -> None:
    """Raise ValueError or TypeError unless both are floating [t] of one shape."""
    check_arrays(prediction=prediction, target=target)
    if np.shape(prediction) != np.shape(target) or np.ndim(target) != 1:
        raise ValueError(
            f"progress is {np.shape(prediction)} and {np.shape(target)}, expected one shape [t]; of a batch use jax.vmap."
        )
    for name, array in (("prediction", prediction), ("target", target)):
        if not jnp.issubdtype(jnp.result_type(array), jnp.floating):
            raise TypeError(f"{name} has dtype {jnp.result_type(array)}, expected floating progress in [0, 1].")


@check_first(check_progress)
@jax.jit
def progress_error(prediction: Progress, target: Progress) -> ByFrame:
    """Absolute difference of progress, in [0, 1]; 0 is best.

    Args:
        prediction: [t] judged in predicted video. target: [t] of the simulator.

    Returns:
        [t] float32; NaN where one of the two is.
    """
    return jnp.abs(jnp.asarray(prediction, jnp.float32) - jnp.asarray(target, jnp.float32))


@check_first(check_progress)
@jax.jit
def outcome_accuracy(prediction: Progress, target: Progress, shown: float | jax.Array = SHOWN) -> ByFrame:
    """Agreement of judged success with the simulator's: 1 where both or neither is a success, else 0.

    Args:
        prediction, target: as of `progress_error`; a target of 1 is a success.
        shown: judged progress from which on a video shows success.

    Returns:
        [t] float32; NaN where one of the two is.
    """
    judged, true = jnp.asarray(prediction, jnp.float32), jnp.asarray(target, jnp.float32)
    agree = ((judged >= shown) == (true >= 1)).astype(jnp.float32)
    return jnp.where(jnp.isnan(judged + true), jnp.nan, agree)


def check_distances(distances: Any) -> None:
    """Raise ValueError or TypeError unless distances are floating [k k]."""
    check_arrays(distances=distances)
    if np.ndim(distances) != 2 or len(set(np.shape(distances))) != 1:
        raise ValueError(f"distances are {np.shape(distances)}, expected [k k]: of each prediction from each truth of a scene.")
    if not jnp.issubdtype(jnp.result_type(distances), jnp.floating):
        raise TypeError(f"distances have dtype {jnp.result_type(distances)}, expected floating.")


@check_first(check_distances)
@jax.jit
def counterfactual_retrieval(distances: Distances) -> Scalar:
    """Share of predictions that are nearest to the truth of their own commands, higher is better; chance is 1/k.

    A prediction that is equally near to n truths, its own among them, counts 1/n.

    Args:
        distances: [k k] of prediction i (row) from truth j (column), for k command variants of one scene and robot.

    Returns:
        Scalar float32; NaN where a distance is.
    """
    distances = jnp.asarray(distances, jnp.float32)
    nearest = distances == jnp.min(distances, axis=1, keepdims=True)
    share = jnp.where(jnp.diagonal(nearest), 1 / jnp.sum(nearest, axis=1, dtype=jnp.float32), 0)
    return jnp.where(jnp.isnan(distances).any(), jnp.nan, jnp.mean(share))
