"""What the sections of configs/*.yaml hold. Fields without a default must be given."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from xew.model.network.dit import (
    AttentionName,
    Prediction,
    RematName,
    TimeEmbedding,
    Visibility,
)


@dataclass(frozen=True)
class Clip:
    """What the model sees at once."""

    frames: int
    """Number of frames, 4 k + 1; the first is given, the others are predicted."""
    height: int
    """Height [pixels]; the camera's 320x240 is padded to this aspect ratio, then resized."""
    width: int


@dataclass(frozen=True)
class ModelSettings:
    size: str
    """One of MODELS."""
    action: str = "none"
    """One of ACTIONS: how the commanded motion is shown."""
    embodiment: str = "none"
    """One of CONDITIONS: how the robot's looks are shown."""
    reference: Literal["frame", "channels"] = "frame"
    """Place of the clip's first frame: latent frame 0 alone, or the channels of every latent frame too, as in
    Ctrl-World (arXiv 2510.10125). A departure."""
    history: tuple[int, ...] = ()
    """Earlier frames that are shown too, counted from the clip's first, as [-40, -20]; before the episode its first counts."""
    text: str = "learned"
    """One of TEXT_ENCODERS: a table of words that the network learns, or Wan's frozen encoder."""
    text_weights: Path | None = None
    """umt5: models_t5_umt5-xxl-enc-bf16.pth, or the text_encoder folder of the diffusers layout."""
    text_tokenizer: Path | None = None
    """umt5: the folder google/umt5-xxl, or the tokenizer folder of the diffusers layout."""
    text_prefix: str = ""
    """Text put before every instruction, as FlowWAM's published weights expect it."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the matrix products."""
    residual: Literal["float32", "bfloat16"] = "float32"
    """Type of the tokens between blocks; their sums are float32 either way."""
    remat: RematName = "none"
    """Part that the backward pass computes again: none, all but attention or matrix products, or everything (blocks.REMAT)."""
    unroll: int = 1
    """Number of blocks compiled as one loop body."""
    attention: AttentionName = "auto"
    """Attention: cuDNN's where it can be used, else XLA's (blocks.choose_attention)."""
    visibility: Visibility = "joint"
    """one_way: condition tokens see condition tokens only, and are computed once a clip when sampling. A departure."""
    time: TimeEmbedding = "exact"
    """flowwam: with the rounding under which FlowWAM's published weights were trained."""
    prediction: Prediction = "velocity"
    """clean: the network predicts clean latents, and the velocity follows. residual: what a linear guess from the noisy latents
    and the clip's first frame leaves of them, so that an untrained network predicts that all stands still. Departures."""
    weights: Path | None = None
    """Published weights to start from: official Wan, diffusers, FlowWAM (dit_layouts.load_dit); from nothing if left out."""


@dataclass(frozen=True)
class StepSettings:
    """What the trainings of world models and of codecs have in common: steps, AdamW, and how often what is written."""

    batch: int
    """Number of samples of a step, over all devices."""
    steps: int = 0
    """Number of steps; 0 where the config gives the length in another unit."""
    seed: int = 0
    learning_rate: float = 5e-5
    """Peak of the learning rate."""
    warmup_steps: int = 0
    """Number of steps in which the learning rate rises to its peak."""
    decay_to: float = 1.0
    """Cosine decay of the learning rate to this part of its peak at the end; 1 keeps it constant."""
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    """Largest global norm of the gradients; larger ones are scaled down to it."""
    ema_decay: float = 0.0
    """Decay of the moving average of the parameters; 0 keeps none. It reaches over 1 / (1 - decay) steps, for which a tenth of
    the training is enough: that of `train` begins with the start's parameters, which stay a part of a longer one."""
    log_every: int = 20
    save_every: int = 1000
    sample_every: int = 1000
    """Number of steps between samples of what has been learned; 0 draws none."""
    keep_checkpoints: int = 2


@dataclass(frozen=True)
class TrainSettings(StepSettings):
    epochs: float = 0.0
    """Passes over the training samples; give this or `steps`."""
    accumulate: int = 1
    """Parts of the batch that are computed one after another: less memory, the same step."""
    chunks: Literal[1, 2] = 1
    """Consecutive clips of a sample; the second starts from the predicted, not the true, end of the first."""
    optimizer: Literal["adamw", "muon"] = "adamw"
    """AdamW as in the paper, or Muon for the matrices of the blocks and AdamW for the rest."""
    mu_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the optimizer's first moment, and of what Muon makes orthogonal; bfloat16 saves two bytes a parameter, and
    some of the time of Muon's products (docs/performance.md)."""
    shift: float = 5.0
    """Shift of the noise levels, in training and in sampling."""
    moving: float = 0.0
    """Places that differ from the clip's first frame weigh up to 1 + this times as much in the loss; 0 weighs all alike."""
    history_noise: float = 0.0
    """Standard deviation of what is added to earlier frames' latents in training; Ctrl-World has 0.3."""


@dataclass(frozen=True)
class AdaptSettings:
    """Adaptation of a trained run to robots that it has not seen, from a few episodes. Off without `start_from`."""

    start_from: Path | None = None
    """The run whose weights, at its latest checkpoint, are the start."""
    robots: tuple[str, ...] = ()
    """Robots whose episodes are learned from."""
    episodes: int = 1
    """Number of episodes of each task and robot, those of the first accepted training seeds (M in the paper)."""
    replay: float = 0.0
    """Part of every batch that comes from the run's own training robots; 0 as in the paper."""
    lora_rank: int = 0
    """Rank of the LoRA corrections that are learned instead of all weights; 0, as in the paper, learns all weights."""


@dataclass(frozen=True)
class RolloutSettings:
    sampler: str = "euler"
    """One of SAMPLERS."""
    grid: str = "flowwam"
    """Noise schedule: one of SCHEDULES, each by the name of the project that has it."""
    steps: int = 50
    """Number of evaluations of the network a chunk."""
    shift: float | None = None
    """Shift of the noise levels; that of training where left out."""
    guidance: float = 1.0
    """Classifier-free guidance against `negative_prompt`; 1 is none and costs nothing. Wan's own sampling has 5; networks
    trained here have never gone without their instruction."""
    negative_prompt: str = ""
    batch: int = 4
    """Number of episodes at once over all devices."""
    unroll: int = 0
    """Number of blocks compiled as one loop body; 0 takes the training's. Many spare the backward pass its stacked arrays,
    which a sampler has not, and take long to compile: a minute and a half on a GPU at 12."""
    max_frames: int = 0
    """Number of frames of an episode that are predicted, from its first; 0 predicts all."""
    seed: int = 0


def count_replayed(batch: int, replay: float) -> int:
    """Number of samples of a batch that are replayed: the nearest whole one, at least one where any are asked for."""
    return max(1, round(batch * replay)) if replay else 0
