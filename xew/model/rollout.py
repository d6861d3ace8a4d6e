"""Rollouts: a trained model predicts episodes from their first frame and their commands.

Reads  a run, or a config that names published weights; episodes
Writes <out>/<task>/<seed>/<robot>/rgb.mkv (lossless, 320x240) and rollout.json

Episodes are predicted in batches over all devices; while these work on one, the next is read and the last is written.
Command: python -m xew.model.rollout RUN --data DATA --split test [--robots … --out … --rollout.steps …]
"""

import itertools
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh
from tqdm import tqdm

from xew.command_line import find_path, parse_command
from xew.compilation import keep_compiled_programs
from xew.concurrency import usable_cores
from xew.config import CONVERTER, ConfigError, admit, find_config, is_packaged, user_errors
from xew.dataset import Episode
from xew.episode import Record, episode_folder, remove_left_overs
from xew.files import hold_lock, read_json
from xew.model.cache.scales import Scale, load_run_scales
from xew.model.cache.store import load_codec
from xew.model.codecs.contract import Codec
from xew.model.devices.sharding import MeshSettings, make_mesh, replicated_sharding
from xew.model.episodes.choice import select_episodes
from xew.model.experiment import Experiment, parse_experiment
from xew.model.network.dit import cast_params, network_graph
from xew.model.network.dit_layouts import load_dit_params
from xew.model.runs.checkpoint import load_params
from xew.model.runs.folder import load_run_codec, load_run_config
from xew.model.runs.layout import checkpoint_time
from xew.model.sampling.predict import Prediction, Predictor, make_predictor
from xew.model.settings.checks import check_experiment
from xew.model.settings.settings import RolloutSettings
from xew.model.training.step import make_trainer
from xew.model.video.frames import to_camera_size
from xew.rollout import write_rollout

Item = tuple[Episode, dict[str, Any]]
"""An episode to predict and the header that its rollout will have."""
WRITERS = min(8, usable_cores())
"""Threads that compress videos."""
WAITING = 16
"""Videos that may wait for a writer before predicting waits too."""


def load_predictor(run: Path, experiment: Experiment, step: int | None = None) -> tuple[Predictor, int | None]:
    """Load a model, with a copy of it on each device, and the step of its checkpoint.

    Of a config the `model.weights` are taken as they are, and the step is None. The experiment is the config of the run, with
    the sampling settings that were changed.

    Raises:
        ConfigError: there is no such checkpoint, or there are no such weights.
    """
    if is_config(run):
        return load_published(experiment, run), None
    mesh, codec = make_mesh(MeshSettings()), load_run_codec(run, experiment.codec)
    params, step = load_params(run, experiment.network, step, replicated_sharding(mesh))
    scales = load_run_scales(experiment.conditions, run)
    return _place_predictor(experiment, codec, params, mesh, scales), step


def _place_predictor(experiment: Experiment, codec: Codec, params: Any, mesh: Mesh, scales: Mapping[str, Scale]) -> Predictor:
    """The model with its parameters in the types of its products, and a copy of the codec on each device."""
    params = jax.jit(cast_params, static_argnums=0)(network_graph(experiment.network.for_sampling), params)
    return make_predictor(experiment, jax.device_put(codec, replicated_sharding(mesh)), params, scales)


def is_config(run: Path) -> bool:
    """Whether it is a config with published weights, and not the folder of a run."""
    return run.suffix in (".yaml", ".yml") or is_packaged(run)


def default_name(run: Path) -> str:
    """Name of a run's rollouts where the command line gives none."""
    run = find_config(run).resolve()
    return run.stem if is_config(run) else run.name


def load_published(experiment: Experiment, source: Path) -> Predictor:
    """A config's network with its published weights, untrained here.

    Raises:
        ConfigError: the config names no weights, or needs numbers that only training determines.
    """
    if experiment.model.weights is None:
        raise ConfigError(f"{source} names no model.weights; give published ones, or the folder of a run instead of a config.")
    scaled = [condition.name for condition in experiment.conditions.values() if condition.scale != "none"]
    if scaled:
        raise ConfigError(f"{source}: {', '.join(scaled)} is scaled by training episodes; train a run and roll that out.")
    mesh = make_mesh(MeshSettings())
    graph, params = make_trainer(experiment.spec, mesh).random_network()
    params = load_dit_params(graph, params, experiment.model.weights)
    return _place_predictor(experiment, load_codec(experiment.encoding), params, mesh, {})


def check_out(out: Path, data: Path) -> None:
    """Raise ConfigError where rollouts would take the place of the episodes that they predict."""
    if out.resolve() == data.resolve():
        raise ConfigError(f"--out is {out}, where the episodes are; rollouts would replace them, choose another folder.")


def rollout_header(experiment: Experiment, step: int | None, saved: int | None, episode: Episode) -> dict[str, Any]:
    """rollout.json: what was predicted, from what, with what. How many were predicted at once is no part of it.

    Args:
        step, saved: of the checkpoint and when it was saved (`checkpoint_time`), which distinguishes it from the checkpoint of
            another run of the same config; None for published weights.
    """
    _, record = episode
    action, embodiment = experiment.model.action, experiment.model.embodiment
    header = common_header(
        experiment.out.name,
        "+".join(name for name in (action, embodiment) if name != "none") or "none",
        record,
        experiment.rollout.max_frames,
    )
    config = CONVERTER.unstructure(replace(experiment, rollout=replace(experiment.rollout, batch=0)))
    return header | {"checkpoint_step": step, "checkpoint_saved": saved, "config": config}


def common_header(model: str, condition: str, record: Record, max_frames: int = 0) -> dict[str, Any]:
    """What every model's rollout.json says."""
    frames = min(record.frame_count, max_frames) if max_frames else record.frame_count
    return {"model": model, "condition": condition, "source_hash": record.hashes["rgb"], "frame_count": frames}


def is_done(out: Path, episode: Episode, header: dict[str, Any]) -> bool:
    """Whether this very rollout is there already."""
    _, record = episode
    folder = episode_folder(out, record.task, record.seed, record.robot)
    try:
        return read_json(folder / "rollout.json") == header and (folder / "rgb.mkv").exists()
    except (OSError, ValueError):
        return False


def group_by_length(pending: Sequence[Item], size: int) -> Iterator[list[Item]]:
    """Groups of episodes of similar length, so that few chunks are computed for nothing."""
    ordered = sorted(pending, key=lambda item: item[1]["frame_count"])
    for start in range(0, len(ordered), size):
        yield ordered[start : start + size]


class RolloutWriter:
    """Writes rollouts in threads; the block's end waits for all of them. A failed write is raised at the next chance.

    Args:
        out: root of the rollout tree.
        done: called, in the caller's thread, after each rollout that is on disk.
        resize: what brings a video to the size in which it is written, if anything.
    """

    def __init__(
        self, out: Path, done: Callable[[], Any], resize: Callable[[np.ndarray], np.ndarray] | None = to_camera_size
    ) -> None:
        self.out, self.done, self.resize = out, done, resize
        self.threads = ThreadPoolExecutor(WRITERS)
        self.waiting: deque[Future[Path]] = deque()

    def write(self, record: Record, video: np.ndarray, header: dict[str, Any]) -> None:
        """Hand over uint8 [t h w 3]."""
        self.waiting.append(self.threads.submit(self._write, record, video, header))
        while len(self.waiting) > WAITING or (self.waiting and self.waiting[0].done()):
            self._settle()

    def _write(self, record: Record, video: np.ndarray, header: dict[str, Any]) -> Path:
        resized = video if self.resize is None else self.resize(video)
        return write_rollout(self.out, record.task, record.seed, record.robot, resized, header)

    def _settle(self) -> None:
        self.waiting.popleft().result()
        self.done()

    def __enter__(self) -> "RolloutWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """What was handed over is written also where the block ended in an error."""
        self.threads.shutdown(wait=True)
        while kind is None and self.waiting:
            self._settle()


@dataclass(frozen=True)
class _PendingBatch:
    """A batch on the devices."""

    items: list[Item]
    prediction: Prediction

    def hand_over(self, writer: RolloutWriter) -> None:
        for ((_, record), header), video in zip(self.items, self.prediction.fetch(), strict=True):
            writer.write(record, video[: header["frame_count"]], header)


def predict_and_write(predictor: Predictor, pending: Sequence[Item], writer: RolloutWriter) -> None:
    """Roll out episodes and write each as long as its header says; reads one batch ahead of the devices."""
    size = max(min(predictor.settings.batch, len(pending)), 1)
    pending_batch: _PendingBatch | None = None
    for items in group_by_length(pending, size):
        longest = max(header["frame_count"] for _, header in items)
        following = _PendingBatch(items, predictor.begin([episode for episode, _ in items], longest, size))
        if pending_batch is not None:
            pending_batch.hand_over(writer)
        pending_batch = following
    if pending_batch is not None:
        pending_batch.hand_over(writer)


@dataclass(frozen=True)
class Flags:
    """Options of the command itself."""

    checkpoint: int | None = None
    """Step of the run's checkpoint; the latest where left out."""
    data: Path | None = None
    """Episodes; those of the run's config where left out."""
    split: Literal["test", "validation", "train"] = "test"
    """Seed family. Whatever is tuned is tuned on validation seeds."""
    robots: tuple[str, ...] = ()
    """Robots to predict; all of the data where left out."""
    out: Path | None = None
    """Folder to write to; rollouts/<name of the run> where left out."""
    trust: tuple[str, ...] = ()
    """Modules of your own, such as my_lab.tasks, that the run and the data may name."""


@dataclass(frozen=True)
class RunChoices:
    """Settings of a trained run that its rollouts can change."""

    rollout: RolloutSettings = field(default_factory=RolloutSettings)


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Predict episodes and write them."""
    run, flags, experiment = parse_rollout(arguments)
    keep_compiled_programs()
    predictor, step = load_predictor(run, experiment, flags.checkpoint)
    data, out = flags.data or experiment.data, flags.out or Path("rollouts") / default_name(run)
    check_out(out, data)
    episodes = select_episodes(data, flags.split, flags.robots or None)
    saved = None if step is None else checkpoint_time(run, step)
    headers = [(episode, rollout_header(experiment, step, saved, episode)) for episode in episodes]
    pending = [item for item in headers if not is_done(out, *item)]
    experiment.instructions.encode([record.instruction for (_, record), _ in pending])  # all at once, where that costs
    with (
        hold_lock(out),
        tqdm(total=len(pending), desc="rollout", unit="episode", file=sys.stderr) as progress,
        RolloutWriter(out, progress.update) as writer,
    ):
        remove_left_overs(out)
        predict_and_write(predictor, pending, writer)
    source = "published weights" if step is None else f"checkpoint {step}"
    print(f"{out}: {len(pending)} rollouts new, {len(headers) - len(pending)} there before, {source}")


def _find_trusted(words: Sequence[str]) -> list[str]:
    """Modules behind --trust among a command's arguments; an invalid name is an error later, when the options are parsed."""
    first = words.index("--trust") + 1 if "--trust" in words else len(words)
    given = itertools.takewhile(lambda word: not word.startswith("-"), words[first:])
    return [word for word in given if word.replace(".", "_").isidentifier() and ".." not in word]


def parse_rollout(arguments: Sequence[str] | None) -> tuple[Path, Flags, Experiment]:
    """Parse the command line: the run or config, the command's flags, and the experiment with its overrides.

    A run takes only --rollout.… overrides; a config with published weights takes all that are not flags too.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    path, prog, description = find_path(words, Flags), "python -m xew.model.rollout", __doc__.splitlines()[0]
    if path is not None and is_config(path):
        flags, experiment = parse_experiment(Flags, words, prog, description)
        return path, flags, experiment
    wrong = [word for word in words if word.startswith("--") and "." in word and not word.startswith("--rollout.")]
    if path is not None and wrong:
        raise ConfigError(f"{' '.join(wrong)}: a trained run takes only --rollout.… overrides (see --help for the rest).")
    admit(_find_trusted(words))  # the run's config is read before the options are parsed
    command = parse_command(
        Flags,
        RunChoices,
        lambda run: RunChoices(load_run_config(run).rollout),
        words,
        prog=prog,
        description=description,
        metavar="RUN",
    )
    admit(command.flags.trust)
    experiment = replace(load_run_config(command.path), rollout=command.config.rollout)
    check_experiment(experiment, str(command.path / "config.yaml"))
    return command.path, command.flags, experiment


if __name__ == "__main__":
    main()
