"""Closed loop: a trained world model as a simulator, in which a policy acts on predicted frames.

Reads  a run, or a config that names published weights; of episodes the first frame, header, camera and commands
Writes <out>/<task>/<seed>/<robot>/rgb.mkv and rollout.json, as `python -m xew.model.rollout`

`WorldModelEnv` is a `gymnasium.vector.VectorEnv` (extra `policy`). An action is a chunk of commands, an observation the chunk
of frames that the model predicts for them. A step renders conditions of its own commands alone. With the recorded commands it
predicts what `rollout` does, to the byte on a CPU, if the model's conditions are causal. Two are not, because a loop cannot
know the commands to come:
    carried_render   finds grasps by a gripper's range over all commands, and draws what a later grasp uncovers
    a codec's head   sees the render of the frame after a chunk, which here is the chunk's last (`codec.sees_render`)
Command: python -m xew.model.simulate RUN --data DATA --split test --policy expert [--robots … --out … --rollout.steps …]
"""

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from xew.concurrency import map_in_order
from xew.config import user_errors
from xew.dataset import Episode
from xew.model import rollout
from xew.model.episodes.commands import Pictures, new_command
from xew.model.loading import load_predictor
from xew.model.runs.folder import load_run_config
from xew.model.sampling.predict import Continuation, Prediction, Predictor
from xew.model.sampling.reading import EpisodeInputs
from xew.model.sampling.rolling import Item
from xew.model.sampling.writing import RolloutWriter
from xew.model.video.frames import to_camera_size
from xew.policies.environment import PolicyEnv, demand_gymnasium, run_policy
from xew.policies.policy import Policy
from xew.policies.registry import open_policy, short_name


class WorldModelEnv(PolicyEnv):
    """A world model as an environment, in which predicted frames follow commands.

    The reward is 0: a video does not measure success, `python -m xew.metrics.evaluate` grades it.

    Args:
        predictor: the model (`load_environment` reads it from a run).
        episodes: where the environments begin, as of `PolicyEnv`.
        batch: least size of the batch; predictions of fewer episodes are filled up.

    Raises:
        ConfigError: as of `PolicyEnv`.
    """

    _started: Continuation | None
    """The prediction, once it has begun."""

    def __init__(self, predictor: Predictor, episodes: Sequence[Episode], batch: int = 1) -> None:
        self.predictor, self.batch = predictor, batch
        super().__init__(episodes, predictor.inputs.clip.frames - 1, predictor.settings.max_frames)

    def _open(self) -> None:
        self._started = None
        self._rendered: list[dict[str, Pictures]] = [{} for _ in self._scenes]

    def _advance(self) -> np.ndarray:
        inputs = list(map_in_order(self._make_inputs, range(self.num_envs)))
        self._started = self._started or self.predictor.start(inputs, self.batch)
        frames = np.asarray(self.predictor.extend(self._started, [streams for _, streams in inputs]))[: self.num_envs, 1:]
        return np.stack([self._to_camera(video) for video in frames])

    def _join_videos(self) -> list[np.ndarray]:
        """All frames [t h w 3] of each episode so far; frame 0 is the codec's reconstruction."""
        assert self._started is not None, "a step has begun it"
        seen = Prediction(self._started.chunks, self.num_envs, self._commands.shape[1]).fetch()
        return [self._to_camera(video) for video in seen]

    def _make_inputs(self, number: int) -> EpisodeInputs:
        """What the model is given of an episode: as recorded at its end, where a rollout repeats the last frame, too."""
        episode, states, first = self._scenes[number]
        action = self._commands[number, : episode[1].frame_count]
        command = new_command(*episode, states, action, first, self._rendered[number])
        return self.predictor.reader.make(episode, command, first)

    def _to_camera(self, video: np.ndarray) -> np.ndarray:
        return to_camera_size(video, self._records[0].camera.size)


def load_environment(run: Path, episodes: Sequence[Episode], checkpoint: int | None = None) -> WorldModelEnv:
    """The environment of a run's model, by default of its latest checkpoint. Raises ConfigError if there is none."""
    demand_gymnasium()
    return WorldModelEnv(load_predictor(run, load_run_config(run), checkpoint)[0], episodes)


@dataclass(frozen=True)
class Flags(rollout.Flags):
    """Options of the command itself."""

    out: Path | None = None
    """Folder to write to (default: rollouts/<name of the run>-<name of the policy>)."""
    policy: str = "expert"
    """expert, noisy_expert, module:NAME of a function of frames and `State` that returns commands, or lerobot:FOLDER of a
    policy that LeRobot trained on an export."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Run a policy in the world model and write the videos."""
    prog, description = "python -m xew.model.simulate", __doc__.splitlines()[0]
    run, flags, experiment = rollout.parse_rollout(arguments, Flags, prog, description)
    demand_gymnasium()
    policy, name = open_policy(flags.policy), short_name(flags.policy)
    out = Path("rollouts") / f"{rollout.default_name(run)}-{name}"
    extra = {"model": f"{experiment.out.name}-{name}", "policy": flags.policy}
    rollout.predict_pending(run, flags, experiment, functools.partial(simulate, policy), out, extra)


def simulate(policy: Policy, open_predictor: Callable[[], Predictor], pending: Sequence[Item], out: Path) -> None:
    """Run a policy in episodes, in batches of similar length, and write their videos."""
    predictor = open_predictor()
    size = max(min(predictor.settings.batch, len(pending)), 1)
    ordered = sorted(pending, key=lambda item: item[1]["frame_count"])
    with (
        tqdm(total=len(pending), desc="simulate", unit="episode", file=sys.stderr) as progress,
        RolloutWriter(out, progress.update, resize=None) as writer,
    ):
        for start in range(0, len(ordered), size):
            items = ordered[start : start + size]
            env = WorldModelEnv(predictor, [episode for episode, _ in items], size)
            for ((_, record), header), video in zip(items, run_policy(env, policy), strict=True):
                writer.write(record, video, header | predictor.header)


if __name__ == "__main__":
    main()
