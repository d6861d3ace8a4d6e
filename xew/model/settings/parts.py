"""The parts that an experiment is resolved into, each for one place that takes it."""

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
    """What the network is given of a clip: how it is cut, and which conditions go with it."""

    clip: Clip
    chunks: int
    """Consecutive clips of a training sample."""
    history: tuple[int, ...]
    """Earlier frames, counted from the clip's first."""
    conditions: dict[str, Condition]
    """Conditions by the stream or mechanism that each feeds; `.name` is a condition's name in the cache."""
    shapes: dict[str, tuple[int, ...]]
    """Shapes of a clip's arrays by stream or mechanism, rgb and text included: latents [t h w c], numbers [t n], text [l e] or
    [l]."""
    patch: Patch
    """Latent frames, rows and columns of a token of the network."""

    @property
    def latent_shape(self) -> tuple[int, ...]:
        """Shape [t h w c] of one RGB clip."""
        return self.shapes["rgb"]

    @property
    def grids(self) -> list[TokenGrid]:
        """Tokens (t', h', w') of each stream, RGB first."""
        streams = ["rgb", *(name for name in self.conditions if name in STREAMS)]
        return [token_grid((1, *self.shapes[name]), self.patch) for name in streams]


@dataclass(frozen=True)
class Encoding:
    """How episodes become latents, and where these are kept: everything that the latent cache depends on."""

    inputs: ClipInputs
    codec: CodecSettings
    kind: type[Codec]
    """Class of codec that the settings name."""
    folder: Path
    data: Path
    start_from: Path | None
    """Run whose codec and scales are used, in an adaptation."""
    autoencoder: VaeSize | None = None
    """Size of the video autoencoder, where the codec is one."""

    @property
    def remedy(self) -> str:
        """What to do where the cache lacks something."""
        return f"run `python -m xew.model.latents CONFIG --data {self.data}`, with the other choices of this command too"


@dataclass(frozen=True)
class EpisodeChoice:
    """Which episodes of a data set a training run reads; every robot by its own key."""

    robots: tuple[str, ...]
    """Robots whose training episodes are learned from."""
    shots: int = 0
    """Number of episodes of each task and robot in an adaptation, which needs them of all robots; 0 takes all there are."""
    replay: tuple[str, ...] = ()
    """Robots whose training episodes are replayed, in an adaptation with replay."""
    samples: Mapping[str, str] = field(default_factory=dict)
    """Roles of the robots that sample videos are drawn of: seen, unseen or target."""
    motion: str = SHARED_MOTION
    """Kind of motion of the episodes, as the split names it."""


@dataclass(frozen=True)
class TrainSpec:
    """What a run trains and how: the network, its inputs, and the settings of optimizer and loss."""

    network: Network
    inputs: ClipInputs
    settings: TrainSettings
    """With `steps` once the number of samples is known, see `with_steps`."""
    replay: float = 0.0
    """Part of every batch that is replayed, in an adaptation."""
    lora_rank: int = 0
    """Rank of the corrections that are learned; 0 learns all weights."""

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Optimizer of these settings."""
        return make_optimizer(self.settings)

    def with_steps(self, samples: int) -> "TrainSpec":
        """The same with the length of the run in steps, for so many new (not replayed) training samples."""
        return replace(self, settings=set_steps(self.settings, samples, self.replay))


def pick_conditions(settings: ModelSettings) -> list[Condition]:
    """Look up the conditions of action, embodiment and history. Raises ConfigError for a name that does not exist."""
    action, embodiment = pick(ACTIONS, settings.action, "action", (tuple,)), pick(CONDITIONS, settings.embodiment, "embodiment")
    return [*list_conditions(action), *list_conditions(embodiment), *([HISTORY] if settings.history else [])]


def sample_roles(split: Split, targets: Iterable[str] = ()) -> dict[str, str]:
    """Roles of the robots that samples are drawn of: those that choices are made by (`validation_split`), and targets."""
    chosen = validation_split(split)
    roles = dict.fromkeys(chosen.train_robots, "seen") | dict.fromkeys(chosen.held_out_robots, "unseen")
    return roles | dict.fromkeys(targets, "target")
