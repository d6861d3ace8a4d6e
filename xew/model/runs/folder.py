"""Run folders: what they hold, who may write them, and the config and codec that they were made with.

<out>/config.yaml       the resolved config, itself a valid input
<out>/codec/            the codec that the latents were made with
<out>/scales.json       normalization of conditions that are numbers, where there are any
<out>/checkpoints/STEP  params, optimizer, position of the data; ema where it is kept
<out>/start.json        of an adapted run: where it started from
<out>/metrics.jsonl     and TensorBoard's event files
"""

import dataclasses
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from xew import config
from xew.config import ConfigError
from xew.model.codecs.codec import Codec, codec_class
from xew.model.experiment import Experiment, load_experiment

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
"""Settings that a resumed run may change; any other would make it another experiment."""


def prepare_run(experiment: Experiment, codec: Codec, *, resume: bool, overwrite: bool) -> None:
    """Make a run folder ready, new, continued or replaced, and keep config and codec in it.

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
    """Make a folder ready for a run with these settings, new, continued or replaced, and write them there as config.yaml.

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
    """Raise ConfigError where settings that may not change differ."""
    before, after = dict(flatten(saved)), dict(flatten(asked))
    changed = [key for key in after if before[key] != after[key] and not key.startswith(FREE_TO_CHANGE)]
    if changed:
        found = "; ".join(f"{key} was {before[key]!r}, is {after[key]!r}" for key in changed)
        raise ConfigError(f"{out} was begun with another config ({found}); set it back, use --overwrite, or choose --out.")


def _check_same_codec(codec: Codec, out: Path) -> None:
    """Raise ConfigError where the codec is another. A file of weights may have moved, but must hold the same."""
    if (out / "codec").exists() and type(codec).load(out / "codec").hash != codec.hash:
        raise ConfigError(f"{out} was begun with another codec than the config's now; set it back, or choose --out.")


def flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Name every field of nested settings, as ('train.steps', value)."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from flatten(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def load_run(out: Path) -> tuple[Experiment, Codec]:
    """Config and codec of a run. Raises ConfigError if the folder lacks them."""
    return load_run_config(out), load_run_codec(out)


def load_run_config(out: Path) -> Experiment:
    """The config that a run was trained with. Raises ConfigError if the folder holds none."""
    if not (out / "config.yaml").exists():
        raise ConfigError(f"{out} holds no run; train one: python -m xew.model.train CONFIG --out {out}")
    return load_experiment(out / "config.yaml")


def load_run_codec(out: Path) -> Codec:
    """The codec that a run was trained with. Raises ConfigError if the folder lacks it."""
    try:
        return codec_class(load_run_config(out).codec).load(out / "codec")
    except FileNotFoundError as error:
        raise ConfigError(f"{out} lacks its codec ({error.filename}); copy the whole run, or train again.") from error
