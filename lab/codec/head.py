"""Train the render head that ships with the codec, from packed groups of frames to a file of weights.

Reads  episodes with pictures, and rollouts of such episodes
Writes pack: <out>/{truth,render,first,scene,episode,predicted}.npy, memory-mapped; train: weights as .safetensors

A sample is a group of four frames of an episode: the truth, the commanded render around it, the episode's first frame and, with
`--carried`, the scene in which grippers carry objects, which is given in the first frame's place. What the head is given was
decoded from the truth's latents, half of the time with noise, or was predicted by a model. The robot and what moves weigh more.
Nothing of the truth but the first frame reaches the head.
Command: python -m lab.codec.head pack --data DATA --robots body:0-11 --out PACK [--rollouts ROLLOUTS]
         python -m lab.codec.head train --packs PACK … --out xew/model/codecs/render_head.safetensors
"""

import functools
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import nnx
from jax import Array

from xew.compilation import keep_compiled_programs
from xew.concurrency import map_in_order, usable_cores
from xew.dataset import Episode, read_dataset
from xew.episode import episode_folder, read_pixels
from xew.metrics import lpips
from xew.model.codecs.autoencoders import ConvAutoencoderCodec
from xew.model.codecs.contract import CodecSettings, GivenFrames, given_frames, to_signed
from xew.model.codecs.conv_autoencoder import save_weights
from xew.model.codecs.render_head import HeadSize, RenderHead, robot_pixels
from xew.model.codecs.vae_layers import as_row
from xew.model.episodes.commands import episode_command
from xew.model.video.frames import TEMPORAL_FACTOR, padding_to
from xew.protocol import expand_robots
from xew.rollout import read_rollout, read_rollout_video

HEIGHT, WIDTH = 256, 320
"""Size of the frames that the head works on [pixels], as of configs/fixed.yaml."""
CAMERA = (240, 320, 3)
LEAST_MOTION = 40 / 127.5
"""Difference of a channel from the first frame, in [-1, 1], from which a pixel counts as one that moves."""
LOADERS = 8
"""Number of threads that read batches."""
SAVED_EVERY = 1000
"""Steps between savings of the weights."""
LOGGED_EVERY = 200
"""Steps between printed errors."""
WARM_UP = 200
"""Steps of linear warm-up."""
AHEAD = 3
"""Largest number of steps that wait for the device."""


@dataclass(frozen=True)
class Pack:
    """Cut groups of frames out of episodes and write them as memory-mapped arrays."""

    data: Path
    out: Path
    robots: tuple[str, ...]
    rollouts: Path | None = None
    """Rollouts of the whole episodes; an episode without one is left out."""
    carried: bool = False
    """Whether the scene with carried objects is written too."""
    every: int = 3
    """Groups of an episode of which one is taken."""


@dataclass(frozen=True)
class Train:
    """Train a head on packed groups."""

    packs: tuple[Path, ...]
    out: Path
    seconds: float = 400.0
    """Time of training after the first step [s]."""
    predicted: float = 0.5
    """Share of batches from packs of rollouts, where there are any."""
    batch: int = 8
    """Groups of four frames a step."""
    learning_rate: float = 1e-3
    noise: float = 0.5
    """Largest standard deviation of noise on standardized latents, in half of the samples."""
    robot_weight: float = 3.0
    """Weight of the robot's pixels beyond that of others."""
    motion_weight: float = 3.0
    """Weight of pixels that move and are not the robot, beyond that of others."""
    lpips: float = 0.3
    """Weight of LPIPS."""
    gradient: float = 0.5
    """Weight of the image's gradients."""
    seed: int = 0
    size: HeadSize = field(default_factory=HeadSize)


class Group(NamedTuple):
    """Samples: arrays uint8 with a leading axis."""

    truth: Any
    """[n 4 h w 3]."""
    render: Any
    """[n 6 h w 3]."""
    first: Any
    """[n 1 h w 3]."""
    scene: Any
    """[n 4 h w 3], or None."""
    predicted: Any
    """[n 4 h w 3], or None."""


def list_starts(frames: int, seed: int, every: int) -> range:
    """First frames of every `every`-th group of four of an episode, behind its first frame."""
    return range(1 + TEMPORAL_FACTOR * (seed % every), frames - TEMPORAL_FACTOR + 1, TEMPORAL_FACTOR * every)


def pack(args: Pack) -> None:
    """Write the groups of a data set, or of its rollouts; episodes are read in as many processes as there are cores."""
    episodes = [
        (folder, record)
        for folder, record in read_dataset(args.data).select(robots=expand_robots(args.robots), split="train", faults=False)
        if args.rollouts is None or (_rollout(args, record) / "rgb.mkv").exists()
    ]
    counts = [len(list_starts(record.frame_count, record.seed, args.every)) for _, record in episodes]
    total, (height, width, channels) = sum(counts), CAMERA
    shapes = {"truth": (total, 4), "render": (total, 6), "first": (len(episodes), 1)}
    shapes |= {"scene": (total, 4)} if args.carried else {}
    shapes |= {"predicted": (total, 4)} if args.rollouts is not None else {}
    args.out.mkdir(parents=True)
    for name, shape in shapes.items():
        np.lib.format.open_memmap(args.out / f"{name}.npy", "w+", np.uint8, (*shape, height, width, channels)).flush()
    np.save(args.out / "episode.npy", np.repeat(np.arange(len(episodes)), counts))
    offsets = np.cumsum([0, *counts])[:-1].tolist()
    with ProcessPoolExecutor(usable_cores()) as processes:
        list(processes.map(functools.partial(_pack_episode, args), range(len(episodes)), episodes, offsets))
    print(f"{args.out}: {total} groups of {len(episodes)} episodes", flush=True)


def _rollout(args: Pack, record: Any) -> Path:
    assert args.rollouts is not None
    return episode_folder(args.rollouts, record.task, record.seed, record.robot)


def _pack_episode(args: Pack, number: int, episode: Episode, offset: int) -> None:
    """Write the groups of one episode behind those of the episodes before."""
    folder, record = episode
    arrays = {path.stem: np.load(path, mmap_mode="r+") for path in args.out.glob("*.npy") if path.stem != "episode"}
    truth, render = (read_pixels(folder, name, record=record) for name in ("rgb", "robot"))
    predicted = read_rollout_video(read_rollout(_rollout(args, record))) if args.rollouts is not None else None
    scene = episode_command(folder, record, render, truth).carried_scene if args.carried else None
    arrays["first"][number] = truth[:1]
    for row, start in enumerate(list_starts(record.frame_count, record.seed, args.every), offset):
        arrays["truth"][row] = truth[start : start + TEMPORAL_FACTOR]
        arrays["render"][row] = given_frames(render, truth[:1], start, TEMPORAL_FACTOR).render
        if scene is not None:
            arrays["scene"][row] = scene[start : start + TEMPORAL_FACTOR]
        if predicted is not None:
            arrays["predicted"][row] = predicted[start : start + TEMPORAL_FACTOR]


@dataclass(frozen=True)
class Packed:
    """Arrays of a pack by name, mapped from the disk."""

    arrays: dict[str, np.ndarray]

    def take(self, rows: np.ndarray) -> Group:
        """The groups of some rows."""
        first = self.arrays["first"][self.arrays["episode"][rows]]
        scene, predicted = (self.arrays[name][rows] if name in self.arrays else None for name in ("scene", "predicted"))
        return Group(self.arrays["truth"][rows], self.arrays["render"][rows], first, scene, predicted)


def open_pack(folder: Path) -> Packed:
    """Map the arrays of a pack."""
    return Packed({path.stem: np.load(path, mmap_mode="r") for path in folder.glob("*.npy")})


def draw_batches(args: Train, packs: Sequence[Packed]) -> Iterator[tuple[Packed, np.ndarray]]:
    """Endless batches of rows of one pack; packs of one kind are drawn by their size."""
    rng = np.random.default_rng(args.seed)
    kinds = [[p for p in packs if ("predicted" in p.arrays) is predicted] for predicted in (False, True)]
    while True:
        chosen = kinds[1] if kinds[1] and (not kinds[0] or rng.random() < args.predicted) else kinds[0]
        sizes = np.array([len(p.arrays["truth"]) for p in chosen])
        packed = chosen[rng.choice(len(chosen), p=sizes / sizes.sum())]
        yield packed, np.sort(rng.integers(len(packed.arrays["truth"]), size=args.batch))


def pad(frames: Array) -> Array:
    """Camera frames [... 240 320 3] uint8 to the model's size."""
    top, bottom, left, right = padding_to(HEIGHT, WIDTH)
    widths = [(0, 0)] * (frames.ndim - 3) + [(top, bottom), (left, right), (0, 0)]
    return jnp.pad(frames, widths, mode="edge")


def vary(key: Array, group: Group) -> Group:
    """Mirror half of the samples and permute the color channels of half, all pictures of a sample alike."""

    def one(key: Array, *parts: Array) -> tuple[Array, ...]:
        flip, permute, order = jax.random.split(key, 3)
        channels = jnp.where(jax.random.uniform(permute) < 0.5, jax.random.permutation(order, 3), jnp.arange(3))
        mirrored = jax.random.uniform(flip) < 0.5
        return tuple(jnp.take(jnp.where(mirrored, part[..., ::-1, :], part), channels, axis=-1) for part in parts)

    parts = [part for part in group if part is not None]
    varied = iter(jax.vmap(one)(jax.random.split(key, len(parts[0])), *parts))
    return Group(*(None if part is None else next(varied) for part in group))


def decode_noisy(codec: ConvAutoencoderCodec, truth: Array, key: Array, most: float) -> Array:
    """What the codec makes of groups [b 4 h w 3], with noise on the standardized latents of half of them."""
    strength, half, normal = jax.random.split(key, 3)
    autoencoder, shape = codec.autoencoder, (len(truth), 1, 1, 1)
    latents = autoencoder.encode_groups(truth)
    level = jnp.where(jax.random.bernoulli(half, 0.5, shape), most * jax.random.uniform(strength, shape), 0)
    noise = as_row(autoencoder.latents_std[...], 4) * jax.random.normal(normal, latents.shape)
    return jnp.clip(autoencoder.decode_groups(latents + level * noise), -1, 1)


def head_loss(
    head: RenderHead, decoded: Array, given: GivenFrames, first: Array, truth: Array, key: Array, args: Train
) -> tuple[Array, Array]:
    """The loss, and the mean absolute difference, of groups of frames [b 4 h w 3] in [-1, 1]."""
    frames = head(decoded, given)
    robot = robot_pixels(to_signed(given.render[:, 1:-1]))
    differs = jnp.abs(truth - to_signed(first)).max(axis=-1, keepdims=True) > LEAST_MOTION
    moves = differs.astype(robot.dtype) * (1 - robot)
    weights = 1 + args.robot_weight * robot + args.motion_weight * moves
    difference = weights * jnp.abs(frames - truth)
    slopes = sum(
        (weights.take(jnp.arange(1, weights.shape[axis]), axis) * jnp.abs(jnp.diff(frames - truth, axis=axis))).sum()
        for axis in (2, 3)
    )
    norm = 3 * weights.sum()
    chosen = jax.random.randint(key, (), 0, TEMPORAL_FACTOR)
    pair = ((jnp.take(video, chosen, axis=1) + 1) / 2 for video in (frames, truth))
    perceptual = lpips(*pair, chunk=len(frames), exact=False).mean() if args.lpips else jnp.float32(0)
    return difference.sum() / norm + args.gradient * slopes / norm + args.lpips * perceptual, jnp.abs(frames - truth).mean()


class HeadState(NamedTuple):
    """State of the training of a head."""

    params: Any
    moments: Any
    average: Any
    """Moving average of the parameters, which is what is saved."""
    number: Array
    """Number of steps done."""


def make_step(args: Train, graph: nnx.GraphDef, optimizer: optax.GradientTransformation) -> Callable[..., Any]:
    """The compiled step (state, groups uint8, codec, learning rate) -> (state, mean absolute error)."""

    @functools.partial(jax.jit, donate_argnums=0)
    def step(state: HeadState, group: Group, codec: Any, rate: Array) -> tuple[HeadState, Array]:
        keys = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), state.number), 3)
        varied = vary(keys[0], Group(*(None if part is None else pad(part) for part in group)))
        truth, scene = to_signed(varied.truth), varied.first if varied.scene is None else varied.scene
        given = GivenFrames(varied.render, scene)
        is_predicted = varied.predicted is not None
        decoded = to_signed(varied.predicted) if is_predicted else decode_noisy(codec, truth, keys[1], args.noise)

        def loss(params: Any) -> tuple[Array, Array]:
            return head_loss(nnx.merge(graph, params), decoded, given, varied.first, truth, keys[2], args)

        (_, error), gradients = jax.value_and_grad(loss, has_aux=True)(state.params)
        updates, moments = optimizer.update(gradients, state.moments, state.params)
        params = optax.apply_updates(state.params, jax.tree.map(lambda update: -rate * update, updates))
        decay = jnp.minimum(0.999, (1 + state.number) / (10 + state.number))
        average = optax.incremental_update(params, state.average, 1 - decay)
        return HeadState(params, moments, average, state.number + 1), error

    return step


def train_head(args: Train, codec: ConvAutoencoderCodec, packs: Sequence[Packed]) -> RenderHead:
    """Train for `args.seconds` after the first steps, and return the head of the averaged parameters."""
    graph, params = nnx.split(RenderHead(args.size, dtype=jnp.bfloat16, rngs=nnx.Rngs(args.seed)))
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    step = make_step(args, graph, optimizer)
    state = HeadState(params, optimizer.init(params), jax.tree.map(jnp.copy, params), jnp.int32(0))
    begin, errors = math.inf, deque[Array](maxlen=LOGGED_EVERY)
    batches = map_in_order(lambda batch: jax.device_put(batch[0].take(batch[1])), draw_batches(args, packs), LOADERS)
    for number, group in enumerate(batches, start=1):
        passed = max(time.perf_counter() - begin, 0.0)
        if passed >= args.seconds:
            break
        rate = args.learning_rate * min(1, number / WARM_UP) * (1 - passed / args.seconds)
        state, error = step(state, group, codec, jnp.float32(rate))
        errors.append(error)
        errors[max(len(errors) - AHEAD, 0)].block_until_ready()  # so few steps wait, and the clock is the device's
        if number == AHEAD:
            begin = time.perf_counter()
        if number % LOGGED_EVERY == 0:
            print(f"{number} steps, {passed:.0f} s, mean error {np.mean(jax.device_get(list(errors))):.5f}", flush=True)
        if number % SAVED_EVERY == 0:
            save_weights(nnx.merge(graph, state.average), args.out)
    return nnx.merge(graph, state.average)


def train(args: Train) -> None:
    """Train a head and write its weights."""
    keep_compiled_programs()
    codec = ConvAutoencoderCodec.open(CodecSettings(dtype="bfloat16"))
    save_weights(train_head(args, codec, [open_pack(folder) for folder in args.packs]), args.out)


Command = Annotated[Pack, tyro.conf.subcommand("pack")] | Annotated[Train, tyro.conf.subcommand("train")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Pack groups, or train a head."""
    args = tyro.cli(Command, args=arguments, description=(__doc__ or "").splitlines()[0])
    pack(args) if isinstance(args, Pack) else train(args)


if __name__ == "__main__":
    main()
