"""The settings of `python -m lab.codec`, and their checks."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from lab.codec.pictures import ALIGNED, UNALIGNED, Cut
from lab.codec.unpaired import Seeds
from xew.config import ConfigError, load, pick
from xew.model.codecs.conv_autoencoder import AUTOENCODERS, AutoencoderSize
from xew.model.settings.checks import LEAST_OF_STEPS, check_least, check_steps
from xew.model.settings.settings import Clip
from xew.model.video.frames import TEMPORAL_FACTOR
from xew.protocol import SPLITS, expand_robots

SMALLEST_SIDE = 32
"""Least side [pixels] of a picture that LPIPS takes."""


@dataclass(frozen=True)
class PictureSettings:
    """Selection and storage of the training frames."""

    every: int = 3
    """Interval of the consecutive clips that are taken; 1 takes all."""
    drawn_every: int = 1
    """Interval of the episodes whose drawn streams (optical flow, mask, ray map) are taken, because drawing is slow."""
    device_share: float = 0.4
    """Largest share of an accelerator's memory for the pictures; larger ones stay in the host's memory."""
    host_gb: float = 64.0
    """Largest size of all pictures together [GB]."""


@dataclass(frozen=True)
class CodecTrainSettings:
    """Training of the autoencoder. A sample is a clip."""

    batch: int
    """Number of samples of a step, over all devices."""
    steps: int = 0
    """Number of steps; 0 if `seconds` sets the length."""
    seed: int = 0
    learning_rate: float = 1e-3
    """Peak of the learning rate."""
    warmup_steps: int = 200
    """Number of steps of linear warm-up."""
    decay_to: float = 0.02
    """Final learning rate of the cosine decay relative to its peak; 1 keeps it constant."""
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    """Largest global norm of the gradients; larger ones are scaled down to it."""
    ema_decay: float = 0.998
    """Decay of the exponential moving average of the parameters; 0 keeps none."""
    log_every: int = 50
    save_every: int = 2000
    sample_every: int = 2000
    """Number of steps between sample reconstructions; 0 disables them."""
    keep_checkpoints: int = 1
    seconds: float = 0.0
    """Training time [s] after the first step, including time before an interruption; 0 if `steps` sets the length. The learning
    rate follows the time."""
    l1: float = 1.0
    """Weight of the mean absolute difference, on a scale of -1 to 1."""
    mse: float = 2.0
    """Weight of the mean squared difference, on the same scale."""
    lpips: float = 0.2
    """Weight of LPIPS."""
    lpips_frames: int = 1
    """Number of random frames of each clip for LPIPS; 0 takes all."""
    penalty: float = 1e-3
    """Weight of the latents' mean square."""
    noise: float = 0.1
    """Standard deviation of the noise on latents before they are decoded."""
    region: float = 0.0
    """Additional weight of the robot's pixels in l1 and mse."""
    still: float = 0.1
    """Share of samples that repeat one frame, as the codec's first group."""
    permute: float = 0.25
    """Share of samples with permuted color channels."""
    flip: bool = False
    """Whether half of the samples are mirrored."""
    jitter: float = 0.0
    """Largest change of a color channel's gain and offset, in half of the samples, on a scale of -1 to 1."""
    statistics_clips: int = 2048
    """Number of clips for the mean and standard deviation of the latents."""


@dataclass(frozen=True)
class ReportSettings:
    """Data of the final report."""

    clips: int = 4
    """Number of clips of each robot and stream."""
    trained_robots: int = 3
    """Number of training robots to measure."""
    robots: tuple[str, ...] = ()
    """Other robots to measure (default: all held-out ones)."""
    test_seeds: bool = False
    """Measure test seeds instead of training seeds."""
    pictures: bool = True
    """Draw contact sheets."""

    @property
    def seeds(self) -> Seeds:
        """Seed family."""
        return "test" if self.test_seeds else "train"


@dataclass(frozen=True)
class CodecExperiment:
    """The config of a codec (lab/codec/*.yaml)."""

    data: Path
    """Episodes, made by `python -m xew.sim_warp.generate`."""
    out: Path
    clip: Clip
    """Clip of the world model: the size of the pictures and of the clips in the report."""
    train: CodecTrainSettings
    size: str = "base"
    """Size of the autoencoder, one of AUTOENCODERS."""
    robots: tuple[str, ...] = ()
    """Training robots (`body:0-63` names 64 procedural bodies; default: of `split`)."""
    split: str = "fixed"
    """One of protocol.SPLITS, which gives the kind of motion and the default training robots."""
    streams: dict[str, float] = field(default_factory=lambda: {"rgb": 4.0, "robot_render": 2.0, "optical_flow": 1.0})
    """Share of the samples of each stream of pictures (rgb and picture conditions)."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the activations."""
    pictures: PictureSettings = field(default_factory=PictureSettings)
    report: ReportSettings = field(default_factory=ReportSettings)

    @property
    def autoencoder(self) -> AutoencoderSize:
        """The autoencoder's size."""
        return pick(AUTOENCODERS, self.size, "size of the autoencoder")

    @property
    def train_robots(self) -> tuple[str, ...]:
        """Keys of the training robots."""
        return expand_robots(self.robots) or pick(SPLITS, self.split, "split").train_robots

    @property
    def motion(self) -> str:
        """Kind of motion of the training episodes."""
        return pick(SPLITS, self.split, "split").motion

    @property
    def cut(self) -> Cut:
        """Cutting of the training videos."""
        return Cut(TEMPORAL_FACTOR, self.pictures.every, self.clip.height, self.clip.width, self.pictures.drawn_every)


LEAST = LEAST_OF_STEPS | {
    "train.clip_norm": 0,
    "train.weight_decay": 0,
    "train.ema_decay": 0,
    "clip.frames": 1,
    "train.seconds": 0,
    "train.l1": 0,
    "train.mse": 0,
    "train.lpips": 0,
    "train.lpips_frames": 0,
    "train.penalty": 0,
    "train.noise": 0,
    "train.region": 0,
    "train.still": 0,
    "train.permute": 0,
    "train.jitter": 0,
    "train.statistics_clips": 1,
    "pictures.every": 1,
    "pictures.drawn_every": 1,
    "pictures.device_share": 0,
    "pictures.host_gb": 0,
    "report.clips": 1,
    "report.trained_robots": 0,
}
"""Least values of a config's settings."""


def load_codec_experiment(path: Path | str, overrides: Sequence[str] = ()) -> CodecExperiment:
    """Read and check a config. Raises ConfigError for a setting that does not exist or does not fit."""
    return check_codec_experiment(load(CodecExperiment, path, overrides), path)


def check_codec_experiment(experiment: CodecExperiment, path: Path | str) -> CodecExperiment:
    """Return the experiment. Raises ConfigError, naming its path, for a setting that does not exist or does not fit."""
    check_least(LEAST, experiment, str(path))
    check_streams(experiment.streams)
    _ = experiment.train_robots
    factor, clip, train = experiment.autoencoder.spatial_factor, experiment.clip, experiment.train
    check_steps(train.steps, train.seconds, "seconds", str(path))
    if train.ema_decay >= 1:
        raise ConfigError(f"{path}: train.ema_decay is {train.ema_decay:g}; it must be under 1.")
    if clip.frames % 4 != 1:
        near = max(5, clip.frames // 4 * 4 + 1)
        raise ConfigError(f"{path}: clip.frames is {clip.frames}; it must be 4 k + 1, for example {near}.")
    for name, side in (("clip.height", clip.height), ("clip.width", clip.width)):
        if side % factor or side < SMALLEST_SIDE:
            raise ConfigError(
                f"{path}: {name} is {side}; it must be a multiple of {factor} (the factor of {experiment.size}) and at least"
                f" {SMALLEST_SIDE} (for LPIPS)."
            )
    return experiment


def check_streams(streams: dict[str, float]) -> None:
    """Raise ConfigError unless every name is a stream of pictures with a share of at least 0, one of them positive."""
    known = (*ALIGNED, *UNALIGNED)
    for name, share in streams.items():
        pick(dict.fromkeys(known, ""), name, "stream of pictures")
        if not share >= 0:
            raise ConfigError(f"streams: {name} has the share {share:g}; it must be at least 0.")
    if not any(streams.values()):
        raise ConfigError(f"streams has no share over 0; expected one for some of {', '.join(known)}.")
