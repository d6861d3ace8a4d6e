"""What the sections of configs/*.yaml hold. The defaults are the recommended recipe, that of configs/fixed.yaml."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from xew.model.network.spec import NetworkSettings


@dataclass(frozen=True)
class Clip:
    """What the model sees at once."""

    frames: int = 33
    """Number of frames, 4 k + 1; the first is given, the others are predicted."""
    height: int = 256
    """Height [pixels]; the camera's 320x240 is padded to this aspect ratio, then resized."""
    width: int = 320


@dataclass(frozen=True)
class ModelSettings(NetworkSettings):
    """The network, what it is conditioned on, and the weights that it starts from."""

    size: str = "small"
    """One of MODELS."""
    action: str = "mask_and_flow_channels"
    """One of ACTIONS: the form in which the network is given the commanded motion."""
    embodiment: str = "pasted_render"
    """One of CONDITIONS: the form in which the network is given the robot's appearance."""
    reference: Literal["frame", "channels"] = "channels"
    """Place of the clip's first frame: latent frame 0 alone, as in Wan, or the channels of every latent frame too, as in
    Ctrl-World (arXiv 2510.10125)."""
    text: str = "learned"
    """One of TEXT_ENCODERS: a table of words that the network learns, or Wan's frozen encoder."""
    text_weights: Path | None = None
    """umt5: models_t5_umt5-xxl-enc-bf16.pth, or the text_encoder folder of the diffusers layout."""
    text_tokenizer: Path | None = None
    """umt5: the folder google/umt5-xxl, or the tokenizer folder of the diffusers layout."""
    text_prefix: str = ""
    """Text put before every instruction, as FlowWAM's published weights expect it."""
    weights: Path | None = None
    """Published weights to start from: official Wan, diffusers, FlowWAM (dit_layouts.load_dit); from scratch if left out."""


@dataclass(frozen=True)
class TrainSettings:
    batch: int = 4
    """Number of samples of a step, over all devices."""
    steps: int = 7500
    """Number of steps; 0 where `epochs` gives the length."""
    epochs: float = 0.0
    """Passes over the training samples; give this or `steps`."""
    seed: int = 0
    optimizer: Literal["adamw", "muon"] = "muon"
    """AdamW as in the paper, or Muon for the matrices of the blocks and AdamW for the rest."""
    learning_rate: float = 2e-3
    """Peak of the learning rate."""
    warmup_steps: int = 100
    """Number of steps in which the learning rate rises to its peak."""
    decay_to: float = 0.05
    """Cosine decay of the learning rate to this part of its peak at the end; 1 keeps it constant."""
    ema: float = 0.1
    """Reach of the exponential moving average of the parameters, as a fraction of the run's steps; 0 keeps none. Samples and
    rollouts use the average."""
    motion_loss_weight: float = 4.0
    """Places that differ from the clip's first frame weigh up to 1 + this times as much in the loss; 0 weighs all alike."""
    shift: float = 5.0
    """Shift of the noise levels, in training and in sampling."""
    history_noise: float = 0.0
    """Standard deviation of what is added to earlier frames' latents in training; Ctrl-World has 0.3."""
    chunks: Literal[1, 2] = 1
    """Consecutive clips of a sample; the second starts from the predicted, not the true, end of the first."""
    accumulate: int = 1
    """Parts of the batch that are computed one after another: less memory, the same step."""
    mu_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the optimizer's first moment, and of what Muon makes orthogonal; bfloat16 saves two bytes a parameter, and
    some of the time of Muon's products (docs/performance.md)."""
    log_every: int = 50
    save_every: int = 2500
    sample_every: int = 0
    """Number of steps between sample videos in TensorBoard; 0 draws none."""
    keep_checkpoints: int = 2


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
    sampler: str = "unipc"
    """One of SAMPLERS."""
    noise_schedule: str = "flowwam"
    """One of SCHEDULES, each by the name of the project that has it."""
    steps: int = 8
    """Number of evaluations of the network a chunk."""
    guidance: float = 1.0
    """Classifier-free guidance against `negative_prompt`; 1 is none and costs nothing. Wan's own sampling has 5; networks
    trained here have never gone without their instruction."""
    negative_prompt: str = ""
    batch: int = 15
    """Number of episodes at once over all devices."""
    max_frames: int = 0
    """Number of frames of an episode that are predicted, from its first; 0 predicts all."""
    seed: int = 0


def count_replayed(batch: int, replay: float) -> int:
    """Number of samples of a batch that are replayed: the nearest whole one, at least one where any are asked for."""
    return max(1, round(batch * replay)) if replay else 0
