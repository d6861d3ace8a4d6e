"""Checkpoints of a run (Orbax): written in the background, read on any devices.

Reads, writes <out>/checkpoints/STEP, and <out>/sums/STEP.json with the SHA-256 of each of its files

A checkpoint without sums, of a run that was killed before writing them, is read without verification.
"""

import contextlib
import functools
import json
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from xew.config import ConfigError
from xew.files import file_digest, read_json, write_text
from xew.model.devices.sharding import place_like
from xew.model.network.dit import network_shapes
from xew.model.network.lora import apply_lora, init_lora
from xew.model.network.spec import Network
from xew.model.runs.folder import KeptStep, trace_run
from xew.model.runs.layout import list_steps
from xew.names import demand_utf8

SUMMING = ThreadPoolExecutor(1, "sums")
"""Thread that computes checksums of earlier checkpoints during training."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """The state of a training run."""

    step: jax.Array
    """[] int32, number of optimizer steps taken."""
    params: Any
    optimizer: Any
    ema: Any = None
    """Moving average of the parameters, or None."""
    base: Any = None
    """Frozen parameters that `params` corrects (LoRA), or None; checkpoints do not hold them."""


def open_checkpoints(out: Path, keep: int = 1) -> ocp.CheckpointManager:
    """Open the checkpoints of a run, written in the background."""
    demand_utf8(out.absolute())
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=True)
    return ocp.CheckpointManager((out / "checkpoints").absolute(), options=options)


@contextlib.contextmanager
def write_checkpoints(out: Path, keep: int = 1) -> Iterator[ocp.CheckpointManager]:
    """Open the checkpoints of a run for writing; at the end of the block all are complete and have sums."""
    try:
        with open_checkpoints(out, keep) as checkpoints:
            yield checkpoints
    finally:
        if jax.process_index() == 0:
            note_sums(out)


def save_state(checkpoints: ocp.CheckpointManager, state: TrainState, data_position: dict[str, Any]) -> None:
    """Start writing a checkpoint of the state unless one of its step exists; the state may be changed on return."""
    step = int(state.step)
    if step in checkpoints.all_steps():
        return
    items = {"params": state.params, "optimizer": state.optimizer} | ({} if state.ema is None else {"ema": state.ema})
    saves = {name: ocp.args.StandardSave(tree) for name, tree in items.items()}
    if jax.process_index() == 0:
        checkpoints.wait_until_finished()
        SUMMING.submit(note_sums, Path(checkpoints.directory).parent)
    checkpoints.save(step, args=ocp.args.Composite(data=ocp.args.JsonSave(data_position), **saves))


def save_params(checkpoints: ocp.CheckpointManager, step: int, params: Any) -> None:
    """Write a checkpoint of parameters alone, for inference, and wait for it."""
    checkpoints.save(step, args=ocp.args.Composite(params=ocp.args.StandardSave(params)))
    checkpoints.wait_until_finished()


def restore_state(checkpoints: ocp.CheckpointManager, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """Restore the latest state and the position of the data.

    Args:
        like: arrays, or their shapes, types and shardings on the current devices.

    Raises:
        ConfigError: the checkpoint is damaged: a part is missing, of another size, changed, or not finite.
    """
    step, out = checkpoints.latest_step(), Path(checkpoints.directory).parent
    items = {"params": like.params, "optimizer": like.optimizer} | ({} if like.ema is None else {"ema": like.ema})
    restores = {name: ocp.args.StandardRestore(_abstract(tree)) for name, tree in items.items()}
    restored = _restore(checkpoints, out, step, {"data": ocp.args.JsonRestore(), **restores})
    number = jax.device_put(np.int32(step), like.step.sharding)
    state = TrainState(number, restored["params"], restored["optimizer"], restored.get("ema"))
    return state, restored["data"]


def load_params(
    run: Path, network: Network, step: int | None = None, sharding: jax.sharding.Sharding | None = None
) -> tuple[Any, int]:
    """Restore the float32 parameters of a run's network for inference (the average if there is one), and their step.

    LoRA corrections are added to the parameters of the run that they start from.

    Args:
        run: folder of the run.
        network: its network.
        step: of the checkpoint, by default the latest.
        sharding: of the parameters, by default on the first device.

    Raises:
        ConfigError: the run, or the run that it starts from, has no such checkpoint.
    """
    sharding = sharding or jax.sharding.SingleDeviceSharding(jax.devices()[0])
    like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), network_shapes(network))
    return restore_sum(trace_run(run, step), like)


def restore_sum(lineage: Sequence[KeptStep], like: Any) -> tuple[Any, int]:
    """Restore the parameters of the first checkpoint of a lineage, add the others' LoRA corrections, and return the last step.

    Args:
        lineage: checkpoints from `trace_run` or `trace_start`.
        like: the network's parameters, or their shapes, types and shardings.

    Raises:
        ConfigError: a run has no such checkpoint.
    """
    first, *adapted = lineage
    params, step = _restore_inference(first.run, like, first.step)
    for correction in adapted:
        shapes = jax.eval_shape(functools.partial(init_lora, like, correction.adapt.lora_rank, jax.random.key(0)))
        learned, step = _restore_inference(correction.run, place_like(shapes, like), correction.step)
        params = jax.jit(apply_lora)(params, learned)
    return params, step


def _restore_inference(out: Path, like: Any, step: int | None) -> tuple[Any, int]:
    """Restore `ema`, or else `params`, of a run's checkpoint, and its step; raises as `restore_sum`."""
    with open_checkpoints(out) as checkpoints:
        steps = checkpoints.all_steps()
        if not steps:
            raise ConfigError(f"{out} has no checkpoint; train it: python -m xew.model.train CONFIG --out {out}")
        step = max(steps) if step is None else step
        if step not in steps:
            raise ConfigError(f"{out} has no checkpoint of step {step}; it has {', '.join(map(str, sorted(steps)))}.")
        item = "ema" if (out / "checkpoints" / str(step) / "ema").exists() else "params"
        return _restore(checkpoints, out, step, {item: ocp.args.StandardRestore(_abstract(like))})[item], step


def _restore(checkpoints: ocp.CheckpointManager, out: Path, step: int, restores: dict[str, Any]) -> Any:
    """Restore items of a checkpoint. Raises ConfigError if they are damaged or not finite."""
    if damage := find_damage(out, step, restores):
        raise damaged(out, step, restores, damage)
    try:
        restored = checkpoints.restore(step, args=ocp.args.Composite(**restores))
    except Exception as error:  # Orbax raises many types
        if "RESOURCE_EXHAUSTED" in str(error):
            raise ConfigError(
                f"{out}: the checkpoint of step {step} is whole, but does not fit into the free memory of {jax.devices()[0]}; "
                "stop other programs there, or wait for them."
            ) from error
        raise damaged(out, step, restores, error) from error
    for name in restores.keys() - {"data"}:
        for path, leaf in jax.tree_util.tree_leaves_with_path(restored[name]):
            if not _is_finite(leaf):
                raise damaged(out, step, restores, f"{name}{jax.tree_util.keystr(path)} holds NaN or infinite numbers")
    return restored


def _is_finite(leaf: Any) -> bool:
    """Whether all numbers of an array [...] on this process's devices are finite."""
    if not jnp.issubdtype(leaf.dtype, jnp.inexact):
        return True
    parts = [shard.data for shard in leaf.addressable_shards if shard.replica_id == 0]
    return all(bool(np.isfinite(np.asarray(part)).all()) for part in parts)


def _abstract(tree: Any) -> Any:
    """Shapes, types and shardings of a tree, without which Orbax looks for the devices that saved it."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding), tree)


def note_sums(out: Path) -> None:
    """Write missing sums of a run's complete checkpoints, and remove the sums of deleted checkpoints."""
    steps = list_steps(out)
    for step in steps:
        path, folder = _sums(out, step), out / "checkpoints" / str(step)
        if path.exists():
            continue
        try:
            sums = {
                file.relative_to(folder).as_posix(): file_digest(file) for file in sorted(folder.rglob("*")) if file.is_file()
            }
            write_text(path, json.dumps(sums, indent=1, sort_keys=True) + "\n", within=out)
        except OSError:  # the checkpoint is being replaced, or the disk is full: it is then read without sums
            continue
    if (out / "sums").is_symlink():
        return
    for path in (out / "sums").glob("*.json"):
        if path.stem.isdecimal() and int(path.stem) not in steps:
            path.unlink(missing_ok=True)


def find_damage(out: Path, step: int, items: Collection[str]) -> str:
    """Verify the given items and the top-level files of a checkpoint: the damage, or '' if there is none or no sums."""
    folder, path = out / "checkpoints" / str(step), _sums(out, step)
    if not path.exists():
        return ""
    try:
        sums = read_json(path)
        if not isinstance(sums, dict) or not all(isinstance(digest, str) for digest in sums.values()):
            raise ValueError("expected digests by the names of files")
    except (OSError, ValueError) as error:
        return f"its sums {path} cannot be read: {error}"
    for name, digest in sums.items():
        if "/" in name and name.partition("/")[0] not in items:
            continue
        try:
            actual = file_digest(folder / name)
        except OSError:
            return f"{name} is missing"
        if actual != digest:
            return f"{name} has other bytes than were written"
    return ""


def damaged(out: Path, step: int, items: Collection[str], damage: object) -> ConfigError:
    """The error for a damaged checkpoint, which offers the last whole one."""
    whole = [
        other
        for other in list_steps(out)
        if other != step and _sums(out, other).exists() and not find_damage(out, other, items)
    ]
    offer = "no other is known to be whole: copy the run again, or train it again with --overwrite"
    if whole:
        offer = f"step {whole[-1]} is whole: move that folder away to go on from it, or read it by --checkpoint {whole[-1]}"
    reason = " ".join(str(damage).split())[:200] or type(damage).__name__
    return ConfigError(f"{out / 'checkpoints' / str(step)}: the checkpoint of step {step} is damaged ({reason}); {offer}.")


def _sums(out: Path, step: int) -> Path:
    return out / "sums" / f"{step}.json"
