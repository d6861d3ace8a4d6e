"""Parameters of a run for inference, and where an adapted run started from."""

import json
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding

from xew.config import ConfigError
from xew.files import checkpoint_time
from xew.model.devices.sharding import state_shardings
from xew.model.experiment import Experiment
from xew.model.network.lora import apply_lora, init_lora
from xew.model.runs.checkpoint import open_checkpoints, restore_kept
from xew.model.runs.folder import FREE_TO_CHANGE, flatten, load_run, load_run_config

START = "start.json"
"""Name of the file that says, in an adapted run, which checkpoint of which run it started from."""


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
        return restore_kept(out, like, step)
    assert adapt.start_from is not None
    base = restore_start(out, adapt.start_from, like)
    shapes = jax.eval_shape(lambda: init_lora(like, adapt.lora_rank, jax.random.key(0)))
    corrections, step = restore_kept(out, _place_beside(shapes, like), step)
    return jax.jit(apply_lora)(base, corrections), step


def _place_beside(shapes: Any, like: Any) -> Any:
    """Give shapes their places: on the mesh of `like`, or on its device."""
    sharding = jax.tree.leaves(like)[0].sharding
    if isinstance(sharding, NamedSharding) and isinstance(sharding.mesh, Mesh):
        places = state_shardings(shapes, sharding.mesh)
    else:
        places = jax.tree.map(lambda leaf: sharding, shapes)
    return jax.tree.map(lambda leaf, place: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), shapes, places)


def check_start(experiment: Experiment) -> None:
    """Raises ConfigError unless `adapt.start_from` holds another run, of the same network on the same clips and codec."""
    run = experiment.adapt.start_from
    assert run is not None
    if run.resolve() == experiment.out.resolve():
        raise ConfigError(f"out is {experiment.out}, the run that adapt.start_from names; choose another --out.")
    before, after = dict(flatten(load_run(run)[0])), dict(flatten(experiment))
    compared = [key for key in after if key.startswith(("clip.", "codec.", "model.")) and not key.startswith(FREE_TO_CHANGE)]
    changed = [key for key in compared if before[key] != after[key] and key not in ("model.dtype", "model.weights")]
    if changed:
        found = "; ".join(f"{key} is {before[key]!r} there, {after[key]!r} here" for key in changed)
        raise ConfigError(f"the network of {run} cannot be adapted as another one ({found}); make them agree.")


def note_start(out: Path, run: Path) -> None:
    """Write into a new run which checkpoint of another run it starts from."""
    with open_checkpoints(run) as checkpoints:
        step = checkpoints.latest_step()
    if step is None:
        raise ConfigError(f"{run} has no checkpoint to start from; train it: python -m xew.model.train CONFIG --out {run}")
    note = {"run": str(run), "step": step, "saved": checkpoint_time(run, step)}
    (out / START).write_text(json.dumps(note, indent=1) + "\n")


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
