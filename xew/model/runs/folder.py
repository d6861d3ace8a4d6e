"""Opening a run: the config and codec that it was trained with, and the checkpoint that its network comes from.

<out>/config.yaml       the resolved config, itself a valid input
<out>/codec/            the codec that the latents were made with
<out>/scales.json       normalization of conditions that are numbers, where there are any
<out>/sums/STEP.json     checksums of a checkpoint's files
<out>/.xew-run          the mark of a run: only the files of a run next to it are ever replaced
<out>/checkpoints/STEP  params, optimizer, position of the data; ema where it is kept
<out>/start.json        of an adapted run: where it started from
<out>/metrics.jsonl     and TensorBoard's event files
"""

from dataclasses import dataclass
from pathlib import Path

from xew import config
from xew.config import ConfigError
from xew.files import read_json
from xew.model.codecs.codec import RUN_CODEC, RUN_REMEDY, codec_class, load_kept_codec
from xew.model.codecs.contract import Codec, CodecSettings
from xew.model.experiment import Experiment, load_recorded
from xew.model.runs.layout import checkpoint_time
from xew.model.settings.settings import AdaptSettings

START = "start.json"
"""Name of the file that says, in an adapted run, which checkpoint of which run it started from."""


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


@dataclass(frozen=True)
class KeptStep:
    """A checkpoint of a run."""

    run: Path
    step: int | None
    """Step; the latest where None."""
    adapt: AdaptSettings
    """Adaptation of that run; with LoRA the checkpoint holds corrections, else the whole network."""


def trace_run(out: Path, step: int | None = None) -> list[KeptStep]:
    """The checkpoints that a run's network is the sum of: one of a whole network, then corrections, its own last.

    Raises:
        ConfigError: what the run was adapted from has gone or was trained again since, or the note of it is lost.
    """
    own = KeptStep(out, step, load_run_config(out).adapt)
    return [*trace_start(out, own.adapt.start_from), own] if own.adapt.lora_rank else [own]


def trace_start(out: Path, run: Path | None) -> list[KeptStep]:
    """The checkpoints that make the network of `run` which the adapted run `out` started from, as noted when it began.

    Raises:
        ConfigError: they have gone or were trained again since, or a note is lost.
    """
    kept: list[KeptStep] = []
    while run is not None:
        kept.insert(0, _read_start(out, run))
        out, adapt = run, kept[0].adapt
        run = adapt.start_from if adapt.lora_rank else None
    return kept


@dataclass(frozen=True)
class StartNote:
    """What start.json says."""

    run: str
    step: int
    saved: int | None


def _read_start(out: Path, run: Path) -> KeptStep:
    """Read which checkpoint of a run another was adapted from. Raises ConfigError if it has gone, or the note is lost."""
    try:
        note = config.parse(StartNote, read_json(out / START), str(out / START))
    except (OSError, ValueError, ConfigError) as error:
        raise ConfigError(
            f"{out} does not say from which checkpoint of {run} it was adapted ({error}); copy the whole run, or "
            "adapt again with --overwrite."
        ) from error
    if not (run / "config.yaml").exists() or checkpoint_time(run, note.step) != note.saved:
        raise ConfigError(
            f"{out} was adapted from step {note.step} of {run}, which is not there any more or was trained again; "
            "put that run back (a longer train.keep_checkpoints keeps it), or adapt again with --overwrite."
        )
    return KeptStep(run, note.step, load_run_config(run).adapt)
