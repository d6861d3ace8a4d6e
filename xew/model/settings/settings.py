"""The sections of configs/*.yaml, all but `codec` (codecs/contract.py). The defaults are those of configs/fixed.yaml."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from xew.model.network.spec import NetworkSettings


@dataclass(frozen=True)
class Clip:
    """Size of the clips that the model predicts at once."""

    frames: int = 33
    """Number of frames, 4 k + 1, including the given first frame."""
    height: int = 256
    """Height [pixels]; the camera's 320x240 is padded to the clip's aspect ratio, then resized."""
    width: int = 320


@dataclass(frozen=True)
class ModelSettings(NetworkSettings):
    """The network, its conditions and initial weights."""

    size: str = "small"
    """One of MODELS."""
    action: str = "mask_and_flow_channels"
    """Representation of the commanded motion, one of ACTIONS."""
    embodiment: str = "carried_render_and_shadows"
    """Representation of the robot's appearance, one of CONDITIONS."""
    reference: Literal["frame", "channels"] = "channels"
    """Input of the clip's first frame: latent frame 0 alone, as in Wan, or the channels of every latent frame too, as in
    Ctrl-World (arXiv 2510.10125)."""
    text: str = "learned"
    """One of TEXT_ENCODERS: a learned table of words, or Wan's frozen encoder."""
    text_weights: Path | None = None
    """Weights of umt5: models_t5_umt5-xxl-enc-bf16.pth, or diffusers' text_encoder folder."""
    text_tokenizer: Path | None = None
    """Tokenizer of umt5: the folder google/umt5-xxl, or diffusers' tokenizer folder."""
    text_prefix: str = ""
    """Prefix of every instruction, as FlowWAM's published weights expect it."""
    weights: Path | None = None
    """Published weights to start from: official Wan, diffusers or FlowWAM (default: from scratch)."""


@dataclass(frozen=True)
class TrainSettings:
    batch: int = 16
    """Number of samples of a step, over all devices."""
    steps: int = 3000
    """Number of steps; 0 if `epochs` sets the length."""
    epochs: float = 0.0
    """Number of passes over the training samples; 0 if `steps` sets the length."""
    seed: int = 0
    optimizer: Literal["adamw", "muon"] = "muon"
    """AdamW as in the paper, or Muon for the matrices of the blocks and AdamW for the rest."""
    learning_rate: float = 2e-3
    """Peak of the learning rate."""
    warmup_steps: int = 100
    """Number of steps of linear warm-up."""
    decay_to: float = 0.05
    """Final learning rate of the cosine decay relative to its peak; 1 keeps it constant."""
    ema: float = 0.1
    """Reach of the exponential moving average of the parameters, for samples and rollouts, as a fraction of the run's steps; 0
    disables it."""
    motion_loss_weight: float = 4.0
    """Additional weight, up to this, in the loss of positions that differ from the clip's first frame."""
    shift: float = 5.0
    """Shift of the noise levels in training and sampling."""
    history_noise: float = 0.0
    """Standard deviation of the noise on earlier frames' latents in training; 0.3 in Ctrl-World."""
    chunks: Literal[1, 2] = 1
    """Number of consecutive clips in a sample; the second starts from the predicted end of the first."""
    accumulate: int = 1
    """Number of sequential parts of a batch (gradient accumulation), to save memory."""
    mu_dtype: Literal["float32", "bfloat16"] = "bfloat16"
    """Type of the optimizer's first moment and of Muon's orthogonalization; bfloat16 saves memory and time
    (docs/performance.md)."""
    log_every: int = 50
    save_every: int = 1000
    samples: int = 3
    """Number of moments, evenly spaced and the last at the end, at which validation episodes are rolled out and graded for
    TensorBoard; 0 disables them."""
    keep_checkpoints: int = 2


@dataclass(frozen=True)
class AdaptSettings:
    """Few-shot adaptation of a run to unseen robots; off without `start_from`."""

    start_from: Path | None = None
    """The run to adapt, from its latest checkpoint."""
    robots: tuple[str, ...] = ()
    """Target robots."""
    episodes: int = 1
    """Number of episodes of each task and robot, from the first accepted training seeds (M in the paper)."""
    replay: float = 0.0
    """Part of every batch from the run's training robots; 0 as in the paper."""
    lora_rank: int = 0
    """Rank of LoRA corrections; 0, as in the paper, trains all weights."""


@dataclass(frozen=True)
class RolloutSettings:
    sampler: str = "unipc"
    """One of SAMPLERS."""
    noise_schedule: str = "flowwam"
    """One of SCHEDULES, which are named after projects."""
    steps: int = 4
    """Number of network evaluations for each chunk."""
    guidance: float = 1.0
    """Classifier-free guidance against `negative_prompt`; 1 disables it. Wan uses 5, but xew trains without dropping
    instructions."""
    negative_prompt: str = ""
    batch: int = 15
    """Number of episodes that a GPU predicts at once."""
    max_frames: int = 0
    """Number of frames to predict of each episode; 0 predicts all."""
    seed: int = 0


def count_replayed(batch: int, part: float) -> int:
    """Number of replayed samples of a batch: the nearest integer, at least one if their part is positive."""
    return max(1, round(batch * part)) if part else 0
