"""The initial state of a run: random parameters, published weights, another run's, or its own latest checkpoint."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from xew.model.network.dit_layouts import load_dit_params
from xew.model.runs.checkpoint import TrainState, damaged, restore_state, restore_sum
from xew.model.runs.folder import trace_start
from xew.model.runs.session import Session
from xew.model.training.step import Trainer


def begin_state(trainer: Trainer, start_from: Path | None, weights: Path | None, session: Session, batches: Any) -> TrainState:
    """Make the state of step 0 or restore the latest checkpoint with the position of the data.

    The network starts from the run to adapt, published weights or random parameters.
    """
    resumed = _resume(session, trainer.shapes, batches) if session.step > 0 else None
    if resumed is not None and not trainer.spec.lora_rank:
        return resumed
    params = None
    if start_from is not None:
        params, _ = restore_sum(trace_start(session.out, start_from), trainer.network_shapes)
    elif weights is not None:
        params = load_dit_params(*trainer.random_network(), weights)
    return trainer.init_state(params) if resumed is None else replace(resumed, base=params)


def _resume(session: Session, shapes: TrainState, batches: Any) -> TrainState:
    """Restore the latest checkpoint and the position of the batches."""
    state, position = restore_state(session.checkpoints, shapes)
    try:
        batches.set_state(position)
    except Exception as error:  # Grain raises many types
        raise damaged(session.out, session.step, ("data",), f"the position of the data is invalid: {error}") from error
    return state
