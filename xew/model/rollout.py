"""Rollouts: predict episodes with a trained model from their first frame and their commands.

Reads  a run, or a config that names published weights; episodes
Writes <out>/<task>/<seed>/<robot>/rgb.mkv (lossless, at the camera's size) and rollout.json

Rollouts of a tiled view are also cut into <out>-views/<view>/, one tree for each of its views.
Each GPU has a process, which predicts batches of episodes, reads the next two batches and writes the previous one at a time.
Command: python -m xew.model.rollout RUN --data DATA --split test [--robots … --out … --rollout.steps …]
"""

import functools
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from xew.command_line import find_path, parse_command
from xew.compilation import take_memory_as_needed
from xew.config import CONVERTER, ConfigError, admit, find_config, user_errors
from xew.dataset import Episode, remove_left_overs, view_episode, view_folder
from xew.episode import Record, episode_folder, read_record
from xew.files import hold_lock, read_json
from xew.model.episodes.choice import select_episodes
from xew.model.experiment import Experiment, parse_experiment
from xew.model.loading import is_config, open_predictor
from xew.model.runs.folder import load_run_config
from xew.model.runs.layout import checkpoint_time, list_steps
from xew.model.sampling.predict import Predictor
from xew.model.sampling.rolling import Item, roll_out
from xew.model.settings.checks import check_experiment
from xew.model.settings.settings import RolloutSettings
from xew.rollout import CODEC


def default_name(run: Path) -> str:
    """Default name of a run's rollouts."""
    run = find_config(run).resolve()
    return run.stem if is_config(run) else run.name


def find_step(run: Path, checkpoint: int | None) -> int | None:
    """The step of a run's checkpoint, by default the latest; None for published weights, or without checkpoints."""
    if is_config(run):
        return None
    return max(list_steps(run), default=None) if checkpoint is None else checkpoint


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
    frames = predicted_frames(record, max_frames)
    return {"model": model, "condition": condition, "source_hash": record.hashes["rgb"], "frame_count": frames}


def predicted_frames(record: Record, max_frames: int) -> int:
    """Number of frames of an episode that are predicted; 0 for `max_frames` predicts all."""
    return min(record.frame_count, max_frames) if max_frames else record.frame_count


def is_done(out: Path, episode: Episode, header: dict[str, Any]) -> bool:
    """Whether a rollout with this header exists already. The codec is the checkpoint's, and older rollouts do not name it."""
    _, record = episode
    folder = episode_folder(out, record.task, record.seed, record.robot)
    try:
        stored = dict(read_json(folder / "rollout.json"))
    except (OSError, ValueError, TypeError):
        return False
    stored.pop(CODEC, None)
    return stored == header and (folder / "rgb.mkv").exists()


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
    faults: bool = True
    """Predict episodes of faulty commands too, where the data hold them."""
    out: Path | None = None
    """Folder to write to (default: rollouts/<name of the run>)."""
    trust: tuple[str, ...] = ()
    """Custom modules, such as my_lab.tasks, that the run and the data may name."""


F = TypeVar("F", bound=Flags)
Predict = Callable[[Callable[[], Predictor], Sequence[Item], Path], None]
"""Function that predicts and writes episodes, as `roll_out`."""


@dataclass(frozen=True)
class RunChoices:
    """Settings of a run that rollouts can change."""

    rollout: RolloutSettings = field(default_factory=RolloutSettings)


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Predict episodes and write them."""
    run, flags, experiment = parse_rollout(arguments, Flags, "python -m xew.model.rollout", __doc__.splitlines()[0])
    predict_pending(run, flags, experiment, roll_out)


def predict_pending(
    run: Path,
    flags: Flags,
    experiment: Experiment,
    predict: Predict,
    out: Path | None = None,
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Predict the episodes that a command line chooses and that its folder lacks.

    Args:
        run, flags, experiment: the parsed command line.
        predict: predicts and writes them.
        out: folder to write to without --out (default: rollouts/<name of the run>).
        extra: further fields of rollout.json.
    """
    take_memory_as_needed()
    data, out = flags.data or experiment.data, flags.out or out or Path("rollouts") / default_name(run)
    check_out(out, data)
    episodes = select_episodes(view_folder(data, experiment.view), flags.split, flags.robots or None, flags.faults)
    step = find_step(run, flags.checkpoint)
    saved = None if step is None else checkpoint_time(run, step)
    headers = [(episode, rollout_header(experiment, step, saved, episode) | dict(extra or {})) for episode in episodes]
    pending = [item for item in headers if not is_done(out, *item)]
    with hold_lock(out):
        remove_left_overs(out)
        if pending:
            experiment.instructions.encode([record.instruction for (_, record), _ in pending])  # at once, where that costs
            predict(functools.partial(open_predictor, run, experiment, step), pending, out)
    source = "published weights" if step is None else f"checkpoint {step}"
    print(f"{out}: {len(pending)} rollouts new, {len(headers) - len(pending)} there before, {source}")


def _find_trusted(words: Sequence[str]) -> list[str]:
    """Modules after --trust in a command's arguments; parsing the options later rejects invalid names."""
    first = words.index("--trust") + 1 if "--trust" in words else len(words)
    names = itertools.takewhile(lambda word: not word.startswith("-"), words[first:])
    return [name for name in names if name.replace(".", "_").isidentifier() and ".." not in name]


def parse_rollout(arguments: Sequence[str] | None, kind: type[F], prog: str, description: str) -> tuple[Path, F, Experiment]:
    """Parse the command line: the run or config, the command's flags of this kind, and the experiment with its overrides.

    A run takes only --rollout.… overrides; a config with published weights takes all overrides.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    path = find_path(words, kind)
    if path is not None and is_config(path):
        flags, experiment = parse_experiment(kind, words, prog, description)
        return path, flags, experiment
    refused = [word for word in words if word.startswith("--") and "." in word and not word.startswith("--rollout.")]
    if path is not None and refused:
        raise ConfigError(f"{' '.join(refused)}: a trained run takes only --rollout.… overrides (see --help for the rest).")
    admit(_find_trusted(words))  # the run's config is read before the options are parsed
    command = parse_command(
        kind,
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
