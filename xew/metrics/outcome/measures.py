"""Measures of outcomes: accuracy and progress error of single videos, and retrieval among the command variants of a scene.

Progress is a number in [0, 1] that a task defines from states (`xew.sim_warp.tasks.Task.progress`); it is 1 exactly where the
task is solved.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from xew.metrics.metric import AnyArray, ByFrame, Scalar, check_arrays, check_first

Progress: TypeAlias = Float[AnyArray, " t"]
"""Progress in [0, 1] at each moment; NaN where a judge says nothing."""
Distances: TypeAlias = Float[AnyArray, " k"]
"""Distances from the truths of the k command variants of a scene, a counterfactual set."""

SHOWN = 0.95
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


@check_first(check_progress)
@jax.jit
def hallucinated_success(prediction: Progress, target: Progress, shown: float | jax.Array = SHOWN) -> Scalar:
    """Share of the simulator's failures that a video shows as success, in [0, 1]; 0 is best.

    Args:
        prediction, target, shown: as of `outcome_accuracy`.

    Returns:
        Scalar float32; NaN where no target is a failure.
    """
    values, counts = hallucinated_success_parts(prediction, target, shown)
    return jnp.sum(jnp.where(counts, values, 0)) / jnp.sum(counts).astype(jnp.float32)


@check_first(check_progress)
@jax.jit
def hallucinated_success_frames(prediction: Progress, target: Progress) -> ByFrame:
    """`hallucinated_success` of progress [t] before the mean, [t] float32; NaN where the target is a success."""
    values, counts = hallucinated_success_parts(prediction, target)
    return jnp.where(counts, values, jnp.nan)


@check_first(check_progress)
@jax.jit
def hallucinated_success_parts(
    prediction: Progress, target: Progress, shown: float | jax.Array = SHOWN
) -> tuple[ByFrame, Bool[jax.Array, " t"]]:
    """Values [t] float32 that `hallucinated_success` is the mean of, and [t] bool, which count."""
    return 1 - outcome_accuracy(prediction, target, shown), ~(jnp.asarray(target, jnp.float32) >= 1)


@check_first(check_progress)
@jax.jit
def retrieval(prediction: Distances, target: Distances) -> Scalar:
    """Whether a prediction is nearest to the truth of its own commands: 1, or 1/n if it is equally near to n truths, else 0.

    Args:
        prediction: [k] distances of the prediction from the truths of k command variants of its scene.
        target: [k] distances of its own truth from the same truths, or any numbers of which the least says which one is its
            own.

    Returns:
        Scalar float32; NaN where a distance is.
    """
    value, _ = retrieval_parts(prediction, target)
    return value


@check_first(check_progress)
@jax.jit
def retrieval_parts(prediction: Distances, target: Distances) -> tuple[Scalar, Bool[jax.Array, ""]]:
    """The value that `retrieval` of distances [k] is, scalar float32, and that it counts, scalar bool."""
    predicted, true = jnp.asarray(prediction, jnp.float32), jnp.asarray(target, jnp.float32)
    nearest = predicted == jnp.min(predicted)
    share = jnp.where(nearest[jnp.argmin(true)], 1 / jnp.sum(nearest, dtype=jnp.float32), 0)
    return jnp.where(jnp.isnan(predicted + true).any(), jnp.nan, share), jnp.bool_(True)


def check_distances(distances: Any) -> None:
    """Raise ValueError or TypeError unless distances are floating [k k]."""
    check_arrays(distances=distances)
    if np.ndim(distances) != 2 or len(set(np.shape(distances))) != 1:
        raise ValueError(f"distances are {np.shape(distances)}, expected [k k]: of each prediction from each truth of a scene.")
    if not jnp.issubdtype(jnp.result_type(distances), jnp.floating):
        raise TypeError(f"distances have dtype {jnp.result_type(distances)}, expected floating.")


@check_first(check_distances)
@jax.jit
def counterfactual_retrieval(distances: Float[AnyArray, "k k"]) -> Scalar:
    """Share of predictions that are nearest to the truth of their own commands, higher is better; chance is 1/k.

    It is the mean of `retrieval` over a whole counterfactual set.

    Args:
        distances: [k k] of prediction i (row) from truth j (column), for k command variants of one scene and robot.

    Returns:
        Scalar float32; NaN where a distance is.
    """
    rows = jnp.asarray(distances, jnp.float32)
    return jnp.mean(jax.vmap(retrieval)(rows, 1 - jnp.eye(len(rows))))
