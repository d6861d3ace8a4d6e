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
    """Which frames are learned from, and where they are kept."""

    every: int = 3
    """Clips are taken one after another, each `every`-th of them; 1 takes all of a video."""
    drawn_every: int = 1
    """Number of episodes of which one's drawn streams (optical flow, mask, ray map) are taken; drawing is slow."""
    device_share: float = 0.4
    """Largest share of an accelerator's memory that the pictures may take; where they take more, they stay in the host's."""
    host_gb: float = 64.0
    """Largest size of all pictures together [GB]; more is an error before anything is decoded."""


@dataclass(frozen=True)
class CodecTrainSettings:
    """How the autoencoder learns. A sample is a clip."""

    batch: int
    """Number of samples of a step, over all devices."""
    steps: int = 0
    """Number of steps; 0 where `seconds` gives the length."""
    seed: int = 0
    learning_rate: float = 1e-3
    """Peak of the learning rate."""
    warmup_steps: int = 200
    """Number of steps in which the learning rate rises to its peak."""
    decay_to: float = 0.02
    """Cosine decay of the learning rate to this part of its peak at the end; 1 keeps it constant."""
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    """Largest global norm of the gradients; larger ones are scaled down to it."""
    ema_decay: float = 0.998
    """Decay of the moving average of the parameters; 0 keeps none."""
    log_every: int = 50
    save_every: int = 2000
    sample_every: int = 2000
    """Number of steps between samples of what has been learned; 0 draws none."""
    keep_checkpoints: int = 1
    seconds: float = 0.0
    """Time [s] of training after the first step, which compiles; give this or `steps`. The rate follows the time. What has
    passed before an interruption counts."""
    l1: float = 1.0
    """Weight of the mean absolute difference, on a scale of -1 to 1."""
    mse: float = 2.0
    """Weight of the mean squared difference, on the same scale."""
    lpips: float = 0.2
    """Weight of LPIPS."""
    lpips_frames: int = 1
    """Number of frames of each clip for LPIPS, drawn at each step; 0 for all."""
    penalty: float = 1e-3
    """Weight of the latents' mean square."""
    noise: float = 0.1
    """Standard deviation of the noise on latents before they are decoded."""
    region: float = 0.0
    """Additional weight of the robot's pixels in l1 and mse."""
    still: float = 0.1
    """Share of samples that show one frame of the clip at all times, as a codec's first group does."""
    permute: float = 0.25
    """Share of samples whose color channels change places."""
    flip: bool = False
    """Whether half of the samples are mirrored."""
    jitter: float = 0.0
    """Largest change of a color channel's gain and offset, in half of the samples, on a scale of -1 to 1."""
    statistics_clips: int = 2048
    """Number of clips from which the mean and deviation of the latents are computed at the end."""


@dataclass(frozen=True)
class ReportSettings:
    """What the report at the end is measured on: training seeds of robots that were not trained on, unless asked otherwise."""

    clips: int = 4
    """Number of clips of each robot and stream."""
    trained_robots: int = 3
    """Number of training robots that are measured in addition."""
    robots: tuple[str, ...] = ()
    """Further robots to measure; default: all that are not trained on."""
    test_seeds: bool = False
    """Whether test seeds are read, and not training seeds."""
    pictures: bool = True
    """Whether contact sheets are drawn."""

    @property
    def seeds(self) -> Seeds:
        """Family of the seeds that are read."""
        return "test" if self.test_seeds else "train"


@dataclass(frozen=True)
class CodecExperiment:
    """What lab/codec/*.yaml hold."""

    data: Path
    """Episodes, made by `python -m xew.sim_warp.generate`."""
    out: Path
    clip: Clip
    """Clip of the world model that is to use it: the size of the pictures, and what the report is measured on."""
    train: CodecTrainSettings
    size: str = "base"
    """Size of the autoencoder, one of AUTOENCODERS."""
    robots: tuple[str, ...] = ()
    """Training robots by name (`body:0-63` for 64 procedural bodies); default: the robots of `split`."""
    split: str = "fixed"
    """Split, one of protocol.SPLITS, whose training robots are learned from where no robots are named; it names the kind of
    motion, too."""
    streams: dict[str, float] = field(default_factory=lambda: {"rgb": 4.0, "robot_render": 2.0, "optical_flow": 1.0})
    """Share of the samples that each stream of pictures has, by name: the scene, and conditions that are pictures."""
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
        """Keys of the robots that are learned from."""
        return expand_robots(self.robots) or pick(SPLITS, self.split, "split").train_robots

    @property
    def motion(self) -> str:
        """Kind of motion of the episodes that are learned from, as the split names it."""
        return pick(SPLITS, self.split, "split").motion

    @property
    def cut(self) -> Cut:
        """What is cut out of a video."""
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
"""Numbers of a config that mean nothing below."""


def load_codec_experiment(path: Path | str, overrides: Sequence[str] = ()) -> CodecExperiment:
    """Read and check a config. Raises ConfigError with what does not exist or does not fit."""
    return check_codec_experiment(load(CodecExperiment, path, overrides), path)


def check_codec_experiment(experiment: CodecExperiment, path: Path | str) -> CodecExperiment:
    """The experiment itself. Raises ConfigError, naming its path, if one of its choices does not exist or does not fit."""
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
    """Raise ConfigError unless every name is a stream of pictures with a share of at least 0, and one has more."""
    known = (*ALIGNED, *UNALIGNED)
    for name, share in streams.items():
        pick(dict.fromkeys(known, ""), name, "stream of pictures")
        if not share >= 0:
            raise ConfigError(f"streams: {name} has the share {share:g}; it must be at least 0.")
    if not any(streams.values()):
        raise ConfigError(f"streams names none with a share over 0; name some of {', '.join(known)}.")
