"""Closed loop in the simulator: a policy acts on rendered frames, and physics decides what its commands cause.

`SimulatorEnv` is the counterpart of `xew.model.simulate.WorldModelEnv`, with success and progress of the task. Physics runs in
MuJoCo's C engine, a world a thread. With its own commands, an episode that was made on a CPU is repeated to the bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from xew.concurrency import map_in_order
from xew.config import ConfigError
from xew.dataset import Episode
from xew.episode import Record, data_folder
from xew.policies.environment import PolicyEnv, Scene
from xew.protocol import parse_change
from xew.sim_warp.cameras import place_camera
from xew.sim_warp.changes.looks import stage_of
from xew.sim_warp.changes.scenes import make_scene
from xew.sim_warp.kinematics.forward import tool_poses
from xew.sim_warp.physics.cpu import Stepper
from xew.sim_warp.physics.worlds import World
from xew.sim_warp.production.outcome import measure_outcome
from xew.sim_warp.rendering.observe import recording_world, scene_recording
from xew.sim_warp.rendering.render import Renderer
from xew.sim_warp.rendering.streams import default_renderer
from xew.sim_warp.robots import recorded_robot
from xew.sim_warp.scene import scene_hash
from xew.sim_warp.tasks import recorded_task


@dataclass(frozen=True)
class LiveScene:
    """A scene in which physics runs."""

    record: Record
    stepper: Stepper

    def advance(self, commands: np.ndarray) -> None:
        """Step to the last of all commands [t 16] since the first frame, no further than the recorded length."""
        self.stepper.step(commands[self.stepper.frame_count - 1 : self.record.frame_count])

    def draw(self, start: int, count: int, renderer: Renderer) -> np.ndarray:
        """The camera's `count` frames [t h w 3] uint8 from `start` on; the last one is repeated."""
        motion, world = self.stepper.motion(), self.stepper.world
        frames = np.minimum(np.arange(start, start + count), self.stepper.frame_count - 1)
        states = (array[frames] for array in (motion.joint_pos, motion.object_pose, motion.object_joint))
        recording = scene_recording(world.robot, world.scene, *states)
        camera = place_camera(self.record.camera, world.robot, recording.joint_pos)
        stage = stage_of(parse_change(self.record.change))
        return renderer.render_batch([recording_world(recording)], camera, stage=stage)[0].rgb

    def measure(self, commands: np.ndarray) -> tuple[bool, float]:
        """Success and progress at the last frame, after commands [t 16]; neither if the simulation has broken down."""
        motion, world = self.stepper.motion(), self.stepper.world
        if motion.overflow:
            return False, 0.0
        tools = tool_poses(world.robot, motion.joint_pos).astype(np.float32)
        task, action = recorded_task(self.record.task), commands[: self.stepper.frame_count]
        return measure_outcome(task, world.scene, action, motion, tools)


class SimulatorEnv(PolicyEnv):
    """The simulator as an environment. The reward is 1 where the task is solved at the last frame.

    `info` also holds `success` [n] bool and `progress` [n] float in [0, 1] at the last frame.

    Args:
        episodes: where the environments begin, as of `PolicyEnv`; one view.
        chunk: number of commands of an action and of frames of an observation.
        renderer: default: the process's shared one.

    Raises:
        ConfigError: as of `PolicyEnv`, or an episode is tiled, or of another version of its task.
    """

    def __init__(self, episodes: Sequence[Episode], chunk: int = 16, renderer: Renderer | None = None) -> None:
        self.renderer = renderer or default_renderer()
        super().__init__(episodes, chunk)

    @property
    def info(self) -> dict[str, Any]:
        """The state by name, with success and progress."""
        success, progress = zip(*self._outcomes, strict=True)
        return super().info | {"success": np.array(success), "progress": np.array(progress)}

    @property
    def rewards(self) -> np.ndarray:
        """Rewards [n]: 1 where the task is solved."""
        return np.array([float(success) for success, _ in self._outcomes])

    @property
    def joint_pos(self) -> np.ndarray:
        """Measured joints at the last frame [n 16] float32."""
        return np.stack([live.stepper.motion().joint_pos[-1] for live in self._live])

    def _open(self) -> None:
        self._live = [open_scene(scene) for scene in self._scenes]
        self._shown = [[scene.first] for scene in self._scenes]
        self._outcomes = [live.measure(commands) for live, commands in zip(self._live, self._commands, strict=True)]

    def _advance(self) -> np.ndarray:
        start = self._commands.shape[1] - self.chunk
        self._outcomes = list(map_in_order(_act, zip(self._live, self._commands, strict=True)))
        frames = np.stack([live.draw(start, self.chunk, self.renderer) for live in self._live])
        for shown, chunk in zip(self._shown, frames, strict=True):
            shown.append(chunk)
        return frames

    def _join_videos(self) -> list[np.ndarray]:
        return [np.concatenate(chunks) for chunks in self._shown]


def _act(place: tuple[LiveScene, np.ndarray]) -> tuple[bool, float]:
    live, commands = place
    live.advance(commands)
    return live.measure(commands)


def open_scene(scene: Scene) -> LiveScene:
    """The scene of an episode at its first command. Raises ConfigError if it is tiled or of another version of its task."""
    (folder, record), action = scene.episode, scene.states.action
    if record.camera.parts:
        raise ConfigError(f"{folder} is of a tiled view; choose one view of the data set.")
    made = make_scene(recorded_task(record.task), record.task, record.seed, record.change)
    if scene_hash(made) != record.scene_hash:
        raise ConfigError(f"{folder} is of another version of {record.task}, or was imported; generate the episode again.")
    robot = recorded_robot(record.robot, data_folder(folder))
    return LiveScene(record, Stepper(World(robot, made, action[:1])))
