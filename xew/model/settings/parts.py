"""The parts of an experiment."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import optax

from xew.config import pick
from xew.model.codecs.contract import Codec, CodecSettings
from xew.model.codecs.vae import VaeSize
from xew.model.conditions import ACTIONS, CONDITIONS, HISTORY, Condition, list_conditions
from xew.model.network.dit import STREAMS, token_grid
from xew.model.network.spec import Network
from xew.model.network.tokens import Patch, TokenGrid
from xew.model.settings.optimizer import make_optimizer, set_steps
from xew.model.settings.settings import Clip, ModelSettings, TrainSettings
from xew.protocol import SHARED_MOTION, Split, validation_split


@dataclass(frozen=True)
class ClipInputs:
    """The network's inputs of a clip."""

    clip: Clip
    chunks: int
    """Number of consecutive clips in a training sample."""
    history: tuple[int, ...]
    """Earlier frames, relative to the clip's first."""
    conditions: dict[str, Condition]
    """Conditions by stream or mechanism."""
    shapes: dict[str, tuple[int, ...]]
    """Shapes of a clip's arrays by stream or mechanism: latents [t h w c], numbers [t n], text [l e] or [l]."""
    patch: Patch

    @property
    def latent_shape(self) -> tuple[int, ...]:
        """Shape [t h w c] of a clip's RGB latents."""
        return self.shapes["rgb"]

    @property
    def grids(self) -> list[TokenGrid]:
        """Tokens (t', h', w') of each stream, RGB first."""
        streams = ["rgb", *(name for name in self.conditions if name in STREAMS)]
        return [token_grid((1, *self.shapes[name]), self.patch) for name in streams]


@dataclass(frozen=True)
class Encoding:
    """Everything on which the latent cache depends."""

    inputs: ClipInputs
    codec: CodecSettings
    kind: type[Codec]
    """Class of the codec."""
    folder: Path
    """Folder of the cache."""
    data: Path
    start_from: Path | None
    """Run of an adaptation, whose codec and scales are used."""
    autoencoder: VaeSize | None = None
    """Size of the codec wan_vae."""

    @property
    def remedy(self) -> str:
        """Remedy for an incomplete cache."""
        return f"run `python -m xew.model.latents CONFIG --data {self.data}`, with the other options of this command too"


@dataclass(frozen=True)
class EpisodeChoice:
    """Selection of a training run's episodes."""

    robots: tuple[str, ...]
    """Training robots."""
    shots: int = 0
    """Number of episodes of each task and robot in an adaptation; 0 takes all."""
    replay: tuple[str, ...] = ()
    """Replayed robots of an adaptation."""
    samples: Mapping[str, str] = field(default_factory=dict)
    """Roles (seen, unseen or target) of the robots in sample videos."""
    motion: str = SHARED_MOTION
    """Kind of motion, as in the split."""


@dataclass(frozen=True)
class TrainSpec:
    """Specification of a training run: the network, its inputs, and the settings of optimizer and loss."""

    network: Network
    inputs: ClipInputs
    settings: TrainSettings
    replay: float = 0.0
    """Part of every batch from replayed episodes."""
    lora_rank: int = 0
    """Rank of the LoRA corrections; 0 trains all weights."""

    @property
    def optimizer(self) -> optax.GradientTransformation:
        return make_optimizer(self.settings)

    def with_steps(self, samples: int) -> "TrainSpec":
        """The same with `steps` set for this number of fresh training samples."""
        return replace(self, settings=set_steps(self.settings, samples, self.replay))


def pick_conditions(settings: ModelSettings) -> list[Condition]:
    """Look up the conditions of action, embodiment and history. Raises ConfigError for an unknown name."""
    action, embodiment = pick(ACTIONS, settings.action, "action", (tuple,)), pick(CONDITIONS, settings.embodiment, "embodiment")
    return [*list_conditions(action), *list_conditions(embodiment), *([HISTORY] if settings.history else [])]


def sample_roles(split: Split, targets: Iterable[str] = ()) -> dict[str, str]:
    """Roles of the robots in sample videos: the validation split's, and targets."""
    chosen = validation_split(split)
    roles = dict.fromkeys(chosen.train_robots, "seen") | dict.fromkeys(chosen.held_out_robots, "unseen")
    return roles | dict.fromkeys(targets, "target")
