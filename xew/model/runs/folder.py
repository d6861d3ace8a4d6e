"""Run folders: what they hold, and the config and codec that they were made with.

<out>/config.yaml       the resolved config, itself a valid input
<out>/codec/            the codec that the latents were made with
<out>/scales.json       normalization of conditions that are numbers, where there are any
<out>/sums/STEP.json     checksums of a checkpoint's files
<out>/.xew-run          the mark of a run: only what trainings wrote beside it is ever replaced
<out>/checkpoints/STEP  params, optimizer, position of the data; ema where it is kept
<out>/start.json        of an adapted run: where it started from
<out>/metrics.jsonl     and TensorBoard's event files
"""

from pathlib import Path

from xew.config import ConfigError
from xew.model.codecs.codec import RUN_CODEC, RUN_REMEDY, codec_class, load_kept_codec
from xew.model.codecs.contract import Codec, CodecSettings
from xew.model.experiment import Experiment, load_recorded


def load_run(out: Path) -> tuple[Experiment, Codec]:
    """Config and codec of a run. Raises ConfigError if the folder lacks them."""
    experiment = load_run_config(out)
    return experiment, load_run_codec(out, experiment.codec)


def load_run_config(out: Path) -> Experiment:
    """The config that a run was trained with. Raises ConfigError if the folder holds none."""
    if not (out / "config.yaml").exists():
        raise ConfigError(f"{out} holds no run; train one: python -m xew.model.train CONFIG --out {out}")
    return load_recorded(out / "config.yaml")


def load_run_codec(out: Path, settings: CodecSettings) -> Codec:
    """The codec, of these settings, that a run was trained with. Raises ConfigError if the folder lacks it."""
    return load_kept_codec(codec_class(settings), out / RUN_CODEC, RUN_REMEDY)
