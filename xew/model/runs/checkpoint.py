"""Checkpoints of a run (Orbax): written in the background, read on whatever devices there are."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from xew.config import ConfigError
from xew.files import checkpoint_time
from xew.model.devices.sharding import place_beside
from xew.model.network.lora import apply_lora, init_lora
from xew.model.runs.folder import START, load_run_config


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """The state of a training."""

    step: jax.Array
    """[] int32, number of optimizer steps taken."""
    params: Any
    optimizer: Any
    ema: Any = None
    """Moving average of the parameters, or None."""
    base: Any = None
    """Parameters that stay as they are and that `params` corrects (LoRA), or None; checkpoints do not hold them."""


def open_checkpoints(out: Path, keep: int = 1) -> ocp.CheckpointManager:
    """The checkpoints of a run, written in the background."""
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=True)
    return ocp.CheckpointManager((out / "checkpoints").absolute(), options=options)


def save_state(checkpoints: ocp.CheckpointManager, state: TrainState, data_position: dict[str, Any]) -> None:
    """Begin to write a checkpoint of the state, named by its step; nothing happens if it is there already.

    The state may be changed as soon as this returns. A checkpoint gets its name when it is complete.
    """
    step = int(state.step)
    if step in checkpoints.all_steps():
        return
    items = {"params": state.params, "optimizer": state.optimizer} | ({} if state.ema is None else {"ema": state.ema})
    saves = {name: ocp.args.StandardSave(tree) for name, tree in items.items()}
    checkpoints.save(step, args=ocp.args.Composite(data=ocp.args.JsonSave(data_position), **saves))


def restore_state(checkpoints: ocp.CheckpointManager, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """Restore the latest state and the position of the data.

    Args:
        like: arrays, or their shapes, types and shardings: where each is to lie, whatever devices saved it.
    """
    step = checkpoints.latest_step()
    items = {"params": like.params, "optimizer": like.optimizer} | ({} if like.ema is None else {"ema": like.ema})
    restores = {name: ocp.args.StandardRestore(_abstract(tree)) for name, tree in items.items()}
    restored = checkpoints.restore(step, args=ocp.args.Composite(data=ocp.args.JsonRestore(), **restores))
    number = jax.device_put(np.int32(step), like.step.sharding)
    state = TrainState(number, restored["params"], restored["optimizer"], restored.get("ema"))
    return state, restored["data"]


def restore_params(out: Path, like: Any, step: int | None = None) -> tuple[Any, int]:
    """Restore the network's parameters for inference (the average where one was kept), and their step.

    Of a run with LoRA they are those of the run that it started from, with its corrections added.

    Args:
        like: the network's parameters, or their shapes, types and shardings.
        step: of the checkpoint; the latest where left out.

    Raises:
        ConfigError: the run has no such checkpoint, or what it started from has gone.
    """
    adapt = load_run_config(out).adapt
    if not adapt.lora_rank:
        return _restore_kept(out, like, step)
    assert adapt.start_from is not None
    shapes = place_beside(jax.eval_shape(lambda: init_lora(like, adapt.lora_rank, jax.random.key(0))), like)
    base = restore_start(out, adapt.start_from, like)
    corrections, step = _restore_kept(out, shapes, step)
    return jax.jit(apply_lora)(base, corrections), step


def restore_start(out: Path, run: Path, like: Any) -> Any:
    """Restore the parameters of another run that an adapted run started from, as noted when it began.

    Args:
        out: the adapted run.
        run: the run that it started from.
        like: the network's parameters, or their shapes, types and shardings.

    Raises:
        ConfigError: they have gone or were trained anew since, or the note is lost.
    """
    try:
        note = json.loads((out / START).read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{out} does not tell from which checkpoint of {run} it was adapted ({error}); copy the whole run, or "
            "adapt again with --overwrite."
        ) from error
    if not (run / "config.yaml").exists() or checkpoint_time(run, note["step"]) != note["saved"]:
        raise ConfigError(
            f"{out} was adapted from step {note['step']} of {run}, which is not there any more or was trained anew; "
            "put that run back (a longer train.keep_checkpoints keeps it), or adapt again with --overwrite."
        )
    return restore_params(run, like, note["step"])[0]


def _restore_kept(out: Path, like: Any, step: int | None) -> tuple[Any, int]:
    """Restore what a run's checkpoint holds for inference, `ema` or else `params`, and its step.

    Args:
        like: shapes, types and shardings of what is restored.
        step: of the checkpoint; the latest where left out.

    Raises:
        ConfigError: the run has no such checkpoint.
    """
    with open_checkpoints(out) as checkpoints:
        steps = checkpoints.all_steps()
        if not steps:
            raise ConfigError(f"{out} has no checkpoint; train it: python -m xew.model.train CONFIG --out {out}")
        step = max(steps) if step is None else step
        if step not in steps:
            raise ConfigError(f"{out} has no checkpoint of step {step}; it has {', '.join(map(str, sorted(steps)))}.")
        kept = "ema" if (out / "checkpoints" / str(step) / "ema").exists() else "params"
        restored = checkpoints.restore(step, args=ocp.args.Composite(**{kept: ocp.args.StandardRestore(_abstract(like))}))
        return restored[kept], step


def _abstract(tree: Any) -> Any:
    """Keep only shapes, types and this machine's placement: Orbax would otherwise look for the devices that saved."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding), tree)
