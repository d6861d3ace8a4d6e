"""Training an autoencoder of Wan2.2's kind on the project's own frames: episodes to a file of weights.

Reads  episodes of training robots and training seeds; held-out robots and test seeds for the report
Writes <out>/vae.safetensors and vae.json, which `codec.weights: <out>` reads; config, checkpoints, metrics, pictures

The loss is L1 + LPIPS + a small KL divergence, without an adversary: frames are rendered, and sharp edges are few.
Command: python -m xew.model.train_vae CONFIG [--resume | --overwrite] [--train.steps … and other overrides]
"""

import functools
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from tqdm import tqdm

from xew.command_line import parse_command
from xew.compilation import keep_compiled_programs
from xew.config import ConfigError, load, pick, user_errors
from xew.dataset import Dataset, Episode, read_dataset
from xew.episode import read_video
from xew.model.codecs.ceiling import Ceiling, choose_evenly, measure_ceiling
from xew.model.codecs.codec import WanVaeCodec, to_signed
from xew.model.codecs.vae import VAES, LatentStatistic, VaeSize, VideoVae
from xew.model.codecs.vae_layouts import save_vae
from xew.model.episodes.choice import training_episodes
from xew.model.experiment import beside
from xew.model.runs.checkpoint import TrainState, restore_state
from xew.model.runs.folder import check_one_of, claim_run
from xew.model.runs.log import RunLog
from xew.model.runs.session import open_session
from xew.model.settings.checks import check_least
from xew.model.settings.optimizer import learning_rate, make_optimizer
from xew.model.settings.parts import EpisodeChoice
from xew.model.settings.settings import Clip, TrainSettings
from xew.model.training.loop import STOPPED, Meter, Timetable, run_steps
from xew.model.training.vae_data import Cut, check_streams, make_dataset, random_clips, video_files
from xew.model.video.comparison import strip
from xew.protocol import SPLITS, Split

CEILING_CLIPS = 16
SMALLEST_DEVIATION = 1e-3
"""Smallest deviation of a latent channel, so that one that the autoencoder leaves unused is not blown up."""


@dataclass(frozen=True)
class VaeTrainSettings:
    steps: int
    batch: int
    """Number of clips a step."""
    frames: int = 17
    """Number of frames of a clip, 4 k + 1. Latents further on than any that were trained lose 5 dB with clips of 5 frames."""
    crop: int = 128
    """Side of the square that is cut out of a frame, at most the frame's."""
    clips_of_a_video: int = 4
    """Clips that are cut out of a video once it is decoded."""
    seed: int = 0
    learning_rate: float = 5e-4
    warmup_steps: int = 100
    decay_to: float = 0.05
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    ema_decay: float = 0.999
    lpips: float = 0.2
    """Weight of LPIPS beside the mean absolute difference on a scale of -1 to 1."""
    kl: float = 1e-4
    """Weight of the divergence from the unit normal distribution, mean over latent numbers."""
    statistics_clips: int = 128
    """Number of clips from which the mean and deviation of the latents are computed at the end."""
    log_every: int = 20
    save_every: int = 500
    sample_every: int = 500
    """Number of steps between sample pictures; 0 draws none."""
    keep_checkpoints: int = 1


@dataclass(frozen=True)
class VaeExperiment:
    """What configs/vae_*.yaml hold."""

    data: Path
    """Episodes, made by `python -m xew.sim_warp.generate`."""
    out: Path
    clip: Clip
    """Clip of the world model that is to use it: what the statistics and the report are computed on."""
    train: VaeTrainSettings
    vae: str = "small"
    """One of VAES."""
    split: str = "fixed"
    """Split, one of protocol.SPLITS: which robots train."""
    streams: tuple[str, ...] = ("rgb", "rgb", "robot_render", "optical_flow")
    """Streams that are learned from: the scene and conditions that are pictures; one named twice comes twice as often."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the activations."""
    cache: Path | None = None
    """Pictures that no episode has as a file; beside the data where left out."""

    @property
    def size(self) -> VaeSize:
        return pick(VAES, self.vae, "autoencoder")

    @property
    def robots(self) -> Split:
        return pick(SPLITS, self.split, "split")

    @property
    def cache_folder(self) -> Path:
        return self.cache or beside(self.data, "frames")

    @property
    def optimizer(self) -> TrainSettings:
        """The settings of the optimizer as the world model's training names them."""
        names = ("batch", "steps", "learning_rate", "warmup_steps", "decay_to", "weight_decay", "clip_norm")
        return TrainSettings(**{name: getattr(self.train, name) for name in names})

    def cut(self, *, whole: bool = False) -> Cut:
        """What is cut out of a video: crops for training, or one whole clip of the model's."""
        size = self.clip.height, self.clip.width
        if whole:
            return Cut(1, self.clip.frames, size, size)
        crop = min(self.train.crop, size[0]), min(self.train.crop, size[1])
        return Cut(self.train.clips_of_a_video, self.train.frames, size, crop)


LEAST = {
    "clip.frames": 1,
    "train.steps": 1,
    "train.batch": 1,
    "train.frames": 1,
    "train.clips_of_a_video": 1,
    "train.learning_rate": 0,
    "train.warmup_steps": 0,
    "train.ema_decay": 0,
    "train.lpips": 0,
    "train.kl": 0,
    "train.statistics_clips": 1,
    "train.log_every": 1,
    "train.save_every": 1,
    "train.sample_every": 0,
    "train.keep_checkpoints": 1,
}
"""Numbers of a config that mean nothing below."""


def load_vae_experiment(path: Path | str, overrides: Sequence[str] = ()) -> VaeExperiment:
    """Read and check a config. Raises ConfigError with what does not exist or does not fit."""
    return check_choices(load(VaeExperiment, path, overrides), path)


def check_choices(experiment: VaeExperiment, path: Path | str) -> VaeExperiment:
    """The experiment itself. Raises ConfigError, naming its path, if one of its choices does not exist or does not fit."""
    check_least(LEAST, experiment, str(path))
    check_streams(experiment.streams)
    _ = experiment.robots
    factor, clip, train = experiment.size.spatial_factor, experiment.clip, experiment.train
    for name, frames in (("clip.frames", clip.frames), ("train.frames", train.frames)):
        if frames % 4 != 1:
            raise ConfigError(f"{path}: {name} is {frames}; it must be 4 k + 1, for example {max(5, frames // 4 * 4 + 1)}.")
    for name, side in (("clip.height", clip.height), ("clip.width", clip.width), ("train.crop", train.crop)):
        if side % factor or side < 32:
            raise ConfigError(
                f"{path}: {name} is {side}; it must be a multiple of {factor} (the factor of {experiment.vae})"
                " and at least 32 (for LPIPS)."
            )
    if train.batch % train.clips_of_a_video:
        raise ConfigError(f"{path}: train.batch is {train.batch}; it must be a multiple of train.clips_of_a_video.")
    return experiment


class Losses(NamedTuple):
    """Parts of the loss of one step, each a scalar."""

    total: jax.Array
    l1: jax.Array
    lpips: jax.Array
    kl: jax.Array
    psnr: jax.Array
    """Decibels, of the batch."""
    gradient_norm: jax.Array
    finite: jax.Array
    """Whether the loss and the gradients are finite."""


def vae_losses(vae: VideoVae, frames: jax.Array, key: jax.Array, settings: VaeTrainSettings) -> Losses:
    """The loss of frames [b t h w 3] in [-1, 1], with latents drawn from what the encoder gives."""
    from xew.metrics import lpips  # only here: the model room does without metrics

    mean, log_variance = vae.moments(frames)
    latents = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
    decoded = vae.decode_moments(latents)
    l1 = jnp.abs(decoded - frames).mean()
    made, true = ((jnp.clip(x, -1, 1).reshape(-1, *x.shape[2:]) + 1) / 2 for x in (decoded, frames))
    at_once = len(made) if jax.default_backend() == "gpu" else frames.shape[1]
    perceptual = lpips(made, true, chunk=at_once).mean() if settings.lpips else jnp.float32(0)
    kl = 0.5 * (jnp.square(mean) + jnp.exp(log_variance) - 1 - log_variance).mean()
    psnr = -10 * jnp.log10(jnp.square(made - true).mean() + 1e-10)
    total = l1 + settings.lpips * perceptual + settings.kl * kl
    return Losses(total, l1, perceptual, kl, psnr, jnp.float32(0), jnp.isfinite(total))


def make_vae_step(graph: nnx.GraphDef, statistics: Any, experiment: VaeExperiment) -> Callable[..., tuple[TrainState, Losses]]:
    """The compiled step; its noise depends on the seed and the step alone, so that a resumed run repeats it."""
    settings, optimizer = experiment.train, make_optimizer(experiment.optimizer)

    @functools.partial(jax.jit, donate_argnums=0)
    def step(state: TrainState, pictures: jax.Array) -> tuple[TrainState, Losses]:
        key = jax.random.fold_in(jax.random.key(settings.seed), state.step)

        def loss(params: Any) -> tuple[jax.Array, Losses]:
            losses = vae_losses(nnx.merge(graph, params, statistics), to_signed(pictures), key, settings)
            return losses.total, losses

        (_, losses), gradients = jax.value_and_grad(loss, has_aux=True)(state.params)
        updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        # The average of few steps is over those alone; else the random start would stay in it.
        decay = jnp.minimum(settings.ema_decay, (1 + state.step) / (10 + state.step))
        ema = optax.incremental_update(params, state.ema, 1 - decay)
        norm = optax.tree.norm(gradients)
        losses = losses._replace(gradient_norm=norm, finite=losses.finite & jnp.isfinite(norm))
        return TrainState(state.step + 1, params, optimizer_state, ema), losses

    return step


def init_vae_state(experiment: VaeExperiment) -> tuple[nnx.GraphDef, Any, TrainState]:
    """Structure, statistics of the latents (0 and 1 until the end) and the state of step 0."""

    key = jax.random.key(experiment.train.seed, impl="unsafe_rbg")  # the other kinds take a minute to compile

    def create() -> VideoVae:
        return VideoVae(experiment.size, dtype=jnp.dtype(experiment.dtype), rngs=nnx.Rngs(key))

    graph: nnx.GraphDef = nnx.split(nnx.eval_shape(create))[0]
    optimizer = make_optimizer(experiment.optimizer)

    @jax.jit
    def init() -> tuple[Any, TrainState]:
        vae = create()
        params, statistics = nnx.state(vae, nnx.Param), nnx.state(vae, LatentStatistic)
        return statistics, TrainState(jnp.int32(0), params, optimizer.init(params), jax.tree.map(jnp.copy, params))

    statistics, state = init()
    return graph, statistics, state


@dataclass(frozen=True)
class Flags:
    """Options of the command itself."""

    resume: bool = False
    """Continue the run in --out if there is one."""
    overwrite: bool = False
    """Replace the run in --out."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Train an autoencoder."""
    read = functools.partial(load, VaeExperiment)
    prog = "python -m xew.model.train_vae"
    command = parse_command(Flags, VaeExperiment, read, arguments, prog=prog, description=__doc__.splitlines()[0])
    experiment, flags = check_choices(command.config, command.path), command.flags
    check_one_of(flags.resume, flags.overwrite)
    keep_compiled_programs()
    if not train_vae(experiment, resume=flags.resume, overwrite=flags.overwrite):
        sys.exit(STOPPED)


def train_vae(experiment: VaeExperiment, *, resume: bool = False, overwrite: bool = False) -> bool:
    """Train to the last step, from the start or from the latest checkpoint; then measure, and write the weights.

    Returns:
        Whether the last step was reached.
    """
    settings, rates = experiment.train, learning_rate(experiment.optimizer)
    dataset = read_dataset(experiment.data)
    episodes = training_episodes(dataset, EpisodeChoice(experiment.robots))
    files = video_files(experiment.streams, episodes, experiment.cache_folder)
    batches = iter(make_dataset(files, experiment.cut(), settings.batch, settings.seed))
    claim_run(experiment.out, experiment, load_vae_experiment, resume=resume, overwrite=overwrite)

    graph, statistics, state = init_vae_state(experiment)
    reported = report_episodes(dataset, experiment.robots)
    sample = sample_clip(experiment, next(iter(reported.values()), episodes)[0])
    timetable = Timetable(settings.steps, settings.log_every, settings.save_every, settings.sample_every, rates)
    with open_session(experiment.out, settings.keep_checkpoints) as session:
        log = session.log
        assert log is not None, "autoencoders are trained by one process"
        if session.step:
            state, position = restore_state(session.checkpoints, state)
            batches.set_state(position)

        def draw_samples(state: TrainState, step: int) -> None:
            codec = WanVaeCodec.from_vae(nnx.merge(graph, state.ema, statistics))
            log.image(step, "sample/unseen", strip(sample, codec.decode(codec.encode(sample))))

        take_step = make_vae_step(graph, statistics, experiment)
        state = run_steps(timetable, session, Meter(summarize, settings.batch), take_step, state, batches, draw_samples)
        ended = int(state.step) >= settings.steps
        if ended:
            finish(experiment, nnx.merge(graph, state.ema, statistics), files, reported, log)
    return ended


def summarize(results: Sequence[Losses]) -> dict[str, float]:
    """Means of the parts of the loss over some steps."""
    names = [name for name in Losses._fields if name != "finite"]
    means = {name: float(np.mean([getattr(result, name) for result in results])) for name in names}
    return {"train/loss": means.pop("total")} | {f"train/{name}": value for name, value in means.items()}


def report_episodes(dataset: Dataset, robots: Split) -> dict[str, list[Episode]]:
    """What the report is of: test seeds of held-out and of seen robots, where there are any."""
    found = {
        "unseen": dataset.select(robots=robots.held_out_robots, split="test"),
        "seen": dataset.select(robots=robots.train_robots, split="test"),
    }
    return {name: choose_evenly(episodes, CEILING_CLIPS) for name, episodes in found.items() if episodes}


def sample_clip(experiment: VaeExperiment, episode: Episode) -> np.ndarray:
    """The clip that is shown in training, [t h w 3] uint8 at the model's size."""
    folder, record = episode
    return random_clips(folder / "rgb.mkv", record.frame_count, experiment.cut(whole=True), np.random.default_rng(0))[0]


def finish(
    experiment: VaeExperiment,
    vae: VideoVae,
    files: Sequence[tuple[Path, int]],
    reported: Mapping[str, Sequence[Episode]],
    log: RunLog,
) -> None:
    """Compute the statistics of the latents, measure the reconstruction, and write the weights with both."""
    mean, std = latent_statistics(vae, files, experiment)
    vae.latents_mean.set_value(mean)
    vae.latents_std.set_value(std)
    save_vae(vae, experiment.out / "vae.safetensors")
    codec = WanVaeCodec.from_vae(vae)
    ceilings = {name: measure_model_clips(experiment, codec, chosen) for name, chosen in reported.items()}
    for name, ceiling in ceilings.items():
        print(f"{name} robots, test seeds: {ceiling}")
        log.scalars(experiment.train.steps, {f"ceiling/{name}/psnr": ceiling.psnr, f"ceiling/{name}/lpips": ceiling.lpips})
    report = {
        "vae": experiment.vae,
        "size": asdict(experiment.size),
        "dtype": experiment.dtype,
        "chunk": codec.chunk,
        "hash": codec.hash,
        "steps": experiment.train.steps,
        "latents_mean": mean.tolist(),
        "latents_std": std.tolist(),
        "reconstruction": {name: asdict(ceiling) for name, ceiling in ceilings.items()},
    }
    (experiment.out / "vae.json").write_text(json.dumps(report, indent=1) + "\n")
    print(f"{experiment.out / 'vae.safetensors'}: use it by {codec_options(experiment)}")


def codec_options(experiment: VaeExperiment) -> str:
    """What tells `latents` and `train` to use the autoencoder."""
    size = experiment.size
    chosen = f"--codec.name wan_vae --codec.vae {experiment.vae} --codec.weights {experiment.out}"
    return f"{chosen} --codec.spatial-factor {size.spatial_factor} --codec.channels {size.channels}"


def measure_model_clips(experiment: VaeExperiment, codec: WanVaeCodec, episodes: Sequence[Episode]) -> Ceiling:
    videos = (read_video(folder / "rgb.mkv") for folder, _ in episodes)
    return measure_ceiling(codec, videos, **asdict(experiment.clip))


def latent_statistics(
    vae: VideoVae, files: Sequence[tuple[Path, int]], experiment: VaeExperiment
) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation [c] of the latents' means over whole clips of all training streams."""
    moments = jax.jit(lambda vae, pictures: vae.moments(to_signed(pictures), chunk=8)[0])
    rng, total, squares, count = np.random.default_rng(0), 0.0, 0.0, 0
    for path, frame_count in tqdm(choose_evenly(files, experiment.train.statistics_clips), desc="statistics", unit="clip"):
        clip = random_clips(path, frame_count, experiment.cut(whole=True), rng)
        latents = np.asarray(moments(vae, clip), np.float64).reshape(-1, experiment.size.channels)
        total, squares, count = total + latents.sum(0), squares + np.square(latents).sum(0), count + len(latents)
    mean = total / count
    std = np.sqrt(np.maximum(squares / count - np.square(mean), 0))
    return jnp.asarray(mean, jnp.float32), jnp.asarray(np.maximum(std, SMALLEST_DEVIATION), jnp.float32)


if __name__ == "__main__":
    main()
