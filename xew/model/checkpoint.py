"""Runs on disk: what a run folder holds, whether it may be written, and its checkpoints (Orbax).

<out>/config.yaml       the resolved config, itself a valid input
<out>/codec/            the codec that the latents were made with
<out>/checkpoints/STEP  params, optimizer, position of the data; ema where it is kept
<out>/metrics.jsonl     and TensorBoard's event files
"""

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from xew import config
from xew.config import ConfigError
from xew.model.codec import CODECS, Codec
from xew.model.experiment import Experiment, load_experiment

FREE_TO_CHANGE = (
    "data",
    "cache",
    "out",
    "train.steps",
    "train.log_every",
    "train.save_every",
    "train.sample_every",
    "rollout.",
)
"""What a resumed run may set anew; everything else would make it another experiment."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """All that training changes."""

    step: jax.Array
    """int32, optimizer steps taken."""
    params: Any
    optimizer: Any
    ema: Any = None
    """Moving average of the parameters, or None."""


def prepare_run(experiment: Experiment, codec: Codec, *, resume: bool, overwrite: bool) -> None:
    """Make the run folder ready: new, continued or replaced, as asked.

    Raises:
        ConfigError: it holds a run and neither was asked, or it would be continued with another config.
    """
    out = experiment.out
    saved = out / "config.yaml"
    if saved.exists() and overwrite:
        shutil.rmtree(out)
    elif saved.exists() and resume:
        _check_same(load_experiment(saved), experiment, out)
    elif saved.exists():
        raise ConfigError(
            f"{out} holds a run already; continue it with --resume, replace it with --overwrite, or choose --out."
        )
    elif out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out} is not empty and holds no run; choose another --out.")
    try:
        out.mkdir(parents=True, exist_ok=True)
        config.save(experiment, saved)
        (out / "codec").mkdir(exist_ok=True)
        codec.save(out / "codec")
    except OSError as error:
        raise ConfigError(f"cannot write the run {out}: {error}; choose another --out.") from error


def _check_same(saved: Experiment, asked: Experiment, out: Path) -> None:
    before, after = dict(_flat(saved)), dict(_flat(asked))
    changed = [key for key in after if before[key] != after[key] and not key.startswith(FREE_TO_CHANGE)]
    if changed:
        found = "; ".join(f"{key} was {before[key]!r}, is {after[key]!r}" for key in changed)
        raise ConfigError(f"{out} was begun with another config ({found}); set it back, use --overwrite, or choose --out.")


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every field of nested settings as ('train.steps', value)."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flat(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def open_checkpoints(out: Path, keep: int = 1) -> ocp.CheckpointManager:
    """The checkpoints of a run."""
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
    return ocp.CheckpointManager((out / "checkpoints").absolute(), options=options)


def save_state(checkpoints: ocp.CheckpointManager, state: TrainState, data_position: dict[str, Any]) -> None:
    """Write a checkpoint of the state, named by its step; nothing happens if it is there already."""
    step = int(state.step)
    if step in checkpoints.all_steps():
        return
    items = {"params": state.params, "optimizer": state.optimizer} | ({} if state.ema is None else {"ema": state.ema})
    saves = {name: ocp.args.StandardSave(tree) for name, tree in items.items()}
    checkpoints.save(step, args=ocp.args.Composite(data=ocp.args.JsonSave(data_position), **saves))
    checkpoints.wait_until_finished()


def restore_state(checkpoints: ocp.CheckpointManager, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """The latest state, placed as `like` is on this machine, and the position of the data."""
    step = checkpoints.latest_step()
    items = {"params": like.params, "optimizer": like.optimizer} | ({} if like.ema is None else {"ema": like.ema})
    restores = {name: ocp.args.StandardRestore(_abstract(tree)) for name, tree in items.items()}
    restored = checkpoints.restore(step, args=ocp.args.Composite(data=ocp.args.JsonRestore(), **restores))
    state = TrainState(jax.numpy.asarray(step, "int32"), restored["params"], restored["optimizer"], restored.get("ema"))
    return state, restored["data"]


def restore_params(out: Path, like: Any) -> tuple[Any, int]:
    """Parameters for inference (the average where one was kept) and their step; the optimizer is not read.

    Raises:
        ConfigError: the run has no checkpoint.
    """
    with open_checkpoints(out) as checkpoints:
        step = checkpoints.latest_step()
        if step is None:
            raise ConfigError(f"{out} has no checkpoint; train it: python -m xew.model.train CONFIG --out {out}")
        kept = "ema" if (out / "checkpoints" / str(step) / "ema").exists() else "params"
        restored = checkpoints.restore(step, args=ocp.args.Composite(**{kept: ocp.args.StandardRestore(_abstract(like))}))
        return restored[kept], step


def load_run(out: Path) -> tuple[Experiment, Codec]:
    """Config and codec of a run. Raises ConfigError if the folder holds none."""
    if not (out / "config.yaml").exists():
        raise ConfigError(f"{out} holds no run; train one: python -m xew.model.train CONFIG --out {out}")
    experiment = load_experiment(out / "config.yaml")
    return experiment, CODECS[experiment.codec.name].load(out / "codec")


def _abstract(tree: Any) -> Any:
    """Shapes, types and this machine's placement: Orbax would otherwise look for the devices that saved."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding), tree)
