"""Rollouts: predict episodes with a trained model from their first frame and their commands.

Reads  a run, or a config that names published weights; episodes
Writes <out>/<task>/<seed>/<robot>/rgb.mkv (lossless, at the camera's size) and rollout.json

Rollouts of a tiled view are also cut into <out>-views/<view>/, one tree for each of its views.
Episodes are predicted in batches over all devices, in parallel with reading the next two batches and writing the previous one.
Command: python -m xew.model.rollout RUN --data DATA --split test [--robots … --out … --rollout.steps …]
"""

import itertools
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
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
from xew.concurrency import map_in_order, usable_cores
from xew.config import CONVERTER, ConfigError, admit, find_config, is_packaged, user_errors
from xew.dataset import Episode, view_episode, view_folder
from xew.episode import Record, episode_folder, read_record, remove_left_overs
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
from xew.model.video.frames import Size, to_camera_size
from xew.rollout import write_rollout

Item = tuple[Episode, dict[str, Any]]
"""An episode to predict and the header of its rollout."""
WRITERS = min(8, usable_cores())
"""Number of threads that compress videos."""
WAITING = 16
"""Largest number of videos that wait for a writer."""


def load_predictor(run: Path, experiment: Experiment, step: int | None = None) -> tuple[Predictor, int | None]:
    """Load a run's model on each device, with the step of its checkpoint, or a config's published weights with step None.

    Args:
        run: folder of the run, or the config.
        experiment: its config, perhaps with other sampling settings.
        step: of the checkpoint, by default the latest.

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
    """The predictor with parameters in the types of their products, and a copy of the codec on each device."""
    params = jax.jit(cast_params, static_argnums=0)(network_graph(experiment.network.for_sampling), params)
    return make_predictor(experiment, jax.device_put(codec, replicated_sharding(mesh)), params, scales)


def is_config(run: Path) -> bool:
    """Whether a path is a config with published weights, not the folder of a run."""
    return run.suffix in (".yaml", ".yml") or is_packaged(run)


def default_name(run: Path) -> str:
    """Default name of a run's rollouts."""
    run = find_config(run).resolve()
    return run.stem if is_config(run) else run.name


def load_published(experiment: Experiment, source: Path) -> Predictor:
    """A config's network with its published weights.

    Raises:
        ConfigError: the config names no weights, or needs scales of training episodes.
    """
    if experiment.model.weights is None:
        raise ConfigError(f"{source} names no model.weights; set it to published weights, or give the folder of a run.")
    scaled = [condition.name for condition in experiment.conditions.values() if condition.scale != "none"]
    if scaled:
        raise ConfigError(f"{source}: {', '.join(scaled)} is scaled by training episodes; train a run and roll that out.")
    mesh = make_mesh(MeshSettings())
    graph, params = make_trainer(experiment.spec, mesh).random_network()
    params = load_dit_params(graph, params, experiment.model.weights)
    return _place_predictor(experiment, load_codec(experiment.encoding), params, mesh, {})


def check_out(out: Path, data: Path) -> None:
    """Raise ConfigError if rollouts would overwrite the episodes."""
    if out.resolve() == data.resolve():
        raise ConfigError(f"--out is {out}, the folder of the episodes; choose another --out.")


def rollout_header(experiment: Experiment, step: int | None, saved: int | None, episode: Episode) -> dict[str, Any]:
    """Content of rollout.json, independent of the batch size.

    `step` and `saved` (`checkpoint_time`) identify the checkpoint; they are None for published weights.
    """
    folder, record = episode
    action, embodiment = experiment.model.action, experiment.model.embodiment
    header = common_header(
        experiment.out.name,
        "+".join(name for name in (action, embodiment) if name != "none") or "none",
        record,
        experiment.rollout.max_frames,
    )
    config = CONVERTER.unstructure(replace(experiment, rollout=replace(experiment.rollout, batch=0)))
    if record.camera.parts:
        header["views"] = {part: read_record(view_episode(folder, part)).hashes["rgb"] for part in record.camera.parts}
    return header | {"checkpoint_step": step, "checkpoint_saved": saved, "config": config}


def common_header(model: str, condition: str, record: Record, max_frames: int = 0) -> dict[str, Any]:
    """The fields that every model's rollout.json has."""
    frames = min(record.frame_count, max_frames) if max_frames else record.frame_count
    return {"model": model, "condition": condition, "source_hash": record.hashes["rgb"], "frame_count": frames}


def is_done(out: Path, episode: Episode, header: dict[str, Any]) -> bool:
    """Whether a rollout with this header exists already."""
    _, record = episode
    folder = episode_folder(out, record.task, record.seed, record.robot)
    try:
        return read_json(folder / "rollout.json") == header and (folder / "rgb.mkv").exists()
    except (OSError, ValueError):
        return False


class RolloutWriter:
    """Writes rollouts in threads; the end of its `with` block waits for all. A failed write is raised by a later call.

    Args:
        out: root of the rollout tree.
        done: called in the caller's thread after each written rollout.
        resize: function of each video and the size of the camera's picture, applied before writing, or None.
    """

    def __init__(
        self, out: Path, done: Callable[[], Any], resize: Callable[[np.ndarray, Size], np.ndarray] | None = to_camera_size
    ) -> None:
        self.out, self.done, self.resize = out, done, resize
        self.threads = ThreadPoolExecutor(WRITERS)
        self.waiting: deque[Future[Path]] = deque()

    def write(self, record: Record, video: np.ndarray, header: dict[str, Any]) -> None:
        """Queue a video uint8 [t h w 3]."""
        self.waiting.append(self.threads.submit(self._write, record, video, header))
        while len(self.waiting) > WAITING or (self.waiting and self.waiting[0].done()):
            self._settle()

    def _write(self, record: Record, video: np.ndarray, header: dict[str, Any]) -> Path:
        resized = video if self.resize is None else self.resize(video, record.camera.size)
        name = record.task, record.seed, record.robot
        views, height = header.get("views", {}), resized.shape[1] // max(len(record.camera.parts), 1)
        for number, (view, source) in enumerate(views.items()):
            cut, own = resized[:, number * height : (number + 1) * height], header | {"source_hash": source}
            write_rollout(self.out.with_name(f"{self.out.name}-views") / view, *name, cut, own, record.frame_rate)
        return write_rollout(self.out, *name, resized, header, record.frame_rate)

    def _settle(self) -> None:
        self.waiting.popleft().result()
        self.done()

    def __enter__(self) -> "RolloutWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Write all queued videos, also after an error in the block."""
        self.threads.shutdown(wait=True)
        while kind is None and self.waiting:
            self._settle()


def predict_and_write(predictor: Predictor, pending: Sequence[Item], writer: RolloutWriter) -> None:
    """Roll out episodes in batches of similar length, and write them; threads read two batches ahead of the devices."""
    size = max(min(predictor.settings.batch, len(pending)), 1)
    ordered = sorted(pending, key=lambda item: item[1]["frame_count"])
    read = map_in_order(predictor.read, [episode for episode, _ in ordered], min(size, usable_cores()))
    started: deque[tuple[list[Item], Prediction]] = deque()

    def write_oldest() -> None:
        items, prediction = started.popleft()
        for ((_, record), header), video in zip(items, prediction.fetch(), strict=True):
            writer.write(record, video[: header["frame_count"]], header)

    for start in range(0, len(ordered), size):
        items = ordered[start : start + size]
        inputs = list(itertools.islice(read, len(items)))
        started.append((items, predictor.begin(inputs, items[-1][1]["frame_count"], size)))
        if len(started) > 1:
            write_oldest()
    while started:
        write_oldest()


@dataclass(frozen=True)
class Flags:
    """Options of the command itself."""

    checkpoint: int | None = None
    """Step of the run's checkpoint (default: the latest)."""
    data: Path | None = None
    """Data set (default: the run's)."""
    split: Literal["test", "validation", "train", "final"] = "test"
    """Seed family; use validation seeds for tuning."""
    robots: tuple[str, ...] = ()
    """Robots to predict (default: all in the data)."""
    out: Path | None = None
    """Folder to write to (default: rollouts/<name of the run>)."""
    trust: tuple[str, ...] = ()
    """Custom modules, such as my_lab.tasks, that the run and the data may name."""


@dataclass(frozen=True)
class RunChoices:
    """Settings of a run that rollouts can change."""

    rollout: RolloutSettings = field(default_factory=RolloutSettings)


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Predict episodes and write them."""
    run, flags, experiment = parse_rollout(arguments)
    keep_compiled_programs()
    predictor, step = load_predictor(run, experiment, flags.checkpoint)
    data, out = flags.data or experiment.data, flags.out or Path("rollouts") / default_name(run)
    check_out(out, data)
    episodes = select_episodes(view_folder(data, experiment.view), flags.split, flags.robots or None)
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
    """Modules after --trust in a command's arguments; parsing the options later rejects invalid names."""
    first = words.index("--trust") + 1 if "--trust" in words else len(words)
    names = itertools.takewhile(lambda word: not word.startswith("-"), words[first:])
    return [name for name in names if name.replace(".", "_").isidentifier() and ".." not in name]


def parse_rollout(arguments: Sequence[str] | None) -> tuple[Path, Flags, Experiment]:
    """Parse the command line: the run or config, the command's flags, and the experiment with its overrides.

    A run takes only --rollout.… overrides; a config with published weights takes all overrides.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    path, prog, description = find_path(words, Flags), "python -m xew.model.rollout", __doc__.splitlines()[0]
    if path is not None and is_config(path):
        flags, experiment = parse_experiment(Flags, words, prog, description)
        return path, flags, experiment
    refused = [word for word in words if word.startswith("--") and "." in word and not word.startswith("--rollout.")]
    if path is not None and refused:
        raise ConfigError(f"{' '.join(refused)}: a trained run takes only --rollout.… overrides (see --help for the rest).")
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
