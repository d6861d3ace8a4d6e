"""Runs on disk: what a run folder holds, whether it may be written, and its checkpoints (Orbax).

<out>/config.yaml       the resolved config, itself a valid input
<out>/codec/            the codec that the latents were made with
<out>/checkpoints/STEP  params, optimizer, position of the data; ema where it is kept
<out>/start.json        of an adapted run: where it started from
<out>/metrics.jsonl     and TensorBoard's event files
"""

import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.sharding import Mesh, NamedSharding

from xew import config
from xew.config import ConfigError
from xew.model.codecs.codec import Codec, codec_class
from xew.model.devices.sharding import state_shardings
from xew.model.experiment import Experiment, load_experiment
from xew.model.network.lora import apply_lora, init_lora

T = TypeVar("T")

FREE_TO_CHANGE = (
    "data",
    "cache",
    "out",
    "codec.chunk",
    "codec.weights",
    "mesh.",
    "model.attention",
    "model.remat",
    "model.unroll",
    "train.accumulate",
    "train.epochs",
    "train.steps",
    "train.log_every",
    "train.save_every",
    "train.sample_every",
    "train.keep_checkpoints",
    "rollout.",
)
"""What a resumed run may set anew; everything else would make it another experiment."""
START = "start.json"
"""In an adapted run: which checkpoint of which run it started from."""


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
    base: Any = None
    """Parameters that stay as they are and that `params` corrects (LoRA), or None; checkpoints do not hold them."""


def prepare_run(experiment: Experiment, codec: Codec, *, resume: bool, overwrite: bool) -> None:
    """Make the run folder ready: new, continued or replaced, as asked.

    Raises:
        ConfigError: it holds a run and neither was asked, or it would be continued with another config or codec.
    """
    out = experiment.out
    claim_run(out, experiment, load_experiment, resume=resume, overwrite=overwrite)
    try:
        _check_same_codec(codec, out)
        (out / "codec").mkdir(exist_ok=True)
        codec.save(out / "codec")
    except OSError as error:
        raise ConfigError(f"cannot write the run {out}: {error}; choose another --out.") from error


def claim_run(out: Path, settings: T, load: Callable[[Path], T], *, resume: bool, overwrite: bool) -> None:
    """Make a folder that of a run with these settings, and write them there as config.yaml.

    Args:
        load: reads settings of this kind.

    Raises:
        ConfigError: it holds a run and neither was asked, or it would be continued with another config.
    """
    saved = out / "config.yaml"
    if saved.exists() and overwrite:
        shutil.rmtree(out)
    elif saved.exists() and resume:
        _check_same(load(saved), settings, out)
    elif saved.exists():
        raise ConfigError(
            f"{out} holds a run already; continue it with --resume, replace it with --overwrite, or choose --out."
        )
    elif out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out} is not empty and holds no run; choose another --out.")
    try:
        out.mkdir(parents=True, exist_ok=True)
        config.save(settings, saved)
    except OSError as error:
        raise ConfigError(f"cannot write the run {out}: {error}; choose another --out.") from error


def _check_same(saved: Any, asked: Any, out: Path) -> None:
    before, after = dict(_flat(saved)), dict(_flat(asked))
    changed = [key for key in after if before[key] != after[key] and not key.startswith(FREE_TO_CHANGE)]
    if changed:
        found = "; ".join(f"{key} was {before[key]!r}, is {after[key]!r}" for key in changed)
        raise ConfigError(f"{out} was begun with another config ({found}); set it back, use --overwrite, or choose --out.")


def _check_same_codec(codec: Codec, out: Path) -> None:
    """A file of weights may have moved, but must hold the same."""
    if (out / "codec").exists() and type(codec).load(out / "codec").hash != codec.hash:
        raise ConfigError(f"{out} was begun with another codec than the config's now; set it back, or choose --out.")


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every field of nested settings as ('train.steps', value)."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flat(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


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
    """The latest state and the position of the data.

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
    """The network's parameters for inference (the average where one was kept) and their step.

    Of a run with LoRA they are those of the run that it started from, with its corrections added.

    Args:
        like: the network's parameters, or their shapes, types and shardings.
        step: of the checkpoint; the latest where left out.

    Raises:
        ConfigError: the run has no such checkpoint, or what it started from has gone.
    """
    experiment = load_experiment(out / "config.yaml")
    if not experiment.adapt.lora_rank:
        return _restore_kept(out, like, step)
    base = restore_start(dataclasses.replace(experiment, out=out), like)  # a run may have been moved
    shapes = jax.eval_shape(lambda: init_lora(like, experiment.adapt.lora_rank, jax.random.key(0)))
    corrections, step = _restore_kept(out, _placed_beside(shapes, like), step)
    return jax.jit(apply_lora)(base, corrections), step


def _restore_kept(out: Path, like: Any, step: int | None) -> tuple[Any, int]:
    """What a run's checkpoint holds for inference: `ema` or else `params`."""
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


def check_start(experiment: Experiment) -> None:
    """Raises ConfigError unless `adapt.start_from` holds another run, of the same network on the same clips and codec."""
    run = experiment.adapt.start_from
    assert run is not None
    if run.resolve() == experiment.out.resolve():
        raise ConfigError(f"out is {experiment.out}, the run that adapt.start_from names; choose another --out.")
    before, after = dict(_flat(load_run(run)[0])), dict(_flat(experiment))
    compared = [key for key in after if key.startswith(("clip.", "codec.", "model.")) and not key.startswith(FREE_TO_CHANGE)]
    changed = [key for key in compared if before[key] != after[key] and key not in ("model.dtype", "model.weights")]
    if changed:
        found = "; ".join(f"{key} is {before[key]!r} there, {after[key]!r} here" for key in changed)
        raise ConfigError(f"the network of {run} cannot be adapted as another one ({found}); make them agree.")


def note_start(experiment: Experiment) -> None:
    """Write into a new run which checkpoint of `adapt.start_from` it starts from."""
    run = experiment.adapt.start_from
    assert run is not None
    with open_checkpoints(run) as checkpoints:
        step = checkpoints.latest_step()
    if step is None:
        raise ConfigError(f"{run} has no checkpoint to start from; train it: python -m xew.model.train CONFIG --out {run}")
    note = {"run": str(run), "step": step, "saved": saved_at(run, step)}
    (experiment.out / START).write_text(json.dumps(note, indent=1) + "\n")


def restore_start(experiment: Experiment, like: Any) -> Any:
    """The parameters that an adapted run starts from, as noted when it began.

    Raises:
        ConfigError: they have gone or were trained anew since, or the note is lost.
    """
    run = experiment.adapt.start_from
    assert run is not None
    try:
        note = json.loads((experiment.out / START).read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{experiment.out} does not tell from which checkpoint of {run} it was adapted ({error}); copy the whole run, or "
            "adapt again with --overwrite."
        ) from error
    if not (run / "config.yaml").exists() or saved_at(run, note["step"]) != note["saved"]:
        raise ConfigError(
            f"{experiment.out} was adapted from step {note['step']} of {run}, which is not there any more or was trained anew; "
            "put that run back (a longer train.keep_checkpoints keeps it), or adapt again with --overwrite."
        )
    return restore_params(run, like, note["step"])[0]


def saved_at(run: Path, step: int) -> int | None:
    """When a checkpoint was begun [ns], which tells it from another of the same step; None if there is none."""
    try:
        return json.loads((run / "checkpoints" / str(step) / "_CHECKPOINT_METADATA").read_text())["init_timestamp_nsecs"]
    except (OSError, ValueError, KeyError):
        return None


def _placed_beside(shapes: Any, like: Any) -> Any:
    """Shapes with places: on the mesh of `like`, or on its device."""
    sharding = jax.tree.leaves(like)[0].sharding
    if isinstance(sharding, NamedSharding) and isinstance(sharding.mesh, Mesh):
        places = state_shardings(shapes, sharding.mesh)
    else:
        places = jax.tree.map(lambda leaf: sharding, shapes)
    return jax.tree.map(lambda leaf, place: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), shapes, places)


def load_run(out: Path) -> tuple[Experiment, Codec]:
    """Config and codec of a run. Raises ConfigError if the folder lacks them."""
    experiment = load_run_config(out)
    try:
        return experiment, codec_class(experiment.codec).load(out / "codec")
    except FileNotFoundError as error:
        raise ConfigError(f"{out} lacks its codec ({error.filename}); copy the whole run, or train again.") from error


def load_run_config(out: Path) -> Experiment:
    """The config that a run was trained with. Raises ConfigError if the folder holds none."""
    if not (out / "config.yaml").exists():
        raise ConfigError(f"{out} holds no run; train one: python -m xew.model.train CONFIG --out {out}")
    return load_experiment(out / "config.yaml")


def _abstract(tree: Any) -> Any:
    """Shapes, types and this machine's placement: Orbax would otherwise look for the devices that saved."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding), tree)
