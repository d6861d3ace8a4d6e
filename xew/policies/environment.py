"""Episodes in which a policy acts chunk by chunk, as a `gymnasium.vector.VectorEnv` (extra `policy`)."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from xew.config import ConfigError
from xew.dataset import Episode
from xew.episode import States, read_pixels, read_states
from xew.policies.policy import Policy, State
from xew.protocol import ACTION_DIM

try:
    from gymnasium import spaces
    from gymnasium.error import ResetNeeded
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:  # `demand_gymnasium` says so
    VectorEnv = object


class Scene(NamedTuple):
    """An episode that an environment begins with."""

    episode: Episode
    states: States
    first: np.ndarray
    """[1 h w 3] uint8, first frame."""


class PolicyEnv(VectorEnv):
    """Several episodes at once, which begin and are reset together. An action is a chunk of commands for each.

    An episode does not terminate; it is truncated at its recorded length.

    Args:
        episodes: where the environments begin, all with pictures of one size; `reset` takes others, as many.
        chunk: number of commands of an action and of frames of an observation.
        max_frames: number of frames after which an episode is truncated; 0 for its length.

    Raises:
        ConfigError: gymnasium is not installed, or the episodes do not fit together.
    """

    _commands: np.ndarray
    """[n t 16] float32, of all frames so far."""

    def __init__(self, episodes: Sequence[Episode], chunk: int, max_frames: int = 0) -> None:
        demand_gymnasium()
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED}
        self.num_envs, self.chunk, self.max_frames = len(episodes), chunk, max_frames
        self._begin(episodes)
        width, height = episodes[0][1].camera.size
        self.single_observation_space = spaces.Box(0, 255, (self.chunk, height, width, 3), np.uint8)
        self.single_action_space = spaces.Box(-np.inf, np.inf, (self.chunk, ACTION_DIM), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Return to the first frames, repeated to a chunk [n t h w 3] uint8, and the state by name.

        Args:
            seed: of `np_random`; nothing else depends on it.
            options: {"episodes": [...]} for other episodes.
        """
        super().reset(seed=seed)
        self._begin((options or {}).get("episodes", [scene.episode for scene in self._scenes]))
        first = np.stack([scene.first for scene in self._scenes])
        return first.repeat(self.chunk, axis=1), self.info

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """The chunk of frames [n t h w 3] uint8 that follows canonical commands [n t 16].

        Returns:
            Frames, rewards [n], whether episodes are terminated [n] (none is) and truncated [n], and the state by name.
        """
        if self._is_over.all():
            raise ResetNeeded("all episodes have ended; call reset().")
        self._commands = np.concatenate([self._commands, self._check(actions)], axis=1)
        frames = self._advance()
        return frames, self.rewards, np.zeros(self.num_envs, bool), self._is_over, self.info

    @property
    def state(self) -> State:
        """The state that a policy is given."""
        last = self._commands.shape[1] - 1
        following = np.arange(last + 1, last + 1 + self.chunk)
        recorded = [scene.states.action.take(following, axis=0, mode="clip") for scene in self._scenes]
        return State(self._records, last, self._commands[:, -1], self.joint_pos, np.stack(recorded))

    @property
    def info(self) -> dict[str, Any]:
        """The state by name."""
        return vars(self.state)

    @property
    def joint_pos(self) -> np.ndarray:
        """Joints at the last frame [n 16] float32."""
        return self._commands[:, -1]

    @property
    def rewards(self) -> np.ndarray:
        """Rewards [n] of the last step."""
        return np.zeros(self.num_envs)

    def videos(self) -> list[np.ndarray]:
        """The video [t h w 3] uint8 of each episode so far, at the camera's size. Raises ResetNeeded before the first step."""
        if self._commands.shape[1] < 2:
            raise ResetNeeded("there is no frame after the first yet; call step().")
        return [video[:length] for video, length in zip(self._join_videos(), self._lengths, strict=True)]

    def _open(self) -> None:
        """Begin `_scenes`."""
        raise NotImplementedError

    def _advance(self) -> np.ndarray:
        """The chunk of frames [n t h w 3] of the last commands in `_commands`."""
        raise NotImplementedError

    def _join_videos(self) -> Sequence[np.ndarray]:
        """All frames [t h w 3] of each episode so far."""
        raise NotImplementedError

    def _begin(self, episodes: Sequence[Episode]) -> None:
        sizes = {record.camera.size for _, record in episodes}
        if len(episodes) != self.num_envs or len(sizes) != 1:
            raise ConfigError(
                f"found {len(episodes)} episodes of {len(sizes)} picture sizes; expected {self.num_envs or 'at least one'}, "
                "of one size."
            )
        self._scenes = [read_scene(episode) for episode in episodes]
        self._records = tuple(record for _, record in episodes)
        counts = [record.frame_count for record in self._records]
        self._lengths = [min(count, self.max_frames or count) for count in counts]
        self._commands = np.stack([scene.states.action[:1] for scene in self._scenes])
        self._open()

    @property
    def _is_over(self) -> np.ndarray:
        """[n] bool, whether all frames of an episode have been reached; one of one frame takes a step, too."""
        return np.array([self._commands.shape[1] >= max(length, 2) for length in self._lengths])

    def _check(self, actions: np.ndarray) -> np.ndarray:
        """Actions as float32 [n t 16]. Raises ConfigError for another shape, or if they are not finite."""
        commands = np.asarray(actions, np.float32)
        expected = self.num_envs, self.chunk, ACTION_DIM
        if commands.shape != expected or not np.isfinite(commands).all():
            raise ConfigError(f"the policy gave commands {list(commands.shape)}; expected {list(expected)} finite numbers.")
        return commands


def demand_gymnasium() -> None:
    """Raise ConfigError if gymnasium is not installed."""
    if VectorEnv is object:
        raise ConfigError("an environment for policies needs gymnasium 1.1 or later: python -m pip install 'xew[policy]'.")


def read_scene(episode: Episode) -> Scene:
    """Read the first frame and the states of an episode. Raises EpisodeError if they are damaged."""
    folder, record = episode
    return Scene(episode, read_states(folder, record), read_pixels(folder, "rgb", most=1, record=record))


def run_policy(env: PolicyEnv, policy: Policy) -> list[np.ndarray]:
    """Let a policy act from the first frames until all episodes have ended; returns their videos [t h w 3] uint8."""
    frames, _ = env.reset()
    ended = np.zeros(env.num_envs, bool)
    while not ended.all():
        frames, _, _, ended, _ = env.step(policy(frames, env.state))
    return env.videos()
