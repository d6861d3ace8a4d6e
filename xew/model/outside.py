"""Custom models: predict the study's episodes with any video model, to grade its rollouts.

Reads  episodes, as `EpisodeInputs`
Writes <out>/<task>/<seed>/<robot>/rgb.mkv (lossless, the model's size) and rollout.json

A model `module:NAME` is a function of an `EpisodeInputs` that returns the video, or a class that is instantiated without
arguments and then called. For models that cannot run in this environment, `python -m xew.metrics.evaluate` grades any folder
tree of their videos (`xew.rollout`). Existing rollouts are kept: if the model has changed, delete them or give another --out.
Command: python -m xew.model.outside module:NAME --data DATA --split test --out rollouts/NAME
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol

import numpy as np
import tyro
from tqdm import tqdm

from xew.config import ConfigError, admit, import_named, user_errors
from xew.dataset import Episode, remove_left_overs, view_episode, view_folder
from xew.episode import read_pixels, read_record
from xew.files import hold_lock
from xew.model.episodes.choice import select_episodes
from xew.model.episodes.commands import episode_command
from xew.model.rollout import check_out, common_header, is_done
from xew.model.sampling.writing import RolloutWriter
from xew.protocol import HEAD, LEFT_GRIPPER, RIGHT_GRIPPER


@dataclass(frozen=True)
class EpisodeInputs:
    """Input of a custom model: first frame, instruction, commands and camera, but no measurement.

    It holds copies, so nothing in it leads to the true video or the recorded states.
    """

    task: str
    seed: int
    robot: str
    instruction: str
    frame_rate: float
    """Number of frames a second."""
    frame_count: int
    """Number of frames to predict, including the first."""
    first_frame: np.ndarray
    """Picture of the camera, uint8 [h w 3]; [240 320 3] of the head camera."""
    joints: np.ndarray
    """Commanded joints [rad] and grippers [0 closed, 1 open], float32 [t 16] (`xew.protocol`)."""
    tool_poses: np.ndarray
    """Commanded world poses of the left and right tool, float64 [t 2 7]: x y z [m] and quaternion x y z w."""
    intrinsics: np.ndarray
    """Matrix K of the camera, float64 [3 3] [pixels]."""
    extrinsics: np.ndarray
    """Matrix from the world to the camera (x right, y down, z forward), float64 [4 4], or [t 4 4] of a camera that the
    commands move."""
    robot_render: np.ndarray
    """Robot alone on white, posed by the commands: uint8 [t h w 3]."""
    streams: tuple[np.ndarray, np.ndarray] | None = None
    """Mask and optical flow of that robot, for models with `needs_streams` (`OutsideModel`)."""
    views: Mapping[str, "EpisodeInputs"] | None = None
    """The same of the views that a model with `views` asks for, by name (`OutsideModel`)."""

    @property
    def grippers(self) -> np.ndarray:
        """float32 [t 2], commanded, left and right: 0 closed, 1 open."""
        return self.joints[:, [LEFT_GRIPPER, RIGHT_GRIPPER]]

    @property
    def robot_mask(self) -> np.ndarray:
        """Mask of that robot, bool [t h w]. Raises ConfigError unless the model has `needs_streams`."""
        return self._stream(0)

    @property
    def optical_flow(self) -> np.ndarray:
        """That robot's exact motion to the next frame [pixels], float32 [t h w 2]. Raises ConfigError as `robot_mask`."""
        return self._stream(1)

    def _stream(self, number: int) -> np.ndarray:
        if self.streams is None:
            raise ConfigError(
                "the mask and the optical flow are not rendered for this model; give it the attribute `needs_streams = True`."
            )
        return self.streams[number]


class OutsideModel(Protocol):
    """A custom model. With the attribute `needs_streams = True` its inputs include mask and flow; with `views = ("head",
    "wrist_left")`, the inputs of these views. It predicts the view of --view."""

    def __call__(self, inputs: EpisodeInputs) -> np.ndarray:
        """Video uint8 [t h w 3] with t = inputs.frame_count, including the first frame; any h and w of the camera's ratio."""


def load_model(name: str) -> OutsideModel:
    """The model `module:NAME`; a class is instantiated. Raises ConfigError if there is none."""
    try:
        imported = import_named(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"cannot import the model {name!r}: {error}; expected module:NAME, as examples.own_model:freeze."
        ) from error
    model = imported() if isinstance(imported, type) else imported
    if not callable(model):
        raise ConfigError(f"the model {name!r} is a {type(model).__name__}; expected a function, or a class with __call__.")
    return model


def read_inputs(episode: Episode, max_frames: int = 0, streams: bool = False, views: Sequence[str] = ()) -> EpisodeInputs:
    """Inputs of an episode or of its first `max_frames` frames, also of other views; `streams` need Warp."""
    folder, record = episode
    frames = min(record.frame_count, max_frames) if max_frames else record.frame_count
    command = episode_command(folder, record)
    # Arrays are copied, because a view leads to its base, as the first frame to the true video.
    return EpisodeInputs(
        record.task,
        record.seed,
        record.robot,
        record.instruction,
        record.frame_rate,
        frames,
        first_frame=np.array(read_pixels(folder, "rgb", most=1, record=record)[0]),
        joints=np.array(command.action[:frames]),
        tool_poses=np.array(command.tools[:frames]),
        intrinsics=np.array(command.intrinsics),
        extrinsics=np.array(command.extrinsics),
        robot_render=np.array(command.render[:frames]),
        streams=(np.array(command.streams.mask[:frames]), np.array(command.streams.optical_flow[:frames])) if streams else None,
        views={view: read_inputs(find_view(folder, view), max_frames, streams) for view in views} if views else None,
    )


def find_view(folder: Path, view: str) -> Episode:
    """An episode in a view of its data set. Raises EpisodeError if the view does not have it."""
    seen = view_episode(folder, view)
    return seen, read_record(seen)


def predict(model: OutsideModel, name: str, inputs: EpisodeInputs) -> np.ndarray:
    """The model's video of an episode, [t h w 3] uint8. Raises ConfigError if it has another type or length."""
    video = np.asarray(model(inputs))
    if video.dtype != np.uint8 or video.ndim != 4 or video.shape[-1] != 3 or len(video) != inputs.frame_count:
        raise ConfigError(
            f"{name} gave {video.dtype} {list(video.shape)} for {inputs.task}/{inputs.seed}/{inputs.robot}; "
            f"expected uint8 [{inputs.frame_count} h w 3] (frame_count frames, including the first)."
        )
    return video


@dataclass(frozen=True)
class Args:
    """Options of a custom model's rollouts."""

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="module:NAME")]
    """A function or class, such as examples.own_model:freeze."""
    data: Path
    """Episodes."""
    split: Literal["test", "validation", "train", "final"] = "test"
    """Seed family; use validation seeds for tuning."""
    robots: tuple[str, ...] = ()
    """Robots to predict (default: all in the data)."""
    faults: bool = True
    """Predict episodes of faulty commands too, where the data hold them."""
    max_frames: int = 0
    """Number of frames to predict of each episode; 0 predicts all."""
    condition: str = ""
    """Name of the model's conditions, for the tables."""
    out: Path | None = None
    """Folder to write to (default: rollouts/NAME)."""
    trust: tuple[str, ...] = ()
    """Modules of custom tasks and robots, such as my_lab.tasks, that the data may name."""
    view: str = HEAD
    """View of the data set that the model predicts."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Predict episodes with a custom model, and write them."""
    args = tyro.cli(Args, args=arguments, prog="python -m xew.model.outside", description=__doc__.splitlines()[0])
    admit(args.trust)
    if args.max_frames < 0:
        raise ConfigError(f"--max-frames is {args.max_frames}; expected a number of frames, or 0 for all.")
    name = args.model.rpartition(":")[2]
    out = args.out or Path("rollouts") / name
    check_out(out, args.data)
    episodes = select_episodes(view_folder(args.data, args.view), args.split, args.robots or None, args.faults)
    items = [(e, common_header(name, args.condition, e[1], args.max_frames) | {"outside": args.model}) for e in episodes]
    pending = [item for item in items if not is_done(out, *item)]
    model = load_model(args.model)
    streams, views = bool(getattr(model, "needs_streams", False)), tuple(getattr(model, "views", ()))
    with (
        hold_lock(out),
        tqdm(total=len(pending), desc="rollout", unit="episode", file=sys.stderr) as progress,
        RolloutWriter(out, progress.update, resize=None) as writer,
    ):
        remove_left_overs(out)
        for episode, header in pending:
            inputs = read_inputs(episode, args.max_frames, streams, views)
            writer.write(episode[1], predict(model, args.model, inputs), header)
    print(f"{out}: {len(pending)} rollouts new, {len(items) - len(pending)} there before, {args.model}")


if __name__ == "__main__":
    main()
