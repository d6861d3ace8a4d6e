"""Closed loop: a trained world model as a simulator, in which a policy acts on predicted frames.

Reads  a run, or a config that names published weights; of episodes the first frame, header, camera and commands
Writes <out>/<task>/<seed>/<robot>/rgb.mkv and rollout.json, as `python -m xew.model.rollout`

`WorldModelEnv` is a `gymnasium.vector.VectorEnv` (extra `policy`). An action is a chunk of commands, an observation the chunk
of frames that the model predicts for them. With the recorded commands it predicts what `rollout` does, to the byte on a CPU,
if the model's conditions are causal. Two are not, because a loop cannot know the commands to come:
    carried_render   finds grasps by a gripper's range over all commands, and draws what a later grasp uncovers
    a codec's head   sees the render of the frame after a chunk, which here is the chunk's last (`codec.sees_render`)
Command: python -m xew.model.simulate RUN --data DATA --split test --policy expert [--robots … --out … --rollout.steps …]
"""

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from xew.concurrency import map_in_order
from xew.config import ConfigError, pick, user_errors
from xew.dataset import Episode
from xew.episode import Record, States, read_pixels, read_states
from xew.model import rollout
from xew.model.episodes.commands import new_command
from xew.model.loading import load_predictor
from xew.model.runs.folder import load_run_config
from xew.model.sampling.predict import Continuation, Prediction, Predictor, name_number
from xew.model.sampling.reading import EpisodeInputs
from xew.model.sampling.rolling import Item
from xew.model.sampling.writing import RolloutWriter
from xew.model.video.frames import to_camera_size
from xew.protocol import ACTION_DIM, ARMS

try:
    from gymnasium import spaces
    from gymnasium.error import ResetNeeded
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:  # `demand_gymnasium` says so
    VectorEnv = object

NOISE = 0.02
"""Standard deviation of the noisy expert's joints [rad]."""


@dataclass(frozen=True)
class State:
    """What a policy is given besides frames; also the `info` of an environment, by name."""

    records: tuple[Record, ...]
    """Headers of the episodes, with robot and instruction."""
    frame: int
    """Number of the last frame."""
    command: np.ndarray
    """[n 16] float32, the command in force at it, in the canonical layout (`xew.protocol`)."""
    recorded: np.ndarray
    """[n t 16] float32, the expert's commands of the next chunk, for baselines; the last one is repeated."""


Policy = Callable[[np.ndarray, State], np.ndarray]
"""Function of the last chunk of frames, uint8 [n t h w 3], and the state, that returns the next chunk's commands [n t 16]."""


class Scene(NamedTuple):
    """An episode that an environment begins with."""

    episode: Episode
    states: States
    first: np.ndarray
    """[1 h w 3] uint8, first frame."""


class WorldModelEnv(VectorEnv):
    """A world model as an environment for several episodes at once, which begin and are reset together.

    The reward is 0 and no episode terminates: a video does not measure success, `python -m xew.metrics.evaluate` grades it. An
    episode is truncated at its recorded length. Conditions of all commands so far are rendered in every step.

    Args:
        predictor: the model (`load_environment` reads it from a run).
        episodes: where the environments begin, all with pictures of one size; `reset` takes others, as many.
        batch: least size of the batch; predictions of fewer episodes are filled up.

    Raises:
        ConfigError: gymnasium is not installed, or the episodes do not fit together.
    """

    _commands: np.ndarray
    """[n t 16] float32, of all frames so far."""
    _started: Continuation | None
    """The prediction, once it has begun."""

    def __init__(self, predictor: Predictor, episodes: Sequence[Episode], batch: int = 1) -> None:
        demand_gymnasium()
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED}
        self.predictor, self.num_envs, self.batch = predictor, len(episodes), batch
        self.chunk = predictor.inputs.clip.frames - 1
        self._begin(episodes)
        width, height = episodes[0][1].camera.size
        self.single_observation_space = spaces.Box(0, 255, (self.chunk, height, width, 3), np.uint8)
        self.single_action_space = spaces.Box(-np.inf, np.inf, (self.chunk, ACTION_DIM), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Return to the first frames, repeated to a chunk [n t h w 3] uint8, and the state by name.

        Args:
            seed: of `np_random`; the model's noise depends on `rollout.seed` and the episodes alone.
            options: {"episodes": [...]} for other episodes.
        """
        super().reset(seed=seed)
        self._begin((options or {}).get("episodes", [scene.episode for scene in self._scenes]))
        first = np.stack([scene.first for scene in self._scenes])
        return first.repeat(self.chunk, axis=1), vars(self.state)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Predict the chunk of frames [n t h w 3] uint8 of canonical commands [n t 16].

        Returns:
            Frames, rewards [n] of 0, whether episodes are terminated [n] (none is) and truncated [n], and the state by name.
        """
        if self._is_over.all():
            raise ResetNeeded("all episodes have ended; call reset().")
        self._commands = np.concatenate([self._commands, self._check(actions)], axis=1)
        inputs = list(map_in_order(self._make_inputs, range(self.num_envs)))
        self._started = self._started or self.predictor.start(inputs, self.batch)
        frames = np.asarray(self.predictor.extend(self._started, [streams for _, streams in inputs]))[: self.num_envs, 1:]
        observed = np.stack([self._to_camera(video) for video in frames])
        nothing = np.zeros(self.num_envs)
        return observed, nothing, nothing.astype(bool), self._is_over, vars(self.state)

    @property
    def state(self) -> State:
        """The state that a policy is given."""
        last = self._commands.shape[1] - 1
        following = np.arange(last + 1, last + 1 + self.chunk)
        recorded = [scene.states.action.take(following, axis=0, mode="clip") for scene in self._scenes]
        return State(self._records, last, self._commands[:, -1], np.stack(recorded))

    def videos(self) -> list[np.ndarray]:
        """The video [t h w 3] uint8 of each episode so far, at the camera's size; frame 0 is the codec's reconstruction."""
        if self._started is None:
            raise ResetNeeded("no frame was predicted yet; call step().")
        seen = Prediction(self._started.chunks, self.num_envs, self._commands.shape[1]).fetch()
        return [self._to_camera(video[:length]) for video, length in zip(seen, self._lengths, strict=True)]

    def _begin(self, episodes: Sequence[Episode]) -> None:
        sizes = {record.camera.size for _, record in episodes}
        if len(episodes) != self.num_envs or len(sizes) != 1:
            raise ConfigError(
                f"found {len(episodes)} episodes of {len(sizes)} picture sizes; expected {self.num_envs or 'at least one'}, "
                "of one size."
            )
        self._scenes = [read_scene(episode) for episode in episodes]
        self._records = tuple(record for _, record in episodes)
        most = self.predictor.settings.max_frames
        self._lengths = [rollout.predicted_frames(record, most) for record in self._records]
        self._commands = np.stack([scene.states.action[:1] for scene in self._scenes])
        self._started = None

    @property
    def _is_over(self) -> np.ndarray:
        """[n] bool, whether all frames of an episode are predicted."""
        return np.array([self._started is not None and self._commands.shape[1] >= length for length in self._lengths])

    def _check(self, actions: np.ndarray) -> np.ndarray:
        """Actions as float32 [n t 16]. Raises ConfigError for another shape, or if they are not finite."""
        commands = np.asarray(actions, np.float32)
        expected = self.num_envs, self.chunk, ACTION_DIM
        if commands.shape != expected or not np.isfinite(commands).all():
            raise ConfigError(f"the policy gave commands {list(commands.shape)}; expected {list(expected)} finite numbers.")
        return commands

    def _make_inputs(self, number: int) -> EpisodeInputs:
        """What the model is given of an episode: as recorded at its end, where a rollout repeats the last frame, too."""
        episode, states, first = self._scenes[number]
        action = self._commands[number, : episode[1].frame_count]
        return self.predictor.reader.make(episode, new_command(*episode, states, action, first), first)

    def _to_camera(self, video: np.ndarray) -> np.ndarray:
        return to_camera_size(video, self._records[0].camera.size)


def demand_gymnasium() -> None:
    """Raise ConfigError if gymnasium is not installed."""
    if VectorEnv is object:
        raise ConfigError("xew.model.simulate needs gymnasium 1.1 or later: python -m pip install 'xew[policy]'.")


def read_scene(episode: Episode) -> Scene:
    """Read the first frame and the states of an episode. Raises EpisodeError if they are damaged."""
    folder, record = episode
    return Scene(episode, read_states(folder, record), read_pixels(folder, "rgb", most=1, record=record))


def load_environment(run: Path, episodes: Sequence[Episode], checkpoint: int | None = None) -> WorldModelEnv:
    """The environment of a run's model, by default of its latest checkpoint. Raises ConfigError if there is none."""
    demand_gymnasium()
    return WorldModelEnv(load_predictor(run, load_run_config(run), checkpoint)[0], episodes)


def run_policy(env: WorldModelEnv, policy: Policy) -> list[np.ndarray]:
    """Let a policy act from the first frames until all episodes have ended; returns their videos [t h w 3] uint8."""
    frames, _ = env.reset()
    ended = np.zeros(env.num_envs, bool)
    while not ended.all():
        frames, _, _, ended, _ = env.step(policy(frames, env.state))
    return env.videos()


def expert(frames: np.ndarray, state: State) -> np.ndarray:
    """The recorded commands [n t 16], whatever the frames [n t h w 3] show."""
    return state.recorded


def noisy_expert(frames: np.ndarray, state: State) -> np.ndarray:
    """The recorded commands [n t 16] with normal noise on the joints, which depends on the episode and the frame alone.

    `frames` [n t h w 3] are ignored; joints that a robot does not have stay 0.
    """
    keys = [[name_number(record), state.frame] for record in state.records]
    noise = np.stack([np.random.default_rng(key).normal(0, NOISE, state.recorded.shape[1:]) for key in keys])
    noise[..., [gripper for _, gripper in ARMS]] = 0
    return state.recorded + np.where(state.recorded == 0, 0, noise)


POLICIES: dict[str, Policy] = {"expert": expert, "noisy_expert": noisy_expert}
"""Policies of --policy."""


@dataclass(frozen=True)
class Flags(rollout.Flags):
    """Options of the command itself."""

    out: Path | None = None
    """Folder to write to (default: rollouts/<name of the run>-<name of the policy>)."""
    policy: str = "expert"
    """expert, noisy_expert, or module:NAME of a function of frames and `State` that returns commands."""


@user_errors
def main(arguments: Sequence[str] | None = None) -> None:
    """Run a policy in the world model and write the videos."""
    prog, description = "python -m xew.model.simulate", __doc__.splitlines()[0]
    run, flags, experiment = rollout.parse_rollout(arguments, Flags, prog, description)
    demand_gymnasium()
    policy = pick(POLICIES, flags.policy, "policy")
    name = flags.policy.rpartition(":")[2]
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
