"""Beginning a run: whether its folder may be claimed, what a continued run may change, and what is written there first.

Reads  the run that is continued, or adapted
Writes <out>/config.yaml, codec/, scales.json and, of an adapted run, start.json, once all is checked
"""

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
from flax import nnx
from jax.experimental import multihost_utils

from xew import config
from xew.config import ConfigError
from xew.files import write_text
from xew.model.cache.keys import RUN_SCALES
from xew.model.cache.scales import Scale, dump_scales, load_run_scales
from xew.model.codecs.codec import RUN_CODEC, RUN_REMEDY, load_kept_codec
from xew.model.codecs.contract import Codec
from xew.model.experiment import Experiment, load_recorded
from xew.model.network.dit import WorldModel
from xew.model.network.dit_layouts import check_dit
from xew.model.runs.folder import START, StartNote, load_run_config
from xew.model.runs.layout import RUN_MARK, checkpoint_time, is_run, list_steps, remove_run
from xew.model.weights.reading import read_tensors

T = TypeVar("T")

FREE_TO_CHANGE = (
    "data",
    "cache",
    "out",
    "codec.chunk",
    "codec.weights",
    "mesh.",
    "model.remat",
    "train.accumulate",
    "train.epochs",
    "train.seconds",
    "train.steps",
    "train.log_every",
    "train.save_every",
    "train.sample_every",
    "train.keep_checkpoints",
    "pictures.device_share",
    "pictures.host_gb",
    "report.",
    "rollout.",
)
"""Settings that a resumed run may change; any other would make it another experiment."""


def begin_run(
    experiment: Experiment, codec: Codec, scales: Mapping[str, Scale], *, resume: bool, overwrite: bool
) -> dict[str, Scale]:
    """Make the run folder ready, by the first process, as `prepare_run`; the others wait for it. Returns the run's scales."""
    if jax.process_index() == 0:
        prepare_run(experiment, codec, scales, resume=resume, overwrite=overwrite)
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("run folder")
    return load_run_scales(experiment.conditions, experiment.out)


def prepare_run(experiment: Experiment, codec: Codec, scales: Mapping[str, Scale], *, resume: bool, overwrite: bool) -> None:
    """Make a run folder ready, new, continued or replaced, and keep in it what the run is made with and starts from.

    A run that is continued keeps its own scales and start.

    Raises:
        ConfigError: it holds a run and neither was asked, it would be continued with another config or codec, or the run to
            adapt has no checkpoint.
    """
    out, start, steps = experiment.out, experiment.adapt.start_from, list[int]()
    check_claim(out, experiment, load_recorded, resume=resume, overwrite=overwrite)
    if resume and (out / RUN_CODEC).exists():
        kept = _find_codec(experiment, out)
        if kept is not None and kept.hash != codec.hash:  # a file of weights may have moved, but must hold the same
            raise ConfigError(f"{out} was begun with another codec than the config's now; set it back, or choose --out.")
    if start is not None and not (resume and (out / START).exists()):
        steps = list_steps(start)
        if not steps:
            raise ConfigError(
                f"{start} has no checkpoint to start from; train it: python -m xew.model.train CONFIG --out {start}"
            )
    write_claim(out, experiment, overwrite=overwrite)
    try:
        (out / RUN_CODEC).mkdir(exist_ok=True)
        codec.save(out / RUN_CODEC)
    except OSError as error:
        raise ConfigError(f"cannot write the run {out}: {error}; choose another --out.") from error
    if start is not None and steps:
        note = StartNote(str(start), max(steps), checkpoint_time(start, max(steps)))
        write_text(out / START, json.dumps(dataclasses.asdict(note), indent=1) + "\n")
    if scales and not (out / RUN_SCALES).exists():
        write_text(out / RUN_SCALES, dump_scales(scales))


def check_one_of(resume: bool, overwrite: bool) -> None:
    """Raise ConfigError where a run would be both continued and replaced."""
    if resume and overwrite:
        raise ConfigError("--resume continues the run in --out, --overwrite replaces it; give one of them.")


def claim_run(out: Path, settings: T, read: Callable[[Path], T], *, resume: bool, overwrite: bool) -> None:
    """Make a folder ready for a run with these settings, new, continued or replaced, and write them there as config.yaml."""
    check_claim(out, settings, read, resume=resume, overwrite=overwrite)
    write_claim(out, settings, overwrite=overwrite)


def check_claim(out: Path, settings: T, read: Callable[[Path], T], *, resume: bool, overwrite: bool) -> None:
    """Raise ConfigError where a folder holds a run and neither was asked, or one to be continued with another config."""
    saved = out / "config.yaml"
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; choose another --out.")
    if saved.exists() and resume:
        _check_same(read(saved), settings, out)
    elif saved.exists() and not overwrite:
        raise ConfigError(
            f"{out} holds a run already; continue it with --resume, replace it with --overwrite, or choose --out."
        )
    elif not saved.exists() and out.exists() and not _is_bare(out):
        raise ConfigError(f"{out} is not empty and holds no run; choose another --out.")


def _find_codec(experiment: Experiment, out: Path) -> Codec | None:
    """The codec that a run keeps; None where the run was killed before it was written whole, and so has no checkpoint."""
    try:
        return load_kept_codec(experiment.encoding.kind, out / RUN_CODEC, RUN_REMEDY)
    except ConfigError:
        if list_steps(out):
            raise
        return None


def _is_bare(out: Path) -> bool:
    """Whether a folder is empty, or holds no more than the mark of a run that was killed before its config was written."""
    names = [path.name for path in out.iterdir()]
    return not names or (RUN_MARK in names and all(name.startswith(".") for name in names))


def write_claim(out: Path, settings: Any, *, overwrite: bool) -> None:
    """Write the settings of a run into its folder, which may be claimed, instead of the run there if it is replaced."""
    saved = out / "config.yaml"
    if overwrite and saved.exists():
        _remove_run(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / RUN_MARK).touch()
        config.save(settings, saved)
    except OSError as error:
        raise ConfigError(f"cannot write the run {out}: {error}; choose another --out.") from error


def _remove_run(out: Path) -> None:
    """Remove what trainings have written into the folder of a run. Raises ConfigError if it is none, or holds anything else."""
    if not is_run(out):
        raise ConfigError(f"{out} has a config.yaml but holds no run, so it is not replaced; choose another --out.")
    try:
        foreign = remove_run(out)
    except OSError as error:
        raise ConfigError(f"cannot replace the run {out}: {error}; choose another --out.") from error
    if foreign:
        names = ", ".join(str(path.relative_to(out)) for path in foreign[:3])
        print(f"{out}: the run is replaced; files that are not its own stay there ({names})")


def check_start(experiment: Experiment) -> None:
    """Raise ConfigError unless what the run starts from fits: the run to adapt, or published weights, if there are any."""
    run, weights = experiment.adapt.start_from, experiment.model.weights
    if run is not None and run.resolve() == experiment.out.resolve():
        raise ConfigError(f"out is {experiment.out}, the run that adapt.start_from names; choose another --out.")
    if run is not None:
        _check_same_network(load_run_config(run), experiment, run)
    if weights is not None:
        check_dit(nnx.eval_shape(lambda: WorldModel(experiment.network)), read_tensors(weights))


def _check_same(saved: Any, asked: Any, out: Path) -> None:
    """Raise ConfigError where settings that may not change differ."""
    before, after = dict(_flatten(saved)), dict(_flatten(asked))
    changed = [key for key in after if before[key] != after[key] and not key.startswith(FREE_TO_CHANGE)]
    if changed:
        changes = "; ".join(f"{key} was {before[key]!r}, is {after[key]!r}" for key in changed)
        raise ConfigError(f"{out} was begun with another config ({changes}); set it back, use --overwrite, or choose --out.")


def _check_same_network(source: Any, asked: Any, run: Path) -> None:
    """Raise ConfigError unless the network of a run can be adapted as the one asked for: on the same clips and codec."""
    before, after = dict(_flatten(source)), dict(_flatten(asked))
    compared = [key for key in after if key.startswith(("clip.", "codec.", "model.")) and not key.startswith(FREE_TO_CHANGE)]
    changed = [key for key in compared if before[key] != after[key] and key not in ("model.dtype", "model.weights")]
    if changed:
        differences = "; ".join(f"{key} is {before[key]!r} there, {after[key]!r} here" for key in changed)
        raise ConfigError(f"the network of {run} cannot be adapted as another one ({differences}); make them agree.")


def _flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Name every field of nested settings, as ('train.steps', value)."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flatten(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value
