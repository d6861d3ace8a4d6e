"""What a training starts from: random parameters, published weights, another run's, or its own latest checkpoint."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from flax import nnx

from xew.model.network.blocks import choose_attention
from xew.model.network.dit_layouts import check_dit, load_dit_params
from xew.model.runs.checkpoint import TrainState, damaged, restore_state, restore_sum
from xew.model.runs.lineage import trace_start
from xew.model.runs.session import Session
from xew.model.settings.network import Network
from xew.model.training.step import Learner


def check_network(network: Network) -> None:
    """Raise ConfigError if the network cannot be computed here as asked, or its published weights do not fit."""
    settings = network.settings
    if settings.weights is not None:
        check_dit(nnx.eval_shape(network.create), settings.weights)
    choose_attention(settings.attention, network.size.head_dim, jnp.dtype(settings.dtype))


def begin_state(learner: Learner, start_from: Path | None, session: Session, batches: Any) -> TrainState:
    """Make the state of step 0, or restore that of the latest checkpoint with the position of the data.

    Args:
        start_from: the run that is adapted, if any.
        batches: the iterator of batches, which goes on where it was left.
    """
    resumed = session.step > 0
    params = start_params(learner, start_from, session.out) if not resumed or learner.learning.lora_rank else None
    if not resumed:
        return learner.init_state(params)
    state, position = restore_state(session.checkpoints, learner.shapes)
    try:
        batches.set_state(position)
    except Exception as error:  # of whatever library the position comes from
        raise damaged(session.out, session.step, ("data",), f"the position of the data is none: {error}") from error
    return replace(state, base=params)


def start_params(learner: Learner, start_from: Path | None, out: Path) -> Any:
    """Parameters of step 0, placed on the mesh: those of the run to adapt, published weights, or None for random ones."""
    weights = learner.learning.network.settings.weights
    if start_from is not None:
        return restore_sum(trace_start(out, start_from), learner.network_shapes)[0]
    return None if weights is None else load_dit_params(*learner.random_network(), weights)
